"""A fit of a radiance field, step by step."""

from __future__ import annotations

import numpy as np

from mivol.fields.spherical import SphericalGrid
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.radiance_plan import FitPlan
from mivol.optim.radiance_problem import RadianceProblem
from mivol.optim.ray_batches import RayBatches


def begin_radiance_fit(batches: RayBatches, box: np.ndarray, plan: FitPlan, seed: int = 0) -> Fit:
    """A fit before its first step, for those who take the steps themselves.

    Args:
        batches: what is looked at.
        box: (2, 3) [length], where the field may be.
        plan: how the fit goes.
        seed: of the rays.

    Raises:
        MivolError: as :class:`mivol.optim.radiance_problem.RadianceProblem`.

    Example:
        >>> fit = begin_radiance_fit(RayBatches.of(photos.views, (1, 2, 4)), photos.box, PRESETS["cpu"])
        >>> while not fit.is_done:
        ...     fit.advance()
        >>> field = newest_field(fit)
    """
    return begin_fit(RadianceProblem(batches, box, plan, seed), plan.optimiser, plan.course())


def newest_field(fit: Fit) -> SphericalGrid:
    """The field of a fit after its newest step; the problem holds it as that step found it."""
    fit.problem.set(fit.run.reals)
    return fit.problem.field
