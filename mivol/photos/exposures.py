"""How much the exposures of photographs differ, judged by points that several photographs show.

Conventions. A gain is a factor on the values of a photograph, sRGB codes or radiance. Logarithms are natural. The brightness of
a point in a photograph is the mean of the three channels of its pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mivol.photos.camera import project
from mivol.photos.dataset import Photo

DARK, BRIGHT = 0.04, 0.96
"""Brightness of a pixel that shows a gain: darker ones are noise, brighter ones are cut off."""

ROUNDS = 8
"""Rounds between the brightness of points and the gains of photographs."""

FEWEST = 30
"""Fewest points of a photograph that count for its gain."""

NEIGHBOURS = 2
"""Nearest cameras that predict the gain of a photograph."""

DIFFER = 0.08
"""Unpredicted gains from which photographs need gains in a fit: of sRGB codes, a fifth of the exposure."""


@dataclass(frozen=True)
class Exposures:
    """Gains that explain the brightness of common points, in natural logarithms.

    Attributes:
        spread: standard deviation of the gains.
        unpredicted: standard deviation of their differences from what the ``NEIGHBOURS`` nearest cameras predict, weighted by
            the inverse distance. Colours that depend on the direction can show what neighbours predict without gains.
    """

    spread: float
    unpredicted: float

    @property
    def differ(self) -> bool:
        """Whether a fit needs gains."""
        return self.unpredicted >= DIFFER


def measure_exposures(views: Sequence[Photo]) -> Exposures | None:
    """Find gains of the photographs with at least ``FEWEST`` common points; None if these are fewer than half of all."""
    seen = [_read_brightness(view) for view in views]
    number = np.repeat(np.arange(len(views)), [len(values) for _, values in seen])
    positions, brightness = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    _, point, counts = np.unique(positions, axis=0, return_inverse=True, return_counts=True)
    shared = (counts[point.ravel()] > 1) & (np.bincount(number, minlength=len(views))[number] >= FEWEST)
    named, number = np.unique(number[shared], return_inverse=True)
    if len(named) < max(NEIGHBOURS + 1, len(views) / 2):
        return None
    point, logs, gains = point.ravel()[shared], np.log(brightness[shared]), np.zeros(len(named))
    for _ in range(ROUNDS):
        means = np.bincount(point, logs - gains[number]) / np.maximum(np.bincount(point), 1)
        gains = np.array([np.median((logs - means[point])[number == view]) for view in range(len(named))])
        gains -= gains.mean()
    origins = np.array([views[view].camera.origin for view in named])
    distance, nearest = (found[:, 1:] for found in cKDTree(origins).query(origins, NEIGHBOURS + 1))
    weight = 1 / np.maximum(distance, 1e-9 * np.ptp(origins))
    predicted = (weight * gains[nearest]).sum(axis=1) / weight.sum(axis=1)
    return Exposures(float(gains.std()), float((gains - predicted).std()))


def _read_brightness(view: Photo) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) of the visible points of a photograph, and the brightness of their pixels (N,)."""
    if view.points is None or not len(view.points):
        return np.empty((0, 3)), np.empty(0)
    pixels = np.floor(project(view.camera, view.points)[0])
    inside = ((pixels >= 0) & (pixels < view.camera.size)).all(axis=1)
    column, row = pixels[inside].astype(int).T
    brightness = view.image.mean(axis=-1)[row, column]
    valid = (brightness > DARK) & (brightness < BRIGHT)
    if view.mask is not None:
        valid &= view.mask[row, column]
    return view.points[inside][valid], brightness[valid]
