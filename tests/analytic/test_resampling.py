"""A resampled radiance field has the same values on other nodes."""

from __future__ import annotations

import numpy as np
import pytest
from ball_photos import CUBE

from mivol.errors import MivolError
from mivol.fields.resampling import resample_field
from mivol.fields.spherical_grid import SphericalGrid


def test_a_field_on_finer_nodes_is_the_same_field(variant_rgb: str) -> None:
    n = 6
    g = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    sh = np.stack([x + 2 * y - z] * 3, axis=-1)[..., None, :]
    field = SphericalGrid.from_dense(1 - x + y * 3, sh, CUBE)
    keep = np.ones((n, n, n), bool)
    keep[:2] = False
    fine = resample_field(field, (12, 12, 12), CUBE, keep)
    density, found = fine.to_dense()
    g = (np.arange(12) + 0.5) / 12
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    inner = np.s_[5:-1, 1:-1, 1:-1]
    np.testing.assert_allclose(density[inner], (1 - x + 3 * y)[inner], atol=1e-5)
    np.testing.assert_allclose(found[..., 0, 0][inner], (x + 2 * y - z)[inner], atol=1e-5)
    # Nodes 0 and 1 are not kept, and fine nodes up to 2.5 have no other neighbours.
    assert (density[:3] == 0).all() and (density[3:] != 0).any(axis=(1, 2)).all()
    with pytest.raises(MivolError, match="other axes"):
        resample_field(field, (12, 12, 12), np.array([[0, -1.0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), keep)


def test_levels_are_resampled_apart(variant_rgb: str) -> None:
    """Each level keeps its own values on finer nodes, reads no other level, and has no rows inside the level before."""
    n, levels = 8, 3
    g = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    sh = np.zeros((n, n, n, 1, 3))
    grids = []
    for level in range(levels):
        place = CUBE * 2.0**level
        place[3, 3] = 1
        grids.append(SphericalGrid.from_dense((level + 1) * (1 + x + 2 * y + 4 * z), sh + level, place))
    fine = resample_field(SphericalGrid.from_levels(grids), (16, 16, 16), CUBE, np.ones((levels, n, n, n), bool))
    g = (np.arange(16) + 0.5) / 16
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    # Between the outer nodes values are linear; nodes of 16 from 5 to 10 are covered (16 / 4 - 1 = 3 steps from 7.5).
    inner, covered = np.s_[1:-1, 1:-1, 1:-1], np.s_[5:11, 5:11, 5:11]
    for level in range(levels):
        density, found = fine.extract_level(level).to_dense()
        stored = np.zeros((16, 16, 16), bool)
        stored.reshape(-1)[fine.extract_level(level).stored_nodes()] = True
        expected = (level + 1) * (1 + x + 2 * y + 4 * z)
        assert stored[covered].any() == (level == 0) and stored.sum() == 16**3 - (6**3 if level else 0)
        np.testing.assert_allclose(density[inner][stored[inner]], expected[inner][stored[inner]], rtol=1e-5)
        assert (found[stored] == level).all()
