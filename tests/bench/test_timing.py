"""Contestants run in turns, and first calls are reported apart."""

from __future__ import annotations

import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.bench.harness import timing
from mivol.bench.harness.timing import Stopwatch, Timing, race, ratio_of


def test_contestants_take_turns(variant_rgb: str) -> None:
    """Each is called once uncounted, with the number 0, then in every round, in another order than in the round before."""
    calls = []
    contestants = {name: lambda k, name=name: calls.append((k, name)) or mi.Float(k) for name in "abc"}
    result = race(contestants, 3, keep=True)
    assert calls[:3] == [(0, "a"), (0, "b"), (0, "c")]
    assert ["".join(name for k, name in calls if k == number) for number in (1, 2, 3)] == ["bca", "cab", "abc"]
    assert [np.ravel(r).tolist() for r in result["b"].results] == [[1], [2], [3]]
    assert len(result["c"].seconds) == len(result["c"].processor) == 3


def test_first_calls_count_their_kernels(variant_rgb: str) -> None:
    """A kernel that neither this process nor the cache on disk has seen: it holds a number that is new in each run."""
    new = int.from_bytes(os.urandom(3), "big") / 2**24
    x = dr.arange(mi.Float, 1000)
    dr.eval(x)
    first = timing.time_first_call(lambda _: dr.sin(x) * new + dr.cos(x))
    assert set(first) == {"seconds", "compile_seconds", "kernels_compiled", "kernels_from_disk"}
    assert first["kernels_compiled"] == 1
    assert timing.time_first_call(lambda _: dr.sin(x) * new + dr.cos(x))["kernels_compiled"] == 0


def test_first_calls_add_up_what_the_compiler_took(monkeypatch: pytest.MonkeyPatch, variant_rgb: str) -> None:
    """Milliseconds of Dr.Jit; kernels that were known or found on disk are not compiled, and other entries are no kernels."""
    jit, other = dr.KernelType.JIT, next(kind for kind in dr.KernelType if kind != dr.KernelType.JIT)
    kernel = {"type": jit, "codegen_time": 200.0, "backend_time": 300.0, "cache_hit": False, "cache_disk": False}
    result = [kernel, {**kernel, "cache_hit": True, "cache_disk": True}, {**kernel, "type": other}]
    monkeypatch.setattr(dr, "kernel_history", lambda: result)
    first = timing.time_first_call(lambda _: mi.Float(1))
    assert (first["compile_seconds"], first["kernels_compiled"], first["kernels_from_disk"]) == (1.0, 1, 1)


def test_ratios_are_medians_of_rounds() -> None:
    """2 in two rounds and 10 in one: neither the mean nor the ratio of medians."""
    slow = Timing({}, [2.0, 40.0, 60.0], [3.0, 3.0, 3.0])
    fast = Timing({}, [1.0, 20.0, 6.0], [1.0, 1.0, 3.0])
    assert ratio_of(slow, fast) == 2
    assert ratio_of(slow, fast, "processor") == 3
    report = slow.report(80, "rays")
    assert (report["seconds_median"], report["seconds_min"], report["rays_per_second_median"]) == (40, 2, 2)
    assert report["rays_per_second_best"] == 40


def test_a_stopwatch_adds_up_its_blocks(monkeypatch: pytest.MonkeyPatch, variant_rgb: str) -> None:
    """What stands between two blocks is not counted."""
    now = [0.0]
    monkeypatch.setattr(timing.time, "process_time", lambda: 2 * now[0])
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    watch = Stopwatch()
    for inside, outside in ((1.0, 100.0), (2.0, 100.0)):
        with watch:
            now[0] += inside
        now[0] += outside
    assert (watch.seconds, watch.processor) == (3.0, 6.0)


def test_the_fastest_call_counts() -> None:
    """Three calls, of 5, 2 and 4 seconds."""
    clock = iter([0.0, 5.0, 10.0, 12.0, 20.0, 24.0])
    calls = []
    assert timing.fastest(lambda: calls.append(0), lambda: next(clock)) == 2
    assert len(calls) == 3


def test_peak_memory_of_a_call(variant_rgb: str) -> None:
    """An array of 4 MB, which is freed when the call ends."""
    assert timing.peak_bytes(lambda: dr.eval(dr.arange(mi.Float, 1 << 20) + 1)) >= 4 << 20
