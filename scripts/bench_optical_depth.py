#!/usr/bin/env python3
"""What does an exact optical depth cost, and how exact is it, beside what else could be used?

    scripts/bench_optical_depth.py                        # under 10 minutes on 2 cores
    scripts/bench_optical_depth.py --quick                # under a minute, small sizes: are the errors within their bars?
    scripts/bench_optical_depth.py --only walk,grids      # parts of it

Contestants trace the same rays through the same grid in the same run, in turns: rounds go through all of them, each round
in another order. A time is the median over the rounds, the fastest one beside it; a ratio of times is the median of the
ratios within a round. What the first call pays is reported apart: seconds in the compiler, or kernels that were found on
disk (HOME=$(mktemp -d) hides those). Errors are against a twin in float64 NumPy. Prints JSON; writes
bench_optical_depth.json and bench_optical_depth.png. Each figure that has a bar is printed beside it.

The smoke of the Mitsuba tutorial and a CT scan are read from MIVOL_DATA (default ../shared/data); where they are missing,
made-up fields of the same sizes take their place, and the JSON says so.
"""

from __future__ import annotations

import gc
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from contest import (
    AT_LEAST,
    AT_MOST,
    TO_WORLD,
    Bench,
    Contestant,
    box_of,
    clock,
    ct_scan,
    describe,
    judge,
    made_up,
    perspective,
    race,
    ratio_of,
    smoke,
    threads_in_space,
)
from mivol.report.figures import Series, plot_error_against_time
from mivol.transport.media.grid_integral import Gradient, backproject_segment, integrate_tau
from mivol.transport.traversal.empty_blocks import block_bounds, find_empty_distances
from mivol.transport.traversal.grid_walk import walk
from mivol.transport.traversal.lattice import Lattice, clip

import drjit as dr
import drjit.dda
import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class Size:
    """How much work is done. Sides are of square pictures in pixels, so rays are sides squared."""

    name: str = "full"
    rounds: int = 7
    walk_side: int = 1024
    image_side: int = 256
    image_spp: int = 16
    exact_pixels: int = 192
    exact_rays: int = 4096
    accuracy_res: tuple[int, ...] = (64, 256)
    memory_sides: tuple[int, ...] = (256, 512, 1024)
    grid_side: int = 512
    ct_res: int = 256
    sparse_res: int = 512
    peer_rounds: int = 3
    peer_side: int = 512
    peer_spp: tuple[int, ...] = (1, 4, 16, 64)
    volpath_spp: tuple[int, ...] = (1, 4, 16)
    march_steps: tuple[int, ...] = (16, 32, 64, 128, 256, 512, 1024)


FULL = Size()
QUICK = Size(
    name="quick",
    rounds=3,
    walk_side=256,
    image_side=64,
    image_spp=4,
    exact_pixels=32,
    exact_rays=1024,
    accuracy_res=(64,),
    memory_sides=(64, 128, 256),
    grid_side=128,
    ct_res=64,
    sparse_res=128,
    peer_side=64,
    peer_spp=(1, 4),
    volpath_spp=(1, 4),
    march_steps=(16, 64, 256),
)


# -- Fields and rays -------------------------------------------------------------------------------------------------------


@dataclass
class Work:
    """The work that contestants share: an extinction in the box, and world rays.

    ``o`` and ``d`` are evaluated, and of float32 like everything that the contestants see.
    """

    values: np.ndarray
    o: mi.Point3f
    d: mi.Vector3f

    def __post_init__(self) -> None:
        self.tensor = mi.TensorXf(np.ascontiguousarray(self.values[..., None]))
        self.n = dr.width(self.d)

    def lattice(self, skip: bool = False) -> Lattice:
        """The grid for mivol's walk, empty blocks skipped or not."""
        return Lattice(self.tensor, TO_WORLD, find_empty_distances(self.tensor) if skip else None)

    def tau(self, skip: bool = False) -> Contestant:
        """The optical depth of each ray by mivol."""
        lattice = self.lattice(skip)
        return lambda _: integrate_tau(lattice, self.o, self.d)

    def some(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers, origins and directions of rays spread evenly over all: (m,), (m, 3), (m, 3) float64."""
        index = np.linspace(0, self.n - 1, min(count, self.n)).astype(int)
        return index, np.array(self.o).T[index].astype(np.float64), np.array(self.d).T[index].astype(np.float64)


def camera_rays(side: int, pixels: np.ndarray | None = None, k: int = 1) -> tuple[mi.Point3f, mi.Vector3f]:
    """Rays through the middles of the k x k parts of each pixel, row by row."""
    pixels = np.arange(side * side) if pixels is None else pixels
    y, x, j, i = (np.broadcast_to(a, (len(pixels), k, k)) for a in (*_pixel(pixels, side), *_part(k)))
    at = mi.Point2f(np.float32((x + (i + 0.5) / k).ravel() / side), np.float32((y + (j + 0.5) / k).ravel() / side))
    ray, _ = mi.load_dict(perspective(side)).sample_ray(0.0, 0.5, at, mi.Point2f(0.5))
    o, d = mi.Point3f(ray.o) + dr.zeros(mi.Point3f, dr.width(ray.d)), mi.Vector3f(ray.d)
    dr.eval(o, d)
    return o, d


def _pixel(pixels: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    return (pixels // side)[:, None, None], (pixels % side)[:, None, None]


def _part(k: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(k)[None, :, None], np.arange(k)[None, None, :]


def shuffled(o: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Point3f, mi.Vector3f]:
    """The same rays in an order drawn from the seed 0."""
    order = mi.UInt32(np.random.default_rng(0).permutation(dr.width(d)).astype(np.uint32))
    o, d = dr.gather(mi.Point3f, o, order), dr.gather(mi.Vector3f, d, order)
    dr.eval(o, d)
    return o, d


# -- The twin in float64 ---------------------------------------------------------------------------------------------------


def exact_tau(values: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Optical depth of rays in float64 NumPy, and the measure of its error.

    All planes through voxel centres that a ray crosses are sorted, and two Gauss points between each pair integrate the
    cubic that a trilinear field is there.

    Args:
        values: (Z, Y, X), over ``TO_WORLD``.
        o, d: (n, 3).

    Returns:
        int sigma and int (sigma + |grad sigma|), the gradient over one voxel: (n,) each.
    """
    size = np.array(values.shape[::-1])
    chunk = max(1, (1 << 20) // int(size.sum()))
    parts = [_exact_tau(values, size, o[i : i + chunk], d[i : i + chunk]) for i in range(0, len(o), chunk)]
    return tuple(np.concatenate(p) for p in zip(*parts, strict=True))


def _exact_tau(values: np.ndarray, size: np.ndarray, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    inverse = np.linalg.inv(TO_WORLD)
    q = (o @ inverse[:3, :3].T + inverse[:3, 3]) * size - 0.5
    v = d @ inverse[:3, :3].T * size
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = np.sort(np.stack([(-0.5 - q) / v, (size - 0.5 - q) / v]), axis=0)
        planes = np.concatenate([(np.arange(n) - q[:, a, None]) / v[:, a, None] for a, n in enumerate(size)], axis=1)
    t0 = np.maximum(faces[0].max(axis=1), 0)[:, None]
    t1 = np.maximum(faces[1].min(axis=1)[:, None], t0)
    t = np.sort(np.concatenate([t0, np.clip(planes, t0, t1), t1], axis=1), axis=1)
    length = np.diff(t, axis=1)
    tau, measure = np.zeros((2, len(o)))
    for g in (0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6):
        middle = t[:, :-1] + g * length
        sigma, slope = trilinear(values, q[:, None] + middle[..., None] * v[:, None])
        tau += 0.5 * np.sum(length * sigma, axis=1)
        measure += 0.5 * np.sum(length * (np.abs(sigma) + slope), axis=1)
    return tau, measure


def trilinear(values: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A field and the length of its gradient at lattice points (..., 3), the borders clamped."""
    low = np.floor(q).astype(int)
    f = q - low
    sigma, slope = np.zeros(q.shape[:-1]), np.zeros(q.shape)
    for bits in itertools.product((0, 1), repeat=3):
        x, y, z = (np.clip(low[..., a] + bits[a], 0, values.shape[2 - a] - 1) for a in range(3))
        corner = values[z, y, x].astype(np.float64)
        w = [f[..., a] if bits[a] else 1 - f[..., a] for a in range(3)]
        sigma += corner * w[0] * w[1] * w[2]
        for a in range(3):
            slope[..., a] += corner * w[a - 1] * w[a - 2] * (1 if bits[a] else -1)
    return sigma, np.linalg.norm(slope, axis=-1)


# -- What else could be used -----------------------------------------------------------------------------------------------


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


@dr.syntax
def track_ratio(texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, majorant: mi.Float, sampler: mi.Sampler) -> mi.Float:
    """Transmittance by ratio tracking with one majorant: unbiased."""
    active, t, t1 = inside_box(o, d)
    T = mi.Float(1)
    while active:
        t -= dr.log(1 - sampler.next_1d(active)) / majorant
        active &= t < t1
        T *= dr.select(active, 1 - look_up(texture, o, d, t, active) / majorant, 1)
        active &= T > 0
    return T


@dr.syntax
def track_delta(texture: mi.Texture3f, o: mi.Point3f, d: mi.Vector3f, majorant: mi.Float, sampler: mi.Sampler) -> mi.Float:
    """Transmittance by delta tracking with one majorant, 0 or 1: unbiased."""
    active, t, t1 = inside_box(o, d)
    T = mi.Float(1)
    while active:
        t -= dr.log(1 - sampler.next_1d(active)) / majorant
        active &= t < t1
        absorbed = active & (sampler.next_1d(active) * majorant < look_up(texture, o, d, t, active))
        T = dr.select(absorbed, 0, T)
        active &= ~absorbed
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


def by_tracking(work: Work, spp: int, track: Callable) -> Contestant:
    """A transmittance for each ray from ``spp`` random walks over a Texture3f."""
    texture = mi.Texture3f(work.tensor, wrap_mode=dr.WrapMode.Clamp)
    majorant = dr.opaque(mi.Float, float(work.values.max()))
    return lambda seed: each_sample(work, spp, seed, lambda o, d, sampler: track(texture, o, d, majorant, sampler))


def by_volpath(work: Work, spp: int) -> Contestant:
    """A transmittance for each ray from ``spp`` paths of stock ``volpath`` under a sky of radiance 1."""
    scene = mi.load_dict(box_of(work.values, 8))
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


# -- The questions ---------------------------------------------------------------------------------------------------------


def measure_walk(size: Size) -> dict:
    """How many rays a second does the walk take through the tutorial's smoke?"""
    found = smoke()
    o, d = camera_rays(size.walk_side)
    works = {"camera order": Work(found.values, o, d), "random order": Work(found.values, *shuffled(o, d))}
    timings = race({name: work.tau() for name, work in works.items()}, size.rounds)
    hits = float(dr.mean(mi.Float(inside_box(o, d)[0])).array[0])
    figures = {name: t.report(works[name].n, "rays") for name, t in timings.items()}
    return {"grid": describe(found), "rays": works["camera order"].n, "share_of_rays_in_the_box": hits, **figures}


def measure_image(size: Size) -> dict:
    """Through ``mi.render``: how much sooner than ``volpath`` at the same spp, and at the same error?"""
    found = smoke()
    scene = mi.load_dict(box_of(found.values, size.image_side))
    integrators = {
        "mivol": mi.load_dict({"type": "mivol", "max_depth": 1}),
        "volpath, max_depth 1": mi.load_dict({"type": "volpath", "max_depth": 1}),
        "volpath, max_depth 6": mi.load_dict({"type": "volpath", "max_depth": 6}),
    }
    contestants = {
        name: lambda seed, i=i: mi.render(scene, integrator=i, spp=size.image_spp, seed=seed) for name, i in integrators.items()
    }
    timings = race(contestants, size.rounds, keep=True)
    pixels = np.random.default_rng(0).choice(size.image_side**2, size.exact_pixels, replace=False)
    exact, doubt = pixel_means(found.values, size.image_side, pixels)
    samples = size.image_side**2 * size.image_spp
    figures = {}
    for name, t in timings.items():
        errors = [image[..., 0].ravel()[pixels] - exact for image in t.results]
        figures[name] = t.report(samples, "paths") | {"rms_error": float(np.sqrt(np.mean(np.square(errors))))}
    ours = timings["mivol"]
    for name in ("volpath, max_depth 1", "volpath, max_depth 6"):
        faster = ratio_of(timings[name], ours)
        variance = (figures[name]["rms_error"] / figures["mivol"]["rms_error"]) ** 2
        figures[name] |= {"mivol_is_faster": faster, "mivol_is_faster_at_equal_error": faster * variance}
    about = {"pixels": size.image_side**2, "spp": size.image_spp, "exact_pixels": len(pixels), "rms_error_of_exact": doubt}
    return {"grid": describe(found), **about, **figures}


def pixel_means(values: np.ndarray, side: int, pixels: np.ndarray, k: int = 12) -> tuple[np.ndarray, float]:
    """Mean transmittance of pixels by k x k rays of the twin in each, and how far k/2 x k/2 are from that."""
    means = []
    for parts in (k, k // 2):
        o, d = (np.array(x).T.astype(np.float64) for x in camera_rays(side, pixels, parts))
        means.append(np.exp(-exact_tau(values, o, d)[0]).reshape(len(pixels), -1).mean(axis=1))
    return means[0], float(np.sqrt(np.mean((means[0] - means[1]) ** 2)))


def measure_accuracy(size: Size) -> dict:
    """How far is tau from the float64 twin, over int (sigma + h |grad sigma|)?"""
    figures = {}
    for res in size.accuracy_res:
        rng = np.random.default_rng(res)
        fields = {
            "noise": rng.uniform(0, 4, (res,) * 3).astype(np.float32),
            "threads": threads_in_space(res).values,
        }
        for name, values in fields.items():
            o, d = rays_across(rng, size.exact_rays)
            exact = exact_tau(values, *(x.T.astype(np.float64) for x in (o, d)))
            work, grid = Work(values, mi.Point3f(o), mi.Vector3f(d)), padded(values)
            figures |= {
                f"{res}^3 {name}": errors_of(work.tau()(0), *exact),
                f"{res}^3 {name}, empty blocks skipped": errors_of(work.tau(skip=True)(0), *exact),
                f"drjit.dda.integrate, {res}^3 {name}": errors_of(by_drjit_dda(work, grid), *exact),
            }
    return figures


def errors_of(tau: mi.Float, exact: np.ndarray, measure: np.ndarray) -> dict[str, float]:
    """Errors of optical depths over their measure; where that is 0 the optical depth has to be 0."""
    error, hit = np.abs(np.array(tau) - exact), measure > 0
    relative = error[hit] / measure[hit]
    return {
        "rays": int(hit.sum()),
        "largest_error": float(relative.max()),
        "rms_error": float(np.sqrt(np.mean(relative**2))),
        "error_of_99.9_percent": float(np.quantile(relative, 0.999)),
        "error_where_exactly_empty": float(error[~hit].max(initial=0)),
    }


def rays_across(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays in all directions through points of the box, (3, n) float32; a few along the axes."""
    d = rng.normal(size=(3, n))
    d[:, : n // 8] = np.repeat(np.eye(3), -(-n // 24), axis=1)[:, : n // 8]
    d /= np.linalg.norm(d, axis=0)
    return np.float32(rng.uniform(-1, 1, (3, n)) - rng.uniform(2, 8, n) * d), np.float32(d)


def measure_reverse(size: Size) -> dict:
    """What does the transpose cost, over the optical depth itself?"""
    fields = {"smoke": (smoke(), size.walk_side), "CT": (ct_scan(size.ct_res), size.grid_side)}
    figures = {}
    for name, (found, side) in fields.items():
        work = Work(found.values, *camera_rays(side))
        figures[name] = {"grid": describe(found), "rays": work.n} | race_reverse(work, size.rounds)
    return figures | {"render": race_gradient_of_render(size)}


def race_reverse(work: Work, rounds: int) -> dict:
    """The transpose alone, and gradient steps through the AD graph, beside the walk."""
    lattice, grid, ones = work.lattice(), padded(work.values), dr.full(mi.Float, 1, work.n)
    dr.make_opaque(ones)

    def reverse(_: int) -> mi.Float:
        target = Gradient.zeros(lattice)
        backproject_segment(lattice, target, [ones], clip(lattice, work.o, work.d, 0, math.inf))
        return target.fold()

    contestants = {
        "forward": work.tau(),
        "reverse": reverse,
        "gradient step": lambda _: gradient_step(work.tensor, lambda v: integrate_tau(Lattice(v, TO_WORLD), work.o, work.d)),
        "gradient step of drjit.dda.integrate": lambda _: gradient_step(grid, lambda v: by_drjit_dda(work, v)),
    }
    timings = race(contestants, rounds)
    ratios = {f"{name} over forward": ratio_of(t, timings["forward"]) for name, t in timings.items() if name != "forward"}
    return ratios | {name: t.report(work.n, "rays") for name, t in timings.items()}


def gradient_step(values: mi.TensorXf, tau_of: Callable[[mi.TensorXf], mi.Float]) -> mi.Float:
    """The derivative of a loss, the sum of tau^2 over the rays, with respect to the grid."""
    values = mi.TensorXf(values)
    dr.enable_grad(values)
    tau = tau_of(values)
    dr.backward(dr.sum(tau * tau))
    return dr.grad(values).array


def race_gradient_of_render(size: Size) -> dict:
    """A render by the integrator, and a gradient step through it."""
    scene, integrator = mi.load_dict(box_of(smoke().values, size.image_side)), mi.load_dict({"type": "mivol"})
    params, key = mi.traverse(scene), "box.interior_medium.sigma_t.data"

    def render(seed: int) -> mi.TensorXf:
        return mi.render(scene, params, integrator=integrator, spp=size.image_spp, seed=seed)

    def step(seed: int) -> mi.Float:
        dr.enable_grad(params[key])
        dr.backward(dr.mean(render(seed)))
        gradient = dr.grad(params[key])
        dr.disable_grad(params[key])
        return gradient

    timings = race({"render": render, "gradient step": step}, size.rounds)
    samples = size.image_side**2 * size.image_spp
    figures = {name: t.report(samples, "paths") for name, t in timings.items()}
    return {"gradient step over render": ratio_of(timings["gradient step"], timings["render"])} | figures


def measure_memory(size: Size) -> dict:
    """How does the memory of a gradient step grow with the rays, and with the cells that they cross?"""
    figures = {}
    for res in (16, 64):
        values = made_up((res,) * 3, 2.0, "any").values
        rows = []
        for side in size.memory_sides:
            work = Work(values, *camera_rays(side))
            rows.append((work.n, peak_bytes(work)))
        rays, peak = np.array(rows, float).T
        slope, start = np.polyfit(rays, peak, 1)
        figures[f"{res}^3"] = {
            "rays": rays.astype(int).tolist(),
            "peak_bytes": peak.astype(int).tolist(),
            "bytes_per_ray": float(slope),
            "bytes_without_rays": float(start),
        }
    return figures


def peak_bytes(work: Work) -> int:
    """Most bytes that Dr.Jit held at once during a gradient step, those of the rays included."""
    dr.sync_thread()
    gc.collect()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    clock(lambda _: gradient_step(work.tensor, lambda v: integrate_tau(Lattice(v, TO_WORLD), work.o, work.d)))
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float))


def measure_grids(size: Size) -> dict:
    """Does a walk cost what it crosses, or what the grid holds?"""
    fields = {"smoke": smoke(), "CT": ct_scan(size.ct_res), "threads": threads_in_space(size.sparse_res)}
    figures = {}
    for grid, found in fields.items():
        o, d = camera_rays(size.grid_side)
        orders = {"camera order": Work(found.values, o, d), "random order": Work(found.values, *shuffled(o, d))}
        contestants = {
            f"{order}, {'empty blocks skipped' if skip else 'every cell'}": work.tau(skip)
            for order, work in orders.items()
            for skip in (False, True)
        }
        timings = race(contestants, size.rounds)
        work = orders["camera order"]
        counts = {skip: count_cells(work.lattice(skip), work) for skip in (False, True)}
        held = np.array(block_bounds(work.tensor)) > 0
        figures[grid] = {"grid": describe(found), "rays": work.n, "occupied_blocks": float(held.mean())}
        for name, t in timings.items():
            visited, steps = counts["skipped" in name]
            figures[grid][name] = t.report(work.n, "rays") | {
                "cells_visited_per_ray": visited,
                "steps_per_ray": steps,
                "nanoseconds_per_step": 1e9 * t.median / (work.n * steps),
            }
        del orders, contestants, work, timings
        gc.collect()
    return figures


def count_cells(lattice: Lattice, work: Work) -> tuple[float, float]:
    """Cells visited a ray, and steps of the walk a ray (a jump over an empty block is a step); rays that miss count too."""

    def visit(state: tuple[mi.UInt32, mi.UInt32], cell: object, on: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        return state[0] + dr.select(on, mi.UInt32(1), 0), state[1] + 1

    zero = dr.zeros(mi.UInt32, work.n)
    visited, steps = walk(lattice, clip(lattice, work.o, work.d, 0, math.inf), visit, (zero, mi.UInt32(zero)))
    return tuple(float(np.array(c, np.float64).mean()) for c in (visited, steps))


def measure_peers(size: Size) -> dict:
    """Error of the transmittance of a ray against time, for all that could be used."""
    found = smoke()
    work = Work(found.values, *camera_rays(size.peer_side))
    tau, grid = work.tau(), padded(found.values)
    methods = {
        "mivol": {"": lambda _: dr.exp(-tau(0))},
        "volpath": {f"{s} spp": by_volpath(work, s) for s in size.volpath_spp},
        "ratio tracking": {f"{s} spp": by_tracking(work, s, track_ratio) for s in size.peer_spp},
        "delta tracking": {f"{s} spp": by_tracking(work, s, track_delta) for s in size.peer_spp},
        "marching": {f"{n} steps": by_marching(work, n) for n in size.march_steps},
        "drjit.dda.integrate": {"": lambda _: dr.exp(-by_drjit_dda(work, grid))},
    }
    flat = {(method, setting): call for method, settings in methods.items() for setting, call in settings.items()}
    timings = race(flat, size.peer_rounds, keep=True)
    index, o, d = work.some(size.exact_rays)
    exact = np.exp(-exact_tau(found.values, o, d)[0])
    figures = {"grid": describe(found), "rays": work.n, "exact_rays": len(index)}
    for (method, setting), t in timings.items():
        error = np.array([T[index] - exact for T in t.results])
        errors = {"rms_error": float(np.sqrt(np.mean(error**2))), "mean_error": float(np.mean(error))}
        figures.setdefault(method, []).append({"setting": setting} | errors | t.report(work.n, "rays"))
    return figures


QUESTIONS = {
    "walk": measure_walk,
    "image": measure_image,
    "accuracy": measure_accuracy,
    "reverse": measure_reverse,
    "memory": measure_memory,
    "grids": measure_grids,
    "peers": measure_peers,
}


# -- Saying it -------------------------------------------------------------------------------------------------------------


class Bar(NamedTuple):
    """What the project promises of an answer: a figure, and where it has to lie. ``find`` gives None where it is not there."""

    question: str
    figure: str
    sense: str
    bar: float
    find: Callable[[dict], float | None]


def _largest_error(res: int) -> Callable[[dict], float | None]:
    return lambda a: max((f["largest_error"] for name, f in a.items() if name.startswith(f"{res}^3")), default=None)


ERROR = "error of tau over int (sigma + h |grad sigma|)"
BARS = (
    Bar("walk", "walk [M rays/s]", AT_LEAST, 15, lambda a: a["camera order"]["rays_per_second_median"] / 1e6),
    Bar("image", "mi.render, rate over volpath's", AT_LEAST, 20, lambda a: a["volpath, max_depth 1"]["mivol_is_faster"]),
    Bar("accuracy", f"{ERROR}, 64^3", AT_MOST, 2e-6, _largest_error(64)),
    Bar("accuracy", f"{ERROR}, 256^3", AT_MOST, 2e-6, _largest_error(256)),
    Bar("reverse", "reverse pass over forward pass", AT_MOST, 4, lambda a: a["smoke"]["reverse over forward"]),
    # A ray's own state: o and d, its optical depth, and the derivative of that: 8 float32.
    Bar("memory", "gradient step [bytes/ray]", AT_MOST, 32, lambda a: max(f["bytes_per_ray"] for f in a.values())),
)


def compare(question: str, answer: dict) -> list[dict]:
    """The figures of an answer that have a bar, beside it, and said."""
    found = [(b, b.find(answer)) for b in BARS if b.question == question]
    return [judge(b.figure, value, b.sense, b.bar) for b, value in found if value is not None]


def draw(answers: dict, folder: Path) -> None:
    """Error against time."""
    if (peers := answers.get("peers")) is None:
        return
    rows = {name: points for name, points in peers.items() if isinstance(points, list)}
    series = [
        Series(name, [p["seconds_median"] for p in points], [p["rms_error"] for p in points]) for name, points in rows.items()
    ]
    title = f"Transmittance of {peers['rays']:,} rays through the smoke {peers['grid'].split(',')[0]}: error against time"
    plot_error_against_time(series, folder / "bench_optical_depth.png", error="RMS error of T against float64", title=title)


BENCH = Bench("bench_optical_depth", __doc__, QUESTIONS, (FULL, QUICK), compare, draw)

if __name__ == "__main__":
    BENCH.main()
