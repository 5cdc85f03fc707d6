"""Poses of a folder of photographs, by structure from motion with COLMAP (the extra ``poses``).

Conventions. The model is ``FOLDER/sparse/0`` in COLMAP's binary format, beside the photographs of ``FOLDER/images`` or of
``FOLDER`` itself. Photographs with equal size, camera, lens and focal length in EXIF share one camera. If one
photograph has a quarter turn in EXIF, all are turned upright before the search, as :mod:`mivol.photos.survey` then reads them.

References: Pan et al. 2024 (Global Structure-from-Motion Revisited, ECCV); Schönberger and Frahm 2016 (Structure-from-Motion
Revisited, CVPR).
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.photos.colmap import find_model
from mivol.photos.colmap_process import AGAINST
from mivol.photos.listing import UNREAD, find_mask, list_photographs, name_first, split_numbers
from mivol.photos.photo_file import is_damaged, read_lens_facts, read_mask, read_photo_header, write_upright
from mivol.photos.survey import find_format
from mivol.threads import follow_program

FEWEST = 3
"""Fewest photographs of which poses are searched."""

EXHAUSTIVE = 150
"""Largest number of photographs of which all pairs are matched; of more, neighbours by name and similar ones."""

ODD = 0.3
"""Share of the pairs with an overlap from which a warning speaks of pairs without parallax."""

MIRRORED = (2, 4, 5, 7)
"""Orientations of EXIF with a mirror image, as some front cameras write them."""

FULL = 2**24
"""Free space below which COLMAP is said to have filled the disk [byte]."""

FEWEST_POINTS = 30
"""Points below which a model says nothing: COLMAP asks for as many to find one pose (``abs_pose_min_num_inliers``)."""

FEW = 50
"""Common points below which a pair of photographs is said to have few."""

LONGEST = 2000
"""Longest edge of a photograph in the search for features [pixel]."""

WORK = ".mivol-poses"
"""Folder beside the photographs for features and matches, while the search goes on."""

DIRECT = (".png", ".jpg", ".jpeg")
"""Suffixes that COLMAP reads; others are converted."""

AGAIN = "photograph again in small steps, with each part of the subject sharp in at least three photographs"


@dataclass(frozen=True)
class Poses:
    """The result of a search for poses.

    Attributes:
        folder: the model.
        posed: photographs with a pose.
        unposed: photographs without a pose.
        error: mean reprojection error of the points [pixel].
        points: number of points.
        cameras: number of cameras.
        others: photographs of each further model, which has no part in common with the first.
        best: photograph without a pose -> the photograph with the most points in common with it, and their number.
        left_out: damaged photographs, and copies of others.
        against: pairs of photographs whose common points contradict the poses, and all pairs with many common points.
    """

    folder: Path
    posed: tuple[str, ...]
    unposed: tuple[str, ...]
    error: float
    points: int
    cameras: int
    others: tuple[tuple[str, ...], ...] = ()
    best: Mapping[str, tuple[str, int]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    against: tuple[int, int] = (0, 0)

    def describe(self) -> str:
        """Describe the result in a paragraph."""
        total = len(self.posed) + len(self.unposed)
        lines = [
            f"{self.folder}: {len(self.posed)} of {total} photographs have poses, {self.points} points, {self.cameras} "
            f"camera{'s' * (self.cameras != 1)}, reprojection error {self.error:.2f} pixels"
        ]
        if doubt := self.describe_doubt():
            lines.append(doubt)
        if self.others:
            sizes = ", ".join(str(len(names)) for names in self.others)
            first = self.others[0][0]
            lines.append(
                f"{sizes} photographs ({first}, ...) have poses in separate models, which share nothing with it; "
                f"photograph what lies between {first} and {self.posed[-1]}, or put another place into a folder of its own"
            )
        apart = {name for names in self.others for name in names}
        if elsewhere := [name for name in self.unposed if name not in apart and self._is_elsewhere(name)]:
            lines.append(
                f"without a pose: {name_first(elsewhere)}, which match each other better than photographs with poses; "
                f"photograph what lies between them and {self.posed[-1]}, or put another place into a folder of its own"
            )
        if unposed := [name for name in self.unposed if name not in apart and name not in elsewhere]:
            lines.append(f"without a pose: {name_first(list(map(self._name_unposed, unposed)))}; {AGAIN}")
        return "\n".join(lines)

    def describe_doubt(self) -> str:
        """Say that pairs contradict the poses, and what to photograph; empty if at most ``AGAINST`` of them do."""
        against, count = self.against
        if against <= AGAINST * count:
            return ""
        return (
            f"{against} of {count} pairs of photographs contradict these poses, which happens if parts look alike: if the "
            "cameras do not stand where you walked, put something different beside each side of the subject, and photograph "
            "it again"
        )

    def _is_elsewhere(self, name: str) -> bool:
        """Whether a photograph without a pose has most points in common with another one without a pose."""
        partner, points = self.best.get(name, ("", 0))
        return points >= FEW and partner in self.unposed

    def _name_unposed(self, name: str) -> str:
        """A photograph without a pose, with the reason that its matches show."""
        partner, points = self.best.get(name, ("", 0))
        if points == 0:
            return f"{name} (shows no part of another photograph)"
        return f"{name} (few matches: {points} points in common with {partner})" if points < FEW else name


def find_poses(folder: Path, say: Callable[[str], None] = lambda line: None, is_video: bool = False) -> Poses:
    """Find the poses of the photographs of a folder, and write them to ``sparse/0``, whole or not at all.

    Args:
        folder: folder with photographs, in ``images/`` or in itself; masks may lie in ``masks/NAME.png``.
        say: receives the stages, and warnings about what has no parallax.
        is_video: whether the photographs are frames of a video, in the order of their names.

    Raises:
        MivolError: a missing pycolmap, poses that exist already, too few photographs, a damaged mask, or photographs without
            overlap.
        KeyboardInterrupt: Ctrl-C; features and matches stay in ``WORK``, and the next search of the same photographs
            continues with them.
    """
    images, listed = _check_folder(folder, say)
    names = _leave_out_copies(folder, images, _leave_out_damaged(folder, images, listed, say), say)
    names = sorted(names, key=split_numbers)
    work = folder / WORK
    _begin_work(work, images, names)
    try:
        aliases = {name: f"blank-{number:05d}{Path(name).suffix}" for number, name in enumerate(names) if " " in name}
        masks = _prepare(images, names, work, aliases)
        groups = _group_by_lens(images, names).values()
        job = {
            "images": str(work / "images"),
            "names": [[aliases.get(name, name) for name in group] for group in groups],
            "order": [aliases.get(name, name) for name in names],
            "aliases": {alias: name for name, alias in aliases.items()},
            "masks": str(work / "masks") if masks else "",
            "database": str(work / "database.db"),
            "models": str(work / "models"),
            "sequential": is_video or len(names) > EXHAUSTIVE,
            "longest": LONGEST,
        }
        (work / "models").mkdir()
        found, matches = _run(job, work, say)
        models = [model for model in found if model["points"] >= FEWEST_POINTS]
        faults = _list_faults(matches) + ([] if models else _describe_mirrored(images, names, names))
        if not models:
            expected = "photographs that show the same parts from several places"
            raise refusal(folder, f"{len(names)} photographs without enough overlap", expected, "; ".join(faults) or AGAIN)
        for line in faults:
            say(line)
        poses = _keep(folder, sorted(models, key=lambda model: -len(model["names"])), names, matches)
        for line in _describe_mirrored(images, names, poses.unposed):
            say(line)
    except MivolError:
        shutil.rmtree(work, ignore_errors=True)
        raise
    shutil.rmtree(work, ignore_errors=True)
    return replace(poses, left_out=tuple(name for name in listed if name not in names))


def check_colmap() -> None:
    """Refuse to begin without pycolmap.

    Raises:
        MivolError: pycolmap is missing.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise MivolError('poses need pycolmap, which is not installed: pip install "mivol[poses]".')


def _begin_work(work: Path, images: Path, names: list[str]) -> None:
    """Make the folder of features and matches, or keep one that an interrupted search of the same photographs left."""
    facts = [[name, (images / name).stat().st_size, (images / name).stat().st_mtime_ns] for name in names]
    listed = work / "photographs.json"
    with suppress(OSError, ValueError):
        if json.loads(listed.read_text(encoding="utf-8")) == facts:
            for part in ("images", "masks", "models"):
                shutil.rmtree(work / part, ignore_errors=True)
            return
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    listed.write_text(json.dumps(facts), encoding="utf-8")


def _check_folder(folder: Path, say: Callable[[str], None]) -> tuple[Path, list[str]]:
    """The folder of the images, and the names of the photographs in it; says which images are not read."""
    if folder.is_file():
        found = f"a file {folder.suffix or 'without a suffix'}"
        raise refusal(folder, found, "a folder of photographs, or a video", "unpack an archive, and name its folder")
    if not folder.is_dir():
        raise refusal(folder, "no folder", "a folder of photographs", "check the path")
    check_colmap()
    kind = find_format(folder)
    if kind is not None:
        model = find_model(folder) or "them"
        way_out = f"mivol optimize {folder}, or remove {model} and search again, if there are new photographs"
        raise refusal(folder, f"poses in it already ({kind})", "photographs without poses", way_out)
    images, names = list_photographs(folder)
    if unread := list_photographs(folder, UNREAD)[1]:
        say(f"{len(unread)} images are not read as photographs ({name_first(unread)}): save them as PNG or JPEG to use them")
    if not names and (below := [place.name for place in sorted(images.iterdir()) if list_photographs(place)[1]]):
        found = f"photographs in folders of it only ({name_first(below)})"
        raise refusal(folder, found, f"them in {folder / 'images'}", "move these folders there, or name one of them")
    _check_count(folder, len(names), f"in {images}")
    return images, names


def _check_count(folder: Path, count: int, words: str) -> None:
    if count < FEWEST:
        found = f"{count} photograph{'s' * (count != 1)} {words}"
        way_out = "photograph the subject from more sides" if count else "name the folder that holds them"
        raise refusal(folder, found, f"at least {FEWEST}, and 20 or more for a fit", way_out)


def _leave_out_damaged(folder: Path, images: Path, names: list[str], say: Callable[[str], None]) -> list[str]:
    """The names without files that cannot be decoded.

    Raises:
        MivolError: too few sound photographs.
    """
    damaged = [name for name in names if is_damaged(images / name)]
    if not damaged:
        return names
    found = f"{len(damaged)} of {len(names)} photographs are damaged and left out: {name_first(damaged)}"
    say(f"{found}; copy them again, remove the poses and search again to have them too")
    kept = [name for name in names if name not in set(damaged)]
    _check_count(folder, len(kept), "without damage")
    return kept


def _leave_out_copies(folder: Path, images: Path, names: list[str], say: Callable[[str], None]) -> list[str]:
    """The names without files equal to an earlier one: a pair of equal photographs has no parallax.

    Raises:
        MivolError: too few different photographs.
    """
    first: dict[bytes, str] = {}
    for name in names:
        first.setdefault(hashlib.sha256((images / name).read_bytes()).digest(), name)
    kept = [name for name in names if name in set(first.values())]
    if len(kept) < len(names):
        say(f"{len(names) - len(kept)} of {len(names)} photographs are copies of others and left out")
        _check_count(folder, len(kept), "without copies of others")
    return kept


def _prepare(images: Path, names: list[str], work: Path, aliases: Mapping[str, str]) -> int:
    """Make folders of photographs and masks for COLMAP: links, and copies of turned or converted photographs.

    Returns:
        Number of masks.

    Raises:
        MivolError: a damaged mask.
    """
    headers, masks = {name: read_photo_header(images / name) for name in names}, 0
    turns = any(header.orientation > 4 for header in headers.values())
    for name in names:
        copy = work / "images" / aliases.get(name, name)
        orientation = headers[name].orientation if turns else 1
        _prepare_file(images / name, copy, orientation)
        if (mask := find_mask(images / name)) is not None:
            masks += 1
            read_mask(mask)  # refuses a damaged mask, which COLMAP would ignore
            _prepare_file(mask, work / "masks" / f"{aliases.get(name, name)}.png", orientation)
    return masks


def _describe_mirrored(images: Path, names: list[str], unposed: Sequence[str]) -> list[str]:
    """A sentence on photographs without a pose that EXIF mirrors, unlike others."""
    mirrored = {name for name in names if read_photo_header(images / name).orientation in MIRRORED}
    lost = [name for name in unposed if name in mirrored]
    if not lost or len(mirrored) == len(names):
        return []
    return [
        f"{len(lost)} of {len(names)} photographs ({lost[0]}, ...) are mirrored by their EXIF orientation and found no pose, "
        "because mirror images do not match the others: take them again with the back camera, or remove a wrong tag"
    ]


def _prepare_file(file: Path, copy: Path, orientation: int) -> None:
    """Link an image, or convert it if COLMAP reads no such file, or not upright."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    if orientation == 1 and file.suffix.lower() in DIRECT:
        _link(file.absolute(), copy)
    else:
        write_upright(file, copy, orientation)


def _link(file: Path, copy: Path) -> None:
    """Link a file, or copy it where links are not allowed."""
    try:
        copy.symlink_to(file)
    except OSError:
        shutil.copyfile(file, copy)


def _group_by_lens(images: Path, names: list[str]) -> dict[Any, list[str]]:
    """Photographs by size, camera, lens and focal length."""
    groups = defaultdict(list)
    for name in names:
        groups[read_lens_facts(images / name)].append(name)
    return groups


def _run(job: dict[str, Any], work: Path, say: Callable[[str], None]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Run COLMAP in a process of its own; return its models, and facts about the matches."""
    (work / "job.json").write_text(json.dumps(job), encoding="utf-8")
    models, matches, program, errors = None, {}, Path(__file__).with_name("colmap_process.py"), work / "errors.txt"
    for line in follow_program(program, str(work / "job.json"), errors=errors):
        facts = json.loads(line) if line.startswith("{") else {}
        models, matches = facts.get("models", models), facts.get("matches", matches)
        if "stage" in facts:
            say(facts["stage"])
    last = (errors.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["no message"])[-1]
    if models is None:
        if shutil.disk_usage(work).free < FULL:
            raise MivolError(f"{work} filled the disk: free some space, about 2 MB for each photograph, and try again.")
        raise MivolError(f"COLMAP ended early ({last}): check that the photographs open, and the free disk and memory.")
    return models, matches


def _list_faults(matches: Mapping[str, Any]) -> list[str]:
    """Sentences on pairs of photographs without parallax, with what to photograph instead."""
    count, still, turned = (matches.get(key, 0) for key in ("pairs", "still", "turned"))
    lines = []
    if count and still >= ODD * count:
        lines.append(
            f"{still} of {count} pairs of photographs show a background that does not move: walk around the subject instead of "
            "turning it before the camera, or mask the background (masks/NAME.png, black)"
        )
    if count and turned >= ODD * count:
        lines.append(
            f"between {turned} of {count} pairs of photographs the camera turned on the spot, which shows no depth: step to "
            "the side between photographs"
        )
    return lines


def _keep(folder: Path, models: list[dict[str, Any]], names: list[str], matches: Mapping[str, Any]) -> Poses:
    """Move the largest model to ``sparse/0``."""
    best, *others = models
    target = folder / "sparse" / "0"
    target.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".poses-", dir=target.parent) as place:
        shutil.copytree(best["folder"], Path(place) / "0")
        (Path(place) / "0").replace(target)
    posed = tuple(best["names"])
    rest = tuple(name for name in names if name not in set(posed))
    apart = tuple(tuple(model["names"]) for model in others)
    partners = {name: tuple(matches.get("best", {}).get(name, ("", 0))) for name in rest}
    return Poses(
        target, posed, rest, best["error"], best["points"], best["cameras"], apart, partners, against=tuple(best["against"])
    )
