r"""Pictures of distances become one surface: a truncated signed distance on a grid, and the triangles where it is 0.

Each view says of a voxel's centre at the depth z on the line to a surface at the depth d: it lies s = d - z in front of it.
With the truncation t,

.. math:: v = \min(1, s / t) \quad \text{where} \quad s > -t,

and nothing where it lies further behind: something hides it. The mean of v over all views that say something changes its
sign at the surface. A pixel that shows nothing says that all of its line is free. What no view sees counts as inside, so that
surfaces are closed where cameras stand all around.

A view that sees a surface near the voxel weighs ten times one that says no more than that it is free: depths of things that are
half transparent disagree, and one view through them would tear a hole.

What is lost. The far side of matter thinner than the truncation moves outwards, and its rim is eaten, where some pixels see
it in part and others see past it.

Sources: Curless, Levoy, A Volumetric Method for Building Complex Models from Range Images, 1996; Newcombe et al., KinectFusion,
2011.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from mivol.errors import MivolError
from mivol.fields.surface import mean_normals
from mivol.files.mesh import Mesh
from mivol.machine import available_memory
from mivol.photos import Camera, project

__all__ = ["DepthView", "fuse_depths"]

FREE = 0.1
"""Weight of a view that says no more than "in front", over that of one that sees a surface near."""

TRUNCATION = 4.0
"""Distance beyond which a view says no more than "in front" [voxel]."""


@dataclass(frozen=True)
class DepthView:
    """What a camera saw.

    Attributes:
        camera: without a distorting lens.
        depth: (H, W) along the axis of the camera [length]; infinite where nothing is.
        colour: (H, W, 3) in 0..1.
    """

    camera: Camera
    depth: np.ndarray
    colour: np.ndarray


def fuse_depths(views: Iterable[DepthView], low: np.ndarray, high: np.ndarray, resolution: int) -> Mesh:
    """The surface that pictures of distances agree on.

    Args:
        views: from all around; each is looked at once.
        low, high: (3,) corners of a box [length]; what lies outside is left out.
        resolution: voxels along its longest edge; they are cubes.

    Returns:
        A mesh with colours, closed but where it is cut by the box; counterclockwise from outside.

    Raises:
        MivolError: a box without volume, a resolution below 2, more memory than is free, with the resolution that fits, or
            pictures that show no surface in the box.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if not (np.isfinite([low, high]).all() and (high > low).all()) or resolution < 2:
        found = f"a box from {low.tolist()} to {high.tolist()} of {resolution} voxels"
        raise MivolError(f"{found} was given; a corner above the other, and at least 2 voxels, are expected.")
    from skimage.measure import marching_cubes  # slow to import

    _check_memory(high - low, resolution)
    voxel = float((high - low).max()) / resolution
    size = np.maximum(np.ceil((high - low) / voxel - 1e-6), 2).astype(int)
    fused = _Fused(low, voxel, size)
    for view in views:
        fused.add(view)
    distance = fused.distance()
    if not distance.min() < 0 < distance.max():
        raise MivolError("no surface was seen in the box; give a box that holds one, and views that see it.")
    nodes, faces, _, _ = marching_cubes(distance, 0.0, gradient_direction="descent")
    points = low + (nodes + 0.5) * voxel
    colours = np.stack([map_coordinates(channel, nodes.T, order=1, mode="nearest") for channel in fused.colours()], axis=1)
    return Mesh(points, faces, mean_normals(points, faces), np.clip(colours, 0, 1))


VOXEL_BYTES = 64
"""Of a voxel: six sums, their means, and the distances as marching cubes takes them."""


def _check_memory(extent: np.ndarray, resolution: int) -> None:
    needed, free = VOXEL_BYTES * resolution**3 * float(np.prod(extent / extent.max())), available_memory()
    if free is not None and needed > free:
        fitting = int(resolution * (free / needed) ** (1 / 3))
        raise MivolError(
            f"A grid of {resolution} voxels along the longest edge takes {needed / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB "
            f"are free; a resolution of at most {fitting} fits."
        )


class _Fused:
    """Sums over views at the centres of voxels, (X, Y, Z)."""

    def __init__(self, low: np.ndarray, voxel: float, size: np.ndarray) -> None:
        self.low, self.voxel, self.size = low, voxel, size
        self.total, self.said = np.zeros(size, np.float32), np.zeros(size, np.float32)
        self.colour, self.coloured = np.zeros((3, *size), np.float32), np.zeros(size, np.float32)

    def add(self, view: DepthView) -> None:
        """Take a view into account, slab by slab."""
        y, z = (self.low[a] + (np.arange(self.size[a]) + 0.5) * self.voxel for a in (1, 2))
        for i in range(self.size[0]):
            x = self.low[0] + (i + 0.5) * self.voxel
            places = np.stack(np.broadcast_arrays(x, *np.meshgrid(y, z, indexing="ij")), axis=-1).reshape(-1, 3)
            self._add_slab(i, view, places)

    def _add_slab(self, i: int, view: DepthView, places: np.ndarray) -> None:
        pixel, depth = project(view.camera, places)
        with np.errstate(invalid="ignore"):
            seen = np.flatnonzero((depth > 0) & ((pixel >= 0) & (pixel < view.camera.size)).all(axis=1))
        column, row = pixel[seen].astype(int).T
        away = (view.depth[row, column] - depth[seen]) / (TRUNCATION * self.voxel)
        told = away > -1
        seen, row, column, away = seen[told], row[told], column[told], away[told]
        near = away < 1
        weight = np.where(near, 1, FREE)
        self.total[i].reshape(-1)[seen] += weight * np.minimum(away, 1)
        self.said[i].reshape(-1)[seen] += weight
        self.coloured[i].reshape(-1)[seen[near]] += 1
        for channel in range(3):
            self.colour[channel, i].reshape(-1)[seen[near]] += view.colour[row[near], column[near], channel]

    def distance(self) -> np.ndarray:
        """Mean signed distance [truncation], above 0 outside; -1 where no view says anything."""
        return np.where(self.said > 0, self.total / np.maximum(self.said, 1), -1)

    def colours(self) -> np.ndarray:
        """(3, X, Y, Z) mean colours near the surface."""
        return self.colour / np.maximum(self.coloured, 1)
