r"""A projector with a stored matrix, for scans whose rays lie in layers: all layers share the rows of a single layer.

A walk computes each entry anew in every product. If the matrix of a layer fits into memory, a product reads the matrix
instead: half of a walk's time for a single slice, and a tenth for sixty-four. A subset of views is a part of the matrix at no
cost.

Conventions. A line is followed along its major axis, which crosses more voxels: x is a coordinate in voxels along the major
axis (0 at the first centre), and the other coordinate is ``offset + slope x`` with \|slope\| <= 1. A row of voxels (the same
x) then meets at most four voxels of the line. Entries are the integrals of the trilinear model of
:class:`mivol.tomography.projector.Projector`: hat functions at voxel centres, constant beyond the outermost centres, nothing
outside the box. Positions are float64, fractions of a voxel and entries float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, singledispatch

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse

from mivol.errors import MivolError
from mivol.kernel_recording import RecordedKernel, copy_aligned
from mivol.tomography.geometry import Geometry, VoxelGrid
from mivol.tomography.projector import Projector

LAYERS_AT_ONCE = 32
"""Layers of a product: a lane reads 32 neighbouring floats, two cache lines, for each entry."""

LANES = 16
"""Voxels whose entries alternate in memory, so that the lanes of a vector read neighbours."""

SMALL_PRODUCT = 1 << 26
"""Most multiplications of a product that SciPy computes on one core: smaller ones read caches, and start no kernel."""

MIN_PRODUCTS = 9
"""Products with A and the transpose per layer after which storing pays: storing an entry takes about 23 ns, and each pair of
products reads the entry 2.6 ns sooner than a walk computes it (2.2 and 4.8 ns, a single layer)."""

Blocks = list[scipy.sparse.csr_array]


class StoredProjector(Projector):
    """The operators of a :class:`~mivol.tomography.projector.Projector` from stored rows; made by :func:`store_matrix`.

    ``A = H S``: H interpolates between the layers of the grid at the heights of the detector's rows, S is the stored matrix of
    a layer. Products agree with the walk's products to rounding, and ``A.T`` is the transpose of the same numbers.

    Cost: 8 bytes per entry of S, twice for many layers, and a multiplication per entry and layer.
    """

    def __init__(self, walk: Projector, matrix: RowBlocks | LayerMatrix, to_rows: scipy.sparse.csr_array | None) -> None:
        super().__init__(walk.geometry, walk.grid, walk.views, walk._kernels)
        self._matrix, self._to_rows = matrix, to_rows

    @property
    def nbytes(self) -> int:
        """Bytes of the stored rows."""
        return self._matrix.nbytes

    def subset(self, views: Sequence[int] | np.ndarray) -> StoredProjector:
        """Select the rows of some views, counted among this projector's own, in the same memory."""
        walk = super().subset(views)  # checks the numbers
        matrix = self._matrix.select_views(np.asarray(views, int), self.projection_shape[2])
        return StoredProjector(walk, matrix, self._to_rows)

    def _project_array(self, x: np.ndarray) -> np.ndarray:
        layers = x.reshape(self.grid.shape[0], -1)
        if self._to_rows is not None:
            layers = self._to_rows @ layers
        return self._matrix.project(layers, self.projection_shape).reshape(-1)

    def _backproject_array(self, y: np.ndarray) -> np.ndarray:
        layers = self._matrix.backproject(y.reshape(self.projection_shape))
        return (layers if self._to_rows is None else self._to_rows.T @ layers).reshape(-1)

    def _project(self, values: mi.Float) -> mi.Float:
        return mi.Float(self._project_array(np.array(values)))

    def _backproject(self, y: mi.Float) -> mi.Float:
        return mi.Float(self._backproject_array(np.array(y)))


def matrix_bytes(projector: Projector) -> int | None:
    """Memory needed by :func:`store_matrix` [byte], counted without storing; None for rays that do not lie in layers."""
    lines = find_lines(projector.geometry, projector.grid, projector.views)
    if lines is None:
        return None
    size = count_bytes(lines)
    return size if is_small_product(projector.projection_shape[1], size // 8) else 2 * size


def is_small_product(rows: int, entries: int) -> bool:
    """Whether SciPy multiplies a layer's matrix, which is then stored once, without its transpose."""
    return rows == 1 or rows * entries < SMALL_PRODUCT


def is_worth_storing(rows: int, iterations: int, is_by_subsets: bool) -> bool:
    """Whether storing costs less than the later products save.

    Args:
        rows: rows of the detector: layers that share the stored rows.
        iterations: iterations of a solver, each with about a product with A and a product with its transpose.
        is_by_subsets: whether an iteration takes many small products; a walk of a few hundred rays costs mostly its start.
    """
    return is_by_subsets or rows * iterations >= MIN_PRODUCTS


@singledispatch
def store_matrix(projector: Projector) -> Projector:
    """Store the rows of a projector.

    Raises:
        MivolError: rays that do not lie in layers; only parallel beams and fans of a single row do.
    """
    lines = find_lines(projector.geometry, projector.grid, projector.views)
    if lines is None:
        raise MivolError(
            "found rays that do not lie in layers of constant z, expected those of a parallel beam or of a fan of one row, "
            "whose layers share one matrix: walk them (solve.storage = walk)."
        )
    blocks, (_, rows, columns) = list(build_rows(lines)), projector.projection_shape
    is_small = is_small_product(rows, sum(block.nnz for block in blocks))
    matrix = RowBlocks(blocks) if is_small else LayerMatrix.from_blocks(blocks, (columns, projector.grid.shape[2]))
    return StoredProjector(projector, matrix, _row_interpolation(projector, lines.heights))


def _row_interpolation(projector: Projector, heights: np.ndarray) -> scipy.sparse.csr_array | None:
    """(rows, Z) linear interpolation at the heights, clamped and 0 outside the box; None if rows coincide with layers."""
    grid = projector.grid
    n, where = grid.shape[0], (heights - grid.centre[2]) / grid.voxel_size[2] + (grid.shape[0] - 1) / 2
    inside = (where > -0.5) & (where < n - 0.5)
    held = np.clip(where, 0, n - 1)
    hats = np.maximum(0, 1 - np.abs(held[:, None] - np.arange(n))) * inside[:, None]
    # A share below half a unit of float32 is rounding of the heights: most detectors have their rows on layers.
    hats = np.where(hats < 2**-24, 0, hats).astype(np.float32)
    is_each_a_layer = hats.shape[0] == n and (hats == np.eye(n)).all()
    return None if is_each_a_layer else scipy.sparse.csr_array(hats)


# -- Products by SciPy ------------------------------------------------------------------------------------------------------


class RowBlocks:
    """The matrix of a layer in blocks of rows, for small products and for a layer alone.

    Args:
        blocks: (lines, voxels of a layer) each, of whole views.
    """

    def __init__(self, blocks: Blocks) -> None:
        self._blocks = blocks
        # Transposes copy nothing, but making a transpose takes as long as multiplying a view: make them once.
        self._transposed = [block.T for block in blocks]

    @property
    def nbytes(self) -> int:
        """Bytes of the stored rows."""
        return sum(part.nbytes for b in self._blocks for part in (b.data, b.indices, b.indptr))

    def project(self, layers: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
        """Line integrals (views, rows, cols) of layers (rows, voxels)."""
        views, rows, columns = shape
        operand = layers[0] if rows == 1 else np.ascontiguousarray(layers.T)
        y = np.concatenate([block @ operand for block in self._blocks])
        return y.reshape(views, columns, rows).transpose(0, 2, 1)

    def backproject(self, y: np.ndarray) -> np.ndarray:
        """Layers (rows, voxels) of projections; blocks are added up in float64, as passes of the walk are."""
        views, rows, columns = y.shape
        operand = np.ascontiguousarray(y.transpose(0, 2, 1)).reshape(views * columns, rows)
        operand = operand[:, 0] if rows == 1 else operand
        if len(self._blocks) == 1:
            return np.ascontiguousarray((self._transposed[0] @ operand).T).reshape(rows, -1)
        total, start = np.zeros((self._blocks[0].shape[1], *operand.shape[1:])), 0
        for transposed in self._transposed:
            total += transposed @ operand[start : start + transposed.shape[1]]
            start += transposed.shape[1]
        return np.ascontiguousarray(total.T, np.float32).reshape(rows, -1)

    def select_views(self, views: np.ndarray, columns: int) -> RowBlocks:
        """The rows of views, in their order; runs of neighbours stay together."""
        begins = np.cumsum([0, *(block.shape[0] // columns for block in self._blocks)])
        home = np.searchsorted(begins, views, "right") - 1
        cuts = np.flatnonzero((np.diff(views) != 1) | (np.diff(home) != 0)) + 1
        found = []
        for run in np.split(np.arange(len(views)), cuts):
            block, first = self._blocks[home[run[0]]], (views[run[0]] - begins[home[run[0]]]) * columns
            ends = block.indptr[first : first + len(run) * columns + 1]
            entries = slice(ends[0], ends[-1])
            rows = (block.data[entries], block.indices[entries], ends - ends[0])
            found.append(scipy.sparse.csr_array(rows, shape=(len(ends) - 1, block.shape[1])))
        return RowBlocks(found)


# -- Products with many layers ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LayerMatrix:
    """A sparse matrix whose kernels multiply ``LAYERS_AT_ONCE`` layers together on all cores; sums are float32.

    The entries of ``LANES`` neighbouring rows alternate in memory: entry k of row i is at ``first[i] + k LANES``.

    Attributes:
        first, end: (rows,) place of the first entry, and the place beyond the last entry.
        columns, entries: column and value of each place.
        width: columns of the matrix.
        per_line: successive rows, and columns, of a view or of a line of voxels.
    """

    first: np.ndarray
    end: np.ndarray
    columns: np.ndarray
    entries: np.ndarray
    width: int
    per_line: tuple[int, int]

    @classmethod
    def from_blocks(cls, blocks: Blocks, per_line: tuple[int, int]) -> LayerMatrix:
        """The matrix of blocks of rows; ``per_line`` of its rows, and of its columns."""
        begins = np.cumsum([0, *(block.shape[0] for block in blocks)])
        parts = [(slice(begin, begin + block.shape[0]), 0, block) for begin, block in zip(begins, blocks, strict=False)]
        counts = np.concatenate([np.diff(block.indptr) for block in blocks])
        return cls._interleave(counts, blocks[0].shape[1], per_line, parts)

    @classmethod
    def _interleave(
        cls,
        counts: np.ndarray,
        width: int,
        per_line: tuple[int, int],
        parts: Iterable[tuple[slice, int, scipy.sparse.csr_array]],
    ) -> LayerMatrix:
        """Rows with ``counts`` entries, from parts: which rows, the number of their first column, and their entries."""
        longest = np.pad(counts, (0, -len(counts) % LANES)).reshape(-1, LANES).max(1)
        begins = LANES * np.concatenate([[0], np.cumsum(longest)])
        first = (begins[:-1, None] + np.arange(LANES)).reshape(-1)[: len(counts)]
        columns, entries, end = np.zeros(begins[-1], np.uint32), np.zeros(begins[-1], np.float32), first.copy()
        for rows, column, part in parts:
            size = np.diff(part.indptr)
            at = np.repeat(end[rows] - LANES * part.indptr[:-1].astype(np.int64), size)
            at += LANES * np.arange(part.nnz)
            columns[at], entries[at] = part.indices + column, part.data
            end[rows] += LANES * size
        return cls(first, end, columns, entries, width, per_line)

    @cached_property
    def transposed(self) -> LayerMatrix:
        """The transpose, stored as well."""
        counts = np.zeros(self.width, np.int64)
        for _, part in self._parts():
            counts += np.bincount(part.indices, minlength=self.width)
        columns = ((slice(None), begin, part.T.tocsr()) for begin, part in self._parts())
        return self._interleave(counts, len(self.first), self.per_line[::-1], columns)

    def _parts(self) -> Iterator[tuple[int, scipy.sparse.csr_array]]:
        """Blocks of rows, and the number of their first row."""
        counts = (self.end - self.first) // LANES
        pieces = min(len(counts), 1 + int(counts.sum()) // PAIRS_PER_BLOCK)
        for rows in np.array_split(np.arange(len(counts)), pieces):
            own = counts[rows]
            ends = np.concatenate([[0], np.cumsum(own)])
            at = np.repeat(self.first[rows] - LANES * ends[:-1], own) + LANES * np.arange(ends[-1])
            part = (self.entries[at], self.columns[at].astype(np.int32), ends)
            yield int(rows[0]), scipy.sparse.csr_array(part, shape=(len(rows), self.width))

    @property
    def nbytes(self) -> int:
        """Bytes of the entries and of their transpose."""
        return 2 * (self.columns.nbytes + self.entries.nbytes)

    def select_views(self, views: np.ndarray, columns: int) -> LayerMatrix:
        """The rows of views, in their order."""
        rows = (views[:, None] * columns + np.arange(columns)).reshape(-1)
        return replace(self, first=self.first[rows], end=self.end[rows])

    def project(self, layers: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
        """Line integrals (views, rows, cols) of layers (rows, voxels)."""
        views, rows, columns = shape
        return self._multiply(layers).reshape(rows, views, columns).transpose(1, 0, 2)

    def backproject(self, y: np.ndarray) -> np.ndarray:
        """Layers (rows, voxels) of projections."""
        return self.transposed._multiply(y.transpose(1, 0, 2).reshape(y.shape[1], -1))

    @property
    def _order(self) -> np.ndarray:
        """Order of the rows by strips of ``LANES`` rows of all lines, which read the same columns while a cache holds them."""
        line, place = np.divmod(np.arange(len(self.first)), self.per_line[0])
        return np.lexsort((place, line, place // LANES))

    @cached_property
    def _place(self) -> np.ndarray:
        """Place of each row in ``_order``: to gather takes a tenth of the time of a scatter."""
        return np.argsort(self._order)

    @cached_property
    def _rows(self) -> _Rows:
        first, end = (mi.UInt32(copy_aligned(part[self._order].astype(np.uint32))) for part in (self.first, self.end))
        return _Rows(first, end, mi.UInt32(self.columns), mi.Float(self.entries))

    def _multiply(self, layers: np.ndarray) -> np.ndarray:
        """Multiply layers (layers, columns) float32: (layers, rows)."""
        count, result = len(layers), np.empty((len(layers), len(self.first)), np.float32)
        given = mi.Float(np.ascontiguousarray(layers).reshape(-1))
        for first in range(0, count, LAYERS_AT_ONCE):
            # The last layers may be few.
            width = min(LAYERS_AT_ONCE, 1 << (count - first - 1).bit_length())
            pack, multiply = _record_products(width)
            packed = dr.empty(mi.Float, width * self.width)
            numbers = [dr.opaque(mi.UInt32, n) for n in (first, count, self.width)]
            products = multiply(self._rows, pack(packed, given, *numbers))
            for layer, product in zip(result[first : first + width], products, strict=False):
                np.take(product.numpy(), self._place, out=layer, mode="clip")
        return result


@dataclass
class _Rows:
    """A :class:`LayerMatrix` in arrays of Dr.Jit."""

    first: mi.UInt32
    end: mi.UInt32
    columns: mi.UInt32
    entries: mi.Float


@cache
def _record_products(width: int) -> tuple[Callable, Callable]:
    return RecordedKernel(_pack_layers, width), RecordedKernel(_multiply_layers, width)


def _pack_layers(width: int, packed: mi.Float, given: mi.Float, first: mi.UInt32, count: mi.UInt32, n: mi.UInt32) -> mi.Float:
    """Write ``width`` of ``count`` layers of n columns side by side, from the layer ``first``; beyond the last layer, 0."""
    column = dr.arange(mi.UInt32, dr.width(packed) // width)
    layers = [dr.gather(mi.Float, given, column + (first + k) * n, first + k < count) for k in range(width)]
    dr.scatter(packed, mi.ArrayXf(layers), column)
    return packed


def _multiply_layers(width: int, rows: _Rows, packed: mi.Float) -> list[mi.Float]:
    """The products of ``width`` layers, each (rows,)."""

    def add(at: mi.UInt32, *total: mi.Float) -> tuple[mi.UInt32 | mi.Float, ...]:
        entry, column = dr.gather(mi.Float, rows.entries, at), dr.gather(mi.UInt32, rows.columns, at)
        values = dr.gather(mi.ArrayXf, packed, column, shape=(width, 1))
        return at + LANES, *(dr.fma(entry, values[k], total[k]) for k in range(width))

    state = (mi.UInt32(rows.first), *(mi.Float(0) for _ in range(width)))
    _, *total = dr.while_loop(state, lambda at, *_: at < rows.end, add)
    return total


# -- The rows of a layer ----------------------------------------------------------------------------------------------------

VOXELS_PER_ROW = 4
"""Most voxels of a row met by a line: hats are 2 wide, and a line crosses at most 2 voxels while crossing a row's hat."""

MIN_ENTRY = 1e-9
"""Integrals [voxels] below this limit are rounding, from kinks at a centre; they are left out, an error of 1e-7 of a voxel in
100."""

PAIRS_PER_BLOCK = 1 << 21
"""Pairs of a line and a row computed at once: 64 MiB of places and entries."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines in a plane of ``shape`` voxels (Y, X), each with its part inside.

    Attributes:
        heights: (rows,) z of the layers, with the same lines in each [length].
        slope, offset: (views, cols), as above [voxels].
        length: (views, cols), length of the line over a step of 1 along x [length].
        low, high: (views, cols), the part in the box and, for half lines, beyond the source; high <= low for an empty part.
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
    """Find the lines of a scan whose detector rows all see layers of constant z in the same way; None for other scans.

    Such scans are parallel beams, and fan beams: cones of a single row in the plane of the source.
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
    return _clip_lines(heights, q, np.array(directions) / size, grid.shape[1:], geometry.whole_lines)


def _clip_lines(heights: np.ndarray, q: np.ndarray, e: np.ndarray, shape: tuple[int, int], whole: bool) -> Lines:
    """Clip lines with points ``q`` and directions ``e`` (views, cols, 2) in voxels; a step of 1 is a unit of length."""
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
    # A line in the plane of a face counts as outside, as in the walk.
    missed = (high <= low) | (level & ((offset <= -0.5) | (offset >= n1 - 0.5)))
    low, high = (np.where(missed, 0.0, end) for end in (low, high))
    return Lines(heights, slope, offset, 1 / np.abs(e0), low, high, along_x, shape)


def count_bytes(lines: Lines) -> int:
    """Memory of the rows of all lines [byte], counted beforehand: 8 per entry, with ``2 + 2 |slope|`` entries on average over
    offsets for each row of voxels reached by a line.
    """
    last = np.where(lines.along_x, lines.shape[1], lines.shape[0]) - 1
    reached = np.minimum(np.ceil(lines.high), last) - np.maximum(np.floor(lines.low), 0) + 1
    entries = np.sum(np.where(lines.high > lines.low, reached * (2 + 2 * np.abs(lines.slope)), 0.0))
    return int(8 * entries) + 4 * lines.slope.size


def build_rows(lines: Lines) -> Iterator[scipy.sparse.csr_array]:
    """The matrix (lines, voxels of a layer) in blocks of whole views: CSR, float32 entries and int32 places."""
    n_views, columns = lines.slope.shape
    steps = max(lines.shape)
    views_at_once = max(1, PAIRS_PER_BLOCK // (columns * steps))
    for first in range(0, n_views, views_at_once):
        part = slice(first, first + views_at_once)
        yield _build_block(lines, part, steps)


def _build_block(lines: Lines, part: slice, steps: int) -> scipy.sparse.csr_array:
    names = ("slope", "offset", "length", "low", "high")
    line = {name: mi.Float64(np.ascontiguousarray(getattr(lines, name)[part]).ravel()) for name in names}
    along_x = mi.Bool(np.ascontiguousarray(lines.along_x[part]).ravel())
    count = dr.width(along_x)
    at, entries = _integrate_entries(line, along_x, lines.shape, steps)
    at, entries = (a.numpy().reshape(count, -1) for a in (at, entries))
    kept = entries > 0
    ends = np.zeros(count + 1, np.int32)
    np.cumsum(kept.sum(1, dtype=np.int32), out=ends[1:])
    found = np.flatnonzero(kept)
    return scipy.sparse.csr_array((entries.take(found), at.take(found), ends), shape=(count, lines.shape[0] * lines.shape[1]))


def _integrate_entries(
    line: dict[str, mi.Float64], along_x: mi.Bool, shape: tuple[int, int], steps: int
) -> tuple[mi.Int32, mi.Float]:
    """Places and integrals, ``VOXELS_PER_ROW`` for each line and row of voxels; unused places hold 0."""
    n_y, n_x = (dr.opaque(mi.UInt32, n) for n in shape)
    pair = dr.arange(mi.UInt32, dr.width(along_x) * steps)
    # Exact: pairs are fewer than 2^32, half a step from the next whole number. Processors have no vector division of integers.
    which = mi.UInt32((mi.Float64(pair) + 0.5) * dr.opaque(mi.Float64, 1 / steps))
    row = pair - which * dr.opaque(mi.UInt32, steps)
    slope, offset, length, low, high = (dr.gather(mi.Float64, line[name], which) for name in line)
    major_x = dr.gather(mi.Bool, along_x, which)
    n0, n1 = dr.select(major_x, n_x, n_y), dr.select(major_x, n_y, n_x)
    # Measure x from the row and the other coordinate from a voxel near the line, so that no digits are lost.
    i = mi.Float64(row)
    middle = dr.fma(slope, i, offset)
    origin = dr.floor(middle)
    slope, fraction = mi.Float(slope), mi.Float(middle - origin)
    low, high = mi.Float(dr.clip(low - i, -2, 2)), mi.Float(dr.clip(high - i, -2, 2))
    nearest, last = -mi.Float(origin), mi.Float(mi.Float64(n1) - 1 - origin)
    first_row, last_row = -mi.Float(row), mi.Float(n0) - 1 - mi.Float(row)

    def across(x: mi.Float) -> mi.Float:
        return dr.fma(slope, x, fraction)

    # The hat of the row reaches a voxel to either side, and half a voxel beyond the outermost centres.
    begin = dr.maximum(low, dr.select(row == 0, -0.5, -1))
    end = dr.minimum(high, dr.select(row + 1 == n0, 0.5, 1))
    first = dr.floor(dr.clip(dr.minimum(across(begin), across(end)), nearest, last))

    def hat(x: mi.Float) -> mi.Float:
        return 1 - dr.abs(dr.clip(x, first_row, last_row))

    def place(x: mi.Float) -> mi.Float:
        return dr.clip(across(x), nearest, last) - first

    total = [mi.Float(0.0) for _ in range(VOXELS_PER_ROW)]
    inverse = 1 / dr.select(slope == 0, 1, slope)
    for a, b in ((begin, dr.minimum(end, 0)), (dr.maximum(begin, 0), end)):
        b = dr.maximum(a, b)
        # On this side of the row the line crosses at most a single line of centres. Between kinks the line lies between two
        # voxels of the row, and the product of the hats is quadratic in x, which Simpson's rule integrates exactly.
        kink = (dr.floor(dr.maximum(across(a), across(b))) - fraction) * inverse
        kink = dr.select(slope == 0, b, dr.clip(kink, a, b))
        for c, d in ((a, kink), (kink, b)):
            middle = 0.5 * (c + d)
            lower = dr.floor(place(middle))
            weights = [hat(x) * w for x, w in ((c, 1), (middle, 4), (d, 1))]
            sixth = (d - c) / 6
            upper_part = sixth * sum(w * (place(x) - lower) for x, w in zip((c, middle, d), weights, strict=True))
            lower_part = sixth * sum(weights) - upper_part
            for j in range(VOXELS_PER_ROW):
                total[j] += dr.select(lower == j, lower_part, 0) + dr.select(lower == j - 1, upper_part, 0)

    step0, step1 = dr.select(major_x, 1, n_x), dr.select(major_x, n_x, 1)
    base = row * step0 + mi.UInt32(mi.Int32(origin) + mi.Int32(first)) * step1
    active = (row < n0) & (end > begin)
    at, entries = dr.empty(mi.Int32, VOXELS_PER_ROW * dr.width(pair)), dr.empty(mi.Float, VOXELS_PER_ROW * dr.width(pair))
    # Scatter four neighbours at once: single scatters would take three times as long as all earlier work.
    kept = [dr.select(active & (t > MIN_ENTRY), t * mi.Float(length), 0) for t in total]
    dr.scatter(at, mi.Vector4i([mi.Int32(base + j * step1) for j in range(VOXELS_PER_ROW)]), pair)
    dr.scatter(entries, mi.Vector4f(kept), pair)
    dr.eval(at, entries)
    return at, entries
