r"""Single scattering by quadrature along the camera's ray, without noise, for emitters with a single position or direction.

.. math:: \int_a^b T \sigma c\,dt \approx \frac{\Delta}{2}\,\kappa\,(w_1 c_1 + w_2 c_2), \qquad
          w_q = \sigma_q e^{-\tau_q}, \quad \kappa = \frac{\varphi_1(\tau)(\sigma_1 + \sigma_2)}{w_1 + w_2}

with the source function c = albedo L_s at the two Gauss points of a piece of the ray, and the optical depth tau_q in front of
them by two-stage Gauss collocation (order 4). The factor kappa makes the weights sum to 1 - exp(-tau), so a constant source
function is exact at any optical depth.

Each cell is cut into pieces of at most the optical depth ``MAX_PIECE_TAU``. With an emitter at a finite distance, the pieces
are uniform in the angle seen from it, and span at most ``MAX_PIECE_ANGLE``. A cell in need of more than ``MAX_PIECES`` pieces
is cut only as far as light arrives: up to the optical depth ``NEGLIGIBLE_TAU`` of each channel.

The distance of a cell from the ray's entry into its grid is a float32 number. With an extinction sigma, the optical depth of a
lit layer therefore has an error of sigma times the rounding of this distance: 1 % behind 1e5 optical depths.

Conventions. One medium, whose grids share their cells. Shadows are exact walks, or interpolated in a transmittance grid.

References: Hairer & Wanner 1996, Table 5.1 (the two-stage Gauss method).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.numerics import maximum, minimum, phi1
from mivol.transport.estimators.lighting.emitters import EquiangularSampler, EventSamples, make_ball_sampler
from mivol.transport.estimators.lighting.shadow_rays import NEGLIGIBLE_TAU, trace_shadow_ray
from mivol.transport.estimators.lighting.tabulated_shadows import TransmittanceGrid
from mivol.transport.estimators.scores import IMAGE, TrackedTerm
from mivol.transport.estimators.segment import Absorption, PathSegment, SegmentEstimate, Transmittance
from mivol.transport.estimators.single_scattering.distance_sampling import lit_length
from mivol.transport.estimators.single_scattering.single_scattering import SingleScattering
from mivol.transport.media.body import Body, eval_albedo, medium_interaction
from mivol.transport.media.extinction import to_spectrum
from mivol.transport.media.optical_depth import transmittance
from mivol.transport.media.ray_intervals import MediumInterval, RaySegment, visit_media
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.grid_walk import Cell, walk_cells
from mivol.transport.traversal.interpolation import GAUSS_POINT
from mivol.transport.traversal.lattice import clip_to_grid
from mivol.transport.traversal.random_numbers import SpreadSampler
from mivol.transport.traversal.rays import Ray, point_along

__all__ = ["ScatteringQuadrature"]


MAX_PIECE_TAU = 0.25
"""Largest optical depth of a piece [1]. A kink of the shadow inside (a shadow ray begins to cross other cells) causes an error
of up to MAX_PIECE_TAU^2 / 8 of its light; smooth light is exact to 1e-6 of it."""

MAX_PIECE_ANGLE = 0.1
"""Largest angle of a piece seen from a near emitter [rad] (the integrand 1/r^2 dt is constant in this angle)."""

MAX_PIECES = 256
"""Largest number of pieces of a cell, or of a region of constant extinction, cut up to the end."""

DEEP_PIECES = 2 * int(NEGLIGIBLE_TAU / MAX_PIECE_TAU)
"""Pieces of a deeper cell between the positions where successive channels become dark. Their lengths are equal, so there are
twice as many as needed for a constant extinction."""

BISECTIONS = 12
"""Bisections to find the fraction of a cell at which light becomes negligible: in its logarithm, from [2^-30, 1] to 0.5 %."""

CONSTANT_PIECES = 64
"""Least number of pieces of a region of constant extinction, which may be as long as the medium."""

SKEW = math.sqrt(3) / 6
"""The coefficients of the two-stage Gauss method are 1/4, and 1/4 minus and plus this number."""


class ScatteringQuadrature:
    """The segment estimator of single scattering by quadrature in images; derivatives are Monte Carlo estimates.

    Args:
        drawn: estimator of derivatives, with the media (a single one) and the emitters.
        transmittance_grid: optical depths replacing shadow rays; None means exact shadow rays.

    Bias: of fourth order in the size of a cell for smooth light; of first order across the edge of a shadow.
    Variance: none in images.
    Cost: one walk for each emitter, and two shadow rays (or look-ups) for each piece.
    """

    ends_in_media = False

    def __init__(self, drawn: SingleScattering, transmittance_grid: TransmittanceGrid | None) -> None:
        self.drawn, self.media, self.emitters, self.transmittance_grid = drawn, drawn.media, drawn.emitters, transmittance_grid

    def draw(self, sampler: mi.Sampler | SpreadSampler, active: mi.Bool) -> EventSamples:
        return self.drawn.draw(sampler, active)

    def prepare_derivatives(self, ray: mi.Ray3f) -> None:
        """Find a control variate for the derivatives along camera rays; later calls keep the first one."""
        self.drawn.prepare_derivatives(ray)

    def replayed(self) -> Absorption:
        return Absorption(self.media, drawn_by=self.drawn)

    def estimate(self, segment: PathSegment, purpose: str, active: mi.Bool) -> SegmentEstimate:
        if purpose != IMAGE:
            return self.drawn.estimate(segment, purpose, active)
        L, end, tau, ray = mi.Spectrum(0), None, None, segment.ray
        for number in range(len(self.emitters.sampled)):
            equiangular = make_ball_sampler(ray, self.emitters.bounding_ball(number))
            zero = _empty_sum(self.media, dr.width(ray))
            visit = _LitRay(self, ray, number, equiangular).visit
            end, sums = visit_media(self.media, ray, segment.medium, visit, zero, active)
            tau, L = sums.tau, L + sums.light
        term = TrackedTerm(dr.select(segment.may_scatter, segment.beta * L, 0), active)
        passed = RaySegment(ray, segment.medium, end.t)
        return SegmentEstimate(end, transmittance(tau), term, Transmittance(self.media, passed, active))


@dataclass
class _LightSum:
    """Sums over the pieces of a ray so far.

    Attributes:
        tau, T: optical depth and transmittance, for each channel [1].
        light: scattered radiance.
    """

    tau: list[mi.Float]
    T: list[mi.Float]
    light: mi.Spectrum


ExtinctionProfile = Callable[..., list]
"""``sigma(x)``: extinction of each channel at the fraction x of a span [1/length]."""

SourceFunction = Callable[..., Any]
"""``source(t, active)``: source function at a distance along the ray, in float64 [radiance]."""


@dataclass
class _Span:
    """A part of the ray to be cut into pieces: in one cell, or of constant extinction.

    Attributes:
        start, length: near end, in float64, and length [length].
        sigma: extinction along the span.
        source: source function along the ray.
        equiangular: sampler towards the emitter; None if the emitter is at infinity.
        on: lanes with the span.
    """

    start: mi.Float64
    length: mi.Float
    sigma: ExtinctionProfile
    source: SourceFunction
    equiangular: EquiangularSampler | None
    on: mi.Bool


def _empty_sum(media: SceneMedia, width: int) -> _LightSum:
    rows = [[dr.full(mi.Float, v, width) for _ in range(media.channels)] for v in (0, 1)]
    return _LightSum(rows[0], rows[1], dr.zeros(mi.Spectrum, width))


@dataclass
class _LitRay:
    """A ray, and the emitter whose light is integrated along it.

    Attributes:
        quadrature: media, emitters and shadows.
        ray: ray in world space, with a unit direction.
        number: index of the emitter.
        equiangular: sampler towards the emitter; None if the emitter is at infinity.
    """

    quadrature: ScatteringQuadrature
    ray: Ray
    number: int
    equiangular: EquiangularSampler | None

    def visit(self, state: _LightSum, interval: MediumInterval) -> _LightSum:
        """Add the interval of the medium."""
        media, ray, body, on = self.quadrature.media, self.ray, interval.body, interval.active
        extinction = body.extinction(ray)
        grid = next((p.lattice for p in body.view.parts if p.lattice is not None), None)

        def source(t: mi.Float64, active: mi.Bool) -> mi.Spectrum:
            return self._source(body, t, active)

        def add_constant(state: _LightSum, a: mi.Float64, b: mi.Float64) -> _LightSum:
            sigma = media.to_channels(extinction.constant)
            dt = dr.select(on, lit_length(sigma, dr.maximum(mi.Float(b - a), 0)), 0)
            span = _Span(a, dt, lambda x: sigma, source, self.equiangular, on & (dt > 0))
            return _add_span(state, span, mi.Float(CONSTANT_PIECES))

        t0, t1 = mi.Float64(interval.t0), mi.Float64(interval.t1)
        if grid is None:
            return add_constant(state, t0, t1)
        segment = clip_to_grid(grid, ray.o, ray.d, t0, t1)
        hit = segment.length > 0

        def visit(state: _LightSum, cell: Cell, full: mi.Bool) -> _LightSum:
            start = segment.start + mi.Float64(cell.s)

            def sigma(x: mi.Float) -> list[mi.Float]:
                point, t = dr.fma(cell.step, x, cell.frac), dr.fma(cell.dt, x, mi.Float(start))
                return media.to_channels([v[0] for v in extinction.along(cell.corners, [point], [t])])

            span = _Span(start, cell.dt, sigma, source, self.equiangular, full & (cell.dt > 0))
            return _add_span(state, span, mi.Float(1))

        if not extinction.has_constants:
            return walk_cells(grid, segment, visit, state, extinction.reads, on)
        state = add_constant(state, t0, dr.select(hit, segment.start, t1))
        # No block may be skipped: the constants scatter light in empty blocks of the grid too.
        state = walk_cells(replace(grid, empty_distances=None), segment, visit, state, extinction.reads, on)
        return add_constant(state, dr.select(hit, segment.end, t1), t1)

    def _source(self, body: Body, t: mi.Float64, on: mi.Bool) -> mi.Spectrum:
        """Albedo times the emitter's light scattered towards the camera, at a distance along the ray [radiance]."""
        media, grid = self.quadrature.media, self.quadrature.transmittance_grid
        emitter = self.quadrature.emitters.sampled[self.number]
        mei = medium_interaction(self.ray, t, body.view.medium)
        direct, weight = emitter.sample_direction(mei, mi.Point2f(0.5), on)
        f = media.phases.eval(mei, direct.d, on)
        if grid is None:
            _, clear, _, seen = trace_shadow_ray(media, point_along(self.ray, t), mei.medium, direct, on)
            seen = dr.select(clear, seen, 0)
        else:
            seen = grid.transmittance(mei.p, self.number, on)
        return dr.select(on & (direct.pdf > 0), _scattering_albedo(media, body, self.ray, mei, on) * f * weight * seen, 0)


def _add_span(state: _LightSum, span: _Span, least: mi.Float) -> _LightSum:
    """Cut a span into at least ``least`` pieces, and add them in their order."""
    dt, sigma, equiangular = span.length, span.sigma, span.equiangular
    near, far = sigma(mi.Float(GAUSS_POINT)), sigma(mi.Float(1 - GAUSS_POINT))
    thick = maximum([0.5 * dt * (a + b) for a, b in zip(near, far, strict=True)])
    count = dr.maximum(least, dr.ceil(thick / MAX_PIECE_TAU))
    if equiangular is not None:
        count = dr.maximum(
            count, dr.select(equiangular.finite, dr.ceil(equiangular.angle(mi.Float(span.start), dt) / MAX_PIECE_ANGLE), 1)
        )
    is_deep = span.on & (thick > MAX_PIECES * MAX_PIECE_TAU)
    edges = _sort_rows(_dark_fractions(state.tau, dt, sigma, is_deep))
    lit = dr.select(minimum(state.tau) < NEGLIGIBLE_TAU, DEEP_PIECES * len(edges), 1)
    count = dr.select(is_deep, mi.UInt32(lit), mi.UInt32(dr.clip(count, 1, MAX_PIECES)))
    return _add_pieces(state, span, is_deep, edges, count)


@dr.syntax
def _dark_fractions(front: list[mi.Float], dt: mi.Float, sigma: ExtinctionProfile, is_deep: mi.Bool) -> list[mi.Float]:
    """The fraction of a cell at which each channel reaches the optical depth ``NEGLIGIBLE_TAU``, by bisection; 1 if it never
    does.
    """
    low = [dr.full(mi.Float, 2.0**-30, dr.width(dt)) for _ in front]
    high = [dr.full(mi.Float, 1, dr.width(dt)) for _ in front]
    step = dr.zeros(mi.UInt32, dr.width(dt))
    going = mi.Bool(is_deep)
    while dr.hint(going, label="where a cell is dark"):
        low, high = _bisect_once(front, dt, sigma, low, high)
        step += 1
        going &= step < BISECTIONS
    return high


def _bisect_once(
    front: list[mi.Float], dt: mi.Float, sigma: ExtinctionProfile, low: list[mi.Float], high: list[mi.Float]
) -> tuple:
    """One bisection: the half of [low, high], in its logarithm, in which each channel becomes dark."""
    middle = [dr.sqrt(a * b) for a, b in zip(low, high, strict=True)]
    is_lit = [front[k] + _optical_depth_to(m, dt, sigma)[k] < NEGLIGIBLE_TAU for k, m in enumerate(middle)]
    low = [dr.select(i, m, a) for i, m, a in zip(is_lit, middle, low, strict=True)]
    return low, [dr.select(i, b, m) for i, m, b in zip(is_lit, middle, high, strict=True)]


def _optical_depth_to(x: mi.Float, dt: mi.Float, sigma: ExtinctionProfile) -> list[mi.Float]:
    """Optical depth of each channel from the start of a cell to a fraction of the cell [1]."""
    return [0.5 * x * dt * (a + b) for a, b in zip(sigma(GAUSS_POINT * x), sigma((1 - GAUSS_POINT) * x), strict=True)]


def _sort_rows(shares: list[mi.Float]) -> list[mi.Float]:
    """Sort one or three numbers, the smallest first."""
    if len(shares) == 1:
        return shares
    a, b, c = shares
    low, high = dr.minimum(a, b), dr.maximum(a, b)
    return [dr.minimum(low, c), dr.maximum(low, dr.minimum(high, c)), dr.maximum(high, c)]


@dr.syntax
def _add_pieces(state: _LightSum, span: _Span, is_deep: mi.Bool, edges: list[mi.Float], count: mi.UInt32) -> _LightSum:
    """Add ``count`` pieces, equal in the angle seen from a near emitter, otherwise in length; in a deep cell between
    ``edges``."""
    start, dt, equiangular = span.start, span.length, span.equiangular
    index = dr.zeros(mi.UInt32, dr.width(dt))
    near = dr.zeros(mi.Float, dr.width(dt))
    going = mi.Bool(span.on)
    while dr.hint(going, label="pieces of a cell"):
        share = mi.Float(index + 1) / mi.Float(count)
        far = share * dt
        if equiangular is not None:
            far = dr.select(equiangular.finite, equiangular.sample(mi.Float(start), dt, share), far)
        far = dr.select(is_deep, dt * _deep_fraction(edges, index + 1), far)
        far = dr.select(index + 1 >= count, dt, dr.clip(far, near, dt))
        state = _add_piece(state, span, near, far, going)
        near = far
        index += 1
        going &= index < count
    return state


def _deep_fraction(edges: list[mi.Float], index: mi.UInt32) -> mi.Float:
    """The fraction of a cell at the end of its first ``index`` pieces, with ``DEEP_PIECES`` up to the first edge and between
    edges.
    """
    share, begin = mi.Float(0), mi.Float(0)
    for k, end in enumerate(edges):
        part = dr.clip((mi.Float(index) - k * DEEP_PIECES) / DEEP_PIECES, 0, 1)
        share, begin = share + part * (end - begin), end
    return share


def _add_piece(state: _LightSum, span: _Span, near: mi.Float, far: mi.Float, on: mi.Bool) -> _LightSum:
    """Add the piece [near, far] of a span by two-stage Gauss collocation."""
    step = dr.select(on, far - near, 0)
    places = [near + GAUSS_POINT * (far - near), near + (1 - GAUSS_POINT) * (far - near)]
    inverse = dr.rcp(dr.maximum(span.length, 1e-30))
    values = [span.sigma(p * inverse) for p in places]
    c = [span.source(span.start + mi.Float64(p), on & (step > 0)) for p in places]
    ahead, beyond, gain = [], [], []
    for k, (tau, T) in enumerate(zip(state.tau, state.T, strict=True)):
        s1, s2 = values[0][k], values[1][k]
        piece_tau = 0.5 * step * (s1 + s2)
        first = dr.maximum(step * (0.25 * s1 + (0.25 - SKEW) * s2), 0)
        second = step * ((0.25 + SKEW) * s1 + 0.25 * s2)
        least = dr.minimum(first, second)
        w1, w2 = s1 * dr.exp(least - first), s2 * dr.exp(least - second)
        total = w1 + w2
        whole = T * 0.5 * step * phi1(piece_tau) * (s1 + s2) * dr.select(total > 0, dr.rcp(dr.select(total > 0, total, 1)), 0)
        gain.append((whole * w1, whole * w2))
        ahead.append(tau + piece_tau)
        beyond.append(T * dr.exp(-piece_tau))
    added = dr.select(on, to_spectrum([g[0] for g in gain]) * c[0] + to_spectrum([g[1] for g in gain]) * c[1], 0)
    return _LightSum(ahead, beyond, state.light + added)


def _scattering_albedo(media: SceneMedia, body: Body, ray: Ray, mei: mi.MediumInteraction3f, on: mi.Bool) -> mi.Spectrum:
    """The albedo, or sigma_s / sigma_t for a medium with both coefficients [1]; 0 for an extinction of 0."""
    if body.view.albedo is not None:
        return eval_albedo(body, mei, on)
    scattered, whole = (to_spectrum(body.extinction_at(ray, mei.t, media.channels, on, name)) for name in ("sigma_s", "sigma_"))
    return dr.select(whole > 0, scattered / dr.select(whole > 0, whole, 1), 0)
