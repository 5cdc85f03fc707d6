"""Fields of extinction with closed-form optical depths.

Conventions. Positions and distances are in world units, in float64 NumPy arrays. A ray is ``o + t d`` with ``d`` of any length
but 0; ``t0`` and ``t1`` count lengths of ``d`` (distances for a unit ``d``). Optical depths integrate over the world length, so
rescaling ``d`` does not change the result. ``o`` and ``d`` have shape (..., 3), ``t0`` and ``t1`` shape (...); all broadcast.
``t1 <= t0`` gives 0.

Here: ``Constant``, ``Trilinear`` (``ramp``), ``Ellipsoid`` (``sphere``), ``Slab``, ``GaussianBlob``,
``ExponentialAtmosphere``, and two combinations: ``Within`` (a field inside a parallelepiped; ``box``) and ``Sum``.

References: Kak and Slaney 1988, Chapter 3, for projections of ellipses. Each class shows its integration.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf, erfc

from mivol.errors import MivolError
from mivol.space import check_affine

Floats = NDArray[np.float64]
IDENTITY = tuple(map(tuple, np.eye(4).tolist()))


class AnalyticField(ABC):
    """An extinction sigma_t [1/length] whose line integrals have a closed form."""

    @abstractmethod
    def eval(self, p: ArrayLike) -> Floats:
        """Extinction [1/length] at world positions ``p`` (..., 3), of shape (...)."""

    @abstractmethod
    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        """Integral of ``eval(o + t d)`` over t0 < t < t1 for unit ``d``; arguments are broadcast and t1 > t0."""

    def optical_depth(self, o: ArrayLike, d: ArrayLike, t0: ArrayLike = 0.0, t1: ArrayLike = np.inf) -> Floats:
        r"""Optical depth :math:`\tau = \int_{t_0}^{t_1} \sigma_t(o + t d)\,|d|\,dt` of each ray [1].

        Args:
            o: origins (..., 3), world.
            d: directions (..., 3), world, any length but 0.
            t0: start of the segment, in lengths of ``d``.
            t1: end of the segment, in lengths of ``d``; may be ``inf`` if the integral converges.

        Returns:
            Optical depth in the shape of the broadcast rays; 0 for ``t1 <= t0``.

        Raises:
            MivolError: a direction that is zero or not finite.
        """
        o, d = np.asarray(o, np.float64), np.asarray(d, np.float64)
        length = np.linalg.norm(d, axis=-1)
        if not np.all(np.isfinite(length) & (length > 0)):
            raise MivolError("a ray direction is zero or not finite; give each ray a direction of finite length.")
        shape = np.broadcast_shapes(o.shape[:-1], d.shape[:-1], np.shape(t0), np.shape(t1))
        unit = np.broadcast_to(d / length[..., None], (*shape, 3))
        start, end = (np.broadcast_to(np.asarray(t, np.float64) * length, shape) for t in (t0, t1))
        o, ahead = np.broadcast_to(o, (*shape, 3)), end > start
        tau = np.zeros(shape)
        tau[ahead] = self._integral(o[ahead], unit[ahead], start[ahead], end[ahead])
        return tau

    def voxelise(self, shape: tuple[int, int, int], to_world: ArrayLike = IDENTITY) -> NDArray[np.float32]:
        """Values at the voxel centres of a grid over the unit cube mapped by ``to_world``.

        Args:
            shape: voxels (Z, Y, X).
            to_world: (4, 4) affine map from the unit cube to the world; x is the fastest axis of the grid.

        Returns:
            (Z, Y, X, 1) float32 [1/length]. Trilinear interpolation between voxel centres is exact for ``Trilinear`` fields and
            has an error O(h^2) for smooth fields.
        """
        to_world = check_affine(np.asarray(to_world))
        centres = [(np.arange(n) + 0.5) / n for n in shape]
        z, y, x = np.meshgrid(*centres, indexing="ij")
        world = np.stack([x, y, z], axis=-1) @ to_world[:3, :3].T + to_world[:3, 3]
        return self.eval(world).astype(np.float32)[..., None]


@dataclass(frozen=True)
class Constant(AnalyticField):
    """Constant extinction everywhere: tau = sigma_t (t1 - t0)."""

    sigma_t: float

    def eval(self, p: ArrayLike) -> Floats:
        return np.full(np.shape(p)[:-1], float(self.sigma_t))

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        return self.sigma_t * (t1 - t0)


@dataclass(frozen=True)
class Trilinear(AnalyticField):
    r"""f = a + b x + c y + d z + e xy + f xz + g yz + h xyz in world coordinates, of either sign, everywhere.

    Along a ray f is a cubic in t. About the middle m of a segment of half length s the odd terms cancel, so
    :math:`\tau = 2 s f(m) + \tfrac{2}{3} s^3 f_2`, with :math:`f_2 = e d_x d_y + f d_x d_z + g d_y d_z
    + h (m_x d_y d_z + m_y d_x d_z + m_z d_x d_y)`. A grid represents f exactly between its voxel centres. A ramp is
    ``Trilinear((a, b, c, d, 0, 0, 0, 0))``.
    """

    coefficients: tuple[float, float, float, float, float, float, float, float]

    def eval(self, p: ArrayLike) -> Floats:
        x, y, z = np.moveaxis(np.asarray(p, np.float64), -1, 0)
        k = self.coefficients
        return k[0] + k[1] * x + k[2] * y + k[3] * z + k[4] * x * y + k[5] * x * z + k[6] * y * z + k[7] * x * y * z

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        half = 0.5 * (t1 - t0)
        middle = o + (0.5 * (t0 + t1))[..., None] * d
        mx, my, mz = np.moveaxis(middle, -1, 0)
        dx, dy, dz = np.moveaxis(d, -1, 0)
        e, f, g, h = self.coefficients[4:]
        second = e * dx * dy + f * dx * dz + g * dy * dz + h * (mx * dy * dz + my * dx * dz + mz * dx * dy)
        return 2 * half * self.eval(middle) + 2 / 3 * half**3 * second


def ramp(value: float, gradient: tuple[float, float, float]) -> Trilinear:
    """Linear extinction ``value + gradient . p`` [1/length] everywhere; tau = (mean of the end values) (t1 - t0)."""
    return Trilinear((value, *gradient, 0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class _EllipsoidalField(AnalyticField):
    """A field of the distance from ``centre`` in units of ``radii`` along the columns of ``axes`` (orthonormal)."""

    sigma_t: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radii: tuple[float, float, float] = (1.0, 1.0, 1.0)
    axes: tuple[tuple[float, float, float], ...] = tuple(map(tuple, np.eye(3).tolist()))

    def __post_init__(self) -> None:
        radii, axes = np.asarray(self.radii, float), np.asarray(self.axes, float)
        if radii.shape != (3,) or not np.all(np.isfinite(radii) & (radii > 0)):
            raise MivolError(f"radii are {self.radii}; give three finite lengths above 0.")
        if axes.shape != (3, 3) or not np.allclose(axes.T @ axes, np.eye(3), rtol=0, atol=1e-9):
            raise MivolError("axes are not orthonormal; give three perpendicular unit vectors as columns.")

    def _whiten(self, v: Floats) -> Floats:
        """Vectors in the whitened frame, in which the surface of the body is the unit sphere."""
        return v @ np.asarray(self.axes, float) / np.asarray(self.radii, float)

    def _closest_approach(self, o: Floats, d: Floats) -> tuple[Floats, Floats, Floats]:
        """Parameter t of the point closest to the centre, its squared distance, and |d|, all in the whitened frame."""
        q, w = self._whiten(o - np.asarray(self.centre, float)), self._whiten(d)
        speed = np.linalg.norm(w, axis=-1)
        t_c = -np.sum(q * w, axis=-1) / speed**2
        # B^2 - A C of the textbook quadratic loses |o|^2 eps to cancellation; the closest point loses only |o| eps.
        b2 = np.sum((q + t_c[..., None] * w) ** 2, axis=-1)
        return t_c, b2, speed


@dataclass(frozen=True)
class Ellipsoid(_EllipsoidalField):
    r"""Constant extinction inside an ellipsoid: tau = sigma_t L with the chord :math:`L = 2\sqrt{1 - b^2}/|Wd|`.

    W maps the ellipsoid to the unit sphere, and b is the distance of the mapped ray from the centre, equal to
    :math:`2\sqrt{B^2 - AC}/A` of the usual quadratic (Kak and Slaney 1988, Chapter 3). ``sigma_t`` may be negative, as in the
    Shepp-Logan head.
    """

    def eval(self, p: ArrayLike) -> Floats:
        q = self._whiten(np.asarray(p, np.float64) - np.asarray(self.centre, float))
        return np.where(np.sum(q * q, axis=-1) <= 1.0, float(self.sigma_t), 0.0)

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        t_c, b2, speed = self._closest_approach(o, d)
        half = np.sqrt(np.maximum(1.0 - b2, 0.0)) / speed
        return self.sigma_t * np.maximum(np.minimum(t1, t_c + half) - np.maximum(t0, t_c - half), 0.0)


def sphere(sigma_t: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), radius: float = 1.0) -> Ellipsoid:
    """Constant extinction [1/length] inside a sphere; the chord is 2 sqrt(R^2 - b^2)."""
    return Ellipsoid(sigma_t, centre, (radius, radius, radius))


@dataclass(frozen=True)
class GaussianBlob(_EllipsoidalField):
    r""":math:`\sigma_t e^{-r^2/2}` with r the distance from the centre in units of ``radii`` (the standard deviations).

    .. math:: \tau = \sigma_t\,e^{-b^2/2}\,\sqrt{\pi/2}\,\frac{1}{|Wd|}
              \Big[\mathrm{erf}\frac{(t_1 - t_c)|Wd|}{\sqrt 2} - \mathrm{erf}\frac{(t_0 - t_c)|Wd|}{\sqrt 2}\Big]
    """

    def eval(self, p: ArrayLike) -> Floats:
        q = self._whiten(np.asarray(p, np.float64) - np.asarray(self.centre, float))
        return self.sigma_t * np.exp(-0.5 * np.sum(q * q, axis=-1))

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        t_c, b2, speed = self._closest_approach(o, d)
        a, b = ((t - t_c) * speed / np.sqrt(2.0) for t in (t0, t1))
        return self.sigma_t * np.exp(-0.5 * b2) * np.sqrt(np.pi / 2) / speed * _erf_difference(a, b)


def _erf_difference(a: Floats, b: Floats) -> Floats:
    """erf(b) - erf(a) for a <= b, with a small relative error in the tails too."""
    # In a tail erf is 1 - small, and a difference keeps only absolute precision; erfc holds the small part.
    low, high = np.where(b < 0, -b, a), np.where(b < 0, -a, b)
    return np.where(low > 0, erfc(low) - erfc(high), erf(b) - erf(a))


@dataclass(frozen=True)
class Slab(AnalyticField):
    """Constant extinction between the planes ``normal . p = low`` and ``normal . p = high``; ``normal`` of any length but 0."""

    sigma_t: float
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)
    low: float = 0.0
    high: float = 1.0

    def eval(self, p: ArrayLike) -> Floats:
        height = np.asarray(p, np.float64) @ np.asarray(self.normal, float)
        return np.where((height >= self.low) & (height <= self.high), float(self.sigma_t), 0.0)

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        normal = np.asarray(self.normal, float)
        start, end = _slab_interval(o @ normal, d @ normal, self.low, self.high)
        return self.sigma_t * np.maximum(np.minimum(t1, end) - np.maximum(t0, start), 0.0)


def _slab_interval(x: Floats, slope: Floats, low: float, high: float) -> tuple[Floats, Floats]:
    """Interval of t with low <= x + slope t <= high; for slope 0 it is (-inf, inf) or empty (inf, -inf)."""
    inside = (x >= low) & (x <= high)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        one, other = (low - x) / slope, (high - x) / slope
    # 0 * inf and 0 / 0 are NaN for rays along the planes: for these only ``inside`` counts.
    start = np.where(slope == 0, np.where(inside, -np.inf, np.inf), np.minimum(one, other))
    end = np.where(slope == 0, np.where(inside, np.inf, -np.inf), np.maximum(one, other))
    return start, end


@dataclass(frozen=True)
class Within(AnalyticField):
    """``field`` inside the unit cube mapped by ``to_world`` (rotated, sheared or mirrored), vacuum outside."""

    field: AnalyticField
    to_world: tuple[tuple[float, float, float, float], ...] = IDENTITY

    def __post_init__(self) -> None:
        check_affine(np.asarray(self.to_world))

    def _local(self, v: Floats, w: float) -> Floats:
        """Points (w = 1) or vectors (w = 0) in the frame of the unit cube; vectors keep their parameter t."""
        matrix = np.asarray(self.to_world, float)
        return np.linalg.solve(matrix[:3, :3], (v - w * matrix[:3, 3])[..., None])[..., 0]

    def eval(self, p: ArrayLike) -> Floats:
        p = np.asarray(p, np.float64)
        q = self._local(p, 1.0)
        return np.where(np.all((q >= 0) & (q <= 1), axis=-1), self.field.eval(p), 0.0)

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        q, w = self._local(o, 1.0), self._local(d, 0.0)
        for axis in range(3):
            start, end = _slab_interval(q[..., axis], w[..., axis], 0.0, 1.0)
            t0, t1 = np.maximum(t0, start), np.minimum(t1, end)
        return self.field.optical_depth(o, d, t0, t1)


def box(sigma_t: float, to_world: tuple[tuple[float, float, float, float], ...] = IDENTITY) -> Within:
    """Constant extinction [1/length] inside the unit cube mapped by ``to_world``."""
    return Within(Constant(sigma_t), to_world)


@dataclass(frozen=True)
class ExponentialAtmosphere(AnalyticField):
    r"""Extinction sigma_0 e^{-z/H} with z along ``up``, falling by e over each ``scale_height`` H [length].

    With mu = d . up: :math:`\tau = \frac{\sigma_0 H}{\mu}(e^{-z_0/H} - e^{-z_1/H})`, written as
    :math:`\sigma_0 e^{-z_0/H}\,L\,\varphi_1(L\mu/H)`, :math:`\varphi_1(x) = (1 - e^{-x})/x`, which holds through mu = 0.
    """

    sigma_0: float
    scale_height: float
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if not np.isfinite(self.scale_height) or self.scale_height <= 0:
            raise MivolError(f"scale_height is {self.scale_height}; give a finite length above 0.")
        if not np.isclose(np.linalg.norm(self.up), 1.0, rtol=0, atol=1e-9):
            raise MivolError(f"up has length {np.linalg.norm(self.up):g}; give a unit vector.")

    def eval(self, p: ArrayLike) -> Floats:
        return self.sigma_0 * np.exp(-(np.asarray(p, np.float64) @ np.asarray(self.up, float)) / self.scale_height)

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        rate = d @ np.asarray(self.up, float) / self.scale_height
        start = self.eval(o + t0[..., None] * d)
        level = rate == 0
        with np.errstate(invalid="ignore"):
            effective_length = -np.expm1(-rate * (t1 - t0)) / np.where(level, 1.0, rate)
        return start * np.where(level, t1 - t0, effective_length)


@dataclass(frozen=True)
class Sum(AnalyticField):
    """The sum of several fields: optical depths add."""

    fields: tuple[AnalyticField, ...]

    def eval(self, p: ArrayLike) -> Floats:
        return sum((f.eval(p) for f in self.fields), np.zeros(np.shape(p)[:-1]))

    def _integral(self, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Floats:
        return sum((f.optical_depth(o, d, t0, t1) for f in self.fields), np.zeros(t0.shape))
