"""Scattered light by the consistency of the views, in computed scans that know it."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_refused

from mivol.optim.projections.scatter import FLOOR, fit_scatter
from mivol.tomography.geometry import ConeBeam, FlatDetector, ParallelBeam
from mivol.tomography.phantoms import random_ellipsoids

COLUMNS, VIEWS, QUANTA = 96, 60, 1e4
BEAM = ParallelBeam(np.arange(VIEWS) * np.pi / VIEWS, (1, COLUMNS), 2.2 / COLUMNS)


def scattered(amplitude: float) -> np.ndarray:
    """Scattered light (1, columns), a lopsided dome."""
    u = np.linspace(-1, 1, COLUMNS)
    return amplitude * (1 - 0.6 * u**2 + 0.2 * u)[None]


def scan(beam: FlatDetector, light: np.ndarray, radius: float = 0.92, seed: int = 1) -> tuple[np.ndarray, ...]:
    """Line integrals with scattered light and noise, their weights, and exact ones."""
    exact = random_ellipsoids(40, 3, radius).project(beam)
    exact = 2.5 * exact / exact.max()
    counts = np.maximum(np.random.default_rng(seed).poisson(QUANTA * (np.exp(-exact) + light)), 1.0)
    return -np.log(counts / QUANTA), counts, exact


def test_a_dome_of_scattered_light_is_found_within_its_deviation(variant_rgb) -> None:
    """Errors stay below three deviations in each column, and line integrals come to a quarter of their error or less: noise of
    a pixel remains. The deviation is that of the method and of the noise, which adds less than as much."""
    truth = scattered(0.05)
    y, weights, exact = scan(BEAM, truth)
    found = fit_scatter(BEAM, y, weights)
    assert found.is_needed
    assert np.abs((found.light - truth) / found.sigma).max() < 3
    assert (found.sigma < 2 * FLOOR).all()
    straight, variances = found.subtract(y, weights)
    assert np.sqrt(np.mean((straight - exact) ** 2)) < 0.25 * np.sqrt(np.mean((y - exact) ** 2))
    h = 1e-5
    up, down = (found.subtract(y + step, weights)[0] for step in (h, -h))
    np.testing.assert_allclose(variances, weights * ((up - down) / (2 * h)) ** -2.0, rtol=1e-4)


def test_no_scattered_light_is_none(variant_rgb) -> None:
    y, weights, _ = scan(BEAM, scattered(0.0))
    found = fit_scatter(BEAM, y, weights)
    assert not found.is_needed
    assert np.abs(found.light / found.sigma).max() < 3


def test_the_noise_of_a_pixel_counts_up_to_a_bound(variant_rgb) -> None:
    """The mean of a logarithm is corrected for a variance of at most a quarter: half a quantum and two quanta are alike."""
    y, weights, _ = scan(BEAM, scattered(0.05))
    lights = [fit_scatter(BEAM, y, np.full_like(weights, quanta)).light for quanta in (0.5, 2.0)]
    np.testing.assert_array_equal(*lights)


def test_air_that_scattered_light_brightens_is_no_light(variant_rgb) -> None:
    """Views divided by the air: the light is 1 less what is scattered there. Flats of .8 of the exposure cancel."""
    truth = scattered(0.05)
    y, weights, exact = scan(BEAM, truth)
    edge = np.r_[:4, COLUMNS - 4 : COLUMNS]
    light = 0.8 * np.exp(-y)
    air = light[..., edge].mean()
    found = fit_scatter(BEAM, -np.log(light / air), weights, 4)
    assert np.abs((found.light - truth * 0.8 / air) / found.sigma).max() < 3
    straight, _ = found.subtract(-np.log(light / air), weights)
    # All line integrals would be wrong by the logarithm of the light, .026.
    assert found.air == pytest.approx(0.026, abs=0.006)
    assert abs(np.mean(straight - exact)) < 0.01


@pytest.mark.slow
def test_scattered_light_of_a_cone_beam(variant_rgb) -> None:
    """Along rows and columns."""
    beam = ConeBeam(np.arange(60) * 2 * np.pi / 60, (24, 48), 6.0, 8.0, 2.9 / 48)
    u, v = np.linspace(-1, 1, 48), np.linspace(-1, 1, 24)[:, None]
    truth = 0.05 * (1 - 0.6 * u**2 + 0.2 * u - 0.3 * v**2)
    y, weights, _ = scan(beam, truth, radius=0.7)
    found = fit_scatter(beam, y, weights)
    assert found.is_needed and np.abs((found.light - truth) / found.sigma).max() < 3


def test_scans_that_do_not_tell_scattered_light_are_refused(variant_rgb) -> None:
    y, weights, _ = scan(BEAM, scattered(0.05), radius=2.0)
    assert_refused("reaches the edges of the detector", fit_scatter, BEAM, y, weights)
    y, weights, _ = scan(BEAM, scattered(0.0))
    assert_refused(r"found scattered light of -.*data\.air", fit_scatter, BEAM, y - np.log(0.8), weights)
    assert_refused("no object", fit_scatter, BEAM, 0 * y, 1e12 * weights)
