"""All reals of a problem as one vector, and a search along a line of such vectors that keeps to the domain."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from mivol.optim.problem import Reals
from mivol.optim.scene_problem import SceneProblem


class Packing:
    """All reals as one float64 vector, each parameter in units of its learning rate, and back."""

    def __init__(self, problem: SceneProblem, reals: Reals) -> None:
        self.parts = [(p.name, p.lr, tuple(reals[p.name].shape)) for p in problem.parameters]
        self.low = self._repeat([p.bounds()[0] / p.lr for p in problem.parameters])
        self.high = self._repeat([p.bounds()[1] / p.lr for p in problem.parameters])

    def _repeat(self, ends: list[float]) -> np.ndarray:
        return np.concatenate([np.full(int(np.prod(s)), e) for e, (_, _, s) in zip(ends, self.parts, strict=True)])

    def vector(self, tensors: Reals, power: int = -1) -> np.ndarray:
        """Tensors -> vector; ``power`` -1 for points, +1 for gradients."""
        flat = [np.asarray(tensors[name]).ravel().astype(np.float64) * lr**power for name, lr, _ in self.parts]
        return np.concatenate(flat)

    def tensors(self, vector: np.ndarray, power: int = 1) -> Reals:
        """Vector -> tensors; ``power`` +1 for points, -1 for gradients."""
        parts, start = {}, 0
        for name, lr, shape in self.parts:
            size = int(np.prod(shape))
            part = vector[start : start + size] * lr**power
            parts[name] = mi.TensorXf(part.astype(np.float32).reshape(shape))
            start += size
        return parts

    def project(self, x: np.ndarray) -> np.ndarray:
        """The nearest point inside the bounds."""
        return np.clip(x, self.low, self.high)

    def free(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """False where a bound is met and the gradient presses against it (Bertsekas 1982, Eq. 32)."""
        return ~(((x <= self.low) & (g > 0.0)) | ((x >= self.high) & (g < 0.0)))


def search(
    value: Callable[[np.ndarray], float], packing: Packing, x: np.ndarray, f: float, g: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, float]:
    """Armijo's rule along the projected path P(x + alpha p), alpha = 1, 1/2, 1/4, ... 2^-9.

    Returns:
        The first point with f(new) <= f + 1e-4 g.(new - x), and alpha; (x, 0) where none has it.

    References: Bertsekas 1982, SIAM J. Control Optim. 20(2), Eq. 37.
    """
    for halving in range(10):
        alpha = 0.5**halving
        new = packing.project(x + alpha * p)
        if value(new) <= f + 1e-4 * float(g @ (new - x)):
            return new, alpha
    return x, 0.0
