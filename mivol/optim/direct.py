"""Methods of one step, in the form of solvers: filtered back-projection in parallel and in cone beams.

They need the scanner and not only its matrix, take no weights but 0 (pixels that are not used are bridged), and clip nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from mivol.errors import MivolError
from mivol.optim.linear_problems import LeastSquares, dot, flat, times, weights_of
from mivol.optim.solver import State
from mivol.tomography.filtered import check_circle, check_parallel, feldkamp, filtered_backprojection
from mivol.tomography.preprocess import bridge_gaps
from mivol.tomography.projector import Projector

Method = Callable[[Projector, np.ndarray, str, float], np.ndarray]


def fbp(problem: LeastSquares, state: State | None = None, window: str = "ram-lak", cutoff: float = 1.0) -> Iterator[State]:
    """:func:`~mivol.tomography.filtered.filtered_backprojection` of a parallel beam: one state, and no more."""
    return _once(filtered_backprojection, problem, state, window, cutoff)


def fdk(problem: LeastSquares, state: State | None = None, window: str = "ram-lak", cutoff: float = 1.0) -> Iterator[State]:
    """:func:`~mivol.tomography.filtered.feldkamp` of a circular cone beam: one state, and no more."""
    return _once(feldkamp, problem, state, window, cutoff)


def check_fbp(problem: LeastSquares, **options: object) -> None:
    """Refuse what :func:`fbp` cannot do.

    Raises:
        MivolError: a prior, another beam, or directions that are missing.
    """
    check_prior(problem)
    check_parallel(problem.A)


def check_fdk(problem: LeastSquares, **options: object) -> None:
    """Refuse what :func:`fdk` cannot do.

    Raises:
        MivolError: a prior, another trajectory than a circle, or directions that are missing.
    """
    check_prior(problem)
    check_circle(problem.A)


def check_prior(problem: LeastSquares) -> None:
    """Refuse a prior, which a method of one step has no use for.

    Raises:
        MivolError: there is one.
    """
    if problem.prior is not None:
        raise MivolError("found a prior with filtered back-projection, expected none: use pcg, or a window and a cutoff.")


def _once(method: Method, problem: LeastSquares, state: State | None, window: str, cutoff: float) -> Iterator[State]:
    a = problem.A
    check_prior(problem)
    if state is not None:
        return
    y = np.asarray(problem.b, float).reshape(a.projection_shape)
    if problem.weights is not None:
        y = bridge_gaps(y, np.reshape(problem.weights, a.projection_shape))
    x = method(a, y, window, cutoff).reshape(-1)
    r = flat(problem.b, a.dtype) - a @ x
    norm2 = dot(r, times(weights_of(problem), r))
    yield State(x, 1, norm2 / 2, float(np.sqrt(norm2)))
