"""What a scene needs: the facts found in it, before anything is rendered.

Conventions. Facts only; what is done about them is a plan's (:mod:`mivol.scene.choices`). Shapes, boundaries and places are
found once for each scene; values (is the albedo zero, which blocks are empty) are looked at again whenever an array has
been replaced, and never while a function is being recorded by ``dr.freeze``.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.kernel_recording import is_recording
from mivol.scene.description import check_variant
from mivol.scene.media_light import MediaLight, read_media_light
from mivol.scene.nesting import OrientedBox, shape_bounds
from mivol.scene.readings import GridReading, check_constants, check_emission, is_scattering, read_extinction
from mivol.scene.survey import OUTSIDE_SHAPES, Boundary, SceneSurvey, find_outside_media, is_instance, survey_scene
from mivol.transport.media.body import Body
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.medium_view import MediumView, medium_kind
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import Box

__all__ = ["find_needs", "MediumFacts", "Needs", "mean_cosine"]


def find_needs(
    scene: mi.Scene, sensor: mi.Sensor, survey: SceneSurvey | None = None, spp: int = 0, reads_emission: bool = True
) -> Needs:
    """Ask a scene what it needs.

    Args:
        scene: a loaded scene.
        sensor: the one to render from.
        survey: an earlier survey of the same scene, to save finding what cannot have changed.
        spp: samples a pixel; 0 for the sampler's own count.
        reads_emission: look at where media emit, so that a plan may draw their light.

    Raises:
        MivolError: a variant or a medium that mivol does not render.
    """
    check_variant()
    survey = survey or survey_scene(scene)
    recording = is_recording()
    start = [] if sensor.get_medium() is None else [sensor.get_medium()]
    boundaries = (*survey.boundaries, *find_outside_media(start, survey.boundaries))
    views = tuple(b.view(survey.places) for b in boundaries)
    params = mi.traverse(scene)
    asked = tuple(k for k, v in params if dr.grad_enabled(v))
    media = tuple(
        replace(_read_medium_facts(b, view, survey, recording), misplaced=_find_misplaced(b, view, boundaries, survey))
        for b, view in zip(boundaries, views, strict=True)
    )
    needs = Needs(
        variant=mi.variant(),
        boundaries=boundaries,
        views=views,
        media=media,
        surfaces=survey.surfaces,
        has_null_transmission=survey.has_null_transmission,
        emitters=survey.emitters,
        emitter_kinds=survey.emitter_kinds,
        are_emitters_far=survey.are_emitters_far,
        refractive=survey.refractive,
        is_sealed=survey.is_sealed,
        start=sensor.get_medium(),
        camera_inside=_may_camera_be_inside(scene, sensor, survey),
        parameters=asked,
        places=tuple(k for k in asked if _is_placement(k, params.properties[k][2])),
        film_samples=int(np.prod(sensor.film().crop_size())) * (spp or sensor.sampler().sample_count()),
        are_samples_independent=sensor.sampler().class_name() == "IndependentSampler",
    )
    scatters = needs.surfaces or any(m.is_scattering for m in media)
    refused = any(m.bounded or m.gaussians for m in media)
    if recording or refused or not (reads_emission and scatters and any(m.emits for m in media)):
        return needs
    bodies = [boundary.body(view) for boundary, view in zip(boundaries, views, strict=True)]
    scattering = [body for body, facts in zip(bodies, media, strict=True) if facts.is_scattering]
    light = read_media_light(needs.media_of(scene, bodies, survey.size), boundaries, scattering, sensor, survey)
    return replace(needs, media_light=light)


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
    """Warn of each medium whose grids lie outside of the shape filled by the medium, once for each scene."""
    for facts in needs.media:
        if facts.misplaced and (facts.name, "misplaced") not in survey.warned:
            survey.warned.add((facts.name, "misplaced"))
            warnings.warn(f"{facts.misplacement} (this is said once).", RuntimeWarning, stacklevel=2)


def _is_placement(key: str, owner: object) -> bool:
    """Whether a parameter says where a shape or a sensor is; what is painted on a mesh does not."""
    name = key.rsplit(".", 1)[-1]
    painted = name.startswith(("vertex_", "face_")) and name not in ("vertex_positions", "vertex_normals", "vertex_texcoords")
    return isinstance(owner, mi.Shape | mi.Sensor) and not painted


def _may_camera_be_inside(scene: mi.Scene, sensor: mi.Sensor, survey: SceneSurvey) -> bool:
    """Whether the sensor may lie in the bounding box of a boundary that has to be traced."""
    if all(b.box is not None for b in survey.boundaries):
        return False
    eye = sensor.bbox()
    boxes = [shape_bounds(s) for s in scene.shapes() if s.is_medium_transition() or is_instance(s)]
    # A sensor at infinity has no box of its own: its rays start outside the scene. Walls of a room are flat.
    if not eye.valid() or not boxes:
        return False
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    # Rays begin at the near plane: this far from the eye in a field of view of 150 degrees.
    ahead = 4 * sensor.near_clip() if hasattr(sensor, "near_clip") else 0.0
    return bool((np.array(eye.max) + ahead >= low).all() and (np.array(eye.min) - ahead <= high).all())


def _read_medium_facts(boundary: Boundary, view: MediumView, survey: SceneSurvey, recording: bool) -> MediumFacts:
    grids = [p.lattice for p in view.parts if p.lattice is not None]
    phase = boundary.medium.phase_function()
    common = {
        "mean_cosine": survey.cosines.get(boundary.name),
        "name": boundary.name,
        "kind": medium_kind(boundary.medium),
        "boundary": _describe_boundary(boundary),
        "extinction": "rgb" if view.channels == 3 else "grey",
        "resolutions": tuple(g.res for g in grids),
        "phase": _phase_name(phase),
        "emits": view.emits,
        "gaussians": sum(p.field.count for p in view.parts if isinstance(p, GaussianExtinction)),
        "bounded": next((type(p.field).__name__ for p in view.parts if not p.exact_line), None),
    }
    if recording:
        # What it was when it was last read; a medium that was never read may scatter.
        known = survey.scatters.get(boundary.name, True)
        return MediumFacts(**common, is_scattering=known, occupied=1.0, tau_max=None, unread=True)
    check_constants(view, survey, boundary.name)
    check_emission(view, survey, boundary.name)
    reads = [read_extinction(p, survey, boundary.name) for p in view.parts if p.lattice is not None]
    occupied = min((r.occupied for r in reads), default=1.0)
    scatters = survey.scatters[boundary.name] = is_scattering(view, survey, boundary.name)
    if scatters and survey.are_emitters_far and common["mean_cosine"] is None:
        # Once: where a fit changes the phase function, what is made of this stays unbiased.
        common["mean_cosine"] = survey.cosines[boundary.name] = mean_cosine(phase)
    return MediumFacts(**common, is_scattering=scatters, occupied=occupied, tau_max=_bound_optical_depth(boundary, view, reads))


def _describe_boundary(boundary: Boundary) -> str:
    if boundary.box is not None:
        return "a box"
    return f"{OUTSIDE_SHAPES}, traced" if boundary.shape == OUTSIDE_SHAPES else f"a {boundary.shape}, traced"


def _phase_name(phase: mi.PhaseFunction | None) -> str:
    """The kind of a phase function (Mitsuba calls every Python class by its base)."""
    if phase is None:
        return "none"
    return phase.class_name() if phase.class_name() != "PhaseFunction" else str(phase).partition("[")[0]


def _bound_optical_depth(boundary: Boundary, view: MediumView, reads: list[GridReading]) -> float | None:
    """Bound the optical depth through a medium: its largest extinction times the diagonal of its box."""
    bounds = [float(p.majorant[0]) for p in view.parts if not p.exact_line]
    bounds += [p.field.bound()[0] for p in view.parts if isinstance(p, GaussianExtinction)]
    constants = [float(np.max(np.array(dr.detach(p.constant)))) for p in view.parts if p.is_constant]
    if boundary.box is None:
        return None
    corners = boundary.box.corners()
    diagonal = max(np.linalg.norm(corners[i] - corners[7 - i]) for i in range(4))
    scale = float(np.max(np.array(dr.detach(view.scale))))
    return scale * (sum(constants) + sum(bounds) + sum(r.maximum for r in reads)) * float(diagonal)


@dataclass(frozen=True)
class MediumFacts:
    """What one medium is made of.

    Attributes:
        name: of the shape that it fills.
        kind: class of the medium.
        boundary: where it is, in words.
        extinction: ``grey`` or ``rgb``.
        resolutions: of its grids (Z, Y, X); none for a homogeneous medium.
        is_scattering: some albedo or ``sigma_s`` is above 0, or its derivative is asked for.
        emits: it has an emission or an emission density.
        phase: kind of its phase function.
        occupied: fraction of its blocks of cells that are not empty; of its emptiest grid.
        tau_max: upper bound of the optical depth [1] through its box; None where its boundary is no box.
        unread: values could not be read, because ``dr.freeze`` records.
        mean_cosine: of its phase function [1], when it was first asked; None where it does not scatter, or where some emitter
            is not at infinity and nothing depends on it.
        bounded: class of a field of which no more than a majorant is known along a ray; None where optical depths are exact.
        gaussians: how many Gaussians it is made of that rays are traced through; 0 for none.
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
    unread: bool = False
    bounded: str | None = None
    gaussians: int = 0
    mean_cosine: float | None = None
    misplaced: tuple[str, ...] = ()

    @property
    def misplacement(self) -> str:
        """The sentence about the misplaced grids; empty without one."""
        if not self.misplaced:
            return ""
        return (
            f"the whole grid {' and '.join(self.misplaced)} of the medium in {self.name} lies outside of {self.name} and adds "
            "nothing to the medium: correct the to_world of the grid or of the shape"
        )


@dataclass(frozen=True)
class Needs:
    """The facts of a scene that a plan is made from.

    Attributes:
        variant: the active variant.
        boundaries: media and where they are.
        views: their extinction, in the same order, with its gradients.
        media: what each is made of, in the same order.
        surfaces: class names of the shapes that are more than boundaries.
        has_null_transmission: some surface lets light through undeviated and is more than a boundary.
        emitters: class names.
        emitter_kinds: ``uniform`` (an environment that is the same in all directions), ``delta`` (one position or direction) or
            ``extended``, of each emitter.
        are_emitters_far: every emitter is at infinity, and one of them is not ``uniform``.
        refractive: names of the boundaries that bend or blur the light that passes them.
        is_sealed: every medium lies behind such boundaries and no light passes them undeviated; emitters lie outside of them,
            and paths can hit each. No emitter sample finds light from a point in a medium.
        start: medium that the sensor names.
        camera_inside: the camera may be inside the box around a boundary.
        parameters: keys whose derivatives are asked for.
        places: those of them that are of shapes and sensors.
        film_samples: pixels times samples of the sensor asked about.
        are_samples_independent: its sampler stratifies nothing, so that other random numbers may stand for its own.
        media_light: what was read of the light that media emit; None where none does, where nothing scatters it, or where it
            could not be read.
    """

    variant: str
    boundaries: tuple[Boundary, ...]
    views: tuple[MediumView, ...]
    media: tuple[MediumFacts, ...]
    surfaces: tuple[str, ...]
    has_null_transmission: bool
    emitters: tuple[str, ...]
    emitter_kinds: tuple[str, ...]
    are_emitters_far: bool
    refractive: tuple[str, ...]
    is_sealed: bool
    start: mi.Medium | None
    camera_inside: bool
    parameters: tuple[str, ...]
    places: tuple[str, ...]
    film_samples: int
    are_samples_independent: bool = True
    media_light: MediaLight | None = None

    def media_of(self, scene: mi.Scene, bodies: Sequence[Body], size: float) -> SceneMedia:
        """The media of the scene among its surfaces, as these facts have them.

        Args:
            bodies: one for each of ``boundaries``, in the same order.
            size: of the scene [length].
        """
        return SceneMedia(
            scene,
            bodies,
            has_surfaces=bool(self.surfaces),
            has_null_transmission=self.has_null_transmission,
            start=self.start,
            locates_camera=self.camera_inside and self.start is None,
            size=size,
        )


def mean_cosine(phase: mi.PhaseFunction, n: int = 1 << 12) -> float:
    """Mean cosine [1] of a phase function by its own samples, to 1 / sqrt(n), in the middle of the world."""
    mei = dr.zeros(mi.MediumInteraction3f, n)
    mei.wi = mi.Vector3f(0, 0, 1)
    mei.sh_frame = mi.Frame3f(mei.wi)
    k = dr.arange(mi.Float, n)
    u = mi.Point2f((k + 0.5) / n, k * 0.6180340 - dr.floor(k * 0.6180340))
    wo, _, _ = phase.sample(mi.PhaseFunctionContext(None), mei, k * 0.7548777 - dr.floor(k * 0.7548777), u)
    return float(dr.mean(-wo.z)[0])
