"""Initial Gaussians: at the points of a sparse reconstruction, or at random points that may hold matter.

References: Kerbl et al. 2023, section 5.1 (scales from the nearest neighbours, opacity 0.1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import logit

from mivol.errors import MivolError
from mivol.optim.gaussians.density_control import CloudArrays
from mivol.photos import Photo, Photos, project
from mivol.photos.region import FEWEST_POINTS, count_views

OPACITY = 0.1
SH_0 = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic."""

ROUNDS = 60
"""Maximum number of rounds; each draws as many points as requested, of which alpha rejects some."""

SHARE = 0.5
"""Share of the views whose images must contain a point."""


def find_start_points(photos: Photos, count: int, seed: int) -> tuple[np.ndarray, str]:
    """Initial positions (N, 3) [length], and a description of their source.

    The points of a reconstruction unchanged, if it has enough; otherwise ``count`` random points in the box. With alpha, the
    random points avoid places that are transparent in some view.

    Raises:
        MivolError: alpha leaves no part of the box.
    """
    points = photos.survey.points
    if points is not None and len(points) >= FEWEST_POINTS:
        inside = ((points >= photos.box[0]) & (points <= photos.box[1])).all(axis=1)
        return points[inside], f"{int(inside.sum())} points of the reconstruction in the box"
    rng = np.random.default_rng((seed, 1))
    if any(view.alpha is None for view in photos.views):
        return rng.uniform(*photos.box, (count, 3)), f"{count} random points in the box"
    accepted = [np.zeros((0, 3))]
    for _ in range(ROUNDS):
        drawn = rng.uniform(*photos.box, (count, 3))
        accepted.append(drawn[_may_be_matter(photos.views, drawn)])
        if sum(map(len, accepted)) >= count:
            break
    points = np.concatenate(accepted)[:count]
    if len(points) < 4:
        raise MivolError("alpha leaves no part of the box that all views show as matter: check the box and the cameras.")
    return points, f"{len(points)} random points that no view shows as transparent"


def make_start_cloud(places: np.ndarray, views: Sequence[Photo], degree: int) -> CloudArrays:
    """Round Gaussians of opacity 0.1, scaled by the distances of three neighbours, with the mean colour of the views.

    Args:
        places: (N, 3), at least 4 positions [length].
        views: photographs for the colours.
        degree: of the harmonics.

    Raises:
        MivolError: fewer than 4 positions.
    """
    if len(places) < 4:
        raise MivolError(f"found {len(places)} initial points, expected at least 4 to derive the scales: give more points.")
    far = cKDTree(places).query(places, k=4)[0][:, 1:]
    # Coincident points would have no size, and no derivative of the size.
    scale = np.maximum(np.sqrt((far**2).mean(axis=1)), 1e-3 * np.median(far))
    harmonics = np.zeros((len(places), (degree + 1) ** 2, 3), np.float32)
    harmonics[:, 0] = (_mean_colour(views, places) - 0.5) / SH_0
    quaternions = np.zeros((len(places), 4), np.float32)
    quaternions[:, 0] = 1
    return {
        "means": places.astype(np.float32),
        "log_scales": np.repeat(np.log(scale)[:, None], 3, axis=1).astype(np.float32),
        "quaternions": quaternions,
        "opacity_logits": np.full(len(places), logit(OPACITY), np.float32),
        "harmonics": harmonics,
    }


def _may_be_matter(views: Sequence[Photo], points: np.ndarray) -> np.ndarray:
    """Whether enough views contain each point (N, 3), and no view shows the point as transparent."""
    accepted = count_views([view.camera for view in views], points) >= SHARE * len(views)
    for view in views:
        visible, row, column = _look_up(view, points)
        accepted &= ~visible | (view.alpha[row, column] > 0)
    return accepted


def _mean_colour(views: Sequence[Photo], points: np.ndarray) -> np.ndarray:
    """(N, 3) mean colour over the views containing a point; grey without such views. Occlusion is ignored."""
    total, count = np.full((len(points), 3), 0.5), np.ones(len(points))
    for view in views:
        visible, row, column = _look_up(view, points)
        total[visible] += view.image[row, column][visible]
        count += visible
    return total / count[:, None]


def _look_up(view: Photo, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether a view contains points, and the pixel of each point (0, 0 outside the view)."""
    x, depth = project(view.camera, points)
    with np.errstate(invalid="ignore"):
        visible = (depth > 0) & ((x >= 0) & (x < view.camera.size)).all(axis=1)
    column, row = np.where(visible[:, None], x, 0).astype(int).T
    return visible, row, column
