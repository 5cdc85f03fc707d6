"""What the cameras look at: a box, and between which distances their rays are inside it.

Conventions. A box is (2, 3) float64, low and high corner [length]. Nothing here reads a pixel: a lens only counts by its field
of view without distortion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera import Camera, is_seen, project, rays
from mivol.photos.lens import Panorama

__all__ = [
    *("box_of_points", "check_box", "check_views", "focus_of", "levels_holding", "middle_box", "near_far_of", "nested"),
    *("shared_box", "views_seeing", "within"),
]

SHARE = 0.9
"""Share of the views that must see a point for it to count."""

CELLS = 32
"""Points along each axis at which views are counted, twice: the box is known to 1/32 of itself."""

HELD = 0.99
"""Share of the points of a reconstruction that nested boxes hold: some of its points lie anywhere."""

FEWEST_POINTS = 100
"""Fewer points of a reconstruction say nothing of a box."""

PARALLEL = 1e-4
"""Smallest sum of squared sines, per view, of the axes with the direction they have in common: about 0.6 degrees."""


def focus_of(cameras: Sequence[Camera], name: object = "cameras") -> np.ndarray:
    """(3,) the point nearest to the axes of all cameras, by least squares; panoramas, which have none, look at their place.

    Raises:
        MivolError: axes that are parallel (or a single view), so that no point is nearest.
    """
    across = [np.eye(3) - (0 if isinstance(c.distortion, Panorama) else np.outer(c.forward, c.forward)) for c in cameras]
    total = np.sum(across, axis=0)
    if np.linalg.eigvalsh(total)[0] < PARALLEL * len(cameras):
        raise refusal(name, "cameras that all look in one direction", "views that cross", "say where things are with box=")
    return np.linalg.solve(total, np.sum([a @ c.origin for a, c in zip(across, cameras, strict=True)], axis=0))


def shared_box(cameras: Sequence[Camera], name: object = "cameras") -> np.ndarray:
    """The box about the region that most views share.

    A point counts where at least ``SHARE`` of the views see it, and where it is nearer to the point that the cameras look at
    (:func:`focus_of`) than the median camera: frustums have no end of their own.

    Raises:
        MivolError: parallel cameras, or views that share nothing.
    """
    focus = focus_of(cameras, name)
    reach = float(np.median([np.linalg.norm(c.origin - focus) for c in cameras]))
    box = np.array([focus - reach, focus + reach])
    for _ in range(2):
        step = (box[1] - box[0]) / CELLS
        points = np.stack(np.meshgrid(*[b + s * (np.arange(CELLS) + 0.5) for b, s in zip(box[0], step, strict=True)]), -1)
        points = points.reshape(-1, 3)
        points = points[np.linalg.norm(points - focus, axis=1) <= reach]
        seen = points[views_seeing(cameras, points) >= SHARE * len(cameras)]
        if len(seen) == 0:
            raise refusal(name, "views that share no region", "cameras that look at one thing", "give its place with box=")
        box = np.array([seen.min(axis=0) - step, seen.max(axis=0) + step])
    return box + np.array([step / 2, -step / 2])


MIDDLE = 0.45
"""Half the edge of the innermost box of a capture, in medians of the cameras' distances from what they look at: 0.4 to 0.5 were
best on photographs of one room; the levels around it hold the rest."""


def middle_box(cameras: Sequence[Camera], name: object = "cameras") -> np.ndarray:
    """The cube about what cameras look at, from which nested boxes begin; they may stand in it or in those around it.

    Raises:
        MivolError: parallel cameras, or cameras that all stand where they look.
    """
    focus = focus_of(cameras, name)
    half = MIDDLE * float(np.median([np.linalg.norm(c.origin - focus) for c in cameras]))
    if not half > 0:
        found = "cameras that all stand in one place"
        raise refusal(name, found, "views from several places", "say where things are with box=")
    return np.array([focus - half, focus + half])


def nested(box: np.ndarray, levels: int) -> list[np.ndarray]:
    """Boxes (2, 3) of the same middle, each of twice the extent of the one before."""
    middle = box.mean(axis=0)
    return [middle + 2**level * (box - middle) for level in range(levels)]


def levels_holding(box: np.ndarray, points: np.ndarray, most: int) -> int:
    """The fewest nested boxes that hold ``HELD`` of points (N, 3), and ``most`` where that many do not."""
    out = 2 * np.abs((points - box.mean(axis=0)) / (box[1] - box[0])).max(axis=1)
    return min(most, 1 + math.ceil(math.log2(max(1.0, np.percentile(out, 100 * HELD)))))


def within(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Those of points (N, 3) that lie in a box."""
    return points[((points >= box[0]) & (points <= box[1])).all(axis=1)]


def box_of_points(points: np.ndarray, share: float = 0.98, margin: float = 0.05) -> np.ndarray:
    """The box that holds the middle ``share`` of points (N, 3) along each axis, and ``margin`` of its size more on each side.

    Points of a sparse reconstruction have far outliers; percentiles do not see them.
    """
    cut = 50 * (1 - share)
    low, high = np.percentile(points, [cut, 100 - cut], axis=0)
    return np.array([low - margin * (high - low), high + margin * (high - low)])


def near_far_of(cameras: Sequence[Camera], box: np.ndarray) -> tuple[float, float]:
    """The smallest and the largest distance of any point of the box from any camera [length]; 0 from inside it."""
    origins = np.array([c.origin for c in cameras])
    near = np.linalg.norm(np.clip(origins, *box) - origins, axis=1).min()
    far = np.linalg.norm(np.maximum(np.abs(origins - box[0]), np.abs(origins - box[1])), axis=1).max()
    return float(near), float(far)


def check_box(box: np.ndarray, name: object = "box") -> np.ndarray:
    """The box as (2, 3) float64.

    Raises:
        MivolError: another shape, a value that is not finite, or no volume.
    """
    found = np.asarray(box, np.float64)
    if found.shape != (2, 3) or not np.isfinite(found).all() or not (found[0] < found[1]).all():
        raise refusal(name, f"the box {found.tolist()}", "[low, high] with low below high along x, y, z", "correct box=")
    return found


def check_views(cameras: Sequence[Camera], box: np.ndarray) -> None:
    """Refuse cameras none of whose rays meet the box; 17 x 17 rays of each are tried, the corners among them.

    Raises:
        MivolError: with the names of the first of them.
    """
    away = [camera.name for camera in cameras if not _meets(camera, box)]
    if away:
        names = ", ".join(away[:3]) + (f" and {len(away) - 3} more" if len(away) > 3 else "")
        raise refusal(
            names,
            f"{len(away)} of {len(cameras)} cameras looking away from the box {np.round(box, 3).tolist()}",
            "views of it",
            "give another box, or take these views out",
        )


def views_seeing(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """(N,) how many cameras see each of points (N, 3), distortion left out but for wide lenses."""
    count = np.zeros(len(points), int)
    for camera in cameras:
        if camera.distortion.is_wide:
            at, _ = project(camera, points)
            count += ((at >= 0) & (at <= camera.size)).all(axis=1)
            continue
        x, y, depth = camera.K @ np.diag([1.0, -1.0, -1.0]) @ camera.to_world[:3, :3].T @ (points - camera.origin).T
        inside = (x >= 0) & (x <= camera.size[0] * depth) & (y >= 0) & (y <= camera.size[1] * depth)
        count += inside & (depth > 0)
    return count


def _meets(camera: Camera, box: np.ndarray) -> bool:
    across = np.linspace(0, 1, 17)
    pixels = np.stack(np.meshgrid(across * camera.size[0], across * camera.size[1]), axis=-1)
    o, d = rays(camera, pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (box[:, None, None] - o) / d
    first, last = np.nanmax(t.min(axis=0), axis=-1), np.nanmin(t.max(axis=0), axis=-1)
    return bool(((first <= last) & (last > 0) & is_seen(camera, pixels)).any())
