"""The ray that a path keeps of those that glass mirrors: its light in closed form, and what its weight may not miss."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_same_mean
from scattering_scenes import mivol

from mivol.scene import plan
from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.lighting.kept_rays import KeptRay, MirroredEmitters
from scenes import ball_of, camera, medium, render

RADIANCE, IOR = 3.0, 1.5


@pytest.fixture(autouse=True)
def keeps_mirrors(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths keep a mirrored ray, whatever a preview says."""
    monkeypatch.setattr(plan, "choose_mirror_rays", lambda *_: (0, True, []))


def reflectance(cosine: float) -> float:
    """Of a thin pane: light is mirrored by its first face, or by the second one after any number of turns inside."""
    inside = math.sqrt(1 - (1 - cosine**2) / IOR**2)
    s = (cosine - IOR * inside) / (cosine + IOR * inside)
    p = (IOR * cosine - inside) / (IOR * cosine + inside)
    face = (s**2 + p**2) / 2
    return face + (1 - face) ** 2 * face / (1 - face**2)


def pane(lamp_bsdf: dict, tilt: float = 60.0) -> tuple[mi.Scene, float]:
    """A pane, tilted against the ray of the camera, mirrors a lamp in its middle; behind it, nothing shines. Fog lies aside.

    Also returns the cosine of the ray on the pane.
    """
    turn = mi.ScalarTransform4f().rotate([0, 0, 1], tilt)
    # A rectangle faces +z: first to the camera at -y, then turned about z.
    facing = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    mirrored = mi.ScalarTransform4f().rotate([0, 0, 1], 2 * tilt)
    lamp = mirrored @ mi.ScalarTransform4f().translate([0, -3, 0]).rotate([1, 0, 0], -90)
    glass = {"type": "thindielectric", "int_ior": IOR, "ext_ior": 1.0}
    parts = {
        "pane": {"type": "rectangle", "to_world": turn @ facing, "bsdf": glass},
        "lamp": {"type": "rectangle", "to_world": lamp, "bsdf": lamp_bsdf, "emitter": {"type": "area", "radiance": RADIANCE}},
        "fog": ball_of(medium("homogeneous", 0.5, 0.8), (0, 0, 6), 0.5),
    }
    sensor = camera([0, -4, 0], [0, 0, 0], 4, fov=0.01)
    return mi.load_dict({"type": "scene", **parts, "sensor": sensor}), math.cos(math.radians(tilt))


def test_every_path_finds_the_lamp_in_a_pane() -> None:
    """By chance, a share R of the samples finds all of the lamp. Rays kept of all paths each find R of it, so 4 samples do."""
    scene, cosine = pane({"type": "diffuse", "reflectance": 0.0})
    image = render(scene, mivol(max_depth=3), spp=4)
    # Angles differ by 1e-4 over the image, and R by less than 10 times this share.
    np.testing.assert_allclose(image, reflectance(cosine) * RADIANCE, rtol=2e-3)


def test_a_recorded_picture_follows_the_lamp() -> None:
    """The lamp leaves the mirror and comes back, between pictures of one recording, which reads where lamps are."""
    scene, cosine = pane({"type": "diffuse", "reflectance": 0.0})
    ours, params = mi.load_dict(mivol(max_depth=3)), mi.traverse(scene)
    key = "lamp.to_world"
    place = mi.Transform4f(params[key])
    for away, light in ((0.0, reflectance(cosine) * RADIANCE), (30.0, 0.0), (0.0, reflectance(cosine) * RADIANCE)):
        params[key] = mi.Transform4f().translate([0, 0, away]) @ place
        params.update()
        np.testing.assert_allclose(np.array(mi.render(scene, integrator=ours, spp=4)), light, rtol=2e-3)


@pytest.mark.statistical
def test_chance_finds_a_lamp_that_lets_light_through() -> None:
    """Kept rays pass it. Of 16 x 4096 paths, a share R finds its radiance: a binomial variance."""
    scene, cosine = pane({"type": "null"})
    share, n = reflectance(cosine), 16 * 4096
    found = float(render(scene, mivol(max_depth=3), spp=4096).mean()) / RADIANCE
    assert_same_mean(Estimate(found, share * (1 - share) / n, n), share, rounding=2e-3 * share, what="a null lamp")


def test_no_ray_that_meets_a_lamp_has_the_weight_0() -> None:
    """Rays from around towards points of lamps, whose texture is dark in half of its pixels; and of an environment."""
    dark = np.zeros((8, 8, 3), np.float32)
    dark[::2] = 2.0
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(dark), "raw": True, "filter_type": "nearest"}
    place = mi.ScalarTransform4f().translate([3, 0, 1]).rotate([0.6, 0.8, 0], 40).scale([0.5, 0.1, 2.0])
    lamps = {
        "box": {"type": "cube", "to_world": place, "emitter": {"type": "area", "radiance": texture}},
        "ball": {"type": "sphere", "center": [-2, 1, 0], "radius": 0.3, "emitter": {"type": "area", "radiance": 1e-3}},
    }
    scene = mi.load_dict({"type": "scene", **lamps})
    guide, n = MirroredEmitters(scene, SceneEmitters(scene)), 20000
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, n)
    for shape in scene.shapes():
        target = shape.sample_position(mi.Float(0), sampler.next_2d()).p
        origin = mi.Point3f(mi.warp.square_to_uniform_sphere(sampler.next_2d())) * (4 * sampler.next_1d())
        ray = mi.Ray3f(origin, dr.normalize(target - origin))
        meets = np.array(scene.ray_intersect(ray).is_valid())
        assert meets.mean() > 0.9
        assert np.all(np.array(dr.max(guide.guess(ray, mi.Bool(True))))[meets] > 0)
    away = mi.Ray3f(mi.Point3f(0, 0, -20), mi.Vector3f(0, 0, -1))
    assert np.all(np.array(guide.guess(away, mi.Bool(True))) == 0)

    sky = mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [1, 2, 3]}}})
    guide = MirroredEmitters(sky, SceneEmitters(sky))
    np.testing.assert_allclose(np.array(guide.guess(away, mi.Bool(True))).ravel(), [1, 2, 3], rtol=1e-6)


def test_an_empty_reservoir_has_no_light() -> None:
    kept = KeptRay.empty(3)
    assert np.all(np.array(kept.light_of_all()) == 0)
    ray = mi.Point3d(0), mi.Point3f(0, 0, 1), dr.zeros(mi.MediumPtr, 3), mi.Spectrum(2.0)
    np.testing.assert_array_equal(np.array(kept.add(ray, mi.Float(5, 0, 5), mi.Float(0.5)).light_of_all())[0], [2, 0, 2])
