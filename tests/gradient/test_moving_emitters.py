"""Gradients of single scattering by the position and direction of emitters."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, fresh
from scattering_gradients import BATCHES, assert_gradient, gradients, twin_difference, vjp, weights
from scattering_scenes import PLACE, aimed, mivol, pencils, point, rough_grid, smoke, spot, sun

import scenes
from mivol.transport.estimators.lighting.moving_emitters import _face_direction
from mivol.transport.traversal.box import UNIT_CUBE
from mivol.transport.traversal.rays import FineRay
from mivol.validate.statistics import Moments
from scenes import as_float32, box_of, grid_volume, medium


@pytest.mark.slow
@pytest.mark.statistical
def test_position_of_a_point_light():
    """Smooth for a light outside the medium: distance, direction and shadow all change."""
    values = rough_grid(10)
    box, m = smoke(values, 0.7, "own", PLACE, "hg", 0.4)
    emitter = point([1.5, 1, 2.0])
    seen = pencils({"smoke": box, "emitter": emitter[0]}, *aimed(3, 6))
    w, rows = weights(6)
    at = np.array([1.5, 1, 2.0])

    def light(x, axis):
        place = twins.Point(at + x * np.eye(3)[axis], 3.0)
        return rows @ twins.radiance([m], [place], seen.o, seen.d, order=10)[:, 0]

    truth = np.array([twin_difference(lambda x, a=a: light(x, a), 0.0) for a in range(3)])
    assert_gradient(gradients(seen, "emitter.position", w, 2048), truth[:, None], "position", rounding=1e-4)


TURNED = {
    "sun": lambda axis: sun(axis),
    "spot": lambda axis: spot([1.0, -2, 2.5], np.array([1.0, -2, 2.5]) + 3 * axis, cutoff=40, beam=5),
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("kind", small.cases(TURNED, ["spot"]))
def test_direction_of_an_emitter(kind):
    """A rotating sun moves its shadows; a rotating spot moves its cone only. Rotation by an angle about a perpendicular axis
    [rad]."""
    box, m = smoke(rough_grid(10), 0.7, "own", PLACE, "hg", 0.4)
    axis, across = np.array([-0.3, 0.6, -0.74]), np.array([0.8, 0.6, 0.0])
    axis = axis / np.linalg.norm(axis)

    def turned(x: float) -> np.ndarray:
        # Rodrigues' formula.
        c, s = math.cos(x), math.sin(x)
        return c * axis + s * np.cross(across, axis) + (1 - c) * across * (across @ axis)

    seen = pencils({"smoke": box, "emitter": TURNED[kind](axis)[0]}, *aimed(3, 6))
    w, rows = weights(6)
    known = lambda x: rows @ twins.radiance([m], [TURNED[kind](turned(x))[1]], seen.o, seen.d, order=10)[:, 0]  # noqa: E731
    truth = twin_difference(known, 0.0)

    params, integrator = mi.traverse(seen.scene), mi.load_dict(mivol())
    placed = params["emitter.to_world"]
    still, at = mi.AffineTransform4f(placed.matrix), mi.Vector3f(*np.array(placed.matrix)[:3, 3].ravel().tolist())
    found = []
    for seed in range(BATCHES):
        x = mi.Float(0)
        dr.enable_grad(x)
        move = mi.AffineTransform4f().translate(at).rotate(across.tolist(), dr.rad2deg(x)).translate(-at)
        params["emitter.to_world"] = move @ still
        params.update()
        image = mi.render(seen.scene, params, integrator=integrator, spp=2048, seed=fresh(seed))
        dr.backward(dr.sum(image * mi.TensorXf(w), axis=None))
        found.append(dr.grad(x)[0])
    assert_gradient(np.array(found)[:, None], np.array([truth]), kind, rounding=1e-4)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("depth", [2, 3])
def test_place_of_an_emitter_over_a_floor(depth):
    """A floor under haze: the distance of the emitter, the slope of its light and the haze in between change, in each of two
    bounces.

    No emitter lies in the plane of a face of the haze: the light has a kink there, since rays close to the face leave by it or
    along it.
    """
    haze = medium("homogeneous", 0.7, 0.6 if depth == 2 else 0.0)
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(3)}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(3)}
    parts = {"haze": box_of(haze, PLACE), "floor": floor, "wall": wall, "emitter": point([1.6, 1.3, 2.0])[0]}
    scene = small.close_up(parts, res=8)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "mivol", "max_depth": depth})
    along = mi.Vector3f(0.6, -0.3, 0.5)

    def picture(x: mi.Float, seed: int) -> mi.Float:
        params["emitter.position"] = mi.Point3f(1.6, 1.3, 2) + x * along
        params.update()
        return dr.sum(mi.render(scene, params, integrator=integrator, spp=256, seed=seed, seed_grad=seed + 100), axis=None)

    h, differences, found = 0.02, [], []
    for seed in map(fresh, range(BATCHES)):
        ends = [float(picture(mi.Float(sign * h), seed).array[0]) for sign in (1, -1)]
        differences.append((ends[0] - ends[1]) / (2 * h))
        x = mi.Float(0)
        dr.enable_grad(x)
        dr.backward(picture(x, seed))
        found.append(dr.grad(x)[0])
    m = Moments.from_values((np.array(differences) - np.array(found))[:, None])
    level = abs(np.mean(differences))
    # Truncation: (h / distance)^2 = 1e-4; the box's edges are kinks of the haze in between.
    assert_same_mean(m, rounding=2e-3 * level, what="floor")
    assert_precise(m, 0.02 * level, what="floor")


def round_media() -> dict[str, dict]:
    """Black media in balls, of which one is traced since its medium touches another."""
    grid, haze = medium("mivol_medium", grid_volume("mivol_voxels", 0.2 + rough_grid(1), PLACE)), medium("homogeneous", 0.4)
    turned = mi.ScalarTransform4f().rotate([1, 0, 0], 35).scale([0.7, 1.1, 0.8])
    egg = {"type": "sphere", "to_world": turned, "bsdf": {"type": "null"}, "interior": medium("homogeneous", 1.2)}
    return {
        "an egg": {"ball": egg},
        "a ball in its grid": {"ball": scenes.ball_of(grid, (0.1, 0, 0), 0.8)},
        "a ball around its grid": {"ball": scenes.ball_of(grid, (0, 0, 0), 1.8)},
        "a ball in a box": {
            "box": box_of(haze, PLACE),
            "ball": scenes.ball_of(medium("homogeneous", 1.5), (0, 0, 0), 0.6) | {"exterior": haze},
        },
    }


ROUND = ("an egg", "a ball in its grid", "a ball around its grid", "a ball in a box")


@pytest.mark.slow_for(
    "a ball around its grid-emitter1",
    "a ball in a box-emitter0",
    "a ball in a box-emitter1",
    "an egg-emitter0",
    "an egg-emitter1",
)
@pytest.mark.parametrize("emitter", [(0.3, -0.2, 3.0), (0.05, 0.1, 0.2)])
@pytest.mark.parametrize("name", ROUND)
def test_place_of_an_emitter_behind_balls(name, emitter):
    """The floor has no noise: differences of the same pencils. One emitter is outside the medium, one inside."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2.2]).scale(3)}
    o = np.column_stack([np.random.default_rng(4).uniform(-0.3, 0.3, (6, 2)), np.full(6, -2.0)])
    parts = {**round_media()[name], "floor": floor, "emitter": point(emitter)[0]}
    seen = pencils(parts, as_float32(o), as_float32([0, 0, -1]))
    params, integrator, w = mi.traverse(seen.scene), mi.load_dict(mivol()), weights(6)[0]

    def shown(x: np.ndarray) -> float:
        params["emitter.position"] = mi.Point3f(*(np.array(emitter) + x).tolist())
        params.update()
        return float((np.array(integrator.render(seen.scene, spp=1), np.float64) * w).sum())

    h = 0.004
    truth = [(shown(h * e) - shown(-h * e)) / (2 * h) for e in np.eye(3)]
    shown(np.zeros(3))
    found = vjp(seen.scene, "emitter.position", w, 1, 0, integrator).ravel()
    # A ray along a plane of voxels turns over a kink within h: a share h / voxel of the slope, 1.2e-2 of one ray in six; of the
    # rest truncation is 1e-5 and rounding 1e-7 / h.
    assert np.abs(found - truth).max() <= 3e-3 * np.abs(truth).max()


def test_an_edge_belongs_to_the_steeper_face():
    """A ray nearly in the face y = 0 leaves through x = 1. Rounding puts the point as far from x = 1 as from y = 0."""
    d = np.array([1, 1e-8, 0.1])
    d /= np.linalg.norm(d)
    ray = FineRay(mi.Point3d(0.2, 0, 0.3), mi.Vector3f(d.tolist()), mi.Float(9), mi.Float(0), mi.Color0f())
    rows = [[mi.Float64(float(i == j)) for j in range(3)] + [mi.Float64(0)] for i in range(3)]
    for rounding in (-1e-7, 0, 1e-7):
        face = _face_direction(rows, *UNIT_CUBE, ray, mi.Float64(0.8 / d[0] * (1 + rounding)))
        np.testing.assert_allclose(np.ravel(face), [1 / d[0], 0, 0], rtol=1e-6)
