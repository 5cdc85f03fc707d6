r"""The exact derivative of a grid control along one ray: :math:`\sum_c T_c S_c (1 - e^{-\tau_c})`, written down in float64."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.single_scattering.control_variates import (
    ControlSweep,
    GridControl,
    ProbeDifference,
    SweepSums,
)
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from scenes import as_float32, box_of, camera, grid_volume, media_of, medium

pytestmark = pytest.mark.usefixtures("variant_rgb")

SIGMA = as_float32([0.5, 2.0, 0.25, 1.0])
"""Voxels of the unit cube along x. Its cells reach from one voxel centre to the next, and from a face to the nearest centre."""

S = as_float32([1.0, 0.5, 3.0, 0.25, 2.0])
EDGES = np.array([0, 0.125, 0.375, 0.625, 0.875, 1])
REST, SOURCE, DIMS, AT = 0.75, 1.5, 0.5, 0.5
"""Light from behind the ray; a probe in the middle of the third cell."""

TOLERANCE = 1e-4
"""``taken_light`` is right to 4e-5 of the light that a piece takes; the light is of size 1."""


def depth(sigma: np.ndarray, end: float) -> float:
    """Optical depth up to a distance in the cube."""
    nodes = np.r_[0, 0.125, 0.375, 0.625, 0.875, 1], np.r_[sigma[0], sigma, sigma[-1]]
    x = np.unique(np.r_[nodes[0][nodes[0] < end], end])
    y = np.interp(x, *nodes)
    return float(np.sum(np.diff(x) * (y[1:] + y[:-1]) / 2))


def light(sigma: np.ndarray) -> float:
    """What the sweep differentiates: S of all cells, the light behind, and the probe by itself."""
    tau = np.array([depth(sigma, e) for e in EDGES])
    control = np.sum(S * -np.diff(np.exp(-tau)))
    point = SOURCE * np.interp(AT, [0.375, 0.625], sigma[1:3])
    # A derivative of -REST by the optical depth of the ray, and of -DIMS by that in front of the probe.
    return control - REST * tau[-1] + point - DIMS * depth(sigma, AT)


def slopes(f: Callable[[np.ndarray], float]) -> np.ndarray:
    h = 1e-5
    return np.array([(f(SIGMA + h * e) - f(SIGMA - h * e)) / (2 * h) for e in np.eye(4)])


@pytest.fixture
def media(variant_rgb: str) -> SceneMedia:
    fog = medium("mivol_medium", grid_volume("mivol_voxels", SIGMA.reshape(1, 1, 4, 1)), 0.5)
    return media_of(mi.load_dict({"type": "scene", "box": box_of(fog, np.eye(4)), "sensor": camera([0, -4, 0], [0, 0, 0])}))


def sweep(media: SceneMedia, tangent: bool) -> ControlSweep:
    """A ray from x = -1 on."""
    ray = mi.Ray3f(mi.Point3f(-1, 0.5, 0.5), mi.Vector3f(1, 0, 0), dr.inf, mi.Float(0), mi.Color0f())
    values = np.zeros((2, 2, 5))
    values[:] = S
    control = GridControl(mi.Float(values.ravel().astype(np.float32)), (1, 1, 4), 1)
    probe = ProbeDifference(mi.Float64(1 + 0.375), mi.Float64(1 + AT), [mi.Float(SOURCE)], [mi.Float(DIMS)], mi.Bool(True))
    tracks = SweepSums([[(0, mi.Float(1))]], [mi.Float(REST)], tangent)
    passed = RaySegment(ray, mi.MediumPtr(None), mi.Float(3))
    return ControlSweep(media, control, passed, [mi.Float(depth(SIGMA, 1.0))], tracks, probe)


def test_every_voxel_has_its_gradient(media):
    media.start_gradients()
    with dr.suspend_grad():
        none = sweep(media, tangent=False).differentiate(mi.Bool(True))
    assert [float(x[0]) for x in none] == [0]
    np.testing.assert_allclose(np.array(media.bodies[0].gradients[0].fold()).ravel(), slopes(light), atol=TOLERANCE)


def test_a_tangent_is_the_sum_over_the_voxels(media):
    v = np.array([1.0, -2.0, 3.0, 0.5])
    media.bodies[0].tangents = [mi.Float(v)]
    with dr.suspend_grad():
        (found,) = sweep(media, tangent=True).differentiate(mi.Bool(True))
    assert found[0] == pytest.approx(slopes(light) @ v, abs=TOLERANCE * np.abs(v).sum())
