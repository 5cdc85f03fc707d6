r"""Light of media that emit, found by samples that are drawn towards them.

.. math:: L_d(x, \omega) = \int_{4\pi} f(x, \omega, \omega_i) \int_0^\infty T(t)\,j(x + t\,\omega_i)\,dt\,d\omega_i

A direction is drawn by a coarse table of the emitted power (:mod:`.emission_table`), and a point along it; the light from there
is dimmed by the media in front of it. The path's next segment passes through the same media in a direction of the BSDF or of
the phase function, and both are weighed by the power heuristic of the densities of that direction. So is all light of media on
that segment, and none of surfaces.

References: Villemin & Hery 2013, Simon et al. 2017 (points and lines of volumes that emit); Veach 1997, Eq. 9.13 (weights).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.contribution import TrackedTerm
from mivol.transport.estimators.direct_lighting import DirectLight
from mivol.transport.estimators.emission_table import EmissionTable, EmittingBox
from mivol.transport.estimators.multiple_importance import power_heuristic
from mivol.transport.estimators.shadow_rays import light_through
from mivol.transport.estimators.vertex import Vertex
from mivol.transport.media.body import Body
from mivol.transport.media.channels import by_channel, spectrum
from mivol.transport.media.coefficients import emission_slope, eval_emission
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.fine_ray import FineRay, Ray
from mivol.transport.traversal.random_numbers import draw_pcg32

__all__ = ["EmissionLight", "EmissionSampling", "EmittingPoint"]


class EmissionSampling:
    """The estimator of light from media that emit, at surfaces and in media.

    Args:
        media: of the scene.
        table: of what they emit.
    """

    def __init__(self, media: SceneMedia, table: EmissionTable) -> None:
        self.media, self.table = media, table

    def weigh_met(self, last: mi.Interaction3f, rival: mi.Float, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """The weight of the light of media on a path's segment.

        Args:
            last: where its direction was drawn.
            rival: with which density [1/sr]; 0 where no light of media was drawn there.
            d: the direction.
            active: lanes asked about.
        """
        on = active & (rival > 0)
        return dr.select(on, power_heuristic(rival, self.table.look(last.p, d, on).pdf), 1)

    def at_vertex(
        self,
        vertex: Vertex,
        carried: mi.Spectrum,
        samples: tuple[mi.Float, mi.UInt32],
        attached: bool,
        active: mi.Bool,
        estimates: bool,
    ) -> EmissionLight:
        """Estimate the light of media at a vertex of a path by one point of them.

        Args:
            vertex: the point of the path.
            carried: throughput to there, times the albedo in a medium.
            samples: the number of the cell that is aimed at, and the generator of all others.
            attached: keep the derivatives of BSDF or phase function and emission.
            active: lanes to estimate.
            estimates: whether the shadow is estimated.

        Bias: none. Variance: that of one point. Cost: one shadow ray, and a walk of the table.
        """
        media, it = self.media, vertex.interaction
        u, rng = samples
        rng, (*place, along, chance) = draw_pcg32(rng, 5)
        d = dr.normalize(self.table.draw_place(u, place) - it.p)
        line = self.table.draw_along(it.p, d, along, active)
        f = dr.detach(vertex.eval(d, active))
        on = active & (line.pdf > 0) & (line.density > 0) & dr.any(f != 0)
        weight = power_heuristic(line.pdf, vertex.pdf(d, on)) / dr.select(on, line.pdf * line.density, 1)
        # -- The light that arrives from there ----------------------------------------------------------------------------
        start, medium = vertex.leave(it.p + d * line.t)
        ray = FineRay.leaving(start, d, it, dr.select(on, line.t, 0))
        end, _, light = light_through(media, ray, medium, on, rng if estimates else None)
        on &= ~end.si.is_valid()
        inside = [(box.body, on & (line.box == k) & _holds(box, ray, end.medium)) for k, box in enumerate(self.table.boxes)]
        point = EmittingPoint(RaySegment(ray, medium, ray.maxt, True), inside, on, chance)
        front, emitted = carried * light * weight, mi.Spectrum(0)
        with dr.resume_grad(when=attached):
            for body, here in inside:
                emitted = dr.select(here, eval_emission(body, ray, point.t, media.channels, here), emitted)
            value = dr.select(on, front * vertex.eval(d, on) * emitted, 0)
        return EmissionLight(media, point, value, front * f)


def _holds(box: EmittingBox, ray: Ray, medium: mi.MediumPtr) -> mi.Bool:
    """Whether the end of a ray lies in a medium; ``medium`` is the one that was traced to there."""
    if box.body.box is None:
        return medium == mi.MediumPtr(box.body.view.medium)
    return box.holds(ray(ray.maxt))


@dataclass
class EmittingPoint:
    """A point of a medium that emits, and the shadow ray to it.

    Attributes:
        ray_segment: the shadow ray.
        bodies: the media, each with the lanes whose point lies in it.
        on: lanes that nothing hides it from.
        chance: for derivatives, a number in [0, 1) by which one of a path's shadow rays is kept.
    """

    ray_segment: RaySegment
    bodies: list[tuple[Body, mi.Bool]]
    on: mi.Bool
    chance: mi.Float

    @property
    def t(self) -> mi.Float64:
        """Its distance [length]."""
        return mi.Float64(self.ray_segment.length)


class EmissionLight(TrackedTerm):
    """The light of a point of a medium, as a term, but for the derivatives of the media along its shadow ray.

    Args:
        media: of the scene.
        point: the point.
        value: as the camera sees it, attached to BSDF or phase function and to the emission.
        front: what multiplies the emission of the point, without derivatives.
    """

    def __init__(self, media: SceneMedia, point: EmittingPoint, value: mi.Spectrum, front: mi.Spectrum) -> None:
        super().__init__(value, point.on)
        self.media, self.point, self.front = media, point, front

    @property
    def shadow(self) -> DirectLight:
        """The derivatives of the media along the shadow ray."""
        return DirectLight(self.media, self.point.ray_segment, self.value, self.active)

    def vjp(self, dL: mi.Spectrum) -> None:
        """Derivatives of BSDF or phase function and of the emission, and by the extinction that this goes with."""
        super().vjp(dL)
        ray, t = self.point.ray_segment.ray, self.point.t
        for body, on, name, slope in self._slopes():
            body.deposit(ray, t, by_channel(dL * self.front * slope, self.media.channels), on, name)

    def jvp(self) -> mi.Spectrum:
        """Tangent of both."""
        change, ray, t = super().jvp(), self.point.ray_segment.ray, self.point.t
        for body, on, name, slope in self._slopes():
            own = spectrum(body.tangent_at(ray, t, self.media.channels, on, name))
            change += dr.select(on, self.front * slope * own, 0)
        return change

    def _slopes(self) -> list[tuple[Body, mi.Bool, str, mi.Spectrum]]:
        """The coefficient that the emission of each medium goes with, and the derivative by it."""
        ray, found = self.point.ray_segment.ray, []
        for body, on in self.point.bodies:
            if body.view.emission is not None:
                name, slope = emission_slope(body, ray, self.point.t, on)
                found.append((body, on, name, dr.detach(slope)))
        return found
