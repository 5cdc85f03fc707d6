"""Cells in which emission is integrated: those of the extinction, cut into equal parts where the emission varies faster.

Conventions. As in :mod:`mivol.transport.traversal.lattice`: cells lie between voxel centres, and beyond the last of them
matter is constant up to the box.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mivol.transport.media.medium_view import MediumView

MAX_PARTS = 8
"""Largest number of parts of a cell: voxels of an emission may be an eighth of the extinction's."""

EDGE_PARTS = 4
"""Parts of a cell if the box of an emission ends inside of cells."""


def voxel_to_cell_ratio(volume: mi.Volume, view: MediumView) -> float:
    """Edge of a voxel of the volume over the longest edge of a walked cell, both in the volume's lengths."""
    voxels = _cells_in_voxels(volume, view)
    return 1 / float(np.linalg.norm(voxels[:3, :3], axis=0).max())


def count_parts(view: MediumView) -> int:
    """Number of equal parts into which the cells of a medium are cut, for its emission and its albedo."""
    parts = 1
    for volume in (view.emission, view.albedo) if view.emission is not None and view.walked_lattice is not None else ():
        if not isinstance(volume, mi.Volume) or volume.class_name() == "ConstVolume":
            continue
        # 1e-4: the place of a stock grid is known to 5e-6.
        parts = max(parts, int(np.ceil(1 / voxel_to_cell_ratio(volume, view) - 1e-4)))
        if volume is view.emission:
            parts = max(parts, _edge_parts(volume, view))
    return min(parts, MAX_PARTS)


def _cells_in_voxels(volume: mi.Volume, view: MediumView) -> np.ndarray:
    """The matrix (4, 4) from the walked cells, counted along their axes, to the voxels of a volume."""
    cells = view.walked_lattice
    place = volume.mivol_to_world if hasattr(volume, "mivol_to_world") else view.stock_boxes[volume.ptr].to_world
    to_cells = cells.to_world @ np.diag([*(1 / np.array(cells.res[::-1])), 1.0])
    return np.diag([*np.array(volume.resolution(), dtype=np.float64), 1.0]) @ np.linalg.solve(place, to_cells)


def _edge_parts(volume: mi.Volume, view: MediumView) -> int:
    """Parts of a cell with which the faces of a volume's box fall between parts; at most ``EDGE_PARTS``."""
    cells, size = np.linalg.inv(_cells_in_voxels(volume, view)), np.array(volume.resolution(), dtype=np.float64)
    if not _is_upright(cells[:3, :3]):
        return EDGE_PARTS
    faces = np.sort(np.stack([cells[:3, 3], cells[:3, :3] @ size + cells[:3, 3]]), axis=0)
    # Cells lie between voxel centres; beyond the last of them matter is constant up to the box.
    faces = faces[(faces > 1e-4) & (faces < np.array(view.walked_lattice.res[::-1]) - 1e-4)] - 0.5
    return next(n for n in (1, 2, EDGE_PARTS) if n == EDGE_PARTS or (np.abs(n * faces - np.round(n * faces)) < 1e-4).all())


def _is_upright(steps: np.ndarray) -> bool:
    """Whether each axis of one grid runs along an axis of the other."""
    return bool((np.count_nonzero(np.abs(steps) > 1e-6 * np.abs(steps).max(), axis=0) == 1).all())
