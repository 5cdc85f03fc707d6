"""What two choices of a fit of Gaussians bring: the mip filter at other sizes, and a gain for each photograph.

Conventions. Each pair of fits has the same photographs, steps, rates and seed. PSNR is the mean over views that were not
fitted. At each size a picture has the low-pass filter of its own pixels, compensated where the fit was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mivol import config
from mivol.bench.harness.bars import say
from mivol.bench.studies.gaussian_fits import Fitted, asked_of, fitted, photographs, psnr_of
from mivol.errors import MivolError
from mivol.experiments.gaussian_fit import begin, compare, make_gaussian_plan
from mivol.experiments.judged_views import judge_colour_fitted
from mivol.experiments.photo_data import boxed, read_photos
from mivol.optim.loop import reconstruct
from mivol.photos import load_photos, rectify
from mivol.points import Gaussians

__all__ = ["exposure_gain", "mip_gain"]


def mip_gain(folder: Path, asked: Fitted, scales: Sequence[float]) -> dict:
    """Fit photographs of one size without the mip filter and with it, and judge at several sizes.

    Args:
        folder: as of :func:`mivol.bench.studies.gaussian_fits.fit_and_judge`.
        asked: what is fitted, with the first of its seeds.
        scales: of the judged views, of the files' width.

    Returns:
        Under "without" and "with", by width of the judged views [pixel], PSNR [dB]; and what was asked.

    Raises:
        MivolError: no such folder.
    """
    photos, plan = photographs(folder, asked), asked_of(asked)
    judged = {}
    for scale in scales:
        views = load_photos(folder, split="test", scale=scale, background="white", space="srgb").views
        judged[views[0].camera.size[0]] = views
    answer = {"steps": plan.steps, "fitted_at": photos.views[0].camera.size[0], "views": len(views)}
    for name, mip in (("without", False), ("with", True)):
        chosen = replace(plan, mip=mip)
        cloud = Gaussians(**fitted(photos, chosen, asked.seeds[0]).cloud)
        answer[name] = {str(width): psnr_of(cloud, views, chosen) for width, views in judged.items()}
        say(f"  {name} mip: " + ", ".join(f"{value:.2f} dB at {width}" for width, value in answer[name].items()))
    return answer


def exposure_gain(folder: Path, asked: Fitted, held_out: int) -> dict:
    """Fit real photographs without gains and with them, as ``mivol optimize`` does.

    Args:
        folder: of photographs without alpha.
        asked: what is fitted, with the first of its seeds.
        held_out: every so many of them is judged by.

    Returns:
        Under "without" and "with" ``psnr`` of the held-out views and ``psnr_colour_fitted`` [dB], where the colours of each are
        fitted to its photograph's, since nobody knows its exposure; ``gains``, smallest and largest; and what was asked.

    Raises:
        MivolError: no such folder.
    """
    if not folder.is_dir():
        raise MivolError(f"{folder} is not there: set MIVOL_DATA to the folder that holds multiview/fox.")
    answer: dict = {}
    for name, exposure in (("without", False), ("with", True)):
        settings = {"preset": asked.preset, "effort": asked.effort, "exposure": exposure}
        data = {"path": str(folder), "scale": asked.scale, "held_out": held_out}
        chosen = config.from_dict({"title": folder.name, "photos": data, "gaussians": settings, "seed": asked.seeds[0]})
        photos, judged = read_photos(chosen, Path())
        begun = begin(chosen, boxed(chosen, photos), make_gaussian_plan(chosen))
        problem = begun.problem(chosen.seed)
        reconstruct(problem, begun.plan.optimizer, begun.plan.course())
        seen = [compare(problem, judged, photo, ("psnr",)) for photo in judged.views]
        raw = [quality.values["psnr"] for _, quality in seen]
        pairs = zip(seen, judged.views, strict=True)
        adjusted = [judge_colour_fitted(picture, rectify(photo), judged.space) for (picture, _), photo in pairs]
        gains = problem.exposure.table() if problem.exposure is not None else np.ones(1)
        answer[name] = {
            "psnr": float(np.mean(raw)),
            "psnr_colour_fitted": float(np.mean(adjusted)),
            "gains": [float(gains.min()), float(gains.max())],
        }
        width, height = judged.views[0].camera.size
        counts = {"pixels": [width, height], "fitted": len(begun.views), "judged": len(raw), "steps": begun.plan.steps}
        say(f"  {name} gains: {answer[name]['psnr']:.2f} dB, {answer[name]['psnr_colour_fitted']:.2f} dB with fitted colours")
    return answer | counts
