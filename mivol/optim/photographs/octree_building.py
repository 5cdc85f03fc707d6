"""An octree of a grid or a field: leaves where views see matter, means over a leaf, larger leaves where views hardly differ.

The fine leaves are half voxels of the grid, or smaller. In a half voxel the grid has eight corners and no kink but that of the
activation, so two Gauss points along each axis give the mean extinction, and the mean colour weighted by the extinction:
what the leaf emits. Refinement goes level by level. After each level, leaves with a compositing weight below a threshold in
every view are dropped.

Eight siblings become one leaf if views change by less than a tolerance: the largest weight of a sibling times the largest
change of a colour, plus the largest change of an opacity across the siblings' edge.

References: Yu et al. 2021 (threshold by weight, leaves averaged over samples); Plenoxels (Fridovich-Keil, Yu et al. 2022).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.back_end import check_memory
from mivol.errors import MivolError
from mivol.fields.harmonics import local_frame
from mivol.fields.octree import MAX_DEPTH, MAX_LEAVES, Octree, check_depth, interleave, separate
from mivol.fields.resampling import project_colours, sample_voxels
from mivol.fields.sampled_field import SampledField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.space import place_grid
from mivol.transport.line_integrals.leaf_radiance import LeafColours, raise_leaf_weights
from mivol.transport.line_integrals.radiance_field import RayBundle
from mivol.transport.traversal.leaf_index import LeafIndex

__all__ = ["OctreeRecipe", "ViewRays", "build_octree", "build_octree_of_levels", "build_octree_of_points"]

ViewRays = Callable[[], Iterable[RayBundle]]
"""Returns the rays of all views, view by view."""

GAUSS = 0.5 - 0.5 / math.sqrt(3), 0.5 + 0.5 / math.sqrt(3)
"""The two Gauss points of an interval, as fractions."""


NO_MATTER = "the grid holds no matter: an octree of it would have no leaf."


@dataclass(frozen=True)
class OctreeRecipe:
    """Settings of :func:`build_octree`.

    Attributes:
        depth: levels below the root; 0 takes leaves of half a voxel.
        keep_weight: largest weight in any view below which a leaf is dropped.
        tolerance: change of views [1] up to which eight leaves become one; 0 joins only equal leaves.
    """

    depth: int = 0
    keep_weight: float = 0.015
    tolerance: float = 0.15


def build_octree(grid: SphericalGrid, rays: ViewRays, recipe: OctreeRecipe = OctreeRecipe()) -> Octree:
    """Make an octree from a grid.

    Args:
        grid: field with a single level.
        rays: rays of the views that decide which leaves are seen.
        recipe: depth, threshold and tolerance.

    Raises:
        MivolError: nested grids, colours below 0, a sheared grid, a depth without room for the grid, too many leaves, or no
            view that sees matter.
    """
    base = _check_grid(grid, recipe)
    depth = max(recipe.depth or base + 1, base + 1)
    tree, cells = None, _half_voxels(grid)
    if not len(cells):
        raise MivolError(NO_MATTER)
    for level in range(base + 1, depth + 1):
        is_finer = level > base + 1
        _check_leaves(len(cells) * (8 if is_finer else 1), level)
        if is_finer:
            cells = (2 * cells[:, None] + np.array([*itertools.product((0, 1), repeat=3)])).reshape(-1, 3)
        tree = _sample(grid, base, level, cells, with_colours=False)
        cells = separate(tree.codes, level)
        weights = max_weights(tree, rays)
        if is_finer:
            # Leaves smaller than pixels lie between the rays: what a ray meets in a sibling counts for all eight.
            weights = _largest_of_siblings(tree.codes, weights)
        seen = weights >= recipe.keep_weight
        if not seen.any():
            raise MivolError("no view shows matter in the grid: check the box, the cameras and the threshold.")
        cells = cells[seen]
    tree = _sample(grid, base, depth, cells, with_colours=True)
    tree = merge_siblings(tree, max_weights(tree, rays), recipe.tolerance)
    if recipe.depth and recipe.depth < depth:
        tree = _limit_depth(tree, recipe.depth)
    return tree


def build_octree_of_levels(field: SphericalGrid, rays: ViewRays, recipe: OctreeRecipe = OctreeRecipe()) -> Octree:
    """Make an octree from a nested grid: leaves of half a voxel of their level, and larger ones where views hardly differ.

    Args:
        field: nested grid. What a level holds in the box of the level before is left out, with the cells that its faces cut.
        rays: rays of the views that decide which leaves are seen.
        recipe: depth (at most that of half a voxel of the innermost box), threshold and tolerance.

    Raises:
        MivolError: as :func:`build_octree`, or too many levels for the largest depth.
    """
    n, levels = np.array(field.res[::-1]), field.levels
    depth = int(n.max() * 2**levels - 1).bit_length()
    if depth > MAX_DEPTH or recipe.depth > depth:
        found = f"an octree of depth {max(depth, recipe.depth)} of {levels} levels of {n.max()} nodes"
        raise MivolError(f"{found} was asked for; at most {min(depth, MAX_DEPTH)} is expected: give a smaller --resolution.")
    parts = []
    for number in range(levels):
        level = field.extract_level(number)
        _check_grid(level, replace(recipe, depth=0))
        cells = _half_voxels(level)
        if number:  # twice the places: the box of the level before is from n to 3 n along each axis
            cells = cells[~((2 * cells + 2 > n) & (2 * cells < 3 * n)).all(axis=1)]
        if not len(cells):
            continue
        density, sh = _means(level, 0.5, cells, with_colours=True)
        # Cells of the innermost half voxels, counted from the corner of a cube around the middle of all boxes.
        codes = interleave((cells - n) * 2**number + 2 ** (depth - 1), depth)
        parts.append((codes, np.full(len(cells), number, np.uint8), density, sh))
    if not parts:
        raise MivolError(NO_MATTER)
    codes, sizes, density, sh = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(codes)
    order = order[density[order] > 0]
    place = field.to_world.copy()
    place[:3, :3] *= 2.0**depth / (2 * n)
    place[:3, 3] = field.middle - place[:3, :3] @ [0.5, 0.5, 0.5]
    rows = codes[order], sizes[order], density[order], sh[order]
    tree = Octree.from_rows(depth, place, *rows, offset=field.offset, space=field.space)
    weights = max_weights(tree, rays)
    kept = weights >= recipe.keep_weight
    if not kept.any():
        raise MivolError("no view shows matter in the grid: check the box, the cameras and the threshold.")
    tree = merge_siblings(tree.select(kept), weights[kept], recipe.tolerance)
    return _limit_depth(tree, recipe.depth) if recipe.depth and recipe.depth < depth else tree


POINTS_DEPTH = 7
"""Depth of the octree of a field that is known at points, without another depth: 128 leaves along the longest edge."""


def build_octree_of_points(field: SampledField, rays: ViewRays, recipe: OctreeRecipe, degree: int = 2) -> Octree:
    """Make an octree straight from a hash grid or a NeRF.

    A leaf has the mean extinction of the points in it, and the colour at its centre of mass, projected onto harmonics. Colours
    are only evaluated in leaves that a view sees.

    Args:
        field: with a region, in an upright box.
        rays: rays of the views that decide which leaves are seen.
        recipe: depth (0: ``POINTS_DEPTH``), threshold and tolerance.
        degree: of the harmonics.

    Raises:
        MivolError: a depth out of range, no matter, or no view that sees some.
    """
    depth = recipe.depth or POINTS_DEPTH
    check_depth(depth)
    low = field.to_world[:3, 3]
    res, place = place_grid(np.array([low, low + field.edges]), 2**depth)
    nodes, density, middles = sample_voxels(field, res, place)
    _check_leaves(len(nodes), depth)
    cells = np.stack([nodes % res[2], nodes // res[2] % res[1], nodes // (res[2] * res[1])], axis=1)
    codes = interleave(cells, depth)
    order = np.argsort(codes)
    codes, density, middles = codes[order], density[order], middles[order]
    cube = place @ np.diag([*(2.0**depth / np.array(res[::-1], np.float64)), 1.0])

    def make(kept: np.ndarray, sh: np.ndarray) -> Octree:
        sizes = np.zeros(int(kept.sum()), np.uint8)
        return Octree.from_rows(depth, cube, codes[kept], sizes, density[kept], sh, space=field.space)

    everything = np.ones(len(codes), bool)
    weights = max_weights(make(everything, np.zeros((len(codes), 1, 3), np.float32)), rays)
    kept = weights >= recipe.keep_weight
    if not kept.any():
        raise MivolError(f"no view shows matter in the {field.noun}: check the box, the cameras and the threshold.")
    tree = make(kept, project_colours(field, middles[kept], degree))
    return merge_siblings(tree, weights[kept], recipe.tolerance)


LEAF_BYTES = 200
"""Memory of a leaf while an octree is made [bytes]: its cell, code and order, values without colours, and weight."""


LEAF_BYTES_ON_GPU = 4 * (3 + 1 + 4 + 1)
"""The same on a GPU: place, mean extinction, and in all views the packed values and the weight."""


def _check_leaves(count: int, depth: int) -> None:
    """Refuse more leaves than an octree or the memory holds."""
    wanted = f"an octree of {count} leaves at depth {depth}"
    if count > MAX_LEAVES:
        raise MivolError(f"{wanted} was asked for; at most {MAX_LEAVES} are expected: choose a smaller depth.")
    check_memory(LEAF_BYTES * count, wanted, "choose a smaller depth", on_gpu=LEAF_BYTES_ON_GPU * count)


def _check_grid(grid: SphericalGrid, recipe: OctreeRecipe) -> int:
    """The depth at which leaves are voxels."""
    if grid.levels > 1:
        raise MivolError(f"a field of {grid.levels} nested levels was given; build_octree_of_levels makes one octree of all.")
    if not grid.clamp:
        raise MivolError("a field without clamp was given; an octree shows colours below 0 as 0: set clamp to True.")
    base = max(max(grid.res) - 1, 0).bit_length()
    place = _cube(grid, base)
    if np.abs(local_frame(place) - local_frame(grid.to_world)).max() > 1e-6:
        raise MivolError("a sheared grid was given; an octree is made from a box with right angles.")
    if recipe.depth:
        check_depth(recipe.depth)
    if base + 1 > MAX_DEPTH:
        raise MivolError(
            f"a grid of {max(grid.res)} nodes was given; at most {2 ** (MAX_DEPTH - 1)} are expected along an axis."
        )
    return base


def _cube(grid: SphericalGrid, base: int) -> np.ndarray:
    """The placement of an octree whose leaves at depth ``base`` are the voxels of a grid."""
    return grid.to_world @ np.diag([*(2**base / np.array(grid.res[::-1], np.float64)), 1.0])


def _half_voxels(grid: SphericalGrid) -> np.ndarray:
    """Half voxels (n, 3), along x, y, z, in cells of the grid with matter."""
    below = grid.activation_function.empty_below
    density, _ = grid.values()
    active = np.zeros(grid.node_count, bool)
    active[grid.stored_nodes()] = True if below is None else density > below
    padded = np.pad(active.reshape(grid.res), 1, mode="edge")
    cells = np.zeros(tuple(n + 1 for n in grid.res), bool)
    for k, j, i in itertools.product((0, 1), repeat=3):
        cells |= padded[k : k + cells.shape[0], j : j + cells.shape[1], i : i + cells.shape[2]]
    # The cell between the nodes n - 1 and n consists of the half voxels 2 n - 1 and 2 n along the axis.
    places = np.argwhere(cells)[:, None] * 2 + np.array([*itertools.product((-1, 0), repeat=3)])
    places = places.reshape(-1, 3)
    places = places[(places >= 0).all(axis=1) & (places < 2 * np.array(grid.res)).all(axis=1)]
    return places[:, ::-1]


def _corner_weights(
    grid: SphericalGrid, low: list[mi.Int32], start: mi.Vector3f, edge: float, rows: list[mi.UInt32]
) -> tuple[mi.Float, list[mi.Float]]:
    """Mean extinction of leaves, and the weights of the corners of their cell in the mean colour."""
    raw = [dr.gather(mi.Float, grid.density, row) for row in rows]
    total, weights = mi.Float(0), [mi.Float(0) for _ in range(8)]
    for place in itertools.product(GAUSS, repeat=3):
        at = [start[a] + edge * place[a] - mi.Float(low[a]) for a in range(3)]
        corner = [
            (at[0] if q & 1 else 1 - at[0]) * (at[1] if q & 2 else 1 - at[1]) * (at[2] if q & 4 else 1 - at[2])
            for q in range(8)
        ]
        value = sum((w * r for w, r in zip(corner, raw, strict=True)), mi.Float(0))
        sigma, _ = grid.activation_function.value_and_slope(value)
        total += sigma
        weights = [dr.fma(sigma, c, w) for c, w in zip(corner, weights, strict=True)]
    scale = dr.select(total > 0, dr.rcp(dr.select(total > 0, total, 1)), 0)
    return total * (1 / 8), [w * scale for w in weights]


def _sample(grid: SphericalGrid, base: int, depth: int, cells: np.ndarray, with_colours: bool) -> Octree:
    """Leaves at one depth, in the order of their codes; those without extinction are left out."""
    codes = interleave(cells, depth)
    order = np.argsort(codes)
    codes, cells = codes[order], cells[order]
    density, sh = _means(grid, 2.0 ** (base - depth), cells, with_colours)
    filled = density > 0
    if not filled.any():
        raise MivolError(NO_MATTER)
    sizes = np.zeros(int(filled.sum()), np.uint8)
    settings = {"offset": grid.offset, "space": grid.space}
    return Octree.from_rows(depth, _cube(grid, base), codes[filled], sizes, density[filled], sh[filled], **settings)


def _means(grid: SphericalGrid, edge: float, cells: np.ndarray, with_colours: bool) -> tuple[np.ndarray, np.ndarray]:
    """Mean extinctions (n,) and coefficients (n, basis, 3) of leaves; a leaf of ``edge`` voxels lies in a cell of the grid."""
    place = mi.Vector3f(*(mi.Float(np.ascontiguousarray(c, np.float32)) for c in cells.T))
    # Leaf i begins at i edges from the face of the box, which is half a voxel below node 0.
    start = place * edge - 0.5
    low = [mi.Int32(dr.floor(start[a] + 0.5 * edge)) for a in range(3)]
    n = grid.res[::-1]
    ends = [[dr.clip(low[a] + k, 0, n[a] - 1) for k in (0, 1)] for a in range(3)]
    rows = [
        grid.look_up_rows(mi.UInt32((ends[2][q >> 2] * n[1] + ends[1][q >> 1 & 1]) * n[0] + ends[0][q & 1])) for q in range(8)
    ]
    density, weights = _corner_weights(grid, low, start, edge, rows)
    if not with_colours:
        return np.array(density), np.zeros((len(cells), 1, 3), np.float32)
    sums = [mi.Float(0)] * grid.width
    for row, w in zip(rows, weights, strict=True):
        values = dr.gather(mi.ArrayXf, grid.harmonics, row, shape=(grid.width, 1))
        sums = [dr.fma(w, values[k], s) for k, s in enumerate(sums)]
    table = dr.zeros(mi.Float, grid.width * len(cells))
    dr.scatter(table, mi.ArrayXf(sums), dr.arange(mi.UInt32, len(cells)))
    dr.eval(density, table)
    sh = np.array(table).reshape(len(cells), grid.width)[:, : 3 * grid.basis]
    return np.array(density), sh.reshape(len(cells), grid.basis, 3)


def _largest_of_siblings(codes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The largest weight among the siblings of each leaf; all leaves have one size, in the order of their codes."""
    _, first, which = np.unique(codes >> np.uint64(3), return_index=True, return_inverse=True)
    return np.maximum.reduceat(weights, first)[which]


def max_weights(tree: Octree, rays: ViewRays) -> np.ndarray:
    """The largest compositing weight (n,) of each leaf in all views."""
    index, zero = LeafIndex.find(tree), mi.Float(0)
    packed = dr.zeros(mi.Float, 4 * tree.leaves)
    dr.scatter(packed, tree.density, 4 * dr.arange(mi.UInt32, tree.leaves))
    weight = dr.zeros(mi.Float, tree.leaves)
    for bundle in rays():
        raise_leaf_weights(index, LeafColours(packed, mi.UInt32(zero)), bundle, weight)
        dr.eval(weight)
    return np.array(weight)


# -- Larger leaves -----------------------------------------------------------------------------------------------------


def merge_siblings(tree: Octree, weights: np.ndarray, tolerance: float) -> Octree:
    """Join eight leaves into one as long as views change by at most ``tolerance``.

    Args:
        tree: octree.
        weights: (n,) largest weight of each leaf in the views.
        tolerance: see the module.
    """
    codes, sizes, (density, sh) = tree.codes, tree.sizes, tree.values()
    for size in range(tree.depth):
        parent = codes >> np.uint64(3 * (size + 1))
        own = sizes == size
        starts = np.flatnonzero(own & (codes % np.uint64(8 ** (size + 1)) == 0))
        starts = starts[starts + 8 <= len(codes)]
        complete = np.ones(len(starts), bool)
        for k in range(8):
            complete &= own[starts + k] & (parent[starts + k] == parent[starts])
        group = starts[complete][:, None] + np.arange(8)
        mean, mean_sh = _join(density[group], sh[group])
        edge = tree.cell * 2.0**size
        opacity = -np.expm1(-density[group] * edge) + np.expm1(-mean * edge)[:, None]
        colours = np.abs(sh[group] - mean_sh[:, None]).sum(axis=2).max(axis=(1, 2)) * BRIGHTEST_HARMONIC
        change = weights[group].max(axis=1) * colours + np.abs(opacity).max(axis=1)
        joined = change <= tolerance
        if not joined.any():
            break
        group, first = group[joined], group[joined, 0]
        density[first], sh[first] = mean[joined], mean_sh[joined]
        sizes = sizes.copy()
        sizes[first] = size + 1
        weights = weights.copy()
        weights[first] = weights[group].max(axis=1)
        kept = np.ones(len(codes), bool)
        kept[group[:, 1:].reshape(-1)] = False
        codes, sizes, density, sh, weights = (a[kept] for a in (codes, sizes, density, sh, weights))
    return tree.with_leaves(codes, sizes, density, sh)


BRIGHTEST_HARMONIC = 0.6
"""Bound on the colour from a change of a coefficient: harmonics up to degree 2 are at most 0.63."""


def _join(density: np.ndarray, sh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean extinctions (m,) of groups (m, k), and their coefficients weighted by extinction."""
    total = density.sum(axis=1)
    weight = density / np.maximum(total, np.finfo(np.float32).tiny)[:, None]
    return total / density.shape[1], np.einsum("mk,mkbc->mbc", weight, sh)


def _limit_depth(tree: Octree, depth: int) -> Octree:
    """The octree with leaves no smaller than 2^-depth of the cube: vacuum counts in the mean of a leaf."""
    size = tree.depth - depth
    own = tree.sizes < size
    density, sh = tree.values()
    cells = np.where(own, np.int64(8) ** tree.sizes.astype(np.int64), np.int64(8) ** size)
    amount = density * cells
    code = np.where(own, tree.codes >> np.uint64(3 * size) << np.uint64(3 * size), tree.codes)
    codes, which = np.unique(code, return_inverse=True)
    total = np.bincount(which, amount)
    sums = np.zeros((len(codes), *sh.shape[1:]))
    np.add.at(sums, which, sh * amount[:, None, None])
    sizes = np.zeros(len(codes), np.uint8)
    np.maximum.at(sizes, which, np.maximum(tree.sizes, size) - np.uint8(size))
    edges = np.int64(8) ** (sizes.astype(np.int64) + size)
    settings = {name: getattr(tree, name) for name in ("to_world", "colours", "offset", "space")}
    rows = total / edges, sums / np.maximum(total, np.finfo(np.float64).tiny)[:, None, None]
    return Octree.from_rows(depth, codes=codes >> np.uint64(3 * size), sizes=sizes, density=rows[0], sh=rows[1], **settings)
