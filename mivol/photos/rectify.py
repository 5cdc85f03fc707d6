"""Photographs as a pinhole would have taken them: distortion taken out by resampling.

Conventions. The pinhole has square pixels, the principal point and the size of the camera, and the longer of its focal lengths.
Pixels between four that were taken are interpolated linearly (colour multiplied by alpha); what no pixel saw is masked.
Tracing the lens exactly (:func:`mivol.photos.camera.rays`) loses nothing; this is for those who need a pinhole.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera import Camera, intrinsics, pixel_centres
from mivol.photos.dataset import Photo
from mivol.photos.lens import Lens, distort

__all__ = ["pinhole_of", "rectified"]


def pinhole_of(camera: Camera) -> Camera:
    """The pinhole with square pixels that stands in for a camera.

    Raises:
        MivolError: a wide lens, which sees more than a pinhole.
    """
    if camera.distortion.is_wide:
        found = f"a {type(camera.distortion).__name__.lower()}"
        raise refusal(camera.name, found, "a lens with an image plane", "no pinhole sees what it sees: cut pinholes out of it")
    f = max(camera.K[0, 0], camera.K[1, 1])
    return dataclasses.replace(camera, K=intrinsics(f, f, *camera.K[:2, 2]), distortion=Lens())


def rectified(photo: Photo) -> Photo:
    """A photograph as the pinhole of its camera would have taken it; one of such a pinhole, or of a wide lens, as it is.

    Bias: the interpolation is a low-pass of up to a pixel's width.
    """
    camera = photo.camera
    if camera.distortion.is_wide:
        return photo
    pinhole = pinhole_of(camera)
    if not camera.distortion and camera.K[0, 0] == camera.K[1, 1]:
        return photo
    plane = (pixel_centres(camera.size) - pinhole.K[:2, 2]) / pinhole.K[0, 0]
    at = distort(camera.distortion, plane) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    seen = ((at >= 0) & (at <= camera.size)).all(axis=-1) & (np.linalg.norm(plane, axis=-1) <= camera.distortion.fold)
    at = np.where(seen[..., None], at, 0.5)
    if photo.mask is not None:
        seen &= _interpolated(photo.mask.astype(np.float32), at) == 1
    alpha = None if photo.alpha is None else _interpolated(photo.alpha, at)
    return dataclasses.replace(photo, image=_interpolated(photo.image, at), alpha=alpha, mask=seen, camera=pinhole)


def _interpolated(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Linear interpolation between pixel centres at points (H, W, 2); constant beyond the outermost centres."""
    last = np.array(image.shape[1::-1]) - 1
    place = np.clip(at - 0.5, 0, last)
    low = np.minimum(place.astype(int), np.maximum(last - 1, 0))
    x, y = np.moveaxis((place - low).astype(np.float32), -1, 0)
    if image.ndim == 3:
        x, y = x[..., None], y[..., None]
    (i, j), (i1, j1) = (low[..., 1], low[..., 0]), np.moveaxis(np.minimum(low + 1, last)[..., ::-1], -1, 0)
    top = image[i, j] + x * (image[i, j1] - image[i, j])
    bottom = image[i1, j] + x * (image[i1, j1] - image[i1, j])
    return top + y * (bottom - top)
