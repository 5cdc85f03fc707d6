"""Weights of multiple importance sampling: those of two techniques sum to 1, for densities of any size."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.lighting.direct_lighting import power_heuristic

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_weights_of_two_techniques_sum_to_1():
    """Densities of 1e-30 to 1e30, whose squares are no float32 numbers; each weight is rounded four times."""
    a, b = 10 ** np.random.default_rng(1).uniform(-30, 30, (2, 1000)).astype(np.float32)
    total = np.array(power_heuristic(mi.Float(a), mi.Float(b))) + np.array(power_heuristic(mi.Float(b), mi.Float(a)))
    np.testing.assert_allclose(total, 1, atol=8 * 2.0**-24)


def test_values():
    """(a / b)^2 / (1 + (a / b)^2); a sample that cannot be drawn has no weight, one that only it can draw has all."""
    found = np.array(power_heuristic(mi.Float(3, 0, 0, 2), mi.Float(1, 1, 0, 0)))
    np.testing.assert_allclose(found, [0.9, 0, 0, 1], rtol=4 * 2.0**-24)
