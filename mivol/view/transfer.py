"""A volume of values as a picture: through a transfer function, or as three slices.

Conventions. The transfer function maps a share u of the window of values, 0 to 1, to a colour of a map and to an extinction
proportional to u. It is applied at the voxels, and the field of both is linear between them
(:class:`mivol.fields.spherical_grid.SphericalGrid`), so lines are integrated exactly. A fixed light shades colours by the
gradient of the values, without shadows. Slices show values by the same colours, opaque, in the nearest of three planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from scipy.ndimage import map_coordinates
from skimage.filters import threshold_otsu

from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_volume, write_volume
from mivol.files.volume import VolumeData
from mivol.optim.photographs.field_view import render_view
from mivol.photos import Camera, pixel_centres, rays
from mivol.points.gaussians import to_base_harmonics

MOST_VOXELS = 160
"""Longest edge of the drawn grid [voxel]; larger volumes are averaged in blocks. Slices and saved crops take all voxels."""

DEPTH = 200.0
"""Optical depth [1] along the longest edge of the box, of the highest values at an opacity of 1."""

COLOUR_MAPS = ("bone", "magma", "viridis", "gray", "turbo")

LIGHT = np.array([0.4, -0.6, 0.7])
"""Direction to the light, before normalisation."""

FIRST = 0.7
"""First lower end of the window over the threshold of Otsu (1979), which separates dark from bright values."""

AMBIENT = 0.35
"""Share of a colour without light."""


@dataclass(frozen=True)
class Transfer:
    """Transfer function, or slices.

    Attributes:
        window: lowest and highest shown value as shares of the range of values, 0 to 1.
        opacity: factor on the extinction.
        colours: name in ``COLOUR_MAPS``.
        slices: shares of the box along x, y, z, 0 to 1, of three slices; None shows the volume.
    """

    window: tuple[float, float] = (0.0, 1.0)
    opacity: float = 0.3
    colours: str = COLOUR_MAPS[0]
    slices: tuple[float, float, float] | None = None


class VolumePicture:
    """A volume, prepared for pictures.

    Attributes:
        volume: values and place.
        ends: lowest and highest value that a window of 0 to 1 shows: the quantiles 0.001 and 0.999.
        background: lower end of a window that hides the background, 0 to 1.
    """

    def __init__(self, volume: VolumeData) -> None:
        self.volume = volume
        values = volume.values.mean(axis=3)
        finite = values[np.isfinite(values)]
        if not finite.size or not finite.min() < finite.max():
            raise MivolError("the volume has one value everywhere: there is nothing to see.")
        low, high = np.quantile(finite[:: max(1, finite.size // 1_000_000)], [0.001, 0.999])
        self.ends = (float(low), float(high)) if low < high else (float(finite.min()), float(finite.max()))
        self.values = np.nan_to_num(values, nan=self.ends[0], posinf=self.ends[1], neginf=self.ends[0])
        self.coarse = _block_means(self.values)
        share = (threshold_otsu(self.coarse) - self.ends[0]) / (self.ends[1] - self.ends[0])
        self.background = round(float(np.clip(FIRST * share, 0, 0.9)), 3)
        self._light = _lit_share(self.coarse, volume.to_world)
        self._field: tuple[tuple, SphericalGrid | None] | None = None

    def share(self, values: np.ndarray, transfer: Transfer) -> np.ndarray:
        """Shares u of the window, 0 to 1."""
        low, high = (self.ends[0] + part * (self.ends[1] - self.ends[0]) for part in transfer.window)
        return np.clip((values - low) / max(high - low, 1e-12 * (self.ends[1] - self.ends[0])), 0, 1)

    def draw(self, camera: Camera, transfer: Transfer, crop: Sequence[float] | None = None) -> np.ndarray:
        """Code values (H, W, 3) over black, of what lies in a crop."""
        if transfer.slices is not None:
            return self._draw_slices(camera, transfer, crop)
        field = self._classify(transfer, crop)
        if field is None:
            return np.zeros((camera.size[1], camera.size[0], 3), np.float32)
        return render_view(field, camera, np.zeros(3)).image

    def _classify(self, transfer: Transfer, crop: Sequence[float] | None) -> SphericalGrid | None:
        """The field of the transfer function; None if nothing of it is seen."""
        key = transfer.window, transfer.opacity, transfer.colours, crop
        if self._field is None or self._field[0] != key:
            share = self.share(self.coarse, transfer)
            edge = np.linalg.norm(self.volume.to_world[:3, :3], axis=0).max()
            sigma = (DEPTH * transfer.opacity / edge) * share
            if crop is not None:
                sigma = np.where(_voxels_inside(self.coarse.shape, self.volume.to_world, crop), sigma, 0)
            colours = mpl.colormaps[transfer.colours](share)[..., :3] * self._light[..., None]
            keep, sh = _grow(sigma > 0), to_base_harmonics(colours)[..., None, :]
            has_matter = bool((sigma > 0).any())
            self._field = key, SphericalGrid.from_dense(sigma, sh, self.volume.to_world, keep) if has_matter else None
        return self._field[1]

    def _draw_slices(self, camera: Camera, transfer: Transfer, crop: Sequence[float] | None) -> np.ndarray:
        o, d = rays(camera, pixel_centres(camera.size))
        inverse = np.linalg.inv(self.volume.to_world)
        o, d = o @ inverse[:3, :3].T + inverse[:3, 3], d @ inverse[:3, :3].T
        nearest, place = np.full(o.shape[:2], np.inf), np.zeros(o.shape)
        for axis, at in enumerate(transfer.slices):
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (at - o[..., axis]) / d[..., axis]
                p = o + t[..., None] * d
            p[..., axis] = at
            hit = (t > 0) & (t < nearest) & ((p >= 0) & (p <= 1)).all(axis=-1)
            if crop is not None:
                low, high = np.reshape(crop, (2, 3))
                world = p @ self.volume.to_world[:3, :3].T + self.volume.to_world[:3, 3]
                hit &= ((world >= low) & (world <= high)).all(axis=-1)
            nearest[hit], place[hit] = t[hit], p[hit]
        seen = np.isfinite(nearest)
        nodes = place[seen] * self.values.shape[::-1] - 0.5
        values = map_coordinates(self.values, nodes[:, ::-1].T, order=1, mode="nearest")
        image = np.zeros((*seen.shape, 3), np.float32)
        image[seen] = mpl.colormaps[transfer.colours](self.share(values, transfer))[:, :3]
        return image

    def crop(self, box: Sequence[float]) -> VolumeData:
        """The voxels whose centres lie in a box.

        Raises:
            MivolError: no voxel inside.
        """
        kept = np.nonzero(_voxels_inside(self.values.shape, self.volume.to_world, box))
        if not len(kept[0]):
            raise MivolError("the box holds no voxel: make it larger.")
        ranges = [(int(index.min()), int(index.max()) + 1) for index in kept]
        values = self.volume.values[tuple(slice(*ends) for ends in ranges)]
        part = np.eye(4)
        for axis, ((start, stop), count) in enumerate(zip(ranges[::-1], self.values.shape[::-1], strict=True)):
            part[axis, axis], part[axis, 3] = (stop - start) / count, start / count
        return replace(self.volume, values=np.ascontiguousarray(values), to_world=self.volume.to_world @ part)

    @staticmethod
    def write(path: Path, volume: VolumeData) -> None:
        """Write a volume."""
        write_volume(path, volume.values, volume.to_world)

    @classmethod
    def read(cls, path: Path, dataset: str | None = None) -> VolumePicture:
        """Read and prepare a volume; raises as :func:`mivol.files.read_volume`."""
        return cls(read_volume(path, dataset))


def _voxels_inside(shape: Sequence[int], to_world: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """Which voxels have their centre in a box, bool (Z, Y, X)."""
    low, high = np.reshape(np.asarray(box, np.float64), (2, 3))
    axes = [(np.arange(n) + 0.5) / n for n in shape]
    found = np.ones(tuple(shape), bool)
    for row in range(3):
        steps = [to_world[row, 2 - axis] * values for axis, values in enumerate(axes)]
        place = to_world[row, 3] + steps[0][:, None, None] + steps[1][:, None] + steps[2]
        found &= (place >= low[row]) & (place <= high[row])
    return found


def _block_means(values: np.ndarray) -> np.ndarray:
    """Means of blocks of voxels, so that no edge has more than ``MOST_VOXELS``; the box stays."""
    for axis, n in enumerate(values.shape):
        starts = (np.arange(min(n, MOST_VOXELS)) * n) // min(n, MOST_VOXELS)
        counts = np.diff(np.append(starts, n)).reshape([-1 if a == axis else 1 for a in range(3)])
        values = np.add.reduceat(values, starts, axis) / counts
    return values.astype(np.float32)


def _lit_share(values: np.ndarray, to_world: np.ndarray) -> np.ndarray:
    """Brightness of each voxel under the light, ``AMBIENT`` to 1; voxels without a gradient are fully lit."""
    slopes = [np.gradient(values, axis=axis) if values.shape[axis] > 1 else np.zeros_like(values) for axis in (2, 1, 0)]
    per_unit = np.stack([slope * n for slope, n in zip(slopes, values.shape[::-1], strict=True)], axis=-1)
    normal = per_unit @ np.linalg.inv(to_world[:3, :3])
    length = np.linalg.norm(normal, axis=-1)
    light = LIGHT / np.linalg.norm(LIGHT)
    cosine = np.abs(normal @ light) / np.maximum(length, 1e-30)
    flat = length <= 1e-3 * length.max()
    return np.where(flat, 1, AMBIENT + (1 - AMBIENT) * cosine).astype(np.float32)


def _grow(mask: np.ndarray) -> np.ndarray:
    """The voxels of a mask with their neighbours along the axes and diagonals."""
    for axis in range(3):
        grown = mask.copy()
        forward = [slice(None)] * 3
        backward = [slice(None)] * 3
        forward[axis], backward[axis] = slice(1, None), slice(None, -1)
        grown[tuple(forward)] |= mask[tuple(backward)]
        grown[tuple(backward)] |= mask[tuple(forward)]
        mask = grown
    return mask
