"""What a data set of photographs holds, before a pixel is read: its cameras, its splits and the box that they look at.

Conventions. Cameras as in :mod:`mivol.photos.camera`. A data set divides itself into train, val and test; ``held_out`` takes
every n-th photograph of the training split, or those named, aside. Photographs that are named and not there are skipped, by
name. The box comes from the training cameras (or the points of a reconstruction), whichever split is read, so that all splits
share it.
"""

from __future__ import annotations

import dataclasses
import filecmp
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.photos import region
from mivol.photos.camera import Camera, field_of_view
from mivol.photos.colmap import find_model, read_colmap
from mivol.photos.listing import UNLISTED, Entry, Listing
from mivol.photos.photo_file import PhotoHeader, read_photo_header
from mivol.photos.transforms import read_blender, read_transforms
from mivol.shown import briefly

__all__ = ["FORMATS", "SPLITS", "Format", "PhotoFrame", "PhotoSurvey", "find_format", "survey_photos"]

SPLITS = ("train", "held_out", "val", "test", "all")


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


@dataclass(frozen=True)
class PhotoFrame:
    """A photograph that is there: its file, camera, mask and split, and the points (K, 3) [length] of a reconstruction that
    were found in it, where they are known; no pixel is read yet."""

    file: Path
    camera: Camera
    split: str
    mask: Path | None = None
    points: np.ndarray | None = None


@briefly
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
        levels: nested boxes of a fit, of which ``box`` is the innermost; 1: the box alone.
    """

    path: Path
    format: str
    frames: tuple[PhotoFrame, ...]
    skipped: tuple[str, ...]
    box: np.ndarray
    box_from: str
    near_far: tuple[float, float]
    points: np.ndarray | None = None
    levels: int = 1

    def describe(self) -> str:
        """Describe the data set in a paragraph."""
        cameras = [frame.camera for frame in self.frames]
        sizes = sorted({f"{c.size[0]} x {c.size[1]}" for c in cameras})
        focal = [c.K[0, 0] for c in cameras]
        lens = " and ".join(sorted({_lens(c) for c in cameras}))
        angle = _range([field_of_view(c) for c in cameras])
        counts = ", ".join(f"{n} {split}" for split in (*SPLITS, UNLISTED) if (n := sum(f.split == split for f in self.frames)))
        lines = [
            f"{self.path}: {self.format}, {len(cameras)} photographs ({counts}), {', '.join(sizes)} pixels, {lens}",
            f"focal length {_range(focal)} pixels, horizontal field of view {angle} degrees",
            f"box {_corner(self.box[0])} to {_corner(self.box[1])}, {self.box_from}",
            f"near {self.near_far[0]:.4g}, far {self.near_far[1]:.4g} from the cameras",
        ]
        if self.skipped:
            named = ", ".join(self.skipped[:5]) + (" ..." if len(self.skipped) > 5 else "")
            lines.append(f"skipped {len(self.skipped)} that are not there: {named}")
        return "\n".join(lines)


def survey_photos(
    path: str | os.PathLike,
    *,
    split: str = "all",
    held_out: int | Sequence[str] = 0,
    box: np.ndarray | str | None = None,
) -> PhotoSurvey:
    """Cameras, sizes and box of a data set; no pixel is read.

    Args:
        path: folder, or file of cameras.
        split: one of ``SPLITS``: "train" without what is held out, "held_out", "val" and "test" as the data set has them.
        held_out: every n-th of the training photographs that are there, beginning with the first (0: none), or file names.
        box: (2, 3) [length]; None: from points or cameras (:mod:`mivol.photos.region`); "middle": the innermost of nested
            boxes, which not every camera has to see.

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
    if split in ("held_out", "val", "test"):
        _check_unseen(chosen, [entry for entry in present if entry.split == "train"], cameras)
    frames = [PhotoFrame(entry.file, cameras[id(entry)], entry.split, _mask(entry), entry.points) for entry in chosen]
    training = [entry for entry in present if entry.split in ("train", "held_out")]
    looking = [cameras[id(entry)] for entry in training or chosen]
    found, whence = _box(box, listing.points, looking, path)
    if not isinstance(box, str):
        region.check_views([frame.camera for frame in frames], found)
    near_far = region.near_and_far([*looking, *(frame.camera for frame in frames)], found)
    return PhotoSurvey(path, name, tuple(frames), tuple(absent), found, whence, near_far, listing.points)


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
        header = read_photo_header(entry.file)
        size = header.size
        wanted, whence = (
            (entry.size, "the file of cameras") if entry.size else first.setdefault(entry.split, (size, entry.name))
        )
        if size != wanted:
            found, expected = (f"{w} x {h} pixels" for w, h in (size, wanted))
            turned = f" (EXIF orientation {header.orientation} turns them)" if header.orientation != 1 else ""
            advice = "turn the pixels" if turned else "scale the image"
            raise refusal(entry.file, found + turned, f"{expected} as {whence}", f"{advice}, or correct the cameras")
        _check_orientation(entry, header)
        cameras.append(entry.camera(size))
    return cameras


def _check_orientation(entry: Entry, header: PhotoHeader) -> None:
    """Refuse a picture that viewers turn, unless the cameras are of the pixels as they are stored.

    That shows where the file of cameras gives a size and a quarter turn (5 to 8) would change it.

    Raises:
        MivolError: it does not show.
    """
    is_quarter = header.orientation > 4 and header.size[0] != header.size[1]
    if header.orientation == 1 or (is_quarter and entry.size is not None):
        return
    found = f"EXIF orientation {header.orientation}, by which viewers turn the picture"
    way_out = "turn the pixels if the cameras were found for upright pictures, else remove the tag"
    raise refusal(entry.file, found, "pixels as the cameras see them", way_out)


def _check_unseen(judged: Sequence[Entry], fitted: Sequence[Entry], cameras: Mapping[int, Camera]) -> None:
    """Refuse a photograph that is judged and fitted, too: one file, or one picture of one camera under two names.

    Raises:
        MivolError: the first.
    """
    files = {entry.file.resolve(): entry for entry in fitted}
    seen = {cameras[id(entry)].to_world.tobytes(): entry for entry in fitted}
    for entry in judged:
        twin = files.get(entry.file.resolve()) or seen.get(cameras[id(entry)].to_world.tobytes())
        if twin and (twin.file.samefile(entry.file) or filecmp.cmp(twin.file, entry.file, shallow=False)):
            found, expected = f"a photograph that is fitted, too, as {twin.name}", f"a {entry.split} view that no fit sees"
            raise refusal(entry.file, found, expected, "take it out of one list")


def _mask(entry: Entry) -> Path | None:
    if entry.mask is not None and not entry.mask.is_file():
        raise refusal(entry.mask, "no mask there", f"that of {entry.name}", "copy it, or take it out of the file of cameras")
    return entry.mask


def _box(
    box: np.ndarray | str | None, points: np.ndarray | None, cameras: Sequence[Camera], path: Path
) -> tuple[np.ndarray, str]:
    if isinstance(box, str):
        if box != "middle":
            raise refusal("box", f'"{box}"', '"middle", or two corners', "choose one of those")
        found = region.middle_box(cameras, path)
        return found, f"{region.MIDDLE:g} of the cameras' median distance from what they look at, on each side"
    if box is not None:
        return region.check_box(box), "as given"
    if points is not None and len(points) >= region.FEWEST_POINTS:
        return region.box_of_points(points), f"98 % of {len(points)} points and 5 % more on each side"
    share = f"where at least {100 * region.VIEW_SHARE:.0f} % of {len(cameras)} cameras look"
    return region.shared_box(cameras, path), share


def _range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.6g}" if high - low <= 1e-6 * high else f"{low:.6g} to {high:.6g}"


def _lens(camera: Camera) -> str:
    if camera.distortion.is_wide:
        return type(camera.distortion).__name__.lower()
    return "with distortion" if camera.distortion else "pinhole"


def _corner(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"
