"""The box about what alpha shows: no tighter one is safe, and a grid wastes no voxel on what every view sees through.

Source: Laurentini 1994 (IEEE PAMI 16), the visual hull; here only its box.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter

from mivol.files.source import refusal
from mivol.photos.camera import project
from mivol.photos.dataset import Photo, Photos
from mivol.photos.region import views_seeing

__all__ = ["silhouette_box"]

CELLS = 40
"""Cells along each axis of the box that is searched, twice."""

SHARE = 0.5
"""Share of the views that must see the middle of a cell: what fewer see is not what the photographs are of."""


def silhouette_box(photos: Photos) -> np.ndarray:
    """The box (2, 3) of all cells that no view sees through [length].

    A cell is empty where some view has alpha 0 in all pixels that its sphere covers, so that cells that hold anything are
    kept, at the cost of one or two cells on each side; it must be seen by half of the views. The search begins in
    ``photos.box``.

    Raises:
        MivolError: images without alpha, or nothing left.
    """
    if any(view.alpha is None for view in photos.views):
        raise refusal("silhouette_box", "images without alpha", "alpha in every view", "use the box of the cameras")
    wide = next((view.name for view in photos.views if view.camera.distortion.is_wide), None)
    if wide is not None:
        raise refusal(wide, "a wide lens", "cameras with an image plane for a box about silhouettes", "give the box")
    box = photos.box
    for _ in range(2):
        step = (box[1] - box[0]) / CELLS
        axes = [low + s * (np.arange(CELLS) + 0.5) for low, s in zip(box[0], step, strict=True)]
        cells = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        seen = views_seeing([view.camera for view in photos.views], cells)
        cells = cells[seen >= SHARE * len(photos.views)]
        cells = _kept(photos.views, cells, float(np.linalg.norm(step)) / 2)
        if len(cells) == 0:
            found = "no place that all views show"
            raise refusal("silhouette_box", found, "alpha of one thing", "check the cameras, or give the box")
        box = np.array([cells.min(axis=0) - step / 2, cells.max(axis=0) + step / 2])
    return box


def _kept(views: Sequence[Photo], cells: np.ndarray, radius: float) -> np.ndarray:
    """Cells (N, 3) about which each view that sees their centre has some alpha."""
    for view in views:
        x, depth = project(view.camera, cells)
        nearest = float(np.min(depth[depth > 0], initial=np.inf))
        if nearest <= 2 * radius:
            continue
        # A sphere of radius r at depth z reaches at most f r / (z - r) times 1/cos(view angle) from its centre; one pixel
        # more is for a lens, which magnifies towards the border.
        slope = np.hypot(*np.maximum(view.camera.K[:2, 2], view.camera.size - view.camera.K[:2, 2])) / view.camera.K[0, 0]
        pixels = int(np.ceil(view.camera.K[:2, :2].max() * radius * np.sqrt(1 + slope**2) / (nearest - radius))) + 1
        near = maximum_filter(view.alpha > 0, size=2 * pixels + 1)
        seen = (depth > 0) & ((x >= 0) & (x < view.camera.size)).all(axis=1)
        column, row = np.where(seen[:, None], x, 0).astype(int).T
        cells = cells[~seen | near[row, column]]
    return cells
