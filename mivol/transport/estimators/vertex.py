"""Vertices of a path: a point of a surface with its BSDF, or of a medium with its phase function, with one interface.

Conventions. ``eval`` is the BSDF times the cosine, or the phase function [1/sr]. ``pdf`` is the density of directions that are
sampled at the vertex [1/sr]; multiple importance sampling weighs emitter samples against it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.phase_sampling import phase_context, phase_pdf
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.ray_spawning import spawn_ray

__all__ = ["EitherVertex", "MediumVertex", "SurfaceVertex", "Vertex"]


class Vertex(Protocol):
    """A point at which light is scattered."""

    interaction: mi.Interaction3f

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        """The origin of a ray from the vertex towards ``p``, and the medium around that origin."""

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """BSDF times cosine, or phase function, for light from the direction ``d`` [1/sr], with its derivatives."""

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density [1/sr] of the direction ``d`` when directions are sampled at the vertex."""


@dataclass
class SurfaceVertex:
    """A point of a surface.

    Attributes:
        media: of the scene.
        interaction: the point.
        bsdf: of the surface there.
        medium: the medium around the end of the ray that hit it.
    """

    media: SceneMedia
    interaction: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    medium: mi.MediumPtr

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        si = self.interaction
        start = spawn_ray(si, p - si.p, self.media.size).o
        return mi.Point3d(start), dr.select(si.is_medium_transition(), si.target_medium(p - start), self.medium)

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        return self.bsdf.eval(mi.BSDFContext(), self.interaction, self.interaction.to_local(d), active)

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return self.bsdf.eval_pdf(mi.BSDFContext(), self.interaction, self.interaction.to_local(d), active)[1]


@dataclass
class MediumVertex:
    """A point of the medium ``interaction.medium``.

    Attributes:
        media: of the scene.
        interaction: the point, as Mitsuba's phase functions and emitters see it.
        place: the point in float64, from which rays leave.
    """

    media: SceneMedia
    interaction: mi.MediumInteraction3f
    place: mi.Point3d

    @property
    def phase(self) -> mi.PhaseFunctionPtr:
        """The phase function there."""
        return self.interaction.medium.phase_function()

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        return self.place, self.interaction.medium

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        return self.phase.eval_pdf(phase_context(), self.interaction, d, active)[0]

    def eval_and_pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Both, without derivatives."""
        return dr.detach(self.eval(d, active)), self.pdf(d, active)

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return phase_pdf(self.media, self.phase, self.interaction, d, active)


@dataclass
class EitherVertex:
    """A point of a medium in some lanes, of a surface in the others: one shadow ray serves both.

    Attributes:
        surface, medium: the two.
        in_medium: lanes that are in a medium.
    """

    surface: SurfaceVertex
    medium: MediumVertex
    in_medium: mi.Bool

    @property
    def interaction(self) -> mi.Interaction3f:
        """The point."""
        return dr.select(self.in_medium, mi.Interaction3f(self.medium.interaction), mi.Interaction3f(self.surface.interaction))

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        (inside, medium), (outside, around) = self.medium.leave(p), self.surface.leave(p)
        return dr.select(self.in_medium, inside, outside), dr.select(self.in_medium, medium, around)

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        scattered = self.medium.eval(d, active & self.in_medium)
        return dr.select(self.in_medium, scattered, self.surface.eval(d, active & ~self.in_medium))

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        scattered = self.medium.pdf(d, active & self.in_medium)
        return dr.select(self.in_medium, scattered, self.surface.pdf(d, active & ~self.in_medium))
