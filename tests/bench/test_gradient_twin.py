"""The twin of gradients: its radiance is volpath's, and its derivative is the derivative of its radiance."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, fresh, over_pixels

from mivol.bench.studies.gradients import CONSTANT, DEEP_LIGHTS, TABLES, make_deep_cases, twin
from mivol.bench.studies.gradients.twin import Light, Twin
from mivol.validate.statistics import Moments

SIDE = 6
NOISE = np.random.default_rng(2).uniform(0.5, 1.5, (3, 4, 5))
ENDLESS = [name for name in TABLES["deep estimators"] if name.endswith("unlimited")]
UNLIMITED = {name: replace(light, depth=-1) for name, light in DEEP_LIGHTS.items()}


def means(values: np.ndarray, light: Light, seed: int, spp: int) -> tuple[float, float]:
    """Light and derivative of one set of paths; the density itself is the direction."""
    tracer = Twin(values, values, SIDE, light)
    result, derivative, _ = tracer.paths(seed, spp)
    return float(result.mean()), float(derivative.mean())


@pytest.mark.slow_for(*(name for name in DEEP_LIGHTS if name != CONSTANT))
@pytest.mark.parametrize("name", DEEP_LIGHTS)
def test_the_derivative_is_that_of_the_same_paths(variant_rgb: str, name: str) -> None:
    """Up to a quarter of the majorant collisions are as likely whatever the extinction is: equal seeds give the same paths, and
    light is a smooth function of the extinction. With n <= 5 scatterings and about as many points looked at in between, it is a
    polynomial of degree 10 or so in a factor of it; a difference over 2 % errs by less than 10^3 / 6 0.02^2 = 7 %, one of
    fourth order by 10^5 / 30 0.02^4 = 0.1 %. Sums of float32 are divided by 0.12: 6e-8 of a mean that is at most 20 times as
    large as its derivative."""
    values, h, light = 0.08 * NOISE, 0.02, replace(DEEP_LIGHTS[name], depth=6)
    at = {s: means((1 + s * h) * values, light, 3, 256)[0] for s in (-2, -1, 1, 2)}
    result = means(values, light, 3, 256)[1]
    assert result == pytest.approx((8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * h), rel=2e-3)
    assert abs(result) > 1e-3 * at[1]


@pytest.mark.slow_for(*ENDLESS)
@pytest.mark.statistical
@pytest.mark.parametrize("name", ["emitter inside, depth 6", *ENDLESS])
def test_its_light_is_that_of_volpath(variant_rgb: str, name: str) -> None:
    """Half the box is empty, the other one has an optical depth of 3."""
    light = TABLES["deep estimators"][name]
    values = np.where(np.arange(5) < 2, 0, 3 * NOISE)
    mivol = Twin(values, values, SIDE, light)
    peer = light.integrator("volpath")
    paths = np.concatenate([mivol.paths(fresh(k), 512)[0] for k in range(4)])
    images = [np.array(mi.render(mivol.scene, integrator=peer, spp=256, seed=fresh(100 + k)), np.float64) for k in range(16)]
    light_of_theirs = over_pixels(Moments.from_values(np.array(images).mean(axis=-1, keepdims=True)))
    assert_precise(light_of_theirs, 0.02 * light_of_theirs.mean)
    assert_same_mean(light_of_theirs, Moments.from_values(paths))


@pytest.mark.slow_for("6")
@pytest.mark.parametrize("depth", [6, -1])
def test_white_smoke_in_a_furnace(variant_rgb: str, depth: int) -> None:
    """Paths of unlimited depth leave with the weight 1, each of them, where collisions are as likely as the extinction says;
    those of depth 6 do or end inside."""
    light = replace(DEEP_LIGHTS[CONSTANT], depth=depth, albedo=1.0)
    tracer = Twin(3 * NOISE, NOISE, SIDE, light)
    result = tracer.paths(1, 64)[0]
    # The weight is a product of quotients that are 1 but for a few roundings each.
    np.testing.assert_allclose(result[result > 0], 1, rtol=1e-4)
    assert (result > 0).all() == (depth < 0)


def test_levels_take_noise_and_no_light(variant_rgb: str) -> None:
    """In a furnace the light of a path is its weight, so that nothing is left; without levels the mean of 9216 derivatives
    whose deviation is about 1 would be some 0.01."""
    light = replace(DEEP_LIGHTS[CONSTANT], depth=-1, albedo=1.0)
    tracer = Twin(3 * NOISE, NOISE, SIDE, light)
    raw = tracer.paths(5, 256)[1]
    result = [tracer.derivative(10 + k, 256) for k in range(3)]
    assert np.std(raw) > 0.3
    # Weights are 1 but for their roundings, and so is the sum of the levels.
    assert np.max(np.abs(result)) < 1e-5


@pytest.mark.slow
@pytest.mark.statistical
def test_what_takes_the_noise_has_the_mean_0(variant_rgb: str) -> None:
    """After each number of scatterings, in glass, where paths are long and half of the box is empty."""
    tracer = Twin(np.where(np.arange(5) < 2, 0, 3 * NOISE), NOISE, SIDE, UNLIMITED["glass"])
    _, _, controls = tracer.paths(fresh(9), 4096)
    for row in controls:
        assert_same_mean(Moments.from_values(row), 0.0)


@pytest.mark.slow
def test_levels_of_each_number_of_scatterings_take_more_noise(variant_rgb: str) -> None:
    """In constant light, half of the box empty: they leave 0.63 of the variance that the end of a path alone leaves; the first
    of them alone 0.73."""
    empty = np.broadcast_to(np.arange(5) < 2, NOISE.shape)
    tracer = Twin(np.where(empty, 0, NOISE), np.where(empty, 1.0, 0.0), SIDE, UNLIMITED[CONSTANT])
    levels = tracer._choose_multiples(3, 4096)
    _, result, controls = tracer.paths(4, 4096)
    alone = np.cov(result, controls[0])
    left = alone[0, 0] - alone[0, 1] ** 2 / alone[1, 1]
    assert np.var(result - levels @ controls) < 0.68 * left


@pytest.mark.slow
def test_the_camera_does_not_see_a_hidden_emitter(variant_rgb: str) -> None:
    """Nothing scatters, so that nothing else could bring its light."""
    light = DEEP_LIGHTS["emitter inside"]
    assert light.hidden
    assert Twin(0 * NOISE, NOISE, SIDE, light).paths(1, 256)[0].max() == 0
    assert Twin(0 * NOISE, NOISE, SIDE, replace(light, hidden=False)).paths(1, 256)[0].max() > 0


def test_nothing_of_the_twin_is_walked_by_mivol(variant_rgb: str) -> None:
    """It imports what says what a light is, and no transport."""
    assert not [name for name, value in vars(twin).items() if "mivol.transport" in str(getattr(value, "__module__", ""))]


def test_light_that_is_caught_for_ever_meets_no_emptiness() -> None:
    """A thin half in the place of the empty one, a quarter of the other's mean; not where paths end after six segments."""
    caught = Light(dict, depth=-1, traps_light=True)
    result = make_deep_cases(8, caught)
    assert list(result) == ["half thin", "dense"]
    assert (result["half thin"].values[..., :4] == 0.25).all()
    assert result["half thin"].values[..., 4:].mean() == pytest.approx(1, abs=0.05)
    for other in (replace(caught, depth=6), replace(caught, traps_light=False)):
        assert list(make_deep_cases(8, other)) == ["half empty", "dense"]
    deep = TABLES["deep estimators"]
    assert [name for name in deep if deep[name].traps_light] == ["glass, depth 6", "glass, unlimited"]


def test_deep_cases_change_where_they_say() -> None:
    """The empty half alone, and the density itself."""
    result = make_deep_cases(8, Light(dict))
    half, dense = result["half empty"], result["dense"]
    left = np.arange(8) < 4
    assert (half.values[..., left] == 0).all() and (half.direction[..., left] == 1).all()
    assert (half.direction[..., ~left] == 0).all()
    np.testing.assert_allclose(half.values[..., ~left] * 3, dense.values[..., ~left], rtol=1e-15)
    assert dense.values.min() >= 1.5 and dense.values.max() <= 4.5 and (dense.direction == dense.values).all()
    assert half.step == dense.step == 0
