"""Study of optical depths: its contestants compute the same, and its errors, which no machine moves, are within their bars.

Everything runs in this process at sizes of a few hundred rays; times are looked at by nobody.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_bounded_mean
from oracle import tau_twin

from mivol.bench.harness.contests import Timing
from mivol.bench.scenes import TO_WORLD, GridRays, camera_rays
from mivol.bench.studies import optical_depth as study
from mivol.bench.studies.optical_depth import (
    STUDY,
    OpticalDepthSize,
    delta_survival,
    exact_tau,
    gradient_step,
    ratio_survival,
    tracking,
    volpath,
)
from mivol.report.figures import SERIES

ALL_SOLVERS = ("mivol", "volpath", "ratio tracking", "delta tracking", "marching", "drjit.dda.integrate")
EPS = 2.0**-24
TINY = replace(
    OpticalDepthSize.quick(),
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


def test_memory_of_a_gradient_step(variant_rgb: str) -> None:
    """Bytes a ray are the same on every machine too."""
    (bar,) = STUDY.bars("memory", study.measure_memory(TINY))
    assert bar["met"], bar


@pytest.mark.slow
def test_exact_peers_are_exact_and_marching_is_of_second_order(variant_rgb: str, tmp_path) -> None:
    """A peer that computes something else would make every ratio of times meaningless."""
    peers = study.measure_peers(TINY)
    worst = {name: peers[name][-1]["rms_error"] for name in ALL_SOLVERS}
    # exact: exp(-tau) tau <= 1/e, and each of at most 150 cells rounds a share of tau by a few EPS
    assert worst["mivol"] <= 4 * 150 * EPS / math.e
    assert worst["drjit.dda.integrate"] <= 4 * 150 * EPS / math.e
    # 2nd order: a quarter of the step, a sixteenth of the error; 1st order would be a quarter, 8 lies between
    steps = [row["rms_error"] for row in peers["marching"]]
    assert all(fine <= coarse / 8 for coarse, fine in itertools.pairwise(steps))
    assert worst["mivol"] < min(worst[name] for name in ALL_SOLVERS[1:])
    assert len(ALL_SOLVERS) <= len(SERIES)
    STUDY.draw({"peers": peers}, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.statistical
def test_random_peers_have_the_exact_mean(variant_rgb: str, seed: int) -> None:
    """Every walk returns a transmittance in [0, 1]: by Hoeffding's bound, which needs no variance, 16,384 of them miss a mean
    of 0.4 by 0.02 at most, but for one time in 10^8 a method."""
    side, spp = 16, 64
    rays = GridRays(np.random.default_rng(2).uniform(0, 2, (5, 4, 6)).astype(np.float32), *camera_rays(side))
    index, o, d = rays.select(side * side)
    assert len(index) == side * side
    truth = np.exp(-exact_tau(rays.values, o, d))
    assert np.mean(truth < 0.5) > 0.2, "else most rays miss the box"
    methods = {
        "volpath": volpath(rays, spp),
        "ratio": tracking(rays, spp, ratio_survival),
        "delta": tracking(rays, spp, delta_survival),
    }
    for number, (name, estimate) in enumerate(methods.items()):
        mean = np.array(estimate(10 * seed + number), np.float64).mean()
        assert_same_bounded_mean(mean, side * side * spp, truth.mean(), what=name)


@pytest.mark.slow
def test_walks_count_what_they_cross(variant_rgb: str) -> None:
    """Where most blocks are empty most cells are not visited: a jump over a block is a step that visits none. The counts do not
    depend on the order of rays."""
    for name, grid in study.measure_grids(TINY).items():
        for order in ("camera order", "random order"):
            every, skipped = grid[f"{order}, every cell"], grid[f"{order}, empty blocks skipped"]
            assert every["cells_visited_per_ray"] == every["steps_per_ray"]
            assert skipped["cells_visited_per_ray"] <= skipped["steps_per_ray"] <= every["steps_per_ray"]
        if name == "threads":
            assert skipped["cells_visited_per_ray"] < skipped["steps_per_ray"]
            assert skipped["steps_per_ray"] < every["steps_per_ray"] / 2


def test_exact_optical_depths_are_those_of_the_oracle() -> None:
    """Both are float64 sums of a few hundred terms, in different orders; an eighth of the rays is parallel to an axis."""
    rng = np.random.default_rng(5)
    values = rng.uniform(0, 3, (5, 7, 6)).astype(np.float32)
    d = rng.normal(size=(64, 3))
    d[:8] = np.eye(3)[np.arange(8) % 3]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = rng.uniform(-1, 1, (64, 3)) - rng.uniform(2, 8, (64, 1)) * d
    np.testing.assert_allclose(exact_tau(values, o, d), tau_twin(values, TO_WORLD, o, d)[:, 0], rtol=1e-12, atol=1e-12)


def test_a_pixel_sees_the_transmittance_of_its_rays(variant_rgb: str) -> None:
    """In a grid of one value, rays that cross the same faces have the transmittance of their chord."""
    values, pixels = np.full((2, 2, 2), 0.7, np.float32), np.array([27, 36])
    means, doubt = study.pixel_means(values, 8, pixels, k=2)
    rays = [np.array(x).T.astype(float) for x in camera_rays(8, pixels, 2)]
    expected = np.exp(-tau_twin(values, TO_WORLD, *rays)[:, 0]).reshape(2, 4).mean(axis=1)
    np.testing.assert_allclose(means, expected, rtol=1e-12)
    assert 0 < doubt < 0.1 and (means < 1).all()


def test_rays_of_a_pixel_go_through_its_parts(variant_rgb: str) -> None:
    """The mean direction of 2 x 2 rays of a pixel is that through its middle, to the square of the pixel's angle."""
    _, one = camera_rays(8, np.array([27]))
    _, four = camera_rays(8, np.array([27]), 2)
    mean = np.array(four).mean(axis=1)
    assert np.ptp(np.array(four), axis=1).max() > 0.02
    np.testing.assert_allclose(mean / np.linalg.norm(mean), np.array(mi.Vector3f(one))[:, 0], atol=(math.pi / 4 / 8) ** 2 / 4)


def test_a_gradient_step_derives_the_sum_of_squares(variant_rgb: str) -> None:
    values = mi.TensorXf([1.0, -2.0, 4.0])
    result = gradient_step(values, lambda v: 3 * v.array)
    assert np.array(result).tolist() == [18.0, -36.0, 72.0] and not dr.grad_enabled(values)


@pytest.mark.slow
def test_the_transpose_is_that_of_the_walk(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both read the same lengths: tau summed over rays is the back-projection of ones times the grid, summed (float32)."""
    caught = {}

    def raced(contestants: dict, rounds: int) -> dict:
        caught.update(contestants, rounds=rounds)
        return {name: Timing({}, [float(k)], [1.0]) for k, name in enumerate(contestants, 1)}

    monkeypatch.setattr(study, "race", raced)
    values = np.random.default_rng(2).uniform(0.5, 1.5, (4, 5, 6)).astype(np.float32)
    rays = GridRays(values, *camera_rays(8))
    answer = study.race_reverse(rays, 3)
    names = ("reverse", "gradient step", "gradient step of drjit.dda.integrate")
    assert [answer[f"{name} over forward"] for name in names] == [2, 3, 4] and caught["rounds"] == 3
    assert answer["reverse"]["rays_per_second_median"] == 32 and "forward over forward" not in answer
    tau, lengths = np.array(caught["forward"](0)), np.array(caught["reverse"](0)).ravel()
    assert tau.sum() == pytest.approx((lengths * values.ravel()).sum(), rel=1e-4)
    mivol, peer = (np.array(caught[name](0)) for name in names[1:])
    # d sum tau^2: along the values themselves twice the sum.
    assert (mivol.ravel() * values.ravel()).sum() == pytest.approx(2 * (tau.astype(float) ** 2).sum(), rel=1e-4)
    padded_values = np.pad(values, 1, mode="edge").ravel()
    assert (peer.ravel() * padded_values).sum() == pytest.approx(2 * (tau.astype(float) ** 2).sum(), rel=1e-3)


@pytest.mark.slow
def test_times_are_measured_and_judged(variant_rgb: str) -> None:
    """Every contestant has a time above 0, and the three figures of time have a bar."""
    for name in ("walk", "image", "reverse"):
        answer = STUDY.questions[name](TINY)
        assert timings(answer)
        for t in timings(answer):
            assert 0 < t["seconds_min"] <= t["seconds_median"]
            assert set(t["first_call"]) == {"seconds", "compile_seconds", "kernels_compiled", "kernels_from_disk"}
        (bar,) = STUDY.bars(name, answer)
        assert bar["value"] > 0
        if name == "image":
            for depth in (1, 6):
                figures = answer[f"volpath, max_depth {depth}"]
                variance = (figures["rms_error"] / answer["mivol"]["rms_error"]) ** 2
                assert figures["mivol_is_faster_at_equal_error"] == pytest.approx(figures["mivol_is_faster"] * variance)


BARS = {
    "walk": ({"camera order": {"rays_per_second_median": 2e7}}, [(20, "at least", 15, True)]),
    "image": ({"volpath, max_depth 1": {"mivol_is_faster": 19.0}}, [(19, "at least", 20, False)]),
    "reverse": ({"smoke": {"reverse over forward": 4.5}}, [(4.5, "at most", 4, False)]),
    "memory": (
        {"a": {"bytes_per_ray": 20.0}, "b": {"bytes_per_ray": 33.0}},
        [(20, "at most", 32, True), (33, "at most", 32, False)],
    ),
    "grids": ({}, []),
}


@pytest.mark.parametrize("question", BARS)
def test_the_right_figure_is_judged(question: str) -> None:
    answer, expected = BARS[question]
    assert [(bar["value"], bar["sense"], bar["bar"], bar["met"]) for bar in STUDY.bars(question, answer)] == expected
