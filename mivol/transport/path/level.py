"""The level of radiance that derivatives of free flights are taken from."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.constant_control import find_constant_control
from mivol.transport.path.estimators import Estimators
from mivol.transport.path.scores import Primal
from mivol.transport.path.settings import Settings
from mivol.transport.path.walk import walk_path

__all__ = ["prepare_derivatives"]


PATHS = 4096
"""Paths that the level is estimated from: it need not be accurate, since derivatives are unbiased whatever it is."""

SEED = 0x1E7E1
"""Of those paths. They are independent of the paths of a render, or the level would bias its derivatives."""


def prepare_derivatives(estimators: Estimators, settings: Settings, ray: mi.Ray3f) -> None:
    """Find what derivatives along camera rays need beforehand, once for all passes.

    Args:
        estimators: of the render.
        settings: depth, roulette, hidden emitters.
        ray: the camera rays of a pass.
    """
    estimators.prepare_derivatives(ray)
    segment = estimators.segment
    if segment.ends_in_media and segment.level is None:
        segment.level = _find_level(estimators, settings, ray)


def _find_level(estimators: Estimators, settings: Settings, ray: mi.Ray3f) -> mi.Spectrum | None:
    """The light of a constant sky that a medium scatters, or the mean radiance of camera rays that meet something.

    Returns:
        The level [radiance]; None where a medium has no albedo (but a ``sigma_s``), since its absorption has no such balance.
    """
    if any(body.view.albedo is None for body in estimators.media.bodies):
        return None
    level = find_constant_control(estimators.media)
    if level is None:
        n = dr.width(ray)
        index = mi.UInt32(dr.arange(mi.UInt64, PATHS) * n // PATHS)
        some = dr.gather(mi.Ray3f, mi.Ray3f(ray), index)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(SEED, PATHS)
        score, opacity = walk_path(estimators, settings, sampler, some, Primal(dr.zeros(mi.Spectrum, PATHS)))
        met = dr.select(opacity > 0, 1.0, 0.0)
        level = mi.Spectrum(*(dr.sum(row * met) / dr.maximum(dr.sum(met), 1) for row in score.L))
    dr.eval(level)
    return dr.detach(level)
