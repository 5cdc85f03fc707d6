r"""Rays of photographs for a fit: batches of pixels, in several sizes, and points of a sparse reconstruction.

Pixels. All pixels are in memory. A batch consists of square tiles of pixels. Neighbouring pixels cross the same cells, so
their reads and writes share cache lines, and a packet of lanes stays together. Tiles lie anywhere in a view, with uniform
probability. Smaller sizes are exact area means: if voxels are larger than pixels, a small image gives the same information
with fewer rays. Values are the photographs' values: codes in 8-bit steps, without decoding, or radiance. A masked pixel has a
ray and weight 0. Rays of pinholes are computed. Rays of wide lenses (:mod:`mivol.photos.lens`) are traced once for each lens
and size, and looked up.

Depth supervision. The rays of photographs should end at the points that the photographs show.

.. math:: E = -\log\big((1 - \varepsilon)\,(T(d - m) - T(d + m)) + \varepsilon\big)

d is the distance of a point from a photograph that shows the point, T the transmittance of the ray through the point, and m the
uncertainty of d. The difference is the probability that the ray ends at the point. A share epsilon of the points is assumed
wrong, so derivatives are bounded and a wrong point is outvoted. E removes density in front of the point, adds density around
it, and does not affect matter behind it.

Conventions. Lengths are in world units. Each point becomes two rays, which end before and behind the point. Only their
transmittance is needed, so a fit traverses these rays like the rays of pixels.

Reference: Deng et al. 2022 (DS-NeRF), who compare the distribution of light along the ray with a Gaussian.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.kernel_recording import copy_aligned
from mivol.photos import Camera, Photo, directions, pixel_centres
from mivol.transport.line_integrals.radiance_field import RayBundle

TILE = 4
"""Edge of a tile [pixel]: 16 lanes, a packet of AVX-512."""


@dataclass
class Level:
    """All views in one size: codes 0..255 or radiance, [row][column][rgb] or, with alpha, [rgba], one view after the other.

    ``counted`` is 1 or 0 per pixel; None without masks. ``wide``: rays of wide lenses; None without wide lenses.
    """

    codes: mi.UInt8 | mi.Float
    counted: mi.UInt8 | None
    sizes: np.ndarray
    starts: np.ndarray
    shrink: int
    wide: WideRays | None

    def values(self, at: mi.UInt32) -> mi.Float:
        """Values of pixels; codes are scaled to 0..1."""
        return _read_values(self.codes, at)


def _read_values(codes: mi.UInt8 | mi.Float, at: mi.UInt32) -> mi.Float:
    value = mi.Float(dr.gather(type(codes), codes, at))
    return value if dr.is_float_v(codes) else value * (1 / 255)


@dataclass
class WideRays:
    """Directions through pixel centres in the frames of cameras with wide lenses: [row][column][xyz], lens by lens.

    Attributes:
        directions: of the lenses, each once.
        starts: (V,) first pixel of each view's lens; -1 for a pinhole.
    """

    directions: mi.Float
    starts: np.ndarray

    @classmethod
    def from_cameras(cls, cameras: Sequence[Camera], sizes: np.ndarray, shrink: int) -> WideRays | None:
        """Rays of cameras whose images have ``sizes`` (V, 2) after shrinking; None without wide lenses."""
        tables, starts, known, count = [], [], {}, 0
        for camera, (width, height) in zip(cameras, sizes, strict=True):
            if not camera.distortion.is_wide:
                starts.append(-1)
                continue
            lens = (camera.distortion, camera.K.tobytes(), int(width), int(height))
            if lens not in known:
                known[lens] = count
                tables.append(directions(camera, shrink * pixel_centres((width, height))).astype(np.float32).reshape(-1))
                count += int(width * height)
            starts.append(known[lens])
        return cls(mi.Float(np.concatenate(tables)), np.array(starts, np.int32)) if tables else None


@dataclass
class RayBatch:
    """Rays of pixels of some views, and the colours of the photographs.

    Attributes:
        origins: (V, 3) pinholes of the chosen views, or their offsets from the field of a fit
            (:meth:`mivol.fields.spherical_grid.SphericalGrid.offsets_from`).
        rays: in world space.
        slot: index of each ray's view among the chosen views.
        view: number of each ray's view among all views.
        target: colour of the photograph.
        alpha: 1 for photographs without alpha.
        background: background colour of the photograph.
        counted: 1, or 0 for a masked pixel.
    """

    origins: np.ndarray | mi.Float
    rays: RayBundle
    slot: mi.UInt32
    view: mi.UInt32
    target: mi.Color3f
    alpha: mi.Float
    background: mi.Color3f
    counted: mi.Float


@dataclass
class PixelTable:
    """The pixels of some views as arrays, from which a recorded step makes its rays.

    Attributes:
        lenses, codes, counted, directions: arrays of all photographs (:class:`RayBatches`, :class:`Level`, :class:`WideRays`).
        numbers: UInt32: of each chosen view its number, its first pixel, its width [pixel] and the first pixel of its wide lens
            (2^32 - 1: none); then the first column and the first row of each tile.
        views, tiles: number of chosen views, and of tiles a view.
        channels: as :class:`RayBatches`.
        shrink: as :class:`Level`.
    """

    lenses: mi.Float
    codes: mi.UInt8 | mi.Float
    counted: mi.UInt8 | None
    directions: mi.Float | None
    numbers: mi.UInt32
    views: int
    tiles: int
    channels: int
    shrink: int

    def make_tiles(self, origins: np.ndarray | mi.Float) -> RayBatch:
        """Rays of the tiles; ``origins`` as :class:`RayBatch`."""
        count = self.views * self.tiles
        lane = dr.arange(mi.UInt32, count * TILE * TILE)
        tile, within = lane // (TILE * TILE), lane % (TILE * TILE)
        first = [dr.gather(mi.UInt32, self.numbers, 4 * self.views + a * count + tile) for a in range(2)]
        return self.make_batch(tile // self.tiles, first[0] + within % TILE, first[1] + within // TILE, origins)

    def make_batch(self, slot: mi.UInt32, column: mi.UInt32, row: mi.UInt32, origins: np.ndarray | mi.Float) -> RayBatch:
        """Rays through pixel centres, with the values of the pixels; ``slot`` is the index of each ray's view."""
        view, start, width = (dr.gather(mi.UInt32, self.numbers, k * self.views + slot) for k in range(3))
        within = row * width + column
        pixel = start + within
        values = [_read_values(self.codes, pixel * self.channels + k) for k in range(self.channels)]
        counted = mi.Float(1) if self.counted is None else mi.Float(dr.gather(mi.UInt8, self.counted, pixel))
        lens = [dr.gather(mi.Float, self.lenses, view * LENS + k) for k in range(LENS)]
        x = ((mi.Float(column) + 0.5) * self.shrink - lens[2]) * lens[0]
        y = (lens[3] - (mi.Float(row) + 0.5) * self.shrink) * lens[1]
        if self.directions is None:
            d = mi.Vector3f(*(dr.fma(lens[4 + 3 * a], x, dr.fma(lens[5 + 3 * a], y, -lens[6 + 3 * a])) for a in range(3)))
        else:
            local = self._replace_directions(mi.Vector3f(x, y, -1), slot, within)
            d = mi.Vector3f(*(dr.dot(mi.Vector3f(*lens[4 + 3 * a : 7 + 3 * a]), local) for a in range(3)))
        o = mi.Point3f(lens[13], lens[14], lens[15])
        alpha = values[3] if self.channels == 4 else mi.Float(1)
        target, background = mi.Color3f(*values[:3]), mi.Color3f(*lens[16:])
        return RayBatch(origins, RayBundle(o, dr.normalize(d)), slot, view, target, alpha, background, counted)

    def _replace_directions(self, d: mi.Vector3f, slot: mi.UInt32, pixel: mi.UInt32) -> mi.Vector3f:
        """Directions ``d`` of pinholes in the cameras' frames, replaced for pixels of views with a wide lens."""
        start = dr.gather(mi.UInt32, self.numbers, 3 * self.views + slot)
        is_wide = start != NO_LENS
        at = 3 * (dr.select(is_wide, start, 0) + pixel)
        traced = mi.Vector3f(*(dr.gather(mi.Float, self.directions, at + k, is_wide) for k in range(3)))
        return dr.select(is_wide, traced, d)


@dataclass
class RayBatches:
    """Photographs from pinholes and wide lenses, each with a single viewpoint.

    Attributes:
        origins: (V, 3) viewpoints.
        lenses: numbers of each lens, ``LENS`` per photograph.
        levels: sizes by their shrink factor: 1, 2, 4 ...
        channels: 3, or 4 with alpha.
        space: kind of the values, "srgb" (codes) or "linear" (radiance).
        points: (K, 3) visible points of a reconstruction for each photograph [length]; empty without a reconstruction.
        cameras: of the photographs, in their full size.
    """

    origins: np.ndarray
    lenses: mi.Float
    levels: dict[int, Level]
    channels: int
    space: str = "srgb"
    points: tuple[np.ndarray, ...] = ()
    cameras: tuple[Camera, ...] = ()

    @classmethod
    def from_photos(
        cls, photos: Sequence[Photo], shrinks: Sequence[int] = (1,), with_alpha: bool | None = None, space: str = "srgb"
    ) -> RayBatches:
        """Copy photographs to the device.

        Args:
            photos: at least one photograph.
            shrinks: shrink factors of the sizes to keep, 1 for the full size.
            with_alpha: keep alpha, for changing backgrounds; None keeps it if all photographs have alpha.
            space: kind of the photographs' values; codes are stored in steps of 8 bits, between 0 and 1.

        Raises:
            MivolError: a lens that distorts the image plane, or a photograph without the required alpha.
        """
        if with_alpha is None:
            with_alpha = all(photo.alpha is not None for photo in photos)
        for photo in photos:
            if photo.camera.distortion and not photo.camera.distortion.is_wide:
                raise MivolError(f"the lens of {photo.name} has distortion: rectify the photographs first.")
            if with_alpha and photo.alpha is None:
                raise MivolError(f"{photo.name} has no alpha, so its background cannot be replaced: set with_alpha to False.")
        lenses = np.array([_lens(photo) for photo in photos], np.float32)
        levels = {shrink: _level(photos, shrink, with_alpha, space) for shrink in sorted(set(shrinks))}
        origins = np.array([photo.camera.origin for photo in photos])
        points = tuple(np.zeros((0, 3)) if photo.points is None else photo.points for photo in photos)
        known = points if any(map(len, points)) else ()
        cameras = tuple(photo.camera for photo in photos)
        return cls(origins, mi.Float(lenses.reshape(-1)), levels, 4 if with_alpha else 3, space, known, cameras)

    def with_cameras(self, cameras: Sequence[Camera]) -> RayBatches:
        """The same pixels from other poses: ``cameras`` with the lenses and sizes of the photographs'."""
        lenses = np.array(self.lenses).reshape(-1, LENS)
        lenses[:, 4:13] = [camera.to_world[:3, :3].ravel() for camera in cameras]
        origins = np.array([camera.origin for camera in cameras])
        lenses[:, 13:16] = origins
        return replace(self, origins=origins, lenses=mi.Float(copy_aligned(lenses.ravel())), cameras=tuple(cameras))

    @property
    def bytes(self) -> int:
        """Memory of the pixels and the rays of wide lenses [bytes]."""
        wide = sum(4 * dr.width(level.wide.directions) for level in self.levels.values() if level.wide is not None)
        return sum(dr.itemsize_v(pixels) * dr.width(pixels) for pixels in self._pixels()) + wide

    @cached_property
    def backgrounds(self) -> np.ndarray:
        """(V, 3) background colour of each photograph."""
        return np.array(self.lenses).reshape(-1, LENS)[:, 16:]

    def _pixels(self) -> list[mi.UInt8 | mi.Float]:
        """All stored pixel arrays, in the order of the sizes."""
        levels = [level for _, level in sorted(self.levels.items())]
        return [pixels for level in levels for pixels in (level.codes, level.counted) if pixels is not None]

    def median(self) -> np.ndarray:
        """(3,) median of each colour over the counted pixels of the smallest size; grey without such pixels."""
        counted = self.pixels()
        return np.median(counted, axis=0) if len(counted) else np.full(3, 0.5)

    def pixels(self) -> np.ndarray:
        """(N, 3) colours of the counted pixels of the smallest size."""
        level = self.levels[max(self.levels)]
        codes = np.array(level.codes).reshape(-1, self.channels)[:, :3]
        counted = codes if level.counted is None else codes[np.array(level.counted) > 0]
        return counted / (255 if self.space == "srgb" else 1)

    def choose_views(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Numbers of ``count`` different views in ascending order; at most all views."""
        n = len(self.origins)
        return np.sort(rng.choice(n, min(count, n), replace=False))

    def draw_corners(self, shrink: int, views: np.ndarray, tiles: int, rng: np.random.Generator) -> np.ndarray:
        """Draw the first pixels (column, row) of tiles of each of some views: (views, tiles, 2)."""
        corners = self.levels[shrink].sizes[views] - TILE + 1
        corner = (rng.random((len(views), tiles, 2)) * corners[:, None]).astype(np.uint32)
        # Rays of a view follow its rows: neighbours in the image are close in time.
        order = np.argsort(corner[..., 1] // 32 * 4096 + corner[..., 0], axis=1)
        return np.take_along_axis(corner, order[..., None], axis=1)

    def make_tiles(self, shrink: int, views: np.ndarray, corner: np.ndarray) -> RayBatch:
        """Rays of the tiles of :meth:`draw_corners`; rays of a view are adjacent."""
        return self.tabulate(shrink, views, corner).make_tiles(self.origins[views])

    def tabulate(self, shrink: int, views: np.ndarray, corner: np.ndarray) -> PixelTable:
        """The pixels of some views as arrays, with the tiles of :meth:`draw_corners`."""
        level, wide = self.levels[shrink], self.levels[shrink].wide
        lens = np.full(len(views), NO_LENS) if wide is None else np.int64(wide.starts[views]) % (NO_LENS + 1)
        parts = [views, level.starts[views], level.sizes[views][:, 0], lens, corner[..., 0].ravel(), corner[..., 1].ravel()]
        numbers = mi.UInt32(copy_aligned(np.concatenate(parts).astype(np.uint32)))
        directions = None if wide is None else wide.directions
        arrays = self.lenses, level.codes, level.counted, directions, numbers
        return PixelTable(*arrays, len(views), corner.shape[1], self.channels, shrink)

    def all_pixels(self, shrink: int, view: int) -> RayBatch:
        """All pixels of a view, tile by tile; tiles that cross the border repeat border pixels."""
        width, height = (int(n) for n in self.levels[shrink].sizes[view])
        across, down = -(-width // TILE), -(-height // TILE)
        lane = dr.arange(mi.UInt32, across * down * TILE * TILE)
        tile, within = lane // (TILE * TILE), lane % (TILE * TILE)
        column = dr.minimum(tile % across * TILE + within % TILE, width - 1)
        row = dr.minimum(tile // across * TILE + within // TILE, height - 1)
        views = np.array([view])
        table = self.tabulate(shrink, views, np.zeros((1, 0, 2), np.uint32))
        return table.make_batch(lane * 0, column, row, self.origins[views])

    def image(self, shrink: int, view: int) -> tuple[list[mi.Float], mi.Float]:
        """A whole view, pixel by pixel: its channels (rgb and, if kept, alpha), and the weights (1 or 0)."""
        level = self.levels[shrink]
        width, height = (int(n) for n in level.sizes[view])
        pixel = dr.arange(mi.UInt32, width * height) + dr.opaque(mi.UInt32, int(level.starts[view]))
        channels = [level.values(pixel * self.channels + k) for k in range(self.channels)]
        counted = mi.Float(1) if level.counted is None else mi.Float(dr.gather(mi.UInt8, level.counted, pixel))
        return channels, counted

    def digest(self) -> str:
        """A fingerprint of cameras, pixels and points."""
        digest = hashlib.sha256(np.array(self.lenses).tobytes())
        for level in self.levels.values():
            if level.wide is not None:
                digest.update(np.array(level.wide.directions).tobytes())
        for pixels in self._pixels():
            digest.update(np.array(pixels).tobytes())
        for points in self.points:
            digest.update(points.tobytes())
        return digest.hexdigest()[:16]


LENS = 19
"""Numbers a view: 1/fx, 1/fy, cx, cy, rotation by rows, origin, background."""

NO_LENS = 2**32 - 1
"""First pixel of the wide lens of a pinhole."""


def _lens(photo: Photo) -> list[float]:
    K, pose = photo.camera.K, photo.camera.to_world
    return [1 / K[0, 0], 1 / K[1, 1], K[0, 2], K[1, 2], *pose[:3, :3].reshape(-1), *pose[:3, 3], *photo.background]


def _level(photos: Sequence[Photo], shrink: int, with_alpha: bool, space: str) -> Level:
    images = [_shrunk(_pixels(photo, with_alpha, space), shrink) for photo in photos]
    sizes = np.array([image.shape[1::-1] for image in images], np.int64)
    if sizes.min() < TILE:
        raise MivolError(f"found a view of {sizes.min()} pixels an edge at 1/{shrink}, expected at least {TILE}: shrink less.")
    counts = sizes.prod(axis=1)
    if counts.sum() * 4 >= 2**32:
        raise MivolError(f"found {counts.sum()} pixels, expected at most 2^30: read the photographs smaller.")
    steps, kind, number = (255, mi.UInt8, np.uint8) if space == "srgb" else (0, mi.Float, np.float32)
    codes = np.concatenate([(np.rint(image * steps) if steps else image).astype(number).reshape(-1) for image in images])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    wide = WideRays.from_cameras([photo.camera for photo in photos], sizes, shrink)
    return Level(kind(codes), _counted(photos, shrink), sizes, starts, shrink, wide)


def _counted(photos: Sequence[Photo], shrink: int) -> mi.UInt8 | None:
    """Whether a pixel counts: all averaged pixels count."""
    if all(photo.mask is None for photo in photos):
        return None
    masks = [np.ones(photo.image.shape[:2]) if photo.mask is None else photo.mask.astype(float) for photo in photos]
    return mi.UInt8(np.concatenate([(_shrunk(mask[..., None], shrink) == 1).reshape(-1) for mask in masks]).astype(np.uint8))


def _pixels(photo: Photo, with_alpha: bool, space: str) -> np.ndarray:
    image = np.clip(photo.image, 0, 1) if space == "srgb" else photo.image
    return np.concatenate([image, photo.alpha[..., None]], axis=2) if with_alpha else image


def describe_size(shrink: int) -> str:
    """Describe photographs whose edges are divided by ``shrink``."""
    return "whole photographs" if shrink == 1 else f"photographs shrunk by {shrink}"


def _shrunk(image: np.ndarray, shrink: int) -> np.ndarray:
    """Means over squares of pixels; incomplete squares at the border are dropped, so the camera stays the same."""
    height, width = (n // shrink * shrink for n in image.shape[:2])
    squares = image[:height, :width].reshape(height // shrink, shrink, width // shrink, shrink, -1)
    return squares.mean(axis=(1, 3))


OUTLIERS = 0.05
"""Assumed share of wrong points."""

UNCERTAINTY = 0.01
"""Uncertainty of a distance as a share of the distance, in addition to a voxel."""

POINTS_PER_VIEW = 64
"""Points per photograph in a step."""


@dataclass
class DepthRays:
    """Points as rays.

    Attributes:
        rays: rays that end before the points; then, in the same order, rays that end behind them. Each half may end in rays of
            length 0, which belong to no point.
        count: number of points; in a recorded step an array.
    """

    rays: RayBundle
    count: int | mi.UInt32


def sample_depth_rays(
    points: Sequence[np.ndarray],
    origins: np.ndarray,
    box: np.ndarray,
    levels: int,
    voxel: float,
    rng: np.random.Generator,
    least: int = 0,
) -> DepthRays | None:
    """Draw points of each of some photographs; None if no drawn point lies in the boxes.

    Args:
        points: (K, 3) for each photograph, its visible points [length].
        origins: (V, 3) positions of the photographs [length].
        box: (2, 3) the innermost of nested boxes [length].
        levels: number of nested boxes.
        voxel: edge of a voxel of the innermost box [length].
        rng: draws the points.
        least: number of rays of each half; rays of length 0 fill the rest.
    """
    drawn = [own[rng.integers(0, len(own), POINTS_PER_VIEW)] if len(own) else np.zeros((0, 3)) for own in points]
    slot = np.repeat(np.arange(len(drawn)), [len(own) for own in drawn])
    positions = np.concatenate(drawn)
    extent = np.abs((positions - box.mean(axis=0)) / (box[1] - box[0])).max(axis=1) * 2
    offset = positions - origins[slot]
    d = np.linalg.norm(offset, axis=1)
    # A point at the camera has no direction.
    inside = (extent <= 2 ** (levels - 1)) & (d > 0)
    if not inside.any():
        return None
    offset, d, o = offset[inside], d[inside], origins[slot[inside]]
    margin = voxel * 2 ** np.ceil(np.log2(np.maximum(extent[inside], 1))) + UNCERTAINTY * d
    halves = [np.zeros((max(least, len(d)), 7)) for _ in range(2)]
    for half, ends in zip(halves, (np.maximum(d - margin, 0), d + margin), strict=True):
        half[:, 5] = 1  # a direction for rays of length 0
        half[: len(d)] = np.column_stack([o, offset / d[:, None], ends])
    columns = [_real(column) for column in np.concatenate(halves).T]
    return DepthRays(RayBundle(mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6]), columns[6]), len(d))


def depth_loss_gradient(T: mi.Float, count: int | mi.UInt32) -> mi.Float:
    """Derivatives of the mean of E over points by the transmittances of their rays, in the order of :class:`DepthRays`."""
    number, half = dr.arange(mi.UInt32, dr.width(T)), dr.opaque(mi.UInt32, dr.width(T) // 2)
    point, n = number % half, dr.opaque(mi.UInt32, count) if isinstance(count, int) else count
    ends = dr.gather(mi.Float, T, point) - dr.gather(mi.Float, T, point + half)
    slope = (1 - OUTLIERS) / ((1 - OUTLIERS) * ends + OUTLIERS) / mi.Float(n)
    return dr.select(point < n, dr.select(number < half, -slope, slope), 0)


def _real(values: np.ndarray) -> mi.Float:
    return mi.Float(copy_aligned(np.ascontiguousarray(values, np.float32)))
