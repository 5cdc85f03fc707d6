"""Contests at equal time: samples, seeds, and ratios of variance x time."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.bench.harness import contests
from mivol.bench.harness.contests import Contest, compete, find_samples
from mivol.bench.harness.timing import Timing


@pytest.mark.parametrize(("a_sample", "a_call", "expected"), [(0.01, 0, 64), (1.0, 0, 4), (1e-9, 0, 4096), (0.012, 0.1, 64)])
def test_samples_for_a_time(
    monkeypatch: pytest.MonkeyPatch, variant_rgb: str, a_sample: float, a_call: float, expected: int
) -> None:
    """The largest power of two between 4 and 4096 that takes 1 s by a clock of the test, with the fixed cost of a call."""
    now = [0.0]
    monkeypatch.setattr(contests.time, "process_time", lambda: now[0])

    def render(seed: int, spp: int) -> mi.Float:
        now[0] += a_call + a_sample * spp
        return mi.Float(0)

    assert find_samples(render, 1.0) == expected


def test_every_call_has_its_own_seed(variant_rgb: str) -> None:
    """12 samples: 12, 3 and 1 (not 0) by level. No seed is used twice, and another seed of the contest moves all of them."""
    calls: list[tuple] = []
    methods = {name: lambda seed, spp, name=name: calls.append((name, seed, spp)) or mi.Float(seed) for name in ("a", "b")}
    contest = compete(methods, 2, 1.0, 12, levels=(1, 4, 16))
    assert contest.spp == {(name, level): n for name in ("a", "b") for level, n in ((1, 12), (4, 3), (16, 1))}
    assert {(name, spp) for name, _, spp in calls} == {(name, spp) for name, _ in contest.spp for spp in (12, 3, 1)}
    seeds = {seed for _, seed, _ in calls}
    assert len(seeds) == len(calls) == 18
    assert len(contest.results("a", 4)) == 2
    calls.clear()
    compete(methods, 2, 1.0, 12, levels=(1, 4, 16), seed=3)
    assert {seed - 300_000 for _, seed, _ in calls} == seeds


def test_variances_and_ratios_of_times() -> None:
    """Deviations of 1 and 2 in four rounds (variances 4/3 and 16/3), three times the time, five times the processor time."""
    swing = np.array([-1.0, 1, -1, 1])[:, None]
    slow, fast = Timing({}, [3.0] * 4, [5.0] * 4, list(7 + 2 * swing)), Timing({}, [1.0] * 4, [1.0] * 4, list(7 + swing))
    contest = Contest({("slow", 1): slow, ("fast", 1): fast}, {})
    assert contest.variances("slow") == pytest.approx(16 / 3) and contest.variances("fast") == pytest.approx(4 / 3)
    assert contest.time_ratios("slow", "fast") == {"time": 3, "processor_time": 5}
