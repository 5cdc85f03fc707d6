"""Derivatives of expected depth in one cell."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.line_integrals import expected_depth
from mivol.transport.line_integrals.integrand import CellIntegral

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.3, 3.0, 40.0])
def test_derivatives_of_a_cell(size):
    # Central differences of the formula itself: of order h^2 = 1e-8 in the scale on which it bends, and the 5e-10 to which
    # the moments are known, over h.
    rng = np.random.default_rng([6, int(size * 1000)])
    a, dt = rng.uniform(-2, 2, 200), rng.uniform(0.1, 1, 200)
    sigma = size * rng.uniform(0, 1, (3, 200))

    def stop(sigma: np.ndarray) -> CellIntegral:
        return expected_depth.integrate_distance_in_cell(*(mi.Float64(x) for x in (a, dt, *sigma)))

    exact, h = stop(sigma), 1e-4 * (1 + size)
    for q in range(3):
        step = h * np.eye(3)[q][:, None]
        up, down = stop(sigma + step), stop(sigma - step)
        for slope, f in ((exact.dtau[q], "tau"), (exact.dN[q], "N")):
            difference = (np.array(getattr(up, f)) - np.array(getattr(down, f))) / (2 * h)
            assert np.array(slope) == pytest.approx(difference, abs=2e-5 * np.abs(difference).max())
