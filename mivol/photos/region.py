"""The box that the cameras of photographs look at.

Conventions. A box is (2, 3) float64: its low and its high corner [length]. No function here reads a pixel, and only
:func:`silhouette_box` needs the alpha of the photographs. Distortion is left out, except for wide lenses.

Source of the box of silhouettes: Laurentini 1994 (IEEE PAMI 16), the visual hull; here only the box of the hull.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera import FLIP, Camera, is_seen, project, rays
from mivol.photos.lens import Panorama

SEARCHES = 2
"""Searches of a box, the second one in the box that the first one found."""

VIEW_SHARE = 0.9
"""Share of the views that must see a point of the shared region."""

VIEW_CELLS = 32
"""Cells along each axis in a search for the shared region, which is then known to 1/32 of its size."""

SILHOUETTE_SHARE = 0.5
"""Share of the views that must see the centre of a cell; cells seen by fewer views do not belong to the subject."""

SILHOUETTE_CELLS = 40
"""Cells along each axis in a search for silhouettes."""

BOX_SHARE = 0.99
"""Share of the points of a reconstruction, and of the cameras, inside nested boxes: a few of each are far outliers."""

FEWEST_POINTS = 100
"""Smallest reconstruction [points] from which a box is taken."""

PARALLEL = 1e-4
"""Smallest mean squared sine of the angle between the optical axes and their common direction: about 0.6 degrees."""

MIDDLE = 0.45
"""Largest half edge of the innermost box of a capture [median distance of the cameras from their focus].

0.4 to 0.5 were best for wide lenses; a tele lens takes less (:func:`middle_box`). The larger boxes hold the rest.
"""

CLEAR, TELE, FEWEST_VIEWS = 0.25, 0.35, 4
"""Free space of a capture (:func:`find_free_distances`): a distance from the nearest camera [median distance of the cameras
from their focus], half a frame over the focal length up to which a lens counts as tele, and a number of cameras."""


# -- Boxes from cameras -------------------------------------------------------------------------------------------


def find_focus(cameras: Sequence[Camera], name: object = "cameras") -> np.ndarray:
    """Return the point (3,) nearest to the optical axes of all cameras, by least squares.

    A panorama has no optical axis, so its own position takes the place of the axis.

    Raises:
        MivolError: parallel axes or a single view, for which no point is nearest.
    """
    focus = _nearest_point(cameras)
    if focus is None:
        raise refusal(name, "cameras that all look in one direction", "views that cross", "give the box with box=")
    return focus


def _nearest_point(cameras: Sequence[Camera]) -> np.ndarray | None:
    """The point of :func:`find_focus`; None for parallel axes."""
    across = [np.eye(3) - (0 if isinstance(c.distortion, Panorama) else np.outer(c.forward, c.forward)) for c in cameras]
    total = np.sum(across, axis=0)
    if np.linalg.eigvalsh(total)[0] < PARALLEL * len(cameras):
        return None
    return np.linalg.solve(total, np.sum([a @ c.origin for a, c in zip(across, cameras, strict=True)], axis=0))


def shared_box(cameras: Sequence[Camera], name: object = "cameras") -> np.ndarray | None:
    """Return the box around the region shared by most views; None without such a region.

    The region holds the points seen by at least ``VIEW_SHARE`` of the views and nearer to the focus (:func:`find_focus`)
    than the median camera. The second condition bounds the region, because viewing frustums are infinite.

    Raises:
        MivolError: parallel cameras.
    """
    focus = find_focus(cameras, name)
    return _shared_region(cameras, focus, median_distance(cameras, focus))


def _shared_region(cameras: Sequence[Camera], focus: np.ndarray, reach: float) -> np.ndarray | None:
    """Box of the region of :func:`shared_box` at most ``reach`` from the focus; None without such a region."""
    box = np.array([focus - reach, focus + reach])
    for _ in range(SEARCHES):
        step = (box[1] - box[0]) / VIEW_CELLS
        points = _cell_centres(box, VIEW_CELLS)
        points = points[np.linalg.norm(points - focus, axis=1) <= reach]
        shared = points[count_views(cameras, points) >= VIEW_SHARE * len(cameras)]
        if len(shared) == 0:
            return None
        box = np.array([shared.min(axis=0) - step, shared.max(axis=0) + step])
    return box + np.array([step / 2, -step / 2])


def middle_box(cameras: Sequence[Camera], name: object = "cameras") -> np.ndarray:
    """Return the innermost of nested boxes: a cube around the focus of the cameras, which may stand inside it.

    Half its edge is ``MIDDLE`` times the median distance of the cameras, or half the longest edge of the region that most
    frames share (:func:`shared_box`) if this is smaller. Tele lenses share a small region; cameras without a shared region
    look around.

    Raises:
        MivolError: parallel cameras, or cameras that all stand at their focus.
    """
    focus = find_focus(cameras, name)
    reach = median_distance(cameras, focus)
    if not reach > 0:
        raise refusal(name, "cameras that all stand in one place", "views from several places", "give the box with box=")
    shared = _shared_region(cameras, focus, reach)
    half = MIDDLE * reach if shared is None else min(MIDDLE * reach, float((shared[1] - shared[0]).max()) / 2)
    return np.array([focus - half, focus + half])


def median_distance(cameras: Sequence[Camera], point: np.ndarray) -> float:
    """Return the median distance of the cameras from a point (3,) [length]."""
    return float(np.median([np.linalg.norm(camera.origin - point) for camera in cameras]))


def viewing_distance(cameras: Sequence[Camera], box: np.ndarray) -> float:
    """Return the median distance of the cameras from what they look at [length].

    That is their focus (:func:`find_focus`), which a box (2, 3) of reconstructed points may miss by far: a room's points lie
    all around. For parallel cameras the middle of the box takes its place.
    """
    focus = _nearest_point(cameras)
    return median_distance(cameras, box.mean(axis=0) if focus is None else focus)


def find_subject(cameras: Sequence[Camera], box: np.ndarray) -> np.ndarray:
    """Return the point (3,) at which pictures of the whole should aim [length].

    That is the middle of the box (2, 3). The points of a room, or of the floor under a table, lie all around, so the middle of
    their box may be anywhere: if half its longest edge exceeds the median distance of the cameras from their focus, it is
    the focus, as long as half of the cameras see it.
    """
    middle, focus = np.mean(box, axis=0), _nearest_point(cameras)
    if focus is None or (box[1] - box[0]).max() / 2 < median_distance(cameras, focus):
        return middle
    return focus if count_views(cameras, focus[None])[0] >= 0.5 * len(cameras) else middle


def near_and_far(cameras: Sequence[Camera], box: np.ndarray) -> tuple[float, float]:
    """Return the smallest and the largest distance between a camera and a point of the box [length]; 0 from inside."""
    origins = np.array([c.origin for c in cameras])
    near = np.linalg.norm(np.clip(origins, *box) - origins, axis=1).min()
    far = np.linalg.norm(np.maximum(np.abs(origins - box[0]), np.abs(origins - box[1])), axis=1).max()
    return float(near), float(far)


def count_views(cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """Return for each of the points (N, 3) the number of cameras that see it (N,). Only wide lenses are distorted."""
    count = np.zeros(len(points), int)
    for camera in cameras:
        if camera.distortion.is_wide:
            pixels, _ = project(camera, points)
            count += ((pixels >= 0) & (pixels <= camera.size)).all(axis=1)
            continue
        x, y, depth = camera.K @ np.diag(FLIP) @ camera.to_world[:3, :3].T @ (points - camera.origin).T
        inside = (x >= 0) & (x <= camera.size[0] * depth) & (y >= 0) & (y <= camera.size[1] * depth)
        count += inside & (depth > 0)
    return count


def find_free_distances(cameras: Sequence[Camera], reach: float) -> tuple[float, float]:
    """Return two distances from the nearest camera: no matter is nearer than the first, nor than the second if few see it.

    The first is ``CLEAR`` times ``reach``. The second is ``reach`` for tele lenses, whose frames hold little before the
    subject. Beyond ``TELE`` it falls with the width of the median frame: wide frames show near floors, each in few photographs.

    Args:
        cameras: of all photographs.
        reach: median distance of the cameras from what they look at [length].
    """
    wide = [math.inf if c.distortion.is_wide else max(np.array(c.size) / np.diag(c.K)[:2]) / 2 for c in cameras]
    clear = CLEAR * reach
    return clear, max(clear, reach * min(1.0, TELE / float(np.median(wide))))


def is_free_space(cameras: Sequence[Camera], points: np.ndarray, reach: float) -> np.ndarray:
    """Return whether each of the points (N, 3) holds no matter, judged by the cameras alone (N,).

    Free are all points nearer to a camera than the first of :func:`find_free_distances`, and points nearer than the second that
    fewer than ``FEWEST_VIEWS`` cameras see: fog there explains one photograph and covers the others.

    Args:
        cameras: of all photographs.
        points: positions [length].
        reach: median distance of the cameras from what they look at [length].
    """
    clear, within = find_free_distances(cameras, reach)
    from scipy.spatial import cKDTree  # imported late: a scan or a scene needs none of it

    distance = cKDTree(np.array([camera.origin for camera in cameras])).query(points)[0]
    free = distance < clear
    near = np.flatnonzero(~free & (distance < within))
    free[near] = count_views(cameras, points[near]) < FEWEST_VIEWS
    return free


def check_cameras_meet_box(cameras: Sequence[Camera], box: np.ndarray) -> None:
    """Refuse cameras without a ray through the box (:func:`meets_box`).

    Raises:
        MivolError: names the first three of these cameras.
    """
    missing = [camera.name for camera in cameras if not meets_box(camera, box)]
    if missing:
        names = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        raise refusal(
            names,
            f"{len(missing)} of {len(cameras)} cameras looking away from the box {np.round(box, 3).tolist()}",
            "views of the box",
            "give another box, or remove these views",
        )


def meets_box(camera: Camera, box: np.ndarray) -> bool:
    """Whether a ray of a camera meets a box. 17 x 17 rays are tried, the corners included."""
    across = np.linspace(0, 1, 17)
    pixels = np.stack(np.meshgrid(across * camera.size[0], across * camera.size[1]), axis=-1)
    o, d = rays(camera, pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (box[:, None, None] - o) / d
    first, last = np.nanmax(t.min(axis=0), axis=-1), np.nanmin(t.max(axis=0), axis=-1)
    return bool(((first <= last) & (last > 0) & is_seen(camera, pixels)).any())


def _cell_centres(box: np.ndarray, n: int) -> np.ndarray:
    """Centres (n^3, 3) of the n x n x n cells of a box."""
    axes = [low + step * (np.arange(n) + 0.5) for low, step in zip(box[0], (box[1] - box[0]) / n, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


# -- Boxes from points, and nested boxes --------------------------------------------------------------------------


def box_of_points(points: np.ndarray) -> np.ndarray:
    """Return the box of the middle 98 % of points (N, 3) along each axis, enlarged by 5 % on each side.

    Percentiles are used because sparse reconstructions have far outliers.
    """
    low, high = np.percentile(points, [1, 99], axis=0)
    margin = 0.05 * (high - low)
    return np.array([low - margin, high + margin])


def check_box(box: np.ndarray) -> np.ndarray:
    """Return the box as (2, 3) float64.

    Raises:
        MivolError: another shape, a value that is not finite, or no volume.
    """
    corners = np.asarray(box, np.float64)
    if corners.shape != (2, 3) or not np.isfinite(corners).all() or not (corners[0] < corners[1]).all():
        raise refusal("box", f"the box {corners.tolist()}", "[low, high] with low below high along x, y, z", "correct box=")
    return corners


def nested_boxes(box: np.ndarray, levels: int) -> list[np.ndarray]:
    """Return ``levels`` boxes (2, 3) around one centre; each is twice as large as the previous box."""
    middle = box.mean(axis=0)
    return [middle + 2**level * (box - middle) for level in range(levels)]


def count_levels(box: np.ndarray, points: np.ndarray, cameras: Sequence[Camera], most: int) -> int:
    """Return the smallest number of nested boxes that hold ``BOX_SHARE`` of the points (N, 3), and twice the cameras' reach.

    Tables and floors may have no points. They lie before the subject, as far as the cameras, and as far behind it. The number
    is at most ``most``.
    """

    def reach(places: np.ndarray) -> float:
        radius = 2 * np.abs((places - box.mean(axis=0)) / (box[1] - box[0])).max(axis=1)
        return float(np.percentile(radius, 100 * BOX_SHARE))

    widest = max(reach(points), 2 * reach(np.array([camera.origin for camera in cameras])))
    return min(most, 1 + math.ceil(math.log2(max(1.0, widest))))


def points_in_box(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return the points (N, 3) inside a box."""
    return points[((points >= box[0]) & (points <= box[1])).all(axis=1)]


# -- Box of silhouettes -------------------------------------------------------------------------------------------


def silhouette_box(cameras: Sequence[Camera], alphas: Sequence[np.ndarray | None], box: np.ndarray) -> np.ndarray:
    """Return the box (2, 3) around all cells that every view shows as opaque.

    A cell is empty if one view has alpha 0 in all pixels covered by the cell's bounding sphere. Cells with content are
    therefore kept, and the box is one or two cells too large on each side. Half of the views must see a cell.

    Args:
        cameras: one for each view, with pinholes or lenses that distort a plane.
        alphas: opacity (H, W) of each view.
        box: (2, 3) where the search begins [length].

    Raises:
        MivolError: a view without alpha, a wide lens, or no cell left.
    """
    if any(alpha is None for alpha in alphas):
        raise refusal("silhouette_box", "images without alpha", "alpha in every view", "use the box of the cameras")
    wide = next((camera.name for camera in cameras if camera.distortion.is_wide), None)
    if wide is not None:
        raise refusal(wide, "a wide lens", "cameras with an image plane for a box about silhouettes", "give the box")
    for _ in range(SEARCHES):
        step = (box[1] - box[0]) / SILHOUETTE_CELLS
        cells = _cell_centres(box, SILHOUETTE_CELLS)
        cells = cells[count_views(cameras, cells) >= SILHOUETTE_SHARE * len(cameras)]
        for camera, alpha in zip(cameras, alphas, strict=True):
            cells = _opaque_cells(camera, alpha, cells, float(np.linalg.norm(step)) / 2)
        if len(cells) == 0:
            found = "no region that is opaque in all views"
            raise refusal("silhouette_box", found, "alpha of one subject", "check the cameras, or give the box")
        box = np.array([cells.min(axis=0) - step / 2, cells.max(axis=0) + step / 2])
    return box


def _opaque_cells(camera: Camera, alpha: np.ndarray, cells: np.ndarray, radius: float) -> np.ndarray:
    """Return the cells (N, 3) that the view does not show as empty: outside the image, or near a pixel with alpha."""
    x, depth = project(camera, cells)
    nearest = float(np.min(depth[depth > 0], initial=np.inf))
    if nearest <= 2 * radius:
        return cells
    # A sphere of radius r at depth z extends at most f r / (z - r) / cos(view angle) from the image of its centre. One
    # more pixel allows for a lens, which magnifies towards the border.
    slope = np.hypot(*np.maximum(camera.K[:2, 2], camera.size - camera.K[:2, 2])) / camera.K[0, 0]
    pixels = int(np.ceil(camera.K[:2, :2].max() * radius * np.sqrt(1 + slope**2) / (nearest - radius))) + 1
    from scipy.ndimage import maximum_filter

    near = maximum_filter(alpha > 0, size=2 * pixels + 1)
    inside = (depth > 0) & ((x >= 0) & (x < camera.size)).all(axis=1)
    column, row = np.where(inside[:, None], x, 0).astype(int).T
    return cells[~inside | near[row, column]]
