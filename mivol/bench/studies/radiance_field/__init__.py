"""How fast are a radiance field's rays and their derivatives, and how much sooner is a fit done, beside Mitsuba's tutorial?

    mivol bench radiance_field                     # an hour on 2 idle cores, most of it in photographs and the peer
    mivol bench radiance_field --only step         # 5 minutes
    mivol bench radiance_field --only photographs  # 40 minutes, a third of them for one fit
    mivol bench radiance_field --quick             # under two minutes, small sizes: the times mean nothing

The peer (:mod:`mivol.bench.studies.radiance_field.contestants`) takes uniform steps through textures. Fields: a thin shell, a
fog that fills the box, and a fitted scene (the chair of NeRF's synthetic scenes from MIVOL_DATA, fitted here for a minute;
without the data, views of the shell, and the JSON records this). All are 128^3 nodes of harmonics of degree 2 in [-1, 1]^3.

step: forward and backward, the same 65,536 rays for both, in turns; ratios of processor time, with those of the wall clock.
Three kinds of rays: ``camera``, the pixels of one view; ``pixels``, random pixels of 8 views, as the loader of the tutorial
draws them; ``any``, random origins and directions. The first two share pinholes, so their harmonics are summed once for each
node and pinhole, and this time counts. Rays of the third kind share nothing: each reads 28 numbers at every corner and carries
the corners of a face on to the next cell. They are sorted first, and this time counts.

fit: 7 views of 256 x 256 pixels, rendered of each field over black. The peer fits as the tutorial does: 4 stages of doubling
resolution up to 128^3, 105 steps each, one view in each step. mivol has 3 stages up to the same resolution. Its last stage has
as many rays in a step as a view has pixels, from all views; all else is as in every fit. The mean PSNR of 4 views in between is
measured every 7 steps of either, with stopped clock, after all kernels were compiled. The study reports the time of the peer
over mivol's time to the best PSNR of the peer.

photographs: fits of data sets with the settings of ``mivol optimize``: quality of test views, time, memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.axes import Axes

from mivol.bench.harness.contests import Stopwatch, race, time_ratio
from mivol.bench.harness.figures import new_figure, plot_errors, plot_ratios
from mivol.bench.harness.study import AT_LEAST, AT_MOST, Promise, Study, amount, say_row
from mivol.bench.photo_fits import PhotoSize, find_photographs, fit_photographs, prepare_fit
from mivol.bench.studies.radiance_field.contestants import (
    BLACK,
    BOX,
    STOP,
    FieldSize,
    Peer,
    load_field,
    make_camera,
    middle_cameras,
    photograph,
    ring_cameras,
    tiled_pixels,
    to_bundle,
    trace,
)
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.loop import Fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage, estimate_bytes
from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Camera, Photo
from mivol.report.figures import SERIES
from mivol.transport.line_integrals.radiance_field import (
    RayBundle,
    RayGradient,
    find_occupied_cells,
    make_model,
    render_rays,
    vjp_rays,
)
from mivol.transport.line_integrals.radiance_source import bake, make_exact, vjp_bake
from mivol.validate.metrics import psnr


class FitChoice(NamedTuple):
    """A fit of a data set of photographs.

    Attributes:
        name: data set.
        longest: nodes along an edge of a cube with as many nodes; None: as the preset.
        effort: factor on the steps of the preset.
        preset: name of the preset.
    """

    name: str
    longest: int | None = None
    effort: float = 1.0
    preset: str = "cpu"

    def __str__(self) -> str:
        return f"{self.name} at {self.longest}" if self.longest else f"{self.name}, {self.preset}"


ALL_FITS = (
    FitChoice("chair", 128),
    FitChoice("chair", 256, 1.9),
    FitChoice("chair", preset="fine"),
    *(FitChoice(name, 128) for name in ("still_life", "wires", "glossy")),
    *(FitChoice(name, preset="fine") for name in ("still_life", "wires", "glossy")),
)


@dataclass(frozen=True)
class RadianceSize(FieldSize, PhotoSize):
    """Amount of work."""

    side: int = amount(256, 64, "edge of images whose rays are timed [pixels]")
    rounds: int = amount(3, 1, "warm steps of each contestant")
    photo_fits: tuple[FitChoice, ...] = amount(
        ALL_FITS, (FitChoice("chair", 32, 0.03), FitChoice("wires", 32, 0.03)), "fits", tuple
    )


# -- Steps ------------------------------------------------------------------------------------------------------------------


@dataclass
class RayTask:
    """Rays of one kind.

    Attributes:
        rays: the rays.
        pinholes: shared origins (P, 3).
        view: index of the pinhole of each ray; None: the rays share no pinholes.
    """

    rays: RayBundle
    pinholes: np.ndarray | None = None
    view: np.ndarray | None = None


def make_tasks(size: RadianceSize) -> dict[str, RayTask]:
    """The three kinds of rays."""
    n = size.side**2
    rng = np.random.default_rng(0)
    one = make_camera(0.3, 7, size.side)
    camera = RayTask(to_bundle(*trace(one, tiled_pixels(size.side))), one.origin[None], np.zeros(n, int))
    cameras = ring_cameras(size.side, 8)
    view = np.sort(rng.integers(8, size=n))
    chosen = rng.integers(size.side, size=(n, 2))
    pairs = [trace(c, chosen[view == k]) for k, c in enumerate(cameras)]
    o, d = (np.concatenate(part) for part in zip(*pairs, strict=True))
    pixels = RayTask(to_bundle(o, d), np.array([c.origin for c in cameras]), view)
    o = rng.normal(size=(n, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.7, 0.7, (n, 3)) - o
    return {"camera": camera, "pixels": pixels, "any": RayTask(to_bundle(o, d / np.linalg.norm(d, axis=1, keepdims=True)))}


def mivol_step(field: SphericalGrid, task: RayTask) -> Callable[[int], list[mi.Float]]:
    """Contestant: forward and backward of the squared radiance by mivol."""
    cells, model = find_occupied_cells(field), make_model(field, STOP)
    view = None if task.view is None else mi.UInt32(task.view.astype(np.uint32))

    def step(number: int) -> list[mi.Float]:
        baked = view is not None
        source = bake(field, cells, task.pinholes, view, True) if baked else make_exact(field, task.rays.d, True)
        radiance = render_rays(cells, source, model, task.rays)
        dr.eval(radiance)
        vjp_rays(cells, source, model, radiance, RayGradient(2 * radiance.colour))
        return list(vjp_bake(field, cells, source, task.pinholes)) if baked else list(source.slopes())

    return step


def to_peer(field: SphericalGrid) -> Peer:
    """The same field in textures over the unit cube, in which lengths are half as large."""
    density, sh = field.to_dense()
    sh[..., 0, :] += field.offset / 0.28209479  # the peer has no offset: the constant harmonic takes it
    density, sh = density[..., None] * np.float32(2), sh.reshape(*sh.shape[:3], 27)
    return Peer(*(mi.TensorXf(np.ascontiguousarray(a)) for a in (density, sh)))


def peer_step(peer: Peer, task: RayTask) -> Callable[[int], list[mi.Float]]:
    """Contestant: forward and backward of the squared radiance by the peer."""
    o, d = mi.Point3f((task.rays.o + 1) * 0.5), task.rays.d
    dr.eval(o)

    def step(number: int) -> list[mi.Float]:
        L = peer.render(o, d)
        dr.eval(L)
        return list(peer.backward(o, d, L, 2 * L))

    return step


def measure_step(size: RadianceSize) -> dict:
    """How many rays per second are followed forward and backward, beside the peer?"""
    answer = {}
    for name in size.fields:
        field, origin = load_field(name, size)
        peer = to_peer(field)
        answer[name] = {"field": origin, "rows": field.rows}
        for kind, task in make_tasks(size).items():
            times = race({"mivol": mivol_step(field, task), "peer": peer_step(peer, task)}, size.rounds)
            answer[name][kind] = {
                "ratio_of_processor_time": time_ratio(times["peer"], times["mivol"], "processor"),
                "ratio_of_time": time_ratio(times["peer"], times["mivol"]),
                **{who: t.report(size.side**2, "rays") for who, t in times.items()},
            }
    return answer


# -- Fits of rendered views -------------------------------------------------------------------------------------------------

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


# -- Photographs ------------------------------------------------------------------------------------------------------------

STEPS_TIMED = 8


def measure_photographs(size: RadianceSize) -> dict:
    """How good are held-out views, after how long, and how much memory does a fit hold?"""
    answer = {}
    for wanted in size.photo_fits:
        folder = find_photographs(wanted.name, size)
        if folder is not None:
            answer[str(wanted)] = figures = fit_and_judge(folder, wanted, size)
            say_row(str(wanted), **{key: figures[key] for key in ("psnr", "seconds", "held_gib")})
    return answer


def fit_and_judge(folder: Path, wanted: FitChoice, size: RadianceSize) -> dict:
    """Fit a data set as ``mivol optimize`` does, and measure.

    Returns:
        ``psnr`` [dB] and ``ssim`` of the test views, ``train_psnr`` of some fitted views; ``seconds`` of the reference machine,
        ``processor_seconds``, ``walk_rays_per_second``; processor time ``step_milliseconds`` of a step of the last stage, and
        its ``step_rays``; memory ``counted_gib`` by the plan for the stored rows, and ``held_gib`` by Dr.Jit, both without the
        photographs.
    """
    photos = {"background": "white", "judged": "test", "held_out": 0}
    adapt = (lambda plan: plan) if wanted.longest is None else (lambda plan: plan.with_longest(wanted.longest))
    prepared = prepare_fit(folder, photos, {"field": {"preset": wanted.preset, "effort": wanted.effort}}, adapt=adapt)
    problem, train = prepared.problem, prepared.train.views
    done, last = fit_photographs(problem, size.walk_side), problem.plan.stages[-1]
    return {
        **prepared.score(prepared.judged.views, ("psnr", "ssim")),
        "train_psnr": prepared.score(train[:: max(1, len(train) // 8)])["psnr"],
        "seconds": done.seconds,
        "processor_seconds": done.processor,
        "walk_rays_per_second": done.rate,
        "step_milliseconds": 1e3 * time_step(done.fit),
        "step_rays": 16 * min(last.views, len(train)) * last.tiles,
        "rows": problem.field.rows,
        "counted_gib": estimate_bytes(problem.plan, last, prepared.train.box, problem.field.rows) / 2**30,
        "held_gib": done.held / 2**30,
    }


def time_step(fit: Fit) -> float:
    """Processor time of one more step of a finished fit, median of a few [s]."""
    times = []
    for number in range(STEPS_TIMED):
        with Stopwatch() as watch:
            fit.run.step(fit.next_iteration + number, 1.0)
        times.append(watch.processor)
    return float(np.median(times))


# -- Bars and figure --------------------------------------------------------------------------------------------------------

STEP_BARS = {"camera": 8, "pixels": 4, "any": 4}
"""Smallest ratio to the peer's rays per second, by kind of rays."""

PHOTO_BARS = {
    "chair at 128": [("psnr", AT_LEAST, 30.2), ("seconds", AT_MOST, 60), ("step_milliseconds", AT_MOST, 70)],
    "chair at 256": [("psnr", AT_LEAST, 31.3), ("seconds", AT_MOST, 300), ("held_gib", AT_MOST, 1.5)],
    "chair, fine": [("psnr", AT_LEAST, 32.0), ("seconds", AT_MOST, 1200), ("held_gib", AT_MOST, 16)],
}
"""Bars of fits of photographs, by fit."""

PROMISES = {
    "step": [
        Promise(f"{{}}: {kind} rays, forward and backward", ("*", kind, "ratio_of_processor_time"), AT_LEAST, bar)
        for kind, bar in STEP_BARS.items()
    ],
    "fit": [Promise("{}: time to the same PSNR", ("*", "ratio"), AT_LEAST, 10)],
    "photographs": [Promise(f"{fit}: {bar[0]}", (fit, bar[0]), *bar[1:]) for fit, bars in PHOTO_BARS.items() for bar in bars],
}


def draw(answers: dict, path: Path) -> None:
    """A panel for the steps, and a panel for each field of the fits."""
    panels = [(plot_step, answers["step"])] if "step" in answers else []
    panels += [(plot_fit, {name: answer}) for name, answer in answers.get("fit", {}).items()]
    with new_figure(path, 4.2 * max(len(panels), 1), 3.6) as figure:
        for number, (plot, answer) in enumerate(panels, 1):
            plot(figure.add_subplot(1, len(panels), number), answer)


def plot_step(axes: Axes, answer: dict) -> None:
    """Plot ratios to the peer's rays per second."""
    labels = {"camera": "camera rays", "pixels": "random pixels", "any": "any rays"}
    series = {labels[kind]: [a[kind]["ratio_of_processor_time"] for a in answer.values()] for kind in STEP_BARS}
    plot_ratios(axes, list(answer), series, STEP_BARS.values())
    axes.set(ylim=(-0.6, len(answer) - 0.5 + 1))
    axes.set(title="Rays a second over the peer's", xlabel="forward and backward (lines: the bars)")
    axes.legend(loc="upper left")


def plot_fit(axes: Axes, answer: dict) -> None:
    """Plot the PSNR of held-out views against time."""
    ((name, curves),) = answer.items()
    series = {label: tuple(zip(*curves[who], strict=True)) for who, label in (("ours", "mivol"), ("peer", "tutorial's method"))}
    plot_errors(axes, series, log=False, markersize=3)
    axes.set_xscale("log")
    axes.axhline(curves["peer_psnr"], color=SERIES[1], linestyle="--", linewidth=1.2, label="its best")
    axes.set(title=f"{name}, 7 views", xlabel="time [s]", ylabel="held-out PSNR [dB]")
    axes.legend()


QUESTIONS = {"step": measure_step, "fit": measure_fit, "photographs": measure_photographs}
STUDY = Study(__name__, __doc__, RadianceSize, QUESTIONS, draw=draw, on_request=("photographs",), promises=PROMISES)
