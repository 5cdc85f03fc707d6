"""What tests/readable_figures.py complains about."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from matplotlib.figure import Figure
from readable_figures import find_unreadable


def labelled() -> Figure:
    figure = Figure(figsize=(3, 2), layout="constrained")
    figure.subplots().set(title="A title", xlabel="x [length]")
    return figure


def test_a_figure_with_a_title_and_a_label_is_readable() -> None:
    assert find_unreadable(labelled()) == []


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lambda figure: figure.axes[0].set(title="", xlabel=""), "axes 0 have neither a title nor a label"),
        (lambda figure: figure.axes[0].title.set_fontsize(4), "'A title' has 4 pt"),
        (lambda figure: figure.text(0.9, 0.5, "A long note"), "'A long note' leaves the figure"),
        (lambda figure: figure.text(0.5, 0.93, "Another title"), "'Another title' lies on 'A title'"),
    ],
)
def test_a_fault_of_a_figure_is_found(spoil: Callable[[Figure], object], fault: str) -> None:
    figure = labelled()
    spoil(figure)
    (found,) = find_unreadable(figure)
    assert found.startswith(fault)
