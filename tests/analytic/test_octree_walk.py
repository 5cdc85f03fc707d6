"""The walk through the leaves of an octree: every leaf once, forwards and backwards."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from octrees import PLACE, hard_rays, random_octree

from mivol.fields.octree import Octree, edges_of
from mivol.transport.traversal.leaf_index import LeafIndex
from mivol.transport.traversal.octree_walk import clip_to_octree, reverse_from, walk_leaves


def sums(tree: Octree, o: np.ndarray, d: np.ndarray, there_and_back: bool) -> list[np.ndarray]:
    """Length in leaves, number of leaves and sum of row numbers of each ray; walked back from the last leaf if asked for."""
    index = LeafIndex.find(tree)
    points, directions = (np.ascontiguousarray(a.T) for a in (o, d))
    segment = clip_to_octree(index, mi.Point3f(points), mi.Vector3f(directions), np.inf)

    def visit(state: list, leaf, on: mi.Bool) -> list:
        # Corners and edges may give a leaf a length of rounding size: it does not count as visited.
        on &= leaf.dt > 1e-5
        added = [leaf.dt, mi.UInt32(1), leaf.row % 1024]
        return [s + dr.select(on, a, 0) for s, a in zip(state, added, strict=True)]

    def start() -> list:
        return [dr.zeros(kind, len(o)) for kind in (mi.Float, mi.UInt32, mi.UInt32)]

    state, cell, last = walk_leaves(index, segment, visit, start())
    if there_and_back:
        back = reverse_from(segment, cell, last, mi.Float(0), index)
        state, _, _ = walk_leaves(index, back, visit, start(), last > 0)
    return [np.array(s) for s in state]


@pytest.mark.parametrize("depth, split", [(0, 0.5), (2, 0.5), (7, 0.35), (8, 0.3), (10, 0.25), (12, 0.2)])
def test_leaves_are_visited_once_in_both_directions(variant_rgb: str, depth: int, split: float) -> None:
    tree, (o, d) = random_octree(depth, split=split), hard_rays()
    inverse = np.linalg.inv(PLACE)
    low = tree.corners() / 2**depth
    high = low + edges_of(tree.sizes)[:, None] / 2**depth
    expected = []
    for origin, direction in zip(np.float64(o), np.float64(d), strict=True):
        q, v = inverse[:3] @ np.append(origin, 1), inverse[:3, :3] @ direction
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = (low - q) / v, (high - q) / v
        inside = (q >= low) & (q < high)
        start = np.where(v == 0, np.where(inside, 0, np.inf), np.minimum(*sides)).max(axis=1)
        end = np.where(v == 0, np.where(inside, np.inf, -np.inf), np.maximum(*sides)).min(axis=1)
        length = np.maximum(end - np.maximum(start, 0), 0)
        expected.append((length.sum(), (length > 1e-5).sum(), (np.flatnonzero(length > 1e-5) % 1024).sum()))
    for there_and_back in (False, True):
        found = sums(tree, o, d, there_and_back)
        np.testing.assert_allclose(found[0], [e[0] for e in expected], atol=2e-5)
        assert found[1].tolist() == [e[1] for e in expected] and found[2].tolist() == [e[2] for e in expected]
