"""What a figure looks like, as text: each thing that is drawn, with the properties that the code of a figure can set.

What matplotlib computes itself when it lays out a figure (positions in pixels, where ticks stand) is left out, so that another
release of it changes nothing here.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text

RECORDED = Path(__file__).parent / "looks"


def assert_recorded(name: str, figure: Figure, record: bool) -> None:
    """Compare a figure with what was recorded of it, or record it anew (``pytest --record``): save it and look at it before."""
    path, found = RECORDED / f"{name}.txt", look_of(figure)
    if record:
        path.parent.mkdir(exist_ok=True)
        path.write_text(found, encoding="utf-8")
    assert found.splitlines() == path.read_text(encoding="utf-8").splitlines()


def look_of(figure: Figure) -> str:
    """A figure in lines of text, one a thing that is drawn."""
    lines = [f"figure {_numbers(figure.get_size_inches())} inches, {figure.dpi:g} dpi, {_layout(figure)}"]
    for axes in figure.axes:
        lines += ["", *_axes(axes)]
    for part in (figure, *figure.subfigs):
        lines += [_text("above all", text) for text in part.texts if text.get_text()]
    return "\n".join(lines) + "\n"


def _layout(figure: Figure) -> str:
    engine = figure.get_layout_engine()
    return f"{type(engine).__name__} with {engine.get()}"


def _axes(axes: Axes) -> Iterator[str]:
    if not axes.axison:
        yield "axes that are not shown"
    yield f"axes {axes.get_xscale()} {axes.get_yscale()}, aspect {axes.get_aspect()}, limits {_limits(axes)}"
    yield f"  margins {_numbers(axes.margins())}, grid below {axes.get_axisbelow()}, title {_title_pad(axes):g} pt above"
    if hasattr(axes, "elev"):
        yield f"  seen from {axes.elev:g} and {axes.azim:g} degrees"
    if hasattr(axes, "_colorbar_info"):
        bar = axes._colorbar_info
        numbers = _numbers([bar[key] for key in ("fraction", "pad", "aspect")])
        yield f"  colour bar {bar['location']} of {len(bar['parents'])}: {numbers}"
    for side, spine in axes.spines.items():
        if spine.get_visible():
            yield f"  spine {side} {to_hex(spine.get_edgecolor())} {spine.get_linewidth():g}"
    for where in ("left", "center", "right"):
        title = {"left": axes._left_title, "center": axes.title, "right": axes._right_title}[where]
        if title.get_text():
            yield _text(f"  title {where}", title)
    yield from _axis("x", axes.xaxis)
    yield from _axis("y", axes.yaxis)
    for line in axes.lines:
        yield _line(line)
    for dots in axes.collections:
        if isinstance(dots, PathCollection):
            yield _dots(dots)
        if isinstance(dots, LineCollection):
            yield f"  bars {to_hex(dots.get_color()[0])}: {_summary(np.ravel(dots.get_segments()))}"
    for bar in axes.patches:
        yield f"  bar {to_hex(bar.get_facecolor())}: {_numbers(bar.get_bbox().bounds)}"
    for image in axes.images:
        yield _image(image)
    for text in axes.texts:
        yield _text("  text", text)
    if axes.get_legend() is not None:
        yield _legend(axes.get_legend())


def _axis(name: str, axis: Axis) -> Iterator[str]:
    if axis.label.get_text():
        yield _text(f"  {name} label, pad {axis.labelpad:g}", axis.label)
    places = axis.get_majorticklocs()
    if not len(places):
        return
    tick = axis.get_major_ticks()[0]
    mark, grid = tick.tick1line, tick.gridline
    labels = " ".join(label.get_text() for label in axis.get_ticklabels() if label.get_text())
    size = tick.label1.get_fontsize()
    yield f"  {name} ticks {mark.get_markersize():g} {to_hex(mark.get_color())} of {size:g} pt at {_summary(places)}: {labels}"
    if grid.get_visible():
        yield f"  {name} grid {to_hex(grid.get_color())} {grid.get_linewidth():g}"


def _line(line: Line2D) -> str:
    marker = f", {line.get_marker()} {line.get_markersize():g} edge {to_hex(line.get_markeredgecolor())}"
    edge = f" {line.get_markeredgewidth():g}" if line.get_marker() not in ("None", None, "") else ""
    pen = f"{to_hex(line.get_color())} {line.get_linewidth():g} {line.get_linestyle()} alpha {line.get_alpha()}"
    data = f"{_summary(line.get_xdata())} over {_summary(line.get_ydata())}"
    drawn = f"{pen}{marker if edge else ''}{edge}, above {line.get_zorder():g}, {_clipped(line)}"
    return f"  line {line.get_label()!r} {drawn}: {data}"


def _dots(dots: PathCollection) -> str:
    return (
        f"  dots {to_hex(dots.get_facecolor()[0])}, sizes {_numbers(dots.get_sizes())}, edges {_numbers(dots.get_linewidths())}"
    )


def _clipped(line: Line2D) -> str:
    return "clipped" if line.get_clip_on() else "not clipped"


def _image(image: AxesImage) -> str:
    pixels = np.asarray(image.get_array(), float)
    corners = [_numbers(pixels[r, c]) for r, c in ((0, 0), (0, -1), (-1, 0), (-1, -1))]
    colours = f"{image.get_cmap().name} from {_summary(image.get_clim())}" if pixels.ndim == 2 else "rgb"
    place = f"{pixels.shape} of {_numbers(image.get_extent())}"
    return f"  image {place}, {colours}, {image.get_interpolation()}, corners {' | '.join(corners)}"


def _text(what: str, text: Text) -> str:
    place = f" at {_numbers(text.get_position())}" if what.strip() == "text" else ""
    found = f"{what} {text.get_text()!r} {text.get_fontsize():g} pt {text.get_fontweight()} {to_hex(text.get_color())}"
    found += f" {text.get_ha()} {text.get_va()}{place} {text.get_fontfamily()[0]}"
    if isinstance(text, Annotation):
        found += f", of {_numbers(text.xy)}, {text.anncoords}"
        if text.arrow_patch is not None:
            arrow = text.arrow_patch
            found += (
                f", arrow {to_hex(arrow.get_edgecolor())} {arrow.get_linewidth():g} shrunk {arrow.shrinkA:g} {arrow.shrinkB:g}"
            )
            found += f" {type(arrow.get_arrowstyle()).__name__}"
    return found


def _legend(legend: Legend) -> str:
    rows = [text.get_text() for text in legend.get_texts()]
    size = legend.get_texts()[0].get_fontsize()
    anchor = legend._bbox_to_anchor
    place = "in the axes" if anchor is None else f"at {_numbers(anchor._bbox.get_points().ravel())}"
    shape = f"spacing {legend.labelspacing:g}, handles {legend.handlelength:g}"
    return f"  legend {rows} {size:g} pt, frame {legend.get_frame_on()}, {shape}, {legend._loc}, {place}"


def _title_pad(axes: Axes) -> float:
    return axes.titleOffsetTrans.get_matrix()[1, 2] * 72 / axes.get_figure().dpi


def _limits(axes: Axes) -> str:
    return f"{_numbers(axes.get_xlim())} and {_numbers(axes.get_ylim())}"


def _summary(values: object) -> str:
    """Few numbers as they are, of many their count and range."""
    return _numbers(values) if len(values) <= 9 else f"{len(values)} of {_numbers([np.nanmin(values), np.nanmax(values)])}"


def _numbers(values: object) -> str:
    return " ".join(f"{value:.5g}" for value in np.ravel(np.asarray(values, float)))
