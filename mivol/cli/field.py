"""``mivol optimize`` on photographs: a radiance field from its TOML to its run folder.

Conventions. The folder is that of :mod:`mivol.cli.experiment`; ``metrics.jsonl`` has ``loss`` (mean squared error of a step's
rays) and the metrics of one judged view now and then; ``field.npz`` is the field, ``film/turntable.mp4`` a journey around it.
The field with the optimiser's state is kept at intervals and where the run is stopped; ``--resume`` goes on from there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from mivol import config
from mivol.cli.experiment import CHECKPOINT, recorded, stage, write_curves
from mivol.cli.progress import say, tracked
from mivol.cli.rendering import set_threads, set_variant
from mivol.config import FieldFit
from mivol.errors import MivolError
from mivol.fields.sky import Sky
from mivol.fields.spherical import SphericalGrid, save_field
from mivol.files import write_exr, write_png, write_volume
from mivol.optim import checkpoint
from mivol.optim.radiance_fit import PRESETS, Plan, RadianceFit, Seen, memory_of, render_view
from mivol.optim.radiance_views import Views
from mivol.optim.strategy import nearest
from mivol.photos import Camera, Photo, Photos, load_photos, rectified, silhouette_box, turntable
from mivol.photos.picture import decode_srgb, space_of
from mivol.photos.region import near_far_of
from mivol.report.depth import depth_pixels, normal_pixels, normals_of_depth
from mivol.report.page import write_page
from mivol.report.record import Choice, Image, RunRecord, Table, Volume, append_metrics, rewind_metrics
from mivol.report.video import write_video
from mivol.threads import check_one_thread
from mivol.validate.images import Quality, judge, score

FILM_SIZE = 256
"""Longest edge of a film [pixel]."""

SMALLEST = 16
"""Shortest edge of a photograph that was made smaller [pixel]."""


def run(chosen: FieldFit, base: Path, folder: Path, *, resume: bool = False) -> Path:
    """Fit a radiance field; arguments, result and refusals as :func:`mivol.cli.experiment.run`."""
    check_one_thread()
    set_variant(chosen.variant)
    set_threads(chosen.threads)
    folder.mkdir(parents=True, exist_ok=True)
    asked = make_plan(chosen)
    record = new_record(chosen)
    with recorded(record, folder):
        with stage(record, "photographs"):
            photos, judged = read_photos(chosen, base)
            photos = boxed(chosen, photos)
            plan = shrunk(asked, photos)
            views = Views.of([rectified(view) for view in photos.views], [stage.shrink for stage in plan.stages])
            record.plan, record.notes = choices(plan, photos, views), notes(photos)
            say([photos.text, *(f"{one.choice}: {one.reason}" for one in record.plan)])
        with stage(record, "fit"):
            fit = solve(chosen, folder, RadianceFit(views, photos.box, plan, chosen.seed), judged, resume)
        with stage(record, "images and volumes"):
            write_outputs(chosen, folder, record, fit, photos, judged)
    return write_page(folder)


# -- What is asked for --------------------------------------------------------------------------------------------


def make_plan(chosen: FieldFit) -> Plan:
    """The preset with what the file says otherwise.

    Raises:
        MivolError: an unknown preset.
    """
    wanted = chosen.field
    if wanted.preset not in PRESETS:
        raise MivolError(f'field.preset = "{wanted.preset}" is unknown: {nearest(wanted.preset, list(PRESETS))}')
    plan = PRESETS[wanted.preset]
    names = ("degree", "first_degree", "tv_density", "tv_sh", "sparsity", "matte", "sky", "beta")
    given = {name: getattr(wanted, name) for name in names}
    plan = replace(plan, **{name: value for name, value in given.items() if value is not None})
    stages = [replace(stage, steps=max(1, round(stage.steps * wanted.effort))) for stage in plan.stages]
    plan = replace(plan, stages=tuple(stages))
    return plan if wanted.longest is None else plan.up_to(wanted.longest)


def shrunk(plan: Plan, photos: Photos) -> Plan:
    """The plan with photographs as small as its grids can tell: pixels of half a voxel, at the middle of the box."""
    cameras, box = [view.camera for view in photos.views], photos.box
    pixel = np.median([np.linalg.norm(camera.origin - box.mean(axis=0)) / camera.K[0, 0] for camera in cameras])
    least = min(min(camera.size) for camera in cameras)
    stages = []
    for one in plan.stages:
        voxel = (box[1] - box[0]).max() / one.longest
        finest = max(1.0, min(0.5 * voxel / pixel, least / SMALLEST))
        stages.append(replace(one, shrink=2 ** int(np.log2(finest))))
    return replace(plan, stages=tuple(stages))


def read_photos(chosen: FieldFit, base: Path) -> tuple[Photos, Photos | None]:
    """Photographs to fit, and those to judge by.

    Raises:
        MivolError: as :func:`mivol.photos.load_photos`, or neither a box nor one of the words for it.
    """
    wanted = chosen.photos
    if isinstance(wanted.box, str) and wanted.box not in BOXES:
        raise MivolError(f'photos.box = "{wanted.box}" is unknown: {nearest(wanted.box, list(BOXES))}')
    settings: dict[str, Any] = {
        "scale": wanted.scale,
        "background": wanted.background or None,
        "held_out": wanted.held_out,
        "space": "srgb",
        "box": None if isinstance(wanted.box, str) else np.array(wanted.box, np.float64),
    }
    path = base / wanted.path
    photos = _over(load_photos(path, split="train", **settings), wanted.behind)
    if wanted.judged == "held_out" and not wanted.held_out:
        return photos, None
    return photos, _over(load_photos(path, split=wanted.judged, **settings), wanted.behind)


def _over(photos: Photos, behind: tuple[float, float, float]) -> Photos:
    """Photographs that show a colour where nothing is; those with alpha were put over theirs."""
    if photos.views[0].alpha is not None:
        return photos
    colour = np.array(behind, np.float32)
    return replace(photos, views=tuple(replace(view, background=colour) for view in photos.views))


def boxed(chosen: FieldFit, photos: Photos) -> Photos:
    """The photographs with the box where matter may be.

    Raises:
        MivolError: as :func:`mivol.photos.silhouette_box`.
    """
    wanted = chosen.photos.box
    return BOXES[wanted](photos) if isinstance(wanted, str) else photos


def _about_silhouettes(photos: Photos) -> Photos:
    box = silhouette_box(photos)
    near_far = near_far_of([view.camera for view in photos.views], box)
    return replace(photos, survey=replace(photos.survey, box=box, box_from="about what alpha shows", near_far=near_far))


BOXES = {"cameras": lambda photos: photos, "silhouettes": _about_silhouettes}


def new_record(chosen: FieldFit) -> RunRecord:
    """The record of a run that begins."""
    return RunRecord.new(
        chosen.title,
        method=f"a sparse grid of density and spherical harmonics, fitted to photographs; preset {chosen.field.preset}",
        config=config.resolved(chosen),
        command="mivol optimize",
        seeds={"fit": chosen.seed},
        citations=["mitsuba3", "drjit", "plenoxels_2022", "relu_fields_2022", "max_1995"],
    )


def choices(plan: Plan, photos: Photos, views: Views) -> list[Choice]:
    """What will be done, and why."""
    box = photos.box
    resolutions = ", ".join(str(stage.longest) for stage in plan.stages)
    size = " x ".join(f"{edge:.4g}" for edge in box[1] - box[0])
    return [
        Choice(choice=f"{len(photos.views)} photographs, a box of {size}", reason=photos.survey.box_from),
        Choice(choice=f"grids of {resolutions} nodes along the longest edge", reason="coarse first, to find what is empty"),
        Choice(
            choice=f"photographs shrunk by {', '.join(str(stage.shrink) for stage in plan.stages)}",
            reason="a pixel of half a voxel says as much as four smaller ones",
        ),
        Choice(choice=f"harmonics of degree {plan.degree}", reason=f"{(plan.degree + 1) ** 2} numbers a colour and node"),
        what_is_behind(plan, photos),
        Choice(choice=f"rays end at a transmittance of {plan.stop:g}", reason="what is left out is at most that share"),
        Choice(choice=memory_of(plan, box, views), reason="counted before it is taken"),
    ]


def what_is_behind(plan: Plan, photos: Photos) -> Choice:
    """What rays see that pass the box; where a colour is only believed, the one that the photographs' edges show is told."""
    if plan.sky:
        return Choice(choice=f"a sky of {plan.sky} rows behind the box", reason="field.sky; it is learned with the field")
    if photos.views[0].alpha is not None:
        return Choice(choice="nothing behind the box", reason="alpha says what is there")
    edges = [view.image[at] for view in photos.views for at in (0, -1, (slice(None), 0), (slice(None), -1))]
    most, believed = (
        "(" + ", ".join(f"{c:.2g}" for c in colour) + ")"
        for colour in (np.median(np.concatenate(edges), axis=0), photos.views[0].background)
    )
    reason = f"photos.behind; the edges of the photographs show {most} mostly, and field.sky would learn it"
    return Choice(choice=f"the colour {believed} behind the box", reason=reason)


def notes(photos: Photos) -> list[str]:
    """What a reader must know of the photographs."""
    found = [f"Colours are {photos.space} code values; in a scene mivol_sh shows them as they are."]
    if any(space_of(frame.file) == "linear" for frame in photos.survey.frames):
        found.append("The light of OpenEXR photographs was encoded; what is above 1 counts as 1.")
    if photos.skipped:
        found.append(f"{len(photos.skipped)} photographs are listed and not there: {', '.join(photos.skipped[:5])} ...")
    return found


# -- Fit ----------------------------------------------------------------------------------------------------------


def solve(chosen: FieldFit, folder: Path, fit: RadianceFit, judged: Photos | None, resume: bool) -> RadianceFit:
    """All steps, with metrics and checkpoints.

    Raises:
        MivolError: a checkpoint of another run.
    """
    fingerprint = {"photos": fit.views.digest(), **config.flat(config.resolved(chosen))}
    path = folder / CHECKPOINT
    if resume:
        fit.restore(*checkpoint.read(path, fingerprint))
    rewind_metrics(folder, fit.step)

    def keep() -> None:
        arrays, about = fit.pack()
        checkpoint.write(path, arrays, {**about, "fingerprint": fingerprint})

    started = time.perf_counter() - fit.seconds
    try:
        for loss in tracked(Steps(fit), "steps"):
            fit.seconds = time.perf_counter() - started
            if fit.step % chosen.show.every == 0 or fit.step == fit.plan.steps:
                append_metrics(folder, fit.step, fit.seconds, loss=loss, **look(chosen, fit, judged))
            if fit.step % chosen.checkpoint_every == 0:
                keep()
    finally:
        if fit.field is not None:
            keep()
    return fit


class Steps:
    """The steps that are left of a fit, each with its mean squared error; their number is known."""

    def __init__(self, fit: RadianceFit) -> None:
        self.fit, self.left = fit, max(fit.plan.steps - fit.step, 0)

    def __len__(self) -> int:
        return self.left

    def __iter__(self) -> Iterator[float]:
        for _ in range(len(self)):
            yield float(dr.mean(self.fit.advance())[0])


def look(chosen: FieldFit, fit: RadianceFit, judged: Photos | None) -> dict[str, float]:
    """How well one judged view is seen, another one each time."""
    if judged is None:
        return {}
    photo = judged.views[fit.step // chosen.show.every % len(judged.views)]
    return named(compare(chosen, fit, judged, photo)[1].values)


def compare(chosen: FieldFit, fit: RadianceFit, judged: Photos, photo: Photo) -> tuple[Seen, Quality]:
    """A photograph's view of the field, and how alike they are."""
    seen = render_view(fit.field, photo.camera, behind(fit, photo))
    asked = {"space": judged.space, "mask": photo.mask, "metrics": chosen.show.metrics, "name": photo.name}
    return seen, judge(seen.image, photo.image, **asked)


def named(values: dict[str, float]) -> dict[str, float]:
    """Metrics by the names of :data:`mivol.report.record.QUANTITIES`."""
    return {("held_out_psnr" if name == "psnr" else name): value for name, value in values.items()}


def behind(fit: RadianceFit, photo: Photo) -> NDArray | Sky:
    """What a photograph shows where nothing is."""
    return photo.background if fit.sky is None else fit.sky


# -- What came of it ----------------------------------------------------------------------------------------------


def write_outputs(
    chosen: FieldFit, folder: Path, record: RunRecord, fit: RadianceFit, photos: Photos, judged: Photos | None
) -> None:
    """The field, its views, its film, curves, results."""
    for name in ("views", "volumes", "curves", "film"):
        (folder / name).mkdir(exist_ok=True)
    save_field(folder / "field.npz", fit.field)
    if fit.sky is not None:
        write_exr(folder / "sky.exr", {"": fit.sky.image()})
    record.tables = [storage(fit.field, folder / "field.npz")]
    record.volumes.append(write_density(folder, fit.field))
    stored = fit.field.rows - (fit.field.nodes is not None)
    record.results = {
        "views": float(len(photos.views)),
        "iterations": float(fit.step),
        "nodes": float(stored),
        "bytes": fit.field.bytes / 2**20,
    }
    if judged is not None:
        record.results |= write_judged(chosen, folder, record, fit, judged)
    if chosen.show.frames:
        record.images.append(write_film(chosen, folder, fit, photos))
    write_curves(folder)


def storage(field: SphericalGrid, path: Path) -> Table:
    """What the field takes, beside grids of the same box that keep every node."""
    nodes, kept = math.prod(field.res), len(field.listed())
    kinds = {
        "every node: r, g, b and density of 8 bits": 4 * nodes,
        "every node: four numbers": 16 * nodes,
        f"every node: harmonics of degree {field.degree}": 4 * nodes * (1 + field.width),
        "this field, in memory": field.bytes,
        "this field, its file": path.stat().st_size,
    }
    rows = [(name, f"{size / 2**20:.2f} MiB", f"{size / nodes:.3g}") for name, size in kinds.items()]
    head = (f"{kept} of {nodes} nodes are kept ({kept / nodes:.1%})", "in all", "bytes a node of the box")
    return Table(title="What it takes", head=head, rows=tuple(rows))


def write_density(folder: Path, field: SphericalGrid) -> Volume:
    """The extinction at the nodes, as a grid that other programs read."""
    raw, _ = field.to_dense()
    sigma = np.array(field.act.value_and_slope(type(field.density)(raw.ravel()))[0]).reshape(*field.res, 1)
    write_volume(folder / "volumes/density.vol", sigma, field.to_world)
    write_volume(folder / "volumes/density.npz", sigma, field.to_world)
    size = tuple(float(edge) for edge in np.abs(np.diag(field.to_world)[:3]))
    return Volume(path="volumes/density.npz", role="reconstruction", size=size)


def write_judged(chosen: FieldFit, folder: Path, record: RunRecord, fit: RadianceFit, judged: Photos) -> dict[str, float]:
    """Judge all views, and keep some of them beside their photographs, with distance and normals of the first."""
    found = []
    shown = set(np.linspace(0, len(judged.views) - 1, min(chosen.show.views, len(judged.views))).astype(int).tolist())
    for number, photo in enumerate(judged.views):
        seen, quality = compare(chosen, fit, judged, photo)
        found.append(quality)
        if number in shown:
            record.images += write_view(folder, photo.name, number, seen.image, photo.image)
        if number == 0:
            record.images += write_geometry(folder, seen, photo.camera, judged.near_far)
    return named(score(found).values)


def write_view(folder: Path, name: str, number: int, image: NDArray, photograph: NDArray) -> list[Image]:
    """A render beside its photograph."""
    written = []
    for role, values in {"render": image, "reference": photograph}.items():
        path = f"views/{number:03d}_{role}.png"
        write_png(folder / path, decode_srgb(np.clip(values, 0, 1)))
        written.append(Image(path=path, role=role, view=name, held_out=True, quantity="sRGB value"))
    return written


def write_geometry(folder: Path, seen: Seen, camera: Camera, near_far: tuple[float, float]) -> list[Image]:
    """Distance and normals of a view as colours."""
    pictures = {
        "distance": depth_pixels(seen.depth, near_far, seen.opacity),
        "normals": normal_pixels(normals_of_depth(seen.depth, camera), seen.opacity),
    }
    written = []
    for name, pixels in pictures.items():
        write_png(folder / f"views/{name}.png", decode_srgb(pixels / 255))
        written.append(Image(path=f"views/{name}.png", role="picture", caption=f"{name} of the first judged view"))
    return written


def write_film(chosen: FieldFit, folder: Path, fit: RadianceFit, photos: Photos) -> Image:
    """A journey around the box."""
    cameras = [view.camera for view in photos.views]
    path = "film/turntable.mp4"
    background = behind(fit, photos.views[0])

    def frames() -> Iterator[NDArray[np.uint8]]:
        for camera in turntable(cameras, fit.box, chosen.show.frames):
            seen = render_view(fit.field, _small(camera), background)
            yield np.round(np.clip(seen.image, 0, 1) * 255).astype(np.uint8)

    write_video(folder / path, tracked(Sized(frames(), chosen.show.frames), "frames"), fps=chosen.show.frames / 4)
    return Image(path=path, role="film", caption=f"{chosen.show.frames} views around the box")


def _small(camera: Camera) -> Camera:
    """A camera with at most the pixels of a film."""
    scale = min(1.0, FILM_SIZE / max(camera.size))
    return camera.resized(tuple(max(1, round(edge * scale)) for edge in camera.size))


class Sized:
    """An iterator whose length is known."""

    def __init__(self, items: Iterator, count: int) -> None:
        self.items, self.count = items, count

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator:
        return self.items
