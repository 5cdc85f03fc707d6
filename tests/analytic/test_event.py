"""The end of a segment as an event: a surface, a collision with a medium, or escape."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.lighting.vertex import MediumVertex, MixedVertex
from mivol.transport.estimators.segment import Collision, SegmentEstimate
from mivol.transport.media.body import medium_interaction
from mivol.transport.media.ray_intervals import SegmentEnd
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.event import PathEvent
from mivol.transport.traversal.rays import point_along
from scenes import box_of, camera, media_of, medium

pytestmark = pytest.mark.usefixtures("variant_rgb")


WALL = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def segments(**shapes: dict) -> tuple[SceneMedia, mi.Ray3f, SegmentEnd]:
    """Segments at the wall, beside it, and at it in a lane that has ended before."""
    media = media_of(mi.load_dict({"type": "scene", "sensor": camera([0, -1, 4], [0, 0, 0]), **shapes}))
    ray = mi.Ray3f(mi.Point3f(mi.Float(0, 5, 0), 0, 2), mi.Vector3f(0, 0, -1), dr.inf, mi.Float(0, 0, 0), mi.Color0f())
    si, fog = media.scene.ray_intersect(ray), mi.MediumPtr(mi.load_dict({"type": "homogeneous"}))
    return media, ray, SegmentEnd(si, si.t, fog, 1.0)


def test_a_surface_is_met_where_there_is_one_and_the_lane_goes_on():
    media, _, end = segments(wall=WALL)
    found = PathEvent.from_estimate(SegmentEstimate(end, mi.Spectrum(1), None, None), mi.Bool(True, True, False))
    assert np.array(found.at_surface).tolist() == [True, False, False]
    assert not np.array(found.in_medium).any()
    np.testing.assert_array_equal(np.array(found.t), [2, np.inf, 2])
    vertex = found.vertex(media)
    assert vertex.medium is end.medium and vertex.interaction is end.si and vertex.media is media
    assert np.array(vertex.bsdf == mi.BSDFPtr(media.scene.shapes()[0].bsdf())).tolist() == [True, False, True]


def test_a_collision_comes_before_the_surface():
    """The first lane collides at 0.5; the others go on as before. The vertex is of the medium in that lane alone."""
    media, ray, end = segments(wall=WALL)
    t, on = mi.Float(0.5), mi.Bool(True, False, False)
    mei, place = medium_interaction(ray, t, end.medium), point_along(ray, t)
    hit = Collision(mei, place, mi.Spectrum(0.5), on, mi.Float64(t), mi.UInt32(0))
    found = PathEvent.from_estimate(SegmentEstimate(end, mi.Spectrum(1), None, None, hit), mi.Bool(True, True, True))
    assert np.array(found.at_surface).tolist() == [False, False, True]
    assert np.array(found.in_medium).tolist() == [True, False, False]
    vertex = found.vertex(media)
    assert isinstance(vertex, MixedVertex)
    # The wall is met at z = 0, and the collision is 0.5 in front of the rays' origins.
    assert np.array(vertex.interaction.p.z).tolist()[::2] == [1.5, 0]


def test_where_there_are_no_surfaces_a_collision_has_a_vertex_of_a_medium_alone():
    media, ray, end = segments(cloud=box_of(medium("homogeneous", 1.0, 0.5), np.eye(4)))
    mei, place = medium_interaction(ray, mi.Float(0.5), end.medium), point_along(ray, 0.5)
    hit = Collision(mei, place, mi.Spectrum(0.5), True, mi.Float64(0.5), mi.UInt32(0))
    vertex = PathEvent.from_estimate(SegmentEstimate(end, mi.Spectrum(1), None, None, hit), mi.Bool(True)).vertex(media)
    assert isinstance(vertex, MediumVertex) and vertex.interaction is hit.mei
