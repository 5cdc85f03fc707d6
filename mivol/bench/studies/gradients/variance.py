"""How much sooner has mivol the same error in the density gradient of a volume, in a picture's mean and in an L2 loss?"""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from mivol.bench.harness.agreement import compare_means, mean_of_rounds, number
from mivol.bench.harness.bars import say
from mivol.bench.harness.timing import Timing, ratio_of
from mivol.bench.studies.gradients.size import CONTESTS, OURS, STOCK, Light, Size
from mivol.bench.studies.gradients.subject import along, compete, subjects, variance_over

__all__ = ["ask_contest", "outcome"]


def ask_contest(question: str) -> Callable[[Size], dict]:
    """The question about one volume in some lights."""

    def measure(size: Size) -> dict:
        return measure_contest(question, size)

    measure.__doc__ = f"How much sooner has mivol the same error in the density gradient ({question})?"
    return measure


def measure_contest(question: str, size: Size) -> dict:
    """Ratios of variance x time in the regions of a volume, in each light."""
    volume, lights = CONTESTS[question]
    found = volume()
    answer = {"grid": str(found)}
    regions = {
        "sigma_t >= 1": found.values >= 1,
        "0 < sigma_t < 1": (found.values > 0) & (found.values < 1),
        "sigma_t = 0": found.values == 0,
    }
    for name, light in lights.items():
        target = picture_of(0.7 * found.values, size, light)
        both = subjects(found.values, size.side, light)
        functionals = {
            "mean": {who: s.of_mean for who, s in both.items()},
            "L2": {who: lambda seed, spp, s=s, target=target: s.of_loss(target, seed, spp) for who, s in both.items()},
        }
        answer[name] = {}
        for functional, steps in functionals.items():
            timings, spp = compete(steps, size.budget, size.rounds * light.rounds, size.seed)
            answer[name][functional] = outcome(timings, spp, regions, found.values, size.side, 2 * len(lights))
            say(f"  {name}, {functional}: {said(answer[name][functional])}")
    return answer


def picture_of(values: np.ndarray, size: Size, light: Light) -> mi.TensorXf:
    """A picture without much noise."""
    scene = light.scene(values, size.side)
    return mi.render(scene, integrator=light.integrator(OURS), seed=77, spp=size.difference_spp)


def outcome(
    timings: dict[str, Timing], spp: dict[str, int], regions: dict, values: np.ndarray, side: int, contests: int
) -> dict:
    """Times and, for each region, what variance x time and the means are; the bound on z allows for so many contests."""
    slow, fast = timings[STOCK], timings[OURS]
    ratio = ratio_of(slow, fast, "processor")
    figures = {name: {"spp": spp[name]} | t.report(side * side * spp[name], "samples") for name, t in timings.items()}
    figures |= {"time": ratio_of(slow, fast), "processor_time": ratio}
    for region, chosen in regions.items():
        a, b = variance_over(slow, chosen), variance_over(fast, chosen)
        direction = np.where(chosen, values if values[chosen].any() else 1.0, 0.0)
        figures[region] = {
            "voxels": int(chosen.sum()),
            "variance_x_time": a / b * ratio,
            **compare_means(*(mean_of_rounds(along(t, direction)) for t in (fast, slow)), contests),
        }
    return figures


def said(figures: dict) -> str:
    """One line on a contest."""
    dense = figures["sigma_t >= 1"]
    rates = ", ".join(f"{name} {figures[name]['samples_per_second_median'] / 1e6:.3g}" for name in (OURS, STOCK))
    return (
        f"{dense['variance_x_time']:.0f}x, by the clock {figures['time'] / figures['processor_time']:.2f} of that "
        f"(z {number(dense['z']):+.2f}, {number(dense['percent']):+.2f} % "
        f"+- {number(dense['standard_error_percent']):.2f}); M samples/s: {rates}"
    )
