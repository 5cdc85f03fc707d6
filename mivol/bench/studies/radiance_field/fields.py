"""Radiance fields to measure: a thin shell, a fog, and a fitted scene, all of harmonics of degree 2 in [-1, 1]^3."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from mivol.bench.extinctions import DATA, TO_WORLD
from mivol.bench.studies.radiance_field.size import Size
from mivol.bench.studies.radiance_field.views import BOX, photographed, ring
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.loop import reconstruct
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import load_photos

__all__ = ["FIELDS", "field_of"]


def places(n: int) -> list[np.ndarray]:
    """z, y and x of n^3 nodes in [-1, 1]^3, (n, n, n) each."""
    g = (np.arange(n) + 0.5) / n * 2 - 1
    return np.meshgrid(g, g, g, indexing="ij")


def colours(n: int, seed: int = 0) -> np.ndarray:
    """Smooth harmonics (n, n, n, 9, 3): colours about 0.5, a fifth of them with the direction."""
    z, y, x = (a.astype(np.float32) for a in places(n))
    rng = np.random.default_rng(seed)
    sh = np.empty((n, n, n, 9, 3), np.float32)
    for b in range(9):
        for c in range(3):
            k, phase = rng.uniform(-4, 4, 3), rng.uniform(0, 6)
            sh[..., b, c] = (0.8 if b == 0 else 0.15) * np.sin(k[0] * x + k[1] * y + k[2] * z + phase)
    return sh


def shell(size: Size) -> tuple[SphericalGrid, str]:
    """A sphere of 0.7 whose skin of two voxels is nearly opaque."""
    n = size.resolution
    z, y, x = places(n)
    density = np.clip(2.5 * n * (1 - np.abs(np.sqrt(x * x + y * y + z * z) - 0.7) * n / 2.5), -10, None)
    keep = density > -10
    return SphericalGrid.from_dense(density, colours(n), TO_WORLD, keep), "a shell of radius 0.7"


def fog(size: Size) -> tuple[SphericalGrid, str]:
    """A fog that fills the box."""
    n = size.resolution
    z, y, x = places(n)
    return SphericalGrid.from_dense(
        1 + 0.5 * np.sin(5 * x) * np.sin(4 * y + z), colours(n, 1), TO_WORLD
    ), "a fog of extinction 1"


def fitted(size: Size) -> tuple[SphericalGrid, str]:
    """The chair of NeRF's synthetic scenes, fitted for a minute; without data, views of the shell."""
    quarter = size.chair_steps // 4
    stages = tuple(RadianceStage(size.resolution // k, quarter * s, k, 8, 128) for k, s in ((4, 1), (2, 1), (1, 2)))
    path = DATA / "multiview" / "chair"
    if path.is_dir():
        photos = load_photos(path, split="train", background="white", scale=0.5)
        views, box, origin = RayBatches.of(photos.views, (1, 2, 4)), photos.silhouette_box(), "NeRF's chair"
    else:
        photos = photographed(shell(size)[0], ring(size.side, 24))
        views, box, origin = RayBatches.of(photos, (1, 2, 4)), BOX, "views of the shell (no data folder)"
    plan = RadiancePlan(stages)
    problem = RadianceProblem(views, box, plan)
    reconstruct(problem, plan.optimizer, plan.course())
    # Into the box of the others, dense: the peer has nothing else.
    density, sh = problem.field.to_dense()
    density, sh = (centred(a, size.resolution) for a in (density * problem.unit, sh))
    keep = density > 0
    keep |= np.roll(keep, 1, 0) | np.roll(keep, -1, 0) | np.roll(keep, 1, 1) | np.roll(keep, -1, 1)
    return SphericalGrid.from_dense(density, sh, TO_WORLD, keep), f"{origin}, fitted in {size.chair_steps} steps"


def centred(values: np.ndarray, n: int) -> np.ndarray:
    """Put an array in the middle of n^3 nodes."""
    out = np.zeros((n, n, n, *values.shape[3:]), np.float32)
    low = [(n - s) // 2 for s in values.shape[:3]]
    out[tuple(slice(a, a + s) for a, s in zip(low, values.shape[:3], strict=True))] = values[:n, :n, :n]
    return out


FIELDS: dict[str, Callable[[Size], tuple[SphericalGrid, str]]] = {"shell": shell, "fog": fog, "fitted": fitted}


@cache
def field_of(name: str, size: Size) -> tuple[SphericalGrid, str]:
    """A field and where it is from, made once."""
    return FIELDS[name](size)
