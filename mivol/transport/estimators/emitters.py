"""The emitters of a scene, how their light is to be found, and the choice of one of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.estimators.equiangular import EquiangularSampler, equiangular_towards
from mivol.transport.estimators.event_samples import EventSamples
from mivol.transport.traversal.strata import Strata

__all__ = ["UNIFORM", "ChosenEmitter", "SceneEmitters", "is_among"]


UNIFORM = "ConstantBackgroundEmitter"


class SceneEmitters:
    """The emitters of a scene, and how their light is to be found.

    Args:
        scene: Mitsuba's scene.

    Attributes:
        sampled: emitters that directions are drawn towards, all alike: all but a constant background.
        transmissive: emitters on surfaces that let light pass undeviated.
        samples_phase: directions are drawn from the phase function too, since some emitter can be met by chance.
    """

    def __init__(self, scene: mi.Scene) -> None:
        emitters = scene.emitters()
        delta = int(mi.EmitterFlags.Delta)
        self.sampled = [e for e in emitters if e.class_name() != UNIFORM]
        self.transmissive = [e for e in self.sampled if _is_transmissive(e)]
        met = [e for e in emitters if not any(e is emitter for emitter in self.transmissive)]
        self.samples_phase = any(not int(e.flags()) & delta for e in met)
        balls = [_ball(e) for e in self.sampled]
        self.is_near = any(b is not None for b in balls)
        self._balls = [None if b is None else [dr.opaque(mi.Float, v) for v in b] for b in balls]

    def bounding_ball(self, number: int) -> list[mi.Float] | None:
        """Centre and radius of a lamp that directions are drawn towards; None for one at infinity."""
        return self._balls[number]

    def draw_samples(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None = None) -> EventSamples:
        """Draw the numbers of one event, and note the strata of a pass, where it has some, for directions."""
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

    def choose(self, ray: mi.Ray3f, u: mi.Float) -> ChosenEmitter:
        """Draw a lamp, each with the same probability."""
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
    """Centre and radius of an emitter; None for one at infinity."""
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
    """The lamp that was drawn for each lane: its number, the emitter, and where it is (None: all are at infinity)."""

    number: mi.UInt32
    emitter: mi.EmitterPtr
    equiangular: EquiangularSampler | None
