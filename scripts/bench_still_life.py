#!/usr/bin/env python3
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
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mivol  # noqa: F401  (chooses LLVM)
from contest import AT_LEAST, ROOT, Bench, judge, say
from mivol.optim.radiance_fit import RadianceFit, render_view
from mivol.optim.radiance_plan import Plan, Stage
from mivol.optim.radiance_views import Views
from mivol.photos import Photo, load_photos
from mivol.report.figures import STYLE, save
from mivol.validate import images

import drjit as dr
import matplotlib as mpl
import numpy as np

FOLDER = Path("runs/still_life")

NO_TV = {"tv_sh": 0.0, "tv_density": 0.0}


@dataclass(frozen=True)
class Size:
    """How much is fitted."""

    name: str = "full"
    folder: str = "photographs"
    views: int = 75
    side: int = 128
    longest: int = 64
    steps: int = 600
    shrink: int = 2
    tiles: int = 256
    few: int = 5


FULL = Size()
QUICK = Size("quick", "quick_photographs", 15, 48, 16, 40, 1, 32, 2)


def still_life(size: Size) -> tuple[tuple[Photo, ...], tuple[Photo, ...], np.ndarray]:
    """Photographs to fit, those held out, and the box; rendered where they are not there yet."""
    spec = importlib.util.spec_from_file_location("still_life", ROOT / "scenes" / "still_life" / "photographs.py")
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    folder = FOLDER / size.folder
    made.make(folder, size.views, size.side)
    settings = {"background": "white", "space": "srgb", "box": made.BOX}
    return *(load_photos(folder, split=split, **settings).views for split in ("train", "test")), made.BOX


def fit(photos: Sequence[Photo], held_out: Sequence[Photo], box: np.ndarray, size: Size, degree: int, **priors: float) -> dict:
    """A fit: PSNR of the held-out views, nodes, processor time; and a held-out view, for the picture."""
    quarter = Stage(size.longest // 2, size.steps // 4, size.shrink, 4, max(size.tiles // size.shrink, 16))
    whole = Stage(size.longest, size.steps - size.steps // 4, 1, 4, size.tiles)
    plan = Plan((quarter, whole), degree=degree, **priors)
    work = RadianceFit(Views.of(photos, [stage.shrink for stage in plan.stages]), box, plan)
    start = time.process_time()
    for _ in range(plan.steps):
        dr.eval(work.advance())
    dr.sync_thread()
    seconds = time.process_time() - start
    shown = [render_view(work.field, photo.camera, photo.background).image for photo in held_out]
    judged = [
        images.judge(image, photo.image, space="srgb", metrics=("psnr",)) for image, photo in zip(shown, held_out, strict=True)
    ]
    psnr = images.score(judged).values["psnr"]
    say(f"  degree {degree}, {len(photos)} views, {priors}: {psnr:.2f} dB, {seconds:.0f} s")
    return {
        "degree": degree, "views": len(photos), **priors, "psnr": psnr, "each": [image.values["psnr"] for image in judged],
        "nodes": work.field.rows, "processor_seconds": seconds, "view": np.round(shown[len(shown) // 2], 3).tolist(),
        "photograph": np.round(held_out[len(shown) // 2].image, 3).tolist(),
    }  # fmt: skip


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


def compare(question: str, answer: dict) -> list[dict]:
    """The figures that have a bar."""
    psnr = {name: found["psnr"] for name, found in answer.items()}
    if question == "degree":
        gain = psnr["SH 2"] - max(psnr["SH 0"], psnr["SH 0, no TV"])
        return [judge("dB of degree 2 over degree 0", gain, AT_LEAST, 1.5)]
    return [judge("dB of total variation over none, few views", psnr["TV"] - psnr["no TV"], AT_LEAST, 0)]


def draw(answers: dict, folder: Path) -> None:
    """A held-out view: the photograph, and each fit with what it misses."""
    with mpl.rc_context(STYLE):
        shown = [(question, name, found) for question, fits in answers.items() for name, found in fits.items()]
        figure = mpl.figure.Figure(figsize=(2.1 * (len(shown) + 1), 4.6))
        axes = figure.subplots(2, len(shown) + 1, squeeze=False)
        truth = np.array(shown[0][2].pop("photograph"))
        axes[0, 0].imshow(truth)
        axes[0, 0].set_title("photograph", fontsize=9)
        for column, (question, name, found) in enumerate(shown, 1):
            found.pop("photograph", None)
            view = np.array(found.pop("view"))
            few = f", {found['views']} views" if question == "few" else ""
            axes[0, column].imshow(np.clip(view, 0, 1))
            axes[0, column].set_title(f"{name}{few}: {found['psnr']:.1f} dB", fontsize=9)
            axes[1, column].imshow(np.abs(view - truth).mean(axis=2), cmap="magma", vmin=0, vmax=0.25)
        for one in axes.flat:
            one.set_axis_off()
        save(figure, folder / "bench_still_life.png")


BENCH = Bench("bench_still_life", __doc__, {"degree": ask_degree, "few": ask_few}, (FULL, QUICK), compare, draw)

if __name__ == "__main__":
    BENCH.main()
