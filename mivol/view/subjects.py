"""Subjects of the viewer: a radiance field, Gaussians, points, a scene, photographs, or the model of a run.

Conventions. A subject draws the view of a pinhole as float32 values (H, W, 3) in a colour space of its own, and the painter
makes a picture for a screen. ``space`` "srgb" means code values, "linear" means radiance. A crop is six numbers, a lower
and a higher corner [length].

A fit runs in another process and knows of no viewer: the fit writes models as always, and the viewer reads the newest. A
viewer of an unfinished run takes the lowest priority of the operating system, and the fit keeps the cores.
"""

from __future__ import annotations

import json
import os
import time
import xml.etree.ElementTree as ElementTree
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.experiments.render import (
    Framing,
    PointLook,
    choose_integrator,
    frame_points,
    sky_beside,
    to_gaussians,
)
from mivol.experiments.run_folder import NEWEST, PHOTOGRAPHS
from mivol.fields.field_archives import read_field_view
from mivol.fields.field_files import read_field, write_field
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files.formats import check_has_reader, is_volume
from mivol.files.source import check_file, refusal
from mivol.optim.photographs.field_view import render_view
from mivol.photos import Camera, PhotoSurvey, find_format, survey_photos
from mivol.photos.camera_path import HomeView, find_home_view
from mivol.points.cloud import PointCloud, read_points, write_points
from mivol.points.gaussian_files import is_gaussian_file, read_gaussian_view, read_gaussians, write_gaussians
from mivol.points.gaussians import Gaussians
from mivol.points.summary import is_points_file
from mivol.report.record import RECORD, read_record
from mivol.scene.load import load_scene
from mivol.scene.sensors import to_camera, to_sensor
from mivol.splatting import Splatter, to_tensors
from mivol.view.transfer import Transfer, VolumePicture


@dataclass(frozen=True)
class Look:
    """Choices of the sliders of the page.

    Attributes:
        exposure: exposure value; each unit doubles the light of the picture.
        crop: box outside of which nothing is shown, six numbers [length]; None shows everything.
        transfer: transfer function and slices of a volume.
    """

    exposure: float = 0.0
    crop: tuple[float, ...] | None = None
    transfer: Transfer = field(default_factory=Transfer)


class Subject(ABC):
    """Something to look at.

    Attributes:
        name: name for titles and files.
        box: (2, 3) lower and higher corner of the visible matter [length].
        home: first view; None: a view of the whole box.
        space: colour space of drawn values, "srgb" or "linear".
        is_noisy: whether the mean of several draws with other seeds is a better picture.
        can_crop: whether :attr:`Look.crop` has an effect, and :meth:`save_crop` writes a file.
        has_values: whether :attr:`Look.transfer` has an effect.
        survey: cameras of the photographs that belong to it; None without.
    """

    name: str
    box: np.ndarray
    home: HomeView | None = None
    space: str = "srgb"
    is_noisy: bool = False
    can_crop: bool = False
    has_values: bool = False
    survey: PhotoSurvey | None = None

    @abstractmethod
    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        """Values (H, W, 3) of the view of a pinhole."""

    def save_crop(self, folder: Path, box: Sequence[float]) -> Path:
        """Write the part inside a box into a new file of the folder, and return the path.

        Raises:
            MivolError: nothing inside, or a subject that cannot be cropped.
        """
        raise MivolError(f"{self.name} cannot be cropped: convert it first (mivol convert).")

    def refresh(self) -> bool:
        """Read changed files again; return whether the pictures change."""
        return False

    @property
    def title(self) -> str:
        """Name on the page, with missing parts."""
        return self.name

    def first_look(self) -> Look:
        """The look with which the sliders begin."""
        return Look()

    def first_view(self) -> HomeView:
        """The view with which a page begins."""
        place, up, fov, size = Framing().complete(self.home)
        if place is None:
            place = frame_points(self.box, up, fov, size)
        return HomeView(tuple(up), tuple(place[:3]), tuple(place[3:]), fov, size)


def are_inside(places: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """Which places (N, 3) lie in a box, bool (N,)."""
    low, high = np.reshape(np.asarray(box, np.float64), (2, 3))
    return ((places >= low) & (places <= high)).all(axis=1)


def new_file(folder: Path, stem: str, suffix: str) -> Path:
    """A path that does not exist yet: ``stem.suffix``, ``stem-2.suffix``, ..."""
    folder.mkdir(parents=True, exist_ok=True)
    number, path = 1, folder / f"{stem}{suffix}"
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path


class FieldSubject(Subject):
    """A radiance field over the fitted sky, or over black."""

    def __init__(self, path: Path) -> None:
        self.name, self.field, self.sky = path.stem, read_field(path), sky_beside(path)
        self.home, self.space = read_field_view(path), self.field.space
        self.box = _box_of(self.field.to_world)
        self.can_crop = isinstance(self.field, SphericalGrid)
        self._cropped: tuple[tuple[float, ...] | None, SphericalGrid] = (None, self.field)

    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        if self.can_crop and look.crop != self._cropped[0]:
            self._cropped = look.crop, self.crop(look.crop)
        behind: np.ndarray | Sky = np.zeros(3) if self.sky is None else self.sky
        return render_view(self._cropped[1], camera, behind).image

    def crop(self, box: Sequence[float] | None) -> SphericalGrid:
        """The field with the nodes inside a box; nested boxes keep theirs."""
        if box is None:
            return self.field
        field = self.field
        stored, kept = field.stored_nodes(), np.flatnonzero(are_inside(field.node_positions(), box))
        density, sh = field.values()
        if not len(kept):
            # A field without a node cannot be drawn: one node of vacuum is nothing too.
            kept, density = np.zeros(1, int), np.full(1, field.activation_function.vacuum, np.float32)
        return field.with_rows(density[kept], sh[kept], mi.UInt32(stored[kept].astype(np.uint32)))

    def save_crop(self, folder: Path, box: Sequence[float]) -> Path:
        if not self.can_crop:
            return super().save_crop(folder, box)
        if not are_inside(self.field.node_positions(), box).any():
            raise MivolError("the box holds nothing of the field: make it larger.")
        cropped = self.crop(box)
        path = new_file(folder, f"{self.name}-crop", ".npz")
        write_field(path, cropped, view=self.home)
        return path


MOST_SPLATTERS = 8
"""Sizes of pictures whose renderer is kept."""


class GaussianSubject(Subject):
    """Gaussians, or points as discs, over black."""

    can_crop = True

    def __init__(self, path: Path) -> None:
        is_cloud = not is_gaussian_file(check_file(path))
        cloud = read_points(path) if is_cloud else None
        self._begin(path.stem, read_gaussians(path) if cloud is None else to_gaussians(cloud, PointLook()), cloud)
        self.home = None if is_cloud else read_gaussian_view(path)

    @classmethod
    def of_points(cls, name: str, cloud: PointCloud) -> GaussianSubject:
        """Points as discs."""
        subject = cls.__new__(cls)
        subject._begin(name, to_gaussians(cloud, PointLook()), cloud)
        return subject

    def _begin(self, name: str, gaussians: Gaussians, cloud: PointCloud | None) -> None:
        self.name, self.gaussians, self.cloud = name, gaussians, cloud
        if not gaussians.count:
            raise refusal(name, "no Gaussians", "at least one", "name another file")
        reach, means = 2 * gaussians.scales().max(axis=1, keepdims=True), gaussians.means.astype(np.float64)
        self.box = np.array([np.quantile(means - reach, 0.01, axis=0), np.quantile(means + reach, 0.99, axis=0)])
        self._splatters: OrderedDict[tuple[int, int], Splatter] = OrderedDict()
        self._cropped: tuple[tuple[float, ...] | None, dict] = (None, to_tensors(gaussians))

    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        if look.crop != self._cropped[0]:
            kept = self.gaussians
            if look.crop is not None:
                kept = kept.select(are_inside(kept.means, look.crop))
            self._cropped = look.crop, to_tensors(kept)
        if camera.size not in self._splatters:
            is_cloud = self.cloud is not None
            self._splatters[camera.size] = Splatter(*camera.size, self.gaussians.degree, compensated=is_cloud, discs=is_cloud)
            if len(self._splatters) > MOST_SPLATTERS:
                self._splatters.popitem(last=False)
        self._splatters.move_to_end(camera.size)
        image, _ = self._splatters[camera.size].forward(self._cropped[1], camera, derivatives=False)
        return np.array(image)[..., :3]

    def save_crop(self, folder: Path, box: Sequence[float]) -> Path:
        kept = are_inside(self.gaussians.means, box)
        if not kept.any():
            raise MivolError(f"the box holds none of the {len(kept)} Gaussians or points: make it larger.")
        path = new_file(folder, f"{self.name}-crop", ".ply")
        if self.cloud is None:
            write_gaussians(path, self.gaussians.select(kept), self.home)
        else:
            colours = None if self.cloud.colours is None else self.cloud.colours[kept]
            write_points(path, replace(self.cloud, positions=self.cloud.positions[kept], colours=colours))
        return path


class VolumeSubject(Subject):
    """A volume of values through a transfer function, or as slices.

    Attributes:
        picture: the volume, prepared.
    """

    can_crop = has_values = True

    def __init__(self, path: Path, dataset: str | None = None) -> None:
        self.name, self.picture = path.name.partition(".")[0], VolumePicture.read(path, dataset)
        self.box = _box_of(self.picture.volume.to_world)

    def first_look(self) -> Look:
        return Look(transfer=Transfer((self.picture.background, 1.0)))

    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        return self.picture.draw(camera, look.transfer, look.crop)

    def save_crop(self, folder: Path, box: Sequence[float]) -> Path:
        cropped, path = self.picture.crop(box), new_file(folder, f"{self.name}-crop", ".nrrd")
        self.picture.write(path, cropped)
        return path


class SceneSubject(Subject):
    """A scene of Mitsuba with the scene's integrator; each draw takes a sample of each pixel."""

    space, is_noisy = "linear", True

    def __init__(self, path: Path, defines: Mapping[str, str] | None) -> None:
        loaded = load_scene(path, defines or {})
        self.name, self.scene = loaded.name, loaded.scene
        self.integrator = choose_integrator(self.scene, None if self.scene.integrator() else "mivol")
        bounds = self.scene.bbox()
        self.box = np.array([bounds.min, bounds.max], np.float64).reshape(2, 3)
        if not np.isfinite(self.box).all():
            self.box = np.array([[-1.0] * 3, [1.0] * 3])
        sensors = [sensor for sensor in self.scene.sensors() if sensor.class_name() == "PerspectiveCamera"]
        self.home = find_home_view([to_camera(sensors[0])], self.box) if sensors else None
        if self.home is not None:
            self.home = follow_lookat(path, self.home)

    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        sensor = mi.load_dict(to_sensor(camera))
        return np.array(self.integrator.render(self.scene, sensor, seed=seed, spp=1))[..., :3]


def follow_lookat(path: Path, home: HomeView) -> HomeView:
    """Return the first view of a scene with target and up of a ``lookat`` in its XML, or as it is without one for this camera.

    Drags turn about both. The middle of a scene with a far background is far from what the camera shows, and the camera's own
    up leans back if it looks down.
    """
    try:
        looks = list(ElementTree.parse(path).getroot().iterfind("sensor/transform/lookat")) if path.suffix == ".xml" else []
    except ElementTree.ParseError:
        return home
    for look in looks:
        with suppress(ValueError):
            target, up = (np.array(look.get(key, "").replace(",", " ").split(), float) for key in ("target", "up"))
            ahead, forward = target - home.origin, np.subtract(home.target, home.origin)
            # Off by 1e-3 of the distance at most: Mitsuba holds the transform in single precision.
            if up.shape == (3,) and ahead @ forward > 0 and _sine(ahead, forward) < 1e-3:
                return replace(home, target=tuple(target.tolist()), up=tuple((up / np.linalg.norm(up)).tolist()))
    return home


def _sine(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(a, b)) / (np.linalg.norm(a) * np.linalg.norm(b)))


class PhotoSubject(Subject):
    """Posed photographs: their cameras, and the points of a reconstruction, if given."""

    def __init__(self, path: Path, survey: PhotoSurvey | None = None) -> None:
        self.survey = survey_views(path) if survey is None else survey
        self.name, self.box = path.name or "photographs", np.asarray(self.survey.box, np.float64)
        self.home = find_home_view([frame.camera for frame in self.survey.frames], self.box)
        points = self.survey.points
        has_points = points is not None and len(points) > 0
        self.points = GaussianSubject.of_points(self.name, PointCloud(np.asarray(points))) if has_points else None

    def draw(self, camera: Camera, look: Look, seed: int = 0) -> np.ndarray:
        if self.points is None:
            return np.zeros((camera.size[1], camera.size[0], 3), np.float32)
        return self.points.draw(camera, look, seed)


HELD_OUT = 8
"""Step between photographs that do not take part in a fit, unless the data set or a run says which."""


def survey_views(path: Path, held_out: int = HELD_OUT, fold: int = 0) -> PhotoSurvey:
    """The photographs of a data set; without a split of its own, every ``held_out``-th from ``fold`` on is held out."""
    survey = survey_photos(path)
    if not held_out or any(frame.split != "train" for frame in survey.frames) or len(survey.frames) < 2:
        return survey
    return survey_photos(path, held_out=held_out, fold=fold)


def _box_of(to_world: np.ndarray) -> np.ndarray:
    """Corners (2, 3) of the axis-aligned box around the unit cube under a map (4, 4)."""
    unit = np.array([[x, y, z, 1] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
    corners = (unit @ np.asarray(to_world, np.float64).T)[:, :3]
    return np.array([corners.min(axis=0), corners.max(axis=0)])


# -- The subject of a path ---------------------------------------------------------------------------------------------

FINAL: dict[str, Callable[[Path], Subject]] = {"gaussians.ply": GaussianSubject, "field.npz": FieldSubject}
"""Models written by a run at the end."""

PASSING: dict[str, Callable[[Path], Subject]] = {
    "gaussians_best.ply": GaussianSubject,
    "field_best.npz": FieldSubject,
    NEWEST: VolumeSubject,
}
"""Models written by a run during the fit."""

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
    """Recognise the content of a path, and prepare the content for a viewer.

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
    """The newest model of a run, and the time of change; None without a model."""
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
