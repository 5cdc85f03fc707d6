"""Fitted Gaussians in a bank of fog, on a floor, under a spot, beside a ball of steel and behind one of glass.

    mivol demo gaussians                                          # runs/gaussians/gaussians.ply, a minute and a half
    python scenes/fog/render.py [--gaussians FILE --box x y z to_x to_y to_z] [-o runs/fog]

Rays are traced through the Gaussians themselves, which are the emission of a medium: they shine with their own colours and take
light of the spot from the fog and from the floor behind them. Without the fitted ones a ball of splats stands in.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.files import write_exr, write_png
from mivol.points.gaussian_files import write_gaussians
from mivol.points.gaussians import Gaussians

import mitsuba as mi
import numpy as np

XML = Path(__file__).parent / "scene.xml"
FITTED = Path("runs/gaussians/gaussians.ply")
"""Where `mivol demo gaussians` leaves them."""

BOX = (-1.0, -1.0, -0.2, 1.0, 1.0, 0.6)
"""Two corners of what is taken of the still life [length]; stray Gaussians lie outside."""


def ball(count: int = 3000, seed: int = 0) -> Gaussians:
    """Flat splats on a ball that stands on the floor of ``BOX``, of a colour that changes with the place."""
    normal = np.random.default_rng(seed).normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turned = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(count)], axis=1)  # z to the normal
    return Gaussians(
        0.38 * normal + [0, 0, 0.2],
        np.tile(np.log([0.03, 0.03, 0.006]), (count, 1)),
        turned,
        np.full(count, 3.0),
        (1.5 * np.sin(6 * normal + [0, 2, 4]))[:, None],
    )


def load(cloud: Path, box: tuple[float, ...], **changes: float) -> mi.Scene:
    """The scene with Gaussians of a file in their place; ``changes`` are defaults of ``scene.xml``."""
    low, high = np.array(box[:3]), np.array(box[3:])
    middle = dict(zip(("x", "y", "z"), map(float, (low + high) / 2), strict=True))
    half = dict(zip(("wide", "deep", "high"), map(float, (high - low) / 2), strict=True))
    return mi.load_file(str(XML), cloud=str(cloud.resolve()), **middle, **half, **changes)


def main() -> None:
    """Render, and write the picture."""
    given = arguments()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)
    source = given.gaussians
    if source == FITTED and not source.exists():
        print(f"{FITTED} is not here: a ball of splats stands in for it (mivol demo gaussians makes it)")
        source = given.output / "ball.ply"
        write_gaussians(source, ball())
    sizes = {"width": 3 * given.size // 2, "height": given.size}
    image = np.array(mi.render(load(source, given.box, blur=given.blur, spp=given.spp, fog=given.fog, **sizes)))
    write_exr(given.output / "fog.exr", {"": image})
    write_png(given.output / "fog.png", image)
    print(given.output / "fog.png")


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaussians", type=Path, default=FITTED, help="any file of Gaussians")
    parser.add_argument("--box", type=float, nargs=6, default=BOX, help="what of it is taken [length]")
    parser.add_argument("--blur", type=float, default=0.01, help="the fit's low-pass filter, at its distance [length]")
    parser.add_argument("--fog", type=float, default=0.25, help="extinction of the fog [1/length]")
    parser.add_argument("--size", type=int, default=192, help="height of the picture [pixel]")
    parser.add_argument("--spp", type=int, default=128, help="samples a pixel")
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/fog"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
