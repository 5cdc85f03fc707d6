"""The emitters of a scene: which of them are sampled by direction, which by the phase function, and the choice of one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.estimators.equiangular import EquiangularSampler, equiangular_towards
from mivol.transport.estimators.event_samples import EventSamples
from mivol.transport.traversal.fine_ray import Ray
from mivol.transport.traversal.strata import Strata

__all__ = ["UNIFORM", "ChosenEmitter", "SceneEmitters", "is_among"]


UNIFORM = "ConstantBackgroundEmitter"
"""Mitsuba's class of an environment that is the same in all directions; phase samples alone find its light."""


class SceneEmitters:
    """The emitters of a scene, and by which samples their light is found.

    Args:
        scene: Mitsuba's scene.

    Attributes:
        sampled: emitters that next-event estimation chooses from with equal probabilities: all but a constant environment.
        transmissive: emitters on surfaces that transmit part of the light undeviated.
        samples_phase: directions are drawn from the phase function too, since they can hit some emitter.
        is_near: some emitter has a finite distance.
    """

    def __init__(self, scene: mi.Scene) -> None:
        emitters = scene.emitters()
        delta = int(mi.EmitterFlags.Delta)
        self.sampled = [e for e in emitters if e.class_name() != UNIFORM]
        self.transmissive = [e for e in self.sampled if _is_transmissive(e)]
        opaque = [e for e in emitters if not any(e is emitter for emitter in self.transmissive)]
        self.samples_phase = any(not int(e.flags()) & delta for e in opaque)
        balls = [_ball(e) for e in self.sampled]
        self.is_near = any(b is not None for b in balls)
        self._balls = [None if b is None else [dr.opaque(mi.Float, v) for v in b] for b in balls]

    def bounding_ball(self, number: int) -> list[mi.Float] | None:
        """Centre and radius of one of the ``sampled`` emitters; None for one at infinity."""
        return self._balls[number]

    def draw_samples(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None = None) -> EventSamples:
        """Draw the random numbers of one scattering event from a sampler."""
        return EventSamples(
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            sampler.next_2d(active),
            sampler.next_1d(active),
            strata,
        )

    def choose(self, ray: Ray, u: mi.Float) -> ChosenEmitter:
        """Choose one of the ``sampled`` emitters for each lane, with equal probabilities, by a number in [0, 1)."""
        n, width = len(self.sampled), dr.width(ray)
        index = dr.minimum(mi.UInt32(u * n), max(n - 1, 0))
        emitter = dr.zeros(mi.EmitterPtr, width)
        centre, radius2, finite = mi.Point3f(0), mi.Float(0), mi.Bool(False)
        for k, (candidate, ball) in enumerate(zip(self.sampled, self._balls, strict=True)):
            here = index == k
            emitter = dr.select(here, mi.EmitterPtr(candidate), emitter)
            if ball is not None:
                x, y, z, r = ball
                centre = dr.select(here, mi.Point3f(x, y, z), centre)
                radius2, finite = dr.select(here, dr.square(r), radius2), here | finite
        return ChosenEmitter(index, emitter, equiangular_towards(ray, centre, radius2, finite) if self.is_near else None)


def _is_transmissive(emitter: mi.Emitter) -> bool:
    shape = emitter.get_shape()
    return shape is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)


def _ball(emitter: mi.Emitter) -> list[float] | None:
    """Centre of an emitter's bounding box, and the root mean square distance of points in it; None for one at infinity."""
    box = emitter.get_shape().bbox() if emitter.get_shape() is not None else emitter.bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    if emitter.is_environment() or not np.isfinite([low, high]).all() or (high < low).any():
        return None
    return [*((low + high) / 2), float(np.linalg.norm(high - low) / math.sqrt(12))]


def is_among(emitters: list[mi.Emitter], emitter: mi.EmitterPtr) -> mi.Bool:
    """Whether the emitter of each lane is one of a list."""
    found = mi.Bool(False)
    for candidate in emitters:
        found |= emitter == mi.EmitterPtr(candidate)
    return found


@dataclass
class ChosenEmitter:
    """The emitter that was chosen for each lane.

    Attributes:
        number: its index among the sampled ones.
        emitter: Mitsuba's object.
        equiangular: sampler of distances seen from it; None where all emitters are at infinity.
    """

    number: mi.UInt32
    emitter: mi.EmitterPtr
    equiangular: EquiangularSampler | None
