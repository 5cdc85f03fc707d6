"""Fits of views beside the peer's, and beside one of single pixels: how soon are held-out views as good?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.bars import say
from mivol.bench.harness.timing import Stopwatch
from mivol.bench.studies.radiance_field.fields import field_of
from mivol.bench.studies.radiance_field.peer import Peer
from mivol.bench.studies.radiance_field.size import STOP, Size
from mivol.bench.studies.radiance_field.views import BLACK, BOX, between, photographed, rays_of, rays_through, ring, tiled
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.loop import Fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import TILE, RayBatch, RayBatches
from mivol.photos import Camera, Photo
from mivol.validate.metrics import psnr

__all__ = ["Pixels", "ask_fit", "ask_locality", "our_fit", "peer_fit"]

EVERY = 7
"""Steps between two looks at held-out views."""

Curve = list[tuple[float, float]]
"""Seconds of a fit, and the PSNR of the held-out views [dB] then."""


def held_out_psnr(photos: Sequence[Photo], render: Callable[[Camera], np.ndarray]) -> float:
    """Mean PSNR [dB] of renders (H, W, 3) of held-out views, 100 at most."""
    found = [psnr(np.clip(render(photo.camera), 0, 1), photo.image, 1.0) for photo in photos]
    return float(np.mean(np.minimum(found, 100.0)))


def view_of(field: SphericalGrid, camera: Camera) -> np.ndarray:
    """What a camera sees of our field over black, (H, W, 3)."""
    return render_view(field, camera, BLACK, STOP).image


def view_of_peer(peer: Peer, camera: Camera) -> np.ndarray:
    """What it sees of the peer's."""
    pixels = tiled(camera.size[0])
    ray = rays_of(*rays_through(camera, pixels))
    image = np.empty((*camera.size, 3), np.float32)
    image[tuple(pixels.T)] = np.array(peer.render(mi.Point3f((ray.o + 1) * 0.5), ray.d)).T
    return image


def follow(steps: Iterable, judge: Callable[[], float]) -> Curve:
    """Take steps, and judge what there is after every EVERY of them; only the steps are timed."""
    curve, watch, steps = [], Stopwatch(), iter(steps)
    while True:
        with watch:
            taken = sum(1 for _ in zip(range(EVERY), steps, strict=False))
        if taken < EVERY:
            return curve
        curve.append((watch.seconds, judge()))


# -- Which rays a step has ------------------------------------------------------------------------------------------------


class Pixels(RayBatches):
    """Views of which single pixels are drawn, not tiles."""

    def draw(self, shrink: int, views: np.ndarray, tiles: int, rng: np.random.Generator) -> RayBatch:
        """As many pixels as the tiles would have, in any order."""
        width, height = self.levels[shrink].sizes[views[0]]
        n = len(views) * tiles * TILE**2
        slot, column, row = (rng.integers(0, most, n).astype(np.uint32) for most in (len(views), width, height))
        return self.look_up(shrink, views, mi.UInt32(slot), mi.UInt32(column), mi.UInt32(row))


def ask_locality(size: Size) -> dict:
    """What do tiles of neighbouring rays gain and cost, beside pixels drawn one by one?"""
    field, _ = field_of(size.fields[-1], size)
    n, side = size.fit_resolution // 2, size.fit_side // 2
    photos, held_out = photographed(field, ring(side, 24)), photographed(field, between(side, 24)[::3])
    stages = (
        RadianceStage(n // 2, size.steps, 2, 8, max(side**2 // 512, 1)),
        RadianceStage(n, 2 * size.steps, 1, 8, max(side**2 // 128, 1)),
    )
    answer = {}
    for name, kind in {"tiles": RayBatches, "pixels": Pixels}.items():
        views = kind.of(photos, (1, 2))
        compile_fit(views, stages[-1:])
        fit, watch = begin_radiance_fit(views, BOX, RadiancePlan(stages)), Stopwatch()
        with watch:
            for _ in our_steps(fit):
                pass
        found = held_out_psnr(held_out, lambda camera, fit=fit: view_of(current_field(fit), camera))
        answer[name] = {"psnr": found, "processor_seconds": watch.processor, "steps": fit.course.iterations}
        say(f"  {name}: {found:.2f} dB, {watch.processor / fit.course.iterations * 1e3:.1f} ms a step")
    return answer


# -- Fits beside the peer's -----------------------------------------------------------------------------------------------


def compile_fit(views: RayBatches, stages: Sequence[RadianceStage]) -> None:
    """Take a step of each stage, so that its kernels are there before a clock runs."""
    for stage in stages:
        begin_radiance_fit(views, BOX, RadiancePlan((replace(stage, steps=2),))).advance()
    dr.sync_thread()


def our_steps(fit: Fit) -> Iterator[None]:
    """Take all steps of a plan."""
    for _ in range(fit.course.iterations):
        yield fit.advance()


def our_fit(photos: list[Photo], held_out: list[Photo], size: Size) -> Curve:
    """Our fit: three stages, the last with as many rays a step as a view has pixels."""
    n, steps = size.fit_resolution, size.steps
    tiles = max(size.fit_side**2 // 112, 4)
    kinds = ((8, 1, 4, tiles // 4), (4, 1, 2, tiles // 4), (1, 2, 1, tiles))
    stages = tuple(RadianceStage(n // k, steps * s, shrink, 7, count) for k, s, shrink, count in kinds)
    views = RayBatches.of(photos, (1, 2, 4))
    compile_fit(views, stages)
    fit = begin_radiance_fit(views, BOX, RadiancePlan(stages))
    return follow(our_steps(fit), lambda: held_out_psnr(held_out, lambda camera: view_of(current_field(fit), camera)))


def peer_fit(photos: list[Photo], held_out: list[Photo], size: Size) -> Curve:
    """The peer's fit: four stages of doubling resolution, one view a step."""
    views = [rays_and_colours(photo) for photo in photos]
    for n in (8, 4, 2, 1):  # compiles
        list(Peer.start(size.fit_resolution // n).fit(views, 1))
    dr.sync_thread()
    made = [Peer.start(size.fit_resolution // 8)]
    return follow(
        peer_steps(made, views, size.steps), lambda: held_out_psnr(held_out, lambda camera: view_of_peer(made[-1], camera))
    )


def rays_and_colours(photo: Photo) -> tuple[mi.Point3f, mi.Vector3f, mi.Color3f]:
    """Rays of all pixels of a view in the peer's unit cube, and what they have to see."""
    pixels = tiled(photo.camera.size[0])
    o, d = rays_through(photo.camera, pixels)
    ray = rays_of((o + 1) / 2, d)
    return ray.o, ray.d, mi.Color3f(np.ascontiguousarray(photo.image[tuple(pixels.T)].T))


def peer_steps(made: list[Peer], views: list, steps: int) -> Iterator[None]:
    """Take all steps of the peer's four stages; the peer of each stage is put at the end of ``made``."""
    for stage in range(4):
        if stage:
            made.append(made[-1].refined())
        for _ in made[-1].fit(views, steps):
            yield dr.eval(made[-1].density, made[-1].harmonics)


def ask_fit(size: Size) -> dict:
    """How long until held-out views are as good as the peer's?"""
    answer = {}
    for name in size.fields:
        field, origin = field_of(name, size)
        photos, held_out = photographed(field, ring(size.fit_side)), photographed(field, between(size.fit_side))
        ours, theirs = our_fit(photos, held_out, size), peer_fit(photos, held_out, size)
        took, goal = max(theirs, key=lambda point: point[1])
        when = next((t for t, psnr in ours if psnr >= goal), None)
        ratio = 0.0 if when is None else took / when
        answer[name] = {"field": origin, "peer_psnr": goal, "ours": ours, "peer": theirs, "ratio": ratio}
        reached = "not reached" if when is None else f"after {when:.1f} s"
        say(f"  {name}: peer {goal:.2f} dB in {took:.1f} s; ours {reached}, ends at {ours[-1][1]:.2f} dB")
    return answer
