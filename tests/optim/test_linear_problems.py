"""Problems of line integrals: refusals; total variation with its derivatives, majorisers and scale of a scan's noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import assert_refused
from small_scan import GRID, run

from mivol.optim.projections import linear_problems
from mivol.optim.projections.linear_problems import (
    LeastSquares,
    PoissonCounts,
    SmoothedTV,
    expected_residual_norm,
    scale_tv_to_noise,
)
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector


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
    assert_refused(sentence, build, scan[0], scan[2])


@pytest.mark.parametrize("at_once", [linear_problems.KERNEL_VOXELS, 37])
def test_prior_derivatives_and_majorisers(monkeypatch: pytest.MonkeyPatch, at_once: int) -> None:
    """Gradient against differences; the majoriser lies above the penalty, and its separable form above that. A kernel takes all
    voxels, or 37, which end within a line."""
    monkeypatch.setattr(linear_problems, "KERNEL_VOXELS", at_once)
    shape, rng = (4, 5, 6), np.random.default_rng(5)
    prior = SmoothedTV(shape, 0.7, 0.4, (1.0, 0.5, 2.0))
    x, p = rng.normal(size=(2, 120))
    h = 1e-6
    slope = (prior.value(x + h * p) - prior.value(x - h * p)) / (2 * h)
    gradient, diagonal = np.zeros((2, 120))
    prior.add_derivatives(x, gradient, diagonal)
    assert gradient @ p == pytest.approx(slope, rel=1e-7)
    for scale in (0.01, 0.3, 3.0):
        d = scale * p
        bound = prior.value(x) + gradient @ d + 0.5 * prior.curvature(x, d)
        assert prior.value(x + d) <= bound + 1e-12
        assert prior.curvature(x, d) <= diagonal @ (d * d) + 1e-12
    # Where neighbours move against each other, (p - q)^2 is 2 p^2 + 2 q^2.
    d = (-1.0) ** np.indices(shape).sum(0).reshape(-1)
    assert prior.curvature(x, d) == pytest.approx(diagonal @ (d * d), rel=1e-12)


def test_total_variation_of_a_step_is_its_area_times_height():
    """delta -> 0: a step of height 3 across an area of 5 x 4 voxels of 0.5 x 2 (y, z); a quarter of 3 * 5 * 0.5 * 4 * 2."""
    x = np.zeros((4, 5, 6))
    x[:, :, 3:] = 3.0
    prior = SmoothedTV(x.shape, 0.25, 1e-9, (3.0, 0.5, 2.0))
    assert prior.value(x.reshape(-1)) == pytest.approx(0.25 * 3 * 5 * 0.5 * 4 * 2, rel=1e-8)


def scan_in(unit: float) -> tuple[Projector, np.ndarray, np.ndarray]:
    """A cylinder in a small parallel scan whose lengths are ``unit`` times as large, and weights; rays miss middles."""
    grid = VoxelGrid((8, 16, 16), unit / 8)
    a = Projector(ParallelBeam(np.arange(24) * np.pi / 24, (14, 34), 0.7 * unit / 8), grid)
    y_of, x_of = np.meshgrid(grid.axis("y"), grid.axis("x"), indexing="ij")
    y = a @ np.broadcast_to(1.5 / unit * (np.hypot(x_of, y_of) < 0.6 * unit), grid.shape).astype("f")
    return a, y, 1e4 * np.exp(-y)


def test_noise_scaled_tv_is_independent_of_units() -> None:
    """The same scan in metres and in millimetres: the strength is 1 / length, the slope 1 / length^2. Kernels are float32."""
    metres, millimetres = (scale_tv_to_noise(*scan_in(unit), 1.0, 0.5) for unit in (1.0, 1000.0))
    assert millimetres.strength == pytest.approx(metres.strength / 1e3, rel=1e-5)
    assert millimetres.delta == pytest.approx(metres.delta / 1e6, rel=1e-5)


def test_noise_scaled_tv_balances_the_noise() -> None:
    """A hundred times the quanta pull ten times as hard; the pull of a voxel is that of its rays, within the spread of chords.

    At weights of 1 it is sqrt(sum_i a_ij^2); rays at 0.7 of a voxel sample the two factors of 2/3 and 0.70 to a few per cent.
    """
    a, y, weights = scan_in(1.0)
    few, many = scale_tv_to_noise(a, y, weights, 1.0, 0.5), scale_tv_to_noise(a, y, 100 * weights, 2.0, 0.5)
    assert many.strength == pytest.approx(20 * few.strength, rel=1e-5)
    assert many.delta == pytest.approx(few.delta, rel=1e-5)
    inner = 4 * 256 + np.arange(100, 156, 5)
    pulls = [np.linalg.norm((a @ np.eye(1, a.shape[1], j, dtype="f")[0]).astype(float)) for j in inner]
    found = scale_tv_to_noise(a, y, np.ones_like(y), 1.0, 0.5).strength * (1 / 8) ** 2
    assert abs(found / np.median(pulls) - 1) < 0.1
    # Where the whole grid holds one value, that is the mean.
    full = a @ np.full(a.grid.shape, 1.5, "f")
    assert scale_tv_to_noise(a, full, weights, 1.0, 1.0).delta / 8 == pytest.approx(1.5, rel=1e-5)


def test_expected_norm_of_pure_noise() -> None:
    """Weighted residuals count rays that are used, plain ones add variances, and Pearson's count rays."""
    a = np.ones((4, 2))
    squares = LeastSquares(a, np.ones(4), np.array([4.0, 0.0, 0.25, 1.0]))
    assert expected_residual_norm(squares, "pcg") == pytest.approx(np.sqrt(3))
    assert expected_residual_norm(squares, "sirt") == pytest.approx(np.sqrt(0.25 + 4 + 1))
    assert expected_residual_norm(replace(squares, weights=None), "pcg") == pytest.approx(2)
    counts = PoissonCounts(a, np.ones(4), 2.0)
    assert expected_residual_norm(counts, "ml-tr") == pytest.approx(2)
    assert expected_residual_norm(replace(counts, used=np.array([True, True, False, True])), "ml-tr") == pytest.approx(
        np.sqrt(3)
    )


def test_edges_are_counted() -> None:
    """Of a step across half of a grid, one layer of slopes is an edge."""
    a, y, weights = scan_in(1.0)
    x = np.zeros(a.grid.shape)
    x[..., 8:] = 1.0
    prior = replace(scale_tv_to_noise(a, y, weights, 1.0, 1.0), delta=7.9)
    assert prior.share_of_edges(x) == 1 / 16
    assert replace(prior, delta=8.1).share_of_edges(x) == 0
