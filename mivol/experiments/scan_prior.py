"""The total variation of a reconstruction: how strong it is, in the unit that was asked for, and what it did."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from mivol import config
from mivol.errors import MivolError
from mivol.experiments.projections import Projections
from mivol.optim.projections.inversion import Inversion
from mivol.optim.projections.iterative import projected_cg
from mivol.optim.projections.linear_problems import State, noise_norm
from mivol.optim.projections.smoothed_tv import SmoothedTV, tv_of_noise
from mivol.report.record import PlanLine
from mivol.tomography.projector import Projector

PLAIN_ITERATIONS = {"filtered": 5, "empty": 20}
"""Iterations without a prior after which what is left of noiseless views is the misfit of voxels, by where they began."""


def make_prior(wanted: config.Solve, a: Projector, data: Projections, kept: np.ndarray) -> SmoothedTV | None:
    """Total variation in the unit that was asked for, as if weights were inverse variances; None where none was."""
    if not wanted.tv:
        return None
    if wanted.tv_unit == "length":
        return SmoothedTV(a.grid.shape, wanted.tv, wanted.delta, a.grid.voxel_size)
    return tv_of_noise(a, data.y[kept], data.weights[kept], wanted.tv, wanted.delta)


def settle_noise(problem: Inversion, wanted: config.Solve, data: Projections) -> list[PlanLine]:
    """Where a prior's unit is a noise that is not known: take what a few iterations without a prior leave, and begin there.

    Variances are ``s^2 / w`` then, and s is found. Least squares with weights w need ``s^2`` times the strength that goes with
    ``w / s^2``, which is 1/s of what balances noise of the variances 1 / w: the prior becomes s times as strong.
    """
    task = problem.linear_problem
    if task.prior is None or wanted.tv_unit == "length" or data.is_noise_known:
        return []
    n = PLAIN_ITERATIONS[wanted.start]
    *_, state = (None, *itertools.islice(projected_cg(replace(task, prior=None)), n))
    if state is None:
        return []
    left = state.residual_norm / noise_norm(task, "pcg")
    prior = replace(task.prior, strength=left * task.prior.strength)
    problem.linear_problem = replace(task, x0=state.x, prior=prior)
    reason = f"the projections have none that is known: this is what {n} iterations without total variation leave of them"
    return [PlanLine(choice=f"noise: {left:.4g} times what the weights say", reason=reason)]


def plan_of_prior(prior: SmoothedTV | None, state: State) -> list[PlanLine]:
    """How strong the prior was, and what it did."""
    if prior is None:
        return []
    share, edges = prior.value(state.x) / abs(state.objective), prior.share_of_edges(state.x)
    return [
        PlanLine(
            choice=f"total variation: strength {prior.strength:.4g} / length, smooth below {prior.delta:.4g} / length^2",
            reason=f"it is {share:.2%} of the objective in the end, and keeps {edges:.2%} of the slopes as edges",
        )
    ]


def check_noise(asked: str, data: Projections) -> None:
    """Refuse what needs the size of the noise where it is not known.

    Raises:
        MivolError: it is not.
    """
    if not data.is_noise_known:
        raise MivolError(
            f"{asked} needs the noise of the projections, which these do not have: give readings with flats and darks, or "
            "simulate with photons."
        )
