"""Iterative solvers of line integrals: conjugate gradients, algebraic reconstruction, maximum likelihood of counts.

References: Hestenes & Stiefel 1952 and Paige & Saunders 1982 (CGLS); Polak & Ribiere 1969; Bertsekas 1982 (projected descent
with a diagonal metric); Andersen & Kak 1984 (SART); Gregor & Benson 2008 (SIRT); Wang & Jiang 2004 (ordered subsets); Nuyts et
al. 1998, Phys. Med. Biol. 43, 729 (ML-TR); Erdogan & Fessler 1999, Phys. Med. Biol. 44, 2835 (separable surrogates, optimum
curvature).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mivol.errors import MivolError
from mivol.optim.projections.linear_problems import (
    GRAZED,
    LeastSquares,
    PoissonCounts,
    SmoothedTV,
    SolverState,
    apply_weights,
    blocks,
    dot,
    flat_weights,
    flatten,
    invert_sums,
    map_blocks,
    ray_lengths,
    start_field,
    weighting,
)

Weighting = Callable[[np.ndarray], np.ndarray]
"""From a residual (m,) to the weighted residual."""


def ordered_subsets_sart(
    problem: LeastSquares, state: SolverState | None = None, n_subsets: int = 10, relaxation: float = 1.0, decay: float = 0.99
) -> Iterator[SolverState]:
    """Simultaneous algebraic reconstruction over subsets of views, one sweep of all subsets per iteration.

    ``x <- P(x + lambda C_s A_s^T R_s (b_s - A_s x))`` with ``R_s = 1 / (A_s 1)`` and ``C_s = 1 / (A_s^T 1)``. lambda falls by
    ``decay`` after each sweep; P is the projection onto x >= 0, if requested. Subset s holds every ``n_subsets``-th view. The
    subsets follow in golden-section order, so successive subsets have distant directions. One subset is SIRT.

    Args:
        n_subsets: 1 to the number of views.
        relaxation: lambda of the first sweep, in (0, 2).
        decay: in (0, 1]; a decay below 1 shrinks the limit cycle of inconsistent data, but stops before convergence.

    Operator: entries of at least 0; more than one subset needs ``n_views`` and ``subset(views)``.
    Weights: only weights of 0 matter (they exclude a ray). A prior is refused.
    Cost per iteration: one A and one A^T, and once one more A and A^T for the sums; memory: ``n_subsets`` fields.
    """
    check_sweeps(problem, n_subsets, relaxation, decay)
    a = problem.A
    subsets = _blocks(problem, n_subsets)
    if state is None:
        state = SolverState(start_field(a, problem.x0), 0, np.nan, np.nan)
    while True:
        x, norm2 = state.x.copy(), 0.0
        strength = np.asarray(relaxation * decay**state.iteration, x.dtype)
        for block in subsets:
            r = (block.b - block.a @ x) * block.used
            norm2 += dot(r, r)
            change = block.a.T @ (block.per_ray * r)
            change *= block.per_voxel
            change *= strength
            x += change
            if problem.nonnegative:
                np.maximum(x, 0, out=x)
        state = SolverState(x, state.iteration + 1, norm2 / 2, float(np.sqrt(norm2)))
        yield state


def check_sweeps(problem: LeastSquares, n_subsets: int = 1, relaxation: float = 1.0, decay: float = 1.0) -> None:
    """Check the arguments of :func:`ordered_subsets_sart`.

    Raises:
        MivolError: a prior, relaxation or decay outside the domain, or an invalid number of subsets.
    """
    if problem.prior is not None:
        raise MivolError(
            "found a prior with SIRT or OS-SART, expected none: use pcg or ml-tr, which minimise a penalised objective."
        )
    if not 0 < relaxation < 2 or not 0 < decay <= 1:
        raise MivolError(f"found relaxation {relaxation} and decay {decay}, expected 0 < relaxation < 2 and 0 < decay <= 1.")
    n_views = getattr(problem.A, "n_views", None)
    if n_subsets != 1 and (n_views is None or not 1 <= n_subsets <= n_views):
        raise MivolError(
            f"found {n_subsets} subsets of {n_views or 'no'} views, expected 1 to the number of views, and an operator with "
            "n_views and subset(views)."
        )


def sirt(problem: LeastSquares, state: SolverState | None = None, relaxation: float = 1.0) -> Iterator[SolverState]:
    """SART with one subset and constant relaxation."""
    return ordered_subsets_sart(problem, state, 1, relaxation, 1.0)


def sart(
    problem: LeastSquares, state: SolverState | None = None, relaxation: float = 1.0, decay: float = 0.99
) -> Iterator[SolverState]:
    """SART with a subset for each view (Andersen and Kak); one sweep over all views per iteration."""
    return ordered_subsets_sart(problem, state, getattr(problem.A, "n_views", 1), relaxation, decay)


@dataclass(frozen=True, eq=False)
class _Block:
    a: Any
    b: np.ndarray
    used: np.ndarray
    per_ray: np.ndarray
    per_voxel: np.ndarray


def _blocks(problem: LeastSquares, n_subsets: int) -> list[_Block]:
    a = problem.A
    chord = ray_lengths(a)
    views = [None] if n_subsets == 1 else [np.arange(s, a.n_views, n_subsets) for s in golden_order(n_subsets)]
    return [_block(problem, v, chord) for v in views]


def _block(problem: LeastSquares, views: np.ndarray | None, chord: np.ndarray) -> _Block:
    a = problem.A if views is None else problem.A.subset(views)

    def part(data: np.ndarray) -> np.ndarray:
        rays = flatten(data, a.dtype)
        return rays if views is None else rays.reshape(problem.A.n_views, -1)[views].reshape(-1)

    used = np.ones(a.shape[0], a.dtype) if problem.weights is None else (part(problem.weights) > 0).astype(a.dtype)
    per_ray = used * invert_sums(part(chord))
    return _Block(a, part(problem.b), used, per_ray, invert_sums(a.T @ used))


def golden_order(n: int) -> np.ndarray:
    """A permutation of 0..n-1 with distant neighbours."""
    return np.argsort(np.argsort(np.arange(n) * (np.sqrt(5) - 1) / 2 % 1.0))


def projected_cg(problem: LeastSquares, state: SolverState | None = None, precondition: bool = True) -> Iterator[SolverState]:
    """Preconditioned conjugate gradients on the (weighted, penalised) least squares.

    Without bounds and prior this is linear CG (CGLS if not preconditioned). Otherwise it is Polak-Ribiere CG on the free voxels
    (x > 0, or pushed up by the gradient). A step that would leave the domain is projected onto the domain, and followed to the
    minimum of the majoriser along the projected direction. If the projected direction does not descend, the diagonally scaled
    gradient replaces the direction; its projection always descends. The objective therefore never rises. The length of the
    step before its projection comes from every eighth view: it decides where the step meets the domain, not how far it goes.

    Unknown gains are eliminated (:class:`mivol.tomography.rings.PixelGains`): the objective is that of the best gains.

    Preconditioner: ``diag(A^T W A 1 + separable majoriser of the prior)^-1`` (SQS). Voxels that no ray crosses keep ``x0``.
    Cost per iteration: one A and one A^T, and an eighth of an A for a projected step (one more A with fewer than 16 views).
    """
    a = problem.A
    weights, weigh = flat_weights(problem), weighting(problem)
    sample = _Sample.of(problem, weights)
    # Unknown gains only lower the curvature: the diagonal still majorises.
    data_diagonal = a.T @ apply_weights(weights, ray_lengths(a)) if precondition else None
    if state is None:
        x = start_field(a, problem.x0)
        if problem.nonnegative:
            x = np.maximum(x, 0)
        r = flatten(problem.b, a.dtype) - a @ x
        state = _ls_state(problem, x, 0, r, {"residual": r})
    elif "residual" not in state.memory:
        state = replace(state, memory={"residual": flatten(problem.b, a.dtype) - a @ state.x})
    problem = replace(problem, x0=None)  # the state holds the volume now
    while True:
        found = _direction(problem, state, data_diagonal, weigh)
        if found is None:
            return
        direction, g = found["direction"], found["gradient"]
        step = _descend(problem, weigh, sample, state.x, g, direction)
        if step is None and "direction" in state.memory:
            # Seldom: so the scaled gradient is computed again, where keeping it would cost another field.
            diagonal = _add_majoriser(problem, state.x, np.zeros_like(g), data_diagonal)
            step = _descend(problem, weigh, sample, state.x, g, _scale_descent(problem, state.x, g, diagonal))
        if step is None:
            return
        x, r = _move(problem, state.x, step[0]), state.memory["residual"] - step[1]
        state = _ls_state(problem, x, state.iteration + 1, r, {"residual": r, **found})
        yield state


def _direction(
    problem: LeastSquares, state: SolverState, data_diagonal: np.ndarray | None, weigh: Weighting
) -> dict[str, np.ndarray] | None:
    """The conjugate direction, and memory for the next direction; None at the minimum."""
    x, memory = state.x, state.memory
    g = problem.A.T @ -weigh(memory["residual"])
    direction = _scale_descent(problem, x, g, _add_majoriser(problem, x, g, data_diagonal))
    gz = -dot(g, direction)
    if not gz > 0:
        return None
    if "direction" in memory:
        beta = np.asarray(max(0.0, (gz + dot(memory["gradient"], direction)) / float(memory["gz"])), x.dtype)

        def add_last(part: slice) -> None:
            last = beta * memory["direction"][part]
            if problem.nonnegative:
                last *= _is_free(x[part], g[part])
            direction[part] += last

        map_blocks(add_last, len(x))
    return {"direction": direction, "gradient": g, "gz": np.asarray(gz)}


def _add_majoriser(problem: LeastSquares, x: np.ndarray, g: np.ndarray, data_diagonal: np.ndarray | None) -> np.ndarray:
    """Add the gradient of the prior to ``g``; return the diagonal of the majoriser, 1 without a preconditioner."""
    diagonal = np.ones_like(g) if data_diagonal is None else data_diagonal.copy()
    if problem.prior:
        problem.prior.add_derivatives(x, g, None if data_diagonal is None else diagonal)
    return diagonal


def _is_free(x: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Whether voxels may move along the negative gradient, with 0 as bound."""
    free = x > 0
    free |= g < 0
    return free


def _scale_descent(problem: LeastSquares, x: np.ndarray, g: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """The negative gradient over the diagonal, written into ``diagonal``; 0 at voxels grazed or held by the bound."""
    floor = np.asarray(GRAZED * float(np.max(diagonal, initial=0.0)) or 1, g.dtype)

    def scale(part: slice) -> None:
        step = diagonal[part]
        free = step > floor
        if problem.nonnegative:
            free &= _is_free(x[part], g[part])
        np.maximum(step, floor, out=step)
        np.divide(g[part], step, out=step)
        np.negative(step, out=step)
        step *= free

    map_blocks(scale, len(x))
    return diagonal


def _move(problem: LeastSquares, x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """``x + step``, written into ``step``."""

    def add(part: slice) -> None:
        step[part] += x[part]
        if problem.nonnegative:
            np.maximum(step[part], 0, out=step[part])  # rounding: the step ends in the domain

    map_blocks(add, len(x))
    return step


SAMPLED, MIN_SAMPLES = 8, 2
"""Every how many views give the length of a step before its projection, and the fewest of them."""


def _descend(
    problem: LeastSquares,
    weigh: Weighting,
    sample: _Sample | None,
    x: np.ndarray,
    g: np.ndarray,
    direction: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """(step, A step) to the minimum along ``direction``, projected onto the domain; None if the direction does not descend."""
    rough = sample and sample.length(problem, x, g, direction)
    if rough is None:
        lowest = _minimum(problem, weigh, x, g, direction)
        if lowest is None:
            return None
        rough, image = lowest
        if not problem.nonnegative or _stays_nonnegative(x, rough, direction):
            length = np.asarray(rough, x.dtype)
            return length * direction, length * image
    step, rough = np.empty_like(direction), np.asarray(rough, x.dtype)

    def project(part: slice) -> None:
        np.multiply(direction[part], rough, out=step[part])
        step[part] += x[part]
        np.maximum(step[part], 0, out=step[part])
        step[part] -= x[part]

    map_blocks(project, len(x))
    lowest = _minimum(problem, weigh, x, g, step)
    if lowest is None:
        return None
    # Beyond length 1 the projected step could leave the domain again.
    length = np.asarray(min(1.0, lowest[0]), x.dtype)
    if length < 1:
        map_blocks(lambda part: np.multiply(step[part], length, out=step[part]), len(x))
    return step, length * lowest[1]


def _stays_nonnegative(x: np.ndarray, length: float, direction: np.ndarray) -> bool:
    length = np.asarray(length, x.dtype)
    return all((x[part] + length * direction[part]).min() >= 0 for part in blocks(len(x)))


def _minimum(
    problem: LeastSquares, weigh: Weighting, x: np.ndarray, g: np.ndarray, d: np.ndarray
) -> tuple[float, np.ndarray] | None:
    """Length to the majoriser's minimum along ``d``, and ``A d``; None if ``d`` does not descend."""
    image = problem.A @ d
    length = _length(problem, x, g, d, dot(image, weigh(image)))
    return None if length is None else (length, image)


def _length(problem: LeastSquares, x: np.ndarray, g: np.ndarray, d: np.ndarray, data_curvature: float) -> float | None:
    curvature = data_curvature + (problem.prior.curvature(x, d) if problem.prior else 0.0)
    slope = dot(g, d)
    return -slope / curvature if slope < 0 and curvature > 0 else None


@dataclass(frozen=True, eq=False)
class _Sample:
    """Every eighth view of a problem with a domain, for the length of steps that leave the domain."""

    a: Any
    weights: np.ndarray | None
    all_over_some: float

    @classmethod
    def of(cls, problem: LeastSquares, weights: np.ndarray | None) -> _Sample | None:
        """The sample; None without a domain, or with fewer than 16 views."""
        views = getattr(problem.A, "n_views", 1)
        if not problem.nonnegative or views < SAMPLED * MIN_SAMPLES:
            return None
        some = np.arange(SAMPLED // 2, views, SAMPLED)
        used = None if weights is None else weights.reshape(views, -1)[some].reshape(-1)
        return cls(problem.A.subset(some), used, views / len(some))

    def length(self, problem: LeastSquares, x: np.ndarray, g: np.ndarray, d: np.ndarray) -> float | None:
        """Length to the minimum along ``d`` by the sample's curvature; None if ``d`` ascends, or stays in the domain."""
        image = self.a @ d
        length = _length(problem, x, g, d, self.all_over_some * dot(image, apply_weights(self.weights, image)))
        return None if length is None or _stays_nonnegative(x, length, d) else length


def cgls(problem: LeastSquares, state: SolverState | None = None) -> Iterator[SolverState]:
    """:func:`projected_cg` without a preconditioner."""
    return projected_cg(problem, state, precondition=False)


def _ls_state(problem: LeastSquares, x: np.ndarray, iteration: int, r: np.ndarray, memory: dict) -> SolverState:
    norm2 = dot(r, weighting(problem)(r))
    penalty = problem.prior.value(x) if problem.prior else 0.0
    return SolverState(x, iteration, norm2 / 2 + penalty, float(np.sqrt(norm2)), memory)


def transmission_likelihood(problem: PoissonCounts, state: SolverState | None = None) -> Iterator[SolverState]:
    """Maximum likelihood of transmission counts (ML-TR) with Erdogan and Fessler's optimum curvatures.

    ``x <- max(0, x - grad / (A^T(c . A 1) + separable majoriser of the prior))`` with the gradient ``A^T(mu (y / yhat
    - 1))``, ``mu = blank e^-l``, ``yhat = mu + background``, ``l = A x``, and for each ray the smallest curvature c whose
    parabola at l lies above the negative log-likelihood for all l >= 0. Nuyts' ML-TR is the same with c = mu, which
    may overshoot. The objective never rises. ``objective`` is the sum of ``yhat - y log yhat`` (and the prior);
    ``residual_norm`` is Pearson's ``|(y - yhat) / sqrt(yhat)|``.

    Cost per iteration: one A and two A^T.
    """
    a, prior = problem.A, problem.prior
    counts = _Counts.of(problem)
    chord = ray_lengths(a)
    if state is None:
        x = np.maximum(start_field(a, problem.x0), 0)
        state = counts.state(x, 0, a @ x)
    elif "line" not in state.memory:
        state = replace(state, memory={"line": a @ state.x})
    while True:
        x, line = state.x, state.memory["line"].astype(np.float64)
        gradient = a.T @ counts.slope(line).astype(a.dtype)
        bound = a.T @ (counts.optimum_curvature(line) * chord).astype(a.dtype)
        if prior:
            prior.add_derivatives(x, gradient, bound)
        x = np.maximum(x - gradient * invert_sums(bound), 0)
        state = counts.state(x, state.iteration + 1, a @ x)
        yield state


@dataclass(frozen=True, eq=False)
class _Counts:
    """Counts of rays, float64 (m,), and the negative log-likelihood h(l) of a ray's line integral l."""

    y: np.ndarray
    blank: np.ndarray
    background: np.ndarray
    prior: SmoothedTV | None
    used: np.ndarray | float = 1.0

    @classmethod
    def of(cls, problem: PoissonCounts) -> _Counts:
        y = flatten(problem.counts, np.float64)
        rates = (np.broadcast_to(np.asarray(v, float).reshape(-1), y.shape) for v in (problem.blank, problem.background))
        return cls(y, *rates, problem.prior, 1.0 if problem.used is None else flatten(problem.used, np.float64))

    def slope(self, line: np.ndarray) -> np.ndarray:
        """h'(l)."""
        mu = self.blank * np.exp(-line)
        return self.used * mu * (self.y / (mu + self.background) - 1.0)

    def optimum_curvature(self, line: np.ndarray) -> np.ndarray:
        """Erdogan & Fessler 1999, Eq. 28: ``2 (h(0) - h(l) + l h'(l)) / l^2``, at least 0, and ``h''(0)`` at l = 0."""
        y, blank, background = self.y, self.blank, self.background
        mu = blank * np.exp(-line)
        h0 = blank + background - y * np.log(blank + background)
        h = mu + background - y * np.log(mu + background)
        at_zero = blank * (1.0 - y * background / (blank + background) ** 2)
        # The bracket is of order l^2 h'' and its terms of order h: below l = 1e-3 fewer than 9 digits of float64 remain,
        # and the limit h''(0) has an error of l h'''/3 only.
        small = line < 1e-3
        l2 = np.where(small, 1.0, line * line)
        # At an unused ray the slope is 0 and the other terms have no meaning.
        return self.used * np.maximum(np.where(small, at_zero, 2.0 * (h0 - h + line * self.slope(line)) / l2), 0.0)

    def state(self, x: np.ndarray, iteration: int, line: np.ndarray) -> SolverState:
        """State of the solver with a field whose line integrals are ``line``."""
        expected = self.blank * np.exp(-line.astype(np.float64)) + self.background
        # y log(yhat) -> 0 for y = 0 even where yhat underflows.
        log_expected = np.log(np.maximum(expected, np.finfo(float).tiny))
        objective = float(np.sum(self.used * (expected - self.y * log_expected))) + (self.prior.value(x) if self.prior else 0.0)
        pearson = float(np.sqrt(np.sum(self.used * (self.y - expected) ** 2 / np.maximum(expected, np.finfo(float).tiny))))
        return SolverState(x, iteration, objective, pearson, {"line": line})
