"""Fits of rendered views: beside the peer of the study, and with rays of tiles beside rays of single pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.bars import say_row
from mivol.bench.harness.timing import Stopwatch
from mivol.bench.studies.radiance_field.fields import (
    BLACK,
    BOX,
    STOP,
    FieldSize,
    load_field,
    middle_cameras,
    photograph,
    ring_cameras,
    tiled_pixels,
    to_bundle,
    trace,
)
from mivol.bench.studies.radiance_field.peer import Peer
from mivol.optim.loop import Fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import TILE, RayBatch, RayBatches
from mivol.photos import Camera, Photo
from mivol.validate.metrics import psnr

__all__ = ["PixelBatches", "fit_mivol", "fit_peer", "held_out_psnr", "measure_fit", "measure_locality"]

EVERY = 7
"""Steps between two measurements of the held-out views."""

Curve = list[tuple[float, float]]
"""Seconds of a fit, and the PSNR of the held-out views at this time [dB]."""


def held_out_psnr(photos: Sequence[Photo], render: Callable[[Camera], np.ndarray]) -> float:
    """Mean PSNR of renders (H, W, 3) of held-out views [dB]; a view counts 100 dB at most."""
    values = [psnr(np.clip(render(photo.camera), 0, 1), photo.image, 1.0) for photo in photos]
    return float(np.mean(np.minimum(values, 100.0)))


def render_peer(peer: Peer, camera: Camera) -> np.ndarray:
    """Render a view of the peer's field (H, W, 3)."""
    pixels = tiled_pixels(camera.size[0])
    ray = to_bundle(*trace(camera, pixels))
    image = np.empty((*camera.size, 3), np.float32)
    image[tuple(pixels.T)] = np.array(peer.render(mi.Point3f((ray.o + 1) * 0.5), ray.d)).T
    return image


def follow(steps: Iterable, measure: Callable[[], float]) -> Curve:
    """Take steps, and measure after every EVERY steps; only the steps are timed."""
    curve, watch, steps = [], Stopwatch(), iter(steps)
    while True:
        with watch:
            taken = sum(1 for _ in zip(range(EVERY), steps, strict=False))
        if taken < EVERY:
            return curve
        curve.append((watch.seconds, measure()))


class PixelBatches(RayBatches):
    """Batches of random single pixels in place of tiles."""

    def draw_tiles(self, shrink: int, views: np.ndarray, tiles: int, rng: np.random.Generator) -> RayBatch:
        """Draw as many pixels as the tiles have."""
        width, height = self.levels[shrink].sizes[views[0]]
        n = len(views) * tiles * TILE**2
        slot, column, row = (rng.integers(0, most, n).astype(np.uint32) for most in (len(views), width, height))
        return self.make_batch(shrink, views, mi.UInt32(slot), mi.UInt32(column), mi.UInt32(row))


def compile_fit(views: RayBatches, stages: Sequence[RadianceStage]) -> None:
    """Take a step of each stage, which compiles its kernels before a clock runs."""
    for stage in stages:
        begin_radiance_fit(views, BOX, RadiancePlan((replace(stage, steps=2),))).advance()
    dr.sync_thread()


def all_steps(fit: Fit) -> Iterator[None]:
    """Take all steps of a fit; yields after each step."""
    for _ in range(fit.course.iterations):
        yield fit.advance()


def measure_newest(fit: Fit, held_out: Sequence[Photo]) -> float:
    """PSNR of the held-out views by the newest field of a fit [dB]."""
    return held_out_psnr(held_out, lambda camera: render_view(current_field(fit), camera, BLACK, STOP).image)


def measure_locality(size: FieldSize) -> dict:
    """What do tiles of neighbouring rays gain and cost, beside random single pixels?"""
    field, _ = load_field(size.fields[-1], size)
    n, side = size.fit_resolution // 2, size.fit_side // 2
    photos, held_out = photograph(field, ring_cameras(side, 24)), photograph(field, middle_cameras(side, 24)[::3])
    stages = (
        RadianceStage(n // 2, size.steps, 2, 8, max(side**2 // 512, 1)),
        RadianceStage(n, 2 * size.steps, 1, 8, max(side**2 // 128, 1)),
    )
    answer = {}
    for name, kind in {"tiles": RayBatches, "pixels": PixelBatches}.items():
        views = kind.from_photos(photos, (1, 2))
        compile_fit(views, stages[-1:])
        fit, watch = begin_radiance_fit(views, BOX, RadiancePlan(stages)), Stopwatch()
        with watch:
            for _ in all_steps(fit):
                pass
        decibels = measure_newest(fit, held_out)
        answer[name] = {"psnr": decibels, "processor_seconds": watch.processor, "steps": fit.course.iterations}
        say_row(name, psnr=decibels, milliseconds_per_step=watch.processor / fit.course.iterations * 1e3)
    return answer


def fit_mivol(photos: list[Photo], held_out: list[Photo], size: FieldSize) -> Curve:
    """Fit by mivol: three stages; a step of the last stage has as many rays as a view has pixels."""
    n, steps = size.fit_resolution, size.steps
    tiles = max(size.fit_side**2 // 112, 4)
    kinds = ((8, 1, 4, tiles // 4), (4, 1, 2, tiles // 4), (1, 2, 1, tiles))
    stages = tuple(RadianceStage(n // k, steps * s, shrink, 7, count) for k, s, shrink, count in kinds)
    views = RayBatches.from_photos(photos, (1, 2, 4))
    compile_fit(views, stages)
    fit = begin_radiance_fit(views, BOX, RadiancePlan(stages))
    return follow(all_steps(fit), lambda: measure_newest(fit, held_out))


def fit_peer(photos: list[Photo], held_out: list[Photo], size: FieldSize) -> Curve:
    """Fit by the peer: four stages of doubling resolution, one view in each step."""
    views = [peer_view(photo) for photo in photos]
    for n in (8, 4, 2, 1):  # compiles
        list(Peer.start(size.fit_resolution // n).fit(views, 1))
    dr.sync_thread()
    peers = [Peer.start(size.fit_resolution // 8)]
    return follow(
        peer_steps(peers, views, size.steps),
        lambda: held_out_psnr(held_out, lambda camera: render_peer(peers[-1], camera)),
    )


def peer_view(photo: Photo) -> tuple[mi.Point3f, mi.Vector3f, mi.Color3f]:
    """Rays of all pixels of a view in the unit cube of the peer, and their colours."""
    pixels = tiled_pixels(photo.camera.size[0])
    o, d = trace(photo.camera, pixels)
    ray = to_bundle((o + 1) / 2, d)
    return ray.o, ray.d, mi.Color3f(np.ascontiguousarray(photo.image[tuple(pixels.T)].T))


def peer_steps(peers: list[Peer], views: list, steps: int) -> Iterator[None]:
    """Take all steps of the four stages of the peer; the peer of each stage is appended to ``peers``."""
    for stage in range(4):
        if stage:
            peers.append(peers[-1].refined())
        for _ in peers[-1].fit(views, steps):
            yield dr.eval(peers[-1].density, peers[-1].harmonics)


def measure_fit(size: FieldSize) -> dict:
    """How long until the PSNR of held-out views reaches the best PSNR of the peer?"""
    answer = {}
    for name in size.fields:
        field, origin = load_field(name, size)
        photos, held_out = photograph(field, ring_cameras(size.fit_side)), photograph(field, middle_cameras(size.fit_side))
        mivol, peer = fit_mivol(photos, held_out, size), fit_peer(photos, held_out, size)
        duration, goal = max(peer, key=lambda point: point[1])
        reached = next((t for t, decibels in mivol if decibels >= goal), None)
        ratio = 0.0 if reached is None else duration / reached
        answer[name] = {"field": origin, "peer_psnr": goal, "ours": mivol, "peer": peer, "ratio": ratio}
        say_row(name, peer_psnr=goal, peer_seconds=duration, seconds=reached, final_psnr=mivol[-1][1])
    return answer
