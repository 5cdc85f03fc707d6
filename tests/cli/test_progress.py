"""How a run goes, on a terminal and where there is none: the lines that are said, and when a bar is drawn."""

from __future__ import annotations

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from mivol.cli import progress


class Clock:
    """Seconds that pass only when they are told to."""

    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture(params=[True, False], ids=["terminal", "file"])
def output(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> tuple[io.StringIO, bool, Clock]:
    """What is written to the error output, whether it is a terminal, and the clock."""
    written, clock = io.StringIO(), Clock()
    make = lambda stderr: Console(file=written, force_terminal=request.param, width=100, color_system=None)  # noqa: E731
    monkeypatch.setattr(progress, "Console", make)
    monkeypatch.setattr(progress, "time", clock)
    return written, request.param, clock


def fit_at(done: int, loss: float, measures: int = 0, log: tuple[str, ...] = ()) -> SimpleNamespace:
    """A fit after so many iterations."""
    return SimpleNamespace(
        next_iteration=done, seconds=12.34, log=list(log), evaluations=[None] * measures,
        history=[{"loss": 9.0}, {"loss": loss}], latest_errors=lambda: {"psnr": 20.123456, "mine": 0.5},
    )  # fmt: skip


def test_the_newest_numbers_in_words() -> None:
    assert progress.figures(fit_at(1, 0.123456)) == "loss 0.1235, PSNR of the fitted views 20.12 dB, mine 0.5"


def test_channels_of_a_parameter_are_one_group() -> None:
    fit = fit_at(1, 0.5)
    fit.latest_errors = lambda: {"paint[0]": 0.7, "paint[1]": 0.3, "lamp.position[0]": -1.0}
    assert progress.figures(fit) == "loss 0.5, paint 0.7 0.3, lamp.position -1"


def test_lines_are_said_as_they_are(output: tuple) -> None:
    written, *_ = output
    progress.TerminalProgress().say(["[bold] 1 2 3", "x" * 150])
    assert written.getvalue() == "[bold] 1 2 3\n" + "x" * 150 + "\n"


def test_items_are_tracked(output: tuple) -> None:
    """A bar with counts on a terminal; elsewhere one line at the end, with the seconds that passed."""
    written, is_terminal, clock = output
    counts = []
    for item in progress.TerminalProgress().track(["a", "b"], "views"):
        counts.append((item, written.getvalue()))
        clock.now += 1.25
    assert [item for item, _ in counts] == ["a", "b"]
    if is_terminal:
        assert ["0/2" in text for _, text in counts] == [True, True] and "1/2" in counts[1][1] and "1/2" not in counts[0][1]
        assert "2/2" in written.getvalue() and " in " not in written.getvalue()
    else:
        assert written.getvalue() == "views: 2 in 2.5 s\n" and counts == [("a", ""), ("b", "")]


def test_a_fit_is_watched(output: tuple) -> None:
    """On a terminal the bar is drawn anew at most ten times a second; elsewhere a line a measure. What the fit logs is said
    once. In the end the last numbers stand there."""
    written, is_terminal, clock = output
    figures = "loss 0.5, PSNR of the fitted views 20.12 dB, mine 0.5"
    with progress.TerminalProgress().watch(8) as display:
        seen = []
        for done, later, measures in ((1, 0.2, 1), (2, 0.05, 1), (3, 0.06, 2), (4, 0, 2)):
            clock.now += later
            before = len(written.getvalue())
            display(fit_at(done, 0.5, measures, ("refined",) if done > 2 else ()))
            seen.append(written.getvalue()[before:])
        display.newest.next_iteration, display.newest.seconds = 5, 12.36
        before = len(written.getvalue())
    end = written.getvalue()[before:]
    assert ["refined" in text for text in seen] == [False, False, True, False]
    if is_terminal:
        assert ["/8" in text for text in seen] == [True, False, True, False] and "1/8" in seen[0] and "3/8" in seen[2]
        assert "5/8" in end and figures in end and "iterations in" not in end
    else:
        assert seen == [f"iteration 1 of 8: {figures}\n", "", f"refined\niteration 3 of 8: {figures}\n", ""]
        assert end == f"5 iterations in 12.4 s: {figures}\n"


def test_a_fit_that_never_began_says_nothing(output: tuple) -> None:
    written, is_terminal, _ = output
    with progress.TerminalProgress().watch(8):
        pass
    assert ("0/8" in written.getvalue()) == is_terminal and "iterations in" not in written.getvalue()
