"""What optical depths and their derivatives cost: rays a second, the transpose over the walk, bytes and cells a ray."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.extinctions import TO_WORLD, ct_scan, made_up, smoke, threads_in_space
from mivol.bench.harness.timing import clock, race, ratio_of
from mivol.bench.scenes import box_scene
from mivol.bench.studies.optical_depth.peers import by_drjit_dda, inside_box, padded
from mivol.bench.studies.optical_depth.size import Size
from mivol.bench.studies.optical_depth.work import Work, camera_rays, shuffled
from mivol.transport.media.grid_integral import NodeGradient, backproject_segment, integrate_tau
from mivol.transport.traversal.grid_blocks import bound_blocks
from mivol.transport.traversal.grid_walk import walk_cells
from mivol.transport.traversal.lattice import Lattice, clip_to_grid

__all__ = ["measure_grids", "measure_memory", "measure_reverse", "measure_walk"]


def measure_walk(size: Size) -> dict:
    """How many rays a second does the walk take through the tutorial's smoke?"""
    found = smoke()
    o, d = camera_rays(size.walk_side)
    works = {"camera order": Work(found.values, o, d), "random order": Work(found.values, *shuffled(o, d))}
    timings = race({name: work.tau() for name, work in works.items()}, size.rounds)
    hits = float(dr.mean(mi.Float(inside_box(o, d)[0])).array[0])
    figures = {name: t.report(works[name].n, "rays") for name, t in timings.items()}
    return {"grid": str(found), "rays": works["camera order"].n, "share_of_rays_in_the_box": hits, **figures}


def measure_reverse(size: Size) -> dict:
    """What does the transpose cost, over the optical depth itself?"""
    fields = {"smoke": (smoke(), size.walk_side), "CT": (ct_scan(size.ct_res), size.grid_side)}
    figures = {}
    for name, (found, side) in fields.items():
        work = Work(found.values, *camera_rays(side))
        figures[name] = {"grid": str(found), "rays": work.n} | race_reverse(work, size.rounds)
    return figures | {"render": race_gradient_of_render(size)}


def race_reverse(work: Work, rounds: int) -> dict:
    """The transpose alone, and gradient steps through the AD graph, beside the walk."""
    lattice, grid, ones = work.lattice(), padded(work.values), dr.full(mi.Float, 1, work.n)
    dr.make_opaque(ones)

    def reverse(_: int) -> mi.Float:
        target = NodeGradient.zeros(lattice)
        backproject_segment(lattice, target, [ones], clip_to_grid(lattice, work.o, work.d, 0, math.inf))
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
    scene, integrator = mi.load_dict(box_scene(smoke().values, size.image_side)), mi.load_dict({"type": "mivol"})
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
    for res in size.memory_res:
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
        held = np.array(bound_blocks(work.tensor)) > 0
        figures[grid] = {"grid": str(found), "rays": work.n, "occupied_blocks": float(held.mean())}
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
    visited, steps = walk_cells(lattice, clip_to_grid(lattice, work.o, work.d, 0, math.inf), visit, (zero, mi.UInt32(zero)))
    return tuple(float(np.array(c, np.float64).mean()) for c in (visited, steps))
