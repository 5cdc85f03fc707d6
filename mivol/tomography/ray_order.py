"""In which order rays are walked: those that read the same voxels after one another, so that a cache still holds them.

A vector of lanes takes a tile of the detector, whose rays run side by side; then the same rows of the other views follow,
whose rays run through the same layers of voxels, and not the rest of the view, which is a whole volume away.
"""

from __future__ import annotations

import numpy as np

__all__ = ["order_rays"]

TILE = (2, 8)
"""Rows and columns of a tile: 16 lanes, one vector of 512 bits."""


def order_rays(views: int, rows: int, columns: int) -> np.ndarray:
    """The numbers of rays (view, row, column) in the order in which they are walked.

    Returns:
        (views * rows * columns,), each number once.
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    in_view = np.lexsort((column % TILE[1], row % TILE[0], column // TILE[1], row // TILE[0]))
    first = np.arange(views)[:, None] * (rows * columns)
    bands = np.split(in_view, range(TILE[0] * columns, len(in_view), TILE[0] * columns))
    return np.concatenate([(first + band).ravel() for band in bands])
