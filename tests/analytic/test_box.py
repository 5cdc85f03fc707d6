"""Boxes: corners, containment, and boxes of cubes; balls, and where rays enter and leave them."""

from __future__ import annotations

import math
from fractions import Fraction

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.box import (
    UNIT_CUBE,
    Box,
    clip_to_ball,
    clip_to_box,
    clip_to_faces,
    find_ball,
    find_faces,
    fit_ball,
    fit_box,
    is_in_box,
)
from scenes import camera


def placed(low: float, edge: float) -> np.ndarray:
    """A cube with its low corner on the diagonal."""
    matrix = np.diag([edge, edge, edge, 1.0])
    matrix[:3, 3] = low
    return matrix


def test_a_box_contains_what_lies_in_it_to_a_tolerance():
    box = Box(placed(-1, 2))
    assert box.contains(placed(-1, 2), 1e-9) and box.contains(placed(-0.5, 1), 0)
    assert not box.contains(placed(-0.5, 2), 1e-3)
    assert box.contains(placed(-1.001, 2), 1e-3) and not box.contains(placed(-1.003, 2), 1e-3)


def test_matching_boxes_have_the_same_corners():
    """Independent of the order of the axes: a quarter turn about z maps the cube to itself."""
    turned = placed(-1, 2) @ np.array([[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    assert Box(placed(-1, 2)).matches(turned, 1e-12)
    assert not Box(placed(-1, 2)).matches(placed(-1, 2.1), 1e-2)
    assert Box(placed(-1, 2)).matches(placed(-1, 2.01), 1e-2)


@pytest.mark.parametrize("t1", [np.inf, 2.5])
def test_an_upright_box_clips_as_any_box(t1: float) -> None:
    """Rays from afar, from inside and beside; parallel to faces between, outside and in them; NaN and directions of length 0.

    Each way rounds some ten times: relative to the distance, by at most 16 x 2^-53 over the smallest of the components 0.01.
    """
    rng, box = np.random.default_rng(4), Box(np.array([[2, 0, 0, -1], [0, 0.5, 0, 0.25], [0, 0, 3, 1], [0, 0, 0, 1.0]]))
    o, d = rng.uniform(-4, 4, (3, 4096)).astype(np.float32), rng.normal(size=(3, 4096)).astype(np.float32)
    d = np.where(np.abs(d) < 0.01, 0.01, d)
    o[:, ::4] = np.array([[0.0], [0.5], [2.0]]) + 0.2 * o[:, ::4] / 4  # inside
    for k, place in enumerate((0.3, -1.0, 1.0, 1.5)):  # between, in and outside of two faces
        o[0, k::64], d[0, k::64] = place, -0.0 if k % 2 else 0.0
    d[:, 4::64], o[1, 5::64] = 0, np.nan
    ray, interval = (mi.Point3f(o), mi.Vector3f(d)), (mi.Float64(0), mi.Float64(t1))
    *_, begin, end = map(np.array, clip_to_box(box.rows(), *UNIT_CUBE, *ray, *interval)[2:])
    low, high = map(np.array, clip_to_faces(*find_faces(box.rows()), *ray, *interval))
    hits = end > begin
    assert hits.sum() > 1000 and hits[0::64].all() and not hits[1::64].any()
    np.testing.assert_array_equal(high > low, hits)
    np.testing.assert_allclose(low[hits], begin[hits], rtol=16 * 2.0**-53 / 0.01)
    np.testing.assert_allclose(high[hits], end[hits], rtol=16 * 2.0**-53 / 0.01)


def test_upright_boxes_have_edges_along_the_axes() -> None:
    at = mi.ScalarTransform4f().translate([100.3, -0.9, 7]).scale([0.3, 2, 5])
    assert fit_box(mi.load_dict({"type": "cube", "to_world": at})).is_upright
    tilted = at.rotate([0, 0, 1], 1e-4)
    assert not fit_box(mi.load_dict({"type": "cube", "to_world": tilted})).is_upright
    quarter = mi.ScalarTransform4f().rotate([0, 0, 1], 90)
    assert not fit_box(mi.load_dict({"type": "cube", "to_world": quarter})).is_upright


def test_box_of_a_sheared_cube():
    """The eight corners of a sheared cube, to the float32 of its vertices."""
    shear = np.array([[1, 0.5, 0, 3], [0, 2, 0, -1], [0.25, 0, 1, 0], [0, 0, 0, 1.0]])
    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f(shear)})
    ends = np.array([[x, y, z, 1] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
    np.testing.assert_allclose(fit_box(cube).corners(), (ends @ shear.T)[:, :3], atol=8 * 2.0**-24 * 6)


SHEAR = np.array([[1, 0.5, 0, 3], [0, 2, 0, -1], [0.25, 0, 1, 0], [0, 0, 0, 1.0]])
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]]  # fmt: skip
"""Two triangles a face of the unit cube, with their outsides out."""


def mesh_of(corners: np.ndarray, faces: list) -> mi.Mesh:
    mesh = mi.Mesh("mesh", len(corners), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(corners.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(np.array(faces, np.uint32).ravel())
    params.update()
    return mesh


@pytest.mark.parametrize("shares", [True, False], ids=["8 vertices", "36 vertices"])
@pytest.mark.parametrize("place", [np.eye(4), SHEAR], ids=["upright", "sheared"])
def test_a_mesh_may_be_a_box(place: np.ndarray, shares: bool) -> None:
    """In any order of its vertices and faces; the corners are those of its vertices, to their float32."""
    rng = np.random.default_rng(3)
    world = CORNERS @ place[:3, :3].T + place[:3, 3]
    order = rng.permutation(8)
    faces = np.argsort(order)[np.array(FACES)[rng.permutation(12)]]
    mesh = mesh_of(world[order], faces) if shares else mesh_of(world[order][faces].reshape(-1, 3), np.arange(36).reshape(12, 3))
    found = fit_box(mesh).corners()
    apart = np.abs(found[:, None] - world[None]).max(axis=2)
    assert sorted(apart.argmin(axis=1)) == list(range(8))
    assert apart.min(axis=1).max() <= 4 * 2.0**-24 * np.abs(world).max()


MOVED = CORNERS + 1e-4 * np.eye(8)[5][:, None]
OTHERS = {
    "a corner that is moved": (MOVED, FACES),
    "a frustum": (CORNERS * (1 - 0.3 * CORNERS[:, 2:] * [1, 1, 0]), FACES),
    "faces that look inwards": (CORNERS, [face[::-1] for face in FACES]),
    "one face that looks inwards": (CORNERS, [FACES[0][::-1], *FACES[1:]]),
    "an open side, and one that is covered twice": (CORNERS, [*FACES[:10], [0, 1, 2], [1, 3, 2]]),
    "triangles that overlap": (CORNERS, [[0, 1, 2], *FACES[1:]]),
    "faces that cross the inside": (CORNERS, [[0, 1, 7], *FACES[1:]]),
    "a tetrahedron": (CORNERS[:4], [[0, 1, 2]] * 12),
    "a part of the sides": (CORNERS, FACES[:11]),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_meshes_are_no_box(name: str) -> None:
    assert fit_box(mesh_of(*OTHERS[name])) is None


def test_other_shapes_are_no_box() -> None:
    assert fit_box(mi.load_dict({"type": "sphere"})) is None
    mirrored = mi.ScalarTransform4f().scale([-1, 1, 1])
    assert fit_box(mi.load_dict({"type": "cube", "to_world": mirrored})) is None  # its inside is outside, as in Mitsuba


# -- Balls -----------------------------------------------------------------------------------------------------------------


def ball_around(centre: list[float], radius: float) -> Box:
    """The ball of a ``sphere`` shape."""
    return fit_ball(mi.load_dict({"type": "sphere", "center": centre, "radius": radius}))


def chord(o: np.ndarray, d: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Both ends of the chord of a ray in exact rational arithmetic up to the square root."""
    o, d, c, r = ([Fraction(float(x)) for x in np.atleast_1d(v)] for v in (o, d, centre, radius))
    away = [a - b for a, b in zip(o, c, strict=True)]
    dd, ad, aa = (sum(x * y for x, y in zip(a, b, strict=True)) for a, b in ((d, d), (away, d), (away, away)))
    root = math.sqrt((ad * ad - dd * (aa - r[0] ** 2)) / dd**2)
    return np.array([float(-ad / dd) - root, float(-ad / dd) + root])


@pytest.mark.parametrize("away", [2.0, 100.0, 1e4])
def test_a_ray_enters_and_leaves_a_ball_where_its_equation_says(away: float) -> None:
    """Seen from afar the ends keep their digits: coordinates of the size ``away`` are rounded in float64 a few times."""
    rng, centre, radius = np.random.default_rng(3), np.array([0.3, -0.2, 0.5]), 0.7
    target = centre + rng.uniform(-0.3, 0.3, (16, 3))
    o = np.float32(target + away * np.array([0.48, -0.6, 0.64]))
    d = np.float32((target - o) / np.linalg.norm(target - o, axis=1, keepdims=True))
    box = ball_around(centre.tolist(), radius)
    c, r = box.to_world[:3, 3] + box.to_world[0, 0] / 2, box.to_world[0, 0] / 2
    ball, ray = find_ball(box.rows()), (mi.Point3f(o.T), mi.Vector3f(d.T))
    t0, t1 = clip_to_ball(*ball, *ray, mi.Float64(0), mi.Float64(np.inf))
    truth = np.array([chord(a, b, c, r) for a, b in zip(o, d, strict=True)])
    found = np.stack([np.array(t0), np.array(t1)], axis=1)
    np.testing.assert_allclose(found, truth, rtol=0, atol=64 * 2.0**-52 * away)
    middle = truth.mean(axis=1)
    t0, t1 = clip_to_ball(*ball, *ray, mi.Float64(middle), mi.Float64(middle + 0.1))
    np.testing.assert_array_equal(np.array(t0), middle)
    np.testing.assert_array_equal(np.array(t1), middle + 0.1)


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_rays_beside_behind_and_without_a_ball(start: float) -> None:
    """A ray beside the ball, one that leaves it behind, a direction of length 0, and NaN have no interval inside."""
    ball = find_ball(ball_around([0.0, 0.0, 0.0], 0.5).rows())
    o = mi.Point3f([0.6, 0, 0, 0], 0, [-2, 2, -2, -2])
    d = mi.Vector3f(0, 0, [1, 1, 0, np.nan])
    t0, t1 = clip_to_ball(*ball, o, d, mi.Float64(start), mi.Float64(np.inf))
    assert not np.any(np.array(t1) > np.array(t0))


def test_points_in_a_ball() -> None:
    box = ball_around([1.0, 0.0, 0.0], 0.5)
    p = mi.Point3f([1.0, 1.49, 1.51, 1.4, 0.49], [0, 0, 0, 0.4, 0], 0)
    assert np.array(is_in_box(box.rows(), True, p)).tolist() == [True, True, False, False, False]
    assert np.array(is_in_box(box.rows(), False, p)).tolist() == [True, True, False, True, False]
    assert box.diameter == pytest.approx(1, rel=1e-7)


@pytest.mark.parametrize("kind", ["mivol", "stock"])
def test_a_ball_in_closed_form_looks_as_when_it_is_traced(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant, and a grid in the box around the ball, which the ball cuts; a traced boundary is known to a few float32
    roundings of its coordinates."""
    noise = np.random.default_rng(1).random((5, 6, 7, 1)).astype(np.float32)
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(noise), "to_world": place}
    medium = {"type": "heterogeneous" if kind == "stock" else "mivol_medium", "sigma_t": grid, "albedo": 0.0}
    ball = {"type": "sphere", "radius": 1.0, "bsdf": {"type": "null"}, "interior": medium}
    fog = ball | {"center": [2.5, 0, 0], "radius": 1.0, "interior": {"type": "homogeneous", "sigma_t": 0.7, "albedo": 0.0}}
    scene = mi.load_dict({"type": "scene", "ball": ball, "fog": fog, "sky": {"type": "constant"},
                          "sensor": camera([4, 6, 2], [1, 0, 0], res=16, fov=40)})  # fmt: skip
    images = []
    for fit in (fit_ball, lambda shape: None):
        monkeypatch.setattr("mivol.scene.survey.fit_ball", fit)
        images.append(np.array(mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 2}), spp=4, seed=1)))
    assert images[0].min() < 0.5
    # Far from the rim; a ray that grazes the ball has a chord of any length below sqrt(8 r eps).
    np.testing.assert_allclose(*images, rtol=0, atol=1e-3)
    assert np.median(np.abs(images[0] - images[1])) < 1e-6
