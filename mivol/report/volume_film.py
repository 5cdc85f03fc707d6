"""A volume seen from all sides: its integrals along parallel rays, while it turns about its upright axis.

Conventions. Values are (Z, Y, X, C), sizes world lengths along x, y, z. A picture has the highest layer on top. Rays are
horizontal, so each layer is projected on its own: a Radon transform, by bilinear samples in steps of the smallest voxel edge.
Grey is the integral over the largest one of all pictures: black where nothing is.

Here: :func:`volume_frames`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse import csr_matrix

__all__ = ["FEWEST_LAYERS", "volume_frames"]

FEWEST_LAYERS = 8
"""Fewer layers along an axis are slices, which the page shows anyway."""

LARGEST = 96
"""Voxels along an edge that are projected; more are means of blocks."""

WIDTH = 192
"""Pixels of a picture."""


def volume_frames(
    values: NDArray, size: Sequence[float], upright: str, count: int = 36
) -> tuple[list[NDArray[np.uint8]], float]:
    """Pictures of a volume from ``count`` directions about its upright axis, at equal steps of a whole turn.

    Args:
        values: (Z, Y, X, C); channels are averaged, values below 0 count as 0.
        size: world lengths of the box's edges along x, y, z.
        upright: "y" or "z", the axis that it turns about.
        count: of pictures.

    Returns:
        Grey pictures, uint8 (height, width, 3), and the integral that is shown white [unit of the values times length]. None,
        and 0, for a volume of fewer than ``FEWEST_LAYERS`` along an axis, and for one that is 0 everywhere.
    """
    if min(values.shape[:3]) < FEWEST_LAYERS:
        return [], 0.0
    axes = (1, 0, 2) if upright == "y" else (0, 1, 2)
    grid = np.maximum(values, 0).mean(axis=3, dtype=np.float64).transpose(axes)[::-1]
    lengths = np.array(size[::-1])[list(axes)]
    for axis in range(3):
        grid = _block_means(grid, axis)
    steps = lengths / grid.shape
    angles = 2 * math.pi * np.arange(count) / count
    pictures = [grid.reshape(len(grid), -1) @ _rays(grid.shape[1:], steps[1:], angle).T for angle in angles]
    largest = max(float(picture.max()) for picture in pictures)
    if largest <= 0:
        return [], 0.0
    height = max(1, round(WIDTH * lengths[0] / (pictures[0].shape[1] * steps[1:].min())))
    return [_grey(picture / largest, (WIDTH, height)) for picture in pictures], largest


def _block_means(grid: NDArray, axis: int) -> NDArray:
    n = grid.shape[axis]
    starts = np.arange(0, n, math.ceil(n / LARGEST))
    counts = np.diff(np.append(starts, n)).reshape([-1 if k == axis else 1 for k in range(3)])
    return np.add.reduceat(grid, starts, axis) / counts


def _rays(shape: Sequence[int], steps: NDArray, angle: float) -> csr_matrix:
    """(rays, voxels of a layer): integrals of a layer along rays that go in the direction of ``angle``."""
    pitch = steps.min()
    count = math.ceil(math.hypot(*(steps * shape)) / pitch)
    places = (np.arange(count) - (count - 1) / 2) * pitch
    across, along = np.meshgrid(places, places, indexing="ij")
    turned = math.cos(angle) * along + math.sin(angle) * across, math.cos(angle) * across - math.sin(angle) * along
    at = [place / step + (n - 1) / 2 for place, step, n in zip(turned, steps, shape, strict=True)]
    low = [np.floor(one).astype(int) for one in at]
    rays, voxels, weights = [], [], []
    ray = np.broadcast_to(np.arange(count)[:, None], across.shape)
    for corner in np.ndindex(2, 2):
        node = [one + step for one, step in zip(low, corner, strict=True)]
        inside = np.logical_and.reduce([(one >= 0) & (one < n) for one, n in zip(node, shape, strict=True)])
        share = np.prod([1 - np.abs(one - place) for one, place in zip(node, at, strict=True)], axis=0)
        rays.append(ray[inside])
        voxels.append((node[0] * shape[1] + node[1])[inside])
        weights.append(share[inside] * pitch)
    entries = np.concatenate(weights), (np.concatenate(rays), np.concatenate(voxels))
    return csr_matrix(entries, shape=(count, shape[0] * shape[1]))


def _grey(share: NDArray, size: tuple[int, int]) -> NDArray[np.uint8]:
    picture = Image.fromarray(np.round(255 * share).astype(np.uint8)).resize(size, Image.Resampling.BILINEAR)
    return np.repeat(np.asarray(picture)[..., None], 3, axis=2)
