"""Gaussians with their colours through cameras that see far more than half of all directions, and through glass.

The truth is the float64 twin along rays that are computed here: of the lens, and by Snell's law behind glass.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
import wide_cameras
from gaussian_scenes import SIDE, camera_rays, render
from scipy.special import logit

from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, HARMONICS
from mivol.points.gaussians import Gaussians

ROUNDING = 1e-4
"""Of light, relative to colours of at most 2 (test_gaussian_radiance.py)."""

BALL, GLASS = 2.4, 1.5
"""Radius of a ball of glass around the cloud, which ends 1.8 from its middle at most, and its index of refraction."""

EYE = np.array([0.4, 0.3, 5.0])


def cloud(count: int, around: float = 0.5, seed: int = 0) -> Gaussians:
    """Long and flat ones, nearly opaque ones among them, in a cube."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.uniform(-around, around, (count, 3)),
        log_scales=np.log(rng.uniform(0.08, 0.3, (count, 3))),
        quaternions=rng.normal(size=(count, 4)),
        opacity_logits=logit(rng.uniform(0.2, 0.95, count)),
        harmonics=0.6 * rng.normal(size=(count, 9, 3)),
    )


def scene(gaussians: Gaussians, boundary: dict, sensor: dict) -> mi.Scene:
    """The cloud in a boundary, before a camera of one sample a pixel in a box."""
    tensors = {name: mi.TensorXf(getattr(gaussians, name)) for name in (*EXTINCTION_PARAMETERS, HARMONICS)}
    medium = {"type": "mivol_medium", "emission": {"type": "mivol_gaussians", **tensors}}
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    sensor = {**sensor, "film": film, "sampler": {"type": "independent"}}
    return mi.load_dict({"type": "scene", "cloud": {**boundary, "interior": medium}, "sensor": sensor})


def light_along(gaussians: Gaussians, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """(rays, 3) of the twin, without an end."""
    span = np.zeros(len(o)), np.full(len(o), np.inf)
    colour = oracle.colours(gaussians.harmonics.astype(np.float64), d, "srgb")
    return oracle.composite(oracle.Cloud.of(gaussians), colour, (o, d), span)[0]


@pytest.mark.parametrize("kind", [wide_cameras.FISHEYE, wide_cameras.PANORAMA])
def test_cameras_of_any_lens_see_them(kind: str) -> None:
    """From the middle of a cloud that stands all around, turned and moved; rays are those of the formula in float64.

    Directions in float32 are known to a few 2^-24: 3e-7, times 3 / 0.08 of the farthest and thinnest Gaussian, 1e-5."""
    wide_cameras.register()
    gaussians = cloud(60, around=1.5)
    place = mi.ScalarTransform4f().translate([0.1, -0.2, 0.15]).rotate([0.6, 0, 0.8], 40)
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(3.0), "bsdf": {"type": "null"}}
    found = scene(gaussians, box, {"type": kind, "to_world": place})
    matrix = np.array(place.matrix, np.float64)
    o, d = camera_rays(found, 5)
    light = light_along(gaussians, o, d)
    behind = d @ matrix[:3, 2] < 0
    assert light.max() > 0.3 and light[behind].max() > 0.3
    np.testing.assert_allclose(render(found, seed=5).reshape(-1, 3), light, rtol=2 * ROUNDING, atol=2 * ROUNDING)


def test_they_are_seen_in_a_ball_of_glass() -> None:
    """A ray is reflected, into the dark, or refracted, after which it meets the cloud. Radiance in glass is larger than what
    leaves it towards the camera by the square of its index, with which directions are concentrated there. So each pixel of one
    sample shows one of two values, and how many are reflected is a sum of Fresnel's probabilities, to five standard deviations.

    A point on the ball is rounded by 2.4 x 2^-24, its normal and with it the direction by a few times as much: 1e-6, times
    2.4 / 0.08 of the thinnest Gaussian, 3e-5."""
    gaussians = cloud(40)
    ball = {"type": "sphere", "radius": BALL, "bsdf": {"type": "dielectric", "int_ior": GLASS, "ext_ior": 1.0}}
    target = mi.ScalarTransform4f().look_at(EYE.tolist(), [0, 0, 0], [0, 1, 0])
    found = scene(gaussians, ball, {"type": "perspective", "fov": 25.0, "to_world": target})
    o, d = camera_rays(found, 4)
    middle = -(o * d).sum(axis=1)
    enters = middle - np.sqrt(middle**2 + BALL**2 - (o * o).sum(axis=1))
    p = o + enters[:, None] * d
    normal = p / BALL
    cos = -(d * normal).sum(axis=1)
    inner = np.sqrt(1 - (1 - cos**2) / GLASS**2)
    refracted = d / GLASS + (cos / GLASS - inner)[:, None] * normal
    light = light_along(gaussians, p, refracted) / GLASS**2
    across, along = (cos - GLASS * inner) / (cos + GLASS * inner), (GLASS * cos - inner) / (GLASS * cos + inner)
    reflects = (across**2 + along**2) / 2
    seen = render(found, depth=2, seed=4).reshape(-1, 3)
    was_reflected = (seen == 0).all(axis=1)
    assert light.max() > 0.2
    expected = np.where(was_reflected[:, None], 0, light)
    np.testing.assert_allclose(seen, expected, rtol=2 * ROUNDING, atol=2 * ROUNDING)
    bright = light.max(axis=1) > 1e-3
    deviation = np.sqrt((reflects * (1 - reflects))[bright].sum())
    assert abs(was_reflected[bright].sum() - reflects[bright].sum()) < 5 * deviation
