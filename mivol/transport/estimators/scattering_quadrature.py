r"""Single scattering without noise: quadrature along the camera's ray, for lamps of one position or direction.

.. math:: \int_a^b T \sigma c\,dt \approx \frac{\Delta}{2}\,\kappa\,(w_1 c_1 + w_2 c_2), \qquad
          w_q = \sigma_q e^{-\tau_q}, \quad \kappa = \frac{\varphi_1(\tau)(\sigma_1 + \sigma_2)}{w_1 + w_2}

with the source function c = albedo L_s at the two Gauss points of a piece, and tau_q the optical depth in front of them by the
two-stage Gauss method (order 4). The factor kappa makes the weights add up to 1 - exp(-tau), so a constant source is exact at
any optical depth. A cell is cut into pieces of an optical depth of at most ``PIECE``, and of an angle of at most ``TURN`` as
seen from a lamp near by, evenly in that angle. A cell that would need more than ``MOST`` of them is cut as far as light comes:
to the optical depth ``DARK`` of each channel.

Shadow rays start at float32 points: with an extinction sigma, what is lit errs by sigma times the rounding of a distance
along the camera's ray and of a coordinate, so by 1 % where 1e5 optical depths lie between coordinates that differ by 1.

Conventions. One body, whose grids share their cells. Shadows are exact walks, or looked up where the world has a light grid.
References: Hairer & Wanner 1996, Table 5.1 (the two-stage Gauss method).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.numerics import phi1
from mivol.transport.estimators.contribution import TrackedTerm
from mivol.transport.estimators.distance_reservoir import lit_length
from mivol.transport.estimators.equiangular import EquiangularSampler, equiangular_sampler
from mivol.transport.estimators.event_samples import EventSamples
from mivol.transport.estimators.segment import PICTURE, PathSegment, SegmentEstimate, Transmittance
from mivol.transport.estimators.shadow_rays import DARK, shadow_ray
from mivol.transport.estimators.single_scattering import SingleScattering
from mivol.transport.estimators.transmittance_grid import TransmittanceGrid
from mivol.transport.media.body import Body
from mivol.transport.media.channels import spectrum
from mivol.transport.media.coefficients import eval_albedo, medium_interaction
from mivol.transport.media.optical_depth import transmittance
from mivol.transport.media.ray_intervals import RaySegment, visit_media
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, walk
from mivol.transport.traversal.interpolation import GAUSS
from mivol.transport.traversal.lattice import clip
from mivol.transport.traversal.strata import Strata

__all__ = ["ScatteringQuadrature"]


PIECE = 0.25
"""Largest optical depth of a piece: where shadows bend within it (a shadow ray begins to cross other cells) it errs by up to
PIECE^2 / 8 of its light; smooth light is exact to 1e-6 of it."""

TURN = 0.1
"""Largest angle [rad] of a piece as seen from a near lamp (1/r^2 is a constant in that angle)."""

MOST = 256
"""Most pieces of a cell or of a stretch of constant extinction that is cut to its end."""

DEEP = 2 * int(DARK / PIECE)
"""Pieces of a deeper cell between the places where one channel and the next becomes dark: even in length, so twice as many as
an even extinction would need."""

BISECTIONS = 12
"""Halvings of the logarithm of the share at which a cell is dark: from 2^-30 to 1, to 0.5 % of it."""

STRETCH = 64
"""Pieces of a stretch of constant extinction, which may be as long as the medium, at least."""

SKEW = math.sqrt(3) / 6


class ScatteringQuadrature:
    """Scatters the light of a segment once, by quadrature in pictures; derivatives are drawn.

    Args:
        drawn: the estimator of derivatives; it knows the media, a single body, and the emitters.
        transmittance_grid: in place of shadow rays; None for exact ones.

    Bias: of fourth order in the size of a cell where the light is smooth; of first order across the edge of a shadow.
    Cost: one walk for each emitter, and two shadow rays (or look-ups) a piece.
    """

    directions = "spread"

    def __init__(self, drawn: SingleScattering, transmittance_grid: TransmittanceGrid | None) -> None:
        self.drawn, self.media, self.emitters, self.transmittance_grid = drawn, drawn.media, drawn.emitters, transmittance_grid

    def draw(self, sampler: mi.Sampler, active: mi.Bool, strata: Strata | None) -> EventSamples:
        return self.drawn.draw(sampler, active, strata)

    def find_controls(self, ray: mi.Ray3f) -> None:
        """Find a control variate for derivatives along camera rays, once."""
        self.drawn.find_controls(ray)

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        if purpose != PICTURE:
            return self.drawn.estimate(segment, purpose, active)
        L, end, tau, ray = mi.Spectrum(0), None, None, segment.ray
        for number, lamp in enumerate(self.emitters.sampled):
            equiangular = equiangular_sampler(ray, self.emitters.bounding_ball(number))
            visit = partial(_integrate_body, self, ray, lamp, number, equiangular)
            zero = _start(self.media, dr.width(ray))
            end, (tau, _, light) = visit_media(self.media, ray, segment.medium, visit, zero, active)
            L += light
        term = TrackedTerm(dr.select(segment.scatters, segment.beta * L, 0), active)
        passed = RaySegment(ray, segment.medium, end.t)
        return SegmentEstimate(end, transmittance(tau), term, Transmittance(self.media, passed, active))


_Sum = tuple
"""(optical depth so far, transmittance so far, light) of a stretch."""

Profile = Callable[..., list]
"""Extinction [1/length] of each channel at a share of a cell."""

Source = Callable[..., Any]
"""Source function at a distance along the ray: ``source(t, active)``."""


def _start(media: SceneMedia, width: int) -> _Sum:
    rows = [[dr.full(mi.Float, v, width) for _ in range(media.channels)] for v in (0, 1)]
    return rows[0], rows[1], dr.zeros(mi.Spectrum, width)


def _integrate_body(
    quadrature: ScatteringQuadrature,
    ray: mi.Ray3f,
    lamp: mi.Emitter,
    number: int,
    equiangular: EquiangularSampler | None,
    state: _Sum,
    body: Body,
    t0: mi.Float,
    t1: mi.Float,
    on: mi.Bool,
) -> _Sum:
    """Add one body's interval."""
    media = quadrature.media
    field = body.extinction(ray)
    grid = next((p.lattice for p in body.view.parts if p.lattice is not None), None)

    def source(t: mi.Float64, active: mi.Bool) -> mi.Spectrum:
        return _source(quadrature, body, ray, lamp, number, t, active)

    def add_constant(state: _Sum, a: mi.Float64, b: mi.Float64) -> _Sum:
        sigma = media.rows(field.constant)
        dt = dr.select(on, lit_length(sigma, dr.maximum(mi.Float(b - a), 0)), 0)
        return _pieces(state, a, dt, lambda x: sigma, source, equiangular, mi.Float(STRETCH), on & (dt > 0))

    t0, t1 = mi.Float64(t0), mi.Float64(t1)
    if grid is None:
        return add_constant(state, t0, t1)
    segment = clip(grid, ray.o, ray.d, t0, t1)
    hit = segment.length > 0

    def visit(state: _Sum, cell: Cell, full: mi.Bool) -> _Sum:
        def sigma(x: mi.Float) -> list[mi.Float]:
            return media.rows([v[0] for v in field.along(cell.corners, [dr.fma(cell.step, x, cell.frac)])])

        start = segment.start + mi.Float64(cell.s)
        return _pieces(state, start, cell.dt, sigma, source, equiangular, mi.Float(1), full & (cell.dt > 0))

    if not field.has_constants:
        return walk(grid, segment, visit, state, field.reads, on)
    state = add_constant(state, t0, dr.select(hit, segment.start, t1))
    # Where the grid is empty the constants are not.
    state = walk(replace(grid, empty_distances=None), segment, visit, state, field.reads, on)
    return add_constant(state, dr.select(hit, segment.end, t1), t1)


def _pieces(
    state: _Sum,
    start: mi.Float64,
    dt: mi.Float,
    sigma: Profile,
    source: Source,
    equiangular: EquiangularSampler | None,
    least: mi.Float,
    on: mi.Bool,
) -> _Sum:
    """Cut [start, start + dt] into pieces and add them in their order."""
    near, far = sigma(mi.Float(GAUSS)), sigma(mi.Float(1 - GAUSS))
    thick = _largest([0.5 * dt * (a + b) for a, b in zip(near, far, strict=True)])
    count = dr.maximum(least, dr.ceil(thick / PIECE))
    if equiangular is not None:
        count = dr.maximum(count, dr.select(equiangular.finite, dr.ceil(equiangular.angle(mi.Float(start), dt) / TURN), 1))
    is_deep = on & (thick > MOST * PIECE)
    edges = _in_order(_dark_shares(state[0], dt, sigma, is_deep))
    lit = dr.select(_least(state[0]) < DARK, DEEP * len(edges) + 1, 1)
    count = dr.select(is_deep, mi.UInt32(lit), mi.UInt32(dr.clip(count, 1, MOST)))
    return _add_pieces(state, start, dt, sigma, source, equiangular, is_deep, edges, count, on)


@dr.syntax
def _dark_shares(front: list[mi.Float], dt: mi.Float, sigma: Profile, is_deep: mi.Bool) -> list[mi.Float]:
    """The share of a cell at which each channel has the optical depth ``DARK``, by bisection; 1 where it never has."""
    low = [dr.full(mi.Float, 2.0**-30, dr.width(dt)) for _ in front]
    high = [dr.full(mi.Float, 1, dr.width(dt)) for _ in front]
    step = dr.zeros(mi.UInt32, dr.width(dt))
    going = mi.Bool(is_deep)
    while dr.hint(going, label="where a cell is dark"):
        low, high = _halve(front, dt, sigma, low, high)
        step += 1
        going &= step < BISECTIONS
    return high


def _halve(front: list[mi.Float], dt: mi.Float, sigma: Profile, low: list[mi.Float], high: list[mi.Float]) -> tuple:
    """The half of [low, high], in its logarithm, in which each channel becomes dark."""
    middle = [dr.sqrt(a * b) for a, b in zip(low, high, strict=True)]
    is_lit = [front[k] + _depth_at(m, dt, sigma)[k] < DARK for k, m in enumerate(middle)]
    low = [dr.select(i, m, a) for i, m, a in zip(is_lit, middle, low, strict=True)]
    return low, [dr.select(i, b, m) for i, m, b in zip(is_lit, middle, high, strict=True)]


def _depth_at(x: mi.Float, dt: mi.Float, sigma: Profile) -> list[mi.Float]:
    """Optical depth of each channel from the start of a cell to a share of it."""
    return [0.5 * x * dt * (a + b) for a, b in zip(sigma(GAUSS * x), sigma((1 - GAUSS) * x), strict=True)]


def _in_order(shares: list[mi.Float]) -> list[mi.Float]:
    """One or three numbers, the least first."""
    if len(shares) == 1:
        return shares
    a, b, c = shares
    low, high = dr.minimum(a, b), dr.maximum(a, b)
    return [dr.minimum(low, c), dr.maximum(low, dr.minimum(high, c)), dr.maximum(high, c)]


@dr.syntax
def _add_pieces(
    state: _Sum,
    start: mi.Float64,
    dt: mi.Float,
    sigma: Profile,
    source: Source,
    equiangular: EquiangularSampler | None,
    is_deep: mi.Bool,
    edges: list[mi.Float],
    count: mi.UInt32,
    on: mi.Bool,
) -> _Sum:
    """Add ``count`` pieces, even in the angle seen from a near lamp, else in length; in a deep cell between its ``edges``."""
    tau, T, light = state
    index = dr.zeros(mi.UInt32, dr.width(dt))
    near = dr.zeros(mi.Float, dr.width(dt))
    going = mi.Bool(on)
    while dr.hint(going, label="pieces of a cell"):
        share = mi.Float(index + 1) / mi.Float(count)
        far = share * dt
        if equiangular is not None:
            far = dr.select(equiangular.finite, equiangular.sample(mi.Float(start), dt, share), far)
        far = dr.select(is_deep, dt * _between(edges, index + 1), far)
        far = dr.select(index + 1 >= count, dt, dr.clip(far, near, dt))
        tau, T, light = _add_piece(tau, T, light, start, dt, near, far, sigma, source, going)
        near = far
        index += 1
        going &= index < count
    return tau, T, light


def _between(edges: list[mi.Float], index: mi.UInt32) -> mi.Float:
    """The share of a cell at which ``index`` pieces end, ``DEEP`` of them from 0 to the first edge and from one to the next."""
    share, begin = mi.Float(0), mi.Float(0)
    for k, end in enumerate(edges):
        part = dr.clip((mi.Float(index) - k * DEEP) / DEEP, 0, 1)
        share, begin = share + part * (end - begin), end
    return share


def _add_piece(
    tau: list[mi.Float],
    T: list[mi.Float],
    light: mi.Spectrum,
    start: mi.Float64,
    dt: mi.Float,
    near: mi.Float,
    far: mi.Float,
    sigma: Profile,
    source: Source,
    on: mi.Bool,
) -> _Sum:
    """Add the piece [near, far] of a cell by the collocation rule."""
    step = dr.select(on, far - near, 0)
    places = [near + GAUSS * (far - near), near + (1 - GAUSS) * (far - near)]
    inverse = dr.rcp(dr.maximum(dt, 1e-30))
    values = [sigma(p * inverse) for p in places]
    c = [source(start + mi.Float64(p), on & (step > 0)) for p in places]
    ahead, beyond, gain = [], [], []
    for k in range(len(tau)):
        s1, s2 = values[0][k], values[1][k]
        own = 0.5 * step * (s1 + s2)
        first = dr.maximum(step * (0.25 * s1 + (0.25 - SKEW) * s2), 0)
        second = step * ((0.25 + SKEW) * s1 + 0.25 * s2)
        least = dr.minimum(first, second)
        w1, w2 = s1 * dr.exp(least - first), s2 * dr.exp(least - second)
        total = w1 + w2
        whole = T[k] * 0.5 * step * phi1(own) * (s1 + s2) * dr.select(total > 0, dr.rcp(dr.select(total > 0, total, 1)), 0)
        gain.append((whole * w1, whole * w2))
        ahead.append(tau[k] + own)
        beyond.append(T[k] * dr.exp(-own))
    light = light + dr.select(on, spectrum([g[0] for g in gain]) * c[0] + spectrum([g[1] for g in gain]) * c[1], 0)
    return ahead, beyond, light


def _source(
    quadrature: ScatteringQuadrature, body: Body, ray: mi.Ray3f, lamp: mi.Emitter, number: int, t: mi.Float64, on: mi.Bool
) -> mi.Spectrum:
    """Albedo times the light of one lamp that turns to the camera, at a point of its ray."""
    mei = medium_interaction(ray, t, body.view.medium)
    direct, weight = lamp.sample_direction(mei, mi.Point2f(0.5), on)
    f, _ = body.view.medium.phase_function().eval_pdf(mi.PhaseFunctionContext(None), mei, direct.d, on)
    media, grid = quadrature.media, quadrature.transmittance_grid
    if grid is None:
        _, clear, _, seen = shadow_ray(media, mi.Point3f(mei.p), mei.medium, direct, on)
        seen = dr.select(clear, seen, 0)
    else:
        seen = grid.transmittance(mei.p, number, on)
    return dr.select(on & (direct.pdf > 0), _share(media, body, ray, mei, on) * f * weight * seen, 0)


def _share(media: SceneMedia, body: Body, ray: mi.Ray3f, mei: mi.MediumInteraction3f, on: mi.Bool) -> mi.Spectrum:
    """The albedo, or sigma_s over the extinction, which the weights of a piece are multiples of; 0 where that is 0."""
    if body.view.albedo is not None:
        return eval_albedo(body, mei, on)
    scattered, whole = (spectrum(body.extinction_at(ray, mei.t, media.channels, on, name)) for name in ("sigma_s", "sigma_"))
    return dr.select(whole > 0, scattered / dr.select(whole > 0, whole, 1), 0)


def _least(rows: list[mi.Float]) -> mi.Float:
    best = rows[0]
    for row in rows[1:]:
        best = dr.minimum(best, row)
    return best


def _largest(rows: list[mi.Float]) -> mi.Float:
    best = rows[0]
    for row in rows[1:]:
        best = dr.maximum(best, row)
    return best
