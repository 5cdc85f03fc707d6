"""The content of a data set of photographs before reading pixels: cameras, splits and box.

Conventions. Cameras are those of :mod:`mivol.photos.camera`. A data set has the splits train, val and test. ``held_out`` moves
every n-th or named photographs from the training split to the held-out split. Missing photographs are skipped and listed.
The box is found from the training cameras (or from the points of a reconstruction) for every split, so all splits share it.
"""

from __future__ import annotations

import dataclasses
import filecmp
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.display import format_point, with_short_repr
from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.photos import region
from mivol.photos.camera import Camera, field_of_view
from mivol.photos.colmap import find_model, read_colmap
from mivol.photos.listing import UNLISTED, Entry, Listing
from mivol.photos.photo_file import PhotoHeader, read_photo_header
from mivol.photos.transforms import read_blender, read_transforms

SPLITS = ("train", "held_out", "val", "test", "all")


@dataclass(frozen=True)
class DataSetFormat:
    """A format of data sets: a test of a path, and the reader."""

    recognise: Callable[[Path], bool]
    read: Callable[[Path], Listing]


#: name -> format, in the order of the trials.
DATA_SET_FORMATS: dict[str, DataSetFormat] = {
    "Blender (NeRF)": DataSetFormat(lambda path: (path / "transforms_train.json").is_file(), read_blender),
    "transforms.json": DataSetFormat(
        lambda path: (path / "transforms.json").is_file() or path.suffix == ".json", read_transforms
    ),
    "COLMAP": DataSetFormat(lambda path: find_model(path) is not None, read_colmap),
}


@dataclass(frozen=True)
class PhotoFrame:
    """An existing photograph, without its pixels.

    Attributes:
        file: image file.
        camera: camera at the size of the image.
        split: one of ``SPLITS`` or ``UNLISTED``.
        mask: file of the mask, optional.
        points: points (K, 3) of a sparse reconstruction visible in the photograph [length], if known.
    """

    file: Path
    camera: Camera
    split: str
    mask: Path | None = None
    points: np.ndarray | None = None


@with_short_repr
@dataclass(frozen=True)
class PhotoSurvey:
    """The content of a data set, from its cameras and the headers of its images.

    Attributes:
        path: path of the data set.
        format: key of ``FORMATS``.
        frames: existing photographs of the split.
        skipped: names of missing photographs of the split.
        box: (2, 3) float64, the box in view of the cameras [length].
        box_from: origin of the box, as text.
        near_far: smallest and largest distance of the box from the cameras [length].
        points: points (N, 3) of a sparse reconstruction, if known.
        levels: number of nested boxes of a fit, with ``box`` as the innermost.
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
        lens = " and ".join(sorted({_lens_name(c) for c in cameras}))
        angle = _format_range([field_of_view(c) for c in cameras])
        counts = ", ".join(f"{n} {split}" for split in (*SPLITS, UNLISTED) if (n := sum(f.split == split for f in self.frames)))
        lines = [
            f"{self.path}: {self.format}, {len(cameras)} photographs ({counts}), {', '.join(sizes)} pixels, {lens}",
            f"focal length {_format_range(focal)} pixels, horizontal field of view {angle} degrees",
            f"box {format_point(self.box[0])} to {format_point(self.box[1])}, {self.box_from}",
            f"near {self.near_far[0]:.4g}, far {self.near_far[1]:.4g} from the cameras",
        ]
        if self.skipped:
            named = ", ".join(self.skipped[:5]) + (" ..." if len(self.skipped) > 5 else "")
            lines.append(f"skipped {len(self.skipped)} missing photographs: {named}")
        return "\n".join(lines)


def survey_photos(
    path: str | os.PathLike, *, split: str = "all", held_out: int | Sequence[str] = 0, box: np.ndarray | str | None = None
) -> PhotoSurvey:
    """Read cameras, sizes and box of a data set, without pixels.

    Args:
        path: folder, or file of cameras.
        split: one of ``SPLITS``; "train" excludes the held-out photographs.
        held_out: n for every n-th existing training photograph from the first on (0 for no held-out view), or file names.
        box: (2, 3) [length]; by default from points or cameras (:mod:`mivol.photos.region`); "middle" for the innermost of
            nested boxes, which some cameras may miss.

    Raises:
        MivolError: no data set, a split without photographs, wrong cameras, or a camera looking away from the box.
    """
    path = Path(path)
    name, listing = _read(path)
    if split not in SPLITS:
        raise refusal("split", f'"{split}"', f"one of {', '.join(SPLITS)}", "choose one")
    entries = _assign_held_out(listing.entries, held_out, path)
    present = [entry for entry in entries if entry.file.is_file()]
    chosen = [entry for entry in present if split in ("all", entry.split)]
    absent = [entry.name for entry in entries if not entry.file.is_file() and split in ("all", entry.split)]
    if not chosen:
        raise _no_photographs(path, split, absent, entries)
    cameras = {id(entry): camera for entry, camera in zip(present, _cameras(present), strict=True)}
    if split in ("held_out", "val", "test"):
        _check_unseen(chosen, [entry for entry in present if entry.split == "train"], cameras)
    frames = [PhotoFrame(entry.file, cameras[id(entry)], entry.split, _mask(entry), entry.points) for entry in chosen]
    training = [entry for entry in present if entry.split in ("train", "held_out")]
    looking = [cameras[id(entry)] for entry in training or chosen]
    found_box, box_from = _box(box, listing.points, looking, path)
    if not isinstance(box, str):
        region.check_views([frame.camera for frame in frames], found_box)
    near_far = region.near_and_far([*looking, *(frame.camera for frame in frames)], found_box)
    return PhotoSurvey(path, name, tuple(frames), tuple(absent), found_box, box_from, near_far, listing.points)


def find_format(path: Path) -> str | None:
    """Return the key of ``FORMATS`` of a folder or file of cameras; None for other paths."""
    return next((name for name, kind in DATA_SET_FORMATS.items() if kind.recognise(path)), None)


def _read(path: Path) -> tuple[str, Listing]:
    if not path.exists():
        raise refusal(path, "nothing there", "a folder of photographs or a file of cameras", "check the path")
    name = find_format(path)
    if name is None:
        known = ", ".join(DATA_SET_FORMATS)
        raise refusal(path, "no cameras", f"one of {known}", "name the folder of the file of cameras")
    return name, DATA_SET_FORMATS[name].read(path)


def _assign_held_out(entries: list[Entry], held_out: int | Sequence[str], path: Path) -> list[Entry]:
    """Set the split of held-out entries to "held_out"."""
    train = [entry for entry in entries if entry.split == "train" and entry.file.is_file()]
    if isinstance(held_out, int):
        if held_out < 0 or held_out == 1:
            raise refusal("held_out", f"{held_out}", "0, or 2 and more", "1 would hold out every view")
        chosen = {id(entry) for entry in train[::held_out]} if held_out else set()
    else:
        names = {name for entry in train for name in (entry.name, entry.file.name)}
        unknown = next((name for name in held_out if name not in names), None)
        if unknown is not None:
            raise refusal(path, f'no training photograph "{unknown}" to hold out', "names of files", "correct held_out")
        chosen = {id(entry) for entry in train if {entry.name, entry.file.name} & set(held_out)}
    return [dataclasses.replace(entry, split="held_out") if id(entry) in chosen else entry for entry in entries]


def _no_photographs(path: Path, split: str, absent: list[str], entries: list[Entry]) -> MivolError:
    if absent:
        found = f"none of the {len(absent)} listed photographs (the first is {absent[0]})"
        return refusal(path, found, "at least one image beside the cameras", "copy the images")
    splits = ", ".join(sorted({entry.split for entry in entries}))
    return refusal(path, f"no photograph in the split {split}", f"one of {splits}", "choose one, or set held_out")


def _cameras(entries: Sequence[Entry]) -> list[Camera]:
    """Cameras of photographs; each size must agree with the file of cameras, or with the first photograph of the split."""
    cameras, first = [], {}
    for entry in entries:
        header = read_photo_header(entry.file)
        size = header.size
        listed, source = (
            (entry.size, "the file of cameras") if entry.size else first.setdefault(entry.split, (size, entry.name))
        )
        if size != listed:
            found, expected = (f"{w} x {h} pixels" for w, h in (size, listed))
            turned = f" (EXIF orientation {header.orientation} turns them)" if header.orientation != 1 else ""
            advice = "turn the pixels" if turned else "scale the image"
            raise refusal(entry.file, found + turned, f"{expected} as {source}", f"{advice}, or correct the cameras")
        _check_orientation(entry, header)
        cameras.append(entry.camera(size))
    return cameras


def _check_orientation(entry: Entry, header: PhotoHeader) -> None:
    """Refuse a photograph rotated by image viewers, unless the cameras clearly describe the stored pixels.

    A size in the file of cameras proves this if a quarter turn (orientation 5 to 8) would change the size.

    Raises:
        MivolError: a rotation without this proof.
    """
    is_quarter = header.orientation > 4 and header.size[0] != header.size[1]
    if header.orientation == 1 or (is_quarter and entry.size is not None):
        return
    found = f"EXIF orientation {header.orientation}, by which viewers turn the image"
    way_out = "turn the pixels if the cameras describe upright images, else remove the tag"
    raise refusal(entry.file, found, "pixels in the orientation of the cameras", way_out)


def _check_unseen(judged: Sequence[Entry], fitted: Sequence[Entry], cameras: Mapping[int, Camera]) -> None:
    """Refuse a held-out photograph that is also a training photograph: the same file, or equal pixels and poses.

    Raises:
        MivolError: names the first such photograph.
    """
    files = {entry.file.resolve(): entry for entry in fitted}
    poses = {cameras[id(entry)].to_world.tobytes(): entry for entry in fitted}
    for entry in judged:
        twin = files.get(entry.file.resolve()) or poses.get(cameras[id(entry)].to_world.tobytes())
        if twin and (twin.file.samefile(entry.file) or filecmp.cmp(twin.file, entry.file, shallow=False)):
            found, expected = f"a photograph also fitted as {twin.name}", f"a {entry.split} view outside the fit"
            raise refusal(entry.file, found, expected, "remove it from one list")


def _mask(entry: Entry) -> Path | None:
    if entry.mask is not None and not entry.mask.is_file():
        raise refusal(entry.mask, "no file", f"the mask of {entry.name}", "copy the mask, or remove its entry")
    return entry.mask


def _box(
    box: np.ndarray | str | None, points: np.ndarray | None, cameras: Sequence[Camera], path: Path
) -> tuple[np.ndarray, str]:
    if isinstance(box, str):
        if box != "middle":
            raise refusal("box", f'"{box}"', '"middle", or two corners', "choose one")
        cube = region.middle_box(cameras, path)
        return cube, f"{region.MIDDLE:g} of the median distance of the cameras from their focus, on each side"
    if box is not None:
        return region.check_box(box), "as given"
    if points is not None and len(points) >= region.FEWEST_POINTS:
        return region.box_of_points(points), f"98 % of {len(points)} points, enlarged by 5 % on each side"
    return region.shared_box(cameras, path), f"in view of at least {100 * region.VIEW_SHARE:.0f} % of {len(cameras)} cameras"


def _format_range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.6g}" if high - low <= 1e-6 * high else f"{low:.6g} to {high:.6g}"


def _lens_name(camera: Camera) -> str:
    if camera.distortion.is_wide:
        return type(camera.distortion).__name__.lower()
    return "with distortion" if camera.distortion else "pinhole"
