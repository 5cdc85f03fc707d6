"""The system matrix of a scan and its exact transpose, never formed: ``A @ x`` are line integrals, ``A.T @ y`` the
back-projection.

Conventions. x is a grid (Z, Y, X) [1/length] of the trilinear model (values at voxel centres, clamped borders, nothing outside
the box); y are projections (views, rows, cols), without unit. Both may be flat; the result has the form of the input. Both are
float32. Both operators are the sums defined in :mod:`mivol.transport.media.grid_extinction`, so the pair is matched: ``<A x, y>
= <x, A.T y>`` to rounding.

Rays are set up in float64: origins move to a sphere around the grid and are measured from its centre, so a source or an object
far from the world's origin costs no accuracy. Kernels receive rays as arrays. So a subset of views, another pass or another
geometry compiles and traces nothing (:class:`RecordedKernels`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.kernel_recording import RecordedKernel, copy_aligned
from mivol.threads import check_one_thread, lend_ownership
from mivol.tomography.column_integral import (
    ColumnGrid,
    Line,
    backproject_columns,
    fold_nodes,
    integrate_columns,
    pad_nodes,
    zero_nodes,
)
from mivol.tomography.geometry import Geometry, VoxelGrid, view_index
from mivol.transport.media.grid_extinction import NodeGradient, backproject_segment, integrate_segment
from mivol.transport.traversal.box import clip_to_box
from mivol.transport.traversal.grid_blocks import find_empty_distances, read_distances
from mivol.transport.traversal.lattice import Lattice, clip_to_grid

if TYPE_CHECKING:
    import scipy.sparse.linalg
    import torch


PASS_CELLS = 1 << 30
"""Most cells crossed by the rays of a kernel: about a second on two cores, so that Ctrl-C acts soon."""

PASS_SUM = 1 << 13
"""Most rays of a kernel through a voxel, on average: adding 1e6 equal float32 terms in turn errs by 8e-4, adding 8192 by 1e-5.
Kernels are added up in float64."""

MIN_CELLS_PER_VOXEL = 16
"""Crossed cells per voxel of the grid above which empty blocks are located and values are copied with a margin: either reads
each voxel a few times."""

MAX_ALONG = 0.2
"""Largest share of cells entered along an axis, on average, for the walk between columns along this axis: each such step is a
fresh start. Measured gain: 1.2 at 0.2 for rays of random direction, 1.8 to 2.3 at 0 to 0.06 for rays of scanners."""

MAX_EMPTY = 0.6
"""Largest share of empty blocks for the walk between columns, which skips no block (measured on balls and on a head)."""

RAY_BYTES = 28
"""Memory of a ray [byte]: origin, direction and number."""

CACHE_BYTES = 1 << 30
"""Largest size of rays kept between calls [byte]; larger sets are built anew in each call."""


def count_product_bytes(voxels: int, rays: int) -> int:
    """Memory of the arrays of ``A @ x`` and ``A.T @ y`` [byte]: of a voxel, a number and two float64 sums over passes; of a
    ray, two numbers and its kept place.
    """
    return 20 * voxels + 8 * rays + min(RAY_BYTES * rays, CACHE_BYTES)


class RayPass(NamedTuple):
    """Rays of a kernel.

    Attributes:
        numbers: numbers of the rays among all rays.
        o, d: origins and directions, from the grid's centre.
        is_ordered: whether the numbers are in another order than the projections.
    """

    numbers: mi.UInt32
    o: mi.Point3f
    d: mi.Vector3f
    is_ordered: bool

    def are_all(self, count: int) -> bool:
        """Whether the pass holds all ``count`` rays of the projector, in order."""
        return dr.width(self.o) == count and not self.is_ordered


def check_geometry(geometry: object, grid: object) -> None:
    """Refuse an object that is not a scanner, or a grid that is not a VoxelGrid.

    Raises:
        MivolError: the sentence names the type.
    """
    if not all(hasattr(geometry, name) for name in ("rays", "whole_lines", "shape")):
        raise MivolError(
            f"Found {type(geometry).__name__} for the geometry, expected where the rays run: mivol.ParallelBeam(angles, (rows, "
            "columns), pitch), mivol.ConeBeam, or rays of your own."
        )
    if not isinstance(grid, VoxelGrid):
        raise MivolError(
            f"Found {type(grid).__name__} for the grid, expected where the voxels lie: mivol.VoxelGrid((Z, Y, X), voxel_size)."
        )


class Projector:
    """Line integrals of a grid along the rays of a scan, and their transpose.

    Args:
        geometry: a ParallelBeam, ConeBeam, PencilRays, or an object with ``shape``, ``whole_lines`` and ``rays(views)``.
        grid: placement of the voxels.
        views: participating views, in this order; by default all.
        kernels: kernels of another projector of this grid, to share recordings; by default its own.

    Attributes:
        shape: (rays, voxels).
        dtype: float32.
        n_views: number of views.
        projection_shape: (views, rows, cols).
        T: the transpose, with ``@``, ``shape`` and ``T``.

    Cost: a walk through the grid per ray; memory 28 bytes per ray up to CACHE_BYTES, besides x and y.

    Example:
        >>> A = Projector(ParallelBeam(angles, (1, 640)), VoxelGrid((1, 640, 640)))
        >>> y = A @ x
        >>> gradient = A.T @ (y - measured)
    """

    dtype = np.dtype(np.float32)

    def __init__(
        self,
        geometry: Geometry,
        grid: VoxelGrid,
        views: Sequence[int] | np.ndarray | None = None,
        kernels: RecordedKernels | None = None,
    ) -> None:
        if mi.variant() is None or mi.variant().startswith("scalar"):
            raise MivolError(
                f"Found the variant {mi.variant()}, expected one that compiles: call mi.set_variant('llvm_ad_rgb') or "
                "'cuda_ad_rgb' first."
            )
        check_one_thread()
        check_geometry(geometry, grid)
        self.geometry, self.grid = geometry, grid
        self.views = view_index(views, geometry.shape[0])
        if len(self.views) == 0:
            raise MivolError(f"Found no views, expected some from 0 to {geometry.shape[0] - 1}.")
        self.n_views = len(self.views)
        self.projection_shape = (self.n_views, *geometry.shape[1:])
        self.shape = (int(np.prod(self.projection_shape)), grid.size)
        self._kernels = kernels or RecordedKernels(grid)
        self._cache: list[RayPass] | None = None

    def __repr__(self) -> str:
        return f"Projector({type(self.geometry).__name__} {self.projection_shape}, grid {self.grid.shape})"

    def __matmul__(self, x: np.ndarray) -> np.ndarray:
        """Line integrals of ``x``: (Z, Y, X) gives (views, rows, cols), (voxels,) gives (rays,)."""
        x, flat = _to_flat(x, self.grid.shape, "voxels")
        y = self._project_array(x)
        return y if flat else y.reshape(self.projection_shape)

    @property
    def T(self) -> Transpose:
        """The transpose: ``A.T @ y``."""
        return Transpose(self)

    def subset(self, views: Sequence[int] | np.ndarray) -> Projector:
        """Select the rows of some views, counted among this projector's own. Compiles nothing."""
        return Projector(self.geometry, self.grid, self.views[view_index(views, self.n_views)], self._kernels)

    @cached_property
    def column_sums(self) -> np.ndarray:
        """``A.T @ 1``, (Z, Y, X): total length of all rays in each voxel [length]."""
        return self.T @ np.ones(self.projection_shape, np.float32)

    @cached_property
    def row_sums(self) -> np.ndarray:
        """``A @ 1``, (views, rows, cols): length of each ray in the grid [length]."""
        return self @ np.ones(self.grid.shape, np.float32)

    def as_linear_operator(self) -> scipy.sparse.linalg.LinearOperator:
        """The pair as a SciPy linear operator, for ``lsqr``, ``lsmr``, ``cg``, ``eigsh`` and others."""
        from scipy.sparse.linalg import LinearOperator

        return LinearOperator(
            self.shape,
            matvec=lambda x: self @ np.reshape(x, -1),
            rmatvec=lambda y: self.T @ np.reshape(y, -1),
            dtype=self.dtype,
        )

    def integrate(self, values: mi.TensorXf) -> mi.TensorXf:
        """``A @ values`` on Dr.Jit tensors, differentiable in forward and reverse mode.

        Args:
            values: (Z, Y, X).

        Returns:
            (views, rows, cols).
        """
        return self._apply(_Projection, values)

    def _apply(self, operation: type[_Projection], values: mi.TensorXf) -> mi.TensorXf:
        if tuple(values.shape) != self.grid.shape:
            raise MivolError(f"Found a tensor of shape {tuple(values.shape)}, expected the grid's {self.grid.shape}.")
        return mi.TensorXf(dr.custom(operation, values.array, self), self.projection_shape)

    def to_torch(self) -> Callable[[torch.Tensor], torch.Tensor]:
        """The projector as a differentiable PyTorch function from (Z, Y, X) to (views, rows, cols), through ``dr.wrap``.

        Raises: MivolError: PyTorch is not installed; later, a tensor on another device than the variant.

        Example:
            >>> project = A.to_torch()
            >>> ((project(x) - y) ** 2).sum().backward()
        """
        try:
            import torch  # noqa: F401
        except ImportError:
            raise MivolError("Found no PyTorch, expected it for to_torch: pip install torch.") from None

        @dr.wrap(source="torch", target="drjit")
        def project(x: mi.TensorXf) -> mi.TensorXf:
            return self._apply(_ProjectionOfTorch, x)

        place = "cpu" if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else "cuda"

        def checked(x: torch.Tensor) -> torch.Tensor:
            if x.device.type != place:
                advice = f'expected one on {place}, where {mi.variant()} computes: give x.to("{place}")'
                raise MivolError(f"Found a tensor on {x.device.type}, {advice}.")
            return project(x)

        return checked

    def _project_array(self, x: np.ndarray) -> np.ndarray:
        """``A x``, flat."""
        return np.array(self._project(mi.Float(copy_aligned(x))))

    def _backproject_array(self, y: np.ndarray) -> np.ndarray:
        """``A^T y``, flat."""
        return np.array(self._backproject(mi.Float(copy_aligned(y))))

    # -- Passes over the rays ---------------------------------------------------------------------------------------------

    def _project(self, values: mi.Float) -> mi.Float:
        """``A values``, flat."""
        check_one_thread()
        empty = padded = None
        if self._pays_to_prepare:
            empty = find_empty_distances(mi.TensorXf(values, (*self.grid.shape, 1)))
            is_empty = read_distances(empty, self.grid.shape) > 0
            if self._along is not None and dr.mean(dr.select(is_empty, 1.0, 0.0))[0] < MAX_EMPTY:
                padded = self._kernels.pad(values)
        y = None
        for rays in self._passes():
            if padded is not None:
                tau = self._kernels.integrate_columns(padded, rays.o, rays.d, self._along)
            else:
                tau = self._kernels.integrate(values, empty, rays.o, rays.d)
            if rays.are_all(self.shape[0]):
                return tau
            y = dr.zeros(mi.Float, self.shape[0]) if y is None else y
            dr.scatter(y, tau, rays.numbers)
            dr.eval(y)
            dr.sync_thread()
        return y

    def _backproject(self, y: mi.Float) -> mi.Float:
        """``A^T y``, flat; passes are added up in float64."""
        check_one_thread()
        total = None
        for rays in self._passes():
            if rays.are_all(self.shape[0]):
                return self._backproject_pass(y, rays)
            weight = dr.gather(mi.Float, y, rays.numbers)
            total = dr.zeros(mi.Float64, self.grid.size) if total is None else total
            total += mi.Float64(self._backproject_pass(weight, rays))
            dr.eval(total)
            dr.sync_thread()
        return mi.Float(total)

    def _backproject_pass(self, weight: mi.Float, rays: RayPass) -> mi.Float:
        if self._pays_to_prepare and self._along is not None:
            return self._kernels.backproject_columns(weight, rays.o, rays.d, self._along)
        return self._kernels.backproject(weight, rays.o, rays.d)

    @property
    def _pays_to_prepare(self) -> bool:
        """Whether rays cross so many cells that a preparation of the voxels pays."""
        return self.shape[0] * sum(self.grid.shape) > MIN_CELLS_PER_VOXEL * self.grid.size

    @cached_property
    def _along(self) -> int | None:
        """The axis seldom crossed by the rays, judged by up to eight views; None if all axes are crossed, or on a GPU."""
        if dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
            return None
        some = self.views[np.unique(np.linspace(0, self.n_views - 1, 8).astype(int))]
        crossed = np.abs(self._rays(some)[1] / np.asarray(self.grid.voxel_size, np.float32)).mean(0)
        axis = int(crossed.argmin())
        return axis if crossed[axis] <= MAX_ALONG * crossed.sum() else None

    def _passes(self) -> Iterable[RayPass]:
        """The rays, pass by pass."""
        if self._cache is None and RAY_BYTES * self.shape[0] <= CACHE_BYTES:
            self._cache = list(self._set_up_passes())
        return self._set_up_passes() if self._cache is None else self._cache

    def _set_up_passes(self) -> Iterator[RayPass]:
        per_view = int(np.prod(self.projection_shape[1:]))
        across = self.grid.size // max(self.grid.shape)
        budget = max(1, min(PASS_CELLS // (sum(self.grid.shape) + 3), PASS_SUM * across))
        views_at_once = max(1, budget // per_view)
        for first in range(0, self.n_views, views_at_once):
            views = self.views[first : first + views_at_once]
            o, d = self._rays(views)
            order = order_rays(len(views), *self.projection_shape[1:]) if self._is_ordered else np.arange(len(o))
            for start in range(0, len(o), budget):
                part = order[start : start + budget]
                origin, direction = ([mi.Float(copy_aligned(c)) for c in a[part].T] for a in (o, d))
                numbers = mi.UInt32(copy_aligned((first * per_view + part).astype(np.uint32)))
                yield RayPass(numbers, mi.Point3f(*origin), mi.Vector3f(*direction), self._is_ordered)

    @property
    def _is_ordered(self) -> bool:
        """Whether the order of rays matters; a single row is in the best order already."""
        return self._pays_to_prepare and self.projection_shape[1] > 1

    def _rays(self, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rays (N, 3) starting on the sphere around the grid, from the grid's centre."""
        o, d = (np.reshape(a, (-1, 3)) for a in self.geometry.rays(views))
        o = o - np.asarray(self.grid.centre)
        to_sphere = -np.einsum("ij,ij->i", o, d) - self.grid.radius
        if not self.geometry.whole_lines:
            to_sphere = np.maximum(to_sphere, 0.0)
        return (o + to_sphere[:, None] * d).astype(np.float32), d.astype(np.float32)


class Transpose:
    """The transpose of a :class:`Projector`."""

    dtype = Projector.dtype

    def __init__(self, projector: Projector) -> None:
        self.T = projector
        self.shape = projector.shape[::-1]

    def __matmul__(self, y: np.ndarray) -> np.ndarray:
        """Back-projection of ``y``: (views, rows, cols) gives (Z, Y, X), (rays,) gives (voxels,)."""
        y, flat = _to_flat(y, self.T.projection_shape, "rays")
        x = self.T._backproject_array(y)
        return x if flat else x.reshape(self.T.grid.shape)


class _Projection(dr.CustomOp):
    """y = A x, with its tangent and the transpose, in passes."""

    def eval(self, values: mi.Float, projector: Projector) -> mi.Float:
        self.projector = projector
        return projector._project(dr.detach(values))

    def forward(self) -> None:
        self.set_grad_out(self.projector._project(self.grad_in("values")))

    def backward(self) -> None:
        self.set_grad_in("values", self.projector._backproject(self.grad_out()))

    def name(self) -> str:
        return "projection"


class _ProjectionOfTorch(_Projection):
    """The same for PyTorch, whose own threads request derivatives on a GPU while the calling thread waits."""

    def eval(self, values: mi.Float, projector: Projector) -> mi.Float:
        y = super().eval(values, projector)
        dr.eval(y)
        dr.sync_thread()
        return y

    def backward(self) -> None:
        with lend_ownership():
            super().backward()


def _to_flat(a: np.ndarray, shape: tuple[int, ...], what: str) -> tuple[np.ndarray, bool]:
    """(flat float32 array, whether it was flat)."""
    try:
        a = np.asarray(a)
    except ValueError:
        message = f"Found rows of different lengths, expected {shape} or flat, one number for each of the {what}."
        raise MivolError(message) from None
    flat = a.shape == (int(np.prod(shape)),)
    if not flat and a.shape != shape:
        raise MivolError(f"Found an array of shape {a.shape}, expected {shape} or flat, one number for each of the {what}.")
    if np.iscomplexobj(a):
        raise MivolError("Found complex numbers, expected real ones: project the real and the imaginary part apart.")
    return np.ascontiguousarray(a, np.float32).reshape(-1), flat


TILE = (2, 8)
"""Rows and columns of a tile: 16 lanes, a vector of 512 bits."""


def order_rays(views: int, rows: int, columns: int) -> np.ndarray:
    """Order the numbers of rays (view, row, column) so that successive rays read the same voxels and a cache still holds them.

    A vector of lanes takes a tile of the detector, with parallel neighbouring rays. Then follow the same rows of the other
    views, which cross the same layers of voxels; the rest of the same view is a whole volume away.

    Returns:
        (views * rows * columns,), each number once.
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    in_view = np.lexsort((column % TILE[1], row % TILE[0], column // TILE[1], row // TILE[0]))
    first = np.arange(views)[:, None] * (rows * columns)
    bands = np.split(in_view, range(TILE[0] * columns, len(in_view), TILE[0] * columns))
    return np.concatenate([(first + band).ravel() for band in bands])


# -- Recorded kernels ------------------------------------------------------------------------------------------------------


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
        self._integrate = RecordedKernel(_trace_integral, shape)
        self._backproject = RecordedKernel(_trace_backprojection, shape)
        self._pad = RecordedKernel(_pad_columns, ColumnGrid(shape, 2))
        self._columns: dict[str, Callable] = {}

    def _renew(self) -> None:
        """Record anew after a change of the number of threads."""
        if self._threads != dr.thread_count():
            self._record()

    def integrate(self, values: mi.Float, empty: mi.UInt32 | None, o: mi.Point3f, d: mi.Vector3f) -> mi.Float:
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
            self._columns[name] = RecordedKernel(trace, ColumnGrid(self.grid.shape, along))
        return self._columns[name](given, o, d, self._from_world)


# -- Recorded functions --------------------------------------------------------------------------------------------------


def _trace_integral(
    shape: tuple[int, int, int], values: mi.Float, empty: mi.UInt32 | None, o: mi.Point3f, d: mi.Vector3f, rows: Rows
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
