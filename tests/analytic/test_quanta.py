"""Numbers of quanta from readings, and pixels that have none: dead and saturated ones."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.tomography.preprocess import correct_transmission, count_quanta, fit_air, to_line_integrals

GAIN, READ_NOISE = 2.5, 4.0


def fields() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Readings, two flats and two darks of 3 x 4 pixels, whose sample variances are exactly those of the model.

    Two numbers m +- d have a variance of 2 d^2: d^2 = v / 2.
    """
    light = np.full((3, 4), 1000.0)
    sign = np.array([1.0, -1.0])[:, None, None]
    darks = 50.0 + sign * READ_NOISE / np.sqrt(2) * np.ones((3, 4))
    flats = 50.0 + light + sign * np.sqrt((READ_NOISE**2 + GAIN * light) / 2)
    readings = 50.0 + np.linspace(1.0, 0.1, 24).reshape(2, 3, 4) * light
    return readings, flats, darks


def test_quanta_have_the_moments_of_readings() -> None:
    """Mean and variance of a Poisson number are one: (reading - dark) / gain + s quanta stand for a variance of the reading of
    gain (reading - dark) + read noise^2, in quanta^2, where s = read noise^2 / gain^2."""
    readings, flats, darks = fields()
    quanta = count_quanta(readings, flats, darks)
    signal = readings - 50.0
    np.testing.assert_allclose(quanta.counts, (GAIN * signal + READ_NOISE**2) / GAIN**2, rtol=1e-12)
    np.testing.assert_allclose(quanta.blank, 1000.0 / GAIN, rtol=1e-12)
    np.testing.assert_allclose(quanta.background, READ_NOISE**2 / GAIN**2, rtol=1e-12)
    assert quanta.used.all()
    assert quanta.blank.shape == readings.shape
    transmission = correct_transmission(readings, flats, darks)
    np.testing.assert_allclose(
        transmission.value, (quanta.counts - quanta.background) / quanta.blank, rtol=1e-12, err_msg="another transmission"
    )


def test_dead_and_saturated_pixels_are_not_used() -> None:
    """A pixel without light in the flats, one whose flats are saturated, and one reading that is: weight 0, and the gain is
    that of the others. Darks above the signal leave a count of 0, not less."""
    readings, flats, darks = fields()
    flats[:, 0, 1] = 49.0
    flats[:, 2, 2] += 9000.0
    readings[1, 1, 1] = 5000.0
    readings[0, 0, 0] = -200.0
    quanta = count_quanta(readings, flats, darks, saturation=5000.0)
    lost = np.zeros(readings.shape, bool)
    lost[:, 0, 1] = lost[:, 2, 2] = lost[1, 1, 1] = True
    np.testing.assert_array_equal(quanta.used, ~lost)
    assert (quanta.counts[lost] == 0).all()
    assert (quanta.blank > 0).all()
    assert quanta.counts[0, 0, 0] == 0
    y, weights = to_line_integrals(correct_transmission(readings, flats, darks, saturation=5000.0))
    assert (y[lost] == 0).all()
    assert (weights[lost] == 0).all()
    assert (weights[~lost][1:] > 0).all()
    np.testing.assert_allclose(quanta.background, READ_NOISE**2 / GAIN**2, rtol=1e-12)


def test_a_detector_that_is_mostly_dead_is_refused() -> None:
    readings, flats, darks = fields()
    flats[:, :, :2] = 10.0
    with pytest.raises(MivolError, match=r"at detector pixel \(0, 0\) and at half of all"):
        correct_transmission(readings, flats, darks)


def test_flats_without_noise_count_nothing() -> None:
    readings, flats, darks = fields()
    with pytest.raises(MivolError, match="scatter no more than darks"):
        count_quanta(readings, np.repeat(flats.mean(0, keepdims=True), 2, 0), darks)


def test_air_leaves_out_dead_pixels() -> None:
    """The same line through the others; without any of them there is no air."""
    t = np.full((1, 2, 8), 0.9)
    t[0, 1, 0] = np.nan
    np.testing.assert_allclose(fit_air(t, 2), 0.9, rtol=1e-15)
    t[0, 1, 1] = np.inf
    with pytest.raises(MivolError, match="at an edge of row 1 of view 0"):
        fit_air(t, 2)
