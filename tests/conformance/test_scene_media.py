"""The medium around a camera that is inside a boundary."""

from __future__ import annotations

import mitsuba as mi
import pytest
import scattering_scenes as small
from scattering_scenes import PLACE, assert_same_images, mivol, moments
from volpath_scenes import LEAK, grid_in, lit

import scenes
from scenes import ball_of, box_of


@pytest.mark.slow_for("ball")
@pytest.mark.statistical
@pytest.mark.parametrize("shape", small.cases(["box", "ball"], ["box"]))
def test_camera_inside(shape):
    """The sensor names its medium, as volpath requires."""
    interior = grid_in({}, seed=4)["interior"] | {"id": "fog"}
    ref = {"type": "ref", "id": "fog"}
    parts = lit({"fog": interior, "box": box_of(ref, PLACE) if shape == "box" else ball_of(ref, (0, 0, 0), 1.0)})
    sensor = scenes.camera((0.4, -0.3, 0.2), (-0.5, 0.4, 0), res=16, fov=60.0) | {"medium": ref}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": sensor})
    assert_same_images(scene, rounding=LEAK)


@pytest.mark.slow
@pytest.mark.statistical
def test_camera_inside_that_names_no_medium():
    """Volpath then starts in vacuum; mivol finds the medium. The image equals that of a sensor naming the medium."""
    interior = grid_in({}, seed=4)["interior"] | {"id": "fog"}
    parts = lit({"fog": interior, "box": box_of({"type": "ref", "id": "fog"}, PLACE)})
    sensor = scenes.camera((0.4, -0.3, 0.2), (-0.5, 0.4, 0), res=8, fov=60.0)
    names = mi.load_dict({"type": "scene", **parts, "sensor": sensor | {"medium": {"type": "ref", "id": "fog"}}})
    silent = mi.load_dict({"type": "scene", **parts, "sensor": sensor})
    small.assert_same_whole(moments(silent, mivol(), 32), moments(names, mivol(), 32, first=500))
