"""Numbers as pixels: every picture of a kind on one scale, and the scale said beside it.

Conventions. Images are (height, width[, 1 or 3]) of linear values, row 0 at the top; pixels are uint8 (height, width,
3). A :class:`Scale` is shared by all pictures that are meant to be compared. Radiance in three channels is shown in sRGB;
everything in one channel is grey, linear in the value; differences are blue below zero, white at zero, red above.
Pixels that are not finite are magenta.
"""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.image import imsave
from numpy.typing import NDArray

from mivol.errors import MivolError
from mivol.files import encode_srgb
from mivol.files.atomic import write_whole_bytes
from mivol.photos import Camera, pixel_centres, rays

__all__ = [
    "SIGNED",
    "Scale",
    "Slices",
    "data_uri",
    "to_pixels",
    "shared_scale",
    "signed_scale",
    "middle_slices",
    "COLOURS",
    "depth_pixels",
    "normal_pixels",
    "normals_from_depth",
]

SIGNED = "RdBu_r"
BROKEN = (255, 0, 255)
PLANES = {"xy": 0, "xz": 1, "yz": 2}


class Scale(NamedTuple):
    """Values shown as black (or full blue) and white (or full red); ``kind`` is grey, colour or signed."""

    kind: str
    low: float
    high: float


def shared_scale(*images: NDArray, low: float | None = 0.0, kind: str | None = None, percentile: float = 99.8) -> Scale:
    """One scale for several images: from ``low`` (their smallest value if None) to their given percentile.

    The percentile, and not the maximum, so that one firefly does not turn the rest black.
    """
    values = np.concatenate([image[np.isfinite(image)].ravel() for image in images])
    if values.size == 0:
        return Scale(kind or "grey", 0.0, 1.0)
    bottom = float(values.min()) if low is None else min(low, float(np.percentile(values, 100 - percentile)))
    top = float(np.percentile(values, percentile))
    kind = kind or ("colour" if any(_channels(image) == 3 for image in images) else "grey")
    return Scale(kind, bottom, top if top > bottom else bottom + 1.0)


def signed_scale(*images: NDArray, percentile: float = 99.8) -> Scale:
    """One symmetric scale for several differences."""
    values = np.concatenate([np.abs(image[np.isfinite(image)]).ravel() for image in images])
    limit = float(np.percentile(values, percentile)) if values.size else 0.0
    return Scale("signed", -limit if limit else -1.0, limit or 1.0)


def to_pixels(image: NDArray, scale: Scale) -> NDArray[np.uint8]:
    """The image in 8 bits on ``scale``.

    Raises:
        MivolError: not (height, width), (height, width, 1) or (height, width, 3).
    """
    values = np.asarray(image, np.float64)
    if values.ndim not in (2, 3) or _channels(values) not in (1, 3):
        raise MivolError(f"an image has shape {values.shape}; give (height, width) or (height, width, 1 or 3).")
    values = values.reshape(*values.shape[:2], -1)
    if scale.kind == "signed":
        values = values.mean(axis=2, keepdims=True)
    broken = ~np.isfinite(values).all(axis=2)
    unit = np.clip((np.where(np.isfinite(values), values, 0.0) - scale.low) / (scale.high - scale.low), 0.0, 1.0)
    rgb = _KINDS[scale.kind](unit)
    rgb[broken] = BROKEN
    return rgb


def _grey(unit: NDArray) -> NDArray[np.uint8]:
    return np.repeat(np.round(255 * unit.mean(axis=2, keepdims=True)).astype(np.uint8), 3, axis=2)


def _colour(unit: NDArray) -> NDArray[np.uint8]:
    return np.broadcast_to(np.round(255 * encode_srgb(unit)).astype(np.uint8), (*unit.shape[:2], 3)).copy()


def _signed(unit: NDArray) -> NDArray[np.uint8]:
    return mpl.colormaps[SIGNED](unit[..., 0], bytes=True)[..., :3].copy()


_KINDS = {"grey": _grey, "colour": _colour, "signed": _signed}


def _channels(image: NDArray) -> int:
    return 1 if image.ndim == 2 else image.shape[2]


def encode_png(rgb: NDArray[np.uint8]) -> bytes:
    """The pixels as a PNG."""
    buffer = io.BytesIO()
    imsave(buffer, rgb, format="png", metadata={"Software": None}, pil_kwargs={"optimize": True})
    return buffer.getvalue()


def data_uri(rgb: NDArray[np.uint8]) -> str:
    """The pixels as a PNG inside a ``data:`` address."""
    return "data:image/png;base64," + base64.b64encode(encode_png(rgb)).decode("ascii")


class Slices(NamedTuple):
    """The middle slices of a grid by plane, first axis to the right, second upwards; ``where`` says which."""

    images: dict[str, NDArray]
    where: dict[str, str]
    aspect: dict[str, float]


def middle_slices(grid: NDArray, size: tuple[float, float, float] | None = None) -> Slices:
    """The three orthogonal slices through the middle of a grid.

    Args:
        grid: (Z, Y, X[, C]).
        size: world lengths of the box along x, y, z; None: voxels are cubes.

    Returns:
        Slices ``xy``, ``xz``, ``yz`` with the second axis upwards, and width over height of each in the world.

    Raises:
        MivolError: the grid's rank is not 3 or 4.
    """
    grid = np.asarray(grid)
    if grid.ndim not in (3, 4):
        raise MivolError(f"a volume has shape {grid.shape}; give (Z, Y, X) or (Z, Y, X, C).")
    x, y, z = size or tuple(float(n) for n in grid.shape[2::-1])
    middle = [n // 2 for n in grid.shape[:3]]
    images = {plane: np.take(grid, middle[axis], axis=axis)[::-1] for plane, axis in PLANES.items()}
    missing = dict(zip(PLANES, "zyx", strict=True))
    where = {p: f"{missing[p]} = {middle[axis] + 1} of {grid.shape[axis]}" for p, axis in PLANES.items()}
    return Slices(images, where, {"xy": x / y, "xz": x / z, "yz": y / z})


COLOURS = "viridis_r"


def depth_pixels(distance: NDArray, near_far: tuple[float, float], opacity: NDArray | None = None) -> NDArray[np.uint8]:
    """Distances as colours (H, W, 3), mixed with white by the opacity.

    Args:
        distance: (H, W) [length]; what is not finite is white.
        near_far: distances that are lightest and darkest.
        opacity: (H, W) in 0..1; None: 1.

    Raises:
        MivolError: another shape, or near not below far.
    """
    _check_plane(distance)
    near, far = near_far
    if not near < far:
        raise MivolError(f"distances are coloured between {near} and {far}; near must be below far.")
    there = np.isfinite(distance)
    share = np.clip((np.where(there, distance, far) - near) / (far - near), 0, 1)
    return _over_white(mpl.colormaps[COLOURS](share)[..., :3], there, opacity)


def normals_from_depth(distance: NDArray, camera: Camera) -> NDArray:
    """Unit normals (H, W, 3) in the world of the surface that a picture of distances is of, towards the camera.

    The surface is differentiated between neighbouring pixels (central differences inside, one-sided at the border), so that
    an edge in the distance is a wall there. NaN where a neighbour is not finite.

    Raises:
        MivolError: another size than the camera's.
    """
    _check_plane(distance)
    if distance.shape != camera.size[::-1]:
        raise MivolError(f"distances of shape {distance.shape} were not seen by a camera of {camera.size[::-1]} pixels.")
    origin, direction = rays(camera, pixel_centres(camera.size))
    points = origin + distance[..., None] * direction
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    with np.errstate(invalid="ignore"):
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(np.sum(normal * direction, axis=-1, keepdims=True) > 0, -normal, normal)


def normal_pixels(normals: NDArray, opacity: NDArray | None = None) -> NDArray[np.uint8]:
    """Unit normals (H, W, 3) as colours, mixed with white by the opacity (H, W); NaN is white."""
    there = np.isfinite(normals).all(axis=-1)
    return _over_white((1 + np.where(there[..., None], normals, 0)) / 2, there, opacity)


def _check_plane(distance: NDArray) -> None:
    if np.ndim(distance) != 2 or min(np.shape(distance)) < 2:
        raise MivolError(f"a picture of distances has shape {np.shape(distance)}; give (height, width), at least 2 x 2.")


def _over_white(colour: NDArray, there: NDArray, opacity: NDArray | None) -> NDArray[np.uint8]:
    a = np.where(there, 1.0 if opacity is None else np.clip(opacity, 0, 1), 0.0)[..., None]
    return np.round(255 * (a * colour + 1 - a)).astype(np.uint8)


PREVIEW = "preview.png"
EDGE, GAP = 320, 8
"""Pixels of the box's longest edge, and between two slices."""


def is_preview_due(iteration: int, iterations: int) -> bool:
    """Whether a preview is written after an iteration: the first and the last one, and some twenty between."""
    return iteration in (1, iterations) or iteration % max(1, iterations // 20) == 0


def write_preview(folder: Path, volume: NDArray, size: tuple[float, float, float]) -> Path:
    """Write ``preview.png`` whole: the middle slices xy, xz and yz side by side, on one grey scale, second axis upwards.

    Args:
        folder: of the run.
        volume: (Z, Y, X).
        size: lengths of the box's edges along x, y, z; the longest is EDGE pixels.
    """
    cut = middle_slices(volume, size)
    scale = shared_scale(*cut.images.values())
    edges = dict(zip("xyz", np.maximum(1, np.rint(EDGE * np.array(size) / max(size))).astype(int), strict=True))
    parts = [_resized(to_pixels(image, scale), edges[plane[1]], edges[plane[0]]) for plane, image in cut.images.items()]
    height = max(part.shape[0] for part in parts)
    paper = np.full((height, sum(part.shape[1] for part in parts) + 2 * GAP, 3), 255, np.uint8)
    left = 0
    for part in parts:
        paper[height - part.shape[0] :, left : left + part.shape[1]] = part
        left += part.shape[1] + GAP
    write_whole_bytes(folder / PREVIEW, encode_png(paper))
    return folder / PREVIEW


def _resized(rgb: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """The nearest pixels."""
    rows, columns = ((np.arange(n) + 0.5) * have // n for n, have in zip((height, width), rgb.shape, strict=False))
    return rgb[rows.astype(int)[:, None], columns.astype(int)]
