"""Numbers as pixels: distances, normals, and the preview of a running fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from photo_sets import look_at
from PIL import Image

from mivol.errors import MivolError
from mivol.photos import Camera, intrinsics, pixel_centres, rays
from mivol.report.pixel_scale import EDGE, GAP, depth_pixels, is_preview_due, normal_pixels, normals_from_depth, write_preview


def test_normals_of_a_sphere(artefacts: Path) -> None:
    camera = Camera(intrinsics(400, 400, 100, 80), (200, 160), look_at(np.array([3.0, -2, 1.5])))
    o, d = rays(camera, pixel_centres(camera.size))
    b = np.sum(o * d, axis=-1)
    with np.errstate(invalid="ignore"):
        distance = -b - np.sqrt(b**2 - np.sum(o * o, axis=-1) + 0.25)
    hit = np.isfinite(distance)
    normals = normals_from_depth(distance, camera)
    inner = np.isfinite(normals).all(axis=-1) & (np.sum(normals * d, axis=-1) < -0.3)
    truth = 2 * (o + distance[..., None] * d)
    # Central differences of z = sqrt(1 - x^2) err by h^2/6 z''' = h^2/(2 z^5) in slope, h^2/(2 z^3) in angle: with pixels of
    # h = 3.4/400 on a radius of 1/2 and z = 0.3 it is 5.4e-3 along each axis, 7.6e-3 for both.
    assert inner.sum() > 5000
    np.testing.assert_allclose(normals[inner], truth[inner], atol=7.6e-3)
    depth = depth_pixels(distance, (2.5, 4.5))
    assert (depth[~hit] == 255).all() and (depth[hit] < 255).any(axis=-1).all()
    Image.fromarray(np.hstack([depth, normal_pixels(normals)])).save(artefacts / "sphere.png")


def test_near_is_light_far_is_dark_and_transparent_is_white() -> None:
    distance = np.array([[1.0, 2, 3, np.inf], [1, 2, 3, 0]])
    colours = depth_pixels(distance, (1, 3), np.array([[1, 1, 1, 1], [1, 0.5, 0, 1]]))
    brightness = colours.astype(float).mean(axis=-1)
    assert brightness[0, 0] > brightness[0, 1] > brightness[0, 2]
    assert (colours[0, 3] == 255).all() and (colours[1, 2] == 255).all()
    np.testing.assert_array_equal(colours[1, 3], colours[1, 0])  # a distance below near has the colour of near
    np.testing.assert_allclose(colours[1, 1], (colours[0, 1] + 255.0) / 2, atol=1)
    np.testing.assert_array_equal(normal_pixels(np.array([[[0.0, 0, 1], [-1, 0, 0]]]))[0], [[128, 128, 255], [0, 128, 128]])
    for shape, span, message in (((3,), (0, 1), "give \\(height, width\\)"), ((2, 2), (1, 1), "give near below far")):
        with pytest.raises(MivolError, match=message):
            depth_pixels(np.ones(shape), span)
    with pytest.raises(MivolError, match="do not fit a camera"):
        normals_from_depth(np.ones((5, 5)), Camera(intrinsics(90, 100, 30, 20), (64, 48), np.eye(4)))


def test_a_preview_shows_three_slices_on_one_scale(tmp_path: Path) -> None:
    """A box of 1 x 2 x 0.5: xy, xz and yz from 0 to the largest value, the second axis up."""
    volume = np.zeros((2, 4, 2), np.float32)
    volume[1, 0, 0] = 4.0  # the middle layer z = 1: low y, low x
    volume[0, 2, 1] = 2.0  # the middle y = 2 and x = 1: low z
    path = write_preview(tmp_path, volume, (1.0, 2.0, 0.5))
    image = np.round(255 * imread(path)[..., 0]).astype(int)
    x, y, z = EDGE // 2, EDGE, EDGE // 4
    assert image.shape == (y, x + x + y + 2 * GAP)
    xy, xz, yz = image[:, :x], image[y - z :, x + GAP : x + GAP + x], image[y - z :, -y:]
    assert (image[: y - z, x + GAP :] == 255).all() and (image[:, x : x + GAP] == 255).all()
    assert (xy[-y // 4 :, : x // 2] == 255).all() and (xy[: -y // 4] == 0).all() and (xy[:, x // 2 :] == 0).all()
    half = int(np.round(255 * 2 / np.percentile([4.0] + 7 * [0.0] + [2.0] + 3 * [0.0] + [2.0] + 7 * [0.0], 99.8)))
    assert (xz[z // 2 :, x // 2 :] == half).all() and (xz[: z // 2] == 0).all() and (xz[:, : x // 2] == 0).all()
    assert (yz[z // 2 :, y // 2 : 3 * y // 4] == half).all() and (yz[: z // 2] == 0).all() and (yz[:, : y // 2] == 0).all()


def test_a_run_writes_about_twenty_previews() -> None:
    """The first and the last iteration, and every twentieth part of a run; every iteration of a short run."""
    assert [k for k in range(1, 8) if is_preview_due(k, 7)] == [1, 2, 3, 4, 5, 6, 7]
    assert [k for k in range(1, 65) if is_preview_due(k, 64)] == sorted({1, 64, *range(3, 64, 3)})
    assert sum(is_preview_due(k, 5000) for k in range(1, 5001)) == 21
