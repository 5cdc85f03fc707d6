r"""How a lens bends the image: the polynomial model of Brown and Conrady, as OpenCV, COLMAP and nerfstudio write it.

.. math:: x_d = x\,g + 2 p_1 x y + p_2 (r^2 + 2 x^2), \quad y_d = y\,g + p_1 (r^2 + 2 y^2) + 2 p_2 x y, \quad
   g = 1 + k_1 r^2 + k_2 r^4 + k_3 r^6 + k_4 r^8

Conventions. (x, y) are directions on the plane one length in front of the pinhole, x to the right, **y down** (OpenCV), before
the lens; (x_d, y_d) are the same after it, so that a pixel is (fx x_d + cx, fy y_d + cy). :math:`k_4` is nerfstudio's term in
r^8, not the denominator of OpenCV's rational model.

Source: Brown 1966 (Photogrammetric Engineering 32), decentring in the form of OpenCV's ``calib3d``.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from mivol.files.source import refusal

__all__ = ["Lens", "distort", "undistort", "Fisheye", "Panorama"]

NEWTON_STEPS = 20

CONVERGED = 1e-12
"""Residual [1] on the plane at distance 1: 1e-8 pixel at a focal length of 10 000 pixels, and 4 000 times the rounding."""


LEAST_TERM = 1e-30
"""A last coefficient below it moves no ray of any image; dividing by it could overflow."""

LARGEST_TERM = 1e6
"""Lenses have coefficients of the order of 1; beyond this the fold cannot be found."""


@dataclass(frozen=True)
class Lens:
    """Coefficients of the distortion; all 0: a pinhole."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    is_wide = False

    def __bool__(self) -> bool:
        """Whether it bends anything."""
        return any(astuple(self))

    @property
    def fold(self) -> float:
        """Radius r at which the radial part r g(r^2) stops growing: beyond it the image folds back; inf: nowhere."""
        return _fold_radius(self.k1, self.k2, self.k3, self.k4)


def distort(lens: Lens, xy: np.ndarray) -> np.ndarray:
    """Where the lens puts directions: (..., 2) on the plane at distance 1 to (..., 2) on it."""
    x, y = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
    r2 = x * x + y * y
    gain = _gain(lens, r2)
    xd = x * gain + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x)
    yd = y * gain + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y
    return np.stack([xd, yd], axis=-1)


def undistort(lens: Lens, xy: np.ndarray, name: object = "lens") -> np.ndarray:
    """The inverse of :func:`distort`, by Newton's method with the exact Jacobian.

    Args:
        lens: coefficients.
        xy: (..., 2) after the lens.
        name: named in the refusal.

    Returns:
        (..., 2) before the lens; distorted again it gives ``xy`` to 1e-12.

    Raises:
        MivolError: a point has no original on the side of the fold that holds the middle of the image.
    """
    target = np.asarray(xy, np.float64)
    if not lens:
        return target.copy()
    found = target.copy()
    for _ in range(NEWTON_STEPS):
        residual = distort(lens, found) - target
        if np.abs(residual).max(initial=0.0) <= CONVERGED:
            break
        found = found - _solve(lens, found, residual)
    wrong = ~(np.abs(distort(lens, found) - target).max(axis=-1) <= CONVERGED) | (np.linalg.norm(found, axis=-1) > lens.fold)
    if wrong.any():
        at = target[wrong].reshape(-1, 2)[0]
        raise refusal(
            name,
            f"a lens whose image folds back: nothing is seen at ({at[0]:.4g}, {at[1]:.4g}) times the focal length",
            "distortion that can be inverted over the whole image",
            "correct k1 to k4, p1, p2, or crop the image",
        )
    return found


def _fold_radius(k1: float, k2: float, k3: float, k4: float) -> float:
    """The smallest r > 0 at which r (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) stops growing; infinite if it always grows."""
    slope = np.polynomial.Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    roots = slope.trim(LEAST_TERM).roots()
    squares = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1e-300)) & (roots.real > 0)]
    return float(np.sqrt(squares.min(initial=np.inf)))


def _gain(lens: Lens, r2: np.ndarray) -> np.ndarray:
    return 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * (lens.k3 + r2 * lens.k4)))


def _solve(lens: Lens, xy: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """J^-1 residual; infinite where J is singular, so that the check of the result sees it."""
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
"""Of a search that halves its bracket where Newton's method would leave it: as many halvings leave pi / 2^60."""


@dataclass(frozen=True)
class Fisheye:
    """Coefficients of a fisheye; all 0: the equidistant projection."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    is_wide = True

    @property
    def widest(self) -> float:
        """The angle from the axis up to which the image grows, at most pi; what would lie beyond is not in the image."""
        return min(np.pi, _fold_radius(self.k1, self.k2, self.k3, self.k4))

    def radius(self, theta: np.ndarray) -> np.ndarray:
        """Distance from the middle of the image, in focal lengths, of directions at angles from the axis [radian]."""
        t = theta * theta
        return theta * (1 + t * (self.k1 + t * (self.k2 + t * (self.k3 + t * self.k4))))

    def point(self, d: np.ndarray) -> np.ndarray:
        """Where directions (..., 3) of any length lie in the image (..., 2); NaN where they do not."""
        across = np.hypot(d[..., 0], d[..., 1])
        theta = np.arctan2(across, d[..., 2])
        radius = np.where(theta <= self.widest, self.radius(theta), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.where(across[..., None] > 0, d[..., :2] / across[..., None], 0.0)
        return unit * radius[..., None]

    def direction(self, xy: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of image points (..., 2), to 1e-12; beyond the image those of its rim.

        Safeguarded Newton: the radius grows with the angle up to :attr:`widest`, so a bracket always holds the solution.
        """
        xy = np.asarray(xy, np.float64)
        radius = np.hypot(xy[..., 0], xy[..., 1])
        theta = self._angle(np.minimum(radius, self.radius(np.float64(self.widest))))
        with np.errstate(divide="ignore", invalid="ignore"):
            unit = np.where(radius[..., None] > 0, xy / radius[..., None], 0.0)
        return np.concatenate([unit * np.sin(theta)[..., None], np.cos(theta)[..., None]], axis=-1)

    def sees(self, xy: np.ndarray) -> np.ndarray:
        """Whether image points (..., 2) show a direction."""
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
        """Longitude and latitude (..., 2) [radian, to the right and down] of directions (..., 3) of any length."""
        return np.stack([np.arctan2(d[..., 0], d[..., 2]), np.arctan2(d[..., 1], np.hypot(d[..., 0], d[..., 2]))], axis=-1)

    def direction(self, xy: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of image points (..., 2)."""
        longitude, latitude = np.moveaxis(np.asarray(xy, np.float64), -1, 0)
        level = np.cos(latitude)
        return np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], axis=-1)

    def sees(self, xy: np.ndarray) -> np.ndarray:
        """Whether image points (..., 2) show a direction: all do between the poles."""
        return np.abs(xy[..., 1]) <= np.pi / 2
