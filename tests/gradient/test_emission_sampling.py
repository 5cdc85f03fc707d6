"""Derivatives of sampled light of emitting media, at scattering events."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from media_light_scenes import drawn, met, seen
from scattering_gradients import along, assert_transposed, backward, forward

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
CASES = [pytest.param(*case, marks=() if case == QUICK else pytest.mark.slow) for case in KEYS]


def _step(scene: mi.Scene, key: str) -> np.ndarray | float:
    """A direction with entries of one sign."""
    shape = np.shape(mi.traverse(scene)[key])
    return np.random.default_rng(2).uniform(0.5, 1.5, shape) if np.prod(shape) > 3 else 1.0


@pytest.mark.slow_for("over a floor-sigma_t")
@pytest.mark.parametrize(("name", "what"), CASES)
def test_forward_is_the_transpose_of_reverse(name: str, what: str, whole_paths: None) -> None:
    scene, key, integrator = seen(name), KEYS[name, what], mi.load_dict(drawn(3))
    w, v, seed = np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3)), _step(scene, key), fresh(5)
    there, back = forward(scene, key, v, 16, seed, integrator), backward(scene, key, w, 16, seed, integrator)
    assert_transposed(there * w, back * v)


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
