"""A small scan as a float64 matrix, which solvers are held against dense algebra on."""

from __future__ import annotations

import itertools

import numpy as np
import oracle_projector

from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts, SolverState
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan

N, VIEWS = 16, 24
GRID = VoxelGrid((1, N, N), (2 / N, 2 / N, 1.0), centre=(0.0, 0.0, -0.25))
BEAM = ParallelBeam(np.arange(VIEWS) * np.pi / VIEWS, (1, N + 4), 2 / N, detector_offset=(-0.25, 0.0))


class Views:
    """A matrix that knows which rows belong to which view."""

    def __init__(self, matrix, n_views: int):
        self.matrix, self.n_views = matrix, n_views
        self.shape, self.dtype = matrix.shape, matrix.dtype

    def __matmul__(self, x):
        return self.matrix @ x

    @property
    def T(self):
        return self.matrix.T

    def subset(self, views):
        rows = np.arange(self.shape[0]).reshape(self.n_views, -1)[views].reshape(-1)
        return Views(self.matrix[rows], len(views))


def small_scan() -> tuple[Views, np.ndarray, np.ndarray]:
    """Operator, truth, and exact line integrals of the truth's voxels."""
    a = Views(oracle_projector.system_matrix(BEAM, GRID), VIEWS)
    truth = shepp_logan().voxelise(GRID, 8).astype(float).reshape(-1)
    return a, truth, a @ truth


def run(name: str, problem, n: int, state: SolverState | None = None, **options) -> list[SolverState]:
    return list(itertools.islice(SOLVERS[name].run(problem, state=state, **options), n))


def problem_for(name: str, scan, seed: int = 0, prior=None, **options):
    """A noisy problem of the kind that the solver wants; two sizes of weights, some rays unused."""
    a, _, b = scan
    rng = np.random.default_rng(seed)
    if SOLVERS[name].problem is PoissonCounts:
        counts = rng.poisson(2000 * np.exp(-b) + 30).astype(float)
        return PoissonCounts(a, counts, 2000.0, 30.0, prior=prior)
    weights = rng.choice([0.0, 1.0, 4.0], size=b.shape)
    return LeastSquares(a, b + 0.02 * rng.normal(size=b.shape), weights, prior=prior, **options)
