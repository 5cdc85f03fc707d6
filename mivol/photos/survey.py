"""The content of a data set of photographs before reading pixels: cameras, splits and box.

Conventions. Cameras follow :mod:`mivol.photos.camera`. A data set has the splits train, val and test. ``held_out`` moves
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
from mivol.photos import app_exports, region
from mivol.photos.app_exports import read_llff
from mivol.photos.camera import Camera, field_of_view
from mivol.photos.colmap import find_model, read_colmap
from mivol.photos.listing import UNLISTED, Entry, Listing, find_mask, find_shrink, list_photographs, name_first
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
    "LLFF": DataSetFormat(lambda path: (path / "poses_bounds.npy").is_file() or path.name == "poses_bounds.npy", read_llff),
    "Polycam": DataSetFormat(app_exports.is_polycam, app_exports.read_polycam),
    "Record3D": DataSetFormat(app_exports.is_record3d, app_exports.read_record3d),
    "ARKit (3D Scanner App)": DataSetFormat(app_exports.is_arkit, app_exports.read_arkit),
    "RealityCapture": DataSetFormat(app_exports.is_reality_capture, app_exports.read_reality_capture),
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
        orientation: orientation of EXIF by which the pixels are turned, since the camera describes upright pixels.
    """

    file: Path
    camera: Camera
    split: str
    mask: Path | None = None
    points: np.ndarray | None = None
    orientation: int = 1


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
        notes: sentences on photographs that were turned or are smaller than listed, on masks, and on missing poses.
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
    notes: tuple[str, ...] = ()

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
            f"distances from the cameras: {self.near_far[0]:.4g} (near) to {self.near_far[1]:.4g} (far)",
        ]
        if self.skipped:
            lines.append(f"skipped {len(self.skipped)} missing photographs: {name_first(self.skipped)}")
        return "\n".join([*lines, *self.notes])


def survey_photos(
    path: str | os.PathLike,
    *,
    split: str = "all",
    held_out: int | Sequence[str] = 0,
    fold: int = 0,
    box: np.ndarray | str | None = None,
) -> PhotoSurvey:
    """Read cameras, sizes and box of a data set, without pixels.

    Args:
        path: folder, or file of cameras.
        split: one of ``SPLITS``; "train" excludes the held-out photographs.
        held_out: n for every n-th existing training photograph (0 for no held-out view), or file names.
        fold: number of the first of every n-th photograph, from 0 to n - 1: the n folds hold out each photograph once.
        box: (2, 3) [length]; by default from points or cameras (:mod:`mivol.photos.region`); "middle" for the innermost of
            nested boxes, which some cameras may miss.

    Raises:
        MivolError: no data set, a split without photographs, wrong cameras, or a camera looking away from a given box.
    """
    path = Path(path)
    name, listing = _read(path)
    if split not in SPLITS:
        raise refusal("split", f'"{split}"', f"one of {', '.join(SPLITS)}", "choose one")
    entries = _assign_held_out(listing.entries, held_out, fold, path)
    present = [entry for entry in entries if entry.file.is_file()]
    chosen = [entry for entry in present if split in ("all", entry.split)]
    absent = [entry.name for entry in entries if not entry.file.is_file() and split in ("all", entry.split)]
    if not chosen:
        raise _no_photographs(path, split, absent, entries)
    placed = {id(entry): place for entry, place in zip(present, _place_cameras(present), strict=True)}
    cameras = {key: place.camera for key, place in placed.items()}
    if split in ("held_out", "val", "test"):
        _check_unseen(chosen, [entry for entry in present if entry.split == "train"], cameras)
    frames = [PhotoFrame(e.file, cameras[id(e)], e.split, _mask(e), e.points, placed[id(e)].orientation) for e in chosen]
    training = [entry for entry in present if entry.split in ("train", "held_out")]
    looking = [cameras[id(entry)] for entry in training or chosen]
    is_middle, (found_box, box_from) = _box(box, listing, looking, path)
    notes = [*listing.notes, *_note_changes(frames, [placed[id(entry)] for entry in chosen])]
    if not is_middle:
        frames, note = _leave_out_views(frames, found_box, box is not None)
        notes += note
    near_far = region.near_and_far([*looking, *(frame.camera for frame in frames)], found_box)
    return PhotoSurvey(
        path, name, tuple(frames), tuple(absent), found_box, box_from, near_far, listing.points, notes=tuple(notes)
    )


MOST_AWAY = 0.25
"""Largest share of the photographs that may look away from a box that was found, and are left out."""


def _leave_out_views(frames: list[PhotoFrame], box: np.ndarray, is_given: bool) -> tuple[list[PhotoFrame], list[str]]:
    """The photographs that look at the box, and a note on the others.

    Raises:
        MivolError: photographs that look away from a given box, or more than ``MOST_AWAY`` of them from a box that was found.
    """
    meets = [region.meets_box(frame.camera, box) for frame in frames]
    away = [frame.file.name for frame, does in zip(frames, meets, strict=True) if not does]
    if is_given or len(away) > MOST_AWAY * len(frames):
        region.check_cameras_meet_box([frame.camera for frame in frames], box)
    if not away:
        return frames, []
    kept = [frame for frame, does in zip(frames, meets, strict=True) if does]
    away_from = "look away from what the others show; their poses may be wrong"
    return kept, [f"left out: {name_first(away)}, which by their poses {away_from}"]


def find_format(path: Path) -> str | None:
    """Return the key of ``FORMATS`` of a folder or file of cameras; None for other paths."""
    return next((name for name, kind in DATA_SET_FORMATS.items() if kind.recognise(path)), None)


def _read(path: Path) -> tuple[str, Listing]:
    if not path.exists():
        raise refusal(path, "nothing there", "a folder of photographs or a file of cameras", "check the path")
    name = find_format(path)
    if name is None:
        known = ", ".join(DATA_SET_FORMATS)
        if names := list_photographs(path)[1]:
            found = f"{len(names)} photograph{'s' * (len(names) != 1)} without cameras"
            raise refusal(path, found, f"cameras of {known}", f"mivol poses {path} finds them")
        found = "no photographs and no cameras" if path.is_dir() else "no cameras"
        raise refusal(path, found, f"photographs with cameras of {known}", "name the folder that holds them")
    return name, DATA_SET_FORMATS[name].read(path)


def _assign_held_out(entries: list[Entry], held_out: int | Sequence[str], fold: int, path: Path) -> list[Entry]:
    """Set the split of held-out entries to "held_out"."""
    train = [entry for entry in entries if entry.split == "train" and entry.file.is_file()]
    if isinstance(held_out, int):
        if held_out < 0 or held_out == 1:
            raise refusal("held_out", f"{held_out}", "0, or 2 and more", "1 would hold out every view")
        if not 0 <= fold < max(held_out, 1):
            raise refusal("fold", f"{fold}", f"0 to {max(held_out, 1) - 1}", "count folds from 0, below held_out")
        chosen = {id(entry) for entry in train[fold::held_out]} if held_out else set()
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


@dataclass(frozen=True)
class _Place:
    """The camera of a photograph at the size of its pixels, the orientation that turns them, and the factor of its size."""

    camera: Camera
    orientation: int = 1
    shrink: int = 1


def _place_cameras(entries: Sequence[Entry]) -> list[_Place]:
    """Place the cameras of photographs.

    Each size must agree with the file of cameras, up to a factor of ``listing.SHRUNK``, or with the first photograph of the
    split. Photographs with an orientation of EXIF are turned if the cameras describe upright pixels (:func:`_are_turned`).
    """
    headers = [read_photo_header(entry.file) for entry in entries]
    are_turned = _are_turned(entries, headers)
    places, first = [], {}
    for entry, header in zip(entries, headers, strict=True):
        turned = header.orientation != 1 and _is_turned(entry, header, are_turned)
        size = header.upright_size if turned else header.size
        listed, source = (
            (entry.size, "the file of cameras") if entry.size else first.setdefault(entry.split, (size, entry.name))
        )
        shrink = find_shrink(size, listed) if entry.size else int(size == listed)
        if not shrink:
            found, expected = (f"{w} x {h} pixels" for w, h in (size, listed))
            expected += f" as {source}" + (", or 1/2, 1/4 or 1/8" if entry.size else "")
            raise refusal(entry.file, found, expected, "scale the image, or correct the cameras")
        camera = entry.camera(listed) if shrink == 1 else entry.camera(listed).resized(size)
        places.append(_Place(camera, header.orientation if turned else 1, shrink))
    return places


def _proves_turn(entry: Entry, header: PhotoHeader) -> bool | None:
    """Whether the size in the file of cameras is the size of upright pixels; None without a proof.

    A proof is a quarter turn (orientation 5 to 8) after which only one of both sizes fits.
    """
    if header.orientation < 5 or entry.size is None:
        return None
    stored, upright = (find_shrink(size, entry.size) is not None for size in (header.size, header.upright_size))
    return None if stored == upright else upright


def _are_turned(entries: Sequence[Entry], headers: Sequence[PhotoHeader]) -> bool | None:
    """Whether the cameras of a data set describe upright pixels; None without a proof, or with proofs of both."""
    proofs = {_proves_turn(entry, header) for entry, header in zip(entries, headers, strict=True)} - {None}
    return proofs.pop() if len(proofs) == 1 else None


def _is_turned(entry: Entry, header: PhotoHeader, are_turned: bool | None) -> bool:
    """Whether the camera describes upright pixels: by the size of this photograph, else by the sizes of the others.

    Raises:
        MivolError: no photograph proves this.
    """
    own = _proves_turn(entry, header)
    if own is None and are_turned is None and entry.is_stored:
        return False
    if own is None and are_turned is None:
        found = f"EXIF orientation {header.orientation}, by which viewers turn the image"
        expected = "a size in the file of cameras that shows whether they describe upright pixels"
        way_out = "turn the pixels if the cameras describe upright images, else remove the tag"
        raise refusal(entry.file, found, expected, way_out)
    return are_turned if own is None else own


def _note_changes(frames: Sequence[PhotoFrame], places: Sequence[_Place]) -> list[str]:
    """Sentences on photographs that were turned or are smaller than listed, and on masks."""
    notes = []
    for shrink in sorted({place.shrink for place in places} - {1}):
        count = sum(place.shrink == shrink for place in places)
        notes.append(f"{count} photographs have 1/{shrink} of the size in the file of cameras; their cameras are scaled")
    if turned := sum(place.orientation != 1 for place in places):
        notes.append(f"{turned} photographs are turned by their EXIF orientation, since the cameras describe upright images")
    if masked := sum(frame.mask is not None for frame in frames):
        notes.append(f"{masked} of {len(frames)} photographs have masks, whose black pixels do not count")
    return notes


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
    if entry.mask is None:
        return find_mask(entry.file)
    if not entry.mask.is_file():
        raise refusal(entry.mask, "no file", f"the mask of {entry.name}", "copy the mask, or remove its entry")
    return entry.mask


def _box(
    box: np.ndarray | str | None, listing: Listing, cameras: Sequence[Camera], path: Path
) -> tuple[bool, tuple[np.ndarray, str]]:
    """Whether the box is the one in the middle, which cameras may look away from; the box, and how it was found."""
    points = listing.points
    if isinstance(box, str):
        if box != "middle":
            raise refusal("box", f'"{box}"', '"middle", or two corners', "choose one")
        return True, _middle_box(cameras, path)
    if box is not None:
        return False, (region.check_box(box), "as given")
    if listing.box is not None:
        return False, (listing.box, "around what the photographs show between their nearest and farthest distance")
    if points is not None and len(points) >= region.FEWEST_POINTS:
        return False, (region.box_of_points(points), f"98 % of {len(points)} points, enlarged by 5 % on each side")
    seen, shared = (
        f"in view of at least {100 * region.VIEW_SHARE:.0f} % of {len(cameras)} cameras",
        region.shared_box(cameras, path),
    )
    if shared is not None:
        return False, (shared, seen)
    cube, size = _middle_box(cameras, path)
    return True, (cube, f"{size}, because no place is {seen}")


def _middle_box(cameras: Sequence[Camera], path: Path) -> tuple[np.ndarray, str]:
    """The innermost of nested boxes, and a description of its size."""
    cube = region.middle_box(cameras, path)
    half = float(cube[1, 0] - cube[0, 0]) / 2 / region.median_distance(cameras, cube.mean(axis=0))
    seen = "" if half > 0.999 * region.MIDDLE else ", as wide as what the frames share"
    return cube, f"{half:.2g} of the median distance of the cameras from their focus, on each side{seen}"


def _format_range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:.6g}" if high - low <= 1e-6 * high else f"{low:.6g} to {high:.6g}"


def _lens_name(camera: Camera) -> str:
    if camera.distortion.is_wide:
        return type(camera.distortion).__name__.lower()
    return "with distortion" if camera.distortion else "pinhole"
