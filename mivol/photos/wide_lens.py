r"""Lenses whose image is no plane: fisheyes, which see half of all directions and more, and panoramas, which see all.

Conventions. A direction (x, y, z) is that of OpenCV's camera: x to the right, y **down**, z forward. An image point (x_d, y_d)
stands for the pixel (fx x_d + cx, fy y_d + cy), as with a lens that distorts a plane (:mod:`mivol.photos.lens`).

A fisheye puts a direction at the angle :math:`\theta` from the axis to the distance

.. math:: \theta_d = \theta\,(1 + k_1 \theta^2 + k_2 \theta^4 + k_3 \theta^6 + k_4 \theta^8)

from the middle, on the same side. A panorama puts longitude and latitude [radian] side by side: the axis is in the middle, and
x_d = 1 is one radian to the right.

Source: Kannala and Brandt 2006 (IEEE PAMI 28, eq. 6), with the coefficients of OpenCV's ``fisheye``; equirectangular images as
nerfstudio has them, -z of the camera in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Fisheye", "Panorama"]

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
        slope = np.polynomial.Polynomial([1, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4])
        roots = slope.trim(1e-30).roots()
        squares = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1e-300)) & (roots.real > 0)]
        return float(min(np.pi, np.sqrt(squares.min(initial=np.inf))))

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

