"""SIRT and ordered subsets: their step is their formula, and they recover what was scanned without noise."""

from __future__ import annotations

import numpy as np
import pytest
from small_scan import run

from mivol.optim.projections.linear_problems import LeastSquares


@pytest.mark.parametrize("name", ["sirt", "os-sart"])
def test_algebraic_methods_recover_consistent_data(scan, name):
    a, truth, b = scan
    options = {"n_subsets": 6, "decay": 1.0} if name == "os-sart" else {}
    states = run(name, LeastSquares(a, b, nonnegative=True), 150, **options)
    error = np.linalg.norm(states[-1].x - truth) / np.linalg.norm(truth)
    assert error < {"sirt": 0.10, "os-sart": 0.02}[name]
    assert states[-1].residual_norm < 1e-2 * states[0].residual_norm


def test_sirt_step_is_its_formula(scan):
    a, _, b = scan
    dense = a.matrix.toarray()
    used = (np.arange(len(b)) % 5 > 0).astype(float)
    problem = LeastSquares(a, b, weights=3 * used)
    first, second = run("sirt", problem, 2, relaxation=0.7)
    length = dense.sum(1)
    rays = np.where(length > 0, used / np.where(length > 0, length, 1), 0)
    voxels = 1 / (dense.T @ used)
    expected = first.x + 0.7 * voxels * (dense.T @ (rays * (b - dense @ first.x)))
    # Rays that only graze the grid (length below 1e-6 of the longest) are left out by the solver: none here.
    np.testing.assert_allclose(second.x, expected, atol=1e-12)


def test_one_subset_of_os_sart_is_sirt_and_many_are_faster(scan):
    a, truth, b = scan
    problem = LeastSquares(a, b)
    sirt, one = run("sirt", problem, 3)[-1], run("os-sart", problem, 3, n_subsets=1, decay=1.0)[-1]
    np.testing.assert_array_equal(sirt.x, one.x)
    many = run("os-sart", problem, 3, n_subsets=8)[-1]
    assert np.linalg.norm(many.x - truth) < 0.8 * np.linalg.norm(sirt.x - truth)


def test_sart_takes_a_view_at_a_time(scan):
    """Andersen and Kak's update is that of ordered subsets of one view each."""
    a, _, b = scan
    problem = LeastSquares(a, b)
    each, all_views = run("sart", problem, 2, relaxation=0.5)[-1], run("os-sart", problem, 2, n_subsets=24, relaxation=0.5)[-1]
    np.testing.assert_array_equal(each.x, all_views.x)
