"""Contests of methods in rounds: seconds of calls, variance x time of noisy methods, and the agreement of their means.

Conventions. A contestant takes the number of a round, makes a seed from the number, and returns unevaluated Dr.Jit
arrays. The contestants of a question take turns within each round, in an order that changes from round to round, so
that other work on the machine slows all contestants alike. Processor seconds are summed over all threads of the process; other
work on the machine changes them less than it changes the wall clock.

The error of an unbiased estimate falls with the square root of the time, so variance x time depends on the method
alone. Each method gets the samples that take the same processor time. A ratio of variances times the ratio of processor times
says how much sooner one method reaches an error.

Agreement of two means: z, its bound by Student's t, and the smallest visible bias. Values are float64, one for each round; a
round has its own seed. An error is the variance of a mean with the degrees of freedom of its estimate
(:class:`mivol.validate.statistics.Estimate`). A time ratio of two methods is meaningless if their means differ, so every
study of unbiased methods compares the means first.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.study import Size, amount
from mivol.validate.statistics import Estimate, Moments, Significance, effective_dof, z_bound, z_image

__all__ = [
    "FALSE_ALARM",
    "SEED_STRIDE",
    "BudgetSize",
    "Contest",
    "Contestant",
    "Method",
    "Stopwatch",
    "Timing",
    "agreement_figures",
    "compare_means",
    "compete",
    "contest_images",
    "fastest",
    "find_samples",
    "finite_or_none",
    "gain_figures",
    "image_errors",
    "mean_of_pixels",
    "mean_of_rounds",
    "peak_bytes",
    "race",
    "time_ratio",
    "render_method",
    "time_call",
]

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


def time_ratio(slow: Timing, fast: Timing, clock: str = "seconds") -> float:
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


# -- Contests at equal time --------------------------------------------------------------------------------------------

FALSE_ALARM = 1e-3
"""Probability that a run reports a difference although all means agree."""


def mean_of_rounds(values: np.ndarray) -> Estimate:
    """Estimate the mean of at least two independent values (rounds,)."""
    m = Moments.from_values(values)
    return Estimate(float(m.mean), float(m.variance_of_mean), m.n - 1)


def mean_of_pixels(rounds: np.ndarray) -> Estimate:
    """Estimate the mean over rounds and pixels (rounds, pixels).

    Two variances are known, and the larger one counts. The sum of the variances of the pixels has many degrees of freedom
    (:func:`effective_dof`; few if one pixel has most of the noise), but misses noise shared by pixels, for instance random
    numbers of a tile. The variance of the means of rounds has this shared noise.
    """
    shared = mean_of_rounds(rounds.mean(axis=1))
    v = Moments.from_values(rounds).variance_of_mean
    alone = float(v.sum()) / v.size**2
    if alone <= shared.var:
        return shared
    return Estimate(shared.mean, alone, float(effective_dof(v, rounds.shape[0] - 1)))


def compare_means(a: Estimate, b: Estimate, comparisons: int) -> dict[str, float | None]:
    """Compare two means by Student's t with Welch's degrees of freedom.

    Args:
        a: mean under test.
        b: reference mean; percentages are relative to this mean.
        comparisons: number of comparisons that share ``FALSE_ALARM``.

    Returns:
        z of a - b, the bound of z, the difference and its standard error in percent of b. An infinite value is None: z for
        means without variance, the percentages for b = 0.
    """
    variance = a.var + b.var
    dof = effective_dof(np.array([a.var, b.var]), np.array([a.dof, b.dof]))
    scale = 100 / abs(b.mean) if b.mean else math.inf
    return {
        "z": finite_or_none(z_image(a, b)),
        "z_bound": float(z_bound(Significance(FALSE_ALARM, comparisons), dof)),
        "percent": finite_or_none(scale * math.copysign(1, b.mean) * (a.mean - b.mean)),
        "standard_error_percent": finite_or_none(scale * math.sqrt(variance)),
    }


def finite_or_none(x: float) -> float | None:
    """Replace infinity and NaN, which JSON lacks, by None."""
    return float(x) if np.isfinite(x) else None


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

    def variances(self, name: str) -> np.ndarray:
        """Variance of one result at the first level, for each number."""
        return Moments.from_values(self.results(name)).variance

    def time_ratios(self, slow: str, fast: str) -> dict[str, float]:
        """Time of one method over the time of another, by the wall clock and by processor time."""
        pair = self.timings[slow, 1], self.timings[fast, 1]
        return {"time": time_ratio(*pair), "processor_time": time_ratio(*pair, "processor")}


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


# -- Contests of images -----------------------------------------------------------------------------------------------------


def render_method(scene: mi.Scene, integrator: mi.Integrator) -> Method:
    """The images of a scene by an integrator."""
    return lambda seed, spp: mi.render(scene, integrator=integrator, spp=spp, seed=seed)


def contest_images(
    scene: mi.Scene, integrators: dict[str, mi.Integrator], size: BudgetSize, levels: tuple[int, ...] = (1,)
) -> Contest:
    """Render images by all integrators in turns."""
    methods = {name: render_method(scene, integrator) for name, integrator in integrators.items()}
    return compete(methods, size.rounds, size.budget, size.spp, levels=levels, seed=size.seed)


def image_errors(contest: Contest, name: str, level: int, counts: np.ndarray) -> dict:
    """Mean, variance, relative error and time of the images of one integrator, over the counted pixels."""
    m, spp = Moments.from_values(contest.results(name, level)), contest.spp[name, level]
    variance, mean = m.variance.mean(axis=-1)[counts], m.mean.mean(axis=-1)[counts]
    return {
        "spp": spp,
        "mean": float(mean.mean()),
        "variance_mean_over_pixels": float(variance.mean()),
        "variance_median_over_pixels": float(np.median(variance)),
        "relative_error_mean_over_pixels": math.sqrt(variance.mean()) / float(mean.mean()),
        "relative_error_median_over_pixels": float(np.median(np.sqrt(variance)[mean > 0] / mean[mean > 0])),
        **contest.timings[name, level].report(counts.size * spp, "samples"),
    }


def gain_figures(contest: Contest, slow: str, fast: str, counts: np.ndarray) -> dict:
    """Ratios of times and of variance x time, over the counted pixels."""
    a, b = (contest.variances(name).mean(axis=-1)[counts] for name in (slow, fast))
    times = contest.time_ratios(slow, fast)
    with np.errstate(divide="ignore", invalid="ignore"):
        by_pixel = np.median((a / b)[(a > 0) | (b > 0)])
    return times | {
        "variance_x_time_mean_over_pixels": float(a.mean() / b.mean() * times["processor_time"]),
        "variance_x_time_median_over_pixels": float(by_pixel * times["processor_time"]),
    }


def agreement_figures(contest: Contest, slow: str, fast: str, counts: np.ndarray, comparisons: int) -> dict:
    """z of the means over the counted pixels, its bound, and the standard error relative to the mean of ``slow``.

    ``comparisons`` share the probability of a false alarm.
    """
    means = (mean_of_pixels(contest.results(name).mean(axis=-1)[:, counts]) for name in (fast, slow))
    agreement = compare_means(*means, comparisons)
    error = agreement["standard_error_percent"]
    return {
        "z": agreement["z"],
        "z_bound": agreement["z_bound"],
        "relative_standard_error": None if error is None else error / 100,
    }
