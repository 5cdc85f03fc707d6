"""Solvers of line integrals by name: iterative solvers, and filtered back-projection in the same form.

Conventions. Iterative solvers take any operator with ``@`` and ``.T``. Filtered back-projection needs the geometry of the scan.
It bridges pixels of weight 0, ignores all other weights, and clips nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from mivol.errors import MivolError
from mivol.optim.projections.iterative import (
    cgls,
    check_sweeps,
    ordered_subsets_sart,
    projected_cg,
    sart,
    sirt,
    transmission_likelihood,
)
from mivol.optim.projections.linear_problems import (
    LeastSquares,
    PoissonCounts,
    Solver,
    SolverState,
    apply_weights,
    dot,
    flat_weights,
    flatten,
)
from mivol.tomography.filtered import check_circle, check_parallel, feldkamp, filtered_backprojection
from mivol.tomography.preprocess import interpolate_gaps
from mivol.tomography.projector import Projector

FilteredBackprojection = Callable[[Projector, np.ndarray, str, float], np.ndarray]


def fbp(
    problem: LeastSquares, state: SolverState | None = None, window: str = "ram-lak", cutoff: float = 1.0
) -> Iterator[SolverState]:
    """:func:`~mivol.tomography.filtered.filtered_backprojection` of a parallel beam, as a single state."""
    return _backproject_once(filtered_backprojection, problem, state, window, cutoff)


def fdk(
    problem: LeastSquares, state: SolverState | None = None, window: str = "ram-lak", cutoff: float = 1.0
) -> Iterator[SolverState]:
    """:func:`~mivol.tomography.filtered.feldkamp` of a circular cone beam, as a single state."""
    return _backproject_once(feldkamp, problem, state, window, cutoff)


def check_fbp(problem: LeastSquares, **options: object) -> None:
    """Check that :func:`fbp` can solve a problem.

    Raises:
        MivolError: a prior, another beam, or missing directions.
    """
    check_prior(problem)
    check_parallel(problem.A)


def check_fdk(problem: LeastSquares, **options: object) -> None:
    """Check that :func:`fdk` can solve a problem.

    Raises:
        MivolError: a prior, another trajectory than a circle, or missing directions.
    """
    check_prior(problem)
    check_circle(problem.A)


def check_prior(problem: LeastSquares) -> None:
    """Check that a problem has no prior, which a direct method cannot use.

    Raises:
        MivolError: a prior.
    """
    if problem.prior is not None:
        raise MivolError("found a prior with filtered back-projection, expected none: use pcg, or a window and a cutoff.")


def _backproject_once(
    method: FilteredBackprojection, problem: LeastSquares, state: SolverState | None, window: str, cutoff: float
) -> Iterator[SolverState]:
    a = problem.A
    check_prior(problem)
    if state is not None:
        return
    y = np.asarray(problem.b, float).reshape(a.projection_shape)
    if problem.weights is not None:
        y = interpolate_gaps(y, np.reshape(problem.weights, a.projection_shape))
    x = method(a, y, window, cutoff).reshape(-1)
    r = flatten(problem.b, a.dtype) - a @ x
    norm2 = dot(r, apply_weights(flat_weights(problem), r))
    yield SolverState(x, 1, norm2 / 2, float(np.sqrt(norm2)))


SOLVERS: dict[str, Solver] = {
    "pcg": Solver(
        projected_cg,
        LeastSquares,
        promises="the objective never rises; without bounds and prior, the least error in the energy norm at each step",
        cites=("hestenes_1952", "erdogan_1999"),
    ),
    "cgls": Solver(
        cgls,
        LeastSquares,
        promises="the least residual over the Krylov space of each iteration; early stopping regularises",
        cites=("hestenes_1952",),
    ),
    "sirt": Solver(
        sirt,
        LeastSquares,
        promises="converges to a least-squares solution weighted by 1 / (ray length)",
        cites=("andersen_1984",),
        check=check_sweeps,
    ),
    "sart": Solver(
        sart,
        LeastSquares,
        promises="the fastest first sweeps; a limit cycle on inconsistent data, which relaxation and decay shrink",
        cites=("andersen_1984",),
        check=check_sweeps,
    ),
    "os-sart": Solver(
        ordered_subsets_sart,
        LeastSquares,
        promises="n_subsets times SIRT's progress at first; a limit cycle on inconsistent data, which decay shrinks",
        cites=("andersen_1984",),
        check=check_sweeps,
    ),
    "ml-tr": Solver(
        transmission_likelihood,
        PoissonCounts,
        promises="the negative log-likelihood never rises; x >= 0; takes no logarithm of counts",
        cites=("nuyts_1998", "erdogan_1999"),
    ),
}
"""Iterative solvers by name. ``run(problem, state=None, **options)``."""

DIRECT: dict[str, Solver] = {
    "fbp": Solver(
        fbp,
        LeastSquares,
        promises="exact for many views without noise; linear, so values below 0 remain",
        cites=("kak_1988",),
        check=check_fbp,
    ),
    "fdk": Solver(
        fdk,
        LeastSquares,
        promises="exact in the source's plane for many views without noise; linear, so values below 0 remain",
        cites=("feldkamp_1984", "parker_1982"),
        check=check_fdk,
    ),
}
"""Direct solvers by name. ``run(problem, state=None, window=..., cutoff=...)``; the problem's operator is a projector."""

ALL_SOLVERS: dict[str, Solver] = SOLVERS | DIRECT
"""Solvers available in files."""
