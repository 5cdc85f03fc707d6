"""Measured figures beside their bars. A bar is the promised bound of a figure."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypedDict

__all__ = [
    "AT_LEAST",
    "AT_MOST",
    "Bar",
    "Promise",
    "find_disagreements",
    "judge",
    "judge_agreement",
    "judge_promises",
    "say",
    "say_row",
]

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


class Promise(NamedTuple):
    """A declared bar.

    Attributes:
        label: label of the figure; braces stand for the keys that "*" has matched.
        keys: keys of the figure in the answer; "*" matches every key.
        sense: AT_LEAST or AT_MOST.
        bar: bound.
        factor: factor from the value in the answer to the figure.
    """

    label: str
    keys: tuple[str, ...]
    sense: str
    bar: float
    factor: float = 1.0


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


def judge_promises(promises: Iterable[Promise], answer: dict) -> list[Bar]:
    """Compare the figures of an answer with their bars. A figure that the answer lacks, or that is None, has no bar."""
    return [
        judge(promise.label.format(*names), promise.factor * value, promise.sense, promise.bar)
        for promise in promises
        for names, value in find_figures(answer, promise.keys)
        if value is not None
    ]


def find_figures(answer: dict, keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float | None]]:
    """Figures at some keys, with the keys that "*" has matched."""
    if not keys:
        yield (), answer
        return
    first, *rest = keys
    for name in answer if first == "*" else [first] if first in answer else []:
        for names, value in find_figures(answer[name], tuple(rest)):
            yield ((name, *names) if first == "*" else names), value


def judge_agreement(label: str, z: float | None, bound: float) -> Bar:
    """Compare the difference of two means, in standard errors, with its bound; print only a difference above the bound.

    Different means without noise have no z (None) and miss every bound.
    """
    return judge(AGREEMENT + label, sys.float_info.max if z is None else abs(z), AT_MOST, bound, quiet=True)


def find_disagreements(bars: list[Bar]) -> list[str]:
    """Labels of the means that differ. Time ratios of methods with different means are meaningless."""
    return [bar["figure"] for bar in bars if bar["figure"].startswith(AGREEMENT) and not bar["met"]]
