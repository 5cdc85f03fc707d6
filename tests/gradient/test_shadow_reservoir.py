"""One shadow ray of several, kept by its light: the mean of its derivative is the sum of theirs."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_same_mean, fresh

from mivol.transport.estimators.flights.flight_derivatives import ShadowReservoir, ShadowTerm
from mivol.transport.estimators.lighting.direct_lighting import DirectLight
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32
from mivol.transport.traversal.rays import FineRay
from scenes import box_of, camera, media_of, medium

pytestmark = pytest.mark.usefixtures("variant_rgb")

LIGHTS, LENGTHS = (0.5, 0.0, 2.0, 0.1), (0.3, 0.9, 0.2, 0.7)


def fog() -> object:
    """Media of one homogeneous box, ready to take derivatives."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": box_of(medium("mivol_medium", 0.5, 0.8), np.diag([2.0, 2.0, 2.0, 1.0])),
            "sky": {"type": "constant"},
            "sensor": camera((0, -4, 0), (0, 0, 0), res=2),
        }
    )
    return media_of(scene)


@pytest.mark.statistical
def test_mean_is_the_sum() -> None:
    """The derivative of light L over a length l by a constant extinction is -L l."""
    media, n = fog(), 1 << 14
    ray = FineRay.from_ray(mi.Ray3f(dr.full(mi.Point3f, 0.1, n), mi.Vector3f(0, 0, 1)))
    rng, kept = seed_pcg32(mi.Float((0.4 + fresh(0) * 0.6180339887498949) % 1), n), ShadowReservoir.empty(media, ray)
    for light, length in zip(LIGHTS, LENGTHS, strict=True):
        rng, (chance,) = draw_pcg32(rng, 1)
        segment = RaySegment(ray, dr.zeros(mi.MediumPtr, n), dr.full(mi.Float, length, n), True)
        term = DirectLight(media, segment, dr.full(mi.Spectrum, light, n), mi.Bool(light > 0))
        kept = kept.offer(term, chance)
    term = ShadowTerm(media, kept)
    assert np.all(np.array(term.value) == 0)
    media.bodies[0].tangents = [mi.Float(1)]
    found = np.array(term.jvp().x, dtype=np.float64) * np.ones(n)
    truth = -sum(a * b for a, b in zip(LIGHTS, LENGTHS, strict=True))
    assert_same_mean(Estimate(found.mean(), found.var(ddof=1) / n, n - 1), truth, rounding=1e-6, what="derivative")
    # The transpose, lane by lane: 16384 terms summed in float32.
    media.start_gradients()
    term.vjp(dr.full(mi.Spectrum, 1, n))
    assert float(np.array(media.bodies[0].gradients[0]).sum()) == pytest.approx(3 * found.sum(), rel=1e-4)
