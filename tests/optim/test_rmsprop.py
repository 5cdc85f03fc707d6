"""RMSprop: its formula, and that it leaves alone what has no derivative."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.optim.first_order import LARGEST, LONGEST_MEMORY, RMSprop, descend, from_halves, to_halves


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


def test_every_half_is_a_mean_and_comes_back(variant_rgb: str) -> None:
    """What was held is held again as it was, so what has no derivative is not worn away; 0 stays 0."""
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16)
    means = from_halves(mi.TensorXf16(halves))
    known = np.array(means)
    assert known[0] == 0 and (np.diff(known) > 0).all() and np.isfinite(known).all()
    assert (np.array(to_halves(means)) == halves).all()


def test_means_in_halves_are_off_by_a_fifth_of_a_percent(variant_rgb: str) -> None:
    """Half a unit in the last of 11 bits, four times; the roundings of float32 add less than 2^-19."""
    means = np.geomspace(1e-24, 1e12, 20001).astype(np.float32)
    found = np.array(from_halves(to_halves(mi.TensorXf(means)))) / means.astype(np.float64)
    assert np.abs(found - 1).max() < (1 + 2**-11) ** 4 - 1 + 2**-19
    largest = np.array(to_halves(mi.TensorXf(np.float32([1e20, 3e38]))))
    assert (largest == LARGEST).all()


def test_means_in_halves_follow(variant_rgb: str) -> None:
    """With the longest memory a mean goes from 100 to 1 as derivatives do, but for the 2^-9 / (1 - memory) of it by which
    rounding can hold it; with a hundred times that memory it would not move at all, and longer ones are refused."""

    def after(memory: float) -> float:
        held = to_halves(mi.TensorXf([100.0], (1,)))
        for _ in range(1000):
            held = to_halves(mi.TensorXf(descend(mi.Float(0), from_halves(held).array, mi.Float(1), 0.1, memory)[1], (1,)))
        return float(from_halves(held).array[0])

    assert after(LONGEST_MEMORY) == pytest.approx(1, rel=2**-9 / (1 - LONGEST_MEMORY) * 1.1)
    assert after(1 - (1 - LONGEST_MEMORY) / 100) == pytest.approx(100, rel=2**-9)
    with pytest.raises(MivolError, match=r"found memory = 0.999 with half = true, expected at most 0.98"):
        RMSprop(memory=0.999, half=True).begin(None)
