"""Invalid problems of line integrals are refused."""

from __future__ import annotations

import numpy as np
import pytest
from small_scan import GRID, run

from mivol.errors import MivolError
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts
from mivol.optim.projections.smoothed_tv import SmoothedTV


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda a, b: LeastSquares(a, b[:-1]), "expected 480, one for each ray"),
        (lambda a, b: LeastSquares(a, np.where(np.arange(480) == 7, np.nan, b)), "'b' at flat index 7"),
        (lambda a, b: LeastSquares(a, b, -np.ones_like(b)), "negative weight"),
        (lambda a, b: LeastSquares(a, b, x0=np.zeros(3)), "one for each voxel"),
        (lambda a, b: PoissonCounts(a, b - 10, 5.0), "counts >= 0"),
        (lambda a, b: run("os-sart", LeastSquares(a, b), 1, n_subsets=99), "99 subsets of 24 views"),
        (lambda a, b: run("os-sart", LeastSquares(a, b), 1, relaxation=2.0), "relaxation 2.0"),
        (lambda a, b: run("sirt", LeastSquares(a, b, prior=SmoothedTV(GRID.shape, 1.0, 1.0)), 1), "use pcg or ml-tr"),
    ],
)
def test_invalid_problems_are_refused(scan, build, sentence):
    with pytest.raises(MivolError, match=sentence):
        build(scan[0], scan[2])
