"""mivol inside ``moment`` and ``aov``: stock integrators that nest others show what it shows alone."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, difference, fresh, over_pixels
from scattering_scenes import close_up, mivol, moments, rough_grid, smoke

from mivol.validate.statistics import Moments
from scenes import ball_of, medium, pencil, sky

XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
"""From linear sRGB, as ``moment`` converts what it squares (ITU-R BT.709 primaries, to 6 digits)."""

KEY = "smoke.interior_medium.sigma_t.data"


def surfaces_in_smoke() -> mi.Scene:
    """Smoke of 120 voxels around a red ball, over a floor, under a coloured sky."""
    box, _ = smoke(rough_grid(1), albedo=0.8)
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
    place = mi.ScalarTransform4f().translate([0, 0, -1.1]).scale(2.5)
    light = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.8, 1.0]}}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": red}
    return close_up({"smoke": box, "ball": ball, "floor": {"type": "rectangle", "to_world": place}, "sky": light})


@pytest.mark.slow
@pytest.mark.statistical
def test_moment_has_the_same_mean_and_the_right_second_moment():
    """Welch's t of 8 batches each; the squares come from renders of one sample a pixel, 48 of them in 16 batches."""
    scene = surfaces_in_smoke()
    nested = moments(scene, {"type": "moment", "inner": mivol()}, 32, 8, first=500)
    alone = moments(scene, mivol(), 32, 8)
    assert nested.mean.shape == (16, 16, 9)
    mean = nested.mean[..., :3]
    assert_same_mean(Estimate(mean, nested.variance_of_mean[..., :3], 7), alone, tile=4, what="tiles")
    np.testing.assert_allclose(nested.mean[..., 3:6], mean @ XYZ.T, rtol=1e-5)  # 6 digits of the matrix

    integrator = mi.load_dict(mivol())
    single = np.stack([np.array(mi.render(scene, integrator=integrator, spp=1, seed=fresh(1000 + s))) for s in range(48)])
    squares = ((single @ XYZ.T) ** 2).mean(axis=(1, 2)).reshape(16, 3, 3).mean(axis=1)
    # The batches of ``moment`` share no random numbers, and neither do pixels of one.
    whole, truth = over_pixels(Moments(nested.n, nested.mean[..., 6:], nested.m2[..., 6:])), Moments.from_values(squares)
    assert_same_mean(whole, truth, what="second moments")
    assert_precise(difference(whole, truth), 0.015 * truth.mean, what="second moments")
    # It is not the square of the mean, by more than 3 of the 1.5 % above.
    assert np.all(truth.mean > 1.05 * (alone.mean @ XYZ.T).mean(axis=(0, 1)) ** 2)


def test_moment_of_light_through_media_alone_is_exact():
    """One ray through absorbing smoke has one radiance: the first moment is that of mivol alone, the second its square."""
    box, _ = smoke(rough_grid(2))
    scene = mi.load_dict({"type": "scene", "smoke": box, "sky": sky(0.7), "ray": pencil((-3, 0.2, 0.1), (1, 0, 0))})
    alone = np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=1)), spp=4))
    inner = mivol(max_depth=1, aovs="tau")
    # R, G, B, tau, X, Y, Z and the squares of the last four
    nested = np.array(mi.render(scene, integrator=mi.load_dict({"type": "moment", "inner": inner}), spp=4))[0, 0]
    np.testing.assert_allclose(nested[:3], alone[0, 0], rtol=1e-6)
    assert np.exp(-nested[3]) * 0.7 == pytest.approx(alone[0, 0, 0], rel=1e-5) and nested[3] > 0.1
    np.testing.assert_allclose(nested[7:], nested[3:7] ** 2, rtol=1e-5)


@pytest.mark.slow
def test_aov_shows_the_same_and_has_the_same_derivatives():
    scene = surfaces_in_smoke()
    params, inner = mi.traverse(scene), mivol()
    found = {}
    for name, integrator in {"alone": inner, "nested": {"type": "aov", "aovs": "dist:depth", "inner": inner}}.items():
        dr.enable_grad(params[KEY])
        dr.set_grad(params[KEY], 0)
        params.update()
        image = mi.render(scene, params, integrator=mi.load_dict(integrator), spp=16)
        dr.backward(dr.mean(image[..., :3], axis=None))
        found[name] = np.array(dr.detach(image)), np.array(dr.grad(params[KEY]))
    # Two threads add to one pixel and one voxel in either order: float32 eps times the 16 or 1e4 terms.
    np.testing.assert_allclose(found["nested"][0][..., :3], found["alone"][0], rtol=1e-5)
    np.testing.assert_allclose(found["nested"][1], found["alone"][1], rtol=1e-3, atol=1e-5 * np.abs(found["alone"][1]).max())
    assert found["nested"][0].shape[2] == 4 and found["nested"][0][8, 8, 3] > 1


@pytest.mark.parametrize("names", [False, True])
def test_a_nested_camera_may_be_where_the_first_sensor_is_not(names):
    """``moment`` does not tell which sensor it renders: in ink, looking at an emitter in it; outside, looking away from it."""
    ref = {"type": "ref", "id": "ink"}
    parts = {
        "ink": medium("homogeneous", 0.8) | {"id": "ink"},
        "ball": ball_of(ref, (0, 0, 0), 1.0),
        "emitter": {"type": "sphere", "center": [-0.5, 0, 0], "radius": 0.2, "emitter": {"type": "area", "radiance": 2.0}},
        "sky": sky(1.0),
    }
    inside = pencil((0.5, 0, 0), (-1, 0, 0)) | ({"medium": ref} if names else {})
    away = pencil((3, 0, 0), (1, 0, 0))
    integrator = mi.load_dict({"type": "moment", "inner": mivol(max_depth=1)})
    # The ray in the ink is 0.8 long, but for the 9e-5 that a radiancemeter's rays start ahead: 7.2e-5 of optical depth.
    for sensors, truth in (((away, inside), (1, 2 * np.exp(-0.64))), ((inside, away), (2 * np.exp(-0.64), 1))):
        scene = mi.load_dict({"type": "scene", **parts, **{f"sensor{k}": s for k, s in enumerate(sensors)}})
        seen = [float(np.array(mi.render(scene, integrator=integrator, sensor=k, spp=1))[0, 0, 0]) for k in (0, 1)]
        np.testing.assert_allclose(seen, truth, rtol=1e-4)
