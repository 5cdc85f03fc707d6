"""Schedules: first and last factors."""

from __future__ import annotations

import numpy as np

from mivol.optim.schedules import SCHEDULES, Constant, Cosine, Exponential, Step


def test_schedules_begin_at_1_and_end_at_their_final_value() -> None:
    n = 41
    chosen = [Constant(), Cosine(final=0.2), Step(at=(0.5, 0.9), ratio=0.1), Exponential(final=0.01, delay=10)]
    assert {schedule.label() for schedule in chosen} == set(SCHEDULES)
    factors = np.array([[s.factor(i, n) for i in range(n)] for s in chosen])
    assert np.allclose(factors[:, 0], 1.0)
    assert np.allclose(factors[:, -1], [1.0, 0.2, 0.01, 0.01])
    assert np.all(np.diff(factors, axis=1) <= 1e-12)
    assert np.isclose(factors[1, 20], 0.6)
    assert np.allclose(factors[3, [10, 25]], [1.0, 0.1])
    assert np.allclose(factors[2, [20, 21]], [1.0, 0.1])
