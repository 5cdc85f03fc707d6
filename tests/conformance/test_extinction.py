"""Every kind of extinction answers the same questions along a ray, and its derivatives are transposes of each other."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.activation import activation_of
from mivol.transport.media.activated_grid_extinction import ActivatedGridExtinction
from mivol.transport.media.constant_extinction import ConstantExtinction
from mivol.transport.media.extinction import ExactExtinction, RayInterval
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.traversal.empty_blocks import block_bounds, empty_block_distances
from mivol.transport.traversal.lattice import Lattice

pytestmark = pytest.mark.usefixtures("variant_rgb")

RES, RAYS = (9, 10, 11), 64
BOX = np.diag([2.0, 2.0, 2.0, 1.0]) + np.pad(np.full((3, 1), -1.0), ((0, 1), (3, 0)))
"""The unit cube as [-1, 1]^3."""


def noise(channels: int, low: float) -> Lattice:
    """A grid of noise that is empty in one half; blocks without values are skipped."""
    values = np.random.default_rng(3).uniform(low, 2, (*RES, channels)).astype(np.float32)
    values[:, :, 5:] = min(low, 0)
    values, occupied = mi.TensorXf(values), mi.TensorXf(np.maximum(values, 0))
    return Lattice(values, BOX, empty_block_distances(block_bounds(occupied), RES))


KINDS: dict[str, Callable[[], ExactExtinction]] = {
    "a grey constant": lambda: ConstantExtinction("sigma_t", mi.Float(0.7)),
    "an rgb constant": lambda: ConstantExtinction("sigma_t", mi.Color3f(0.7, 0.1, 1.3)),
    "a grey grid": lambda: GridExtinction("sigma_t", noise(1, 0)),
    "an rgb grid": lambda: GridExtinction("sigma_t", noise(3, 0)),
    "relu of a grid": lambda: ActivatedGridExtinction("sigma_t", noise(1, -2), activation_of("relu")),
    "exp of a grid": lambda: ActivatedGridExtinction("sigma_t", Lattice(noise(1, -2).values, BOX), activation_of("exp")),
}


def rays() -> tuple[mi.Ray3f, mi.Float, mi.Float]:
    """Rays around and through the box, and an interval of each that begins inside for some."""
    rng = np.random.default_rng(5)
    d = rng.normal(size=(3, RAYS))
    o = rng.uniform(-0.9, 0.9, (3, RAYS)) - 1.5 * (d := d / np.linalg.norm(d, axis=0))
    ray = mi.Ray3f(mi.Point3f(o.astype(np.float32)), mi.Vector3f(d.astype(np.float32)))
    return ray, mi.Float(rng.uniform(0, 1.5, RAYS).astype(np.float32)), mi.Float(rng.uniform(1.5, 4, RAYS).astype(np.float32))


def numbers(rows: list[mi.Float]) -> np.ndarray:
    return np.array([np.broadcast_to(np.array(row, np.float64), RAYS) for row in rows])


@pytest.mark.parametrize("name", [name for name in KINDS if "relu" not in name])
def test_an_optical_depth_is_the_sum_of_the_values_on_its_way(name: str) -> None:
    part, (ray, t0, t1), n = KINDS[name](), rays(), 4000
    dt = (t1 - t0) / n
    total = np.zeros((part.channels, RAYS))
    for first in range(0, n, 500):
        k = dr.repeat(dr.arange(mi.Float, 500), RAYS) + first + 0.5
        lane = dr.tile(dr.arange(mi.UInt32, RAYS), 500)
        many, start, step = (dr.gather(type(x), x, lane) for x in (ray, t0, dt))
        rows = part.eval_at(mi.Float(1), many, start + k * step, mi.Bool(True))
        total += np.array([np.broadcast_to(np.array(r, np.float64), 500 * RAYS).reshape(500, RAYS).sum(axis=0) for r in rows])
    largest = np.exp(2) if "exp" in name else 2.0
    found = numbers(part.integrate(RayInterval(ray, t0, t1, mi.Bool(True))))
    # A sum at midpoints misses half a step at each of the two faces of the box, and less inside; a point counts as inside up to
    # 1e-3 of a voxel beyond a face (lattice.locate). Two Gauss points a cell are wrong by up to 2 % of what an activation makes
    # of noise (the table of mivol.fields.activation, an optical depth of 0.1 to 1 a voxel: 0.5 % rms; relu has edges).
    beyond = 2 * 1e-3 * (2 / min(RES)) / np.abs(np.array(ray.d)).min(axis=0)
    bound = largest * (np.array(dt) + beyond) + (0.02 * found if " of " in name else 1e-5)
    assert (np.abs(total * np.array(dt) - found) < bound).all()


@pytest.mark.parametrize("where", ["along an interval", "at a point"])
@pytest.mark.parametrize("name", KINDS)
def test_derivatives_are_transposes(name: str, where: str) -> None:
    """<J v, w> = <v, J^T w>, for a tangent that is not 0 where the values are; and J v is not 0."""
    part, (ray, t0, t1), on = KINDS[name](), rays(), mi.Bool(True)
    rng = np.random.default_rng(8)
    dr.enable_grad(part.values)
    shape = dr.shape(part.scaled(mi.Float(1)))
    v = rng.normal(size=shape).astype(np.float32)
    w = rng.normal(size=(part.channels, RAYS)).astype(np.float32)
    weight, gradient = [mi.Float(row) for row in w], part.start_gradient()
    with dr.suspend_grad():
        tangent = type(dr.detach(part.values))(v)
        if where == "at a point":
            jvp = numbers(part.jvp_at(tangent, ray, 0.5 * (t0 + t1), on))
            part.vjp_at(gradient, weight, ray, 0.5 * (t0 + t1), on)
        else:
            jvp = numbers(part.jvp(tangent, RayInterval(ray, t0, t1, on)))
            part.vjp(gradient, weight, RayInterval(ray, t0, t1, on))
    dr.backward(part.deliver(mi.Float(1), gradient))
    vjp = np.array(dr.grad(part.values), np.float64).reshape(shape)
    # Each of the terms is rounded a few times: 1e-6 of the sum of their sizes is 16 roundings of float32 each.
    terms = np.abs(jvp * w).sum() + np.abs(v * vjp).sum()
    assert np.abs(jvp).max() > 0.01
    assert abs((jvp * w).sum() - (v * vjp).sum()) < 1e-6 * terms
