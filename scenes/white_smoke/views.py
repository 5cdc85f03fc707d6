"""How many views does a smoke need? The fit of scenes/white_smoke from 5 to 50 of them, each at the same cost.

    python scenes/white_smoke/views.py [--counts 5 16 50] [-o runs/white_smoke_views]

Every fit is `mivol optimize scenes/white_smoke/fit.toml` with another number of views; each is measured on the same four views
that none has seen. Iterations draw four views each, so that fifty cost what five do.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol  # noqa: F401  (chooses the LLVM library; call it before the first variant)
from mivol.cli import main as mivol_main
from mivol.files import read_exr, read_volume, stack_layers
from mivol.report import figures, pixel_scale
from mivol.report.record import RunRecord, read_record

import matplotlib as mpl
import numpy as np

HERE = Path(__file__).parent


def fit(count: int, folder: Path, given: argparse.Namespace) -> RunRecord:
    """The experiment from ``count`` views."""
    changes = [
        'truth.file="data:smoke"',
        *(f"{rig}.{side}={given.size}" for rig in ("views", "held_out") for side in ("width", "height")),
        f"views.count={count}",
        f"fit.iterations={given.iterations}",
        f"event.0.at=[{given.iterations // 4}, {given.iterations // 2}]",
        f'title="The tutorial\'s smoke from {count} views"',
    ]
    flags = [part for change in changes for part in ("--set", change)]
    if mivol_main(["optimize", str(HERE / "fit.toml"), "-o", str(folder), *flags]):
        raise SystemExit(f"the fit from {count} views did not end well: see {folder / 'run.json'}.")
    return read_record(folder)


def main() -> None:
    """Fit, print a table, draw the figure."""
    given = arguments()
    records = {count: fit(count, given.output / f"{count}_views", given) for count in given.counts}
    for count, record in records.items():
        found = record.results
        print(
            f"{count:3d} views: {found['held_out_psnr']:.2f} dB on views not seen, nRMSE of the volume {found['nrmse']:.3f}, "
            f"{found['fit_seconds']:.0f} s"
        )
    figures.save_figure(draw(given.output, records), given.output / "views.png")
    print(given.output / "views.png")


def draw(folder: Path, records: dict[int, RunRecord]) -> mpl.figure.Figure:
    """Truth and reconstructions: a view that none has seen, and a slice; below them the errors against the number of views."""
    columns = len(records) + 1
    with mpl.rc_context(figures.STYLE):
        figure = mpl.figure.Figure(figsize=(1.9 * columns, 6.6))
        above, below = figure.subfigures(2, 1, height_ratios=(3, 2))
        views, slices = above.subplots(2, columns)
        first = next(iter(records))
        reference, _ = images(folder / f"{first}_views", records[first])
        scale = pixel_scale.shared_scale(reference)
        top = float(middle(folder / f"{first}_views", records[first], "truth").max())
        put(views[0], pixel_scale.to_pixels(reference, scale), "a view not seen")
        put(slices[0], hot(middle(folder / f"{first}_views", records[first], "truth"), top), "slice of the truth")
        for column, (count, record) in enumerate(records.items(), 1):
            home = folder / f"{count}_views"
            put(views[column], pixel_scale.to_pixels(images(home, record)[1], scale), f"from {count} views")
            put(slices[column], hot(middle(home, record, "reconstruction"), top), f"{count} views")
        names = {"held_out_psnr": "held-out PSNR [dB]", "nrmse": "nRMSE of the volume"}
        for number, (axes, (key, label)) in enumerate(zip(below.subplots(1, 2), names.items(), strict=True)):
            axes.plot(list(records), [r.results[key] for r in records.values()], marker="o", color=figures.SERIES[number])
            axes.set(xscale="log", xlabel="views", ylabel=label)
            axes.set_xticks(list(records), [str(count) for count in records])
            axes.minorticks_off()
    return figure


def images(home: Path, record: RunRecord) -> tuple[np.ndarray, np.ndarray]:
    """Reference and render of the first view that was held out."""
    path = next(image.path for image in record.images if image.held_out)
    parts = stack_layers(read_exr(home / path)[0])
    return parts["reference"], parts[""]


def middle(home: Path, record: RunRecord, role: str) -> np.ndarray:
    """The slice z = middle of the truth or the reconstruction."""
    path = next(volume.path for volume in record.volumes if volume.role == role)
    return pixel_scale.middle_slices(read_volume(home / path).values).images["xy"][..., 0]


def hot(values: np.ndarray, top: float) -> np.ndarray:
    """Values as colours, black at 0."""
    return mpl.colormaps["magma"](np.clip(values / top, 0, 1))


def put(axes: mpl.axes.Axes, rgb: np.ndarray, text: str) -> None:
    """A square picture with a line above it: the smoke's box is a cube, whatever its voxels are."""
    axes.imshow(rgb, aspect=rgb.shape[1] / rgb.shape[0])
    axes.set_title(text, fontsize=9, weight="normal")
    axes.set_axis_off()


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[5, 16, 50], help="numbers of views")
    parser.add_argument("--size", type=int, default=64, help="pixels along a side")
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/white_smoke_views"))
    return parser.parse_args()


if __name__ == "__main__":
    main()
