"""Doubts about Mitsuba's pictures, one check after the other, from facts that are made up: just met, and just not."""

from __future__ import annotations

import itertools
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mivol.validate import trust
from mivol.validate.trust import FACE_TOLERANCE, MediumShape, _crossings
from scenes import affine, rotation

CORNERS = np.array(list(product((0.0, 1.0), repeat=3)))

FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 5, 1], [0, 4, 5],
                  [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
"""Of the unit cube, with normals outwards."""

PLAIN = MediumShape("box", CORNERS, None, None, None, None, "", (), CORNERS, 1.0, 0.0, {"albedo.value": 0.5})


def found(kind: str, **facts: object) -> list[tuple[str, bool]]:
    return list(trust.DOUBT_CHECKS[kind](replace(PLAIN, **facts)))


def test_a_plain_medium_raises_no_doubt() -> None:
    assert all(list(check(PLAIN)) == [] for check in trust.DOUBT_CHECKS.values())


def overhanging(by: float) -> np.ndarray:
    """World to a box that the unit cube overhangs so far."""
    return affine(np.eye(3) * (1 + by))


GRID = overhanging(2 * FACE_TOLERANCE)
INSIDE = overhanging(0.5 * FACE_TOLERANCE)

THRESHOLDS: dict[str, list[tuple[dict, bool | None]]] = {
    "not finite": [
        ({"majorant": np.inf}, True),
        ({"majorant": np.nan}, True),
        ({"majorant": -1e-9}, True),
        ({"majorant": 0.0}, None),
    ],
    "rotated grid": [
        ({"grids": (affine(2 * rotation([0, 0, 1], 0.3)),)}, True),
        ({"grids": (affine(2 * np.eye(3)), affine(2 * rotation([0, 0, 1], 0.3)))}, True),
        ({"grids": (affine(2 * np.eye(3)[[1, 2, 0]]),)}, None),
        ({"grids": (affine(2 * rotation([0, 0, 1], 0.9e-5)),)}, None),
        ({"grids": (affine(2 * rotation([0, 0, 1], 1.1e-5)),)}, True),
        ({"grids": (affine(0.3 * rotation([0, 0, 1], 0.3), [0.4, 0.4, 0.4]),)}, None),
    ],
    "too deep": [
        ({"to_local": GRID, "majorant": 87.001 / np.sqrt(3)}, True),
        ({"to_local": GRID, "majorant": 86.999 / np.sqrt(3)}, None),
        ({"to_local": INSIDE, "majorant": 1e3}, None),
        ({"majorant": 1e3}, None),
    ],
    "constant box": [
        ({"to_local": GRID, "volume": "ConstVolume"}, False),
        ({"to_local": INSIDE, "volume": "ConstVolume"}, None),
        ({"to_local": GRID, "volume": "GridVolume"}, None),
    ],
    "mirrored": [
        ({"to_world": np.diag([-1.0, 1, 1, 1])}, True),
        ({"to_world": np.diag([-1.0, -1, 1, 1])}, None),
        ({"faces": FACES}, None),
        ({"faces": FACES[:, ::-1]}, True),
        ({"faces": FACES, "points": CORNERS + 100}, None),
    ],
    "wrong inverse": [
        ({"to_local": np.diag([2.0, 1, 1, 1]), "to_local_inverse": np.diag([0.5, 1, 1, 1])}, None),
        ({"to_local": np.diag([2.0, 1, 1, 1]), "to_local_inverse": np.diag([0.5 * (1 + 0.9e-4), 1, 1, 1])}, None),
        ({"to_local": np.diag([2.0, 1, 1, 1]), "to_local_inverse": np.diag([0.5 * (1 + 2.1e-4), 1, 1, 1])}, True),
        ({"to_local": affine(np.eye(3), [1, 2, 3]), "to_local_inverse": affine(np.eye(3), [-1, -2, -3]).T}, None),
        ({"to_local": affine(np.eye(3), [1, 2, 3]), "to_local_inverse": affine(np.eye(3), [-1, -2, -3])}, True),
        ({"to_local": np.eye(4)}, None),
        ({"to_local_inverse": 2 * np.eye(4)}, None),
    ],
    "small g": [
        ({"params": {"phase_function.g": 9e-4, "albedo.value": 0.5}}, False),
        ({"params": {"phase_function.g": -9e-4, "sigma_s.data": np.ones(3)}}, False),
        ({"params": {"phase_function.g": 9e-4}}, False),
        ({"params": {"phase_function.g": 1e-3, "albedo.value": 0.5}}, None),
        ({"params": {"phase_function.g": 0.0, "albedo.value": 0.5}}, None),
        ({"params": {"phase_function.g": 9e-4, "albedo.value": np.zeros(3)}}, None),
        ({"params": {"phase_function.g": 9e-4, "albedo.value": 0.0, "sigma_s.value": 1.0}}, False),
    ],
    "microflakes": [
        ({"params": {"phase_function.S.data": 1, "albedo.value": 0.5}}, True),
        ({"params": {"phase_function.nested.S.value": 1, "albedo.value": 0.5}}, True),
        ({"params": {"phase_function.S.data": 1, "albedo.value": 0.0}}, None),
        ({"params": {"phase_function.Scale": 1, "albedo.value": 0.5}}, None),
    ],
    "emission": [
        ({"params": {"emission.value": [0, 0, 1e-9]}}, True),
        ({"params": {"emission.value": [0, 0, 0]}}, None),
        ({"params": {"scale": 1.0}}, None),
    ],
    "thick skin": [
        ({"skin": 2.001e-3}, False),
        ({"skin": 1.999e-3}, None),
        ({"skin": 1.0, "params": {"albedo.value": 0.0}}, None),
    ],
}


def test_every_check_has_its_threshold() -> None:
    assert THRESHOLDS.keys() == trust.DOUBT_CHECKS.keys()


@pytest.mark.parametrize(("kind", "number"), [(kind, k) for kind, cases in THRESHOLDS.items() for k in range(len(cases))])
def test_a_doubt_begins_where_it_should(kind: str, number: int) -> None:
    """Whether there is a doubt, and whether it is fatal (True) or a remark (False)."""
    facts, fatal = THRESHOLDS[kind][number]
    doubts = found(kind, **facts)
    assert [is_fatal for _, is_fatal in doubts] == ([] if fatal is None else [fatal])
    assert all("box" in sentence for sentence, _ in doubts)


def test_shapes_that_touch() -> None:
    """Beside each other with a face in common, or one in the other with one; not with a gap, and not where corners meet."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (6000, 3))
    axis = rng.integers(3, size=6000)
    points[np.arange(6000), axis] = rng.integers(2, size=6000)

    def cube(low: tuple, size: float = 1.0) -> MediumShape:
        corners = CORNERS * size + low
        return replace(PLAIN, points=corners, surface=points * size + low)

    one = cube((0, 0, 0))
    places = {(1, 0, 0): True, (1.001, 0, 0): False, (0, 0.5, 1): True, (1, 1, 1): False, (3, 0, 0): False}
    for other, touches in places.items():
        assert trust._touch(one, cube(other)) == trust._touch(cube(other), one) == touches, other
    assert trust._touch(one, cube((0, 0.25, 0.25), 0.5)) and not trust._touch(one, cube((0.25, 0.25, 0.25), 0.5))


def test_a_point_is_inside() -> None:
    """The box itself, the ball in it where the shape is one, and what the faces of a mesh enclose."""
    ball = replace(PLAIN, points=2 * CORNERS - 1 + 5, to_world=affine(np.eye(3), [5, 5, 5]))
    cube = replace(PLAIN, faces=FACES)
    for shape, inside, outside in (
        (PLAIN, [0.99, 0.01, 0.5], [1.01, 0.5, 0.5]),
        (ball, [5.5, 5.5, 5.5], [5.6, 5.6, 5.6]),
        (cube, [0.99, 0.01, 0.5], [0.5, 0.5, -0.01]),
    ):
        assert shape.holds(np.array(inside)) and not shape.holds(np.array(outside))
    assert PLAIN.diagonal == pytest.approx(np.sqrt(3)) and not PLAIN.overhangs
    assert replace(PLAIN, to_local=GRID).overhangs and not replace(PLAIN, to_local=INSIDE).overhangs
    assert replace(PLAIN, to_local=affine(np.eye(3), [-2 * FACE_TOLERANCE, 0, 0])).overhangs


def cube() -> np.ndarray:
    """(12, 3, 3) the triangles of the unit cube."""
    triangles = []
    for axis, side in itertools.product(range(3), (0.0, 1.0)):
        corners = np.insert(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), axis, side, axis=1)
        triangles += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    return np.array(triangles)


def test_a_ray_leaves_a_cube_once_more_than_it_enters() -> None:
    """Crossings are 1 from inside; from outside 0 or 2, as slabs say."""
    triangles, toward = cube(), np.array([0.8017837, 0.2672612, 0.5345225])
    for p in np.random.default_rng(4).uniform(-0.6, 1.6, (300, 3)):
        far, near = np.maximum((1 - p) / toward, -p / toward).min(), np.minimum((1 - p) / toward, -p / toward).max()
        expected = (near < far) * (int(far > 0) + int(near > 0))
        assert _crossings(p, triangles) == expected, p
