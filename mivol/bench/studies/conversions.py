"""What does it cost to turn one representation into another?

    mivol bench conversions            # half an hour of processor time
    mivol bench conversions --quick    # a minute, small sizes: the figures mean nothing

Each model is fitted to the photographs of the still life (200 x 200 pixels; missing ones are rendered to runs/photographs) with
its preset. ``mivol convert`` then makes each other model of it, without further flags. The loss is the PSNR between views of
the file and of its source, as ``mivol convert`` prints it; in brackets the PSNR of the file for the test views over white. No
conversion makes a nested grid: nothing lies outside of the one box of the other models.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi
import numpy as np

from mivol.bench.harness.contests import Stopwatch
from mivol.bench.harness.study import Study, amount, say_row
from mivol.bench.photo_fits import FittedProblem, PhotoSize, find_photographs, prepare_fit
from mivol.experiments import field_fit
from mivol.experiments.field_conversion import (
    NETWORK_PRESETS,
    Representation,
    convert_to_gaussians,
    convert_to_grid,
    convert_to_network,
    convert_to_octree,
    views_psnr,
)
from mivol.experiments.gaussian_conversion import convert_to_field
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.loop import begin_fit
from mivol.optim.photographs.sampled_problem import PRESETS
from mivol.photos import Photo, Photos, rectify, survey_photos
from mivol.points import Gaussians, write_gaussians
from mivol.validate.metrics import ImageScore, average_scores, score_image

KINDS = {"grid": "grid", "octree": "octree", "hash grid": "hash", "NeRF": "nerf", "Gaussians": "gaussians"}
"""Targets of conversions, and their names for ``--to``."""


@dataclass(frozen=True)
class ConversionSize(PhotoSize):
    """Amount of work."""

    edge: int = amount(200, 24, "longest edge of photographs and views [pixels]")
    models: tuple[str, ...] = amount(("grid", "nested grid", "octree", "hash grid", "NeRF", "Gaussians"), doc="sources")
    targets: tuple[str, ...] = amount(tuple(KINDS), doc="targets")
    effort: float = amount(1.0, 0.02, "factor on the steps of all fits")
    longest: int = amount(0, 16, "nodes along the longest edge of the grids; 0: the presets'")


def list_sources(size: ConversionSize) -> dict[str, dict]:
    """Settings of the fit of each source."""
    grid = {"effort": size.effort} | ({"longest": size.longest} if size.longest else {})
    return {
        "grid": {"field": grid},
        "nested grid": {"field": {"preset": "capture", "exposure": False, **grid}},
        "octree": {"field": {"kind": "octree", **grid}},
        "hash grid": {"field": {"kind": "hash", "preset": "minute", "effort": size.effort}},
        "NeRF": {"field": {"kind": "nerf", "preset": "minutes", "effort": size.effort}},
        "Gaussians": {"gaussians": {"preset": "minute", "effort": size.effort}},
    }


def measure_conversions(size: ConversionSize) -> dict:
    """How near is each model to the model from which it was made?"""
    folder, answer = find_photographs("still_life", size), {}
    edge = max(survey_photos(folder, split="test").frames[0].camera.size)
    photos = {"background": "white", "judged": "test", "held_out": 0, "scale": min(size.edge / edge, 1.0)}
    for name, settings in list_sources(size).items():
        if name not in size.models:
            continue
        prepared = prepare_fit(folder, photos, settings)
        begin_fit(prepared.problem, prepared.problem.plan.optimizer, prepared.problem.plan.course()).complete()
        with TemporaryDirectory() as place:
            source = write_model(Path(place), prepared.problem)
            own = judge(Representation.open(source), prepared.judged)
            answer[name] = {"psnr": own, "targets": {}}
            say_row(name, psnr=own)
            for kind in KINDS:
                if kind != name and kind in size.targets:
                    row = convert_and_judge(source, kind, prepared.judged, size)
                    answer[name]["targets"][kind] = row
                    say_row(f"{name} to {kind}", **row)
    return {"sources": answer}


def write_model(folder: Path, problem: FittedProblem) -> Path:
    """Write a fitted model, and return its file."""
    if isinstance(problem, GaussianProblem):
        write_gaussians(folder / "gaussians.ply", Gaussians(**problem.cloud))
        return folder / "gaussians.ply"
    field_fit.write_result(folder, problem)
    return folder / "field.npz"


def convert_and_judge(path: Path, kind: str, judged: Photos, size: ConversionSize) -> dict:
    """Convert a file.

    Returns:
        ``loss`` [dB] between views of both; ``psnr`` [dB] of the test views; ``mib`` of the new file; ``processor_seconds``.
    """
    target = path.parent / f"converted.{'ply' if kind == 'Gaussians' else 'npz'}"
    watch, variant = Stopwatch(), mi.variant()
    with watch:
        if kind in ("hash grid", "NeRF"):
            plan = PRESETS[KINDS[kind]][NETWORK_PRESETS[KINDS[kind]]]
            plan = replace(plan, steps=max(round(plan.steps * size.effort), 1))
            convert_to_network(path, target, KINDS[kind], variant, plan)
        elif kind == "Gaussians":
            convert_to_gaussians(path, target, None, variant)
        elif kind == "octree":
            convert_to_octree(path, target, None, variant)
        elif path.suffix == ".ply":
            convert_to_field(path, target, 128, None, variant)
        else:
            convert_to_grid(path, target, None, variant)
    made = Representation.open(target)
    return {
        "loss": views_psnr(made, Representation.open(path)),
        "psnr": judge(made, judged),
        "mib": target.stat().st_size / 2**20,
        "processor_seconds": watch.processor,
    }


def judge(source: Representation, judged: Photos) -> float:
    """Mean PSNR [dB] of the judged views, over their backgrounds."""

    def score(view: Photo) -> ImageScore:
        image, opacity = source.show(view.camera)
        over = image + (1 - opacity)[..., None] * np.asarray(view.background)
        return score_image(over, view.image, space=judged.space, mask=view.mask, metrics=("psnr",))

    return average_scores([score(rectify(view)) for view in judged.views]).values["psnr"]


def table(question: str, answer: dict) -> list[str]:
    """The matrix of the conversions, for the docs."""
    sources = answer["sources"]
    lines = [f"| from, to | {' | '.join(KINDS)} |", "|---" * (len(KINDS) + 1) + "|"]
    for name, row in sources.items():
        cells = (row["targets"].get(kind) for kind in KINDS)
        shown = ("-" if cell is None else f"{cell['loss']:.1f} ({cell['psnr']:.1f})" for cell in cells)
        lines.append(f"| {name} ({row['psnr']:.1f}) | {' | '.join(shown)} |")
    return lines


STUDY = Study(__name__, __doc__, ConversionSize, {"matrix": measure_conversions}, table=table)
