"""Figures of several panels in the style of mivol's reports."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from mivol.report.figures import MARKERS, SERIES, STYLE, save_figure

__all__ = ["new_figure", "plot_errors", "plot_ratios", "show_images", "use_plain_ticks"]


@contextmanager
def new_figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """An empty figure, written to ``path`` (.png or .svg) when the block ends; width and height in inches."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        yield figure
    save_figure(figure, path)


def use_plain_ticks(axis: Axis, unit: str = "") -> None:
    """Label a logarithmic axis with few, plain numbers and a unit."""
    axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}{unit}"))
    axis.set_minor_formatter(NullFormatter())


def plot_errors(
    axes: Axes, curves: dict[str, tuple[Sequence[float], Sequence[float]]], log: bool = True, **style: float | str
) -> None:
    """Plot one line for each method (seconds, errors); ``log``: on logarithmic axes."""
    plot = axes.loglog if log else axes.plot
    for i, (name, (seconds, errors)) in enumerate(curves.items()):
        plot(seconds, errors, marker=MARKERS[i], color=SERIES[i], label=name, **style)


def plot_ratios(
    axes: Axes, labels: Sequence[str], series: dict[str, Sequence[float]], bars: Iterable[float], first: int = 0
) -> None:
    """Plot ratios on a logarithmic axis, one row for each label from top to bottom, with a line at each common bar.

    Args:
        labels: names of the rows.
        series: ratios of each row, by name; the colours begin at number ``first``.
        bars: positions of lines, in the colours 0, 1, ...
    """
    rows = np.arange(len(labels))[::-1]
    for i, (name, ratios) in enumerate(series.items(), first):
        axes.semilogx(ratios, rows, MARKERS[i], color=SERIES[i], label=name)
    for i, bar in enumerate(bars):
        axes.axvline(bar, color=SERIES[i], linestyle="--", linewidth=1.2)
    axes.set(yticks=rows, yticklabels=list(labels))
    use_plain_ticks(axes.xaxis, "×")


def show_images(panels: Iterable[Axes], images: dict[str, np.ndarray], **title: float) -> None:
    """Show images (H, W, 3), clipped to [0, 1], with their titles; the other panels stay empty."""
    for axes in (panels := list(panels)):
        axes.set_axis_off()
    for axes, (name, image) in zip(panels, images.items(), strict=False):
        axes.imshow(np.clip(image, 0, 1))
        axes.set_title(name, **title)
