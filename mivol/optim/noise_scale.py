"""What noise says about how to solve: the norm of a residual of noise alone, and how strong a prior balances it.

References: Morozov 1966 (discrepancy principle); Rudin, Osher & Fatemi 1992 (total variation whose residual is noise).
"""

from __future__ import annotations

import numpy as np

from mivol.optim.linear_problems import LeastSquares, PoissonCounts, flat
from mivol.optim.smoothed_tv import SmoothedTV
from mivol.tomography.projector import Projector

UNWEIGHTED = ("sirt", "sart", "os-sart")
"""Solvers whose residual has no weights."""

CHORD = 0.47
"""``sum a^2 / sum a`` of the rays that meet a voxel of edge 1, whose share of a trilinear field falls to 0 at its neighbours:
2/3 for the distance along the detector's rows (0.70 in the mean over directions), times 2/3 for that along z. Rays through the
middles of layers alone have the first factor only: their balance is 1.2 times as strong."""


def noise_norm(problem: LeastSquares | PoissonCounts, solver: str) -> float:
    """The norm that a solver's ``residual_norm`` has where the volume is the true one.

    The square of a weighted residual ``r sqrt(w)``, and of Pearson's, has a mean of 1 at each ray that is used; without
    weights the variances are left, ``sum 1 / w``.
    """
    if isinstance(problem, PoissonCounts):
        return float(np.sqrt(np.size(problem.counts) if problem.used is None else np.sum(problem.used)))
    if problem.weights is None:
        return float(np.sqrt(np.size(problem.b)))
    used = problem.weights[problem.weights > 0].astype(np.float64)
    return float(np.sqrt(np.sum(1.0 / used) if solver in UNWEIGHTED else used.size))


def tv_of_noise(a: Projector, y: np.ndarray, weights: np.ndarray, tv: float, delta: float) -> SmoothedTV:
    """Total variation in units of the scan's own noise and values: lengths, quanta and materials do not matter.

    The data pull at a voxel with the slope ``A^T W r``, whose standard deviation from noise is ``sqrt(sum_i w_i a_ij^2)``;
    total variation pulls through each face with at most ``strength dV / h``. At ``tv`` = 1 the two are equal at the median of
    the voxels seen, ``a_ij^2`` taken as ``0.47 h a_ij``. ``delta`` = 1 is a slope of the scan's mean value over one voxel,
    which is ``sum w y c / sum w c^2``, c being a ray's way through the grid.

    Args:
        a: of the views that are fitted.
        y, weights: (views, rows, cols), with variances 1 / weights.
        tv: in parts of the balance.
        delta: in parts of the mean value a voxel.
    """
    edge = float(np.prod(a.grid.voxel_size) ** (1 / 3))
    w = np.asarray(weights, np.float64)
    seen = np.asarray(a.T @ flat(w, a.dtype), np.float64)
    pull = np.sqrt(CHORD * edge * np.median(seen[seen > 0])) if (seen > 0).any() else 0.0
    chord = np.asarray(a @ np.ones(a.shape[1], a.dtype), np.float64).reshape(w.shape)
    mean = abs(float(np.sum(w * y * chord))) / max(float(np.sum(w * chord**2)), np.finfo(float).tiny)
    slope = delta * mean / edge
    return SmoothedTV(a.grid.shape, tv * float(pull) / edge**2, slope or np.finfo(np.float32).tiny, a.grid.voxel_size)
