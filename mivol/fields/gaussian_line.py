r"""One Gaussian along a line: its optical depth between two points in closed form, with the derivatives by all that it has.

.. math:: \sigma_t(x, \omega) = -\log(1 - o\,e^{-m^2/2})\;|W\omega|\;\varphi(s), \qquad
          \tau = -\log(1 - o\,e^{-m^2/2})\,\big[\Phi(s_1) - \Phi(s_0)\big]

W makes the Gaussian a round one of standard deviation 1 about its mean mu: q = W (x - mu) and v = W omega. Along the line

.. math:: s = q \cdot v / |v|, \qquad p = q - (q \cdot v / |v|^2)\, v, \qquad m = |p|,

s is the whitened distance from the point where the line is nearest to the mean, and m the whitened distance there. A line
through all of it loses the share alpha = o exp(-m^2/2) of its light, which is what a splat of opacity o shows at that distance
from its centre; what Gaussians in front of each other let through is the product of (1 - alpha) in any order, as in splatting.

Two consequences. The extinction depends on the direction: a Gaussian is not deeper seen along its longer axis, as a splat is
not. It is the same for a direction and its opposite, but light that turns meets another extinction than it left: with an
isotropic phase function, camera and emitter may not change places.

Conventions. A row holds what is known of a Gaussian, 16 numbers: W by rows, mu, o, the scale of the medium, and two zeros.

Source: the opacity along a ray is evaluated at its peak as in Moenne-Loccoz et al., 3D Gaussian Ray Tracing, 2024; the
extinction of this shape and its integral were derived for mivol.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = ["REACH", "ROW_SIZE", "SCALE_COLUMN", "WhitenedLine", "LineSlopes", "row_tangent", "intersect_gaussian", "read_row"]

ROW_SIZE, SCALE_COLUMN = 16, 13
"""Numbers of a Gaussian, and which of them is the scale of the medium."""

REACH = 4.0
"""Standard deviations at which a Gaussian ends: at most 4e-4 of its opacity lie beyond (measured on 10,000 Gaussians: an error
of the transmittance of 1.1e-3; with 3 of 0.02)."""


INVERSE_ROOT_2, INVERSE_ROOT_2_PI = 1 / math.sqrt(2), 1 / math.sqrt(2 * math.pi)


@dataclass
class LineSlopes:
    """Derivatives of a number with respect to q, v and the opacity of one Gaussian."""

    q: mi.Vector3f
    v: mi.Vector3f
    opacity: mi.Float

    def by_row(self, line: WhitenedLine) -> list[mi.Float]:
        """Derivatives with respect to the first 13 numbers of the row."""
        y, d, (a, b, c) = line.from_mean, line.d, line.rows
        mean = -(a * self.q.x + b * self.q.y + c * self.q.z)
        rows = [self.q[k] * y + self.v[k] * d for k in range(3)]
        return [*(row[j] for row in rows for j in range(3)), mean.x, mean.y, mean.z, self.opacity]


@dataclass
class WhitenedLine:
    """A line through a point ``o`` in the direction of the unit vector ``d``, as one Gaussian sees it.

    Attributes:
        rows: of W [1/length].
        from_mean, d: o - mu [length], and the direction.
        v: W d [1/length].
        speed: |v|: standard deviations passed in a length [1/length].
        p: the whitened place, from the mean, where the line is nearest to it.
        peak: distance of that place from ``o`` [length].
        half: half the length of the chord inside of ``REACH`` [length]; 0 where the line misses.
        opacity: of the Gaussian at its centre [1].
        m2: m^2, the squared whitened distance of that place from the mean.
        hits: whether the line comes within ``REACH``.
    """

    rows: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]
    from_mean: mi.Vector3f
    d: mi.Vector3f
    v: mi.Vector3f
    speed: mi.Float
    p: mi.Vector3f
    peak: mi.Float
    half: mi.Float
    opacity: mi.Float
    m2: mi.Float
    hits: mi.Bool

    @property
    def falloff(self) -> mi.Float:
        """exp(-m^2 / 2)."""
        return dr.exp(-0.5 * self.m2)

    @property
    def alpha(self) -> mi.Float:
        """The share of light that the whole line loses [1]."""
        return self.opacity * self.falloff

    @property
    def depth(self) -> mi.Float:
        """Optical depth of the whole line [1], -log(1 - alpha)."""
        return minus_log_one_minus(self.alpha)

    @property
    def chord(self) -> tuple[mi.Float, mi.Float]:
        """Distances from ``o`` at which the line comes within ``REACH`` and leaves it [length]."""
        return self.peak - self.half, self.peak + self.half

    def share(self, a: mi.Float, b: mi.Float) -> mi.Float:
        """The share [1] of the depth that lies between two distances from ``o``, which lie on the chord."""
        low, high = ((t - self.peak) * self.speed * INVERSE_ROOT_2 for t in (a, b))
        return 0.5 * (dr.erf(high) - dr.erf(low))

    def share_up_to(self, a: mi.Float) -> mi.Float:
        """The share [1] of the depth that lies before a distance from ``o``, from the far end of the line."""
        return 0.5 * (1 + dr.erf((a - self.peak) * self.speed * INVERSE_ROOT_2))

    def share_slopes(self, a: mi.Float, b: mi.Float) -> LineSlopes:
        """Derivatives of the optical depth between two distances from ``o``, as they are cut to the chord.

        Where the chord ends between them the end counts as fixed: its move would add at most exp(-REACH^2 / 2) of the depth.
        """
        start, end = self.chord
        low = dr.select(a > start, _normal_density((a - self.peak) * self.speed), 0)
        high = dr.select(b < end, _normal_density((b - self.peak) * self.speed), 0)
        share, depth, step = self.share(a, b), self.depth, dr.rcp(self.speed)
        rise = share * self._rise
        grows, moves = depth * (high - low) * step, depth * (high * b - low * a) * step
        q = grows * self.v - rise * self.p
        v = (grows - rise * self.peak) * self.p + moves * self.v
        return LineSlopes(q, v, share * self._by_opacity)

    @property
    def contains_origin(self) -> mi.Bool:
        """Whether ``o`` lies on the chord."""
        start, end = self.chord
        return self.hits & (start <= 0) & (end >= 0)

    @property
    def density(self) -> mi.Float:
        """The extinction [1/length] at ``o``; 0 outside of the chord."""
        return dr.select(self.contains_origin, self.depth * self.speed * _normal_density(self.peak * self.speed), 0)

    @property
    def density_slopes(self) -> LineSlopes:
        """Derivatives of the extinction at ``o``, where the chord holds it."""
        s, step = -self.peak * self.speed, dr.rcp(self.speed)
        bell, depth, rise = _normal_density(s), self.depth, self._rise
        q = -bell * (self.speed * rise * self.p + depth * s * self.v)
        v = bell * (depth * step * self.v + s * (rise - depth) * self.p)
        return LineSlopes(q, v, bell * self.speed * self._by_opacity)

    @property
    def _by_opacity(self) -> mi.Float:
        """Derivative of the depth by the opacity."""
        return self.falloff / (1 - self.alpha)

    @property
    def _rise(self) -> mi.Float:
        """Derivative of the depth by -m^2 / 2."""
        return self.alpha / (1 - self.alpha)


def read_row(rows: mi.Float, index: mi.UInt32) -> list[mi.Float]:
    """The 16 numbers of a Gaussian."""
    return list(dr.gather(mi.ArrayXf, rows, index, shape=(ROW_SIZE, dr.width(index))))


def intersect_gaussian(row: list[mi.Float], o: mi.Point3f, d: mi.Vector3f) -> WhitenedLine:
    """See a line through ``o`` in the direction ``d`` as a Gaussian does.

    Args:
        row: of the Gaussian.
        o, d: world, ``d`` of unit length. Near the Gaussian ``o`` need not be: of a ray's place float32 keeps 1e-7 of the
            distance to it.
    """
    rows = tuple(mi.Vector3f(*row[3 * k : 3 * k + 3]) for k in range(3))
    y = mi.Vector3f(o) - mi.Vector3f(*row[9:12])
    q, v = (mi.Vector3f(*(dr.dot(w, x) for w in rows)) for x in (y, d))
    speed = dr.norm(v)
    peak = -dr.dot(q, v) / (speed * speed)
    p = q + peak * v
    m2 = dr.squared_norm(p)
    hits = m2 < REACH**2
    half = dr.select(hits, dr.safe_sqrt(REACH**2 - m2) / speed, 0)
    return WhitenedLine(rows, y, mi.Vector3f(d), v, speed, p, peak, half, row[12], m2, hits)


def row_tangent(line: WhitenedLine, slopes: LineSlopes, change: list[mi.Float]) -> mi.Float:
    """The tangent of a number with these derivatives, from the tangent of the row."""
    return sum((s * c for s, c in zip(slopes.by_row(line), change, strict=False)), mi.Float(0))


def minus_log_one_minus(alpha: mi.Float) -> mi.Float:
    """-log(1 - alpha), to 1e-7 of itself: 1 - alpha alone would lose the digits of a small alpha."""
    x = alpha
    series = dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, dr.fma(x, 1 / 6, 1 / 5), 1 / 4), 1 / 3), 1 / 2), 1)
    return dr.select(x < 0.05, x * series, -dr.log(1 - x))


def _normal_density(s: mi.Float) -> mi.Float:
    """The density of the normal distribution."""
    return INVERSE_ROOT_2_PI * dr.exp(-0.5 * s * s)
