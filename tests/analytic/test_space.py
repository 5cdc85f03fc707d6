"""Where a grid lies: lattice coordinates of known points, and the boxes that have no volume."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_refused

from mivol.space import check_affine, lattice_from_world


def box(*columns: tuple[float, float, float], shift: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = np.array(columns, dtype=float).T, shift
    return m


def test_centres_and_faces():
    """Voxel n has its centre at q = n; the faces of the box lie at -1/2 and N - 1/2."""
    place = box((2, 0, 0), (0, 3, 0), (0, 0, 4), shift=(1, 1, 1))
    q = lattice_from_world(place, (7, 6, 5))  # Z, Y, X
    low, high = np.array([1, 1, 1, 1.0]), np.array([3, 4, 5, 1.0])
    centre = np.array([1 + 2 * 1.5 / 5, 1 + 3 * 0.5 / 6, 1 + 4 * 6.5 / 7, 1.0])
    # Float64 products of numbers of order 1.
    assert np.abs(q @ low - [-0.5, -0.5, -0.5]).max() < 1e-14
    assert np.abs(q @ high - [4.5, 5.5, 6.5]).max() < 1e-14
    assert np.abs(q @ centre - [1, 0, 6]).max() < 1e-14


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (box((1, 0, 0), (0, 1, 0), (1, 1, 0)), "degenerate"),  # flat: the third edge lies in the plane of the others
        (box((1, 0, 0), (0, 0, 0), (0, 0, 1)), "degenerate"),
        (box((1, 0, 0), (0, np.nan, 0), (0, 0, 1)), "non-finite"),
        (np.eye(3), "shape"),
        (np.diag([1, 1, 1, 2.0]), "affine"),
    ],
)
def test_places_without_volume(matrix, word):
    assert_refused(word, check_affine, matrix)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_small_and_large_boxes_pass(scale):
    check_affine(box((scale, 0, 0), (0, 3 * scale, 0), (0, 0, scale)))
