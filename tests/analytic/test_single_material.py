"""Corrections of one material: Paganin's filter by its own forward formula and by units, hardening by a known spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_refused

from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import random_ellipsoids
from mivol.tomography.preprocess import Transmission
from mivol.tomography.projector import Projector
from mivol.tomography.single_material import filter_phase, fit_hardening, phase_length


def test_length_of_the_phase_filter() -> None:
    """Water at 20 keV, 100 mm behind: lambda = 0.6199 Angstrom, delta / beta = 1000: sqrt(.1 x 1000 x 6.199e-11 / 4 pi)."""
    assert phase_length(1000, 100, 20) == pytest.approx(2.2211e-5, rel=1e-4)
    assert phase_length(1000, 400, 20) == pytest.approx(2 * phase_length(1000, 100, 20))
    assert phase_length(1000, 100, 80) == pytest.approx(phase_length(1000, 100, 20) / 2)


def test_phase_filter_inverts_the_transport_of_intensity() -> None:
    """Of cosines that continue as mirror images, T - a laplacian T is T (1 + a k^2): the filter returns T to rounding."""
    rows, columns, length = 12, 20, phase_length(500, 50, 15) / 2e-6
    r, c = (np.arange(n) + 0.5 for n in (rows, columns))
    thick = 0.6 + 0.2 * np.cos(3 * np.pi * r / rows)[:, None] * np.cos(5 * np.pi * c / columns)
    square = (3 * np.pi / rows) ** 2 + (5 * np.pi / columns) ** 2
    measured = thick + length**2 * square * (thick - 0.6)
    found, said = filter_phase(Transmission(measured[None], np.full((1, rows, columns), 1e-4)), 500, 50, 15, 2)
    assert said == pytest.approx(length)
    np.testing.assert_allclose(found.value[0], thick, atol=1e-12)
    # White noise keeps the mean square of the filter.
    k = [(np.pi * np.arange(n) / n) ** 2 for n in (rows, columns)]
    share = np.mean(1 / (1 + length**2 * (k[0][:, None] + k[1])) ** 2)
    np.testing.assert_allclose(found.variance, 1e-4 * share)


def test_phase_filter_keeps_unused_pixels_and_refuses_wrong_units() -> None:
    value = np.full((1, 4, 9), 0.5)
    value[0, 1, 3] = np.nan
    light = Transmission(value, np.full(value.shape, 1e-4))
    found, _ = filter_phase(light, 100, 10, 20, 1)
    assert np.isnan(found.value[0, 1, 3]) and np.isnan(found.value).sum() == 1
    np.testing.assert_allclose(found.value[np.isfinite(found.value)], 0.5)
    assert_refused(r"phase filter of 702 pixels.*distance in mm", filter_phase, light, 1000, 100, 20, 0.0316228)
    assert_refused("phase filter of 7.02e-05 pixels", filter_phase, light, 1, 1e-6, 20, 1)


COLUMNS = 64
BEAM = ParallelBeam(np.arange(48) * np.pi / 48, (1, COLUMNS), 1 / 32)


def two_discs() -> np.ndarray:
    """Path lengths (views, 1, columns) through discs of radius .5 and .25."""
    at, length = BEAM.u, 0
    for x, y, radius in ((-0.2, 0.1, 0.5), (0.6, -0.3, 0.25)):
        s = x * np.cos(BEAM.angles) + y * np.sin(BEAM.angles)
        length = length + 2 * np.sqrt(np.maximum(radius**2 - (at - s[:, None]) ** 2, 0))
    return length[:, None]


@pytest.mark.parametrize("scatter", [0.0, 0.05])
def test_hardened_lines_become_straight(variant_rgb, scatter: float) -> None:
    """Two energies of one material, absorption 4 and 1.5: line integrals bend, and become proportional to the length."""
    a, length = Projector(BEAM, VoxelGrid((1, COLUMNS, COLUMNS), 1 / 32)), two_discs()
    y = -np.log(0.5 * np.exp(-4 * length) + 0.5 * np.exp(-1.5 * length) + np.where(length > 0, scatter, 0))
    found = fit_hardening(a, y, np.ones(y.shape), 3, scatter > 0)
    straight, weights = found.straighten(y, np.ones(y.shape))

    def bend(values: np.ndarray) -> float:
        inside = length > 0.1
        line = (values * length)[inside].sum() / (length[inside] ** 2).sum()
        return float(np.sqrt(np.mean((values[inside] / line - length[inside]) ** 2)))

    # Path lengths from voxels err by about a tenth of a voxel; what is left of the bend is a quarter of it at most.
    assert bend(straight) < 0.25 * bend(y)
    assert found.misfit < 0.6
    # The weights follow the slope of the curve.
    h = 1e-5
    up, down = (found.straighten(y + step, weights)[0] for step in (h, -h))
    np.testing.assert_allclose(weights, ((up - down) / (2 * h)) ** -2.0, rtol=1e-5)


def test_scattered_light_of_one_energy_is_found(variant_rgb) -> None:
    """A twentieth of the light behind the object: the polynomial can replace a part of it, the rest is within .015."""
    a, length = Projector(BEAM, VoxelGrid((1, COLUMNS, COLUMNS), 1 / 32)), two_discs()
    y = -np.log(np.exp(-2.5 * length) + np.where(length > 0, 0.05, 0))
    found = fit_hardening(a, y, np.ones(y.shape), 2, True)
    assert abs(found.scatter - 0.05) < 0.015
    dark = found.straighten(np.full((1, 1, 1), 5.0), np.ones((1, 1, 1)))
    assert dark[1].item() == 0


@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("photons", [3e3, 1e5])
def test_straight_lines_need_no_polynomial(variant_rgb, photons: float, degree: int) -> None:
    """One energy, one material: no polynomial lowers the misfit."""
    a, length = Projector(BEAM, VoxelGrid((1, COLUMNS, COLUMNS), 1 / 32)), two_discs()
    counts = np.random.default_rng(1).poisson(photons * np.exp(-1.5 * length)).astype(float)
    assert not fit_hardening(a, -np.log(counts / photons), counts, degree, False).is_needed
    assert_refused("no material", fit_hardening, a, 0 * length, np.ones(length.shape), 2, False)


def test_several_materials_are_refused(variant_rgb) -> None:
    """Forty ellipsoids of one energy: a polynomial of degree 3 lowers the misfit, and spoils the line integrals."""
    beam = ParallelBeam(np.arange(48) * np.pi / 48, (1, COLUMNS))
    y = random_ellipsoids(40, 11, 26).project(beam)
    y /= y.max()
    a = Projector(beam, VoxelGrid((1, COLUMNS, COLUMNS)))
    assert_refused("whose slope falls to .* several materials", fit_hardening, a, y, np.ones(y.shape), 3, False)
