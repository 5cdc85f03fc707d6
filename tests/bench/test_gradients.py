"""The bench of gradients: ours agree with finite differences, prbvolpath's do not where they should not, and the arithmetic
of its tables is right. Samples are fixed; no time decides."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import ALPHA, note
from scipy import stats

from mivol.bench.harness import agreement
from mivol.bench.harness.timing import Budget, Timing
from mivol.bench.studies.gradients import BENCH, QUICK, bias, tutorial, variance
from mivol.bench.studies.gradients.bias import Case, cases, difference, refine, table_row
from mivol.bench.studies.gradients.size import CONTESTS, OURS, STOCK, TABLES
from mivol.bench.studies.gradients.subject import compete, subjects
from mivol.bench.studies.gradients.tutorial import (
    Run,
    at_voxels,
    finish,
    half_circle,
    measure_tutorial,
    optimise,
    upright,
    warm_up,
)
from mivol.bench.studies.gradients.variance import measure_contest, outcome
from mivol.files import read_volume

LIGHTS = TABLES["estimators"]
SMOKE = CONTESTS["smoke"][1]

TINY = replace(
    QUICK,
    rounds=3,
    side=6,
    budget=Budget(spp=4),
    table_rounds=8,
    table_side=6,
    table_budget=Budget(spp=64),
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


def test_budgets_are_kept(variant_rgb: str) -> None:
    """Contestants get the samples of the budget, and a seed of their own in each round."""
    calls = []
    steps = {name: lambda seed, spp, name=name: calls.append((name, seed, spp)) or mi.Float(1) for name in (OURS, STOCK)}
    _, spp = compete(steps, Budget(spp=4), 2)
    assert spp == {OURS: 4, STOCK: 4}
    assert {n for _, _, n in calls} == {4}
    assert len({seed for _, seed, _ in calls}) == len(calls) == 6


@pytest.mark.slow
def test_density_0_tells_a_biased_estimator_from_ours(variant_rgb: str) -> None:
    """Where the density is 0 free flights never stop, and their derivative is exactly 0. Ours is known to 5 %, and its
    seeds are fixed: a miss of the bound by chance would have been seen when they were chosen."""
    row = table_row(cases(TINY.table_res)["density 0"], LIGHTS["constant light"], TINY)
    assert row[STOCK]["bias_percent"] == pytest.approx(-100)
    assert row[OURS]["known_to_percent"] < 5
    assert abs(row[OURS]["bias_percent"]) < 15
    assert row[OURS]["spp"] == 64


@pytest.mark.slow
def test_gradients_of_a_mean_and_of_a_loss(variant_rgb: str) -> None:
    """Against the picture less 3, the derivative of the squared difference is 6 times that of the mean. The sum over voxels is
    known to a few percent by 64 samples of 16 pixels, and its seeds are fixed: 4 to 8 tells it from 1, 3 and 12."""
    ours = subjects(np.full((2, 2, 2), 0.5, np.float32), 4, LIGHTS["constant light"])[OURS]
    picture = mi.render(ours.scene, integrator=ours.integrator, spp=256, seed=1)
    mean, loss = np.array(ours.of_mean(3, 64)), np.array(ours.of_loss(picture - 3, 3, 64))
    assert mean.shape == loss.shape == (8,)
    assert np.all(mean < 0)
    assert 4 < loss.sum() / mean.sum() < 8


def test_a_region_has_its_own_variance_and_derivative() -> None:
    """Gradients that swing by 1 about the same values, and by 2 in the dense half and in six times the processor time: 24
    there, 6 in the empty half; the derivative along sigma_t itself is that of the dense voxels only."""
    values = np.array([2.0, 2, 2, 2, 0, 0, 0, 0]).reshape(2, 2, 2)
    swing = np.array([-1.0, 1, -1, 1, -1, 1])[:, None]
    slow = Timing({}, [3.0] * 6, [6.0] * 6, list(5 + swing * np.repeat([2.0, 1.0], 4)))
    fast = Timing({}, [1.0] * 6, [1.0] * 6, list(5 + swing * np.ones(8)))
    regions = {"dense": values > 0, "empty": values == 0}
    found = outcome({OURS: fast, STOCK: slow}, {OURS: 1, STOCK: 2}, regions, values, 4, 4)
    assert (found["time"], found["processor_time"]) == (3, 6)
    assert found["dense"]["variance_x_time"] == pytest.approx(24)
    assert found["empty"]["variance_x_time"] == pytest.approx(6)
    assert (found["dense"]["voxels"], found["dense"]["z"], found["dense"]["percent"]) == (4, 0, 0)
    # four voxels of 2, each with a deviation of 1 and of 2 that all share: variances of sums 8^2 and 16^2 times 6/5 over 6
    error = math.sqrt((8**2 + 16**2) / 5) / 40
    assert found["dense"]["standard_error_percent"] == pytest.approx(100 * error)
    assert found["empty"]["standard_error_percent"] == pytest.approx(100 * math.sqrt((4**2 + 4**2) / 5) / 20)
    assert found[STOCK]["samples_per_second_median"] == pytest.approx(4 * 4 * 2 / 3)


def test_every_figure_has_its_bar() -> None:
    """A ratio and |z| for each light and functional of the smoke, two bounds on the bias of each case, one of the tutorial."""
    dense = {"variance_x_time": 100.0, "z": -5.0, "z_bound": 4.0}
    smoke = {light: {"mean": {"sigma_t >= 1": dense}, "L2": {"sigma_t >= 1": dense}} for light in SMOKE}
    rows = BENCH.compare("smoke", smoke)
    assert [row["met"] for row in rows] == [True, False] * 4
    assert [row["bar"] for row in rows[::2]] == [light.bar for light in SMOKE.values() for _ in range(2)]
    ours = {"bias_percent": -0.3, "known_to_percent": 0.1, "bias_standard_errors": -3.0}
    table = {light: {name: {OURS: ours} for name in cases(2)} for light in LIGHTS}
    rows = BENCH.compare("estimators", table)
    assert [row["value"] for row in rows] == pytest.approx([0.6, 3.0] * 8)
    assert [row["met"] for row in rows] == [False, True] * 8
    run = {"to_the_last_loss_of_prbvolpath": {"sooner": 21.0}, "to_its_lowest_loss": {"sooner": 40.0}}
    assert [row["met"] for row in BENCH.compare("tutorial", run)] == [True]
    assert [row["met"] for row in BENCH.compare("deep tutorial", run)] == [False, True]


@pytest.mark.slow
def test_every_question_is_answered(variant_rgb: str, tmp_path: Path) -> None:
    """Figures of all three questions are there, compared and drawn; what they are is for the sizes that are quoted."""
    answers = BENCH.ask(("estimators", "tutorial"), TINY)
    answers["smoke"] = measure_contest("smoke", replace(TINY, side=4))
    bars = answers.pop("bars") + BENCH.compare("smoke", answers["smoke"])
    assert len(bars) == 2 * len(LIGHTS) * len(cases(2)) + 1 + 4 * len(SMOKE)
    for light in SMOKE:
        assert set(answers["estimators"][light]) == set(cases(2))
        for functional in ("mean", "L2"):
            assert answers["smoke"][light][functional]["sigma_t >= 1"]["variance_x_time"] > 0
    for run in answers["tutorial"]["runs"].values():
        assert len(run["loss"]) == len(run["seconds"]) == sum(TINY.steps)
    BENCH.draw(answers, tmp_path)
    assert (tmp_path / "bench_gradients.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.statistical
@pytest.mark.slow
def test_the_tutorial_of_mivol_learns(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its image loss falls to a half at least within 2 x 2 iterations, and its references are those of volpath."""
    monkeypatch.setattr(agreement, "FALSE_ALARM", ALPHA)
    note(ALPHA, "references")
    answer = measure_tutorial(2, replace(TINY, side=12, reference_spp=64, loss_spp=16, resolutions=(4, 8), steps=(2, 2)))
    ours = answer["runs"][OURS]["loss"]
    assert ours[-1] < 0.5 * ours[0]
    assert abs(answer["references"]["z_against_volpath"]) <= answer["references"]["z_bound"]


def test_cases_change_where_they_say() -> None:
    """Directions are 1 where nothing is, and the medium itself elsewhere; its noise is a half about 1."""
    found = cases(8)
    steps = {"density 0": 0.01, "half empty": 0.02, "thin": 0.1, "dense": 0.05}
    assert {name: case.step for name, case in found.items()} == steps
    empty, half, thin, dense = found.values()
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
        assert difference(subject, case, 0, 1) == pytest.approx(8 * slope, rel=1e-11)  # 18 / (6 h) roundings of 40


def test_refined_until_the_mean_is_known_well_enough() -> None:
    """Values that swing by 1 about 10: the mean of n has the variance 1 / (n - 1), which is (1 % of 10)^2 at 101 or so."""
    numbers = []
    found = refine([9.0, 11.0] * 8, lambda k: numbers.append(k) or 9.0 + 2 * (k % 2), 1.0, 1000)
    assert len(found) in (101, 102)
    assert numbers == list(range(16, len(found)))
    assert len(refine(found, None, math.inf, 1000)) == len(found)
    assert len(refine(found, None, 0.0, len(found))) == len(found)
    assert len(refine(found, lambda k: 10.0, 0.0, len(found) + 3)) == len(found) + 3


def test_the_smoke_stands_as_in_the_tutorial(variant_rgb: str, data_dir: Path) -> None:
    """The file under the tutorial's rotation, and the turned array without one: the same values at the same places."""
    path = data_dir / "volumes_vol" / "tutorials_volume.vol"
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(2).translate(-0.5)
    theirs = mi.load_dict({"type": "gridvolume", "filename": str(path), "to_world": turn})
    grid = mi.VolumeGrid(upright(read_volume(path, frame="unit").values[..., 0])[..., None])
    place = mi.ScalarTransform4f().translate(-1).scale(2)
    ours = mi.load_dict({"type": "gridvolume", "grid": grid, "raw": True, "to_world": place})
    it = mi.Interaction3f()
    it.p = mi.Point3f(np.random.default_rng(0).uniform(-0.99, 0.99, (3, 500)).astype(np.float32))
    a, b = (np.array(v.eval_1(it)) for v in (theirs, ours))
    assert a.max() > 0.5
    # the rotation by cos(90 degrees) = 6e-17 moves a point by an ulp: 53 voxels * 6e-8 * a difference of at most 1.85
    np.testing.assert_allclose(a, b, atol=2e-5)


def test_the_tutorials_cameras_stand_on_half_a_circle(variant_rgb: str) -> None:
    """4 away from the middle, which they look at, from -x over z towards x in steps of 36 degrees."""
    for i, sensor in enumerate(half_circle(4)):
        pose = np.array(sensor.world_transform().matrix).reshape(4, 4)
        angle = np.radians(36 * i - 90)
        place = 4 * np.array([np.sin(angle), 0, np.cos(angle)])
        # Rounded to 2^-24 of 4 by a few products of float32.
        np.testing.assert_allclose(pose[:3, 3], place, atol=2e-6)
        np.testing.assert_allclose(pose[:3, 2], -place / 4, atol=1e-6)
        np.testing.assert_allclose(pose[:3, 1], [0, 1, 0], atol=1e-6)
        assert tuple(sensor.film().size()) == (4, 4)


@pytest.mark.slow
def test_the_tutorials_loop_follows_its_references(variant_rgb: str) -> None:
    """Matter takes more of the constant light than it scatters: a first step of Adam, of its rate, thins the smoke where the
    reference is brighter and thickens it where that is darker."""
    sensors, found = half_circle(2, 1), {}
    for light in (0.0, 2.0):
        judge = SimpleNamespace(
            sensors=sensors,
            references=[dr.full(mi.TensorXf, light, (2, 2, 3))],
            loss=lambda *_: 0.0,
            density_error=lambda values: float(values.mean()),
        )
        (run,) = optimise(OURS, 2, judge, replace(TINY, resolutions=(2,), steps=(1,), step_spp=(4,)))
        found[light] = run.density_error[0]
    # From 0.002 by 0.02, and not below 1e-6.
    assert found == pytest.approx({0.0: 0.022, 2.0: 1e-6}, rel=1e-3)


def test_when_ours_is_there_is_read_off_its_own_clock() -> None:
    """Its lowest loss may lie before the last one."""
    ours = Run([1.0, 2.0, 3.0], [1.0, 1.0, 1.0], [5.0, 0.9, 0.5], [0.9, 0.8, 0.7])
    theirs = Run([20.0, 30.0, 60.0], [20.0, 20.0, 40.0], [4.0, 0.6, 1.0], [0.9, 0.85, 0.84])
    got = finish({OURS: ours, STOCK: theirs})
    last, lowest = got["to_the_last_loss_of_prbvolpath"], got["to_its_lowest_loss"]
    assert (last["mivol_after_iterations"], last["sooner"], last["sooner_by_processor_time"]) == (2, 30.0, 40.0)
    assert last["density_errors"] == {OURS: 0.8, STOCK: 0.84}
    assert lowest == {
        "loss": 0.6,
        "after_iterations": 2,
        "seconds_of_prbvolpath": 30.0,
        "mivol_after_iterations": 3,
        "seconds_of_mivol": 3.0,
        "sooner": 10.0,
        "sooner_by_processor_time": 20.0,
        "density_errors": {OURS: 0.7, STOCK: 0.85},
    }
    assert got["whole_schedule_is_faster"] == 20.0
    assert got["ends"] == {OURS: {"loss": 0.5, "density_error": 0.7}, STOCK: {"loss": 1.0, "density_error": 0.84}}
    ours.loss = [5.0, 4.0, 3.0]
    never = finish({OURS: ours, STOCK: theirs})["to_its_lowest_loss"]
    assert (never["mivol_after_iterations"], never["sooner"]) == (None, 0)
    ours.loss = [5.0, 0.6, 0.5]
    assert finish({OURS: ours, STOCK: theirs})["to_its_lowest_loss"]["mivol_after_iterations"] == 2


def test_voxels_are_read_at_their_centres(variant_rgb: str) -> None:
    """A ramp is reproduced by trilinear reading, but for the last half voxels; weights are rounded to 2^-24."""
    ramp = np.broadcast_to((np.arange(8, dtype=np.float32) + 0.5) / 8, (8, 8, 8))
    fine = at_voxels(ramp, 16)
    np.testing.assert_allclose(fine[3, 5, 1:-1], (np.arange(1, 15) + 0.5) / 16, atol=1e-6)


def test_a_warm_up_takes_one_step_of_each_stage() -> None:
    small = warm_up(replace(QUICK, resolutions=(2, 4, 8), steps=(5, 6, 7), step_spp=(8, 9, 10)))
    assert (small.steps, small.step_spp, small.resolutions) == ((1, 1, 1), (1, 1, 1), (2, 4, 8))


def test_each_contestant_has_its_own_seeds(variant_rgb: str) -> None:
    """Another seed of a size moves them all by 100,000; the first call of a race has the number 0."""
    calls = []
    steps = {name: lambda seed, spp, name=name: calls.append((name, seed)) or mi.Float(1) for name in (OURS, STOCK)}
    compete(steps, Budget(spp=4), 1, seed=3)
    assert calls == [(OURS, 301_000), (STOCK, 302_000), (STOCK, 302_001), (OURS, 301_001)]


def test_contests_of_the_smoke(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two functionals in each light, against the picture of 0.7 of the density; regions at and above 1, between, and at 0."""
    values = np.array([0.0, 0.5, 1.0, 2.0]).reshape(1, 2, 2)
    found = SimpleNamespace(values=values, __str__=lambda self: "smoke")
    lights = {"sun": SimpleNamespace(bar=1, rounds=1), "sky": SimpleNamespace(bar=2, rounds=3)}
    monkeypatch.setitem(variance.CONTESTS, "smoke", (lambda: found, lights))
    monkeypatch.setattr(variance, "picture_of", lambda values, size, light: ("picture", values, light))
    heard, said = [], []

    def both(values: np.ndarray, side: int, light: object) -> dict:
        of_loss = lambda target, seed, spp: ("loss", light, target, seed, spp)  # noqa: E731
        return {who: SimpleNamespace(of_mean=(who, side, light), of_loss=of_loss) for who in (OURS, STOCK)}

    def outcome_of(*asked: object) -> dict:
        heard.append(asked)
        return {"asked": len(heard)}

    monkeypatch.setattr(variance, "subjects", both)
    monkeypatch.setattr(variance, "compete", lambda steps, budget, rounds, seed: ((steps, budget, rounds, seed), "spp"))
    monkeypatch.setattr(variance, "outcome", outcome_of)
    monkeypatch.setattr(variance, "said", lambda figures: f"{figures['asked']}")
    monkeypatch.setattr(variance, "say", said.append)
    size = replace(TINY, seed=5)
    answer = variance.ask_contest("smoke")(size)
    assert answer.pop("grid") == str(found)
    assert answer == {"sun": {"mean": {"asked": 1}, "L2": {"asked": 2}}, "sky": {"mean": {"asked": 3}, "L2": {"asked": 4}}}
    assert said == ["  sun, mean: 1", "  sun, L2: 2", "  sky, mean: 3", "  sky, L2: 4"]
    for (race, spp, regions, given, side, contests), name in zip(heard, ("sun", "sun", "sky", "sky"), strict=True):
        rounds = size.rounds * lights[name].rounds
        assert (spp, side, contests, race[1:]) == ("spp", size.side, 4, (size.budget, rounds, 5)) and given is values
        chosen = {region: mask.ravel().tolist() for region, mask in regions.items()}
        assert chosen == {
            "sigma_t >= 1": [False, False, True, True],
            "0 < sigma_t < 1": [False, True, False, False],
            "sigma_t = 0": [True, False, False, False],
        }
        assert set(race[0]) == {OURS, STOCK} and lights[name] is not None
    assert heard[0][0][0][OURS] == (OURS, size.side, lights["sun"])
    _, light, (_, fainter, at), *rest = heard[3][0][0][STOCK](8, 9)
    assert (light, at, rest) == (lights["sky"], lights["sky"], [8, 9])
    assert fainter.tolist() == (0.7 * values).tolist()


def test_a_target_is_rendered_with_many_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    light = SimpleNamespace(scene=lambda values, side: (values, side), integrator=lambda name: name)
    monkeypatch.setattr(variance.mi, "render", lambda scene, **given: (scene, given))
    found = variance.picture_of("values", TINY, light)
    assert found == (("values", TINY.side), {"integrator": OURS, "seed": 77, "spp": TINY.difference_spp})


def test_what_is_said_of_a_contest() -> None:
    dense = {"variance_x_time": 61.6, "z": -1.25, "percent": 0.5, "standard_error_percent": 0.25}
    rates = {name: {"samples_per_second_median": rate} for name, rate in ((OURS, 2.5e6), (STOCK, 1e6))}
    line = variance.said({"sigma_t >= 1": dense, "processor_time": 3.0, "time": 2.0} | rates)
    assert line == f"62x, by the clock 0.67 of that (z -1.25, +0.50 % +- 0.25); M samples/s: {OURS} 2.5, {STOCK} 1"


def test_a_row_of_the_table_of_bias(monkeypatch: pytest.MonkeyPatch) -> None:
    """Differences of 3 and 5 in turns, our derivatives of 4 and 2, those of the other of 2 and 4 with a swing of 3 in the empty
    half; each seed says what it is for."""
    values, direction = np.array([[[2.0, 0.0]]]), np.array([[[0.0, 1.0]]])
    swing = np.array([-1.0, 1, -1, 1])
    slow = Timing({}, [5.0] * 4, [3.0] * 4, list(np.stack([0 * swing, 4 + 3 * swing], 1)))
    fast = Timing({}, [1.0] * 4, [1.0] * 4, list(np.stack([7 * swing, 4 + swing], 1)))
    asked, refined = [], []
    ours = SimpleNamespace(of_mean=lambda seed, spp: asked.append(("derivative", seed, spp)) or [1.0, 4.0 + seed % 2])
    other = SimpleNamespace(of_mean="theirs")
    monkeypatch.setattr(bias, "subjects", lambda values, side, light: asked.append((values.dtype.name, side, light))
                        or {OURS: ours, STOCK: other})  # fmt: skip
    competed = ({OURS: fast, STOCK: slow}, {OURS: 8, STOCK: 2})
    monkeypatch.setattr(bias, "compete", lambda steps, *rest: asked.append((steps, *rest)) or competed)
    differ = lambda subject, case, seed, spp: asked.append((subject, seed, spp)) or 3.0 + 2 * (seed % 2)  # noqa: E731
    monkeypatch.setattr(bias, "difference", differ)

    def refine_by_one(found: list, estimate: object, percent: float, most: int) -> np.ndarray:
        refined.append((list(found), percent, most))
        return np.array([*found, estimate(len(found))])

    monkeypatch.setattr(bias, "refine", refine_by_one)
    size = replace(TINY, table_rounds=4, seed=2, certain_percent=0.5, most_estimates=40)
    row = table_row(Case(values, direction, 0.1), "light", size, 6)
    assert asked[:2] == [
        ("float32", size.table_side, "light"),
        ({OURS: ours.of_mean, STOCK: "theirs"}, size.table_budget, 4, 2),
    ]
    ours_asked = [("derivative", 209_000 + k, size.derivative_spp) for k in range(5)]
    assert asked[2:] == [*ours_asked, *((ours, 205_000 + k, size.difference_spp) for k in range(5))]
    assert refined == [([4.0, 5.0, 4.0, 5.0], 0.5, 40), ([3.0, 5.0, 3.0, 5.0], 0.5, 40)]
    # five derivatives of 4, 5, 4, 5, 4; five differences of 3, 5, 3, 5, 3
    assert (row["truth"], row[OURS]["derivative"], row[STOCK]["derivative"]) == pytest.approx((3.8, 4.4, 4.0))
    assert row["its_standard_error"] == pytest.approx(math.sqrt(1.2 / 5))
    assert (row[OURS]["bias_percent"], row[STOCK]["bias_percent"]) == pytest.approx((100 * 0.6 / 3.8, 100 * 0.2 / 3.8))
    assert (row[OURS]["variance"], row[STOCK]["variance"]) == pytest.approx((4 / 3, 12))
    assert (row[OURS]["spp"], row[STOCK]["spp"], row[OURS]["seconds_median"], row[STOCK]["seconds_median"]) == (8, 2, 1, 5)
    assert row["variance_x_time"] == pytest.approx(27)
    still = Timing({}, [1.0] * 4, [1.0] * 4, [np.ones(2)] * 4)
    monkeypatch.setattr(bias, "compete", lambda *_: ({OURS: still, STOCK: slow}, {OURS: 8, STOCK: 2}))
    assert table_row(Case(values, direction, 0.1), "light", size)["variance_x_time"] is None


def test_truth_is_a_difference_or_the_twins(monkeypatch: pytest.MonkeyPatch) -> None:
    """A case with a step is a difference of our pictures; one without is for the twin."""
    monkeypatch.setattr(bias, "difference", lambda *asked: ("difference", *asked))
    twin = lambda *asked: SimpleNamespace(derivative=lambda seed, spp: ("twin", *asked, seed, spp))  # noqa: E731
    monkeypatch.setattr(bias, "Twin", twin)
    stepped, smooth = Case("values", "direction", 0.1), Case("values", "direction")
    assert bias.truth_of(stepped, "light", "ours", TINY)(7) == ("difference", "ours", stepped, 7, TINY.difference_spp)
    found = bias.truth_of(smooth, "light", "ours", TINY)(7)
    assert found == ("twin", "values", "direction", TINY.table_side, "light", 7, TINY.difference_spp)


def test_tables_of_bias_ask_every_case(monkeypatch: pytest.MonkeyPatch) -> None:
    """In each light, with the bound on z for all rows of the question."""
    monkeypatch.setattr(bias, "table_row", lambda case, light, size, rows: (case.values.shape, light, size, rows))
    monkeypatch.setattr(bias, "said_of_row", lambda row: "said")
    size = replace(TINY, table_res=3)
    names = ("density 0", "half empty", "thin", "dense")
    wanted = {name: {case: ((3, 3, 3), light, size, 4 * len(LIGHTS)) for case in names} for name, light in LIGHTS.items()}
    assert bias.ask_table("estimators")(size) == wanted
    deep = TABLES["deep estimators"]
    halves = dict.fromkeys(deep, "half empty") | {"glass, unlimited": "half thin"}
    wanted = {
        name: {case: ((3, 3, 3), light, size, 2 * len(deep)) for case in (halves[name], "dense")}
        for name, light in deep.items()
    }
    assert bias.ask_table("deep estimators")(size) == wanted


def test_the_tutorials_questions(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """References of the upright smoke over 40 by mivol, checked against volpath; both loops warmed up, then run; seeds by
    camera."""
    values = np.arange(24.0, dtype=np.float32).reshape(2, 3, 4)
    found = SimpleNamespace(values=values, __str__=lambda self: "smoke")
    heard, rendered, loops = [], [], []
    monkeypatch.setattr(tutorial, "smoke", lambda: found)
    monkeypatch.setattr(tutorial, "half_circle", lambda side: [f"camera {k}, {side}" for k in range(2)])
    monkeypatch.setattr(tutorial, "make_integrator", lambda name, depth: f"{name} {depth}")
    monkeypatch.setattr(tutorial, "tutorial_scene", lambda tensor: np.array(tensor))
    monkeypatch.setattr(tutorial.mi, "load_dict", lambda scene: scene)

    def render(scene: np.ndarray, sensor: str, integrator: str, spp: int, seed: int) -> mi.Float:
        rendered.append((sensor, integrator, spp, seed))
        return mi.Float(seed)

    monkeypatch.setattr(tutorial.mi, "render", render)
    monkeypatch.setattr(tutorial, "check_references", lambda *asked: heard.append(asked) or "checked")

    def run_loop(name: str, depth: int, judge: tutorial.Judge, size: object) -> list[Run]:
        loops.append((name, depth, size))
        heard.append(judge)
        return [Run([1.0], [2.0], [0.5], [0.25]), Run([1.0, 2.0], [2.0, 3.0], [0.5, 0.4], [0.25, 0.2])]

    monkeypatch.setattr(tutorial, "optimise", run_loop)
    monkeypatch.setattr(tutorial, "finish", lambda runs: {"runs": runs})
    said = []
    monkeypatch.setattr(tutorial, "say", said.append)
    answer = tutorial.ask_tutorial("tutorial")(TINY)
    assert rendered == [(f"camera {k}, {TINY.side}", f"{OURS} 2", TINY.reference_spp, k) for k in range(2)]
    scene, sensors, references, volpath, spp = heard[0]
    truth = upright(values / 40)
    assert np.array_equal(scene, truth[..., None]) and [float(r[0]) for r in references] == [0, 1]
    assert (sensors, volpath, spp) == ([f"camera {k}, {TINY.side}" for k in range(2)], "volpath 2", TINY.check_spp)
    assert loops == [(name, 2, size) for size in (warm_up(TINY), TINY) for name in (OURS, STOCK)]
    judge = heard[1]
    assert (judge.sensors, judge.references, judge.spp) == (sensors, references, TINY.loss_spp)
    assert np.array_equal(judge.truth, at_voxels(truth, 4))
    assert answer["grid"] == str(found) and answer["references"] == "checked"
    assert {name: run.loss for name, run in answer["runs"].items()} == {OURS: [0.5, 0.4], STOCK: [0.5, 0.4]}
    assert said[:2] == [
        f"  {OURS}   1:     1.0 s (processor 2.0), loss 0.50000, density 0.250",
        f"  {OURS}   2:     2.0 s (processor 3.0), loss 0.40000, density 0.200",
    ]


def test_losses_have_no_noise_in_their_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    """The product of the errors of two renders, summed over cameras, each with seeds of its own."""
    seeds = []

    def render(scene: str, sensor: str, integrator: str, spp: int, seed: int) -> np.ndarray:
        seeds.append((sensor, spp, seed))
        return np.full((2, 2, 3), {"a": 1.0, "b": 5.0}[sensor] + (seed >= 20_000))

    monkeypatch.setattr(tutorial.mi, "render", render)
    judge = tutorial.Judge(["a", "b"], [np.full((2, 2, 3), 3.0), np.full((2, 2, 3), 2.0)], np.zeros((2, 2, 2)), 7)
    assert judge.loss("scene", 5, "eye") == -2 * -1 + 3 * 4
    assert seeds == [("a", 7, 10_005), ("a", 7, 20_005), ("b", 7, 10_105), ("b", 7, 20_105)]


def test_references_are_checked_in_eight_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches of 2 and 4 in turns, whose mean 3 is known to 1 / sqrt(7), against references of 1 and 2."""
    seeds = []

    def render(scene: str, sensor: str, integrator: str, spp: int, seed: int) -> np.ndarray:
        seeds.append(seed)
        return np.full((2, 2, 3), 3.0 - 1 + 2 * (seed // 100 % 2))

    monkeypatch.setattr(tutorial.mi, "render", render)
    references = [np.full((2, 2, 3), 1.0), np.full((2, 2, 3), 2.0)]
    found = tutorial.check_references("scene", ["a", "b"], references, "volpath", 3)
    assert seeds == [100 * b + k for b in range(8) for k in range(2)]
    error = math.sqrt(8 / 7 / 8)
    assert (found["mean"], found["z_against_volpath"]) == pytest.approx((1.5, -1.5 / error))
    assert found["relative_standard_error"] == pytest.approx(error / 3)
    assert found["z_bound"] == pytest.approx(stats.t.isf(agreement.FALSE_ALARM / 2, 7), rel=1e-6)


@pytest.mark.slow
def test_the_tutorials_loop_has_two_stages(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seeds are the number of the iteration, for each camera; the loss is judged with others in each stage; the second stage
    has the finer grid and goes on from where the first one was."""
    seeds, judged, shapes = [], [], []
    every = mi.render

    def render(*given: object, **asked: object) -> mi.TensorXf:
        seeds.append((asked["spp"], asked["seed"]))
        return every(*given, **asked)

    monkeypatch.setattr(tutorial.mi, "render", render)
    judge = SimpleNamespace(
        sensors=half_circle(2, 2),
        references=[dr.full(mi.TensorXf, 0.0, (2, 2, 3))] * 2,
        loss=lambda scene, seed, eye: judged.append(seed) or 0.5,
        density_error=lambda values: shapes.append((values.shape, float(values.mean()))) or 0.25,
    )
    (*_, run) = optimise(OURS, 2, judge, replace(TINY, resolutions=(2, 4), steps=(2, 1), step_spp=(4, 2)))
    assert seeds == [(4, 0), (4, 0), (4, 1), (4, 1), (2, 0), (2, 0)]
    assert judged == [0, 1, 1000]
    assert [shape for shape, _ in shapes] == [(2, 2, 2), (2, 2, 2), (4, 4, 4)]
    # Two steps of Adam from 0.002, of its rate or nearly so, and smaller ones later on, all of them up.
    means = [mean for _, mean in shapes]
    assert means[0] == pytest.approx(0.042, rel=0.1) and means == sorted(means)
    assert (run.loss, run.density_error) == ([0.5] * 3, [0.25] * 3)
    assert len(run.seconds) == len(run.processor) == 3 and run.seconds == sorted(run.seconds)
