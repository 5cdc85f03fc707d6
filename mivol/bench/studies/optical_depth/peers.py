"""Other methods for the transmittance of rays: marching, ratio and delta tracking, ``volpath``, ``drjit.dda``, float64 NumPy.

Conventions. Every method gets the same rays through the same grid over [-1, 1]^3 and returns one transmittance for each ray.
Marching and tracking read a ``Texture3f``, as a user of Mitsuba would write them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import drjit.dda
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from mivol.bench.extinctions import TO_WORLD
from mivol.bench.harness.timing import Contestant
from mivol.bench.reference_walk import GridRays
from mivol.bench.scenes import box_scene


def intersect_box(o: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
    """Hit, entry and exit distance of rays and the box, by Mitsuba's bounding box."""
    hit, t0, t1 = mi.BoundingBox3f(mi.Point3f(-1), mi.Point3f(1)).ray_intersect(mi.Ray3f(o, d))
    return hit & (t1 > 0), dr.maximum(t0, 0), t1


def look_up(texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, t: mi.Float, active: mi.Bool) -> mi.Float:
    """Extinction at a distance along a ray."""
    return texture.eval(dr.fma(dr.fma(d, t, o), 0.5, 0.5), active)[0]


@dr.syntax
def march(texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, steps: mi.UInt32) -> mi.Float:
    """Transmittance by the midpoint rule, with equal steps through the box."""
    active, t0, t1 = intersect_box(o, d)
    dt = (t1 - t0) / mi.Float(steps)
    tau, i = mi.Float(0), mi.UInt32(0)
    while active & (i < steps):
        tau += look_up(texture, o, d, dr.fma(mi.Float(i) + 0.5, dt, t0), active)
        i += 1
    return dr.exp(-dr.select(active, tau * dt, 0))


Survival = Callable[["mi.Float", "mi.Sampler", "mi.Bool"], "mi.Float"]
"""Probability of a real collision -> factor of the transmittance."""


def ratio_survival(p_real: mi.Float, sampler: mi.Sampler, active: mi.Bool) -> mi.Float:
    """Ratio tracking: the expected surviving share."""
    return 1 - p_real


def delta_survival(p_real: mi.Float, sampler: mi.Sampler, active: mi.Bool) -> mi.Float:
    """Delta tracking: 0 or 1 at random."""
    return dr.select(sampler.next_1d(active) < p_real, 0, mi.Float(1))


@dr.syntax
def track(
    texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, majorant: mi.Float, sampler: mi.Sampler, survive: Survival
) -> mi.Float:
    """Unbiased transmittance by tracking with one majorant."""
    active, t, t1 = intersect_box(o, d)
    T = mi.Float(1)
    while active:
        t -= dr.log(1 - sampler.next_1d(active)) / majorant
        active &= t < t1
        p_real = look_up(texture, o, d, t, active) / majorant
        T *= dr.select(active, survive(p_real, sampler, active), 1)
        active &= T > 0
    return T


def mean_of_samples(rays: GridRays, spp: int, seed: int, estimate: Callable) -> mi.Float:
    """Mean of ``spp`` estimates for each ray; the samples of a ray are adjacent, as in a renderer."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, rays.n * spp)
    ray = dr.arange(mi.UInt32, rays.n * spp) // dr.opaque(mi.UInt32, spp)
    o, d = dr.gather(mi.Point3f, rays.o, ray), dr.gather(mi.Vector3f, rays.d, ray)
    return dr.block_sum(estimate(o, d, sampler), spp) / spp


def marching(rays: GridRays, steps: int) -> Contestant:
    """Contestant: ray marching in equal steps over a Texture3f."""
    texture = mi.Texture3f(rays.tensor, wrap_mode=dr.WrapMode.Clamp)
    return lambda _: march(texture, rays.o, rays.d, dr.opaque(mi.UInt32, steps))


def tracking(rays: GridRays, spp: int, survive: Survival) -> Contestant:
    """Contestant: ``spp`` random walks for each ray over a Texture3f."""
    texture = mi.Texture3f(rays.tensor, wrap_mode=dr.WrapMode.Clamp)
    majorant = dr.opaque(mi.Float, float(rays.values.max()))
    return lambda seed: mean_of_samples(rays, spp, seed, lambda o, d, s: track(texture, o, d, majorant, s, survive))


def volpath(rays: GridRays, spp: int) -> Contestant:
    """Contestant: ``spp`` paths of Mitsuba's ``volpath`` for each ray, under a sky of radiance 1."""
    scene = mi.load_dict(box_scene(rays.values, 8))
    integrator = mi.load_dict({"type": "volpath", "max_depth": 1})

    def paths(o: mi.Point3f, d: mi.Vector3f, sampler: mi.Sampler) -> mi.Float:
        return integrator.sample(scene, sampler, mi.RayDifferential3f(o, d))[0].x

    return lambda seed: mean_of_samples(rays, spp, seed, paths)


def pad_for_drjit(values: np.ndarray) -> mi.TensorXf:
    """Pad a grid by one voxel on each side for ``drjit.dda.integrate``, whose nodes lie at the corners of its box."""
    return mi.TensorXf(np.pad(values, 1, mode="edge"))


def integrate_by_drjit(rays: GridRays, padded: mi.TensorXf) -> mi.Float:
    """Optical depth of each ray by ``drjit.dda.integrate`` over a padded grid; rays are clipped to the true box."""
    size = np.array(rays.values.shape[::-1])
    low, high = mi.Vector3f((-1 - 1 / size).tolist()), mi.Vector3f((1 + 1 / size).tolist())
    hit, t0, t1 = intersect_box(rays.o, rays.d)
    start = mi.Vector3f(dr.fma(rays.d, t0, rays.o))
    return drjit.dda.integrate(start, rays.d, t1 - t0, low, high, padded, active=hit)


def exact_tau(values: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Optical depths (n,) of rays in float64.

    A ray crosses planes through voxel centres. Between two adjacent planes a trilinear field is a cubic along the ray, and two
    Gauss points integrate this cubic exactly.

    Args:
        values: (Z, Y, X) extinction in the box ``TO_WORLD``.
        o, d: origins and directions (n, 3).
    """
    chunk = max(1, (1 << 20) // sum(values.shape))
    return np.concatenate([_exact_tau(np.float64(values), o[i : i + chunk], d[i : i + chunk]) for i in range(0, len(o), chunk)])


def _exact_tau(values: np.ndarray, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    size, inverse = np.array(values.shape[::-1]), np.linalg.inv(TO_WORLD)
    q = (o @ inverse[:3, :3].T + inverse[:3, 3]) * size - 0.5
    v = d @ inverse[:3, :3].T * size
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = np.sort(np.stack([(-0.5 - q) / v, (size - 0.5 - q) / v]), axis=0)
        planes = np.concatenate([(np.arange(n) - q[:, a, None]) / v[:, a, None] for a, n in enumerate(size)], axis=1)
    t0 = np.maximum(faces[0].max(axis=1), 0)[:, None]
    t1 = np.maximum(faces[1].min(axis=1)[:, None], t0)
    t = np.sort(np.concatenate([t0, np.clip(planes, t0, t1), t1], axis=1), axis=1)
    length, tau = np.diff(t, axis=1), np.zeros(len(o))
    for g in (0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6):
        at = q[:, None] + (t[:, :-1] + g * length)[..., None] * v[:, None]
        tau += 0.5 * np.sum(
            length * map_coordinates(values, np.moveaxis(at[..., ::-1], -1, 0), order=1, mode="nearest"), axis=1
        )
    return tau
