"""Problems of line integrals and the state of their solvers: least squares, the likelihood of counts, total variation.

Conventions. The operator A maps voxels (n,) to rays (m,), both flat; ``A.shape`` is (m, n). ``b`` are line integrals
(dimensionless), ``weights`` their inverse variances (0 excludes a ray), x the field (1/length). Vectors keep the operator's
dtype. Sums are float64 in a fixed order: a run is bitwise repeatable with a repeatable operator.

A solver is a generator. The generator yields a :class:`SolverState` per iteration, without end or until the minimum. The caller
controls progress, checkpoints and stopping. Arrays of a state are never overwritten, and ``run(problem, state=saved)``
continues an interrupted run. A state without memory continues from its field alone.

References: Morozov 1966 (discrepancy principle); Huber 1964; Charbonnier et al. 1997 (half-quadratic majoriser); Rudin, Osher &
Fatemi 1992 (total variation).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.kernel_recording import RecordedKernel
from mivol.threads import map_arrays
from mivol.tomography.projector import Projector
from mivol.tomography.rings import PixelGains


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Minimise ``1/2 |W^(1/2) (A x - b)|^2 + prior(x)``, over ``x >= 0`` if ``nonnegative``.

    Args:
        A: linear operator (m, n).
        b: (m,) line integrals, in a shape with m entries.
        weights: inverse variances of ``b``; None: 1.
        x0: start; None: 0.
        nonnegative: keep every voxel at or above 0.
        prior: optional penalty.
        gains: unknown gains of the pixels, which conjugate gradients eliminate; ``b`` is then explained up to their offsets.
    """

    A: Any
    b: np.ndarray
    weights: np.ndarray | None = None
    x0: np.ndarray | None = None
    nonnegative: bool = False
    prior: SmoothedTV | None = None
    gains: PixelGains | None = None

    def __post_init__(self) -> None:
        check_sizes(self.A, self.x0, b=self.b, weights=self.weights)
        if self.weights is not None and np.min(self.weights) < 0:
            raise MivolError("found a negative weight, expected inverse variances: set the weight of unused rays to 0.")


@dataclass(frozen=True, eq=False)
class PoissonCounts:
    """Maximise the likelihood of ``counts ~ Poisson(blank exp(-A x) + background)`` over ``x >= 0``, minus a prior.

    Args:
        A: linear operator (m, n) with entries >= 0.
        counts: (m,) numbers of quanta: detector readings over the gain.
        blank: quanta without an object, a number or (m,).
        background: expected quanta from other sources (dark, scatter), a number or (m,).
        x0: start, >= 0; None: 0.
        prior: optional penalty.
        used: (m,) whether a ray is used (dead and saturated pixels are not); None: all rays.
    """

    A: Any
    counts: np.ndarray
    blank: np.ndarray | float
    background: np.ndarray | float = 0.0
    x0: np.ndarray | None = None
    prior: SmoothedTV | None = None
    used: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_sizes(self.A, self.x0, counts=self.counts, used=self.used)
        if np.min(self.counts) < 0 or np.min(self.blank) <= 0 or np.min(self.background) < 0:
            raise MivolError("found negative data or a blank of 0, expected counts >= 0, background >= 0 and blank > 0.")


def check_sizes(a: Any, x0: np.ndarray | None, **data: np.ndarray | None) -> None:
    """Check data for an operator.

    Raises:
        MivolError: another number of values than rays or voxels, or a nonfinite value.
    """
    m, n = a.shape
    for name, value in data.items():
        if value is None:
            continue
        if np.size(value) != m:
            raise MivolError(f"found {np.size(value)} values in '{name}', expected {m}, one for each ray of the operator.")
        if not np.isfinite(value).all():
            raise MivolError(
                f"found a value that is not finite in '{name}' at flat index {int(np.argmin(np.isfinite(value)))}: give "
                "unusable rays a weight of 0 and a finite value."
            )
    if x0 is not None and (np.size(x0) != n or not np.isfinite(x0).all()):
        raise MivolError(
            f"found a start of {np.size(x0)} values, expected {n} finite ones, one for each voxel of the operator."
        )


def flatten(a: np.ndarray, dtype: Any) -> np.ndarray:
    """An array as a vector."""
    return np.asarray(a, dtype).reshape(-1)


def start_field(a: Any, x0: np.ndarray | None) -> np.ndarray:
    """A copy of the start, or 0."""
    return np.zeros(a.shape[1], a.dtype) if x0 is None else flatten(x0, a.dtype).copy()


def ray_lengths(a: Any) -> np.ndarray:
    """``A 1`` (m,), which a projector computes once."""
    return flatten(a.row_sums if isinstance(a, Projector) else a @ np.ones(a.shape[1], a.dtype), a.dtype)


def flat_weights(problem: LeastSquares) -> np.ndarray | None:
    """Weights of rays (m,); None: 1."""
    return None if problem.weights is None else flatten(problem.weights, problem.A.dtype)


def apply_weights(weights: np.ndarray | None, v: np.ndarray) -> np.ndarray:
    """Weighted vector; None stands for weights of 1."""
    return v if weights is None else weights * v


def weighting(problem: LeastSquares) -> Callable[[np.ndarray], np.ndarray]:
    """The function from a residual (m,) to the weighted residual, without the offsets of unknown gains."""
    if problem.gains is not None:
        return problem.gains.weigh
    weights = flat_weights(problem)
    return lambda v: apply_weights(weights, v)


BLOCK, BLOCKS_AT_ONCE = 1 << 16, 16
"""Numbers treated at once, whose temporaries stay in a cache, and successive blocks that a thread takes."""


def blocks(n: int) -> Iterator[slice]:
    """Slices of at most ``BLOCK`` of n numbers."""
    return (slice(first, min(first + BLOCK, n)) for first in range(0, n, BLOCK))


Result = TypeVar("Result")


def map_blocks(work: Callable[[slice], Result], n: int) -> list[Result]:
    """The results of ``work`` for each of the :func:`blocks` of n numbers, in their order, by as many threads as Dr.Jit has."""
    parts = list(blocks(n))
    chunks = [parts[first : first + BLOCKS_AT_ONCE] for first in range(0, len(parts), BLOCKS_AT_ONCE)]
    found = map_arrays(lambda chunk: [work(part) for part in chunk], chunks, dr.thread_count())
    return list(itertools.chain.from_iterable(found))


def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum in float64 in a fixed order, which BLAS does not guarantee."""
    return sum(map_blocks(lambda part: float(np.sum(a[part] * b[part], dtype=np.float64)), len(a)), 0.0)


GRAZED = 1e-6
"""A ray or a voxel is grazed, and stays unchanged, if its entries sum to at most this share of the largest sum."""


def invert_sums(v: np.ndarray, largest: float | None = None) -> np.ndarray:
    """1 / v of sums v; 0 at grazed rays and voxels. ``largest``: the largest of all sums, if v is a part of them."""
    floor = GRAZED * (float(np.max(v, initial=0.0)) if largest is None else largest)
    return np.where(v > floor, 1.0 / np.where(v > floor, v, 1.0), 0.0).astype(v.dtype)


@dataclass(frozen=True, eq=False)
class SolverState:
    """State of a solver after an iteration.

    Args:
        x: (n,) the field.
        iteration: number of completed iterations.
        objective: minimised value at ``x``; for SIRT and OS-SART half the squared residual.
        residual_norm: ``|W^(1/2) (b - A x)|``; for OS-SART from the residuals of each subset before its update.
        memory: further arrays that the next iteration needs.
    """

    x: np.ndarray
    iteration: int
    objective: float
    residual_norm: float
    memory: dict[str, np.ndarray] = field(default_factory=dict)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of the state by name, for ``np.savez``."""
        scalars = {"iteration": self.iteration, "objective": self.objective, "residual_norm": self.residual_norm}
        arrays = {"x": self.x, **{name: np.asarray(value) for name, value in scalars.items()}}
        return arrays | {f"memory.{name}": value for name, value in self.memory.items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> SolverState:
        """State from the arrays of :meth:`to_arrays`."""
        memory = {name.removeprefix("memory."): arrays[name] for name in arrays if name.startswith("memory.")}
        scalars = int(arrays["iteration"]), float(arrays["objective"]), float(arrays["residual_norm"])
        return cls(arrays["x"], *scalars, memory)


def last_state(states: Iterator[SolverState], count: int) -> SolverState | None:
    """The state after at most ``count`` iterations; None without an iteration. Earlier states are not kept."""
    state = None
    for state in itertools.islice(states, count):  # noqa: B007  (only the last state counts)
        pass
    return state


def accept_all(problem: object, **options: object) -> None:
    """The check of a solver without restrictions."""


@dataclass(frozen=True)
class Solver:
    """A solver: ``run(problem, state=None, **options)`` yields states.

    ``check(problem, **options)`` raises the errors of the first iteration of ``run``, without computing. ``cites`` are keys of
    ``mivol.cite.CITATIONS``.
    """

    run: Callable[..., Iterator[SolverState]]
    problem: type
    promises: str
    cites: tuple[str, ...]
    check: Callable[..., None] = accept_all


UNWEIGHTED = ("sirt", "sart", "os-sart")
"""Solvers with an unweighted residual."""


def expected_residual_norm(problem: LeastSquares | PoissonCounts, solver: str) -> float:
    """The expected ``residual_norm`` of a solver at the true volume.

    The squares of a weighted residual ``r sqrt(w)``, and of Pearson's residual, have a mean of 1 for each used ray. Unweighted
    residuals have the mean ``sum 1 / w``.
    """
    if isinstance(problem, PoissonCounts):
        return float(np.sqrt(np.size(problem.counts) if problem.used is None else np.sum(problem.used)))
    if problem.weights is None:
        return float(np.sqrt(np.size(problem.b)))
    used = problem.weights[problem.weights > 0].astype(np.float64)
    return float(np.sqrt(np.sum(1.0 / used) if solver in UNWEIGHTED else used.size))


# -- Total variation -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SmoothedTV:
    """Total variation with a quadratic bottom (Huber on the length of the gradient): ``strength sum psi(|grad x|) dV``.

    ``psi(t) = t^2 / (2 delta)`` below ``delta`` and ``t - delta / 2`` above; differences are forward, and 0 at the far
    borders.

    Args:
        shape: (Z, Y, X).
        strength: factor on the sum [1/length], which makes the penalty dimensionless.
        delta: slope [value per length] below which noise is smoothed instead of preserved as an edge.
        voxel_size: one number or (x, y, z) [length].

    References: Huber 1964; Charbonnier et al. 1997 (half-quadratic majoriser).
    """

    shape: tuple[int, int, int]
    strength: float
    delta: float
    voxel_size: float | tuple[float, float, float] = 1.0

    def value(self, x: np.ndarray) -> float:
        """The penalty."""
        return self._scale * self._sum(_penalties, x)

    def add_derivatives(self, x: np.ndarray, gradient: np.ndarray, diagonal: np.ndarray | None) -> None:
        """Add the derivative (n,) of the penalty to ``gradient``; add a diagonal (n,) of its majoriser to a given ``diagonal``.

        The diagonal follows from ``(p - q)^2 <= 2 p^2 + 2 q^2`` on each difference.
        """
        for voxels, (slope, bound) in self._run(_derivatives, x):
            gradient[voxels] += slope
            if diagonal is not None:
                diagonal[voxels] += bound

    def curvature(self, x: np.ndarray, p: np.ndarray) -> float:
        """Second derivative of the majoriser at ``x`` along ``p``."""
        return self._scale * self._sum(_curvatures, x, p)

    def share_of_edges(self, x: np.ndarray) -> float:
        """Share of voxels with a slope of ``delta`` or more, which are preserved as edges."""
        return self._sum(_edges, x) / x.size

    @property
    def _spacing(self) -> np.ndarray:
        return np.broadcast_to(np.asarray(self.voxel_size, float), (3,))[::-1]

    @property
    def _scale(self) -> float:
        return self.strength * float(np.prod(self._spacing))

    def _sum(self, function: Callable, *fields: np.ndarray) -> float:
        return float(sum(part.sum(dtype=np.float64) for _, (part,) in self._run(function, *fields)))

    def _run(self, function: Callable, *fields: np.ndarray) -> Iterator[tuple[slice, list[np.ndarray]]]:
        """Numbers for each voxel, part by part, by a kernel that reads fields (n,) in place."""
        array = mi.Float64 if fields[0].dtype == np.float64 else mi.Float
        given = [array(np.ascontiguousarray(x, fields[0].dtype).reshape(-1)) for x in fields]
        n_z, n_y, n_x = self.shape
        sizes = [dr.opaque(mi.UInt32, n) for n in (n_x * n_y, n_x, 1, n_z, n_y, n_x)]
        inverses = [dr.opaque(mi.Float64, 1 / n) for n in (n_x, n_y)]
        numbers = [dr.opaque(array, v) for v in (*(1 / self._spacing), self.delta, self._scale)]
        for first in range(0, fields[0].size, KERNEL_VOXELS):
            count = min(KERNEL_VOXELS, fields[0].size - first)
            lattice = _Slopes(dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first), sizes, inverses, numbers)
            yield slice(first, first + count), [found.numpy() for found in _record(function)(lattice, *given)]


KERNEL_VOXELS = 1 << 20
"""Voxels of a kernel of the total variation: a result takes 4 MiB, which Dr.Jit keeps for the next one."""


@cache
def _record(function: Callable) -> Callable:
    return RecordedKernel(function)


@dataclass
class _Slopes:
    """Forward differences of the voxels' values along z, y and x, each over its spacing; 0 at the far borders.

    Attributes:
        voxel: numbers of voxels.
        sizes: numbers from a voxel to the next along z, y and x, and (Z, Y, X).
        inverses: 1 / X and 1 / Y.
        numbers: 1 / spacing along z, y and x, delta, and the factor on the sum over voxels.
    """

    voxel: mi.UInt32
    sizes: list[mi.UInt32]
    inverses: list[mi.Float64]
    numbers: list[mi.Float]

    def neighbours(self) -> list[tuple[mi.Bool, mi.Bool]]:
        """Whether there is a voxel before, and after, along z, y and x."""
        n_z, n_y, n_x = self.sizes[3:]
        # Exact below 2^32: half a step from the next whole number. Processors have no vector division of integers.
        line = mi.UInt32((mi.Float64(self.voxel) + 0.5) * self.inverses[0])
        layer = mi.UInt32((mi.Float64(line) + 0.5) * self.inverses[1])
        places = ((layer, n_z), (line - layer * n_y, n_y), (self.voxel - line * n_x, n_x))
        return [(at > 0, at + 1 < size) for at, size in places]

    def differences(self, x: mi.Float, before: int | None = None) -> list[mi.Float]:
        """Differences at each voxel, or at the voxel before it along an axis (0 without such a voxel)."""
        neighbours, voxel, is_there = self.neighbours(), self.voxel, mi.Bool(True)
        exists = [after for _, after in neighbours]
        if before is not None:
            voxel, is_there = voxel - self.sizes[before], neighbours[before][0]
            exists = [is_there & (axis == before or after) for axis, after in enumerate(exists)]
        own, found = dr.gather(type(x), x, voxel, is_there), []
        for axis, e in enumerate(exists):
            found.append(dr.select(e, (dr.gather(type(x), x, voxel + self.sizes[axis], e) - own) * self.numbers[axis], 0))
        return found

    def inverse_slope(self, differences: list[mi.Float]) -> mi.Float:
        """``psi'(t) / t`` of the length t of the gradient."""
        return 1 / dr.maximum(dr.sqrt(sum(d * d for d in differences)), self.numbers[3])


def _penalties(slopes: _Slopes, x: mi.Float) -> list[mi.Float]:
    t, delta = dr.sqrt(sum(d * d for d in slopes.differences(x))), slopes.numbers[3]
    return [dr.select(t < delta, t * t / (2 * delta), t - delta / 2)]


def _edges(slopes: _Slopes, x: mi.Float) -> list[mi.Float]:
    return [dr.select(dr.sqrt(sum(d * d for d in slopes.differences(x))) >= slopes.numbers[3], mi.Float(1), 0)]


def _curvatures(slopes: _Slopes, x: mi.Float, p: mi.Float) -> list[mi.Float]:
    return [slopes.inverse_slope(slopes.differences(x)) * sum(d * d for d in slopes.differences(p))]


def _derivatives(slopes: _Slopes, x: mi.Float) -> list[mi.Float]:
    """Derivative of the penalty, and diagonal of its majoriser: sums over differences that begin or end at a voxel."""
    own, gradient, diagonal = slopes.differences(x), 0, 0
    w = slopes.inverse_slope(own)
    for axis, (is_before, is_after) in enumerate(slopes.neighbours()):
        before, scale = slopes.differences(x, axis), slopes.numbers[4] * slopes.numbers[axis]
        begins, ends = dr.select(is_after, w, 0), dr.select(is_before, slopes.inverse_slope(before), 0)
        gradient += scale * (ends * before[axis] - begins * own[axis])
        diagonal += 2 * scale * slopes.numbers[axis] * (begins + ends)
    return [gradient, diagonal]


CHORD = 0.47
"""``sum a^2 / sum a`` over the rays through a voxel of edge 1, whose share of a trilinear field falls to 0 at its neighbours:
2/3 for the distance along the detector's rows (0.70 averaged over directions), times 2/3 for the distance along z. Rays through
the centres of layers have the first factor only, and a balance 1.2 times as strong."""


def scale_tv_to_noise(a: Projector, y: np.ndarray, weights: np.ndarray, tv: float, delta: float) -> SmoothedTV:
    """Total variation in units of the scan's own noise and values, independent of lengths, quanta and materials.

    The data act on a voxel with the gradient ``A^T W r``, whose standard deviation from noise is ``sqrt(sum_i w_i a_ij^2)``.
    Total variation acts through each face with at most ``strength dV / h``. At ``tv`` = 1 both are equal at the median of the
    visible voxels, with ``a_ij^2`` approximated by ``0.47 h a_ij``. ``delta`` = 1 is a slope of the scan's mean value over one
    voxel. The mean value is ``sum w y c / sum w c^2``, with a ray's path length c in the grid.

    Args:
        a: projector of the fitted views.
        y, weights: (views, rows, cols), with variances 1 / weights.
        tv: strength in units of the balance.
        delta: in units of the mean value per voxel.
    """
    edge = float(np.prod(a.grid.voxel_size) ** (1 / 3))
    w = np.asarray(weights, np.float64)
    sensitivity = a.T @ flatten(w, a.dtype)
    pull = np.sqrt(CHORD * edge * np.median(sensitivity[sensitivity > 0])) if (sensitivity > 0).any() else 0.0
    chord = ray_lengths(a).astype(np.float64).reshape(w.shape)
    mean = abs(float(np.sum(w * y * chord))) / max(float(np.sum(w * chord**2)), np.finfo(float).tiny)
    slope = delta * mean / edge
    return SmoothedTV(a.grid.shape, tv * float(pull) / edge**2, slope or np.finfo(np.float32).tiny, a.grid.voxel_size)
