"""A projector whose matrix is stored: for scans whose rays lie in layers, one layer's rows serve them all.

A walk computes each entry anew in every product. Where a layer's matrix fits into memory, a product reads it: that takes
half of a walk's time for one slice and a tenth for sixty-four, and a subset of views is a part of it that costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np
import scipy.sparse

from mivol.errors import MivolError
from mivol.tomography.projector import Projector
from mivol.tomography.slice_matrix import build_rows, count_bytes, find_lines

__all__ = ["StoredProjector", "bytes_to_store", "is_worth_storing", "store"]

LAYERS_AT_ONCE = 32
"""Columns of one product: 32 floats are two cache lines, and a layer of 256^2 of them fits into a second-level cache."""

PRODUCTS_TO_PAY = 9
"""Products with A and its transpose, counted a layer, after which storing is paid for: an entry takes the processor about 23 ns
to store, and each pair of products reads it 2.6 ns sooner than a walk finds it (2.2 and 4.8 ns, one layer)."""

Blocks = list[scipy.sparse.csr_array]


class StoredProjector(Projector):
    """The operators of a :class:`~mivol.tomography.projector.Projector`, from stored rows; made by :func:`store`.

    ``A = H S``: H interpolates between the layers of the grid at the heights of the detector's rows, S is the stored matrix of
    a layer. Products agree with the walk's to its rounding, and ``A.T`` is the transpose of the same numbers.

    Cost: 8 bytes an entry of S, and a multiplication an entry and layer.
    """

    def __init__(self, walk: Projector, blocks: Blocks, to_rows: scipy.sparse.csr_array | None) -> None:
        super().__init__(walk.geometry, walk.grid, walk.views, walk._kernels)
        self._blocks, self._to_rows = blocks, to_rows
        # Made once: a transpose copies nothing, but takes as long to make as a view takes to multiply.
        self._transposed = [block.T for block in blocks]

    @property
    def nbytes(self) -> int:
        """Bytes of the stored rows."""
        return sum(part.nbytes for b in self._blocks for part in (b.data, b.indices, b.indptr))

    def subset(self, views: Sequence[int] | np.ndarray) -> StoredProjector:
        """The rows of some views, counted among this projector's own: the same memory, read in part."""
        walk = super().subset(views)
        return StoredProjector(walk, _views_of(self._blocks, np.asarray(views, int), self.projection_shape[2]), self._to_rows)

    def _project_array(self, x: np.ndarray) -> np.ndarray:
        layers = x.reshape(self.grid.shape[0], -1)
        if self._to_rows is not None:
            layers = self._to_rows @ layers
        views, rows, columns = self.projection_shape
        if rows == 1:
            return np.concatenate([block @ layers[0] for block in self._blocks])
        y = np.empty((views * columns, rows), np.float32)
        for part in _parts(rows):
            operand = np.ascontiguousarray(layers[part].T)
            np.concatenate([block @ operand for block in self._blocks], out=y[:, part])
        return y.reshape(views, columns, rows).transpose(0, 2, 1).reshape(-1)

    def _backproject_array(self, y: np.ndarray) -> np.ndarray:
        views, rows, columns = self.projection_shape
        y = y.reshape(views, rows, columns)
        layers = np.empty((rows, self._blocks[0].shape[1]), np.float32)
        for part in _parts(rows):
            operand = np.ascontiguousarray(y[:, part].transpose(0, 2, 1)).reshape(views * columns, -1)
            layers[part] = self._back(operand[:, 0] if rows == 1 else operand).T
        return (layers if self._to_rows is None else self._to_rows.T @ layers).reshape(-1)

    def _back(self, operand: np.ndarray) -> np.ndarray:
        """Blocks are added up in float64, as the walk's passes are."""
        if len(self._blocks) == 1:
            return self._transposed[0] @ operand
        total, start = np.zeros((self._blocks[0].shape[1], *operand.shape[1:])), 0
        for transposed in self._transposed:
            total += transposed @ operand[start : start + transposed.shape[1]]
            start += transposed.shape[1]
        return total

    def _project(self, values: mi.Float) -> mi.Float:
        return mi.Float(self._project_array(np.array(values)))

    def _backproject(self, y: mi.Float) -> mi.Float:
        return mi.Float(self._backproject_array(np.array(y)))


def bytes_to_store(projector: Projector) -> int | None:
    """Bytes that :func:`store` would take, counted without storing; None where the rays do not lie in layers."""
    lines = find_lines(projector.geometry, projector.grid, projector.views)
    return None if lines is None else count_bytes(lines)


def is_worth_storing(rows: int, iterations: int, is_by_subsets: bool) -> bool:
    """Whether storing costs less than it saves.

    Args:
        rows: of the detector: layers that share the stored rows.
        iterations: of a solver, each with about one product with A and one with its transpose.
        is_by_subsets: whether an iteration takes many small products; a walk of a few hundred rays costs mostly its start.
    """
    return is_by_subsets or rows * iterations >= PRODUCTS_TO_PAY


def store(projector: Projector) -> StoredProjector:
    """The same projector with its rows stored.

    Raises:
        MivolError: rays that do not lie in layers: only parallel beams and fans of one row do.
    """
    lines = find_lines(projector.geometry, projector.grid, projector.views)
    if lines is None:
        raise MivolError(
            "found rays that do not lie in layers of constant z, expected those of a parallel beam or of a fan of one row, "
            "whose layers share one matrix: walk them (solve.storage = walk)."
        )
    return StoredProjector(projector, list(build_rows(lines)), _interpolation(projector, lines.heights))


def _interpolation(projector: Projector, heights: np.ndarray) -> scipy.sparse.csr_array | None:
    """(rows, Z) linear interpolation at the heights, clamped and 0 outside the box; None where rows are layers."""
    grid = projector.grid
    n, where = grid.shape[0], (heights - grid.centre[2]) / grid.voxel_size[2] + (grid.shape[0] - 1) / 2
    inside = (where > -0.5) & (where < n - 0.5)
    held = np.clip(where, 0, n - 1)
    hats = np.maximum(0, 1 - np.abs(held[:, None] - np.arange(n))) * inside[:, None]
    is_each_a_layer = hats.shape[0] == n and (hats == np.eye(n)).all()
    return None if is_each_a_layer else scipy.sparse.csr_array(hats.astype(np.float32))


def _parts(rows: int) -> list[slice]:
    return [slice(first, min(first + LAYERS_AT_ONCE, rows)) for first in range(0, rows, LAYERS_AT_ONCE)]


def _views_of(blocks: Blocks, views: np.ndarray, columns: int) -> Blocks:
    """The rows of views, in their order; runs of neighbours stay together."""
    begins = np.cumsum([0, *(block.shape[0] // columns for block in blocks)])
    home = np.searchsorted(begins, views, "right") - 1
    cuts = np.flatnonzero((np.diff(views) != 1) | (np.diff(home) != 0)) + 1
    found = []
    for run in np.split(np.arange(len(views)), cuts):
        block, first = blocks[home[run[0]]], (views[run[0]] - begins[home[run[0]]]) * columns
        ends = block.indptr[first : first + len(run) * columns + 1]
        entries = slice(ends[0], ends[-1])
        rows = (block.data[entries], block.indices[entries], ends - ends[0])
        found.append(scipy.sparse.csr_array(rows, shape=(len(ends) - 1, block.shape[1])))
    return found
