"""The operators of a scan through a grid, traced once and replayed for other rays and values."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from mivol.kernel_recording import record_kernels
from mivol.tomography.column_integral import (
    ColumnGrid,
    Line,
    backproject_columns,
    fold_nodes,
    integrate_columns,
    pad_nodes,
    zero_nodes,
)
from mivol.tomography.geometry import VoxelGrid
from mivol.transport.media.grid_integral import NodeGradient, backproject_segment, integrate_segment
from mivol.transport.traversal.box import clip_to_box
from mivol.transport.traversal.lattice import Lattice, clip_to_grid

__all__ = ["RecordedKernels"]

Rows = list
"""``Lattice.from_world``: 3 rows of 4 numbers."""


class RecordedKernels:
    """Both operators through a grid for arbitrary rays, traced once and replayed.

    Tracing a walk takes milliseconds, longer than the walk itself for a subset of a few hundred rays. Dr.Jit records the
    kernels at the first call (``dr.freeze``) and launches them for other rays and values without tracing.

    Args:
        grid: the grid; its centre is the origin of the rays.
    """

    def __init__(self, grid: VoxelGrid) -> None:
        self.grid = grid
        values = dr.zeros(mi.TensorXf, (*grid.shape, 1))
        self._from_world = Lattice(values, VoxelGrid(grid.shape, grid.voxel_size).to_world).from_world
        self._record()

    def _record(self) -> None:
        # The recording of the transpose includes a buffer with a copy per thread.
        self._threads = dr.thread_count()
        shape = self.grid.shape
        self._integrate = record_kernels(_trace_integral, shape)
        self._backproject = record_kernels(_trace_backprojection, shape)
        self._pad = record_kernels(_pad_columns, ColumnGrid(shape, 2))
        self._columns: dict[str, Callable] = {}

    def _renew(self) -> None:
        """Record anew after a change of the number of threads."""
        if self._threads != dr.thread_count():
            self._record()

    def integrate(self, values: mi.Float, empty: mi.UInt8 | None, o: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        """Line integrals of ``values`` along rays; ``empty`` blocks are skipped."""
        return self._integrate(values, empty, o, d, self._from_world)

    def backproject(self, weight: mi.Float, o: mi.Point3f, d: mi.Vector3f) -> mi.Float:
        """Sum over rays of ``weight`` times the contribution of each voxel to the ray."""
        self._renew()
        return self._backproject(weight, o, d, self._from_world)

    # -- Rays that seldom cross one axis --------------------------------------------------------------------------------------

    def pad(self, values: mi.Float) -> mi.Float:
        """The values with a margin of a node, for :meth:`integrate_columns`."""
        return self._pad(values)

    def integrate_columns(self, padded: mi.Float, o: mi.Point3f, d: mi.Vector3f, along: int) -> mi.Float:
        """As :meth:`integrate`, for rays that seldom cross the layers of the axis ``along``."""
        return self._by_columns(f"integrate {along}", _trace_columns, padded, o, d, along)

    def backproject_columns(self, weight: mi.Float, o: mi.Point3f, d: mi.Vector3f, along: int) -> mi.Float:
        """As :meth:`backproject`, for rays that seldom cross the layers of the axis ``along``."""
        return self._by_columns(f"backproject {along}", _trace_column_sums, weight, o, d, along)

    def _by_columns(self, name: str, trace: Callable, given: mi.Float, o: mi.Point3f, d: mi.Vector3f, along: int) -> mi.Float:
        self._renew()
        if name not in self._columns:
            self._columns[name] = record_kernels(trace, ColumnGrid(self.grid.shape, along))
        return self._columns[name](given, o, d, self._from_world)


# -- Recorded functions --------------------------------------------------------------------------------------------------


def _trace_integral(
    shape: tuple[int, int, int], values: mi.Float, empty: mi.UInt8 | None, o: mi.Point3f, d: mi.Vector3f, rows: Rows
) -> mi.Float:
    lattice = Lattice(mi.TensorXf(values, (*shape, 1)), None, empty, from_world=rows)
    return integrate_segment(lattice, values, clip_to_grid(lattice, o, d, 0, dr.inf))[0]


def _trace_backprojection(shape: tuple[int, int, int], weight: mi.Float, o: mi.Point3f, d: mi.Vector3f, rows: Rows) -> mi.Float:
    lattice = Lattice(dr.zeros(mi.TensorXf, (*shape, 1)), None, from_world=rows)
    target = NodeGradient.zeros(lattice)
    backproject_segment(lattice, target, [weight], clip_to_grid(lattice, o, d, 0, dr.inf))
    return target.fold()


def _pad_columns(grid: ColumnGrid, values: mi.Float) -> mi.Float:
    return pad_nodes(values, grid)


def _trace_columns(grid: ColumnGrid, padded: mi.Float, o: mi.Point3f, d: mi.Vector3f, rows: Rows) -> mi.Float:
    return integrate_columns(grid, padded, _line_in(grid, o, d, rows))


def _trace_column_sums(grid: ColumnGrid, weight: mi.Float, o: mi.Point3f, d: mi.Vector3f, rows: Rows) -> mi.Float:
    target = zero_nodes(grid)
    backproject_columns(grid, target, weight, _line_in(grid, o, d, rows))
    return fold_nodes(target, grid)


def _line_in(grid: ColumnGrid, o: mi.Point3f, d: mi.Vector3f, rows: Rows) -> Line:
    """The part of rays inside the box of the grid."""
    high = tuple(n - 0.5 for n in grid.res[::-1])
    q, v, t0, t1 = clip_to_box(rows, (-0.5,) * 3, high, o, d, mi.Float64(0), mi.Float64(dr.inf))
    hit = t1 > t0
    entry = [dr.clip(dr.fma(dr.select(hit, t0, 0), v[a], q[a]), -0.5, high[a]) for a in range(3)]
    return Line(entry, v, dr.select(hit, t1 - t0, 0))
