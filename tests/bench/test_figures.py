"""Figures are written when their block ends; axes of ratios have plain numbers."""

from __future__ import annotations

from pathlib import Path

import pytest

from mivol.bench.harness.figures import new_figure, use_plain_ticks
from mivol.report.figures import STYLE


def test_a_figure_is_written_when_its_block_ends(tmp_path: Path) -> None:
    """In the style of the reports, with labels 1, 3, 10, ... and their unit on an axis of ratios."""
    path = tmp_path / "a.png"
    with new_figure(path, 3, 2) as figure:
        axes = figure.subplots()
        axes.loglog([1, 30], [1, 2])
        use_plain_ticks(axes.xaxis, "×")
        assert axes.title.get_fontsize() == STYLE["axes.titlesize"]
        figure.canvas.draw()
        labels = [label.get_text() for label in axes.get_xticklabels()]
        assert not path.exists()
    assert {"1×", "3×", "10×", "30×"} <= set(labels)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_block_that_fails_writes_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), new_figure(tmp_path / "a.png", 1, 1):
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []
