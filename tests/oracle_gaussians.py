"""Gaussians that rays are traced through, in float64 NumPy, written to be read: no cells, no lists; all rays ask all Gaussians.

It shares no code with mivol. Where each Gaussian is cut can be frozen, so that finite differences see a smooth function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import expit, ndtr

Floats = NDArray[np.float64]

REACH, MOST_OPAQUE = 4.0, 0.999
"""Standard deviations at which a Gaussian ends; opacities above it count as it."""


@dataclass(frozen=True)
class Cloud:
    """Pre-images of N Gaussians, float64, named as mivol names them."""

    means: Floats
    log_scales: Floats
    quaternions: Floats
    opacity_logits: Floats

    @classmethod
    def of(cls, gaussians: object) -> Cloud:
        return cls(*(np.asarray(getattr(gaussians, name), np.float64) for name in cls.__dataclass_fields__))

    def moved(self, name: str, change: Floats) -> Cloud:
        return Cloud(**{**vars(self), name: getattr(self, name) + change})

    def whitening(self) -> Floats:
        """(N, 3, 3): W (x - mean) has length 1 at one standard deviation."""
        turn = Rotation.from_quat(self.quaternions[:, [1, 2, 3, 0]]).as_matrix()
        return np.swapaxes(turn, 1, 2) / np.exp(self.log_scales)[:, :, None]


@dataclass(frozen=True)
class Cut:
    """Where Gaussians are cut, (rays, N) each: whether a line reaches them, and up to which whitened place on either side."""

    hits: NDArray[np.bool_]
    half: Floats
    starts: NDArray[np.bool_]
    ends: NDArray[np.bool_]


@dataclass(frozen=True)
class Lines:
    """What each Gaussian sees of each line, (rays, N)."""

    speed: Floats
    peak: Floats
    m2: Floats
    depth: Floats


def see(cloud: Cloud, o: Floats, d: Floats) -> Lines:
    """Lines o + t d, (rays, 3) each, d of unit length."""
    W = cloud.whitening()
    q = np.einsum("nij,rnj->rni", W, o[:, None] - cloud.means)
    v = np.einsum("nij,rj->rni", W, d)
    speed = np.linalg.norm(v, axis=-1)
    peak = -(q * v).sum(-1) / speed**2
    m2 = ((q + peak[..., None] * v) ** 2).sum(-1)
    opacity = np.minimum(expit(cloud.opacity_logits), MOST_OPAQUE)
    return Lines(speed, peak, m2, -np.log1p(-opacity * np.exp(-m2 / 2)))


def extinction(cloud: Cloud, p: Floats, w: Floats, reach: float = REACH) -> Floats:
    """(rays, N) extinctions [1/length] at points, for light along w."""
    line = see(cloud, p, w)
    s = line.peak * line.speed
    bell = np.exp(-(s**2) / 2) / np.sqrt(2 * np.pi)
    return np.where(line.m2 + s**2 <= reach**2, line.depth * line.speed * bell, 0.0)


def find_cut(cloud: Cloud, o: Floats, d: Floats, t0: Floats, t1: Floats) -> Cut:
    """Where Gaussians of ``REACH`` are cut by themselves, and where by the interval."""
    line = see(cloud, o, d)
    half = np.sqrt(np.maximum(REACH**2 - line.m2, 0))
    low, high = ((t[:, None] - line.peak) * line.speed for t in (t0, t1))
    hits = (line.m2 < REACH**2) & (np.minimum(high, half) > np.maximum(low, -half))
    return Cut(hits, half, low < -half, high > half)


def optical_depth(cloud: Cloud, o: Floats, d: Floats, t0: Floats, t1: Floats, cut: Cut | None = None) -> Floats:
    """(rays,) optical depths of intervals; with the cut of other Gaussians, if one is given."""
    cut = cut or find_cut(cloud, o, d, t0, t1)
    line = see(cloud, o, d)
    low, high = ((t[:, None] - line.peak) * line.speed for t in (t0, t1))
    low, high = np.where(cut.starts, -cut.half, low), np.where(cut.ends, cut.half, high)
    return np.where(cut.hits, line.depth * (ndtr(high) - ndtr(low)), 0.0).sum(axis=1)


# -- Colours, in the order of peaks ------------------------------------------------------------------------------------------


def light_of_codes(code: Floats) -> Floats:
    """IEC 61966-2-1."""
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0) + 0.055) / 1.055) ** 2.4)


def harmonics_along(d: Floats) -> Floats:
    """(rays, 16) real spherical harmonics up to degree 3 of unit directions, by polynomials and their normalisation."""
    x, y, z = d.T
    bands = [
        (1 / 4, [1 + 0 * x]),
        (3 / 4, [-y, z, -x]),
        (15 / 4, [x * y, -y * z, (3 * z * z - 1) / np.sqrt(12), -x * z, (x * x - y * y) / 2]),
        (
            7 / 16,
            [
                -np.sqrt(5 / 2) * y * (3 * x * x - y * y),
                np.sqrt(60) * x * y * z,
                -np.sqrt(3 / 2) * y * (5 * z * z - 1),
                z * (5 * z * z - 3),
                -np.sqrt(3 / 2) * x * (5 * z * z - 1),
                np.sqrt(15) * z * (x * x - y * y),
                -np.sqrt(5 / 2) * x * (x * x - 3 * y * y),
            ],
        ),
    ]
    return np.stack([np.sqrt(norm / np.pi) * value for norm, values in bands for value in values], axis=-1)


def colours(harmonics: Floats, d: Floats, space: str) -> Floats:
    """(rays, N, 3) radiances."""
    codes = np.maximum(0.5 + np.einsum("rb,nbc->rnc", harmonics_along(d)[:, : harmonics.shape[1]], harmonics), 0)
    return light_of_codes(codes) if space == "srgb" else codes


def order_of(cloud: Cloud, o: Floats, d: Floats) -> NDArray[np.int64]:
    """(rays, N) Gaussians from the nearest peak to the farthest; of the same peak the lower number first."""
    return np.argsort(see(cloud, o, d).peak, axis=1, kind="stable")


def composite(
    cloud: Cloud,
    colour: Floats,
    rays: tuple[Floats, Floats],
    span: tuple[Floats, Floats],
    frozen: tuple[NDArray[np.int64], Cut] | None = None,
    scale: float = 1.0,
) -> tuple[Floats, Floats]:
    """(rays, 3) light and (rays,) transmittance of intervals; in the order and with the cut of other Gaussians, if given."""
    order, cut = frozen or (order_of(cloud, *rays), find_cut(cloud, *rays, *span))
    line = see(cloud, *rays)
    low, high = ((t[:, None] - line.peak) * line.speed for t in span)
    low, high = np.where(cut.starts, -cut.half, low), np.where(cut.ends, cut.half, high)
    tau = scale * np.where(cut.hits, line.depth * (ndtr(high) - ndtr(low)), 0.0)
    tau, colour = np.take_along_axis(tau, order, 1), np.take_along_axis(colour, order[..., None], 1)
    front = np.cumsum(tau, axis=1) - tau
    return ((np.exp(-front) * -np.expm1(-tau))[..., None] * colour).sum(axis=1), np.exp(-tau.sum(axis=1))
