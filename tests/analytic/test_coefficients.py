"""Points at which Mitsuba's volumes are evaluated, and the albedo there."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.body import Body
from mivol.transport.media.coefficients import eval_albedo, medium_interaction
from mivol.transport.media.constant_extinction import ConstantExtinction
from mivol.transport.media.medium_view import MediumView
from scenes import as_float32, grid_volume

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_a_far_point_is_rounded_once():
    """The sum is made in float64, where that in float32 would be 16 ulps off: 1e4 in front of a camera that is 1e4 away."""
    rng = np.random.default_rng(2)
    d = as_float32(rng.normal(size=(3, 64)))
    d = as_float32(d / np.linalg.norm(d, axis=0))
    t = 1e4 + rng.uniform(size=64)
    o = as_float32(-1e4 * d)
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d), 0.25, mi.Color0f())
    mei = medium_interaction(ray, mi.Float64(t))
    np.testing.assert_array_equal(np.array(mei.p), (o + t * d).astype(np.float32))
    np.testing.assert_array_equal(np.array(mei.wi), -d.astype(np.float32))
    assert np.array(mei.t).tolist() == t.astype(np.float32).tolist() and mei.time[0] == 0.25
    np.testing.assert_allclose(np.array(mei.sh_frame.n), -d, atol=2.0**-23)


def test_the_medium_is_the_one_that_is_named():
    ray, fog = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)), mi.load_dict({"type": "homogeneous"})
    named, bare = medium_interaction(ray, mi.Float(1), fog), medium_interaction(ray, mi.Float(1))
    assert named.medium == mi.MediumPtr(fog) and bare.medium == None


def test_albedo_of_a_grid_and_of_a_number():
    volume = mi.load_dict(grid_volume("mivol_voxels", np.arange(8.0).reshape(2, 2, 2) / 8))
    ray = mi.Ray3f(mi.Point3f(0.5, 0.25, 0.25), mi.Vector3f(0, 0, 1))
    for albedo, expected in ((volume, 2.5 / 8), (mi.Color3f(0.25, 0.5, 1), [0.25, 0.5, 1]), (mi.Float(0.75), 0.75)):
        view = MediumView(None, [ConstantExtinction("sigma_t", mi.Float(1))], mi.Float(1), albedo=albedo)
        found = eval_albedo(Body(view, None), medium_interaction(ray, mi.Float(0.25)), mi.Bool(True))
        # Float32 weights of eight corners.
        np.testing.assert_allclose(np.array(found).ravel(), np.broadcast_to(expected, 3), rtol=4 * 2.0**-23)
