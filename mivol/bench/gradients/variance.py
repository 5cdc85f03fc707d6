"""How much sooner has mivol the same error in the density gradient of the smoke, in a picture's mean and in an L2 loss?"""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from mivol.bench.agreement import compare_means, mean_of_rounds, number
from mivol.bench.bars import say
from mivol.bench.extinctions import smoke
from mivol.bench.gradients.size import ALBEDO, LIGHTS, OURS, STOCK, Size
from mivol.bench.gradients.subject import along, compete, subjects, variance_over
from mivol.bench.scenes import box_scene, depth_two
from mivol.bench.timing import Timing, ratio_of

__all__ = ["measure_smoke", "outcome"]


def measure_smoke(size: Size) -> dict:
    """How much sooner has mivol the same error in the density gradient of the smoke?"""
    found = smoke()
    answer = {"grid": str(found)}
    regions = {
        "sigma_t >= 1": found.values >= 1,
        "0 < sigma_t < 1": (found.values > 0) & (found.values < 1),
        "sigma_t = 0": found.values == 0,
    }
    for light, parts in LIGHTS.items():
        target = picture_of(0.7 * found.values, size, parts)
        both = subjects(found.values, size.side, parts)
        functionals = {
            "mean": {name: s.of_mean for name, s in both.items()},
            "L2": {name: lambda seed, spp, s=s, target=target: s.of_loss(target, seed, spp) for name, s in both.items()},
        }
        answer[light] = {}
        for functional, steps in functionals.items():
            timings, spp = compete(steps, size.budget, size.rounds, size.seed)
            answer[light][functional] = outcome(timings, spp, regions, found.values, size.side)
            say(f"  {light}, {functional}: {said(answer[light][functional])}")
    return answer


def picture_of(values: np.ndarray, size: Size, parts: Callable[[], dict]) -> mi.TensorXf:
    """A picture without much noise."""
    scene = mi.load_dict(box_scene(values, size.side, ALBEDO, **parts()))
    return mi.render(scene, integrator=depth_two(OURS), seed=77, spp=size.difference_spp)


def outcome(timings: dict[str, Timing], spp: dict[str, int], regions: dict, values: np.ndarray, side: int) -> dict:
    """Times and, for each region, what variance x time and the means are."""
    slow, fast = timings[STOCK], timings[OURS]
    ratio = ratio_of(slow, fast)
    figures = {name: {"spp": spp[name]} | t.report(side * side * spp[name], "samples") for name, t in timings.items()}
    figures |= {"time": ratio, "processor_time": ratio_of(slow, fast, "processor")}
    for region, chosen in regions.items():
        a, b = variance_over(slow, chosen), variance_over(fast, chosen)
        direction = np.where(chosen, values if values[chosen].any() else 1.0, 0.0)
        figures[region] = {
            "voxels": int(chosen.sum()),
            "variance_x_time": a / b * ratio,
            **compare_means(*(mean_of_rounds(along(t, direction)) for t in (fast, slow)), 2 * len(LIGHTS)),
        }
    return figures


def said(figures: dict) -> str:
    """One line on a contest."""
    dense = figures["sigma_t >= 1"]
    rates = ", ".join(f"{name} {figures[name]['samples_per_second_median'] / 1e6:.3g}" for name in (OURS, STOCK))
    return (
        f"{dense['variance_x_time']:.0f}x, processor {figures['processor_time'] / figures['time']:.2f} "
        f"(z {number(dense['z']):+.2f}, {number(dense['percent']):+.2f} % "
        f"+- {number(dense['standard_error_percent']):.2f}); M samples/s: {rates}"
    )
