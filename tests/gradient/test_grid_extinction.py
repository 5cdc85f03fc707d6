"""Derivatives of the optical depth: the transpose and the tangent are those of the same matrix.

tau is linear in the voxels, so the tangent is the optical depth of the tangent. The transpose is compared with the dense rows
of the twin.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import tau_gradient_twin
from scattering_scenes import PLACE, close_up, mivol

from scenes import (
    FRAMES,
    as_float32,
    box_of,
    from_lanes,
    grid_volume,
    make_lattice,
    medium,
    random_rays,
    sky,
    tau_and_row,
    tau_fast,
    tensor,
    to_lanes,
)

pytestmark = pytest.mark.usefixtures("two_threads")

BOUND = 2e-6


def integrate(values, to_world, o, d, t_max=math.inf, skip=False):
    """The optical depth of tensors, with derivatives."""
    from mivol.transport.media.grid_extinction import integrate_tau

    ends = mi.Float(np.broadcast_to(np.float32(t_max), len(o)).copy())
    return integrate_tau(make_lattice(values, to_world, skip), *to_lanes(o, d), ends, mi.Bool(True))


def lanes_like(tau, y):
    """An array (n, C) as lanes of the type of tau."""
    y = np.ascontiguousarray(y.T, dtype=np.float32)
    return type(tau)(y[0]) if len(y) == 1 else type(tau)(y)


def vjp(values, y, to_world, o, d, t_max=math.inf, skip=False):
    """A^T y, in reverse mode."""
    values = tensor(values)
    dr.enable_grad(values)
    tau = integrate(values, to_world, o, d, t_max, skip)
    dr.set_grad(tau, lanes_like(tau, y))
    dr.enqueue(dr.ADMode.Backward, tau)
    dr.traverse(dr.ADMode.Backward)
    return np.asarray(dr.grad(values))


def jvp(values, tangent, to_world, o, d, t_max=math.inf, skip=False):
    """A x, in forward mode."""
    values = tensor(values)
    dr.enable_grad(values)
    dr.set_grad(values, tensor(tangent))
    tau = integrate(values, to_world, o, d, t_max, skip)
    return from_lanes(dr.forward_to(tau))


def setting(seed, name, channels, n=200):
    rng = np.random.default_rng([seed, channels, *name.encode()])
    values = rng.uniform(0, 1, (7, 5, 20, channels))
    values[:, :, 5:] = 0  # two blocks of 8 that a forward walk may skip
    o, d = random_rays(rng, FRAMES[name], n)
    return rng, as_float32(values), FRAMES[name], o, d


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("channels", [1, 3])
def test_transpose_is_the_rows_of_the_twin(seed, name, channels):
    # A row's weight has the error of its interval: BOUND times the ray's length in the cell and of its two neighbours.
    rng, values, to_world, o, d = setting(seed, name, channels, n=24)
    y = as_float32(rng.normal(size=(24, channels)))
    rows = np.array([tau_gradient_twin(values.shape, to_world, *ray) for ray in zip(o, d, strict=True)])
    exact = np.einsum("nzyx,nc->zyxc", rows, y)
    reach = np.abs(y).max() * rows.max() * 24
    got = vjp(values, y, to_world, o, d)
    assert np.all(np.abs(got - exact) <= BOUND * reach)
    assert np.abs(exact).max() > 1e3 * BOUND * reach


@pytest.mark.parametrize("t_max", [0.4, 1.7])
def test_transpose_of_a_cut_segment(seed, t_max):
    rng, values, to_world, o, d = setting(seed, "two_units", 1, n=24)
    y = as_float32(rng.normal(size=(24, 1)))
    end = as_float32(t_max)
    rows = np.array([tau_gradient_twin(values.shape, to_world, *ray, 0, end) for ray in zip(o, d, strict=True)])
    got = vjp(values, y, to_world, o, d, t_max)[..., 0]
    assert np.all(np.abs(got - np.einsum("nzyx,nc->zyx", rows, y)) <= BOUND * np.abs(y).max() * rows.max() * 24)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("skip", [False, True])
def test_adjoint_identity(seed, name, channels, skip):
    # <A x, y> = <x, A^T y> to 1e-6 |A x| |y|, products in float64.
    rng, values, to_world, o, d = setting(seed, name, channels)
    x, y = (as_float32(rng.normal(size=s)) for s in (values.shape, (len(o), channels)))
    ax, aty = jvp(values, x, to_world, o, d, skip=skip), vjp(values, y, to_world, o, d, skip=skip)
    difference = abs(np.sum(ax.astype(np.float64) * y) - np.sum(x * aty.astype(np.float64)))
    assert difference <= 1e-6 * np.linalg.norm(ax) * np.linalg.norm(y)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("skip", [False, True])
def test_tangent_is_the_integral_of_the_tangent(seed, channels, skip):
    # Linear: the tangent is A itself, at any point, even where the field is empty and the walk could skip.
    rng, values, to_world, o, d = setting(seed, "rotated", channels)
    x = as_float32(rng.normal(size=values.shape))
    assert np.array_equal(jvp(values, x, to_world, o, d, skip=skip), tau_fast(x, to_world, o, d))


def test_chain_rule_through_a_map_of_the_voxels(seed):
    # d/dx of sum(y tau(exp x)) = A^T y exp x: the tensor may be the result of a computation.
    rng, values, to_world, o, d = setting(seed, "unit", 1)
    y = as_float32(rng.uniform(0, 1, (len(o), 1)))
    x = tensor(np.log(values + 0.1))
    dr.enable_grad(x)
    tau = integrate(dr.exp(x), to_world, o, d)
    dr.backward(dr.sum(tau * mi.Float(y[:, 0].astype(np.float32))))
    expected = vjp(values, y, to_world, o, d) * (values + 0.1)
    # exp and log each add an EPS, the log one multiplied by |log| <= 2.3.
    assert np.allclose(np.asarray(dr.grad(x)), expected, rtol=4e-6, atol=1e-6 * expected.max())


def test_gradients_add_up_over_two_integrals_of_one_grid(seed):
    _, values, to_world, o, d = setting(seed, "unit", 1)
    v = tensor(values)
    dr.enable_grad(v)
    dr.backward(dr.sum(integrate(v, to_world, o, d)) + 2 * dr.sum(integrate(v, to_world, o, -d)))
    ones = np.ones((len(o), 1))
    expected = vjp(values, ones, to_world, o, d) + 2 * vjp(values, ones, to_world, o, -d)
    assert np.allclose(np.asarray(dr.grad(v)), expected, rtol=0, atol=BOUND * expected.max())


def test_a_detached_grid_asks_for_no_gradient(seed):
    _, values, to_world, o, d = setting(seed, "unit", 1, n=8)
    assert not dr.grad_enabled(integrate(tensor(values), to_world, o, d))


def test_inactive_lanes_receive_and_give_nothing(seed):
    from mivol.transport.media.grid_extinction import integrate_tau

    _, values, to_world, o, d = setting(seed, "unit", 1, n=64)
    v = tensor(values)
    dr.enable_grad(v)
    on = np.arange(64) % 3 == 0
    tau = integrate_tau(make_lattice(v, to_world), *to_lanes(o, d), mi.Float(math.inf), mi.Bool(on))
    dr.backward(dr.sum(tau))
    expected = vjp(values, on[:, None].astype(float), to_world, o, d)
    assert np.array_equal(np.asarray(tau)[~on], np.zeros((~on).sum()))
    assert np.allclose(np.asarray(dr.grad(v)), expected, rtol=0, atol=BOUND * expected.max())


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 2, 2)])
def test_a_million_rays_into_few_voxels(seed, shape):
    """The row sums are the chords; a naive float32 accumulator of 1e6 terms of one sign drifts by 1e-4 and stalls at 2^24 of
    its unit. Asked: 1e-5, far below the 1 % that would harm; a sum in blocks reaches 1e-6."""
    rng = np.random.default_rng([seed, 42])
    n = 1_000_000
    o = as_float32(np.column_stack([np.full(n, -1.0), rng.uniform(0, 1, (n, 2))]))
    _, row = tau_and_row(shape, np.eye(4), o, [1.0, 0, 0])
    assert row.sum(dtype=np.float64) == pytest.approx(n, rel=1e-5)
    if shape == (2, 2, 2):
        u = np.clip(o[:, 1:] * 2 - 0.5, 0, 1)
        exact = 0.5 * np.array(
            [[(1 - u[:, 1]) @ (1 - u[:, 0]), (1 - u[:, 1]) @ u[:, 0]], [u[:, 1] @ (1 - u[:, 0]), u[:, 1] @ u[:, 0]]]
        )
        # A GPU adds each term to the sum itself: 1e6 roundings of at most 6e-8 of it spread by 2e-5, in no fixed order.
        rtol = 1e-5 if mi.variant().startswith("llvm") else 1e-4
        assert np.allclose(row, exact[:, :, None], rtol=rtol, atol=0)


def test_rays_with_gradients_are_refused(seed):
    _, values, to_world, o, d = setting(seed, "unit", 1, n=4)
    lattice, (p, w) = make_lattice(values, to_world), to_lanes(o, d)
    from mivol.transport.media.grid_extinction import integrate_tau

    for attached in (p, w):
        dr.enable_grad(attached)
        with pytest.raises(ValueError, match="rays with gradients"):
            integrate_tau(lattice, p, w)
        dr.disable_grad(attached)
    end = mi.Float(1)
    dr.enable_grad(end)
    with pytest.raises(ValueError, match="rays with gradients"):
        integrate_tau(lattice, p, w, end)


@pytest.mark.parametrize("channels", [2, 4])
def test_other_channel_counts_are_refused(channels):
    with pytest.raises(ValueError, match="channels"):
        tau_fast(np.ones((2, 2, 2, channels)), np.eye(4), [0, 0, 0], [0, 0, 1])


@pytest.mark.parametrize(("spare", "rays"), [(-1, 5), (0, 5), (0, 3)])
def test_gradients_are_packed_up_to_a_size(variant_rgb, monkeypatch, spare, rays):
    """Packed gradients hold the 8 corners of a cell side by side; larger gradients, and gradients of few rays, hold a number a
    node, on every back end. A face has (4 5 6)^(2/3) = 24.3 cells.
    """
    from mivol.transport.media import grid_extinction

    lattice = make_lattice(np.ones((3, 4, 5, 2), np.float32), FRAMES["unit"], False)
    monkeypatch.setattr(grid_extinction, "PACKED_LIMIT", grid_extinction.gradient_bytes(lattice.res, 2) + spare)
    monkeypatch.setattr(grid_extinction, "FEW_RAYS", 4 / 24.3)
    found = grid_extinction.NodeGradient.zeros(lattice, rays)
    packed = spare == 0 and rays == 5 and "llvm" in variant_rgb
    assert (found.packed, dr.width(found.buffer)) == (packed, 8 * 4 * 5 * 6 * 2 if packed else 3 * 4 * 5 * 2)


@pytest.mark.parametrize(("spp", "packs"), [(1, False), (2, True)])
def test_the_rays_of_a_render_choose_how_a_gradient_is_added(cpu_back_end, monkeypatch, spp, packs):
    """A face of 9^2 cells has few rays up to 10.1, and a film of 3^2 pixels has 9 for each sample. Both ways agree."""
    from mivol.transport.media import grid_extinction

    values = np.random.default_rng(3).uniform(0, 3, (8, 8, 8, 1)).astype(np.float32)
    smoke = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.8)
    scene, key = close_up({"smoke": box_of(smoke, PLACE), "sky": sky(0.7)}, res=3), "smoke.interior_medium.sigma_t.data"
    params, made, zeros = mi.traverse(scene), [], grid_extinction.NodeGradient.zeros
    monkeypatch.setattr(grid_extinction.NodeGradient, "zeros", lambda *given: made.append(zeros(*given)) or made[-1])

    def gradient():
        dr.enable_grad(params[key])
        dr.set_grad(params[key], 0)
        mi.load_dict(mivol(max_depth=3)).render_backward(scene, params, dr.ones(mi.TensorXf, (3, 3, 3)), seed=1, spp=spp)
        return np.array(dr.grad(params[key]))

    chosen = gradient()
    assert {each.packed for each in made} == {packs}
    monkeypatch.setattr(grid_extinction, "FEW_RAYS", math.inf if packs else 0)
    other = gradient()
    assert made[-1].packed != packs
    # A node gets at most 8 numbers from each of 18 rays and of a few points, in another order.
    np.testing.assert_allclose(chosen, other, rtol=0, atol=200 * 2.0**-24 * np.abs(other).max())
    assert np.count_nonzero(other) > 100
