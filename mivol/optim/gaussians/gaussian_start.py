"""Where a fit of Gaussians begins: at the points of a sparse reconstruction, or at random where the photographs show something.

References: Kerbl et al. 2023, section 5.1 (scales by the nearest neighbours, opacity 0.1).
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

__all__ = ["make_start_cloud", "find_start_points"]

OPACITY = 0.1
SH_0 = 0.5 / math.sqrt(math.pi)
"""The constant harmonic."""

ROUNDS = 60
"""Times that as many points as are wanted are drawn in the box before what alpha leaves of them must do."""

SHARE = 0.5
"""Share of the views that must see a point."""


def find_start_points(photos: Photos, count: int, seed: int) -> tuple[np.ndarray, str]:
    """Where Gaussians begin (N, 3) [length], and where that comes from, for people.

    The points of a reconstruction, as they are, where there are enough of them; else ``count`` points drawn evenly from the box
    or, of photographs with alpha, from the part of it that no view sees through.

    Raises:
        MivolError: alpha leaves nothing of the box.
    """
    points = photos.survey.points
    if points is not None and len(points) >= FEWEST_POINTS:
        inside = ((points >= photos.box[0]) & (points <= photos.box[1])).all(axis=1)
        return points[inside], f"{int(inside.sum())} points of the reconstruction that lie in the box"
    rng = np.random.default_rng((seed, 1))
    if any(view.alpha is None for view in photos.views):
        return rng.uniform(*photos.box, (count, 3)), f"{count} points at random in the box"
    found = [np.zeros((0, 3))]
    for _ in range(ROUNDS):
        drawn = rng.uniform(*photos.box, (count, 3))
        found.append(drawn[_may_be_matter(photos.views, drawn)])
        if sum(map(len, found)) >= count:
            break
    kept = np.concatenate(found)[:count]
    if len(kept) < 4:
        raise MivolError("alpha leaves no place in the box where all views show something: check the box and the cameras.")
    return kept, f"{len(kept)} points at random where no view sees through"


def make_start_cloud(places: np.ndarray, views: Sequence[Photo], degree: int) -> CloudArrays:
    """Round Gaussians of opacity 0.1, as large as three neighbours are far, of the mean colour that views show there.

    Args:
        places: (N, 3), at least 4 [length].
        views: what they are seen in.
        degree: of the harmonics.

    Raises:
        MivolError: fewer than 4 places.
    """
    if len(places) < 4:
        raise MivolError(f"found {len(places)} points to begin with; 4 are needed to tell how large Gaussians are: give more.")
    far = cKDTree(places).query(places, k=4)[0][:, 1:]
    # Points that coincide would have no size at all, and no derivative of it.
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
    """Points (N, 3) that enough views see, and none of them where it is transparent."""
    kept = count_views([view.camera for view in views], points) >= SHARE * len(views)
    for view in views:
        seen, row, column = _looked_up(view, points)
        kept &= ~seen | (view.alpha[row, column] > 0)
    return kept


def _mean_colour(views: Sequence[Photo], points: np.ndarray) -> np.ndarray:
    """(N, 3) mean over the views that see a point of the colour there; grey where none does. What is in front is not known."""
    total, count = np.full((len(points), 3), 0.5), np.ones(len(points))
    for view in views:
        seen, row, column = _looked_up(view, points)
        total[seen] += view.image[row, column][seen]
        count += seen
    return total / count[:, None]


def _looked_up(view: Photo, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether a view shows points, and the pixel of each (0, 0 where it does not)."""
    x, depth = project(view.camera, points)
    with np.errstate(invalid="ignore"):
        seen = (depth > 0) & ((x >= 0) & (x < view.camera.size)).all(axis=1)
    column, row = np.where(seen[:, None], x, 0).astype(int).T
    return seen, row, column
