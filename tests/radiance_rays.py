"""Radiance fields and rays through them: the same for analytic tests and for hard cases."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import (
    RayBundle,
    RayGradient,
    RenderedRays,
    find_occupied_cells,
    make_model,
    render_rays,
    vjp_rays,
)
from mivol.transport.line_integrals.radiance_source import bake, make_exact
from mivol.transport.traversal.occupied_cells import CellIndex

TO_WORLD = np.array([[2.0, 0.3, 0.0, -1.2], [-0.2, 1.5, 0.1, -0.7], [0.0, 0.1, 2.5, -1.3], [0, 0, 0, 1]])
"""Rotated a little, sheared and of three lengths."""


def make(res=(5, 6, 7), basis=4, seed=0, scale=6.0):
    """A rough field of both signs of density, some colours below 0."""
    rng = np.random.default_rng(seed)
    return (rng.normal(0.3, 1, res) * scale).astype(np.float32), rng.normal(0, 0.4, (*res, basis, 3)).astype(np.float32)


def aim(count, to_world=TO_WORLD, seed=1):
    """Rays from around a box through it, in float32 as the kernels get them."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(0.1, 0.9, (count, 3)) @ to_world[:3, :3].T + to_world[:3, 3]
    o = np.float32(rng.normal(size=(count, 3)) * 3)
    d = target - o
    return o, np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))


def rays_of(o, d) -> RayBundle:
    o, d = (np.atleast_2d(np.asarray(a, np.float32)) for a in (o, d))
    return RayBundle(mi.Point3f(np.ascontiguousarray(o.T)), mi.Vector3f(np.ascontiguousarray(d.T)))


def followed(field, o, d, stop=0.0, pinhole=None) -> RenderedRays:
    rays, cells = rays_of(o, d), find_occupied_cells(field)
    source = make_exact(field, rays.d) if pinhole is None else bake(field, cells, np.atleast_2d(pinhole), mi.UInt32(0))
    return render_rays(cells, source, make_model(field, stop), rays)


def see(field, o, d, stop=0.0, pinhole=None):
    """Colour (n, 3), transmittance and distance."""
    seen = followed(field, o, d, stop, pinhole)
    return np.array(seen.colour).T, np.array(seen.T), np.array(seen.distance)


def derive(field: SphericalGrid, o, d, colour, T=0.0, distance=0.0, stop=0.0):
    """Derivatives of sum(colour . L + T T + distance D) for the raw densities and harmonics of the nodes."""
    rays, cells = rays_of(o, d), find_occupied_cells(field)
    source, model = make_exact(field, rays.d, slope=True), make_model(field, stop)
    seen = render_rays(cells, source, model, rays)
    vjp_rays(cells, source, model, seen, RayGradient(mi.Color3f(*colour), T, distance))
    return field.with_values(*source.slopes()).values()


def looked(index: CellIndex, shape: tuple[int, ...], ahead: tuple[bool, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Ways (levels, Z, Y, X, 3: x, y, z) from all cells, and their numbers."""
    level, z, y, x = (mi.Int32(a.ravel().astype(np.int32)) for a in np.indices(shape))
    cell, every = mi.Vector3i(x, y, z), mi.Bool(True)
    brick, free = index.look_up(cell, level, mi.Array3b(*ahead), every)
    number = index.rank(cell, dr.select(free.x == 0, brick, 0), every)
    return np.array(free).T.reshape(*shape, 3), np.array(number).reshape(shape)
