"""Maximum likelihood of counts of quanta behind an absorber (ML-TR).

References: Nuyts et al. 1998, Phys. Med. Biol. 43, 729; Erdogan & Fessler 1999, Phys. Med. Biol. 44, 2835 (optimum curvature).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mivol.optim.linear_problems import Penalty, PoissonCounts, first_field, flat, inverse
from mivol.optim.solver import State


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
    counts = _Counts.of(problem)
    chord = a @ np.ones(a.shape[1], a.dtype)
    if state is None:
        x = np.maximum(first_field(a, problem.x0), 0)
        state = counts.state(x, 0, a @ x)
    while True:
        x, line = state.x, state.memory["line"].astype(np.float64)
        gradient = a.T @ counts.slope(line).astype(a.dtype)
        bound = a.T @ (counts.optimum_curvature(line) * chord).astype(a.dtype)
        if prior:
            gradient, bound = gradient + prior.gradient(x), bound + prior.separable(x)
        x = np.maximum(x - gradient * inverse(bound), 0)
        state = counts.state(x, state.iteration + 1, a @ x)
        yield state


@dataclass(frozen=True, eq=False)
class _Counts:
    """Counts of rays, float64 (m,), and the negative log-likelihood h(l) of a ray's line integral l."""

    y: np.ndarray
    blank: np.ndarray
    background: np.ndarray
    prior: Penalty | None
    used: np.ndarray | float = 1.0

    @classmethod
    def of(cls, problem: PoissonCounts) -> _Counts:
        y = flat(problem.counts, np.float64)
        rates = (np.broadcast_to(np.asarray(v, float).reshape(-1), y.shape) for v in (problem.blank, problem.background))
        return cls(y, *rates, problem.prior, 1.0 if problem.used is None else flat(problem.used, np.float64))

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
        # The bracket is of order l^2 h'' and its terms of order h: below l = 1e-3 less than 9 digits of float64 are left,
        # and h''(0), the limit, is off by l h'''/3 only.
        small = line < 1e-3
        l2 = np.where(small, 1.0, line * line)
        # At a ray that is not used the slope is 0 and the rest means nothing.
        return self.used * np.maximum(np.where(small, at_zero, 2.0 * (h0 - h + line * self.slope(line)) / l2), 0.0)

    def state(self, x: np.ndarray, iteration: int, line: np.ndarray) -> State:
        """Where the solver stands with a field whose line integrals are ``line``."""
        expected = self.blank * np.exp(-line.astype(np.float64)) + self.background
        # y log(yhat) -> 0 for y = 0 even where yhat underflows.
        log_expected = np.log(np.maximum(expected, np.finfo(float).tiny))
        objective = float(np.sum(self.used * (expected - self.y * log_expected))) + (self.prior.value(x) if self.prior else 0.0)
        pearson = float(np.sqrt(np.sum(self.used * (self.y - expected) ** 2 / np.maximum(expected, np.finfo(float).tiny))))
        return State(x, iteration, objective, pearson, {"line": line})
