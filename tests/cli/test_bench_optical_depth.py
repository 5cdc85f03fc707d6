"""`scripts/bench_optical_depth.py --quick`: it answers every question, and the errors, which no noise of a machine can
move, are within their bars. Times are written down and decide nothing."""

from __future__ import annotations

import itertools
import math
from types import ModuleType

import bench_script
import numpy as np
import pytest
from oracle import tau_scale, tau_twin

from mivol.report.figures import SERIES

METHODS = ("mivol", "volpath", "ratio tracking", "delta tracking", "marching", "drjit.dda.integrate")
EPS = 2.0**-24


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    return bench_script.load("bench_optical_depth")


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What the script prints, and under "folder" where its files are."""
    return bench_script.quick("bench_optical_depth", tmp_path_factory.mktemp("bench"))


def timings(answer: object) -> list[dict]:
    """Every timed contestant in an answer."""
    if isinstance(answer, dict):
        return [answer] if "seconds_median" in answer else [t for v in answer.values() for t in timings(v)]
    return [t for v in answer for t in timings(v)] if isinstance(answer, list) else []


def test_every_question_is_answered(quick: dict, bench: ModuleType) -> None:
    assert set(bench.QUESTIONS) <= set(quick)
    assert len(quick["bars"]) == len(bench.BARS) - 1  # 256^3 is left to the full run
    for question in bench.QUESTIONS:
        for t in timings(quick[question]):
            assert 0 < t["seconds_min"] <= t["seconds_median"]
            assert set(t["first_call"]) == {"seconds", "compile_seconds", "kernels_compiled", "kernels_from_disk"}
    assert sum(t["first_call"]["kernels_compiled"] + t["first_call"]["kernels_from_disk"] for t in timings(quick)) > 0
    assert set(METHODS) <= set(quick["peers"])
    assert len(METHODS) <= len(SERIES)
    assert (quick["folder"] / "bench_optical_depth.png").read_bytes().startswith(b"\x89PNG")


def test_errors_are_within_their_bars(quick: dict) -> None:
    """Error and memory are the same on every machine, so they may decide."""
    bars = {row["figure"]: row["met"] for row in quick["bars"]}
    decided = {name: met for name, met in bars.items() if "error" in name or "bytes" in name}
    assert len(decided) == 2
    assert all(decided.values()), decided
    assert all(f["error_where_exactly_empty"] == 0 for f in quick["accuracy"].values())


def test_contestants_compute_the_same(quick: dict) -> None:
    """A peer that computes something else would make every ratio of times meaningless."""
    peers = quick["peers"]
    worst = {name: peers[name][-1]["rms_error"] for name in METHODS}
    # exact: exp(-tau) tau <= 1/e, and each of at most 150 cells rounds a share of tau by a few EPS
    assert worst["mivol"] <= 4 * 150 * EPS / math.e
    assert worst["drjit.dda.integrate"] <= 4 * 150 * EPS / math.e
    # 2nd order: a quarter of the step, a sixteenth of the error; 1st order would be a quarter, 8 lies between
    steps = [row["rms_error"] for row in peers["marching"]]
    assert all(fine <= coarse / 8 for coarse, fine in itertools.pairwise(steps))
    for name in ("volpath", "ratio tracking", "delta tracking"):
        for row in peers[name]:
            # unbiased: 5 standard errors are exceeded by chance once in 2e6
            rounds_and_rays = 3 * peers["exact_rays"]
            assert abs(row["mean_error"]) <= 5 * row["rms_error"] / math.sqrt(rounds_and_rays)
    assert worst["mivol"] < min(worst[name] for name in METHODS[1:])


def test_walks_count_what_they_cross(quick: dict) -> None:
    """Where 93 of 100 blocks are empty, most cells are not visited; the counts do not depend on the order of rays."""
    for name, grid in quick["grids"].items():
        for order in ("camera order", "random order"):
            every, skipped = grid[f"{order}, every cell"], grid[f"{order}, empty blocks skipped"]
            assert every["cells_visited_per_ray"] == every["steps_per_ray"]
            assert skipped["cells_visited_per_ray"] <= skipped["steps_per_ray"] <= every["steps_per_ray"]
        if name == "threads":
            assert skipped["steps_per_ray"] < every["steps_per_ray"] / 3


def test_twin_of_the_bench_is_the_oracle(bench: ModuleType) -> None:
    """Both are float64 sums of a few hundred terms, ordered differently."""
    rng = np.random.default_rng(5)
    values = rng.uniform(0, 3, (5, 7, 6)).astype(np.float32)
    o, d = (x.T.astype(np.float64) for x in bench.rays_across(rng, 64))
    tau, measure = bench.exact_tau(values, o, d)
    np.testing.assert_allclose(tau, tau_twin(values, bench.TO_WORLD, o, d)[:, 0], rtol=1e-12, atol=1e-12)
    # the oracle's slopes are differences over 2e-3 of a voxel; Gauss points within 1e-3 of a plane see it a little
    np.testing.assert_allclose(measure, tau_scale(values, bench.TO_WORLD, o, d)[:, 0], rtol=1e-3, atol=1e-12)
