"""The facts of a scene: what it is made of, as a plan is told. Nothing is decided here."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from mivol.transport.media.box import Box
from mivol.transport.media.medium_view import MediumView

__all__ = ["Boundary", "MediumFacts", "Needs"]


@dataclass(frozen=True)
class Boundary:
    """One medium and where it is: its name in the scene, the shape that it fills, and its box, if the shape is one.

    A medium that fills no shape of its own (around other shapes, around the camera, in instances) is behind ``AROUND``.
    """

    medium: mi.Medium
    name: str
    shape: str
    box: Box | None


@dataclass(frozen=True)
class MediumFacts:
    """What one medium is made of.

    ``resolutions`` are those of its grids (Z, Y, X), none for a homogeneous medium; ``emits`` tells whether it is a source of
    light, ``occupied`` which share of their blocks of cells holds anything; ``tau_max`` bounds the optical depth through its
    box [1] (None where it is not bounded by a box); ``unread``: values could not be read, because a function is being recorded;
    ``bounded`` names the field of which no more than a majorant is known along a ray, None where optical depths are exact.
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
        refractive: names of the boundaries that bend or blur the light that passes them.
        start: medium that the sensor names.
        camera_inside: the camera may be inside the box around a boundary.
        parameters: keys whose derivatives are asked for.
        places: those of them that are of shapes and sensors.
        film_samples: pixels times samples of the sensor asked about.
    """

    variant: str
    boundaries: tuple[Boundary, ...]
    views: tuple[MediumView, ...]
    media: tuple[MediumFacts, ...]
    surfaces: tuple[str, ...]
    has_null_transmission: bool
    emitters: tuple[str, ...]
    emitter_kinds: tuple[str, ...]
    refractive: tuple[str, ...]
    start: mi.Medium | None
    camera_inside: bool
    parameters: tuple[str, ...]
    places: tuple[str, ...]
    film_samples: int
