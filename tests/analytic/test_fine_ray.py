"""Rays with an origin in float64, beside Mitsuba's own."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.fine_ray import FineRay, point_along, traced

pytestmark = pytest.mark.usefixtures("variant_rgb")

PLACE = np.array([100.0 + 1e-9, -8.0 + 1e-10, 1e-12])
"""Its distance from the nearest float32 numbers is far below their steps there."""


def ray_from(place: np.ndarray) -> FineRay:
    it = dr.zeros(mi.MediumInteraction3f)
    it.time = 0.25
    return FineRay.leaving(mi.Point3d(*place.tolist()), mi.Vector3f(0, 0.6, 0.8), it, mi.Float(3))


def numbers(p: object) -> np.ndarray:
    return np.array(p, dtype=np.float64)[:, 0]


def test_an_origin_keeps_its_digits():
    ray = ray_from(PLACE)
    assert (numbers(ray.o) == PLACE).all()
    assert (numbers(FineRay.of(ray).o) == PLACE).all()
    assert float(ray.time[0]) == 0.25
    assert float(ray.maxt[0]) == 3


def test_points_are_found_in_float64_and_rounded_once():
    """Origin and step are each less than half a step of float32 at 100, and their sum is more."""
    t, d, place = 5e-6, np.float32([0, 0.6, 0.8]).astype(np.float64), np.array([1.0, 100 + 3e-6, 100 + 3e-6])
    there = place + t * d
    # A fused product and sum is rounded once, numpy's twice: one step of float64 apart at most.
    assert np.abs(numbers(point_along(ray_from(place), mi.Float64(t))) - there).max() <= np.spacing(100.0)
    assert (numbers(ray_from(place)(mi.Float64(t))) == there.astype(np.float32)).all()
    assert (there.astype(np.float32)[1:] > 100).all()


def test_mitsuba_traces_from_the_nearest_point():
    found = traced(ray_from(PLACE))
    assert isinstance(found, mi.Ray3f)
    assert (numbers(found.o) == PLACE.astype(np.float32)).all()
    assert float(found.maxt[0]) == 3


def test_a_ray_of_mitsuba_becomes_one_without_change():
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 0.3), mi.Vector3f(0, 0, 1), 2.0, 0.5, mi.Color0f())
    found = FineRay.of(ray)
    assert (numbers(found.o) == np.float32([0.1, 0.2, 0.3])).all()
    assert float(found.maxt[0]) == 2
    assert float(found.time[0]) == 0.5
