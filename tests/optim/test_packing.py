"""Tensors as one vector, and the search along it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mivol.optim.second_order import search_line

OPEN = SimpleNamespace(project=lambda x: x)


@pytest.mark.parametrize(("limit", "alpha"), [(1.0, 1.0), (0.3, 0.25), (2.0**-9, 2.0**-9), (2.0**-9.5, 0.0)])
def test_steps_are_halved_nine_times_at_most(limit: float, alpha: float) -> None:
    """The first step that is no longer than what lowers the value; none where even 2^-9 is too long."""

    def value(x: np.ndarray) -> float:
        return -x[0] if x[0] <= limit else 1.0

    new, found = search_line(value, OPEN, np.zeros(1), 0.0, np.array([-1.0]), np.ones(1))
    assert (found, new.tolist()) == (alpha, [alpha])


def test_a_step_has_to_lower_the_value_by_a_share_of_its_slope() -> None:
    """By 1e-4 of it: exactly that much is enough."""
    x, g, p = np.zeros(1), np.array([-1.0]), np.ones(1)
    assert search_line(lambda x: -1e-4 * x[0], OPEN, x, 0.0, g, p)[1] == 1.0
    assert search_line(lambda x: -0.9e-4 * x[0], OPEN, x, 0.0, g, p)[1] == 0.0


def test_steps_are_projected() -> None:
    new, alpha = search_line(
        lambda x: -x[0], SimpleNamespace(project=lambda x: np.minimum(x, 0.5)), np.zeros(1), 0.0, -np.ones(1), np.ones(1)
    )
    assert (new.tolist(), alpha) == ([0.5], 1.0)
