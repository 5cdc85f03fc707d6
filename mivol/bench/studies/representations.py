"""How do all representations compare: quality, time, size, and speed of rendering?

    mivol bench representations                 # two hours of processor time
    mivol bench representations --only chair    # a data set; --models grid octree for some models
    mivol bench representations --only octree   # two minutes: an octree beside the grid that it was made of
    mivol bench representations --quick         # a minute, small sizes: the figures mean nothing

The photographs of the still life (200 x 200 pixels; missing photographs are rendered to runs/photographs), of the chair (same
size) and of the fox (longest edge of 480 pixels; both from MIVOL_DATA, default ../shared/data) are fitted as ``mivol optimize``
does with the settings of the presets. Test views judge the still life and the chair, over white; every eighth photograph
judges the fox, whose background nested grids fit (a grid, an octree, a hash grid and a NeRF have one box, and black behind).
Minutes and rays per second hold for two cores that walk 25 M rays per second through the tutorial's smoke. Memory is the
largest memory of Dr.Jit, without the photographs. Fields are rendered with one ray per pixel; Gaussians are splatted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.hashgrid import HashGridEncoding
from matplotlib.ticker import MaxNLocator

from mivol.bench.harness.contests import Stopwatch, race, time_ratio
from mivol.bench.harness.figures import new_figure, show_images
from mivol.bench.harness.study import AT_LEAST, AT_MOST, Promise, Study, amount, ask, say_row
from mivol.bench.photo_fits import FittedProblem, PhotoSize, find_photographs, fit_photographs, prepare_fit, prepare_fit_in_time
from mivol.bench.scenes import REFERENCE_RATE, TO_WORLD, box_scene, constant_light, make_integrator, smoke
from mivol.errors import MivolError
from mivol.experiments import field_fit
from mivol.experiments.field_conversion import compare_speed
from mivol.fields.field_files import read_field, write_field
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.networks import Network
from mivol.fields.octree import Octree
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files.image_files import encode_srgb
from mivol.optim.first_order import Adam
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.loop import begin_fit
from mivol.optim.parameters import Parameter
from mivol.optim.photographs.field_view import render_view
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.photos import rectify, survey_photos
from mivol.points import Gaussians, write_gaussians
from mivol.scene.sensors import parse_rig
from mivol.validate.metrics import average_scores, psnr


@dataclass(frozen=True)
class RepresentationSize(PhotoSize):
    """Amount of work."""

    edge: int = amount(200, 48, "longest edge of photographs and views of the still life and the chair [pixels]")
    fox_edge: int = amount(480, 48, "longest edge of the photographs of the fox [pixels]")
    models: tuple[str, ...] = amount(
        ("grid", "nested grid", "octree", "hash grid", "NeRF", "Gaussians"), doc="models of the table"
    )
    longest: int = amount(0, 16, "nodes along the longest edge of the grids; 0: the presets'")
    hash_grid: str = amount("minute", "tiny", "preset of the hash grid")
    nerf: str = amount("minutes", "tiny", "preset of the NeRF")
    gaussians: str = amount("minute", "minute", "preset of the Gaussians")
    effort: float = amount(1.0, 0.02, "factor on the steps of the presets")
    nerf_effort: float = amount(1.0, 0.02, "factor on the steps of the NeRF")
    samples: int = amount(1 << 17, 1 << 12, "samples of a hash grid")
    rounds: int = amount(7, 2, "timed calls with these samples")
    rounds_edge: int = amount(64, 16, "longest edge of the photographs for coarse and fine networks [pixels]")
    rounds_seconds: float = amount(300.0, 1.0, "processor time of each fit of these photographs [s]")
    smoke_side: int = amount(32, 8, "edge of the views of the smoke [pixels]")
    smoke_seconds: float = amount(30.0, 0.5, "processor time of each fit of the smoke [s]")
    smoke_spp: int = amount(2, 2, "samples per pixel of a step of the smoke")
    smoke_reference: int = amount(256, 16, "samples per pixel of the reference views of the smoke")


def list_settings(size: RepresentationSize, has_alpha: bool) -> dict[str, dict]:
    """Settings of the fit of each model, by its name in the table. Photographs with alpha have equal exposures."""
    grid = {"effort": size.effort} | ({"longest": size.longest} if size.longest else {})
    return {
        "grid": {"field": grid},
        "nested grid": {"field": {"preset": "capture", **grid} | ({"exposure": False} if has_alpha else {})},
        "octree": {"field": {"kind": "octree", **grid}},
        "hash grid": {"field": {"kind": "hash", "preset": size.hash_grid, "effort": size.effort}},
        "NeRF": {"field": {"kind": "nerf", "preset": size.nerf, "effort": size.nerf_effort}},
        "Gaussians": {"gaussians": {"preset": size.gaussians, "effort": size.effort}},
    }


def measure(name: str, size: RepresentationSize) -> dict:
    """Fit the photographs of a data set by each model."""
    folder = find_photographs(name, size)
    if folder is None:
        return {}
    settings, answer = list_settings(size, has_alpha=name != "fox"), {}
    for label in size.models:
        if label not in settings:
            raise MivolError(f'models has "{label}": {", ".join(settings)} are expected.')
        answer[label] = figures = fit_and_judge(folder, choose_photos(name, folder, label, size), settings[label], size)
        say_row(label, **{key: value for key, value in figures.items() if isinstance(value, float)})
    return answer


def choose_photos(name: str, folder: Path, model: str, size: RepresentationSize) -> dict:
    """The table ``photos`` of a fit: sizes, background and judges."""
    if name == "fox":
        nested = {"background": "nested"} if model == "nested grid" else {}
        return {"held_out": 8, "largest": size.fox_edge, **nested}
    edge = max(survey_photos(folder, split="test").frames[0].camera.size)
    return {"background": "white", "judged": "test", "held_out": 0, "scale": min(size.edge / edge, 1.0)}


def fit_and_judge(folder: Path, photos: dict, settings: dict, size: RepresentationSize) -> dict:
    """Fit a folder of photographs, and measure.

    Args:
        folder: folder of the photographs.
        photos: table ``photos`` of the fit, besides the path.
        settings: table ``field`` or ``gaussians`` by its name.
        size: amount of work.

    Returns:
        ``psnr`` [dB] and ``ssim`` of the judged views; ``minutes`` and ``shown_pixels_per_second`` of the reference machine;
        ``processor_seconds`` and ``walk_rays_per_second``; ``held_mib``; ``file_mib``; ``count`` of nodes, leaves,
        numbers of a hash grid or network, or Gaussians; for the figure the middle view and its photograph.
    """
    prepared = prepare_fit(folder, photos, settings)
    done = fit_photographs(prepared.problem, size.walk_side)
    watch, views, images = Stopwatch(), [rectify(view) for view in prepared.judged.views], []
    prepared.show(views[0])  # compiles
    with watch:
        for view in views:
            images.append(prepared.show(view))
    pixels = sum(view.camera.size[0] * view.camera.size[1] for view in views)
    middle = len(views) // 2
    count, file_bytes = store(prepared.problem)
    scores = [prepared.judge(image, view, ("psnr", "ssim")) for image, view in zip(images, views, strict=True)]
    return {
        **average_scores(scores).values,
        "minutes": done.seconds / 60,
        "processor_seconds": done.processor,
        "walk_rays_per_second": done.rate,
        "shown_pixels_per_second": pixels / watch.processor * dr.thread_count() * REFERENCE_RATE / done.rate,
        "held_mib": done.held / 2**20,
        "file_mib": file_bytes / 2**20,
        "count": count,
        "view": images[middle],
        "photograph": views[middle].image,
    }


def table(question: str, answer: dict) -> list[str]:
    """The table of the representations of a data set, for the docs."""
    if question == "rounds":
        rows = ((name, f"{row['psnr']:.2f} dB / {row['ssim']:.3f}", row["steps"]) for name, row in answer.items())
        head = "| samples of a ray | PSNR / SSIM | steps |", "|---|---|---|"
        return [*head, *(f"| {name} | {score} | {steps} |" for name, score, steps in rows)]
    if question in ("samples", "smoke") or not answer:
        return []
    if question == "octree":
        head = "| model | PSNR | file | views of 800 px |", "|---|---|---|---|"
        rows = ((name, answer[name]) for name in ("grid", "octree"))
        return [
            *head,
            *(
                f"| {name} | {row['psnr']:.2f} dB | {row['file_bytes'] / 2**20:.2g} MiB | "
                f"{row['pixels_per_second'] / 1e6:.1f} M pixels/s |"
                for name, row in rows
            ),
        ]
    head = "| model | PSNR / SSIM | time | memory | file | rays shown |", "|---|---|---|---|---|---|"
    return [
        *head,
        *(
            f"| {name} | {row['psnr']:.2f} dB / {row['ssim']:.3f} | {row['minutes']:.2g} min | {row['held_mib']:.3g} MiB | "
            f"{row['file_mib']:.2g} MiB | {row['shown_pixels_per_second'] / 1e6:.2g} M/s |"
            for name, row in answer.items()
        ),
    ]


def store(problem: FittedProblem) -> tuple[int, int]:
    """Number of nodes, leaves, numbers of a hash grid or network, or Gaussians, and the size of their files [bytes]."""
    with TemporaryDirectory() as folder:
        if isinstance(problem, GaussianProblem):
            cloud = Gaussians(**problem.cloud)
            write_gaussians(Path(folder) / "gaussians.ply", cloud)
            count = cloud.count
        else:
            field_fit.write_result(Path(folder), problem)
            field = problem.field
            count = next(getattr(field, name) for name in ("leaves", "rows", "numbers") if hasattr(field, name))
        return count, sum(path.stat().st_size for path in Path(folder).iterdir())


def measure_sample_rates(size: RepresentationSize) -> dict:
    """How many samples a second does a hash grid take, with all derivatives, beside Dr.Jit's own derivatives?

    Points lie along rays, as in a fit. The peer is ``drjit.hashgrid`` with networks of ``drjit.nn``, differentiated by Dr.Jit.
    Rates are samples per second of processor time and thread.
    """
    count, sizes = size.samples, HashSizes()
    rng = np.random.default_rng(0)
    start = np.repeat(rng.random((3, -(-count // 32))), 32, axis=1)[:, :count]
    points = mi.Point3f(np.float32(0.9 * start + 0.003 * (np.arange(count) % 32)))
    directions = mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, count)
    by_sigma, by_colour = mi.Float(rng.normal(size=count)), mi.Color3f(rng.normal(size=(3, count)))
    dr.eval(points, directions, by_sigma, by_colour)
    field = HashField.random(sizes, np.eye(4))
    peer = HashGridEncoding(
        mi.Float,
        3,
        n_levels=sizes.levels,
        n_features_per_level=sizes.features,
        hashmap_size=sizes.features << sizes.log2_table,
        base_resolution=sizes.coarsest,
        per_level_scale=sizes.growth,
    )
    density, colours = mi.Float(field.density_weights), mi.Float(field.colour_weights)

    def differentiate_peer(_: int) -> list[mi.Float]:
        dr.enable_grad(peer.data, density, colours)
        geometry = Network.eval_lanes(sizes.density_network.pack(density), list(peer(points)))
        inputs = [*geometry, *dr.sh_eval(directions, sizes.degree)]
        raw = Network.eval_lanes(sizes.colour_network.pack(colours), inputs)
        rgb = mi.Color3f(*(dr.rcp(1 + dr.exp(-v)) for v in raw))
        dr.backward(dr.sum(by_sigma * dr.exp(geometry[0]) + dr.dot(by_colour, rgb)))
        return [dr.grad(peer.data), dr.grad(density), dr.grad(colours)]

    contestants = {
        "mivol": lambda _: list(field.evaluate(points, directions).vjp(by_sigma, by_colour).values()),
        "drjit.hashgrid": differentiate_peer,
    }
    timings = race(contestants, size.rounds)
    rates = {name: count / float(np.median(timing.processor)) for name, timing in timings.items()}
    for name, rate in rates.items():
        say_row(name, samples_per_processor_second=rate, on_2_cores=2 * rate)
    return {"rates": rates, "ratio": time_ratio(timings["drjit.hashgrid"], timings["mivol"], "processor")}


def measure_octree(size: RepresentationSize) -> dict:
    """How good, small and fast is the octree of the chair beside its grid, after a fit of its leaves?

    Both are judged and rendered as their files hold them, in one run: test views over white, bytes of the files, and views of
    ``mivol convert`` that end at the same transmittance.
    """
    folder, stages = find_photographs("chair", size), {}
    if folder is None:
        return {}
    prepared = prepare_fit(folder, choose_photos("chair", folder, "octree", size), list_settings(size, True)["octree"])

    def keep(name: str, field: SphericalGrid | Octree) -> str:
        stages[name] = field
        return name

    prepared.problem.report = keep
    fit_photographs(prepared.problem, size.walk_side)
    answer, written = {}, {}
    with TemporaryDirectory() as place:
        for name, field in (("grid", stages["grid"]), ("octree", prepared.problem.field)):
            path = Path(place) / f"{name}.npz"
            write_field(path, field)
            written[name] = read_field(path)
            views = [rectify(view) for view in prepared.judged.views]
            shown = [render_view(written[name], view.camera, view.background).image for view in views]
            scores = [prepared.judge(image, view) for image, view in zip(shown, views, strict=True)]
            answer[name] = {**average_scores(scores).values, "file_bytes": path.stat().st_size}
    rates, ratio = compare_speed(written["octree"], written["grid"])
    for name, rate in zip(("octree", "grid"), rates, strict=True):
        answer[name]["pixels_per_second"] = rate
        say_row(name, **answer[name])
    octree, grid = answer["octree"], answer["grid"]
    gain = {"db": octree["psnr"] - grid["psnr"], "bytes": octree["file_bytes"] / grid["file_bytes"], "pixels": ratio}
    say_row("octree over grid", **gain)
    return {**answer, "over_grid": gain}


ROUNDS = {
    "one network, map of occupied cells": {},
    "coarse + fine, 32 + 32 samples": {"coarse": 32, "fine": 32},
    "coarse + fine, 64 + 128 samples": {"coarse": 64, "fine": 128},
}
"""Settings of NeRFs whose samples are placed in different ways; the last ones are the published numbers."""


def measure_rounds(size: RepresentationSize) -> dict:
    """How good is a NeRF with a coarse and a fine network, beside one network with a map of occupied cells, in equal time?

    Each fit has as many steps as fit into the time, with the whole course of learning rates.
    """
    folder, answer = find_photographs("still_life", size), {}
    photos = choose_photos("still_life", folder, "NeRF", replace(size, edge=size.rounds_edge))
    for name, more in ROUNDS.items():
        field = {"kind": "nerf", "preset": size.nerf, **more}
        prepared = prepare_fit_in_time(folder, photos, field, size.rounds_seconds)
        done = fit_photographs(prepared.problem, size.walk_side)
        score = prepared.score(prepared.judged.views, ("psnr", "ssim"))
        answer[name] = {**score, "steps": prepared.steps, "processor_seconds": done.processor}
        say_row(name, **answer[name])
    return answer


SMOKE_KEY = "box.interior_medium.sigma_t."

SMOKE_VIEWS, SMOKE_JUDGED = 16, (2, 6, 10, 14)
"""Training views around the smoke, and held-out views."""


@dataclass(frozen=True)
class SmokeFit:
    """An extinction to fit.

    Attributes:
        sigma_t: plugin.
        rates: learning rate of each parameter.
        domain: of each parameter.
        epsilon: of Adam, relative to the largest gradient.
    """

    sigma_t: dict
    rates: dict[str, float]
    domain: tuple[float, float] = (-np.inf, np.inf)
    epsilon: float = 1e-15


def list_smoke_fits(majorant: float) -> dict[str, SmokeFit]:
    """Voxels at four learning rates, and hash grids of no more numbers, at points of paths and at the nodes of a grid."""
    place = {"to_world": mi.ScalarTransform4f(np.float32(TO_WORLD))}
    start = mi.TensorXf(np.full((28, 28, 28, 1), 0.05 * majorant, np.float32))
    sizes = {"levels": 6, "log2_table": 11, "coarsest": 6, "finest": 40, "width": 16}
    hashed = {"type": "mivol_hash", "majorant": majorant, **sizes, **place}
    rates = {"table": 0.05, "weights_0": 0.02, "weights_1": 0.02}
    voxels = {"type": "mivol_voxels", "data": start, **place}
    return {
        **{f"voxels, rate {rate:g}": SmokeFit(voxels, {"data": rate}, (0, np.inf)) for rate in (0.05, 0.1, 0.2, 0.5)},
        "hash grid at nodes": SmokeFit(hashed | {"nodes": 28}, rates),
        "hash grid at points": SmokeFit(hashed, rates),
    }


def measure_smoke(size: RepresentationSize) -> dict:
    """How well does a hash grid fit a scattering smoke (``max_depth`` 6), beside voxels of as many numbers, in equal time?

    Each fit takes the same processor time; its first step, which compiles, does not count. PSNR is of the held-out views'
    sRGB codes.
    """
    values = smoke().values
    light, albedo, integrator = constant_light(), 0.9, make_integrator("mivol", 6)
    edges = {"width": size.smoke_side, "height": size.smoke_side}
    rig = parse_rig({"rig": "hemisphere", "count": SMOKE_VIEWS, "lowest": -90, **edges})
    truth = mi.load_dict(box_scene(values, size.smoke_side, albedo, **light))
    views = []
    for number, described in enumerate(rig.sensors(truth)):
        sensor = mi.load_dict(described)
        image = mi.render(truth, sensor=sensor, integrator=integrator, spp=size.smoke_reference, seed=number)
        views.append(View(str(number), sensor, image))
    answer = {}
    for name, fit in list_smoke_fits(1.25 * float(values.max())).items():
        answer[name] = fit_smoke(fit, views, light, albedo, size)
        say_row(name, **answer[name])
    hashed, voxels = (max(f["psnr"] for n, f in answer.items() if n.startswith(kind)) for kind in ("hash", "voxels"))
    return {"fits": answer, "hash_over_voxels_db": hashed - voxels}


def fit_smoke(fit: SmokeFit, views: list[View], light: dict, albedo: float, size: RepresentationSize) -> dict:
    """Fit an extinction for the given processor time; PSNR of the held-out views, numbers and steps."""
    parts = box_scene(np.ones((2, 2, 2), np.float32), size.smoke_side, albedo, **light)
    parts["box"]["interior"] |= {"type": "mivol_medium", "sigma_t": fit.sigma_t}
    scene, integrator = mi.load_dict(parts), make_integrator("mivol", 6)
    parameters = [Parameter(SMOKE_KEY + name, lr=rate, domain=fit.domain) for name, rate in fit.rates.items()]
    train = [view for view in views if int(view.name) not in SMOKE_JUDGED]
    problem = SceneProblem(scene, train, parameters, integrator, spp=size.smoke_spp)
    begun = begin_fit(problem, Adam(beta_2=0.99, epsilon=fit.epsilon), 1 << 20)
    begun.advance()
    watch = Stopwatch()
    while watch.processor < size.smoke_seconds:
        with watch:
            begun.advance()
    scores = []
    for view in (view for view in views if int(view.name) in SMOKE_JUDGED):
        image = mi.render(scene, sensor=view.sensor, integrator=integrator, spp=size.smoke_reference, seed=1)
        codes = (encode_srgb(np.clip(np.array(a), 0, 1)) for a in (image, view.reference))
        scores.append(psnr(*codes, 1.0))
    numbers = sum(dr.width(value.array) for value in problem.values().values())
    return {"psnr": float(np.mean(scores)), "steps": begun.next_iteration, "numbers": numbers}


def draw(answers: dict, path: Path) -> None:
    """Plot PSNR against minutes, and show a judged view of each fit beside its photograph."""
    rows = [
        (question, answer)
        for question, answer in answers.items()
        if answer and question not in ("samples", "smoke", "rounds", "octree")
    ]
    if not rows:
        return
    columns = 2 + max(len(answer) for _, answer in rows)
    with new_figure(path, 2.6 * columns, 2.9 * len(rows)) as figure:
        for line, (question, answer) in zip(figure.subplots(len(rows), columns, squeeze=False), rows, strict=True):
            for name, figures in answer.items():
                line[0].plot(figures["minutes"], figures["psnr"], "o", label=name)
            line[0].set(xlabel="time [min]", ylabel="PSNR [dB]")
            line[0].xaxis.set_major_locator(MaxNLocator(3, prune="both"))
            line[0].set_title(question)
            line[0].legend(fontsize=7)
            images = {"photograph": next(iter(answer.values()))["photograph"]}
            images |= {f"{name}: {figures['psnr']:.1f} dB": figures["view"] for name, figures in answer.items()}
            show_images(line[1:], images, fontsize=8)


QUESTIONS = {
    "samples": measure_sample_rates,
    "smoke": measure_smoke,
    "rounds": measure_rounds,
    "octree": measure_octree,
    "chair": ask("What are the photographs of the chair by each model, if its data is here?", measure, "chair"),
    "still_life": ask("What are the photographs of the still life by each model?", measure, "still_life"),
    "fox": ask("What are the photographs of the fox by each model, if its data is here?", measure, "fox"),
}
PROMISES = {
    "samples": [Promise("samples per second of a hash grid on 2 cores [M]", ("rates", "mivol"), AT_LEAST, 0.9, 2e-6)],
    "smoke": [Promise("hash grid over voxels, smoke at depth 6 [dB]", ("hash_over_voxels_db",), AT_LEAST, -0.5)],
    "octree": [
        Promise("fitted octree over its grid, chair [dB]", ("over_grid", "db"), AT_LEAST, -0.1),
        Promise("file of the octree over the grid's", ("over_grid", "bytes"), AT_MOST, 0.5),
        Promise("pixels per second of the octree over the grid's", ("over_grid", "pixels"), AT_LEAST, 2.0),
    ],
}
STUDY = Study(__name__, __doc__, RepresentationSize, QUESTIONS, draw=draw, table=table, promises=PROMISES)
