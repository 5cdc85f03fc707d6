r"""Depth supervision: points of a sparse reconstruction, at which rays of their photographs should end.

.. math:: E = -\log\big((1 - \varepsilon)\,(T(d - m) - T(d + m)) + \varepsilon\big)

d is the distance of a point from a photograph that shows the point, T the transmittance of the ray through the point, and m the
uncertainty of d. The difference is the probability that the ray ends at the point. A share epsilon of the points is assumed
wrong, so derivatives are bounded and a wrong point is outvoted. E removes density in front of the point, adds density around
it, and does not affect matter behind it.

Conventions. Lengths are in world units. Each point becomes two rays, which end before and behind the point. Only their
transmittance is needed, so a fit traverses these rays like the rays of pixels.

Reference: Deng et al. 2022 (DS-NeRF), who compare the distribution of light along the ray with a Gaussian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.line_integrals.radiance_field import RayBundle

OUTLIERS = 0.05
"""Assumed share of wrong points."""

UNCERTAINTY = 0.01
"""Uncertainty of a distance as a share of the distance, in addition to a voxel."""

POINTS_PER_VIEW = 64
"""Points per photograph in a step."""


@dataclass
class DepthRays:
    """Points as rays.

    Attributes:
        rays: rays that end before the points; then, in the same order, rays that end behind them.
        count: number of points.
    """

    rays: RayBundle
    count: int


def sample_depth_rays(
    points: Sequence[np.ndarray], origins: np.ndarray, box: np.ndarray, levels: int, voxel: float, rng: np.random.Generator
) -> DepthRays | None:
    """Draw points of each of some photographs; None if no drawn point lies in the boxes.

    Args:
        points: (K, 3) for each photograph, its visible points [length].
        origins: (V, 3) positions of the photographs [length].
        box: (2, 3) the innermost of nested boxes [length].
        levels: number of nested boxes.
        voxel: edge of a voxel of the innermost box [length].
        rng: draws the points.
    """
    drawn = [own[rng.integers(0, len(own), POINTS_PER_VIEW)] if len(own) else np.zeros((0, 3)) for own in points]
    slot = np.repeat(np.arange(len(drawn)), [len(own) for own in drawn])
    positions = np.concatenate(drawn)
    extent = np.abs((positions - box.mean(axis=0)) / (box[1] - box[0])).max(axis=1) * 2
    offset = positions - origins[slot]
    d = np.linalg.norm(offset, axis=1)
    # A point at the camera has no direction.
    inside = (extent <= 2 ** (levels - 1)) & (d > 0)
    if not inside.any():
        return None
    offset, d, o = offset[inside], d[inside], origins[slot[inside]]
    margin = voxel * 2 ** np.ceil(np.log2(np.maximum(extent[inside], 1))) + UNCERTAINTY * d
    twice = np.tile(np.arange(len(d)), 2)
    o, towards = mi.Point3f(*_columns(o[twice])), mi.Vector3f(*_columns((offset / d[:, None])[twice]))
    ends = _real(np.concatenate([np.maximum(d - margin, 0), d + margin]))
    return DepthRays(RayBundle(o, towards, ends), len(d))


def depth_loss_gradient(T: mi.Float, count: int) -> mi.Float:
    """Derivatives of the mean of E over points by the transmittances of their rays (2 count), in the order of the rays."""
    number, n = dr.arange(mi.UInt32, 2 * count), dr.opaque(mi.UInt32, count)
    point = number % n
    ends = dr.gather(mi.Float, T, point) - dr.gather(mi.Float, T, point + n)
    slope = (1 - OUTLIERS) / ((1 - OUTLIERS) * ends + OUTLIERS) / mi.Float(n)
    return dr.select(number < n, -slope, slope)


def _columns(rows: np.ndarray) -> list[mi.Float]:
    return [_real(column) for column in rows.T]


def _real(values: np.ndarray) -> mi.Float:
    return mi.Float(np.ascontiguousarray(values, np.float32))
