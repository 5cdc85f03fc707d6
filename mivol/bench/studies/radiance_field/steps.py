"""Rays a second of a radiance field, forward and backward, beside the peer; and what a step of a ray holds in memory."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.bars import say
from mivol.bench.harness.timing import race, ratio_of
from mivol.bench.studies.radiance_field.fields import field_of
from mivol.bench.studies.radiance_field.peer import Peer
from mivol.bench.studies.radiance_field.size import STOP, Size
from mivol.bench.studies.radiance_field.views import camera, rays_of, rays_through, ring, tiled
from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import (
    RayBundle,
    RayGradient,
    find_occupied_cells,
    make_model,
    render_rays,
    vjp_rays,
)
from mivol.transport.line_integrals.radiance_source import bake, make_exact, vjp_bake

__all__ = ["Task", "ask_memory", "ask_step", "our_step", "peer_of", "peer_step", "tasks"]


@dataclass
class Task:
    """Rays of one kind: what they are, their pinholes and which of them each has."""

    rays: RayBundle
    pinholes: np.ndarray | None = None
    view: np.ndarray | None = None


def tasks(size: Size) -> dict[str, Task]:
    """The three kinds of rays."""
    n = size.side**2
    rng = np.random.default_rng(0)
    one = camera(0.3, 7, size.side)
    found = {"camera": Task(rays_of(*rays_through(one, tiled(size.side))), one.origin[None], np.zeros(n, int))}
    eight = ring(size.side, 8)
    view = np.sort(rng.integers(8, size=n))
    pixels = rng.integers(size.side, size=(n, 2))
    pairs = [rays_through(c, pixels[view == k]) for k, c in enumerate(eight)]
    o, d = (np.concatenate(part) for part in zip(*pairs, strict=True))
    found["pixels"] = Task(rays_of(o, d), np.array([c.origin for c in eight]), view)
    o = rng.normal(size=(n, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.7, 0.7, (n, 3)) - o
    found["any"] = Task(rays_of(o, d / np.linalg.norm(d, axis=1, keepdims=True)))
    return found


def our_step(field: SphericalGrid, task: Task) -> Callable[[int], list[mi.Float]]:
    """Forward and backward of the squared radiance."""
    cells, model = find_occupied_cells(field), make_model(field, STOP)
    view = None if task.view is None else mi.UInt32(task.view.astype(np.uint32))

    def step(number: int) -> list[mi.Float]:
        baked = view is not None
        source = bake(field, cells, task.pinholes, view, True) if baked else make_exact(field, task.rays.d, True)
        seen = render_rays(cells, source, model, task.rays)
        dr.eval(seen)
        vjp_rays(cells, source, model, seen, RayGradient(2 * seen.colour))
        return list(vjp_bake(field, cells, source, task.pinholes)) if baked else list(source.slopes())

    return step


def peer_of(field: SphericalGrid) -> Peer:
    """The same field in textures over the unit cube, whose lengths are half of ours."""
    density, sh = field.to_dense()
    sh[..., 0, :] += field.offset / 0.28209479  # the peer has no offset: it goes into the constant harmonic
    density, sh = density[..., None] * np.float32(2), sh.reshape(*sh.shape[:3], 27)
    return Peer(*(mi.TensorXf(np.ascontiguousarray(a)) for a in (density, sh)))


def peer_step(peer: Peer, task: Task) -> Callable[[int], list[mi.Float]]:
    """The same of the peer."""
    o, d = mi.Point3f((task.rays.o + 1) * 0.5), task.rays.d
    dr.eval(o)

    def step(number: int) -> list[mi.Float]:
        L = peer.render(o, d)
        dr.eval(L)
        return list(peer.backward(o, d, L, 2 * L))

    return step


def ask_step(size: Size) -> dict:
    """How many rays a second, forward and backward, beside the peer?"""
    answer = {}
    for name in size.fields:
        field, origin = field_of(name, size)
        peer = peer_of(field)
        answer[name] = {"field": origin, "rows": field.rows}
        for kind, task in tasks(size).items():
            times = race({"mivol": our_step(field, task), "peer": peer_step(peer, task)}, size.rounds)
            answer[name][kind] = {
                "ratio_of_processor_time": ratio_of(times["peer"], times["mivol"], "processor"),
                "ratio_of_time": ratio_of(times["peer"], times["mivol"]),
                **{who: t.report(size.side**2, "rays") for who, t in times.items()},
            }
            say(f"  {name}, {kind}: {answer[name][kind]['ratio_of_processor_time']:.1f}")
    return answer


def ask_memory(size: Size) -> dict:
    """What does a gradient step hold, and what of it goes with the rays?"""
    field, _ = field_of("shell", size)
    peaks = []
    for side in (size.side, 2 * size.side):
        task = tasks(replace(size, side=side))["camera"]
        step = our_step(field, task)
        for _ in range(2):
            dr.eval(step(0))
            dr.sync_thread()
            dr.flush_malloc_cache()
            dr.detail.malloc_clear_statistics()
        dr.eval(step(0))
        dr.sync_thread()
        peaks.append(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))
    rays_more = 3 * size.side**2
    return {
        "field_bytes": field.bytes,
        "peak_bytes": peaks,
        "bytes_per_ray": (peaks[1] - peaks[0]) / rays_more,
        "resident_bytes": resident_bytes(),
    }


def resident_bytes() -> int | None:
    """The most memory that this process has held; None on Windows, whose Python does not tell."""
    if sys.platform == "win32":
        return None
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
