"""Resampling of a radiance field: on finer nodes, or in another box along the same axes.

Conventions. Raw densities and harmonics are linear between the old nodes and constant in the outer half voxel. Densities keep
their sign, so a surface at a zero crossing keeps its position.
"""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner


def resample_field(old: SphericalGrid, res: tuple[int, int, int], to_world: np.ndarray, keep: np.ndarray) -> SphericalGrid:
    """A sparse field with the same values on other nodes.

    Args:
        old: field to resample.
        res, to_world: nodes and box of the new grid, along the axes of the old grid.
        keep: (Z, Y, X) of the old grid, or (levels, Z, Y, X), bool. A new node is stored if one of the 8 old nodes around it is
            kept and, in a nested field, if the level before does not cover it.

    Raises:
        MivolError: other axes.
    """
    axes = _AxisWeights.between(old, res, to_world)
    kept = np.flatnonzero([_select_nodes(level, axes) for level in keep.reshape(old.levels, *old.res)])
    kept = kept[~np.array(is_covered_by_inner(mi.UInt32(kept.astype(np.uint32)), res))] if old.levels > 1 else kept
    density, harmonics = _interpolate(old, axes, np.unravel_index(kept, (old.levels, *res)))
    count = len(kept)
    flat = dr.full(mi.Float, old.activation_function.vacuum, count + 1)
    packed = dr.zeros(mi.Float, (count + 1) * old.width)
    if count:
        dr.scatter(flat, density, dr.arange(mi.UInt32, count))
        dr.scatter(packed, mi.ArrayXf(harmonics), dr.arange(mi.UInt32, count))
    dr.eval(flat, packed)
    nodes = mi.UInt32(kept.astype(np.uint32))
    return replace(old, res=tuple(res), to_world=to_world, density=flat, harmonics=packed, nodes=nodes, index=None)


def _select_nodes(keep: np.ndarray, axes: list[_AxisWeights]) -> np.ndarray:
    """New nodes (Z, Y, X) with a kept node among the 8 old nodes around them; axis by axis, to save memory."""
    for a, axis in enumerate(axes):
        low, high = axis.nodes
        keep = keep.take(low, a) | keep.take(high, a)
    return keep


class _AxisWeights:
    """Along one axis: the two old nodes around each new node, and their weights, both (2, n)."""

    def __init__(self, q: np.ndarray, n: int) -> None:
        whole = np.rint(q)
        q = np.where(np.abs(q - whole) < 1e-9 * n, whole, q)
        low = np.floor(q)
        # A new node on an old node has this node twice: its neighbour does not count as near.
        self.nodes = np.clip(np.stack([low, np.ceil(q)]).astype(int), 0, n - 1)
        self.weights = np.stack([1 - (q - low), q - low]).astype(np.float32)

    @classmethod
    def between(cls, old: SphericalGrid, res: tuple[int, int, int], to_world: np.ndarray) -> list[_AxisWeights]:
        """The weights along z, y and x."""
        move = np.linalg.inv(old.to_world) @ to_world
        if np.abs(move[:3, :3] - np.diag(np.diag(move)[:3])).max() > 1e-6 * np.abs(move[:3, :3]).max():
            raise MivolError("a grid with other axes was given; a field is resampled along its own: keep its rotation.")
        axes = []
        for a, (n, m) in enumerate(zip(old.res[::-1], res[::-1], strict=True)):
            axes.append(cls((((np.arange(m) + 0.5) / m) * move[a, a] + move[a, 3]) * n - 0.5, n))
        return axes[::-1]


def _interpolate(old: SphericalGrid, axes: list[_AxisWeights], place: tuple) -> tuple[mi.Float, list[mi.Float]]:
    """Values at new nodes, given by levels and indices along z, y, x."""
    density, harmonics = mi.Float(0), [mi.Float(0)] * old.width
    if len(place[0]) == 0:
        return density, harmonics
    for corner in range(8):
        ends = [
            (axis.nodes[corner >> k & 1][i], axis.weights[corner >> k & 1][i])
            for k, (axis, i) in enumerate(zip(axes, place[1:], strict=True))
        ]
        node = np.ravel_multi_index([place[0], *(n for n, _ in ends)], (old.levels, *old.res))
        weight = mi.Float(math.prod(s for _, s in ends))
        row = old.look_up_rows(mi.UInt32(node.astype(np.uint32)))
        density = dr.fma(weight, dr.gather(mi.Float, old.density, row), density)
        values = dr.gather(mi.ArrayXf, old.harmonics, row, shape=(old.width, 1))
        harmonics = [dr.fma(weight, v, h) for v, h in zip(values, harmonics, strict=True)]
    return density, harmonics
