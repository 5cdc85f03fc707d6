r"""Derivatives of paths that branch where they first collide.

.. math:: L = \frac{1}{k} \sum_{j=1}^{k} L_j

A path is walked as a stem, from the camera to its first collision, and k branches from there to its end, whose mean is the
radiance that the stem finds. Many camera rays pass a volume without a collision: they have only a stem, and most noise of a
gradient is that of the few branches. These lie side by side, in the order of their lengths once those are known, so that few
lanes wait for their neighbours.

With the noise A of stems and B of a branch, at the costs a and b, A + B / k at the cost a + b k is best with
k = sqrt(B a / (A b)), and b is in proportion to the share of stems that collide.

Bias: none. Memory: some 40 numbers a branch; there are at most as many as stems.

References: Arvo & Kirk 1990 (splitting); Vicini et al. 2021 (path replay).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.path.estimators import Estimators
from mivol.transport.path.film import CameraRays
from mivol.transport.path.scores import Primal, Replay
from mivol.transport.path.settings import Settings
from mivol.transport.path.successive import values_at
from mivol.transport.path.walk import Landing, walk_branch, walk_stem
from mivol.transport.traversal.fine_ray import FineRay
from mivol.transport.traversal.random_numbers import LaneSampler, draw_seeds

__all__ = ["count_branches", "replay_branches"]

MOST = 4
"""Branches of a path."""

BALANCE = 0.6
"""(B a) / (A b), times the share of stems that collide: for a share of 0.17 two branches, for more than 0.27 one. (Smoke and a
cloud of that share: three have the least variance x time over voxels with sigma_t >= 1, one over empty voxels.)"""

LONGEST = np.uint16(0xFFFF)
"""Scatterings of a path, as far as its place in the order of lengths goes."""


def count_branches(stems: int, collided: int) -> int:
    """How many branches a path has, of as many stems of which some have collided."""
    return min(MOST, max(1, round(math.sqrt(BALANCE * stems / collided))))


def replay_branches(estimators: Estimators, settings: Settings, rays: CameraRays, dL: mi.Spectrum) -> None:
    """Add the derivatives of the radiance along camera rays to gradients.

    Args:
        estimators: whose segments end in media, prepared for derivatives along these rays.
        settings: depth, roulette, hidden emitters.
        rays: of a sampler whose numbers are independent.
        dL: d loss / d radiance of each ray.
    """
    n, sampler = dr.width(rays.ray), rays.sampler
    seeds = draw_seeds(sampler)
    again, replayed = sampler.clone(), estimators.replayed()
    stems, landing = walk_stem(replayed, settings, sampler, rays.ray, Primal(dr.zeros(mi.Spectrum, n)))
    dr.eval(seeds, stems.L, landing)
    collided = dr.compress(landing.on)
    if (count := dr.width(collided)) == 0:
        walk_stem(estimators, settings, again, rays.ray, Replay(stems.L, dL))
        return
    k = count_branches(n, count)
    share, branches = dr.opaque(mi.Float, 1 / k), _Branches.of(landing, collided, seeds, k)
    found, depth = branches.walk(replayed, settings, Primal(dr.zeros(mi.Spectrum, count * k)))
    dr.eval(found.L, depth)
    for total, one in zip(stems.L, found.L, strict=True):
        dr.scatter_add(total, one * share, branches.stem)
    walk_stem(estimators, settings, again, rays.ray, Replay(stems.L, dL))
    level = estimators.segment.level
    estimators.segment.level = None if level is None else level.of_branches
    order = _by_length(depth)
    branches = branches.at(order)
    L, dL = dr.gather(mi.Spectrum, found.L, order), dr.gather(mi.Spectrum, dL, branches.stem)
    branches.walk(estimators, settings, Replay(L, dL * share))


@dataclass
class _Branches:
    """Branches of paths.

    Attributes:
        stem: the numbers of their stems.
        landing: where these have collided.
        seeds: of the random numbers, and the number of their sequence.
    """

    stem: mi.UInt32
    landing: Landing
    seeds: tuple[mi.UInt32, mi.UInt32, mi.UInt32]

    @classmethod
    def of(cls, landing: Landing, collided: mi.UInt32, seeds: tuple[mi.UInt32, mi.UInt32], k: int) -> _Branches:
        """So many branches of each stem that has collided, side by side."""
        number = dr.arange(mi.UInt32, dr.width(collided) * k)
        stem = dr.gather(mi.UInt32, collided, number // dr.opaque(mi.UInt32, k))
        a, b = (dr.gather(mi.UInt32, seed, stem) for seed in seeds)
        # The branches of a stem differ in their number only: a hash of it is the state, or their numbers would resemble each
        # other.
        found = cls(stem, _gather_landing(landing, stem), (*mi.sample_tea_32(a ^ (b << 8), number), number))
        dr.eval(found)
        return found

    def at(self, order: mi.UInt32) -> _Branches:
        """The branches in another order."""
        stem, *seeds = (dr.gather(mi.UInt32, values, order) for values in (self.stem, *self.seeds))
        found = _Branches(stem, _gather_landing(self.landing, order), tuple(seeds))
        dr.eval(found)
        return found

    def walk(self, estimators: Estimators, settings: Settings, score: Primal | Replay) -> tuple[Primal | Replay, mi.UInt32]:
        """Walk them to their ends; the score, and how often each has scattered."""
        return walk_branch(estimators, settings, LaneSampler.seeded(*self.seeds), self.landing, score)


def _gather_landing(landing: Landing, index: mi.UInt32) -> Landing:
    """The collisions with these numbers."""
    ray = landing.ray
    o, d, maxt, time = (values_at(values, index) for values in (ray.o, ray.d, ray.maxt, ray.time))
    t, body, beta, on = (values_at(values, index) for values in (landing.t, landing.body, landing.beta, landing.on))
    return Landing(FineRay(o, d, maxt, time, ray.wavelengths), t, body, beta, on)


def _by_length(depth: mi.UInt32) -> mi.UInt32:
    """The numbers of paths in the order of their lengths, the longest first."""
    # Numbers of 16 bits are sorted in a time that is linear in their count; longer paths are too few to be told apart.
    shortness = LONGEST - np.minimum(depth.numpy(), LONGEST).astype(np.uint16)
    return mi.UInt32(np.argsort(shortness, kind="stable"))
