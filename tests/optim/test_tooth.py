"""Real and simulated projections: noise, logarithm, drift and rotation axis, and the tooth's held-out views."""

from __future__ import annotations

import functools
import importlib.util
import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from false_alarms import Estimate, assert_same_mean, assert_same_variance, assert_within, fresh
from refusals import assert_refused
from scipy import stats

from mivol.errors import MivolError
from mivol.files import ProjectionData, read_projections, read_volume
from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import random_ellipsoids
from mivol.tomography.preprocess import Transmission, correct_transmission, fit_light_drift, normalise_air, to_line_integrals
from mivol.tomography.projector import Projector
from mivol.tomography.rotation_axis import axis_from_mirrors, axis_from_moments, axis_from_reconstructions, find_axis
from mivol.validate.statistics import Moments

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "tooth.py"


def script():
    spec = importlib.util.spec_from_file_location("tooth_script", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def readings(t: np.ndarray, rng: np.random.Generator, light: float = 4000.0, gain: float = 2.0, dark: float = 100.0):
    """What a detector of ``gain`` (reading per quantum) and read noise 3 reads behind a transmission of ``t``."""
    return gain * rng.poisson(light / gain * t) + dark + rng.normal(0, 3.0, t.shape)


@pytest.fixture
def simulated():
    """121 views of ellipsoids, 1.495 degrees apart: no two are half a turn apart exactly. The axis at 35.30 of 64."""
    return simulate(fresh(0))


@functools.cache
def simulate(seed: int):
    angles = np.radians(1.495 * np.arange(121))
    beam = ParallelBeam(angles, (1, 64), pitch=1.0, axis_offset=35.3 - 31.5)
    y = 0.12 * random_ellipsoids(6, seed=8).scaled(26.0).project(beam)
    rng = np.random.default_rng(seed)
    ones = np.ones((20, 1, 64))
    transmission = correct_transmission(readings(np.exp(-y), rng), readings(ones, rng), readings(0 * ones, rng))
    return angles, y, transmission


# -- Noise and logarithm ------------------------------------------------------------------------------------------------


@pytest.mark.statistical
def test_variance_of_the_transmission_is_measured():
    """Rationale: 4000 repeated scans of one row of wedges; their spread is the variance that one scan claims.

    Expected: the variance of 4000 draws is known to sqrt(2 / 4000) = 2.2 %, and the mean over 64 pixels to 0.3 %; flats of
    64 pixels x 20 give the gain to sqrt(2 / (19 * 64)) = 4 %, and 4000 of them to 0.06 %. To first order in the noise, of
    which the darkest wedge has the most: 1 %.
    """
    rng = np.random.default_rng(fresh(1))
    t = np.linspace(0.02, 1.0, 64).reshape(1, 1, 64)
    ones = np.ones((20, 1, 64))
    repeats = [correct_transmission(readings(t, rng), readings(ones, rng), readings(0 * ones, rng)) for _ in range(4000)]
    values = np.array([r.value for r in repeats])
    claimed = np.mean([r.variance for r in repeats], axis=0)
    assert_same_variance(values, claimed, what="transmissions")
    ratio = claimed / values.var(axis=0, ddof=1)
    assert_within(ratio.mean() - 1, 0.01 + 6 * math.sqrt(2 / 4000 / 64), chance=2 * stats.norm.sf(6), what="variances")
    # The bias of a ratio with a noisy denominator is T var(flat) / n / flat^2 = 2.5e-5.
    assert_same_mean(Moments.from_values(values), t, rounding=2.5e-5, what="transmissions")


@pytest.mark.statistical
def test_weights_make_residuals_of_unit_size(simulated):
    """sqrt(w) (y - truth) has variance 1: 7744 values know it to sqrt(2 / 7744) = 1.6 %, the flats' gain to 4 %, and
    errors of the flats that all views share to 6 %: 7.3 % together, of which 6 are allowed (4.3 % were measured)."""
    _, truth, transmission = simulated
    y, weights = to_line_integrals(transmission)
    z = np.sqrt(weights) * (y - truth)
    assert_within(np.mean(z**2) - 1, 6 * 0.073, chance=2 * stats.norm.sf(6), what="squared residuals")


def test_no_light_has_weight_0():
    """Hard case 39."""
    t = Transmission(np.array([[[0.5, 1e-4, -0.02, 0.0, np.nan, np.inf]]]), np.full((1, 1, 6), 1e-4))
    y, weights = to_line_integrals(t)
    assert np.isfinite(y).all()
    assert np.isfinite(weights).all()
    assert y[0, 0, 0] == pytest.approx(np.log(2))
    assert weights[0, 0, 0] == pytest.approx(0.25 / 1e-4)
    assert (weights[0, 0, 1:] == 0).all()


def test_brighter_than_the_light_stays_negative():
    """Hard case 40."""
    y, weights = to_line_integrals(Transmission(np.full((1, 1, 1), 1.1), np.full((1, 1, 1), 1e-4)))
    assert y == pytest.approx(-np.log(1.1))
    assert weights == pytest.approx(1.21 / 1e-4)


def test_air_is_normalised_without_touching_the_object(simulated):
    """A light that fades by 3 % and tilts by 1 % over the scan: divided away up to the noise of 2 x 6 air pixels."""
    _, truth, transmission = simulated
    fade = 1 - 0.03 * np.linspace(0, 1, 121)[:, None, None] * (1 + np.linspace(-0.5, 0.5, 64) / 3)
    assert truth[..., :6].max() == truth[..., -6:].max() == 0
    restored = normalise_air(Transmission(transmission.value * fade, transmission.variance * fade**2), 6)
    straight = normalise_air(transmission, 6)
    np.testing.assert_allclose(restored.value, straight.value, rtol=1e-3)
    assert np.abs(straight.value[..., :6].mean() - 1) < 1e-2
    assert_refused("2 to 32 of 64", normalise_air, transmission, 33)


def test_drift_is_fitted_to_each_pixel():
    rng = np.random.default_rng(0)
    times, offset, slope = np.linspace(-1, 1, 9), rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
    drift = offset + times[:, None, None] * slope
    weights = rng.uniform(0.5, 2, drift.shape)
    weights[:, 0, 0] = 0
    weights[1:, 0, 1] = 0
    fit = fit_light_drift(drift, weights, times)
    known = np.array([[False, False, True], [True, True, True]])
    np.testing.assert_allclose(fit.eval(times)[:, known], drift[:, known], atol=1e-12)
    assert (fit.eval(times)[:, ~known] == 0).all()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda r, f, d: (r, f[..., :5], d), "one detector"),
        (lambda r, f, d: (r, f[:0], d), "at least 1"),
        (lambda r, f, d: (r, d, f), r"no light, or too much, at detector pixel \(0, 0\)"),
    ],
)
def test_unusable_fields_are_refused(change, sentence):
    rng = np.random.default_rng(0)
    r, f, d = rng.normal(50, 1, (3, 1, 9)), rng.normal(90, 1, (4, 1, 9)), rng.normal(10, 1, (4, 1, 9))
    assert_refused(sentence, correct_transmission, *change(r, f, d))


# -- Axis -------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.statistical
def test_axis_is_found_three_ways(simulated):
    """Simulated axis at 35.30, noise of 2 % a pixel: as near as each method claims, and its claims are small.

    Mirrors: a line through 12 pairs has 10 degrees of freedom; cubic interpolation errs by 0.03. Moments: 121 views less 3
    unknowns; the flats' errors, 1 / sqrt(2000 * 20) of a pixel's light, are the same in all views, so that no scatter shows
    them: they move the centre of mass by sqrt(sum (i - 31.5)^2) / mass times that. Both lose 0.04 to the noise's logarithm.
    The misfit of reconstructions is bumpy on 64 pixels: -0.09 +- 0.04 over 8 seeds, so 0.35 is 7 of these away.
    """
    angles, _, transmission = simulated
    y, weights = to_line_integrals(transmission)
    mirrors, moments = axis_from_mirrors(y, angles), axis_from_moments(y, angles)
    flats = np.sqrt(np.sum((np.arange(64) - 31.5) ** 2) / 2000 / 20) / y.sum(axis=-1).mean()
    assert_same_mean(Estimate(mirrors.column, mirrors.uncertainty**2, 10), 35.3, rounding=0.04, what="mirrors")
    assert_same_mean(Estimate(moments.column, moments.uncertainty**2 + flats**2, 118), 35.3, rounding=0.04, what="moments")
    assert flats < 0.2
    assert moments.uncertainty < 0.4
    assert_within(find_axis(y, weights, angles).column - 35.3, 0.35, chance=stats.norm.sf(7), what="misfits")
    assert_refused("no least misfit", axis_from_reconstructions, y, weights, angles, start=29.0, width=1.0)


def test_mirrors_on_both_sides_of_half_a_turn():
    """Over 183 degrees opposite views lie between views: without noise the axis to 0.03 (interpolation)."""
    angles = np.radians(1.22 * np.arange(151))
    beam = ParallelBeam(angles, (1, 96), pitch=1.0, axis_offset=44.25 - 47.5)
    y = random_ellipsoids(1, seed=4).scaled(40.0).project(beam)
    assert abs(axis_from_mirrors(y, angles, n_views=9).column - 44.25) < 0.03


def test_mirror_pairs_need_half_a_turn():
    assert_refused("use axis_from_moments", axis_from_mirrors, np.ones((3, 1, 8)), np.radians([0.0, 40.0, 90.0]))
    with pytest.raises(MivolError, match="view 1 without contrast"):
        axis_from_mirrors(np.array([[[0.0, 1.0, 0.0]], [[0.0, 0.0, 0.0]]]), np.radians([0.0, 180.0]))


# -- The tooth ----------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_tooth_axis_and_held_out_views_small(data_dir):
    """One of the two rows, columns summed by 2. The axis is known: others put it at column 296 of 640, to half a pixel.

    Expected: a column of 2 has its middle at 2 c + 0.5; views that were held out are predicted to within twice the
    noise that the flats show (the edges' interference fringes are no absorption and stay), and the air to that noise,
    of which 10 flats tell 1 / sqrt(2 * 9 * 80) = 3 %.
    """
    tooth = script()
    scan = tooth.binned(read_projections(data_dir / "ct_projections" / "tooth.h5"), 2)
    scan = ProjectionData(scan.projections[:, :1], scan.flats[:, :1], scan.darks[:, :1], scan.angles)
    fit = tooth.reconstruct(scan, air=50, size=190, strength=1000.0, rounds=(12, 8, 12))
    assert abs(2 * fit.axis.column + 0.5 - 296) < 0.5
    figures = tooth.figures_of(fit, 0.0)
    assert figures["held_out_views"] == 18
    assert figures["held_out_residual_over_noise"] < 2.0
    assert figures["held_out_air_residual_over_noise"] == pytest.approx(1.0, abs=0.15)
    enamel, outside = fit.x[0, 100:140, 146:152].mean(), fit.x[0, :20].mean()
    assert enamel > 50 * outside


@pytest.mark.slow
def test_the_script_finds_the_axis_and_draws(data_dir, tmp_path):
    """In a process of its own, with columns summed by 2, whose middles are at 2 c + 0.5."""
    data = str(data_dir / "ct_projections" / "tooth.h5")
    command = [sys.executable, str(SCRIPT), data, "--bin", "2", "--tv", "1000", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    figures = json.loads(done.stdout)
    assert abs(2 * figures["axis_column"] + 0.5 - 296) < 0.5
    assert figures["held_out_residual_over_noise"] < 2
    assert (tmp_path / "tooth.png").stat().st_size > 50_000


def test_cone_beam_of_a_ct_volume_is_inverted(data_dir):
    """A measured volume as truth, projected at twice the resolution that it is reconstructed at (no inverse crime)."""
    fine = read_volume(data_dir / "ct_mri" / "tooth.nrrd").values[..., 0].astype(np.float32)
    fine = fine[: fine.shape[0] // 4 * 4, : fine.shape[1] // 4 * 4, : fine.shape[2] // 4 * 4]
    fine = fine.reshape(*(n for k in fine.shape for n in (k // 2, 2))).mean((1, 3, 5)) / 255
    coarse = fine.reshape(*(n for k in fine.shape for n in (k // 2, 2))).mean((1, 3, 5))
    beam = ConeBeam(np.arange(48) * 2 * np.pi / 48, (48, 32), 200.0, 300.0, pitch=3.0)
    y = Projector(beam, VoxelGrid(fine.shape, 1.0)) @ fine
    problem = LeastSquares(Projector(beam, VoxelGrid(coarse.shape, 2.0)), y, nonnegative=True)
    states = list(itertools.islice(SOLVERS["pcg"].run(problem), 15))
    error = np.linalg.norm(states[-1].x - coarse.ravel()) / np.linalg.norm(coarse)
    # Rays 2 apart at the axis and voxels of 2: what limits it are the edges. 0.2 is what published tests of this kind ask.
    assert error < 0.2
