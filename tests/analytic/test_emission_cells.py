"""Parts of a cell for an emission with voxels of its own."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.line_integrals.emission import MAX_PARTS, count_parts, voxel_to_cell_ratio
from mivol.transport.media.medium_view import MediumView
from mivol.transport.traversal.lattice import Lattice
from scenes import FRAMES


def shift_along_x(x: float) -> np.ndarray:
    to_world = np.eye(4)
    to_world[0, 3] = x
    return to_world


CASES = {
    "the same voxels": (8, np.eye(4), 1),
    "coarser": (4, np.eye(4), 1),
    "three times as fine": (24, np.eye(4), 3),
    "too fine": (200, np.eye(4), MAX_PARTS),
    "beyond the box": (8, np.diag([2.0, 2, 2, 1]), 1),
    "ends at a voxel's face": (4, np.diag([0.5, 0.5, 0.5, 1]), 2),
    "ends at a voxel's centre": (4, np.diag([0.5625, 0.5625, 0.5625, 1]), 1),
    "begins at a voxel's face": (4, shift_along_x(0.125), 2),
    "ends anywhere": (4, np.diag([0.53, 1, 1, 1]), 4),
    "turned": (4, FRAMES["rotated"], 4),
}
"""Voxels of the emission along an edge, its place; the extinction has 8 on the unit cube."""


@pytest.mark.parametrize("name", CASES)
def test_parts_of_a_cell(name: str) -> None:
    count, place, parts = CASES[name]
    emission = mi.load_dict({"type": "mivol_voxels", "data": dr_zeros(count), "to_world": mi.ScalarTransform4f(place)})
    view = make_view(emission)
    assert count_parts(view) == parts
    if name == "three times as fine":
        assert voxel_to_cell_ratio(emission, view) == pytest.approx(1 / 3)


def dr_zeros(count: int) -> mi.TensorXf:
    return mi.TensorXf(np.zeros((count, count, count, 1), np.float32))


def make_view(emission: mi.Volume | float | None) -> MediumView:
    """The part of a medium's view that counts."""
    view = MediumView.__new__(MediumView)
    values = {
        "emission": emission,
        "albedo": 0.5,
        "stock_boxes": {},
        "parts": [],
        "emission_lattice": Lattice(dr_zeros(8), np.eye(4)),
    }
    for key, value in values.items():
        object.__setattr__(view, key, value)
    return view


def test_numbers_need_no_parts() -> None:
    assert count_parts(make_view(None)) == count_parts(make_view(2.0)) == 1
