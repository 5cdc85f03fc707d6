"""Samples in two rounds: order, density and parts of the ray, and a fit of both networks against finite differences."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.nerf import NerfField, NerfSizes
from mivol.optim.photographs.sampled_problem import find_region, join_slopes
from mivol.transport.line_integrals.hierarchical_samples import cut_into_strata, merge_rounds
from mivol.transport.line_integrals.radiance_field import RayBundle, RayGradient
from mivol.transport.line_integrals.sampled_rays import (
    RaySamples,
    SampledModel,
    _find_weights,
    render_hierarchical,
    vjp_samples,
)
from mivol.transport.traversal.lattice import Lattice

SIZES = NerfSizes(depth=2, width=8, skip=0, place=2, direction=1, branch=4, coarse=6, fine=9)


def rays(count: int) -> RayBundle:
    """Rays through the unit cube; the last misses it."""
    rng = np.random.default_rng(0)
    o = np.float32(rng.random((count, 3)) * [1, 1, 0.1] - [0, 0, 1])
    o[-1, 0] = 9
    d = np.float32(np.tile([0.1, -0.1, 1.0], (count, 1)))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    bundle = RayBundle(mi.Point3f(np.ascontiguousarray(o.T)), mi.Vector3f(np.ascontiguousarray(d.T)))
    dr.eval(bundle.o, bundle.d)
    return bundle


def test_weights_of_samples_are_those_of_compositing(variant_rgb: str) -> None:
    """Two rays of three samples and one, packed: the share of a sample is T before it minus T behind it."""
    sigma, dt = np.float32([0.5, 2, 1, 3]), np.float32([0.2, 0.4, 1.0, 0.5])
    samples = RaySamples(mi.UInt32(0, 0, 0, 1), mi.Float(0, 1, 2, 0), mi.Float(dt), mi.UInt32(0, 3), mi.UInt32(3, 1))
    T = np.exp(-np.concatenate([[0], np.cumsum((sigma * dt)[:3].astype(np.float64))]))
    wanted = [*(T[:-1] - T[1:]), 1 - np.exp(-1.5)]
    np.testing.assert_allclose(np.array(_find_weights(samples, mi.Float(sigma))), wanted, rtol=1e-6)


@pytest.mark.parametrize("u", [None, 0.37])
def test_rounds_are_merged_in_order_and_fill_the_ray(variant_rgb: str, u: float | None) -> None:
    lattice = Lattice(dr.zeros(mi.TensorXf, (3, 3, 3, 1)), np.eye(4))
    strata = cut_into_strata(lattice, rays(20), 8, u)
    crossing = dr.width(strata.ray)
    assert 0 < crossing < 20
    weights = np.zeros((crossing, 8), np.float32)
    weights[:, 5] = 1
    t, dt = (np.array(a, np.float64).reshape(crossing, 24) for a in merge_rounds(strata, mi.Float(weights.ravel()), 16, u))
    assert (np.diff(t, axis=1) >= -1e-6).all()
    length, begin = 8 * np.array(strata.dt, np.float64), np.array(strata.begin, np.float64)
    np.testing.assert_allclose(dt.sum(axis=1), length, rtol=1e-5)
    assert (dt >= 0).all()
    # All 16 of the second round, but for 16 x 1e-5 of them, lie in the sixth stratum, beside one of the first round.
    place = np.floor((t - begin[:, None]) / np.array(strata.dt)[:, None] + 1e-5)
    assert ((place == 5).sum(axis=1) >= 16).all()
    first = np.sort(np.array(strata.t).reshape(crossing, 8), axis=1)
    assert all(np.isin(np.float32(a), np.float32(b)).all() for a, b in zip(first, t, strict=True))


def test_even_weights_give_even_samples(variant_rgb: str) -> None:
    lattice = Lattice(dr.zeros(mi.TensorXf, (3, 3, 3, 1)), np.eye(4))
    strata = cut_into_strata(lattice, rays(4), 4, None)
    t, _ = merge_rounds(strata, dr.full(mi.Float, 0.25, dr.width(strata.t)), 8, None)
    crossing = dr.width(strata.ray)
    share = (np.array(t).reshape(crossing, 12) - np.array(strata.begin)[:, None]) / (4 * np.array(strata.dt)[:, None])
    expected = np.sort([*((np.arange(8) + 0.5) / 8), *((np.arange(4) + 0.5) / 4)])
    np.testing.assert_allclose(share, np.tile(expected, (crossing, 1)), atol=2e-6)


def test_both_networks_have_their_derivatives(variant_rgb: str) -> None:
    """Of a loss on the colours and transmittances of both, at the samples of one render; samples do not move."""
    place = np.eye(4)
    field = find_region(replace(NerfField.random(SIZES, place, seed=3)), 4)
    assert field.numbers == 2 * SIZES.size and field.coarse.numbers == SIZES.size
    bundle, rng = rays(6), np.random.default_rng(1)
    by = [RayGradient(mi.Color3f(np.float32(rng.normal(size=(3, 6)))), mi.Float(np.float32(rng.normal(size=6)))) for _ in "ab"]
    renders = render_hierarchical(SampledModel.from_field(field, 0.0), bundle, 0.4)
    each = [vjp_samples(one, slope) for one, slope in zip(renders, by, strict=True)]
    gradient = np.array(join_slopes(each)["weights"], np.float64)
    assert len(gradient) == 2 * SIZES.size

    def loss(weights: np.ndarray) -> float:
        """At the fixed samples: composited in float64 from the values of both networks."""
        changed, total = replace(field, weights=mi.Float(np.float32(weights))), 0.0
        for one, network, slope in zip(renders, (changed, changed.coarse), by, strict=True):
            samples = one.samples
            values = network.evaluate(samples.points(bundle), samples.directions(bundle))
            sigma, dt, ray = (np.array(a, np.float64) for a in (values.sigma, samples.dt, samples.ray))
            colour, tau, light = np.array(values.colour, np.float64).T, np.zeros(6), np.zeros((6, 3))
            for k, r in enumerate(ray.astype(int)):
                light[r] += np.exp(-tau[r]) * -np.expm1(-sigma[k] * dt[k]) * colour[k]
                tau[r] += sigma[k] * dt[k]
            total += float((np.array(slope.colour).T * light).sum() + (np.array(slope.T) * np.exp(-tau)).sum())
        return total

    weights, h = np.array(field.weights, np.float64), 4e-3
    for k in (int(np.abs(gradient[: SIZES.size]).argmax()), SIZES.size + int(np.abs(gradient[SIZES.size :]).argmax())):
        step = np.zeros(len(weights))
        step[k] = h
        slope = (loss(weights + step) - loss(weights - step)) / (2 * h)
        # float32 rounds the loss by 1e-6 / h; the third derivative adds h^2.
        assert slope == pytest.approx(gradient[k], rel=0.01)
