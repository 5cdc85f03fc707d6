"""RMSprop: its formula, and that it leaves alone what has no derivative."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mivol.optim.rmsprop import descend


def test_steps_are_those_of_the_formula(variant_rgb: str) -> None:
    """Three steps against NumPy in float64: the first moves by the rate itself, for its square is its own mean."""
    rng = np.random.default_rng(0)
    slopes, x, mean = rng.normal(size=(3, 8)), rng.normal(size=8), np.zeros(8)
    values, squares = mi.Float(x.astype(np.float32)), mi.Float(np.zeros(8, np.float32))
    for k, g in enumerate(slopes):
        values, squares = descend(values, squares, mi.Float(g.astype(np.float32)), 0.1, 0.9)
        mean = g**2 if k == 0 else 0.9 * mean + 0.1 * g**2
        x = x - 0.1 * g / np.sqrt(mean)
        # Steps of at most 0.32 with a relative rounding of a few float32 ulp each (rsqrt: 2^-22).
        np.testing.assert_allclose(np.array(values), x, atol=3 * 0.32 * 2**-20)
        np.testing.assert_allclose(np.array(squares), mean, rtol=4 * 2**-23)


def test_what_has_no_derivative_stays_and_is_not_forgotten(variant_rgb: str) -> None:
    """Number 0 was never touched, number 1 was and is not now, number 2 is: only that one changes."""
    values, squares = mi.Float(1, 2, 3), mi.Float(0, 4, 4)
    moved, known = descend(values, squares, mi.Float(0, 0, 2), 0.5, 0.9)
    assert np.array(moved).tolist() == [1, 2, 2.5]
    assert np.array(known).tolist() == [0, 4, 4]
