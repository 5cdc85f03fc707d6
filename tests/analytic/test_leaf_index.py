"""Where a ray finds leaves: free boxes hold no leaf, and vacuum is crossed in few steps."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from octrees import PLACE, random_octree

from mivol.fields.octree import Octree, edges_of
from mivol.kernel_recording import ALIGNMENT
from mivol.transport.traversal.leaf_index import LeafIndex, find_octant
from mivol.transport.traversal.octree_walk import clip_to_octree


@pytest.mark.parametrize("depth", [5, 8, 9])
def test_free_boxes_hold_no_leaf(variant_rgb: str, depth: int) -> None:
    """The box of each looked-up cell, on the side to which a ray runs: vacuum has no leaf in it, a leaf has its edge."""
    tree, rng = random_octree(depth, split=0.35), np.random.default_rng(0)
    index, cells = LeafIndex.find(tree), rng.integers(0, 2**depth, (1000, 3))
    down = rng.random((1000, 3)) < 0.5
    d = mi.Vector3f(np.where(down, -1, 1).T.astype(np.float32))
    row, is_leaf, edge, beyond = index.look_up(mi.Vector3i(cells.T.astype(np.int32)), find_octant(d), mi.Bool(True))
    row, is_leaf, edge, beyond = np.array(row), np.array(is_leaf), np.array(edge), np.array(beyond).T
    first = tree.corners()
    last = first + edges_of(tree.sizes)[:, None]
    for k, cell in enumerate(cells):
        low = cell & -edge[k]
        box = low - np.where(down[k], beyond[k], 0), low + edge[k] + np.where(down[k], 0, beyond[k])
        owners = np.flatnonzero(((first < box[1]) & (last > box[0])).all(axis=1))
        assert owners.tolist() == ([row[k]] if is_leaf[k] else [])
        if is_leaf[k]:
            assert (low == first[row[k]]).all() and edge[k] == edges_of(tree.sizes[row[k] : row[k] + 1])[0]
    assert is_leaf.any() and (beyond.max(axis=0) > 0).all()


def test_vacuum_is_crossed_in_few_steps(variant_rgb: str) -> None:
    # Two leaves of one cell at opposite corners of 2^12 cells: the box of the leaves is the whole cube.
    codes = np.array([0, 8**12 - 1], np.uint64)
    tree = Octree.from_rows(12, PLACE, codes, np.zeros(2, np.uint8), np.ones(2), np.zeros((2, 1, 3)))
    index = LeafIndex.find(tree)
    rng = np.random.default_rng(0)
    o, d = rng.uniform(-0.3, 0.3, (3, 64)), rng.uniform(-0.05, 0.05, (3, 64))
    o[0], d[0] = o[0] - 2, d[0] + 1
    segment = clip_to_octree(index, mi.Point3f(np.float32(o)), mi.Vector3f(np.float32(d / np.linalg.norm(d, axis=0))), np.inf)
    cell, steps = mi.Vector3i(segment.cell), 0
    while True:
        _, is_leaf, edge, beyond = index.look_up(cell, find_octant(segment.d), mi.Bool(True))
        steps += 1
        assert not dr.any(is_leaf)
        # The ray runs along x: the cells to cross along it are the most that a step can take.
        cell.x = (cell.x & -edge) + edge + beyond.x
        cell = dr.clip(cell, 0, 2**12 - 1)
        if dr.all(cell.x == 2**12 - 1):
            break
    # 64 entries along an axis, at most 12 of them a step.
    assert steps <= 7


def test_an_octant_beside_a_leaf_is_crossed_together_with_the_next_one(variant_rgb: str) -> None:
    """Octant (1, 1, 1) lies in the brick of the only leaf: free upwards, and the leaf's octant is next downwards."""
    tree = Octree.from_rows(3, PLACE, np.zeros(1, np.uint64), np.zeros(1, np.uint8), np.ones(1), np.zeros((1, 1, 3)))
    index, cell = LeafIndex.find(tree), mi.Vector3i(2, 2, 2)
    for signs, expected in (((1, 1, 1), 2), ((1, 1, -1), 2), ((-1, -1, -1), 0)):
        _, is_leaf, edge, beyond = index.look_up(cell, find_octant(mi.Vector3f(*signs)), mi.Bool(True))
        assert not is_leaf[0] and edge[0] == 2 and np.array(beyond).ravel().tolist() == [expected] * 3


def test_records_are_read_as_packets(variant_rgb: str) -> None:
    """Dr.Jit splits the read of a record at an unaligned address into four, and views take a tenth longer."""
    tree = random_octree(8, split=0.35)
    index = LeafIndex.find(tree)
    if dr.backend_v(index.halves) == dr.JitBackend.LLVM:
        assert index.halves.numpy().ctypes.data % ALIGNMENT == 0
