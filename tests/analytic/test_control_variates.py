"""The rough source function of a control variate: where light comes from one direction or from all, it is known exactly."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import PLACE, close_up, point, smoke
from scipy.interpolate import RegularGridInterpolator

from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.single_scattering import control_variates
from mivol.transport.estimators.single_scattering.control_variates import (
    CameraOrigins,
    GridControl,
    build_grid_control,
    count_nodes,
)
from mivol.transport.path.estimators import Settings

pytestmark = pytest.mark.usefixtures("variant_rgb")

ALBEDO = 0.7


def control_of(emitter: dict) -> GridControl:
    """S in smoke so thin that it dims nothing: 4 x 3 x 5 voxels, whose coarse lattice has its nodes in the corners."""
    values = np.full((4, 3, 5, 1), 1e-7, np.float32)
    scene = close_up({"smoke": smoke(values, ALBEDO)[0], "emitter": emitter})
    survey, settings = survey_scene(scene), Settings(max_depth=2)
    with dr.suspend_grad():
        needs = find_needs(scene, scene.sensors()[0], survey)
        plan = make_plan(needs, settings)
        direct = build_estimators(scene, needs, plan, settings, survey, pictures=False).direct
        origins = CameraOrigins(mi.Point3f(0, 0, 5), mi.Float(0), mi.Vector3f(0, 0, -1))
        return build_grid_control(direct, direct.media.bodies[0], origins)


def test_constant_sky_of_a_colour():
    """albedo L, in every cell and each channel."""
    colour = [0.2, 1.0, 3.0]
    found = control_of({"type": "constant", "radiance": {"type": "rgb", "value": colour}})
    assert found.channels == 3
    values = np.array(found.values).reshape(5, 4, 6, 3)
    # 32 directions of weights that add up to 1, each rounded a few times, and a transmittance of 1 - 4e-7.
    np.testing.assert_allclose(values, np.broadcast_to(ALBEDO * np.array(colour), values.shape), rtol=1e-5)


def test_point_light_from_the_corners_of_the_grid():
    """albedo I / (4 pi r^2) in the nodes, which lie in the corners of the box, and linear between them."""
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
    """4 x 3 x 4 nodes, two cells apart: the light of each in its place, and trilinear between them."""
    monkeypatch.setattr(control_variates, "CELLS_PER_NODE", 2)
    place, intensity = np.array([4.0, 1.0, 2.5]), 3.0
    values = np.array(control_of(point(place, intensity)[0]).values).reshape(5, 4, 6)
    edges = [np.linspace(-1, 1, n) for n in (4, 3, 4)]
    away = place - np.stack(np.meshgrid(*edges, indexing="ij"), axis=-1)[..., ::-1]
    nodes = ALBEDO * intensity / (4 * np.pi * (away**2).sum(axis=-1))
    cells = np.stack(np.meshgrid(*(np.linspace(-1, 1, n) for n in values.shape), indexing="ij"), axis=-1)
    np.testing.assert_allclose(values, RegularGridInterpolator(edges, nodes)(cells), rtol=1e-5)


def test_nodes_stand_eight_cells_apart():
    """Two where all cells are within one step, and 33 at most: 31 steps of 8 cells and a last one of 7 need all of them."""
    assert [count_nodes(n) for n in (1, 7, 8, 15, 16, 247, 254, 255, 256, 1024)] == [2, 2, 3, 3, 4, 32, 33, 33, 33, 33]


def test_a_cell_has_the_light_of_its_place():
    """Three edges and two channels' worth of numbers: a cell is found in z, y, x, from a lower node of -1 on."""
    res, channels = (2, 4, 3), 3
    values = np.arange(3 * 5 * 4 * channels, dtype=np.float32).reshape(3, 5, 4, channels)
    control = GridControl(mi.Float(values.ravel()), res, channels)
    lower = np.stack(np.meshgrid(*(np.arange(-1, n) for n in res), indexing="ij"), axis=-1).reshape(-1, 3)
    found = control.at(mi.Vector3i(*lower[:, ::-1].T), mi.Bool(True))
    assert np.array_equal(np.array(found).T, values.reshape(-1, channels))
