"""The matrix of line integrals through one layer of voxels, as sparse rows: where the rays lie in layers, all layers share it.

Conventions. A line is followed along its major axis, the one along which it crosses more voxels: x there is a coordinate in
voxels (0 at the first centre), and the other coordinate is ``offset + slope x`` with \\|slope\\| <= 1. A row of voxels (one x)
then meets at most four of its voxels. Entries are the very integrals of the trilinear model that
:class:`mivol.tomography.projector.Projector` walks: hat functions at voxel centres, held constant beyond the outermost centres,
nothing outside the box. Positions are float64, fractions of a voxel and entries float32.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse

from mivol.tomography.geometry import Geometry, VoxelGrid

__all__ = ["Lines", "build_rows", "count_bytes", "find_lines"]

PLACES = 4
"""Most voxels of a row that a line meets: hats are 2 wide, and a line crosses at most 2 voxels while it crosses a row's hat."""

NEGLIGIBLE = 1e-9
"""Integrals [voxels] below this are rounding, of kinks that fall on a centre: left out, which is 1e-7 of a voxel in 100."""

BLOCK = 1 << 21
"""Pairs of a line and a row that are computed at once: 64 MiB of places and entries."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines in a plane of ``shape`` voxels (Y, X), each with its part inside.

    Attributes:
        heights: (rows,) z of the layers that lines lie in, the same lines in each [length].
        slope, offset: (views, cols), as above [voxels].
        length: (views, cols), length of the line over a step of 1 along x [length].
        low, high: (views, cols), its part in the box and, of half lines, beyond the source; high <= low where there is none.
        along_x: (views, cols), whether the major axis is the grid's x.
        shape: (Y, X).
    """

    heights: np.ndarray
    slope: np.ndarray
    offset: np.ndarray
    length: np.ndarray
    low: np.ndarray
    high: np.ndarray
    along_x: np.ndarray
    shape: tuple[int, int]


def find_lines(geometry: Geometry, grid: VoxelGrid, views: np.ndarray) -> Lines | None:
    """The lines of a scan whose detector rows see layers of constant z, all the same way; None of any other.

    These are parallel beams, and fan beams: cones of one row in the plane of the source.
    """
    heights, starts, directions = None, [], []
    for view in views:
        o, d = (rays[0] for rays in geometry.rays([view]))
        same = (d == d[:1]).all() and (o[..., :2] == o[:1, :, :2]).all() and (o[..., 2] == o[:, :1, 2]).all()
        if (d[..., 2] != 0).any() or not same or (heights is not None and (o[:, 0, 2] != heights).any()):
            return None
        heights = o[:, 0, 2]
        starts.append(o[0, :, :2])
        directions.append(d[0, :, :2])
    size, n = np.array(grid.voxel_size[:2]), np.array(grid.shape[:0:-1])
    q = (np.array(starts) - np.array(grid.centre[:2])) / size + (n - 1) / 2
    return _lines(heights, q, np.array(directions) / size, grid.shape[1:], geometry.whole_lines)


def _lines(heights: np.ndarray, q: np.ndarray, e: np.ndarray, shape: tuple[int, int], whole: bool) -> Lines:
    """Of points ``q`` and directions ``e`` (views, cols, 2) in voxels, of which a step of 1 is a unit of length."""
    along_x = np.abs(e[..., 0]) >= np.abs(e[..., 1])
    swap = np.where(along_x, 0, 1)[..., None]
    (q0, q1), (e0, e1) = ([np.take_along_axis(a, s, -1)[..., 0] for s in (swap, 1 - swap)] for a in (q, e))
    n0, n1 = np.where(along_x, shape[1], shape[0]), np.where(along_x, shape[0], shape[1])
    slope = e1 / e0
    offset = q1 - slope * q0
    low, high = np.full(slope.shape, -0.5), n0 - 0.5
    if not whole:
        low, high = np.where(e0 > 0, np.maximum(low, q0), low), np.where(e0 < 0, np.minimum(high, q0), high)
    level = slope == 0
    safe = np.where(level, 1.0, slope)
    ends = np.sort([(-0.5 - offset) / safe, (n1 - 0.5 - offset) / safe], axis=0)
    low, high = (np.where(level, old, new) for old, new in ((low, np.maximum(low, ends[0])), (high, np.minimum(high, ends[1]))))
    # In the plane of a face a line counts as outside, as in the walk.
    missed = (high <= low) | (level & ((offset <= -0.5) | (offset >= n1 - 0.5)))
    low, high = (np.where(missed, 0.0, end) for end in (low, high))
    return Lines(heights, slope, offset, 1 / np.abs(e0), low, high, along_x, shape)


def count_bytes(lines: Lines) -> int:
    """Bytes of the rows of all lines, counted beforehand: 8 an entry, ``2 + 2 |slope|`` of them in the mean over offsets in
    each row of voxels that a line's part reaches."""
    last = np.where(lines.along_x, lines.shape[1], lines.shape[0]) - 1
    reached = np.minimum(np.ceil(lines.high), last) - np.maximum(np.floor(lines.low), 0) + 1
    entries = np.sum(np.where(lines.high > lines.low, reached * (2 + 2 * np.abs(lines.slope)), 0.0))
    return int(8 * entries) + 4 * lines.slope.size


def build_rows(lines: Lines) -> Iterator[scipy.sparse.csr_array]:
    """The matrix (lines, voxels of a layer) in blocks of whole views: CSR, float32 entries and int32 places."""
    n_views, columns = lines.slope.shape
    steps = max(lines.shape)
    views_at_once = max(1, BLOCK // (columns * steps))
    for first in range(0, n_views, views_at_once):
        part = slice(first, first + views_at_once)
        yield _block(lines, part, steps)


def _block(lines: Lines, part: slice, steps: int) -> scipy.sparse.csr_array:
    names = ("slope", "offset", "length", "low", "high")
    line = {name: mi.Float64(np.ascontiguousarray(getattr(lines, name)[part]).ravel()) for name in names}
    along_x = mi.Bool(np.ascontiguousarray(lines.along_x[part]).ravel())
    count = dr.width(along_x)
    at, entries = _entries(line, along_x, lines.shape, steps)
    at, entries = (a.numpy().reshape(count, -1) for a in (at, entries))
    kept = entries > 0
    ends = np.zeros(count + 1, np.int32)
    np.cumsum(kept.sum(1, dtype=np.int32), out=ends[1:])
    found = np.flatnonzero(kept)
    return scipy.sparse.csr_array((entries.take(found), at.take(found), ends), shape=(count, lines.shape[0] * lines.shape[1]))


def _entries(line: dict[str, mi.Float64], along_x: mi.Bool, shape: tuple[int, int], steps: int) -> tuple[mi.Int32, mi.Float]:
    """Places and integrals, ``PLACES`` for each line and row of voxels; 0 where a line meets fewer."""
    n_y, n_x = (dr.opaque(mi.UInt32, n) for n in shape)
    pair = dr.arange(mi.UInt32, dr.width(along_x) * steps)
    # Exact: pairs are fewer than 2^32, half a step from the next whole number. Processors divide whole numbers one by one.
    which = mi.UInt32((mi.Float64(pair) + 0.5) * dr.opaque(mi.Float64, 1 / steps))
    row = pair - which * dr.opaque(mi.UInt32, steps)
    slope, offset, length, low, high = (dr.gather(mi.Float64, line[name], which) for name in line)
    major_x = dr.gather(mi.Bool, along_x, which)
    n0, n1 = dr.select(major_x, n_x, n_y), dr.select(major_x, n_y, n_x)
    # From here on x and the other coordinate are measured from the row and from a voxel near the line: no digits are lost.
    i = mi.Float64(row)
    middle = dr.fma(slope, i, offset)
    origin = dr.floor(middle)
    slope, fraction = mi.Float(slope), mi.Float(middle - origin)
    low, high = mi.Float(dr.clip(low - i, -2, 2)), mi.Float(dr.clip(high - i, -2, 2))
    nearest, last = -mi.Float(origin), mi.Float(mi.Float64(n1) - 1 - origin)
    first_row, last_row = -mi.Float(row), mi.Float(n0) - 1 - mi.Float(row)

    def across(x: mi.Float) -> mi.Float:
        return dr.fma(slope, x, fraction)

    # The hat of the row reaches one voxel to either side, and half a voxel beyond the outermost centres.
    begin = dr.maximum(low, dr.select(row == 0, -0.5, -1))
    end = dr.minimum(high, dr.select(row + 1 == n0, 0.5, 1))
    first = dr.floor(dr.clip(dr.minimum(across(begin), across(end)), nearest, last))

    def hat(x: mi.Float) -> mi.Float:
        return 1 - dr.abs(dr.clip(x, first_row, last_row))

    def place(x: mi.Float) -> mi.Float:
        return dr.clip(across(x), nearest, last) - first

    total = [mi.Float(0.0) for _ in range(PLACES)]
    inverse = 1 / dr.select(slope == 0, 1, slope)
    for a, b in ((begin, dr.minimum(end, 0)), (dr.maximum(begin, 0), end)):
        b = dr.maximum(a, b)
        # On this side of the row the line crosses one line of centres at most. Between kinks it lies between two voxels of the
        # row, and the product of the hats is a square of x, which Simpson's rule integrates exactly.
        kink = (dr.floor(dr.maximum(across(a), across(b))) - fraction) * inverse
        kink = dr.select(slope == 0, b, dr.clip(kink, a, b))
        for c, d in ((a, kink), (kink, b)):
            middle = 0.5 * (c + d)
            lower = dr.floor(place(middle))
            weights = [hat(x) * w for x, w in ((c, 1), (middle, 4), (d, 1))]
            sixth = (d - c) / 6
            upper_part = sixth * sum(w * (place(x) - lower) for x, w in zip((c, middle, d), weights, strict=True))
            lower_part = sixth * sum(weights) - upper_part
            for j in range(PLACES):
                total[j] += dr.select(lower == j, lower_part, 0) + dr.select(lower == j - 1, upper_part, 0)

    step0, step1 = dr.select(major_x, 1, n_x), dr.select(major_x, n_x, 1)
    base = row * step0 + mi.UInt32(mi.Int32(origin) + mi.Int32(first)) * step1
    active = (row < n0) & (end > begin)
    at, entries = dr.empty(mi.Int32, PLACES * dr.width(pair)), dr.empty(mi.Float, PLACES * dr.width(pair))
    # Four neighbours at once: single numbers would take thrice the time of all that goes before.
    kept = [dr.select(active & (t > NEGLIGIBLE), t * mi.Float(length), 0) for t in total]
    dr.scatter(at, mi.Vector4i([mi.Int32(base + j * step1) for j in range(PLACES)]), pair)
    dr.scatter(entries, mi.Vector4f(kept), pair)
    dr.eval(at, entries)
    return at, entries
