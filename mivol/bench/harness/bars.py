"""Measured figures beside their bars. A bar is the promised bound of a figure."""

from __future__ import annotations

import sys
from typing import TypedDict

__all__ = ["AT_LEAST", "AT_MOST", "Bar", "find_disagreements", "judge", "judge_agreement", "say", "say_row"]

AT_LEAST, AT_MOST = "at least", "at most"
AGREEMENT = "|z|: "
"""Prefix of the figures of :func:`judge_agreement`."""


class Bar(TypedDict):
    """A figure: label, value, sense and value of the bound, and whether the bound is met."""

    figure: str
    value: float
    sense: str
    bar: float
    met: bool


def say(text: str) -> None:
    """Print progress to standard error; standard output is for the JSON."""
    print(text, file=sys.stderr, flush=True)


def say_row(place: str, **numbers: float | None) -> None:
    """Print a line of progress: a place and its numbers, with three digits."""
    shown = (f"{name.replace('_', ' ')} {'none' if value is None else f'{value:.3g}'}" for name, value in numbers.items())
    say(f"  {place}: {', '.join(shown)}")


def judge(figure: str, value: float, sense: str, bar: float, quiet: bool = False) -> Bar:
    """Compare a figure with its bar, and print both.

    Args:
        figure: label of the figure.
        value: measured value.
        sense: AT_LEAST or AT_MOST.
        bar: bound.
        quiet: print only missed bars.
    """
    met = value >= bar if sense == AT_LEAST else value <= bar
    if not (quiet and met):
        say(f"  {figure}: {value:.3g}, bar {sense} {bar:g}{'' if met else ': MISSED'}")
    return {"figure": figure, "value": value, "sense": sense, "bar": bar, "met": bool(met)}


def judge_agreement(label: str, z: float | None, bound: float) -> Bar:
    """Compare the difference of two means, in standard errors, with its bound; print only a difference above the bound.

    Different means without noise have no z (None) and miss every bound.
    """
    return judge(AGREEMENT + label, sys.float_info.max if z is None else abs(z), AT_MOST, bound, quiet=True)


def find_disagreements(bars: list[Bar]) -> list[str]:
    """Labels of the means that differ. Time ratios of methods with different means are meaningless."""
    return [bar["figure"] for bar in bars if bar["figure"].startswith(AGREEMENT) and not bar["met"]]
