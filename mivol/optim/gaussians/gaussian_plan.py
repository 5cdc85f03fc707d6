"""How a fit of Gaussians goes: sizes of photographs, degrees, how many Gaussians when, learning rates; presets by name.

Conventions. Steps are counted, the clock is not asked, so that a fit can be repeated and resumed. Rates of places are shares of
the scene's extent (1.1 times the largest distance of a camera from the middle of all).

References: Kerbl et al. 2023 (rates, thresholds, loss); Kheradmand et al. 2024 (relocation, noise, priors); Yu et al. 2024
(the mip filter).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.machine import available_memory
from mivol.optim.events import CoarseToFine, ControlDensity, Event
from mivol.optim.first_order import Adam
from mivol.optim.loop import Course
from mivol.photos import Camera

__all__ = ["CONTROLS", "PRESETS", "GaussianPlan", "GaussianStage", "estimate_bytes", "scene_extent", "check_memory"]

CONTROLS = ("clone_split", "relocation")
"""What control of the density there is: that of Kerbl et al. 2023, and that of Kheradmand et al. 2024."""


@dataclass(frozen=True)
class GaussianStage:
    """A part of a fit.

    Attributes:
        edge: of the photographs, the longer one, about [pixel]: they are shrunk by the power of two that comes nearest.
        steps: one picture each.
        degree: of the harmonics.
        shrink: of the photographs; found by :meth:`GaussianPlan.for_edge`.
    """

    edge: int
    steps: int
    degree: int
    shrink: int = 1


@dataclass(frozen=True)
class GaussianPlan:
    """How a fit of Gaussians goes.

    Attributes:
        stages: one after the other, with sizes that do not shrink and degrees that do not fall.
        start: Gaussians at first, where they are drawn at random.
        most: Gaussians at the end of growth.
        control: one of ``CONTROLS``.
        every: steps between two changes of the density.
        grows: between which shares of all steps the density changes.
        threshold: slope of a Gaussian's place on the screen from which it is divided [1 / half an edge of the picture].
        least_opacity: Gaussians below are taken out, or relocated.
        largest_clone: scale up to which a Gaussian is cloned and not split [extent].
        largest: scale from which one is taken out [extent].
        reset_every: steps between two resets of all opacities to 0.01; 0: none.
        ssim: share of SSIM in the loss.
        low_pass: variance that is added to each ellipse in pictures of the photographs' size [pixel^2].
        mip: whether what is smaller than a pixel keeps its light (Yu et al. 2024), instead of its opacity: such a set may be
        seen at
            other sizes than it was fitted at, by renderers that do the same.
        exposure: a gain for each channel of each photograph (:mod:`mivol.optim.photographs.exposure`).
        random_background: photographs with alpha are seen over another colour each step.
        place, place_end: first and last rate of places [extent], with a geometric course between them.
        scale, turn, opacity, colour: rates of log-scales, quaternions, opacity logits and constant coefficients.
        sheen: rate of higher coefficients, over that of constant ones.
        end: last over first rate of all but places.
        noise: of relocation: places are moved at random by this times their rate, those of transparent Gaussians.
        sparsity: of relocation: weight of the mean opacity and of the mean scale [extent].
    """

    stages: tuple[GaussianStage, ...]
    start: int = 5_000
    most: int = 20_000
    control: str = "clone_split"
    every: int = 100
    grows: tuple[float, float] = (0.05, 0.6)
    threshold: float = 0.0
    least_opacity: float = 0.005
    largest_clone: float = 0.01
    largest: float = 0.1
    reset_every: int = 0
    ssim: float = 0.2
    low_pass: float = 0.3
    mip: bool = False
    exposure: bool = False
    random_background: bool = True
    place: float = 4e-4
    place_end: float = 4e-6
    scale: float = 2e-2
    turn: float = 4e-3
    opacity: float = 0.05
    colour: float = 1e-2
    sheen: float = 1 / 5
    end: float = 0.3
    noise: float = 5e5
    sparsity: float = 0.01

    @property
    def steps(self) -> int:
        """Steps of all stages."""
        return sum(stage.steps for stage in self.stages)

    @property
    def degree(self) -> int:
        """Of the harmonics in the end."""
        return self.stages[-1].degree

    @property
    def stage_starts(self) -> tuple[int, ...]:
        """Steps before which the stages after the first begin."""
        return tuple(int(n) for n in np.cumsum([stage.steps for stage in self.stages])[:-1])

    @property
    def optimizer(self) -> Adam:
        """What takes the steps; derivatives of single Gaussians are many orders below the largest, and count as much."""
        return Adam(epsilon=1e-12)

    def course(self, *more: Event) -> Course:
        """All steps, with the stages, the control of the density and what else is to happen between them."""
        first, last = (max(1, round(share * self.steps)) for share in self.grows)
        control = ControlDensity(every=self.every, begin=first, end=max(last, first + 1))
        return Course(self.steps, events=(CoarseToFine(at=self.stage_starts), control, *more))

    def count_at(self, step: int, start: int) -> int:
        """How many Gaussians there may be from a step on: growth is even from ``start`` to ``most``."""
        first, last = (share * self.steps for share in self.grows)
        share = min(max((step + self.every - first) / max(last - first, 1), 0), 1)
        return start + round((max(self.most, start) - start) * share)

    def learning_rates(self, step: int, extent: float) -> dict[str, float]:
        """Learning rates in a step, by parameter."""
        share = step / max(self.steps, 1)
        falls = self.end**share
        place = self.place * (self.place_end / self.place) ** share * extent
        return {
            "means": place,
            "log_scales": self.scale * falls,
            "quaternions": self.turn * falls,
            "opacity_logits": self.opacity * falls,
            "harmonics": self.colour * falls,
        }

    def low_pass_at(self, shrink: float) -> float:
        """Variance of the filter in photographs that are means over squares of ``shrink`` pixels [their pixel^2].

        A mean over s x s pixels widens an ellipse by the variance of s points side by side, (s^2 - 1) / 12, beside the filter
        of the full size: so a fit at a smaller size seeks what is judged at the full one.
        """
        return (self.low_pass + (shrink**2 - 1) / 12) / shrink**2

    def for_edge(self, edge: int) -> GaussianPlan:
        """The plan for photographs whose longer edge is so long [pixel]."""
        shrinks = [2 ** max(0, round(math.log2(edge / stage.edge))) for stage in self.stages]
        return replace(self, stages=tuple(replace(one, shrink=n) for one, n in zip(self.stages, shrinks, strict=True)))

    def minutes(self, pixels: int) -> float:
        """About how long the fit takes on two cores that walk 25 million rays a second (``STEP``).

        Args:
            pixels: of a photograph in full size; the sizes of the stages must be known (:meth:`for_edge`).
        """
        seconds, done = 0.0, 0
        for stage in self.stages:
            count = self.count_at(done + stage.steps // 2, self.start)
            seconds += stage.steps * (STEP + EACH_GAUSSIAN * count + EACH_PIXEL * pixels / stage.shrink**2)
            done += stage.steps
        return seconds / 60

    def in_minutes(self, minutes: float, pixels: int) -> GaussianPlan:
        """The plan with as many steps as take about so long there; arguments as of :meth:`minutes`. No clock is asked."""
        return self.scaled(minutes / self.minutes(pixels))

    def scaled(self, effort: float) -> GaussianPlan:
        """The plan with so many times the steps."""
        return replace(self, stages=tuple(replace(one, steps=max(1, round(one.steps * effort))) for one in self.stages))


PUBLISHED = {
    "place": 1.6e-4,
    "place_end": 1.6e-6,
    "scale": 5e-3,
    "turn": 1e-3,
    "colour": 2.5e-3,
    "sheen": 1 / 20,
    "end": 1.0,
    "threshold": 2e-4,
    "grows": (1 / 60, 0.5),
    "reset_every": 3000,
}
"""Rates and density control of Kerbl et al. 2023, for 30,000 steps; the others have rates for a tenth of that. Measured after
2730 steps of ``minutes`` on every tenth training view, held out, at 200 x 200 pixels: the chair has 37.9 dB and glossy things
32.6. With rates of places four times as high 37.5 and 32.3; where all others fall to a tenth besides, 36.9 and 31.9."""

PRESETS: dict[str, GaussianPlan] = {
    "tiny": GaussianPlan(
        (GaussianStage(64, 150, 0), GaussianStage(128, 350, 1)), 1500, 4000, every=50, place=8e-4, place_end=8e-6
    ),
    "minute": GaussianPlan((GaussianStage(100, 400, 0), GaussianStage(200, 2000, 2)), start=4000, most=10_000, every=50),
    "minutes": GaussianPlan((GaussianStage(100, 800, 0), GaussianStage(200, 7000, 3)), start=8000, most=35_000),
    "fine": GaussianPlan(
        (GaussianStage(100, 500, 0), GaussianStage(200, 3000, 2), GaussianStage(400, 3000, 3)), start=6000, most=30_000
    ),
    "finest": GaussianPlan(
        (GaussianStage(100, 500, 0), GaussianStage(200, 3000, 2), GaussianStage(400, 3500, 3), GaussianStage(800, 1500, 3)),
        6000,
        50_000,
    ),
    "gpu": GaussianPlan(
        (GaussianStage(200, 1000, 0), GaussianStage(400, 2000, 2), GaussianStage(800, 27_000, 3)), 100_000, 400_000, **PUBLISHED
    ),
}
"""``tiny`` takes seconds, ``minute`` and ``minutes`` one and five on two idle cores, ``fine`` about as long as ``minutes``, for
photographs of 400 pixels and more, ``finest`` ten to twenty, for 800 and more; ``gpu`` has the published steps (not
measured)."""


def scene_extent(cameras: Sequence[Camera]) -> float:
    """1.1 times the largest distance of a camera from the mean of all [length] (Kerbl et al. 2023, released code)."""
    origins = np.array([camera.origin for camera in cameras])
    return 1.1 * float(np.linalg.norm(origins - origins.mean(axis=0), axis=1).max())


STEP, EACH_GAUSSIAN, EACH_PIXEL = 5e-3, 0.75e-6, 0.23e-6
"""Seconds of a step, and of each Gaussian and each pixel in it, on two cores that walk 25 million rays a second in
``mivol bench optical_depth``. Measured with 10,000 and 25,000 Gaussians of degree 2 at 100, 200 and 400 pixels squared,
which it meets to 10 %."""

NUMBER, PIXEL = 4 * 6, 4 * 40
"""Bytes of a number of the cloud (value, derivative, two moments, and two of them anew while a step is made), and of a pixel
of a picture (photograph, render, sums over windows, derivatives)."""

LISTED = 32
"""Entries that a Gaussian has in the lists of tiles; small ones have 1 to 4, each of 100 bytes."""


def estimate_bytes(plan: GaussianPlan, count: int, pixels: int) -> int:
    """Memory of a step with so many Gaussians and pixels."""
    numbers = 11 + 3 * (plan.degree + 1) ** 2
    return count * (numbers * NUMBER + LISTED * 100) + pixels * PIXEL


def check_memory(plan: GaussianPlan, photographs: int, pixels: int, limit: int | None = None) -> str:
    """What a fit will take, in a sentence.

    Args:
        plan: what is asked for.
        photographs: bytes that all of them take.
        pixels: of the largest.
        limit: [bytes]; None for what the machine has left (on a GPU nothing is checked).

    Raises:
        MivolError: more than there is; how many Gaussians fit is said.
    """
    most = max(plan.most, plan.start)
    needed = photographs + estimate_bytes(plan, most, pixels)
    if limit is None and dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
        limit = available_memory()
    if limit is not None and needed > limit:
        each, rest = estimate_bytes(plan, 1, 0), limit - photographs - estimate_bytes(plan, 0, pixels)
        advice = f"gaussians.most = {rest // each} fits" if rest > each else "read the photographs smaller (photos.scale)"
        taken, left = f"{needed / 2**30:.1f} GiB", f"{limit / 2**30:.1f}"
        raise MivolError(f"a fit of {most} Gaussians takes about {taken} and {left} are left; {advice}.")
    return f"about {needed / 2**20:.0f} MiB: photographs {photographs / 2**20:.0f}, Gaussians and a picture the rest"
