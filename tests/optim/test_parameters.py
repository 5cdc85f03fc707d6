"""Parameters: maps there and back, projection, refusals; and the grids that events refine."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY, absorbing_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from mivol.errors import MivolError
from mivol.optim.events import EVENTS, Checkpoint, CoarseToFine, Evaluate, UpdateOccupancy, Upsample, in_order, upsample
from mivol.optim.parameters import MAPS, Parameter, as_tensor, find, inverse_softplus, like, softplus
from mivol.optim.schedules import SCHEDULES, Constant, Cosine, Exponential, Step

EPS = float(np.finfo(np.float32).eps)
DOMAINS = {"identity": (0.0, math.inf), "softplus": (0.0, math.inf), "log": (0.0, math.inf), "logistic": (0.0, 1.0)}


@pytest.mark.parametrize("name", MAPS)
def test_there_and_back(variant_rgb, name: str) -> None:
    """Reals u = f(x) err by eps |u|, which e^u turns into a relative error of eps |u| <= 14 eps at x = 1e-6; logistic
    loses 1 - x, absolutely eps."""
    x = np.geomspace(1e-6, 0.999, 200).astype(np.float32)
    p = Parameter("x", domain=DOMAINS[name], map=name)
    back = np.asarray(p.from_reals(p.to_reals(mi.TensorXf(x))))
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


def test_scene_values_of_any_type_go_through_tensors(variant_rgb) -> None:
    for value in (mi.Float(1.5), mi.Color3f(1, 2, 3), mi.TensorXf(np.ones((1, 2, 3, 1), "f"))):
        again = like(as_tensor(value), value)
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
    with pytest.raises(MivolError, match=sentence):
        Parameter("sigma_t", **settings_)


def test_refused_starts(variant_rgb) -> None:
    """Negative and NaN voxels are named by index; a start on the bound that softplus never reaches is said to be that."""
    values = np.ones((2, 2, 2, 1), "f")
    for bad in (np.nan, -0.5, np.inf):
        values[1, 0, 1, 0] = bad
        with pytest.raises(MivolError, match=r"sigma_t\[1, 0, 1, 0\]"):
            Parameter("sigma_t", domain=(0.0, 1e9)).to_reals(mi.TensorXf(values))
    with pytest.raises(MivolError, match="start inside it"):
        Parameter("sigma_t", domain=(0.0, math.inf), map="softplus").to_reals(mi.TensorXf(np.zeros((1, 1, 1, 1), "f")))


def test_find_offers_the_nearest_key(variant_rgb) -> None:
    params = mi.traverse(absorbing_scene(np.ones((2, 2, 2, 1))))
    assert find(KEY, params) == KEY
    with pytest.raises(MivolError, match=f'did you mean "{KEY}"'):
        find("cube.interior_medium.sigma_t.dat", params)
    lamp = mi.traverse(mi.load_dict({"type": "scene", "lamp": {"type": "spot"}}))
    with pytest.raises(MivolError, match="AffineTransform4f, and a fit looks for numbers"):
        find("lamp.to_world", lamp)
    nameless = mi.traverse(mi.load_dict({"type": "scene", "s": {"type": "sphere"}}))
    addressed = next((key for key in list(nameless.keys()) if key.startswith("object_")), None)
    if addressed:
        with pytest.raises(MivolError, match="memory address"):
            find(addressed, nameless)


# -- Refining a grid ----------------------------------------------------------------------------------------------

SIZES = st.tuples(*[st.integers(1, 6)] * 3)
NEW_SIZES = st.tuples(*[st.integers(1, 11)] * 3)


@settings(max_examples=60, deadline=None)
@given(SIZES, NEW_SIZES, st.integers(1, 3), st.integers(0, 1000))
def test_upsampling_conserves_mass(old: tuple[int, ...], new: tuple[int, ...], channels: int, seed: int) -> None:
    """Rationale: a refined start must absorb as much as the coarse one, or the loss jumps. Whole factors conserve the
    mass by themselves, others do not.
    Expected: the mean of each channel is kept to the rounding of float32 values (eps / 2 each, of one sign at worst);
    nothing is negative (linear, not cubic).

    Hard case 47.
    """
    mi.set_variant("llvm_ad_rgb")
    rng = np.random.default_rng(seed)
    field = rng.uniform(0, 1, (*old, channels)) ** 8 * (rng.uniform(size=(*old, 1)) > 0.5)
    fine = np.asarray(upsample(mi.TensorXf(field.astype("f")), new))
    assert fine.shape == (*new, channels)
    before = field.astype("f").astype(np.float64).mean(axis=(0, 1, 2))
    after = fine.astype(np.float64).mean(axis=(0, 1, 2))
    assert np.all(np.abs(after - before) <= EPS * before)
    assert fine.min(initial=0.0) >= 0.0


def test_no_overshoot(variant_rgb) -> None:
    """A step stays between its levels, but for the factor that restores the mass, which is 1 for a step by symmetry.

    Hard case 47.
    """
    step = np.zeros((4, 4, 4, 1), "f")
    step[2:] = 1.0
    fine = np.asarray(upsample(mi.TensorXf(step), (8, 8, 8)))
    assert fine.min() == 0.0
    assert fine.max() <= 1.0 + EPS
    ramp = fine[:, 0, 0, 0]
    assert np.all(np.diff(ramp) >= 0)
    assert np.allclose(ramp[3:5], [0.25, 0.75], rtol=2 * EPS)


def test_upsampling_of_a_field_of_both_signs_without_mass(variant_rgb) -> None:
    values = np.array([1.0, -1.0], "f").reshape(2, 1, 1, 1)
    fine = np.asarray(upsample(mi.TensorXf(values), (4, 1, 1)))
    assert np.allclose(fine.ravel(), [1, 0.5, -0.5, -1], atol=EPS)


def test_events_are_due_when_they_say(variant_rgb) -> None:
    assert [i for i in range(9) if Upsample(at=(3, 5)).due(i)] == [3, 5]
    assert [i for i in range(9) if Checkpoint(every=4).due(i)] == [4, 8]
    assert [i for i in range(9) if Evaluate(every=4).due(i)] == [0, 4, 8]
    assert [i for i in range(9) if CoarseToFine(at=(3, 5)).due(i)] == [3, 5]
    assert [i for i in range(9) if UpdateOccupancy(every=4).due(i)] == [4, 8]
    assert set(EVENTS) == {"upsample", "coarse_to_fine", "update_occupancy", "checkpoint", "evaluate"}
    assert isinstance(in_order((Upsample(at=(1,)), Evaluate(), Checkpoint()))[0], Checkpoint)


# -- Schedules ----------------------------------------------------------------------------------------------------


def test_schedules_begin_at_one_and_end_where_they_say() -> None:
    n = 41
    chosen = [Constant(), Cosine(final=0.2), Step(at=(0.5, 0.9), ratio=0.1), Exponential(final=0.01, delay=10)]
    assert {schedule.label() for schedule in chosen} == set(SCHEDULES)
    factors = np.array([[s.factor(i, n) for i in range(n)] for s in chosen])
    assert np.allclose(factors[:, 0], 1.0)
    assert np.allclose(factors[:, -1], [1.0, 0.2, 0.01, 0.01])
    assert np.all(np.diff(factors, axis=1) <= 1e-12)
    assert np.isclose(factors[1, 20], 0.6)
    assert np.allclose(factors[3, [10, 25]], [1.0, 0.1])
    assert np.allclose(factors[2, [20, 21]], [1.0, 0.1])
