"""The alpha of a film: what a camera ray meets, a surface or media, on its way straight ahead."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, over_pixels
from scattering_scenes import cases, fog, mivol, moments, rough_grid, smoke, volpath

from mivol.validate.statistics import Moments
from scenes import ball_of, camera, film, medium, sky

pytestmark = pytest.mark.usefixtures("traced_balls")

RGBA = film(8, 8) | {"pixel_format": "rgba"}


def seen(parts: dict) -> mi.Scene:
    return mi.load_dict({"type": "scene", **parts, "sensor": camera((1.5, -2.5, 1.2), (0, 0, 0), fov=50.0) | {"film": RGBA}})


def mask(opacity: float) -> dict:
    place = mi.ScalarTransform4f().look_at([0.6, -1, 0.5], [1.5, -2.5, 1.2], [0, 0, 1]) @ mi.ScalarTransform4f().scale(0.5)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "mask", "opacity": opacity, "nested": {"type": "diffuse"}}}


BALL = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse"}}
SCENES = {
    "thin": lambda: {"fog": fog(0.2)[0]},
    "thick": lambda: {"fog": fog(5.0)[0]},
    "grid": lambda: {"smoke": smoke(rough_grid(1))[0]},
    "traced": lambda: {"fog": ball_of(medium("homogeneous", 0.8), (0, 0, 0), 1.0)},
    "ball in a grid": lambda: {"smoke": smoke(rough_grid(1))[0], "ball": BALL},
    "mask": lambda: {"smoke": smoke(rough_grid(1))[0], "ball": BALL, "mask": mask(0.6)},
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", cases(SCENES, ["thick", "grid", "ball in a grid"]))
def test_alpha_is_what_volpath_draws(name):
    """Welch's t, 8 batches each; emitters are hidden, so that the sky does not count."""
    scene = seen(SCENES[name]() | {"sky": sky(0.5)})
    ours = moments(scene, mivol(hide_emitters=True), 64, 8)
    stock = moments(scene, volpath(hide_emitters=True), 256, 8, first=500)
    a, b = alpha_of(ours), alpha_of(stock)
    # Rays of volpath enter 1e-4 behind a boundary; sums of 256 float32 ones and zeros.
    assert_same_mean(a, b, tile=4, rounding=1e-3, what="tiles")
    a, b = over_pixels(a), over_pixels(b)
    assert_same_mean(a, b, rounding=1e-3, what="whole images")
    assert_precise(b, 0.01, what="whole images")
    assert 0.05 < a.mean[0] < 0.999


def alpha_of(image: Moments) -> Moments:
    return Moments(image.n, image.mean[..., 3:4], image.m2[..., 3:4])


def test_alpha_is_the_opacity_at_any_depth():
    """At depth 1 too, where volpath finds no point in a medium: 1 - exp(-tau), the mean of the channels, without noise."""
    grey, rgb = fog(0.5)[0], {"type": "rgb", "value": [0.2, 1.0, 4.0]}
    colourful = grey | {"interior": medium("mivol_medium", rgb)}
    for parts in ({"fog": grey}, {"fog": colourful}, {"fog": grey, "ball": BALL}):
        scene = seen(parts)
        for depth in (1, 2):
            image = np.array(mi.render(scene, integrator=mi.load_dict(mivol(max_depth=depth, aovs="alpha")), spp=16))
            np.testing.assert_allclose(image[..., 3], image[..., 4], atol=1e-6)
            assert image[..., 3].max() > 0.5


@pytest.mark.statistical
def test_nested_integrators_draw_it():
    scene = seen(SCENES["thin"]() | {"sky": sky(0.5)})
    alone = moments(scene, mivol(hide_emitters=True), 64)
    nested = moments(scene, {"type": "moment", "inner": mivol(hide_emitters=True)}, 64, first=500)
    a, b = over_pixels(alpha_of(alone)), over_pixels(alpha_of(nested))
    assert_same_mean(a, b, rounding=1e-6, what="whole images")
    assert_precise(b, 0.01, what="whole images")
