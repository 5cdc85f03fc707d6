"""Where cameras stand, as pictures of a page: those of photographs and those of a scene."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from photo_sets import write_blender
from tiny_experiment import SCENE, write_experiment

from mivol.experiments import camera_pictures
from mivol.photos import PhotoSurvey, survey_photos
from mivol.scene.camera_rigs import find_media_box


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[PhotoSurvey, Path, str]]:
    """What is drawn, and where."""
    found: list = []
    monkeypatch.setattr(camera_pictures, "plot_cameras", lambda *given: found.append(given))
    return found


def test_cameras_that_judge_are_drawn_too(tmp_path: Path, drawn: list) -> None:
    """In the box that was fitted in; one picture from the side and one from above."""
    write_blender(tmp_path / "set")
    train, test = (survey_photos(tmp_path / "set", split=split) for split in ("train", "test"))
    photos, judged = (SimpleNamespace(survey=survey) for survey in (train, test))
    images = camera_pictures.draw_photo_cameras(tmp_path, photos, judged)
    assert [(i.path, i.role) for i in images] == [("cameras_side.png", "picture"), ("cameras_plan.png", "picture")]
    assert all(i.caption for i in images)
    assert [(path.name, part) for _, path, part in drawn] == [("cameras_side.png", "side"), ("cameras_plan.png", "plan")]
    for survey, _, _ in drawn:
        assert survey.frames == train.frames + test.frames and survey.box is train.box
    drawn.clear()
    camera_pictures.draw_photo_cameras(tmp_path, photos, None)
    assert drawn[0][0].frames == train.frames


def test_pinholes_of_a_scene_are_drawn_about_its_media(variant_rgb, tmp_path: Path, drawn: list) -> None:
    write_experiment(tmp_path)
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    flat = mi.load_dict({"type": "orthographic"})
    views = [SimpleNamespace(name=name, sensor=sensor) for name, sensor in (("a", scene.sensors()[0]), ("b", flat))]
    images = camera_pictures.draw_view_cameras(tmp_path, scene, {"train": [views[0]], "held_out": views})
    survey = drawn[0][0]
    assert [(f.camera.name, f.split) for f in survey.frames] == [("a", "train"), ("a", "held_out")] and len(images) == 2
    np.testing.assert_allclose(survey.frames[0].camera.origin, [0, 1, 4], atol=1e-6)
    assert 'origin="0, 1, 4"' in SCENE
    np.testing.assert_array_equal(survey.box, find_media_box(scene))
    assert camera_pictures.draw_view_cameras(tmp_path, scene, {"train": views[1:]}) == []
