"""Trilinear interpolation, its weights, and the outer half voxel."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.interpolation import interpolate, upward_frac, weights

pytestmark = pytest.mark.usefixtures("variant_rgb")

BITS = np.array([[q & 1, q >> 1 & 1, q >> 2] for q in range(8)])
ROUNDING = 2.0**-24


def points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(7).uniform(0, 1, (3, n)).astype(np.float32)


def test_a_trilinear_function_is_its_interpolant():
    """1 + 2 x + 3 y + 5 z + 7 x y z of the corners' bits; each of seven steps rounds by at most half an ulp of 18."""
    p = points()
    x, y, z = BITS.T
    corners = 1.0 + 2 * x + 3 * y + 5 * z + 7 * x * y * z
    found = np.array(interpolate([mi.Float(float(c)) for c in corners], mi.Vector3f(*p)), dtype=np.float64)
    x, y, z = p.astype(np.float64)
    np.testing.assert_allclose(found, 1 + 2 * x + 3 * y + 5 * z + 7 * x * y * z, atol=14 * 18 * ROUNDING)


def test_weights_are_the_transpose():
    """Products of three factors x or 1 - x: at most five roundings each."""
    p = points()
    exact = np.prod(np.where(BITS[:, :, None] == 1, p.astype(np.float64), 1 - p.astype(np.float64)), axis=1)
    for found, weight in zip(weights(mi.Vector3f(*p)), exact, strict=True):
        np.testing.assert_allclose(np.array(found), weight, rtol=5 * ROUNDING)


def test_the_outer_half_voxel_has_one_node():
    """A grid of (Z, Y, X) = (4, 3, 2): all weight is on the upper node before the first, on the lower from the last on."""
    lower = mi.Vector3i(mi.Int32(-1, 0, 1), mi.Int32(-1, 1, 2), mi.Int32(-1, 2, 3))
    found = np.array(upward_frac(mi.Vector3f(0.25), lower, (4, 3, 2)))
    np.testing.assert_array_equal(found, [[1, 0.25, 0]] * 3)
