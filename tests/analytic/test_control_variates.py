"""Control variates of single scattering: the source function under light from one direction or from everywhere, and its exact
derivative.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import PLACE, close_up, point, smoke
from scipy.interpolate import RegularGridInterpolator

from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.single_scattering import control_variates
from mivol.transport.estimators.single_scattering.control_variates import (
    CameraOrigins,
    ControlSweep,
    GridControl,
    ProbeDifference,
    SweepSums,
    build_grid_control,
    count_nodes,
)
from mivol.transport.estimators.single_scattering.single_scattering import SingleScattering
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.estimators import Settings
from scenes import as_float32, box_of, camera, grid_volume, media_of, medium

ALBEDO = 0.7


def direct_light(emitter: dict) -> DirectLighting:
    """In smoke too thin to attenuate light: 4 x 3 x 5 voxels, with the nodes of the coarse lattice in the corners."""
    values = np.full((4, 3, 5, 1), 1e-7, np.float32)
    scene = close_up({"smoke": smoke(values, ALBEDO)[0], "emitter": emitter})
    survey, settings = survey_scene(scene), Settings(max_depth=2)
    needs = find_needs(scene, scene.sensors()[0], survey)
    plan = make_plan(needs, settings)
    return build_estimators(scene, needs, plan, settings, survey, for_images=False).direct


def control_of(emitter: dict) -> GridControl:
    """S in the smoke of :func:`direct_light`."""
    with dr.suspend_grad():
        direct = direct_light(emitter)
        origins = CameraOrigins(mi.Point3f(0, 0, 5), mi.Float(0), mi.Vector3f(0, 0, -1))
        return build_grid_control(direct, direct.media.bodies[0], origins)


def test_the_control_of_the_first_rays_is_kept():
    estimator = SingleScattering(direct_light(point((0, 0, 9))[0]))
    estimator.prepare_derivatives(mi.Ray3f([0, 0, 5], [0, 0, -1]))
    kept = estimator.grid_control
    assert isinstance(kept, GridControl) and estimator.constant_control is None
    estimator.prepare_derivatives(mi.Ray3f([0, 0, 6], [0, 0, -1]))
    assert estimator.grid_control is kept


def test_constant_sky_of_a_colour():
    """S is albedo L, in every cell and each channel."""
    colour = [0.2, 1.0, 3.0]
    found = control_of({"type": "constant", "radiance": {"type": "rgb", "value": colour}})
    assert found.channels == 3
    values = np.array(found.values).reshape(5, 4, 6, 3)
    # 32 directions of weights that add up to 1, each rounded a few times, and a transmittance of 1 - 4e-7.
    np.testing.assert_allclose(values, np.broadcast_to(ALBEDO * np.array(colour), values.shape), rtol=1e-5)


def test_point_light_from_the_corners_of_the_grid():
    """S is albedo I / (4 pi r^2) at the nodes in the corners of the box, and linear between them."""
    place, intensity = np.array([4.0, 1.0, 2.5]), 3.0
    found = control_of(point(place, intensity)[0])
    values = np.array(found.values).reshape(5, 4, 6)

    def light(x: float, y: float, z: float) -> float:
        return ALBEDO * intensity / (4 * np.pi * np.sum((place - [x, y, z]) ** 2))

    # The first and the last cell along each axis, z first; those of the middle along y are half-way between them.
    corners = np.array([[[light(x, y, z) for x in (-1, 1)] for y in (-1, 1)] for z in (-1, 1)])
    np.testing.assert_allclose(values[::4, ::3, ::5], corners, rtol=1e-5)
    share = np.arange(4) / 3
    between = (1 - share)[:, None] * corners[0, 0] + share[:, None] * corners[0, 1]
    np.testing.assert_allclose(values[0, :, ::5], between, rtol=1e-5)
    assert np.allclose(PLACE @ [0, 0, 0, 1], [-1, -1, -1, 1])


def test_point_light_between_nodes_of_three_edges(monkeypatch):
    """4 x 3 x 4 nodes, two cells apart: each node has the light at its position, trilinear in between."""
    monkeypatch.setattr(control_variates, "CELLS_PER_NODE", 2)
    place, intensity = np.array([4.0, 1.0, 2.5]), 3.0
    values = np.array(control_of(point(place, intensity)[0]).values).reshape(5, 4, 6)
    edges = [np.linspace(-1, 1, n) for n in (4, 3, 4)]
    away = place - np.stack(np.meshgrid(*edges, indexing="ij"), axis=-1)[..., ::-1]
    nodes = ALBEDO * intensity / (4 * np.pi * (away**2).sum(axis=-1))
    cells = np.stack(np.meshgrid(*(np.linspace(-1, 1, n) for n in values.shape), indexing="ij"), axis=-1)
    np.testing.assert_allclose(values, RegularGridInterpolator(edges, nodes)(cells), rtol=1e-5)


def test_nodes_stand_eight_cells_apart():
    """Two nodes if all cells lie within one step, and 33 at most: 31 steps of 8 cells and a last one of 7 need all 33."""
    assert [count_nodes(n) for n in (1, 7, 8, 15, 16, 247, 254, 255, 256, 1024)] == [2, 2, 3, 3, 4, 32, 33, 33, 33, 33]


def test_a_cell_has_the_light_of_its_place():
    """Three different edges and two channels: cells are numbered in z, y, x, from a lower node of -1 on."""
    res, channels = (2, 4, 3), 3
    values = np.arange(3 * 5 * 4 * channels, dtype=np.float32).reshape(3, 5, 4, channels)
    control = GridControl(mi.Float(values.ravel()), res, channels)
    lower = np.stack(np.meshgrid(*(np.arange(-1, n) for n in res), indexing="ij"), axis=-1).reshape(-1, 3)
    found = control.at(mi.Vector3i(*lower[:, ::-1].T), mi.Bool(True))
    assert np.array_equal(np.array(found).T, values.reshape(-1, channels))


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
    """The differentiated light: S of all cells, the light behind, and the probe."""
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
    """The sweep of a ray starting at x = -1."""
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
