"""Parameters: maps and their inverses, projection, refusals."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY, absorbing_scene
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.optim.parameters import (
    ANY,
    MAPS,
    NOT_NEGATIVE,
    SHARE,
    Parameter,
    as_tensor,
    find_key,
    find_parameter_kind,
    inverse_softplus,
    softplus,
    to_type_of,
)
from mivol.optim.strategy import suggest_name

EPS = float(np.finfo(np.float32).eps)
DOMAINS = {"identity": (0.0, math.inf), "softplus": (0.0, math.inf), "log": (0.0, math.inf), "logistic": (0.0, 1.0)}


@pytest.mark.parametrize("name", MAPS)
def test_maps_invert(variant_rgb, name: str) -> None:
    """Reals u = f(x) err by eps |u|, which e^u turns into a relative error of eps |u| <= 14 eps at x = 1e-6; logistic
    loses 1 - x, absolutely eps. The reals of a domain lie within their bounds."""
    x = np.geomspace(1e-6, 0.999, 200).astype(np.float32)
    p = Parameter("x", domain=DOMAINS[name], map=name)
    u = p.to_reals(mi.TensorXf(x))
    back, (low, high) = np.asarray(p.from_reals(u)), p.bounds()
    assert low < np.asarray(u).min() and np.asarray(u).max() < high
    assert np.all(np.abs(back - x) <= 32 * EPS * x + 2 * EPS * (name == "logistic"))


def test_softplus_keeps_relative_precision(variant_rgb) -> None:
    """Against float64: log(1 + e^u) for u in [-80, 80], and its slope, the logistic function; exp and log
    err by a few ulp each. u = 0 is among the points: max and |.| have no slope there."""
    u = np.linspace(-80, 80, 4001).astype(np.float32)
    x = mi.Float(u)
    dr.enable_grad(x)
    value = softplus(x)
    dr.backward(value)
    exact = np.logaddexp(0, u.astype(np.float64))
    slope = 1 / (1 + np.exp(-u.astype(np.float64)))
    assert np.max(np.abs(np.asarray(value) - exact) / exact) <= 8 * EPS
    assert np.max(np.abs(np.asarray(x.grad) - slope) / slope) <= 8 * EPS
    y = np.geomspace(1e-6, 80, 1000)
    again = np.logaddexp(0, np.asarray(inverse_softplus(mi.Float(y.astype(np.float32)))).astype(np.float64))
    assert np.max(np.abs(again - y) / y) <= 24 * EPS  # u is of size 14, rounded: 14 eps / 2 of e^u


@pytest.mark.parametrize("name", ["identity", "log"])
def test_projection_is_the_nearest_point_of_the_domain(variant_rgb, name: str) -> None:
    p = Parameter("x", domain=(0.5, 2.0), map=name)
    reals = mi.TensorXf(np.array([-3.0, 0.1, 5.0], "f"))
    value = np.asarray(p.from_reals(p.project(reals)))
    assert np.allclose(value, [0.5, 0.5 if name == "identity" else math.exp(0.1), 2.0], rtol=4 * EPS)


def test_scene_values_convert_to_tensors_and_back(variant_rgb) -> None:
    for value in (mi.Float(1.5), mi.Color3f(1, 2, 3), mi.TensorXf(np.ones((1, 2, 3, 1), "f"))):
        again = to_type_of(as_tensor(value), value)
        assert type(again) is type(value)
        assert np.array_equal(np.asarray(again), np.asarray(value))


REFUSED = {
    "empty domain": ({"domain": (1.0, 0.0)}, "is empty"),
    "unknown map": ({"map": "softpluss"}, 'did you mean "softplus"'),
    "map without its domain": ({"map": "logistic", "domain": (0.0, math.inf)}, "two finite bounds"),
    "log of negative values": ({"map": "log", "domain": (-1.0, 1.0)}, "at least 0"),
    "softplus with an upper bound": ({"map": "softplus", "domain": (0.0, 1.0)}, "no upper bound"),
    "no step": ({"lr": 0.0}, "learning rate"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_settings(case: str) -> None:
    settings_, sentence = REFUSED[case]
    assert_refused(sentence, Parameter, "sigma_t", **settings_)


def test_refused_starts(variant_rgb) -> None:
    """Negative and NaN voxels are named by index; a start on the bound that softplus never reaches is said to be that."""
    values = np.ones((2, 2, 2, 1), "f")
    for bad in (np.nan, -0.5, np.inf):
        values[1, 0, 1, 0] = bad
        assert_refused(r"sigma_t\[1, 0, 1, 0\]", Parameter("sigma_t", domain=(0.0, 1e9)).to_reals, mi.TensorXf(values))
    with pytest.raises(MivolError, match="start inside it"):
        Parameter("sigma_t", domain=(0.0, math.inf), map="softplus").to_reals(mi.TensorXf(np.zeros((1, 1, 1, 1), "f")))


def test_find_offers_the_nearest_key(variant_rgb) -> None:
    params = mi.traverse(absorbing_scene(np.ones((2, 2, 2, 1))))
    assert find_key(KEY, params) == KEY
    assert_refused(f'did you mean "{KEY}"', find_key, "cube.interior_medium.sigma_t.dat", params)
    emitter = mi.traverse(mi.load_dict({"type": "scene", "emitter": {"type": "spot"}}))
    assert_refused("AffineTransform4f, expected a number", find_key, "emitter.to_world", emitter)


def test_an_object_without_an_id_is_asked_for_one(variant_rgb) -> None:
    """Mitsuba names it by its address, so a key of one run says nothing in the next."""
    nameless = mi.traverse(mi.load_string('<scene version="3.0.0"><shape type="sphere"><emitter type="area"/></shape></scene>'))
    with pytest.raises(MivolError, match='did you mean "<id>.emitter.radiance.value": give the objects .* an id in the scene'):
        find_key("shape_1.emitter.radiance.value", nameless)
    for key in (next(key for key in list(nameless.keys()) if key.startswith("object_")), "object_123.emitter.radiance.value"):
        assert_refused("memory address", find_key, key, nameless)


@pytest.mark.parametrize(
    ("key", "unit", "domain"),
    [
        ("lamp.position", "length", ANY),
        ("smoke.interior_medium.sigma_t.data", "1/length", NOT_NEGATIVE),
        ("smoke.interior_medium.albedo.value.value", "1", SHARE),
        ("smoke.interior_medium.sigma_t.weights_0", "", ANY),
        ("cube.interior_medium.phase_function.g", "1", (-0.999, 0.999)),
        ("sky.radiance.value", "radiance", NOT_NEGATIVE),
        ("sun.irradiance.value", "radiance sr", NOT_NEGATIVE),
        ("lamp.intensity.value", "radiance length²", NOT_NEGATIVE),
        ("wall.bsdf.reflectance.data", "1", SHARE),
        ("ball.bsdf.diffuse_reflectance.value", "1", SHARE),
        ("sky.data", "", NOT_NEGATIVE),
        ("albedo.position", "length", ANY),
        ("cube.to_world", "", ANY),
    ],
)
def test_a_key_tells_its_unit_and_domain(key: str, unit: str, domain: tuple[float, float]) -> None:
    """By its last word that says something; what is given goes before."""
    assert find_parameter_kind(key) == (unit, domain)
    assert (Parameter(key).unit, Parameter(key).domain) == (unit, domain)
    given = Parameter(key, "1/m", (-2.0, 3.0))
    assert (given.unit, given.domain) == ("1/m", (-2.0, 3.0))


# -- Names -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "way_out"), [("adm", 'did you mean "adam"?'), ("qqqq", "known are: adam, lbfgs."), ("", "known are: adam, lbfgs.")]
)
def test_suggestions_for_misspelt_names(word: str, way_out: str) -> None:
    assert suggest_name(word, ["lbfgs", "adam"]) == way_out
