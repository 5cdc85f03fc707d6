r"""The light of lamps behind smooth glass: each vertex draws a direction in which a bent ray may meet a lamp or the bright
focus of an environment map.

.. math:: L = \frac{f(\omega)\, T\, L_e}{P\, q(\omega) + p(\omega)}

No straight ray passes smooth glass, so emitter samples find no light behind glass, and paths meet lamps by chance. Here a
vertex chooses a lamp with the probability P, draws a direction omega from a lobe q around the way to the lamp, and follows the
ray through all smooth glass ahead. T contains the transmitted shares. Paths that meet the same lamp by chance, through glass
alone, sample the same light with the density p of a BSDF or phase function. The balance heuristic weighs both.

The focus of a map (:class:`.BrightMap`) counts as a lamp far away.

The axis of the lobe comes from one step: the straight line to the middle of the lamp is traced to the first glass, and the line
from there to the lamp is refracted back to the vertex. The lobe (Henyey & Greenstein) is as wide as the lamp and the step
together, so a wrong axis costs efficiency only. (Two and four steps: the same variance in a ball and a cube, and 1.2 and 1.5
times the time.)

References: Hanika et al. 2015 (next-event estimation through glass); Veach & Guibas 1995 (the balance heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.phase.closed_forms import angle_between, eval_hg, sample_hg, scattered_direction
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.shadow_rays import find_transmittance
from mivol.transport.estimators.lighting.vertex import Vertex
from mivol.transport.traversal.random_numbers import fork_state
from mivol.transport.traversal.rays import FineRay, spawn_ray

__all__ = ["REFRACTS", "TRANSMITS", "RefractedLighting", "RefractedSamples", "VertexBeforeGlass", "refracts_only"]


FAR = 1e4
"""Distance of the focus of a map, over the size of the scene [1]."""

WIDTH = 0.7
"""Width of a lobe, 1 - g, over the angle of the lamp and of the step together [1/rad] (measured: 0.3 and 1.5 have the same
variance within 3 %)."""

MIN_WIDTH = 2e-3
"""Smallest width of a lobe [1]. Float32 knows the axis to about 1e-6."""

TRANSMITS = 1 - 2**-24
"""Largest float32 below 1. Mitsuba's glass transmits for numbers above the reflectance, with the density 1 - reflectance."""


REFRACTS = int(mi.BSDFFlags.DeltaReflection) | int(mi.BSDFFlags.DeltaTransmission)
"""Flags of the BSDFs that only mirror and refract."""


def refracts_only(si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a surface only mirrors and refracts. Glass with holes, or blended with paint, is left to chance."""
    return (si.bsdf().flags() & mi.UInt32(int(mi.BSDFFlags.All))) == REFRACTS


@dataclass
class RefractedSamples:
    """The random numbers for the light behind glass at a vertex.

    Attributes:
        which_lamp: uniform random number in [0, 1) for the lamp.
        direction: two for the direction.
        rng: state of a generator for transmittances.
    """

    which_lamp: mi.Float
    direction: mi.Point2f
    rng: mi.UInt32


@dataclass
class VertexBeforeGlass:
    """The last vertex at which a path has drawn a direction from a density, and what glass has done since.

    Attributes:
        interaction: the vertex.
        d: the direction.
        pdf: density of the direction [1/sr].
        was_transmitted: lanes that smooth glass has transmitted since.
        was_mirrored: lanes that a surface has mirrored since, or transmitted without being smooth glass, and lanes without
            such a vertex.
    """

    interaction: mi.Interaction3f
    d: mi.Vector3f
    pdf: mi.Float
    was_transmitted: mi.Bool
    was_mirrored: mi.Bool

    @classmethod
    def none(cls, n: int) -> VertexBeforeGlass:
        """No vertex, in ``n`` lanes."""
        none = dr.full(mi.Bool, False, n)
        return cls(dr.zeros(mi.Interaction3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Float, n), none, ~none)

    def at_specular(self, on: mi.Bool, mirrors: mi.Bool) -> VertexBeforeGlass:
        """The same vertex after a surface has turned paths in the lanes ``on``; ``mirrors``: not through smooth glass."""
        transmitted, mirrored = self.was_transmitted | (on & ~mirrors), self.was_mirrored | (on & mirrors)
        return VertexBeforeGlass(self.interaction, self.d, self.pdf, transmitted, mirrored)


@dataclass
class _RayThroughGlass:
    """State of a ray on the way through glass.

    Attributes:
        on: lanes on the way.
        ray: the ray from the last glass on.
        medium: medium around the origin of the ray.
        T: transmitted share of the light so far [1].
        depth: number of scattering events so far.
        rng: state of a generator for the next transmittance.
        has_crossed: lanes behind some glass.
        L: light found, dimmed by ``T`` [radiance].
    """

    on: mi.Bool
    ray: FineRay
    medium: mi.MediumPtr
    T: mi.Spectrum
    depth: mi.UInt32
    rng: mi.UInt32
    has_crossed: mi.Bool
    L: mi.Spectrum


class RefractedLighting:
    """The estimator of the light of lamps behind smooth glass.

    Args:
        direct: estimator of direct lighting, with the emitters of the scene.
        depth_limit: largest path depth.

    Bias: none, together with :meth:`weigh_path`. Variance: one direction towards one lamp. Light that a surface mirrors on the
    way is left to chance. Cost: a ray to the glass, and a ray through each piece of glass to the lamp.
    """

    def __init__(self, direct: DirectLighting, depth_limit: int) -> None:
        self.media, self.depth_limit = direct.media, depth_limit
        # The tables are made here, outside of recorded loops.
        self.lamps = direct.near_emitters
        self._focus, self._map = None, None
        if direct.bright is not None:
            self._focus, self._map = direct.bright.focus, self.media.scene.environment()

    @classmethod
    def of_lamps(cls, direct: DirectLighting, depth_limit: int) -> RefractedLighting | None:
        """Make the estimator; None without lamps and without a map (or if the map has gradients enabled)."""
        made = cls(direct, depth_limit)
        return made if made.lamps.sampled or made._map is not None else None

    def estimate(self, vertex: Vertex, samples: RefractedSamples, depth: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """Estimate the light of lamps behind smooth glass scattered at a vertex, over the albedo in media [radiance].

        Args:
            vertex: the vertex.
            samples: its random numbers.
            depth: number of scattering events, with the event at the vertex.
            active: lanes to estimate.
        """
        it = vertex.interaction
        number = self._choose(it, samples.which_lamp)
        axis, g = self._aim(it, number, active)
        d = scattered_direction(-axis, sample_hg(samples.direction.x, g), samples.direction.y)
        f, pdf = vertex.eval_and_pdf(d, active)
        density = pdf + self._density(it, number, axis, g, d)
        on = active & (density > 0) & dr.any(f != 0)
        start, medium = vertex.leave(mi.Point3f(it.p) + d)
        L = self._follow(FineRay.from_point(start, d, it), medium, number, depth, samples.rng, on)
        return dr.select(on, f * L / dr.select(on, density, 1), 0)

    def weigh_path(self, before: VertexBeforeGlass, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Float:
        """The weight of the light of an emitter that paths have met behind a specular surface by chance [1].

        Args:
            before: the last vertex of each path.
            emitter: the emitter.
            active: lanes that have met the emitter.
        """
        number, known = self._number_of(emitter)
        on = active & before.was_transmitted & ~before.was_mirrored & known

        def weigh(before: VertexBeforeGlass, number: mi.UInt32) -> mi.Float:
            axis, g = self._aim(before.interaction, number, on)
            density = before.pdf + self._density(before.interaction, number, axis, g, before.d)
            return dr.select(density > 0, before.pdf / dr.select(density > 0, density, 1), 1)

        def keep(before: VertexBeforeGlass, number: mi.UInt32) -> mi.Float:
            return dr.full(mi.Float, 1, dr.width(number))

        # Packets of lanes pass by if none of them has met a lamp through glass.
        return dr.if_stmt((before, dr.select(on, number, 0)), on, weigh, keep, label="lamp behind glass")

    def _density(self, it: mi.Interaction3f, number: mi.UInt32, axis: mi.Vector3f, g: mi.Float, d: mi.Vector3f) -> mi.Float:
        """Density of a direction in :meth:`estimate`, with the probability of the lamp [1/sr]."""
        return self._probability(it, number) * eval_hg(angle_between(-axis, d), g)

    # -- Lamps by number: the focus of the map comes behind the lamps ---------------------------------------------------------

    @property
    def _map_share(self) -> float:
        """Probability of the map [1]."""
        return 0.0 if self._map is None else 0.5 if self.lamps.sampled else 1.0

    def _choose(self, it: mi.Interaction3f, u: mi.Float) -> mi.UInt32:
        share, count = self._map_share, len(self.lamps.sampled)
        if share == 1:
            return dr.full(mi.UInt32, count, dr.width(u))
        number, _ = self.lamps.choose_at_point(it.p, dr.minimum((u - share) / (1 - share), TRANSMITS))
        return dr.select(u < share, count, number)

    def _probability(self, it: mi.Interaction3f, number: mi.UInt32) -> mi.Float:
        share, is_map = self._map_share, number == len(self.lamps.sampled)
        if share == 1:
            return mi.Float(1)
        of_lamp = self.lamps.probability_at_point(it.p, dr.select(is_map, 0, number))
        return dr.select(is_map, share, (1 - share) * of_lamp)

    def _number_of(self, emitter: mi.EmitterPtr) -> tuple[mi.UInt32, mi.Bool]:
        """The number of an emitter, and lanes in which there is one."""
        count, number, known = len(self.lamps.sampled), mi.UInt32(0), mi.Bool(False)
        if count:
            number = self.lamps.number_of(emitter)
            known = number < count
        if self._map is not None:
            is_map = emitter == mi.EmitterPtr(self._map)
            number, known = dr.select(is_map, count, number), known | is_map
        return number, known

    def _ball(self, it: mi.Interaction3f, number: mi.UInt32) -> tuple[mi.Point3f, mi.Float]:
        """Centre and radius of a lamp, as seen from a point [length]."""
        count, centre, radius = len(self.lamps.sampled), mi.Point3f(0), mi.Float(0)
        is_map = number == count
        if count:
            centre, radius = self.lamps.ball(dr.select(is_map, 0, number))
        if self._map is None:
            return centre, radius
        x, y, z, angle = (dr.gather(mi.Float, self._focus, mi.UInt32(k)) for k in range(4))
        far = FAR * self.media.size
        return dr.select(is_map, it.p + far * mi.Vector3f(x, y, z), centre), dr.select(is_map, far * angle, radius)

    def _aim(self, it: mi.Interaction3f, number: mi.UInt32, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
        """The axis and the mean cosine of the lobe at a point, for a lamp."""
        centre, radius = self._ball(it, number)
        away = mi.Vector3f(centre - it.p)
        straight = dr.normalize(away)
        si = self.media.tracer.ray_intersect(it.spawn_ray(straight), mi.RayFlags.All, False, active)
        on = active & si.is_valid() & refracts_only(si)
        # The relative index is the same at each angle of incidence, and light along the normal is never mirrored as a whole.
        level = mi.SurfaceInteraction3f(si)
        level.wi = mi.Vector3f(0, 0, dr.mulsign(mi.Float(1), si.wi.z))
        eta = si.bsdf().sample(mi.BSDFContext(), level, mi.Float(TRANSMITS), mi.Point2f(0.5), on)[0].eta
        normal = dr.mulsign(si.sh_frame.n, dr.dot(si.sh_frame.n, straight))
        onward = dr.normalize(mi.Vector3f(centre - si.p))
        cosine = dr.dot(onward, normal)
        sine2 = dr.square(eta) * (1 - dr.square(cosine))
        on &= (cosine > 0) & (sine2 < 1)
        bent = eta * (onward - cosine * normal) + dr.safe_sqrt(1 - sine2) * normal
        axis = dr.select(on, dr.normalize(bent), straight)
        angle = dr.sqrt(dr.square(radius) * dr.rcp(dr.squared_norm(away)) + dr.squared_norm(axis - straight))
        return axis, 1 - dr.clip(WIDTH * angle, MIN_WIDTH, 1)

    def _follow(
        self, ray: FineRay, medium: mi.MediumPtr, number: mi.UInt32, depth: mi.UInt32, rng: mi.UInt32, active: mi.Bool
    ) -> mi.Spectrum:
        """The light of a lamp along a ray through smooth glass, dimmed by all on the way [radiance]."""
        media, limit = self.media, self.depth_limit

        def step(state: _RayThroughGlass) -> tuple[_RayThroughGlass]:
            end, _, _, T = find_transmittance(media, state.ray, state.medium, state.on, state.rng)
            si, T = end.si, state.T * T
            emitter = si.emitter(media.scene, state.on)
            found, known = self._number_of(emitter)
            lit = state.on & state.has_crossed & known & (found == number)
            L = state.L + dr.select(lit, T * emitter.eval(si, lit), 0)
            # -- Through the glass --------------------------------------------------------------------------------------
            on = state.on & si.is_valid() & dr.any(T != 0) & (state.depth + 1 < limit)
            on &= refracts_only(si)
            sample, weight = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(TRANSMITS), mi.Point2f(0.5), on)
            on &= mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaTransmission)
            onward = FineRay.from_ray(spawn_ray(si, si.to_world(sample.wo), media.size))
            medium = dr.select(si.is_medium_transition(), si.target_medium(onward.d), end.medium)
            onward.time, onward.maxt = state.ray.time, dr.full(mi.Float, dr.inf, dr.width(on))
            return (
                _RayThroughGlass(
                    on,
                    dr.select(on, onward, state.ray),
                    dr.select(on, medium, state.medium),
                    dr.select(on, T * weight * sample.pdf, 0),
                    state.depth + 1,
                    fork_state(state.rng, 1),
                    state.has_crossed | on,
                    L,
                ),
            )

        n = dr.width(ray.d)
        black, white, none = dr.zeros(mi.Spectrum, n), dr.full(mi.Spectrum, 1, n), dr.full(mi.Bool, False, n)
        start = _RayThroughGlass(none | active, ray, medium, white, mi.UInt32(depth), rng, none, black)
        return dr.while_loop((start,), lambda state: state.on, step, label="through glass")[0].L
