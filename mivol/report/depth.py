"""Distances and surface normals as pictures.

Conventions. Distances are along unit rays [length], (H, W); where nothing is, opacity is 0 and the picture white. Near is
light, far dark. A normal (x, y, z) of the world is the colour (1 + n)/2.
"""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from mivol.errors import MivolError
from mivol.photos import Camera, pixel_centres, rays

__all__ = ["COLOURS", "depth_pixels", "normal_pixels", "normals_of_depth"]

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


def normals_of_depth(distance: NDArray, camera: Camera) -> NDArray:
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
