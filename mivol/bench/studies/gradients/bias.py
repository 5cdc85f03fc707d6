"""Bias and variance of gradients where estimators differ, against finite differences with common random numbers or the twin."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mivol.bench.harness.agreement import compare_means, finite, mean_of_rounds, number
from mivol.bench.harness.bars import say
from mivol.bench.harness.timing import ratio_of
from mivol.bench.studies.gradients.size import OURS, STOCK, TABLES, Light, Size
from mivol.bench.studies.gradients.subject import SEEDS, Subject, along, compete, subjects, variance_over
from mivol.bench.studies.gradients.twin import Twin
from mivol.validate.moments import Moments
from mivol.validate.statistics import Estimate

__all__ = ["Case", "cases", "deep_cases", "difference", "ask_table", "refine", "table_row", "truth_of"]


@dataclass(frozen=True)
class Case:
    """Densities (Z, Y, X), a direction to change them in, and the step of a finite difference along it; 0 for the twin."""

    values: np.ndarray
    direction: np.ndarray
    step: float = 0.0


def cases(res: int) -> dict[str, Case]:
    """Where estimators differ.

    A step h changes an optical depth x of a path by h x; it is at most 0.05 (density 0), 0.1 (half empty), 0.03 (thin) and 0.15
    (dense: for paths of x <= 3, which carry 95 % of the light), so that truncation is at most (h x)^4 / 30 = 0.002 % (central)
    or (h x)^3 / 4 = 0.025 % (one-sided).
    """
    rng = np.random.default_rng(1)
    noise = rng.uniform(0.5, 1.5, (res,) * 3)
    ones, left = np.ones((res,) * 3), np.broadcast_to(np.arange(res) < res // 2, (res,) * 3)
    return {
        "density 0": Case(0 * ones, ones, 0.01),
        "half empty": Case(np.where(left, 0, 4 * noise), np.where(left, 1.0, 0.0), 0.02),
        "thin": Case(0.05 * noise, 0.05 * noise, 0.1),
        "dense": Case(10 * noise, 10 * noise, 0.05),
    }


THIN = 0.25
"""Extinction of the half that is empty elsewhere, where light is caught: a quarter of the mean of the other half."""


def deep_cases(res: int, light: Light) -> dict[str, Case]:
    """Where paths scatter often: an empty half, by which alone the derivative is taken, beside an optical depth of about 1; and
    an optical depth of about 6, by the density itself. In both the derivative is far from 0 in all lights.

    Light that a boundary catches, at unlimited depth, has a thin half in the place of the empty one: along emptiness it flies
    ways l of which the density falls as 1 / l^3 only, and the second moment of estimates has no bound.
    """
    noise = np.random.default_rng(1).uniform(0.5, 1.5, (res,) * 3)
    left = np.broadcast_to(np.arange(res) < res // 2, (res,) * 3)
    name, least = ("half thin", THIN) if light.catches and light.depth < 0 else ("half empty", 0.0)
    return {
        name: Case(np.where(left, least, noise), np.where(left, 1.0, 0.0)),
        "dense": Case(3 * noise, 3 * noise),
    }


def difference(subject: Subject, case: Case, seed: int, spp: int) -> float:
    """A finite difference along the direction with common random numbers: central of fourth order, or one-sided of third."""
    v, h = case.direction, case.step
    central = (case.values[v > 0] > 0).all()
    weights = {-2: 0.5, -1: -4, 1: 4, 2: -0.5} if central else {0: -11, 1: 18, 2: -9, 3: 2}
    return sum(w * subject.mean(case.values + s * h * v, seed, spp) for s, w in weights.items()) / (6 * h)


def refine(found: Sequence[float], estimate: Callable[[int], float], percent: float, most: int) -> np.ndarray:
    """Add independent estimates until their mean is known well enough.

    Args:
        found: those there are, two at least.
        estimate: makes one from its number, which is its seed.
        percent: wanted standard error of the mean, in percent of it.
        most: how many there may be in all; no clock is asked.
    """
    found = list(found)
    while len(found) < most:
        m = Moments.of(np.array(found))
        if math.sqrt(m.variance_of_mean) <= percent / 100 * abs(m.mean):
            break
        found.append(estimate(len(found)))
    return np.array(found)


def ask_table(question: str) -> Callable[[Size], dict]:
    """The question about bias in some lights."""
    lights = TABLES[question]

    def measure(size: Size) -> dict:
        answer = {}
        for name, light in lights.items():
            answer[name] = {}
            asked = cases(size.table_res) if light.depth == 2 else deep_cases(size.table_res, light)
            for which, case in asked.items():
                answer[name][which] = row = table_row(case, light, size, len(lights) * len(asked))
                say(f"  {name}, {which}: {said_of_row(row)}")
        return answer

    measure.__doc__ = "Bias and variance of free flights (prbvolpath) and of ours, at density 0 and where there is much."
    return measure


def truth_of(case: Case, light: Light, ours: Subject, size: Size) -> Callable[[int], float]:
    """Estimates of the derivative from their seeds: finite differences of our pictures, or the twin's."""
    if case.step:
        return lambda seed: difference(ours, case, seed, size.difference_spp)
    twin = Twin(case.values, case.direction, size.table_side, light)
    return lambda seed: twin.derivative(seed, size.difference_spp)


def table_row(case: Case, light: Light, size: Size, rows: int = 1) -> dict:
    """Both estimators in one case, in one light; the bound on z allows for so many rows."""
    both = subjects(case.values.astype(np.float32), size.table_side, light)
    steps = {name: s.of_mean for name, s in both.items()}
    timings, spp = compete(steps, size.table_budget, size.table_rounds, size.seed)
    derivatives = {name: along(timing, case.direction) for name, timing in timings.items()}
    first, v = SEEDS * size.seed, case.direction.ravel()

    def derivative(k: int) -> float:
        return float(np.array(both[OURS].of_mean(first + 9000 + k, size.derivative_spp), np.float64) @ v)

    estimate = truth_of(case, light, both[OURS], size)

    def differ(k: int) -> float:
        return estimate(first + 5000 + k)

    known = {"percent": size.certain_percent, "most": size.most_estimates}
    begun = range(size.table_rounds)
    derivatives[OURS] = refine([derivative(k) for k in begun], derivative, **known)
    truth = mean_of_rounds(refine([differ(k) for k in begun], differ, **known))
    row = {"truth": truth.mean, "its_standard_error": math.sqrt(truth.var)}
    for name, timing in timings.items():
        row[name] = figures_of(derivatives[name], truth, rows) | {
            "variance": variance_over(timing, case.direction > 0),
            "spp": spp[name],
            "seconds_median": timing.median,
        }
    a, b = row[STOCK]["variance"], row[OURS]["variance"]
    row["variance_x_time"] = finite(a / b * ratio_of(timings[STOCK], timings[OURS], "processor")) if b > 0 else None
    return row


def figures_of(derivatives: np.ndarray, truth: Estimate, rows: int) -> dict:
    """Derivatives (rounds,) of one estimator against the truth."""
    found = compare_means(mean_of_rounds(derivatives), truth, 2 * rows)
    return {
        "derivative": float(derivatives.mean()),
        "bias_standard_errors": found["z"],
        "bias_percent": found["percent"],
        "known_to_percent": found["standard_error_percent"],
    }


def said_of_row(row: dict) -> str:
    """One line of the table."""
    parts = [f"truth {row['truth']:.4g} +- {row['its_standard_error']:.1g}"]
    for name in (STOCK, OURS):
        r = row[name]
        parts.append(
            f"{name} {number(r['bias_percent']):+.2f} % "
            f"({number(r['bias_standard_errors']):+.1f} se of {number(r['known_to_percent']):.2f} %)"
        )
    return "; ".join(parts) + f"; variance x time {number(row['variance_x_time']):.3g}"
