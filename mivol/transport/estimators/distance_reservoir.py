r"""Where light is scattered towards the camera: a distance along its ray, with the density it was drawn from.

.. math:: p(t) = \frac{W_c}{\sum_c W_c}\, p_c(t), \qquad
          W_c = \overline{T_a (1 - e^{-\tau_c})}\;\frac{\theta_b - \theta_a}{\rho\,(b - a)}

One walk sums the optical depth of the ray and keeps one piece (a cell, or a stretch of constant extinction) in proportion to
its weight: the light that it takes from the ray, mean over the channels, times the mean of 1 / r^2 as seen from the lamp that
was chosen. In the piece the distance is drawn by inverting its exact optical depth, or by equal angles seen from the lamp;
the density of the two together is known, so nothing is biased by the weights being approximate.

Conventions. A probe for derivatives adds ``probe_depth`` to the extinction: density is then drawn where there is none yet,
since the derivative is not zero there.

References: Kulla & Fajardo 2012 (equal angles); Miller et al. 2019 (spectral combination of free paths); Chao 1982 (keeping one
of a weighted stream).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.emitters import ChosenEmitter
from mivol.transport.estimators.equiangular import EquiangularSampler
from mivol.transport.estimators.shadow_rays import DARK
from mivol.transport.estimators.visibility_cache import VisibilityCache
from mivol.transport.media.body import Body
from mivol.transport.media.ray_intervals import MediumVisitor
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, walk
from mivol.transport.traversal.interpolation import gauss_points
from mivol.transport.traversal.lattice import clip, split
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32

__all__ = ["Candidate", "Reservoir", "fill_reservoir", "inverse", "lit_length", "start_reservoir", "taken_light"]


@dataclass
class Candidate:
    """The piece of a ray that was kept so far.

    Attributes:
        weight: of the piece.
        begin, s, dt: it starts ``s`` behind ``begin``, a distance along the ray, and is ``dt`` long.
        front: optical depth in front of it.
        probe_sigma: extinction [1/length] that a probe adds there.
        body: number of its body.
        is_new: whether the walk under way has found it.
        rng: state of the generator.
    """

    weight: mi.Float
    begin: mi.Float
    s: mi.Float
    dt: mi.Float
    front: list[mi.Float]
    probe_sigma: mi.Float
    body: mi.UInt32
    is_new: mi.Bool
    rng: mi.UInt32


@dataclass
class Reservoir:
    """What has been walked of a ray, and pieces of it that were kept, each drawn for itself.

    Attributes:
        tau, T: optical depth [1] and transmittance [1] of each channel, of all that was walked.
        total: sum of the weights.
        candidates: the pieces.
    """

    tau: list[mi.Float]
    T: list[mi.Float]
    total: mi.Float
    candidates: list[Candidate]

    def of(self, number: mi.UInt32) -> Candidate:
        """One of the pieces in each lane."""
        found = self.candidates[0]
        for k, other in enumerate(self.candidates[1:], 1):
            found = dr.select(number == k, other, found)
        return found


def start_reservoir(media: SceneMedia, u: mi.Float, width: int, count: int = 1) -> Reservoir:
    """Begin with nothing; ``u`` in [0, 1) seeds the generators of ``count`` pieces."""
    tau, T = [[dr.full(mi.Float, v, width) for _ in range(media.channels)] for v in (0, 1)]
    return Reservoir(
        tau, T, dr.zeros(mi.Float, width), [_start_candidate(media, seed_pcg32(u, width, k), width) for k in range(count)]
    )


def _start_candidate(media: SceneMedia, rng: mi.UInt32, width: int) -> Candidate:
    zero = [dr.zeros(mi.Float, width) for _ in range(5)]
    front = [dr.zeros(mi.Float, width) for _ in range(media.channels)]
    return Candidate(*zero[:4], front, zero[4], dr.zeros(mi.UInt32, width), dr.zeros(mi.Bool, width), rng)


def fill_reservoir(
    media: SceneMedia, ray: mi.Ray3f, chosen: ChosenEmitter, cache: VisibilityCache | None, probe_depth: float
) -> MediumVisitor:
    """The visitor that sums optical depth and offers every piece of a ray to a :class:`Reservoir`.

    Args:
        media: of the scene.
        ray: world space, unit direction.
        chosen: the emitter of each lane.
        cache: where emitters shine; None where that is not known.
        probe_depth: optical depth to add evenly over each body, for probes of derivatives; 0 for an image.

    Cost: as an optical depth, with one exponential and one random number a cell (measured: 1.7 times its time).
    """
    return _Filling(media, ray, chosen, cache, probe_depth).visit


@dataclass
class _Filling:
    """What candidates are weighed by, as :func:`fill_reservoir` was told."""

    media: SceneMedia
    ray: mi.Ray3f
    chosen: ChosenEmitter
    cache: VisibilityCache | None
    probe_depth: float

    def visit(self, reservoir: Reservoir, body: Body, t0: mi.Float, t1: mi.Float, on: mi.Bool) -> Reservoir:
        """Offer the pieces of one body, and sum the optical depth of its parts that have other cells."""
        reservoir = self._offer_body(reservoir, body, t0, t1, on)
        number = next(index for index, other in enumerate(self.media.bodies) if other is body)
        for candidate in reservoir.candidates:
            candidate.body = dr.select(candidate.is_new, number, candidate.body)
            candidate.is_new = dr.zeros(mi.Bool, dr.width(candidate.is_new))
        others = [p for p in body.view.parts if not any(p is q for q in body.flight_parts)]
        if others:
            rest = body.optical_depth(self.ray, t0, t1, self.media.channels, on, others)
            reservoir.tau = [t + r for t, r in zip(reservoir.tau, rest, strict=True)]
            reservoir.T = [dr.exp(-t) for t in reservoir.tau]
        return reservoir

    def _offer_body(
        self, reservoir: Reservoir, body: Body, t0: mi.Float | mi.Float64, t1: mi.Float | mi.Float64, on: mi.Bool
    ) -> Reservoir:
        """Offer the pieces of one body, in their order.

        Ends of a box come in float64: seen from 30 box sizes away, a float32 entry errs by 1e-6 of a box.
        """
        ray, rows, equiangular = self.ray, self.media.rows, self.chosen.equiangular
        field = body.extinction(ray, body.flight_parts)
        grid = next((p.lattice for p in body.flight_parts if p.lattice is not None), None)
        segment = clip(grid, ray.o, ray.d, t0, t1) if grid is not None else None
        filled = segment.length if segment is not None and not field.has_constants else mi.Float(t1 - t0)
        probe_sigma = self._probe_sigma(filled)

        def add_constant(reservoir: Reservoir, a: mi.Float | mi.Float64, b: mi.Float | mi.Float64) -> Reservoir:
            sigma, front = rows(field.constant), reservoir.tau
            length = dr.select(on, dr.maximum(mi.Float(b - a), 0), 0)
            dt = lit_length(sigma, length)
            tau = [s * dt for s in sigma]
            begin, rest = split(a)
            piece = (begin, rest, dt, tau, equiangular, None, probe_sigma, on & (dt > 0))
            reservoir = _offer_candidate(reservoir, *piece)
            # A length may have no end.
            tau = [f + dr.select(s > 0, s * length, 0) for f, s in zip(front, sigma, strict=True)]
            return replace(reservoir, tau=tau, T=[dr.exp(-t) for t in tau])

        if segment is None:
            reservoir = add_constant(reservoir, t0, t1)
            return _note_probe(reservoir, probe_sigma)
        # Where there is no extinction there is no light, but there is a derivative.
        walks_all = self.probe_depth > 0 or field.has_constants or len(field.reads) > 1
        lattice = replace(grid, empty_distances=None) if walks_all else grid
        hit = segment.length > 0

        def visit(reservoir: Reservoir, cell: Cell, full: mi.Bool) -> Reservoir:
            half = dr.select(full, 0.5 * cell.dt, 0)
            tau = rows([half * (a + b) for a, b in field.along(cell.corners, list(gauss_points(cell)))])
            lit = None if self.cache is None else self.cache.at(cell.lower, self.chosen.number, full)
            return _offer_candidate(
                reservoir, segment.t0, segment.t0_rest + cell.s, cell.dt, tau, equiangular, lit, probe_sigma, full
            )

        if field.has_constants:
            reservoir = add_constant(reservoir, t0, dr.select(hit, segment.start, t1))
        # An image takes no light from behind this depth; derivatives are swept back from the far end, and need all of it.
        until = None if self.probe_depth else lambda p: _least_of(p.tau) > DARK
        reservoir = walk(lattice, segment, visit, reservoir, field.reads, on, until)
        if field.has_constants:
            reservoir = add_constant(reservoir, dr.select(hit, segment.end, t1), t1)
        return _note_probe(reservoir, probe_sigma)

    def _probe_sigma(self, length: mi.Float) -> mi.Float | None:
        """Extinction [1/length] that a probe adds over a length; None for an image."""
        if not self.probe_depth:
            return None
        return dr.select(dr.isfinite(length) & (length > 0), self.probe_depth * inverse(length), 0)


def lit_length(sigma: list[mi.Float], length: mi.Float) -> mi.Float:
    """How far a stretch of constant extinction is worth a look: to the optical depth ``DARK`` of its clearest channel."""
    least = mi.Float(dr.inf)
    for s in sigma:
        least = dr.select(s > 0, dr.minimum(least, s), least)
    return dr.minimum(length, DARK / least)


def _least_of(rows: list[mi.Float]) -> mi.Float:
    least = rows[0]
    for row in rows[1:]:
        least = dr.minimum(least, row)
    return least


def _note_probe(reservoir: Reservoir, probe_sigma: mi.Float | None) -> Reservoir:
    if probe_sigma is None:
        return reservoir
    return replace(
        reservoir,
        candidates=[replace(k, probe_sigma=dr.select(k.is_new, probe_sigma, k.probe_sigma)) for k in reservoir.candidates],
    )


def _offer_candidate(
    reservoir: Reservoir,
    begin: mi.Float,
    s: mi.Float,
    dt: mi.Float,
    tau: list[mi.Float],
    equiangular: EquiangularSampler | None,
    lit: mi.Float | None,
    probe_sigma: mi.Float | None,
    on: mi.Bool,
) -> Reservoir:
    """Keep a piece with the probability of its weight among all so far."""
    ahead = [a + b for a, b in zip(reservoir.tau, tau, strict=True)]
    beyond = [dr.exp(-t) for t in ahead]
    weight = mi.Float(0)
    for own, T, T_out in zip(tau, reservoir.T, beyond, strict=True):
        weight += taken_light(own, T, T_out)
        if probe_sigma is not None:
            weight += 0.5 * probe_sigma * dt * (T + T_out)
    if equiangular is not None:
        weight *= equiangular.mean(begin + s, dt)
    if lit is not None:
        weight *= lit
    # A piece of length 0 has a NaN for its mean angle; a weight beyond float32 would be kept for ever.
    weight = dr.select(on & (dt > 0) & (weight < 1e30), weight, 0)
    total = reservoir.total + weight
    return Reservoir(
        ahead,
        beyond,
        total,
        [_replace_candidate(old, weight, total, begin, s, dt, reservoir.tau) for old in reservoir.candidates],
    )


def _replace_candidate(
    old: Candidate, weight: mi.Float, total: mi.Float, begin: mi.Float, s: mi.Float, dt: mi.Float, tau: list[mi.Float]
) -> Candidate:
    """The new piece in place of the old one, with the probability of its weight."""
    rng, (u,) = draw_pcg32(old.rng, 1)
    keep = u * total < weight
    return Candidate(
        dr.select(keep, weight, old.weight),
        dr.select(keep, begin, old.begin),
        dr.select(keep, s, old.s),
        dr.select(keep, dt, old.dt),
        [dr.select(keep, t, f) for t, f in zip(tau, old.front, strict=True)],
        old.probe_sigma,
        old.body,
        old.is_new | keep,
        rng,
    )


def taken_light(tau: mi.Float, T: mi.Float, T_out: mi.Float) -> mi.Float:
    """T (1 - exp(-tau)), to 4e-5 of it: a difference where it keeps its digits, a series elsewhere."""
    series = dr.fma(tau, dr.fma(tau, dr.fma(tau, dr.fma(tau, 1 / 120, -1 / 24), 1 / 6), -1 / 2), 1)
    return dr.select(tau < 0.5, T * tau * series, T - T_out)


def inverse(x: mi.Float) -> mi.Float:
    """1 / x for x >= 0, finite at 0 (1e30), so that a product with 0 stays 0."""
    return dr.rcp(dr.maximum(x, 1e-30))
