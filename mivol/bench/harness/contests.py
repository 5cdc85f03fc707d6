"""Contests of noisy methods at equal time: variance x time, from independent results in rounds.

Conventions. The error of an unbiased estimate falls with the square root of the time, so variance x time depends on the method
alone. Each method gets the samples that take the same processor time. All methods then run in turns, in rounds with their own
seeds. A ratio of variances times the ratio of processor times says how much sooner one method reaches an error.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mivol.bench.harness.study import Size, amount
from mivol.bench.harness.timing import Contestant, Timing, race, ratio_of, time_call
from mivol.validate.moments import Moments

__all__ = ["SEED_STRIDE", "BudgetSize", "Contest", "Method", "compete", "find_samples"]

MIN_SAMPLES, MAX_SAMPLES = 4, 4096
"""Samples per pixel of one call."""

SEED_STRIDE = 100_000
"""Distance between the seeds of two contests with different ``seed``."""

Method = Callable[[int, int], object]
"""Seed and samples per pixel -> Dr.Jit arrays: an image or a gradient."""


def find_samples(method: Method, seconds: float) -> int:
    """Samples per pixel of a call: the largest power of two that takes this processor time at most [s]."""

    def measure(spp: int) -> float:
        before = time.process_time()
        time_call(lambda seed: method(seed, spp), spp)
        return time.process_time() - before

    spp = MIN_SAMPLES
    measure(spp)
    while True:
        # Take the shorter of two calls: the other may have compiled a kernel, or prepared the scene. A part of the
        # duration does not grow with the samples, so the last steps are small.
        duration = min(measure(spp), measure(spp))
        if duration > seconds / 2 or spp >= MAX_SAMPLES:
            return spp
        spp = min(spp * (8 if duration < seconds / 32 else 2), MAX_SAMPLES)


@dataclass(frozen=True)
class BudgetSize(Size):
    """Amount of work of a contest of images or gradients."""

    rounds: int = amount(8, doc="images or gradients of each method")
    budget: float = amount(0.8, 0.02, "processor time of one render [s]")
    spp: int = amount(0, doc="samples per pixel of one render; 0: decided by the budget")
    levels: tuple[int, ...] = amount((1, 4, 16), (1, 4), "divisors of the samples, for error against time")
    seed: int = amount(0, doc="seed of all renders")


@dataclass(frozen=True)
class Contest:
    """Results of a contest.

    Attributes:
        timings: by method and level, with the results of each round.
        spp: samples per pixel, by method and level.
    """

    timings: dict[tuple[str, int], Timing]
    spp: dict[tuple[str, int], int]

    def results(self, name: str, level: int = 1) -> np.ndarray:
        """Results (rounds, ...) in float64."""
        return np.array(self.timings[name, level].results, np.float64)

    def variances(self, name: str, level: int = 1) -> np.ndarray:
        """Variance of one result, for each number."""
        return Moments.from_values(self.results(name, level)).variance

    def time_ratios(self, slow: str, fast: str) -> dict[str, float]:
        """Time of one method over the time of another, by the wall clock and by processor time."""
        pair = self.timings[slow, 1], self.timings[fast, 1]
        return {"time": ratio_of(*pair), "processor_time": ratio_of(*pair, "processor")}


def compete(
    methods: dict[str, Method],
    rounds: int,
    seconds: float,
    spp: int = 0,
    *,
    levels: tuple[int, ...] = (1,),
    seed: int = 0,
) -> Contest:
    """Run methods in turns.

    Args:
        methods: by name; each has its own seeds.
        rounds: calls of each method and level, 99 at most.
        seconds: processor time of one call [s]; decides the number of samples.
        spp: samples per pixel of one call; 0: decided by ``seconds``.
        levels: divisors of the samples, for curves of error against time; the first is 1.
        seed: other values give independent results.
    """
    calls: dict[tuple[str, int], Contestant] = {}
    counts = {}
    for place, (name, method) in enumerate(methods.items(), 1):
        samples = spp or find_samples(method, seconds)
        for level in levels:
            first, n = SEED_STRIDE * seed + 10_000 * place + 100 * level, max(samples // level, 1)
            counts[name, level] = n
            calls[name, level] = lambda number, method=method, first=first, n=n: method(first + number, n)
    return Contest(race(calls, rounds, keep=True), counts)
