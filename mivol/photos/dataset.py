"""Posed photographs: a folder of images and a file of cameras, read into one form.

Conventions. Cameras as in :mod:`mivol.photos.camera`, pixels as in :mod:`mivol.photos.picture`. A data set divides itself into
train, val and test; ``held_out`` takes every n-th photograph of the training split, or those named, aside. Photographs that
are named and not there are skipped, by name. The box comes from the training cameras (or the points of a reconstruction),
whichever split is read, so that all splits share it.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.photos import region
from mivol.photos.camera import Camera
from mivol.photos.colmap import find_model, read_colmap
from mivol.photos.listing import UNLISTED, Entry, Listing
from mivol.photos.picture import picture_size, read_mask, read_picture, shrink, space_of
from mivol.photos.transforms import read_blender, read_transforms

__all__ = [
    "BACKGROUNDS",
    "FORMATS",
    "SPLITS",
    "Format",
    "Frame",
    "Photo",
    "Photos",
    "PhotoSurvey",
    "find_format",
    "load_photos",
    "survey_photos",
]

SPLITS = ("train", "held_out", "val", "test", "all")

Background = str | Sequence[float] | None


@dataclass(frozen=True)
class Format:
    """A way in which data sets lie on disk: how to recognise one, and its reader."""

    recognise: Callable[[Path], bool]
    read: Callable[[Path], Listing]


#: name -> format, tried in this order.
FORMATS: dict[str, Format] = {
    "Blender (NeRF)": Format(lambda path: (path / "transforms_train.json").is_file(), read_blender),
    "transforms.json": Format(lambda path: (path / "transforms.json").is_file() or path.suffix == ".json", read_transforms),
    "COLMAP": Format(lambda path: find_model(path) is not None, read_colmap),
}

#: name -> colour for each of n views, (n, 3), from a seed.
BACKGROUNDS: dict[str, Callable[[int, int], np.ndarray]] = {
    "white": lambda n, seed: np.ones((n, 3)),
    "black": lambda n, seed: np.zeros((n, 3)),
    "random": lambda n, seed: np.random.default_rng(seed).random((n, 3)),
}


@dataclass(frozen=True)
class Frame:
    """A photograph that is there: its file, camera, mask and split; no pixel is read yet."""

    file: Path
    camera: Camera
    split: str
    mask: Path | None = None


@dataclass(frozen=True)
class PhotoSurvey:
    """What a data set holds, from its cameras and the headers of its images.

    Attributes:
        path: as given.
        format: key of ``FORMATS``.
        frames: those of the split that are there.
        skipped: names of those that are not.
        box: (2, 3) float64 [length], what is looked at.
        box_from: where the box comes from, for people.
        near_far: distances from the cameras between which all of the box lies [length].
        points: (N, 3) of a sparse reconstruction, or None.
    """

    path: Path
    format: str
    frames: tuple[Frame, ...]
    skipped: tuple[str, ...]
    box: np.ndarray
    box_from: str
    near_far: tuple[float, float]
    points: np.ndarray | None = None

    @property
    def text(self) -> str:
        """A paragraph of facts."""
        cameras = [frame.camera for frame in self.frames]
        sizes = sorted({f"{c.size[0]} x {c.size[1]}" for c in cameras})
        focal = [c.K[0, 0] for c in cameras]
        lens = "with distortion" if any(c.distortion for c in cameras) else "pinhole"
        counts = ", ".join(f"{n} {split}" for split in (*SPLITS, UNLISTED) if (n := sum(f.split == split for f in self.frames)))
        lines = [
            f"{self.path}: {self.format}, {len(cameras)} photographs ({counts}), {', '.join(sizes)} pixels, {lens}",
            f"focal length {_range(focal)} pixels, horizontal field of view {_range([_angle(c) for c in cameras])} degrees",
            f"box {_corner(self.box[0])} to {_corner(self.box[1])}, {self.box_from}",
            f"near {self.near_far[0]:.4g}, far {self.near_far[1]:.4g}",
        ]
        if self.skipped:
            named = ", ".join(self.skipped[:5]) + (" ..." if len(self.skipped) > 5 else "")
            lines.append(f"skipped {len(self.skipped)} that are not there: {named}")
        return "\n".join(lines)


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
    """

    name: str
    image: np.ndarray
    alpha: np.ndarray | None
    mask: np.ndarray | None
    camera: Camera
    background: np.ndarray

    def over(self, colour: np.ndarray) -> np.ndarray:
        """(H, W, 3) the image over another background, (3,) or (H, W, 3).

        Raises:
            MivolError: it has no alpha.
        """
        if self.alpha is None:
            raise _without_alpha(self.name)
        return self.image + (1 - self.alpha[..., None]) * (np.asarray(colour, np.float32) - self.background)


@dataclass(frozen=True)
class Photos:
    """Photographs, ready to be fitted.

    Attributes:
        views: of the split.
        space: what their values are: "srgb" (code values) or "linear".
        survey: what was found before pixels were read.
    """

    views: tuple[Photo, ...]
    space: str
    survey: PhotoSurvey

    @property
    def box(self) -> np.ndarray:
        """(2, 3) what is looked at [length]."""
        return self.survey.box

    @property
    def near_far(self) -> tuple[float, float]:
        """Distances between which all of the box lies [length]."""
        return self.survey.near_far

    @property
    def skipped(self) -> tuple[str, ...]:
        """Names of photographs that are not there."""
        return self.survey.skipped

    @property
    def text(self) -> str:
        """A paragraph of facts."""
        width, height = self.views[0].camera.size
        return f"{self.survey.text}\nread as {width} x {height} pixels of {self.space} values"


def survey_photos(
    path: str | os.PathLike,
    *,
    split: str = "all",
    held_out: int | Sequence[str] = 0,
    box: np.ndarray | None = None,
) -> PhotoSurvey:
    """Cameras, sizes and box of a data set; no pixel is read.

    Args:
        path: folder, or file of cameras.
        split: one of ``SPLITS``: "train" without what is held out, "held_out", "val" and "test" as the data set has them.
        held_out: every n-th of the training photographs that are there, beginning with the first (0: none), or file names.
        box: (2, 3) [length]; None: from points or cameras (:mod:`mivol.photos.region`).

    Raises:
        MivolError: no data set, a split without photographs, cameras that are wrong or look away from the box.
    """
    path = Path(path)
    name, listing = _read(path)
    if split not in SPLITS:
        raise refusal("split", f'"{split}"', f"one of {', '.join(SPLITS)}", "choose one of those")
    entries = _divided(listing.entries, held_out, path)
    present = [entry for entry in entries if entry.file.is_file()]
    chosen = [entry for entry in present if split in ("all", entry.split)]
    absent = [entry.name for entry in entries if not entry.file.is_file() and split in ("all", entry.split)]
    if not chosen:
        raise _nothing_left(path, split, absent, entries)
    cameras = {id(entry): camera for entry, camera in zip(present, _cameras(present), strict=True)}
    frames = [Frame(entry.file, cameras[id(entry)], entry.split, _mask(entry)) for entry in chosen]
    training = [entry for entry in present if entry.split in ("train", "held_out")]
    looking = [cameras[id(entry)] for entry in training or chosen]
    found, whence = _box(box, listing.points, looking, path)
    region.check_views([frame.camera for frame in frames], found)
    near_far = region.near_far_of([*looking, *(frame.camera for frame in frames)], found)
    return PhotoSurvey(path, name, tuple(frames), tuple(absent), found, whence, near_far, listing.points)


def load_photos(
    path: str | os.PathLike,
    *,
    split: str = "train",
    scale: float = 1.0,
    background: Background = None,
    space: str | None = None,
    held_out: int | Sequence[str] = 0,
    box: np.ndarray | None = None,
    seed: int = 0,
) -> Photos:
    """Read a data set of posed photographs.

    Args:
        path: folder, or file of cameras; the format is recognised (``FORMATS``).
        split: one of ``SPLITS``.
        scale: of the images, in (0, 1]: 0.5 halves width and height, by exact means over area.
        background: behind images with alpha: "white", "black", "random" (a colour for each view; :meth:`Photo.over` for
            others) or (r, g, b); None where there is no alpha.
        space: "srgb" or "linear", what the values shall be; None: as the files are.
        held_out: every n-th training photograph, or file names (:func:`survey_photos`).
        box: (2, 3) [length]; None: found.
        seed: of random backgrounds.

    Raises:
        MivolError: as :func:`survey_photos`; images with alpha and no background or the reverse; NaN; a damaged file.

    Example:
        >>> photos = load_photos("chair", scale=0.25, background="white")
        >>> o, d = rays(photos.views[0].camera, pixel_centres(photos.views[0].camera.size))
    """
    survey = survey_photos(path, split=split, held_out=held_out, box=box)
    space = _space(space, survey.frames)
    if not 0 < scale <= 1:
        raise refusal("scale", f"{scale}", "a number above 0 and at most 1", "photographs can only be shrunk")
    colours = _backgrounds(background, len(survey.frames), seed)
    views = [_photo(frame, scale, colour, space) for frame, colour in zip(survey.frames, colours, strict=True)]
    return Photos(tuple(views), space, survey)


# -- Choosing -----------------------------------------------------------------------------------------------------


def find_format(path: Path) -> str | None:
    """The key of ``FORMATS`` of a folder or file of cameras; None where it is neither."""
    return next((name for name, kind in FORMATS.items() if kind.recognise(path)), None)


def _read(path: Path) -> tuple[str, Listing]:
    if not path.exists():
        raise refusal(path, "nothing there", "a folder of photographs or a file of cameras", "check the path")
    name = find_format(path)
    if name is None:
        known = ", ".join(FORMATS)
        raise refusal(path, "no cameras", f"one of {known}", "name the folder that holds the file of cameras")
    return name, FORMATS[name].read(path)


def _divided(entries: list[Entry], held_out: int | Sequence[str], path: Path) -> list[Entry]:
    """Entries with the split "held_out" where they are held out."""
    train = [entry for entry in entries if entry.split == "train" and entry.file.is_file()]
    if isinstance(held_out, int):
        if held_out < 0 or held_out == 1:
            raise refusal("held_out", f"{held_out}", "0, or 2 and more", "1 would hold out every view")
        aside = {id(entry) for entry in train[::held_out]} if held_out else set()
    else:
        names = {name for entry in train for name in (entry.name, entry.file.name)}
        unknown = next((name for name in held_out if name not in names), None)
        if unknown is not None:
            raise refusal(path, f'no training photograph "{unknown}" to hold out', "names of files", "correct held_out")
        aside = {id(entry) for entry in train if {entry.name, entry.file.name} & set(held_out)}
    return [dataclasses.replace(entry, split="held_out") if id(entry) in aside else entry for entry in entries]


def _nothing_left(path: Path, split: str, absent: list[str], entries: list[Entry]) -> MivolError:
    if absent:
        found = f"none of the {len(absent)} photographs that it names ({absent[0]} is the first)"
        return refusal(path, found, "at least one image beside the cameras", "copy the images")
    there = ", ".join(sorted({entry.split for entry in entries}))
    return refusal(path, f"no photograph in the split {split}", f"one of {there}", "choose one, or set held_out")


def _cameras(entries: Sequence[Entry]) -> list[Camera]:
    """Cameras of photographs whose size is what the file of cameras says, or that of the first of their split."""
    cameras, first = [], {}
    for entry in entries:
        size = picture_size(entry.file)
        wanted, whence = (
            (entry.size, "the file of cameras") if entry.size else first.setdefault(entry.split, (size, entry.name))
        )
        if size != wanted:
            found, expected = (f"{w} x {h} pixels" for w, h in (size, wanted))
            raise refusal(entry.file, found, f"{expected} as {whence}", "scale the image, or correct the cameras")
        cameras.append(entry.camera(size))
    return cameras


def _mask(entry: Entry) -> Path | None:
    if entry.mask is not None and not entry.mask.is_file():
        raise refusal(entry.mask, "no mask there", f"that of {entry.name}", "copy it, or take it out of the file of cameras")
    return entry.mask


def _box(box: np.ndarray | None, points: np.ndarray | None, cameras: Sequence[Camera], path: Path) -> tuple[np.ndarray, str]:
    if box is not None:
        return region.check_box(box), "as given"
    if points is not None and len(points) >= region.FEWEST_POINTS:
        return region.box_of_points(points), f"98 % of {len(points)} points and 5 % more on each side"
    share = f"where at least {100 * region.SHARE:.0f} % of {len(cameras)} cameras look"
    return region.shared_box(cameras, path), share


# -- Reading ------------------------------------------------------------------------------------------------------


def _space(wanted: str | None, frames: Sequence[Frame]) -> str:
    held = {space_of(frame.file): frame.file for frame in frames}
    if wanted is None and len(held) == 2:
        names = " and ".join(file.name for file in held.values())
        raise refusal(names, "8-bit and OpenEXR images in one set", "one kind of values", 'choose space="srgb" or "linear"')
    if wanted not in (None, "srgb", "linear"):
        raise refusal("space", f'"{wanted}"', '"srgb" or "linear"', "choose one of those")
    return wanted or next(iter(held))


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


def _photo(frame: Frame, scale: float, background: np.ndarray | None, space: str) -> Photo:
    image, alpha = read_picture(frame.file, space)
    if alpha is None and background is not None:
        raise _without_alpha(frame.file)
    if alpha is not None and background is None:
        raise refusal(frame.file, "an image with alpha", "a background to put it over", 'set background="white", for instance')
    camera = _shrunk_camera(frame.camera, scale)
    mask = None if frame.mask is None else _read_mask(frame, camera.size)
    image = shrink(image, camera.size)
    if alpha is not None:
        alpha = shrink(alpha, camera.size)
        image += (1 - alpha[..., None]) * background
    behind = np.zeros(3, np.float32) if background is None else background
    return Photo(frame.file.name, image, alpha, mask, camera, behind)


def _shrunk_camera(camera: Camera, scale: float) -> Camera:
    width, height = (max(1, round(n * scale)) for n in camera.size)
    return camera.resized((width, height))


def _read_mask(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """A shrunk pixel counts where all that it is the mean of count."""
    mask = read_mask(frame.mask)
    if mask.shape != frame.camera.size[::-1]:
        found, wanted = (f"{w} x {h}" for h, w in (mask.shape, frame.camera.size[::-1]))
        raise refusal(frame.mask, f"a mask of {found}", f"{wanted} as its photograph", "scale it")
    return shrink((~mask).astype(np.float32), size) == 0


def _without_alpha(name: object) -> MivolError:
    return refusal(name, "an image without alpha", "alpha, since a background is asked for", "leave background away")


# -- Words --------------------------------------------------------------------------------------------------------


def _range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.6g}" if high - low <= 1e-6 * high else f"{low:.6g} to {high:.6g}"


def _angle(camera: Camera) -> float:
    left, right = camera.K[0, 2], camera.size[0] - camera.K[0, 2]
    return float(np.degrees(np.arctan(left / camera.K[0, 0]) + np.arctan(right / camera.K[0, 0])))


def _corner(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"
