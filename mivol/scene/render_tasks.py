"""Renders of a planned scene as tasks: what Dr.Jit traces, records and replays.

Conventions. A task holds facts and choices, and no arrays. In each call it views the media of the scene anew, so that a
recording reads the arrays of that call.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import RecordedTask, copy_aligned, is_recording
from mivol.scene.media_light import MediaLight, find_light_place
from mivol.scene.needs import Needs
from mivol.scene.plan import Plan, Readings, build_estimators
from mivol.scene.scene_state import SceneState, find_hidden_arrays
from mivol.scene.survey import SceneSurvey
from mivol.space import lattice_from_world
from mivol.transport.estimators.lighting.bright_map import BrightMap
from mivol.transport.estimators.lighting.emission_sampling import place_cells
from mivol.transport.estimators.lighting.tabulated_shadows import place_nodes
from mivol.transport.estimators.scores import Primal, Replay, Tangent
from mivol.transport.line_integrals.aovs import integrate_aovs, jvp_aovs, vjp_aovs
from mivol.transport.media.body import cuts_grids
from mivol.transport.media.extinction import to_components
from mivol.transport.media.phases import Phase, read_phase
from mivol.transport.path.derivatives import (
    carry_tangents,
    collect_albedo_derivatives,
    keeps_collisions,
    prepare_derivatives,
    replay_branches,
)
from mivol.transport.path.estimators import Estimators, Settings
from mivol.transport.path.film import (
    CameraRays,
    LightOfOwnRays,
    RenderSamples,
    adjoint_rays,
    count_passes,
    render_on_film,
    sample_rays,
)
from mivol.transport.path.successive import paths_per_lane, walk_branching, walk_successively
from mivol.transport.path.walk import (
    has_one_segment,
    leave_camera,
    leave_camera_from_memory,
    walk_from_camera,
    walk_light,
    walk_path,
)
from mivol.transport.traversal.box import with_placements
from mivol.transport.traversal.random_numbers import SpreadSampler


@dataclass
class PreparedArrays:
    """The arrays made before a render, which a recording takes as inputs.

    Attributes:
        readings: what transport reads of the values of media.
        light: table of the light of media (density, cumulative); None without a table.
        views: sensors of a ``batch``; None if the sensor is no batch.
        placements: numbers of boxes, grids and the scene (:func:`prepare_placements`); None while ``dr.freeze`` records.
        tracer: scene of the surfaces alone; None to trace the whole scene.
        emitters: weights and places of emitters (:func:`mivol.transport.estimators.lighting.emitters.read_emitters`); None
            while ``dr.freeze`` records.
        bright: table for samples of the environment map, in images (:class:`BrightMap`).
        phases: the phase function of each medium, whose arrays Mitsuba hides from Dr.Jit.
        rays: the rays and weights of a sensor whose arrays Mitsuba hides (:func:`mivol.transport.path.film.sample_rays`); None
            to sample the sensor in the render.
    """

    readings: Readings
    light: tuple[mi.Float, mi.Float64] | None
    views: mi.SensorPtr | None
    placements: mi.Float64 | None
    tracer: mi.Scene | None
    emitters: mi.Float | None
    bright: BrightMap | None
    phases: list[Phase] = field(default_factory=list)
    rays: list[tuple[mi.Ray3f, mi.Spectrum]] | None = None


@dataclass
class PlannedScene:
    """The facts of a scene, its plan, and what transport reads of its values. Valid while no parameter changes.

    Attributes:
        state: state of the parameters.
        spp: samples per pixel.
        survey: where the media, surfaces and emitters are.
        needs: facts without arrays: a kept view of a medium would keep the derivatives of an earlier step.
        plan: choices for the scene.
        arrays: arrays made for the plan.
        settings: of the integrator, for this purpose.
        layout: of ``arrays.placements``.
        unrecorded: why renders are not recorded; None if they are.
        image_plan: plan of the image from which derivatives were planned; None if they were planned by themselves.
        may_gain: whether a gain of sampling the light of media was predicted, at the time of the plan.
    """

    state: SceneState
    spp: int
    survey: SceneSurvey
    needs: Needs
    plan: Plan
    arrays: PreparedArrays
    settings: Settings
    layout: PlacementLayout
    unrecorded: str | None = None
    image_plan: Plan | None = None
    may_gain: bool = False

    def read_arrays(self) -> PreparedArrays:
        """The arrays of the next call. The derivatives of a phase function belong to one step, so they are not kept."""
        boundaries = self.needs.boundaries
        return replace(self.arrays, phases=[read_phase(boundary.medium.phase_function()) for boundary in boundaries])

    def is_for(self, state: SceneState, spp: int) -> bool:
        """Whether a scene in this state, with so many samples, has the same facts."""
        return self.spp == spp and self.state.is_same(state)

    def is_like(self, state: SceneState, spp: int) -> bool:
        """Whether a scene in this state, with so many samples, differs at most by values that a recording follows."""
        return self.spp == spp and self.state.sensor is state.sensor and self.state.key == state.key

    @cached_property
    def key(self) -> tuple:
        """All that a recording depends on and does not follow."""
        are_far = tuple(map(math.isinf, self.needs.emitter_distances))
        return (*self.plan.decisions, self.needs.camera_inside, are_far, self.layout.key, *self.state.key)


@dataclass
class PlacementLayout:
    """Where groups of numbers are in the array of :func:`prepare_placements`.

    Attributes:
        places: index of the first number of each group, by the bytes of the group.
        scales: scale of the medium in each boundary if Mitsuba holds it as a number. A task keeps the first, whose bytes
            lead to the present one.
        key: all places that a recording does not follow: those of grids, and all if a medium that emits fills no box. Also
            what the host decides: which groups are equal, which boundaries cut grids or are upright, which media have a scale
            of 1, and the nodes of the table of shadows.
    """

    places: dict[bytes, int] = field(default_factory=dict)
    key: tuple = ()
    scales: tuple[float | None, ...] = ()


def prepare_placements(needs: Needs, size: float, shadow_nodes: int) -> tuple[mi.Float64 | None, PlacementLayout]:
    """The numbers of boxes, grids and surfaces, and the scales of stock media, as one array.

    For :func:`mivol.transport.traversal.box.with_placements`.

    Args:
        needs: facts with the views of the media.
        size: size of the scene [length].
        shadow_nodes: nodes along an edge of the table of shadows; 0 without a table.
    """
    found = (view.numbers.get("scale") for view in needs.views)
    scales = tuple(scale if isinstance(scale, float) else None for scale in found)
    if is_recording():
        return None, PlacementLayout(scales=scales)
    groups = [np.array([size], np.float64), needs.lit_box]
    nodes, table = place_nodes(needs.lit_box, shadow_nodes)
    groups += [table.from_world, table.to_world[:3]] if shadow_nodes else []
    boxes, holes, grids = [b.box for b in needs.boundaries], [b.hole for b in needs.boundaries], []
    for box, hole, view in zip(boxes, holes, needs.views, strict=True):
        groups += [one.from_world for one in (box, hole) if one is not None]
        groups += [np.array([box.edge])] if box is not None else []
        lattices = (part.lattice for part in view.parts if part.lattice is not None)
        grids += [lattice_from_world(lattice.to_world, lattice.res) for lattice in lattices if lattice.to_world is not None]
        if view.emits:
            grids += [stock.from_world for stock in view.stock_boxes.values()]
            groups += [place_cells(box)] if box is not None else []
    groups += [np.array([scale]) for scale in scales if scale is not None]
    groups += [*(needs.surface_boxes or ()), *grids]
    firsts = np.cumsum([0, *(group.size for group in groups)])
    numbers = copy_aligned(np.concatenate([group.ravel() for group in groups]))
    places = {group.tobytes(): int(k) for group, k in zip(groups[::-1], firsts[-2::-1], strict=True)}
    glows = [(view, box) for view, box in zip(needs.views, boxes, strict=True) if view.emits]
    kept = groups if any(box is None for _, box in glows) else grids
    key = (*(places[group.tobytes()] for group in groups), *map(cuts_grids, needs.views, boxes, holes), *nodes)
    key += tuple(scale == 1 for scale in scales)
    key += tuple(box is not None and box.is_upright for box in boxes)
    if kept is grids:
        key += tuple(find_light_place(view, box.to_world) is box.to_world for view, box in glows)
    key += tuple(group.tobytes() for group in kept)
    return mi.Float64(numbers), PlacementLayout(places, key, scales)


def find_unrecorded(scene: mi.Scene, sensor: mi.Sensor, spp: int, needs: Needs, plan: Plan, for_images: bool) -> str | None:
    """Why images, or derivatives, of a scene are traced in every call; None if they are recorded."""
    if count_passes(sensor, spp, plan.pass_rays) > 1:
        # A recording launches all its passes at once: Ctrl-C would act after the last.
        return "tracing takes little of a render of several passes"
    if any(m.bounded or m.has_own_walk for m in needs.media):
        return "the host reads majorants, lists Gaussians and indexes octrees"
    return find_hidden_arrays(scene, sensor)


class RenderTask(RecordedTask):
    """A render of a scene whose plan is made.

    Args:
        opened: facts and plan of the scene, settings, and the samples per pixel.
        aovs: as in :class:`mivol.scene.session.Session`.
        for_images: True for estimators of images, False for estimators of derivatives.
    """

    def __init__(self, opened: PlannedScene, aovs: list[str], for_images: bool) -> None:
        super().__init__()
        self.survey, self.needs, self.plan = opened.survey, opened.needs, opened.plan
        self.spp, self.settings, self.aovs, self.for_images = opened.spp, opened.settings, aovs, for_images
        self.layout = opened.layout

    def build_estimators(self, scene: mi.Scene, arrays: PreparedArrays) -> Estimators:
        """Build the planned estimators over the arrays of the scene."""
        with with_placements(arrays.placements, self.layout.places):
            needs = self.needs.with_views(self.survey, arrays.phases, self.layout.scales)
            if arrays.light is not None:
                needs = replace(needs, media_light=MediaLight(*arrays.light))
            made = arrays.readings, arrays.tracer, arrays.emitters, arrays.bright
            return build_estimators(scene, needs, self.plan, self.settings, self.survey, self.for_images, *made)

    def samples(self, sensor: mi.Sensor, arrays: PreparedArrays, seed: mi.UInt32) -> RenderSamples:
        """The samples of the render."""
        given = None if arrays.rays is None else iter(arrays.rays)
        return RenderSamples(sensor, seed, self.spp, self.plan.pass_rays, arrays.views, given)

    def with_rays(self, sensor: mi.Sensor, arrays: PreparedArrays, seed: mi.UInt32) -> PreparedArrays:
        """The arrays with the rays of the sensor."""
        own = [count for count, _ in self.list_own_rays(sensor)]
        return replace(arrays, rays=sample_rays(self.samples(sensor, arrays, seed), own))

    def list_own_rays(self, sensor: mi.Sensor) -> list[tuple[int, str]]:
        """Rays of a pixel for light with rays of its own, and the names of their estimators: only images have them."""
        return []


class JoiningTask(RecordedTask):
    """Nothing, with a scene and its tracer as inputs: a replay joins the arrays that map the same memory."""

    def __call__(self, scene: mi.Scene, tracer: mi.Scene, number: mi.UInt32) -> mi.UInt32:
        return number + 1


class ImageTask(RenderTask):
    """An image."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given, for_images=True)

    def __call__(self, scene: mi.Scene, sensor: mi.Sensor, arrays: PreparedArrays, seed: mi.UInt32) -> mi.TensorXf:
        samples, plan, estimators = self.samples(sensor, arrays, seed), self.plan, self.build_estimators(scene, arrays)
        lights = [
            LightOfOwnRays(count, partial(_find_radiance, getattr(estimators, name)()))
            for count, name in self.list_own_rays(sensor)
        ]
        estimators = plan.light_of_paths(estimators)
        return render_on_film(samples, self.aovs, lambda rays: _render_primal(estimators, rays, plan, self.aovs), lights)

    def list_own_rays(self, sensor: mi.Sensor) -> list[tuple[int, str]]:
        plan, spp = self.plan, self.spp or sensor.sampler().sample_count()
        counts = spp * plan.lamp_rays, plan.emission_rays, plan.mirror_rays
        names = "of_lamps", "of_camera_emission", "of_mirrors"
        return [(count, name) for count, name in zip(counts, names, strict=True) if count]


class GradientTask(RenderTask):
    """The derivatives of an image, added to the gradients of the parameters."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given, for_images=False)

    def __call__(
        self, scene: mi.Scene, sensor: mi.Sensor, arrays: PreparedArrays, seed: mi.UInt32, grad_in: mi.TensorXf
    ) -> None:
        with dr.suspend_grad():
            with dr.resume_grad():
                estimators = self.build_estimators(scene, arrays)
            media = estimators.media
            media.find_followed()
            constant = None
            if len(self.needs.parameters) == 1 and estimators.segment.ends_in_media and not self.aovs:
                constant = media.find_only_constant()
            if constant is not None:
                self._sum_tangents(estimators, constant, self.samples(sensor, arrays, seed), grad_in)
                return
            keeps = self.plan.branches and self.needs.follows_albedos and keeps_collisions(estimators)
            media.start_gradients(self.needs.crop_samples)
            # Deliver gradients of volumes after all passes: Dr.Jit follows the edge from a derived value to its parameter only
            # once.
            with dr.isolate_grad():
                for rays, dL, daovs in adjoint_rays(self.samples(sensor, arrays, seed), self.aovs, grad_in):
                    if keeps:
                        collect_albedo_derivatives(estimators, rays, dL)
                    else:
                        _replay(estimators, rays, dL, self.plan.branches)
                    vjp_aovs(media, rays.ray, self.aovs, daovs)
                    dr.eval()
            with dr.resume_grad():
                media.deliver_gradients()

    def _sum_tangents(
        self, estimators: Estimators, constant: mi.Float | mi.Color3f, samples: RenderSamples, grad_in: mi.TensorXf
    ) -> None:
        """Add the derivative by the only coefficient with gradients: each ray's tangent times d loss / d radiance.

        This takes half the time of a replay. A colour of the radiance depends on one channel only.
        """
        estimators.media.start_unit_tangent()
        total = dr.zeros(mi.Spectrum)
        with dr.isolate_grad():
            for rays, dL, _ in adjoint_rays(samples, self.aovs, grad_in):
                product = dL * _find_tangent(estimators, rays, self.plan.branches)
                total += mi.Spectrum(*(dr.sum(row) for row in to_components(product)))
                dr.eval(total)
        with dr.resume_grad():
            kind = type(constant)
            dr.accum_grad(constant, kind(total) if dr.size_v(kind) == dr.size_v(total) else sum(to_components(total)))
            dr.enqueue(dr.ADMode.Backward, constant)
            dr.traverse(dr.ADMode.Backward)


class TangentTask(RenderTask):
    """The derivative of an image along the gradients of the parameters."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given, for_images=False)

    def __call__(self, scene: mi.Scene, sensor: mi.Sensor, arrays: PreparedArrays, seed: mi.UInt32) -> mi.TensorXf:
        with dr.suspend_grad():
            with dr.resume_grad():
                estimators = self.build_estimators(scene, arrays)
                estimators.media.find_followed()
                estimators.media.start_tangent()
            samples = self.samples(sensor, arrays, seed)
            branches, aovs = self.plan.branches, self.aovs
            return render_on_film(samples, aovs, lambda rays: _render_tangent(estimators, rays, branches, aovs))


OWN_KERNEL = 1 << 16
"""From this many samples an image has a kernel of its own. The kernel shared with stems and branches passes the start of each
path through memory, for some 40 ns, and saves 0.3 s of the compiler: the time of 100 such images."""


def _render_primal(estimators: Estimators, rays: CameraRays, plan: Plan, aovs: list[str]) -> tuple:
    if plan.image_branches > 1:
        L, alpha, _ = walk_branching(estimators, rays.sampler, rays.ray, plan.image_branches)
        return L, alpha, integrate_aovs(estimators.media, rays.ray, aovs)
    count = paths_per_lane(plan.successive_paths, dr.width(rays.ray))
    if count > 1:
        L, alpha = walk_successively(estimators, rays.sampler, rays.ray, count)
    elif estimators.segment.ends_in_media and isinstance(rays.sampler, SpreadSampler) and dr.width(rays.ray) < OWN_KERNEL:
        L, alpha, _ = walk_light(estimators, leave_camera_from_memory(estimators, rays.sampler, rays.ray), stops=False)
    else:
        L, alpha = _walk_paths(estimators, rays)
    return L, alpha, integrate_aovs(estimators.media, rays.ray, aovs)


def _find_radiance(estimators: Estimators, rays: CameraRays) -> mi.Spectrum:
    """Radiance of one path for each ray."""
    return _walk_paths(estimators, rays)[0]


def _walk_paths(estimators: Estimators, rays: CameraRays) -> tuple[mi.Spectrum, mi.Float]:
    """Radiance and alpha of one path for each ray."""
    score, alpha = walk_path(estimators, rays.sampler, rays.ray, Primal(zero_radiance(rays.ray)))
    return score.L, alpha


def _render_tangent(estimators: Estimators, rays: CameraRays, branches: bool, aovs: list[str]) -> tuple:
    """The derivative of the radiance along camera rays, alpha and AOVs, for the film."""
    tangent = _find_tangent(estimators, rays, branches)
    return tangent, dr.zeros(mi.Float, dr.width(tangent)), jvp_aovs(estimators.media, rays.ray, aovs)


def _find_tangent(estimators: Estimators, rays: CameraRays, branches: bool) -> mi.Spectrum:
    """The derivative of the radiance along camera rays."""
    prepare_derivatives(estimators, rays.ray)
    if branches:
        return carry_tangents(estimators, rays)
    black = zero_radiance(rays.ray)
    return walk_path(estimators, rays.sampler, rays.ray, Tangent(black, black))[0].dL


def _replay(estimators: Estimators, rays: CameraRays, dL: mi.Spectrum, branches: bool) -> None:
    prepare_derivatives(estimators, rays.ray)
    if branches:
        replay_branches(estimators, rays, dL)
    else:
        _replay_whole(estimators, rays, dL)


def _replay_whole(estimators: Estimators, rays: CameraRays, dL: mi.Spectrum) -> None:
    start, L = leave_camera(estimators, rays.sampler, rays.ray), None
    if not has_one_segment(estimators):
        L = walk_from_camera(estimators.replayed(), start.clone(), Primal(zero_radiance(rays.ray)))[0].L
        dr.eval(L)
    walk_from_camera(estimators, start, Replay(L, dL))


def zero_radiance(ray: mi.Ray3f) -> mi.Spectrum:
    """No light along each ray."""
    return dr.zeros(mi.Spectrum, dr.width(ray))
