"""Error of the transmittance of rays against time, for all that could be used in the place of an exact optical depth.

Conventions. Every method gets the same rays through the same grid over [-1, 1]^3 and returns one transmittance a ray.
Marching and tracking read a ``Texture3f``, as a user of Mitsuba would write them.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import drjit.dda
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import smoke
from mivol.bench.harness.timing import Contestant, race
from mivol.bench.scenes import box_scene
from mivol.bench.studies.optical_depth.size import Size
from mivol.bench.studies.optical_depth.twin import exact_tau
from mivol.bench.studies.optical_depth.work import Work, camera_rays

__all__ = ["by_drjit_dda", "inside_box", "measure_peers", "padded"]


def inside_box(o: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
    """Where rays are in the box, as a user of Mitsuba finds it."""
    hit, t0, t1 = mi.BoundingBox3f(mi.Point3f(-1), mi.Point3f(1)).ray_intersect(mi.Ray3f(o, d))
    return hit & (t1 > 0), dr.maximum(t0, 0), t1


def look_up(texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, t: mi.Float, active: mi.Bool) -> mi.Float:
    """The extinction at a distance along a ray."""
    return texture.eval(dr.fma(dr.fma(d, t, o), 0.5, 0.5), active)[0]


@dr.syntax
def march(texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, steps: mi.UInt32) -> mi.Float:
    """Transmittance by the midpoint rule with equal steps through the box."""
    active, t0, t1 = inside_box(o, d)
    dt = (t1 - t0) / mi.Float(steps)
    tau, i = mi.Float(0), mi.UInt32(0)
    while active & (i < steps):
        tau += look_up(texture, o, d, dr.fma(mi.Float(i) + 0.5, dt, t0), active)
        i += 1
    return dr.exp(-dr.select(active, tau * dt, 0))


Survival = Callable[["mi.Float", "mi.Sampler", "mi.Bool"], "mi.Float"]
"""Takes the probability that a tentative collision is a real one; returns the factor that the transmittance gets."""


def ratio(p_real: mi.Float, sampler: mi.Sampler, active: mi.Bool) -> mi.Float:
    """Ratio tracking: the expected share that survives."""
    return 1 - p_real


def delta(p_real: mi.Float, sampler: mi.Sampler, active: mi.Bool) -> mi.Float:
    """Delta tracking: all or nothing, drawn."""
    return dr.select(sampler.next_1d(active) < p_real, 0, mi.Float(1))


@dr.syntax
def track(
    texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, majorant: mi.Float, sampler: mi.Sampler, survive: Survival
) -> mi.Float:
    """Transmittance by tracking with one majorant, unbiased with either way to survive a tentative collision."""
    active, t, t1 = inside_box(o, d)
    T = mi.Float(1)
    while active:
        t -= dr.log(1 - sampler.next_1d(active)) / majorant
        active &= t < t1
        p_real = look_up(texture, o, d, t, active) / majorant
        T *= dr.select(active, survive(p_real, sampler, active), 1)
        active &= T > 0
    return T


def each_sample(work: Work, spp: int, seed: int, estimate: Callable) -> mi.Float:
    """Mean of ``spp`` estimates a ray, those of one ray side by side, as a renderer lays them out."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, work.n * spp)
    ray = dr.arange(mi.UInt32, work.n * spp) // dr.opaque(mi.UInt32, spp)
    o, d = dr.gather(mi.Point3f, work.o, ray), dr.gather(mi.Vector3f, work.d, ray)
    return dr.block_sum(estimate(o, d, sampler), spp) / spp


def by_marching(work: Work, steps: int) -> Contestant:
    """A transmittance for each ray in ``steps`` equal steps over a Texture3f."""
    texture = mi.Texture3f(work.tensor, wrap_mode=dr.WrapMode.Clamp)
    return lambda _: march(texture, work.o, work.d, dr.opaque(mi.UInt32, steps))


def by_tracking(work: Work, spp: int, survive: Survival) -> Contestant:
    """A transmittance for each ray from ``spp`` random walks over a Texture3f."""
    texture = mi.Texture3f(work.tensor, wrap_mode=dr.WrapMode.Clamp)
    majorant = dr.opaque(mi.Float, float(work.values.max()))
    return lambda seed: each_sample(work, spp, seed, lambda o, d, s: track(texture, o, d, majorant, s, survive))


def by_volpath(work: Work, spp: int) -> Contestant:
    """A transmittance for each ray from ``spp`` paths of stock ``volpath`` under a sky of radiance 1."""
    scene = mi.load_dict(box_scene(work.values, 8))
    volpath = mi.load_dict({"type": "volpath", "max_depth": 1})

    def paths(o: mi.Point3f, d: mi.Vector3f, sampler: mi.Sampler) -> mi.Float:
        return volpath.sample(scene, sampler, mi.RayDifferential3f(o, d))[0].x

    return lambda seed: each_sample(work, spp, seed, paths)


def padded(values: np.ndarray) -> mi.TensorXf:
    """A grid for ``drjit.dda.integrate``, whose nodes lie at the corners of its box: one voxel of edge on each side."""
    return mi.TensorXf(np.pad(values, 1, mode="edge"))


def by_drjit_dda(work: Work, grid: mi.TensorXf) -> mi.Float:
    """The optical depth of each ray by ``drjit.dda.integrate`` over a padded grid: rays are cut to the true box."""
    size = np.array(work.values.shape[::-1])
    low, high = mi.Vector3f((-1 - 1 / size).tolist()), mi.Vector3f((1 + 1 / size).tolist())
    hit, t0, t1 = inside_box(work.o, work.d)
    start = mi.Vector3f(dr.fma(work.d, t0, work.o))
    return drjit.dda.integrate(start, work.d, t1 - t0, low, high, grid, active=hit)


def measure_peers(size: Size) -> dict:
    """Error of the transmittance of a ray against time, for all that could be used."""
    found = smoke()
    work = Work(found.values, *camera_rays(size.peer_side))
    tau, grid = work.tau(), padded(found.values)
    methods = {
        "mivol": {"": lambda _: dr.exp(-tau(0))},
        "volpath": {f"{s} spp": by_volpath(work, s) for s in size.volpath_spp},
        "ratio tracking": {f"{s} spp": by_tracking(work, s, ratio) for s in size.peer_spp},
        "delta tracking": {f"{s} spp": by_tracking(work, s, delta) for s in size.peer_spp},
        "marching": {f"{n} steps": by_marching(work, n) for n in size.march_steps},
        "drjit.dda.integrate": {"": lambda _: dr.exp(-by_drjit_dda(work, grid))},
    }
    flat = {(method, setting): call for method, settings in methods.items() for setting, call in settings.items()}
    timings = race(flat, size.peer_rounds, keep=True)
    index, o, d = work.spread(size.exact_rays)
    exact = np.exp(-exact_tau(found.values, o, d)[0])
    figures = {"grid": str(found), "rays": work.n, "exact_rays": len(index)}
    for (method, setting), t in timings.items():
        error = np.array([T[index] - exact for T in t.results])
        errors = {"rms_error": float(np.sqrt(np.mean(error**2))), "mean_error": float(np.mean(error))}
        figures.setdefault(method, []).append({"setting": setting} | errors | t.report(work.n, "rays"))
    return figures
