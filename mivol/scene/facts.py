"""The facts of a scene that a plan is made from; choices are made in :mod:`mivol.scene.choices`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi

from mivol.transport.media.body import Body
from mivol.transport.media.medium_view import MediumView, view_medium
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.box import Box

__all__ = ["Boundary", "MediaLight", "MediumFacts", "Needs"]


@dataclass(frozen=True)
class Boundary:
    """One medium and where it is.

    Attributes:
        medium: Mitsuba's object.
        name: of the shape that it fills.
        shape: class of that shape; ``AROUND`` for a medium that fills none (around other shapes or the camera, in instances).
        box: the shape, where it is a box that no other boundary overlaps; None where it has to be traced.
        level: of a nested radiance field, each level of which is a medium of its own.
        hole: the box in which that level is not, for the level before is there; None of all other media.
    """

    medium: mi.Medium
    name: str
    shape: str
    box: Box | None
    level: int = 0
    hole: Box | None = None

    def view(self, places: dict) -> MediumView:
        """Its medium as a sum of fields; ``places`` as in :func:`mivol.transport.media.medium_view.view_medium`.

        Raises:
            MivolError: a medium that mivol does not render.
        """
        return view_medium(self.medium, self.box, places, self.level)

    def body(self, view: MediumView, estimates_shadows: bool = False) -> Body:
        """A view of its medium, where it is."""
        return Body(view, self.box, estimates_shadows, self.hole)


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


@dataclass
class MediaLight:
    """What was read of the light that media emit.

    Attributes:
        density, cumulative: of :class:`mivol.transport.estimators.lighting.emission_sampling.EmissionTable`.
        gain: how much sooner draws of it reach an error than chance does [1], as predicted.
    """

    density: mi.Float
    cumulative: mi.Float
    gain: float


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
