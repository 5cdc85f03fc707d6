"""Photographs of a ball of many colours with a sheen, over white: what the tests of radiance fields share."""

from __future__ import annotations

import numpy as np
from sampled_fields import CUBE

from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatch, RayBatches
from mivol.photos import Camera, Photo
from mivol.photos.camera import intrinsics

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])
WHITE = np.ones(3, np.float32)


def ball(n: int = 24) -> SphericalGrid:
    """A sphere of many colours with a sheen that goes with the direction."""
    g = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    sh = np.zeros((n, n, n, 4, 3))
    sh[..., 0, :] = np.stack([np.sin(3 * x), np.cos(4 * y), np.sin(3 * z + 1)], axis=-1)
    sh[..., 2, :] = 0.4
    return SphericalGrid.from_dense(60 * (0.6 - np.sqrt(x * x + y * y + z * z)), sh, CUBE)


def camera(k: float, side: int = 48) -> Camera:
    """A pinhole on a sphere of radius 3, elsewhere for each number."""
    back = np.array([np.cos(0.7 * k), np.sin(0.7 * k), 0.9 * np.cos(1.9 * k)]) * 3
    z = back / np.linalg.norm(back)
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), back
    return Camera(intrinsics(1.3 * side, 1.3 * side, side / 2, side / 2), (side, side), pose)


def photo(field: SphericalGrid, k: float, side: int = 48) -> Photo:
    """What that pinhole sees of a field, over white."""
    seen = render_view(field, camera(k, side), WHITE)
    return Photo(f"view {k}", np.clip(seen.image, 0, 1), seen.opacity, None, camera(k, side), WHITE)


PLAN = RadiancePlan((RadianceStage(12, 60, 2, 4, 24), RadianceStage(24, 90, 1, 4, 48)), degree=1, random_background=False)


def error_of(fit: Fit, k: float = 2.5) -> float:
    """Mean squared error of a view between those that were fitted."""
    return float(np.mean((np.clip(render_view(fit.problem.field, camera(k), WHITE).image, 0, 1) - photo(ball(), k).image) ** 2))


def fitted(batches: RayBatches, plan: RadiancePlan, steps: int | None = None, fit: Fit | None = None) -> Fit:
    """A fit after so many steps; all by default."""
    fit = fit or begin_fit(RadianceProblem(batches, BOX, plan), plan.optimizer, plan.course())
    while fit.next_iteration < (plan.steps if steps is None else steps):
        fit.advance()
    fit.problem.set_reals(fit.run.reals)
    return fit


def draw_tiles(batches: RayBatches, shrink: int, views: np.ndarray, tiles: int, rng: np.random.Generator) -> RayBatch:
    """The rays of ``tiles`` tiles of each of some views."""
    return batches.make_tiles(shrink, views, batches.draw_corners(shrink, views, tiles, rng))
