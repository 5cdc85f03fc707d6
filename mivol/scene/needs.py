"""The facts of a scene that a plan is made from.

Conventions. This module holds facts; decisions follow in :mod:`mivol.scene.choices`. Shapes, boundaries and placements are
found once for each scene. Values (zero albedo, empty blocks) are read again after an array was replaced, and never while
``dr.freeze`` records.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.back_end import check_variant
from mivol.errors import MivolWarning
from mivol.kernel_recording import is_recording
from mivol.scene.media_light import MediaLight, read_media_light
from mivol.scene.nesting import OrientedBox, shape_bounds
from mivol.scene.readings import (
    GridReading,
    check_constants,
    check_emission,
    is_scattering,
    read_extinction,
    read_lowest_albedo,
    read_number,
)
from mivol.scene.scene_state import is_painted
from mivol.scene.survey import (
    OUTSIDE_SHAPES,
    Boundary,
    BranchNoise,
    MirrorNoise,
    OwnRaysNoise,
    RefractedNoise,
    SceneSurvey,
    ShapeFacts,
    find_outside_media,
    is_instance,
    survey_scene,
)
from mivol.scene_graph import find_children, list_values, traverse
from mivol.transport.estimators.lighting.emitters import find_bounding_ball
from mivol.transport.media.body import Body
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.medium_view import MediumView, medium_kind
from mivol.transport.media.octree_extinction import OctreeExtinction
from mivol.transport.media.phases import Phase
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import Box
from mivol.transport.traversal.lattice import Lattice


def find_needs(
    scene: mi.Scene,
    sensor: mi.Sensor,
    survey: SceneSurvey | None = None,
    spp: int = 0,
    reads_emission: bool = True,
    differentiated: Sequence[tuple[str, mi.Object]] | None = None,
) -> Needs:
    """Find the facts of a scene.

    Args:
        scene: a loaded scene.
        sensor: the sensor to render.
        survey: an earlier survey of the same scene; by default a new survey.
        spp: samples per pixel; 0 for the sampler's own count.
        reads_emission: whether to locate the light of media, so that a plan may sample the light.
        differentiated: keys of the parameters with gradients enabled, and their owners; by default found in the scene.

    Raises:
        MivolError: a variant or a medium that mivol does not render.
    """
    check_variant()
    survey = survey or survey_scene(scene)
    start = [] if sensor.get_medium() is None else [sensor.get_medium()]
    boundaries = (*survey.boundaries, *find_outside_media(start, survey.boundaries))
    views = tuple(b.view(survey.grids) for b in boundaries)
    if differentiated is None:
        params = traverse(scene)
        differentiated = [(k, params.properties[k][2]) for k, v in list_values(params) if dr.grad_enabled(v)]
    media = read_media(boundaries, views, survey)
    samples = spp or sensor.sampler().sample_count()
    needs = Needs(
        **vars(survey.facts),
        variant=mi.variant(),
        boundaries=boundaries,
        views=views,
        media=media,
        start=sensor.get_medium(),
        camera_inside=may_camera_be_inside(scene, sensor, survey),
        **_sort_parameters(differentiated, boundaries),
        film_samples=int(np.prod(sensor.film().size())) * samples,
        crop_samples=int(np.prod(sensor.film().crop_size())) * samples,
        spp=samples,
        is_colour_film=not mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special),
        are_samples_independent=sensor.sampler().class_name() == "IndependentSampler",
        emitter_distances=find_emitter_distances(scene, boundaries, media),
        endless_media=_name_endless_media(scene, start, boundaries, views),
    )
    return locate_light(needs, scene, sensor, survey) if reads_emission else needs


def locate_light(needs: Needs, scene: mi.Scene, sensor: mi.Sensor, survey: SceneSurvey) -> Needs:
    """The facts, with views of the media and with the light of the media."""
    scatters = needs.surfaces or any(m.is_scattering for m in needs.media)
    refused = any(m.bounded or m.has_own_walk for m in needs.media)
    if is_recording() or refused or not (scatters and any(m.emits for m in needs.media)):
        return needs
    bodies = [boundary.body(view) for boundary, view in zip(needs.boundaries, needs.views, strict=True)]
    scattering = [body for body, facts in zip(bodies, needs.media, strict=True) if facts.is_scattering]
    media = needs.make_media(scene, bodies, survey.size, survey.usable_tracer)
    return replace(needs, media_light=read_media_light(media, needs.boundaries, scattering, sensor, survey))


def read_media(boundaries: Sequence[Boundary], views: Sequence[MediumView], survey: SceneSurvey) -> tuple[MediumFacts, ...]:
    """Read the facts of each boundary's medium; each state of an array is read once."""
    return tuple(
        replace(_read_medium_facts(b, view, survey), misplaced=_find_misplaced(b, view, boundaries, survey))
        for b, view in zip(boundaries, views, strict=True)
    )


def _sort_parameters(
    differentiated: Sequence[tuple[str, mi.Object]], boundaries: Sequence[Boundary]
) -> dict[str, tuple[str, ...] | bool]:
    """``Needs.parameters``, ``Needs.places`` and ``Needs.follows_albedos``."""
    media = [find_children(boundary.medium) for boundary in boundaries] if differentiated else []
    albedos = {children["albedo"].ptr for children in media if "albedo" in children}
    return {
        "follows_albedos": bool(differentiated) and all(owner.ptr in albedos for _, owner in differentiated),
        "parameters": tuple(key for key, _ in differentiated),
        "places": tuple(key for key, owner in differentiated if _is_placement(key, owner)),
    }


def _name_endless_media(
    scene: mi.Scene, start: list[mi.Medium], boundaries: Sequence[Boundary], views: Sequence[MediumView]
) -> tuple[str, ...]:
    """``Needs.endless_media``. Media in instances fill shapes of their own."""
    edges = [shape for shape in scene.shapes() if shape.is_medium_transition()]
    around = {m.ptr for m in (*start, *(edge.exterior_medium() for edge in edges)) if m is not None}
    parts = zip(boundaries, views, strict=True)
    free = [b.name for b, v in parts if b.around is None and b.medium.ptr in around and not all(p.lattice for p in v.parts)]
    return tuple(free)


def find_emitter_distances(scene: mi.Scene, boundaries: Sequence[Boundary], media: Sequence[MediumFacts]) -> tuple[float, ...]:
    """``Needs.emitter_distances``; ``media`` are the facts of the medium in each boundary."""
    boundaries = [b for b, m in zip(boundaries, media, strict=True) if m.is_scattering]
    balls = [find_bounding_ball(e) for e in scene.emitters()]
    return tuple(
        math.inf if ball is None else min((_relative_distance(b, ball) for b in boundaries), default=math.inf) for ball in balls
    )


def _relative_distance(boundary: Boundary, ball: list[float]) -> float:
    return 0.0 if boundary.around is None else boundary.around.distance(np.array(ball[:3]))


def _find_misplaced(
    boundary: Boundary, view: MediumView, boundaries: Sequence[Boundary], survey: SceneSurvey
) -> tuple[str, ...]:
    """Find the grids of a medium that lie wholly outside of all shapes filled by the medium, by the names of the parts."""
    key = (boundary.name, boundary.level)
    if key not in survey.misplaced:
        shapes = [b.around for b in boundaries if b.medium.ptr == boundary.medium.ptr]
        grids = {} if None in shapes else {p.name: p.lattice for p in view.parts if p.lattice is not None}
        boxes = {name: OrientedBox.from_box(Box(lattice.to_world)) for name, lattice in grids.items()}
        survey.misplaced[key] = tuple(name for name, box in boxes.items() if not any(box.shares(s) for s in shapes))
    return survey.misplaced[key]


def warn_of_misplaced_grids(needs: Needs, survey: SceneSurvey) -> None:
    """Warn once for each scene and medium if the whole grid lies outside of the shape filled by the medium."""
    for facts in needs.media:
        if facts.misplaced and (facts.name, "misplaced") not in survey.warned:
            survey.warned.add((facts.name, "misplaced"))
            warnings.warn(f"{facts.misplacement} (this is said once).", MivolWarning, stacklevel=2)


def find_clipped_view(needs: Needs, sensor: mi.Sensor) -> str:
    """A sentence if every medium begins behind the sensor's ``far_clip`` (10,000 without it); else empty."""
    boxes = [boundary.around for boundary in needs.boundaries]
    if not isinstance(sensor, mi.ProjectiveCamera) or not boxes or None in boxes:
        return ""
    eye = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4, -1)[:3, 3, 0]
    nearest = min(box.distance(eye) * box.longest_edge for box in boxes)
    if nearest <= sensor.far_clip():
        return ""
    return (
        f"the media begin {nearest:.4g} from the camera, whose far_clip is {sensor.far_clip():.4g}, so that no ray meets them: "
        "enlarge the far_clip of the sensor"
    )


def find_undefined_light(needs: Needs, scene: mi.Scene, sensor: mi.Sensor) -> str:
    """A sentence if extended light from infinity would have to cross a medium without an end; else empty.

    No sentence if surfaces stop all of 256 rays that leave the camera in directions spread over the sphere.
    """
    emitters = zip(scene.emitters(), needs.emitter_kinds, strict=True)
    far = [e for e, kind in emitters if kind != "delta" and int(e.flags()) & int(mi.EmitterFlags.Infinite)]
    if not needs.endless_media or not far or _are_rays_stopped(scene, sensor):
        return ""
    return (
        f"the medium {needs.endless_media[0]} has no end, so it is not defined how much light of {far[0].id()} crosses it from "
        "infinity (volpath takes what emitter samples find, over twice the radius of the scene): put the medium into a shape "
        "with a null BSDF around the scene and the camera"
    )


def warn_of_view(needs: Needs, scene: mi.Scene, sensor: mi.Sensor, survey: SceneSurvey) -> None:
    """Warn once for each scene and sensor if no ray meets a medium, or if the light behind a medium is not defined."""
    if ("view", sensor.ptr) in survey.warned or is_recording():
        return
    survey.warned.add(("view", sensor.ptr))
    for said in filter(None, (find_clipped_view(needs, sensor), find_undefined_light(needs, scene, sensor))):
        warnings.warn(f"{said} (this is said once).", MivolWarning, stacklevel=2)


def _are_rays_stopped(scene: mi.Scene, sensor: mi.Sensor) -> bool:
    """Whether surfaces stop all of 256 rays that leave a camera in directions spread over the sphere."""
    with dr.suspend_grad():
        u, v = dr.meshgrid(dr.linspace(mi.Float, 0, 1, 16), dr.linspace(mi.Float, 0.01, 0.99, 16))
        ray = mi.Ray3f(mi.Point3f(sensor.world_transform().translation()), mi.warp.square_to_uniform_sphere(mi.Point2f(u, v)))
        return bool(dr.all(scene.ray_test(ray)))


def _is_placement(key: str, owner: object) -> bool:
    """Whether a parameter places a shape or a sensor; colours painted on a mesh do not count."""
    return isinstance(owner, mi.Shape | mi.Sensor) and not is_painted(key.rsplit(".", 1)[-1])


def may_camera_be_inside(scene: mi.Scene, sensor: mi.Sensor, survey: SceneSurvey) -> bool:
    """Whether the sensor may lie in the bounding box of a traced boundary."""
    if all(b.box is not None for b in survey.boundaries):
        return False
    eye = sensor.bbox()
    boxes = [shape_bounds(s) for s in scene.shapes() if s.is_medium_transition() or is_instance(s)]
    # A sensor at infinity has no box: its rays start outside the scene. Boxes may be flat, as the walls of a room.
    if not eye.valid() or not boxes:
        return False
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    # Rays begin at the near plane, at most this far from the eye for a field of view up to 150 degrees.
    ahead = 4 * sensor.near_clip() if hasattr(sensor, "near_clip") else 0.0
    return bool((np.array(eye.max) + ahead >= low).all() and (np.array(eye.min) - ahead <= high).all())


def _read_medium_facts(boundary: Boundary, view: MediumView, survey: SceneSurvey) -> MediumFacts:
    grids = [p.lattice for p in view.parts if p.lattice is not None]
    phase = boundary.medium.phase_function()
    common = {
        "mean_cosine": survey.cosines.get(boundary.name),
        "name": boundary.name,
        "kind": medium_kind(boundary.medium),
        "boundary": _describe_boundary(boundary),
        "extinction": "rgb" if view.channels == 3 else "grey",
        "resolutions": tuple(g.res for g in grids),
        "bricks": tuple(0 if g.bricks is None else g.bricks.count for g in grids),
        "phase": _phase_name(phase),
        "emits": view.emits,
        "gaussians": sum(p.field.count for p in view.parts if isinstance(p, GaussianExtinction)),
        "leaves": sum(p.field.leaves for p in view.parts if isinstance(p, OctreeExtinction)),
        "bounded": next((getattr(p.field, "kind", type(p.field).__name__) for p in view.parts if not p.exact_line), None),
    }
    if is_recording():
        # Use the last reading; a medium without a reading may scatter.
        known = survey.scatters.get(boundary.name, True)
        return MediumFacts(**common, is_scattering=known, occupied=1.0, tau_max=None, unread=True)
    check_constants(view, survey, boundary.name)
    check_emission(view, survey, boundary.name)
    reads = [read_extinction(p, survey, boundary.name) for p in view.parts if p.lattice is not None]
    occupied = min((r.occupied for r in reads), default=1.0)
    scatters = survey.scatters[boundary.name] = is_scattering(view, survey, boundary.name)
    if scatters and survey.facts.are_emitters_far and common["mean_cosine"] is None:
        # Read once: if a fit changes the phase function, side flights stay unbiased.
        common["mean_cosine"] = survey.cosines[boundary.name] = mean_cosine(phase)
    return MediumFacts(
        **common,
        is_scattering=scatters,
        occupied=occupied,
        tau_max=_bound_optical_depth(boundary, view, reads, survey),
        tau_min=_find_thinnest(boundary, view, survey),
        cell_depth=_bound_cell_depth(grids, view, reads, survey),
        albedo_min=read_lowest_albedo(view, survey, boundary.name),
    )


def _describe_boundary(boundary: Boundary) -> str:
    if boundary.box is not None:
        return "a ball" if boundary.box.is_round else "a box"
    return f"{OUTSIDE_SHAPES}, traced" if boundary.shape == OUTSIDE_SHAPES else f"a {boundary.shape}, traced"


def _phase_name(phase: mi.PhaseFunction | None) -> str:
    """Name of a phase function. Mitsuba gives every Python class the name of its base class."""
    if phase is None:
        return "none"
    return phase.class_name() if phase.class_name() != "PhaseFunction" else str(phase).partition("[")[0]


def _bound_optical_depth(boundary: Boundary, view: MediumView, reads: list[GridReading], survey: SceneSurvey) -> float | None:
    """Bound the optical depth of a medium by its largest extinction times the diameter of the box or ball."""
    bounds = [float(p.majorant[0]) for p in view.parts if not p.exact_line]
    bounds += [max(p.field.bound()) for p in view.parts if isinstance(p, GaussianExtinction | OctreeExtinction)]
    constants = [float(np.max(np.array(dr.detach(p.constant)))) for p in view.parts if p.is_constant]
    if boundary.box is None:
        return None
    return _read_scale(view, survey) * (sum(constants) + sum(bounds) + sum(r.maximum for r in reads)) * boundary.box.diameter


def _bound_cell_depth(grids: list[Lattice], view: MediumView, reads: list[GridReading], survey: SceneSurvey) -> float | None:
    """Bound the optical depth of the sum of a medium's grids along the edge of their smallest cells; None without a grid."""
    if not grids:
        return None
    edge = min(abs(np.linalg.det(grid.to_world[:3, :3]) / math.prod(grid.res)) ** (1 / 3) for grid in grids)
    return _read_scale(view, survey) * sum(r.maximum for r in reads) * edge


def _read_scale(view: MediumView, survey: SceneSurvey) -> float:
    """The scale of a medium."""
    return read_number(dr.detach(view.numbers.get("scale", 1.0)), survey)


def _find_thinnest(boundary: Boundary, view: MediumView, survey: SceneSurvey) -> float:
    """The optical depth of a homogeneous medium's clearest channel across its shape [1]; 0 for other media."""
    if boundary.around is None or not all(p.is_constant for p in view.parts):
        return 0.0
    extinction = sum((np.array(dr.detach(p.constant), dtype=np.float64).ravel() for p in view.parts), np.zeros(1))
    return float(np.min(extinction)) * _read_scale(view, survey) * boundary.around.edge


@dataclass(frozen=True)
class MediumFacts:
    """The facts of a medium.

    Attributes:
        name: name of the shape filled by the medium.
        kind: class of the medium.
        boundary: description of the boundary.
        extinction: ``grey`` or ``rgb``.
        resolutions: resolutions (Z, Y, X) of the grids; empty for a homogeneous medium.
        is_scattering: whether an albedo or ``sigma_s`` is above 0 or has gradients enabled.
        emits: whether the medium has an emission or an emission density.
        phase: kind of the phase function.
        occupied: smallest share of occupied blocks among the grids [1].
        tau_max: upper bound of the optical depth through the box [1]; None unless the boundary is a box.
        tau_min: optical depth of a homogeneous medium's clearest channel across its shape [1]; 0 for other media.
        cell_depth: upper bound of the optical depth of the grids along the edge of a cell [1]; None if unknown.
        albedo_min: lowest albedo [1]; 0 for a medium with ``sigma_s``.
        unread: whether values could not be read because ``dr.freeze`` records.
        bounded: class of a field with only a known majorant along a ray; None with exact optical depths.
        gaussians: number of Gaussians for ray tracing; 0 for other media.
        leaves: number of leaves of octrees; 0 for other media.
        mean_cosine: mean cosine of the phase function at the first reading [1]; None for a medium that does not scatter, or
            with a near emitter.
        misplaced: names of the grids that lie wholly outside of the shape.
        bricks: number of stored bricks of each grid, 0 for a dense grid; empty if all are dense.
    """

    name: str
    kind: str
    boundary: str
    extinction: str
    resolutions: tuple[tuple[int, int, int], ...]
    is_scattering: bool
    emits: bool
    phase: str
    occupied: float
    tau_max: float | None
    tau_min: float = 0.0
    cell_depth: float | None = None
    albedo_min: float = 0.0
    unread: bool = False
    bounded: str | None = None
    gaussians: int = 0
    leaves: int = 0
    mean_cosine: float | None = None
    misplaced: tuple[str, ...] = ()
    bricks: tuple[int, ...] = ()

    @property
    def has_own_walk(self) -> bool:
        """Whether rays follow Gaussians, or the leaves of an octree, in place of the cells of a grid."""
        return self.gaussians > 0 or self.leaves > 0

    @property
    def misplacement(self) -> str:
        """A sentence about the misplaced grids; empty without misplaced grids."""
        if not self.misplaced:
            return ""
        return (
            f"the whole grid {' and '.join(self.misplaced)} of the medium in {self.name} lies outside of {self.name} and adds "
            "nothing to the medium: correct the to_world of the grid or of the shape"
        )


@dataclass(frozen=True, kw_only=True)
class Needs(ShapeFacts):
    """The facts of a scene.

    Attributes:
        variant: the active variant.
        boundaries: the media with their boundaries.
        views: the extinction of each boundary's medium, with gradients.
        media: the facts of each boundary's medium.
        start: medium named by the sensor.
        camera_inside: whether the camera may be inside the box around a boundary.
        parameters: keys of the parameters with gradients enabled.
        places: keys among ``parameters`` that place shapes and sensors.
        follows_albedos: the parameters with gradients enabled belong to volumes of the albedos of media.
        film_samples: pixels of the whole film times samples per pixel: a crop is planned as the whole film, so that it has the
            same pixels.
        crop_samples: the same of the crop that is rendered.
        spp: samples per pixel.
        is_colour_film: whether the film stores colours, and not quantities of its own.
        are_samples_independent: whether the sensor has Mitsuba's independent sampler, whose numbers others may replace.
        emitter_distances: distance of each emitter to the nearest medium that scatters, over the longest edge of the box around
            the medium [1]; 0 for an emitter inside, or for a medium without a known end; infinite for an emitter at infinity.
        endless_media: names of the media without a known end: they fill the space around the camera or around shapes, and no
            grid bounds them.
        near_gain: measured gain of drawing the light of near emitters along segments [1] (:mod:`mivol.scene.previews`); None
            before a measurement.
        lamp_noise: measured variances, for one sample of a pixel, of the light of lamps seen directly and of all other light;
            None before a measurement.
        emission_noise: what a preview measures of the light of media seen directly (:class:`OwnRaysNoise`); None before a
            measurement.
        branch_noise: what a preview measures of paths that branch (:class:`BranchNoise`); None before a measurement.
        mirror_noise: measured noise of the light mirrored by glass (:class:`MirrorNoise`); None before a measurement.
        refracted_noise: measured noise beside lamps behind glass (:class:`RefractedNoise`); None before a measurement.
        media_light: the light that media emit; None without such light, without scattering, or if the light could not be read.
    """

    variant: str
    boundaries: tuple[Boundary, ...]
    views: tuple[MediumView, ...]
    media: tuple[MediumFacts, ...]
    start: mi.Medium | None
    camera_inside: bool
    parameters: tuple[str, ...]
    places: tuple[str, ...]
    follows_albedos: bool
    film_samples: int
    crop_samples: int
    spp: int
    is_colour_film: bool
    are_samples_independent: bool
    emitter_distances: tuple[float, ...]
    endless_media: tuple[str, ...]
    near_gain: float | None = None
    lamp_noise: tuple[float, float] | None = None
    emission_noise: OwnRaysNoise | None = None
    branch_noise: BranchNoise | None = None
    mirror_noise: MirrorNoise | None = None
    refracted_noise: RefractedNoise | None = None
    media_light: MediaLight | None = None

    @property
    def nearness(self) -> float:
        """The smallest of ``emitter_distances`` [1]; infinite without emitters."""
        return min(self.emitter_distances, default=math.inf)

    @property
    def has_lamps(self) -> bool:
        """Whether a shape emits light."""
        return "AreaLight" in self.emitters

    def with_parameters(self, differentiated: Sequence[tuple[str, mi.Object]]) -> Needs | None:
        """The facts of the same values with gradients enabled on other parameters, for derivatives; None to find them anew.

        A medium without scattering scatters if its albedo has gradients; the table of the light of media is not kept.
        """
        may_scatter = any("sigma_t" not in key.split(".") for key, _ in differentiated)
        if any(m.emits or (may_scatter and not m.is_scattering) for m in self.media):
            return None
        unknown = {"lamp_noise": None, "branch_noise": None, "mirror_noise": None, "refracted_noise": None}
        return replace(self, **unknown, **_sort_parameters(differentiated, self.boundaries))

    def follow_shapes(self, boundaries: tuple[Boundary, ...], facts: ShapeFacts) -> Needs:
        """The same facts of the same shapes in other places."""
        return replace(self, boundaries=boundaries, surface_boxes=facts.surface_boxes, lit_box=facts.lit_box)

    def with_views(self, survey: SceneSurvey, phases: list[Phase], scales: tuple[float | None, ...]) -> Needs:
        """The same facts with the media viewed anew: a recording reads their arrays from the scene, all but these."""
        views = (b.view(survey.grids, *given) for b, *given in zip(self.boundaries, phases, scales, strict=True))
        return replace(self, views=tuple(views))

    def make_media(self, scene: mi.Scene, bodies: Sequence[Body], size: float, tracer: mi.Scene | None) -> SceneMedia:
        """Build the media of the scene among its surfaces.

        Args:
            bodies: a body for each of ``boundaries``, in the same order.
            size: diagonal of the scene [length].
            tracer: scene of the surfaces alone; None to trace ``scene``.
        """
        return SceneMedia(
            scene,
            bodies,
            has_surfaces=bool(self.surfaces),
            has_null_transmission=self.has_null_transmission,
            start=self.start,
            locates_camera=self.camera_inside and self.start is None,
            size=size,
            stops_rays=self.stops_rays,
            surface_boxes=self.surface_boxes,
            tracer=tracer,
            lit_box=self.lit_box,
        )


def mean_cosine(phase: mi.PhaseFunction, n: int = 1 << 12) -> float:
    """Estimate the mean cosine [1] of a phase function from n of its own samples, with error 1 / sqrt(n), at the world's
    origin.
    """
    mei = dr.zeros(mi.MediumInteraction3f, n)
    mei.wi = mi.Vector3f(0, 0, 1)
    mei.sh_frame = mi.Frame3f(mei.wi)
    k = dr.arange(mi.Float, n)
    u = mi.Point2f((k + 0.5) / n, k * 0.6180340 - dr.floor(k * 0.6180340))
    wo, _, _ = phase.sample(mi.PhaseFunctionContext(None), mei, k * 0.7548777 - dr.floor(k * 0.7548777), u)
    return float(dr.mean(-wo.z)[0])
