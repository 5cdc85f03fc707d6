"""How long does a step of an optimisation take beside its kernels, in a loop that a user writes?

    mivol bench steps                                        # half a minute on 2 idle cores
    mivol bench steps --only fits                            # ten seconds: steps of mivol's own fits
    mivol bench steps --only chair                           # a minute: a step of a grid of 128^3, with MIVOL_DATA
    mivol bench steps --only first                           # a minute: first steps of fresh processes, nothing compiled before
    mivol bench steps --only loops                           # two minutes: loops with an optimizer, from 16^2 x 1 to 128^2 x 16
    mivol bench steps --quick                                # ten seconds, two scenes, few steps
    mivol bench steps --scenes tutorial god_rays --sides 16 64 --spp 1 16

A step sets a parameter, calls ``params.update()``, and renders an image; with a gradient it also calls ``dr.backward`` on a
loss of the image. The loop with ``mivol`` and the loop with ``prbvolpath`` differ in the name of the integrator only. They take
turns. On the smallest film kernels take no time, so a step shows the work of the host: tracing, or the replay of a recording.

loops: the same with a whole step of a fit, as in the tutorials of Mitsuba: ``mi.render``, ``dr.backward`` on the mean squared
difference from a constant image, ``mi.ad.Adam``, values clipped at 0, ``params.update()``.

first: the first step with a gradient of a fresh process with an empty cache of kernels, 16^2 x 1, in processor time: it traces,
records and compiles.

chair: steps of the last stage of a fit of the chair (400 pixels, preset ``cpu`` with 128 nodes along the box, 65,536 rays a
step), with their processor time.

The scene ``tutorial`` is the smoke of the Mitsuba tutorial under a sky at depth 6; ``tutorial_sun`` is the same smoke with the
phase function ``hg`` under a sun in a sky; ``tutorial_rgb`` has an extinction for each colour there. A point light
shines in thin smoke on a fine grid in ``lamp_in_thin_smoke``. The other scenes are scenes of the study ``everyday``.

fits: a step of the fit loop with its optimizer, schedule, priors and record, on tiny models: the density of ``tutorial`` with
Adam (also through ``prbvolpath``), a radiance field of 24^3 nodes (256 rays a step) and 256 Gaussians, both from photographs
of 24^2 pixels.

Milliseconds are wall times: medians over the steps after the first ``WARM`` ones, in which both integrators compile. A ratio is
the time of ``prbvolpath`` over the time of mivol, without regard to their noise (``mivol bench everyday`` compares errors).
Launches are kernels, copies and fills of a step; the numbers in brackets leave out the update of the parameter.
"""

from __future__ import annotations

import itertools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.contests import Stopwatch
from mivol.bench.harness.figures import new_figure, use_plain_ticks
from mivol.bench.harness.study import AT_LEAST, AT_MOST, Bar, Question, Size, Study, amount, ask, judge, say_row
from mivol.bench.photo_fits import PhotoSize, find_photographs, prepare_fit
from mivol.bench.scenes import box_scene, made_up, point_light, smoke, sun_and_sky
from mivol.bench.studies.everyday import EverydayScene, chosen_scenes
from mivol.errors import MivolError
from mivol.experiments.gaussian_fit import make_start_cloud
from mivol.optim.first_order import Adam
from mivol.optim.gaussians.gaussian_plan import GaussianPlan, GaussianStage
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.parameters import Parameter
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.photos import Camera, Photo
from mivol.photos.camera import intrinsics
from mivol.report.figures import SERIES
from mivol.splatting import Splatter
from mivol.threads import run_child

PEER = "prbvolpath"
DENSITY_OF_BOX = "box.interior_medium.sigma_t.data"
TUTORIAL = EverydayScene(lambda side: box_scene(smoke().values, side, albedo=0.8), 6, 1.0, None, DENSITY_OF_BOX)
"""The scene ``tutorial``."""


def _coloured_smoke() -> np.ndarray:
    """The smoke of the tutorial with an extinction for each colour (Z, Y, X, 3) [1/length]."""
    return smoke().values[..., None] * np.float32([1.0, 0.6, 0.3])


OWN_SCENES = {
    "tutorial": TUTORIAL,
    "tutorial_sun": replace(TUTORIAL, build=lambda side: box_scene(smoke().values, side, albedo=0.8, **sun_and_sky())),
    "tutorial_rgb": replace(TUTORIAL, build=lambda side: box_scene(_coloured_smoke(), side, albedo=0.8, **sun_and_sky())),
    "lamp_in_thin_smoke": replace(
        TUTORIAL,
        build=lambda side: box_scene(made_up((40, 40, 40), 3.0).values, side, albedo=0.9, **point_light((0.0, 0.1, 0.2))),
    ),
}
"""The scenes of this study, by name."""

WARM = 3
"""Steps before the timing."""


@dataclass(frozen=True)
class StepsSize(Size):
    """Amount of work."""

    scenes: tuple[str, ...] = amount(
        ("smoke_sun_map", "smoke_on_floor", "smoke_point_inside", "god_rays", "tissue", "jade_null_sun"),
        ("smoke_on_floor", "jade_null_sun"),
        f"{', '.join(OWN_SCENES)}, and scenes of the study everyday",
    )
    sides: tuple[int, ...] = amount((4, 16, 64), (4,), "edges of the image [pixels]")
    spp: tuple[int, ...] = amount((1,), doc="samples per pixel of a step")
    steps: int = amount(15, 3, "steps of each integrator")
    loop_scenes: tuple[str, ...] = amount(("tutorial", "smoke_on_floor", "jade_null_sun"), ("tutorial",), "scenes of loops")
    films: int = amount(4, 1, "films of loops: 16^2 x 1, 32^2 x 4, 64^2 x 16, 128^2 x 16")
    nodes: int = amount(128, 16, "nodes along the box of the chair")
    loop_steps: int = amount(7, 2, "steps of each loop")


class _Loop:
    """A user's loop over one scene with one integrator."""

    def __init__(self, scene: EverydayScene, name: str, side: int, spp: int) -> None:
        self.scene, self.key, self.spp = scene.load(side), scene.parameter, spp
        self.integrator, self.params = scene.integrator(name), mi.traverse(self.scene)
        self.start = type(self.params[self.key])(self.params[self.key])
        self.count = 0

    def step(self, differentiates: bool) -> None:
        """Put another value, render, and differentiate on request."""
        self.put_value(differentiates)
        self.render(differentiates)

    def count_render_launches(self, differentiates: bool) -> int:
        """Launches of a step without the update of its value."""
        self.put_value(differentiates)
        return count_launches(partial(self.render, differentiates))

    def put_value(self, is_differentiated: bool) -> None:
        """Put another value of the parameter."""
        self.count += 1
        value = type(self.start)(self.start * (1 - 1e-4 * self.count))
        if is_differentiated:
            dr.enable_grad(value)
        self.params[self.key] = value
        self.params.update()

    def render(self, differentiates: bool) -> None:
        """Render, and differentiate on request."""
        image = mi.render(self.scene, self.params, integrator=self.integrator, spp=self.spp, seed=self.count)
        if differentiates:
            dr.backward(dr.mean(image, axis=None))
            dr.eval(dr.grad(self.params[self.key]))
        dr.eval(image)
        dr.sync_thread()


class _FitLoop(_Loop):
    """A user's fit of a parameter by ``mi.ad.Adam``."""

    def __init__(self, scene: EverydayScene, name: str, side: int, spp: int) -> None:
        super().__init__(scene, name, side, spp)
        self.adam = mi.ad.Adam(lr=1e-3, params={self.key: self.start})
        self.params.update(self.adam)

    def fit(self) -> None:
        """Take a step."""
        self.count += 1
        image = mi.render(self.scene, self.params, integrator=self.integrator, spp=self.spp, seed=self.count)
        dr.backward(dr.mean(dr.square(image - 0.5), axis=None))
        self.adam.step()
        self.adam[self.key] = dr.maximum(self.adam[self.key], 0)
        self.params.update(self.adam)
        dr.eval(self.adam[self.key])
        dr.sync_thread()


FILMS = (16, 1), (32, 4), (64, 16), (128, 16)
"""Edge [pixels] and samples per pixel of loops."""


def measure_loops(size: StepsSize) -> dict:
    """Time whole steps of fits by both integrators."""
    rows = {}
    for name, scene in choose_scenes(size.loop_scenes).items():
        for side, spp in FILMS[: size.films]:
            loops = {who: _FitLoop(scene, who, side, spp) for who in (PEER, "mivol")}
            row = race_steps({who: loop.fit for who, loop in loops.items()}, size.loop_steps)
            rows[f"{name}, {side}^2 x {spp}"] = row
            say_row(f"{name}, {side}^2 x {spp}", ratio=row["ratio"], milliseconds=row["milliseconds"]["mivol"])
    return {"rows": rows, "least_ratio": min(row["ratio"] for row in rows.values())}


CHAIR_STEPS = 16
"""Steps of a timed run through steps of the chair: losses are read late, and lists of cells are made anew in few steps."""


def measure_chair(size: StepsSize) -> dict:
    """Time steps of a large grid."""
    folder = find_photographs("chair", PhotoSize())
    if folder is None:
        return {"rows": {}}
    photos = {"background": "white", "judged": "test", "held_out": 0, "scale": 0.5}
    prepared = prepare_fit(folder, photos, {"field": {"preset": "cpu", "longest": size.nodes}})
    plan = prepared.problem.plan
    fit = begin_fit(prepared.problem, plan.optimizer, plan.course())
    while fit.next_iteration < sum(stage.steps for stage in plan.stages[:-1]) + CHAIR_STEPS:
        fit.advance()
    watches = []
    for _ in range(size.steps):
        fit.read_losses()
        watches.append(Stopwatch())
        with watches[-1]:
            for _ in range(CHAIR_STEPS):
                fit.advance()
            fit.read_losses()
    wall, processor = (1e3 * float(np.median(times)) / CHAIR_STEPS for times in _times_of(watches))
    say_row("chair", wall_ms=wall, processor_ms=processor)
    row = {"milliseconds": {"mivol": wall}, "processor": processor, "launches": {"mivol": count_launches(fit.advance)}}
    return {"rows": {f"the chair in {size.nodes}^3": row}}


def _times_of(watches: list[Stopwatch]) -> tuple[list[float], list[float]]:
    return [watch.seconds for watch in watches], [watch.processor for watch in watches]


CHILD = "import sys; import mitsuba as mi; mi.set_variant(sys.argv[1]); from mivol.bench.studies import steps; {}"
"""Program of a fresh process."""

MAX_CHAIR = 50.0
"""Wall time that a step of the chair should take at most on two idle cores [ms]."""

MAX_FIRST = 2.0
"""Processor time that a first step should take at most [s]."""


def measure_first(size: StepsSize) -> dict:
    """Time first steps in fresh processes."""
    rows = {}
    for name in size.loop_scenes:
        found = {who: _run_first_step(name, who) for who in (PEER, "mivol")}
        times, launches = ({who: row[kind] for who, row in found.items()} for kind in ("milliseconds", "launches"))
        rows[f"{name}, first step"] = {
            "milliseconds": times,
            "launches": launches,
            "ratio": times[PEER] / times["mivol"],
        }
        say_row(f"{name}, first step", peer=times[PEER], mivol=times["mivol"])
    return {"rows": rows, "most_seconds": max(row["milliseconds"]["mivol"] for row in rows.values()) / 1e3}


def _run_first_step(scene: str, who: str) -> dict[str, float]:
    with TemporaryDirectory() as cache:
        program = CHILD.format("print(steps.time_first_step(*sys.argv[2:]))")
        done = run_child(program, mi.variant(), scene, who, timeout=600, env=os.environ | {"DRJIT_CACHE_DIR": cache})
    if done.returncode:
        raise MivolError(f"the process of the first step of {who} ended with {done.returncode}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def time_first_step(scene: str, who: str) -> str:
    """Processor time [ms] and launches of the first step of this process, as JSON."""
    loop = _Loop(choose_scenes((scene,))[scene], who, 16, 1)
    started = time.process_time()
    launches = count_launches(lambda: loop.step(True))
    return json.dumps({"milliseconds": 1e3 * (time.process_time() - started), "launches": launches})


def choose_scenes(names: tuple[str, ...]) -> dict[str, EverydayScene]:
    """The scenes with these names; the scenes of this study come last."""
    scenes = chosen_scenes([name for name in names if name not in OWN_SCENES])
    return scenes | {name: scene for name, scene in OWN_SCENES.items() if name in names}


def measure_steps(differentiates: bool, size: StepsSize) -> dict:
    """Time steps of both integrators in each scene and for each film."""
    rows = {}
    for name, scene in choose_scenes(size.scenes).items():
        for side, spp in itertools.product(size.sides, size.spp):
            row = _contend({who: _Loop(scene, who, side, spp) for who in (PEER, "mivol")}, size, differentiates)
            rows[f"{name}, {side}^2 x {spp}"] = row
            say_row(f"{name}, {side}^2 x {spp}", ratio=row["ratio"], milliseconds=row["milliseconds"]["mivol"])
    return {"rows": rows, "least_ratio": min(row["ratio"] for row in rows.values())}


def _contend(loops: dict[str, _Loop], size: StepsSize, differentiates: bool) -> dict:
    row = race_steps({name: partial(loop.step, differentiates) for name, loop in loops.items()}, size.steps)
    return row | {"render_launches": {name: loop.count_render_launches(differentiates) for name, loop in loops.items()}}


def race_steps(steps: dict[str, Callable[[], object]], count: int) -> dict:
    """Times, launches, and the ratio of times of steps that take turns; the ratio only if the peer takes part."""
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for step in steps.values():
        for _ in range(WARM):
            step()
    for _ in range(count):
        for name, step in steps.items():
            seconds[name].append(_time(step))
    row = {
        "milliseconds": {name: 1e3 * float(np.median(s)) for name, s in seconds.items()},
        "launches": {name: count_launches(step) for name, step in steps.items()},
    }
    return row | {"ratio": float(np.median(np.divide(seconds[PEER], seconds["mivol"])))} if PEER in steps else row


def _time(step: Callable[[], object]) -> float:
    start = time.perf_counter()
    step()
    return time.perf_counter() - start


PHOTO_SIDE, PHOTOS = 24, 6
"""Edge [pixels] and number of the photographs of tiny fits."""


def measure_fits(size: StepsSize) -> dict:
    """Time steps of fits of tiny models."""
    scenes = {name: _begin_scene_fit(name) for name in (PEER, "mivol")}
    photos = _photograph_cloud()
    grid = RadiancePlan((RadianceStage(24, 1000, tiles=4),), degree=1)
    field = RadianceProblem(RayBatches.from_photos(photos, (1,)), np.array([[-1.0] * 3, [1.0] * 3]), grid)
    plan = GaussianPlan((GaussianStage(PHOTO_SIDE, 1000, 1, 1),), start=256, most=256)
    cloud = make_start_cloud(_draw_places(256, 1), photos, plan.degree)
    gaussians = GaussianProblem(RayBatches.from_photos(photos, (1,)), [photo.camera for photo in photos], cloud, plan)
    rows = {"a scene with Adam": race_steps({name: fit.advance for name, fit in scenes.items()}, size.steps)}
    for name, problem, optimizer in (("a grid", field, grid.optimizer), ("Gaussians", gaussians, plan.optimizer)):
        rows[name] = race_steps({"mivol": begin_fit(problem, optimizer, 1000).advance}, size.steps)
    return {"rows": rows, "least_ratio": rows["a scene with Adam"]["ratio"]}


def _begin_scene_fit(name: str) -> Fit:
    scene = TUTORIAL.load(4)
    view = View("view", scene.sensors()[0], mi.TensorXf(np.ones((4, 4, 3), np.float32)))
    parameter = Parameter(TUTORIAL.parameter, domain=(0.0, np.inf), lr=1e-3)
    return begin_fit(SceneProblem(scene, [view], [parameter], TUTORIAL.integrator(name), spp=1), Adam(), 1000)


def _draw_places(count: int, seed: int) -> np.ndarray:
    """Points on a sphere of radius 0.6."""
    drawn = np.random.default_rng(seed).normal(size=(count, 3))
    return 0.6 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def _photograph_cloud() -> list[Photo]:
    """Photographs of opaque Gaussians on a sphere, over white."""
    cloud, white = make_start_cloud(_draw_places(120, 5), [], 0), np.ones(3, np.float32)
    cloud["opacity_logits"][:] = 3
    cloud["harmonics"][:, 0] = 1.5 * np.sin(5 * cloud["means"])
    tensors = {name: mi.TensorXf(array) for name, array in cloud.items()}
    found = []
    for k in range(PHOTOS):
        pose = np.array(mi.ScalarTransform4f().look_at([3 * np.cos(k), 3 * np.sin(k), 1], [0, 0, 0], [0, 0, 1]).matrix)
        # Photographs look along -z of their pose, Mitsuba's sensors along +z.
        pose[:3, [0, 2]] *= -1
        camera = Camera(intrinsics(30, 30, PHOTO_SIDE / 2, PHOTO_SIDE / 2), (PHOTO_SIDE, PHOTO_SIDE), pose)
        seen = np.clip(np.array(Splatter(PHOTO_SIDE, PHOTO_SIDE, 0).forward(tensors, camera, derivatives=False)[0]), 0, 1)
        found.append(Photo(f"view {k}", seen[..., :3] + 1 - seen[..., 3:], seen[..., 3], None, camera, white))
    return found


def count_launches(call: Callable[[], None]) -> int:
    """Number of kernels, copies and fills launched by a call."""
    dr.sync_thread()
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        call()
        dr.sync_thread()
        return len(dr.kernel_history())


def compare(question: str, answer: dict) -> list[Bar]:
    """No step may take longer than the step of the peer; a first step may."""
    if question == "chair":
        times = [row["milliseconds"]["mivol"] for row in answer["rows"].values()]
        return [judge("chair: wall time of a step [ms]", ms, AT_MOST, MAX_CHAIR) for ms in times]
    if question == "first":
        return [judge("first: most processor time [s]", answer["most_seconds"], AT_MOST, MAX_FIRST)]
    return [judge(f"{question}: least ratio of times", answer["least_ratio"], AT_LEAST, 1.0)]


def table(question: str, answer: dict) -> list[str]:
    """A line for each scene and film."""
    lines = [f"| scene, film | {PEER} [ms] | mivol [ms] | ratio | launches |", "|---|---|---|---|---|"]
    for name, row in answer["rows"].items():
        ms, launches = row["milliseconds"], row["launches"]
        if PEER in ms:
            counts = f"{launches[PEER]} / {launches['mivol']}"
            if "render_launches" in row:
                counts += f" ({row['render_launches'][PEER]} / {row['render_launches']['mivol']})"
            lines.append(f"| {name} | {ms[PEER]:.3g} | {ms['mivol']:.3g} | {row['ratio']:.3g} | {counts} |")
        else:
            lines.append(f"| {name} | | {ms['mivol']:.3g} | | {launches['mivol']} |")
    return lines


def draw(answers: dict, path: Path) -> None:
    """Milliseconds of both integrators in each row."""
    with new_figure(path, 6.4 * len(answers), 4.2) as figure:
        panels = np.atleast_1d(figure.subplots(1, len(answers)))
        for axes, (question, answer) in zip(panels, answers.items(), strict=True):
            for who, colour in zip((PEER, "mivol"), SERIES, strict=False):
                values = [row["milliseconds"].get(who, np.nan) for row in answer["rows"].values()]
                axes.plot(values, np.arange(len(values)), "o", color=colour, label=who)
            axes.set_yticks(np.arange(len(answer["rows"])), list(answer["rows"]), fontsize=7)
            axes.set(xscale="log", xlabel="wall time of a step [ms]", title=question)
            use_plain_ticks(axes.xaxis)
        panels[0].legend()


QUESTIONS: dict[str, Question] = {
    "images": ask("How long does a step with an image take?", measure_steps, False),
    "gradients": ask("How long does a step with an image and its gradient take?", measure_steps, True),
    "loops": ask("How long does a whole step of a user's fit take?", measure_loops),
    "chair": ask("How long does a step of a large grid take?", measure_chair),
    "first": ask("How much processor time does the first step of a fresh process take?", measure_first),
    "fits": ask("How long does a step of a fit take?", measure_fits),
}

STUDY = Study(__name__, __doc__, StepsSize, QUESTIONS, compare, draw, table)
