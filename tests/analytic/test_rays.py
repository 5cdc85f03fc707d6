"""Rays with an origin in float64, and camera rays clipped at both planes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import assert_same_images, fog, mivol, point, smoke

from mivol.transport.traversal.rays import FineRay, point_along, to_mitsuba_ray
from scenes import ball_of, camera, medium, sky

pytestmark = pytest.mark.usefixtures("traced_balls")

PLACE = np.array([100.0 + 1e-9, -8.0 + 1e-10, 1e-12])
"""Its distance from the nearest float32 numbers is far below their steps there."""


def ray_from(place: np.ndarray) -> FineRay:
    it = dr.zeros(mi.MediumInteraction3f)
    it.time = 0.25
    return FineRay.from_point(mi.Point3d(*place.tolist()), mi.Vector3f(0, 0.6, 0.8), it, mi.Float(3))


def numbers(p: object) -> np.ndarray:
    return np.array(p, dtype=np.float64)[:, 0]


def test_an_origin_keeps_its_digits():
    ray = ray_from(PLACE)
    assert (numbers(ray.o) == PLACE).all()
    assert (numbers(FineRay.from_ray(ray).o) == PLACE).all()
    assert float(ray.time[0]) == 0.25
    assert float(ray.maxt[0]) == 3


def test_points_are_found_in_float64_and_rounded_once():
    """Origin and step are each less than half a float32 step at 100; their sum is more."""
    t, d, place = 5e-6, np.float32([0, 0.6, 0.8]).astype(np.float64), np.array([1.0, 100 + 3e-6, 100 + 3e-6])
    there = place + t * d
    # A fused product and sum is rounded once, numpy's twice: one step of float64 apart at most.
    assert np.abs(numbers(point_along(ray_from(place), mi.Float64(t))) - there).max() <= np.spacing(100.0)
    assert (numbers(ray_from(place)(mi.Float64(t))) == there.astype(np.float32)).all()
    assert (there.astype(np.float32)[1:] > 100).all()


def test_mitsuba_traces_from_the_nearest_point():
    found = to_mitsuba_ray(ray_from(PLACE))
    assert isinstance(found, mi.Ray3f)
    assert (numbers(found.o) == PLACE.astype(np.float32)).all()
    assert float(found.maxt[0]) == 3


def test_a_ray_of_mitsuba_becomes_one_without_change():
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 0.3), mi.Vector3f(0, 0, 1), 2.0, 0.5, mi.Color0f())
    found = FineRay.from_ray(ray)
    assert (numbers(found.o) == np.float32([0.1, 0.2, 0.3])).all()
    assert float(found.maxt[0]) == 2
    assert float(found.time[0]) == 0.5


SIGMA = 0.7
FOG = {
    "box": lambda: fog(SIGMA)[0],
    "traced": lambda: ball_of(medium("homogeneous", SIGMA), (0, 0, 0), 1.0),
    "grid": lambda: smoke(np.full((3, 4, 5, 1), SIGMA))[0],
}
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}


def look_down(parts: dict, near: float, far: float) -> mi.Scene:
    """An orthographic camera, 0.002 wide, 4 above the origin."""
    turn = mi.ScalarTransform4f()
    place = turn.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]) @ turn.scale([1e-3, 1e-3, 1])
    sensor = camera((0, 0, 4), (0, 0, 0), res=4) | {"type": "orthographic", "to_world": place}
    del sensor["fov"]
    return mi.load_dict({"type": "scene", **parts, "sky": sky(), "sensor": sensor | {"near_clip": near, "far_clip": far}})


@pytest.mark.filterwarnings("ignore:the media begin 3 from the camera:RuntimeWarning")
@pytest.mark.slow_for("grid", "traced")
@pytest.mark.parametrize("kind", FOG)
def test_fog_is_cut_at_both_planes(kind):
    """The planes lie 3 and 5 in front of the camera."""
    for near, far, seen in ((0.01, 1e4, 2.0), (3.5, 1e4, 1.5), (0.01, 4.5, 1.5), (3.5, 4.75, 1.25), (0.01, 2.0, 0.0)):
        scene = look_down({"fog": FOG[kind]()}, near, far)
        image = np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=1, aovs="tau")), spp=4))
        # Chords of the ball are 2e-6 shorter, places of planes are rounded 4 times to float32, in numbers below 8.
        np.testing.assert_allclose(image[..., 3], SIGMA * seen, atol=5e-6)
        np.testing.assert_allclose(image[..., 0], np.exp(-SIGMA * seen), rtol=5e-6)


def test_what_a_mask_transmits_ends_at_the_same_plane():
    """A black mask at 2, an emitter at 4.5: the sky of 1 fills the image in front of the emitter, even through the mask."""
    turn = mi.ScalarTransform4f()
    mask = {"type": "mask", "opacity": 0.6, "nested": {"type": "diffuse", "reflectance": 0.0}}
    masked = {"type": "rectangle", "to_world": turn.translate([0, 0, 2]), "bsdf": mask}
    emitter = {"type": "rectangle", "to_world": turn.translate([0, 0, -0.5]), "emitter": {"type": "area", "radiance": 5.0}}
    for far, top in ((4.4, 1.0), (4.6, 5.0)):
        scene = look_down({"mask": masked, "emitter": emitter}, 0.01, far)
        # 16 pixels of one sample: all pass, or none, with a chance of 0.6^16 = 3e-4 for this seed.
        image = np.array(mi.render(scene, integrator=mi.load_dict(mivol()), spp=1, seed=1))
        assert np.unique(image).tolist() == [0.0, top]


@pytest.mark.slow
@pytest.mark.statistical
def test_the_same_picture_as_volpath():
    """Scattering fog around the camera, a ball in front of the far plane and a ball behind it; light comes from beyond.

    (Behind a boundary volpath forgets the plane: a ray spawned there has no end. In a medium with has_spectral_extinction
    volpath loses the rays meeting the plane.)
    """
    ref = {"type": "ref", "id": "haze"}
    balls = {"near": (0.1, 0.1, 2.3), "far": (-0.3, 0.1, 0.5)}
    parts = {
        "haze": medium("homogeneous", 0.4, 0.8, has_spectral_extinction=False) | {"id": "haze"},
        "room": ball_of(ref, (0, 0, 0), 4.0),
        **{k: {"type": "sphere", "center": list(c), "radius": 0.25, "bsdf": RED} for k, c in balls.items()},
        "bulb": point([0.5, 1.0, -0.5], 6.0)[0],
        "sky": sky(0.3),
    }
    sensor = camera((0, 0, 3.0), (0, 0, 0), res=16, fov=30.0) | {"medium": ref, "near_clip": 0.1, "far_clip": 1.6}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": sensor})
    assert_same_images(scene, rounding=1e-4)
    open_end = mi.load_dict({"type": "scene", **parts, "sensor": sensor | {"far_clip": 100.0}})
    cut, whole = (np.array(mi.render(s, integrator=mi.load_dict(mivol()), spp=16)).mean() for s in (scene, open_end))
    assert abs(cut - whole) > 0.1 * whole
