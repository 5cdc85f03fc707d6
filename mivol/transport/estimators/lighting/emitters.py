"""The emitters of a scene, the choice of an emitter for each lane, and the random numbers and distances of samples towards it.

Equiangular sampling draws distances along a ray uniformly in the angle seen from an emitter.

References: Kulla & Fajardo 2012 (equiangular sampling).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.traversal.random_numbers import Strata
from mivol.transport.traversal.rays import Ray

__all__ = [
    "UNIFORM_EMITTER",
    "ChosenEmitter",
    "SceneEmitters",
    "fractional_part",
    "is_among",
    "EventSamples",
    "EquiangularSampler",
    "make_ball_sampler",
    "make_equiangular_sampler",
]


UNIFORM_EMITTER = "ConstantBackgroundEmitter"
"""Mitsuba's class of a constant environment, whose light is found by phase samples alone."""


class SceneEmitters:
    """The emitters of a scene, and the samples by which their light is found.

    Args:
        scene: Mitsuba's scene.

    Attributes:
        sampled: emitters that next-event estimation chooses from with equal probabilities: all except a constant environment.
        transmissive: emitters on surfaces that transmit part of the light without deviation.
        samples_phase: phase functions are sampled too, since their directions can hit an emitter.
        is_near: some emitter has a finite distance.
    """

    def __init__(self, scene: mi.Scene) -> None:
        emitters = scene.emitters()
        delta = int(mi.EmitterFlags.Delta)
        self.sampled = [e for e in emitters if e.class_name() != UNIFORM_EMITTER]
        self.transmissive = [e for e in self.sampled if _is_transmissive(e)]
        opaque = [e for e in emitters if not any(e is emitter for emitter in self.transmissive)]
        self.samples_phase = any(not int(e.flags()) & delta for e in opaque)
        balls = [_find_bounding_ball(e) for e in self.sampled]
        self.is_near = any(b is not None for b in balls)
        self._balls = [None if b is None else [dr.opaque(mi.Float, v) for v in b] for b in balls]

    def bounding_ball(self, number: int) -> list[mi.Float] | None:
        """Centre and radius of a ``sampled`` emitter [length]; None if the emitter is at infinity."""
        return self._balls[number]

    def draw_event_samples(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None = None) -> EventSamples:
        """Draw the random numbers of a scattering event."""
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

    def choose_emitter(self, ray: Ray, u: mi.Float) -> ChosenEmitter:
        """Choose one of the ``sampled`` emitters for each lane with equal probabilities, by ``u`` in [0, 1)."""
        n, width = len(self.sampled), dr.width(ray)
        index = dr.minimum(mi.UInt32(u * n), max(n - 1, 0))
        emitter = dr.zeros(mi.EmitterPtr, width)
        centre, radius2, finite = mi.Point3f(0), mi.Float(0), mi.Bool(False)
        for k, (candidate, ball) in enumerate(zip(self.sampled, self._balls, strict=True)):
            is_chosen = index == k
            emitter = dr.select(is_chosen, mi.EmitterPtr(candidate), emitter)
            if ball is not None:
                x, y, z, r = ball
                centre = dr.select(is_chosen, mi.Point3f(x, y, z), centre)
                radius2, finite = dr.select(is_chosen, dr.square(r), radius2), is_chosen | finite
        return ChosenEmitter(index, emitter, make_equiangular_sampler(ray, centre, radius2, finite) if self.is_near else None)


def _is_transmissive(emitter: mi.Emitter) -> bool:
    shape = emitter.get_shape()
    return shape is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null)


def _find_bounding_ball(emitter: mi.Emitter) -> list[float] | None:
    """Centre of an emitter's bounding box, and root mean square distance of its points [length]; None for an emitter at
    infinity.
    """
    box = emitter.get_shape().bbox() if emitter.get_shape() is not None else emitter.bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    if emitter.is_environment() or not np.isfinite([low, high]).all() or (high < low).any():
        return None
    return [*((low + high) / 2), float(np.linalg.norm(high - low) / math.sqrt(12))]


def is_among(emitters: list[mi.Emitter], emitter: mi.EmitterPtr) -> mi.Bool:
    """Whether the emitter of each lane is in a list."""
    is_listed = mi.Bool(False)
    for candidate in emitters:
        is_listed |= emitter == mi.EmitterPtr(candidate)
    return is_listed


@dataclass
class ChosenEmitter:
    """The emitter chosen for each lane.

    Attributes:
        number: index in ``SceneEmitters.sampled``.
        emitter: Mitsuba's emitter.
        equiangular: sampler of distances by the angle seen from the emitter; None if all emitters are at infinity.
    """

    number: mi.UInt32
    emitter: mi.EmitterPtr
    equiangular: EquiangularSampler | None


@dataclass
class EventSamples:
    """The random numbers of a scattering event, uniform in [0, 1).

    Attributes:
        piece: seed of the reservoir choosing a piece of the ray.
        inside: numbers for the technique of distance sampling, and for the distance inside the piece.
        which_emitter: number for the emitter.
        emitter: numbers for the point or direction on the emitter.
        component: number for the component of the phase function.
        direction: numbers for the direction of the phase sample.
        which_shadow_ray: number for the differentiated shadow ray.
        strata: strata of directions; None means the whole square.
    """

    piece: mi.Float
    inside: mi.Point2f
    which_emitter: mi.Float
    emitter: mi.Point2f
    component: mi.Float
    direction: mi.Point2f
    which_shadow_ray: mi.Float
    strata: Strata | None = None

    def for_event(self, number: mi.UInt32, count: int) -> EventSamples:
        """The numbers of one of ``count`` events on a ray.

        An additive recurrence shifts the numbers of the first event; directions are stratified over the events.
        """
        if count == 1:
            return self.with_directions(self.emitter, self.direction)
        # Additive recurrences with the generalised golden ratios have low discrepancy in one and two dimensions (Roberts 2018).
        k, across = mi.Float(number), max(a for a in range(1, int(count**0.5) + 1) if count % a == 0)
        part = Strata(number, across, count // across)

        def one(u: mi.Float) -> mi.Float:
            return fractional_part(dr.fma(k, 0.6180339887, u))

        def two(u: mi.Point2f) -> mi.Point2f:
            return mi.Point2f(fractional_part(dr.fma(k, 0.7548776662, u.x)), fractional_part(dr.fma(k, 0.5698402910, u.y)))

        moved = EventSamples(
            self.piece,
            two(self.inside),
            self.which_emitter,
            self.emitter,
            one(self.component),
            self.direction,
            one(self.which_shadow_ray),
            self.strata,
        )
        return moved.with_directions(part.jitter(two(self.emitter)), part.jitter(two(self.direction)))

    def with_directions(self, emitter: mi.Point2f, direction: mi.Point2f) -> EventSamples:
        """The same numbers with others for directions, which are moved into their strata."""
        if self.strata is not None:
            emitter, direction = self.strata.jitter(emitter), self.strata.jitter(direction)
        return replace(self, emitter=emitter, direction=direction, strata=None)


def fractional_part(x: mi.Float) -> mi.Float:
    """x - floor(x), in [0, 1)."""
    return x - dr.floor(x)


def make_ball_sampler(ray: Ray, ball: list[mi.Float] | None) -> EquiangularSampler | None:
    """Make the sampler towards an emitter by its bounding ball (x, y, z, radius) [length]; None if the emitter is at
    infinity."""
    if ball is None:
        return None
    x, y, z, r = ball
    return make_equiangular_sampler(ray, mi.Point3f(x, y, z), dr.square(r), mi.Bool(True))


def make_equiangular_sampler(ray: Ray, centre: mi.Point3f, radius2: mi.Float, finite: mi.Bool) -> EquiangularSampler:
    """Make the sampler towards a ball about ``centre``, for lanes with an emitter at a ``finite`` distance."""
    away = centre - mi.Point3f(ray.o)
    t0 = dr.dot(away, ray.d)
    h2 = dr.squared_norm(away - t0 * ray.d)
    # A ray may pass through a point light. The distance is at least 1e-4 of the distance to the light, so the angle stays in
    # the range of float32. The bound changes the density, and with it the variance, but no mean.
    rho = dr.sqrt(h2 + radius2 + 1e-8 * dr.squared_norm(away) + 1e-30)
    return EquiangularSampler(t0, dr.select(finite, rho, 1), finite)


@dataclass
class EquiangularSampler:
    """Equiangular sampling towards one emitter.

    Attributes:
        t0: distance along the ray at which the emitter is nearest [length].
        rho: distance from the ray to the emitter at ``t0`` [length].
        finite: lanes with an emitter at a finite distance; ``t0`` and ``rho`` have no meaning in other lanes.
    """

    t0: mi.Float
    rho: mi.Float
    finite: mi.Bool

    def angle(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """The angle of [a, a + dt] seen from the emitter [rad]; a difference of two arctangents would cancel to 0 far away."""
        near, far = a - self.t0, (a - self.t0) + dt
        return dr.atan2(self.rho * dt, dr.fma(near, far, dr.square(self.rho)))

    def mean(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """Mean of 1 / (rho^2 + (t - t0)^2) over [a, a + dt] [1/length^2]; 1 for an emitter at infinity."""
        return dr.select(self.finite, self.angle(a, dt) * dr.rcp(self.rho * dt), 1)

    def sample(self, a: mi.Float, dt: mi.Float, u: mi.Float) -> mi.Float:
        """Distance from ``a`` at the fraction ``u`` of the angle [length], by the addition theorem of the tangent."""
        x = (a - self.t0) / self.rho
        sin, cos = dr.sincos(u * self.angle(a, dt))
        return dr.clip(self.rho * sin * dr.fma(x, x, 1) / dr.fma(-x, sin, cos), 0, dt)

    def density(self, a: mi.Float, dt: mi.Float, t: mi.Float) -> mi.Float:
        """Density of :meth:`sample` at the distance ``t`` from ``a`` [1/length]."""
        r2 = dr.square(self.rho) + dr.square((a - self.t0) + t)
        return self.rho * dr.rcp(r2 * self.angle(a, dt))
