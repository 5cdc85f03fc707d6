"""Smoke that was reconstructed under a white sky, rendered under lamps that it never saw, against the true smoke under them.

    mivol optimize scenes/white_smoke/fit.toml
    python scenes/relit_smoke/relight.py [--volume runs/white_smoke/volumes/..._reconstruction.vol] [-o runs/relit_smoke]

The reference is the true smoke by Mitsuba's volpath at the same depth; the render is the reconstruction by mivol. Beside them
stands the reconstruction's mass spread evenly inside its hull: what the right outline alone would give.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.experiments.examples import EXAMPLES
from mivol.files import read_volume, write_volume
from mivol.report import figures, pixel_scale
from mivol.validate.metrics import psnr
from mivol.validate.reference import render_reference

import matplotlib as mpl
import mitsuba as mi
import numpy as np

HERE = Path(__file__).parent
XML = HERE / "scene.xml"
FOUND = Path("runs/white_smoke/volumes/smoke_interior_medium_sigma_t_data_reconstruction.vol")
"""Where `mivol optimize scenes/white_smoke/fit.toml` leaves the reconstruction."""


def flat(values: np.ndarray) -> np.ndarray:
    """The same mass, spread evenly over the voxels above a tenth of the largest value."""
    inside = values > 0.1 * values.max()
    return np.where(inside, values.sum() / inside.sum(), 0.0).astype(np.float32)


def render(volume: Path, given: argparse.Namespace) -> np.ndarray:
    """A smoke under the lamps, by mivol."""
    scene = mi.load_file(str(XML), volume=str(volume.resolve()), size=given.size)
    return np.array(mi.render(scene, spp=given.spp))


def main() -> None:
    """Print the PSNR, draw the figure."""
    given = arguments()
    mi.set_variant("llvm_ad_rgb")
    given.output.mkdir(parents=True, exist_ok=True)
    truth = render_reference(
        XML, given.output / "references", max_depth=2, max_spp=given.reference_spp, progress=False,
        overrides={"volume": EXAMPLES["white_smoke"].stand_in.place(given.truth, given.output), "size": given.size},
    )  # fmt: skip
    found = read_volume(given.volume, frame="unit").values
    write_volume(given.output / "flat.vol", flat(found))
    images = {"reconstruction": render(given.volume, given), "its mean in its hull": render(given.output / "flat.vol", given)}
    ceiling = psnr(truth.mean + np.sqrt(truth.variance), truth.mean)
    print(f"reference: standard error {truth.standard_error:.2g}, no render can be nearer to it than {ceiling:.1f} dB")
    for name, image in images.items():
        print(f"{name}: {psnr(image, truth.mean):.2f} dB")
    figures.save_figure(draw(truth.mean, images), given.output / "relit_smoke.png")
    print(given.output / "relit_smoke.png")


def draw(reference: np.ndarray, images: dict[str, np.ndarray]) -> mpl.figure.Figure:
    """The true smoke, and under it nothing; each render, and under it its difference."""
    scale = pixel_scale.shared_scale(reference)
    signed = pixel_scale.Scale("signed", -0.25 * scale.high, 0.25 * scale.high)
    with mpl.rc_context(figures.STYLE):
        figure = mpl.figure.Figure(figsize=(8.4, 6.0))
        grid = figure.subplots(2, 3)
        put(grid[0, 0], pixel_scale.to_pixels(reference, scale), "true smoke (volpath)")
        for column, (name, image) in enumerate(images.items(), 1):
            put(grid[0, column], pixel_scale.to_pixels(image, scale), f"{name}, {psnr(image, reference):.1f} dB")
            put(grid[1, column], pixel_scale.to_pixels(image - reference, signed), f"difference, ±{signed.high:.2g}")
        grid[1, 0].set_axis_off()
    return figure


def put(axes: mpl.axes.Axes, rgb: np.ndarray, text: str) -> None:
    """A picture with a line above it."""
    axes.imshow(rgb)
    axes.set_title(text, fontsize=9, weight="normal")
    axes.set_axis_off()


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--volume", type=Path, default=FOUND, help="reconstruction, .vol")
    parser.add_argument("--truth", default="data:smoke")
    parser.add_argument("--size", type=int, default=128, help="pixels along a side")
    parser.add_argument("--spp", type=int, default=256, help="samples of mivol's renders")
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/relit_smoke"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
