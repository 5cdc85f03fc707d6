"""Sums of all numbers of the dictionary of a scene, by name: equal scenes have equal sums."""

from __future__ import annotations

import re
from collections.abc import Iterator

import mitsuba as mi
import numpy as np

NUMBERS = re.compile(r"[-+.e\d\s]+(,[-+.e\d\s]+)+")
"""Numbers with commas between them, as a scene file has them."""


def numbers_of(value: object, name: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """The numbers of a scene, each with the last name on the way to it."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from numbers_of(each, key)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from numbers_of(each, name)
    elif isinstance(value, mi.ScalarTransform4f):
        yield name, np.array(value.matrix, dtype=np.float64)
    elif isinstance(value, str):
        yield (name, np.array(value.split(","), dtype=np.float64)) if NUMBERS.fullmatch(value) else (value, np.ones(1))
    elif value is not None:
        yield name, np.atleast_1d(np.array(value, dtype=np.float64))


def add_up(scene: dict, sums: dict[str, float]) -> dict[str, float]:
    """Add the numbers of a scene to sums by name; weights tell the places in an array apart."""
    for name, found in numbers_of(scene):
        sums[name] = sums.get(name, 0.0) + float((found * np.cos(np.arange(found.size)).reshape(found.shape)).sum())
    return sums
