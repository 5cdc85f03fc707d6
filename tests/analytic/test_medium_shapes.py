"""Whether a point lies inside a closed mesh: a ray from it crosses the mesh an odd number of times."""

from __future__ import annotations

import itertools

import numpy as np

from mivol.validate.trust import _crossings


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
