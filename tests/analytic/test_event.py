"""The end of a segment as an event: a surface, or escape."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.ray_intervals import SegmentEnd
from mivol.transport.path.event import PathEvent
from scenes import camera, media_of

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_a_surface_is_met_where_there_is_one_and_the_lane_goes_on():
    """Rays at the wall, beside it, and at it in a lane that has ended before."""
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    media = media_of(mi.load_dict({"type": "scene", "wall": wall, "sensor": camera([0, -1, 4], [0, 0, 0])}))
    ray = mi.Ray3f(mi.Point3f(mi.Float(0, 5, 0), 0, 2), mi.Vector3f(0, 0, -1), dr.inf, mi.Float(0, 0, 0), mi.Color0f())
    si, fog = media.scene.ray_intersect(ray), mi.MediumPtr(mi.load_dict({"type": "homogeneous"}))
    found = PathEvent.of(SegmentEnd(si, si.t, fog, 1.0), mi.Bool(True, True, False))
    assert np.array(found.at_surface).tolist() == [True, False, False]
    np.testing.assert_array_equal(np.array(found.t), [2, np.inf, 2])
    vertex = found.vertex(media, ray)
    assert vertex.medium is fog and vertex.interaction is si and vertex.media is media
    assert np.array(vertex.bsdf == mi.BSDFPtr(media.scene.shapes()[0].bsdf())).tolist() == [True, False, True]
