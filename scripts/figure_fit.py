"""Draw what came of a fit: views that it has not seen beside their predictions, the volume beside the truth, and its errors.

    scripts/figure_fit.py RUN OUT.png [--truth 1.1 1.4 -0.6]

RUN is a folder of ``mivol optimize``. Held-out views and their differences share one scale; the slice is the middle one that
contains the ``up`` axis of the cameras. Where numbers were looked for, and no volume, they stand against the iteration, with
the ``--truth`` dashed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mivol  # noqa: F401  (chooses LLVM before anything loads it)
from mivol.files import read_exr, read_volume, stack_layers
from mivol.report import figures, pixel_scale
from mivol.report.record import RunRecord, read_metrics, read_record
from mivol.validate.metrics import psnr

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

MOST_VIEWS = 2


def held_out(folder: Path, record: RunRecord) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """(name, reference, render) of each view that was not fitted."""
    names = dict.fromkeys(i.view for i in record.images if i.held_out)
    found = []
    for name in names:
        path = next(i.path for i in record.images if i.view == name and i.role == "render")
        parts = stack_layers(read_exr(folder / path)[0])
        found.append((name, parts["reference"], parts[""]))
    return found


def noise_of(folder: Path, record: RunRecord, name: str, reference: np.ndarray) -> str:
    """How near a perfect render would come to a reference that has noise, where that is known."""
    path = next((i.path for i in record.images if i.view == name and i.role == "standard error"), None)
    if path is None:
        return ""
    error = stack_layers(read_exr(folder / path)[0])["standard_error"]
    return f" (the truth itself would have {20 * np.log10(reference.max() / np.sqrt(np.mean(np.square(error)))):.1f} dB)"


def show_views(rows: list[list[Axes]], views: list[tuple[str, np.ndarray, np.ndarray]]) -> None:
    """A row for each view: reference, prediction, difference."""
    scale = pixel_scale.shared_scale(*(reference for _, reference, _ in views))
    signed = pixel_scale.Scale("signed", -0.2 * scale.high, 0.2 * scale.high)
    for row, (_, reference, render) in zip(rows, views, strict=True):
        texts = ("not seen (Mitsuba)", f"predicted, {psnr(render, reference):.1f} dB", f"difference, ±{0.2 * scale.high:.2g}")
        pictures = ((reference, scale), (render, scale), (render - reference, signed))
        for axes, (image, how), text in zip(row, pictures, texts, strict=True):
            put(axes, pixel_scale.to_pixels(image, how), text)


def show_slices(grid: dict[str, Axes], folder: Path, record: RunRecord) -> None:
    """The slice of truth and reconstruction."""
    plane = "xz" if record.config["views"].get("up") == "z" else "xy"
    grids = {v.role: (read_volume(folder / v.path).values, v.size) for v in record.volumes}
    cuts = {role: pixel_scale.middle_slices(*grids[role]) for role in ("truth", "reconstruction")}
    top = float(cuts["truth"].images[plane].max())
    for role, cut in cuts.items():
        image = mpl.colormaps["magma"](np.clip(cut.images[plane][..., 0] / top, 0, 1))
        put(grid[role], image, f"{role}, slice", cut.aspect[plane])


def show_numbers(axes: Axes, rows: list[dict], names: list[str], truth: list[float]) -> None:
    """Numbers that were found against the iteration."""
    for number, name in enumerate(names):
        seen = [(row["iteration"], row[name]) for row in rows if row.get(name) is not None]
        axes.plot(*zip(*seen, strict=True), color=figures.SERIES[number % 6], marker="o", markersize=3, label=name)
    for number, value in enumerate(truth):
        axes.axhline(value, color=figures.SERIES[number % 6], linestyle="--", linewidth=1)
    axes.set_xlabel("iteration")
    axes.set_title("found (dashed: true)" if truth else "found", fontsize=9, weight="normal")
    axes.legend()


def show_curve(axes: Axes, rows: list[dict]) -> None:
    """PSNR of held-out views, and the error of the volume, against the iteration."""
    seen = [(r["iteration"], r["held_out_psnr"], r.get("nrmse")) for r in rows if r.get("held_out_psnr") is not None]
    iteration, quality, error = zip(*seen, strict=True)
    axes.plot(iteration, quality, color=figures.SERIES[0], marker="o", markersize=3)
    axes.set_xlabel("iteration")
    axes.set_ylabel("held-out PSNR [dB]", color=figures.SERIES[0])
    if None not in error:
        other = axes.twinx()
        other.plot(iteration, error, color=figures.SERIES[1], marker="s", markersize=3)
        other.set_ylim(0, 1.05)
        other.grid(False)
        other.set_ylabel("nRMSE of the volume", color=figures.SERIES[1])


def put(axes: Axes, rgb: np.ndarray, text: str, aspect: float | None = None) -> None:
    """A picture with a line above it."""
    axes.imshow(rgb, aspect=rgb.shape[1] / rgb.shape[0] / aspect if aspect else None)
    axes.set_title(text, fontsize=9, weight="normal")
    axes.set_axis_off()


def main(folder: Path, out: Path, truth: list[float]) -> None:
    """Print the numbers, draw the figure."""
    record, rows = read_record(folder), read_metrics(folder)
    for name, value in record.results.items():
        print(f"{name}: {value:.4g}")
    views = held_out(folder, record)
    for name, reference, render in views:
        print(f"{name}: {psnr(render, reference):.2f} dB{noise_of(folder, record, name, reference)}")
    views = views[:MOST_VIEWS]
    names = [name for name in record.results if name.endswith("]")]
    last = ["numbers", "numbers", "curve"] if names else ["truth", "reconstruction", "curve"]
    with mpl.rc_context(figures.STYLE):
        figure = Figure(figsize=(8.2, 2.7 * (len(views) + 1)))
        grid = figure.subplot_mosaic([*([f"{row} {column}" for column in range(3)] for row in range(len(views))), last])
        show_views([[grid[f"{row} {column}"] for column in range(3)] for row in range(len(views))], views)
        if names:
            show_numbers(grid["numbers"], rows, names, truth)
        else:
            show_slices(grid, folder, record)
        show_curve(grid["curve"], rows)
    figures.save_figure(figure, out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--truth", type=float, nargs="*", default=[])
    given = parser.parse_args()
    main(given.run, given.out, given.truth)
