"""Figures of several panels in the style of mivol's reports."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib as mpl
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from mivol.report.figures import STYLE, save_figure

__all__ = ["drawn", "plain_ticks"]


@contextmanager
def drawn(path: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure of that many inches to draw on; it is written to ``path`` (.png or .svg) when the block ends."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        FigureCanvasAgg(figure)
        yield figure
    save_figure(figure, path)


def plain_ticks(axis: Axis, unit: str) -> None:
    """Few labels on a logarithmic axis, as plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}{unit}"))
    axis.set_minor_formatter(NullFormatter())
