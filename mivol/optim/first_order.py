"""Gradient-based optimizers: Adam, RMSprop without momentum, and the optimizers of ``mi.ad``. OPTIMIZERS lists all by name.

Conventions. A step changes each real number by a multiple of the learning rate. RMSprop leaves a number and the running mean
unchanged where the derivative is 0: a batch of rays reaches few rows of a sparse field, and the other rows keep their means.

References: Kingma and Ba 2015 (Adam); Hinton 2012 (RMSprop; Coursera, lecture 6e).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.kernel_recording import RecordedFunctions
from mivol.optim.optimizer import FirstOrder, Optimizer, OptimizerRun
from mivol.optim.problem import DifferentiableProblem, Reals, Refinement
from mivol.optim.second_order import GaussNewton, Lbfgs
from mivol.optim.strategy import check_strategy, make_table, setting


class Adam(FirstOrder, tag="adam"):
    """Mitsuba's Adam (``mi.ad.Adam``), with a learning rate and a projection for each parameter.

    ``epsilon`` is relative to the largest gradient of the first step. Behind dense matter gradients vanish, and an absolute
    1e-8 would let Adam follow rounding noise at the full rate. Source: Kingma and Ba 2015, Algorithm 1.
    """

    cites = ("kingma_2015",)

    beta_1: Annotated[float, setting("1", "memory of the gradient", ge=0, lt=1)] = 0.9
    beta_2: Annotated[float, setting("1", "memory of the squared gradient", ge=0, lt=1)] = 0.999
    epsilon: Annotated[float, setting("largest gradient", "gradients well below this value cause small steps", gt=0)] = 1e-6

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
        self.adam.step(eval=False)
        moved = self.problem.after_step({name: dr.detach(value) for name, value in self.adam.items()}, iteration)
        dr.eval(moved)  # and the moments, in the same kernels
        for name, value in moved.items():
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
        """Carry both moments over to the new unknowns; the count of steps, which corrects them, continues."""
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
"""Factor on stored fourth roots. A half has 11 bits from 2^-14 to 2^16, and fewer bits down to 2^-24. Derivatives with a root
mean square between 1e-12 and 1e6 [loss / real] keep full precision, and those above 1e-18 are stored. Smaller ones are lost:
the next derivative then moves the number by a whole learning rate, as a first derivative does."""

LARGEST = 65504.0
"""The largest half. A larger root is stored as this value, so a derivative above 1e6 takes a step above the rate."""

LONGEST_MEMORY = 0.98
"""The longest memory of means in half precision. Rounding changes a mean by at most 4 x 2^-11 = 0.2 % a step. With a longer
memory the share 1 - memory of a step would be less than ten times the rounding, and means would not follow."""


class RMSprop(FirstOrder, tag="rmsprop"):
    """RMSprop without momentum. Numbers without a derivative stay; the first squared derivative begins the running mean.

    A row of a field is reached by a few views at a time. Momentum from earlier views would pull the row away. Source: Hinton
    2012, lecture 6e.
    """

    memory: Annotated[float, setting("1", "memory of the running mean of squared derivatives", ge=0, lt=1)] = 0.95
    half: Annotated[bool, setting("1", "store the running means as fourth roots in half precision")] = False

    def begin(self, problem: DifferentiableProblem) -> OptimizerRun:
        """Start from the problem's present values.

        Raises:
            MivolError: a memory too long for means in half precision.
        """
        if self.half and self.memory > LONGEST_MEMORY:
            raise MivolError(
                f"found memory = {self.memory:g} with half = true, expected at most {LONGEST_MEMORY:g}: running means in half "
                "precision could not follow; lower the memory or set half = false."
            )
        return RMSpropRun(self, problem)


class RMSpropRun(OptimizerRun):
    """State: the reals, and the running means of their squared derivatives as stored (0: no derivative yet)."""

    def __init__(self, settings: RMSprop, problem: DifferentiableProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.squares = {name: self._store(dr.zeros(mi.TensorXf, value.shape)) for name, value in self.reals.items()}
        self._recorded = RecordedFunctions()

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, slopes = self.problem.loss_and_gradient(self.reals, iteration, self.settings.views)
        rates = {name: dr.opaque(mi.Float, rate * factor) for name, rate in self.problem.learning_rates(iteration).items()}
        moves = getattr(self.problem, "moves_after_step", lambda iteration: [])(iteration)
        given = self.settings.memory, self.settings.half, self.reals, self.squares, slopes, rates
        if moves:
            reals, squares = self._recorded.call(descend_and_move, *given, *moves[0])
        else:
            # Evaluated with the step: a later move would hold a second copy of the reals.
            reals, squares = descend_and_move(*given, self.problem.after_step, (iteration,))
        del slopes, given  # as large as the reals
        for function, arguments in moves[1:]:
            reals = self._recorded.call(function, reals, *arguments)
        self.reals, self.squares = reals, squares
        return loss

    def warning(self) -> str:
        return self._recorded.describe_failure()

    def _store(self, means: mi.TensorXf) -> mi.TensorXf | mi.TensorXf16:
        return store_means(means, self.settings.half)

    def _load(self, held: mi.TensorXf | mi.TensorXf16) -> mi.TensorXf:
        return load_means(held)

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
        self.squares = {**self.squares, name: self._store(dr.zeros(mi.TensorXf, reals.shape))}

    def refine(self, refinement: Refinement) -> None:
        """Carry the squares over to the new unknowns: without them, the first step would move every number by a whole rate.

        The old reals are released first, since the carried means need as much memory.
        """
        self.reals = refinement.reals
        means = refinement.carry({name: self._load(held) for name, held in self.squares.items()})
        for name, shrink in refinement.derivative_factors.items():
            means[name] = mi.TensorXf(means[name].array * dr.opaque(mi.Float, shrink**2), means[name].shape)
        self.squares = {name: self._store(mean) for name, mean in means.items()}
        dr.eval(self.squares)


def descend_and_move(
    memory: float,
    half: bool,
    reals: Reals,
    squares: Reals,
    slopes: Reals,
    rates: dict[str, mi.Float],
    move: Callable[..., Reals],
    arguments: tuple[Any, ...],
) -> tuple[Reals, Reals]:
    """Reals and running means after a step and a move (``move(reals, *arguments)``), in the same kernels."""
    moved, means = {}, {}
    for name, value in reals.items():
        found = descend(value.array, load_means(squares[name]).array, slopes[name].array, rates[name], memory)
        moved[name], mean = (mi.TensorXf(array, value.shape) for array in found)
        means[name] = store_means(mean, half)
    # Squares and reals share terms: scheduled here, both are evaluated in the same kernels.
    dr.schedule(means)
    moved = move(moved, *arguments)
    dr.eval(moved, means)
    return moved, means


def store_means(means: mi.TensorXf, half: bool) -> mi.TensorXf | mi.TensorXf16:
    """Running means in the precision of a fit."""
    return to_halves(means) if half else means


def load_means(held: mi.TensorXf | mi.TensorXf16) -> mi.TensorXf:
    """Running means from :func:`store_means`."""
    return from_halves(held) if isinstance(held, mi.TensorXf16) else held


def to_halves(means: mi.TensorXf) -> mi.TensorXf16:
    """Running means as fourth roots in half precision, scaled by ``UNIT``."""
    roots = dr.minimum(UNIT * dr.sqrt(dr.sqrt(means.array)), LARGEST)
    return mi.TensorXf16(mi.Float16(roots), means.shape)


def from_halves(roots: mi.TensorXf16) -> mi.TensorXf:
    """Running means from :func:`to_halves`, to 0.2 % of each."""
    return mi.TensorXf(dr.square(dr.square(mi.Float(roots.array) * (1 / UNIT))), roots.shape)


def descend(
    values: mi.Float, squares: mi.Float, slope: mi.Float, rate: mi.Float | float, memory: float
) -> tuple[mi.Float, mi.Float]:
    """Values and running means of squared derivatives after a step of ``rate``, where the derivative is not 0."""
    square = dr.square(slope)
    mean = dr.select(squares == 0, square, dr.fma(memory, squares - square, square))
    touched = mean > 0
    step = rate * slope * dr.rsqrt(dr.select(touched, mean, 1))
    return dr.select(touched, values - step, values), dr.select(slope == 0, squares, mean)


OPTIMIZERS = make_table(Adam, RMSprop, Lbfgs, GaussNewton)
"""Optimizers available in files."""


class MitsubaOptimizer(Optimizer, tag="given", kw_only=True):
    """An optimizer of ``mi.ad`` with separate learning rates.

    Mivol cannot save the optimizer's state, and the fit has no checkpoint.
    """

    optimizer: Any

    def begin(self, problem: DifferentiableProblem) -> OptimizerRun:
        return MitsubaOptimizerRun(self, problem)


class MitsubaOptimizerRun(OptimizerRun):
    """State: the reals, and the state of the Mitsuba optimizer."""

    def __init__(self, settings: MitsubaOptimizer, problem: DifferentiableProblem) -> None:
        super().__init__(problem)
        self.optimizer = settings.optimizer
        self.optimizer.update(self.reals)
        self.rates = {name: self.optimizer.learning_rate(name) for name in self.reals}

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, gradients = self.problem.loss_and_gradient(self.reals, iteration)
        if factor != 1.0:
            self.optimizer.set_learning_rate({name: rate * factor for name, rate in self.rates.items()})
        for name, gradient in gradients.items():
            dr.enable_grad(self.optimizer[name])
            dr.set_grad(self.optimizer[name], gradient)
        self.optimizer.step()
        stepped = {name: dr.detach(self.optimizer[name]) for name in self.reals}
        self.reals = self.problem.after_step(stepped, iteration)
        for name, value in self.reals.items():
            self.optimizer[name] = value
        return loss

    def pack(self) -> dict[str, np.ndarray]:
        raise MivolError(
            f"mivol cannot save the state of {type(self.optimizer).__name__} in a checkpoint: leave checkpoint out, or "
            "choose one of mivol's optimizers."
        )

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        super().replace(name, reals)
        self.optimizer[name] = reals
        self.optimizer.reset(name)


def to_optimizer(given: Optimizer | mi.ad.Optimizer) -> Optimizer:
    """An optimizer of mivol unchanged; an optimizer of ``mi.ad`` in its adapter.

    Raises:
        MivolError: an object of another type, or as :func:`mivol.optim.strategy.check_strategy`.
    """
    if isinstance(given, type | Optimizer):
        return check_strategy(given)
    if hasattr(given, "begin"):
        return given
    if not isinstance(given, mi.ad.Optimizer):
        raise MivolError(
            f"found {type(given).__name__}, expected an optimizer of mivol or of mi.ad, or an object with begin(problem)."
        )
    return MitsubaOptimizer(optimizer=given)
