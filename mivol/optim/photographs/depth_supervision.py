r"""What the points of a sparse reconstruction say of distances: a ray through one that a photograph saw ends there.

.. math:: E = -\log\big((1 - \varepsilon)\,(T(d - m) - T(d + m)) + \varepsilon\big)

d is the distance of a point from a photograph in which it was found, T the transmittance of the ray through it, and m by how
much d may be off. The difference is the probability that the ray ends there; of a share of the points nothing is believed, so
that derivatives are bounded and a wrong point is outvoted. In front of the point E takes density away, about it E adds some,
and of what lies behind it nothing is said.

Conventions. Lengths are the world's. A point is looked at as two rays, which end before it and behind it; all that is needed of
either is its transmittance, so that a fit walks them as it walks the rays of pixels.

Reference: Deng et al. 2022 (DS-NeRF), where the share of light that ends at each distance is compared with a Gaussian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.line_integrals.radiance_field import RayBundle

__all__ = ["DepthRays", "depth_loss_gradient", "sample_depth_rays"]

WRONG = 0.05
"""Share of the points of which nothing is believed."""

OFF = 0.01
"""By how much a distance may be off, as a share of it, beside a voxel."""

EACH = 64
"""Points that are drawn of a photograph in a step."""


@dataclass
class DepthRays:
    """Points as rays.

    Attributes:
        rays: those that end before the points, then, in the same order, those that end behind them.
        count: points.
    """

    rays: RayBundle
    count: int


def sample_depth_rays(
    points: Sequence[np.ndarray],
    origins: np.ndarray,
    box: np.ndarray,
    levels: int,
    voxel: float,
    rng: np.random.Generator,
) -> DepthRays | None:
    """Draw points of each of some photographs; None where none of them has any in the boxes.

    Args:
        points: (K, 3) for each photograph, those that were found in it [length].
        origins: (V, 3) where the photographs were taken [length].
        box: (2, 3) the innermost of nested boxes [length].
        levels: how many there are.
        voxel: edge of a voxel of the innermost [length].
        rng: draws them.
    """
    drawn = [own[rng.integers(0, len(own), EACH)] if len(own) else np.zeros((0, 3)) for own in points]
    slot = np.repeat(np.arange(len(drawn)), [len(own) for own in drawn])
    places = np.concatenate(drawn)
    out = np.abs((places - box.mean(axis=0)) / (box[1] - box[0])).max(axis=1) * 2
    away = places - origins[slot]
    d = np.linalg.norm(away, axis=1)
    # A ray to a point where the photograph was taken has no direction.
    kept = (out <= 2 ** (levels - 1)) & (d > 0)
    if not kept.any():
        return None
    away, d, o = away[kept], d[kept], origins[slot[kept]]
    off = voxel * 2 ** np.ceil(np.log2(np.maximum(out[kept], 1))) + OFF * d
    twice = np.tile(np.arange(len(d)), 2)
    o, towards = mi.Point3f(*_columns(o[twice])), mi.Vector3f(*_columns((away / d[:, None])[twice]))
    ends = _real(np.concatenate([np.maximum(d - off, 0), d + off]))
    return DepthRays(RayBundle(o, towards, ends), len(d))


def depth_loss_gradient(T: mi.Float, count: int) -> mi.Float:
    """Derivatives of the mean of E over points by the transmittances of their rays (2 count), in the order of the rays."""
    number, n = dr.arange(mi.UInt32, 2 * count), dr.opaque(mi.UInt32, count)
    point = number % n
    ends = dr.gather(mi.Float, T, point) - dr.gather(mi.Float, T, point + n)
    slope = (1 - WRONG) / ((1 - WRONG) * ends + WRONG) / mi.Float(n)
    return dr.select(number < n, -slope, slope)


def _columns(rows: np.ndarray) -> list[mi.Float]:
    return [_real(column) for column in rows.T]


def _real(values: np.ndarray) -> mi.Float:
    return mi.Float(np.ascontiguousarray(values, np.float32))
