r"""Samples of rays in two rounds: strata of equal length, then more where a coarse field has weight.

.. math:: F(k) = \frac{\sum_{i \le k} (w_i + \epsilon)}{\sum_i (w_i + \epsilon)}, \qquad w_i = T_i \alpha_i, \qquad
          t_j = F^{-1}\Big(\frac{j + \xi_j}{n}\Big)

The density of the second round is constant in a stratum, and its numbers are stratified, so both rounds are in order along the
ray and are merged by counting. A merged sample stands for the part of the ray up to the middles between it and its neighbours.
The parts fill the ray's way through the box, so a field of constant density has Beer-Lambert's transmittance.

Conventions. Distances are from the origin of the ray [length]. Rays that miss the box have no samples.

Reference: Mildenhall et al. 2020, section 5.2 (epsilon = 1e-5).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.line_integrals.radiance_field import RayBundle
from mivol.transport.traversal.lattice import Lattice, clip_to_grid
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32

__all__ = ["Strata", "cut_into_strata", "merge_rounds"]

EPSILON = 1e-5
"""Added to each weight, so that no stratum is left out (the published program)."""


@dataclass
class Strata:
    """Equal strata of the rays that cross a box, with a sample in each.

    Attributes:
        number: strata of a ray.
        ray: index of each crossing ray, (m,).
        begin, dt: of each crossing ray, where the first stratum begins, and the length of a stratum [length].
        t: places of the samples, ray by ray (m number,).
        width: number of all rays.
    """

    number: int
    ray: mi.UInt32
    begin: mi.Float
    dt: mi.Float
    t: mi.Float
    width: int

    def packed(self, number: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The ray of each of ``number`` samples a crossing ray, and of every ray its first sample and its number of samples."""
        counts = dr.zeros(mi.UInt32, self.width)
        dr.scatter(counts, dr.opaque(mi.UInt32, number), self.ray)
        own = dr.gather(mi.UInt32, self.ray, dr.arange(mi.UInt32, number * dr.width(self.ray)) // number)
        dr.eval(counts, own)
        return own, dr.prefix_sum(counts), counts


def _jitter(u: float | None, count: int, stream: int) -> mi.Float:
    """Uniform numbers in [0, 1); 1/2 without a seed."""
    if u is None:
        return mi.Float(0.5)
    return draw_pcg32(seed_pcg32(dr.opaque(mi.Float, (u + 0.5 * stream) % 1), count), 1)[1][0]


def cut_into_strata(lattice: Lattice, rays: RayBundle, number: int, u: float | None) -> Strata | None:
    """Cut the way of each ray through the box of a grid into ``number`` strata; None if no ray crosses it.

    Args:
        lattice: the grid.
        rays: world rays, |d| = 1.
        number: strata of a ray.
        u: uniform number in [0, 1), the seed of the places; None: the middles of the strata.
    """
    segment = clip_to_grid(lattice, rays.o, rays.d, mi.Float(0), rays.t_max)
    width = dr.width((rays.o, rays.d))
    length, t0 = segment.length + dr.zeros(mi.Float, width), segment.t0 + dr.zeros(mi.Float, width)
    dr.eval(length, t0)
    ray = dr.compress(length > 0)
    crossing = dr.width(ray)
    if crossing == 0:
        return None
    begin, dt = dr.gather(mi.Float, t0, ray), dr.gather(mi.Float, length, ray) * (1 / number)
    sample = dr.arange(mi.UInt32, crossing * number)
    own = sample // number
    place = mi.Float(sample % number) + _jitter(u, crossing * number, 0)
    t = dr.fma(dr.gather(mi.Float, dt, own), place, dr.gather(mi.Float, begin, own))
    dr.eval(begin, dt, t)
    return Strata(number, ray, begin, dt, t, width)


@dr.syntax
def _accumulate(weights: mi.Float, number: int, rays: int) -> mi.Float:
    """Running sums of the weights of each ray, over their total."""
    lane, k, total = dr.arange(mi.UInt32, rays), mi.UInt32(0), dr.zeros(mi.Float, rays)
    sums = dr.empty(mi.Float, number * rays)
    while dr.hint(k < number, exclude=[sums]):
        total += dr.gather(mi.Float, weights, lane * number + k) + EPSILON
        dr.scatter(sums, total, lane * number + k)
        k += 1
    dr.eval(sums, total)
    return sums / dr.gather(mi.Float, total, dr.arange(mi.UInt32, number * rays) // number)


def merge_rounds(strata: Strata, weights: mi.Float, number: int, u: float | None) -> tuple[mi.Float, mi.Float]:
    """Draw ``number`` more samples of each crossing ray, and merge both rounds.

    Args:
        strata: first round.
        weights: compositing weight of each of its samples.
        number: samples of the second round.
        u: uniform number in [0, 1), the seed of the places; None: evenly.

    Returns:
        Places and lengths of the merged samples, in order along each ray.
    """
    first, rays = strata.number, dr.width(strata.ray)
    share = _accumulate(weights, first, rays)
    dr.eval(share)
    sample = dr.arange(mi.UInt32, rays * number)
    own, j = sample // number, sample % number
    x = (mi.Float(j) + _jitter(u, rays * number, 1)) * (1 / number)

    # -- The stratum in which F reaches x, and the place in it -------------------------------------------------------------
    start = own * first
    at = start + mi.UInt32(dr.binary_search(0, first - 1, lambda k: dr.gather(mi.Float, share, start + mi.UInt32(k)) < x))
    below = dr.select(at > start, dr.gather(mi.Float, share, at - 1, at > start), 0)
    here = dr.gather(mi.Float, share, at) - below
    inside = dr.clip((x - below) / dr.select(here > 0, here, 1), 0, 1)
    begin, dt = dr.gather(mi.Float, strata.begin, own), dr.gather(mi.Float, strata.dt, own)
    t = dr.fma(dt, mi.Float(at - start) + inside, begin)
    dr.eval(t, at)

    # -- Both rounds in order ----------------------------------------------------------------------------------------------
    both = first + number
    merged = dr.empty(mi.Float, rays * both)
    before = (at - start) + dr.select(dr.gather(mi.Float, strata.t, at) <= t, mi.UInt32(1), 0)
    dr.scatter(merged, t, own * both + j + before)
    coarse = dr.arange(mi.UInt32, rays * first)
    ray, k = coarse // first, coarse % first
    # Samples of the second round in front: those whose count of earlier first samples is at most k.
    dr.eval(before)
    low = ray * number
    ahead = mi.UInt32(dr.binary_search(0, number, lambda i: _is_before(before, mi.UInt32(i), number, low, k)))
    dr.scatter(merged, strata.t, ray * both + k + ahead)
    dr.eval(merged)

    # -- The parts of the ray -----------------------------------------------------------------------------------------------
    every = dr.arange(mi.UInt32, rays * both)
    ray, m = every // both, every % both
    low_end, length = dr.gather(mi.Float, strata.begin, ray), dr.gather(mi.Float, strata.dt, ray) * first
    previous = dr.gather(mi.Float, merged, every - 1, m > 0)
    following = dr.gather(mi.Float, merged, every + 1, m + 1 < both)
    left = dr.select(m > 0, 0.5 * (previous + merged), low_end)
    right = dr.select(m + 1 < both, 0.5 * (merged + following), low_end + length)
    dt = dr.maximum(right - left, 0)
    dr.eval(dt)
    return merged, dt


def _is_before(before: mi.UInt32, i: mi.UInt32, number: int, low: mi.UInt32, k: mi.UInt32) -> mi.Bool:
    """Whether sample i of a ray's ``number`` in the second round, from ``low`` on, lies in front of sample k of the first."""
    within = i < number
    return within & (dr.gather(mi.UInt32, before, low + i, within) <= k)
