"""Unknowns finer than the voxels that are asked for: a ray sees edges inside voxels, which a coarser model cannot follow.

Line integrals of sharp edges do not agree with any field of voxels. Least squares trades the misfit for ripples at the edges,
which grow from iteration to iteration. Twice as many unknowns along each edge take the misfit up, and their mean loses it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mivol.tomography.geometry import Geometry, ParallelBeam, VoxelGrid

__all__ = ["subdivide", "voxel_means"]


def subdivide(grid: VoxelGrid, parts: int, geometry: Geometry) -> VoxelGrid:
    """The same box in ``parts`` times as many voxels along each axis, and along x and y only for a parallel beam.

    Each row of a parallel beam sees one height: there is nothing to tell finer layers apart.
    """
    times = (1 if isinstance(geometry, ParallelBeam) else parts, parts, parts)
    shape = tuple(k * n for k, n in zip(times, grid.shape, strict=True))
    return VoxelGrid(shape, tuple(edge / k for edge, k in zip(grid.voxel_size, times[::-1], strict=True)), grid.centre)


def voxel_means(x: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Means over blocks: a field (Z, Y, X) on a subdivided grid as one of ``shape``, in the same dtype.

    Values at the middles of equal parts are averaged, which is the mean of the field up to its curvature.
    """
    blocks = [n for edge, fine in zip(shape, x.shape, strict=True) for n in (edge, fine // edge)]
    return x.reshape(blocks).mean((1, 3, 5), dtype=x.dtype)
