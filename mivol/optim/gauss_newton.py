r"""Gauss-Newton on pixel means.

A filtered pixel averages transmittance, not optical depth, so that absorption is linear only along a pencil ray
(-log of a pixel mean is not the mean of -log): Gauss-Newton therefore linearises the pixel mean itself,

.. math:: (J^T W J + R'' + \mu D)\, p = -(J^T W r + R'), \qquad u \leftarrow P(u + \alpha p),

with J v and J^T w from forward and reverse mode of the integrator, D = diag(J^T W J 1) and conjugate gradients inside.

References: Nocedal and Wright 2006; Erdogan and Fessler 1999; Hestenes and Stiefel 1952.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.optim.optimiser import Optimiser, Run
from mivol.optim.packing import Packing, search
from mivol.optim.parameters import Parameter
from mivol.optim.problem import Reals
from mivol.optim.scene_problem import SceneProblem
from mivol.optim.seeds import ADJOINT, PRIMAL
from mivol.optim.strategy import of


class GaussNewton(Optimiser, tag="gauss_newton"):
    """Gauss-Newton on pixel means, conjugate gradients inside, Levenberg-Marquardt damping, projection onto the bounds.

    Source: Nocedal and Wright 2006, sections 10.3 and 7.1; D is the separable surrogate of Erdogan and Fessler 1999,
    Eq. 21, exact for media that only absorb, whose J has one sign.
    """

    cites = ("hestenes_1952", "erdogan_1999")

    inner: Annotated[int, of("iteration", "conjugate-gradient steps per linearisation", ge=1)] = 6
    damping: Annotated[float, of("1", "first mu, relative to D", ge=0)] = 1e-3

    def begin(self, problem: SceneProblem) -> Run:
        return GaussNewtonRun(self, problem)


class GaussNewtonRun(Run):
    """State: the reals and the damping. Image, J and J^T use the same samples in every iteration: one set of them, and
    another for the gradient where light is sampled."""

    def __init__(self, settings: GaussNewton, problem: SceneProblem) -> None:
        super().__init__(problem)
        self.settings = settings
        self.damping = settings.damping
        self.weights = [problem.loss.weight(batch.reference) for batch in problem.batches]

    def step(self, iteration: int, factor: float) -> float:
        packing = Packing(self.problem, self.reals)
        linear = Linearised(self.problem, self.reals, self.weights, packing)
        x, g = packing.vector(self.reals), linear.gradient
        free = packing.free(x, g)
        diagonal = np.abs(linear.curvature(np.ones_like(x)))
        # A voxel that no ray meets has no curvature and no gradient: the floor keeps it where it is, not at 0 / 0.
        diagonal = np.maximum(diagonal, 1e-6 * diagonal.max() + 1e-300)
        p = conjugate_gradients(
            lambda v: free * (linear.curvature(free * v) + self.damping * diagonal * v),
            -g * free, diagonal, self.settings.inner,
        )  # fmt: skip
        new, alpha = search(lambda z: self.problem.loss_value(packing.tensors(z), 0), packing, x, linear.loss, g, factor * p)
        self.damping = self.damping / 3.0 if alpha == 1.0 else max(4.0 * self.damping, 1e-6)
        self.finished = "no step lowers the loss" if self.damping > 1e6 or not p.any() else ""
        self.reals = packing.tensors(new)
        return linear.loss

    def pack(self) -> dict[str, np.ndarray]:
        return super().pack() | {"damping": np.array(self.damping)}

    def unpack(self, arrays: dict[str, np.ndarray]) -> None:
        super().unpack(arrays)
        self.damping = float(arrays["damping"])


class Linearised:
    """The problem around one point: loss, gradient, and products with J^T W J + R''.

    Attributes:
        loss: f(u).
        gradient: by the vector of ``packing``.
    """

    def __init__(self, problem: SceneProblem, reals: Reals, weights: list[mi.TensorXf], packing: Packing) -> None:
        self.problem, self.reals, self.weights, self.packing = problem, reals, weights, packing
        self.seeds = [problem.seed_for(0, index, PRIMAL) for index in range(len(problem.batches))]
        self.slopes = {p.name: slope(p, reals[p.name]) for p in problem.parameters}
        problem.set(reals)
        compared = []
        for index, (batch, seed) in enumerate(zip(problem.batches, self.seeds, strict=True)):
            compared.append(problem.compare(batch, seed, len(problem.views)))
            # The noise of an image and of a derivative from the same samples is correlated: that would bias J^T W r.
            own = problem.seed_for(0, index, ADJOINT) if problem.noisy else seed
            problem.vjp(batch.sensor, compared[-1].adjoint, own)
        energy, gradients = problem.through_priors_and_maps(reals, problem.gradients())
        self.loss = problem.remember(compared) + energy
        self.gradient = packing.vector(gradients, 1)

    def curvature(self, v: np.ndarray) -> np.ndarray:
        """(J^T W J + R'') v."""
        direction = {k: t * self.slopes[k] for k, t in self.packing.tensors(v).items()}
        images = self._jvp(direction)
        self.problem.set(self.reals)
        for batch, weight, seed, image in zip(self.problem.batches, self.weights, self.seeds, images, strict=True):
            share = batch.n_views / len(self.problem.views) / len(image.array)
            self.problem.vjp(batch.sensor, weight * image * share, seed)
        product = self.problem.gradients()
        for p in self.problem.parameters:
            value = dr.detach(p.from_reals(self.reals[p.name]))
            for prior in p.priors:
                product[p.name] += prior.curvature(value, direction[p.name], p.spacing(value.shape))
        return self.packing.vector({k: t * self.slopes[k] for k, t in product.items()}, 1)

    def _jvp(self, direction: Reals) -> list[mi.TensorXf]:
        self.problem.set(self.reals)
        pairs = zip(self.problem.batches, self.seeds, strict=True)
        return [self.problem.jvp(batch.sensor, direction, seed) for batch, seed in pairs]


def slope(parameter: Parameter, u: mi.TensorXf) -> mi.TensorXf:
    """dx/du of a parameter's map, entry by entry."""
    u = mi.TensorXf(dr.detach(u))
    dr.enable_grad(u)
    dr.backward(dr.sum(parameter.from_reals(u).array))
    return dr.grad(u)


def conjugate_gradients(
    apply: Callable[[np.ndarray], np.ndarray], b: np.ndarray, diagonal: np.ndarray, iterations: int
) -> np.ndarray:
    """x with A x = b for A >= 0, Jacobi-preconditioned, from 0; stops early where the residual is rounding.

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
