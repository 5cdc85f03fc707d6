"""Density gradients: mivol's agree with finite differences, prbvolpath's do not at density 0, and the arithmetic of the tables
is right. Samples are fixed; no time decides."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import ALPHA, note

from mivol.bench.harness import contests
from mivol.bench.harness.contests import Contest, Timing
from mivol.bench.scenes import square_error
from mivol.bench.studies import gradients as study
from mivol.bench.studies.gradients import (
    CONTESTS,
    STUDY,
    SUN,
    TABLES,
    Case,
    GradientSize,
    contest_figures,
    finite_difference,
    make_cases,
    measure_row,
    refine,
)
from mivol.bench.studies.gradients.tutorial import (
    Judge,
    Run,
    compare_runs,
    half_circle,
    measure_tutorial,
    resample,
    turn_upright,
)
from mivol.files import read_volume

MIVOL, PEER = "mivol", "prbvolpath"
LIGHTS = TABLES["estimators"]
SMOKE = CONTESTS["smoke"][1]
TINY = replace(
    GradientSize.quick(),
    rounds=3,
    side=6,
    spp=4,
    table_rounds=8,
    table_side=6,
    table_spp=64,
    table_res=4,
    derivative_spp=64,
    difference_spp=64,
    reference_spp=16,
    check_spp=2,
    loss_spp=4,
    resolutions=(2, 4),
    steps=(1, 1),
    step_spp=(1, 2),
)


def make_contest(gradients: dict[str, np.ndarray], times: dict[str, tuple[float, float]]) -> Contest:
    """A contest with these gradients (rounds, voxels), and with these wall-clock and processor times."""
    timings = {
        (name, 1): Timing({}, [times[name][0]] * len(g), [times[name][1]] * len(g), list(g)) for name, g in gradients.items()
    }
    return Contest(timings, dict.fromkeys(timings, 1))


@pytest.mark.slow
def test_density_0_tells_a_biased_estimator_from_mivol(variant_rgb: str) -> None:
    """At density 0 free flights never stop, so their derivative is exactly 0. mivol's is known to 5 %, and its seeds are
    fixed."""
    row = measure_row(make_cases(TINY.table_res)["density 0"], LIGHTS["constant light"], TINY)
    assert row[PEER]["bias_percent"] == pytest.approx(-100)
    assert row[MIVOL]["known_to_percent"] < 5
    assert abs(row[MIVOL]["bias_percent"]) < 15
    assert row[MIVOL]["spp"] == 64
    # The variance of the peer is 0 as well, so there is no ratio of use.
    assert row["variance_x_time"] == 0


def test_gradients_of_a_mean_and_of_a_loss(variant_rgb: str) -> None:
    """For the image less 3 as target, the derivative of the squared difference is 6 times that of the mean. The sum over voxels
    is known to a few percent by 64 samples of 16 pixels, and its seeds are fixed: 4 to 8 tells 6 from 1, 3 and 12."""
    gradient = LIGHTS["constant light"].gradients(np.full((2, 2, 2), 0.5, np.float32), 4)[MIVOL]
    image = mi.render(gradient.scene, integrator=gradient.integrator, spp=256, seed=1)
    mean, loss = np.array(gradient.of_mean(3, 64)), np.array(gradient.of_loss(square_error(image - 3), 3, 64))
    assert mean.shape == loss.shape == (8,)
    assert np.all(mean < 0)
    assert 4 < loss.sum() / mean.sum() < 8


def test_a_region_has_its_own_variance_and_derivative() -> None:
    """Gradients that swing by 1 about the same values, and by 2 in the dense half and in six times the processor time: 24
    there, 6 in the empty half. The derivative along sigma_t itself is that of the dense voxels only."""
    values = np.array([2.0, 2, 2, 2, 0, 0, 0, 0]).reshape(2, 2, 2)
    swing = np.array([-1.0, 1, -1, 1, -1, 1])[:, None]
    images = {PEER: 5 + swing * np.repeat([2.0, 1.0], 4), MIVOL: 5 + swing * np.ones(8)}
    figures = contest_figures(make_contest(images, {PEER: (3.0, 6.0), MIVOL: (1.0, 1.0)}), values, 4, 4)
    assert (figures["time"], figures["processor_time"]) == (3, 6)
    dense, empty = figures["sigma_t >= 1"], figures["sigma_t = 0"]
    assert (dense["variance_x_time"], empty["variance_x_time"]) == pytest.approx((24, 6))
    assert (dense["voxels"], dense["z"], dense["percent"]) == (4, 0, 0)
    # Four voxels of 2 with common deviations of 1 and of 2: variances of the sums 8^2 and 16^2, times 6/5 over 6.
    assert dense["standard_error_percent"] == pytest.approx(100 * math.sqrt((8**2 + 16**2) / 5) / 40)
    assert empty["standard_error_percent"] == pytest.approx(100 * math.sqrt((4**2 + 4**2) / 5) / 20)
    assert figures[PEER]["samples_per_second_median"] == pytest.approx(4 * 4 * 1 / 3)


def test_cases_change_where_they_say() -> None:
    """Directions are 1 in empty regions, and the medium itself elsewhere; its noise is within a half of 1."""
    cases = make_cases(8)
    assert {name: c.step for name, c in cases.items()} == {"density 0": 0.01, "half empty": 0.02, "thin": 0.1, "dense": 0.05}
    empty, half, thin, dense = cases.values()
    assert (empty.values == 0).all() and (empty.direction == 1).all()
    left = np.arange(8) < 4
    assert (half.values[..., left] == 0).all() and (half.direction[..., left] == 1).all()
    assert (half.direction[..., ~left] == 0).all()
    noise = dense.values / 10
    assert noise.min() >= 0.5 and noise.max() <= 1.5
    # A product and a quotient are rounded to 2^-53 each.
    np.testing.assert_allclose(half.values[..., ~left], 4 * noise[..., ~left], rtol=1e-15)
    np.testing.assert_allclose(thin.values, 0.05 * noise, rtol=1e-15)
    assert (thin.direction == thin.values).all() and (dense.direction == dense.values).all()


def test_differences_are_exact_for_a_parabola() -> None:
    """Central ones, and one-sided ones where a negative density would be needed; float64, step 0.01."""
    subject = SimpleNamespace(mean=lambda values, seed, spp: float(np.sum(3 * values + values**2)))
    for values, slope in ((np.zeros((2, 2, 2)), 3.0), (np.ones((2, 2, 2)), 5.0)):
        case = Case(values, np.ones((2, 2, 2)), 0.01)
        assert finite_difference(subject, case, 0, 1) == pytest.approx(8 * slope, rel=1e-11)  # 18 / (6 h) roundings of 40


def test_estimates_are_added_until_the_mean_is_known() -> None:
    """Values that swing by 1 about 10: the mean of n has the variance 1 / (n - 1), which is (1 % of 10)^2 at 101 or so."""
    numbers = []
    values = refine([9.0, 11.0] * 8, lambda k: numbers.append(k) or 9.0 + 2 * (k % 2), 1.0, 1000)
    assert len(values) in (101, 102)
    assert numbers == list(range(16, len(values)))
    assert len(refine(values, None, math.inf, 1000)) == len(values)
    assert len(refine(values, None, 0.0, len(values))) == len(values)
    assert len(refine(values, lambda k: 10.0, 0.0, len(values) + 3)) == len(values) + 3


def test_a_row_of_the_table_of_biases(monkeypatch: pytest.MonkeyPatch) -> None:
    """Differences of 3 and 5 in turns, mivol's derivatives of 4 and 5, those of prbvolpath of 3 and 5 with a swing of 3 in the
    empty half, in three times the processor time. Each use has its own seeds."""
    swing, seeds = np.array([-1.0, 1, -1, 1]), []
    images = {MIVOL: np.stack([7 * swing, 4 + swing], 1), PEER: np.stack([0 * swing, 4 + 3 * swing], 1)}
    contest = make_contest(images, {MIVOL: (1.0, 1.0), PEER: (5.0, 3.0)})
    gradients = {
        MIVOL: SimpleNamespace(of_mean=lambda seed, spp: seeds.append((seed, spp)) or [1.0, 4.0 + seed % 2]),
        PEER: SimpleNamespace(of_mean=None),
    }
    light = SimpleNamespace(gradients=lambda values, side: gradients)
    monkeypatch.setattr(study, "compete", lambda *_, **__: contest)
    monkeypatch.setattr(
        study, "finite_difference", lambda gradient, case, seed, spp: seeds.append((seed, spp)) or 3.0 + 2 * (seed % 2)
    )
    size = replace(TINY, table_rounds=4, seed=2)
    row = measure_row(Case(np.array([[[2.0, 0.0]]]), np.array([[[0.0, 1.0]]]), 0.1), light, size)
    assert seeds == [(209_000 + k, size.derivative_spp) for k in range(4)] + [
        (205_000 + k, size.difference_spp) for k in range(4)
    ]
    assert (row["truth"], row[MIVOL]["derivative"], row[PEER]["derivative"]) == pytest.approx((4, 4.5, 4))
    assert (row[MIVOL]["bias_percent"], row[PEER]["bias_percent"]) == pytest.approx((12.5, 0))
    assert (row[MIVOL]["variance"], row[PEER]["variance"]) == pytest.approx((4 / 3, 12))
    assert row["its_standard_error"] == pytest.approx(math.sqrt(1 / 3))
    assert row["variance_x_time"] == pytest.approx(27)


def test_the_smoke_stands_as_in_the_tutorial(variant_rgb: str, data_dir: Path) -> None:
    """The file under the rotation of the tutorial, and the turned array without rotation: equal values at equal positions."""
    path = data_dir / "volumes_vol" / "tutorials_volume.vol"
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2).translate(-0.5)
    rotated = mi.load_dict({"type": "gridvolume", "filename": str(path), "to_world": turn})
    grid = mi.VolumeGrid(turn_upright(read_volume(path, frame="unit").values[..., 0])[..., None])
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    upright = mi.load_dict({"type": "gridvolume", "grid": grid, "raw": True, "to_world": place})
    it = mi.Interaction3f()
    it.p = mi.Point3f(np.random.default_rng(0).uniform(-0.99, 0.99, (3, 500)).astype(np.float32))
    a, b = (np.array(v.eval_1(it)) for v in (rotated, upright))
    assert a.max() > 0.5
    # The rotation by cos(90 degrees) = 6e-17 moves a point by an ulp: 53 voxels * 6e-8 * a difference of at most 1.85.
    np.testing.assert_allclose(a, b, atol=2e-5)


def test_the_cameras_of_the_tutorial_stand_on_half_a_circle(variant_rgb: str) -> None:
    """4 away from the centre, their target, from -x over z towards x in steps of 36 degrees."""
    for i, sensor in enumerate(half_circle(4)):
        pose = np.array(sensor.world_transform().matrix).reshape(4, 4)
        angle = np.radians(36 * i - 90)
        place = 4 * np.array([np.sin(angle), 0, np.cos(angle)])
        # Rounded to 2^-24 of 4 by a few products of float32.
        np.testing.assert_allclose(pose[:3, 3], place, atol=2e-6)
        np.testing.assert_allclose(pose[:3, 2], -place / 4, atol=1e-6)
        np.testing.assert_allclose(pose[:3, 1], [0, 1, 0], atol=1e-6)
        assert tuple(sensor.film().size()) == (4, 4)


def test_voxels_are_read_at_their_centres(variant_rgb: str) -> None:
    """A ramp is reproduced by trilinear reading, but for the last half voxels; weights are rounded to 2^-24."""
    ramp = np.broadcast_to((np.arange(8, dtype=np.float32) + 0.5) / 8, (8, 8, 8))
    np.testing.assert_allclose(resample(ramp, 16)[3, 5, 1:-1], (np.arange(1, 15) + 0.5) / 16, atol=1e-6)


def test_losses_have_no_noise_in_their_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """The product of the errors of two renders, summed over cameras, each with its own seeds."""
    seeds = []

    def render(scene: str, sensor: str, integrator: str, spp: int, seed: int) -> np.ndarray:
        seeds.append(seed)
        return np.full((2, 2, 3), {"a": 1.0, "b": 5.0}[sensor] + (seed >= 20_000))

    monkeypatch.setattr(mi, "render", render)
    judge = Judge(["a", "b"], [np.full((2, 2, 3), 3.0), np.full((2, 2, 3), 2.0)], np.zeros((2, 2, 2)), 7)
    assert judge.loss("scene", 5, "integrator") == -2 * -1 + 3 * 4
    assert len(set(seeds)) == 4


def test_times_to_a_loss_are_read_off_the_clocks() -> None:
    """The lowest loss may lie before the last one; mivol may never reach it."""
    fast = Run([1.0, 2.0, 3.0], [1.0, 1.0, 1.0], [5.0, 0.9, 0.5], [0.9, 0.8, 0.7])
    slow = Run([20.0, 30.0, 60.0], [20.0, 20.0, 40.0], [4.0, 0.6, 1.0], [0.9, 0.85, 0.84])
    figures = compare_runs({MIVOL: fast, PEER: slow})
    last, lowest = figures["to_the_last_loss_of_prbvolpath"], figures["to_its_lowest_loss"]
    assert (last["sooner"], last["mivol_after_iterations"], last["seconds_of_mivol"]) == (30, 2, 2)
    assert (lowest["sooner"], lowest["mivol_after_iterations"], lowest["after_iterations"]) == (10, 3, 2)
    assert lowest["sooner_by_processor_time"] == 20
    assert lowest["density_errors"] == {MIVOL: 0.7, PEER: 0.85}
    assert figures["whole_schedule_is_faster"] == 20
    fast.loss = [5.0, 4.0, 3.0]
    never = compare_runs({MIVOL: fast, PEER: slow})["to_its_lowest_loss"]
    assert (never["mivol_after_iterations"], never["sooner"]) == (None, 0)


@pytest.mark.statistical
@pytest.mark.slow
def test_mivol_learns_in_the_tutorial(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The image loss falls to half at least within 2 x 2 iterations, and the references agree with volpath's."""
    monkeypatch.setattr(contests, "FALSE_ALARM", ALPHA)
    note(ALPHA, "references")
    answer = measure_tutorial(2, replace(TINY, side=12, reference_spp=64, loss_spp=16, resolutions=(4, 8), steps=(2, 2)))
    loss = answer["runs"][MIVOL]["loss"]
    assert loss[-1] < 0.5 * loss[0]
    assert abs(answer["references"]["z_against_volpath"]) <= answer["references"]["z_bound"]
    assert all(len(run["loss"]) == len(run["seconds"]) == 4 for run in answer["runs"].values())


def test_every_figure_has_its_bar() -> None:
    """A ratio and |z| for each light and functional of the smoke, two bounds on the bias of each case, and the tutorial."""
    dense = {"variance_x_time": 100.0, "z": -5.0, "z_bound": 4.0}
    smoke = {light: {"mean": {"sigma_t >= 1": dense}, "L2": {"sigma_t >= 1": dense}} for light in SMOKE}
    bars = STUDY.bars("smoke", smoke)
    assert [bar["met"] for bar in bars] == [True] * 4 + [False] * 4
    assert [bar["bar"] for bar in bars[:4]] == [light.bar for light in SMOKE.values() for _ in range(2)]
    figures = {"bias_percent": -0.3, "known_to_percent": 0.1, "bias_standard_errors": -3.0}
    bars = STUDY.bars("estimators", {light: {name: {MIVOL: figures} for name in make_cases(2)} for light in LIGHTS})
    assert [bar["value"] for bar in bars] == pytest.approx([0.6, 3.0] * 8)
    assert [bar["met"] for bar in bars] == [False, True] * 8
    run = {"to_the_last_loss_of_prbvolpath": {"sooner": 21.0}, "to_its_lowest_loss": {"sooner": 40.0}}
    assert [bar["met"] for bar in STUDY.bars("tutorial", run)] == [True]
    assert [bar["met"] for bar in STUDY.bars("deep tutorial", run)] == [False, True]


@pytest.mark.slow
def test_contests_and_tables_are_measured(variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A contest in the smoke and a table of biases, judged and drawn, under one light."""
    for lights in (LIGHTS, SMOKE):
        monkeypatch.delitem(lights, SUN)
    answers = STUDY.answer(("estimators", "smoke"), replace(TINY, side=4))
    assert len(answers.pop("bars")) == 2 * len(LIGHTS) * len(make_cases(2)) + 4 * len(SMOKE)
    for light in SMOKE:
        assert set(answers["estimators"][light]) == set(make_cases(2))
        for functional in ("mean", "L2"):
            assert answers["smoke"][light][functional]["sigma_t >= 1"]["variance_x_time"] > 0
    STUDY.draw(answers, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
