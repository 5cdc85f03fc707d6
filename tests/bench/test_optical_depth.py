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
from mivol.bench.optical_depth import BENCH, PROMISES, QUESTIONS, QUICK, accuracy
from mivol.bench.optical_depth.accuracy import measure_accuracy, measure_image
from mivol.bench.optical_depth.cost import gradient_step, measure_grids, measure_memory, measure_reverse, measure_walk
from mivol.bench.optical_depth.peers import by_tracking, by_volpath, delta, measure_peers, ratio
from mivol.bench.optical_depth.twin import exact_tau
from mivol.bench.optical_depth.work import Work, camera_rays, rays_across
from mivol.bench.timing import Timing
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
