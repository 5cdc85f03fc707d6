"""Grids of spherical harmonics: sizes of rows, stored nodes, the same field on other nodes, and fields at points."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from sampled_fields import CUBE, Cloud, Slab
from scipy.ndimage import map_coordinates

from mivol.errors import MivolError
from mivol.fields.bricks import SparseIndex
from mivol.fields.harmonics import basis_size, harmonic_degree, row_width
from mivol.fields.resampling import OPAQUE, resample_field, sample_field
from mivol.fields.sampled_field import Region
from mivol.fields.spherical_grid import SphericalGrid


@pytest.mark.parametrize(("degree", "basis", "width"), [(0, 1, 4), (1, 4, 12), (2, 9, 28), (3, 16, 48), (4, 25, 76)])
def test_rows_of_harmonics(degree: int, basis: int, width: int) -> None:
    """(d + 1)^2 harmonics of three numbers, padded to a multiple of 4."""
    assert (basis_size(degree), harmonic_degree(basis), row_width(basis)) == (basis, degree, width)


@pytest.mark.parametrize("basis", [-4, 0, 2, 24, 26, 36])
def test_no_degree(basis: int) -> None:
    assert_refused("1, 4, 9, 16 or 25", harmonic_degree, basis)


def test_between_nodes_a_field_is_trilinear(variant_rgb: str) -> None:
    """Of random numbers: in a linear field, any two nodes of a line give the same value. Constant beyond the outer nodes."""
    rng = np.random.default_rng(4)
    density, sh = rng.uniform(1, 2, (3, 4, 5)), rng.uniform(0, 1, (3, 4, 5, 1, 3))
    field = SphericalGrid.from_dense(density, sh, CUBE)
    p = rng.uniform(-1, 1, size=(3, 60)).astype(np.float32)
    at = (np.linalg.inv(CUBE)[:3, :3] @ p + np.linalg.inv(CUBE)[:3, 3:]) * [[5], [4], [3]] - 0.5
    sigma, colour = field.eval(mi.Point3f(p), mi.Vector3f(0, 0, 1))
    for found, nodes in ((sigma, density), (colour.y, field.offset + sh[..., 0, 1] * np.sqrt(0.25 / np.pi))):
        np.testing.assert_allclose(found, map_coordinates(nodes, at[::-1], order=1, mode="nearest"), rtol=1e-5)


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


# -- Sampled fields ----------------------------------------------------------------------------------------------------

RES = (6, 8, 10)


def region(low: int = 0, high: int = 9) -> Region:
    """Cells of a map of 8 nodes an edge, occupied from ``low`` to ``high`` along x."""
    mask = np.zeros((9, 9, 9), np.uint8)
    mask[:, :, low:high] = 1
    return Region((8, 8, 8), CUBE, mi.UInt8(mask.ravel()), 0.1)


def test_a_constant_slab_fills_its_voxels(variant_rgb: str) -> None:
    """Voxels are 0.2 long in x: the slab from -0.6 to 0.4 fills the nodes 2 to 6, and its colour is the first harmonic."""
    density, sh = sample_field(replace(Slab(1.5, -0.6, 0.4), region=region()), RES, CUBE).to_dense()
    expected = np.zeros(RES)
    expected[:, :, 2:7] = 1.5
    np.testing.assert_allclose(density, expected, atol=1e-6)
    first = np.array([0.2, 0.5, 0.9]) - 0.5
    np.testing.assert_allclose(sh[:, :, 2:7, 0], np.broadcast_to(first * 3.5449077, (6, 8, 5, 3)), atol=1e-6)
    np.testing.assert_allclose(sh[..., 1:, :], 0, atol=1e-6)


def test_colours_that_depend_on_the_direction_are_projected(variant_rgb: str) -> None:
    """Green is 0.5 + 0.3 d_y: the harmonic -0.4886 y. Red is 0.5 + 0.5 x at the centre of mass of a voxel."""
    density, sh = sample_field(replace(Cloud(3.0), region=region()), RES, CUBE, degree=1).to_dense()
    stored = density > 0.05
    np.testing.assert_allclose(sh[..., 1, 1][stored], -0.3 / 0.48860251, rtol=1e-5)
    x = (np.arange(10) + 0.5) / 5 - 1
    red = sh[..., 0, 0] / 3.5449077
    # The centre of mass lies at most half the distance of the outer points, 0.05, from the middle.
    assert np.abs(red - 0.5 * x)[stored].max() < 0.5 * 0.0501


def test_unoccupied_cells_are_left_out_and_opaque_voxels_are_capped(variant_rgb: str) -> None:
    """Cell i of the map lies from x = (i - 1/2) / 4 - 1: cells 4 and further begin at -0.125."""
    density, _ = sample_field(replace(Slab(1e6), region=region(4)), RES, CUBE).to_dense()
    edge = (8 / (6 * 8 * 10)) ** (1 / 3)
    assert not density[:, :, :4].any()
    np.testing.assert_allclose(density[:, :, 5:], OPAQUE / edge, rtol=1e-6)
    assert_refused("no matter in the box", sample_field, replace(Slab(0.0), region=region()), RES, CUBE)
