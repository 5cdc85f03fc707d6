"""Procedural volumes: seeded densities for demos and tests, with the same numbers on every machine.

Conventions. A recipe maps points (..., 3) in the unit cube, as (x, y, z), and a generator to values in [0, 1]. Volumes sample
the recipe at voxel centres, so every resolution shows the same object. PROCEDURAL lists the recipes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import KDTree

from mivol.errors import MivolError


def tangle(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Soft blobs with filaments wound around them: smooth regions, thin structures and empty space.

    Seven anisotropic Gaussians have random frames. Three tubes of Gaussian cross-section follow closed curves
    c + sum_k a_k cos(2 pi k s) + b_k sin(2 pi k s), k = 1, 2.
    """
    total = np.zeros(p.shape[:-1])
    for _ in range(7):
        centre, radii = rng.uniform(0.3, 0.7, 3), rng.uniform(0.05, 0.13, 3)
        frame, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        total += rng.uniform(0.25, 0.7) * np.exp(-0.5 * np.sum(((p - centre) @ frame / radii) ** 2, axis=-1))
    for _ in range(3):
        total = np.maximum(total, tube(p, rng))
    return np.clip(total, 0.0, 1.0) * inside(p)


def tube(p: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """exp(-1/2 (distance to a random closed curve / 0.022)^2), with the curve sampled at 160 points."""
    s = 2.0 * np.pi * np.arange(160)[:, None] / 160
    curve = 0.5 + sum(
        np.outer(np.cos(k * s), rng.uniform(-0.26, 0.26, 3)) / k + np.outer(np.sin(k * s), rng.uniform(-0.26, 0.26, 3)) / k
        for k in (1, 2)
    )
    nearest, _ = KDTree(curve).query(p)
    return np.exp(-0.5 * (nearest / 0.022) ** 2)


def inside(p: np.ndarray) -> np.ndarray:
    """A window: 1 inside the cube, smoothly 0 towards its faces, which keeps the object off the box."""
    from_middle = np.max(np.abs(p - 0.5), axis=-1)
    return np.clip((0.48 - from_middle) / 0.06, 0.0, 1.0)


PROCEDURAL: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {"tangle": tangle}


def make_procedural(name: str, shape: Sequence[int], seed: int, peak: float) -> np.ndarray:
    """Make a procedural volume.

    Args:
        name: key of PROCEDURAL.
        shape: (Z, Y, X).
        seed: selects the object.
        peak: largest possible value [unit of the field].

    Returns:
        (Z, Y, X, 1) float32 in [0, peak].

    Raises:
        MivolError: unknown name.
    """
    if name not in PROCEDURAL:
        raise MivolError(f'unknown procedural volume "{name}": known are {", ".join(PROCEDURAL)}.')
    axes = [(np.arange(n) + 0.5) / n for n in shape]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    values = PROCEDURAL[name](np.stack([x, y, z], axis=-1), np.random.default_rng(seed))
    return (peak * values[..., None]).astype(np.float32)
