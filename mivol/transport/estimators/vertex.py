"""A point at which light turns: on a surface, by its BSDF, or in a medium, by its phase function; the same to direct lighting.

Conventions. ``eval`` is the BSDF times the cosine, or the phase function [1/sr]; ``pdf`` the density that directions are drawn
from at the vertex [1/sr], which multiple importance sampling weighs emitter samples against.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.phase_sampling import phase_context, phase_pdf
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.ray_spawning import spawn_ray

__all__ = ["MediumVertex", "SurfaceVertex", "Vertex"]


class Vertex(Protocol):
    """Where light turns, and how."""

    interaction: mi.Interaction3f

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3f, mi.MediumPtr]:
        """Where a ray towards ``p`` begins, and the medium around that point."""

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """How much light from the direction ``d`` turns to where the path came from, with its derivatives."""

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Density of the direction ``d`` among those that are drawn at the vertex."""


@dataclass
class SurfaceVertex:
    """A point of a surface.

    Attributes:
        media: of the scene.
        interaction: the point.
        bsdf: of the surface there.
        medium: what surrounds the end of the ray that met it.
    """

    media: SceneMedia
    interaction: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    medium: mi.MediumPtr

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3f, mi.MediumPtr]:
        si = self.interaction
        start = spawn_ray(si, p - si.p, self.media.size).o
        return start, dr.select(si.is_medium_transition(), si.target_medium(p - start), self.medium)

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        return self.bsdf.eval(mi.BSDFContext(), self.interaction, self.interaction.to_local(d), active)

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return self.bsdf.eval_pdf(mi.BSDFContext(), self.interaction, self.interaction.to_local(d), active)[1]


@dataclass
class MediumVertex:
    """A point of a medium; ``interaction.medium`` is what surrounds it."""

    media: SceneMedia
    interaction: mi.MediumInteraction3f

    @property
    def phase(self) -> mi.PhaseFunctionPtr:
        """The phase function there."""
        return self.interaction.medium.phase_function()

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3f, mi.MediumPtr]:
        return mi.Point3f(self.interaction.p), self.interaction.medium

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        return self.phase.eval_pdf(phase_context(), self.interaction, d, active)[0]

    def pdf(self, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        return phase_pdf(self.media, self.phase, self.interaction, d, active)
