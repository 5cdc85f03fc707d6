"""Channels of extinction: conversions of values and of derivatives are transposes of each other."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.channels import colours_to_channels, to_part_channels, to_scene_channels

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.parametrize(("part", "scene"), [(1, 1), (1, 3), (3, 3), (3, 1)])
def test_rows_and_derivatives_are_transposes(part, scene):
    """<rows of v, w> = <v, derivatives of w>; the sums have at most six products, each below 1."""
    rng = np.random.default_rng(part * 10 + scene)
    v, w = rng.uniform(0, 1, (part, 20)), rng.uniform(0, 1, (scene, 20))
    rows = to_scene_channels([mi.Float(x) for x in v], scene)
    derivatives = to_part_channels([mi.Float(x) for x in w], part)
    assert (len(rows), len(derivatives)) == (scene, part)
    left = sum(np.array(r, dtype=np.float64) * x for r, x in zip(rows, w, strict=True))
    right = sum(x * np.array(d, dtype=np.float64) for x, d in zip(v, derivatives, strict=True))
    np.testing.assert_allclose(left, right, atol=6 * 4 * 2.0**-24)


def test_grey_is_the_luminance():
    """White stays 1; the weights of ITU-R BT.709 have six digits and sum to 1 + 4.1e-8."""
    (white,) = to_scene_channels([mi.Float(1)] * 3, 1)
    (green,) = to_scene_channels([mi.Float(0), mi.Float(1), mi.Float(0)], 1)
    assert white[0] == pytest.approx(1, abs=1e-6) and green[0] == pytest.approx(0.71516, rel=1e-6)


def test_a_grey_extinction_gets_the_sum_of_colours():
    assert [x[0] for x in colours_to_channels(mi.Color3f(1, 2, 4), 1)] == [7]
    assert [x[0] for x in colours_to_channels(mi.Color3f(1, 2, 4), 3)] == [1, 2, 4]
