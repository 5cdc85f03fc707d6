"""Priors: energies against float64 twins, slopes against differences, majorisers above what they majorise."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.optim.priors import (
    DECOUPLED_PRIORS,
    PRIORS,
    Bounds,
    DecoupledPrior,
    HuberTotalVariation,
    Laplacian,
    Sparse,
    TotalVariation,
)

SPACING = (0.5, 0.25, 0.2)
CHOSEN = [
    TotalVariation(edge=0.3),
    HuberTotalVariation(edge=1.5),  # of which the square is not twice as much
    Laplacian(),
    Sparse(),
    Bounds(low=0.2, high=0.8),
]
BY_NAME = pytest.mark.parametrize("prior", CHOSEN, ids=lambda prior: prior.label())


def field(shape: tuple[int, ...] = (3, 4, 5, 2), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.05, 1.0, shape).astype(np.float32).astype(np.float64)


def forward(x: np.ndarray, axis: int) -> np.ndarray:
    return np.diff(x, axis=axis, append=np.take(x, [-1], axis))


def squared_gradient(x: np.ndarray) -> np.ndarray:
    return sum((forward(x, axis) / SPACING[axis]) ** 2 for axis in range(3))


def laplacian(x: np.ndarray) -> np.ndarray:
    padded = np.pad(x, [(1, 1)] * 3 + [(0, 0)], mode="edge")
    middle = [slice(1, -1)] * 3
    total = 0.0
    for axis in range(3):
        around = [tuple(slice(1 + s, x.shape[a] + 1 + s) if a == axis else middle[a] for a in range(3)) for s in (-1, 1)]
        total = total + (padded[around[0]] + padded[around[1]] - 2 * x) / SPACING[axis] ** 2
    return total


def twin(prior, x: np.ndarray) -> float:
    """The energy, as its docstring says it."""
    if isinstance(prior, TotalVariation):
        return float(np.mean(np.sqrt(squared_gradient(x) + prior.edge**2) - prior.edge))
    if isinstance(prior, HuberTotalVariation):
        g = np.sqrt(squared_gradient(x))
        return float(np.mean(np.where(g <= prior.edge, g**2 / (2 * prior.edge), g - prior.edge / 2)))
    if isinstance(prior, Laplacian):
        return float(np.mean(laplacian(x) ** 2) / 2)
    if isinstance(prior, Sparse):
        return float(np.mean(np.abs(x)))
    outside = np.maximum(x - prior.high, 0) + np.minimum(x - prior.low, 0)
    return float(np.mean(outside**2) / 2)


def test_the_table_is_all_tested() -> None:
    assert {prior.label() for prior in CHOSEN} == set(PRIORS)
    assert set(DECOUPLED_PRIORS.values()) == set(DecoupledPrior.__subclasses__())


@BY_NAME
def test_energy_is_that_of_the_twin(variant_rgb, prior) -> None:
    """Differences of float32 values below 1 err by 6e-8 / spacing, squared twice at most: 1e-5 of the energy is ample."""
    x = field()
    found, _ = prior.value_and_gradient(x, SPACING)
    assert abs(found - twin(prior, x)) <= 1e-5 * twin(prior, x)


@BY_NAME
def test_gradient_is_that_of_the_twin(variant_rgb, prior) -> None:
    """Central differences of the float64 twin: error h^2 f''' + 1e-16 f / h, below 1e-7 f; float32 gives 1e-5."""
    x = field(seed=1)
    rng = np.random.default_rng(2)
    _, gradient = prior.value_and_gradient(x, SPACING)
    for _ in range(5):
        v, h = rng.standard_normal(x.shape), 1e-5
        expected = (twin(prior, x + h * v) - twin(prior, x - h * v)) / (2 * h)
        assert abs(np.sum(gradient * v) - expected) <= 1e-4 * np.sum(np.abs(gradient * v))


@BY_NAME
def test_majoriser_lies_above(variant_rgb, prior) -> None:
    """E(x + v) <= E(x) + <g, v> + 1/2 v^T H v: what makes lagged diffusivity descend. Bounds are majorised only while no
    further voxel leaves the interval, so v moves nothing over a wall there."""
    rng = np.random.default_rng(4)
    x = field(seed=3)
    energy, gradient = prior.value_and_gradient(x, SPACING)
    for scale in (1e-2, 0.3, 2.0):
        v = scale * rng.standard_normal(x.shape)
        if isinstance(prior, Bounds):
            v = np.where((x > 0.8) | (x < 0.2), 1e-3 * v, 0.0)
        tensors = mi.TensorXf(x.astype("f")), mi.TensorXf(v.astype("f"))
        above = energy + np.sum(gradient * v) + float(prior.quadratic(*tensors, SPACING)[0])
        assert twin(prior, x + v) <= above * (1 + 1e-5) + 1e-6


@BY_NAME
def test_curvature_is_the_derivative_of_the_quadratic(variant_rgb, prior) -> None:
    """<v, H v> / 2 is the quadratic itself; H is symmetric. Float32 sums of 120 terms: 1e-5."""
    x, v, w = (mi.TensorXf(field(seed=s).astype("f")) for s in (5, 6, 7))
    hv, hw = np.asarray(prior.curvature(x, v, SPACING)), np.asarray(prior.curvature(x, w, SPACING))
    energy = float(prior.quadratic(x, v, SPACING)[0])
    assert np.isclose(np.sum(hv * np.asarray(v)) / 2, energy, rtol=1e-5)
    assert np.isclose(np.sum(hv * np.asarray(w)), np.sum(hw * np.asarray(v)), rtol=1e-4)


@pytest.mark.parametrize("prior", CHOSEN[:3], ids=lambda prior: prior.label())
def test_majorisers_of_gradients_touch_what_they_majorise(variant_rgb, prior) -> None:
    """<H(x) x, x> = <g, x>: the quadratic form of x at x has the slope of the energy there."""
    x = field(seed=3)
    _, gradient = prior.value_and_gradient(x, SPACING)
    tensor = mi.TensorXf(x.astype("f"))
    # Float32 sums of 120 numbers.
    assert 2 * float(prior.quadratic(tensor, tensor, SPACING)[0]) == pytest.approx(np.sum(gradient * x), rel=1e-5)


@pytest.mark.parametrize("prior", CHOSEN[:3], ids=lambda prior: prior.label())
def test_a_constant_field_costs_nothing(variant_rgb, prior) -> None:
    value, gradient = prior.value_and_gradient(np.full((4, 4, 4), 0.7), SPACING)
    assert abs(value) <= 1e-7 * prior.edge if hasattr(prior, "edge") else value == 0.0
    assert np.all(gradient == 0.0)


def test_energy_does_not_change_with_the_resolution(variant_rgb) -> None:
    """A ramp of slope 3: |grad| is 3 in all cells but the last plane, where clamping makes it 0: (1 - 1/n) of it."""
    for n in (8, 64):
        ramp = np.broadcast_to(3.0 * (np.arange(n) + 0.5) / n, (2, 2, n))
        value, _ = TotalVariation(edge=1e-3).value_and_gradient(ramp, (1.0, 1.0, 1.0 / n))
        assert np.isclose(value, (3.0 - 1e-3) * (1 - 1 / n), rtol=1e-4)


def test_axes_are_not_swapped(variant_rgb) -> None:
    """A ramp along z alone sees only the first spacing."""
    ramp = np.broadcast_to(np.arange(4.0)[:, None, None], (4, 5, 6))
    value, _ = TotalVariation(edge=1e-3).value_and_gradient(ramp, (0.5, 7.0, 9.0))
    assert np.isclose(value, 0.75 * (2.0 - 1e-3), rtol=1e-4)


def test_slope_of_tv_is_finite_where_the_field_is_flat(variant_rgb) -> None:
    for prior in CHOSEN[:2]:
        x = mi.TensorXf(np.zeros((2, 2, 2, 1), "f"))
        dr.enable_grad(x)
        dr.backward(prior.energy(x, SPACING))
        assert np.all(np.asarray(dr.grad(x)) == 0.0)


def test_refuses_a_flat_array(variant_rgb) -> None:
    with pytest.raises(MivolError, match="reshape"):
        Sparse().value_and_gradient(np.zeros(8), SPACING)


def test_which_priors_compare_neighbours() -> None:
    """The others may act on parameters that are no grid."""
    assert {name for name, prior in PRIORS.items() if prior.is_spatial} == {"tv", "huber_tv", "laplacian"}
    assert {name for name, prior in DECOUPLED_PRIORS.items() if prior.is_spatial} == {"smoothness"}
