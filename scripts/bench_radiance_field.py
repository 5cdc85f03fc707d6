#!/usr/bin/env python3
"""How fast are a radiance field's rays and their derivatives, and how much sooner is a fit done, beside Mitsuba's tutorial?

    scripts/bench_radiance_field.py                     # half an hour on 2 idle cores, most of it in the peer
    scripts/bench_radiance_field.py --only step,memory  # 6 minutes
    scripts/bench_radiance_field.py --quick             # under two minutes, small sizes: its times mean nothing

The peer is scripts/radiance_peer.py: uniform steps over textures. Fields: a thin shell, a fog that fills the box, and a fitted
scene (the chair of NeRF's synthetic scenes from MIVOL_DATA, fitted here for a minute; without data, views of a made-up object,
and the JSON says so). All are 128^3 nodes of harmonics of degree 2 in [-1, 1]^3.

step: forward and backward, the same 65,536 rays for both, in turns; ratios of processor time (which other work on the machine
moves least), with the clock's beside them. camera: the pixels of one view; pixels: drawn at random from 8 views, as the
tutorial's loader draws them; any: random origins and directions. The first two share pinholes, so their harmonics are summed
once a node and pinhole, and that is counted. Rays of the third share nothing; no photographs have such rays, and no bar is set
for them: in a fog they cost what the peer's cost, 28 numbers at each corner of a cell, from anywhere in memory.

memory: the most that Dr.Jit held during a gradient step, for N and 4 N rays: what a ray costs is its own state.

locality: fits of 64^3 nodes from 24 views of the fitted scene, with rays of tiles of 4 x 4 pixels (what a fit does) and with as
many rays of single pixels drawn at random from the same views: time a step, and held-out PSNR after as many steps.

fit: 7 views of 256 x 256 pixels rendered of each field over black. The peer does as the tutorial does: 4 stages of doubling
resolution up to 128^3, 105 steps each, one view a step. Ours has 3 stages to the same resolution, in the last as many rays a
step as a view has pixels, from all views, and otherwise what every fit has. The mean PSNR of 4 views between them is followed,
every 7 steps of either, the clock stopped while it is measured; kernels are compiled before. Printed is the peer's time over
ours to the best PSNR that the peer reaches.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mivol  # noqa: F401  (chooses LLVM)
from contest import AT_LEAST, AT_MOST, DATA, TO_WORLD, Bench, judge, plain_ticks, race, ratio_of, say
from mivol.fields.spherical import SphericalGrid
from mivol.optim.radiance_fit import Plan, RadianceFit, Stage
from mivol.optim.radiance_views import TILE, Batch, Views
from mivol.photos import Camera, Photo, load_photos, pixel_centres, rays, silhouette_box
from mivol.photos.camera import intrinsics
from mivol.report.figures import MARKERS, SERIES, STYLE, save
from mivol.transport.line_integrals.radiance_field import RayBatch, backward, bake, cells_of, exact, fold, model_of, render
from radiance_peer import Peer

import drjit as dr
import matplotlib as mpl
import mitsuba as mi
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

STOP = 1e-4
"""Transmittance at which our rays end; the peer's end at 0."""


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    name: str = "full"
    resolution: int = 128
    side: int = 256
    rounds: int = 3
    steps: int = 105
    chair_steps: int = 800
    fit_resolution: int = 128
    fit_side: int = 256


FULL = Size()
QUICK = Size("quick", 32, 64, 1, 7, 30, 32, 32)
BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


# -- Fields and views ---------------------------------------------------------------------------------------------------------


def colours(n: int, seed: int = 0) -> np.ndarray:
    """Smooth harmonics (n, n, n, 9, 3): colours about 0.5, a fifth of them with the direction."""
    g = (np.arange(n, dtype=np.float32) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    rng = np.random.default_rng(seed)
    sh = np.empty((n, n, n, 9, 3), np.float32)
    for b in range(9):
        for c in range(3):
            k, phase = rng.uniform(-4, 4, 3), rng.uniform(0, 6)
            sh[..., b, c] = (0.8 if b == 0 else 0.15) * np.sin(k[0] * x + k[1] * y + k[2] * z + phase)
    return sh


def shell(size: Size) -> tuple[SphericalGrid, str]:
    """A sphere of 0.7 whose skin of two voxels is nearly opaque."""
    n = size.resolution
    g = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    density = np.clip(2.5 * n * (1 - np.abs(np.sqrt(x * x + y * y + z * z) - 0.7) * n / 2.5), -10, None)
    keep = density > -10
    return SphericalGrid.from_dense(density, colours(n), TO_WORLD, keep), "a shell of radius 0.7"


def fog(size: Size) -> tuple[SphericalGrid, str]:
    """A fog that fills the box."""
    n = size.resolution
    g = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    return SphericalGrid.from_dense(
        1 + 0.5 * np.sin(5 * x) * np.sin(4 * y + z), colours(n, 1), TO_WORLD
    ), "a fog of extinction 1"


def fitted(size: Size) -> tuple[SphericalGrid, str]:
    """The chair, fitted for a minute, or a made-up object's views."""
    third = size.chair_steps // 4
    stages = tuple(Stage(size.resolution // k, third * s, k, 8, 128) for k, s in ((4, 1), (2, 1), (1, 2)))
    path = DATA / "multiview" / "chair"
    if path.is_dir():
        photos = load_photos(path, split="train", background="white", scale=0.5)
        views, box, origin = Views.of(photos.views, (1, 2, 4)), silhouette_box(photos), "NeRF's chair"
    else:
        photos = photographed(shell(size)[0], 24, size.side)
        views, box, origin = Views.of(photos, (1, 2, 4)), BOX, "views of the shell (no data folder)"
    fit = RadianceFit(views, box, Plan(stages))
    for number, stage in enumerate(stages):
        fit.begin(number)
        for _ in range(stage.steps):
            fit.advance()
    # Into the box of the others, dense: the peer has nothing else.
    density, sh = fit.field.to_dense()
    density, sh = (_resized(a, size.resolution) for a in (density * fit.unit, sh))
    keep = density > 0
    keep |= np.roll(keep, 1, 0) | np.roll(keep, -1, 0) | np.roll(keep, 1, 1) | np.roll(keep, -1, 1)
    return SphericalGrid.from_dense(density, sh, TO_WORLD, keep), f"{origin}, fitted in {size.chair_steps} steps"


def _resized(values: np.ndarray, n: int) -> np.ndarray:
    """Put an array in the middle of n^3 nodes."""
    out = np.zeros((n, n, n, *values.shape[3:]), np.float32)
    low = [(n - s) // 2 for s in values.shape[:3]]
    out[tuple(slice(a, a + s) for a, s in zip(low, values.shape[:3], strict=True))] = values[:n, :n, :n]
    return out


FIELDS: dict[str, Callable[[Size], tuple[SphericalGrid, str]]] = {"shell": shell, "fog": fog, "fitted": fitted}
_KEPT: dict[tuple[str, str], tuple[SphericalGrid, str]] = {}


def field_of(name: str, size: Size) -> tuple[SphericalGrid, str]:
    """A field, made once."""
    if (name, size.name) not in _KEPT:
        _KEPT[name, size.name] = FIELDS[name](size)
    return _KEPT[name, size.name]


def camera(k: int, of: int, side: int, height: float = 0.9) -> Camera:
    """Camera k on a ring about the box, looking at its middle."""
    angle = 2 * np.pi * k / of
    back = np.array([np.cos(angle), np.sin(angle), 0.0]) * 3 + [0, 0, height]
    z = back / np.linalg.norm(back)
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), back
    return Camera(intrinsics(1.2 * side, 1.2 * side, side / 2, side / 2), (side, side), pose, name=f"camera {k}")


def ring(side: int, count: int = 7, between: bool = False) -> list[Camera]:
    """Cameras of a ring, or those half-way between some of them."""
    return (
        [camera(k + 0.5, count, side) for k in range(0, count, 2)]
        if between
        else [camera(k, count, side) for k in range(count)]
    )


def tiled(side: int) -> np.ndarray:
    """Pixels of a view (row, column), tile by tile of 4 x 4."""
    i = np.arange(side * side)
    tile, within = i // 16, i % 16
    return np.stack([tile // (side // 4) * 4 + within // 4, tile % (side // 4) * 4 + within % 4], axis=1)


def rays_through(one: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of rays through the centres of pixels (row, column)."""
    o, d = rays(one, pixel_centres(one.size)[pixels[:, 0], pixels[:, 1]])
    return np.broadcast_to(o, d.shape), d


def rays_of(o: np.ndarray, d: np.ndarray) -> RayBatch:
    """Rays on the device."""
    made = RayBatch(*(kind(np.ascontiguousarray(np.float32(a.T))) for kind, a in ((mi.Point3f, o), (mi.Vector3f, d))))
    dr.eval(made.o, made.d)
    return made


def photographed(field: SphericalGrid, count: int, side: int, between: bool = False) -> list[Photo]:
    """Views of a field over black, from a ring."""
    return [_photo(field, one) for one in ring(side, count, between)]


def _photo(field: SphericalGrid, one: Camera) -> Photo:
    o, d = rays_through(one, tiled(one.size[0]))
    cells = cells_of(field)
    seen = render(cells, bake(field, cells, o[:1], mi.UInt32(0)), model_of(field), rays_of(o, d))
    image = np.empty((*one.size, 3), np.float32)
    image[tuple(tiled(one.size[0]).T)] = np.clip(np.array(seen.colour).T, 0, 1)
    return Photo(one.name, image, None, None, one, np.zeros(3, np.float32))


# -- Steps --------------------------------------------------------------------------------------------------------------------


@dataclass
class Task:
    """Rays of one kind: what they are, their pinholes and which of them each has."""

    rays: RayBatch
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
    cells, model = cells_of(field), model_of(field, STOP)
    view = None if task.view is None else mi.UInt32(task.view.astype(np.uint32))

    def step(number: int) -> list[mi.Float]:
        baked = view is not None
        source = bake(field, cells, task.pinholes, view, True) if baked else exact(field, task.rays, True)
        seen = render(cells, source, model, task.rays)
        dr.eval(seen)
        backward(cells, source, model, seen, 2 * seen.colour)
        return list(fold(field, cells, source, task.pinholes)) if baked else [source.density_slope, source.harmonics_slope]

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
    for name in FIELDS:
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


# -- Memory -------------------------------------------------------------------------------------------------------------------


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
        "resident_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


# -- Which rays a step has -----------------------------------------------------------------------------------------------------


class Pixels(Views):
    """Views of which single pixels are drawn, not tiles."""

    def draw(self, shrink: int, views: np.ndarray, tiles: int, rng: np.random.Generator) -> Batch:
        """As many pixels as the tiles would have, in any order."""
        width, height = self.levels[shrink].sizes[views[0]]
        n = len(views) * tiles * TILE**2
        slot, column, row = (rng.integers(0, most, n).astype(np.uint32) for most in (len(views), width, height))
        return self.look_up(shrink, views, mi.UInt32(slot), mi.UInt32(column), mi.UInt32(row))


def ask_locality(size: Size) -> dict:
    """What do tiles of neighbouring rays gain and cost, beside pixels drawn one by one?"""
    field, _ = field_of("fitted", size)
    n, side = size.fit_resolution // 2, size.fit_side // 2
    photos = [_photo(field, one) for one in ring(side, 24)]
    judge_of = Judge([_photo(field, one) for one in ring(side, 24, between=True)[::3]])
    stages = (Stage(n // 2, size.steps, 2, 8, max(side**2 // 512, 1)), Stage(n, 2 * size.steps, 1, 8, max(side**2 // 128, 1)))
    answer = {}
    for name, kind in {"tiles": Views, "pixels": Pixels}.items():
        views = kind.of(photos, (1, 2))
        dr.eval(RadianceFit(views, BOX, Plan((replace(stages[-1], steps=2),))).advance())
        dr.sync_thread()
        fit, start = RadianceFit(views, BOX, Plan(stages)), time.process_time()
        for _ in range(fit.plan.steps):
            dr.eval(fit.advance())
        dr.sync_thread()
        seconds = time.process_time() - start
        psnr = judge_of(lambda rays, origin, fit=fit: seen_of(fit, rays, origin))
        answer[name] = {"psnr": psnr, "processor_seconds": seconds, "steps": fit.plan.steps}
        say(f"  {name}: {psnr:.2f} dB, {seconds / fit.plan.steps * 1e3:.1f} ms a step")
    return answer


def seen_of(fit: RadianceFit, rays: RayBatch, origin: np.ndarray) -> np.ndarray:
    """What rays from a pinhole see of a fit's field, (n, 3)."""
    cells = cells_of(fit.field)
    return np.array(render(cells, bake(fit.field, cells, origin, mi.UInt32(0)), model_of(fit.field, STOP), rays).colour).T


# -- Fits ---------------------------------------------------------------------------------------------------------------------


EVERY = 7
"""Steps between two looks at held-out views."""


class Judge:
    """Held-out views, and the mean PSNR of renders of them; its time is not counted."""

    def __init__(self, photos: list[Photo]) -> None:
        self.views = []
        for photo in photos:
            side = photo.camera.size[0]
            o, d = rays_through(photo.camera, tiled(side))
            self.views.append((rays_of(o, d), photo.image[tuple(tiled(side).T)], o[:1]))

    def __call__(self, render: Callable[[RayBatch, np.ndarray], np.ndarray]) -> float:
        errors = [np.mean((np.clip(render(rays, o), 0, 1) - image) ** 2) for rays, image, o in self.views]
        return float(np.mean([-10 * np.log10(max(e, 1e-10)) for e in errors]))


def our_fit(photos: list[Photo], judge_of: Judge, size: Size) -> list[tuple[float, float]]:
    """(seconds, PSNR) of our fit."""
    n, steps = size.fit_resolution, size.steps
    tiles = max(size.fit_side**2 // 112, 4)  # as many rays as a view has pixels
    kinds = ((8, 1, 4, tiles // 4), (4, 1, 2, tiles // 4), (1, 2, 1, tiles))
    stages = tuple(Stage(n // k, steps * s, shrink, 7, count) for k, s, shrink, count in kinds)
    views = Views.of(photos, (1, 2, 4))
    for stage in stages:  # compiles
        dr.eval(RadianceFit(views, BOX, Plan((replace(stage, steps=2),))).advance())
    dr.sync_thread()
    fit = RadianceFit(views, BOX, Plan(stages))

    curve, spent = [], 0.0
    for number, stage in enumerate(stages):
        start = time.perf_counter()
        fit.begin(number)
        for step in range(stage.steps):
            dr.eval(fit.advance())
            if (step + 1) % EVERY == 0:
                dr.sync_thread()
                spent += time.perf_counter() - start
                curve.append((spent, judge_of(lambda rays, origin: seen_of(fit, rays, origin))))
                start = time.perf_counter()
        dr.sync_thread()
        spent += time.perf_counter() - start
    return curve


def peer_fit(photos: list[Photo], judge_of: Judge, size: Size) -> list[tuple[float, float]]:
    """(seconds, PSNR) of the peer's fit."""
    views = []
    for photo in photos:
        o, d = rays_through(photo.camera, tiled(photo.camera.size[0]))
        ray = rays_of((o + 1) / 2, d)
        views.append((ray.o, ray.d, mi.Color3f(np.ascontiguousarray(photo.image[tuple(tiled(photo.camera.size[0]).T)].T))))
    for n in (8, 4, 2, 1):  # compiles
        list(Peer.start(size.fit_resolution // n).fit(views, 1))
    dr.sync_thread()
    peer, curve, spent = Peer.start(size.fit_resolution // 8), [], 0.0

    def render(rays: RayBatch, origin: np.ndarray) -> np.ndarray:
        return np.array(peer.render(mi.Point3f((rays.o + 1) * 0.5), rays.d)).T

    for number in range(4):
        start = time.perf_counter()
        for step, _ in enumerate(peer.fit(views, size.steps)):
            dr.eval(peer.density, peer.harmonics)
            if (step + 1) % EVERY == 0:
                dr.sync_thread()
                spent += time.perf_counter() - start
                curve.append((spent, judge_of(render)))
                start = time.perf_counter()
        if number < 3:
            peer = peer.refined()
    return curve


def ask_fit(size: Size) -> dict:
    """How long until held-out views are as good as the peer's?"""
    answer = {}
    for name in FIELDS:
        field, origin = field_of(name, size)
        photos = photographed(field, 7, size.fit_side)
        judge_of = Judge(photographed(field, 7, size.fit_side, between=True))
        ours, theirs = our_fit(photos, judge_of, size), peer_fit(photos, judge_of, size)
        took, goal = max(theirs, key=lambda point: point[1])
        when = next((t for t, psnr in ours if psnr >= goal), None)
        ratio = 0.0 if when is None else took / when
        answer[name] = {"field": origin, "peer_psnr": goal, "ours": ours, "peer": theirs, "ratio": ratio}
        reached = "not reached" if when is None else f"after {when:.1f} s"
        say(f"  {name}: peer {goal:.2f} dB in {took:.1f} s; ours {reached}, ends at {ours[-1][1]:.2f} dB")
    return answer


# -- Saying it ----------------------------------------------------------------------------------------------------------------

STEP_BARS = {"camera": 8, "pixels": 4}
"""How many times the peer's rays a second there must be, for each order of the rays."""


def compare(question: str, answer: dict) -> list[dict]:
    """The figures that have a bar."""
    if question == "memory":
        return [judge("bytes a ray beyond the grid's", answer["bytes_per_ray"], AT_MOST, 512)]
    if question == "locality":
        return []
    if question == "fit":
        return [judge(f"{name}: time to the same PSNR", a["ratio"], AT_LEAST, 10) for name, a in answer.items()]
    return [
        judge(f"{name}: {kind} rays, forward and backward", a[kind]["ratio_of_processor_time"], AT_LEAST, bar)
        for name, a in answer.items()
        for kind, bar in STEP_BARS.items()
    ]


def draw(answers: dict, folder: Path) -> None:
    """A panel for each question that has a picture, and one for each field of the fits."""
    panels = [(PANELS[question], answer) for question, answer in answers.items() if question in PANELS]
    panels += [(draw_fit, {name: answer}) for name, answer in answers.get("fit", {}).items()]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.2 * max(len(panels), 1), 3.6))
        FigureCanvasAgg(figure)
        for number, (panel, answer) in enumerate(panels, 1):
            panel(figure.add_subplot(1, len(panels), number), answer)
    save(figure, folder / "bench_radiance_field.png")


def draw_step(axes: mpl.axes.Axes, answer: dict) -> None:
    """How many times the peer's rays a second, for each order of the rays."""
    rows = np.arange(len(answer))[::-1]
    for i, kind in enumerate(("camera", "pixels", "any")):
        ratios = [a[kind]["ratio_of_processor_time"] for a in answer.values()]
        axes.semilogx(ratios, rows, MARKERS[i], color=SERIES[i], label=f"{kind} rays" if kind != "pixels" else "random pixels")
        if kind in STEP_BARS:
            axes.axvline(STEP_BARS[kind], color=SERIES[i], linestyle="--", linewidth=1.2)
    axes.set(yticks=rows, yticklabels=list(answer), ylim=(-0.6, len(rows) + 0.5))
    axes.set(title="Rays a second over the peer's", xlabel="forward and backward (lines: the bars)")
    plain_ticks(axes.xaxis, "×")
    axes.legend(loc="upper left")


def draw_memory(axes: mpl.axes.Axes, answer: dict) -> None:
    """Peak of a step for two numbers of rays."""
    axes.bar(("rays", "4 x rays"), np.array(answer["peak_bytes"]) / 2**20, 0.5, color=SERIES[0])
    axes.axhline(answer["field_bytes"] / 2**20, color=SERIES[1], linestyle="--", linewidth=1.2, label="the field")
    axes.set(title=f"{answer['bytes_per_ray']:.0f} bytes a ray", ylabel="peak of a step [MiB]")
    axes.legend()


def draw_locality(axes: mpl.axes.Axes, answer: dict) -> None:
    """What a step takes, and where as many steps end."""
    for i, (name, a) in enumerate(answer.items()):
        axes.plot(1e3 * a["processor_seconds"] / a["steps"], a["psnr"], MARKERS[i], color=SERIES[i], label=name)
    axes.set(title="Tiles and single pixels", xlabel="processor time of a step [ms]", ylabel="held-out PSNR [dB]")
    axes.margins(0.4)
    axes.legend()


def draw_fit(axes: mpl.axes.Axes, answer: dict) -> None:
    """Held-out views against time."""
    ((name, curves),) = answer.items()
    for i, (who, label) in enumerate((("ours", "mivol"), ("peer", "tutorial's method"))):
        axes.semilogx(*zip(*curves[who], strict=True), marker=MARKERS[i], markersize=3, color=SERIES[i], label=label)
    axes.axhline(curves["peer_psnr"], color=SERIES[1], linestyle="--", linewidth=1.2)
    axes.set(title=f"{name}, 7 views", xlabel="time [s]", ylabel="held-out PSNR [dB]")
    axes.legend(loc="lower right")


PANELS = {"step": draw_step, "memory": draw_memory, "locality": draw_locality}

BENCH = Bench(
    "bench_radiance_field",
    __doc__,
    {"step": ask_step, "memory": ask_memory, "locality": ask_locality, "fit": ask_fit},
    (FULL, QUICK),
    compare,
    draw,
)

if __name__ == "__main__":
    BENCH.main()
