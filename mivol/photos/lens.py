r"""Lens models: how directions and image points map to each other.

Conventions. A direction (x, y, z) is in OpenCV's camera frame: x to the right, y **down**, z forward. An image point
(x_d, y_d) is in focal lengths from the principal point, so its pixel is (fx x_d + cx, fy y_d + cy).

:class:`Lens` is the polynomial model of Brown and Conrady, as OpenCV, COLMAP and nerfstudio write it. It distorts the plane
one length in front of the pinhole, with (x, y) before the lens and (x_d, y_d) behind it:

.. math:: x_d = x\,g + 2 p_1 x y + p_2 (r^2 + 2 x^2), \quad y_d = y\,g + p_1 (r^2 + 2 y^2) + 2 p_2 x y, \quad
   g = 1 + k_1 r^2 + k_2 r^4 + k_3 r^6 + k_4 r^8

:math:`k_4` is nerfstudio's term in r^8, not the denominator of OpenCV's rational model.

:class:`Fisheye` and :class:`Panorama` are wide lenses: their image is no plane, because they see half of all directions or
more. A fisheye maps the angle :math:`\theta` from the axis to the distance

.. math:: \theta_d = \theta\,(1 + k_1 \theta^2 + k_2 \theta^4 + k_3 \theta^6 + k_4 \theta^8)

from the principal point. A panorama maps longitude and latitude [radian] to x_d and y_d; its centre shows the axis.

Sources: Brown 1966 (Photogrammetric Engineering 32), decentring in the form of OpenCV's ``calib3d``; Kannala and Brandt 2006
(IEEE PAMI 28, eq. 6) with the coefficients of OpenCV's ``fisheye``; equirectangular images as in nerfstudio, with -z of the
camera in the centre.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from mivol.files.source import refusal

NEWTON_STEPS = 20
"""Largest number of steps that undistort a point."""

CONVERGED = 1e-12
"""Residual on the plane at distance 1: 1e-8 pixel at a focal length of 10 000 pixels, 4 000 times the rounding error."""

LEAST_TERM = 1e-30
"""Smallest last coefficient of a polynomial. Smaller values move no ray, and a division by them could overflow."""

LARGEST_TERM = 1e6
"""Largest coefficient of a lens, beyond which the search for the fold fails. Real coefficients are of order 1."""


@dataclass(frozen=True)
class Lens:
    """Coefficients of a distorted image plane; zeros describe a pinhole."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    is_wide = False

    def __bool__(self) -> bool:
        """Whether the lens distorts."""
        return any(astuple(self))

    @property
    def fold(self) -> float:
        """Radius r at which the radial part r g(r^2) stops growing; the image folds back beyond it. Infinite without a fold."""
        return _fold_radius(self.k1, self.k2, self.k3, self.k4)


def distort(lens: Lens, xy: np.ndarray) -> np.ndarray:
    """Apply the distortion to points (..., 2) on the plane at distance 1."""
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    r2 = x * x + y * y
    gain = _gain(lens, r2)
    xd = x * gain + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x)
    yd = y * gain + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y
    return np.stack([xd, yd], axis=-1)


def undistort(lens: Lens, xy: np.ndarray, name: object = "lens") -> np.ndarray:
    """Invert :func:`distort` by Newton's method with the exact Jacobian.

    Args:
        lens: coefficients.
        xy: distorted points (..., 2).
        name: subject of the refusal.

    Returns:
        Undistorted points (..., 2); distorting them gives ``xy`` to 1e-12.

    Raises:
        MivolError: a point without an original inside the fold.
    """
    target = np.asarray(xy, np.float64)
    if not lens:
        return target.copy()
    plane = target.copy()
    for _ in range(NEWTON_STEPS):
        residual = distort(lens, plane) - target
        if np.abs(residual).max(initial=0.0) <= CONVERGED:
            break
        plane = plane - _solve(lens, plane, residual)
    failed = ~(np.abs(distort(lens, plane) - target).max(axis=-1) <= CONVERGED) | (np.linalg.norm(plane, axis=-1) > lens.fold)
    if failed.any():
        x, y = target[failed].reshape(-1, 2)[0]
        raise refusal(
            name,
            f"a lens whose image folds back: nothing is seen at ({x:.4g}, {y:.4g}) times the focal length",
            "distortion that can be inverted over the whole image",
            "correct k1 to k4, p1, p2, or crop the image",
        )
    return plane


def _fold_radius(k1: float, k2: float, k3: float, k4: float) -> float:
    """The smallest r > 0 at which r (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) stops growing; infinite if it always grows."""
    slope = np.polynomial.Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    roots = slope.trim(LEAST_TERM).roots()
    squares = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1e-300)) & (roots.real > 0)]
    return float(np.sqrt(squares.min(initial=np.inf)))


def _gain(lens: Lens, r2: np.ndarray) -> np.ndarray:
    return 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * (lens.k3 + r2 * lens.k4)))


def _solve(lens: Lens, xy: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """J^-1 residual; infinite for a singular J, which the caller detects."""
    x, y = np.moveaxis(xy, -1, 0)
    r2 = x * x + y * y
    slope = 2 * (lens.k1 + r2 * (2 * lens.k2 + r2 * (3 * lens.k3 + r2 * 4 * lens.k4)))
    gain = _gain(lens, r2)
    xx = gain + x * x * slope + 2 * lens.p1 * y + 6 * lens.p2 * x
    yy = gain + y * y * slope + 6 * lens.p1 * y + 2 * lens.p2 * x
    xy_ = x * y * slope + 2 * lens.p1 * x + 2 * lens.p2 * y
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1 / (xx * yy - xy_ * xy_)
        rx, ry = np.moveaxis(residual, -1, 0)
        return np.stack([(yy * rx - xy_ * ry) * inverse, (xx * ry - xy_ * rx) * inverse], axis=-1)


STEPS = 60
"""Largest number of steps of a safeguarded Newton search; 60 bisections reduce its bracket to pi / 2^60."""


@dataclass(frozen=True)
class Fisheye:
    """Coefficients of a fisheye; zeros describe the equidistant projection."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    is_wide = True

    @property
    def widest(self) -> float:
        """Largest angle from the axis in the image [radian]: the image radius grows up to it, at most up to pi."""
        return min(np.pi, _fold_radius(self.k1, self.k2, self.k3, self.k4))

    def radius(self, theta: np.ndarray) -> np.ndarray:
        """Return the image radius [focal length] of angles from the axis [radian]."""
        t = theta * theta
        return theta * (1 + t * (self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4))))

    def point(self, d: np.ndarray) -> np.ndarray:
        """Return the image points (..., 2) of directions (..., 3) of arbitrary length; NaN outside the image."""
        across = np.hypot(d[..., 0], d[..., 1])
        theta = np.arctan2(across, d[..., 2])
        radius = np.where(theta <= self.widest, self.radius(theta), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.where(across[..., None] > 0, d[..., :2] / across[..., None], 0.0)
        return unit * radius[..., None]

    def direction(self, xy: np.ndarray) -> np.ndarray:
        """Return unit directions (..., 3) of image points (..., 2), to 1e-12; points outside get the direction at the rim.

        Safeguarded Newton: the image radius grows with the angle up to :attr:`widest`, which brackets the solution.
        """
        xy = np.asarray(xy, np.float64)
        radius = np.hypot(xy[..., 0], xy[..., 1])
        theta = self._angle(np.minimum(radius, self.radius(np.float64(self.widest))))
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.where(radius[..., None] > 0, xy / radius[..., None], 0.0)
        return np.concatenate([unit * np.sin(theta)[..., None], np.cos(theta)[..., None]], axis=-1)

    def sees(self, xy: np.ndarray) -> np.ndarray:
        """Return whether image points (..., 2) show a direction."""
        return np.hypot(xy[..., 0], xy[..., 1]) <= self.radius(np.float64(self.widest))

    def _angle(self, radius: np.ndarray) -> np.ndarray:
        low, high = np.zeros_like(radius), np.full_like(radius, self.widest)
        theta = np.minimum(radius, high)
        for _ in range(STEPS):
            error = self.radius(theta) - radius
            if np.abs(error).max(initial=0.0) <= 1e-14:
                break
            low, high = np.where(error < 0, theta, low), np.where(error > 0, theta, high)
            t = theta * theta
            slope = 1 + t * (3 * self.k1 + t * (5 * self.k2 + t * (7 * self.k3 + t * 9 * self.k4)))
            with np.errstate(divide="ignore", invalid="ignore"):
                newton = theta - error / slope
            theta = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        return theta


@dataclass(frozen=True)
class Panorama:
    """An equirectangular image."""

    is_wide = True

    def point(self, d: np.ndarray) -> np.ndarray:
        """Return longitude and latitude (..., 2) [radian, to the right and down] of directions (..., 3) of arbitrary length."""
        return np.stack([np.arctan2(d[..., 0], d[..., 2]), np.arctan2(d[..., 1], np.hypot(d[..., 0], d[..., 2]))], axis=-1)

    def direction(self, xy: np.ndarray) -> np.ndarray:
        """Return unit directions (..., 3) of image points (..., 2)."""
        longitude, latitude = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
        level = np.cos(latitude)
        return np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], axis=-1)

    def sees(self, xy: np.ndarray) -> np.ndarray:
        """Return whether image points (..., 2) lie between the poles."""
        return np.abs(xy[..., 1]) <= np.pi / 2
