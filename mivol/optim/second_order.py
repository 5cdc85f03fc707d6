r"""Curvature-based optimizers: L-BFGS and Gauss-Newton, each with bounds and a projected line search.

Conventions. The reals form a float64 vector, each parameter in units of the learning rate (:class:`Packing`). Every iteration
renders with the same random numbers.

A filtered pixel averages transmittance, not optical depth. Absorption is therefore linear only along a single ray, since -log
of a pixel mean is not the mean of -log. Gauss-Newton linearises the pixel mean:

.. math:: (J^T W J + R'' + \mu D)\, p = -(J^T W r + R'), \qquad u \leftarrow P(u + \alpha p),

J v and J^T w come from forward and reverse mode of the integrator, and D = diag(J^T W J 1).

References: Nocedal and Wright 2006; Bertsekas 1982; Erdogan and Fessler 1999; Hestenes and Stiefel 1952.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import mitsuba as mi
import numpy as np

from mivol.optim.optimizer import Optimizer, OptimizerRun
from mivol.optim.problem import BoundedProblem, LinearizableProblem, Reals
from mivol.optim.strategy import setting


class Packing:
    """Conversion of reals to a float64 vector, each parameter in units of the learning rate, and back."""

    def __init__(self, problem: BoundedProblem, reals: Reals) -> None:
        self.parts = [(p.name, p.lr, tuple(reals[p.name].shape)) for p in problem.parameters]
        self.low = self._repeat([p.bounds()[0] / p.lr for p in problem.parameters])
        self.high = self._repeat([p.bounds()[1] / p.lr for p in problem.parameters])

    def _repeat(self, ends: list[float]) -> np.ndarray:
        return np.concatenate([np.full(int(np.prod(s)), e) for e, (_, _, s) in zip(ends, self.parts, strict=True)])

    def vector(self, tensors: Reals, power: int = -1) -> np.ndarray:
        """Vector of tensors; ``power`` -1 for points, +1 for gradients."""
        flat = [np.asarray(tensors[name]).ravel().astype(np.float64) * lr**power for name, lr, _ in self.parts]
        return np.concatenate(flat)

    def tensors(self, vector: np.ndarray) -> Reals:
        """Tensors of the vector of a point."""
        parts, start = {}, 0
        for name, lr, shape in self.parts:
            size = int(np.prod(shape))
            part = vector[start : start + size] * lr
            parts[name] = mi.TensorXf(part.astype(np.float32).reshape(shape))
            start += size
        return parts

    def project(self, x: np.ndarray) -> np.ndarray:
        """The nearest point inside the bounds."""
        return np.clip(x, self.low, self.high)

    def free(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """False at a bound against which the gradient presses (Bertsekas 1982, Eq. 32)."""
        return ~(((x <= self.low) & (g > 0.0)) | ((x >= self.high) & (g < 0.0)))


def search_line(
    value: Callable[[np.ndarray], float], packing: Packing, x: np.ndarray, f: float, g: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, float]:
    """Armijo's rule along the projected path P(x + alpha p), alpha = 1, 1/2, 1/4, ... 2^-9.

    Returns:
        The first point with f(new) <= f + 1e-4 g.(new - x), and alpha; (x, 0) without such a point.

    References: Bertsekas 1982, SIAM J. Control Optim. 20(2), Eq. 37.
    """
    for halving in range(10):
        alpha = 0.5**halving
        new = packing.project(x + alpha * p)
        if value(new) <= f + 1e-4 * float(g @ (new - x)):
            return new, alpha
    return x, 0.0


class Lbfgs(Optimizer, tag="lbfgs"):
    """Limited-memory BFGS on the free variables, with a projected line search and the same samples in every iteration.

    SciPy's L-BFGS-B keeps its memory out of reach of a checkpoint. Source: Nocedal and Wright 2006, Algorithm 7.4 (two loops);
    bounds: Bertsekas 1982.
    """

    cites = ("liu_1989",)

    memory: Annotated[int, setting("pair", "number of stored steps", ge=1, le=100)] = 10

    def begin(self, problem: BoundedProblem) -> OptimizerRun:
        return LbfgsRun(self, problem)


class LbfgsRun(OptimizerRun):
    """State: the reals, and the pairs (step, change of gradient)."""

    def __init__(self, settings: Lbfgs, problem: BoundedProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.steps: list[np.ndarray] = []
        self.changes: list[np.ndarray] = []
        self.last: tuple[np.ndarray, np.ndarray] | None = None

    def step(self, iteration: int, factor: float) -> float:
        packing = Packing(self.problem, self.reals)
        measured, gradients = self.problem.loss_and_gradient(self.reals, 0)
        loss = float(measured)
        x, g = packing.vector(self.reals), packing.vector(gradients, 1)
        steps, changes = self._remember(x, g)
        free = packing.free(x, g)
        p = -apply_inverse_hessian(g * free, [s * free for s in steps], [y * free for y in changes]) * factor
        if not g @ p < 0.0:
            p = -g * free / max(np.abs(g * free).max(), 1e-300)
        new, alpha = search_line(lambda z: self.problem.loss_value(packing.tensors(z), 0), packing, x, loss, g, p)
        if alpha == 0.0 or not p.any():
            # The stored curvature misled the search: drop it once, and stop if the search fails without it.
            self.stop_reason = "" if steps else "no step lowers the loss"
            steps, changes, x, g = [], [], None, None
        self.steps, self.changes, self.last = steps, changes, None if x is None else (x, g)
        self.reals = packing.tensors(new)
        return loss

    def _remember(self, x: np.ndarray, g: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The stored pairs with the latest pair, if its curvature is positive beyond rounding."""
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


def apply_inverse_hessian(g: np.ndarray, steps: list[np.ndarray], changes: list[np.ndarray]) -> np.ndarray:
    """H g for the limited-memory inverse Hessian H; without pairs, g scaled to a largest entry of 1."""
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


class GaussNewton(Optimizer, tag="gauss_newton"):
    """Gauss-Newton on pixel means, with conjugate gradients, Levenberg-Marquardt damping and projection onto the bounds.

    Source: Nocedal and Wright 2006, sections 10.3 and 7.1; D is the separable surrogate of Erdogan and Fessler 1999,
    Eq. 21, exact for media that only absorb, whose J has one sign.
    """

    cites = ("hestenes_1952", "erdogan_1999")

    inner: Annotated[int, setting("iteration", "conjugate-gradient steps per linearisation", ge=1)] = 6
    damping: Annotated[float, setting("1", "first damping, relative to the diagonal of the curvature", ge=0)] = 1e-3

    def begin(self, problem: LinearizableProblem) -> OptimizerRun:
        return GaussNewtonRun(self, problem)


class GaussNewtonRun(OptimizerRun):
    """State: the reals and the damping."""

    def __init__(self, settings: GaussNewton, problem: LinearizableProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.damping = settings.damping
        problem.check_linearizable()

    def step(self, iteration: int, factor: float) -> float:
        packing = Packing(self.problem, self.reals)
        linear = self.problem.linearize(self.reals)
        x, g = packing.vector(self.reals), packing.vector(linear.gradient, 1)
        free = packing.free(x, g)

        def curvature(v: np.ndarray) -> np.ndarray:
            return packing.vector(linear.curvature(packing.tensors(v)), 1)

        diagonal = np.abs(curvature(np.ones_like(x)))
        # A voxel that no ray meets has no curvature and no gradient: the floor avoids 0 / 0 and leaves the voxel unchanged.
        diagonal = np.maximum(diagonal, 1e-6 * diagonal.max() + 1e-300)
        p = conjugate_gradients(
            lambda v: free * (curvature(free * v) + self.damping * diagonal * v),
            -g * free, diagonal, self.settings.inner,
        )  # fmt: skip
        new, alpha = search_line(
            lambda z: self.problem.loss_value(packing.tensors(z), 0), packing, x, linear.loss, g, factor * p
        )
        self.damping = self.damping / 3.0 if alpha == 1.0 else max(4.0 * self.damping, 1e-6)
        self.stop_reason = "no step lowers the loss" if self.damping > 1e6 or not p.any() else ""
        self.reals = packing.tensors(new)
        return linear.loss

    def pack(self) -> dict[str, np.ndarray]:
        return super().pack() | {"damping": np.array(self.damping)}

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        super().unpack(arrays)
        self.damping = float(arrays["damping"])


def conjugate_gradients(
    apply: Callable[[np.ndarray], np.ndarray], b: np.ndarray, diagonal: np.ndarray, iterations: int
) -> np.ndarray:
    """Solve A x = b for A >= 0 from 0, with Jacobi preconditioner; stops early when the residual is rounding error.

    References: Hestenes and Stiefel 1952; Nocedal and Wright 2006, Algorithm 5.3.
    """
    x, r = np.zeros_like(b), b.copy()
    z = r / diagonal
    d, rz = z.copy(), float(r @ z)
    stop = 1e-12 * rz
    for _ in range(iterations):
        if rz <= stop:
            break
        image = apply(d)
        bend = float(d @ image)
        if bend <= 0.0:
            break
        x += rz / bend * d
        r -= rz / bend * image
        z = r / diagonal
        rz, before = float(r @ z), rz
        d = z + rz / before * d
    return x
