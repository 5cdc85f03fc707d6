"""Slow twin of the walk: optical depths of rays in float64 NumPy, with the scale of the rounding error of float32."""

from __future__ import annotations

import itertools
import math

import numpy as np

from mivol.bench.extinctions import TO_WORLD

__all__ = ["exact_tau"]


def exact_tau(values: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Optical depth of rays in float64 NumPy, and the measure of its error.

    A ray crosses planes through voxel centres. Between two adjacent planes a trilinear field is a cubic along the ray, and two
    Gauss points integrate this cubic exactly.

    Args:
        values: (Z, Y, X) extinction in the box ``TO_WORLD``.
        o, d: origins and directions (n, 3).

    Returns:
        Integrals of sigma and of |sigma| + |grad sigma|, with the gradient per voxel: (n,) each.
    """
    size = np.array(values.shape[::-1])
    chunk = max(1, (1 << 20) // int(size.sum()))
    parts = [_exact_tau(values, size, o[i : i + chunk], d[i : i + chunk]) for i in range(0, len(o), chunk)]
    return tuple(np.concatenate(p) for p in zip(*parts, strict=True))


def _exact_tau(values: np.ndarray, size: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inverse = np.linalg.inv(TO_WORLD)
    q = (o @ inverse[:3, :3].T + inverse[:3, 3]) * size - 0.5
    v = d @ inverse[:3, :3].T * size
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = np.sort(np.stack([(-0.5 - q) / v, (size - 0.5 - q) / v]), axis=0)
        planes = np.concatenate([(np.arange(n) - q[:, a, None]) / v[:, a, None] for a, n in enumerate(size)], axis=1)
    t0 = np.maximum(faces[0].max(axis=1), 0)[:, None]
    t1 = np.maximum(faces[1].min(axis=1)[:, None], t0)
    t = np.sort(np.concatenate([t0, np.clip(planes, t0, t1), t1], axis=1), axis=1)
    length = np.diff(t, axis=1)
    tau, measure = np.zeros((2, len(o)))
    for g in (0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6):
        middle = t[:, :-1] + g * length
        sigma, slope = _trilinear(values, q[:, None] + middle[..., None] * v[:, None])
        tau += 0.5 * np.sum(length * sigma, axis=1)
        measure += 0.5 * np.sum(length * (np.abs(sigma) + slope), axis=1)
    return tau, measure


def _trilinear(values: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and length of the gradient of a field at lattice points (..., 3), with clamped borders."""
    low = np.floor(q).astype(int)
    f = q - low
    sigma, slope = np.zeros(q.shape[:-1]), np.zeros(q.shape)
    for bits in itertools.product((0, 1), repeat=3):
        x, y, z = (np.clip(low[..., a] + bits[a], 0, values.shape[2 - a] - 1) for a in range(3))
        corner = values[z, y, x].astype(np.float64)
        w = [f[..., a] if bits[a] else 1 - f[..., a] for a in range(3)]
        sigma += corner * w[0] * w[1] * w[2]
        for a in range(3):
            slope[..., a] += corner * w[a - 1] * w[a - 2] * (1 if bits[a] else -1)
    return sigma, np.linalg.norm(slope, axis=-1)
