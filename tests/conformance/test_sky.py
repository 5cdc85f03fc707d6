"""A sky is an environment map of Mitsuba, with derivatives by its texels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused

from mivol.fields.sky import Sky


def some(count: int) -> tuple[np.ndarray, mi.Vector3f]:
    d = np.random.default_rng(0).normal(size=(count, 3))
    d[:6] = [[0, 1, 0], [0, -1, 0], [0, 0, -1], [-1e-6, 0, -1], [1e-6, 0, -1], [0, 0, 1]]  # the poles, both sides of the seam
    d = np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    return d, mi.Vector3f(np.ascontiguousarray(d.T))


def test_a_sky_is_an_envmap_of_mitsuba(variant_rgb: str) -> None:
    image = np.float32(np.random.default_rng(1).random((8, 16, 3)))
    light = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image), "scale": 1.0})
    _, d = some(2000)
    si = mi.SurfaceInteraction3f()
    si.wi = -d
    # Bilinear weights move by 1e-7 of an angle times 16 columns, and by acos near the poles: sqrt(1e-7) = 3e-4 of a row.
    # On a GPU an envmap is a texture whose weights have 8 bits: two of them, each known to 1/512.
    by_texture = 0 if variant_rgb.startswith("llvm") else 2 / 512
    seen, expected, inner = np.array(Sky.from_image(image).eval(d)), np.array(light.eval(si)), np.abs(np.array(d.y)) < 0.99
    np.testing.assert_allclose(seen, expected, atol=1e-3 + by_texture)
    np.testing.assert_allclose(seen[:, inner], expected[:, inner], atol=1e-5 + by_texture)


def test_derivatives_of_a_sky(variant_rgb: str) -> None:
    """Radiance is linear in the texels: <by, J way> = <J^T by, way>, to the rounding of 500 terms."""
    rng, (_, d) = np.random.default_rng(2), some(500)
    way = np.float32(rng.normal(size=(5, 10, 3)))
    by = np.float32(rng.normal(size=(3, 500)))
    seen = np.array(Sky.from_image(way).eval(d))
    slopes = Sky.from_image(way).texel_gradient(d, mi.Color3f(by))
    assert np.vdot(by, seen) == pytest.approx(np.vdot(np.array(slopes).reshape(5, 10, 4)[..., :3], way), rel=1e-4)
    assert dr.all(dr.gather(mi.Float, slopes, 3 + 4 * dr.arange(mi.UInt32, 50)) == 0)


def test_a_sky_of_one_row_is_refused(variant_rgb: str) -> None:
    assert_refused("1 rows .* at least 2", Sky.uniform, 1, 0.5)
    assert Sky.uniform(2, 0.5).image().shape == (2, 4, 3)


def test_smoothing_a_sky(variant_rgb: str) -> None:
    """Texels move by a share towards the mean of four neighbours: across the seam, and at a pole to the row beside."""
    image = np.float32(np.random.default_rng(3).random((6, 12, 3)))
    around = np.roll(image, 1, 1) + np.roll(image, -1, 1)
    around += np.concatenate([image[:1], image[:-1]]) + np.concatenate([image[1:], image[-1:]])
    found = Sky.from_image(image).smooth(0.25).image()
    # A few roundings of numbers below 4.
    np.testing.assert_allclose(found, image + 0.25 * (around / 4 - image), atol=1e-6)


def test_corners_of_a_direction_are_texels(variant_rgb: str) -> None:
    """The four texels exist, with weights of at least 0 and sum 1, to two roundings; also at the poles and the seam."""
    for rows in (2, 5):
        _, d = some(400)
        corners = Sky.from_image(np.zeros((rows, 2 * rows, 3), np.float32))._corners(d)
        texels, shares = (np.array([np.array(pair[k], np.float64) for pair in corners]) for k in (0, 1))
        assert texels.shape == (4, 400) and (texels >= 0).all() and (texels < 2 * rows * rows).all()
        assert (shares >= 0).all()
        np.testing.assert_allclose(shares.sum(axis=0), 1, rtol=0, atol=2.0**-22)
        above, below = texels[:2] // (2 * rows), texels[2:] // (2 * rows)
        np.testing.assert_array_equal(below, above + 1)
