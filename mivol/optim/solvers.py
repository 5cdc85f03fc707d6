"""From line integrals to the field: iterative solvers for any linear operator that has ``@`` and ``.T``.

Conventions. The operator A maps voxels (n,) to rays (m,), both flat; ``A.shape`` is (m, n). ``b`` are line integrals
(dimensionless), ``weights`` their inverse variances (0: the ray is not used), x the field (1/length). Vectors keep the
operator's dtype, sums are float64 and are formed in a fixed order, so a run is bitwise repeatable where the operator
is.

Each solver is a generator: it yields a :class:`State` per iteration for ever (or until nothing is left to gain), so
progress, checkpoints and stopping are the caller's. The arrays of a state are never written again, and
``run(problem, state=saved)`` continues as if it had not stopped.

References: Hestenes & Stiefel 1952 and Paige & Saunders 1982 (CGLS); Polak & Ribiere 1969; Bertsekas 1982 (projected
descent with a diagonal metric); Erdogan & Fessler 1999, Phys. Med. Biol. 44, 2835 (separable surrogates, optimum
curvature); Andersen & Kak 1984 (SART); Gregor & Benson 2008 (SIRT); Nuyts et al. 1998, Phys. Med. Biol. 43, 729
(ML-TR).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from mivol.errors import MivolError

__all__ = ["SOLVERS", "LeastSquares", "PoissonCounts", "Prior", "SmoothedTV", "Solver", "State"]


class Prior(Protocol):
    """A convex penalty with a quadratic majoriser that touches it at x."""

    def value(self, x: np.ndarray) -> float: ...
    def gradient(self, x: np.ndarray) -> np.ndarray: ...
    def curvature(self, x: np.ndarray, p: np.ndarray) -> float:
        """Second derivative along ``p`` of the majoriser at ``x``."""

    def separable(self, x: np.ndarray) -> np.ndarray:
        """Diagonal of a separable quadratic that majorises the majoriser."""


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """Minimise ``1/2 |W^(1/2) (A x - b)|^2 + prior(x)``, over ``x >= 0`` where ``nonnegative``.

    Args:
        A: linear operator (m, n).
        b: (m,) line integrals, of any shape with m entries.
        weights: inverse variances of ``b``, or None for all 1.
        x0: start, or None for 0.
        nonnegative: keep every voxel at or above 0.
        prior: optional penalty.
    """

    A: Any
    b: np.ndarray
    weights: np.ndarray | None = None
    x0: np.ndarray | None = None
    nonnegative: bool = False
    prior: Prior | None = None

    def __post_init__(self) -> None:
        _check_sizes(self.A, self.x0, b=self.b, weights=self.weights)
        if self.weights is not None and np.min(self.weights) < 0:
            raise MivolError("Found a negative weight, expected inverse variances (0 for rays that are not to be used).")


@dataclass(frozen=True, eq=False)
class PoissonCounts:
    """Maximise the likelihood of ``counts ~ Poisson(blank exp(-A x) + background)`` over ``x >= 0``, less a prior.

    Args:
        A: linear operator (m, n) with entries >= 0.
        counts: (m,) numbers of quanta; a detector's reading divided by its gain.
        blank: quanta without an object, one number or (m,).
        background: expected quanta that are not the object's (dark, scatter), one number or (m,).
        x0: start, >= 0, or None for 0.
        prior: optional penalty.
    """

    A: Any
    counts: np.ndarray
    blank: np.ndarray | float
    background: np.ndarray | float = 0.0
    x0: np.ndarray | None = None
    prior: Prior | None = None

    def __post_init__(self) -> None:
        _check_sizes(self.A, self.x0, counts=self.counts)
        if np.min(self.counts) < 0 or np.min(self.blank) <= 0 or np.min(self.background) < 0:
            raise MivolError("Found negative counts or background or a blank of 0, expected counts >= 0 and a blank above 0.")


@dataclass(frozen=True, eq=False)
class State:
    """Where a solver stands after an iteration.

    Args:
        x: (n,) the field.
        iteration: iterations done.
        objective: value of what the solver minimises, at ``x``; for SIRT and OS-SART half the squared residual.
        residual_norm: ``|W^(1/2) (b - A x)|``; for OS-SART of the residuals as each subset met them, before its update.
        memory: what else the solver must know to go on.
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
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> State:
        """The state that :meth:`to_arrays` gave."""
        memory = {name.removeprefix("memory."): arrays[name] for name in arrays if name.startswith("memory.")}
        scalars = int(arrays["iteration"]), float(arrays["objective"]), float(arrays["residual_norm"])
        return cls(arrays["x"], *scalars, memory)


@dataclass(frozen=True)
class Solver:
    """A method: ``run(problem, state=None, **options)`` yields states."""

    run: Callable[..., Iterator[State]]
    problem: type
    needs: str
    promises: str
    citation: str


# -- Conjugate gradients ---------------------------------------------------------------------------------------------


def conjugate_gradients(problem: LeastSquares, state: State | None = None, precondition: bool = True) -> Iterator[State]:
    """Preconditioned conjugate gradients on the (weighted, penalised) least squares.

    Without bounds and prior this is linear CG (CGLS where not preconditioned). With them it is Polak-Ribiere CG on the
    voxels that are free (x > 0, or pushed up by the gradient); a step that would leave the domain is bent back on to it
    (projected) and followed to the minimum of the majoriser along the bent direction; where a bent direction does not
    lead down the diagonally scaled gradient replaces it, whose projection always does. The objective therefore never
    rises.

    Preconditioner: ``diag(A^T W A 1 + separable majoriser of the prior)^-1`` (SQS). Voxels that no ray sees stay at
        ``x0``.
    Cost per iteration: one A and one A^T, one A more where a step is bent.
    """
    a, prior = problem.A, problem.prior
    weights = _weights(problem)
    data_diagonal = a.T @ _times(weights, a @ np.ones(a.shape[1], a.dtype)) if precondition else None
    if state is None:
        x = _start(a, problem.x0)
        if problem.nonnegative:
            x = np.maximum(x, 0)
        r = _flat(problem.b, a.dtype) - a @ x
        state = _ls_state(problem, x, 0, r, {"residual": r})
    while True:
        x, r, old = state.x, state.memory["residual"], state.memory
        g = -(a.T @ _times(weights, r))
        if prior:
            g = g + prior.gradient(x)
        free = (x > 0) | (g < 0) if problem.nonnegative else None
        z = g * _inverse(data_diagonal if not prior else data_diagonal + prior.separable(x)) if precondition else g
        z = z if free is None else z * free
        gz = _dot(g, z)
        if not gz > 0:
            return
        direction = -z
        if "direction" in old:
            beta = max(0.0, (gz - _dot(old["gradient"], z)) / float(old["gz"]))
            direction = direction + np.asarray(beta, x.dtype) * (old["direction"] if free is None else old["direction"] * free)
        step = _descend(problem, weights, x, g, direction) or _descend(problem, weights, x, g, -z)
        if step is None:
            return
        x, r = x + step[0], r - step[1]
        if problem.nonnegative:
            x = np.maximum(x, 0)  # rounding only: the step ends in the domain
        memory = {"residual": r, "direction": direction, "gradient": g, "gz": np.asarray(gz)}
        state = _ls_state(problem, x, state.iteration + 1, r, memory)
        yield state


def _descend(
    problem: LeastSquares, weights: np.ndarray | None, x: np.ndarray, g: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """(step, A step) to the minimum along ``direction``, bent on to the domain; None where it does not lead down."""

    def minimum(d: np.ndarray) -> tuple[float, np.ndarray] | None:
        image = problem.A @ d
        curvature = _dot(image, _times(weights, image)) + (problem.prior.curvature(x, d) if problem.prior else 0.0)
        slope = _dot(g, d)
        return (-slope / curvature, image) if slope < 0 and curvature > 0 else None

    found = minimum(direction)
    if found is None:
        return None
    step = np.asarray(found[0], x.dtype) * direction
    if not problem.nonnegative or (x + step).min() >= 0:
        return step, np.asarray(found[0], x.dtype) * found[1]
    bent = np.maximum(x + step, 0) - x
    found = minimum(bent)
    if found is None:
        return None
    # Beyond length 1 the bent step could leave the domain again.
    length = np.asarray(min(1.0, found[0]), x.dtype)
    return length * bent, length * found[1]


def _cgls(problem: LeastSquares, state: State | None = None) -> Iterator[State]:
    return conjugate_gradients(problem, state, precondition=False)


def _ls_state(problem: LeastSquares, x: np.ndarray, iteration: int, r: np.ndarray, memory: dict) -> State:
    norm2 = _dot(r, _times(_weights(problem), r))
    penalty = problem.prior.value(x) if problem.prior else 0.0
    return State(x, iteration, norm2 / 2 + penalty, float(np.sqrt(norm2)), memory)


# -- Algebraic reconstruction ----------------------------------------------------------------------------------------


def ordered_subsets_sart(
    problem: LeastSquares, state: State | None = None, n_subsets: int = 10, relaxation: float = 1.0, decay: float = 0.99
) -> Iterator[State]:
    """Simultaneous algebraic reconstruction over subsets of views, one sweep of all subsets per iteration.

    ``x <- P(x + lambda C_s A_s^T R_s (b_s - A_s x))`` with ``R_s = 1 / (A_s 1)``, ``C_s = 1 / (A_s^T 1)``, lambda
    falling by ``decay`` after each sweep, and P the projection on x >= 0 where asked for. Subset s holds every
    ``n_subsets``-th view, and the subsets come in golden-section order, so that successive ones look from far apart.
    One subset is SIRT.

    Args:
        n_subsets: 1 to the number of views.
        relaxation: lambda of the first sweep, in (0, 2).
        decay: in (0, 1]; below 1 the limit cycle of inconsistent data shrinks, and the method stops short of
            convergence.

    Weights: only where they are 0 is heeded (the ray is left out). A prior is refused.
    Cost per iteration: one A and one A^T, and once one A and one A^T more for the sums; memory: ``n_subsets`` fields.
    """
    a = problem.A
    if problem.prior is not None:
        raise MivolError(
            "Found a prior with SIRT or OS-SART, expected none: use pcg or ml-tr, which minimise a penalised objective."
        )
    if not 0 < relaxation < 2 or not 0 < decay <= 1:
        raise MivolError(f"Found relaxation {relaxation} and decay {decay}, expected 0 < relaxation < 2 and 0 < decay <= 1.")
    blocks = _blocks(problem, n_subsets)
    if state is None:
        state = State(_start(a, problem.x0), 0, np.nan, np.nan)
    while True:
        x, norm2 = state.x, 0.0
        strength = np.asarray(relaxation * decay**state.iteration, x.dtype)
        for block in blocks:
            r = (block.b - block.a @ x) * block.used
            norm2 += _dot(r, r)
            x = x + strength * block.per_voxel * (block.a.T @ (block.per_ray * r))
            if problem.nonnegative:
                x = np.maximum(x, 0)
        state = State(x, state.iteration + 1, norm2 / 2, float(np.sqrt(norm2)))
        yield state


def _sirt(problem: LeastSquares, state: State | None = None, relaxation: float = 1.0) -> Iterator[State]:
    return ordered_subsets_sart(problem, state, 1, relaxation, 1.0)


@dataclass(frozen=True, eq=False)
class _Block:
    a: Any
    b: np.ndarray
    used: np.ndarray
    per_ray: np.ndarray
    per_voxel: np.ndarray


def _blocks(problem: LeastSquares, n_subsets: int) -> list[_Block]:
    a = problem.A
    if n_subsets == 1:
        views = [None]
    else:
        n_views = getattr(a, "n_views", None)
        if n_views is None or not 1 <= n_subsets <= n_views:
            raise MivolError(
                f"Found {n_subsets} subsets of {n_views or 'no'} views, expected at least 1, at most as many as views, "
                "and an operator with n_views and subset(views)."
            )
        views = [np.arange(s, n_views, n_subsets) for s in _golden_order(n_subsets)]
    return [_block(problem, v) for v in views]


def _block(problem: LeastSquares, views: np.ndarray | None) -> _Block:
    a = problem.A if views is None else problem.A.subset(views)

    def part(data: np.ndarray) -> np.ndarray:
        flat = _flat(data, a.dtype)
        return flat if views is None else flat.reshape(problem.A.n_views, -1)[views].reshape(-1)

    used = np.ones(a.shape[0], a.dtype) if problem.weights is None else (part(problem.weights) > 0).astype(a.dtype)
    per_ray = used * _inverse(a @ np.ones(a.shape[1], a.dtype))
    return _Block(a, part(problem.b), used, per_ray, _inverse(a.T @ used))


def _golden_order(n: int) -> np.ndarray:
    """A permutation of 0..n-1 whose neighbours are far apart."""
    return np.argsort(np.argsort(np.arange(n) * (np.sqrt(5) - 1) / 2 % 1.0))


# -- Counts ----------------------------------------------------------------------------------------------------------


def transmission_likelihood(problem: PoissonCounts, state: State | None = None) -> Iterator[State]:
    """Maximum likelihood of transmission counts (ML-TR) with Erdogan and Fessler's optimum curvatures.

    ``x <- max(0, x - grad / (A^T(c . A 1) + separable majoriser of the prior))`` with the gradient ``A^T(mu (y / yhat
    - 1))``, ``mu = blank e^-l``, ``yhat = mu + background``, ``l = A x`` and per ray the smallest curvature c whose
    parabola at l lies above the negative log-likelihood for all l >= 0. Nuyts' ML-TR is the same with c = mu, which
    may overshoot. The objective never rises. ``objective`` is the sum of ``yhat - y log yhat`` (and the prior);
    ``residual_norm`` is Pearson's ``|(y - yhat) / sqrt(yhat)|``.

    Cost per iteration: one A and two A^T.
    """
    a, prior = problem.A, problem.prior
    y = _flat(problem.counts, np.float64)
    blank, background = (
        np.broadcast_to(np.asarray(v, float).reshape(-1), y.shape) for v in (problem.blank, problem.background)
    )
    chord = a @ np.ones(a.shape[1], a.dtype)
    if state is None:
        x = np.maximum(_start(a, problem.x0), 0)
        state = _count_state(prior, x, 0, y, blank, background, a @ x)
    while True:
        x, line = state.x, state.memory["line"].astype(np.float64)
        mu = blank * np.exp(-line)
        slope = mu * (y / (mu + background) - 1.0)
        gradient = a.T @ slope.astype(a.dtype)
        bound = a.T @ (_optimum_curvature(y, blank, background, line) * chord).astype(a.dtype)
        if prior:
            gradient, bound = gradient + prior.gradient(x), bound + prior.separable(x)
        x = np.maximum(x - gradient * _inverse(bound), 0)
        state = _count_state(prior, x, state.iteration + 1, y, blank, background, a @ x)
        yield state


def _optimum_curvature(y: np.ndarray, blank: np.ndarray, background: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Erdogan & Fessler 1999, Eq. 28: ``2 (h(0) - h(l) + l h'(l)) / l^2``, at least 0, and ``h''(0)`` at l = 0."""
    mu = blank * np.exp(-line)
    h0 = blank + background - y * np.log(blank + background)
    h = mu + background - y * np.log(mu + background)
    slope = mu * (y / (mu + background) - 1.0)
    at_zero = blank * (1.0 - y * background / (blank + background) ** 2)
    # The bracket is of order l^2 h'' and its terms of order h: below l = 1e-3 less than 9 digits of float64 are left,
    # and h''(0), the limit, is off by l h'''/3 only.
    small = line < 1e-3
    l2 = np.where(small, 1.0, line * line)
    return np.maximum(np.where(small, at_zero, 2.0 * (h0 - h + line * slope) / l2), 0.0)


def _count_state(
    prior: Prior | None,
    x: np.ndarray,
    iteration: int,
    y: np.ndarray,
    blank: np.ndarray,
    background: np.ndarray,
    line: np.ndarray,
) -> State:
    expected = blank * np.exp(-line.astype(np.float64)) + background
    # y log(yhat) -> 0 for y = 0 even where yhat underflows.
    log_expected = np.log(np.maximum(expected, np.finfo(float).tiny))
    objective = float(np.sum(expected - y * log_expected)) + (prior.value(x) if prior else 0.0)
    pearson = float(np.sqrt(np.sum((y - expected) ** 2 / np.maximum(expected, np.finfo(float).tiny))))
    return State(x, iteration, objective, pearson, {"line": line})


# -- Prior -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SmoothedTV:
    """Total variation with a quadratic bottom (Huber on the length of the gradient): ``strength sum psi(|grad x|) dV``.

    ``psi(t) = t^2 / (2 delta)`` below ``delta`` and ``t - delta / 2`` above; differences are forward and 0 at the far
    borders.

    Args:
        shape: (Z, Y, X).
        strength: multiplies the sum; its unit makes the whole dimensionless.
        delta: slope [value per length] below which noise is smoothed instead of kept as an edge.
        voxel_size: one number or (x, y, z) [length].

    References: Huber 1964; Charbonnier et al. 1997 (half-quadratic majoriser).
    """

    shape: tuple[int, int, int]
    strength: float
    delta: float
    voxel_size: float | tuple[float, float, float] = 1.0

    def value(self, x: np.ndarray) -> float:
        """The penalty."""
        t = np.sqrt(sum(d * d for d in self._differences(x)))
        psi = np.where(t < self.delta, t * t / (2 * self.delta), t - self.delta / 2)
        return self._scale * float(psi.sum(dtype=np.float64))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """(n,) derivative of the penalty."""
        differences = self._differences(x)
        w = self._inverse_slope(differences)
        total = np.zeros(self.shape, x.dtype)
        for axis, d in enumerate(differences):
            flux = np.delete(w * d, -1, axis) / self._spacing[axis]
            total[_part(axis, slice(1, None))] += flux
            total[_part(axis, slice(None, -1))] -= flux
        return (total * self._scale).reshape(-1).astype(x.dtype)

    def curvature(self, x: np.ndarray, p: np.ndarray) -> float:
        """Second derivative of the majoriser at ``x`` along ``p``."""
        w = self._inverse_slope(self._differences(x))
        return self._scale * float(sum((w * d * d).sum(dtype=np.float64) for d in self._differences(p)))

    def separable(self, x: np.ndarray) -> np.ndarray:
        """(n,) diagonal that majorises: ``(p - q)^2 <= 2 p^2 + 2 q^2`` on each difference."""
        w = self._inverse_slope(self._differences(x))
        total = np.zeros(self.shape, x.dtype)
        for axis, h in enumerate(self._spacing):
            part = 2 * np.delete(w, -1, axis) / h**2
            total[_part(axis, slice(1, None))] += part
            total[_part(axis, slice(None, -1))] += part
        return (total * self._scale).reshape(-1).astype(x.dtype)

    @property
    def _spacing(self) -> np.ndarray:
        return np.broadcast_to(np.asarray(self.voxel_size, float), (3,))[::-1]

    @property
    def _scale(self) -> float:
        return self.strength * float(np.prod(self._spacing))

    def _differences(self, x: np.ndarray) -> list[np.ndarray]:
        x = x.reshape(self.shape)
        return [
            np.diff(x, axis=i, append=x[_part(i, slice(-1, None))]) / h.astype(x.dtype) for i, h in enumerate(self._spacing)
        ]

    def _inverse_slope(self, differences: list[np.ndarray]) -> np.ndarray:
        return 1.0 / np.maximum(np.sqrt(sum(d * d for d in differences)), self.delta)


def _part(axis: int, where: slice) -> tuple[slice, ...]:
    return tuple(where if i == axis else slice(None) for i in range(3))


# -- Small algebra ---------------------------------------------------------------------------------------------------


def _check_sizes(a: Any, x0: np.ndarray | None, **data: np.ndarray | None) -> None:
    m, n = a.shape
    for name, value in data.items():
        if value is None:
            continue
        if np.size(value) != m:
            raise MivolError(f"Found {np.size(value)} values in '{name}', expected {m}, one for each ray of the operator.")
        if not np.isfinite(value).all():
            raise MivolError(
                f"Found a value that is not finite in '{name}' at flat index {int(np.argmin(np.isfinite(value)))}, "
                "expected finite numbers: give unusable rays a weight of 0 and any value."
            )
    if x0 is not None and (np.size(x0) != n or not np.isfinite(x0).all()):
        raise MivolError(
            f"Found a start of {np.size(x0)} values, expected {n} finite ones, one for each voxel of the operator."
        )


def _flat(a: np.ndarray, dtype: Any) -> np.ndarray:
    return np.asarray(a, dtype).reshape(-1)


def _start(a: Any, x0: np.ndarray | None) -> np.ndarray:
    return np.zeros(a.shape[1], a.dtype) if x0 is None else _flat(x0, a.dtype).copy()


def _weights(problem: LeastSquares) -> np.ndarray | None:
    return None if problem.weights is None else _flat(problem.weights, problem.A.dtype)


def _times(weights: np.ndarray | None, v: np.ndarray) -> np.ndarray:
    return v if weights is None else weights * v


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Sum in float64 in a fixed order (BLAS promises neither)."""
    return float(np.sum(a * b, dtype=np.float64))


def _inverse(v: np.ndarray) -> np.ndarray:
    """1 / v, and 0 where v is below 1e-6 of the largest: such rays and voxels are only grazed, and are left alone."""
    floor = 1e-6 * float(np.max(v, initial=0.0))
    return np.where(v > floor, 1.0 / np.where(v > floor, v, 1.0), 0.0).astype(v.dtype)


#: Methods by name. ``run(problem, state=None, **options)``.
SOLVERS: dict[str, Solver] = {
    "pcg": Solver(
        conjugate_gradients,
        LeastSquares,
        needs="A and its exact transpose; weights, x >= 0 and a prior if wanted",
        promises="the objective never rises; without bounds and prior, the least error in the energy norm at each step",
        citation="Hestenes & Stiefel 1952; Polak & Ribiere 1969; Bertsekas 1982; preconditioner Erdogan & Fessler 1999",
    ),
    "cgls": Solver(
        _cgls,
        LeastSquares,
        needs="A and its exact transpose",
        promises="the least residual over the Krylov space of each iteration; stopping early regularises",
        citation="Hestenes & Stiefel 1952; Paige & Saunders 1982",
    ),
    "sirt": Solver(
        _sirt,
        LeastSquares,
        needs="A with entries >= 0 and its transpose",
        promises="converges to a least-squares solution weighted by 1 / (ray length)",
        citation="Gregor & Benson 2008",
    ),
    "os-sart": Solver(
        ordered_subsets_sart,
        LeastSquares,
        needs="A with entries >= 0, its transpose, n_views and subset(views)",
        promises="n_subsets times SIRT's progress at first; a limit cycle on inconsistent data, which decay shrinks",
        citation="Andersen & Kak 1984; Wang & Jiang 2004",
    ),
    "ml-tr": Solver(
        transmission_likelihood,
        PoissonCounts,
        needs="A with entries >= 0 and its transpose; counts, blank and background in quanta",
        promises="the negative log-likelihood never rises; x >= 0; no logarithm of a count is taken",
        citation="Nuyts et al. 1998; Erdogan & Fessler 1999",
    ),
}
