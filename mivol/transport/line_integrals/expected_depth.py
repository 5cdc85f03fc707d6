r"""Expected depth: the mean distance at which a ray is stopped, with its tangent and its transpose.

.. math:: N = \int t\,\sigma T\,dt + t_s T_s, \quad N_{cell} = a \alpha + \Delta \Big(\int_0^1 e^{-\tau(u)} du - e^{-\tau}\Big)

The expected depth is N over the opacity. In a cell [a, a + D] three Gauss points give the optical depth, and the first and
second Legendre moments (slope B and bend G) of the extinction. The transmittance T = exp(-tau u) exp(B (u - u^2) - G (2 u^3 - 3
u^2 + u)) is expanded in these, to second order in B and first order in G, about a cell of constant extinction with the same
optical depth:

.. math:: N_{cell} = a\,\alpha + \Delta \Big(\tau E_1 + B (E_1 - E_2) + \frac{B^2}{2} (E_2 - 2 E_3 + E_4)
          - G (E_1 - 3 E_2 + 2 E_3)\Big)

with E_n(tau) from :mod:`mivol.numerics`. This is exact for a thin cell of any (cubic) extinction, and for a constant extinction
at any optical depth, so a region of constant extinction is one cell of any length; else the error falls as D^6. Nothing is
divided by a transmittance or by an extinction, so derivatives are finite everywhere.

Conventions. Distances are counted from ``origin``. With the expected depth itself as origin N is 0, so the derivative of the
quotient N / alpha is that of N over alpha.

References: Max 1995 (the integral, with distance as the source); Abramowitz & Stegun 25.4.30 (Gauss points).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.numerics import exp_moments, one_minus_exp
from mivol.transport.line_integrals.composite import composite_ray, vjp_composite
from mivol.transport.line_integrals.integrand import LineIntegral, RayPiece
from mivol.transport.media.compositing import CellIntegral
from mivol.transport.media.ray_intervals import RaySegment, SegmentEnd
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["integrate_distance_in_cell", "integrate_expected_depth", "jvp_expected_depth", "vjp_expected_depth"]


SPREAD = math.sqrt(15) / 10
"""Distance of the outer Gauss points from the middle of [0, 1]; with the weights 5/18, 8/18, 5/18 exact to degree 5."""

BLACK = 1000.0
"""Stands for an infinite optical depth: exp(-1000) is 0, and in float64 1000 + x - 1000 is x again, to 1e-13."""


def integrate_distance_in_cell(a: mi.Float, dt: mi.Float, near: mi.Float, middle: mi.Float, far: mi.Float) -> CellIntegral:
    """Integrate t sigma T over a cell.

    Args:
        a: distance of its near end [length].
        dt: its length [length], finite.
        near, middle, far: extinction [1/length] at its three Gauss points.

    Bias: none for a thin cell or a constant extinction; O(dt^7) for a smooth one; at most about the length of the cell where
        the extinction changes strongly within a cell of large optical depth.
    """
    sides = near + far
    tau = dt * dr.fma(sides, 5 / 18, middle * (8 / 18))
    slope = dt * (math.sqrt(15) / 6) * (far - near)
    bend = dt * (5 / 9) * dr.fma(middle, -2, sides)
    T = dr.exp(-tau)
    e0, e1, e2, e3, e4, e5 = exp_moments(tau)
    by_slope, by_bend = e1 - e2, -(e1 - 3 * e2 + 2 * e3)
    twice = e2 - 2 * e3 + e4
    mean = tau * e1 + slope * (by_slope + 0.5 * slope * twice) + bend * by_bend
    by_tau = T - e1 - slope * (e2 - e3 + 0.5 * slope * (e3 - 2 * e4 + e5)) + bend * (e2 - 3 * e3 + 2 * e4)
    by_slope += slope * twice

    straight = dt * dr.fma(a, T, dt * by_tau)
    lean, bow = dt * dt * (math.sqrt(15) / 6) * by_slope, dt * dt * (5 / 9) * by_bend
    dN = [straight * (5 / 18) - lean + bow, straight * (8 / 18) - 2 * bow, straight * (5 / 18) + lean + bow]
    return CellIntegral(tau, T, dr.fma(a, tau * e0, dt * mean), [dt * (5 / 18), dt * (8 / 18), dt * (5 / 18)], dN)


def _integrate_in_constant(site: RayPiece, origin: mi.Float, sigma: mi.Float) -> CellIntegral:
    """Integrate over constant extinction of any length.

    For an infinite length N = a + 1/sigma. There is no expected depth for extinction 0; N and its derivative are then 0.
    """
    begin = dr.select(site.on, site.a - origin, 0)
    finite = dr.isfinite(site.dt)
    integral = integrate_distance_in_cell(begin, dr.select(finite, site.dt, 0), sigma, sigma, sigma)
    endless = site.on & ~finite & (sigma > 0)
    mean = dr.rcp(dr.select(endless, sigma, 1))
    return CellIntegral(
        dr.select(endless, BLACK, integral.tau),
        dr.select(endless, 0, integral.T),
        dr.select(endless, begin + mean, integral.N),
        [sum(integral.dtau, mi.Float(0))],
        [dr.select(endless, -dr.square(mean), sum(integral.dN, mi.Float(0)))],
    )


@dataclass
class _ExpectedDepth:
    """The integrand of expected depth: distances counted from ``origin``, a row for each channel."""

    rows: int
    origin: mi.Float
    points: ClassVar[tuple[float, ...]] = (0.5 - SPREAD, 0.5, 0.5 + SPREAD)
    asked: ClassVar[str] = "the AOV depth was asked for"
    way_out: ClassVar[str] = "leave depth out of aovs"

    def cell(self, site: RayPiece, sigma: list[list[mi.Float]]) -> list[CellIntegral]:
        return [integrate_distance_in_cell(site.a - self.origin, site.dt, *row) for row in sigma]

    def constant(self, site: RayPiece, sigma: list[mi.Float]) -> list[CellIntegral]:
        return [_integrate_in_constant(site, self.origin, s) for s in sigma]

    def vjp(self, site: RayPiece, sigma: list[list[mi.Float]], weight: list[mi.Float]) -> None:
        """Do nothing: N depends on the extinction only."""

    def jvp(self, site: RayPiece, sigma: list[list[mi.Float]]) -> list[mi.Float]:
        return [mi.Float(0) for _ in range(self.rows)]

    def least(self, t1: mi.Float) -> mi.Float:
        return dr.minimum(t1 - self.origin, 0)

    def end(self, end: SegmentEnd) -> list[mi.Float]:
        """What the opaque surface at the end of a ray adds, by itself."""
        return [dr.select(end.si.is_valid(), end.t - self.origin, 0)] * self.rows


def integrate_expected_depth(
    media: SceneMedia, ray_segment: RaySegment, end: SegmentEnd, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:
    """Integrate the distance at which a ray is stopped, mean over channels.

    Args:
        media: of the scene.
        ray_segment: the ray, the medium around its origin, and how far it goes; world space, unit direction.
        end: where it ends, possibly at an opaque surface.
        active: lanes to integrate.

    Returns:
        N [length], the expected depth times the opacity, and that opacity [1]. The opacity is that of the optical depth in N:
        with a radiance field it differs a little from ``alpha``, since an activated extinction depends on the points of a cell.

    Raises:
        MivolError: a medium that sums grids of two resolutions or places.

    Bias: that of :func:`integrate_distance_in_cell`. Cost: a walk of each body.
    """
    integrand = _ExpectedDepth(media.channels, mi.Float(0))
    composite = composite_ray(LineIntegral(media, integrand, ray_segment, active), integrand.end(end), skip=True)
    alpha = [dr.select(end.si.is_valid(), 1, one_minus_exp(mi.Float(t))) for t in composite.tau]
    return _mean(composite.N), _mean(alpha)


def jvp_expected_depth(
    media: SceneMedia, ray_segment: RaySegment, end: SegmentEnd, origin: mi.Float, active: mi.Bool
) -> mi.Float:
    """Tangent of N, with distances counted from ``origin``, from the tangents that the media took from the parameters.

    Args:
        media, ray_segment, end, active: as :func:`integrate_expected_depth`.
        origin: the expected depth; the result over the opacity is then its tangent.
    """
    integrand = _ExpectedDepth(media.channels, origin)
    line = LineIntegral(media, integrand, ray_segment, active)
    return _mean(composite_ray(line, integrand.end(end), tangent=True).N[media.channels :])


def vjp_expected_depth(
    media: SceneMedia, ray_segment: RaySegment, end: SegmentEnd, origin: mi.Float, weight: mi.Float, active: mi.Bool
) -> None:
    """Add ``weight`` (d loss / d N) times the derivative of N to the gradients of the media: the transpose of the tangent.

    Args:
        media, ray_segment, end, active: as :func:`integrate_expected_depth`.
        origin: the expected depth, as in :func:`jvp_expected_depth`.
        weight: of each lane.

    Cost: two walks of each body, and one packed write of 8 a cell and channel.
    """
    k = media.channels
    integrand = _ExpectedDepth(k, origin)
    line = LineIntegral(media, integrand, ray_segment, active)
    vjp_composite(line, composite_ray(line, integrand.end(end)), [weight / k] * k, [mi.Float(0)] * k)


def _mean(rows: list[mi.Float]) -> mi.Float:
    return sum(rows[1:], rows[0]) / len(rows)
