"""Do view-dependent colours help a radiance field, and does total variation help it with few views?

    mivol bench still_life                 # two minutes on 2 cores
    mivol bench still_life --quick         # 20 seconds, small sizes: the figures mean nothing

The scene is scenes/still_life: metal, varnished and matte objects under four lights, fixed before any fit. Its photographs (75
of 128 x 128 pixels by Mitsuba's path tracer, 15 of them held out, between the others) are rendered to
runs/still_life/photographs if they are missing. Fits have 64 nodes along the longest edge, and a coarser stage before that.

degree: one colour for all directions (harmonics of degree 0, with total variation or without, whichever is better) against
degree 2, on the held-out views. few: degree 2 from 12 of the 60 views, with total variation of density and colours as in
every fit, and without, on the same held-out views. Each pair has the same rays, steps and rates. PSNR is computed by
mivol.validate.images, over white.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.bench.harness.bars import AT_LEAST, Bar, judge, say_row
from mivol.bench.harness.figures import new_figure
from mivol.bench.harness.study import Size, Study, amount
from mivol.bench.harness.timing import Stopwatch
from mivol.bench.photo_fits import load_photographer
from mivol.optim.loop import reconstruct
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo, load_photos
from mivol.validate import images

__all__ = ["STUDY", "StillLifeSize", "measure_degree", "measure_few"]

NO_TV = {"tv_sh": 0.0, "tv_density": 0.0}
MAX_ERROR = 0.25
"""Error that the figure shows in the brightest colour."""


@dataclass(frozen=True)
class StillLifeSize(Size):
    """Amount of work."""

    folder: str = amount("runs/still_life/photographs", "runs/still_life/quick_photographs", "folder of the photographs")
    views: int = amount(75, 15, "number of photographs")
    side: int = amount(128, 48, "edge of the photographs [pixels]")
    longest: int = amount(64, 16, "nodes along the longest edge in the last stage; the first stage has half")
    steps: int = amount(600, 40, "steps of all stages")
    shrink: int = amount(2, 1, "factor by which photographs are smaller in the first stage")
    tiles: int = amount(256, 32, "tiles of 4 x 4 pixels in the view of a step")
    few: int = amount(5, 2, "question few: every such photograph is fitted")
    spp: int = amount(64, doc="samples per pixel of the photographs")


def load_still_life(size: StillLifeSize) -> tuple[tuple[Photo, ...], tuple[Photo, ...], np.ndarray]:
    """Photographs to fit, held-out photographs, and the box of the scene; missing photographs are rendered."""
    script = load_photographer()
    folder = Path(size.folder)
    script.make(folder, size.views, size.side, size.spp)
    settings = {"background": "white", "space": "srgb", "box": script.BOX}
    train, test = (load_photos(folder, split=split, **settings).views for split in ("train", "test"))
    return train, test, script.BOX


def fit_views(
    photos: Sequence[Photo], held_out: Sequence[Photo], box: np.ndarray, size: StillLifeSize, degree: int, **priors: float
) -> dict:
    """Fit a radiance field, and judge by held-out views.

    Args:
        photos, held_out: views to fit and to judge by.
        box: (2, 3) box of the scene [length].
        size: nodes, steps, rays.
        degree: degree of the harmonics.
        priors: fields of :class:`mivol.optim.photographs.radiance_plan.RadiancePlan`.

    Returns:
        PSNR [dB] of the held-out views, nodes, processor time; for the figure the middle held-out view and its render.
    """
    half = RadianceStage(size.longest // 2, size.steps // 4, size.shrink, 4, max(size.tiles // size.shrink, 16))
    whole = RadianceStage(size.longest, size.steps - size.steps // 4, 1, 4, size.tiles)
    plan = RadiancePlan((half, whole), degree=degree, **priors)
    problem, watch = (
        RadianceProblem(RayBatches.from_photos(photos, [stage.shrink for stage in plan.stages]), box, plan),
        Stopwatch(),
    )
    with watch:
        reconstruct(problem, plan.optimizer, plan.course())
    renders = [render_view(problem.field, photo.camera, photo.background).image for photo in held_out]
    pairs = zip(renders, held_out, strict=True)
    judged = [images.score_image(image, photo.image, space="srgb", metrics=("psnr",)) for image, photo in pairs]
    psnr = images.average_scores(judged).values["psnr"]
    say_row(f"degree {degree}, {len(photos)} views, {priors or 'with TV'}", psnr=psnr, processor_seconds=watch.processor)
    middle = len(renders) // 2
    return {
        "degree": degree,
        "views": len(photos),
        **priors,
        "psnr": psnr,
        "each": [image.values["psnr"] for image in judged],
        "nodes": problem.field.rows,
        "processor_seconds": watch.processor,
        "view": renders[middle],
        "photograph": held_out[middle].image,
    }


def measure_degree(size: StillLifeSize) -> dict:
    """How much better are held-out views with harmonics of degree 2 than with one colour?"""
    train, held_out, box = load_still_life(size)
    fits = {"SH 0": (0, {}), "SH 0, no TV": (0, NO_TV), "SH 2": (2, {})}
    return {name: fit_views(train, held_out, box, size, degree, **priors) for name, (degree, priors) in fits.items()}


def measure_few(size: StillLifeSize) -> dict:
    """How much better are held-out views with total variation, for a fit of few views?"""
    train, held_out, box = load_still_life(size)
    fits = {"no TV": NO_TV, "TV": {}}
    return {name: fit_views(train[:: size.few], held_out, box, size, 2, **priors) for name, priors in fits.items()}


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the gains."""
    psnr = {name: figures["psnr"] for name, figures in answer.items()}
    if question == "degree":
        gain = psnr["SH 2"] - max(psnr["SH 0"], psnr["SH 0, no TV"])
        return [judge("dB of degree 2 over degree 0", gain, AT_LEAST, 1.5)]
    return [judge("dB of total variation over none, few views", psnr["TV"] - psnr["no TV"], AT_LEAST, 0)]


def draw(answers: dict, path: Path) -> None:
    """Show a held-out view: the photograph, and the render and the error of each fit."""
    fits = [(question, name, figures) for question, answer in answers.items() for name, figures in answer.items()]
    with new_figure(path, 2.1 * (len(fits) + 1), 4.6) as figure:
        axes = figure.subplots(2, len(fits) + 1, squeeze=False)
        axes[0, 0].imshow(fits[0][2]["photograph"])
        axes[0, 0].set_title("photograph", fontsize=9)
        scale = f"black 0, yellow {MAX_ERROR:g} and more\n[code value, white is 1]"
        text = f"errors, mean of the colours:\n{scale};\nnumbers above are PSNR"
        axes[1, 0].text(0, 1, text, transform=axes[1, 0].transAxes, va="top", fontsize=8)
        for column, (question, name, figures) in enumerate(fits, 1):
            few = f", {figures['views']} views" if question == "few" else ""
            axes[0, column].imshow(np.clip(figures["view"], 0, 1))
            axes[0, column].set_title(f"{name}{few}: {figures['psnr']:.1f} dB", fontsize=9)
            error = np.abs(figures["view"] - figures["photograph"]).mean(axis=2)
            axes[1, column].imshow(error, cmap="magma", vmin=0, vmax=MAX_ERROR)
        for one in axes.flat:
            one.set_axis_off()


STUDY = Study(__name__, __doc__, StillLifeSize, {"degree": measure_degree, "few": measure_few}, compare, draw)
