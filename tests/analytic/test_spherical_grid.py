"""Grids of spherical harmonics: sizes of rows, the index of stored nodes, and the same field on other nodes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import CUBE
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.fields.bricks import SparseIndex
from mivol.fields.harmonics import basis_size, harmonic_degree, row_width
from mivol.fields.resampling import resample_field
from mivol.fields.spherical_grid import SphericalGrid


@pytest.mark.parametrize(("degree", "basis", "width"), [(0, 1, 4), (1, 4, 12), (2, 9, 28), (3, 16, 48), (4, 25, 76)])
def test_rows_of_harmonics(degree: int, basis: int, width: int) -> None:
    """(d + 1)^2 harmonics of three numbers, padded to a multiple of 4."""
    assert (basis_size(degree), harmonic_degree(basis), row_width(basis)) == (basis, degree, width)


@pytest.mark.parametrize("basis", [-4, 0, 2, 24, 26, 36])
def test_no_degree(basis: int) -> None:
    assert_refused("1, 4, 9, 16 or 25", harmonic_degree, basis)


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


COUNTS = [1, 7, 8, 9, 32, 33, 1000]
"""Ends of words of 8 and of 32 nodes, and one node more and less."""


def draw_stored(node_count: int, share: float) -> np.ndarray:
    return np.random.default_rng(node_count).random(node_count) < share


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("node_count", COUNTS)
def test_ranks_are_counts_of_stored_nodes_before(node_count: int, share: float) -> None:
    stored = draw_stored(node_count, share)
    index = SparseIndex.from_sorted(mi.UInt32(np.flatnonzero(stored).astype(np.uint32)), node_count)
    rank, is_stored = index.rank(dr.arange(mi.UInt32, node_count))
    assert np.array_equal(np.array(is_stored), stored)
    assert np.array_equal(np.array(rank), np.cumsum(stored) - stored)
    assert index.bytes == 8 * -(-node_count // 32)
