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
