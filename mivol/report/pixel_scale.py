"""Map numbers to pixels on a scale shared by all images of a kind.

Conventions. Images hold linear values (height, width[, 1 or 3]), row 0 at the top; pixels are uint8 (height, width, 3).
Images meant for comparison share a :class:`Scale`. Radiance of three channels is shown in sRGB. A single channel is grey and
linear in the value. Differences are blue below zero, white at zero and red above. Pixels that are not finite are magenta.

Distances are measured along unit rays [length]; near is light, far is dark, and an opacity of 0 is white. A world normal n
has the colour (1 + n)/2.
"""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mivol.errors import MivolError
from mivol.files import encode_srgb
from mivol.files.atomic import write_whole_bytes
from mivol.photos import Camera, pixel_centres, rays

SIGNED = "RdBu_r"
"""Colour map of signed values."""

DEPTHS = "viridis_r"
"""Colour map of distances."""

MAGENTA = (255, 0, 255)
PLANES = {"xy": 0, "xz": 1, "yz": 2}
PREVIEW = "preview.png"

EDGE, GAP = 320, 8
"""Longest edge of the box in a preview, and the gap between two slices [pixel]."""


class Scale(NamedTuple):
    """The range of values mapped to the range of colours.

    Attributes:
        kind: "grey", "colour" or "signed".
        low: value shown black (signed: blue).
        high: value shown white (signed: red).
    """

    kind: str
    low: float
    high: float


HIGH = 99.8
"""Percentile of the values at the upper end of a scale [%]."""


def shared_scale(*images: NDArray, kind: str | None = None) -> Scale:
    """Return a scale for several images, from 0, or from a low percentile below 0, to a high percentile of their values.

    A percentile instead of the maximum keeps one firefly from turning the rest black.
    """
    values = np.concatenate([image[np.isfinite(image)].ravel() for image in images])
    if values.size == 0:
        return Scale(kind or "grey", 0.0, 1.0)
    bottom = min(0.0, float(np.percentile(values, 100 - HIGH)))
    top = float(np.percentile(values, HIGH))
    kind = kind or ("colour" if any(_channels(image) == 3 for image in images) else "grey")
    return Scale(kind, bottom, top if top > bottom else bottom + 1.0)


def signed_scale(*images: NDArray) -> Scale:
    """Return a symmetric scale for several differences."""
    values = np.concatenate([np.abs(image[np.isfinite(image)]).ravel() for image in images])
    limit = float(np.percentile(values, HIGH)) if values.size else 0.0
    return Scale("signed", -limit if limit else -1.0, limit or 1.0)


def to_pixels(image: NDArray, scale: Scale) -> NDArray[np.uint8]:
    """Return the image in 8 bits on a scale.

    Raises:
        MivolError: another shape than (height, width) or (height, width, 1 or 3).
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
    rgb[broken] = MAGENTA
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
    """Encode pixels as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(rgb)).save(buffer, "png", compress_level=6)
    return buffer.getvalue()


def data_uri(rgb: NDArray[np.uint8]) -> str:
    """Encode pixels as a ``data:`` address of a PNG."""
    return "data:image/png;base64," + base64.b64encode(encode_png(rgb)).decode("ascii")


class Slices(NamedTuple):
    """The three middle slices of a grid, each by its plane: "xy", "xz" or "yz".

    Attributes:
        images: slices; the first axis of the plane points right, the second up.
        where: index of each slice as text.
        aspect: width over height in the world.
    """

    images: dict[str, NDArray]
    where: dict[str, str]
    aspect: dict[str, float]


def middle_slices(grid: NDArray, size: tuple[float, float, float] | None = None) -> Slices:
    """Return the three orthogonal slices through the middle of a grid.

    Args:
        grid: (Z, Y, X[, C]).
        size: edges of the box along x, y, z [length]; by default cubic voxels.

    Raises:
        MivolError: a grid of another rank.
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


def depth_pixels(distance: NDArray, near_far: tuple[float, float], opacity: NDArray | None = None) -> NDArray[np.uint8]:
    """Return distances as colours (H, W, 3), mixed with white by the opacity.

    Args:
        distance: (H, W) [length]; values that are not finite are white.
        near_far: distances of the lightest and the darkest colour [length].
        opacity: (H, W) in 0..1, by default 1.

    Raises:
        MivolError: another shape, or near not below far.
    """
    _check_plane(distance)
    near, far = near_far
    if not near < far:
        raise MivolError(f"distances cannot be coloured between {near} and {far}; give near below far.")
    finite = np.isfinite(distance)
    share = np.clip((np.where(finite, distance, far) - near) / (far - near), 0, 1)
    return _over_white(mpl.colormaps[DEPTHS](share)[..., :3], finite, opacity)


def normals_from_depth(distance: NDArray, camera: Camera) -> NDArray:
    """Return unit world normals (H, W, 3) of the surface in a distance image; they point towards the camera.

    Neighbouring pixels are differentiated (central differences inside, one-sided differences at the border). A jump in
    distance therefore becomes a wall. A pixel with a non-finite neighbour is NaN.

    Raises:
        MivolError: a size that differs from the camera's.
    """
    _check_plane(distance)
    if distance.shape != camera.size[::-1]:
        raise MivolError(f"distances of shape {distance.shape} do not fit a camera of {camera.size[::-1]} pixels.")
    origin, direction = rays(camera, pixel_centres(camera.size))
    points = origin + distance[..., None] * direction
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    with np.errstate(invalid="ignore"):
        normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(np.sum(normal * direction, axis=-1, keepdims=True) > 0, -normal, normal)


def normal_pixels(normals: NDArray, opacity: NDArray | None = None) -> NDArray[np.uint8]:
    """Return unit normals (H, W, 3) as colours, mixed with white by the opacity (H, W); NaN becomes white."""
    finite = np.isfinite(normals).all(axis=-1)
    return _over_white((1 + np.where(finite[..., None], normals, 0)) / 2, finite, opacity)


def _check_plane(distance: NDArray) -> None:
    if np.ndim(distance) != 2 or min(np.shape(distance)) < 2:
        raise MivolError(f"a distance image has shape {np.shape(distance)}; give (height, width), at least 2 x 2.")


def _over_white(colour: NDArray, finite: NDArray, opacity: NDArray | None) -> NDArray[np.uint8]:
    a = np.where(finite, 1.0 if opacity is None else np.clip(opacity, 0, 1), 0.0)[..., None]
    return np.round(255 * (a * colour + 1 - a)).astype(np.uint8)


def is_preview_due(iteration: int, iterations: int) -> bool:
    """Return whether a run writes a preview after an iteration: the first, the last, and about ten between them."""
    return iteration in (1, iterations) or iteration % max(1, iterations // 10) == 0


def write_preview(folder: Path, volume: NDArray, size: tuple[float, float, float]) -> Path:
    """Write ``preview.png``: the middle slices xy, xz and yz side by side on one grey scale, the second axis up.

    Args:
        folder: run folder.
        volume: (Z, Y, X).
        size: edges of the box along x, y, z [length]; the longest edge gets ``EDGE`` pixels.
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
    """Resize to the nearest pixels."""
    rows, columns = ((np.arange(n) + 0.5) * old // n for n, old in zip((height, width), rgb.shape, strict=False))
    return rgb[rows.astype(int)[:, None], columns.astype(int)]
