"""Initial Gaussians: positions, scales and colours, computed by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from ball_photos import camera

from mivol.errors import MivolError
from mivol.optim.gaussians.gaussian_start import find_start_points, make_start_cloud
from mivol.photos import Photo, project

BOX = np.array([[-0.5, -0.4, -0.3], [0.5, 0.6, 0.7]])


def photo(k: float, seed: int, alpha: bool = True) -> Photo:
    """A view of 40 x 40 pixels of noise, transparent in its left part."""
    image = np.random.default_rng(seed).uniform(0, 1, (40, 40, 3)).astype(np.float32)
    clear = np.ones((40, 40), np.float32)
    clear[:, :18] = 0
    return Photo(f"view {k}", image, clear if alpha else None, None, camera(k, 40), np.ones(3, np.float32))


def photos(views: list[Photo], points: np.ndarray | None = None) -> SimpleNamespace:
    return SimpleNamespace(survey=SimpleNamespace(points=points), box=BOX, views=views)


def seen_pixel(view: Photo, point: np.ndarray) -> tuple[int, int] | None:
    """Row and column of the pixel that shows a point; None for none."""
    (x, y), depth = project(view.camera, point)
    if not depth > 0 or not (0 <= x < 40 and 0 <= y < 40):
        return None
    return int(y), int(x)


def test_reconstruction_points_are_used_unchanged() -> None:
    """Those in the box, whose faces belong to it; fewer than 100 points say nothing."""
    points = np.random.default_rng(1).uniform(-1, 1, (120, 3))
    points[0], points[1] = BOX
    inside = [p for p in points if all(low <= x <= high for low, x, high in zip(BOX[0], p, BOX[1], strict=True))]
    found, says = find_start_points(photos([], points), 7, 3)
    np.testing.assert_array_equal(found, inside)
    assert says == f"{len(inside)} points of the reconstruction in the box"
    for few in (points[:99], None):
        found, says = find_start_points(photos([photo(0.0, 0, alpha=False)], few), 7, 3)
        np.testing.assert_array_equal(found, np.random.default_rng((3, 1)).uniform(*BOX, (7, 3)))
        assert says == "7 random points in the box"
    assert len(find_start_points(photos([], points[:100]), 7, 3)[0]) < 100


def test_random_points_avoid_transparent_pixels() -> None:
    """Points count where half of the views show them, and none shows them where it is transparent."""
    views = [photo(k, k) for k in range(3)]
    # A camera that looks the other way shows nothing of the box and says nothing against it.
    away = camera(1.0, 40)
    turned = away.to_world @ np.diag([-1.0, 1, -1, 1])
    views.append(Photo("away", views[0].image, views[0].alpha, None, type(away)(away.K, away.size, turned), np.ones(3)))
    rng, kept = np.random.default_rng((5, 1)), []
    while len(kept) < 60:
        for point in rng.uniform(*BOX, (60, 3)):
            at = [seen_pixel(view, point) for view in views]
            shown = [(view, pixel) for view, pixel in zip(views, at, strict=True) if pixel]
            if len(shown) >= 2 and all(view.alpha[pixel] > 0 for view, pixel in shown):
                kept.append(point)
    found, says = find_start_points(photos(views), 60, 5)
    np.testing.assert_allclose(found, kept[:60], rtol=1e-14)
    assert says == "60 random points that no view shows as transparent"
    assert len(find_start_points(photos(views[:1] + views[3:]), 20, 5)[0]) == 20
    clear = [Photo("clear", v.image, np.zeros_like(v.alpha), None, v.camera, v.background) for v in views]
    with pytest.raises(MivolError, match="alpha leaves no part of the box"):
        find_start_points(photos(clear), 10, 5)


def test_scale_is_the_distance_of_neighbours() -> None:
    """The root mean square of the three nearest distances; of points that coincide, a thousandth of the median."""
    places = np.random.default_rng(2).uniform(-0.4, 0.4, (30, 3))
    places = np.concatenate([places, np.repeat([[0.45, 0.5, 0.6]], 5, axis=0)])
    far = np.sort(np.linalg.norm(places[:, None] - places, axis=-1), axis=1)[:, 1:4]
    views = [photo(k, k) for k in range(3)]
    made = make_start_cloud(places, views, 2)
    scale = np.maximum(np.sqrt((far**2).mean(axis=1)), 1e-3 * np.median(far))
    np.testing.assert_allclose(made["log_scales"], np.log(scale)[:, None].repeat(3, axis=1), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(made["means"], places.astype(np.float32))
    np.testing.assert_array_equal(made["quaternions"], [[1, 0, 0, 0]] * 35)
    np.testing.assert_allclose(made["opacity_logits"], [math.log(0.1 / 0.9)] * 35, rtol=1e-6)
    # The mean of what the views show there and of one grey: times the constant harmonic, 1 / (2 sqrt(pi)).
    wanted = []
    for place in places:
        shown = [view.image[pixel] for view in views if (pixel := seen_pixel(view, place))]
        wanted.append((0.5 + np.sum(shown, axis=0)) / (1 + len(shown)) if shown else np.full(3, 0.5))
    np.testing.assert_allclose(made["harmonics"][:, 0] / (2 * math.sqrt(math.pi)), np.array(wanted) - 0.5, rtol=0, atol=1e-6)
    assert made["harmonics"].shape == (35, 9, 3) and not made["harmonics"][:, 1:].any()
    assert all(array.dtype == np.float32 for array in made.values())


def test_fewer_than_four_points_are_refused() -> None:
    assert len(make_start_cloud(np.eye(4, 3), [], 0)["means"]) == 4
    with pytest.raises(MivolError, match="found 3 initial points, expected at least 4"):
        make_start_cloud(np.eye(3), [], 0)
