"""The choice of an event's differentiated shadow ray: in proportion to its light, with its value over this probability."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.single_scattering.scattering_derivatives import _choose_shadow_ray
from mivol.transport.media.ray_intervals import RaySegment

pytestmark = pytest.mark.usefixtures("variant_rgb")


def shadow_ray(x: float, value: list[float], on: list[bool]) -> SimpleNamespace:
    """A ray towards +x from (x, 0, 0), of length 10 + x."""
    ray = mi.Ray3f(mi.Point3f(mi.Float([x] * len(on)), 0, 0), mi.Vector3f(1, 0, 0), 0, mi.Color0f())
    segment = RaySegment(ray, dr.zeros(mi.MediumPtr, len(on)), mi.Float([10 + x] * len(on)))
    return SimpleNamespace(ray_segment=segment, value=mi.Spectrum(*value), on=mi.Bool(on))


def test_each_has_its_light_as_probability() -> None:
    """Light of 3 and 1: the first ray for a chance below 3/4, with 4/3 of its value; else the second with 4 times its value.
    Without light, none.
    """
    probe = SimpleNamespace(
        chance=mi.Float([0.0, 0.74, 0.76, 0.99]),
        direct=[shadow_ray(1.0, [0.5, 1.0, 1.5], [True] * 4), shadow_ray(2.0, [0.25, 0.25, 0.5], [True, True, True, False])],
    )
    ray, value, on = _choose_shadow_ray(probe)
    assert np.array(ray.ray.o.x).tolist() == [1, 1, 2, 2] and np.array(ray.length).tolist() == [11, 11, 12, 12]
    np.testing.assert_allclose(np.array(value).T, [[2 / 3, 4 / 3, 2]] * 2 + [[1, 1, 2]] * 2, rtol=2.0**-21)  # three roundings
    assert np.array(on).tolist() == [True, True, True, False]
    dark = SimpleNamespace(chance=mi.Float([0.2, 0.8]), direct=[shadow_ray(x, [0, 0, 0], [True] * 2) for x in (1.0, 2.0)])
    _, value, on = _choose_shadow_ray(dark)
    assert not np.any(np.array(value)) and not np.any(np.array(on))


def test_one_alone_is_taken() -> None:
    probe = SimpleNamespace(chance=mi.Float(0.9), direct=[shadow_ray(1.0, [0.5, 1.0, 1.5], [True])])
    ray, value, on = _choose_shadow_ray(probe)
    assert ray is probe.direct[0].ray_segment and np.array(value).ravel().tolist() == [0.5, 1, 1.5] and on[0]
