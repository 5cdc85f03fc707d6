"""Conjugate gradients for line integrals, with bounds and a penalty where they are wanted.

References: Hestenes & Stiefel 1952 and Paige & Saunders 1982 (CGLS); Polak & Ribiere 1969; Bertsekas 1982 (projected descent
with a diagonal metric); Erdogan & Fessler 1999, Phys. Med. Biol. 44, 2835 (separable surrogates).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mivol.optim.linear_problems import LeastSquares, dot, first_field, flat, inverse, times, weights_of
from mivol.optim.solver import State


def projected_cg(problem: LeastSquares, state: State | None = None, precondition: bool = True) -> Iterator[State]:
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
    a = problem.A
    weights = weights_of(problem)
    data_diagonal = a.T @ times(weights, a @ np.ones(a.shape[1], a.dtype)) if precondition else None
    if state is None:
        x = first_field(a, problem.x0)
        if problem.nonnegative:
            x = np.maximum(x, 0)
        r = flat(problem.b, a.dtype) - a @ x
        state = _ls_state(problem, x, 0, r, {"residual": r})
    while True:
        found = _direction(problem, state, data_diagonal, weights)
        if found is None:
            return
        direction, downhill, memory = found
        g = memory["gradient"]
        step = _descend(problem, weights, state.x, g, direction) or _descend(problem, weights, state.x, g, downhill)
        if step is None:
            return
        x, r = state.x + step[0], state.memory["residual"] - step[1]
        if problem.nonnegative:
            x = np.maximum(x, 0)  # rounding only: the step ends in the domain
        state = _ls_state(problem, x, state.iteration + 1, r, {"residual": r, **memory})
        yield state


def _direction(
    problem: LeastSquares, state: State, data_diagonal: np.ndarray | None, weights: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]] | None:
    """The conjugate direction, the scaled downhill one, and what the next direction must know; None at the minimum."""
    x, old, prior = state.x, state.memory, problem.prior
    g = -(problem.A.T @ times(weights, old["residual"]))
    if prior:
        g = g + prior.gradient(x)
    free = (x > 0) | (g < 0) if problem.nonnegative else None
    z = g
    if data_diagonal is not None:
        z = g * inverse(data_diagonal if not prior else data_diagonal + prior.separable(x))
    z = z if free is None else z * free
    gz = dot(g, z)
    if not gz > 0:
        return None
    direction = -z
    if "direction" in old:
        beta = max(0.0, (gz - dot(old["gradient"], z)) / float(old["gz"]))
        direction = direction + np.asarray(beta, x.dtype) * (old["direction"] if free is None else old["direction"] * free)
    return direction, -z, {"direction": direction, "gradient": g, "gz": np.asarray(gz)}


def _descend(
    problem: LeastSquares, weights: np.ndarray | None, x: np.ndarray, g: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """(step, A step) to the minimum along ``direction``, bent on to the domain; None where it does not lead down."""

    def minimum(d: np.ndarray) -> tuple[float, np.ndarray] | None:
        image = problem.A @ d
        curvature = dot(image, times(weights, image)) + (problem.prior.curvature(x, d) if problem.prior else 0.0)
        slope = dot(g, d)
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


def cgls(problem: LeastSquares, state: State | None = None) -> Iterator[State]:
    """The same without a preconditioner."""
    return projected_cg(problem, state, precondition=False)


def _ls_state(problem: LeastSquares, x: np.ndarray, iteration: int, r: np.ndarray, memory: dict) -> State:
    norm2 = dot(r, times(weights_of(problem), r))
    penalty = problem.prior.value(x) if problem.prior else 0.0
    return State(x, iteration, norm2 / 2 + penalty, float(np.sqrt(norm2)), memory)
