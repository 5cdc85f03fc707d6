"""A figure beside its bar, the value that the project promises of it."""

from __future__ import annotations

import sys
from typing import TypedDict

__all__ = ["AT_LEAST", "AT_MOST", "Bar", "judge", "judge_agreement", "means_that_differ", "say"]

AT_LEAST, AT_MOST = "at least", "at most"
AGREEMENT = "|z|: "
"""With what the figures of :func:`judge_agreement` begin."""


class Bar(TypedDict):
    """A figure, its value, in which sense it is bounded, the bound, and whether it is met."""

    figure: str
    value: float
    sense: str
    bar: float
    met: bool


def say(text: str) -> None:
    """To standard error: standard output is for the JSON."""
    print(text, file=sys.stderr, flush=True)


def judge(figure: str, value: float, sense: str, bar: float, aloud: bool = True) -> Bar:
    """Put a figure beside its bar, and say it.

    Args:
        figure: what was measured.
        value: of it.
        sense: AT_LEAST or AT_MOST.
        bar: the bound.
        aloud: say it in any case; else only where it misses.
    """
    met = value >= bar if sense == AT_LEAST else value <= bar
    if aloud or not met:
        say(f"  {figure}: {value:.3g}, bar {sense} {bar:g}{'' if met else ': MISSED'}")
    return {"figure": figure, "value": value, "sense": sense, "bar": bar, "met": bool(met)}


def judge_agreement(what: str, z: float | None, bound: float) -> Bar:
    """Put the difference of two means, in standard errors, beside its bound; said only where it is beyond.

    Means that differ without any noise have no z (None); they count as beyond every bound.
    """
    return judge(AGREEMENT + what, sys.float_info.max if z is None else abs(z), AT_MOST, bound, aloud=False)


def means_that_differ(bars: list[Bar]) -> list[str]:
    """Figures of :func:`judge_agreement` that are beyond their bound: ratios of such methods mean nothing."""
    return [bar["figure"] for bar in bars if bar["figure"].startswith(AGREEMENT) and not bar["met"]]
