"""A grid placed in the world, and the part of a ray inside its box.

Conventions. A cell (i, j, k), each index from -1 to N - 1, lies between the nodes i and i + 1. Node indices are clamped to the
grid, so the outer half voxel is constant and a single voxel needs no special case. A ray is o + t d with t in world length for
a unit d. The mapped direction is not normalised, so t remains a world length under any scale, shear or mirroring. Entry and
exit of the box are found in float64: in float32 the entry point of a ray starting 1e4 scene sizes away is off by 3e-3 of a
cell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.bricks import Bricks
from mivol.space import check_affine, lattice_from_world
from mivol.transport.traversal.box import clip_to_box, map_point, opaque_rows
from mivol.transport.traversal.rays import Ray

__all__ = ["Lattice", "Mask3", "Segment", "clip_to_grid", "locate_cell", "points_of_piece", "segment_between", "split_float64"]


Mask3 = Any
"""Three masks a lane, ``dr.mask_t(mi.Vector3f)``: Mitsuba has no public name for the type."""


@dataclass
class Lattice:
    """A grid placed in the world.

    Attributes:
        values: TensorXf (Z, Y, X, C), at voxel centres; (bricks, 8, 8, 8, C) of a sparse grid.
        to_world: (4, 4) float64, unit cube to world.
        empty_distances: packed distance of each block of cells to the nearest non-empty block
            (:mod:`mivol.transport.traversal.grid_blocks`); None to walk all blocks.
        trims: whether a walk with ``empty_distances`` skips only the empty blocks before the first and behind the last occupied
            block of a ray.
        block_ranges: :class:`mivol.transport.traversal.grid_blocks.BlockRanges` for tracking; None to walk every cell.
        from_world: (3, 4) map from the world to lattice coordinates; made from ``to_world`` by default.
        bricks: where the values of a sparse grid are stored; None for a dense grid.
    """

    values: mi.TensorXf
    to_world: np.ndarray
    empty_distances: mi.UInt32 | None = None
    block_ranges: Any = None
    from_world: list[list[mi.Float64]] | None = None
    bricks: Bricks | None = None
    trims: bool = False

    def __post_init__(self) -> None:
        if self.from_world is not None:
            return
        shape = tuple(self.values.shape) if self.bricks is None else (*self.bricks.res, self.channels)
        if len(shape) != 4 or 0 in shape:
            raise MivolError(f"a grid of shape {shape} was given; (Z, Y, X, channels) is expected: reshape it.")
        if np.prod([n + 1 for n in shape[:3]]) * self.channels >= 2**31:
            raise MivolError(f"a grid of shape {shape} was given; at most 2^31 cells and channels are expected: split it.")
        given = np.asarray(self.to_world, np.float64)
        self.to_world, from_world = _check_place(given.tobytes(), given.shape, self.res)
        self.from_world = opaque_rows(from_world)

    @property
    def res(self) -> tuple[int, int, int]:
        """Resolution (Z, Y, X)."""
        return tuple(self.values.shape[:3]) if self.bricks is None else self.bricks.res

    @property
    def channels(self) -> int:
        """Number of values at each voxel."""
        return self.values.shape[-1]

    def where_derivatives(self) -> Lattice:
        """The lattice whose walk passes every cell with a derivative: all cells, or those with a stored node."""
        return replace(self, empty_distances=None if self.bricks is None else self.bricks.distances)

    def to_world_points(self, u: mi.Vector3f) -> mi.Point3f:
        """Map points of the unit cube to the world, in float32."""
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in self.to_world[:3]]
        return mi.Point3f(*(dr.fma(r[0], u.x, dr.fma(r[1], u.y, dr.fma(r[2], u.z, r[3]))) for r in rows))


@lru_cache(maxsize=256)
def _check_place(to_world: bytes, shape: tuple[int, ...], res: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The (4, 4) place of a grid and the (3, 4) map to its lattice, checked once: each step of a fit views the grid anew."""
    place = check_affine(np.frombuffer(to_world).reshape(shape))
    return place, lattice_from_world(place, res)


@dataclass
class Segment:
    """The part of a ray inside the box of a lattice.

    Attributes:
        cell, frac: cell of the entry point, and the fraction from the lower node of the cell.
        d: lattice distance per world length.
        d_rest: rounding error of ``d``; d + d_rest has double precision.
        t0: distance of the entry from the origin of the ray [length].
        t0_rest: rounding error of ``t0``.
        length: length inside the box [length].
    """

    cell: mi.Vector3i
    frac: mi.Vector3f
    d: mi.Vector3f
    d_rest: mi.Vector3f
    t0: mi.Float
    length: mi.Float
    t0_rest: mi.Float | float = 0.0

    @property
    def start(self) -> mi.Float64:
        """Distance from the origin of the ray to the entry [length]."""
        return mi.Float64(self.t0) + mi.Float64(self.t0_rest)

    @property
    def end(self) -> mi.Float64:
        """Distance from the origin of the ray to the exit [length]."""
        return self.start + mi.Float64(self.length)


def clip_to_grid(lattice: Lattice, o: mi.Point3f, d: mi.Vector3f, t_min: mi.Float, t_max: mi.Float) -> Segment:
    """Clip a ray to the box of a grid, in float64.

    Args:
        lattice: the grid and its place.
        o, d: world ray; t is world length for a unit d.
        t_min, t_max: interval of the ray [length]; ``t_max`` may be infinite.

    Returns:
        The part inside the box; ``length`` is 0 if the ray misses the box.
    """
    n = lattice.res[::-1]
    high = tuple(k - 0.5 for k in n)
    q, v, t0, t1 = clip_to_box(lattice.from_world, (-0.5,) * 3, high, o, d, mi.Float64(t_min), mi.Float64(t_max))
    return segment_between(q, v, n, t0, t1)


def segment_between(
    q: list[mi.Float64], v: list[mi.Float64], n: tuple[int, int, int], t0: mi.Float64, t1: mi.Float64
) -> Segment:
    """The part from t0 to t1 of the line q + t v in a lattice of n nodes (X, Y, Z); ``length`` is 0 if t1 <= t0."""
    hit = t1 > t0
    t0 = dr.select(hit, t0, 0)
    cell, frac = mi.Vector3i(), mi.Vector3f()
    for a in range(3):
        entry = dr.clip(dr.fma(t0, v[a], q[a]), -0.5, n[a] - 0.5)
        low = dr.floor(entry)
        cell[a], frac[a] = mi.Int32(low), mi.Float(entry - low)
    direction = mi.Vector3f(mi.Float(v[0]), mi.Float(v[1]), mi.Float(v[2]))
    rest = mi.Vector3f(*(mi.Float(v[a] - mi.Float64(direction[a])) for a in range(3)))
    start, start_rest = split_float64(t0)
    return Segment(cell, frac, direction, rest, start, mi.Float(dr.select(hit, t1 - t0, 0)), start_rest)


def split_float64(x: mi.Float64 | mi.Float) -> tuple[mi.Float, mi.Float]:
    """Split a number into the nearest float32 and the remainder."""
    near = mi.Float(x)
    return near, mi.Float(mi.Float64(x) - mi.Float64(near))


def locate_cell(lattice: Lattice, o: mi.Point3f, d: mi.Vector3f, t: mi.Float) -> tuple[mi.Vector3i, mi.Vector3f, mi.Bool]:
    """Find the cell of a point of a ray, in float64.

    Returns:
        The lower node of the cell (-1 to N - 1), the fractions from the lower node, and whether the point is in the box.
    """
    n, t = lattice.res[::-1], mi.Float64(t)
    cell, frac, inside = mi.Vector3i(), mi.Vector3f(), mi.Bool(True)
    p = [dr.fma(t, mi.Float64(d[a]), mi.Float64(o[a])) for a in range(3)]
    for a, row in enumerate(lattice.from_world):
        q = map_point(row, p)
        # A distance that was drawn inside the box may, once rounded to float32, lie outside it by 1e-7 of itself.
        inside &= dr.abs(q - 0.5 * (n[a] - 1)) < 0.5 * n[a] + 1e-3
        q = dr.clip(q, -0.5, n[a] - 0.5)
        low = dr.minimum(dr.floor(q), n[a] - 1)
        cell[a], frac[a] = mi.Int32(low), mi.Float(q - low)
    return cell, frac, inside


def points_of_piece(
    lattice: Lattice, ray: Ray, start: mi.Float64, dt: mi.Float, active: mi.Bool
) -> tuple[mi.Vector3i, list[mi.Vector3f], mi.Bool]:
    """Four points of a piece of a ray in a cell, at 0, 1/3, 2/3 and 1 of its length.

    Args:
        lattice: the grid.
        ray: world space, unit direction.
        start, dt: distance of the beginning of the piece on the ray, and length of the piece [length].
        active: lanes with a piece.

    Returns:
        The lower node of the cell, the points as fractions from the lower node, and the lanes whose piece lies in the box.
    """
    segment = clip_to_grid(lattice, ray.o, ray.d, start, start + mi.Float64(dt))
    # The cell is that of the middle of the piece: its ends lie in faces of the cell, and rounding may put them on either side.
    along = segment.d * segment.length
    shift = mi.Vector3i(dr.floor(segment.frac + 0.5 * along))
    cell, frac = segment.cell + shift, segment.frac - mi.Vector3f(shift)
    points = [dr.clip(dr.fma(along, k / 3, frac), 0, 1) for k in range(4)]
    return cell, points, active & (segment.length > 0)
