"""Reciprocity: a camera at infinity and a directional emitter may change places (Chandrasekhar 1960, section 52)."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from scattering_scenes import rough_grid, smoke

import scenes
from mivol.validate.statistics import Estimate, Moments

ALONG, SHONE = [0.2, 1.0, -0.3], [0.9, -0.1, -0.6]
"""Where the camera looks, and where the light travels."""


def swapped(shape: dict, looks: list[float], travels: list[float], depth: int) -> Estimate:
    """Mean radiance that a camera at infinity sees of a shape under a directional emitter of irradiance 1."""
    d = np.array(looks) / np.linalg.norm(looks)
    # A square of 4 x 4 around the origin holds the shape from every side.
    place = mi.ScalarTransform4f().look_at(origin=(-5 * d).tolist(), target=[0, 0, 0], up=[0.1, 0.2, 0.9]).scale(2)
    sensor = {"type": "orthographic", "to_world": place, "film": scenes.film(8, 8), "sampler": {"type": "independent"}}
    sun = {"type": "directional", "direction": travels, "irradiance": 1.0}
    scene = mi.load_dict({"type": "scene", "shape": shape, "sun": sun, "sensor": sensor})
    integrator = mi.load_dict({"type": "mivol", "max_depth": depth})
    means = [scenes.render(scene, integrator, 512, seed=fresh(k)).mean(dtype=np.float64) for k in range(16)]
    return Estimate.from_result(Moments.from_values(np.array(means)[:, None]))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("depth", [2, -1])
def test_camera_and_emitter_change_places(variant_rgb: str, depth: int) -> None:
    """In a grid that is dense towards the emitter and thin towards the camera, with a peaked phase function."""
    ramp = (np.arange(6)[::-1] / 5) ** 3
    fog = smoke(rough_grid(3, 30.0) * ramp[None, None, :, None], 0.95, name="hg", g=0.6)[0]
    there, back = swapped(fog, ALONG, SHONE, depth), swapped(fog, SHONE, ALONG, depth)
    assert_same_mean(there, back, rounding=1e-5 * back.mean, what="radiance")
    assert_precise(difference(there, back), 0.02 * back.mean, what="radiance")
