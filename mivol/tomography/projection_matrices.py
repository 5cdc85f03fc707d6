"""Cone beams given by projection matrices, as calibrations write them.

Conventions. A matrix P (3 x 4) takes a world position to a pixel: ``(column, row, 1) ~ P (x, y, z, 1)``, whole numbers at the
middles of pixels unless ``first_pixel`` says otherwise. Any factor on a matrix, negative ones too, leaves it what it is.

Reference: Hartley & Zisserman, Multiple View Geometry in Computer Vision (2004), section 6.2.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mivol.errors import MivolError
from mivol.tomography.panel_views import PanelViews

SMALLEST = 1e-12
"""A matrix whose smallest singular value is below this share of its largest has no source that float64 could place."""


def panels_of_matrices(
    matrices: np.ndarray,
    detector: tuple[int, int],
    seen: Sequence[float] = (0.0, 0.0, 0.0),
    first_pixel: Sequence[float] = (0.0, 0.0),
) -> PanelViews:
    """The source and a detector of each view, whose rays are those of its matrix.

    With ``P = (M | p)`` the source is ``-M^-1 p``, and the ray through a pixel runs along ``M^-1 (column, row, 1)``. Where
    along its rays a detector stands is not in a matrix: it is put through ``seen``, which also tells the half of the lines.

    Args:
        matrices: (views, 3, 4).
        detector: (rows, columns).
        seen: a position in front of every source [length].
        first_pixel: (column, row) of the middle of the first pixel.

    Raises:
        MivolError: another shape, and by its number the first view with numbers that are not finite, without a source (a
            singular M, as of parallel light), or whose source has ``seen`` beside it.
    """
    p = np.asarray(matrices, np.float64)
    if p.ndim != 3 or p.shape[1:] != (3, 4) or len(p) == 0:
        raise MivolError(f"found projection matrices of shape {p.shape}, expected (views, 3, 4), one for each view.")
    _refuse(~np.isfinite(p).all((1, 2)), "numbers that are not finite", "finite ones: complete the matrix")
    m = p[:, :, :3]
    # Rows have units of their own (pixels, pixels, 1), and whole matrices any factor: neither says how near to singular one is.
    lengths = np.linalg.norm(m, axis=2, keepdims=True)
    values = np.linalg.svd(m / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    _refuse(values[:, -1] <= SMALLEST * values[:, 0], "a singular left half", "three independent rows: a point source has them")
    inverse = np.linalg.inv(m)
    source = -(inverse @ p[:, :, 3:])[..., 0]
    depth = m[:, 2] @ np.asarray(seen, float) + p[:, 2, 3]
    beside = np.abs(depth) <= SMALLEST * lengths[:, 2, 0] * np.linalg.norm(source - seen, axis=1)
    _refuse(beside, f"{tuple(map(float, seen))} beside the source", "the grid's centre before it: check the unit of lengths")
    step_u, step_v, corner = (inverse * depth[:, None, None]).transpose(2, 0, 1)
    corner = source + corner + first_pixel[0] * step_u + first_pixel[1] * step_v
    rows, columns = detector
    middle = corner + (columns - 1) / 2 * step_u + (rows - 1) / 2 * step_v
    return PanelViews(np.hstack([source, middle, step_u, step_v]), detector)


def _refuse(wrong: np.ndarray, found: str, expected: str) -> None:
    if wrong.any():
        raise MivolError(f"found {found} in the projection matrix of view {int(np.argmax(wrong))}, expected {expected}.")
