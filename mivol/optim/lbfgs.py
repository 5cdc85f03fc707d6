"""L-BFGS with bounds.

References: Nocedal and Wright 2006; Bertsekas 1982.
"""

from __future__ import annotations

from typing import Annotated

import mitsuba as mi
import numpy as np

from mivol.optim.optimiser import Optimiser, Run
from mivol.optim.packing import Packing, search
from mivol.optim.scene_problem import SceneProblem
from mivol.optim.strategy import of


class Lbfgs(Optimiser, tag="lbfgs"):
    """Limited-memory BFGS on the free variables, with a projected line search and the same samples in every iteration.

    SciPy's L-BFGS-B keeps its memory between iterations where no checkpoint can reach it; hence these forty lines.
    Source: Nocedal and Wright 2006, Algorithm 7.4 (two loops); bounds: Bertsekas 1982.
    """

    cites = ("liu_1989",)

    memory: Annotated[int, of("pair", "steps remembered", ge=1, le=100)] = 10

    def begin(self, problem: SceneProblem) -> Run:
        return LbfgsRun(self, problem)


class LbfgsRun(Run):
    """State: the reals, and the pairs (step, change of gradient)."""

    def __init__(self, settings: Lbfgs, problem: SceneProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.steps: list[np.ndarray] = []
        self.changes: list[np.ndarray] = []
        self.last: tuple[np.ndarray, np.ndarray] | None = None

    def step(self, iteration: int, factor: float) -> float:
        packing = Packing(self.problem, self.reals)
        loss, gradients = self.problem.loss_and_gradient(self.reals, 0)
        x, g = packing.vector(self.reals), packing.vector(gradients, 1)
        steps, changes = self._remember(x, g)
        free = packing.free(x, g)
        p = -two_loops(g * free, [s * free for s in steps], [y * free for y in changes]) * factor
        if not g @ p < 0.0:
            p = -g * free / max(np.abs(g * free).max(), 1e-300)
        new, alpha = search(lambda z: self.problem.loss_value(packing.tensors(z), 0), packing, x, loss, g, p)
        if alpha == 0.0 or not p.any():
            # The remembered curvature misled the search: forget it once, and give up where it is not to blame.
            self.finished = "" if steps else "no step lowers the loss"
            steps, changes, x, g = [], [], None, None
        self.steps, self.changes, self.last = steps, changes, None if x is None else (x, g)
        self.reals = packing.tensors(new)
        return loss

    def _remember(self, x: np.ndarray, g: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The pairs with the newest one, if its curvature is positive beyond rounding."""
        if self.last is None:
            return self.steps, self.changes
        s, y = x - self.last[0], g - self.last[1]
        if not s @ y > 1e-10 * np.linalg.norm(s) * np.linalg.norm(y):
            return self.steps, self.changes
        keep = self.settings.memory
        return [*self.steps, s][-keep:], [*self.changes, y][-keep:]

    def pack(self) -> dict[str, np.ndarray]:
        arrays = super().pack() | {"pairs": np.array([self.steps, self.changes])}
        return arrays if self.last is None else arrays | {"last": np.array(self.last)}

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        super().unpack(arrays)
        self.steps, self.changes = (list(half) for half in arrays["pairs"])
        self.last = tuple(arrays["last"]) if "last" in arrays else None

    def replace(self, name: str, reals: mi.TensorXf) -> None:
        super().replace(name, reals)
        self.steps, self.changes, self.last = [], [], None


def two_loops(g: np.ndarray, steps: list[np.ndarray], changes: list[np.ndarray]) -> np.ndarray:
    """H g for the limited-memory inverse Hessian H; without pairs, g scaled so that its largest entry is 1."""
    pairs = [(s, y, 1.0 / (s @ y)) for s, y in zip(steps, changes, strict=True) if s @ y > 0.0]
    if not pairs:
        return g / max(np.abs(g).max(), 1e-300)
    q, weights = g.copy(), []
    for s, y, rho in reversed(pairs):
        weights.append(rho * (s @ q))
        q -= weights[-1] * y
    s, y, _ = pairs[-1]
    q *= (s @ y) / (y @ y)
    for (s, y, rho), weight in zip(pairs, reversed(weights), strict=True):
        q += s * (weight - rho * (y @ q))
    return q
