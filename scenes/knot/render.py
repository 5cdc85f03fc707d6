"""A knot of needles, 3D Gaussians that rays are traced through: it scatters the light of a lamp and casts shadows.

    python scenes/knot/render.py [--count 6000] [-o runs/knot]

Nothing is read: the Gaussians are made here, written as a PLY that any viewer of splats opens, and read by the scene.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.files import write_exr, write_png
from mivol.points.gaussian_files import write_gaussians
from mivol.points.gaussians import Gaussians, logit

import mitsuba as mi
import numpy as np

XML = Path(__file__).parent / "scene.xml"


def curve(angle: np.ndarray) -> np.ndarray:
    """A trefoil (n, 3) that lies between the heights -0.3 and 0.3."""
    wide = 2 + np.cos(3 * angle)
    return 0.3 * np.stack([wide * np.cos(2 * angle), wide * np.sin(2 * angle), np.sin(3 * angle)], axis=1)


def knot(count: int, seed: int = 0) -> Gaussians:
    """Grey needles along a trefoil, a little astray of it and of its direction; the scene gives them their albedo."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, count)
    means = curve(angle) + 0.05 * rng.normal(size=(count, 3))
    along = curve(angle + 1e-3) - curve(angle - 1e-3)
    along = along / np.linalg.norm(along, axis=1, keepdims=True) + 0.25 * rng.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turned = np.stack([1 + along[:, 0], np.zeros(count), -along[:, 2], along[:, 1]], axis=1)  # x to the needle
    scales, opacities = np.tile([0.05, 0.009, 0.009], (count, 1)), rng.uniform(0.3, 0.9, count)
    return Gaussians(means, np.log(scales), turned, logit(opacities), np.zeros((count, 1, 3)))


def main() -> None:
    """Make the knot, render it, write the picture."""
    given = arguments()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)
    cloud = given.output / "knot.ply"
    write_gaussians(cloud, knot(given.count))
    sizes = {"width": 3 * given.size // 2, "height": given.size}
    image = np.array(mi.render(mi.load_file(str(XML), cloud=str(cloud.resolve()), spp=given.spp, **sizes)))
    write_exr(given.output / "knot.exr", {"": image})
    write_png(given.output / "knot.png", image)
    print(given.output / "knot.png")


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=6000, help="needles")
    parser.add_argument("--size", type=int, default=160, help="height of the picture [pixel]")
    parser.add_argument("--spp", type=int, default=32, help="samples a pixel")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/knot"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
