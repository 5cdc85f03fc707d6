"""Vertices: a diffuse surface with smoke on one side, and a point of smoke."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.lighting.vertex import MediumVertex, SurfaceVertex
from mivol.transport.media.body import medium_interaction
from mivol.transport.media.scene_media import SceneMedia
from scenes import camera, media_of, medium

ROUNDING = 4 * 2.0**-23


@pytest.fixture
def media(variant_rgb: str) -> SceneMedia:
    """A wall in the plane z = 0, with smoke behind it (z < 0)."""
    smoke = medium("homogeneous", 1.0, 0.5, phase={"type": "hg", "g": 0.5})
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.5}, "interior": smoke}
    return media_of(mi.load_dict({"type": "scene", "wall": wall, "sensor": camera([0, -1, 4], [0, 0, 0])}))


def on_the_wall(media: SceneMedia) -> SurfaceVertex:
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 2), mi.Vector3f(0, 0, -1))
    si = media.scene.ray_intersect(ray)
    return SurfaceVertex(media, si, si.bsdf(ray), mi.MediumPtr(None))


def test_a_diffuse_wall_reflects_by_the_cosine(media):
    """reflectance / pi times the cosine, and the density of directions by the cosine."""
    vertex, d = on_the_wall(media), mi.Vector3f(0.6, 0, 0.8)
    value, pdf = vertex.eval_and_pdf(d, mi.Bool(True))
    np.testing.assert_allclose(np.array(value).ravel(), [0.4 / np.pi] * 3, rtol=ROUNDING)
    assert pdf[0] == pytest.approx(0.8 / np.pi, rel=ROUNDING)


def test_a_ray_starts_in_the_medium_of_its_side(media):
    """Smoke lies behind the wall; the origin of the ray lies slightly on this side."""
    vertex = on_the_wall(media)
    front, above = vertex.leave(mi.Point3f(1, 0, 3))
    back, below = vertex.leave(mi.Point3f(1, 0, -3))
    assert 0 < front.z[0] < 1e-3 and -1e-3 < back.z[0] < 0
    smoke = media.scene.shapes()[0].interior_medium()
    assert below == mi.MediumPtr(smoke) and above == None


def test_a_wall_that_bounds_nothing_keeps_the_medium_of_the_ray():
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle"}, "sensor": camera([0, -1, 4], [0, 0, 0])})
    vertex, smoke = on_the_wall(media_of(scene)), mi.load_dict({"type": "homogeneous"})
    vertex.medium = mi.MediumPtr(smoke)
    assert vertex.leave(mi.Point3f(0, 0, 3))[1] == mi.MediumPtr(smoke)


def test_a_point_of_smoke_scatters_by_its_phase_function(media):
    """Henyey-Greenstein of g = 0.5 at scattering angles of 0 and 90 degrees; the ray starts in the medium, at the point."""
    smoke = media.scene.shapes()[0].interior_medium()
    mei = medium_interaction(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, -1)), mi.Float(2), smoke)
    vertex = MediumVertex(media, mei, mi.Point3d(mei.p))
    for d, expected in ((mi.Vector3f(0, 0, -1), 0.75 / 0.5**3), (mi.Vector3f(1, 0, 0), 0.75 / 1.25**1.5)):
        for value in vertex.eval_and_pdf(d, mi.Bool(True)):
            np.testing.assert_allclose(np.array(value).ravel(), expected / (4 * np.pi), rtol=2 * ROUNDING)
    start, around = vertex.leave(mi.Point3f(5))
    assert np.array(start).ravel().tolist() == [0, 0, -2] and around == mi.MediumPtr(smoke)
