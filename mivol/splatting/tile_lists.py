"""The splats in each tile of an image, nearest first.

A tile lists a splat if its alpha is at least ``least_alpha`` somewhere in the rectangle spanned by the centres of the pixels
of the tile. The decision is exact: an ellipse cuts an interval out of each row of tiles, and both ends of the interval are
closed forms. Lists are sorted by (tile, depth, index of the Gaussian). Entries are made in the order of depth, and the
transposition of a sparse matrix, a stable counting sort, brings them to their tiles.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse

from mivol.errors import MivolError

TILE = 8
"""Pixels along the edge of a tile. 4 and 16 are slower."""

MOST_ENTRIES = 1 << 28
"""Largest number of entries, all lists together: T of 64 pixels once in 4 entries is 16 numbers an entry, and addresses are 32
bits.
"""

SLACK = 1e-3
"""Widening of an ellipse before it is listed [pixel]: far more than the rounding of its centre and its radii."""


@dataclass
class Grid:
    """The tiles of an image, opaque to kernels.

    Attributes:
        columns, rows: number of tiles.
        least: least alpha of a drawn splat.
    """

    columns: mi.Int32
    rows: mi.Int32
    least: mi.Float


@dataclass(frozen=True, eq=False)
class TileLists:
    """Entries of the tiles, tile after tile.

    Attributes:
        entries: (E,) uint32 index of a splat.
        starts: (tiles + 1,) beginning of the list of each tile in ``entries``.
    """

    entries: np.ndarray
    starts: np.ndarray


@dataclass
class _Ellipse:
    """alpha >= least: centre, and the numbers for its intervals."""

    x: mi.Float
    y: mi.Float
    reach_x: mi.Float
    reach_y: mi.Float
    top_at: mi.Float
    slope: mi.Float
    inner: mi.Float
    drawn: mi.Bool

    @classmethod
    def of(cls, shape: mi.Float, grid: Grid, index: mi.UInt32, drawn: mi.Bool) -> _Ellipse:
        x, y, xx, xy, yy, opacity, _, _ = dr.gather(mi.ArrayXf, shape, index, drawn, shape=(8, dr.width(index)))
        # xx dx^2 + xy dx dy + yy dy^2 = level on its border; all three are negative definite.
        level = dr.log2(grid.least * dr.rcp(dr.maximum(opacity, 1e-30)))
        drawn &= level <= 0
        level = dr.minimum(level, 0)
        det = dr.rcp(dr.maximum(xx * yy - 0.25 * xy * xy, 1e-37))
        reach_x, reach_y = dr.sqrt(level * yy * det), dr.sqrt(level * xx * det)
        slope = -0.5 * xy * dr.rcp(xx)
        # Where it reaches furthest to the right, dy = -xy / (2 yy) dx.
        top_at = -0.5 * xy * dr.rcp(yy) * reach_x
        return cls(x, y, reach_x, reach_y, top_at, slope, level * dr.rcp(xx), drawn)

    def rows(self, grid: Grid) -> tuple[mi.Int32, mi.Int32]:
        """First row of tiles, and the row behind the last."""
        return _tiles(self.y - self.reach_y, self.y + self.reach_y, grid.rows, self.drawn)

    def columns(self, row: mi.Int32, grid: Grid) -> tuple[mi.Int32, mi.Int32]:
        """First column of tiles in a row of tiles, and the column behind the last."""
        low = mi.Float(row * TILE) + 0.5 - self.y
        high = low + (TILE - 1)
        low, high = dr.maximum(low, -self.reach_y), dr.minimum(high, self.reach_y)
        right = self._end(dr.clip(self.top_at, low, high), 1)
        left = self._end(dr.clip(-self.top_at, low, high), -1)
        return _tiles(self.x + left, self.x + right, grid.columns, self.drawn)

    def _end(self, dy: mi.Float, side: int) -> mi.Float:
        """Offset at which the horizontal line at ``dy`` leaves the ellipse."""
        within = dr.sqrt(dr.maximum(1 - dr.square(dy * dr.rcp(dr.maximum(self.reach_y, 1e-30))), 0))
        return self.slope * dy + side * within * dr.sqrt(self.inner)


def _tiles(low: mi.Float, high: mi.Float, count: mi.Int32, drawn: mi.Bool) -> tuple[mi.Int32, mi.Int32]:
    """Tiles with the centre of a pixel in [low, high]: the first tile, and the tile behind the last."""
    end = mi.Float(count)
    first = dr.clip(dr.ceil((low - SLACK - (TILE - 0.5)) / TILE), 0, end)
    behind = dr.clip(dr.floor((high + SLACK - 0.5) / TILE) + 1, first, end)
    return mi.Int32(first), mi.Int32(dr.select(drawn, behind, first))


def count_tiles(shape: mi.Float, drawn: mi.Bool, grid: Grid) -> mi.UInt32:
    """Count the tiles of each splat.

    Args:
        shape: eight numbers a splat, as :meth:`mivol.splatting.projection.Splats.shape`.
        drawn: whether a splat is drawn.
        grid: the tiles.
    """
    ellipse = _Ellipse.of(shape, grid, dr.arange(mi.UInt32, dr.width(drawn)), mi.Bool(drawn))
    row, end = ellipse.rows(grid)

    def step(row: mi.Int32, count: mi.UInt32) -> tuple[mi.Int32, mi.UInt32]:
        first, behind = ellipse.columns(row, grid)
        return row + 1, count + mi.UInt32(behind - first)

    _, count = dr.while_loop((row, mi.UInt32(0)), lambda row, _: row < end, step, label="count tiles")
    return count


def write_tiles(shape: mi.Float, order: mi.UInt32, offsets: mi.UInt32, target: mi.Int32, grid: Grid) -> mi.Int32:
    """Write the tiles of some splats.

    Args:
        shape: eight numbers for every splat.
        order: indices of the listed splats.
        offsets: beginning of the tiles of each splat in ``target``.
        target: receives the tiles, row by row.
        grid: the tiles.
    """
    ellipse = _Ellipse.of(shape, grid, order, mi.Bool(True))
    row, end = ellipse.rows(grid)
    column, behind = ellipse.columns(row, grid)

    def step(
        row: mi.Int32, column: mi.Int32, behind: mi.Int32, at: mi.UInt32
    ) -> tuple[mi.Int32, mi.Int32, mi.Int32, mi.UInt32]:
        inside = column < behind
        dr.scatter(target, row * grid.columns + column, at, inside, mode=dr.ReduceMode.Permute)
        row = dr.select(inside, row, row + 1)
        first, last = ellipse.columns(row, grid)
        column, behind = dr.select(inside, column + 1, first), dr.select(inside, behind, last)
        return row, column, behind, at + dr.select(inside, mi.UInt32(1), mi.UInt32(0))

    dr.while_loop((row, column, behind, offsets), lambda row, *_: row < end, step, label="write tiles")
    return target


def nearest_first(depth: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(n,) uint32 rows in ascending order of depth, the smaller row first at a tie.

    Depth and row are sorted as a single number of 64 bits, since bits of positive float32 numbers ascend as the numbers do: a
    seventh of the time of a stable sort of indices.

    Args:
        depth: (N,) float32, above 0 in the rows.
        rows: (n,) integers from 0, below 2^32.
    """
    keys = (depth[rows].view(np.uint32).astype(np.uint64) << np.uint64(32)) | rows.astype(np.uint64)
    keys.sort()
    return keys.astype(np.uint32)  # the low half


def list_tiles(tiles: np.ndarray, order: np.ndarray, offsets: np.ndarray, n_tiles: int) -> TileLists:
    """Make the lists of the tiles.

    Args:
        tiles: (E,) int32 tiles of the splats in ``order``, splat after splat.
        order: (n,) uint32 indices of splats, nearest first.
        offsets: (n + 1,) int32 beginning of the tiles of each splat.
        n_tiles: number of tiles.
    """
    if len(order) == 0:
        return TileLists(np.zeros(0, np.uint32), np.zeros(n_tiles + 1, np.uint32))
    matrix = scipy.sparse.csr_array((np.zeros(len(tiles), np.int8), tiles, offsets), shape=(len(order), n_tiles)).tocsc()
    return TileLists(order[matrix.indices], matrix.indptr.astype(np.uint32))


def check_memory(needed: int, available: int | None, entries: int, longest: str) -> None:
    """Refuse lists that do not fit.

    Raises:
        MivolError: ``needed`` is more than half of ``available`` [bytes], or ``entries`` exceeds MOST_ENTRIES.
    """
    if entries > MOST_ENTRIES:
        raise MivolError(
            f"Found {entries:,} entries of splats in tiles ({longest}), expected at most {MOST_ENTRIES:,}: use fewer or "
            "smaller Gaussians, or a smaller image."
        )
    if available is not None and needed > available // 2:
        raise MivolError(
            f"Found {entries:,} entries of splats in tiles, which take {needed / 2**30:.2g} GiB ({longest}); expected at most "
            f"{available / 2**31:.2g} GiB, half of the memory that is free: use fewer or smaller Gaussians, or a smaller image."
        )
