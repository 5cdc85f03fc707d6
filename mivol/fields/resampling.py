"""Resampling of a radiance field: on finer nodes, in another box along the same axes, or from points to a grid.

Conventions. Raw densities and harmonics are linear between the old nodes and constant in the outer half voxel. Densities keep
their sign, so a surface at a zero crossing keeps its position.
"""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import maximum_filter

from mivol.errors import MivolError
from mivol.fields.sampled_field import SampledField
from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner
from mivol.space import bounds_of, lattice_from_world, place_grid


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


# -- From points to a grid -------------------------------------------------------------------------------------------------


OPAQUE = 1.5
"""Largest optical depth of a voxel in a grid of a sampled field. Interpolation from denser nodes would fill the empty voxels
beside a surface (views of the chair at 128 nodes, against its hash grid: 30.4 dB with 1.5, 29.8 dB with 8)."""

EMPTY = 1e-3
"""Optical depth of a voxel below which a node is not stored."""

PARTS = 2
"""Points along each edge of a voxel, whose mean is the density of the node."""

DIRECTIONS = 48
"""Directions of the colours that are projected onto harmonics: a Fibonacci lattice."""

NODES, VOXELS = 1 << 13, 1 << 16
"""Nodes whose colours are sampled at a time, and voxels whose densities are."""


def sample_field(
    field: SampledField | SphericalGrid, res: tuple[int, int, int], to_world: np.ndarray, degree: int = 2
) -> SphericalGrid:
    """A sparse grid of a field that is known at points, as a nested grid is too.

    The density of a node is the mean over its voxel. Its colour is taken at the centre of mass of the voxel, in
    ``DIRECTIONS`` directions, and projected onto the harmonics by least squares.

    Args:
        field: with a region, or a grid of any levels.
        res, to_world: nodes (Z, Y, X) and box of the grid.
        degree: of the harmonics.

    Raises:
        MivolError: no matter in the box.
    """
    nodes, density, places = sample_voxels(field, res, to_world)
    sh = project_colours(field, places, degree)
    stored = mi.UInt32(nodes.astype(np.uint32))
    edge = voxel_edge(res, to_world)
    return SphericalGrid.from_rows(res, to_world, np.minimum(density, OPAQUE / edge), sh, stored, space=field.space)


MOST_VOXELS = 1 << 30
"""Largest number of voxels whose points are sampled."""

GRID_NODES = 128
"""Default number of nodes along the longest edge of such a grid."""


def sample_to_grid(field: SampledField | SphericalGrid, resolution: int) -> SphericalGrid:
    """The grid of a hash grid, a NeRF or a nested grid, with ``resolution`` nodes along the longest edge of its whole box.

    Raises:
        MivolError: no matter in the box, or fewer than 2 nodes.
    """
    if resolution < 2:
        raise MivolError(f"found a grid of {resolution} nodes along its longest edge, expected at least 2: ask for more.")
    place = field.level_to_world(field.levels - 1) if isinstance(field, SphericalGrid) else field.to_world
    return sample_field(field, *place_grid(bounds_of(place), resolution))


def voxel_edge(res: tuple[int, int, int], to_world: np.ndarray) -> float:
    """Cube root of the volume of a voxel [length]."""
    return float(np.abs(np.linalg.det(to_world[:3, :3])) / np.prod(res)) ** (1 / 3)


def sample_voxels(
    field: SampledField | SphericalGrid, res: tuple[int, int, int], to_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The voxels of a grid that hold matter of a field: flat numbers (n,), mean densities (n,), centres of mass (n, 3).

    Raises:
        MivolError: no matter in the box, or more than ``MOST_VOXELS``.
    """
    z, y, x = res
    if x * y * z > MOST_VOXELS:
        raise MivolError(
            f"found {x} x {y} x {z} voxels to sample, expected at most {MOST_VOXELS}: give a smaller --resolution."
        )
    edge = voxel_edge(res, to_world)
    numbers, densities, centres = [], [], []
    every = _nodes_near_matter(field, res, to_world) if isinstance(field, SphericalGrid) else range(x * y * z)
    for start in range(0, len(every), VOXELS):
        node = np.asarray(every[start : start + VOXELS])
        sigma, places = _sample_voxels(field, node, res, to_world)
        mean = sigma.mean(axis=1)
        kept = mean * edge > EMPTY
        weight = sigma[kept] / sigma[kept].sum(axis=1, keepdims=True)
        numbers.append(node[kept])
        densities.append(mean[kept].astype(np.float32))
        centres.append((weight[..., None] * places[kept]).sum(axis=1))
    nodes, density, places = map(np.concatenate, (numbers, densities, centres)) if numbers else ([], [], [])
    if not len(nodes):
        raise MivolError("found no matter in the box of the grid, expected some: give another box.")
    return nodes, density, places


def _nodes_near_matter(field: SphericalGrid, res: tuple[int, int, int], to_world: np.ndarray) -> np.ndarray:
    """Flat numbers of the voxels of a grid near nodes with matter of a nested grid."""
    below, middle = field.activation_function.empty_below, 0.5 * (np.array(field.res[::-1]) - 1)
    has_matter = np.zeros(field.node_count, bool)
    has_matter[field.stored_nodes()] = True if below is None else field.values()[0] > below
    voxel = np.abs(np.linalg.inv(field.to_world)[:3, :3] @ (to_world[:3, :3] / res[::-1])) * np.array(field.res[::-1])[:, None]
    span = 0.5 * (PARTS - 1) / PARTS * voxel.sum(axis=1)  # of the points of a voxel from its middle [nodes]
    near = []
    for number, level in enumerate(has_matter.reshape(field.levels, *field.res)):
        # Matter reaches less than a node beyond its own, and the middle lies up to half a node from the nearest one.
        reach = math.ceil(1.5 + span.max() / 2.0**number) - 1
        near.append(maximum_filter(level, 2 * reach + 1))
    (z, y, x), found = res, []
    # From the unit cube of the grid to nodes of the innermost level, counted from the middle.
    turn = lattice_from_world(field.to_world, field.res) @ to_world
    turn[:, 3] -= middle
    unit_y, unit_x = np.meshgrid((np.arange(y) + 0.5) / y, (np.arange(x) + 0.5) / x, indexing="ij")
    for k in range(z):
        q = np.stack([unit_x, unit_y], axis=-1) @ turn[:, :2].T + (turn[:, 2] * (k + 0.5) / z + turn[:, 3])
        held = np.zeros((y, x), bool)
        for number, level in enumerate(near):
            edge = (middle + 0.5) * 2.0**number
            own = (np.abs(q) <= edge + span).all(axis=-1)
            if number:
                own &= (np.abs(q) > 0.5 * edge - span).any(axis=-1)
            place = np.clip(np.rint(q / 2.0**number + middle), 0, 2 * middle).astype(int)
            held |= own & level[place[..., 2], place[..., 1], place[..., 0]]
        found.append(held)
    return np.flatnonzero(np.stack(found))


def project_colours(field: SampledField | SphericalGrid, places: np.ndarray, degree: int) -> np.ndarray:
    """Harmonics (n, basis, 3) of a field's colours at places (n, 3), by least squares over ``DIRECTIONS`` directions."""
    return np.concatenate([_project_colours(field, places[k : k + NODES], degree) for k in range(0, len(places), NODES)])


def _sample_voxels(
    field: SampledField | SphericalGrid, node: np.ndarray, res: tuple[int, int, int], to_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Densities (N, points) at the points of voxels, and their places (N, points, 3)."""
    z, y, x = res
    index = np.stack([node % x, node // x % y, node // (x * y)], axis=-1)
    offsets = (np.stack(np.meshgrid(*[np.arange(PARTS)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / PARTS
    unit = (index[:, None, :] + offsets) / [x, y, z]
    places = unit @ to_world[:3, :3].T + to_world[:3, 3]
    p = mi.Point3f(np.ascontiguousarray(places.reshape(-1, 3).T, np.float32))
    dr.eval(p)
    if isinstance(field, SphericalGrid):
        sigma, _ = field.eval(p, mi.Vector3f(0, 0, 1))
    else:
        held = dr.compress(field.region.holds(p))
        sigma = dr.zeros(mi.Float, dr.width(p))
        if dr.width(held):
            dr.scatter(sigma, field.density(dr.gather(mi.Point3f, p, held)), held)
    return np.array(sigma, np.float64).reshape(len(node), -1), places


def _project_colours(field: SampledField | SphericalGrid, places: np.ndarray, degree: int) -> np.ndarray:
    """Harmonics (N, basis, 3) of the colours at places (N, 3), without the offset 1/2 of a grid."""
    k = np.arange(DIRECTIONS)
    height, turn = 1 - (2 * k + 1) / DIRECTIONS, np.pi * (3 - np.sqrt(5)) * k
    flat = np.sqrt(1 - height**2)
    towards = np.stack([flat * np.cos(turn), flat * np.sin(turn), height]).astype(np.float32)
    values = [np.array(value, np.float64) for value in dr.sh_eval(mi.Vector3f(towards), degree)]
    basis = np.stack(np.broadcast_arrays(*values), axis=1)  # the first harmonic is one number
    p = mi.Point3f(np.ascontiguousarray(np.repeat(places, DIRECTIONS, axis=0).T, np.float32))
    d = mi.Vector3f(np.tile(towards, len(places)))
    dr.eval(p, d)
    colour = field.eval(p, d)[1] if isinstance(field, SphericalGrid) else field.evaluate(p, d).colour
    colour = np.array(colour, np.float64).T.reshape(len(places), DIRECTIONS, 3)
    return np.einsum("bk,nkc->nbc", np.linalg.pinv(basis), colour - 0.5).astype(np.float32)
