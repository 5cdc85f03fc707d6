"""Draw the picture of the README from a finished demo: what was seen, what is predicted, and the volume beside the truth.

scripts/figure_readme.py [runs/demo] [docs/demo.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import mivol  # noqa: F401  (chooses LLVM before anything loads it)
from mivol.files import read_exr, read_volume
from mivol.report.figures import save_figure
from mivol.report.record import read_record

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def image(folder: Path, path: str) -> np.ndarray:
    """One EXR as grey (H, W)."""
    channels, _ = read_exr(folder / path)
    return np.mean([channels[c] for c in "RGB"], axis=0)


def main(folder: Path, out: Path) -> None:
    """Four panels in a row: a view that was not fitted, its prediction, and a slice of truth and reconstruction."""
    record = read_record(folder)
    held = [i for i in record.images if i.held_out and i.path.endswith(".exr")]
    view = held[0].view
    pair = {i.role: image(folder, i.path) for i in held if i.view == view}
    volume = {v.role: read_volume(folder / v.path).values[..., 0] for v in record.volumes}
    middle = volume["truth"].shape[0] // 2
    top = volume["truth"].max()
    panels = [
        ("a view it has not seen (Mitsuba)", pair["reference"], 1.0),
        ("the same view, reconstructed", pair["render"], 1.0),
        ("a slice of the true volume", volume["truth"][middle], top),
        ("the slice, reconstructed", volume["reconstruction"][middle], top),
    ]
    figure = Figure(figsize=(10, 2.67), constrained_layout=True)
    FigureCanvasAgg(figure)
    for axes, (title, pixels, high) in zip(figure.subplots(1, 4), panels, strict=True):
        axes.imshow(pixels, cmap="gray" if high == 1.0 else "magma", vmin=0, vmax=high, interpolation="nearest")
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_axis_off()
    out.parent.mkdir(exist_ok=True)
    save_figure(figure, out)


if __name__ == "__main__":
    given = [Path(a) for a in sys.argv[1:]]
    main(*(given + [Path("runs/demo"), Path("docs/demo.png")][len(given) :]))
