r"""Which depth does a scene need?  Measured on a small preview, against the noise that is asked for.

A path tracer that ends at ``max_depth`` d leaves out the light that scatters more often. A preview of 32 x 32 cells of the
film is rendered at each depth of :data:`DEPTHS`; with the means I_d of a cell, a depth leaves out

.. math:: e_d = \sqrt{ \langle (I_d - I_\infty)^2 \rangle } \,/\, \langle I_\infty \rangle

The smallest depth whose e_d is below the noise of a pixel that is asked for is enough: what it leaves out would not be seen.
The squares are products of differences of independent batches, so the noise of the preview has no mean in them.

Bias: none in e_d^2. Variance: said as a standard error, by the jackknife over the batches (Efron & Stein 1981).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mivol.scene.build import build_estimators
from mivol.scene.needs import find_needs
from mivol.scene.plan import make_plan
from mivol.scene.survey import SceneSurvey, survey_scene
from mivol.transport.estimators.scores import Primal
from mivol.transport.path.estimators import Settings
from mivol.transport.path.walk import walk_path

__all__ = ["DEPTHS", "NOISE", "DepthAnswer", "LeftOut", "leaves_out", "measure_depths"]

DEPTHS = (2, 3, 6, -1)
"""Depths that are compared; the last one, which has no limit, judges the others."""

NOISE = 0.02
"""Noise of a pixel over the mean radiance, where none is asked for."""

SIDE, BATCHES, SAMPLES = 32, 8, 16
"""Cells along an edge of the preview, batches, and samples of a cell in each."""

SEED = 0xDE97
"""Of all depths: what their paths share cancels in the differences."""


@dataclass(frozen=True)
class LeftOut:
    """What a depth leaves out.

    Attributes:
        depth: ``max_depth``.
        share: of the mean radiance [1].
        rms: root mean square over the cells of the preview, over the mean radiance [1].
        at_most: that, and two standard errors of its square [1].
    """

    depth: int
    share: float
    rms: float
    at_most: float

    def __str__(self) -> str:
        return f"depth {self.depth} leaves out {self.share:.2%} of the light, {self.rms:.2%} rms (at most {self.at_most:.2%})"


@dataclass(frozen=True)
class DepthAnswer:
    """The depth that a scene needs.

    Attributes:
        left_out: by each limited depth of :data:`DEPTHS`.
        noise: of a pixel over the mean radiance that is asked for [1].
    """

    left_out: tuple[LeftOut, ...]
    noise: float

    @property
    def depth(self) -> int:
        """The smallest depth of :data:`DEPTHS` that leaves out less than the noise."""
        return next((found.depth for found in self.left_out if found.at_most <= self.noise), DEPTHS[-1])

    @property
    def reason(self) -> str:
        """Why it is that one, in words."""
        measured = "; ".join(map(str, self.left_out))
        return f"{measured}; noise of {self.noise:.2%} is asked for"


def measure_depths(scene: mi.Scene, sensor: mi.Sensor, settings: Settings, noise: float = NOISE) -> DepthAnswer:
    """Measure what each depth leaves out of the light that a sensor sees.

    Args:
        scene: with everything that is looked at in place.
        sensor: one of its sensors, or another.
        settings: of the integrator; their depth is not looked at.
        noise: of a pixel over the mean radiance that is asked for [1].

    Raises:
        MivolError: as :func:`mivol.scene.plan.make_plan`.

    Cost: half a million paths, and one kernel for each depth.
    """
    with dr.suspend_grad():
        survey = survey_scene(scene)
        seen = [_preview(scene, sensor, survey, replace(settings, max_depth=depth)) for depth in DEPTHS]
    return DepthAnswer(tuple(leaves_out(depth, some, seen[-1]) for depth, some in zip(DEPTHS, seen[:-1], strict=False)), noise)


def leaves_out(depth: int, some: NDArray, full: NDArray) -> LeftOut:
    """Compare the cells (batches, cells) of a depth with those of all light."""
    lost, level = full - some, full.mean()
    if level <= 0:
        return LeftOut(depth, 0.0, 0.0, 0.0)
    count = len(lost)
    square = _mean_square(lost)
    without = np.array([_mean_square(np.delete(lost, k, axis=0)) for k in range(count)])
    error = math.sqrt((count - 1) / count * np.square(without - without.mean()).sum())
    rms, most = (math.sqrt(max(value, 0.0)) / level for value in (square, square + 2 * error))
    return LeftOut(depth, float(lost.mean() / level), rms, most)


def _mean_square(lost: NDArray) -> float:
    """Mean over cells of the square of the mean over batches, without the mean of its noise."""
    count = len(lost)
    return float(np.mean(np.square(lost.sum(axis=0)) - np.square(lost).sum(axis=0)) / (count * (count - 1)))


def _preview(scene: mi.Scene, sensor: mi.Sensor, survey: SceneSurvey, settings: Settings) -> NDArray:
    """Mean radiance of all colours of each cell (batches, cells)."""
    cells = SIDE * SIDE
    needs = find_needs(scene, sensor, survey, cells * BATCHES * SAMPLES, settings.may_draw_emission)
    plan = make_plan(needs, settings)
    estimators = build_estimators(scene, needs, plan, settings, survey, pictures=True)
    n = BATCHES * cells * SAMPLES
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, n)
    cell = dr.arange(mi.UInt32, n) // SAMPLES % cells
    place = (mi.Vector2f(cell % SIDE, cell // SIDE) + sampler.next_2d()) / SIDE
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = mi.Float(sensor.shutter_open())
    ray, weight = sensor.sample_ray_differential(time, mi.Float(0), mi.Point2f(place), aperture)
    score, _ = walk_path(estimators, sampler, ray, Primal(dr.zeros(mi.Spectrum, n)))
    seen = np.array(score.L * weight, np.float64).reshape(-1, n).mean(axis=0)
    return seen.reshape(BATCHES, cells, SAMPLES).mean(axis=2)
