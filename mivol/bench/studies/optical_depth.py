"""What does an exact optical depth cost, and how exact is it, beside other methods?

    mivol bench optical_depth                        # under 10 minutes on 2 cores
    mivol bench optical_depth --quick                # under a minute, small sizes: do the errors meet their bars?
    mivol bench optical_depth --only walk,grids      # some of the questions

All contestants trace the same rays through the same grid, in turns within each round. A time is the median over the rounds,
with the fastest time beside it. A ratio of times is the median of the ratios within a round. The cost of the first call is
reported apart: seconds in the compiler, or kernels found on disk (HOME=$(mktemp -d) hides those). Errors are differences to
sums in float64 NumPy.

The smoke of the Mitsuba tutorial and a CT scan come from MIVOL_DATA (default ../shared/data). Without the data, made-up fields
of the same sizes take their place, and the JSON records this.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import drjit.dda
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from mivol.bench.harness.contests import Contestant, peak_bytes, race, time_call, time_ratio
from mivol.bench.harness.study import AT_LEAST, AT_MOST, Promise, Size, Study, amount
from mivol.bench.scenes import (
    TO_WORLD,
    GridRays,
    ParameterGradient,
    StudyExtinction,
    box_scene,
    camera_rays,
    ct_scan,
    made_up,
    smoke,
    threads_in_space,
)
from mivol.report.figures import Series, plot_error_against_time
from mivol.transport.media.grid_extinction import NodeGradient, backproject_segment, integrate_tau
from mivol.transport.traversal.grid_blocks import bound_blocks
from mivol.transport.traversal.grid_walk import walk_cells
from mivol.transport.traversal.lattice import Lattice, clip_to_grid


@dataclass(frozen=True)
class OpticalDepthSize(Size):
    """Amount of work."""

    rounds: int = amount(7, 3, "warm calls of each contestant")
    walk_side: int = amount(1024, 256, "edge of the image whose rays are walked [pixels]")
    image_side: int = amount(256, 64, "edge of rendered images [pixels]")
    image_spp: int = amount(16, 4, "samples per pixel of rendered images")
    exact_pixels: int = amount(192, 32, "pixels compared with float64")
    exact_rays: int = amount(4096, 1024, "rays compared with float64")
    memory_res: tuple[int, ...] = amount((16, 64), doc="voxels along an edge of the grids for memory")
    memory_sides: tuple[int, ...] = amount((256, 512, 1024), (64, 128, 256), "edges of the images for memory [pixels]")
    grid_side: int = amount(512, 128, "edge of the image whose rays cross large grids [pixels]")
    ct_res: int = amount(256, 64, "voxels along an edge of the CT scan")
    sparse_res: int = amount(512, 128, "voxels along an edge of the threads")
    peer_rounds: int = amount(3, doc="warm calls of each peer")
    peer_side: int = amount(512, 64, "edge of the image for peers [pixels]")
    peer_spp: tuple[int, ...] = amount((1, 4, 16, 64), (1, 4), "samples per ray of tracking")
    volpath_spp: tuple[int, ...] = amount((1, 4, 16), (1, 4), "samples per ray of volpath")
    march_steps: tuple[int, ...] = amount((16, 32, 64, 128, 256, 512, 1024), (16, 64, 256), "steps of ray marching")


# -- Speed ------------------------------------------------------------------------------------------------------------------


def measure_walk(size: OpticalDepthSize) -> dict:
    """How many rays per second does the walk take through the smoke of the tutorial?"""
    grid = smoke()
    orders = order_rays(grid, size.walk_side)
    timings = race({name: rays.optical_depths() for name, rays in orders.items()}, size.rounds)
    rays = orders["camera order"]
    hits = float(dr.mean(mi.Float(intersect_box(rays.o, rays.d)[0])).array[0])
    reports = {name: t.report(rays.n, "rays") for name, t in timings.items()}
    return {"grid": str(grid), "rays": rays.n, "share_of_rays_in_the_box": hits, **reports}


def order_rays(grid: StudyExtinction, side: int) -> dict[str, GridRays]:
    """Camera rays through a grid, in the order of the image and in random order."""
    o, d = camera_rays(side)
    return {"camera order": GridRays(grid.values, o, d), "random order": GridRays(grid.values, *shuffle(o, d))}


def shuffle(o: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Point3f, mi.Vector3f]:
    """Put rays into random order, by the seed 0."""
    order = mi.UInt32(np.random.default_rng(0).permutation(dr.width(d)).astype(np.uint32))
    o, d = dr.gather(mi.Point3f, o, order), dr.gather(mi.Vector3f, d, order)
    dr.eval(o, d)
    return o, d


def measure_grids(size: OpticalDepthSize) -> dict:
    """Does the cost of a walk follow the crossed cells or the size of the grid?"""
    grids = {"smoke": smoke(), "CT": ct_scan(size.ct_res), "threads": threads_in_space(size.sparse_res)}
    answer = {}
    for name, grid in grids.items():
        answer[name] = measure_grid(grid, size)
        gc.collect()
    return answer


def measure_grid(grid: StudyExtinction, size: OpticalDepthSize) -> dict:
    """Times and steps of walks with and without empty blocks, in both orders of the rays."""
    orders = order_rays(grid, size.grid_side)
    contestants = {
        f"{order}, {'empty blocks skipped' if skip else 'every cell'}": rays.optical_depths(skip)
        for order, rays in orders.items()
        for skip in (False, True)
    }
    timings = race(contestants, size.rounds)
    rays = orders["camera order"]
    counts = {skip: count_cells(rays.lattice(skip), rays) for skip in (False, True)}
    occupied = np.array(bound_blocks(rays.tensor)) > 0
    answer: dict = {"grid": str(grid), "rays": rays.n, "occupied_blocks": float(occupied.mean())}
    for name, timing in timings.items():
        visited, steps = counts["skipped" in name]
        answer[name] = timing.report(rays.n, "rays") | {
            "cells_visited_per_ray": visited,
            "steps_per_ray": steps,
            "nanoseconds_per_step": 1e9 * timing.median / (rays.n * steps),
        }
    return answer


def count_cells(lattice: Lattice, rays: GridRays) -> tuple[float, float]:
    """Mean number of visited cells and of steps per ray, rays that miss the box included; a leap over a block is a step."""

    def visit(state: tuple[mi.UInt32, mi.UInt32], cell: object, on: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        return state[0] + dr.select(on, mi.UInt32(1), 0), state[1] + 1

    zero = dr.zeros(mi.UInt32, rays.n)
    visited, steps = walk_cells(lattice, clip_to_grid(lattice, rays.o, rays.d, 0, math.inf), visit, (zero, mi.UInt32(zero)))
    return tuple(float(np.array(c, np.float64).mean()) for c in (visited, steps))


# -- Derivatives ------------------------------------------------------------------------------------------------------------


def measure_reverse(size: OpticalDepthSize) -> dict:
    """What does the transpose cost, relative to the optical depth itself?"""
    answer = {}
    for name, grid, side in (("smoke", smoke(), size.walk_side), ("CT", ct_scan(size.ct_res), size.grid_side)):
        rays = GridRays(grid.values, *camera_rays(side))
        answer[name] = {"grid": str(grid), "rays": rays.n} | race_reverse(rays, size.rounds)
    return answer | {"render": race_gradient_of_render(size)}


def race_reverse(rays: GridRays, rounds: int) -> dict:
    """Times of the walk, of its transpose, and of gradient steps through the AD graph."""
    lattice, padded, ones = rays.lattice(), pad_for_drjit(rays.values), dr.full(mi.Float, 1, rays.n)
    dr.make_opaque(ones)

    def reverse(_: int) -> mi.Float:
        gradient = NodeGradient.zeros(lattice)
        backproject_segment(lattice, gradient, [ones], clip_to_grid(lattice, rays.o, rays.d, 0, math.inf))
        return gradient.fold()

    contestants = {
        "forward": rays.optical_depths(),
        "reverse": reverse,
        "gradient step": lambda _: grid_gradient_step(rays),
        "gradient step of drjit.dda.integrate": lambda _: gradient_step(padded, lambda v: integrate_by_drjit(rays, v)),
    }
    timings = race(contestants, rounds)
    ratios = {f"{name} over forward": time_ratio(t, timings["forward"]) for name, t in timings.items() if name != "forward"}
    return ratios | {name: t.report(rays.n, "rays") for name, t in timings.items()}


def grid_gradient_step(rays: GridRays) -> mi.Float:
    """A gradient step of mivol's optical depth."""
    return gradient_step(rays.tensor, lambda v: integrate_tau(Lattice(v, TO_WORLD), rays.o, rays.d))


def gradient_step(values: mi.TensorXf, integrate: Callable[[mi.TensorXf], mi.Float]) -> mi.Float:
    """Derivative of the sum of tau^2 over all rays with respect to the grid."""
    values = mi.TensorXf(values)
    dr.enable_grad(values)
    tau = integrate(values)
    dr.backward(dr.sum(tau * tau))
    return dr.grad(values).array


def race_gradient_of_render(size: OpticalDepthSize) -> dict:
    """Times of a render and of a gradient step through ``mi.render``."""
    gradient = ParameterGradient(mi.load_dict(box_scene(smoke().values, size.image_side)), mi.load_dict({"type": "mivol"}))

    def render(seed: int) -> mi.TensorXf:
        return mi.render(gradient.scene, gradient.params, integrator=gradient.integrator, spp=size.image_spp, seed=seed)

    def step(seed: int) -> mi.Float:
        return gradient.of_loss(lambda image: dr.mean(image, axis=None), seed, size.image_spp)

    timings = race({"render": render, "gradient step": step}, size.rounds)
    reports = {name: t.report(size.image_side**2 * size.image_spp, "paths") for name, t in timings.items()}
    return {"gradient step over render": time_ratio(timings["gradient step"], timings["render"])} | reports


def measure_memory(size: OpticalDepthSize) -> dict:
    """How does the memory of a gradient step grow with the number of rays, and with the number of crossed cells?"""
    answer = {}
    for res in size.memory_res:
        values, counts, peaks = made_up((res,) * 3, 2.0, "any").values, [], []
        for side in size.memory_sides:
            rays = GridRays(values, *camera_rays(side))
            gc.collect()
            counts.append(rays.n)
            peaks.append(peak_bytes(lambda rays=rays: time_call(lambda _: grid_gradient_step(rays))))
        slope, start = np.polyfit(np.array(counts, float), np.array(peaks, float), 1)
        answer[f"{res}^3"] = {
            "rays": counts,
            "peak_bytes": peaks,
            "bytes_per_ray": float(slope),
            "bytes_without_rays": float(start),
        }
    return answer


# -- Errors -----------------------------------------------------------------------------------------------------------------


def measure_image(size: OpticalDepthSize) -> dict:
    """How much sooner than ``volpath`` does ``mi.render`` finish, with the same samples per pixel and with the same error?"""
    grid = smoke()
    scene = mi.load_dict(box_scene(grid.values, size.image_side))
    settings = {"mivol": ("mivol", 1), "volpath, max_depth 1": ("volpath", 1), "volpath, max_depth 6": ("volpath", 6)}
    contestants = {}
    for name, (kind, depth) in settings.items():
        integrator = mi.load_dict({"type": kind, "max_depth": depth})
        contestants[name] = lambda seed, i=integrator: mi.render(scene, integrator=i, spp=size.image_spp, seed=seed)
    timings = race(contestants, size.rounds, keep=True)
    pixels = np.random.default_rng(0).choice(size.image_side**2, size.exact_pixels, replace=False)
    exact, doubt = pixel_means(grid.values, size.image_side, pixels)
    answer: dict = {
        "grid": str(grid),
        "pixels": size.image_side**2,
        "spp": size.image_spp,
        "exact_pixels": len(pixels),
        "rms_error_of_exact": doubt,
    }
    for name, timing in timings.items():
        errors = [image[..., 0].ravel()[pixels] - exact for image in timing.results]
        answer[name] = timing.report(size.image_side**2 * size.image_spp, "paths") | {"rms_error": rms(errors)}
        if name != "mivol":
            faster = time_ratio(timing, timings["mivol"])
            variance = (answer[name]["rms_error"] / answer["mivol"]["rms_error"]) ** 2
            answer[name] |= {"mivol_is_faster": faster, "mivol_is_faster_at_equal_error": faster * variance}
    return answer


def pixel_means(values: np.ndarray, side: int, pixels: np.ndarray, k: int = 12) -> tuple[np.ndarray, float]:
    """Mean transmittance of pixels from k x k rays of the twin each, and the RMS difference to k/2 x k/2 rays."""
    means = []
    for parts in (k, k // 2):
        o, d = (np.array(x).T.astype(np.float64) for x in camera_rays(side, pixels, parts))
        means.append(np.exp(-exact_tau(values, o, d)).reshape(len(pixels), -1).mean(axis=1))
    return means[0], rms(means[0] - means[1])


def rms(errors: object) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


def measure_peers(size: OpticalDepthSize) -> dict:
    """How does the error of the transmittance of a ray fall with time, for all methods?"""
    grid = smoke()
    rays = GridRays(grid.values, *camera_rays(size.peer_side))
    tau, padded = rays.optical_depths(), pad_for_drjit(grid.values)
    methods = {
        ("mivol", ""): lambda _: dr.exp(-tau(0)),
        **{("volpath", f"{n} spp"): volpath(rays, n) for n in size.volpath_spp},
        **{("ratio tracking", f"{n} spp"): tracking(rays, n, ratio_survival) for n in size.peer_spp},
        **{("delta tracking", f"{n} spp"): tracking(rays, n, delta_survival) for n in size.peer_spp},
        **{("marching", f"{n} steps"): marching(rays, n) for n in size.march_steps},
        ("drjit.dda.integrate", ""): lambda _: dr.exp(-integrate_by_drjit(rays, padded)),
    }
    timings = race(methods, size.peer_rounds, keep=True)
    index, o, d = rays.select(size.exact_rays)
    exact = np.exp(-exact_tau(grid.values, o, d))
    answer: dict = {"grid": str(grid), "rays": rays.n, "exact_rays": len(index)}
    for (method, setting), timing in timings.items():
        error = np.array([T[index] - exact for T in timing.results])
        errors = {"setting": setting, "rms_error": rms(error), "mean_error": float(np.mean(error))}
        answer.setdefault(method, []).append(errors | timing.report(rays.n, "rays"))
    return answer


# -- Bars and figure --------------------------------------------------------------------------------------------------------


# The state of a ray: o and d, its optical depth, and the derivative of the optical depth: 8 float32.
PROMISES = {
    "walk": [Promise("walk [M rays/s]", ("camera order", "rays_per_second_median"), AT_LEAST, 15, 1e-6)],
    "image": [Promise("mi.render, rate over volpath's", ("volpath, max_depth 1", "mivol_is_faster"), AT_LEAST, 20)],
    "reverse": [Promise("reverse pass over forward pass", ("smoke", "reverse over forward"), AT_MOST, 4)],
    "memory": [Promise("gradient step, {} [bytes/ray]", ("*", "bytes_per_ray"), AT_MOST, 32)],
}


def draw(answers: dict, path: Path) -> None:
    """Plot error against time for all methods."""
    if (peers := answers.get("peers")) is None:
        return
    series = [
        Series(name, [p["seconds_median"] for p in points], [p["rms_error"] for p in points])
        for name, points in peers.items()
        if isinstance(points, list)
    ]
    title = f"Transmittance of {peers['rays']:,} rays through the smoke {peers['grid'].split(',')[0]}: error against time"
    plot_error_against_time(series, path, error="RMS error of T against float64", title=title)


QUESTIONS = {
    "walk": measure_walk,
    "image": measure_image,
    "reverse": measure_reverse,
    "memory": measure_memory,
    "grids": measure_grids,
    "peers": measure_peers,
}
STUDY = Study(__name__, __doc__, OpticalDepthSize, QUESTIONS, draw=draw, promises=PROMISES)


# -- Peers ------------------------------------------------------------------------------------------------------------------


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
    """Pad a grid by one voxel on each side for ``drjit.dda.integrate``, whose nodes lie at the corners of the box."""
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
