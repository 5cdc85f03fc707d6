"""Cameras of photographs and Mitsuba's sensors are the same cameras; a scene's own renders are a data set."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from photo_sets import look_at, ring

from mivol.errors import MivolError
from mivol.photos import Camera, Lens, intrinsics, load_photos, project, rays
from mivol.scene.sensors import to_camera, to_sensor
from mivol.validate.photographs import render_photographs

EPS = float(np.finfo(np.float32).eps)
CAMERA = Camera(intrinsics(60, 60, 25, 30), (64, 48), look_at(np.array([3.0, -2, 1])), name="test")


def test_sensor_has_the_rays_of_the_camera(variant_rgb: str) -> None:
    """Mitsuba's own rays, the principal point off the middle both ways; near clipping moves origins along them."""
    sensor = mi.load_dict(to_sensor(CAMERA))
    u = np.random.default_rng(0).random((100, 2))
    found, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(u.T), mi.Point2f(0.5))
    o, d = rays(CAMERA, u * CAMERA.size)
    # A float32 projection matrix inverted in float32: a dozen roundings of numbers up to 1.
    np.testing.assert_allclose(np.array(found.d).T, d, atol=16 * EPS)
    np.testing.assert_allclose(np.cross(np.array(found.o).T - o, d), 0, atol=8 * EPS)


def test_camera_of_a_sensor(variant_rgb: str) -> None:
    found = to_camera(mi.load_dict(to_sensor(CAMERA)))
    assert found.size == CAMERA.size
    np.testing.assert_allclose(found.K, CAMERA.K, rtol=8 * EPS)  # an angle in degrees and two fractions, in float32
    np.testing.assert_allclose(found.to_world, CAMERA.to_world, atol=4 * EPS)


def test_camera_of_a_cropped_sensor(variant_rgb: str) -> None:
    look = to_sensor(CAMERA)
    look["film"] |= {"crop_offset_x": 5, "crop_offset_y": 7, "crop_width": 20, "crop_height": 30}
    sensor = mi.load_dict(look)
    found = to_camera(sensor)
    assert found.size == (20, 30)
    u = np.random.default_rng(1).random((50, 2))
    made, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(u.T), mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(made.d).T, rays(found, u * found.size)[1], atol=32 * EPS)


def test_what_mitsuba_has_no_camera_for(variant_rgb: str) -> None:
    bent = Camera(CAMERA.K, CAMERA.size, CAMERA.to_world, Lens(k1=0.1), "bent")
    with pytest.raises(MivolError, match="bent: found a lens with distortion"):
        to_sensor(bent)
    with pytest.raises(MivolError, match="focal lengths 60 and 70"):
        to_sensor(Camera(intrinsics(60, 70, 25, 30), (64, 48), np.eye(4)))
    with pytest.raises(MivolError, match="expected a perspective sensor"):
        to_camera(mi.load_dict({"type": "orthographic"}))


@pytest.mark.slow
def test_renders_are_photographs(variant_rgb: str, tmp_path: Path) -> None:
    """A small emitter off the middle: in each photograph the light's centre is where the camera of the file says."""
    place = np.array([0.4, -0.2, 0.3])
    cameras = [Camera(intrinsics(60, 60, 25, 30), (64, 48), pose) for pose in ring(3, 3)]
    emitter = {
        "type": "sphere",
        "radius": 0.1,
        "to_world": mi.ScalarTransform4f().translate(place.tolist()),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]}},
    }
    scene = {"type": "scene", "emitter": emitter, **{f"sensor{i}": to_sensor(c) for i, c in enumerate(cameras)}}
    made = render_photographs(scene, tmp_path / "set", test=[1], max_depth=1, max_spp=32, progress=False)
    assert [result.path.name for result in made] == ["view_000.exr", "view_001.exr", "view_002.exr"]
    photos = load_photos(tmp_path / "set", split="all")
    assert photos.space == "linear" and [frame.split for frame in photos.survey.frames] == ["train", "test", "train"]
    for view, camera in zip(photos.views, cameras, strict=True):
        rows, columns = np.mgrid[:48, :64] + 0.5
        weight = view.image[..., 1] / view.image[..., 1].sum()
        centre = (weight * columns).sum(), (weight * rows).sum()
        # The image of a sphere of 2 pixels' radius is an ellipse about a point 0.01 pixels from that of its centre; 32
        # samples a pixel along an edge of 13 pixels move the mean by 1e-2.
        np.testing.assert_allclose(centre, project(view.camera, place)[0], atol=0.05)
        np.testing.assert_allclose(view.image.max(axis=(0, 1)), [3, 2, 1], rtol=1e-5)
        np.testing.assert_allclose(view.camera.K, camera.K, rtol=8 * EPS)


def test_nothing_to_photograph_with(variant_rgb: str, tmp_path: Path) -> None:
    with pytest.raises(MivolError, match="no sensor"):
        render_photographs({"type": "scene", "s": {"type": "sphere"}}, tmp_path, max_depth=1)
