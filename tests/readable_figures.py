"""What holds for every figure that a reader is shown."""

from __future__ import annotations

from itertools import combinations

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

SMALLEST_TEXT = 6.0
"""Font size that is legible in a figure of its natural size [pt]."""

SLACK = 1.0
"""Overlap of two texts, or a text beyond the edge of the figure, that no reader sees [pixel at 100 dpi]."""


def assert_readable(figure: Figure) -> None:
    """All axes are labelled, and all texts are large enough, inside the figure and apart from each other."""
    faults = find_unreadable(figure)
    assert not faults, faults


def find_unreadable(figure: Figure) -> list[str]:
    """What a reader of the figure would complain about, a sentence each."""
    FigureCanvasAgg(figure).draw()
    faults = [f"axes {k} have neither a title nor a label" for k, axes in enumerate(figure.axes) if not _is_labelled(axes)]
    texts = _texts(figure)
    boxes = {text: text.get_window_extent() for text in texts}
    faults += [f"{t.get_text()!r} has {t.get_fontsize():g} pt" for t in texts if t.get_fontsize() < SMALLEST_TEXT]
    width, height = figure.bbox.width, figure.bbox.height
    for text, box in boxes.items():
        if min(box.x0, box.y0, width - box.x1, height - box.y1) < -SLACK:
            faults.append(f"{text.get_text()!r} leaves the figure: {box.extents.round()} of {width:g} x {height:g} pixels")
    for one, other in combinations(texts, 2):
        a, b = boxes[one], boxes[other]
        if min(a.x1, b.x1) - max(a.x0, b.x0) > SLACK and min(a.y1, b.y1) - max(a.y0, b.y0) > SLACK:
            faults.append(f"{one.get_text()!r} lies on {other.get_text()!r}")
    return faults


def _texts(figure: Figure) -> list[Text]:
    """Titles, labels of axes, legends and notes; matplotlib places the labels of ticks itself."""
    found = [*figure.texts, *(text for part in figure.subfigs for text in part.texts)]
    for axes in figure.axes:
        found += [axes.title, axes._left_title, axes._right_title, *axes.texts]
        # Axes of a 3D plot draw themselves, though their axison is false.
        found += [axis.label for axis in axes._axis_map.values()] if axes.axison or axes.name == "3d" else []
        found += axes.get_legend().get_texts() if axes.get_legend() is not None else []
    return [text for text in found if text.get_visible() and text.get_text().strip()]


def _is_labelled(axes: Axes) -> bool:
    """Whether a title or a label stands at the axes, at axes in the same row or column, or at the figure."""
    place = axes.get_subplotspec()
    grid = [other for other in axes.figure.axes if other.get_subplotspec() is not None] if place is not None else []
    near = [o.get_subplotspec() for o in grid if o.get_subplotspec().get_gridspec() is place.get_gridspec()] if grid else []
    near = [s for s in near if set(s.rowspan) & set(place.rowspan) or set(s.colspan) & set(place.colspan)]
    labelled = [axes, *(other for other in grid if other.get_subplotspec() in near)]
    words = (word for a in labelled for word in (a.get_title(), a.get_title("left"), a.get_xlabel(), a.get_ylabel()))
    return any(words) or bool(axes.figure.texts)
