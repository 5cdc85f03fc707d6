"""The rotation axis: parts of the search on known numbers, cone beams of a known head, and the scan of scenes/bonsai."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from false_alarms import assert_same_mean, assert_same_variance, fresh
from refusals import assert_refused

from mivol.bench.studies.preparation import AXIS_SCANS, AxisScan
from mivol.errors import MivolError
from mivol.files import write_volume
from mivol.tomography import cone_axis
from mivol.tomography import rotation_axis as axes
from mivol.tomography.geometry import ConeBeam
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.preprocess import correct_transmission, find_air, to_line_integrals
from mivol.validate.statistics import Estimate


def test_the_offset_of_a_column() -> None:
    assert axes.Axis(5.0, 0.1, "").offset(8) == 1.5
    assert axes.Axis(5.0, 0.1, "").offset(8, 0.5) == 0.75


def bumps(degrees: np.ndarray, column: float, n: int = 60) -> np.ndarray:
    """Two smooth shadows of 3 columns that go around an axis, in two rows (views, 2, n)."""
    theta, s = np.radians(degrees)[:, None, None], np.arange(n) - column
    row = np.array([[1.0], [0.6]])
    return sum(h * np.exp(-(((s - row * r * np.cos(theta + p)) / 3) ** 2) / 2) for h, r, p in ((1, 12, 0.3), (2, 8, 2.0)))


ARCS = {
    "half a turn": (np.arange(90) * 2.0, 2, False),
    "half a turn, both ends": (np.arange(91) * 2.0, 1, True),
    "backwards from elsewhere": (40 - np.arange(90) * 2.0, 2, False),
    "a little more": (np.arange(100) * 2.0 + 0.7, 10, True),
    "a whole turn": (np.arange(121) * 2.98, 61, True),
}


@pytest.mark.parametrize("case", ARCS)
@pytest.mark.parametrize("column", [27.3, 31.0])
def test_the_axis_of_mirror_images(case: str, column: float) -> None:
    """Opposite views, measured or interpolated, agree about the axis, and the axis is found to 0.03 by smooth shadows.

    Cubic interpolation between views 2 or 3 degrees apart errs by 3 / 128 (12 d / 3)^4 < 1e-3 of a shadow of 3 columns, 12 off.
    """
    degrees, count, measured = ARCS[case]
    y = bumps(degrees, column)
    here, there, are_measured = axes._opposite_views(y, np.radians(degrees), 360)
    assert (len(here), are_measured) == (count, measured)
    s = np.arange(60.0)
    for a, b in zip(here.reshape(-1, 60), there.reshape(-1, 60), strict=True):
        inside = (2 * column - s >= 0) & (2 * column - s <= 59)
        np.testing.assert_allclose(a[inside], np.interp(2 * column - s, s, b)[inside], atol=0.06)
    axis = axes.axis_from_mirrors(y, np.radians(degrees))
    assert abs(axis.column - column) < 0.03 and axis.method == f"mirror images, {count} views"


def test_views_that_stand_for_an_opposite_view() -> None:
    """One at the same angle; two mirrored on either side; own neighbours on the side without mirrored ones; else none."""
    own, step = np.array([-2.0, -1, np.inf, 1, 2]), 1.0

    def places(mirrored: list[float]) -> list[tuple[float, bool]] | None:
        nodes = axes._nodes(own, np.array(mirrored), step)
        return nodes and [(node.place, node.is_mirrored) for node in nodes]

    assert places([3.0, 0.01]) == [(0.0, True)]
    assert places([-1.5, -0.5, 0.5, 1.5, 2.5]) == [(-0.5, True), (-1.5, True), (0.5, True), (1.5, True)]
    assert places([1.0, 2.0, 3.0]) == [(-1.0, False), (-2.0, False), (1.0, True), (2.0, True)]
    assert places([1.5, 2.5]) is None and places([40.0]) is None
    np.testing.assert_allclose(axes._lagrange(np.array([-2.0, -1, 1, 2])), np.array([-1, 4, 4, -1]) / 6)


def test_columns_that_both_see() -> None:
    """An axis at 3 of 10 columns, give or take a half: columns 1 to 4 and their images 1.. 5 stay a column from the edges."""
    assert axes._common_columns(10, 3.0, 1, 0.5).tolist() == [1, 2, 3, 4]
    groups = axes._mirror_groups(np.arange(20, 82), 50.5, 1.0, 24)
    assert groups.max() == 4 and (groups == groups[::-1]).all() and set(groups) == set(range(5))
    assert axes._mirror_groups(np.arange(20), 9.5, 1.0, 8) is None
    assert axes._mirror_groups(np.arange(20), 9.5, 1.0, 7).max() == 2


def test_a_group_with_nearly_all_of_the_curvature() -> None:
    """Groups with minima at 7.0, 7.1 and 7.4 of weights 8, 1 and 1: the mean is 7.05; left out one at a time, the others have
    7.25, 7.044 and 7.011, and the jackknife's deviation is that of these three times sqrt(2 / 3 * 3)."""
    weights, places = np.array([8.0, 1, 1]), np.array([7.0, 7.1, 7.4])
    column, sigma = axes._jackknife_minimum(lambda x: weights * (x - places) ** 2, 6.8, 0.5)
    left = [(weights @ places - w * p) / (10 - w) for w, p in zip(weights, places, strict=True)]
    assert (column, sigma) == pytest.approx((7.05, np.sqrt(2 / 3 * np.sum((left - np.mean(left)) ** 2))))


def test_what_resembles_no_mirror_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise, a view without contrast, and angles of another scan."""
    degrees = np.arange(90) * 2.0
    noise = np.random.default_rng(2).normal(size=(90, 2, 60))
    assert_refused("resemble no mirror images", axes.axis_from_mirrors, noise, np.radians(degrees))
    flat = bumps(degrees, 30.0)
    flat[2] = 1
    assert_refused("view 2 without contrast", axes.axis_from_mirrors, flat, np.radians(degrees))
    assert_refused("half a turn apart", axes.axis_from_mirrors, flat, np.radians(degrees / 2))


def test_a_constant_and_its_deviation() -> None:
    """The mean of four numbers and its standard error; as a line through five, that of least squares."""
    values = np.array([1.0, 2, 4, 5])
    assert axes._fit_first_coefficient(np.ones((4, 1)), values) == pytest.approx((3, np.sqrt(10 / 3 / 4)))
    x, y = np.array([0.0, 1, 2, 3, 5]), np.array([1.0, 2, 2, 4, 4])
    (slope, offset), covariance = np.polyfit(x, y, 1, cov=True)
    assert slope > 0
    assert axes._fit_first_coefficient(np.stack([np.ones(5), x], 1), y) == pytest.approx((offset, np.sqrt(covariance[1, 1])))
    assert axes._fit_first_coefficient(np.ones((1, 1)), np.array([7.0])) == pytest.approx((7, 0))


def spots(degrees: np.ndarray, column: float, n: int = 96) -> np.ndarray:
    """Shadows of 60 round spots, up to 90 columns from an axis (views, 2, n); the detector sees about half of them."""
    rng = np.random.default_rng(3)
    theta, s = np.radians(degrees)[:, None, None], np.arange(n) - column
    row = np.array([[1.0], [0.8]])
    parts = zip(rng.uniform(0.5, 2, 60), 90 * np.sqrt(rng.uniform(0, 1, 60)), rng.uniform(0, 7, 60), strict=True)
    return sum(h * np.exp(-(((s - row * r * np.cos(theta + p)) / 2) ** 2) / 2) for h, r, p in parts)


@pytest.mark.parametrize("column", [40.3, 52.75])
def test_the_axis_of_the_least_entropy(column: float, variant_rgb: str) -> None:
    """A region of interest, without noise: the column is found to half of the last step of half a column, backwards too."""
    degrees = np.arange(150) * 1.2
    y = spots(degrees, column)
    axis = axes.axis_from_entropy(y, np.ones(y.shape), np.radians(degrees))
    assert abs(axis.column - column) < 0.25 and np.isnan(axis.uncertainty)
    assert axis.method == "least entropy of slices, 2 rows"
    turned = axes.axis_from_entropy(y[..., ::-1].copy(), np.ones(y.shape), -np.radians(degrees))
    assert abs(turned.column - (95 - column)) < 0.25


def test_averaged_columns_have_the_axis_of_columns(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Means of two columns: column c is (c - 1 / 2) / 2 there, and half a column would be seen in steps of a quarter."""
    degrees, columns = np.arange(150) * 1.2, np.arange(42.0, 47.0, 0.25)
    y = spots(degrees, 44.5)
    entropies = axes._slice_entropies(y, np.radians(degrees), columns, 2)
    assert abs(columns[entropies.argmin()] - 44.5) <= 0.25
    monkeypatch.setattr(axes, "ENTROPY_COLUMNS", 64)
    assert abs(axes.axis_from_entropy(y, np.ones(y.shape), np.radians(degrees)).column - 44.5) < 0.25


def test_slices_without_a_clear_least_entropy_are_refused(variant_rgb: str) -> None:
    """Noise, and directions that are missing in half a turn."""
    degrees = np.arange(150) * 1.2
    noise = np.random.default_rng(5).normal(size=(150, 2, 96))
    assert_refused("clearly the least entropy", axes.axis_from_entropy, noise, np.ones(noise.shape), np.radians(degrees))
    missing = np.radians(degrees * 0.8)
    assert_refused("directions missing in half a turn", axes.axis_from_entropy, noise, np.ones(noise.shape), missing)


def test_moments_follow_a_circle() -> None:
    """Two rows of one pixel of mass each, with centres at 5 + cos and 5 + 2 sin: both rows say 5, and sampling errs by .01."""
    angles = np.linspace(0, 2 * np.pi, 7)
    y = np.zeros((7, 2, 11))
    for view, angle in enumerate(angles):
        for row, centre in enumerate((5 + np.cos(angle), 5 + 2 * np.sin(angle))):
            low = int(centre)
            y[view, row, low], y[view, row, low + 1] = low + 1 - centre, centre - low
    found = axes.axis_from_moments(y, angles)
    assert (found.column, found.uncertainty) == pytest.approx((5, 0.01), abs=1e-9)
    y[:, 1] = np.roll(y[:, 1], 2, axis=-1)
    found = axes.axis_from_moments(y, angles)
    # Views agree and rows do not: 5 and 7 scatter by sqrt(2), and their mean by 1.
    assert (found.column, found.uncertainty) == pytest.approx((6, np.hypot(1, 0.01)))
    y[:, 1] = np.roll(y[:, 1], -2, axis=-1)
    rough = y.copy()
    rough[3] = np.roll(y[3], 1, axis=-1)
    found = axes.axis_from_moments(rough, angles)
    design = np.stack([np.ones(7), np.cos(angles), np.sin(angles)], 1)
    centres = rough @ np.arange(11)
    column, scatter = axes._fit_first_coefficient(design, centres.mean(1))
    assert (found.column, found.uncertainty) == pytest.approx((column, np.hypot(scatter, 0.01)))
    # Air of .01 in eleven columns pulls the axis from 6 towards the middle, by .11 of the distance over a mass of 1.11.
    bright = np.roll(y, 1, axis=-1) + 0.01
    found = axes.axis_from_moments(bright, angles)
    assert found.column == pytest.approx(6 - 0.11 / 1.11)
    assert found.uncertainty == pytest.approx(np.hypot(0.01, 0.11 / 1.11 * (found.column - 5)))
    # A row beside the object has a hundredth of its mass, and does not count; nor does a row that is empty in one view.
    beside = np.concatenate([y, np.random.default_rng(0).uniform(0, 0.002, (7, 1, 11))], 1)
    assert axes.axis_from_moments(beside, angles) == axes.axis_from_moments(y, angles)
    y[2, 1] = 0
    assert axes.axis_from_moments(y, angles) == axes.axis_from_moments(y[:, :1], angles)
    y[2] = 0
    assert_refused("no row with an object in every view, .* give scan.axis_offset", axes.axis_from_moments, y, angles)


@pytest.mark.parametrize("shift", [0.0, 20.0])
def test_less_than_half_a_turn_has_the_axis_of_moments(shift: float, variant_rgb: str) -> None:
    """Noise of .002 on views over 120 degrees, of which none are opposite. An object that leaves the detector is refused."""
    degrees = np.arange(60) * 2.0
    y = bumps(degrees, 31.0 + shift) + 0.002 * np.random.default_rng(1).normal(size=(60, 2, 60))
    given = (y, np.full(y.shape, 0.002**-2), np.radians(degrees))
    if shift:
        assert_refused("found no rotation axis: opposite views show no mirror images", axes.find_axis, *given)
    else:
        axis = axes.find_axis(*given)
        assert abs(axis.column - 31.0) < 5 * axis.uncertainty < 0.2 and axis.method == "moments of the shadows"


SHORT_ARCS = {
    "blocks": AxisScan(0.8, radius=12.4, views=24, arc=160.0, columns=40, head=False, seed=3),
    "head": AxisScan(-2.9, radius=14.0, views=40, arc=130.0, columns=40, rows=1, seed=2),
    "eight rows": AxisScan(1.9, radius=25.6, views=24, arc=160.0, columns=64, head=False, rows=8, seed=3),
    "cut off": AxisScan(-2.5, radius=52.0, views=40, arc=160.0, columns=64, depth=0.5, seed=4),
}


@pytest.mark.parametrize("name", SHORT_ARCS)
def test_the_deviation_of_an_axis_of_less_than_half_a_turn(variant_rgb: str, name: str) -> None:
    """Within three deviations, which are at most a third of a column. An object that some views cut off is refused:
    reconstructions say 1.9 columns too much there, with a deviation of .08."""
    scan = SHORT_ARCS[name]
    given = (*to_line_integrals(correct_transmission(*scan.readings())), scan.beam().angles)
    if name == "cut off":
        assert_refused("some views do not see the whole object", axes.find_axis, *given)
    else:
        axis = axes.find_axis(*given)
        assert abs(axis.column - scan.column) < 3 * axis.uncertainty < 0.33


def test_how_far_the_object_reaches() -> None:
    """From column 4.5 to that of the ninth of the densest ray; a tenth is not seen, and a tenth more is added."""
    y = np.zeros((2, 1, 20))
    y[0, 0, 5], y[1, 0, 15], y[1, 0, 18], y[0, 0, 1] = 10.0, 1.1, 1.0, 1.0
    assert axes._object_radius(y, 4.5) == int(np.ceil(1.1 * 10.5))
    assert axes._object_radius(y, 14.0) == int(np.ceil(1.1 * 9))


def test_the_least_of_a_parabola() -> None:
    """3 (x - 7)^2 + 2 by five points around 6.5: exact, and as wide as its own least value makes it."""
    found = axes._parabola_minimum(lambda x: 3 * (x - 7) ** 2 + 2, 6.5, 2.0, 50)
    assert found == pytest.approx((7, np.sqrt(2 / (3 * 50))))
    assert axes._parabola_minimum(lambda x: (x - 1.99) ** 2 + 1, 1.0, 1.0, 1)[0] == pytest.approx(1.99)
    for f in (lambda x: (x - 2.01) ** 2, lambda x: (x + 0.01) ** 2, lambda x: -((x - 1) ** 2), lambda x: x):
        assert_refused(r"between columns 0\.0 and 2\.0", axes._parabola_minimum, f, 1.0, 1.0, 1)


def test_halves_of_the_views_predict_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """The middle rows; five trials over the width, and five over a fourth of it; the mean, and the larger of the two errors."""
    asked = []

    def misfit(y: np.ndarray, w: np.ndarray, angles: np.ndarray, column: float, known: slice, hidden: slice) -> float:
        asked.append((y.shape, w.shape, column, known, hidden))
        return 2 + 3 * (column - (7.0 if known == slice(0, None, 2) else 7.2)) ** 2

    monkeypatch.setattr(axes, "_held_out_misfit", misfit)
    y, weights = np.ones((6, 4, 5)), np.ones((6, 4, 5))
    weights[1] = 0
    found = axes.axis_from_reconstructions(y, weights, np.arange(6.0), 6.5)
    # 20 weighted pixels of one half, 30 of the other: 2 / (3 n) each.
    assert found.column == pytest.approx(7.1)
    assert found.uncertainty == pytest.approx(max(0.1, np.sqrt(2 / 60 + 2 / 90) / 2))
    assert found.method == "one half of the views predicted from the other"
    assert {shape for shape, *_ in asked} == {(6, 2, 5)} and {shape for _, shape, *_ in asked} == {(6, 2, 5)}
    columns = [column for _, _, column, *_ in asked]
    np.testing.assert_allclose(columns[:5], 6.5 + 2 * np.linspace(-1, 1, 5))
    np.testing.assert_allclose(columns[5:10], 7.0 + 0.5 * np.linspace(-1, 1, 5))
    halves = [(known, hidden) for *_, known, hidden in asked]
    assert halves == [(slice(0, None, 2), slice(1, None, 2))] * 10 + [(slice(1, None, 2), slice(0, None, 2))] * 10
    asked.clear()
    axes.axis_from_reconstructions(np.ones((6, 3, 5)), np.ones((6, 3, 5)), np.arange(6.0), 6.5)
    assert asked[0][0] == (6, 1, 5)


BUMPY = float(np.sqrt(0.1**2 + 0.04**2 + 0.02**2))
RULES = {
    "the refined one": ((7.1, 0.1), (7.0, 0.2), (7.1, BUMPY, "halves")),
    "at least half of the distance": ((7.4, 0.1), (7.0, 0.3), (7.4, 0.2, "halves")),
    "the mirrors'": ((7.4, 0.1), (7.0, 0.15), (7.0, 0.15, "mirrors")),
    "the mirrors' by far": ((8.4, 0.1), (7.0, 0.02), (7.0, 0.02, "mirrors; reconstructions say 8.40, which does not count")),
    "nothing refined": (None, (7.0, 0.02), (7.0, 0.02, "mirrors; no column nearby predicts half of the views best")),
}


@pytest.mark.parametrize("case", RULES)
def test_which_axis_counts(monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    """The one of the smaller deviation; without mirror images an object as wide as the detector has no axis.

    Three columns in three directions: the bumps of the misfit add hypot(.04, .02) to the refined deviation.
    """
    fine, rough, wanted = RULES[case]

    def answer(found: tuple[float, float] | None, method: str) -> axes.Axis:
        if found is None:
            raise MivolError("Found none.")
        return axes.Axis(*found, method)

    monkeypatch.setattr(axes, "axis_from_mirrors", lambda *_: answer(rough, "mirrors"))
    monkeypatch.setattr(axes, "axis_from_reconstructions", lambda *_: answer(fine, "halves"))
    y = np.ones((2, 1, 3))
    found = axes.find_axis(y, y, np.arange(2.0))
    assert (found.column, found.uncertainty) == pytest.approx(wanted[:2]) and found.method == wanted[2]
    monkeypatch.setattr(axes, "axis_from_mirrors", lambda *_: answer(None, ""))
    assert_refused(
        "do not see the whole object .* give scan.axis_offset, or data.find_axis = false", axes.find_axis, y, y, np.arange(2.0)
    )


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
    mirrored = cone_axis._mirrored_columns(beam, alpha, column_of(beam))
    np.testing.assert_allclose(cone_axis._fan_angles(beam), alpha, rtol=1e-14)
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
    axis = cone_axis.axis_from_fans(-np.log(light), light, replace(beam, axis_offset=9.0))
    assert abs(axis.column - column_of(beam)) < 2 * axis.uncertainty
    assert axes.SAMPLING_ERROR <= axis.uncertainty < 5 * axes.SAMPLING_ERROR
    assert cone_axis.cone_axis_offset(axis, beam) == pytest.approx(beam.axis_offset, abs=2 * axis.uncertainty * beam.pitch[1])
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
        axis = cone_axis.axis_from_fans(y, counts, beam)
        found.append((axis.column, axis.uncertainty**2 - axes.SAMPLING_ERROR**2))
    columns, claimed = np.transpose(found)
    assert_same_variance(columns, claimed.mean(), what="axes of cone beams")
    mean = Estimate(columns.mean(), columns.var(ddof=1) / 64, 63)
    assert_same_mean(mean, column_of(beam), rounding=axes.SAMPLING_ERROR, what="axes of cone beams")


def test_pixels_that_are_not_used_tell_nothing() -> None:
    """A dead column and a scratch of any value, of weight 0: the axis as before, to what sampling may do."""
    beam = beam_of(0.07)
    light = light_of(beam)
    y, weights = -np.log(light), light.copy()
    weights[..., 9] = weights[20:22] = 0.0
    y[weights == 0] = 50.0
    assert abs(cone_axis.axis_from_fans(y, weights, beam).column - column_of(beam)) < 2 * axes.SAMPLING_ERROR


REFUSED = {
    "no row in the plane": (beam_of(0.0, detector_offset=(1.0, 0.0)), "no row of the detector in the plane"),
    "three views": (beam_of(0.0, views=3), "3 different view angles"),
    "no line twice": (beam_of(0.0, arc=140.0), "no structure visible from both ends of its lines"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_scans_that_do_not_tell_the_axis(case: str) -> None:
    beam, sentence = REFUSED[case]
    light = light_of(beam, 1)
    assert_refused(sentence, cone_axis.axis_from_fans, -np.log(light), light, beam)


@pytest.mark.parametrize("y", [np.zeros((60, 1, 48)), np.random.default_rng(1).normal(size=(60, 1, 48))])
def test_air_and_noise_have_no_axis(y: np.ndarray) -> None:
    """The correlation of noise with its mirror image is far below a half (24 directions of 5 independent columns)."""
    assert_refused("no structure visible", cone_axis.axis_from_fans, y, np.ones_like(y), beam_of(0.0))


def test_the_least_of_sectors() -> None:
    """Two sectors of 3 (x - 7 -+ 0.2)^2: least at 7, and their slopes of -+1.2 there make 0.2; a ridge is refused."""
    found = axes.sector_minimum(lambda x: np.array([3 * (x - 7.2) ** 2, 3 * (x - 6.8) ** 2]), 6.5, 1.0)
    assert found == pytest.approx((7.0, np.sqrt(2 * 2 * 1.2**2) / 12))
    for ridge in (lambda x: np.array([-(x**2), 0.0]), lambda x: np.array([x, (x - 9) ** 2])):
        assert_refused("no column near 0", axes.sector_minimum, ridge, 0.0, 1.0)


SCRIPT = Path(__file__).resolve().parents[2] / "scenes" / "bonsai" / "scan.py"
SPREAD, PLACE = 6.0, np.array([5.0, -9.0, 3.0])


@pytest.fixture(scope="module")
def scan() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bonsai_scan", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("turn", [0, 3, 7])
def test_sums_are_the_integrals_of_a_blob(scan: ModuleType, turn: int) -> None:
    """A Gaussian has the integral sqrt(2 pi) s exp(-b^2 / 2 s^2) along a line that passes it at a distance b.

    Sums over the planes are exact to exp(-(pi s)^2), which is nothing; linear interpolation in a plane adds at most h^2 / 8
    (f_uu + f_vv), which is 2 / (8 s^2) of the peak.
    """
    n = 64
    z, y, x = np.ogrid[:n, :n, :n]
    middle = (n - 1) / 2
    r2 = (x - middle - PLACE[0]) ** 2 + (y - middle - PLACE[1]) ** 2 + (z - middle - PLACE[2]) ** 2
    blob = np.exp(-r2 / (2 * SPREAD**2))
    panel, shape = scan.panels(n, 11, 20)[turn], (12, 20)
    ray = panel.pixels(shape) - panel.source
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    off = PLACE - panel.source
    b2 = off @ off - (ray @ off) ** 2
    exact = np.sqrt(2 * np.pi) * SPREAD * np.exp(-b2 / (2 * SPREAD**2))
    found = scan.joseph(blob, panel, shape)
    assert exact.max() > 14
    assert np.abs(found - exact).max() < exact.max() / (4 * SPREAD**2)


def test_the_shadow_of_the_cylinder_falls_on_the_detector(scan: ModuleType) -> None:
    """Tangents to the cylinder end inside of the outermost columns, on either side, though the detector is off the middle."""
    edge, columns = 64, 40
    panel = scan.panels(edge, 5, columns)[2]
    ends = panel.pixels((1, columns))[0, [0, -1]] - panel.source
    ends /= np.linalg.norm(ends, axis=-1, keepdims=True)
    distances = [np.linalg.norm(np.cross(panel.source, end)) for end in ends]
    # 1.02 of the shadow's half, less half a column at the edge and 1.5 off the middle.
    assert min(distances) > edge / 2 * (1.02 - 4 / columns - 0.01)
    assert max(distances) < edge / 2 * (1.02 + 4 / columns)


def test_readings_become_a_table_and_a_stack(scan: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flats are the light and the dark level, darks the dark level, a shadow lies between; a line of the table is a panel."""
    write_volume(tmp_path / "object.npz", np.ones((64, 64, 64, 1), np.float32))
    small = ["--views", "3", "--columns", "8", "--object", str(tmp_path / "object.npz")]
    monkeypatch.setattr(sys, "argv", ["scan.py", *small, "-o", str(tmp_path)])
    scan.main()
    readings, flats, darks = (np.load(tmp_path / f"{name}.npy") for name in ("readings", "flats", "darks"))
    # Means of 10 x 8 x rows readings: noise of sqrt(3e4) and 2 a reading, over sqrt(640) at least; six standard errors.
    assert abs(flats.mean() - 3.01e4) < 6 * np.sqrt(3e4) / np.sqrt(640)
    assert abs(darks.mean() - 100) < 6 * 2 / np.sqrt(640)
    # A cylinder as high as it is wide, of an optical depth of 9 across: no light to speak of within, all of it beside.
    assert readings.min() < 150 and readings.max() > 0.9 * flats.mean()
    table = np.loadtxt(tmp_path / "panels.txt")
    assert table.shape == (3, 12)
    assert np.allclose(table[1], np.concatenate(scan.panels(64, 3, 8)[1]), rtol=1e-12, atol=1e-9)


def test_a_run_is_judged_by_its_volume(scan: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A volume that is a tenth too large errs by 0.1."""
    truth = np.random.default_rng(0).random((4, 4, 4, 1)).astype(np.float32)
    (tmp_path / "volumes").mkdir()
    write_volume(tmp_path / "truth.npz", truth)
    write_volume(tmp_path / "volumes" / "reconstruction.npz", np.float32(1.1) * truth)
    scan.judge(tmp_path, tmp_path)
    assert capsys.readouterr().out == "nRMSE 0.1000\n"


def test_a_slice_is_halved_in_its_mean(scan: ModuleType) -> None:
    values = np.arange(64.0).reshape(4, 4, 4)
    # The mean of corners 0, 1, 4, 5, 16, 17, 20, 21.
    assert scan.halved(values)[0, 0, 0] == 10.5
    assert scan.halved(values).mean() == values.mean()


@pytest.mark.slow
def test_axes_of_twenty_scans(variant_rgb, capsys: pytest.CaptureFixture) -> None:
    """From readings to the axis: within .2 of a column, or as far off as the deviation says; the table is printed (pytest -s).

    Twenty squares of normal deviates have a mean above 3.3 with a chance of 1e-6.
    """
    z = []
    for name, scan in AXIS_SCANS.items():
        light = correct_transmission(*scan.readings())
        air = find_air(light)
        y, weights = to_line_integrals(air.normalise(light) if air and air.is_needed else light)
        axis = axes.find_axis(y, weights, scan.beam().angles)
        error = axis.column - scan.column
        z.append(error / axis.uncertainty)
        told = f"{air.factor.mean():.3f}" if air else "none"
        with capsys.disabled():
            print(f"{name:32} {scan.column:7.2f} {error:+.3f} +- {axis.uncertainty:.3f}  air {told}  {axis.method}")
        assert abs(error) < max(0.2, 3 * axis.uncertainty)
        assert air is None or abs(air.factor.mean() - scan.air) < 0.01
        assert (air is not None and air.is_needed) or scan.air == 1.0 or scan.radius > 60
    assert np.mean(np.square(z)) < 3.3


def test_many_noisy_views_are_averaged(variant_rgb) -> None:
    """An object wider than a detector of 40 columns, 900 views of 100 quanta: the noise of single views hides their mirror
    images, the means of eleven show them."""
    scan = AxisScan(1.4, radius=50, views=900, columns=40, depth=1, photons=100, rows=3, seed=2, head=False)
    y, weights = to_line_integrals(correct_transmission(*scan.readings()))
    assert_refused("resemble no mirror images", axes.axis_from_mirrors, y, scan.beam().angles)
    found = axes.find_axis(y, weights, scan.beam().angles)
    assert abs(found.column - scan.column) < 3 * found.uncertainty < 0.3


def test_means_of_views_weigh_their_noise() -> None:
    """Views over 270 degrees that begin at 200: groups of three, by angle; 0 where no view is used."""
    angles = np.radians(np.mod(200 + np.arange(0, 270, 0.5), 360))
    y, weights = np.tile(np.arange(540.0)[:, None, None], (1, 1, 60)), np.ones((540, 1, 60))
    weights[1], weights[3:6] = 4, 0
    mixed = np.random.default_rng(0).permutation(540)
    mean, total, at = axes._average_views(y[mixed], weights[mixed], angles[mixed])
    assert mean.shape == (180, 1, 60) and np.all(total[0] == 6) and np.all(total[1] == 0)
    assert np.allclose(mean[:3, 0, 0], [(0 + 4 + 2) / 6, 4, 7])
    assert np.allclose(np.degrees(at[[0, -1]]), [200.5, 469])
    assert axes._average_views(y[::3], weights[::3], angles[::3])[0].shape == (180, 1, 60)
