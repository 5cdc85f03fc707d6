"""From readings to line integrals, number by number: each formula by hand on a few pixels (float64, rounding only)."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_refused

from mivol.tomography import preprocess
from mivol.tomography.preprocess import (
    LightDrift,
    Transmission,
    calibrate,
    correct_transmission,
    count_quanta,
    to_line_integrals,
)


def test_noise_of_which_the_form_is_known() -> None:
    """As of 10,000 quanta; what is darker than nothing has none."""
    found = preprocess.assume_quantum_noise(np.array([[[0.5, -0.1, 2.0]]]))
    assert found.value.tolist() == [[[0.5, -0.1, 2.0]]] and found.variance.tolist() == [[[0.5e-4, 0.0, 2e-4]]]


DARKS = np.array([[[10.0, 11, 10, 10, 10]], [[12, 13, 12, 12, 12]], [[14, 15, 14, 14, 14]]])
FLATS = np.array([[[100.0, 110, 10, 90, 80]], [[120, 130, 14, 110, 100]]])
READINGS = np.array([[[50.0, 61, 9, 119, 30]], [[5, 70, 8, 120, 40]]])


def test_a_detector_is_calibrated_by_living_pixels() -> None:
    """Darks of 12 that vary by 4; flats that add 98, 88 and 78 and vary by 200; the second pixel is saturated in a flat, the
    third is dead."""
    found = preprocess.calibrate(READINGS, FLATS, DARKS, 120.5)
    assert found.dark.tolist() == [[12, 13, 12, 12, 12]]
    np.testing.assert_array_equal(found.light, [[98, np.nan, np.nan, 88, 78]])
    assert (found.dark_variance, found.gain, found.n_flats, found.n_darks) == (4, pytest.approx(196 / 88), 2, 3)


def test_transmission_and_its_variance() -> None:
    """To first order, with the noise of the detector pooled over its living pixels."""
    found = preprocess.correct_transmission(READINGS, FLATS, DARKS, 131)
    dark, light = np.array([12.0, 13, 12, 12]), np.array([98.0, 107, 88, 78])
    gain = (200 - 4) / light.mean()
    alive = [0, 1, 3, 4]
    signal = READINGS[:, 0, alive] - dark
    t = signal / light
    read = 4 + gain * np.maximum(signal, 0)
    variance = (read + t**2 * (4 + gain * light) / 2 + (1 - t) ** 2 * 4 / 3) / light**2
    np.testing.assert_allclose(found.value[:, 0, alive], t, rtol=1e-14)
    np.testing.assert_allclose(found.variance[:, 0, alive], variance, rtol=1e-14)
    assert np.isnan(found.value[:, 0, 2]).all() and np.isnan(found.variance[:, 0, 2]).all()
    # A reading of exactly the saturation is saturated, and so is a flat.
    at = preprocess.correct_transmission(READINGS, FLATS - 15, DARKS, 120)
    assert np.isnan(at.value[:, 0, 3]).tolist() == [False, True]
    known = preprocess.calibrate(READINGS, FLATS, DARKS, 130)
    np.testing.assert_array_equal(np.isnan(known.light), [[False, True, True, False, False]])
    assert known.saturation == 130 and preprocess.calibrate(READINGS, FLATS, DARKS).saturation == np.inf


@pytest.mark.parametrize(
    ("readings", "flats", "darks", "sentence"),
    [
        (READINGS[0], FLATS, DARKS, "three stacks"),
        (READINGS[..., :3], FLATS, DARKS, "three stacks"),
        (READINGS, FLATS[..., :3], DARKS, "three stacks"),
        (READINGS, FLATS, DARKS[..., :3], "three stacks"),
        (READINGS, FLATS[:0], DARKS, "Found 0 flats and 3 darks, expected at least 1"),
        (READINGS, FLATS, DARKS[:0], "Found 2 flats and 0 darks, expected at least 1"),
        (READINGS[..., 1:3], FLATS[..., 1:3], DARKS[..., 1:3], r"at detector pixel \(0, 1\)"),
    ],
)
def test_fields_that_calibrate_nothing(readings: np.ndarray, flats: np.ndarray, darks: np.ndarray, sentence: str) -> None:
    """As many dead pixels as others are too many; one less are not."""
    assert_refused(sentence, preprocess.calibrate, readings, flats, darks)
    preprocess.calibrate(READINGS[..., 1:], FLATS[..., 1:], DARKS[..., 1:])


@pytest.mark.parametrize("copies", [1, 3])
def test_flats_without_scatter_tell_no_noise(copies: int) -> None:
    """One flat, or copies of one: transmissions as ever, the noise of quanta in ratios alone, and no quanta to count."""
    flats = np.repeat(FLATS[:1], copies, axis=0)
    found = preprocess.correct_transmission(READINGS, flats, DARKS, 131)
    light = np.array([88.0, 97, 78, 68])
    alive = [0, 1, 3, 4]
    t = (READINGS[:, 0, alive] - [12, 13, 12, 12]) / light
    np.testing.assert_allclose(found.value[:, 0, alive], t, rtol=1e-14)
    np.testing.assert_allclose(found.variance[:, 0, alive], np.maximum(t, 0) * preprocess.UNKNOWN_NOISE, rtol=1e-14)
    assert np.isnan(found.value[:, 0, 2]).all() and not found.is_noise_known
    reason = "one flat tells" if copies == 1 else "the 3 flats are copies of one image, which tell"
    assert found.notes[0].startswith(f"the noise is unknown, because {reason} no scatter")
    assert_refused("choose pcg", count_quanta, READINGS, flats, DARKS)
    assert preprocess.correct_transmission(READINGS, FLATS, DARKS).is_noise_known


def test_one_dark_leaves_its_noise_to_the_quanta() -> None:
    found = preprocess.calibrate(READINGS, FLATS, DARKS[1:2])
    assert (found.dark_variance, found.gain, found.n_darks) == (0, pytest.approx(200 / (371 / 4)), 1)
    assert found.notes == ("one dark: its noise is unknown, and the scatter of the flats counts as noise of quanta",)
    assert preprocess.correct_transmission(READINGS, FLATS, DARKS[1:2]).notes == found.notes
    assert preprocess.calibrate(READINGS, FLATS, np.zeros_like(DARKS[:1])).notes == ()


def test_quanta_of_a_pixel() -> None:
    """(reading - dark) / gain and the read noise in quanta; 0 and 1 where nothing is used."""
    found = preprocess.count_quanta(READINGS, FLATS, DARKS)
    gain = 196 / (371 / 4)
    shift = 4 / gain**2
    assert found.background == pytest.approx(shift)
    wanted = np.maximum((READINGS[:, 0] - [12, 13, 12, 12, 12]) / gain + shift, 0)
    wanted[:, 2] = 0
    np.testing.assert_allclose(found.counts[:, 0], wanted, rtol=1e-14)
    np.testing.assert_allclose(found.blank[:, 0], [np.array([98, 107, gain, 88, 78]) / gain] * 2, rtol=1e-14)
    assert found.used[:, 0].tolist() == [[True, True, False, True, True]] * 2
    some = found.select_views(np.array([1]))
    assert (some.counts.tolist(), some.blank.tolist()) == (found.counts[1:].tolist(), found.blank[1:].tolist())
    assert some.used.tolist() == found.used[1:].tolist() and some.background == found.background
    assert preprocess.Quanta(found.counts, 3.0, 0.0, found.used).select_views(np.array([0])).blank == 3.0


def disc(air: np.ndarray | float, radius: float = 20.0, orbit: float = 8.0, density: float = 0.05) -> Transmission:
    """Views of a disc that goes around, 100 columns, under a light of ``air`` (a number a view), with a noise of .003."""
    noise = 0.003
    angle = np.linspace(0, np.pi, 30)[:, None, None]
    chord = 2 * np.sqrt(np.maximum(radius**2 - (np.arange(100) - 49.5 - orbit * np.cos(angle)) ** 2, 0))
    t = np.broadcast_to(air, 30)[:, None, None] * np.exp(-density * chord) * np.ones((1, 2, 1))
    return Transmission(t + noise * np.random.default_rng(3).normal(size=t.shape), np.full(t.shape, noise**2))


@pytest.mark.parametrize("level", [0.5, 0.7, 1.0, 1.1])
def test_air_is_measured_at_the_edges(level: float) -> None:
    """To five deviations of its own, and needed unless it is that of the flats; a view's dead pixel tells nothing."""
    light = disc(level)
    light.value[3, 1, 2] = np.nan
    air = preprocess.find_air(light)
    assert air is not None and air.is_needed == (level != 1.0)
    assert np.ptp(air.factor) == 0 and abs(air.factor[0] - level) < 5 * air.uncertainty
    # Two edges of five columns, two rows and thirty views; the scatter over views is known to a few percent.
    assert air.uncertainty == pytest.approx(0.003 / np.sqrt(2 * 2 * 5 * 30), rel=0.2)
    found = air.normalise(light)
    np.testing.assert_allclose(found.value[0], light.value[0] / air.factor[0])
    np.testing.assert_allclose(found.variance[0], light.variance[0] / air.factor[0] ** 2)
    # The disc reaches to column 22 and 78 at most; an eighth of the columns is the most that is asked for.
    assert air.columns == 12


def test_air_that_drifts_is_measured_in_each_view() -> None:
    drift = np.linspace(0.8, 0.9, 30)
    air = preprocess.find_air(disc(drift))
    assert air is not None and air.is_needed
    # The mean of 20 pixels in each of 30 views, six deviations.
    np.testing.assert_allclose(air.factor, drift, atol=6 * 0.003 / np.sqrt(20))


EDGES = {
    "a disc wider than the detector": disc(1.0, 90.0),
    "a disc around the axis, wider than the detector": disc(1.0, 70.0, 0.0, 0.005),
    "a disc that reaches one edge": Transmission(disc(1.0).value[..., 25:], disc(1.0).variance[..., 25:]),
    "absorption alone": disc(0.3),
    "few columns": Transmission(disc(1.0).value[..., :15], disc(1.0).variance[..., :15]),
    "nothing finite": Transmission(np.full((30, 2, 100), np.nan), np.ones((30, 2, 100))),
    "mass that comes and goes": Transmission(
        disc(1.0).value * np.where(abs(np.arange(100) - 50) < 9, np.linspace(0.2, 1, 30)[:, None, None], 1), disc(1.0).variance
    ),
}


@pytest.mark.parametrize("case", EDGES)
def test_edges_that_are_no_air(case: str) -> None:
    """Even edges that are too dark are told, and not believed."""
    air = preprocess.find_air(EDGES[case])
    if case in ("a disc wider than the detector", "absorption alone"):
        assert not air.is_believed and not air.is_needed and 0 < air.factor.mean() < 0.4
    else:
        assert air is None


def test_views_that_a_camera_lost() -> None:
    """A closed shutter leaves noise about 0, a frame too bright no absorption; a view with 2 % of the light counts."""
    light = disc(1.0)
    assert not np.any(preprocess.find_lost_views(light))
    noise = light.value[20] - np.median(light.value[20], axis=0)
    for view, level in ((4, 0.0), (9, 0.02), (13, 1.2), (17, 1.3)):
        light.value[view] = level + 0.1 * noise
    light.value[3, 1, 2] = np.nan
    light.variance[4] *= 0.01
    is_dark, is_bright = preprocess.find_lost_views(light)
    assert np.flatnonzero(is_dark).tolist() == [4] and np.flatnonzero(is_bright).tolist() == [17]


def test_air_is_a_straight_line_through_both_edges() -> None:
    """Means of 2 and of 4 of the finite pixels in two columns at either edge, between their middles and beyond."""
    value = np.array([[[1.0, 3, 9, 9, np.nan, 4]]])
    air = preprocess.fit_air(value, 2)
    np.testing.assert_allclose(air, [[[1.75, 2.25, 2.75, 3.25, 3.75, 4.25]]], rtol=1e-14)
    found = preprocess.normalise_air(Transmission(value, np.ones_like(value)), 2)
    np.testing.assert_allclose(found.value, value / air, rtol=1e-14)
    np.testing.assert_allclose(found.variance, 1 / air**2, rtol=1e-14)
    counts = preprocess.normalise_air(preprocess.assume_quantum_noise(1000 * value), 2)
    known = preprocess.assume_quantum_noise(value / air)
    np.testing.assert_allclose(counts.variance, known.variance, rtol=1e-14)
    assert not counts.is_noise_known
    assert preprocess.normalise_air(Transmission(value, value), 3).value.shape == value.shape
    for n in (0, 1, 4):
        assert_refused(f"Found {n} air columns, expected 2 to 3 of 6", preprocess.normalise_air, Transmission(value, value), n)
    dark = np.ones((2, 3, 6))
    dark[1, 2, :2] = np.nan
    assert_refused("at an edge of row 2 of view 1", preprocess.fit_air, dark, 2)


def test_light_that_is_noise_counts_nothing() -> None:
    """Three standard deviations are noise, a little more is light; without variance, or not finite, nothing is known."""
    value = np.array([0.75, 0.7501, 2.0, np.nan, 0.5, 0.5, 0.5])
    variance = np.array([0.0625, 0.0625, 0.04, 0.01, np.nan, 0.0, np.inf])
    y, weights = preprocess.to_line_integrals(Transmission(value, variance))
    t = np.array([0.7501, 2.0])
    np.testing.assert_allclose(y, [0, *-np.log(t), 0, 0, 0, 0], rtol=1e-14)
    np.testing.assert_allclose(weights, [0, *(t**2 / [0.0625, 0.04]), 0, 0, 0, 0], rtol=1e-14)
    y, _ = preprocess.to_line_integrals(Transmission(value, variance), 2.0)
    assert y[0] == pytest.approx(-np.log(0.75))


def test_drift_is_a_weighted_line_in_time() -> None:
    """As NumPy's fit with the roots of the weights; pixels seen once, or at one time, have none."""
    rng = np.random.default_rng(1)
    residual, weights, times = rng.normal(size=(5, 1, 4)), rng.uniform(1, 2, (5, 1, 4)), np.array([-2.0, -1, 0.5, 1, 3])
    weights[1:, 0, 2] = 0
    weights[:, 0, 3] = 0
    found = preprocess.fit_light_drift(residual, weights, times)
    for k in range(2):
        slope, offset = np.polyfit(times, residual[:, 0, k], 1, w=np.sqrt(weights[:, 0, k]))
        assert (found.slope[0, k], found.offset[0, k]) == pytest.approx((slope, offset), rel=1e-10)
    assert found.slope[0, 2:].tolist() == found.offset[0, 2:].tolist() == [0, 0]
    still = preprocess.fit_light_drift(residual, np.ones_like(weights), np.full(5, 0.1))
    assert not still.slope.any() and not still.offset.any()
    moved = LightDrift(np.array([[1.0, 2]]), np.array([[3.0, 4]])).eval(np.array([0.0, 10.0]))
    assert moved.tolist() == [[[1, 2]], [[31, 42]]]


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
    assert_refused(r"at detector pixel \(0, 0\) and at half of all", correct_transmission, readings, flats, darks)


def test_flats_without_noise_count_nothing() -> None:
    readings, flats, darks = fields()
    assert_refused("scatter no more than darks", count_quanta, readings, np.repeat(flats.mean(0, keepdims=True), 2, 0), darks)


def test_saturated_flats_are_named() -> None:
    """A twentieth of the pixels at the largest number of 12 bits; the same share at another number is a bright flat."""
    rng = np.random.default_rng(3)
    flats = rng.uniform(2000, 3000, (4, 5, 20))
    flats[:, :, 3] = 4095
    darks = rng.uniform(0, 10, (4, 5, 20))
    found = calibrate(flats, flats, darks).notes
    assert found == (
        "5% of the flats' pixels are 4095, the largest number of their bits: the flats seem saturated, data.saturation = 4095 "
        "leaves such pixels out",
    )
    flats[:, :, 3] = 4094
    assert calibrate(flats, flats, darks).notes == ()
