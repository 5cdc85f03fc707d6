"""Algebraic reconstruction: each ray's residual is spread back over the voxels that it crosses.

References: Andersen & Kak 1984 (SART); Gregor & Benson 2008 (SIRT); Wang & Jiang 2004 (ordered subsets).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mivol.errors import MivolError
from mivol.optim.linear_problems import LeastSquares, dot, first_field, flat, inverse
from mivol.optim.solver import State


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
    check_sweeps(problem, n_subsets, relaxation, decay)
    a = problem.A
    blocks = _blocks(problem, n_subsets)
    if state is None:
        state = State(first_field(a, problem.x0), 0, np.nan, np.nan)
    while True:
        x, norm2 = state.x, 0.0
        strength = np.asarray(relaxation * decay**state.iteration, x.dtype)
        for block in blocks:
            r = (block.b - block.a @ x) * block.used
            norm2 += dot(r, r)
            x = x + strength * block.per_voxel * (block.a.T @ (block.per_ray * r))
            if problem.nonnegative:
                x = np.maximum(x, 0)
        state = State(x, state.iteration + 1, norm2 / 2, float(np.sqrt(norm2)))
        yield state


def check_sweeps(problem: LeastSquares, n_subsets: int = 1, relaxation: float = 1.0, decay: float = 1.0) -> None:
    """Refuse what :func:`ordered_subsets_sart` cannot do; arguments as there.

    Raises:
        MivolError: a prior, steps outside their domain, or subsets that the views cannot be shared out to.
    """
    if problem.prior is not None:
        raise MivolError(
            "Found a prior with SIRT or OS-SART, expected none: use pcg or ml-tr, which minimise a penalised objective."
        )
    if not 0 < relaxation < 2 or not 0 < decay <= 1:
        raise MivolError(f"Found relaxation {relaxation} and decay {decay}, expected 0 < relaxation < 2 and 0 < decay <= 1.")
    n_views = getattr(problem.A, "n_views", None)
    if n_subsets != 1 and (n_views is None or not 1 <= n_subsets <= n_views):
        raise MivolError(
            f"Found {n_subsets} subsets of {n_views or 'no'} views, expected at least 1, at most as many as views, "
            "and an operator with n_views and subset(views)."
        )


def sirt(problem: LeastSquares, state: State | None = None, relaxation: float = 1.0) -> Iterator[State]:
    """One subset, and a relaxation that stays."""
    return ordered_subsets_sart(problem, state, 1, relaxation, 1.0)


def sart(problem: LeastSquares, state: State | None = None, relaxation: float = 1.0, decay: float = 0.99) -> Iterator[State]:
    """A subset for each view, as Andersen and Kak have it; one sweep over all views per iteration."""
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
    chord = a @ np.ones(a.shape[1], a.dtype)
    views = [None] if n_subsets == 1 else [np.arange(s, a.n_views, n_subsets) for s in _golden_order(n_subsets)]
    return [_block(problem, v, chord) for v in views]


def _block(problem: LeastSquares, views: np.ndarray | None, chord: np.ndarray) -> _Block:
    a = problem.A if views is None else problem.A.subset(views)

    def part(data: np.ndarray) -> np.ndarray:
        rays = flat(data, a.dtype)
        return rays if views is None else rays.reshape(problem.A.n_views, -1)[views].reshape(-1)

    used = np.ones(a.shape[0], a.dtype) if problem.weights is None else (part(problem.weights) > 0).astype(a.dtype)
    per_ray = used * inverse(part(chord))
    return _Block(a, part(problem.b), used, per_ray, inverse(a.T @ used))


def _golden_order(n: int) -> np.ndarray:
    """A permutation of 0..n-1 whose neighbours are far apart."""
    return np.argsort(np.argsort(np.arange(n) * (np.sqrt(5) - 1) / 2 % 1.0))
