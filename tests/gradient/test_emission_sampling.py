"""Derivatives of sampled light of emitting media, at scattering events."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from media_light_scenes import drawn, met, seen
from scattering_gradients import along, assert_each_transposed

FIRE = "fire.interior_medium."
KEYS = {
    ("over a floor", "sigma_t"): FIRE + "sigma_t.data",
    ("over a floor", "emission"): FIRE + "emission.data",
    ("over a floor", "floor"): "floor.bsdf.reflectance.value",
    ("in fog", "sigma_t"): FIRE + "sigma_t.data",
    ("in fog", "emission"): FIRE + "emission.data",
    ("in fog", "albedo of the fog"): "haze.albedo.value.value",
    ("in fog", "extinction of the fog"): "haze.sigma_t.value.value",
    ("by itself", "sigma_t"): FIRE + "sigma_t.data",
    ("by itself", "albedo"): FIRE + "albedo.data",
    ("by itself", "emission_density"): FIRE + "emission_density.data",
    ("by itself", "g"): FIRE + "phase_function.g",
    ("radiance field", "density"): FIRE + "emission.density",
    ("radiance field", "colour"): FIRE + "emission.sh",
    ("balls", "emission"): FIRE + "emission.value.value",
}
QUICK = ("over a floor", "sigma_t")


def _step(scene: mi.Scene, key: str) -> np.ndarray | float:
    """A direction with entries of one sign."""
    shape = np.shape(mi.traverse(scene)[key])
    return np.random.default_rng(2).uniform(0.5, 1.5, shape) if np.prod(shape) > 3 else 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", dict.fromkeys(name for name, _ in KEYS))
def test_forward_is_the_transpose_of_reverse(name: str, whole_paths: None) -> None:
    keys = [key for (place, _), key in KEYS.items() if place == name]
    assert_each_transposed(seen(name), keys, mi.load_dict(drawn(3)), 16, fresh(5))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "what"),
    [QUICK, ("in fog", "sigma_t"), ("by itself", "albedo"), ("radiance field", "density"), ("balls", "emission")],
)
def test_draws_keep_the_mean_of_derivatives(name: str, what: str) -> None:
    """Sampling of the emission keeps the mean derivative of paths meeting the emission by chance."""
    scene, key = seen(name), KEYS[name, what]
    v, (few, many) = _step(scene, key), (16, 64) if (name, what) == QUICK else (64, 256)
    found, truth = (along(scene, key, v, mi.load_dict(i), spp) for i, spp in ((drawn(3), few), (met(3), many)))
    assert_same_mean(found, truth, rounding=1e-5 * np.abs(truth.mean), what="derivative")
    assert_precise(difference(found, truth), 0.15 * np.abs(truth.mean), what="derivative")
