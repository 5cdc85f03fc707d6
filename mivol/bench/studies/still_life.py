"""Does a radiance field see that light depends on the direction, and does total variation help where views are few?

    scripts/bench_still_life.py                 # two minutes on 2 cores
    scripts/bench_still_life.py --quick         # 20 seconds, small sizes: its figures mean nothing

The scene is scenes/still_life: metal, varnish and matt things under four lights, fixed before any fit. Its photographs (75 of
128 x 128 pixels by Mitsuba's path tracer, 15 of them held out, between the others) are made where they are missing, in
runs/still_life/photographs. Fits have 64 nodes along the longest edge and a coarser stage before that.

degree: one colour for all directions (harmonics of degree 0, with total variation or with none, whichever does better) against
degree 2, on the held-out views. few: degree 2 from 12 of the 60 views, with the total variation of density and colours that
every fit has against none, on the same held-out views. Each pair has the same rays, steps and rates. PSNR is that of
mivol.validate.images, over white.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from mivol.bench.extinctions import CHECKOUT
from mivol.bench.harness.bars import AT_LEAST, Bar, judge, say
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench
from mivol.bench.harness.timing import Stopwatch
from mivol.errors import MivolError
from mivol.optim.loop import reconstruct
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo, load_photos
from mivol.validate import images

__all__ = ["BENCH", "FULL", "QUICK", "Size", "ask_degree", "ask_few", "main", "photographer"]

NO_TV = {"tv_sh": 0.0, "tv_density": 0.0}
SCENE = CHECKOUT / "scenes" / "still_life" / "photographs.py"


@dataclass(frozen=True)
class Size:
    """How much is fitted.

    Attributes:
        name: for the JSON.
        folder: of the photographs, which are made where they are missing.
        views, side: how many photographs, of how many pixels squared.
        longest: nodes along the longest edge of the last stage; the first one has half of them.
        steps: of all stages.
        shrink: of the photographs in the first stage.
        tiles: of 4 x 4 pixels in a step's view.
        few: of the photographs, every so many-th is fitted where few are.
        spp: samples per pixel of the photographs.
    """

    name: str = "full"
    folder: Path = Path("runs/still_life/photographs")
    views: int = 75
    side: int = 128
    longest: int = 64
    steps: int = 600
    shrink: int = 2
    tiles: int = 256
    few: int = 5
    spp: int = 64


FULL = Size()
QUICK = Size("quick", Path("runs/still_life/quick_photographs"), 15, 48, 16, 40, 1, 32, 2)


def photographer() -> ModuleType:
    """The script that renders the photographs.

    Raises:
        MivolError: it is not there: mivol was installed without its checkout.
    """
    if not SCENE.is_file():
        raise MivolError(f"{SCENE} is not there; run this bench from a checkout of mivol, which has the scene.")
    spec = importlib.util.spec_from_file_location("still_life", SCENE)
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def still_life(size: Size) -> tuple[tuple[Photo, ...], tuple[Photo, ...], np.ndarray]:
    """Photographs to fit, those held out, and the box; rendered where they are not there yet.

    Raises:
        MivolError: as :func:`photographer`.
    """
    made = photographer()
    made.make(size.folder, size.views, size.side, size.spp)
    settings = {"background": "white", "space": "srgb", "box": made.BOX}
    return *(load_photos(size.folder, split=split, **settings).views for split in ("train", "test")), made.BOX


def fit(photos: Sequence[Photo], held_out: Sequence[Photo], box: np.ndarray, size: Size, degree: int, **priors: float) -> dict:
    """Fit, and judge by held-out views.

    Args:
        photos, held_out: views.
        box: (2, 3) what is looked at.
        size: nodes, steps, rays.
        degree: of the harmonics.
        priors: fields of :class:`mivol.optim.photographs.radiance_plan.RadiancePlan`.

    Returns:
        PSNR [dB] of the held-out views, nodes, processor time; and for the figure the middle one of them and its render.
    """
    half = RadianceStage(size.longest // 2, size.steps // 4, size.shrink, 4, max(size.tiles // size.shrink, 16))
    whole = RadianceStage(size.longest, size.steps - size.steps // 4, 1, 4, size.tiles)
    plan = RadiancePlan((half, whole), degree=degree, **priors)
    problem, watch = RadianceProblem(RayBatches.of(photos, [stage.shrink for stage in plan.stages]), box, plan), Stopwatch()
    with watch:
        reconstruct(problem, plan.optimizer, plan.course())
    shown = [render_view(problem.field, photo.camera, photo.background).image for photo in held_out]
    judged = [
        images.judge(image, photo.image, space="srgb", metrics=("psnr",)) for image, photo in zip(shown, held_out, strict=True)
    ]
    psnr = images.score(judged).values["psnr"]
    say(f"  degree {degree}, {len(photos)} views, {priors}: {psnr:.2f} dB, {watch.processor:.0f} s")
    middle = len(shown) // 2
    return {
        "degree": degree,
        "views": len(photos),
        **priors,
        "psnr": psnr,
        "each": [image.values["psnr"] for image in judged],
        "nodes": problem.field.rows,
        "processor_seconds": watch.processor,
        "view": shown[middle],
        "photograph": held_out[middle].image,
    }


def ask_degree(size: Size) -> dict:
    """How much better are held-out views with harmonics of degree 2 than with one colour?"""
    train, held_out, box = still_life(size)
    asked = {"SH 0": (0, {}), "SH 0, no TV": (0, NO_TV), "SH 2": (2, {})}
    return {name: fit(train, held_out, box, size, degree, **priors) for name, (degree, priors) in asked.items()}


def ask_few(size: Size) -> dict:
    """How much better are held-out views with total variation, where few views were fitted?"""
    train, held_out, box = still_life(size)
    asked = {"no TV": NO_TV, "TV": {}}
    return {name: fit(train[:: size.few], held_out, box, size, 2, **priors) for name, priors in asked.items()}


def compare(question: str, answer: dict) -> list[Bar]:
    """The figures that have a bar."""
    psnr = {name: found["psnr"] for name, found in answer.items()}
    if question == "degree":
        gain = psnr["SH 2"] - max(psnr["SH 0"], psnr["SH 0, no TV"])
        return [judge("dB of degree 2 over degree 0", gain, AT_LEAST, 1.5)]
    return [judge("dB of total variation over none, few views", psnr["TV"] - psnr["no TV"], AT_LEAST, 0)]


BRIGHTEST = 0.25
"""Error that the figure shows in the brightest colour."""


def draw(answers: dict, folder: Path) -> None:
    """A held-out view: the photograph, and each fit with what it misses."""
    shown = [(question, name, found) for question, fits in answers.items() for name, found in fits.items()]
    with drawn(folder / "bench_still_life.png", 2.1 * (len(shown) + 1), 4.6) as figure:
        axes = figure.subplots(2, len(shown) + 1, squeeze=False)
        axes[0, 0].imshow(shown[0][2]["photograph"])
        axes[0, 0].set_title("photograph", fontsize=9)
        scale = f"black 0, yellow {BRIGHTEST:g} and more\n[code value, white is 1]"
        says = f"errors, mean of the colours:\n{scale};\nnumbers above are PSNR"
        axes[1, 0].text(0, 1, says, transform=axes[1, 0].transAxes, va="top", fontsize=8)
        for column, (question, name, found) in enumerate(shown, 1):
            few = f", {found['views']} views" if question == "few" else ""
            axes[0, column].imshow(np.clip(found["view"], 0, 1))
            axes[0, column].set_title(f"{name}{few}: {found['psnr']:.1f} dB", fontsize=9)
            error = np.abs(found["view"] - found["photograph"]).mean(axis=2)
            axes[1, column].imshow(error, cmap="magma", vmin=0, vmax=BRIGHTEST)
        for one in axes.flat:
            one.set_axis_off()


BENCH = Bench("bench_still_life", __doc__, {"degree": ask_degree, "few": ask_few}, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
