"""The places in many small boxes of a grid, listed one box after the other, in parts that fit into memory.

Conventions. A place is a triple of whole numbers (x, y, z); a box holds the places from (0, 0, 0) up to its size.
"""

from __future__ import annotations

import numpy as np

__all__ = ["PAIRS", "cut_into_parts", "places_in_boxes"]

PAIRS = 1 << 21
"""Places of all boxes that are listed together, and one box more, which has no more than there are nodes."""


def places_in_boxes(sizes: np.ndarray) -> np.ndarray:
    """All places (x, y, z) of boxes of these sizes (n, 3), one box after the other, each from (0, 0, 0)."""
    counts = sizes.prod(axis=1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    x, y = (np.repeat(sizes[:, axis], counts) for axis in (0, 1))
    return np.stack([number % x, number // x % y, number // (x * y)], axis=1)


def cut_into_parts(counts: np.ndarray) -> np.ndarray:
    """Where a list of boxes of so many places is cut so that no part has much more than ``PAIRS``."""
    return np.flatnonzero(np.diff(np.cumsum(counts) // PAIRS)) + 1
