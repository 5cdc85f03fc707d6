"""Posed photographs: the images of a data set with their cameras, in one size and one colour space.

Conventions. :mod:`mivol.photos.camera` defines cameras, :mod:`mivol.photos.photo_file` pixels. :mod:`mivol.photos.survey` finds
the photographs and their box.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.display import with_short_repr
from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.machine import available_memory
from mivol.photos.camera import Camera, intrinsics, is_seen, pixel_centres
from mivol.photos.lens import Lens, distort
from mivol.photos.listing import find_shrink
from mivol.photos.photo_file import find_colour_space, read_mask, read_photo, read_photo_header, shrink
from mivol.photos.region import silhouette_box
from mivol.photos.survey import PhotoFrame, PhotoSurvey, survey_photos

Background = str | Sequence[float] | None


#: name -> function from the number of views and a seed to colours (n, 3).
BACKGROUNDS: dict[str, Callable[[int, int], np.ndarray]] = {
    "white": lambda n, seed: np.ones((n, 3)),
    "black": lambda n, seed: np.zeros((n, 3)),
    "random": lambda n, seed: np.random.default_rng(seed).random((n, 3)),
}


@with_short_repr
@dataclass(frozen=True)
class Photo:
    """A photograph with its camera.

    Attributes:
        name: file name.
        image: (H, W, 3) float32, blended over ``background`` by alpha.
        alpha: (H, W) float32; None for a file without alpha.
        mask: (H, W) bool, False for ignored pixels; None without ignored pixels.
        camera: camera at the size of the image.
        background: (3,) float32 colour behind the image.
        points: points (K, 3) of a sparse reconstruction visible in the photograph [length], if known.
    """

    name: str
    image: np.ndarray
    alpha: np.ndarray | None
    mask: np.ndarray | None
    camera: Camera
    background: np.ndarray
    points: np.ndarray | None = None

    def over(self, colour: np.ndarray) -> np.ndarray:
        """Return the image (H, W, 3) over another background, (3,) or (H, W, 3).

        Raises:
            MivolError: a photograph without alpha.
        """
        if self.alpha is None:
            raise _without_alpha(self.name)
        return self.image + (1 - self.alpha[..., None]) * (np.asarray(colour, np.float32) - self.background)


@with_short_repr
@dataclass(frozen=True)
class Photos:
    """Photographs for a fit.

    Attributes:
        views: photographs of the split.
        space: colour space of the values: "srgb" (code values) or "linear" (radiance).
        survey: cameras, splits and box, found before reading pixels.
        white: radiance of the files at a linear value of 1.
        stored: colour spaces of the files.
    """

    views: tuple[Photo, ...]
    space: str
    survey: PhotoSurvey
    white: float = 1.0
    stored: frozenset[str] = frozenset({"srgb"})

    @property
    def box(self) -> np.ndarray:
        """The box (2, 3) in view of the cameras [length]."""
        return self.survey.box

    def silhouette_box(self) -> np.ndarray:
        """Return the box (2, 3) around the region that no view shows as transparent [length].

        Raises:
            MivolError: as :func:`mivol.photos.region.silhouette_box`.
        """
        cameras, alphas = [view.camera for view in self.views], [view.alpha for view in self.views]
        return silhouette_box(cameras, alphas, self.box)

    @property
    def near_far(self) -> tuple[float, float]:
        """Smallest and largest distance of the box from the cameras [length]."""
        return self.survey.near_far

    @property
    def skipped(self) -> tuple[str, ...]:
        """Names of missing photographs."""
        return self.survey.skipped

    def describe(self) -> str:
        """Describe the photographs in a paragraph."""
        width, height = self.views[0].camera.size
        lines = [self.survey.describe(), f"read as {width} x {height} pixels of {self.space} values"]
        if self.views[0].alpha is not None:
            colours = {tuple(view.background.tolist()) for view in self.views}
            colour = "(" + ", ".join(f"{c:g}" for c in colours.pop()) + ")" if len(colours) == 1 else "a colour of its own"
            lines.append(f"transparent pixels show {colour}; photos.background chooses another colour")
        return "\n".join(lines)


def load_photos(
    path: str | os.PathLike,
    *,
    split: str = "train",
    scale: float = 1.0,
    background: Background = None,
    space: str | None = None,
    stored: str | None = None,
    held_out: int | Sequence[str] = 0,
    fold: int = 0,
    box: np.ndarray | str | None = None,
    seed: int = 0,
    largest: int | None = None,
    limit: int | None = None,
) -> Photos:
    """Read a data set of posed photographs.

    Args:
        path: folder, or file of cameras; the format is recognised (:data:`mivol.photos.survey.DATA_SET_FORMATS`).
        split: one of :data:`mivol.photos.survey.SPLITS`.
        scale: scale of the images in (0, 1]; 0.5 halves width and height by exact means over area.
        background: colour behind images with alpha: "white", "black", "random" (one colour per view; :meth:`Photo.over`
            blends over other colours) or (r, g, b). None is "white", as in NeRF's protocol. Only for images with alpha.
        space: colour space of the values, "srgb" or "linear"; by default the space of the files.
        stored: colour space of PNG and JPEG files, "srgb" or "linear"; by default srgb, or linear for a PNG with a gAMA of 1.
        held_out, fold: n for every n-th training photograph and the number of the first, or file names (:func:`survey_photos`).
        box: (2, 3) [length]; None or "middle" to find the box from the cameras or points.
        seed: seed of random backgrounds.
        largest: longest edge of a photograph [pixel]; larger photographs shrink below ``scale``.
        limit: memory limit [bytes], by default the available memory.

    Raises:
        MivolError: errors of :func:`survey_photos`; more pixels than the memory holds; a background for images without
            alpha; NaN; a damaged file.

    Example:
        >>> photos = load_photos("chair", scale=0.25, background="white")
        >>> o, d = rays(photos.views[0].camera, pixel_centres(photos.views[0].camera.size))
    """
    survey = survey_photos(path, split=split, held_out=held_out, fold=fold, box=box)
    stored_spaces = _find_stored_spaces(survey.frames, stored)
    space = _choose_space(space, stored_spaces)
    if not 0 < scale <= 1:
        raise refusal("scale", f"{scale}", "a number above 0 and at most 1", "photographs can only be shrunk")
    if largest is not None:
        scale = min(scale, largest / max(max(frame.camera.size) for frame in survey.frames))
    _check_memory(survey, scale, available_memory() if limit is None else limit)
    has_alpha = check_alpha(survey.frames)
    if background is not None and not has_alpha:
        raise _without_alpha(survey.frames[0].file)
    background = "white" if has_alpha and background is None else background
    colours = _backgrounds(background, len(survey.frames), seed)
    views = [_load_photo(frame, scale, colour, (space, stored)) for frame, colour in zip(survey.frames, colours, strict=True)]
    return Photos(tuple(views), space, survey, stored=frozenset(stored_spaces))


# -- Reading ------------------------------------------------------------------------------------------------------

KEPT_BYTES = 24
"""Memory of a loaded pixel [byte]: rgb as float32, and a copy while the lens distortion is removed."""

READ_BYTES = 64
"""Memory of a pixel during reading [byte]: rgb as float32 and float64, and the integral along an axis."""


def _check_memory(survey: PhotoSurvey, scale: float, limit: int | None) -> None:
    """Refuse photographs larger than the memory, before reading pixels.

    Raises:
        MivolError: names the largest possible scale.
    """
    sizes = [math.prod(frame.camera.size) for frame in survey.frames]
    kept, read = KEPT_BYTES * sum(sizes), READ_BYTES * max(sizes)
    if limit is None or kept * scale**2 + read <= limit:
        return
    fitting = math.floor(100 * math.sqrt(max(limit - read, 0) / kept)) / 100
    advice = f"use scale={fitting:g}" if fitting > 0 else "a single photograph is too large: shrink the files"
    found = f"{len(sizes)} photographs of about {(kept * scale**2 + read) / 2**30:.2g} GiB at scale {scale:.3g}"
    raise refusal(survey.path, found, f"at most the free memory, {limit / 2**30:.2g} GiB", advice)


def check_alpha(frames: Sequence[PhotoFrame]) -> bool:
    """Return whether the photographs have alpha.

    Raises:
        MivolError: only some photographs have alpha.
    """
    kinds = {read_photo_header(frame.file).has_alpha: frame.file for frame in frames}
    if len(kinds) == 2:
        found, advice = f"alpha here but not in {kinds[False].name}", "add an opaque alpha to the others, or remove alpha"
        raise refusal(kinds[True], found, "alpha in all photographs or in none", advice)
    return next(iter(kinds))


def _find_stored_spaces(frames: Sequence[PhotoFrame], stored: str | None) -> dict[str, Path]:
    """The colour spaces of the files, each with an example."""
    _check_space("stored", stored)
    return {find_colour_space(frame.file, stored): frame.file for frame in frames}


def _choose_space(requested: str | None, stored: dict[str, Path]) -> str:
    if requested is None and len(stored) == 2:
        names = " and ".join(file.name for file in stored.values())
        found, advice = "sRGB codes and radiance in one data set", 'set space = "srgb" or "linear"'
        raise refusal(names, found, "a single colour space", advice)
    _check_space("space", requested)
    return requested or next(iter(stored))


def _check_space(name: str, value: str | None) -> None:
    if value not in (None, "srgb", "linear"):
        raise refusal(name, f'"{value}"', '"srgb" or "linear"', "choose one")


def _backgrounds(background: Background, n: int, seed: int) -> Sequence[np.ndarray | None]:
    if background is None:
        return [None] * n
    if isinstance(background, str):
        if background not in BACKGROUNDS:
            known = ", ".join(BACKGROUNDS)
            raise refusal("background", f'"{background}"', f"one of {known}, or (r, g, b)", "choose one")
        return BACKGROUNDS[background](n, seed).astype(np.float32)
    colour = np.asarray(background, np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise refusal("background", f"{background}", "three finite numbers", "give (r, g, b)")
    return np.broadcast_to(colour, (n, 3))


def _load_photo(frame: PhotoFrame, scale: float, background: np.ndarray | None, spaces: tuple[str, str | None]) -> Photo:
    """Read a photograph; ``spaces`` holds the requested colour space and the declared space of the file."""
    image, alpha = read_photo(frame.file, *spaces, frame.orientation)
    camera = _shrunk_camera(frame.camera, scale)
    mask = None if frame.mask is None else _read_mask(frame, camera.size)
    inside = is_seen(camera, pixel_centres(camera.size))
    if not inside.all():
        mask = inside if mask is None else mask & inside
    image = shrink(image, camera.size)
    if alpha is not None:
        alpha = shrink(alpha, camera.size)
        image += (1 - alpha[..., None]) * background
    behind = np.zeros(3, np.float32) if background is None else background
    return Photo(frame.file.name, image, alpha, mask, camera, behind, frame.points)


def _shrunk_camera(camera: Camera, scale: float) -> Camera:
    width, height = (max(1, round(n * scale)) for n in camera.size)
    return camera.resized((width, height))


def _read_mask(frame: PhotoFrame, size: tuple[int, int]) -> np.ndarray:
    """Read and shrink a mask. A new pixel is valid if all pixels below it are valid."""
    mask = read_mask(frame.mask)
    if find_shrink(frame.camera.size, mask.shape[::-1]) is None:
        found, expected = (f"{w} x {h}" for h, w in (mask.shape, frame.camera.size[::-1]))
        raise refusal(frame.mask, f"a mask of {found}", f"{expected} as in the photograph", "scale the mask")
    return shrink((~mask).astype(np.float32), size) == 0


def _without_alpha(name: object) -> MivolError:
    return refusal(name, "an image without alpha", "alpha, because a background is given", "remove background")


# -- Rectification ------------------------------------------------------------------------------------------------


def to_pinhole(camera: Camera) -> Camera:
    """Return a pinhole with square pixels in place of a camera.

    The pinhole has the size, the principal point and the longer focal length of the camera.

    Raises:
        MivolError: a wide lens, whose field of view no pinhole covers.
    """
    if camera.distortion.is_wide:
        found = f"a {type(camera.distortion).__name__.lower()}"
        raise refusal(camera.name, found, "a lens with an image plane", "no pinhole covers its view: cut pinholes out of it")
    f = max(camera.K[0, 0], camera.K[1, 1])
    return dataclasses.replace(camera, K=intrinsics(f, f, *camera.K[:2, 2]), distortion=Lens())


def rectify(photo: Photo) -> Photo:
    """Return a photograph resampled to the pinhole of its camera (:func:`to_pinhole`).

    Colour multiplied by alpha is interpolated linearly between pixels; pixels outside the photograph are masked. Photographs of
    a wide lens or of a pinhole with square pixels are returned unchanged. Tracing rays exactly through the lens
    (:func:`mivol.photos.camera.rays`) needs no resampling.

    Bias: the interpolation is a low-pass filter of up to a pixel.
    """
    camera = photo.camera
    if camera.distortion.is_wide:
        return photo
    pinhole = to_pinhole(camera)
    if not camera.distortion and camera.K[0, 0] == camera.K[1, 1]:
        return photo
    plane = (pixel_centres(camera.size) - pinhole.K[:2, 2]) / pinhole.K[0, 0]
    pixels = distort(camera.distortion, plane) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    inside = ((pixels >= 0) & (pixels <= camera.size)).all(axis=-1)
    inside &= np.linalg.norm(plane, axis=-1) <= camera.distortion.fold
    pixels = np.where(inside[..., None], pixels, 0.5)
    if photo.mask is not None:
        inside &= _interpolate(photo.mask.astype(np.float32), pixels) == 1
    alpha = None if photo.alpha is None else _interpolate(photo.alpha, pixels)
    return dataclasses.replace(photo, image=_interpolate(photo.image, pixels), alpha=alpha, mask=inside, camera=pinhole)


def _interpolate(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Interpolate linearly between pixel centres at image points (H, W, 2); constant beyond the outermost centres."""
    last = np.array(image.shape[1::-1]) - 1
    index = np.clip(points - 0.5, 0, last)
    low = np.minimum(index.astype(int), np.maximum(last - 1, 0))
    x, y = np.moveaxis((index - low).astype(np.float32), -1, 0)
    if image.ndim == 3:
        x, y = x[..., None], y[..., None]
    (i, j), (i1, j1) = (low[..., 1], low[..., 0]), np.moveaxis(np.minimum(low + 1, last)[..., ::-1], -1, 0)
    top = image[i, j] + x * (image[i, j1] - image[i, j])
    bottom = image[i1, j] + x * (image[i1, j1] - image[i1, j])
    return top + y * (bottom - top)
