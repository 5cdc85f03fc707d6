"""Seconds of calls on the device: contestants in turns, warm calls apart from first ones, samples for a budget.

Conventions. A contestant takes the number of a round, from which it makes its seed, and returns Dr.Jit arrays that are
still to be evaluated. Contestants of one question run in turns within rounds, each round in another order, so that what
else the machine does falls on all of them alike. "Processor" seconds are summed over all threads of the process: other
work on the machine moves them less than the clock on the wall.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import drjit as dr
import numpy as np

__all__ = ["Budget", "Contestant", "Stopwatch", "Timing", "clock", "fastest", "race", "ratio_of"]

LEAST_SAMPLES, MOST_SAMPLES = 4, 4096
"""Per pixel, of one render."""

Contestant = Callable[[int], object]
"""Takes the number of the round (a seed), returns Dr.Jit arrays that are still to be evaluated."""


@dataclass
class Timing:
    """Seconds of the warm calls of one contestant, what its first call was, and what the calls returned.

    Attributes:
        first: of the first call, see :func:`first_call`.
        seconds: on the wall, one for each round.
        processor: of all threads, one for each round.
        results: NumPy arrays, where :func:`race` was asked to keep them.
    """

    first: dict[str, float]
    seconds: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    results: list[np.ndarray] = field(default_factory=list)

    @property
    def median(self) -> float:
        """Median over the rounds [s]."""
        return float(np.median(self.seconds))

    def report(self, units: float, name: str) -> dict[str, float]:
        """Median and fastest time, the rates at which ``units`` of that name were done, and the first call."""
        fastest = min(self.seconds)
        return {
            "seconds_median": self.median,
            "seconds_min": fastest,
            "processor_seconds_median": float(np.median(self.processor)),
            f"{name}_per_second_median": units / self.median,
            f"{name}_per_second_best": units / fastest,
            "first_call": self.first,
        }


def race(contestants: dict[str, Contestant], rounds: int, keep: bool = False) -> dict[str, Timing]:
    """Time contestants in turns.

    Args:
        contestants: by name.
        rounds: calls of each, after a first one that is not counted; they are numbered from 1.
        keep: keep what each call returned, as NumPy arrays.
    """
    timings = {name: Timing(first_call(call)) for name, call in contestants.items()}
    names = list(contestants)
    for number in range(1, rounds + 1):
        for name in names[number % len(names) :] + names[: number % len(names)]:
            before = time.process_time()
            result, seconds = clock(contestants[name], number)
            timings[name].processor.append(time.process_time() - before)
            timings[name].seconds.append(seconds)
            if keep:
                timings[name].results.append(np.array(result))
            del result
    return timings


def fastest(call: Callable[[], object], now: Callable[[], float], times: int = 3) -> float:
    """Seconds of the fastest of a few calls, the first of which may compile, by the clock ``now``."""
    seconds = []
    for _ in range(times):
        start = now()
        call()
        seconds.append(now() - start)
    return min(seconds)


def clock(call: Contestant, number: int = 0) -> tuple[object, float]:
    """Make a call and evaluate what it returns; the result and its seconds on the wall."""
    start = time.perf_counter()
    result = call(number)
    dr.eval(result)
    dr.sync_thread()
    return result, time.perf_counter() - start


def first_call(call: Contestant) -> dict[str, float]:
    """Make the first call: seconds in all and in the compiler, kernels compiled, kernels found on disk."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        _, seconds = clock(call)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return {
        "seconds": seconds,
        "compile_seconds": sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1e3,
        "kernels_compiled": sum(not k["cache_hit"] for k in kernels),
        "kernels_from_disk": sum(k["cache_disk"] for k in kernels),
    }


def ratio_of(slow: Timing, fast: Timing, clock: str = "seconds") -> float:
    """How many times longer one takes than the other: median over the rounds, by ``seconds`` or by ``processor``."""
    return float(np.median(np.array(getattr(slow, clock)) / np.array(getattr(fast, clock))))


class Budget(NamedTuple):
    """How many samples a contestant gets: a fixed number, or as many as take a time.

    Attributes:
        seconds: of processor time that one call may take.
        spp: samples per pixel; where it is given, no clock is asked.
    """

    seconds: float = 1.0
    spp: int | None = None

    def samples(self, render: Callable[[int, int], object]) -> int:
        """Samples per pixel of a call: ``spp``, or the largest power of two that takes ``seconds`` or less.

        Args:
            render: seed, samples per pixel -> Dr.Jit arrays.
        """
        return self.spp or _samples_for(render, self.seconds)


def _samples_for(render: Callable[[int, int], object], seconds: float) -> int:
    def taken(spp: int) -> float:
        before = time.process_time()
        clock(lambda seed: render(seed, spp), spp)
        return time.process_time() - before

    spp = LEAST_SAMPLES
    taken(spp)
    while True:
        # The smaller of two: the other may have compiled a kernel, or made what is kept for a scene. A part of
        # what they take does not grow with the samples, so the last step is a small one.
        least = min(taken(spp), taken(spp))
        if least > seconds / 2 or spp >= MOST_SAMPLES:
            return spp
        spp = min(spp * (8 if least < seconds / 32 else 2), MOST_SAMPLES)


@dataclass
class Stopwatch:
    """Sums the seconds inside its ``with`` blocks, on the wall and of all threads, once the device is done.

    What stands between the blocks (judging a fit, writing a line) costs nothing.
    """

    seconds: float = 0.0
    processor: float = 0.0
    _started: tuple[float, float] = (0.0, 0.0)

    def __enter__(self) -> Stopwatch:
        self._started = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        dr.sync_thread()
        self.seconds += time.perf_counter() - self._started[0]
        self.processor += time.process_time() - self._started[1]
