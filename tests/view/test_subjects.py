"""What the viewer shows, and what it writes of a crop."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from photo_sets import write_transforms
from refusals import assert_refused

from mivol.experiments.render import make_camera
from mivol.experiments.run_folder import NEWEST, PHOTOGRAPHS, RunFolder
from mivol.fields.field_files import read_field, write_field
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_volume, write_volume
from mivol.points import Gaussians, read_gaussians, write_gaussians
from mivol.report.record import RunRecord, write_record
from mivol.scene.sensors import to_camera
from mivol.view.subjects import Look, RunSubject, find_model, open_subject
from mivol.view.transfer import Transfer

CAMERA = make_camera([0.5, -3, 0.5, 0.5, 0.5, 0.5], (0, 0, 1), 30, (32, 24))
LEFT = (0.0, 0.0, 0.0, 0.5, 1.0, 1.0)
"""The half of the unit cube with x below 0.5, on the left of the pictures."""


def two_balls(path: Path) -> Path:
    """Two white Gaussians, at x = 0.25 and 0.75."""
    means = np.array([[0.25, 0.5, 0.5], [0.75, 0.5, 0.5]])
    harmonics = np.full((2, 1, 3), 1.77)
    write_gaussians(path, Gaussians(means, np.full((2, 3), -2.5), np.eye(4)[[0, 0]], np.full(2, 9.0), harmonics))
    return path


def full_grid(path: Path) -> Path:
    """A bright cube."""
    field = SphericalGrid.from_dense(np.full((8, 8, 8), 9.0), np.full((8, 8, 8, 1, 3), 1.77), np.eye(4))
    write_field(path, field)
    return path


def full_volume(path: Path) -> Path:
    """A cube of ones with an empty layer, since a constant volume has nothing to see."""
    values = np.ones((8, 8, 8, 1), np.float32)
    values[0] = 0
    write_volume(path, values, np.eye(4))
    return path


MODELS = {"balls.ply": two_balls, "grid.npz": full_grid, "cube.nrrd": full_volume}


@pytest.mark.parametrize("name", MODELS)
def test_a_crop_hides_what_lies_outside(tmp_path: Path, name: str) -> None:
    subject = open_subject(MODELS[name](tmp_path / name))
    whole, half = (subject.draw(CAMERA, Look(crop=crop)) for crop in (None, LEFT))
    assert whole.shape == (24, 32, 3) and whole[8:16, 18:22].mean() > 0.2
    assert half[8:16, 11:14].mean() > 0.2 and half[8:16, 20:].max() < 1e-3


@pytest.mark.parametrize("name", MODELS)
def test_a_saved_crop_holds_the_same(tmp_path: Path, name: str) -> None:
    subject = open_subject(MODELS[name](tmp_path / name))
    path = subject.save_crop(tmp_path / "crops", LEFT)
    again = subject.save_crop(tmp_path / "crops", LEFT)
    assert path != again and path.name.startswith(f"{name.partition('.')[0]}-crop")
    if path.suffix == ".ply":
        assert read_gaussians(path).means.tolist() == [[0.25, 0.5, 0.5]]
    elif path.suffix == ".npz":
        assert np.array(read_field(path).node_positions())[:, 0].max() < 0.5
    else:
        cropped = read_volume(path)
        assert cropped.values.shape == (8, 8, 4, 1) and np.allclose(cropped.to_world, np.diag([0.5, 1, 1, 1]))
        right = read_volume(subject.save_crop(tmp_path / "crops", (0.5, 0, 0, 1, 1, 1)))
        assert np.allclose(right.to_world[:3, 3], (0.5, 0, 0)) and np.allclose(np.diag(right.to_world), (0.5, 1, 1, 1))
    assert_refused("make it larger", subject.save_crop, tmp_path / "crops", (2, 2, 2, 3, 3, 3))


def test_slices_show_values_where_they_are(tmp_path: Path) -> None:
    """A slice y = 0.5 of a ramp along x is dark on the left and bright on the right."""
    ramp = np.broadcast_to(np.linspace(0, 1, 16, dtype=np.float32), (16, 16, 16))[..., None]
    write_volume(tmp_path / "ramp.nrrd", np.ascontiguousarray(ramp), np.eye(4))
    subject = open_subject(tmp_path / "ramp.nrrd")
    image = subject.draw(CAMERA, Look(transfer=Transfer(colours="gray", slices=(1.0, 0.5, 0.0))))
    row = image[12, :, 0]
    seen = np.flatnonzero(row > 0.01)
    assert len(seen) > 8 and (np.diff(row[seen[0] : seen[-2]]) >= -1e-3).all() and row[seen[-3]] > 0.7


def test_a_run_shows_its_newest_model_and_reads_it_again(tmp_path: Path) -> None:
    write_record(RunRecord.new("a run"), tmp_path)
    assert find_model(tmp_path) is None
    full_volume(tmp_path / NEWEST)
    subject = RunSubject(tmp_path)
    assert subject.has_values and not subject.refresh()
    two_balls(tmp_path / "gaussians.ply")
    assert subject.refresh() and not subject.has_values and subject.can_crop
    assert subject.draw(CAMERA, Look()).max() > 0.5


def test_a_run_shows_its_photographs_before_it_has_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The path in the folder starts at the folder; the first model replaces the points and keeps the cameras.

    The viewer of an unfinished run gives way to the fit. All further tests of this process would give way, too."""
    steps = []
    monkeypatch.setattr("os.nice", lambda step: steps.append(step) or 0)
    (tmp_path / "photos").mkdir()
    write_transforms(tmp_path / "photos", {"fl_x": 10.0, "w": 12, "h": 8})
    run = RunFolder(tmp_path / "runs" / "a", RunRecord.new("a run"))
    write_record(run.record, run.path)
    run.write_photographs(tmp_path / "photos", 4, 1)
    assert str(tmp_path) not in (run.path / PHOTOGRAPHS).read_text(encoding="utf-8")
    subject = open_subject(run.path)
    assert max(steps) == 19
    assert [frame.split == "train" for frame in subject.survey.frames] == [True, False, True, True]
    assert not subject.draw(CAMERA, Look()).any() and "no model" in subject.title
    assert_refused("no model yet", subject.save_crop, tmp_path, LEFT)
    two_balls(run.path / "gaussians.ply")
    assert subject.refresh() and subject.title == "a"
    assert subject.draw(CAMERA, Look()).max() > 0.5 and len(subject.survey.frames) == 4


def test_foreign_paths_are_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.pdf").write_text("text")
    (tmp_path / "scan.zip").write_bytes(b"PK\x03\x04" + bytes(64))
    known = (("missing", "no file"), ("empty", "mivol poses"), ("a.pdf", "mivol explain"), ("scan.zip", "unpack it"))
    for name, word in known:
        assert_refused(word, open_subject, tmp_path / name)


LOOKAT = '<lookat origin="0,-4,0" target="0, 1 0.5" up="0 0 2"/>'


@pytest.mark.parametrize(
    ("transform", "is_aimed"),
    [
        (LOOKAT, True),
        (LOOKAT + '<translate x="1"/>', False),  # moves the target as well
        ('<matrix value="1 0 0 0 0 0 1 -4 0 -1 0 0 0 0 0 1"/>', False),
    ],
)
def test_a_scene_turns_about_what_its_camera_looks_at(variant_rgb: str, tmp_path: Path, transform: str, is_aimed: bool) -> None:
    """The target is 5 and 0.5 away, so the camera's own up leans back; the middle of the scene is that of a ball far away."""
    path = tmp_path / "scene.xml"
    sensor = f'<sensor type="perspective"><transform name="to_world">{transform}</transform></sensor>'
    ball = '<shape type="sphere"><float name="radius" value="100"/><point name="center" x="90" y="0" z="0"/></shape>'
    path.write_text(f'<scene version="3.0.0">{sensor}<integrator type="direct"/>{ball}</scene>')
    subject = open_subject(path)
    ahead = np.subtract(subject.home.target, subject.home.origin)
    reach = np.linalg.norm(ahead)
    assert (reach == pytest.approx(25.25**0.5, rel=1e-6)) == is_aimed
    np.testing.assert_allclose(ahead / reach, to_camera(subject.scene.sensors()[0]).forward, atol=1e-5)
    assert (subject.home.up == (0, 0, 1)) == is_aimed
