"""Priors: energies and gradients against float64 oracles, majorisers, and decoupled moves of a radiance field."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import CUBE
from refusals import assert_refused

from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner
from mivol.optim.priors import (
    DECOUPLED_PRIORS,
    PRIORS,
    Bounds,
    DecoupledPrior,
    FieldRows,
    HuberTotalVariation,
    Laplacian,
    Neighbours,
    Smoothness,
    Sparse,
    TotalVariation,
    decay_view_dependence,
    sparsify,
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


def test_every_prior_is_tested() -> None:
    assert {prior.label() for prior in CHOSEN} == set(PRIORS)
    assert set(DECOUPLED_PRIORS.values()) == set(DecoupledPrior.__subclasses__())


@BY_NAME
def test_prior_energy_matches_the_oracle(variant_rgb, prior) -> None:
    """Differences of float32 values below 1 err by 6e-8 / spacing, squared twice at most: 1e-5 of the energy is ample."""
    x = field()
    found, _ = prior.value_and_gradient(x, SPACING)
    assert abs(found - twin(prior, x)) <= 1e-5 * twin(prior, x)


@BY_NAME
def test_prior_gradient_matches_the_oracle(variant_rgb, prior) -> None:
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
def test_majorisers_touch_the_energy(variant_rgb, prior) -> None:
    """<H(x) x, x> = <g, x>: the quadratic form of x at x has the slope of the energy there."""
    x = field(seed=3)
    _, gradient = prior.value_and_gradient(x, SPACING)
    tensor = mi.TensorXf(x.astype("f"))
    # Float32 sums of 120 numbers.
    assert 2 * float(prior.quadratic(tensor, tensor, SPACING)[0]) == pytest.approx(np.sum(gradient * x), rel=1e-5)


@pytest.mark.parametrize("prior", CHOSEN[:3], ids=lambda prior: prior.label())
def test_constant_field_has_no_energy(variant_rgb, prior) -> None:
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
    assert_refused("reshape", Sparse().value_and_gradient, np.zeros(8), SPACING)


def test_which_priors_compare_neighbours() -> None:
    """The others may act on parameters that are no grid."""
    assert {name for name, prior in PRIORS.items() if prior.is_spatial} == {"tv", "huber_tv", "laplacian"}
    assert {name for name, prior in DECOUPLED_PRIORS.items() if prior.is_spatial} == {"smoothness"}


def smoothed(values: mi.Float, field: SphericalGrid, amount: float, share: float = 1.0, first: int = 7) -> mi.Float:
    """A smooth density: a step down a slope of 1 is ``amount`` long."""
    return Smoothness(share=share).apply(values, FieldRows(1, Neighbours.from_field(field), amount, 1.0, first))


def test_decoupled_priors_descend(variant_rgb: str) -> None:
    rng = np.random.default_rng(0)
    density, sh = rng.normal(size=(4, 5, 6)).astype(np.float32), rng.normal(size=(4, 5, 6, 4, 3)).astype(np.float32)
    field = SphericalGrid.from_dense(density, sh, CUBE)
    amount = 0.05

    def variation(v: np.ndarray) -> float:
        steps = [np.diff(v, axis=a, append=np.take(v, [-1], axis=a)) for a in (0, 1, 2)]
        return float(np.sum(np.sqrt((6 * amount) ** 2 + sum(s * s for s in steps))))

    moved = smoothed(field.density, field, amount)
    way = rng.normal(size=density.shape)
    v = density.astype(np.float64)
    expected = -amount * (variation(v + 1e-6 * way) - variation(v - 1e-6 * way)) / 2e-6
    assert np.sum((np.array(moved).reshape(v.shape) - v) * way) == pytest.approx(expected, rel=1e-4)

    moved = sparsify(field.density, mi.Float(0.04), 0.5)
    cauchy = lambda v: np.sum(np.log(1 + 2 * np.maximum(0.5 * v, 0) ** 2))  # noqa: E731
    expected = -0.01 * (cauchy(v + 1e-6 * way) - cauchy(v - 1e-6 * way)) / 2e-6 / 0.5**2
    assert np.sum((np.array(moved).reshape(v.shape) - v) * way) == pytest.approx(expected, rel=1e-4)
    assert (np.array(sparsify(field.density, mi.Float(400), 0.5)) <= np.maximum(density.reshape(-1), 0)).all()
    assert np.array(sparsify(field.density, mi.Float(400), 0.5))[density.reshape(-1) > 0] == pytest.approx(0, abs=1e-6)

    decayed = np.array(decay_view_dependence(field.harmonics, field.width, mi.Float(0.75)))
    kept = decayed.reshape(*density.shape, -1)[..., :12].reshape(sh.shape)
    np.testing.assert_array_equal(kept[..., 0, :], sh[..., 0, :])
    np.testing.assert_allclose(kept[..., 1:, :], 0.75 * sh[..., 1:, :], rtol=1e-6)


def test_smoothing_a_sparse_field_equals_smoothing_stored_nodes(variant_rgb: str) -> None:
    """Terms are those of the nodes that are stored; what is not stored beyond them is vacuum, before them it has no term."""
    rng = np.random.default_rng(2)
    density, keep, amount = rng.normal(size=(4, 5, 6)).astype(np.float32), rng.random((4, 5, 6)) < 0.6, 0.05
    field = SphericalGrid.from_dense(density, np.zeros((4, 5, 6, 1, 3)), CUBE, keep)
    dense = np.where(keep, density, 0.0)  # the vacuum of a ReLU

    def variation(v: np.ndarray) -> float:
        steps = [np.diff(v, axis=a, append=np.take(v, [-1], axis=a)) for a in (0, 1, 2)]
        return float(np.sum(np.sqrt((6 * amount) ** 2 + sum(s * s for s in steps))[keep]))

    moved = smoothed(field.density, field, amount)
    way = rng.normal(size=density.shape) * keep
    expected = -amount * (variation(dense + 1e-6 * way) - variation(dense - 1e-6 * way)) / 2e-6
    # As above: central differences in float64, values moved in float32.
    assert np.sum((np.array(moved)[:-1] - density[keep]) * way[keep]) == pytest.approx(expected, rel=1e-4)


def test_strong_smoothing_adds_no_extrema(variant_rgb: str) -> None:
    """What was between the smallest and the largest value stays there, and the vacuum around stays empty."""
    rng = np.random.default_rng(1)
    density = rng.normal(size=(6, 6, 6)).astype(np.float32)
    keep = np.zeros(density.shape, bool)
    keep[1:5, 1:5, 1:5] = True
    field = SphericalGrid.from_dense(density, np.zeros((6, 6, 6, 1, 3)), CUBE, keep)
    values, before = mi.Float(field.density), np.array(field.density)
    for start in range(40):
        values = smoothed(values, field, 1e3, 0.5, start)
        after = np.array(values)
        # Rounding of a sum of seven terms.
        assert before.min() - 1e-6 <= after.min() and after.max() <= before.max() + 1e-6
        assert after[-1] == before[-1]
    assert np.ptp(after) < 0.2 * np.ptp(before)


def test_smoothing_every_few_steps_covers_the_same_rows(variant_rgb: str) -> None:
    """A row is moved as far by one look at four shares as by a look at one; between two looks nothing moves."""
    density = np.random.default_rng(3).normal(size=(4, 4, 8)).astype(np.float32)
    field = SphericalGrid.from_dense(density, np.zeros((4, 4, 8, 1, 3)), CUBE)
    around = Neighbours.from_field(field)
    often, seldom = Smoothness(share=1 / 8), Smoothness(share=1 / 8, every=4)
    looks = [FieldRows(1, around, 0.05, 1.0, first, 8) for first in (7, 23, 39, 55)]
    moved = np.array(seldom.apply(field.density, looks[0]))
    shares = [np.array(often.apply(field.density, look)) for look in looks]
    expected = density.reshape(-1) + sum(share - density.reshape(-1) for share in shares)
    # Each row is in one share; sums of float32 numbers of order 1.
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-6)
    assert np.count_nonzero(moved != density.reshape(-1)) > 0.9 * len(moved) / 2
    resting = FieldRows(1, around, 0.05, 1.0, 7, 9)
    np.testing.assert_array_equal(np.array(seldom.apply(field.density, resting)), density.reshape(-1))


def test_covered_nodes_are_no_neighbours(variant_rgb: str) -> None:
    """An outer level ends at the inner box: the differences across it are 0, and no level is beside another in memory only."""
    n = 8
    grids = []
    for level in range(2):
        place = CUBE * 2.0**level
        place[3, 3] = 1
        grids.append(SphericalGrid.from_dense(np.full((n, n, n), 2.0 + 2 * level), np.zeros((n, n, n, 1, 3)), place))
    field = SphericalGrid.from_levels(grids)
    covered = np.array(is_covered_by_inner(dr.arange(mi.UInt32, field.node_count), field.res))
    field = field.select_nodes(~covered)
    moved = mi.Float(field.density)
    smoothed(moved, field, 0.05)
    # Constants in each level have no variation: nothing moves, not even beside the vacuum that is not stored.
    np.testing.assert_array_equal(np.array(moved)[:-1], np.array(field.density)[:-1])
    assert covered.sum() == 2**3
