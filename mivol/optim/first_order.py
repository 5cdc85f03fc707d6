"""Optimizers that follow gradients: Adam, and RMSprop without momentum.

Conventions. A step changes each real number by a multiple of its learning rate. RMSprop leaves a number and its running mean
unchanged where the derivative is 0: a batch of rays reaches few rows of a sparse field, and the other rows keep their means.

References: Kingma and Ba 2015 (Adam); Hinton 2012 (RMSprop; Coursera, lecture 6e).
"""

from __future__ import annotations

from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.optimizer import FirstOrder, OptimizerRun
from mivol.optim.problem import DifferentiableProblem, Reals, Refinement
from mivol.optim.strategy import setting


class Adam(FirstOrder, tag="adam"):
    """Mitsuba's Adam (``mi.ad.Adam``), with each parameter's own learning rate and projection.

    ``epsilon`` is taken relative to the largest gradient of the first step: behind dense matter gradients vanish, and
    an absolute 1e-8 would have Adam walk at full pace on rounding noise. Source: Kingma and Ba 2015, Algorithm 1.
    """

    cites = ("kingma_2015",)

    beta_1: Annotated[float, setting("1", "memory of the gradient", ge=0, lt=1)] = 0.9
    beta_2: Annotated[float, setting("1", "memory of its square", ge=0, lt=1)] = 0.999
    epsilon: Annotated[float, setting("largest gradient", "gradients well below this hardly move anything", gt=0)] = 1e-6

    def begin(self, problem: DifferentiableProblem) -> OptimizerRun:
        return AdamRun(self, problem)


class AdamRun(OptimizerRun):
    """State: the reals, Adam's two moments and step count, and the gradient scale of the first step."""

    def __init__(self, settings: Adam, problem: DifferentiableProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.scale = 0.0
        self.adam = mi.ad.Adam(lr=1.0, beta_1=settings.beta_1, beta_2=settings.beta_2, epsilon=settings.epsilon)
        self.adam.update(self.reals)

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, gradients = self.problem.loss_and_gradient(self.reals, iteration, self.settings.views)
        self.scale = self.scale or max(float(dr.max(dr.abs(g.array))[0]) for g in gradients.values()) or 1.0
        for name, rate in self.problem.learning_rates(iteration).items():
            self.adam.set_learning_rate({name: rate * factor})
            dr.set_grad(self.adam[name], gradients[name] / self.scale)
        self.adam.step()
        for name, value in self.problem.after_step(dict(self.adam.items()), iteration).items():
            self.adam[name] = value
        self.reals = {name: dr.detach(value) for name, value in self.adam.items()}
        return loss

    def pack(self) -> dict[str, np.ndarray]:
        arrays = super().pack() | {"scale": np.array(self.scale)}
        for name, (_, _, _, (count, first, second, _)) in self.adam.state.items():
            moments = {"count": count, "first": first, "second": second}
            arrays |= {f"{kind}/{name}": np.array(value) for kind, value in moments.items()}
        return arrays

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        super().unpack(arrays)
        self.scale = float(arrays["scale"])
        for name, value in self.reals.items():
            self.adam[name] = value
            kept, promoted, rate, _ = self.adam.state[name]
            moments = (mi.Float(arrays[f"{kind}/{name}"]) for kind in ("first", "second"))
            self.adam.state[name] = kept, promoted, rate, (mi.UInt32(arrays[f"count/{name}"]), *moments, None)

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        super().replace(name, reals)
        self.adam[name] = reals
        self.adam.reset(name)
        self.scale = 0.0

    def refine(self, refinement: Refinement) -> None:
        """Both moments are carried over like the reals; the count of steps, by which they are corrected, goes on."""
        states = {name: self.adam.state[name][3] for name in self.reals}
        shapes = {name: value.shape for name, value in self.reals.items()}
        moments = [
            refinement.carry({name: mi.TensorXf(state[which], shapes[name]) for name, state in states.items()})
            for which in (1, 2)
        ]
        self.reals = dict(refinement.reals)
        for name, value in self.reals.items():
            self.adam[name] = value
            kept, promoted, rate, _ = self.adam.state[name]
            shrink = refinement.derivative_factors.get(name, 1.0)
            first, second = (tensors[name].array * shrink**power for power, tensors in enumerate(moments, 1))
            self.adam.state[name] = kept, promoted, rate, (states[name][0], first, second, None)


UNIT = 64.0
"""Fourth roots are held times this. A half has 11 bits from 2^-14 to 2^16, and fewer down to 2^-24: derivatives whose root mean
square is between 1e-12 and 1e6 [loss / real] keep their precision, and from 1e-18 on they are known. Smaller ones are
forgotten: the next such derivative moves its number by a whole rate, as the first does."""

LARGEST = 65504.0
"""The largest half. Larger roots are held as this: steps against derivatives above 1e6 are longer than the rate, not 0."""

LONGEST_MEMORY = 0.98
"""The longest memory of means that are held in halves. These are rounded by at most 4 x 2^-11 = 0.2 % a step; with a longer
memory the 1 - memory that a step adds would not be ten times as much, and means would stay where they were."""


class RMSprop(FirstOrder, tag="rmsprop"):
    """RMSprop without momentum, on the numbers that have a derivative; the first derivative is its own mean.

    Rows of a field are touched by a few views at a time, and what a row remembers of others pulls it away (measured on the
    chair at 32^3, 400 steps: 25.7 dB so, 21.0 dB with Adam's momentum). Source: Hinton 2012, lecture 6e.
    """

    memory: Annotated[float, setting("1", "of the running mean of squared derivatives", ge=0, lt=1)] = 0.95
    half: Annotated[bool, setting("1", "these means take half the memory, as fourth roots in half precision")] = False

    def begin(self, problem: DifferentiableProblem) -> OptimizerRun:
        """Start from the values that the problem holds.

        Raises:
            MivolError: a memory too long for means in half precision.
        """
        if self.half and self.memory > LONGEST_MEMORY:
            raise MivolError(
                f"means in half precision were asked for with a memory of {self.memory:g}, which they would not follow: "
                f"at most {LONGEST_MEMORY:g} is expected, or half = false."
            )
        return RMSpropRun(self, problem)


class RMSpropRun(OptimizerRun):
    """State: the reals, and the running means of their squared derivatives (0: there was none yet) as they are held."""

    def __init__(self, settings: RMSprop, problem: DifferentiableProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.squares = {name: self._held(dr.zeros(mi.TensorXf, value.shape)) for name, value in self.reals.items()}

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, slopes = self.problem.loss_and_gradient(self.reals, iteration, self.settings.views)
        rates = self.problem.learning_rates(iteration)
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
            known, slope = self._known(self.squares[name]).array, slopes[name].array
            moved = descend(value.array, known, slope, rates[name], self.settings.memory)
            reals[name], means = (mi.TensorXf(array, value.shape) for array in moved)
            squares[name] = self._held(means)
        return reals, squares

    def _held(self, means: mi.TensorXf) -> mi.TensorXf | mi.TensorXf16:
        return halved(means) if self.settings.half else means

    def _known(self, held: mi.TensorXf | mi.TensorXf16) -> mi.TensorXf:
        return from_halves(held) if self.settings.half else held

    def pack(self) -> dict[str, np.ndarray]:
        return super().pack() | {f"{self._key}/{name}": np.array(value) for name, value in self.squares.items()}

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        super().unpack(arrays)
        tensor = mi.TensorXf16 if self.settings.half else mi.TensorXf
        self.squares = {name: tensor(arrays[f"{self._key}/{name}"]) for name in self.reals}

    @property
    def _key(self) -> str:
        return "roots" if self.settings.half else "squares"

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        super().replace(name, reals)
        self.squares = {**self.squares, name: self._held(dr.zeros(mi.TensorXf, reals.shape))}

    def refine(self, refinement: Refinement) -> None:
        """Squares are carried over like the reals: without them the first step would move every number by a whole rate.

        The old reals are let go first: means are as large while they are carried over.
        """
        self.reals = refinement.reals
        means = refinement.carry({name: self._known(held) for name, held in self.squares.items()})
        for name, shrink in refinement.derivative_factors.items():
            means[name] = mi.TensorXf(means[name].array * dr.opaque(mi.Float, shrink**2), means[name].shape)
        self.squares = {name: self._held(mean) for name, mean in means.items()}
        dr.eval(self.squares)


def halved(means: mi.TensorXf) -> mi.TensorXf16:
    """Running means as fourth roots in half precision, which have the range for it (``UNIT``)."""
    roots = dr.minimum(UNIT * dr.sqrt(dr.sqrt(means.array)), LARGEST)
    return mi.TensorXf16(mi.Float16(roots), means.shape)


def from_halves(roots: mi.TensorXf16) -> mi.TensorXf:
    """Running means from what :func:`halved` gave, to 0.2 % of each."""
    return mi.TensorXf(dr.square(dr.square(mi.Float(roots.array) * (1 / UNIT))), roots.shape)


def descend(values: mi.Float, squares: mi.Float, slope: mi.Float, rate: float, memory: float) -> tuple[mi.Float, mi.Float]:
    """Values and running means of squared derivatives after a step of ``rate`` where there is a derivative."""
    square = dr.square(slope)
    mean = dr.select(squares == 0, square, dr.fma(memory, squares - square, square))
    touched = mean > 0
    step = dr.opaque(mi.Float, rate) * slope * dr.rsqrt(dr.select(touched, mean, 1))
    return dr.select(touched, values - step, values), dr.select(slope == 0, squares, mean)
