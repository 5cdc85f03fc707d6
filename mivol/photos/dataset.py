"""Posed photographs: the images of a data set with their cameras, at one size and in one colour space.

Conventions. Cameras as in :mod:`mivol.photos.camera`, pixels as in :mod:`mivol.photos.photo_file`; which photographs there are
and what they look at is found by :mod:`mivol.photos.survey`.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.machine import available_memory
from mivol.photos.camera import Camera, intrinsics, is_seen, pixel_centres
from mivol.photos.lens import Lens, distort
from mivol.photos.photo_file import find_colour_space, read_mask, read_photo, read_photo_header, shrink
from mivol.photos.region import silhouette_box
from mivol.photos.survey import PhotoFrame, PhotoSurvey, survey_photos
from mivol.shown import briefly

__all__ = ["BACKGROUNDS", "Photo", "Photos", "check_alpha", "load_photos", "to_pinhole", "rectify"]

Background = str | Sequence[float] | None


#: name -> colour for each of n views, (n, 3), from a seed.
BACKGROUNDS: dict[str, Callable[[int, int], np.ndarray]] = {
    "white": lambda n, seed: np.ones((n, 3)),
    "black": lambda n, seed: np.zeros((n, 3)),
    "random": lambda n, seed: np.random.default_rng(seed).random((n, 3)),
}


@briefly
@dataclass(frozen=True)
class Photo:
    """A photograph and its camera.

    Attributes:
        name: its file's.
        image: (H, W, 3) float32, over ``background`` where it has alpha.
        alpha: (H, W) float32, or None where the file has none.
        mask: (H, W) bool, False where a pixel counts for nothing; None: all count.
        camera: of these pixels.
        background: (3,) float32 colour behind it.
        points: (K, 3) those of a sparse reconstruction that were found in it [length]; None where that is not known.
    """

    name: str
    image: np.ndarray
    alpha: np.ndarray | None
    mask: np.ndarray | None
    camera: Camera
    background: np.ndarray
    points: np.ndarray | None = None

    def over(self, colour: np.ndarray) -> np.ndarray:
        """(H, W, 3) the image over another background, (3,) or (H, W, 3).

        Raises:
            MivolError: it has no alpha.
        """
        if self.alpha is None:
            raise _without_alpha(self.name)
        return self.image + (1 - self.alpha[..., None]) * (np.asarray(colour, np.float32) - self.background)


@briefly
@dataclass(frozen=True)
class Photos:
    """Photographs, ready to be fitted.

    Attributes:
        views: of the split.
        space: what their values are: "srgb" (code values) or "linear" (radiance).
        survey: what was found before pixels were read.
        white: of linear values, the radiance of the files for which 1 stands.
        stored: what the values of the files are, of these two.
    """

    views: tuple[Photo, ...]
    space: str
    survey: PhotoSurvey
    white: float = 1.0
    stored: frozenset[str] = frozenset({"srgb"})

    @property
    def box(self) -> np.ndarray:
        """(2, 3) what is looked at [length]."""
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
        """Distances between which all of the box lies [length]."""
        return self.survey.near_far

    @property
    def skipped(self) -> tuple[str, ...]:
        """Names of photographs that are not there."""
        return self.survey.skipped

    def describe(self) -> str:
        """Describe the photographs in a paragraph."""
        width, height = self.views[0].camera.size
        return f"{self.survey.describe()}\nread as {width} x {height} pixels of {self.space} values"


def load_photos(
    path: str | os.PathLike,
    *,
    split: str = "train",
    scale: float = 1.0,
    background: Background = None,
    space: str | None = None,
    stored: str | None = None,
    held_out: int | Sequence[str] = 0,
    box: np.ndarray | str | None = None,
    seed: int = 0,
    largest: int | None = None,
    limit: int | None = None,
) -> Photos:
    """Read a data set of posed photographs.

    Args:
        path: folder, or file of cameras; the format is recognised (:data:`mivol.photos.survey.FORMATS`).
        split: one of :data:`mivol.photos.survey.SPLITS`.
        scale: of the images, in (0, 1]: 0.5 halves width and height, by exact means over area.
        background: behind images with alpha: "white", "black", "random" (a colour for each view; :meth:`Photo.over` for
            others) or (r, g, b); None where there is no alpha.
        space: "srgb" or "linear", what the values shall be; None: as the files are.
        stored: "srgb" or "linear", what those of PNG and JPEG are; None: linear where a PNG says so, else srgb.
        held_out: every n-th training photograph, or file names (:func:`survey_photos`).
        box: (2, 3) [length]; None or "middle": found.
        seed: of random backgrounds.
        largest: longest edge at which any photograph is held [pixel]; larger ones are shrunk further than ``scale`` says.
        limit: memory that may be taken [bytes]; None for what the machine has left.

    Raises:
        MivolError: as :func:`survey_photos`; more pixels than there is memory for; images with alpha and no background or the
            reverse; NaN; a damaged file.

    Example:
        >>> photos = load_photos("chair", scale=0.25, background="white")
        >>> o, d = rays(photos.views[0].camera, pixel_centres(photos.views[0].camera.size))
    """
    survey = survey_photos(path, split=split, held_out=held_out, box=box)
    held = _spaces(survey.frames, stored)
    space = _space(space, held)
    if not 0 < scale <= 1:
        raise refusal("scale", f"{scale}", "a number above 0 and at most 1", "photographs can only be shrunk")
    if largest is not None:
        scale = min(scale, largest / max(max(frame.camera.size) for frame in survey.frames))
    _check_memory(survey, scale, available_memory() if limit is None else limit)
    _check_background(check_alpha(survey.frames), background, survey.frames[0].file)
    colours = _backgrounds(background, len(survey.frames), seed)
    views = [_photo(frame, scale, colour, (space, stored)) for frame, colour in zip(survey.frames, colours, strict=True)]
    return Photos(tuple(views), space, survey, stored=frozenset(held))


# -- Reading ------------------------------------------------------------------------------------------------------

HELD = 24
"""Bytes a pixel that is kept: rgb as float32, and once more while a lens' distortion is taken out."""

READ = 64
"""Bytes a pixel of the one file that is being read: rgb in float32 and float64, and their integral along an axis."""


def _check_memory(survey: PhotoSurvey, scale: float, limit: int | None) -> None:
    """Refuse photographs that do not fit, before any is read.

    Raises:
        MivolError: with the largest scale that does.
    """
    sizes = [math.prod(frame.camera.size) for frame in survey.frames]
    kept, read = HELD * sum(sizes), READ * max(sizes)
    if limit is None or kept * scale**2 + read <= limit:
        return
    fitting = math.floor(100 * math.sqrt(max(limit - read, 0) / kept)) / 100
    advice = f"scale={fitting:g} fits" if fitting > 0 else "not even one can be read: shrink the files"
    found = f"{len(sizes)} photographs at scale {scale:.3g} take about {(kept * scale**2 + read) / 2**30:.2g} GiB"
    raise MivolError(f"{survey.path}: {found} and {limit / 2**30:.2g} are left; {advice}.")


def check_alpha(frames: Sequence[PhotoFrame]) -> bool:
    """Whether photographs have alpha.

    Raises:
        MivolError: some have and some have not.
    """
    kinds = {read_photo_header(frame.file).has_alpha: frame.file for frame in frames}
    if len(kinds) == 2:
        found, advice = f"alpha, and none in {kinds[False].name}", "add an opaque alpha to the others, or remove it from all"
        raise refusal(kinds[True], found, "alpha in all photographs or in none", advice)
    return next(iter(kinds))


def _check_background(has_alpha: bool, background: Background, first: Path) -> None:
    if has_alpha and background is None:
        raise refusal(first, "an image with alpha", "a background to put it over", 'set background="white", for instance')
    if not has_alpha and background is not None:
        raise _without_alpha(first)


def _spaces(frames: Sequence[PhotoFrame], stored: str | None) -> dict[str, Path]:
    """What the values of files are, each with one of them."""
    _check_space("stored", stored)
    return {find_colour_space(frame.file, stored): frame.file for frame in frames}


def _space(wanted: str | None, held: dict[str, Path]) -> str:
    if wanted is None and len(held) == 2:
        names = " and ".join(file.name for file in held.values())
        found, advice = "codes and radiance in one set", 'choose space = "srgb" or "linear" for all'
        raise refusal(names, found, "one kind of values", advice)
    _check_space("space", wanted)
    return wanted or next(iter(held))


def _check_space(name: str, value: str | None) -> None:
    if value not in (None, "srgb", "linear"):
        raise refusal(name, f'"{value}"', '"srgb" or "linear"', "choose one of those")


def _backgrounds(background: Background, n: int, seed: int) -> Sequence[np.ndarray | None]:
    if background is None:
        return [None] * n
    if isinstance(background, str):
        if background not in BACKGROUNDS:
            known = ", ".join(BACKGROUNDS)
            raise refusal("background", f'"{background}"', f"one of {known}, or (r, g, b)", "choose one of those")
        return BACKGROUNDS[background](n, seed).astype(np.float32)
    colour = np.asarray(background, np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise refusal("background", f"{background}", "three finite numbers", "give (r, g, b)")
    return np.broadcast_to(colour, (n, 3))


def _photo(frame: PhotoFrame, scale: float, background: np.ndarray | None, spaces: tuple[str, str | None]) -> Photo:
    """Read one, whose values shall be, and in its file are, what ``spaces`` says."""
    image, alpha = read_photo(frame.file, *spaces)
    camera = _shrunk_camera(frame.camera, scale)
    mask = None if frame.mask is None else _read_mask(frame, camera.size)
    seen = is_seen(camera, pixel_centres(camera.size))
    if not seen.all():
        mask = seen if mask is None else mask & seen
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
    """A shrunk pixel counts where all that it is the mean of count."""
    mask = read_mask(frame.mask)
    if mask.shape != frame.camera.size[::-1]:
        found, wanted = (f"{w} x {h}" for h, w in (mask.shape, frame.camera.size[::-1]))
        raise refusal(frame.mask, f"a mask of {found}", f"{wanted} as its photograph", "scale it")
    return shrink((~mask).astype(np.float32), size) == 0


def _without_alpha(name: object) -> MivolError:
    return refusal(name, "an image without alpha", "alpha, since a background is asked for", "leave background away")


def to_pinhole(camera: Camera) -> Camera:
    """The pinhole with square pixels that stands in for a camera.

    Raises:
        MivolError: a wide lens, which sees more than a pinhole.
    """
    if camera.distortion.is_wide:
        found = f"a {type(camera.distortion).__name__.lower()}"
        raise refusal(camera.name, found, "a lens with an image plane", "no pinhole sees what it sees: cut pinholes out of it")
    f = max(camera.K[0, 0], camera.K[1, 1])
    return dataclasses.replace(camera, K=intrinsics(f, f, *camera.K[:2, 2]), distortion=Lens())


def rectify(photo: Photo) -> Photo:
    """A photograph as the pinhole of its camera would have taken it; one of such a pinhole, or of a wide lens, as it is.

    Bias: the interpolation is a low-pass of up to a pixel's width.
    """
    camera = photo.camera
    if camera.distortion.is_wide:
        return photo
    pinhole = to_pinhole(camera)
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
