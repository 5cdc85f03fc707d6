"""Batches of rays: directions and pixel values."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from ball_photos import draw_tiles

from mivol.errors import MivolError
from mivol.optim.photographs.field_view import PixelRays
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.photos import Camera, Photo, intrinsics, pixel_centres, rays
from mivol.photos.lens import Fisheye, Lens


def test_batches_have_rays_and_pixels_of_their_views(variant_rgb: str, photos: list[Photo]) -> None:
    views = RayBatches.from_photos(photos[:3], (1, 2))
    batch = draw_tiles(views, 1, np.array([0, 2]), 5, np.random.default_rng(0))
    assert dr.width(batch.slot) == 2 * 5 * TILE**2
    whole = views.all_pixels(1, 1)
    _, d = rays(photos[1].camera, pixel_centres((48, 48)))
    found = np.array(whole.rays.d).T.reshape(12, 12, 4, 4, 3).transpose(0, 2, 1, 3, 4).reshape(48, 48, 3)
    np.testing.assert_allclose(found, d, atol=3e-7)
    image = np.array(whole.target).T.reshape(12, 12, 4, 4, 3).transpose(0, 2, 1, 3, 4).reshape(48, 48, 3)
    np.testing.assert_allclose(image, photos[1].image, atol=0.5 / 255 + 1e-6)
    half = np.array(views.all_pixels(2, 1).rays.d).T[0]
    assert np.abs(half - d[0:2, 0:2].mean(axis=(0, 1))).max() < 1e-3
    assert views.digest() != RayBatches.from_photos(photos[1:4], (1, 2)).digest()


@pytest.mark.parametrize("lens", [Lens(), Lens(0.05, p1=0.01), Fisheye(0.01)])
def test_rays_of_a_camera_cover_its_pixels(variant_rgb: str, lens: Lens | Fisheye) -> None:
    """Edges are no multiples of a tile, and the second pass begins within a tile."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], (1, 2, 3)
    pose[:3, 0] *= np.linalg.det(pose[:3, :3])
    camera = Camera(intrinsics(20, 25, 5, 4), (11, 7), pose, lens)
    view, found = PixelRays.from_camera(camera), np.full((77, 3), np.nan)
    for start, count in ((0, 40), (40, view.count - 40)):
        pixel, bundle = view.make(start, count)
        found[np.array(pixel)] = np.array(bundle.d).T
        np.testing.assert_array_equal(np.array(bundle.o).T, np.float32([(1, 2, 3)]))
    # Both are rounded from float64.
    np.testing.assert_allclose(found.reshape(7, 11, 3), rays(camera, pixel_centres((11, 7)))[1], atol=6e-8)


def test_smallest_view_is_a_tile(variant_rgb: str) -> None:
    """A view of one tile is taken as it is; at half its size it is refused, with the way out."""
    camera = Camera(intrinsics(10, 10, TILE / 2, TILE / 2), (TILE, TILE), np.eye(4))
    photo = Photo("a", np.full((TILE, TILE, 3), 0.5, np.float32), None, None, camera, np.zeros(3, np.float32))
    batch = draw_tiles(RayBatches.from_photos([photo]), 1, np.array([0]), 1, np.random.default_rng(0))
    np.testing.assert_allclose(np.array(batch.target), 0.5, atol=0.5 / 255 + 1e-6)
    with pytest.raises(MivolError, match=f"found a view of {TILE // 2} pixels an edge at 1/2, expected at least {TILE}"):
        RayBatches.from_photos([photo], (1, 2))
