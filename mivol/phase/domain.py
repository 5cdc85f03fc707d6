"""Domains of the parameters of phase functions, with refusal or projection of values outside.

Conventions. A value that an optimizer has moved outside is refused when it is set. The host cannot read a value inside a
recording by ``dr.freeze``, or in a volume of unknown values. The nearest value inside then replaces the value, with a
derivative of 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError


@dataclass(frozen=True)
class Domain:
    """An interval of float32 numbers.

    Attributes:
        low, high: the least and the largest allowed number.
        words: the interval, for the error message.
        way_out: advice for the same message.
    """

    low: float
    high: float
    words: str
    way_out: str

    def check(self, values: np.ndarray, name: str) -> None:
        """Refuse values outside.

        Raises:
            MivolError: NaN, or outside the interval after rounding to float32; the message names the first bad value and its
                index.
        """
        values = np.asarray(values, dtype=np.float32)
        wrong = np.argwhere(~((values >= np.float32(self.low)) & (values <= np.float32(self.high))))
        if len(wrong) == 0:
            return
        first = tuple(int(i) for i in wrong[0])
        place = "" if values.size == 1 else f" at {first if len(first) > 1 else first[0]}"
        raise MivolError(f"{name} is {float(values[first]):.9g}{place}; {self.words} is expected: {self.way_out}.")

    def project(self, x: mi.Float) -> mi.Float:
        """The nearest value inside; its derivative is 0 where the value differs from ``x``. NaN stays NaN."""
        # dr.minimum and dr.maximum are not used: where x lies on a bound, their derivative may be that of the constant.
        x = dr.select(x < self.low, self.low, x)
        return x if math.isinf(self.high) else dr.select(x > self.high, self.high, x)


NEXT_TO_ONE = 1 - 2.0**-24
"""The largest float32 below 1."""

LARGEST = 1e30
"""Largest weight or value. Sums of a few such numbers, and their inverses, are within the range of float32."""

ASYMMETRY = Domain(
    -NEXT_TO_ONE, NEXT_TO_ONE, "a number above -1 and below 1", "choose one, or clip it after each step, for instance to 0.999"
)
COSINE_SQUARED = WEIGHT = Domain(
    0.0, LARGEST, "a finite number of at least 0, and at most 1e30,", "choose one, or clip it after each step"
)
