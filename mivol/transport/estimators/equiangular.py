"""Equiangular sampling: distances along a ray, evenly in the angle at which an emitter sees them.

References: Kulla & Fajardo 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = ["EquiangularSampler", "equiangular_sampler", "equiangular_towards"]


def equiangular_sampler(ray: mi.Ray3f, ball: list[mi.Float] | None) -> EquiangularSampler | None:
    """One lamp as seen from rays; None where it is at infinity."""
    if ball is None:
        return None
    x, y, z, r = ball
    return equiangular_towards(ray, mi.Point3f(x, y, z), dr.square(r), mi.Bool(True))


def equiangular_towards(ray: mi.Ray3f, centre: mi.Point3f, radius2: mi.Float, finite: mi.Bool) -> EquiangularSampler:
    """The sampler of rays towards a ball about ``centre``, for the lanes whose emitter is ``finite``."""
    away = centre - ray.o
    t0 = dr.dot(away, ray.d)
    h2 = dr.squared_norm(away - t0 * ray.d)
    # A ray through a point light sees it at distance 0; 1e-4 of the way there keeps the angle in float32. It is a density.
    rho = dr.sqrt(h2 + radius2 + 1e-8 * dr.squared_norm(away) + 1e-30)
    return EquiangularSampler(t0, dr.select(finite, rho, 1), finite)


@dataclass
class EquiangularSampler:
    """A lamp as seen from a ray: it is nearest at ``t0``, at the distance ``rho``; both count where ``finite``."""

    t0: mi.Float
    rho: mi.Float
    finite: mi.Bool

    def angle(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """The angle that [a, a + dt] fills: not a difference of two, which is 0 far away."""
        near, far = a - self.t0, (a - self.t0) + dt
        return dr.atan2(self.rho * dt, dr.fma(near, far, dr.square(self.rho)))

    def mean(self, a: mi.Float, dt: mi.Float) -> mi.Float:
        """Mean of 1 / (rho^2 + (t - t0)^2) over [a, a + dt]; 1 where the lamp is at infinity."""
        return dr.select(self.finite, self.angle(a, dt) * dr.rcp(self.rho * dt), 1)

    def sample(self, a: mi.Float, dt: mi.Float, u: mi.Float) -> mi.Float:
        """Distance from ``a`` at the share ``u`` of the angle, from the addition theorem of the tangent."""
        x = (a - self.t0) / self.rho
        sin, cos = dr.sincos(u * self.angle(a, dt))
        return dr.clip(self.rho * sin * dr.fma(x, x, 1) / dr.fma(-x, sin, cos), 0, dt)

    def density(self, a: mi.Float, dt: mi.Float, t: mi.Float) -> mi.Float:
        """Density of :meth:`sample` at a distance ``t`` from ``a`` [1/length]."""
        r2 = dr.square(self.rho) + dr.square((a - self.t0) + t)
        return self.rho * dr.rcp(r2 * self.angle(a, dt))
