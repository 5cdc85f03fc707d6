"""Boxes: corners, containment, and boxes of cubes."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.box import Box, fit_box

pytestmark = pytest.mark.usefixtures("variant_rgb")


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


def test_box_of_a_sheared_cube():
    """The eight corners of a sheared cube, to the float32 of its vertices."""
    shear = np.array([[1, 0.5, 0, 3], [0, 2, 0, -1], [0.25, 0, 1, 0], [0, 0, 0, 1.0]])
    cube = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f(shear)})
    ends = np.array([[x, y, z, 1] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
    np.testing.assert_allclose(fit_box(cube).corners(), (ends @ shear.T)[:, :3], atol=8 * 2.0**-24 * 6)
