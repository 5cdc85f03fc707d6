"""The sweep over one medium, with an integrand of known sum: opacities add up to 1 - exp(-tau)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.line_integrals.composite import BodySweep
from mivol.transport.line_integrals.integrand import LineIntegral
from mivol.transport.media.body import Body
from mivol.transport.media.compositing import CellIntegral, transmittance_of
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment
from mivol.transport.media.scene_media import SceneMedia
from scenes import box_of, camera, centred, grid_volume, media_of

N = 5
SIGMA = np.array([0.5, 2.0, 0.25, 1.0, 4.0], np.float32)
"""Voxels of a unit cube along x, in a constant of 0.5 that fills [-1, 2]^3."""

CONSTANT = 0.5
ROUNDING = 32 * 2.0**-23
"""Bound of the rounding of sums of 7 pieces, with several roundings each, relative to numbers of size 1."""


class Opacity:
    """N = 1 - exp(-tau) of a cell with the mean extinction, or of a constant."""

    rows, points = 1, (0.25, 0.75)

    def integrate_cell(self, piece: object, sigma: list) -> list[CellIntegral]:
        (row,) = sigma
        tau = piece.dt * 0.5 * (row[0] + row[1])
        half, T = 0.5 * piece.dt, dr.exp(-tau)
        return [CellIntegral(tau, T, 1 - T, [half, half], [T * half, T * half])]

    def integrate_constant(self, piece: object, sigma: list) -> list[CellIntegral]:
        T = dr.exp(-sigma[0] * piece.dt)
        return [CellIntegral(sigma[0] * piece.dt, T, 1 - T, [piece.dt], [T * piece.dt])]

    def vjp(self, piece: object, sigma: list, weight: list) -> None:
        """Do nothing: the integrand has no parameters."""

    def jvp(self, piece: object, sigma: list) -> list[mi.Float]:
        return [mi.Float(0)]


@pytest.fixture
def media(variant_rgb: str) -> SceneMedia:
    grid = grid_volume("mivol_voxels", SIGMA.reshape(1, 1, N, 1))
    fog = {"type": "mivol_medium", "sigma_s": grid, "sigma_a": CONSTANT}
    box = box_of(fog, centred(3 * np.eye(3), (0.5, 0.5, 0.5)))
    return media_of(mi.load_dict({"type": "scene", "box": box, "sensor": camera([0, -4, 0], [0, 0, 0])}))


def sweep(media: SceneMedia, tangent: bool = False) -> BodySweep:
    """A sweep along x through the grid, from -1 + 0.5 to 2."""
    ray = mi.Ray3f(mi.Point3f(-1, 0.5, 0.5), mi.Vector3f(1, 0, 0), dr.inf, mi.Float(0), mi.Color0f())
    on, (body,) = mi.Bool(True), media.bodies
    line = LineIntegral(media, Opacity(), RaySegment(ray, mi.MediumPtr(None), mi.Float(3)), on)
    return BodySweep(line, MediumInterval(ray, mi.Float64(0.5), mi.Float64(3), on, body), tangent)


TAU = SIGMA.mean() + 2.5 * CONSTANT
"""The trilinear values, with a constant border, have the mean of the voxels."""


def in_order(body: Body, grid: object, constant: object) -> list:
    """One entry for each part of the medium, in order."""
    return [constant if part.lattice is None else grid for part in body.view.parts]


def test_opacities_add_up(media):
    with dr.suspend_grad():
        found = sweep(media).integrate(skip=True)
    assert float(found.tau[0][0]) == pytest.approx(TAU, rel=ROUNDING)
    assert found.N[0][0] == pytest.approx(1 - np.exp(-TAU), rel=ROUNDING)


def test_tangents_follow(media):
    """N' = T tau' for any change of the voxels and of the constant."""
    v = np.array([1, -2, 3, -4, 5], np.float32)
    media.bodies[0].tangents = in_order(media.bodies[0], mi.Float(v), mi.Float(0.75))
    with dr.suspend_grad():
        found = sweep(media, tangent=True).integrate(skip=False)
    dtau = v.mean() + 2.5 * 0.75
    assert float(found.tau[1][0]) == pytest.approx(dtau, rel=ROUNDING * 4)
    assert found.N[1][0] == pytest.approx(np.exp(-TAU) * dtau, abs=ROUNDING)


def test_the_transpose_gives_each_voxel_its_share(media):
    """weight T_front T over the length of each part, minus the light behind the medium."""
    media.start_gradients()
    front, weight, behind = 0.25, 3.0, 0.125
    with dr.suspend_grad():
        ahead = [mi.Float64(front + TAU)]
        sweep(media).vjp([mi.Float(weight)], ahead, [mi.Float(behind)])
    slope = weight * np.exp(-front - TAU) - behind
    (body,) = media.bodies
    grid, constant = sorted(zip(in_order(body, 0, 1), body.gradients, strict=True), key=lambda pair: pair[0])
    np.testing.assert_allclose(np.array(grid[1].fold()).ravel(), np.full(N, slope / N), atol=ROUNDING)
    assert np.array(constant[1])[0] == pytest.approx(2.5 * slope, abs=ROUNDING)


def test_a_depth_that_rounding_left_below_0_lets_all_through():
    found = np.array(transmittance_of(mi.Float64(-1e-9, 0, 1)))
    assert found[:2].tolist() == [1, 1] and found[2] == pytest.approx(np.exp(-1), rel=2 * 2.0**-23)
