"""Boxes around shapes, and whether two of them share space: by hand."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.scene.nesting import (
    FACE_TOLERANCE,
    MAX_PAIRS,
    OrientedBox,
    _is_closed,
    _pairs,
    _registry_id,
    oriented_box,
    scene_diagonal,
    shape_bounds,
)
from scenes import rotation

UPRIGHT = np.eye(3)


def box(low: np.ndarray, high: np.ndarray, turn: np.ndarray = UPRIGHT) -> OrientedBox:
    """An upright box, turned about the origin."""
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 0, low, high)
    return OrientedBox(corners @ turn.T, turn.T)


@pytest.mark.parametrize("turn", [np.eye(3), rotation([1, 2, 3], 0.7)], ids=["upright", "turned"])
@pytest.mark.parametrize("size", [1.0, 1e3])
@pytest.mark.parametrize("axis", range(3))
def test_a_gap_counts_in_sizes_of_the_larger_box(turn: np.ndarray, size: float, axis: int) -> None:
    """The size is the largest coordinate of both boxes, whichever is asked; a margin of either sign is met to a part in 1e9."""
    one = box(np.full(3, -size), np.full(3, size), turn)
    largest = np.abs(one.corners).max()
    for margin in (FACE_TOLERANCE, -FACE_TOLERANCE, 0.01):
        for off, shared in ((-1e-3, True), (1e-3, False)):
            low, high = np.full(3, -0.1 * size), np.full(3, 0.1 * size)
            low[axis], high[axis] = size + margin * largest * (1 + off * np.sign(margin)), 1.2 * size
            two = box(low, high, turn)
            scale = max(np.abs(two.corners).max(), largest)
            low[axis] = size + margin * scale * (1 + off * np.sign(margin))
            two = box(low, high, turn)
            assert one.shares(two, margin) == two.shares(one, margin) == shared
    assert one.shares(one) and not one.shares(box(np.full(3, 1.5 * size), np.full(3, 2 * size), turn))


@pytest.mark.parametrize("turn", [np.eye(3), rotation([1, 2, 3], 0.7)], ids=["upright", "turned"])
def test_a_flat_box_has_distances(turn: np.ndarray) -> None:
    """The box of a rectangle of 4 by 2: over its middle, beside it, and both, over its longest edge."""
    flat = box(np.array([-2.0, -1, 0]), np.array([2.0, 1, 0]), turn)
    for point, expected in (([1, 0.5, 0], 0), ([0, 0, 3], 3), ([5, 0, 0], 3), ([5, 0, -4], 5)):
        assert flat.distance(turn @ point) == pytest.approx(expected / 4, abs=1e-12)
    assert box(np.array([-2.0, -1, -3]), np.array([2.0, 1, 0.1]), turn).distance(turn @ [0.3, 0.7, -0.1]) == 0


@pytest.mark.parametrize("axis", range(3))
def test_a_face_parts_boxes_that_are_turned_otherwise(axis: int) -> None:
    """A corner of one box points at the middle of a face of the other: no other plane separates them."""
    one, turned = box(-np.ones(3), np.ones(3)), box(np.full(3, -0.3), np.full(3, 0.3), rotation([1, 2, 3], 0.8))
    for gap, shared in ((-1e-3, True), (1e-3, False)):
        shift = np.zeros(3)
        shift[axis] = 1 + gap - turned.corners[:, axis].min()
        two = OrientedBox(turned.corners + shift, turned.edges)
        assert one.shares(two) == two.shares(one) == shared


def test_edges_that_pass_each_other_are_told_apart() -> None:
    """Bars turned by 45 degrees about x and about y cross above each other: only a plane along an edge of each parts them."""
    bar, flat = np.array([2.0, 0.1, 0.1]), np.array([0.1, 2.0, 0.1])
    one = box(-bar, bar, rotation([1, 0, 0], np.pi / 4))
    half = 0.1 * np.sqrt(2)
    for gap, shared in ((-1e-3, True), (1e-3, False)):
        turned = rotation([0, 1, 0], np.pi / 4)
        two = OrientedBox(box(-flat, flat, turned).corners + np.array([0, 0, 2 * half + gap]), turned.T)
        assert one.shares(two) == two.shares(one) == shared


def scene(**shapes: dict) -> mi.Scene:
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def cube(x: float, half: float = 0.5) -> dict:
    fog = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}
    place = mi.ScalarTransform4f().translate([x, 0, 0]).scale(half)
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": fog}


def test_boxes_around_shapes(variant_rgb: str) -> None:
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], 30).scale([1, 2, 3])
    made = scene(a={"type": "cube", "to_world": turn}, b={"type": "sphere", "center": [9, 0, 0], "radius": 2})
    turned, ball = (oriented_box(s) for s in made.shapes())
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    np.testing.assert_allclose(turned.edges, [[c, s, 0], [-s, c, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(np.ptp(turned.corners @ turned.edges.T, axis=0), [2, 4, 6], rtol=1e-6)
    np.testing.assert_allclose([ball.corners.min(axis=0), ball.corners.max(axis=0)], [[7, -2, -2], [11, 2, 2]], rtol=1e-6)
    assert len(np.unique(ball.corners, axis=0)) == len(np.unique(turned.corners, axis=0)) == 8
    np.testing.assert_array_equal(ball.edges, np.eye(3))
    low, high = shape_bounds(made.shapes()[1])
    np.testing.assert_allclose([low, high], [[7, -2, -2], [11, 2, 2]], rtol=1e-6)
    left = -(c + 2 * s)
    whole = [11 - left, 2 * (2 * c + s), 6]
    assert scene_diagonal(made) == pytest.approx(np.linalg.norm(whole), rel=1e-6)
    assert scene_diagonal(scene()) == 0.0


def test_pairs_are_those_that_share_space(variant_rgb: str) -> None:
    """Cubes that touch are a pair where one of them is traced; those that overlap always are; those apart never."""
    made = scene(a=cube(0), b=cube(1), c=cube(1.5), d=cube(5))
    shapes = made.shapes()
    names = lambda pairs: {(a.id(), b.id()) for a, b in pairs}  # noqa: E731
    assert names(_pairs(shapes, set())) == {("b", "c")}
    for traced in (0, 1):
        assert names(_pairs(shapes, {_registry_id(mi.ShapePtr(shapes[traced]))})) == {("a", "b"), ("b", "c")}
    crowd = scene(**{f"c{i}": cube(0.01 * i) for i in range(13)})
    assert len(_pairs(crowd.shapes(), set())) == MAX_PAIRS


def test_what_is_closed(variant_rgb: str) -> None:
    """A ball and a cube enclose what is inside; a rectangle and a cube without a triangle do not."""
    made = scene(ball={"type": "sphere"}, cube={"type": "cube"}, square={"type": "rectangle"}, disk={"type": "disk"})
    assert {s.id(): _is_closed(s) for s in made.shapes()} == {"ball": True, "cube": True, "square": False, "disk": False}
    whole = mi.traverse(next(s for s in made.shapes() if s.id() == "cube"))
    open_ = mi.Mesh("open", 24, 11)
    params = mi.traverse(open_)
    params["vertex_positions"], params["faces"] = whole["vertex_positions"], whole["faces"][:33]
    params.update()
    assert not _is_closed(open_)
