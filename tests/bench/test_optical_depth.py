"""The bench of optical depths: its contestants compute the same, and its errors, which no machine moves, are within their bars.

Everything runs in this process at sizes of a few hundred rays; times are looked at by nobody.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_bounded_mean
from oracle import tau_scale, tau_twin

from mivol.bench.extinctions import TO_WORLD
from mivol.bench.harness.timing import Timing
from mivol.bench.studies.optical_depth import BENCH, PROMISES, QUESTIONS, QUICK, accuracy, cost
from mivol.bench.studies.optical_depth.accuracy import measure_accuracy, measure_image
from mivol.bench.studies.optical_depth.cost import gradient_step, measure_grids, measure_memory, measure_reverse, measure_walk
from mivol.bench.studies.optical_depth.peers import by_tracking, by_volpath, delta, measure_peers, ratio
from mivol.bench.studies.optical_depth.twin import exact_tau
from mivol.bench.studies.optical_depth.work import Work, camera_rays, rays_across, shuffled
from mivol.report.figures import SERIES

METHODS = ("mivol", "volpath", "ratio tracking", "delta tracking", "marching", "drjit.dda.integrate")
EPS = 2.0**-24
TINY = replace(
    QUICK,
    rounds=1,
    walk_side=32,
    image_side=8,
    exact_pixels=4,
    exact_rays=256,
    memory_res=(16,),
    memory_sides=(64, 128),
    grid_side=32,
    ct_res=16,
    sparse_res=64,
    peer_rounds=1,
    peer_side=16,
    peer_spp=(1,),
    volpath_spp=(1,),
)


def timings(answer: object) -> list[dict]:
    """Every timed contestant in an answer."""
    if isinstance(answer, dict):
        return [answer] if "seconds_median" in answer else [t for v in answer.values() for t in timings(v)]
    return [t for v in answer for t in timings(v)] if isinstance(answer, list) else []


@pytest.mark.slow
def test_bars_are_found_in_the_answers_that_they_judge(variant_rgb: str) -> None:
    """Each question is answered with times above 0, and each bar finds its figure; that of 256^3 needs the full size."""
    assert {p.question for p in PROMISES} <= set(QUESTIONS)
    for question in (measure_walk, measure_image, measure_reverse):
        answer = question(TINY)
        assert timings(answer)
        for t in timings(answer):
            assert 0 < t["seconds_min"] <= t["seconds_median"]
            assert set(t["first_call"]) == {"seconds", "compile_seconds", "kernels_compiled", "kernels_from_disk"}
        (name,) = (name for name, asked in QUESTIONS.items() if asked is question)
        assert [bar["figure"] for bar in BENCH.compare(name, answer)] == [p.figure for p in PROMISES if p.question == name]


@pytest.mark.slow
def test_error_of_optical_depths(variant_rgb: str) -> None:
    """It is rounding, the same on every machine, so the bar decides; empty rays have an optical depth of 0 exactly."""
    answer = measure_accuracy(TINY)
    (bar,) = BENCH.compare("accuracy", answer)
    assert bar["met"], bar
    assert all(figures["error_where_exactly_empty"] == 0 for figures in answer.values())
    assert {"64^3 noise", "64^3 noise, empty blocks skipped", "drjit.dda.integrate, 64^3 noise"} <= set(answer)


def test_memory_of_a_gradient_step(variant_rgb: str) -> None:
    """Bytes a ray are the same on every machine too."""
    (bar,) = BENCH.compare("memory", measure_memory(TINY))
    assert bar["met"], bar


@pytest.mark.slow
def test_exact_peers_are_exact_and_marching_is_of_second_order(variant_rgb: str, tmp_path) -> None:
    """A peer that computes something else would make every ratio of times meaningless."""
    peers = measure_peers(TINY)
    worst = {name: peers[name][-1]["rms_error"] for name in METHODS}
    # exact: exp(-tau) tau <= 1/e, and each of at most 150 cells rounds a share of tau by a few EPS
    assert worst["mivol"] <= 4 * 150 * EPS / math.e
    assert worst["drjit.dda.integrate"] <= 4 * 150 * EPS / math.e
    # 2nd order: a quarter of the step, a sixteenth of the error; 1st order would be a quarter, 8 lies between
    steps = [row["rms_error"] for row in peers["marching"]]
    assert all(fine <= coarse / 8 for coarse, fine in itertools.pairwise(steps))
    assert worst["mivol"] < min(worst[name] for name in METHODS[1:])
    assert len(METHODS) <= len(SERIES)
    BENCH.draw({"peers": peers}, tmp_path)
    assert (tmp_path / "bench_optical_depth.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.statistical
def test_random_peers_have_the_exact_mean(variant_rgb: str, seed: int) -> None:
    """Every walk returns a transmittance in [0, 1]: by Hoeffding's bound, which needs no variance, 16,384 of them miss a mean
    of 0.4 by 0.02 at most, but for one time in 10^8 a method."""
    side, spp = 16, 64
    work = Work(np.random.default_rng(2).uniform(0, 2, (5, 4, 6)).astype(np.float32), *camera_rays(side))
    index, o, d = work.spread(side * side)
    assert len(index) == side * side
    truth = np.exp(-exact_tau(work.values, o, d)[0])
    assert np.mean(truth < 0.5) > 0.2, "else most rays miss the box"
    methods = {"volpath": by_volpath(work, spp), "ratio": by_tracking(work, spp, ratio), "delta": by_tracking(work, spp, delta)}
    for number, (name, estimate) in enumerate(methods.items()):
        mean = np.array(estimate(10 * seed + number), np.float64).mean()
        assert_same_bounded_mean(mean, side * side * spp, truth.mean(), what=name)


@pytest.mark.slow
def test_walks_count_what_they_cross(variant_rgb: str) -> None:
    """Where most blocks are empty most cells are not visited: a jump over a block is a step that visits none. The counts do
    not depend on the order of rays."""
    for name, grid in measure_grids(TINY).items():
        for order in ("camera order", "random order"):
            every, skipped = grid[f"{order}, every cell"], grid[f"{order}, empty blocks skipped"]
            assert every["cells_visited_per_ray"] == every["steps_per_ray"]
            assert skipped["cells_visited_per_ray"] <= skipped["steps_per_ray"] <= every["steps_per_ray"]
        if name == "threads":
            assert skipped["cells_visited_per_ray"] < skipped["steps_per_ray"]
            assert skipped["steps_per_ray"] < every["steps_per_ray"] / 2


def test_twin_of_the_bench_is_the_oracle() -> None:
    """Both are float64 sums of a few hundred terms, ordered differently."""
    rng = np.random.default_rng(5)
    values = rng.uniform(0, 3, (5, 7, 6)).astype(np.float32)
    o, d = (x.T.astype(np.float64) for x in rays_across(rng, 64))
    tau, measure = exact_tau(values, o, d)
    np.testing.assert_allclose(tau, tau_twin(values, TO_WORLD, o, d)[:, 0], rtol=1e-12, atol=1e-12)
    # the oracle's slopes are differences over 2e-3 of a voxel; Gauss points within 1e-3 of a plane see it a little
    np.testing.assert_allclose(measure, tau_scale(values, TO_WORLD, o, d)[:, 0], rtol=1e-3, atol=1e-12)


def test_rays_of_a_pixel_go_through_its_parts(variant_rgb: str) -> None:
    """The mean direction of 2 x 2 rays of a pixel is that through its middle, to the square of the pixel's angle."""
    _, one = camera_rays(8, np.array([27]))
    _, four = camera_rays(8, np.array([27]), 2)
    mean = np.array(four).mean(axis=1)
    assert np.ptp(np.array(four), axis=1).max() > 0.02
    np.testing.assert_allclose(mean / np.linalg.norm(mean), np.array(mi.Vector3f(one))[:, 0], atol=(math.pi / 4 / 8) ** 2 / 4)


def test_an_image_is_as_much_faster_as_its_time_and_variance_are_smaller(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images that are off by 1, 2 and 3 in times of 2, 6 and 8: at equal error 3 * 4 and 4 * 9 times faster."""
    side, picked = TINY.image_side, np.random.default_rng(0).choice(TINY.image_side**2, TINY.exact_pixels, replace=False)
    exact = np.linspace(0.1, 0.9, TINY.exact_pixels)
    image = np.full((side, side, 3), 100.0)

    def raced(contestants: dict, rounds: int, keep: bool) -> dict[str, Timing]:
        assert (rounds, keep) == (TINY.rounds, True)
        found = {}
        for name, (off, seconds) in zip(contestants, ((1, 2.0), (2, 6.0), (3, 8.0)), strict=True):
            ends = [image.copy(), image.copy()]
            for sign, each in zip((-1, 1), ends, strict=True):
                each.reshape(-1, 3)[picked, 0] = exact + sign * off
            found[name] = Timing({}, [seconds] * 2, [seconds] * 2, ends)
        return found

    monkeypatch.setattr(accuracy, "race", raced)
    monkeypatch.setattr(accuracy, "smoke", lambda: SimpleNamespace(values=np.ones((2, 3, 4), np.float32)))
    monkeypatch.setattr(accuracy, "pixel_means", lambda values, side, pixels: (exact, 0.25 * (pixels == picked).all()))
    answer = measure_image(TINY)
    assert [answer[name]["rms_error"] for name in ("mivol", "volpath, max_depth 1", "volpath, max_depth 6")] == [1, 2, 3]
    faster = [(answer[f"volpath, max_depth {n}"][f"mivol_is_faster{end}"]) for n in (1, 6) for end in ("", "_at_equal_error")]
    assert faster == pytest.approx([3, 12, 4, 36])
    assert answer["mivol"]["paths_per_second_median"] == side**2 * TINY.image_spp / 2
    about = {name: answer[name] for name in ("pixels", "spp", "exact_pixels", "rms_error_of_exact")}
    assert about == {"pixels": side**2, "spp": TINY.image_spp, "exact_pixels": 4, "rms_error_of_exact": 0.25}


def test_a_gradient_step_derives_the_sum_of_squares(variant_rgb: str) -> None:
    values = mi.TensorXf([1.0, -2.0, 4.0])
    found = gradient_step(values, lambda v: 3 * v.array)
    assert np.array(found).tolist() == [18.0, -36.0, 72.0] and not dr.grad_enabled(values)


def test_twins_of_pixels_have_finer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 x 12 rays a pixel, and 6 x 6, whose difference is the doubt: transmittances of exp(-k) of k x k rays."""
    asked = []

    def rays(side: int, pixels: np.ndarray, parts: int) -> tuple[np.ndarray, np.ndarray]:
        asked.append((side, pixels.tolist(), parts))
        return np.full((3, len(pixels) * parts**2), parts, np.float32), np.zeros((3, len(pixels) * parts**2), np.float32)

    monkeypatch.setattr(accuracy, "camera_rays", rays)
    scale = np.array([1.0, 2.0])
    monkeypatch.setattr(accuracy, "exact_tau", lambda values, o, d: (np.repeat(scale, len(o) // 2) * o[:, 0] / 10, 0))
    means, doubt = accuracy.pixel_means("values", 8, np.array([3, 5]))
    assert asked == [(8, [3, 5], 12), (8, [3, 5], 6)]
    np.testing.assert_allclose(means, np.exp(-1.2 * scale))
    assert doubt == pytest.approx(np.sqrt(np.mean((np.exp(-1.2 * scale) - np.exp(-0.6 * scale)) ** 2)))


def test_errors_of_optical_depths_by_hand(variant_rgb: str) -> None:
    """Over the measure where there is one; where nothing is the optical depth itself."""
    found = accuracy.errors_of(mi.Float(1.0, 2.5, 3.0, 0.25), np.array([1.0, 2.0, 4.0, 0.0]), np.array([1.0, 2.0, 4.0, 0.0]))
    assert found == pytest.approx({
        "rays": 3, "largest_error": 0.25, "rms_error": math.sqrt((0.25**2 + 0.25**2) / 3),
        "error_of_99.9_percent": 0.25, "error_where_exactly_empty": 0.25,
    })  # fmt: skip
    assert accuracy.errors_of(mi.Float(1.0), np.array([1.5]), np.array([2.0]))["error_where_exactly_empty"] == 0


def test_shuffled_rays_are_the_same_rays(variant_rgb: str) -> None:
    """In the order of the seed 0."""
    numbers = np.arange(15, dtype=np.float32).reshape(3, 5)
    o, d = shuffled(mi.Point3f(numbers), mi.Vector3f(-numbers))
    order = np.random.default_rng(0).permutation(5)
    assert np.array_equal(np.array(o), numbers[:, order]) and np.array_equal(np.array(d), -numbers[:, order])


def test_rays_across_the_box() -> None:
    """An eighth along the axes, in thirds, the others anywhere; they begin 2 to 8 before a point of the box."""
    rng, n = np.random.default_rng(3), 48
    d = rng.normal(size=(3, n))
    d[:, :6] = np.eye(3)[:, [0, 0, 1, 1, 2, 2]]
    d /= np.linalg.norm(d, axis=0)
    o = rng.uniform(-1, 1, (3, n)) - rng.uniform(2, 8, n) * d
    found = rays_across(np.random.default_rng(3), n)
    assert np.array_equal(found[0], np.float32(o)) and np.array_equal(found[1], np.float32(d))


def test_rays_are_spread_over_all(variant_rgb: str) -> None:
    """From the first to the last, as many as asked for, or all."""
    numbers = np.arange(30, dtype=np.float32).reshape(3, 10)
    work = Work(np.ones((2, 2, 2), np.float32), mi.Point3f(numbers), mi.Vector3f(-numbers))
    assert work.n == 10 and work.tensor.shape == (2, 2, 2, 1)
    for count, index in ((4, [0, 3, 6, 9]), (20, list(range(10)))):
        found, o, d = work.spread(count)
        assert found.tolist() == index and o.dtype == d.dtype == np.float64
        assert np.array_equal(o, numbers.T[index]) and np.array_equal(d, -numbers.T[index])


def test_memory_grows_in_a_straight_line(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """1000 bytes and 7 a ray, for each grid; grids are as bright as 2."""
    made = []
    make = lambda shape, peak, why: made.append((shape, peak)) or SimpleNamespace(values=shape[0])  # noqa: E731
    monkeypatch.setattr(cost, "made_up", make)
    monkeypatch.setattr(cost, "camera_rays", lambda side: (side,))
    monkeypatch.setattr(cost, "Work", lambda values, side: SimpleNamespace(n=side**2))
    monkeypatch.setattr(cost, "peak_bytes", lambda work: 1000 + 7 * work.n)
    answer = measure_memory(replace(TINY, memory_res=(4, 8), memory_sides=(10, 20, 30)))
    assert made == [((4, 4, 4), 2.0), ((8, 8, 8), 2.0)]
    for name in ("4^3", "8^3"):
        found = answer[name]
        assert (found["rays"], found["peak_bytes"]) == ([100, 400, 900], [1700, 3800, 7300])
        assert (found["bytes_per_ray"], found["bytes_without_rays"]) == pytest.approx((7, 1000))


def test_the_walk_is_asked_in_two_orders(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same rays through the smoke, a fourth of which meet the box."""
    found = type("Found", (), {"values": "smoke", "__str__": lambda self: "grid"})()
    monkeypatch.setattr(cost, "smoke", lambda: found)
    monkeypatch.setattr(cost, "camera_rays", lambda side: (f"o {side}", "d"))
    monkeypatch.setattr(cost, "shuffled", lambda o, d: (f"{o} shuffled", d))
    monkeypatch.setattr(cost, "inside_box", lambda o, d: (mi.Bool([True, False, False, False]), 0, 0))
    monkeypatch.setattr(cost, "Work", lambda values, o, d: SimpleNamespace(n=9, tau=lambda: (values, o, d)))
    raced = []
    pace = {"camera order": 3.0, "random order": 6.0}
    timed = {name: Timing({}, [s], [s]) for name, s in pace.items()}
    monkeypatch.setattr(cost, "race", lambda contestants, rounds: raced.append((contestants, rounds)) or timed)
    answer = measure_walk(TINY)
    works = {"camera order": ("smoke", "o 32", "d"), "random order": ("smoke", "o 32 shuffled", "d")}
    assert raced == [(works, TINY.rounds)]
    reports = {name: timed[name].report(9, "rays") for name in pace}
    assert answer == {"grid": "grid", "rays": 9, "share_of_rays_in_the_box": 0.25} | reports


@pytest.mark.slow
def test_a_gradient_of_a_render_takes_turns_with_the_render(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The step derives the mean of the picture by the voxels, anew in each call."""
    caught = {}

    def raced(contestants: dict, rounds: int) -> dict:
        caught.update(contestants, rounds=rounds)
        return {"render": Timing({}, [2.0], [2.0]), "gradient step": Timing({}, [5.0], [5.0])}

    monkeypatch.setattr(cost, "race", raced)
    monkeypatch.setattr(cost, "smoke", lambda: SimpleNamespace(values=np.ones((2, 2, 2), np.float32)))
    answer = cost.race_gradient_of_render(TINY)
    assert answer["gradient step over render"] == 2.5 and caught["rounds"] == TINY.rounds
    assert answer["render"]["paths_per_second_median"] == 8 * 8 * TINY.image_spp / 2
    picture, (one, two) = np.array(caught["render"](1)), (np.array(caught["gradient step"](1)) for _ in range(2))
    assert picture.shape == (8, 8, 3) and one.shape == (2, 2, 2, 1)
    # Under a sky of 1 the mean falls with every voxel; sums of float32 in another order.
    assert (one < 0).all()
    np.testing.assert_allclose(one, two, rtol=1e-4)


@pytest.mark.slow
def test_the_transpose_is_that_of_the_walk(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both read the same lengths: tau summed over rays is the back-projection of ones times the grid, summed (float32)."""
    caught = {}

    def raced(contestants: dict, rounds: int) -> dict:
        caught.update(contestants, rounds=rounds)
        return {name: Timing({}, [float(k)], [1.0]) for k, name in enumerate(contestants, 1)}

    monkeypatch.setattr(cost, "race", raced)
    values = np.random.default_rng(2).uniform(0.5, 1.5, (4, 5, 6)).astype(np.float32)
    work = Work(values, *camera_rays(8))
    answer = cost.race_reverse(work, 3)
    names = ("reverse", "gradient step", "gradient step of drjit.dda.integrate")
    assert [answer[f"{name} over forward"] for name in names] == [2, 3, 4] and caught["rounds"] == 3
    assert answer["reverse"]["rays_per_second_median"] == 32 and "forward over forward" not in answer
    tau, lengths = np.array(caught["forward"](0)), np.array(caught["reverse"](0)).ravel()
    assert tau.sum() == pytest.approx((lengths * values.ravel()).sum(), rel=1e-4)
    ours, theirs = (np.array(caught[name](0)) for name in names[1:])
    # d sum tau^2: along the values themselves twice the sum.
    assert (ours.ravel() * values.ravel()).sum() == pytest.approx(2 * (tau.astype(float) ** 2).sum(), rel=1e-4)
    padded_values = np.pad(values, 1, mode="edge").ravel()
    assert (theirs.ravel() * padded_values).sum() == pytest.approx(2 * (tau.astype(float) ** 2).sum(), rel=1e-3)
