r"""Distance sampling in the piece of a ray that a reservoir has kept, with the density of the distance.

The distance is drawn by inverting the piece's exact optical depth (free-flight sampling), or uniformly in the angle seen from
the emitter (equiangular sampling). The density of their mixture, times the probability of the piece, is returned; so the
estimate is unbiased whatever the weights of the pieces were.

References: Kulla & Fajardo 2012 (equiangular sampling); Miller et al. 2019 (spectral combination of free paths).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.numerics import one_minus_exp
from mivol.transport.estimators.distance_reservoir import Candidate, DistanceProposal, inverse
from mivol.transport.media.body import Body
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.cubic import cubic_at, cubic_integral, cubic_through, invert_cubic_integral
from mivol.transport.traversal.fine_ray import Ray
from mivol.transport.traversal.grid_walk import box_nodes, read_nodes
from mivol.transport.traversal.lattice import piece_points
from mivol.transport.traversal.random_numbers import draw_pcg32

__all__ = ["MediumEvent", "sample_distance"]


@dataclass
class MediumEvent:
    """A scattering event on a ray.

    Attributes:
        t, begin: its distance, and that at which its piece begins [length], in float64.
        pdf: density that the distance was drawn with [1/length].
        tau: optical depth [1] in front of it, of each channel, summed over the media in the order of the walk.
        sigma_t: extinction [1/length] there, of each channel.
        body: index of its medium.
        on: lanes that have one.
    """

    t: mi.Float64
    begin: mi.Float64
    pdf: mi.Float
    tau: list[mi.Float]
    sigma_t: list[mi.Float]
    body: mi.UInt32
    on: mi.Bool


def sample_distance(
    proposal: DistanceProposal, candidate: Candidate, total: mi.Float, u: mi.Point2f, active: mi.Bool
) -> MediumEvent:
    """Draw a distance in the piece that a reservoir has kept.

    Args:
        proposal: that the reservoir was filled with.
        candidate: the piece.
        total: sum of the weights of all pieces.
        u: two numbers in [0, 1).
        active: lanes that may scatter.
    """
    media, ray, equiangular = proposal.media, proposal.ray, proposal.chosen.equiangular
    on = active & (candidate.weight > 0)
    dt = dr.select(on, candidate.dt, 1)
    curve = _curve(media, ray, candidate, on)
    whole = [cubic_integral(c, dt, 1) for c in curve]
    front = [dr.exp(-f) for f in candidate.front]

    # -- The technique: free flight, or uniform (in angle where the emitter is finite, in length for probes) -----------
    by_collision = mi.Float(1)
    if proposal.probe_depth:
        mean = sum(whole) / len(whole)
        by_collision = mean * inverse(mean + candidate.probe_sigma * dt)
    if equiangular is not None:
        by_collision = dr.select(equiangular.finite, 0.5 * by_collision, by_collision)
    collides = u.x < by_collision
    begin = candidate.begin + candidate.s
    even = u.y * dt if equiangular is None else dr.select(equiangular.finite, equiangular.sample(begin, dt, u.y), u.y * dt)
    x = dr.select(collides, _invert(curve, whole, front, dt, u), even * dr.rcp(dt))

    # -- The density of their mixture ------------------------------------------------------------------------------------
    sigma = [dr.maximum(cubic_at(c, x), 0) for c in curve]
    tau = [cubic_integral(c, dt, x) for c in curve]
    taken = sum((f * one_minus_exp(w) for f, w in zip(front, whole, strict=True)), mi.Float(0))
    hits = sum((f * s * dr.exp(-t) for f, s, t in zip(front, sigma, tau, strict=True)), mi.Float(0))
    pdf = by_collision * dr.select(taken > 0, hits / dr.select(taken > 0, taken, 1), 0)
    evenly = dr.rcp(dt)
    if equiangular is not None:
        evenly = dr.select(equiangular.finite, equiangular.density(begin, dt, x * dt), evenly)
    pdf = (pdf + (1 - by_collision) * evenly) * candidate.weight / dr.select(on, total, 1)
    start = mi.Float64(candidate.begin) + mi.Float64(candidate.s)
    t = start + mi.Float64(x) * mi.Float64(dt)
    on &= (pdf > 0) & dr.isfinite(pdf)
    return MediumEvent(
        t, start, dr.select(on, pdf, 1), [f + a for f, a in zip(candidate.front, tau, strict=True)], sigma, candidate.body, on
    )


def _curve(media: SceneMedia, ray: Ray, candidate: Candidate, on: mi.Bool) -> list[list[mi.Float]]:
    """The extinction along a piece for each channel: the coefficients of a cubic on [0, 1]."""
    values = [[mi.Float(0) for _ in range(4)] for _ in range(media.channels)]
    for index, body in enumerate(media.bodies):
        here = on & (candidate.body == index)
        own = _values_along(media, body, ray, candidate, here)
        values = [[dr.select(here, n, v) for n, v in zip(new, old, strict=True)] for new, old in zip(own, values, strict=True)]
    return [cubic_through(*v) for v in values]


def _values_along(media: SceneMedia, body: Body, ray: Ray, candidate: Candidate, on: mi.Bool) -> list[list[mi.Float]]:
    """[channel][point] extinction at 0, 1/3, 2/3 and 1 of a piece, in one medium."""
    extinction = body.extinction(ray, body.flight_parts)
    constant = [[c] * 4 for c in extinction.constant]
    lattice = next((p.lattice for p in body.flight_parts if p.lattice is not None), None)
    if lattice is None:
        return _by_point(media, constant)
    start = mi.Float64(candidate.begin) + mi.Float64(candidate.s)
    cell, points, inside = piece_points(lattice, ray, start, candidate.dt, on)
    nodes = box_nodes(cell, dr.full(dr.mask_t(mi.Vector3f), True), lattice.res)
    grid = extinction.along(read_nodes(extinction.reads, nodes, inside), points)
    own = [[dr.select(inside, g, k) for g, k in zip(*row, strict=True)] for row in zip(grid, constant, strict=True)]
    return _by_point(media, own)


def _by_point(media: SceneMedia, values: list[list[mi.Float]]) -> list[list[mi.Float]]:
    """[channel of the scene][point], from [channel of the medium][point]."""
    return [list(row) for row in zip(*(media.rows([v[k] for v in values]) for k in range(4)), strict=True)]


def _invert(curve: list, whole: list[mi.Float], front: list[mi.Float], dt: mi.Float, u: mi.Point2f) -> mi.Float:
    """Invert the cumulative distribution of collisions in a piece: the fraction of its length at which it is ``u.y``.

    Where the extinction is rgb, one channel is drawn in proportion to the light that the piece takes from each.
    """
    c, tau = curve[0], whole[0]
    if len(curve) > 1:
        shares = [f * one_minus_exp(w) for f, w in zip(front, whole, strict=True)]
        # u.x has chosen the technique already and u.y is needed below, so the channel is drawn with a third number.
        left = dr.select(sum(shares) > 0, _scramble(u), 0) * sum(shares)
        for k in range(1, len(curve)):
            later = left >= sum(shares[:k])
            c = [dr.select(later, a, b) for a, b in zip(curve[k], c, strict=True)]
            tau = dr.select(later, whole[k], tau)
    goal = _log_share(u.y, tau)
    return invert_cubic_integral(c, dt, goal, tau)


def _scramble(u: mi.Point2f) -> mi.Float:
    """A third number in [0, 1) from the bits of two."""
    return draw_pcg32(mi.UInt32(u.x * (1 << 24)) * mi.UInt32(0x9E3779B9) + mi.UInt32(u.y * (1 << 24)), 1)[1][0]


def _log_share(u: mi.Float, tau: mi.Float) -> mi.Float:
    """-log(1 - u (1 - exp(-tau))): the optical depth at which the fraction u of all collisions within tau has happened."""
    x = u * one_minus_exp(tau)
    series = dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, 1 / 6, 1 / 5), 1 / 4), 1 / 3), 1 / 2), 1)
    return dr.minimum(dr.select(x < 0.05, x * series, -dr.log(dr.maximum(1 - x, 1e-37))), tau)
