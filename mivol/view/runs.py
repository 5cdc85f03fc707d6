"""What a path shows: the choice of a subject, and the model of a run, read again whenever the fit writes it.

Conventions. A fit runs in another process and knows of no viewer: it writes its models as always, and the viewer reads the
newest one. A viewer of an unfinished run takes the lowest priority of the operating system, so the fit keeps its cores.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.experiments.run_folder import NEWEST, PHOTOGRAPHS
from mivol.files.formats import check_has_reader, is_volume
from mivol.files.source import refusal
from mivol.photos import Camera, PhotoSurvey, find_format
from mivol.points.summary import is_points_file
from mivol.report.record import RECORD, read_record
from mivol.view.subjects import (
    FieldSubject,
    GaussianSubject,
    Look,
    PhotoSubject,
    SceneSubject,
    Subject,
    VolumeSubject,
    survey_views,
)

FINAL: dict[str, Callable[[Path], Subject]] = {"gaussians.ply": GaussianSubject, "field.npz": FieldSubject}
"""Models that a run writes at its end."""

PASSING: dict[str, Callable[[Path], Subject]] = {
    "gaussians_best.ply": GaussianSubject,
    "field_best.npz": FieldSubject,
    NEWEST: VolumeSubject,
}
"""Models that a run writes while it fits."""

POLITE = 19
"""Niceness of a viewer of an unfinished run."""

WAIT = 1.0
"""Time between two looks for the first model of a run [s]."""


def open_subject(
    path: Path,
    photographs: Path | None = None,
    dataset: str | None = None,
    defines: Mapping[str, str] | None = None,
    say: Callable[[str], None] = print,
) -> Subject:
    """Find out what a path is, and prepare it for a viewer.

    Args:
        path: run folder, folder of photographs, field (.npz), Gaussians or points, volume, or scene (.xml).
        photographs: data set whose cameras are shown with it.
        dataset: array of a volume file with several.
        defines: values of a scene's parameters.
        say: receives a line while an unfinished run has no model.

    Raises:
        MivolError: none of these, or as the readers.
    """
    subject = _open(path, dataset, defines, say)
    if photographs is not None:
        subject.survey = survey_views(photographs)
    if subject.survey is not None and subject.home is not None:
        subject.box = np.asarray(subject.survey.box, np.float64)
    return subject


def _open(path: Path, dataset: str | None, defines: Mapping[str, str] | None, say: Callable[[str], None]) -> Subject:
    if not path.exists():
        raise refusal(path, "no file and no folder", "a run, photographs, a model, a volume or a scene", "check the path")
    suffix = path.suffix.lower()
    if path.is_dir() and (path / RECORD).exists():
        return wait_for_run(path, say)
    if find_format(path) is not None:
        return PhotoSubject(path)
    if suffix == ".xml":
        return SceneSubject(path, defines)
    if suffix == ".npz" and not is_volume(path):
        return FieldSubject(path)
    if is_points_file(path):
        return GaussianSubject(path)
    if is_volume(path):
        return VolumeSubject(path, dataset)
    check_has_reader(path)
    found = "a folder without a run or posed photographs" if path.is_dir() else f"a file {path.suffix or 'without a suffix'}"
    way_out = f"mivol poses {path} finds poses of photographs" if path.is_dir() else "mivol explain says what it is"
    raise refusal(path, found, "a run, posed photographs, a model (.npz, .ply, ...), a volume or a scene (.xml)", way_out)


def wait_for_run(folder: Path, say: Callable[[str], None]) -> Subject:
    """The model of a run; waits for the first model of an unfinished run, or for its photographs.

    Raises:
        MivolError: a finished or stopped run without a model.
    """
    has_said = False
    while True:
        record = read_record(folder)
        if record.status == "running" and os.nice(0) < POLITE:
            os.nice(POLITE - os.nice(0))
        if find_model(folder) is not None or (record.status == "running" and find_photographs(folder) is not None):
            return RunSubject(folder)
        if record.status != "running":
            raise refusal(folder, f"a {record.status} run without a model", "one with a model", "run mivol optimize again")
        if not has_said:
            say(f"{folder}: waiting for the first model of the fit")
            has_said = True
        time.sleep(WAIT)


def find_model(folder: Path) -> tuple[Path, float] | None:
    """The newest model of a run, and its time of change; None without a model."""
    listed = [folder / volume.path for volume in read_record(folder).volumes if volume.role == "reconstruction"]
    for names in (FINAL, listed, PASSING):
        found = [(path, path.stat().st_mtime) for path in (folder / name for name in names) if path.is_file()]
        if found:
            return max(found, key=lambda one: one[1])
    return None


class RunSubject(Subject):
    """The newest model of a run, or the points of its photographs before the first model.

    Attributes:
        folder: run folder.
        model: subject of the newest model.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.name, self._time = folder, folder.resolve().name, 0.0
        self.survey = find_photographs(folder)
        if not self.refresh():
            self.model: Subject = PhotoSubject(folder, self.survey)
            # The sliders stay when the model comes; fits of photographs have models that can be cropped.
            self.home, self.box, self.can_crop = self.model.home, self.model.box, True

    @property
    def title(self) -> str:
        return self.name if self._time else f"{self.name}: no model yet"

    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        return self.model.draw(camera, look, seed)

    def save_crop(self, folder: Path, box: Sequence[float]) -> Path:
        if not self._time:
            raise MivolError(f"{self.name} has no model yet: wait for the first one of the fit.")
        return self.model.save_crop(folder, box)

    def first_look(self) -> Look:
        return self.model.first_look()

    def refresh(self) -> bool:
        found = find_model(self.folder)
        if found is None or found[1] == self._time:
            return False
        path, self._time = found
        self.model = {**FINAL, **PASSING}.get(path.name, VolumeSubject)(path)
        self.home, self.space = self.model.home, self.model.space
        self.can_crop, self.has_values = self.model.can_crop, self.model.has_values
        if self.survey is None:
            self.box = self.model.box
        return True


def find_photographs(folder: Path) -> PhotoSurvey | None:
    """The photographs of a run; None if the run has none, or if they are elsewhere (``--photos`` names them then).

    Raises:
        MivolError: a damaged list, or damaged photographs.
    """
    file = folder / PHOTOGRAPHS
    if not file.is_file():
        return None
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        path, held_out, fold = folder / found["path"], int(found["held_out"]), int(found["fold"])
    except (ValueError, TypeError, KeyError) as error:
        raise refusal(file, f"a damaged file ({error})", "the place of photographs", "remove it") from error
    return None if find_format(path) is None else survey_views(path, held_out, fold)
