"""Gaussians along rays, compared with their float64 twin; the twin is compared with quadrature of its values at points."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from scipy.integrate import quad
from scipy.special import logit

from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, GaussianField
from mivol.points.gaussians import Gaussians
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.gaussian_extinction import GaussianExtinction

RAYS, SCALE = 64, 1.5

ROUNDING = 2e-5
"""Of a depth in float32: a place in a box of size 2 is known to 2e-7, which is 4e-6 of the smallest scale; a depth of
exp(-m^2 / 2) changes by m of it, and m is at most REACH: 1.6e-5."""


def cloud(count: int, seed: int = 0) -> Gaussians:
    """Flat and long, faint and nearly opaque Gaussians, with quaternions of any length."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=rng.uniform(-0.6, 0.6, (count, 3)),
        log_scales=np.log(rng.uniform(0.05, 0.3, (count, 3))),
        quaternions=rng.normal(size=(count, 4)),
        opacity_logits=logit(rng.uniform(0.05, 0.95, count)),
        harmonics=np.zeros((count, 1, 3)),
    )


def rays(seed: int = 1, away: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Rays through the cloud, from a sphere around it: origins and unit directions (RAYS, 3), in float32 precision."""
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(RAYS, 3))
    o *= away / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.5, 0.5, (RAYS, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return o.astype(np.float32).astype(np.float64), d.astype(np.float32).astype(np.float64)


def interval(o: np.ndarray, d: np.ndarray, t0: np.ndarray, t1: np.ndarray) -> RayInterval:
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    return RayInterval(ray, mi.Float64(t0), mi.Float64(t1), dr.full(mi.Bool, True, len(o)))


def part_of(gaussians: Gaussians, scale: float = SCALE) -> GaussianExtinction:
    return GaussianExtinction("sigma_t", GaussianField.from_gaussians(gaussians, np.eye(4)), mi.Float(scale))


SPANS = {"through": (0.0, np.inf), "up to the middle": (0.0, 2.0), "a piece": (1.7, 2.2), "from the middle on": (2.0, np.inf)}


@pytest.mark.parametrize("span", SPANS)
@pytest.mark.parametrize("count", [1, 8, 50])
def test_depths_along_rays_are_those_of_the_twin(count: int, span: str) -> None:
    gaussians, (o, d) = cloud(count), rays()
    t0, t1 = (np.full(RAYS, t) for t in SPANS[span])
    truth = oracle.optical_depth(oracle.Cloud.of(gaussians), o, d, t0, t1)
    (tau,) = part_of(gaussians).integrate(interval(o, d, t0, t1))
    assert truth.max() > 0.05
    np.testing.assert_allclose(np.array(tau), truth, rtol=ROUNDING, atol=ROUNDING)


def test_the_depth_of_the_twin_is_the_integral_of_its_extinction() -> None:
    """By adaptive quadrature between the ends of each Gaussian. The twin loses nothing of splatting's Gaussians but the cut
    tails."""
    gaussians, (o, d) = oracle.Cloud.of(cloud(3)), rays()
    for ray in range(6):
        origin, direction = o[ray : ray + 1], d[ray : ray + 1]
        line = oracle.see(gaussians, origin, direction)
        half = np.sqrt(np.maximum(oracle.REACH**2 - line.m2, 0)) / line.speed
        ends = np.sort(np.concatenate([line.peak - half, line.peak + half]).ravel())
        value = lambda t, o=origin, d=direction: oracle.extinction(gaussians, o + t * d, d).sum()  # noqa: E731
        found = sum(quad(value, a, b, epsabs=1e-10)[0] for a, b in itertools.pairwise(ends))
        (tau,) = oracle.optical_depth(gaussians, origin, direction, np.zeros(1), np.full(1, np.inf))
        assert tau == pytest.approx(found, abs=1e-8)
        composited = 1 - np.prod(np.exp(-line.depth))
        assert 1 - np.exp(-tau) == pytest.approx(composited, abs=3 * np.exp(-(oracle.REACH**2) / 2))


def test_a_ray_may_begin_inside_and_far_away() -> None:
    """From 1000 box sizes away, a float32 direction misses by 1e-4; the entry point near the box does not."""
    gaussians = cloud(8)
    _, d = rays()
    o = np.zeros_like(d)
    inside = oracle.optical_depth(oracle.Cloud.of(gaussians), o, d, np.zeros(RAYS), np.full(RAYS, np.inf))
    (tau,) = part_of(gaussians).integrate(interval(o, d, np.zeros(RAYS), np.full(RAYS, np.inf)))
    np.testing.assert_allclose(np.array(tau), inside, rtol=ROUNDING, atol=ROUNDING)
    away, along = np.array([[0.05, 0.1, -4096.0]]).repeat(RAYS, axis=0), np.array([[0.0, 0.0, 1.0]]).repeat(RAYS, axis=0)
    away[:, :2] += (np.arange(RAYS)[:, None] - 32) / 128
    truth = oracle.optical_depth(oracle.Cloud.of(gaussians), away, along, np.zeros(RAYS), np.full(RAYS, np.inf))
    (tau,) = part_of(gaussians).integrate(interval(away, along, np.zeros(RAYS), np.full(RAYS, np.inf)))
    np.testing.assert_allclose(np.array(tau), truth, rtol=ROUNDING, atol=ROUNDING)


def test_a_walk_may_stop_where_enough_is_met() -> None:
    gaussians, (o, d) = cloud(50), rays()
    there = interval(o, d, np.zeros(RAYS), np.full(RAYS, np.inf))
    part = part_of(gaussians)
    (whole,), (short,) = (part.integrate(there, enough) for enough in (None, mi.Float(0.5)))
    whole, short = np.array(whole), np.array(short)
    np.testing.assert_array_equal(short[whole < 0.5], whole[whole < 0.5])
    assert (short[whole > 0.5] > 0.5).all() and (short <= whole).all() and (short < whole).any()


def test_extinctions_at_points_are_those_of_the_twin() -> None:
    gaussians, (o, d) = cloud(50), rays()
    t = np.random.default_rng(2).uniform(1.2, 2.8, RAYS).astype(np.float32)
    truth = oracle.extinction(oracle.Cloud.of(gaussians), o + t[:, None].astype(np.float64) * d, d).sum(axis=1)
    there = interval(o, d, np.zeros(RAYS), np.ones(RAYS))
    (value,) = part_of(gaussians).eval_at(mi.Float(SCALE), there.ray, mi.Float(t), there.active)
    assert truth.max() > 1
    # The slope of an extinction by a whitened place is at most itself, about 1 / (0.05 sqrt(2 pi)) = 8 for each of a few.
    np.testing.assert_allclose(np.array(value), SCALE * truth, rtol=ROUNDING, atol=8 * ROUNDING)
    (outside,) = part_of(gaussians).eval_at(mi.Float(SCALE), there.ray, mi.Float(40), there.active)
    assert not np.array(outside).any()


def differences(value: object, gaussians: oracle.Cloud) -> dict[str, np.ndarray]:
    """Central differences (parameter..., rays) of ``value(cloud)`` by each parameter; the error of steps of 1e-5 is 1e-9."""
    found = {}
    for name in EXTINCTION_PARAMETERS:
        shape, step = getattr(gaussians, name).shape, 1e-5
        rows = []
        for k in range(int(np.prod(shape))):
            change = np.zeros(shape)
            change.flat[k] = step
            rows.append((value(gaussians.moved(name, change)) - value(gaussians.moved(name, -change))) / (2 * step))
        found[name] = np.array(rows).reshape(*shape, -1)
    return found


def follow(part: GaussianExtinction, there: RayInterval, t: mi.Float | None, weight: np.ndarray) -> tuple[dict, np.ndarray]:
    """The gradient of a weighted sum of depths (at a distance t: of extinctions), and two numbers that must agree.

    The numbers are the change of the sum along random changes of all parameters and of the scale: by the tangent, and by the
    gradient.
    """
    rng, tensors, scale = np.random.default_rng(5), part.field.tensors, mi.Float(SCALE)
    dr.enable_grad(scale, *tensors.values())
    gradient = part.start_gradient()
    if t is None:
        part.vjp(gradient, [mi.Float(weight)], there)
    else:
        part.vjp_at(gradient, [mi.Float(weight)], there.ray, t, there.active)
    dr.backward(dr.sum(dr.ravel(part.scaled(scale)) * part.fold_gradient(gradient)))
    by_name = {name: np.array(dr.grad(tensor)) for name, tensor in tensors.items()} | {"scale": np.array(dr.grad(scale))}
    change = {name: rng.normal(size=value.shape) for name, value in by_name.items()}
    for name, tensor in tensors.items():
        dr.set_grad(tensor, mi.TensorXf(change[name].astype(np.float32)))
    dr.set_grad(scale, mi.Float(change["scale"]))
    scaled = part.scaled(scale)
    dr.forward_to(scaled)
    tangent = dr.detach(dr.grad(scaled))
    (row,) = part.jvp(tangent, there) if t is None else part.jvp_at(tangent, there.ray, t, there.active)
    along = sum((by_name[name] * change[name]).sum() for name in by_name)
    return by_name, np.array([np.dot(np.array(row, np.float64), weight), along])


@pytest.mark.parametrize("at", ["along a ray", "at a point"])
@pytest.mark.parametrize("count", [1, 8, pytest.param(50, marks=pytest.mark.slow)])
def test_derivatives_by_every_parameter_are_finite_differences_of_the_twin(count: int, at: str) -> None:
    """Derivatives of a weighted sum over rays, at a fixed cut; the tangent is the transpose of the gradient."""
    gaussians, (o, d) = cloud(count, seed=3), rays()
    twin = oracle.Cloud.of(gaussians)
    weight = np.random.default_rng(4).normal(size=RAYS)
    t0, t1 = np.full(RAYS, 1.0), np.full(RAYS, 2.1)
    if at == "along a ray":
        cut, t = oracle.find_cut(twin, o, d, t0, t1), None
        value = lambda c: oracle.optical_depth(c, o, d, t0, t1, cut)  # noqa: E731
    else:
        t = np.random.default_rng(2).uniform(1.5, 2.5, RAYS).astype(np.float32)
        p = o + t[:, None].astype(np.float64) * d
        held = oracle.extinction(twin, p, d) > 0
        value = lambda c: np.where(held, oracle.extinction(c, p, d, np.inf), 0).sum(axis=1)  # noqa: E731
    truth = {name: SCALE * row @ weight for name, row in differences(value, twin).items()}
    part = part_of(gaussians)
    found, (forward, reverse) = follow(part, interval(o, d, t0, t1), None if t is None else mi.Float(t), weight)
    for name in EXTINCTION_PARAMETERS:
        size = np.abs(truth[name]).max()
        assert size > 1e-3
        # A derivative sums RAYS terms that cancel, each known to a few times ROUNDING.
        np.testing.assert_allclose(found[name], truth[name], rtol=0, atol=2e-4 * size, err_msg=name)
    np.testing.assert_allclose(found["scale"], value(twin) @ weight, rtol=1e-4, atol=1e-4)
    assert forward == pytest.approx(reverse, rel=1e-4)
