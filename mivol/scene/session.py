"""A session renders scenes with one set of settings: facts, plan, walk and film, and the same way back for derivatives.

Conventions. A session belongs to one integrator. The session keeps the surveys of the last ``MAX_SCENES`` scenes, so the same
integrator may render one scene after the other.

Kept sessions. An integrator takes over the session of a freed integrator with equal settings and the same scene, so a loop with
a new integrator in each step replays earlier recordings (:func:`take_session`). Integrators in memory at the same time have
sessions of their own. Mitsuba's objects take no weak references, so a list holds each kept scene until the list has the only
reference. This is checked when an integrator renders and when an integrator is freed.

Derived values. Plugins compute textures and tables from their parameters when a parameter changes. Dr.Jit follows the edge from
a parameter to a derived value only once, and never from inside a loop. So a reverse pass first recomputes the derived values
with fresh edges. A forward pass computes them from copies of the parameters, and carries the tangents to them before any kernel
reads them. Extinction needs neither: transport reads extinction from the parameters.
"""

from __future__ import annotations

import atexit
import itertools
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any
from weakref import ref

import drjit as dr
import mitsuba as mi

from mivol.back_end import is_on_gpu
from mivol.errors import MivolError
from mivol.kernel_recording import CannotRecordError, Recordings, is_recording, without_garbage_collection
from mivol.scene.choices import distance_class
from mivol.scene.needs import (
    Needs,
    find_emitter_distances,
    find_needs,
    locate_light,
    may_camera_be_inside,
    read_media,
    warn_of_misplaced_grids,
    warn_of_view,
)
from mivol.scene.plan import make_plan, plan_key, read_parts, settings_for
from mivol.scene.previews import measure_noise, warn_of_last_order
from mivol.scene.readings import release_unread
from mivol.scene.refusals import parse_aovs
from mivol.scene.render_tasks import (
    GradientTask,
    ImageTask,
    JoiningTask,
    PlannedScene,
    PreparedArrays,
    RenderTask,
    TangentTask,
    find_unrecorded,
    prepare_placements,
    zero_radiance,
)
from mivol.scene.scene_state import SceneState, find_gradient_array
from mivol.scene.sensors import check_film, find_sensor
from mivol.scene.stand_in import StandIn, evaluate_samplers, reset_sampler
from mivol.scene.survey import SceneSurvey, survey_scene
from mivol.scene_graph import find_children, list_values, put_value, traverse, traverse_children
from mivol.transport.estimators.lighting.bright_map import BrightMap, MapReading
from mivol.transport.estimators.lighting.emitters import read_emitters
from mivol.transport.estimators.scores import Primal
from mivol.transport.line_integrals.aovs import integrate_aovs
from mivol.transport.media.medium_view import MediumView
from mivol.transport.media.stock_grids import StockGrids
from mivol.transport.path.estimators import Settings
from mivol.transport.path.film import find_batch_views
from mivol.transport.path.walk import walk_path
from mivol.transport.traversal.box import with_placements


@dataclass
class _SurveyedScene:
    """The survey of a scene, and the shapes and emitters by which the scene is recognised.

    The scene itself is not kept: the scene may hold the integrator of this session, and then neither would ever be freed.

    Attributes:
        parts: the shapes and emitters.
        survey: where they are.
        is_joined: whether the scene and its tracer share their arrays.
        sources: the objects of whose parameters plugins compute values, by pointer; None before the first gradient.
        opened: the plans for images (True) and for derivatives (False).
        stand_ins: of the sensors, by kind. No sensor is held: a user may load a new sensor in each step.
        views: of the last image, for its derivatives; views kept longer would keep the derivatives of an earlier step.
        map: the bright part of the environment map.
        number: tells the recordings of scenes apart.
    """

    parts: list[mi.Object]
    survey: SceneSurvey
    is_joined: bool = False
    sources: set[int] | None = None
    opened: dict[bool, PlannedScene] = field(default_factory=dict)
    stand_ins: dict[str, StandIn] = field(default_factory=dict)
    views: tuple[MediumView, ...] = ()
    map: MapReading = field(default_factory=MapReading)
    number: int = field(default_factory=itertools.count().__next__)

    def derives_from(self, scene: mi.Scene, differentiated: Sequence[tuple[str, mi.Object]]) -> bool:
        """Whether plugins compute values from differentiated parameters (keys and owners) of the scene."""
        if self.sources is None:
            owners = _find_derived_owners(scene, self.find_grids())
            self.sources = {node.ptr for owner in owners for node in traverse(owner).hierarchy}
        return any(owner.ptr in self.sources for _, owner in differentiated)

    def find_grids(self) -> StockGrids:
        """What is known of the stock grids of the scene, with their look-ups."""
        grids = self.survey.grids
        for boundary in self.survey.boundaries:
            parts = [child for name, child in find_children(boundary.medium).items() if name.startswith("sigma_")]
            if any(grids.is_unknown(part) for part in parts):
                boundary.view(grids)
        return grids

    def is_of(self, parts: list[mi.Object]) -> bool:
        """Whether ``parts`` are the very same shapes and emitters."""
        return len(parts) == len(self.parts) and all(a is b for a, b in zip(parts, self.parts, strict=True))


OUT_OF_MEMORY = "out of memory"
"""Words of Dr.Jit's error when the system or the GPU has no more memory."""

MAX_SCENES = 2
"""Most scenes whose plans and recordings a session keeps, for example a scene to fit and a scene to judge by."""

MAX_RECORDINGS = 256
"""Largest number of recordings: an image and a gradient from each of 128 cameras."""


class Session:
    """Renders scenes with one set of settings.

    Args:
        settings: depth, Russian roulette, hidden emitters and the like.
        aovs: comma-separated names from :data:`mivol.transport.line_integrals.aovs.AOVS`.
        is_depth_given: whether the user has chosen ``max_depth``. If not, and the last order of scattering still carries light,
            a warning says so.

    Attributes:
        recordings: recorded images and gradients of the last scenes.

    Raises:
        MivolError: an unknown AOV, or a repeated name.
    """

    def __init__(self, settings: Settings, aovs: str = "", is_depth_given: bool = True) -> None:
        self.settings = settings
        self.is_depth_given = is_depth_given
        self.aovs = parse_aovs(aovs)
        self.recordings = Recordings(MAX_RECORDINGS)
        # The last is the one of the present render.
        self._scenes: list[_SurveyedScene] = []

    def __repr__(self) -> str:
        s = self.settings
        return f"mivol[max_depth={s.max_depth}, rr_depth={s.rr_depth}, aovs={','.join(self.aovs)}]"

    @property
    def is_new(self) -> bool:
        """Whether the session has rendered nothing."""
        return not self._scenes

    def is_like(self, other: Session) -> bool:
        """Whether both sessions have the same settings."""
        settings, others = ((one.settings, one.aovs, one.is_depth_given) for one in (self, other))
        return settings == others

    def render(
        self, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int, develop: bool = True, evaluate: bool = True
    ) -> mi.TensorXf:
        """Render an image (height, width, colours + AOVs).

        Raises:
            MivolError: a refusal of the plan, a film larger than the memory, or ``develop`` set to false.
        """
        if not develop:
            raise MivolError("found develop=False, expected True: mivol returns only developed images.")
        sensor = _find_renderable_sensor(scene, sensor)
        with without_garbage_collection(), dr.suspend_grad():
            opened = self._open(scene, sensor, spp, self._read_state(scene, sensor, True), for_images=True)
            image = self._run(ImageTask, opened, scene, sensor, _opaque_seed(seed))
        if evaluate:
            dr.eval(image)
        return image

    def render_forward(self, scene: mi.Scene, sensor: int | mi.Sensor, seed: int, spp: int) -> mi.TensorXf:
        """Render the derivative of an image along the gradients set on the parameters."""
        sensor = _find_renderable_sensor(scene, sensor)
        with without_garbage_collection():
            with dr.resume_grad():
                grids = self._survey(scene, self._read_state(scene, sensor, False)).find_grids()
            with carry_tangents(scene, grids):
                with dr.resume_grad():
                    opened = self._open(scene, sensor, spp, self._read_state(scene, sensor, False), for_images=False)
                return self._run(TangentTask, opened, scene, sensor, _opaque_seed(seed))

    def render_backward(self, scene: mi.Scene, grad_in: mi.TensorXf, sensor: int | mi.Sensor, seed: int, spp: int) -> None:
        """Add the derivatives of an image, weighted by ``grad_in``, to the gradients of the parameters.

        Cost: a render and its replay. Memory: a single pass, independent of the number of samples.
        """
        sensor = _find_renderable_sensor(scene, sensor)
        with without_garbage_collection():
            with dr.resume_grad():
                attached: list[Any] = []
                state = self._read_state(scene, sensor, False, attached)
                if self._survey(scene, state).derives_from(scene, state.differentiated):
                    recompute_derived(scene, self._surveyed.survey.grids)
                    attached = []
                    state = self._read_state(scene, sensor, False, attached)
                opened = self._open(scene, sensor, spp, state, for_images=False)
            self._run(GradientTask, opened, scene, sensor, _opaque_seed(seed), grad_in, attached=attached)

    def sample(self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool) -> tuple:
        """Estimate the radiance along given rays, for integrators that nest this integrator and do not name a sensor."""
        with dr.suspend_grad():
            sensor = find_sensor(scene, 0)
            opened = self._open(scene, sensor, 1, self._read_state(scene, sensor, True), for_images=True)
            task = RenderTask(opened, self.aovs, for_images=True)
            estimators = task.build_estimators(scene, opened.read_arrays())
            media = estimators.media
            named = [sensor.get_medium() for sensor in scene.sensors()]
            media.start = named[0] if all(medium is named[0] for medium in named) else None
            media.locates_camera = bool(media.traced)
            score, alpha = walk_path(estimators, sampler, ray, Primal(zero_radiance(ray)), active)
            # An integrator that nests this integrator treats alpha as a mask: sample the mask with probability alpha.
            return score.L, sampler.next_1d(active) < alpha, integrate_aovs(media, ray, self.aovs, active)

    def _run(
        self,
        kind: type[RenderTask],
        opened: PlannedScene,
        scene: mi.Scene,
        sensor: mi.Sensor,
        *inputs: Any,
        attached: Sequence[Any] = (),
    ) -> Any:
        """Run a task: record it, replay its recording, or trace it if it cannot be recorded.

        Args:
            attached: arrays to whose gradients the task adds.
        """

        def make() -> RenderTask:
            return kind(opened, self.aovs)

        given = (scene, sensor, opened.read_arrays(), *inputs)
        if is_recording() or opened.unrecorded is not None:
            return make()(*given)
        self._join_arrays(scene, opened.arrays.tracer)
        stand_in = self._find_stand_in(sensor, opened.state.sensor_kind)
        if stand_in is not None:
            stand_in.meet(sensor, scene.sensors(), self.aovs)
            stand_in.show(sensor, opened.state.of_sensor)
            arrays = make().with_rays(sensor, given[2], inputs[0]) if stand_in.takes_rays else given[2]
            given = (scene, stand_in.camera, arrays, *inputs)
        self._reset(given[1])
        gradients = [(value, dr.grad(value)) for value in attached]
        try:
            found = self.recordings.call(kind, (self._surveyed.number, opened.spp, *opened.key), make, *given)
            if stand_in is not None and kind is not GradientTask:
                stand_in.give_film(sensor, self.aovs)
            return found
        except CannotRecordError:
            # The task has run up to the fault.
            for value, gradient in gradients:
                dr.set_grad(value, gradient)
        try:
            return make()(scene, sensor, opened.read_arrays(), *inputs)
        except RuntimeError as error:
            if OUT_OF_MEMORY not in f"{error} {error.__cause__}":
                raise
        width, height = sensor.film().crop_size()
        where = "the GPU" if is_on_gpu() else "this machine"
        raise MivolError(
            f"a render of {width} x {height} pixels ran out of memory on {where}: render crops of half the pixels, or give"
            " the grids 80 % of their nodes along each axis (half the memory)."
        )

    def _read_state(
        self, scene: mi.Scene, sensor: mi.Sensor, for_images: bool, attached: list[Any] | None = None
    ) -> SceneState:
        """Read the state of the parameters (:meth:`SceneState.of`)."""
        known = self._opened.get(for_images) if self._turn_to(_list_parts(scene)) else None
        return SceneState.of(scene, sensor, attached, None if known is None else known.state)

    @property
    def _surveyed(self) -> _SurveyedScene:
        """The scene of the present render."""
        return self._scenes[-1]

    @property
    def _opened(self) -> dict[bool, PlannedScene]:
        """The plans of the scene of the present render."""
        return self._surveyed.opened

    def _turn_to(self, parts: list[mi.Object]) -> bool:
        """Choose the scene of these shapes and emitters for the present render; false for an unknown scene."""
        self._scenes.sort(key=lambda one: one.is_of(parts))
        return bool(self._scenes) and self._surveyed.is_of(parts)

    def _find_stand_in(self, sensor: mi.Sensor, kind: str | None) -> StandIn | None:
        """The camera to render in the place of a sensor; None for the sensor itself."""
        known = self._surveyed.stand_ins
        if kind is None:
            return None
        if kind not in known:
            known[kind] = StandIn.find(sensor, kind)
        return known[kind]

    def _reset(self, sensor: mi.Sensor) -> None:
        """Bring the film and the sampler into a state that does not depend on what was rendered before.

        Both are inputs of a recording, and no task reads their state. But Dr.Jit records anew for an image of zeros in place of
        no image, and for arrays in place of the numbers of a sampler that was never seeded.
        """
        sensor.film().prepare(self.aovs)
        reset_sampler(sensor)

    def _join_arrays(self, scene: mi.Scene, tracer: mi.Scene | None) -> None:
        """Let a scene and its tracer share their arrays before the first recording.

        Both map the same memory of Mitsuba by arrays of their own. The first replay makes them one array. This would change the
        inputs of the next call, which would be recorded anew.
        """
        if tracer is None or self._surveyed.is_joined:
            return
        self._surveyed.is_joined = True
        with suppress(CannotRecordError):
            for _ in range(3):
                self.recordings.call(JoiningTask, (), JoiningTask, scene, tracer, dr.opaque(mi.UInt32, 0))

    def _survey(self, scene: mi.Scene, state: SceneState) -> _SurveyedScene:
        """Survey a new scene, or follow the shapes of a known one."""
        parts = _list_parts(scene)
        kept = self._surveyed if self._turn_to(parts) else None
        if kept is not None:
            # One of the two may be of an earlier place.
            now = [opened.state for opened in kept.opened.values() if opened.survey is kept.survey]
            alike = [known for known in now if known.has_same_rest(state)]
            if any(known.shapes == state.shapes for known in alike) or kept.survey.is_current:
                return kept
            moved = kept.survey.follow_shapes(scene) if alike else None
            if moved is not None:
                kept.survey = moved
                return kept
        others = [one for one in self._scenes if one is not kept]
        if kept is not None or len(others) == MAX_SCENES:
            self.recordings.clear()
        self._scenes = [*others[1 - MAX_SCENES :], _SurveyedScene(parts, survey_scene(scene))]
        if not is_recording():
            evaluate_samplers()
        return self._surveyed

    def _open(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, state: SceneState, for_images: bool) -> PlannedScene:
        """Find the needs, plan, and read values; all of it is kept while the scene stays the same."""
        self._survey(scene, state)
        if is_recording():
            return self._plan(scene, sensor, spp, state, for_images)
        if for_images in self._opened and self._opened[for_images].is_for(state, spp):
            return self._opened[for_images]
        views, self._surveyed.views = self._surveyed.views, ()
        opened = self._open_like_image(scene, sensor, spp, state, views) if views and not for_images else None
        opened = opened or self._renew(scene, sensor, spp, state, for_images)
        opened = opened or self._plan(scene, sensor, spp, state, for_images)
        self._opened[for_images] = opened
        release_unread(self._surveyed.survey)
        return opened

    def _renew(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, state: SceneState, for_images: bool) -> PlannedScene | None:
        """Keep the facts and the plan for other values of the media; None if they change a fact that plans depend on."""
        known, survey = self._opened.get(for_images), self._surveyed.survey
        if known is None or not known.is_like(state, spp):
            return None
        needs, arrays, has_moved = known.needs, known.arrays, survey is not known.survey
        is_placed_anew = has_moved or state.scales != known.state.scales
        if has_moved:
            boundaries = (*survey.boundaries, *needs.boundaries[len(known.survey.boundaries) :])
            needs = needs.follow_shapes(boundaries, survey.facts)
        boundaries = needs.boundaries
        with with_placements(arrays.placements, known.layout.places):
            views = tuple(b.view(survey.grids) for b in boundaries)
            media = read_media(boundaries, views, survey)
            is_inside = may_camera_be_inside(scene, sensor, survey)
            viewed = replace(needs, views=views, media=media)
            viewed = locate_light(viewed, scene, sensor, survey) if self.settings.may_draw_emission else viewed
        if survey.may_gain != known.may_gain:
            return None
        if is_inside != needs.camera_inside or [plan_key(m) for m in media] != [plan_key(m) for m in needs.media]:
            return None
        if has_moved or state.lamps != known.state.lamps:
            distances = find_emitter_distances(scene, boundaries, media)
            if list(map(distance_class, distances)) != list(map(distance_class, needs.emitter_distances)):
                return None
            arrays = replace(arrays, emitters=read_emitters(scene))
        layout = known.layout
        if is_placed_anew:
            placements, layout = prepare_placements(viewed, survey.size, known.plan.shadow_nodes)
            arrays = replace(arrays, placements=placements, tracer=survey.usable_tracer)
        readings, bright = read_parts(viewed, known.plan, survey, for_images), self._read_bright_map(scene, for_images)
        arrays = replace(arrays, readings=readings, light=_read_table(viewed), bright=bright)
        self._surveyed.views = views if for_images else ()
        return replace(known, state=state, survey=survey, needs=needs, arrays=arrays, layout=layout)

    def _plan(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, state: SceneState, for_images: bool) -> PlannedScene:
        """Find the needs, plan, and read values."""
        survey = self._surveyed.survey
        known = next(iter(self._opened.values()), None)
        with with_placements(None if known is None else known.arrays.placements, {} if known is None else known.layout.places):
            needs = find_needs(scene, sensor, survey, spp, self.settings.may_draw_emission, state.differentiated)
        settings = settings_for(self.settings, needs, for_images)
        warn_of_misplaced_grids(needs, survey)
        warn_of_view(needs, scene, sensor, survey)
        with dr.suspend_grad():
            needs = measure_noise(scene, sensor, needs, survey, settings, for_images)
        plan = make_plan(needs, settings, self.aovs)
        if not self.is_depth_given:
            warn_of_last_order(scene, sensor, needs, plan, survey, settings)
        is_known = known is not None and known.survey is survey and known.state.others == state.others
        if not is_recording() and is_known and known.state.scales == state.scales:
            placements, layout = known.arrays.placements, known.layout
        else:
            placements, layout = prepare_placements(needs, survey.size, plan.shadow_nodes)
        readings, emitters = read_parts(needs, plan, survey, for_images), None if is_recording() else read_emitters(scene)
        light, bright = _read_table(needs), self._read_bright_map(scene, for_images)
        arrays = PreparedArrays(readings, light, find_batch_views(sensor), placements, survey.usable_tracer, emitters, bright)
        self._surveyed.views = needs.views if for_images and not is_recording() else ()
        facts = replace(needs, views=(), media_light=None)
        made = survey, facts, plan, arrays, settings, layout
        opened = PlannedScene(state, spp, *made, may_gain=survey.may_gain)
        return self._find_unrecorded(opened, scene, for_images)

    def _read_bright_map(self, scene: mi.Scene, for_images: bool) -> BrightMap | None:
        """Read the bright part of an environment map; returns None for derivatives."""
        if not for_images or is_recording():
            return None
        self._surveyed.map = self._surveyed.map.follow(scene)
        return self._surveyed.map.table

    def _open_like_image(
        self, scene: mi.Scene, sensor: mi.Sensor, spp: int, state: SceneState, views: tuple[MediumView, ...]
    ) -> PlannedScene | None:
        """Plan derivatives by the facts and readings of an image of the same values; None without such an image.

        Args:
            views: of the media, from the image.
        """
        image, known = self._opened.get(True), self._opened.get(False)
        if image is None or image.spp != spp or not image.state.has_same_numbers(state):
            return None
        arrays = replace(image.arrays, bright=None)
        if known is not None and known.image_plan is image.plan and known.is_like(state, spp):
            needs = known.needs.follow_shapes(image.needs.boundaries, image.needs)
            return replace(known, state=state, survey=image.survey, needs=needs, arrays=arrays, layout=image.layout)
        needs = image.needs.with_parameters(state.differentiated)
        if needs is None:
            return None
        settings = settings_for(self.settings, needs, for_images=False)
        plan = make_plan(replace(needs, views=views), settings, self.aovs)
        if plan.readings(for_images=False) != image.plan.readings(for_images=True):
            return None
        made = image.survey, needs, plan, arrays, settings, image.layout
        opened = PlannedScene(state, spp, *made, image_plan=image.plan)
        return self._find_unrecorded(opened, scene, for_images=False)

    def _find_unrecorded(self, opened: PlannedScene, scene: mi.Scene, for_images: bool) -> PlannedScene:
        """Find whether renders are recorded."""
        known, spp = self._opened.get(for_images), opened.spp
        if known is not None and (known.spp, known.key) == (spp, opened.key):
            opened.unrecorded = known.unrecorded
        else:
            opened.unrecorded = find_unrecorded(scene, opened.state.sensor, spp, opened.needs, opened.plan, for_images)
        return opened


def _read_table(needs: Needs) -> tuple[mi.Float, mi.Float64] | None:
    """The table of the light of media, if the scene has a table."""
    return None if needs.media_light is None else (needs.media_light.density, needs.media_light.cumulative)


def _list_parts(scene: mi.Scene) -> list[mi.Object]:
    """The shapes and emitters by which a scene is recognised."""
    return [*scene.shapes(), *scene.emitters()]


def _find_renderable_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """Find the sensor, and check that its image fits into memory."""
    found = find_sensor(scene, sensor)
    check_film(found)
    return found


def _opaque_seed(seed: int | mi.UInt32) -> mi.UInt32:
    """A seed as an argument of kernels: with a literal, a kernel would be compiled anew in every render."""
    opaque = mi.UInt32(seed)
    dr.make_opaque(opaque)
    return opaque


# -- Derived values --------------------------------------------------------------------------------------------------------


@dataclass
class _DifferentiatedParameter:
    """A parameter with gradients enabled, with a copy of its value: an update may replace the array."""

    params: mi.SceneParameters
    key: str
    value: Any

    @property
    def numbers(self) -> Any:
        """The array, or the matrix of a transform."""
        return self.value if dr.is_array_v(self.value) else self.value.matrix

    def assign(self, value: Any) -> None:
        """Set the parameter, and compute all derived values from the new value."""
        put_value(self.params, self.key, value)
        self.params.set_dirty(self.key)
        self.params.update()

    def restore(self) -> None:
        """Restore the original value without an update."""
        put_value(self.params, self.key, self.value)


def recompute_derived(scene: mi.Scene, grids: StockGrids) -> None:
    """Recompute the derived values of all parameters with gradients. Does nothing while ``dr.freeze`` records."""
    for parameter in _find_differentiated(scene, grids):
        parameter.assign(parameter.value)
        parameter.restore()


@contextmanager
def carry_tangents(scene: mi.Scene, grids: StockGrids) -> Iterator[None]:
    """Compute derived values from copies of the parameters, with tangents, inside a ``with`` block."""
    with dr.resume_grad():
        parameters = _find_differentiated(scene, grids)
        copies = [dr.detach(parameter.numbers) for parameter in parameters]
        for parameter, copy in zip(parameters, copies, strict=True):
            dr.enable_grad(copy)
            dr.set_grad(copy, dr.grad(parameter.numbers))
            parameter.assign(type(parameter.value)(copy))
        if copies:
            dr.enqueue(dr.ADMode.Forward, copies)
            dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    try:
        yield
    finally:
        with dr.resume_grad():
            for parameter in parameters:
                parameter.assign(parameter.value)
                parameter.restore()


def _find_differentiated(scene: mi.Scene, grids: StockGrids) -> list[_DifferentiatedParameter]:
    """Find the parameters with gradients of emitters, BSDFs, phase functions and volumes."""
    if is_recording():
        return []
    parameters = []
    for owner in _find_derived_owners(scene, grids):
        params = traverse(owner)
        followed = [(k, v) for k, v in list_values(params) if find_gradient_array(v) is not None]
        parameters += [_DifferentiatedParameter(params, k, type(v)(v)) for k, v in followed if not _is_computed(params, k)]
    return parameters


def _find_derived_owners(scene: mi.Scene, grids: StockGrids) -> list[mi.Object]:
    """The emitters, BSDFs, phase functions and volumes that may compute values from their parameters."""
    inside = [shape.interior_medium() for shape in scene.shapes() if shape.interior_medium() is not None]
    owners = [*scene.emitters(), *(s.bsdf() for s in scene.shapes()), *(o for m in inside for o in _find_parts(m, grids))]
    return list({o.ptr: o for o in owners if o is not None}.values())


def _find_parts(medium: mi.Medium, grids: StockGrids) -> list[mi.Object]:
    """The phase function of a medium, and its volumes except those read directly by transport."""
    known = traverse_children(medium).properties
    volumes = {key.partition(".")[0]: node for key, (_, _, node, _) in known.items() if isinstance(node, mi.Volume)}
    fields = {n for n, v in volumes.items() if hasattr(v, "mivol_extinction")}
    stands = [n for n, v in volumes.items() if n in fields or (n.startswith("sigma_") and not grids.is_called(v))]
    read = [n for n in stands if not any(f"{n}.{source}" in known for source in SOURCES)]
    return [medium.phase_function(), *(v for n, v in volumes.items() if n not in read)]


def _is_computed(params: mi.SceneParameters, key: str) -> bool:
    """Whether a plugin computes the parameter from its other parameters, such as the grid of a ``mivol_transfer``."""
    return key == "data" and any(source in params for source in SOURCES)


SOURCES = "table", "weights"
"""Parameters from which plugins compute their ``data``: of a ``mivol_transfer``, a hash grid and a NeRF."""


MAX_KEPT = 4
"""Most kept pairs of a session and a scene."""


@dataclass
class _KeptSession:
    """A session, its integrator, and a rendered scene."""

    session: Session
    owner: ref[mi.Integrator]
    scene: mi.Scene


# In the order of their last renders.
_kept: list[_KeptSession] = []
atexit.register(_kept.clear)


def take_session(integrator: mi.Integrator, session: Session, scene: mi.Scene) -> Session:
    """The session by which an integrator renders a scene: a kept session in place of an own session without renders.

    The integrator of the scene itself lives as long as the scene, so its session is not kept.

    Args:
        integrator: the integrator, an object in Python.
        session: session of the integrator.
    """
    last = _kept[-1] if _kept else None
    if last is not None and last.session is session and last.scene is scene:
        return session
    _release_scenes()
    if scene.integrator() is integrator:
        return session
    if session.is_new:
        idle = [kept.session for kept in _kept if kept.owner() is None and kept.scene is scene]
        session = next((one for one in reversed(idle) if one.is_like(session)), session)
    owner = ref(integrator, _free_scenes)
    for kept in _kept:
        kept.owner = owner if kept.session is session else kept.owner
    others = [kept for kept in _kept if not (kept.session is session and kept.scene is scene)]
    _kept[:] = [*others[1 - MAX_KEPT :], _KeptSession(session, owner, scene)]
    return session


def _release_scenes() -> None:
    """Release the scenes without other owners: each has a reference from each entry, and one from the counting call."""
    own = Counter(id(kept.scene) for kept in _kept)
    _kept[:] = [kept for kept in _kept if sys.getrefcount(kept.scene) > own[id(kept.scene)] + 1]


def _free_scenes(_: ref[mi.Integrator]) -> None:
    """Release scenes when an integrator is freed, but not in the middle of a trace: Dr.Jit would abort the process."""
    if not dr.flag(dr.JitFlag.SymbolicScope) and not dr.flag(dr.JitFlag.FreezingScope):
        _release_scenes()
