"""The rotation axis of cone beams, in scans of a head whose chords are known and whose axis is where it was put."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from false_alarms import assert_same_mean, assert_same_variance, fresh

from mivol.errors import MivolError
from mivol.tomography import fan_axis
from mivol.tomography.geometry import ConeBeam
from mivol.tomography.phantoms import shepp_logan
from mivol.validate.statistics import Estimate


def beam_of(axis_offset: float, views: int = 60, columns: int = 48, arc: float = 360.0, **changes: object) -> ConeBeam:
    """A head of half width 1, seen whole from 6 half widths away."""
    angles = np.radians(arc) * np.arange(views) / views
    return replace(ConeBeam(angles, (1, columns), 6.0, 9.0, 4.5 / columns, axis_offset), **changes)


def light_of(beam: ConeBeam, parts: int = 3) -> np.ndarray:
    """Transmission of the head, as pixels see it: the mean over parts of each column, no grid takes part."""
    (rows, columns), (v, u) = beam.detector, beam.pitch
    fine = replace(beam, detector=(rows, columns * parts), pitch=(v, u / parts))
    light = np.exp(-2.0 * shepp_logan().project(fine))
    return light.reshape(len(beam.angles), rows, columns, parts).mean(-1)


def column_of(beam: ConeBeam) -> float:
    """Where the axis was put: magnified, from the middle of the detector, which may be displaced."""
    seen = beam.axis_offset * beam.source_to_detector / beam.source_to_axis - beam.detector_offset[1]
    return seen / beam.pitch[1] + (beam.detector[1] - 1) / 2


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_a_line_is_seen_from_both_ends(shift: float) -> None:
    """The ray of a column at theta, and that of its mirrored column at theta + pi + 2 epsilon - 2 alpha: one line, two ways."""
    beam = beam_of(0.4, detector_offset=(0.0, shift))
    alpha = np.arctan((np.arange(48) - 23.5) * beam.pitch[1] / 9.0 + shift / 9.0)
    epsilon = np.arctan(0.4 / 6.0)
    mirrored = fan_axis._mirrored_columns(beam, alpha, column_of(beam))
    np.testing.assert_allclose(fan_axis._fan_angles(beam), alpha, rtol=1e-14)
    for column in (0, 11, 30):
        here = replace(beam, angles=np.array([0.7])).rays()
        away = beam.pitch[1] * (mirrored[column] - 23.5)
        theta = 0.7 + np.pi + 2 * epsilon - 2 * alpha[column]
        there = replace(beam, angles=np.array([theta]), detector=(1, 1), detector_offset=(0.0, shift + away)).rays()
        np.testing.assert_allclose(here[1][0, 0, column], -there[1][0, 0, 0], atol=1e-12)
        across = np.cross(here[0][0, 0, column] - there[0][0, 0, 0], here[1][0, 0, column])
        np.testing.assert_allclose(across, 0.0, atol=1e-12)


SCANS = {
    "as it should be": beam_of(0.0),
    "a little beside": beam_of(0.07),
    "far to the left": beam_of(-0.5),
    "few views": beam_of(0.1, views=24),
    "half a turn and more": beam_of(0.05, views=60, arc=225.0),
    "the other way round": beam_of(0.05, angles=-np.radians(6.0) * np.arange(60)),
    "twice around": beam_of(0.05, angles=np.radians(12.0) * np.arange(60)),
    "a displaced detector": beam_of(0.02, columns=56, pitch=3.5 / 56, detector_offset=(0.0, 1.0), views=180),
    "rows beside the plane": beam_of(0.07, detector=(6, 48), pitch=(0.02, 4.5 / 48), detector_offset=(0.025, 0.0)),
}


@pytest.mark.parametrize("case", SCANS)
def test_the_axis_is_where_it_was_put(case: str) -> None:
    """Without noise, to twice the standard deviation that is claimed, which is at most five times what sampling does to edges.

    Of six rows, 0.02 high, those at -0.005 and 0.015 are nearer to the plane than 0.02 = 0.02 * 6 / (4 * 1.5).
    """
    beam = SCANS[case]
    light = light_of(beam)
    axis = fan_axis.axis_from_fans(-np.log(light), light, replace(beam, axis_offset=9.0))
    assert abs(axis.column - column_of(beam)) < 2 * axis.uncertainty
    assert fan_axis.SAMPLING_ERROR <= axis.uncertainty < 5 * fan_axis.SAMPLING_ERROR
    assert fan_axis.cone_axis_offset(axis, beam) == pytest.approx(beam.axis_offset, abs=2 * axis.uncertainty * beam.pitch[1])
    rows = "2 rows" if case == "rows beside the plane" else "1 row"
    assert axis.method == f"rays measured from both ends, {rows}"


@pytest.mark.statistical
def test_the_uncertainty_is_that_of_repeated_noise() -> None:
    """64 scans of 300 quanta a pixel scatter as the sectors of each say, and about the axis as far as sampling may move it.

    The variance of 24 sectors has 23 degrees of freedom in each scan, so the mean of 64 is known to 4 %, and the scatter of
    64 scans to 18 %: what passes is below 2.2 times the variance that is claimed.
    """
    beam = beam_of(0.07)
    light = light_of(beam)
    found = []
    for seed in range(64):
        counts = np.random.default_rng(fresh(seed)).poisson(300.0 * light).astype(float)
        y = -np.log(np.maximum(counts, 1.0) / 300.0)
        axis = fan_axis.axis_from_fans(y, counts, beam)
        found.append((axis.column, axis.uncertainty**2 - fan_axis.SAMPLING_ERROR**2))
    columns, claimed = np.transpose(found)
    assert_same_variance(columns, claimed.mean(), what="axes of cone beams")
    mean = Estimate(columns.mean(), columns.var(ddof=1) / 64, 63)
    assert_same_mean(mean, column_of(beam), rounding=fan_axis.SAMPLING_ERROR, what="axes of cone beams")


def test_pixels_that_are_not_used_tell_nothing() -> None:
    """A dead column and a scratch of any value, of weight 0: the axis as before, to what sampling may do."""
    beam = beam_of(0.07)
    light = light_of(beam)
    y, weights = -np.log(light), light.copy()
    weights[..., 9] = weights[20:22] = 0.0
    y[weights == 0] = 50.0
    assert abs(fan_axis.axis_from_fans(y, weights, beam).column - column_of(beam)) < 2 * fan_axis.SAMPLING_ERROR


REFUSED = {
    "no row in the plane": (beam_of(0.0, detector_offset=(1.0, 0.0)), "no row of the detector in the plane"),
    "three views": (beam_of(0.0, views=3), "3 different view angles"),
    "no line twice": (beam_of(0.0, arc=140.0), "no lines of a structure that both of their ends show"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_scans_that_do_not_tell_the_axis(case: str) -> None:
    beam, sentence = REFUSED[case]
    light = light_of(beam, 1)
    with pytest.raises(MivolError, match=sentence):
        fan_axis.axis_from_fans(-np.log(light), light, beam)


@pytest.mark.parametrize("y", [np.zeros((60, 1, 48)), np.random.default_rng(1).normal(size=(60, 1, 48))])
def test_air_and_noise_have_no_axis(y: np.ndarray) -> None:
    """The correlation of noise with its mirror image is far below a half (24 directions of 5 independent columns)."""
    with pytest.raises(MivolError, match="no lines of a structure"):
        fan_axis.axis_from_fans(y, np.ones_like(y), beam_of(0.0))


def test_the_least_of_sectors() -> None:
    """Two sectors of 3 (x - 7 -+ 0.2)^2: least at 7, and their slopes of -+1.2 there make 0.2; a ridge is refused."""
    found = fan_axis._sector_minimum(lambda x: np.array([3 * (x - 7.2) ** 2, 3 * (x - 6.8) ** 2]), 6.5, 1.0)
    assert found == pytest.approx((7.0, np.sqrt(2 * 2 * 1.2**2) / 12))
    for ridge in (lambda x: np.array([-(x**2), 0.0]), lambda x: np.array([x, (x - 9) ** 2])):
        with pytest.raises(MivolError, match="no column near 0"):
            fan_axis._sector_minimum(ridge, 0.0, 1.0)
