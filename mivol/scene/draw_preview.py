r"""Does drawing the light of media pay in a scene?  Measured once on a small preview, where it is predicted to.

The prediction (:mod:`mivol.scene.media_light`) knows of the light of media only. Where the noise of other light is larger,
draws take time and hardly any noise. So cells of the film are rendered by chance and with draws, along one ray each, and the
gain is the median over the cells of

.. math:: g = \frac{\max( s_{met}^2,\; n\,(m_{met} - m_{drawn})^2 )}{c\,s_{drawn}^2}

with the means m and variances s^2 of n samples, and c the time that a path with draws takes over that of one without. Where no
path has happened to meet a light that draws find, the difference of the means stands for the noise that was not seen.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mivol.scene.build import build_estimators
from mivol.scene.facts import Needs
from mivol.scene.media_light import COST
from mivol.scene.plan import make_plan
from mivol.scene.recording import without_collections
from mivol.scene.survey import SceneSurvey
from mivol.transport.estimators.scores import Primal
from mivol.transport.path.estimators import Settings
from mivol.transport.path.walk import walk_path

__all__ = ["gain_of_draws", "measure_draws"]

SIDE, SAMPLES, SEED = 24, 48, 0xD3A4
"""Cells along an edge of the preview, samples of each, seed."""


def measure_draws(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> Needs:
    """The needs of a scene with the gain of draws as it is measured, where it is predicted to be above 1.

    Args:
        scene, sensor: what is seen.
        needs: of the scene.
        survey: keeps what was measured; where a fit changes the scene, what is made of this stays unbiased.
        settings: of the integrator.

    Cost: 2 x 27648 paths once, and two kernels.
    """
    light = needs.media_light
    if light is None or light.gain <= 1 or settings.media_light != "auto":
        return needs
    if survey.gain_of_draws is None:
        with without_collections(), dr.suspend_grad():
            met, drawn = (_preview(scene, sensor, needs, survey, replace(settings, media_light=m)) for m in ("met", "drawn"))
        survey.gain_of_draws = gain_of_draws(met, drawn)
    return replace(needs, media_light=replace(light, gain=survey.gain_of_draws))


def gain_of_draws(met: NDArray, drawn: NDArray) -> float:
    """How much sooner draws reach an error than chance does [1], from samples (cells, n) of both; 0 where all is black."""
    n = met.shape[1]
    missed = n * np.square(met.mean(axis=1) - drawn.mean(axis=1))
    noise = np.maximum(met.var(axis=1, ddof=1), missed)
    rest = COST * drawn.var(axis=1, ddof=1)
    lit = (noise > 0) | (rest > 0)
    with np.errstate(divide="ignore"):
        return float(np.median(noise[lit] / rest[lit])) if lit.any() else 0.0


def _preview(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, survey: SceneSurvey, settings: Settings) -> NDArray:
    """Mean radiance of all colours of each sample (cells, SAMPLES), along the middle of each cell."""
    cells, n = SIDE * SIDE, SIDE * SIDE * SAMPLES
    estimators = build_estimators(scene, needs, make_plan(needs, settings), settings, survey, pictures=True)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, n)
    cell = dr.arange(mi.UInt32, n) // SAMPLES
    place = (mi.Point2f(cell % SIDE, cell // SIDE) + 0.5) / SIDE
    ray, weight = sensor.sample_ray_differential(mi.Float(sensor.shutter_open()), mi.Float(0.5), place, mi.Point2f(0.5))
    score, _ = walk_path(estimators, sampler, ray, Primal(dr.zeros(mi.Spectrum, n)))
    return np.array(score.L * weight, np.float64).reshape(-1, n).mean(axis=0).reshape(cells, SAMPLES)
