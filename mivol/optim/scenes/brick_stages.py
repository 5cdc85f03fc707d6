"""Bricks of sparse grids that appear and vanish between the stages of a fit.

Conventions. ``data`` (bricks, 8, 8, 8, C) and ``bricks`` are the parameters of a sparse grid
(:mod:`mivol.fields.voxels`). Bricks whose values are all at most a threshold vanish. Neighbours of the others, 26 a
brick, appear if the gradient asks for them. A trial step with all neighbours at 0 measures the *pull* of each brick: by how
much the loss falls if all its voxels rise. A neighbour appears if its pull exceeds the median size of the pulls of the
stored bricks. These fall to the noise of the gradient as the fit converges; the sign alone would let in half of all neighbours
by noise.
"""

from __future__ import annotations

import itertools
from typing import Protocol

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.parameters import Parameter
from mivol.optim.problem import Reals, Refinement

__all__ = ["BrickProblem", "adapt_bricks", "bricks_key", "check_sparse_parameter", "find_neighbours"]


class BrickProblem(Protocol):
    """What :func:`adapt_bricks` needs of a problem.

    Attributes:
        parameters: the parameters of the fit.
    """

    parameters: list[Parameter]

    def brick_counts(self) -> dict[str, tuple[int, int, int]]:
        """Bricks (Z, Y, X) of the box of each sparse parameter, by name."""

    def brick_numbers(self, name: str) -> np.ndarray:
        """Ascending numbers of the stored bricks of a parameter."""

    def set_brick_numbers(self, name: str, numbers: np.ndarray) -> None:
        """Store other bricks with the next values."""

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[float, Reals]:
        """As of :class:`mivol.optim.problem.DifferentiableProblem`."""


def bricks_key(name: str) -> str:
    """Key of the numbers of the bricks beside the key of their values."""
    return f"{name.rpartition('.')[0]}.bricks"


def check_sparse_parameter(parameter: Parameter) -> None:
    """Check the map and the priors of a sparse grid.

    Raises:
        MivolError: a map that cannot start new voxels at 0, or a prior that compares neighbours, which lie in other bricks.
    """
    if parameter.map != "identity":
        raise MivolError(
            f'{parameter.name} is a sparse grid, whose new voxels start at 0, and map "{parameter.map}" does not take 0: '
            'take "identity".'
        )
    prior = next((prior.label() for prior in parameter.priors if prior.is_spatial), None)
    if prior is not None:
        raise MivolError(
            f'{parameter.name} is a sparse grid, and the prior "{prior}" compares neighbours in a dense grid: leave it out, '
            'take "l1" or "bounds", or set storage to dense.'
        )


def adapt_bricks(problem: BrickProblem, reals: Reals, iteration: int, threshold: float) -> Refinement:
    """Drop empty bricks, and add neighbours where the gradient asks for them.

    Args:
        problem: problem with sparse grids.
        reals: the latest point.
        iteration: selects the random numbers and the views of the trial step.
        threshold: largest value of a brick that vanishes.

    Raises:
        MivolError: no parameter is a sparse grid.

    Cost: a step with the neighbours of all kept bricks.
    """
    counts = problem.brick_counts()
    if not counts:
        raise MivolError("the event 'adapt_bricks' found no sparse grid among the parameters: remove the event.")
    before = {name: problem.brick_numbers(name) for name in counts}
    kept = {name: _find_kept(np.array(reals[name]), before[name], threshold) for name in counts}
    tried = {name: np.union1d(kept[name], find_neighbours(kept[name], counts[name])) for name in counts}
    trial = dict(reals)
    for name, numbers in tried.items():
        problem.set_brick_numbers(name, numbers)
        trial[name] = _carry(reals[name], before[name], numbers)
    gradients = problem.loss_and_gradient(trial, iteration)[1]
    messages, after = [], {}
    for name, numbers in tried.items():
        asked = numbers[_find_asked(np.array(gradients[name]), np.isin(numbers, before[name]))]
        after[name] = np.union1d(kept[name], asked)
        problem.set_brick_numbers(name, after[name])
        new, gone = len(np.setdiff1d(after[name], before[name])), len(np.setdiff1d(before[name], after[name]))
        messages.append(f"{len(after[name])} bricks ({new} appeared, {gone} vanished)")

    def carry(tensors: Reals) -> Reals:
        return {k: _carry(t, before[k], after[k]) if k in after else t for k, t in tensors.items()}

    return Refinement(carry(reals), carry, message=", ".join(messages))


def find_neighbours(numbers: np.ndarray, counts: tuple[int, int, int]) -> np.ndarray:
    """The numbers of the 26 neighbours of bricks in a box of (Z, Y, X) bricks, ascending; bricks among them too."""
    places = np.stack(np.unravel_index(numbers, counts), axis=1)
    around = (places[:, None] + np.array(list(itertools.product((-1, 0, 1), repeat=3)))).reshape(-1, 3)
    around = around[((around >= 0) & (around < counts)).all(axis=1)]
    return np.unique(np.ravel_multi_index(around.T, counts))


def _find_kept(values: np.ndarray, numbers: np.ndarray, threshold: float) -> np.ndarray:
    """The bricks with a value above the threshold; the brick with the largest value if there is none."""
    largest = values.reshape(len(values), -1).max(axis=1)
    return numbers[(largest > threshold) | (largest == largest.max()) & (largest.max() <= threshold)]


def _find_asked(gradient: np.ndarray, stored: np.ndarray) -> np.ndarray:
    """The bricks that are not stored and pull harder than the stored bricks do in the median."""
    pull = -gradient.reshape(len(gradient), -1).sum(axis=1, dtype=np.float64)
    return ~stored & (pull > np.median(np.abs(pull[stored])))


def _carry(tensor: mi.TensorXf, before: np.ndarray, after: np.ndarray) -> mi.TensorXf:
    """The rows of bricks in another set of bricks; 0 for new ones."""
    rows = np.array(tensor)
    carried = np.zeros((len(after), *rows.shape[1:]), np.float32)
    _, old, new = np.intersect1d(before, after, assume_unique=True, return_indices=True)
    carried[new] = rows[old]
    return mi.TensorXf(carried)
