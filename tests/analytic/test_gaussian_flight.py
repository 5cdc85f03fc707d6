"""Free flights through Gaussians: how far they go is known from the optical depth of the float64 twin."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, fresh
from scipy.special import logit

from mivol.fields import gaussian_cells
from mivol.fields.gaussian_field import GaussianField
from mivol.points.gaussians import Gaussians
from mivol.transport.estimators.flights.regular_tracking import sample_gaussian_flight
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.traversal.random_numbers import seed_pcg32

FLIGHTS, SCALE = 1 << 16, 0.6


@pytest.mark.statistical
@pytest.mark.parametrize("cells", [0.5, 50.0])
def test_flights_end_where_the_depth_of_the_twin_says(cells: float, variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The share of flights that end before t is 1 - exp(-tau(t)), in few cells and in many; the others are infinite."""
    monkeypatch.setattr(gaussian_cells, "CELLS_PER_GAUSSIAN", cells)
    rng = np.random.default_rng(0)
    means, scales = np.linspace([-1, 0, 0], [1, 0, 0], 20) + rng.uniform(-0.3, 0.3, (20, 3)), rng.uniform(0.1, 0.4, (20, 3))
    turns, opacities = rng.normal(size=(20, 4)), rng.uniform(0.05, 0.5, 20)
    # The long one is entered first, and the small one may end a flight before it does.
    means[:2], scales[:2], turns[:2], opacities[:2] = [[0.5, 0, 0], [-1, 0, 0]], [[1, 0.3, 0.3], [0.1] * 3], [1, 0, 0, 0], 0.9
    gaussians = Gaussians(means, np.log(scales), turns, logit(opacities), np.zeros((20, 1, 3)))
    part = GaussianExtinction("sigma_t", GaussianField.from_gaussians(gaussians, np.eye(4)), mi.Float(SCALE))
    o, d, end = np.array([[-4.0, 0.1, 0.05]]), np.array([[1.0, 0.0, 0.0]]), 4.8
    ray = mi.Ray3f(dr.zeros(mi.Point3f, FLIGHTS) + mi.Point3f(*o[0].tolist()), mi.Vector3f(*d[0].tolist()))
    interval = RayInterval(ray, mi.Float64(0), mi.Float64(end), dr.full(mi.Bool, True, FLIGHTS))
    seed = mi.Float(np.random.default_rng(fresh(3)).uniform())
    t = np.array(sample_gaussian_flight(part, mi.Float(SCALE), interval, seed_pcg32(seed, FLIGHTS))[0])
    twin = oracle.Cloud.of(gaussians)
    assert (np.isinf(t) | (t <= end + 1e-5)).all()
    for place in np.linspace(2.6, end, 6):
        tau = SCALE * oracle.optical_depth(twin, o, d, np.zeros(1), np.full(1, place))[0]
        ended = t < (np.inf if place == end else place)
        shares = ended.reshape(64, -1).mean(axis=1)
        found = Estimate(shares.mean(), shares.var(ddof=1) / 64, 63)
        assert_same_mean(found, -np.expm1(-tau), rounding=1e-5, what=f"flights that end before {place:.2f}")
        assert_precise(found, 0.004, what="the share")
