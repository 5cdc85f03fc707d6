"""The list of a data set: an entry for each photograph, before any pixel is read."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera import Camera
from mivol.photos.photo_file import SUFFIXES

UNLISTED = "in no list"
"""Split of the photographs outside the lists of the data set."""


@dataclass(frozen=True)
class Entry:
    """A photograph in the list of a data set.

    Attributes:
        name: name in the data set.
        file: path of the image, which may be missing.
        camera: function from (width, height) [pixel] to the camera.
        split: "train", "test", "val" or ``UNLISTED``.
        size: (width, height) in the file of cameras [pixel]; by default all photographs of the split have the same size.
        mask: path of the mask, optional.
        points: points (K, 3) of a sparse reconstruction visible in the photograph [length], if known.
        is_stored: whether the camera describes stored pixels, not upright ones, unless sizes show otherwise.
    """

    name: str
    file: Path
    camera: Callable[[tuple[int, int]], Camera]
    split: str = "train"
    size: tuple[int, int] | None = None
    mask: Path | None = None
    points: np.ndarray | None = None
    is_stored: bool = False


@dataclass(frozen=True)
class Listing:
    """The photographs and points of a data set.

    Attributes:
        entries: photographs in the order of the data set.
        points: points (N, 3) of a sparse reconstruction [length], if known.
        box: (2, 3) box of the visible matter [length], if the data set has distances.
        notes: sentences on the data set for the user.
    """

    entries: list[Entry]
    points: np.ndarray | None = None
    box: np.ndarray | None = None
    notes: tuple[str, ...] = ()


SHRUNK = (1, 2, 4, 8)
"""Sizes in the file of cameras over the sizes of photographs: the folders ``images_2``, ``images_4`` and ``images_8``."""


def find_shrink(size: tuple[int, int], listed: tuple[int, int]) -> int | None:
    """Return the entry k of ``SHRUNK`` for which width and height are 1/k of a listed size, rounded up or down; else None."""
    return next((k for k in SHRUNK if all(abs(k * n - m) < k for n, m in zip(size, listed, strict=True))), None)


def find_image(path: Path) -> Path:
    """Return the existing file of a photograph; without a match the path, or the path with the first of ``SUFFIXES``.

    The name may lack its suffix. A missing folder ``images`` is replaced by ``images_2``, ``images_4`` or ``images_8``, whose
    files may have another suffix.
    """
    has_suffix = path.suffix.lower() in SUFFIXES
    if has_suffix and path.is_file():
        return path
    names = [path, *([] if has_suffix else [path.with_name(path.name + suffix) for suffix in SUFFIXES])]
    for name in list(names):
        names += [small for k in SHRUNK[1:] for small in _in_small_folder(name, k)]
    return next((file for file in names if file.is_file()), path if has_suffix else names[1])


def _in_small_folder(path: Path, shrink: int) -> list[Path]:
    """Files of a photograph in ``images_2``, ... in the place of the missing folder ``images``."""
    at = next((n for n, folder in enumerate(path.parents) if folder.name == "images"), None)
    if at is None or path.parents[at].is_dir():
        return []
    folder = path.parents[at]
    small = folder.with_name(f"images_{shrink}") / path.relative_to(folder)
    return [small, *(small.with_suffix(suffix) for suffix in SUFFIXES)]


def find_mask(image: Path) -> Path | None:
    """Return the mask of a photograph in a folder ``masks`` beside its folder, or beside a folder above; None without a mask.

    The mask of ``images/left/a.jpg`` is ``masks/left/a.jpg.png``, ``masks/left/a.png`` or ``masks/left/a.jpg``.
    """
    for folder in image.parents[1:4]:
        if (folder / "masks").is_dir():
            mask = folder / "masks" / Path(*image.relative_to(folder).parts[1:])
            files = (mask.with_name(f"{mask.name}.png"), mask.with_suffix(".png"), mask)
            return next((file for file in files if file.is_file()), None)
    return None


def check_points(rows: np.ndarray, file: Path, way_out: str) -> None:
    """Refuse points (N, 3 or more) with a number that is not finite.

    Raises:
        MivolError: names the first bad point.
    """
    if not np.isfinite(rows).all():
        number = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise refusal(file, f"point {number} at {rows[number, :3].tolist()}", "finite numbers", way_out)


def name_first(names: Sequence[str]) -> str:
    """Join the first five names by commas; dots stand for the rest."""
    return ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")


def split_numbers(name: str) -> list[tuple[int, str]]:
    """Key that sorts 2.jpg before 10.jpg."""
    return [(int(part), part) if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]{1,18})", name)]


UNREAD = (".tif", ".tiff", ".bmp", ".gif", ".jp2", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
"""Suffixes of images that are not read as photographs. A folder of TIFF files is a scan."""


def list_photographs(folder: Path, suffixes: tuple[str, ...] = SUFFIXES) -> tuple[Path, list[str]]:
    """Return the folder of the images and the sorted names of the photographs in it, with forward slashes.

    The images lie in ``images/`` and folders below, or directly in the folder.

    Args:
        folder: the data set.
        suffixes: of the files to list.
    """
    images = folder / "images"
    files = images.rglob("*") if images.is_dir() else folder.iterdir() if folder.is_dir() else ()
    images = images if images.is_dir() else folder
    return images, sorted(f.relative_to(images).as_posix() for f in files if f.suffix.lower() in suffixes and f.is_file())
