"""Plans of Gaussian fits: image sizes, degrees, numbers of Gaussians over time, learning rates; presets by name.

Conventions. Plans count steps and never read the clock, and a fit can be repeated and resumed. Learning rates of positions are
relative to the scene's extent (1.1 times the largest distance of a camera from the mean camera position).

References: Kerbl et al. 2023 (rates, thresholds, loss); Kheradmand et al. 2024 (relocation, noise, priors); Yu et al. 2024
(the mip filter); Zhao et al. 2024 (several photographs a step).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mivol import back_end
from mivol.optim.events import CoarseToFine, ControlDensity, Event
from mivol.optim.first_order import Adam
from mivol.optim.loop import Course
from mivol.photos import Camera

CONTROLS = ("clone_split", "relocation")
"""Methods of density control: Kerbl et al. 2023 (``clone_split``) and Kheradmand et al. 2024 (``relocation``)."""


@dataclass(frozen=True)
class GaussianStage:
    """A part of a fit.

    Attributes:
        edge: approximate longer edge of the photographs [pixel]: they are shrunk by the nearest power of two.
        steps: number of steps, one image each.
        degree: degree of the harmonics.
        shrink: shrink factor of the photographs, set by :meth:`GaussianPlan.for_edge`.
    """

    edge: int
    steps: int
    degree: int
    shrink: int = 1


@dataclass(frozen=True)
class GaussianPlan:
    """Plan of a Gaussian fit.

    Attributes:
        stages: in their order, with rising or constant image sizes and degrees.
        start: initial number of Gaussians, if drawn at random.
        most: number of Gaussians at the end of growth.
        control: of ``CONTROLS``.
        control_every: steps between two changes of the density.
        growth: shares of the steps between which the density changes.
        split_threshold: gradient of a Gaussian's screen position above which the Gaussian is divided [1 / half an image edge].
        least_opacity: Gaussians below this opacity are removed, or relocated.
        largest_clone: scale up to which a Gaussian is cloned and not split [extent].
        largest: scale above which a Gaussian is removed [extent].
        reset_every: steps between two resets of opacities to 0.01; 0: none.
        ssim: share of SSIM in the loss.
        low_pass: variance added to each ellipse in full-size images [pixel^2].
        mip: whether Gaussians smaller than a pixel keep their light (Yu et al. 2024), instead of their opacity. Renderers with
            the same filter can then render the set at other sizes.
        exposure: a gain for each channel of each photograph (:mod:`mivol.optim.photographs.photo_colours`).
        poses: whether the cameras of the photographs move with the fit.
        random_background: whether photographs with alpha get another background in each step.
        position_rate, final_position_rate: first and last rate of positions [extent], with geometric decay between.
        scale_rate, rotation_rate, opacity_rate, colour_rate: rates of log-scales, quaternions, opacity logits and constant
            coefficients.
        sheen: rate of higher coefficients over the rate of constant coefficients.
        final_rate: last over first rate, except for positions.
        position_noise: for relocation: random moves of transparent Gaussians, in position rates.
        sparsity: for relocation: weight of the mean opacity and of the mean scale [extent].
        reach: for a capture, the median distance of the cameras from the middle of the box [length]: free space
            (:func:`mivol.photos.region.is_free_space`) holds no Gaussians, and far Gaussians may be larger. 0: no capture.
        views: photographs of a step.
    """

    stages: tuple[GaussianStage, ...]
    start: int = 5_000
    most: int = 20_000
    control: str = "clone_split"
    control_every: int = 100
    growth: tuple[float, float] = (0.05, 0.6)
    split_threshold: float = 0.0
    least_opacity: float = 0.005
    largest_clone: float = 0.01
    largest: float = 0.1
    reset_every: int = 0
    ssim: float = 0.2
    low_pass: float = 0.3
    mip: bool = False
    exposure: bool = False
    poses: bool = False
    random_background: bool = True
    position_rate: float = 4e-4
    final_position_rate: float = 4e-6
    scale_rate: float = 2e-2
    rotation_rate: float = 4e-3
    opacity_rate: float = 0.05
    colour_rate: float = 1e-2
    sheen: float = 1 / 5
    final_rate: float = 0.3
    position_noise: float = 5e5
    reach: float = 0.0
    sparsity: float = 0.01
    views: int = 1

    @property
    def steps(self) -> int:
        """Total steps."""
        return sum(stage.steps for stage in self.stages)

    @property
    def degree(self) -> int:
        """Degree of the harmonics at the end."""
        return self.stages[-1].degree

    @property
    def stage_starts(self) -> tuple[int, ...]:
        """First steps of the stages after the first."""
        return tuple(int(n) for n in np.cumsum([stage.steps for stage in self.stages])[:-1])

    @property
    def optimizer(self) -> Adam:
        """The optimizer of the plan. A small epsilon: derivatives of single Gaussians are many orders below the largest
        one.
        """
        return Adam(beta_1=0.9**self.views, beta_2=0.999**self.views, epsilon=1e-12)

    def course(self, *more: Event) -> Course:
        """All steps, with the stages, density control and further events."""
        first, last = (max(1, round(share * self.steps)) for share in self.growth)
        control = ControlDensity(every=self.control_every, begin=first, end=max(last, first + 1))
        return Course(self.steps, events=(CoarseToFine(at=self.stage_starts), control, *more))

    def count_at(self, step: int, start: int) -> int:
        """Maximum number of Gaussians in a step: even growth from ``start`` to ``most``."""
        first, last = (share * self.steps for share in self.growth)
        share = min(max((step + self.control_every - first) / max(last - first, 1), 0), 1)
        return start + round((max(self.most, start) - start) * share)

    def learning_rates(self, step: int, extent: float) -> dict[str, float]:
        """Learning rates in a step, by parameter."""
        share = step / self.steps
        factor = self.final_rate**share
        position_rate = self.position_rate * (self.final_position_rate / self.position_rate) ** share * extent
        return {
            "means": position_rate,
            "log_scales": self.scale_rate * factor,
            "quaternions": self.rotation_rate * factor,
            "opacity_logits": self.opacity_rate * factor,
            "harmonics": self.colour_rate * factor,
        }

    def low_pass_at(self, shrink: float) -> float:
        """Variance of the filter in photographs averaged over squares of ``shrink`` pixels [their pixel^2].

        A mean over s x s pixels widens an ellipse by the variance of s points in a row, (s^2 - 1) / 12, in addition to the
        filter of the full size. A fit at a smaller size therefore approximates full-size images.
        """
        return (self.low_pass + (shrink**2 - 1) / 12) / shrink**2

    def for_edge(self, edge: int) -> GaussianPlan:
        """The plan for photographs with this longer edge [pixel]."""
        shrinks = [2 ** max(0, round(math.log2(edge / stage.edge))) for stage in self.stages]
        return replace(self, stages=tuple(replace(stage, shrink=n) for stage, n in zip(self.stages, shrinks, strict=True)))

    def minutes(self, pixels: int) -> float:
        """Estimated time of the fit on two cores that walk 25 million rays a second (``STEP``).

        Args:
            pixels: pixels of a full-size photograph; :meth:`for_edge` must have set the sizes of the stages.
        """
        seconds, done = 0.0, 0
        for stage in self.stages:
            count = self.count_at(done + stage.steps // 2, self.start)
            each = STEP + EACH_GAUSSIAN * count + EACH_PIXEL * pixels / stage.shrink**2
            seconds += stage.steps * self.views * each
            done += stage.steps
        return seconds / 60

    def in_minutes(self, minutes: float, pixels: int) -> GaussianPlan:
        """The plan with the number of steps for an estimated time; arguments as :meth:`minutes`. The clock is not read."""
        return self.scaled(minutes / self.minutes(pixels))

    def scaled(self, effort: float) -> GaussianPlan:
        """The plan with ``effort`` times the steps."""
        return replace(self, stages=tuple(replace(stage, steps=max(1, round(stage.steps * effort))) for stage in self.stages))

    def with_views(self, views: int) -> GaussianPlan:
        """The plan with several photographs a step, whose gradients a cluster can share.

        The fit sees as many photographs as before, in fewer steps. Rates grow by the root of ``views``, and moments forget as
        much per photograph (Zhao et al. 2024).
        """
        names = "position_rate", "final_position_rate", "scale_rate", "rotation_rate", "opacity_rate", "colour_rate"
        rates = {name: getattr(self, name) * views**0.5 for name in names}
        every = {name: math.ceil(getattr(self, name) / views) for name in ("control_every", "reset_every")}
        return replace(self.scaled(1 / views), views=views, **rates, **every)


PUBLISHED = {
    "position_rate": 1.6e-4,
    "final_position_rate": 1.6e-6,
    "scale_rate": 5e-3,
    "rotation_rate": 1e-3,
    "colour_rate": 2.5e-3,
    "sheen": 1 / 20,
    "final_rate": 1.0,
    "split_threshold": 2e-4,
    "growth": (1 / 60, 0.5),
    "reset_every": 3000,
}
"""Rates and density control of Kerbl et al. 2023, for 30,000 steps; the other presets have rates for a tenth of these steps."""

PRESETS: dict[str, GaussianPlan] = {
    "tiny": GaussianPlan(
        (GaussianStage(64, 150, 0), GaussianStage(128, 350, 1)),
        1500,
        4000,
        control_every=50,
        position_rate=8e-4,
        final_position_rate=8e-6,
    ),
    "minute": GaussianPlan(
        (GaussianStage(100, 400, 0), GaussianStage(200, 2000, 2)), start=4000, most=10_000, control_every=50
    ),
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
"""``tiny`` takes seconds, ``minute`` and ``minutes`` one and five minutes on two idle cores. ``fine`` takes about as long as
``minutes``, for photographs of 400 pixels and more; ``finest`` ten to twenty minutes, for 800 pixels and more. ``gpu`` has the
published steps (not measured)."""


def scene_extent(cameras: Sequence[Camera]) -> float:
    """1.1 times the largest distance of a camera from the mean camera position [length] (Kerbl et al. 2023, released code)."""
    origins = np.array([camera.origin for camera in cameras])
    return 1.1 * float(np.linalg.norm(origins - origins.mean(axis=0), axis=1).max())


STEP, EACH_GAUSSIAN, EACH_PIXEL = 5e-3, 0.75e-6, 0.23e-6
"""Seconds per step, and per Gaussian and pixel in a step, on two cores that walk 25 million rays a second in
``mivol bench optical_depth``. Measured with 10,000 and 25,000 Gaussians of degree 2 at 100, 200 and 400 pixels squared,
and correct to 10 % there."""

NUMBER, PIXEL = 4 * 6, 4 * 40
"""Bytes per number of the cloud (value, derivative, two moments, and two new moments during a step), and per pixel of an image
(photograph, render, sums over windows, derivatives)."""

LISTED = 32
"""Entries of a Gaussian in the lists of tiles, 100 bytes each; small Gaussians have 1 to 4."""


def estimate_bytes(plan: GaussianPlan, count: int, pixels: int) -> int:
    """Memory of a step with ``count`` Gaussians and ``pixels`` pixels [bytes]."""
    numbers = 11 + 3 * (plan.degree + 1) ** 2
    return count * (numbers * NUMBER + LISTED * 100) + pixels * PIXEL


def check_memory(plan: GaussianPlan, photographs: int, pixels: int, limit: int | None = None) -> str:
    """Check that a fit has enough memory; returns a sentence about the memory.

    Args:
        plan: plan of the fit.
        photographs: bytes of the photographs.
        pixels: pixels of the largest photograph.
        limit: [bytes]; None takes the free memory of the machine, or of the GPU.

    Raises:
        MivolError: the fit needs more memory; the message names a possible number of Gaussians.
    """
    most = max(plan.most, plan.start)
    needed = photographs + estimate_bytes(plan, most, pixels)

    def advise(free: float) -> str:
        each, rest = estimate_bytes(plan, 1, 0), free - photographs - estimate_bytes(plan, 0, pixels)
        return f"gaussians.most = {rest // each:.0f} fits" if rest > each else "read the photographs smaller (photos.scale)"

    back_end.check_memory(needed, f"a fit of {most} Gaussians", advise, limit)
    return f"about {needed / 2**20:.0f} MiB: {photographs / 2**20:.0f} for photographs, the rest for Gaussians and an image"
