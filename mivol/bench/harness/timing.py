"""Seconds of calls on the device: contestants in rounds, warm calls apart from first calls.

Conventions. A contestant takes the number of a round, makes a seed from the number, and returns unevaluated Dr.Jit
arrays. The contestants of a question take turns within each round, in an order that changes from round to round, so
that other work on the machine slows all contestants alike. Processor seconds are summed over all threads of the process; other
work on the machine changes them less than it changes the wall clock.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["Contestant", "Stopwatch", "Timing", "fastest", "peak_bytes", "race", "ratio_of", "time_call"]

Contestant = Callable[[int], object]
"""Number of the round (a seed) -> unevaluated Dr.Jit arrays."""


@dataclass
class Timing:
    """Times of one contestant.

    Attributes:
        first: cost of the first call, see :func:`time_first_call`.
        seconds: wall clock of the warm calls [s], one for each round.
        processor: processor time of the same calls [s].
        results: returned values as NumPy arrays, if :func:`race` was to keep them.
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
        """Median and fastest time, the rates for ``units`` of work called ``name``, and the first call."""
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
        rounds: timed calls of each contestant, numbered from 1; a first call with the number 0 is reported apart.
        keep: keep the returned values as NumPy arrays.
    """
    names = list(contestants)
    with hold_collector():
        timings = {name: Timing(time_first_call(call)) for name, call in contestants.items()}
        for number in range(1, rounds + 1):
            for name in names[number % len(names) :] + names[: number % len(names)]:
                before = time.process_time()
                result, seconds = time_call(contestants[name], number)
                timings[name].processor.append(time.process_time() - before)
                timings[name].seconds.append(seconds)
                if keep:
                    timings[name].results.append(np.array(result))
                del result
            gc.collect()
    return timings


@contextmanager
def hold_collector() -> Iterator[None]:
    """Hold Python's collector of reference cycles, so that no call pays for the cycles of another, and no collection falls into
    the tracing of a kernel, where Dr.Jit aborts the process. Objects from before the block are not collected in the block."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def fastest(call: Callable[[], object], clock: Callable[[], float], calls: int = 3) -> float:
    """Shortest duration of a few calls by a clock [s]; the first call may compile."""
    seconds = []
    for _ in range(calls):
        start = clock()
        call()
        seconds.append(clock() - start)
    return min(seconds)


def time_call(call: Contestant, number: int = 0) -> tuple[object, float]:
    """Call a contestant and evaluate its result; the result and the wall-clock time [s]."""
    start = time.perf_counter()
    result = call(number)
    dr.eval(result)
    dr.sync_thread()
    return result, time.perf_counter() - start


def time_first_call(call: Contestant) -> dict[str, float]:
    """Make the first call: total and compiler seconds, number of compiled kernels and of kernels found on disk."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        _, seconds = time_call(call)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return {
        "seconds": seconds,
        "compile_seconds": sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1e3,
        "kernels_compiled": sum(not k["cache_hit"] for k in kernels),
        "kernels_from_disk": sum(k["cache_disk"] for k in kernels),
    }


def ratio_of(slow: Timing, fast: Timing, clock: str = "seconds") -> float:
    """Time of one contestant over the time of another: median over the rounds, by ``seconds`` or by ``processor``."""
    return float(np.median(np.array(getattr(slow, clock)) / np.array(getattr(fast, clock))))


def peak_bytes(call: Callable[[], object]) -> int:
    """Largest memory that Dr.Jit holds at once during a call, with everything allocated before [bytes]."""
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    call()
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float))


@dataclass
class Stopwatch:
    """Sum of the durations of its ``with`` blocks; each block ends when the device is done.

    Attributes:
        seconds: wall clock [s].
        processor: processor time of all threads [s].
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
