r"""Questions about a scene that small previews answer: the sufficient ``max_depth``, the light of the last order of scattering,
and the gain of sampling the light of media.

**Depth.** A path tracer with ``max_depth`` d omits light that scatters more often. :func:`find_sufficient_depth` renders a
preview of 32 x 32 cells of the film at each depth of :data:`DEPTHS`. With the means I_d of a cell, a depth has the error

.. math:: e_d = \sqrt{ \langle (I_d - I_\infty)^2 \rangle } \,/\, \langle I_\infty \rangle

The sufficient depth is the smallest depth with e_d below the requested noise of a pixel. Squares are products of differences
of independent batches, so noise adds no mean. Bias: none in e_d^2. The standard error comes from the jackknife over the
batches (Efron & Stein 1981).

**Last order.** With ``max_depth`` d, light scatters up to d - 1 times. :func:`warn_of_last_order` renders the same paths with d
and with d - 1: the difference is the light that scatters d - 1 times. One kernel serves both, since the depth is an argument.

**Light of media.** The prediction of :mod:`mivol.scene.media_light` considers only the light of media. If other light is
noisier, sampling costs time and removes hardly any noise. So :func:`measure_media_light` renders cells of the film with and
without sampling, along one ray per cell. The gain is the median over the cells of

.. math:: g = \frac{\max( s_{met}^2,\; n\,(m_{met} - m_{drawn})^2 )}{c\,s_{drawn}^2}

with the means m and variances s^2 of n samples, and c the time of a path with sampling over the time of a path without. If no
path hits a light found by sampling, the difference of the means stands for the unseen noise.

**Light of near emitters.** :func:`measure_near_light` renders the same cells with direct light at collisions and at distances
drawn on each segment. The gain is the sum of the variances of all cells with collisions, over c times their sum with distances:
the noise of collisions near an emitter is large in few cells.

**Emission in view.** :func:`measure_emission_noise` measures the variance of pixels with and without the light that media emit
towards the camera, and of this light along camera rays of its own.

**Mirrors.** :func:`measure_mirror_noise` measures the same of the light mirrored by the first glass of a camera ray, and the
variance of paths with a kept mirrored ray.

**Lamps behind glass.** :func:`measure_refracted_noise` measures the variance of pixels with lamps met by chance, and with
directions drawn through the glass.

**Branches.** :func:`measure_branch_noise` measures the variance of pixels with one and with several branches of a path. With k
branches it is A + B / k, so two numbers of branches tell the noise A of stems and B of branches.

**Noise of lights.** :func:`measure_emitter_noise` renders single pixels with and without each emitter, for ``mivol explain``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mivol.errors import MivolWarning
from mivol.kernel_recording import is_recording, without_garbage_collection
from mivol.scene.choices import (
    is_branch_noise_open,
    is_emission_noise_open,
    is_lamp_noise_open,
    is_mirror_noise_open,
    is_near_light_open,
    is_refracted_light_open,
)
from mivol.scene.media_light import SAMPLING_COST
from mivol.scene.needs import Needs, find_needs
from mivol.scene.plan import Plan, build_estimators, choose_segment, make_plan
from mivol.scene.survey import BranchNoise, MirrorNoise, OwnRaysNoise, RefractedNoise, SceneSurvey, survey_scene
from mivol.scene_graph import traverse
from mivol.transport.estimators.lighting.bright_map import MapReading
from mivol.transport.estimators.lighting.kept_rays import MirroredEmitters
from mivol.transport.estimators.scores import Primal
from mivol.transport.path.estimators import Estimators, Settings
from mivol.transport.path.successive import walk_branching
from mivol.transport.path.walk import has_one_segment, walk_path
from mivol.transport.traversal.random_numbers import SpreadSampler
from mivol.transport.traversal.rays import give_each_lane_a_ray

DEPTHS = (2, 3, 6, -1)
"""Compared depths; the last depth, without a limit, is the reference."""

NOISE = 0.02
"""Default noise of a pixel over the mean radiance [1]."""

DEPTH_SIDE, DEPTH_BATCHES, DEPTH_SAMPLES = 32, 8, 16
"""Cells along an edge of the depth preview, batches, and samples per cell and batch."""

DEPTH_SEED = 0xDE97
"""Seed of all depths: common random numbers cancel in the differences."""


@dataclass(frozen=True)
class DepthError:
    """The light omitted by a depth.

    Attributes:
        depth: ``max_depth``.
        share: omitted light over the mean radiance [1].
        rms: root mean square error over the cells, over the mean radiance [1].
        at_most: ``rms`` with two standard errors added to its square [1].
    """

    depth: int
    share: float
    rms: float
    at_most: float

    def __str__(self) -> str:
        return f"depth {self.depth} leaves out {self.share:.2%} of the light, {self.rms:.2%} rms (at most {self.at_most:.2%})"


@dataclass(frozen=True)
class SufficientDepth:
    """The depth sufficient for a scene.

    Attributes:
        left_out: error of each limited depth of :data:`DEPTHS`.
        noise: requested noise of a pixel over the mean radiance [1].
    """

    left_out: tuple[DepthError, ...]
    noise: float

    @property
    def depth(self) -> int:
        """The smallest depth of :data:`DEPTHS` whose error is below the noise."""
        return next((found.depth for found in self.left_out if found.at_most <= self.noise), DEPTHS[-1])

    @property
    def reason(self) -> str:
        """The measurements behind the depth, in words."""
        measured = "; ".join(map(str, self.left_out))
        return f"{measured}; noise of {self.noise:.2%} is requested"


def find_sufficient_depth(scene: mi.Scene, sensor: mi.Sensor, settings: Settings, noise: float = NOISE) -> SufficientDepth:
    """Find the smallest sufficient ``max_depth`` for the light seen by a sensor.

    Args:
        scene: the complete scene.
        sensor: a sensor of the scene, or another sensor.
        settings: settings of the integrator; its depth and its quadrature are ignored.
        noise: requested noise of a pixel over the mean radiance [1].

    Raises:
        MivolError: as :func:`mivol.scene.plan.make_plan`.

    Cost: half a million paths, and one kernel per depth.
    """
    with dr.suspend_grad():
        survey, drawn = survey_scene(scene), replace(settings, deterministic=False, shadows="auto")
        seen = [_render_depth_preview(scene, sensor, survey, replace(drawn, max_depth=depth)) for depth in DEPTHS]
    return SufficientDepth(
        tuple(measure_depth_error(depth, some, seen[-1]) for depth, some in zip(DEPTHS, seen[:-1], strict=False)), noise
    )


def measure_depth_error(depth: int, some: NDArray, full: NDArray) -> DepthError:
    """Compare the cells (batches, cells) of a depth with the cells of all light."""
    lost, level = full - some, full.mean()
    if level <= 0:
        return DepthError(depth, 0.0, 0.0, 0.0)
    count = len(lost)
    square = _mean_square(lost)
    without = np.array([_mean_square(np.delete(lost, k, axis=0)) for k in range(count)])
    error = math.sqrt((count - 1) / count * np.square(without - without.mean()).sum())
    rms, most = (math.sqrt(max(value, 0.0)) / level for value in (square, square + 2 * error))
    return DepthError(depth, float(lost.mean() / level), rms, most)


def _mean_square(lost: NDArray) -> float:
    """Mean over cells of the squared mean over batches, without the mean of the noise."""
    count = len(lost)
    return float(np.mean(np.square(lost.sum(axis=0)) - np.square(lost).sum(axis=0)) / (count * (count - 1)))


def _render_depth_preview(scene: mi.Scene, sensor: mi.Sensor, survey: SceneSurvey, settings: Settings) -> NDArray:
    """Mean radiance over all colours of each cell (batches, cells)."""
    cells = DEPTH_SIDE * DEPTH_SIDE
    needs = find_needs(scene, sensor, survey, cells * DEPTH_BATCHES * DEPTH_SAMPLES, settings.may_draw_emission)
    plan = make_plan(needs, settings)
    estimators = _build_for_images(scene, needs, plan, settings, survey)
    n = DEPTH_BATCHES * cells * DEPTH_SAMPLES
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(DEPTH_SEED, n)
    cell = dr.arange(mi.UInt32, n) // DEPTH_SAMPLES % cells
    place = (mi.Vector2f(cell % DEPTH_SIDE, cell // DEPTH_SIDE) + sampler.next_2d()) / DEPTH_SIDE
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = mi.Float(sensor.shutter_open())
    ray, weight = sensor.sample_ray_differential(time, mi.Float(0), mi.Point2f(place), aperture)
    score, _ = walk_path(estimators, sampler, give_each_lane_a_ray(ray, n), Primal(dr.zeros(mi.Spectrum, n)))
    seen = np.array(score.L * weight, np.float64).reshape(-1, n).mean(axis=0)
    return seen.reshape(DEPTH_BATCHES, cells, DEPTH_SAMPLES).mean(axis=2)


NEAR_LIGHT_COST = 2.0
"""Time of a path with a distance drawn on each segment over the time of a path with direct light at collisions (measured on two
cores: 1.4 in a homogeneous haze with surfaces, 1.6 in fog, 2.1 to 2.4 in smoke of 64^3)."""

LAST_SHARE = 0.01
"""Share of the light in the last order of scattering above which a depth that nobody chose is mentioned [1]."""

LAST_SIDE, LAST_SAMPLES = 24, 16
"""Cells along an edge of the preview of the last order, and samples per cell."""

CELL_SEED = 0xD3A4
"""Seed of previews of cells: common random numbers for what is compared."""


class _KernelArgument(Settings):
    """Settings whose depth is an argument of kernels."""

    @classmethod
    def shortened(cls, settings: Settings, by: int) -> _KernelArgument:
        return cls(**{**asdict(settings), "max_depth": settings.max_depth - by})

    @property
    def depth_limit(self) -> mi.UInt32:
        return dr.opaque(mi.UInt32, self.max_depth)


def warn_of_last_order(
    scene: mi.Scene, sensor: mi.Sensor, needs: Needs, plan: Plan, survey: SceneSurvey, settings: Settings
) -> None:
    """Warn once for each scene if light of the last order of scattering exceeds ``LAST_SHARE`` by two standard errors.

    Args:
        scene, sensor: the scene and the sensor to render.
        needs, plan: facts and choices for ``settings``.
        survey: remembers that the scene has been measured.
        settings: settings of the integrator, with a limited depth.

    Cost: 2 x 9216 paths once, and one kernel. Nothing while ``dr.freeze`` records.
    """
    if "last order" in survey.warned or is_recording():
        return
    survey.warned.add("last order")
    with without_garbage_collection(), dr.suspend_grad():
        estimators = _build_for_images(scene, needs, plan, settings, survey)
        if has_one_segment(estimators):
            return
        whole, shorter = (
            _walk_cells(sensor, replace(estimators, settings=limited), LAST_SIDE, LAST_SAMPLES)
            for limited in (_KernelArgument.shortened(settings, by) for by in (0, 1))
        )
    share, error = last_order_share(whole, shorter)
    if share - 2 * error > LAST_SHARE:
        warnings.warn(
            f"max_depth was not given: light that scatters {settings.max_depth - 1} times, the last order of the default of "
            f"{settings.max_depth}, still carries {share:.0%} of the image; give max_depth (-1 for all light, as in volpath; "
            "this is said once).",
            MivolWarning,
            stacklevel=2,
        )


def last_order_share(whole: NDArray, shorter: NDArray) -> tuple[float, float]:
    """The share of light in ``whole`` that ``shorter`` omits, and its standard error [1], from samples (cells, n) of both.

    The samples of a cell are independent of each other, so the n means over the cells give the error of the ratio.
    """
    full, last = whole.mean(axis=0), (whole - shorter).mean(axis=0)
    if full.mean() <= 0:
        return 0.0, 0.0
    share = last.mean() / full.mean()
    return float(share), float((last - share * full).std(ddof=1) / (math.sqrt(len(full)) * full.mean()))


def measure_noise(
    scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings, for_images: bool
) -> Needs:
    """Measure all that the plan of an image, or of derivatives, decides by noise; each preview knows the ones before.

    Arguments as for :func:`measure_media_light`.

    Returns:
        The needs with what was measured.
    """
    measures = [measure_media_light, measure_near_light]
    if for_images:
        measures = [measure_emission_noise, *measures, measure_lamp_noise]
        measures += [measure_refracted_noise, measure_branch_noise, measure_mirror_noise]
    for measure in measures:
        needs = measure(scene, sensor, needs, survey, settings)
    return needs


def measure_emission_noise(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """Measure the noise of the light that media emit towards the camera, by paths and by camera rays of its own.

    Arguments as for :func:`measure_media_light`; ``survey`` keeps the variances of each sensor.

    Returns:
        The needs with the variances.

    Cost: 2 x 16384 paths once, and a kernel; if paths have less noise without this light, 16384 camera rays and another kernel.
    """
    if not _is_measurable(sensor) or not is_emission_noise_open(needs, settings, choose_segment(needs, settings)):
        return needs
    if sensor.ptr not in survey.emission_noise:
        with without_garbage_collection(), dr.suspend_grad():
            estimators = _build_for_images(scene, needs, make_plan(needs, settings), settings, survey)
            # The weight is an argument of one kernel.
            paths, rest = (
                _measure_pixel_variance(sensor, replace(estimators, camera_emission=dr.opaque(mi.Float, weight)))
                for weight in (1, 0)
            )
            rays = _measure_pixel_variance(sensor, estimators.of_camera_emission()) if rest < paths else 0.0
        survey.emission_noise[sensor.ptr] = OwnRaysNoise(paths, rest, rays)
    return replace(needs, emission_noise=survey.emission_noise[sensor.ptr])


def measure_mirror_noise(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """Measure the noise of the light mirrored by glass: by chance, by own camera rays, and by kept rays.

    Arguments as for :func:`measure_media_light`; ``survey`` keeps the variances of each sensor.

    Returns:
        The needs with the variances.

    Cost: 4 x 16384 paths once, and four kernels.
    """
    if not _is_measurable(sensor) or not is_mirror_noise_open(needs, settings, choose_segment(needs, settings)):
        return needs
    if sensor.ptr not in survey.mirror_noise:
        with without_garbage_collection(), dr.suspend_grad():
            plan = make_plan(needs, settings)
            estimators = plan.light_of_paths(_build_for_images(scene, needs, plan, settings, survey))
            ways = estimators, replace(estimators, glass="transmits"), estimators.of_mirrors()
            own, kept = OwnRaysNoise(*(_measure_pixel_variance(sensor, way) for way in ways)), math.inf
            if not any(m.bounded or m.has_own_walk for m in needs.media):
                mirrored = MirroredEmitters(scene, estimators.direct.emitters)
                kept = _measure_pixel_variance(sensor, replace(estimators, mirrored=mirrored))
            survey.mirror_noise[sensor.ptr] = MirrorNoise(own, kept)
    return replace(needs, mirror_noise=survey.mirror_noise[sensor.ptr])


def measure_refracted_noise(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """Measure the noise of paths beside lamps behind smooth glass: with directions through the glass, and by chance.

    Arguments as for :func:`measure_media_light`; ``survey`` keeps the variances of each sensor. The light that the first glass
    mirrors is left out: :func:`measure_mirror_noise` measures this light.

    Returns:
        The needs with the variances.

    Cost: 2 x 16384 paths once, and two kernels.
    """
    if not _is_measurable(sensor) or not is_refracted_light_open(needs, settings, choose_segment(needs, settings)):
        return needs
    if sensor.ptr not in survey.refracted_noise:
        with without_garbage_collection(), dr.suspend_grad():
            plan = make_plan(needs, settings)
            made = _build_for_images(scene, needs, replace(plan, draws_refracted_light=True), settings, survey)
            drawn = replace(plan.light_of_paths(made), glass="transmits")
            ways = replace(drawn, refracted=None), drawn
            survey.refracted_noise[sensor.ptr] = compare_refracted(*(_sample_pixels(sensor, way) for way in ways))
    return replace(needs, refracted_noise=survey.refracted_noise[sensor.ptr])


DRAW_SIDE, DRAW_SAMPLES = 24, 48
"""Cells along an edge of the emission preview, and samples per cell."""


def measure_media_light(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """Measure the gain of sampling the light of media, if the predicted gain is above 1.

    Args:
        scene, sensor: the scene and the sensor to render.
        needs: facts of the scene.
        survey: keeps the measured gain. If a fit changes the scene later, the stale gain affects noise only, not the mean.
        settings: settings of the integrator.

    Returns:
        The needs with the measured gain.

    Cost: 2 x 27648 paths once, and two kernels.
    """
    light = needs.media_light
    if light is None or light.gain <= 1 or settings.media_light != "auto":
        return needs
    if survey.gain_of_draws is None:
        with without_garbage_collection(), dr.suspend_grad():
            met, drawn = (
                _render_draw_preview(scene, sensor, needs, survey, replace(settings, media_light=m)) for m in ("met", "drawn")
            )
        survey.gain_of_draws = sampling_gain(met, drawn)
    return replace(needs, media_light=replace(light, gain=survey.gain_of_draws))


def measure_near_light(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """Measure the gain of drawing the light of near emitters along segments, for emitters outside of the media but near them.

    Arguments as for :func:`measure_media_light`.

    Returns:
        The needs with the measured gain.

    Cost: 2 x 27648 paths once, and two kernels.
    """
    if not is_near_light_open(needs, settings, choose_segment(needs, settings)):
        return needs
    if survey.near_gain is None and not is_recording():
        with without_garbage_collection(), dr.suspend_grad():
            vertices, segments = (
                _render_draw_preview(scene, sensor, needs, survey, replace(settings, near_light=m))
                for m in ("vertices", "segments")
            )
        noise, rest = (samples.var(axis=1, ddof=1).sum() for samples in (vertices, segments))
        survey.near_gain = float(noise / (NEAR_LIGHT_COST * rest)) if rest > 0 else 0.0
    return replace(needs, near_gain=survey.near_gain)


LAMP_SIDE, LAMP_SAMPLES = 32, 16
"""Pixels along an edge of the preview of lamps, and samples per pixel."""


def measure_lamp_noise(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """Measure the variances in a pixel of the light of lamps that the camera sees directly, and of all other light.

    Arguments as for :func:`measure_media_light`; ``survey`` keeps the variances of each sensor.

    Returns:
        The needs with the variances for one sample, mean over pixels and colours.

    Cost: 16384 camera rays once; if edges of lamps are seen, 16384 paths and another kernel.
    """
    if not is_lamp_noise_open(needs, settings) or is_recording():
        return needs
    if sensor.ptr not in survey.lamp_noise:
        with without_garbage_collection(), dr.suspend_grad():
            plan = make_plan(needs, settings)
            estimators = plan.light_of_paths(_build_for_images(scene, needs, plan, settings, survey))
            edge = _measure_pixel_variance(sensor, estimators.of_lamps())
            rest = _measure_pixel_variance(sensor, replace(estimators, shows="rest")) if edge > 0 else 0.0
        survey.lamp_noise[sensor.ptr] = (edge, rest)
    return replace(needs, lamp_noise=survey.lamp_noise[sensor.ptr])


BRANCH_SIDE, BRANCH_SAMPLES, BRANCH_ROUNDS, BRANCHES = 16, 16, 8, 4
"""Pixels along an edge of the preview of branches, samples per pixel, independent rounds, and branches of a path."""


def measure_branch_noise(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """Measure the variances in a pixel of the light of stems, and of branches behind their first collision.

    Arguments as for :func:`measure_media_light`; ``survey`` keeps the variances of each sensor.

    Returns:
        The needs with the variances.

    Cost: 65536 camera rays once, and 5 paths for each that collides.
    """
    if not _is_measurable(sensor) or not is_branch_noise_open(needs, settings, choose_segment(needs, settings)):
        return needs
    if sensor.ptr not in survey.branch_noise:
        with without_garbage_collection(), dr.suspend_grad():
            plan = make_plan(needs, settings)
            estimators = _build_for_images(scene, needs, plan, settings, survey)
            survey.branch_noise[sensor.ptr] = _measure_branches(sensor, plan.light_of_paths(estimators))
    return replace(needs, branch_noise=survey.branch_noise[sensor.ptr])


def _build_for_images(scene: mi.Scene, needs: Needs, plan: Plan, settings: Settings, survey: SceneSurvey) -> Estimators:
    """The estimators of an image; the environment map is read only where its focus behind glass is drawn."""
    bright = MapReading().follow(scene).table if plan.draws_refracted_light else None
    return build_estimators(scene, needs, plan, settings, survey, for_images=True, bright=bright)


def _is_measurable(sensor: mi.Sensor) -> bool:
    """Whether pixels of a sensor may be measured: not while Dr.Jit records, and not of a camera of several views, since
    Mitsuba's keeps arrays that recordings do not know."""
    return sensor.class_name() != "BatchSensor" and not is_recording()


def _measure_branches(sensor: mi.Sensor, estimators: Estimators) -> BranchNoise:
    """The variances of pixels spread over the film, between rounds of samples that are spread over each pixel."""
    pixel, size, cells = _middle_pixels(sensor, BRANCH_SIDE)
    n = cells * BRANCH_ROUNDS * BRANCH_SAMPLES
    lane = dr.arange(mi.UInt32, n)
    pixel = pixel(lane % (cells * BRANCH_SAMPLES) // BRANCH_SAMPLES)
    seed = lane // (cells * BRANCH_SAMPLES) + CELL_SEED
    sampler = SpreadSampler.of_pixels(mi.Vector2i(pixel), seed, lane % BRANCH_SAMPLES, dr.opaque(mi.UInt32, BRANCH_SAMPLES))
    place = (mi.Point2f(pixel) + sampler.next_2d()) / size
    ray, weight = _camera_ray(sensor, place)
    variances = []
    for count in (1, BRANCHES):
        L, _, depth = walk_branching(estimators, sampler.clone(), ray, count)
        light = np.array(L * weight, np.float64).reshape(-1, BRANCH_ROUNDS, cells, BRANCH_SAMPLES).mean(axis=3)
        variances.append(float(light.var(axis=1, ddof=1).mean()))
    one, several = variances
    branch = max(one - several, 0.0) * BRANCHES / (BRANCHES - 1)
    events = np.array(depth)
    hit = events > 0
    return BranchNoise(max(one - branch, 0.0), branch, float(hit.mean()), float(events[hit].mean()) if hit.any() else 0.0)


SWITCHES = ("radiance.value", "intensity.value", "irradiance.value", "scale")
"""Parameters of an emitter that are 0 without its light; the first that it has counts."""

MAX_SWITCHED = 8
"""Largest number of emitters whose noise is measured: each takes a preview."""


def measure_emitter_noise(
    scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings
) -> list[tuple[str, float]]:
    """Measure how much of the noise each emitter makes: by how much the variance in a pixel falls without its light.

    Arguments as for :func:`measure_media_light`. Lights are switched off one after the other, and on again.

    Returns:
        Name and share [1] of each emitter, the largest share first; empty for one emitter, for more than ``MAX_SWITCHED``,
        and for images without noise. Shares need not add up to 1: choosing among lights makes noise too, and lights behind and
        inside a medium make up for each other. Emitters without one of ``SWITCHES`` are left out.

    Cost: 16384 paths for each emitter, and 16384 more.
    """
    if not 2 <= len(scene.emitters()) <= MAX_SWITCHED or is_recording():
        return []

    plan = make_plan(needs, settings)

    def variance() -> float:
        return _measure_pixel_variance(sensor, _build_for_images(scene, needs, plan, settings, survey))

    shares = []
    with without_garbage_collection(), dr.suspend_grad():
        whole = variance()
        for number, emitter in enumerate(scene.emitters() if whole > 0 else []):
            values = traverse(emitter)
            switch = next((key for key in SWITCHES if key in values), None)
            if switch is None:
                continue
            lit = values[switch]
            kept = type(lit)(lit)
            try:
                values[switch] = kept * 0
                values.update()
                rest = variance()
            finally:
                values[switch] = kept
                values.update()
            shares.append((_name_emitter(scene, emitter, number), max(0.0, 1 - rest / whole)))
    return sorted(shares, key=lambda share: -share[1])


def _name_emitter(scene: mi.Scene, emitter: mi.Emitter, number: int) -> str:
    """The ``id`` of an emitter or of its shape; its class and number in a scene without names."""
    # An object that Python met first as an element of a list of emitters has no method ``shape``.
    shape = next((s for s in scene.shapes() if s.is_emitter() and s.emitter().ptr == emitter.ptr), None)
    return (shape or emitter).id() or f"{emitter.class_name()} {number}"


def _measure_pixel_variance(sensor: mi.Sensor, estimators: Estimators) -> float:
    """Variance of one sample in a pixel, mean over pixels spread over the film."""
    return _mean_variance(_sample_pixels(sensor, estimators))


def _mean_variance(L: NDArray) -> float:
    return float(L.var(axis=1, ddof=1).mean())


def _sample_pixels(sensor: mi.Sensor, estimators: Estimators) -> NDArray:
    """Mean radiance over all colours of each sample (pixels, LAMP_SAMPLES), in pixels spread over the film."""
    pixel, size, cells = _middle_pixels(sensor, LAMP_SIDE)
    n = cells * LAMP_SAMPLES
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(CELL_SEED, n)
    place = (mi.Point2f(pixel(dr.arange(mi.UInt32, n) // LAMP_SAMPLES)) + sampler.next_2d()) / size
    return _walk_from(sensor, estimators, sampler, place).reshape(cells, LAMP_SAMPLES)


def compare_refracted(by_chance: NDArray, drawn: NDArray) -> RefractedNoise:
    """The noise of samples (pixels, n) by chance and of samples with directions through glass.

    If none of N samples meets a lamp by chance, the lamp has a share of at most about 1 / N of the samples. Light that is
    missing by more than two standard errors then stands for the noise: N times the square of the difference of the means.
    """
    noise, other = _mean_variance(by_chance), _mean_variance(drawn)
    missed = by_chance.size * np.square(by_chance.mean() - drawn.mean()) - 4 * (noise + other)
    return RefractedNoise(max(noise, float(missed)), other)


def _middle_pixels(sensor: mi.Sensor, side: int) -> tuple[Callable[[mi.UInt32], mi.Vector2u], mi.ScalarVector2f, int]:
    """The middle pixel of each of at most side x side cells of a film by its number, the film's size, and their count."""
    width, height = (int(n) for n in sensor.film().size())
    columns, rows = min(width, side), min(height, side)

    def pixel(cell: mi.UInt32) -> mi.Vector2u:
        return mi.Vector2u(
            (2 * (cell % columns) + 1) * width // (2 * columns), (2 * (cell // columns) + 1) * height // (2 * rows)
        )

    return pixel, mi.ScalarVector2f(width, height), columns * rows


def sampling_gain(met: NDArray, drawn: NDArray) -> float:
    """Gain in time to an error of sampling over chance [1], from samples (cells, n) of both; 0 for black cells."""
    n = met.shape[1]
    missed = n * np.square(met.mean(axis=1) - drawn.mean(axis=1))
    noise = np.maximum(met.var(axis=1, ddof=1), missed)
    rest = SAMPLING_COST * drawn.var(axis=1, ddof=1)
    lit = (noise > 0) | (rest > 0)
    with np.errstate(divide="ignore"):
        return float(np.median(noise[lit] / rest[lit])) if lit.any() else 0.0


def _render_draw_preview(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> NDArray:
    """Mean radiance over all colours of each sample (cells, DRAW_SAMPLES), along the middle of each cell."""
    plan = make_plan(needs, settings)
    estimators = plan.light_of_paths(_build_for_images(scene, needs, plan, settings, survey))
    return _walk_cells(sensor, estimators, DRAW_SIDE, DRAW_SAMPLES)


def _walk_cells(sensor: mi.Sensor, estimators: Estimators, side: int, samples: int) -> NDArray:
    """Mean radiance over all colours of each sample (cells, samples), along the middles of side x side cells of the film."""
    cells, n = side * side, side * side * samples
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(CELL_SEED, n)
    cell = dr.arange(mi.UInt32, n) // samples
    place = (mi.Point2f(cell % side, cell // side) + 0.5) / side
    return _walk_from(sensor, estimators, sampler, place).reshape(cells, samples)


def _walk_from(sensor: mi.Sensor, estimators: Estimators, sampler: mi.Sampler, place: mi.Point2f) -> NDArray:
    """Mean radiance over all colours of a path from each place on the film."""
    ray, weight = _camera_ray(sensor, place)
    score, _ = walk_path(estimators, sampler, ray, Primal(dr.zeros(mi.Spectrum, dr.width(ray))))
    return np.array(score.L * weight, np.float64).reshape(-1, dr.width(ray)).mean(axis=0)


def _camera_ray(sensor: mi.Sensor, place: mi.Point2f) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
    """The ray through the middle of the lens from each place on the whole film [1], and its weight.

    Mitsuba takes places on the crop. Cameras with a projection go on beyond it; previews of other sensors see the crop alone.
    """
    film = sensor.film()
    if isinstance(sensor, mi.ProjectiveCamera):
        place = (place * mi.ScalarVector2f(film.size()) - mi.ScalarVector2f(film.crop_offset())) / mi.ScalarVector2f(
            film.crop_size()
        )
    time, middle = mi.Float(sensor.shutter_open()), mi.Point2f(0.5)
    ray, weight = sensor.sample_ray_differential(time, mi.Float(0.5), mi.Point2f(place), middle)
    return give_each_lane_a_ray(ray, dr.width(place)), weight
