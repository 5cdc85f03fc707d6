"""RMSprop: steps of a learning rate, divided by how large the derivatives of a number usually are.

A number is left as it is, with all that is known of it, where its derivative is 0: of a sparse field each batch of rays touches
a few rows, and those of the others would be forgotten.

References: Hinton 2012 (Coursera, lecture 6e).
"""

from __future__ import annotations

from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.optim.optimiser import FirstOrder, Run
from mivol.optim.problem import Differentiable, Reals, Refinement
from mivol.optim.strategy import of


class RMSprop(FirstOrder, tag="rmsprop"):
    """RMSprop without momentum, on the numbers that have a derivative; the first derivative is its own mean.

    Rows of a field are touched by a few views at a time, and what a row remembers of others pulls it away (measured on the
    chair at 32^3, 400 steps: 25.7 dB so, 21.0 dB with Adam's momentum). Source: Hinton 2012, lecture 6e.
    """

    memory: Annotated[float, of("1", "of the running mean of squared derivatives", ge=0, lt=1)] = 0.95

    def begin(self, problem: Differentiable) -> Run:
        return RMSpropRun(self, problem)


class RMSpropRun(Run):
    """State: the reals, and the running means of their squared derivatives (0: there was none yet)."""

    def __init__(self, settings: RMSprop, problem: Differentiable) -> None:
        super().__init__(problem)
        self.settings = settings
        self.squares = {name: dr.zeros(mi.TensorXf, value.shape) for name, value in self.reals.items()}

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, slopes = self.problem.loss_and_gradient(self.reals, iteration, self.settings.views)
        rates = self.problem.rates(iteration)
        reals, squares = self._moved(slopes, {name: rate * factor for name, rate in rates.items()})
        del slopes  # as large as the reals, and of no more use
        # Squares and reals are sums of the same terms: scheduled here, they are evaluated in the kernels of the reals.
        dr.schedule(squares)
        reals = self.problem.after_step(reals, iteration)
        dr.eval(reals, squares)
        self.reals, self.squares = reals, squares
        return loss

    def _moved(self, slopes: Reals, rates: dict[str, float]) -> tuple[Reals, Reals]:
        """Reals and squares after a step down slopes."""
        reals, squares = {}, {}
        for name, value in self.reals.items():
            known, slope = self.squares[name].array, slopes[name].array
            moved = descend(value.array, known, slope, rates[name], self.settings.memory)
            reals[name], squares[name] = (mi.TensorXf(array, value.shape) for array in moved)
        return reals, squares

    def pack(self) -> dict[str, np.ndarray]:
        return super().pack() | {f"squares/{name}": np.array(value) for name, value in self.squares.items()}

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        super().unpack(arrays)
        self.squares = {name: mi.TensorXf(arrays[f"squares/{name}"]) for name in self.reals}

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        super().replace(name, reals)
        self.squares = {**self.squares, name: dr.zeros(mi.TensorXf, reals.shape)}

    def refine(self, refinement: Refinement) -> None:
        """Squares are carried over like the reals: without them the first step would move every number by a whole rate."""
        squares = refinement.carry(self.squares)
        for name, shrink in refinement.shrinks.items():
            squares[name] = mi.TensorXf(squares[name].array * dr.opaque(mi.Float, shrink**2), squares[name].shape)
        self.reals, self.squares = refinement.reals, squares


def descend(
    values: mi.Float, squares: mi.Float, slope: mi.Float, rate: float, memory: float
) -> tuple[mi.Float, mi.Float]:
    """Values and running means of squared derivatives after a step of ``rate`` where there is a derivative."""
    square = dr.square(slope)
    mean = dr.select(squares == 0, square, dr.fma(memory, squares - square, square))
    touched = mean > 0
    step = dr.opaque(mi.Float, rate) * slope * dr.rsqrt(dr.select(touched, mean, 1))
    return dr.select(touched, values - step, values), dr.select(slope == 0, squares, mean)
