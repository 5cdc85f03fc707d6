"""Adam, with each parameter's own learning rate.

References: Kingma and Ba 2015.
"""

from __future__ import annotations

from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.optim.optimiser import FirstOrder, Run
from mivol.optim.problem import Differentiable, Refinement
from mivol.optim.strategy import of


class Adam(FirstOrder, tag="adam"):
    """Mitsuba's Adam (``mi.ad.Adam``), with each parameter's own learning rate and projection.

    ``epsilon`` is taken relative to the largest gradient of the first step: behind dense matter gradients vanish, and
    an absolute 1e-8 would have Adam walk at full pace on rounding noise. Source: Kingma and Ba 2015, Algorithm 1.
    """

    cites = ("kingma_2015",)

    beta_1: Annotated[float, of("1", "memory of the gradient", ge=0, lt=1)] = 0.9
    beta_2: Annotated[float, of("1", "memory of its square", ge=0, lt=1)] = 0.999
    epsilon: Annotated[float, of("largest gradient", "gradients well below this hardly move anything", gt=0)] = 1e-6

    def begin(self, problem: Differentiable) -> Run:
        return AdamRun(self, problem)


class AdamRun(Run):
    """State: the reals, Adam's two moments and step count, and the gradient scale of the first step."""

    def __init__(self, settings: Adam, problem: Differentiable) -> None:
        super().__init__(problem)
        self.settings = settings
        self.scale = 0.0
        self.adam = mi.ad.Adam(lr=1.0, beta_1=settings.beta_1, beta_2=settings.beta_2, epsilon=settings.epsilon)
        self.adam.update(self.reals)

    def step(self, iteration: int, factor: float) -> float | mi.Float:
        loss, gradients = self.problem.loss_and_gradient(self.reals, iteration, self.settings.views)
        self.scale = self.scale or max(float(dr.max(dr.abs(g.array))[0]) for g in gradients.values()) or 1.0
        for name, rate in self.problem.rates(iteration).items():
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
            shrink = refinement.shrinks.get(name, 1.0)
            first, second = (tensors[name].array * shrink**power for power, tensors in enumerate(moments, 1))
            self.adam.state[name] = kept, promoted, rate, (states[name][0], first, second, None)
