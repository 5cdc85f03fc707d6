"""Equiangular sampling: distances along a ray, uniform in the angle at which an emitter sees them.

References: Kulla & Fajardo 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.transport.traversal.fine_ray import Ray

__all__ = ["EquiangularSampler", "equiangular_sampler", "equiangular_towards"]


def equiangular_sampler(ray: Ray, ball: list[mi.Float] | None) -> EquiangularSampler | None:
    """The sampler towards one emitter, a ball (x, y, z, radius); None where that is at infinity (no ball)."""
    if ball is None:
        return None
    x, y, z, r = ball
    return equiangular_towards(ray, mi.Point3f(x, y, z), dr.square(r), mi.Bool(True))


def equiangular_towards(ray: Ray, centre: mi.Point3f, radius2: mi.Float, finite: mi.Bool) -> EquiangularSampler:
    """The sampler of rays towards a ball about ``centre``, for the lanes whose emitter is ``finite``."""
    away = centre - mi.Point3f(ray.o)
    t0 = dr.dot(away, ray.d)
    h2 = dr.squared_norm(away - t0 * ray.d)
    # The distance of the ray from a point light may be 0. It is bounded below by 1e-4 of the distance to the light, so that the
    # angle stays in the range of float32. That changes the density only, and with it the variance, but no mean.
    rho = dr.sqrt(h2 + radius2 + 1e-8 * dr.squared_norm(away) + 1e-30)
    return EquiangularSampler(t0, dr.select(finite, rho, 1), finite)


@dataclass
class EquiangularSampler:
    """Equiangular sampling towards one emitter.

    Attributes:
        t0: distance along the ray at which the emitter is nearest [length].
        rho: distance from the ray to the emitter there [length].
        finite: lanes whose emitter is not at infinity; in the others ``t0`` and ``rho`` mean nothing.
    """

    t0: mi.Float
    rho: mi.Float
    finite: mi.Bool

    def angle(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """The angle [rad] under which [a, a + dt] is seen; a difference of two arctangents would cancel to 0 far away."""
        near, far = a - self.t0, (a - self.t0) + dt
        return dr.atan2(self.rho * dt, dr.fma(near, far, dr.square(self.rho)))

    def mean(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """Mean of 1 / (rho^2 + (t - t0)^2) over [a, a + dt]; 1 where the emitter is at infinity."""
        return dr.select(self.finite, self.angle(a, dt) * dr.rcp(self.rho * dt), 1)

    def sample(self, a: mi.Float, dt: mi.Float, u: mi.Float) -> mi.Float:
        """Distance from ``a`` [length] at the fraction ``u`` of the angle, by the addition theorem of the tangent."""
        x = (a - self.t0) / self.rho
        sin, cos = dr.sincos(u * self.angle(a, dt))
        return dr.clip(self.rho * sin * dr.fma(x, x, 1) / dr.fma(-x, sin, cos), 0, dt)

    def density(self, a: mi.Float, dt: mi.Float, t: mi.Float) -> mi.Float:
        """Density of :meth:`sample` at a distance ``t`` from ``a`` [1/length]."""
        r2 = dr.square(self.rho) + dr.square((a - self.t0) + t)
        return self.rho * dr.rcp(r2 * self.angle(a, dt))
