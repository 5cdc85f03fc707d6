"""Vertices of a path: a point of a surface with its BSDF, or of a medium with its phase function.

Conventions. ``eval`` is the BSDF times the cosine, or the phase function [1/sr]. The density of directions sampled at the
vertex [1/sr] weighs emitter samples by multiple importance sampling.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.rays import spawn_ray

__all__ = ["MixedVertex", "MediumVertex", "SurfaceVertex", "Vertex"]


class Vertex(Protocol):
    """A point at which light is scattered.

    Attributes:
        interaction: the point for Mitsuba's BSDFs, phase functions and emitters.
        in_medium: lanes with a point of a medium.
    """

    interaction: mi.Interaction3f
    in_medium: mi.Bool | bool

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        """Origin of a ray from the vertex towards ``p``, and the medium around the origin."""

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        """BSDF times cosine, or phase function, for light from the direction ``d`` [1/sr], with derivatives."""

    def eval_and_pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """:meth:`eval`, and the density of ``d`` among directions sampled at the vertex [1/sr], without derivatives."""


@dataclass
class SurfaceVertex:
    """A point of a surface.

    Attributes:
        media: media of the scene.
        interaction: the point.
        bsdf: BSDF of the surface.
        medium: medium in front of the surface, around the end of the incoming ray.
    """

    media: SceneMedia
    interaction: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    medium: mi.MediumPtr
    in_medium = False

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        si = self.interaction
        start = spawn_ray(si, p - si.p, self.media.size).o
        return mi.Point3d(start), dr.select(si.is_medium_transition(), si.target_medium(p - start), self.medium)

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        return self.bsdf.eval(mi.BSDFContext(), self.interaction, self.interaction.to_local(d), active)

    def eval_and_pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        return dr.detach(self.bsdf.eval_pdf(mi.BSDFContext(), self.interaction, self.interaction.to_local(d), active))


@dataclass
class MediumVertex:
    """A point of the medium ``interaction.medium``.

    Attributes:
        media: media of the scene.
        interaction: the point for Mitsuba's phase functions and emitters.
        p: the point in float64, as the origin of rays.
    """

    media: SceneMedia
    interaction: mi.MediumInteraction3f
    p: mi.Point3d
    in_medium = True

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        return self.p, self.interaction.medium

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        return self.media.phases.eval(self.interaction, d, active)

    def eval_and_pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        return dr.detach(self.eval(d, active)), self.media.phases.pdf(self.interaction, d, active)


@dataclass
class MixedVertex:
    """A point of a medium in some lanes and of a surface in the others, with a common shadow ray.

    Attributes:
        surface, medium: the two vertices.
        in_medium: lanes with a point of a medium.
    """

    surface: SurfaceVertex
    medium: MediumVertex
    in_medium: mi.Bool

    @property
    def interaction(self) -> mi.Interaction3f:
        """The point for Mitsuba's BSDFs, phase functions and emitters."""
        return dr.select(self.in_medium, mi.Interaction3f(self.medium.interaction), mi.Interaction3f(self.surface.interaction))

    def leave(self, p: mi.Point3f) -> tuple[mi.Point3d, mi.MediumPtr]:
        (inside, medium), (outside, around) = self.medium.leave(p), self.surface.leave(p)
        return dr.select(self.in_medium, inside, outside), dr.select(self.in_medium, medium, around)

    def eval(self, d: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
        scattered = self.medium.eval(d, active & self.in_medium)
        return dr.select(self.in_medium, scattered, self.surface.eval(d, active & ~self.in_medium))

    def eval_and_pdf(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        scattered, density = self.medium.eval_and_pdf(d, active & self.in_medium)
        reflected, pdf = self.surface.eval_and_pdf(d, active & ~self.in_medium)
        return dr.select(self.in_medium, scattered, reflected), dr.select(self.in_medium, density, pdf)
