r"""Fits of scenes to images: real numbers in, loss and derivatives out, through any Mitsuba integrator.

.. math:: f(u) = \frac{1}{V}\sum_v \mathrm{loss}(I_v(x(u)), I_v^{ref}) + \sum_k \mathrm{energy}_k(x(u))

Conventions. ``u`` are the reals of each :class:`~mivol.optim.parameters.Parameter`, ``x`` the scene's values. An image is the
mean of passes of at most ``samples_per_pass`` samples. The adjoint of the loss is evaluated at the whole image and carried back
pass by pass, and non-linear losses do not depend on the number of passes. If light is sampled, an image is the mean of two
renders with independent seeds, whose difference measures the noise in the loss. Seeds are a function of (seed, iteration,
batch, purpose, half, pass) only. ``safe_point`` is called between passes; until the return, only ``newest_loss`` may have
changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import SupportsFloat

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.losses import L2, FunctionLoss, Loss, to_loss
from mivol.optim.parameters import Parameter, as_tensor, check_names, find_key, to_type_of
from mivol.optim.problem import LinearizableProblem, Reals, Refinement
from mivol.optim.scenes.brick_stages import adapt_bricks, bricks_key, check_sparse_parameter
from mivol.optim.scenes.render_noise import (
    RenderDifference,
    RenderLoss,
    compare_with_reference,
    describe_noise,
    make_noise_check,
    split_samples,
)
from mivol.optim.scenes.views import (
    ADJOINT,
    PRIMAL,
    RenderBatch,
    View,
    add_alpha,
    check_views,
    count_pixels,
    derive_seed,
    drop_alpha,
    make_batches,
    make_single_batches,
    remove_alpha,
)
from mivol.scene_graph import put_value, traverse

LARGE_PASS = 1 << 16
"""Samples of a pass for which the host waits. It prepares what follows a smaller pass while the pass is computed."""


@dataclass(repr=False)
class SceneProblem(LinearizableProblem):
    """A scene, reference images, and the parameters to fit.

    Attributes:
        scene: a Mitsuba scene.
        views: sensors with reference images, all of equal size.
        parameters: the parameters to fit.
        integrator: differentiable; None takes the scene's integrator.
        loss: of LOSSES, or a function of image and reference (:class:`mivol.optim.losses.FunctionLoss`).
        spp: samples per pixel of an image, and of its derivative.
        samples_per_pass: maximum samples in one kernel.
        seed: root of all random numbers.
        safe_point: called between kernels.
        noisy: whether images hold noise of sampled light, at the scene's present values.
        sparse: names of the parameters that are sparse grids.
        newest_loss: loss of the latest gradient.
    """

    scene: mi.Scene
    views: Sequence[View]
    parameters: Sequence[Parameter]
    integrator: mi.Integrator | None = None
    loss: Loss = field(default_factory=L2)
    spp: int = 16
    samples_per_pass: int = 1 << 20
    seed: int = 0
    safe_point: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        check_views(self.views)
        self.views = [remove_alpha(view) for view in self.views]
        if not self.parameters:
            raise MivolError("found no parameter to fit: name at least one key of mi.traverse(scene).")
        self.integrator = self.integrator or self.scene.integrator()
        self.params = traverse(self.scene)
        for parameter in self.parameters:
            find_key(parameter.name, self.params)
        check_names([parameter.name for parameter in self.parameters])
        names = [parameter.name for parameter in self.parameters]
        self.sparse = [name for name in names if bricks_key(name) in self.params.keys()]  # noqa: SIM118
        for parameter in self.parameters:
            if parameter.name in self.sparse:
                check_sparse_parameter(parameter)
        owners = {name: self.params.properties[name][2] for name in self.sparse}
        self._counts = {name: owner.mivol_bricks.counts for name, owner in owners.items()}
        self.params.keep([*names, *map(bricks_key, self.sparse)])
        self.loss = to_loss(self.loss)
        alone = isinstance(self.loss, FunctionLoss)
        self.batches = make_single_batches(self.views) if alone else make_batches(self.views, self.samples_per_pass)
        self.newest_loss = RenderLoss()
        self._has_noise = make_noise_check(self.integrator, self.scene)
        self.noisy = self._has_noise()

    def __repr__(self) -> str:
        width, height = (int(n) for n in self.views[0].sensor.film().crop_size())
        parameters = ", ".join(f"{p.name} {tuple(as_tensor(self.params[p.name]).shape)}" for p in self.parameters)
        views = f"{len(self.views)} views of {width} x {height} pixels"
        return f"{type(self).__name__}({views}, {self.loss.label()}, fits {parameters})"

    # -- Values ---------------------------------------------------------------------------------------------------

    def values(self) -> Reals:
        """The scene's present values by parameter."""
        return {p.name: dr.detach(as_tensor(self.params[p.name])) for p in self.parameters}

    def gradients(self) -> Reals:
        """Sum of the derivatives from all renders since :meth:`set_reals`, by parameter.

        Raises:
            MivolError: the images do not depend on a parameter.
        """
        gradients = {}
        for p in self.parameters:
            gradient = dr.detach(dr.grad(self.params[p.name]))
            if _is_untouched(gradient):
                raise missing_derivative_error(p.name)
            gradients[p.name] = as_tensor(gradient)
        return gradients

    def initial_reals(self) -> Reals:
        """Reals of the scene's present values.

        Raises:
            MivolError: a value lies outside the domain of its parameter.
        """
        return {p.name: p.to_reals(value) for p, value in zip(self.parameters, self.values().values(), strict=True)}

    def set_reals(self, reals: Reals) -> None:
        """Set the scene's values to x(u), ready to receive gradients."""
        for p in self.parameters:
            value = to_type_of(dr.detach(p.from_reals(reals[p.name])), self.params[p.name])
            dr.make_opaque(value)
            dr.enable_grad(value)
            self.params[p.name] = value
        values = {p.name: type(self.params[p.name])(self.params[p.name]) for p in self.parameters}
        self.params.update()
        # Mitsuba's envmap puts another array into the parameters: restore the attached array.
        for name, value in values.items():
            put_value(self.params, name, value)
        # An extinction alone does not make a medium scatter.
        if any("sigma_t" not in p.name.split(".") for p in self.parameters):
            self.noisy = self._has_noise()

    # -- Sparse grids ---------------------------------------------------------------------------------------------

    def brick_counts(self) -> dict[str, tuple[int, int, int]]:
        """Bricks (Z, Y, X) of the box of each sparse grid among the parameters, by name."""
        return self._counts

    def brick_numbers(self, name: str) -> np.ndarray:
        """Ascending numbers of the stored bricks of a sparse grid."""
        return np.array(self.params[bricks_key(name)], dtype=np.int64)

    def set_brick_numbers(self, name: str, numbers: np.ndarray) -> None:
        """Store other bricks with the values of the next :meth:`set_reals`."""
        self.params[bricks_key(name)] = mi.UInt32(numbers.astype(np.uint32))

    def adapt_bricks(self, reals: Reals, iteration: int, threshold: float) -> Refinement:
        """As :func:`mivol.optim.scenes.brick_stages.adapt_bricks`."""
        return adapt_bricks(self, reals, iteration, threshold)

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """The bricks of sparse grids."""
        return {f"bricks/{name}": self.brick_numbers(name) for name in self.sparse}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        for name in self.sparse:
            self.set_brick_numbers(name, arrays[f"bricks/{name}"])

    # -- Images ---------------------------------------------------------------------------------------------------

    def passes(self, sensor: mi.Sensor, spp: int) -> list[int]:
        """Samples per pixel of each pass; they sum to ``spp`` and differ by at most 1."""
        limit = max(self.samples_per_pass // count_pixels(sensor), 1)
        n = math.ceil(spp / limit)
        return [spp // n + (i < spp % n) for i in range(n)]

    def seed_for(self, iteration: int, index: int, purpose: int) -> int:
        """Seed of a batch, by number."""
        return derive_seed(self.seed, iteration, index, purpose)

    def render(self, sensor: mi.Sensor, seed: int, spp: int | None = None) -> mi.TensorXf:
        """Mean image of a sensor over all passes, detached; with the problem's ``spp`` by default."""
        total, spp = None, spp or self.spp
        for number, share in enumerate(self.passes(sensor, spp)):
            with dr.suspend_grad():
                image = self.integrator.render(self.scene, sensor, seed=derive_seed(seed, number), spp=share)
                total = image * share if total is None else total + image * share
            self._finish(total, share * count_pixels(sensor))
        return drop_alpha(total / spp, sensor)

    def images(self, count: int = 3) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Name, reference and present render of the first views, for notebooks."""
        views = self.views[:count]
        return [(view.name, np.array(view.reference), np.array(self.render(view.sensor, self.seed))) for view in views]

    def vjp(self, sensor: mi.Sensor, adjoint: mi.TensorXf, seed: int) -> None:
        """Add J^T adjoint of a sensor's image to the gradients of the scene's parameters."""
        adjoint = add_alpha(adjoint, sensor)
        for number, spp in enumerate(self.passes(sensor, self.spp)):
            with require_derivative(", ".join(p.name for p in self.parameters)):
                self.integrator.render_backward(
                    self.scene, self.params, adjoint * (spp / self.spp), sensor, derive_seed(seed, number), spp
                )
            self._finish(self.gradients(), spp * count_pixels(sensor))

    def jvp(self, sensor: mi.Sensor, tangents: Reals, seed: int) -> mi.TensorXf:
        """J v of a sensor's image, for a direction v of the scene's parameters."""
        total = None
        for number, spp in enumerate(self.passes(sensor, self.spp)):
            self._set_tangents(tangents)
            image = self.integrator.render_forward(self.scene, self.params, sensor, derive_seed(seed, number), spp)
            total = dr.detach(image) * spp if total is None else total + dr.detach(image) * spp
            self._finish(total, spp * count_pixels(sensor))
        return drop_alpha(total / self.spp, sensor)

    def _set_tangents(self, tangents: Reals) -> None:
        """Set the tangents, before each render: some integrators consume tangents."""
        for p in self.parameters:
            value = self.params[p.name]
            dr.set_grad(value, to_type_of(tangents[p.name], value))

    def _finish(self, arrays: object, samples: int) -> None:
        """Launch the kernels of a pass; wait for a large pass, since an interrupt acts between passes."""
        dr.eval(arrays)
        if samples >= LARGE_PASS:
            dr.sync_thread()
        self.safe_point()

    # -- Loss and gradient ----------------------------------------------------------------------------------------

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[SupportsFloat, Reals]:
        """f(u) and the gradient over ``views`` views, drawn anew in each iteration; 0 takes all views.

        Image and derivative have independent seeds: an estimate of d(I^2) = 2 I dI from the same samples is biased.
        Noise: from the integrator; absorbing media have only the noise of the pixel filter. Effect on the loss:
        :func:`mivol.optim.scenes.render_noise.compare_with_reference`.
        """
        batches = self.batches
        if views:
            chosen = draw_views(iteration, len(self.views), views, self.seed)
            batches = make_single_batches([self.views[index] for index in chosen])
        self.set_reals(reals)
        n_views, compared = sum(batch.n_views for batch in batches), []
        for index, batch in enumerate(batches):
            compared.append(self.compare(batch, self.seed_for(iteration, index, PRIMAL), n_views))
            self.vjp(batch.sensor, compared[-1].adjoint, self.seed_for(iteration, index, ADJOINT))
        energies, gradients = self.through_priors_and_maps(reals, self.gradients())
        return self.remember(compared, energies), gradients

    def rehearse(self) -> None:
        """Compute the derivative of the first batch, to raise errors of a first step early; the scene holds its start
        afterwards.

        Raises:
            MivolError: an error of the integrator or the loss, or images that do not depend on a parameter.
        """
        start, batch = self.initial_reals(), self.batches[0]
        self.set_reals(start)
        compared = self.compare(batch, self.seed_for(0, 0, PRIMAL), len(self.views))
        self.vjp(batch.sensor, compared.adjoint, self.seed_for(0, 0, ADJOINT))
        self.set_reals(start)

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Learning rate of each parameter, the same in all iterations."""
        return {p.name: p.lr for p in self.parameters}

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        """The nearest points of the domains; priors are part of the gradient."""
        return {p.name: p.project(reals[p.name]) for p in self.parameters}

    def loss_value(self, reals: Reals, iteration: int) -> float:
        """f(u), without derivatives."""
        self.set_reals(reals)
        return self.mean_loss(iteration) + self.energy(reals)

    def mean_loss(self, iteration: int) -> float:
        """Mean loss over all views, at the scene's present values."""
        pairs = enumerate(self.batches)
        return math.fsum(self.compare(s, self.seed_for(iteration, i, PRIMAL), len(self.views)).loss for i, s in pairs)

    def compare(self, batch: RenderBatch, seed: int, n_views: int) -> RenderDifference:
        """Render a batch; returns the part of the mean loss over ``n_views`` views.

        Raises:
            MivolError: a loss with pairs, for a noisy render with a sample per pixel.
        """
        parts = split_samples(self.spp, self.loss) if self.noisy else (self.spp,)
        if len(parts) == 1:
            renders = [self.render(batch.sensor, seed)]
        else:
            renders = [self.render(batch.sensor, derive_seed(seed, half), spp) for half, spp in enumerate(parts)]
        return compare_with_reference(
            self.loss, renders, [n / self.spp for n in parts], batch.reference, batch.n_views / n_views
        )

    def remember(self, compared: Sequence[RenderDifference], energies: Sequence[mi.Float] = ()) -> RenderLoss:
        """The sum of the batches' losses and of priors, stored for :meth:`warning`."""
        self.newest_loss = RenderLoss([c.view for c in compared], energies, is_noise_known=not (self.noisy and self.spp == 1))
        return self.newest_loss

    # -- Curvature ------------------------------------------------------------------------------------------------

    @cached_property
    def weights(self) -> list[mi.TensorXf]:
        """Weights W of a quadratic loss, by batch."""
        return [self.loss.weight(batch.reference) for batch in self.batches]

    def check_linearizable(self) -> None:
        """Check that the loss is quadratic.

        Raises:
            MivolError: the loss is not quadratic.
        """
        self.loss.weight(self.batches[0].reference)

    def linearize(self, reals: Reals) -> SceneLinearization:
        """The problem around ``reals``, with the random numbers of iteration 0."""
        return SceneLinearization(self, reals)

    @property
    def warning(self) -> Callable[[], str]:
        loss, newest = self.loss, self.newest_loss
        return lambda: describe_noise(loss, newest.of_views, newest.noise)

    def energy(self, reals: Reals) -> float:
        """Sum of weighted prior energies."""
        return math.fsum(float(p.energy(p.from_reals(dr.detach(reals[p.name])))[0]) for p in self.parameters)

    def through_priors_and_maps(self, reals: Reals, gradients: Reals) -> tuple[list[mi.Float], Reals]:
        """Energies of the priors, and the gradients by the reals for given gradients by the values."""
        energies, by_reals = [], {}
        for p in self.parameters:
            u = mi.TensorXf(dr.detach(reals[p.name]))
            dr.enable_grad(u)
            value = p.from_reals(u)
            energy = p.energy(value)
            energies.append(dr.detach(energy))
            dr.set_grad(value, gradients[p.name])
            dr.enqueue(dr.ADMode.Backward, value)
            if dr.grad_enabled(energy):
                dr.set_grad(energy, 1)
                dr.enqueue(dr.ADMode.Backward, energy)
            dr.traverse(dr.ADMode.Backward)
            by_reals[p.name] = dr.grad(u)
        dr.eval(by_reals, energies)
        return energies, by_reals


class SceneLinearization:
    """A scene's problem around one point u: loss, gradient, and products with J^T W J + R''.

    Images, J and J^T use the same samples. The gradient has samples of its own if light is sampled.

    Attributes:
        loss: f(u).
        gradient: derivative of the loss by the reals.
    """

    def __init__(self, problem: SceneProblem, reals: Reals) -> None:
        self.problem, self.reals = problem, reals
        self.seeds = [problem.seed_for(0, index, PRIMAL) for index in range(len(problem.batches))]
        self.slopes = {p.name: p.map_derivative(reals[p.name]) for p in problem.parameters}
        self.loss, gradients = self.differentiate_images()
        energies, self.gradient = problem.through_priors_and_maps(reals, gradients)
        self.loss += math.fsum(float(energy[0]) for energy in energies)

    def differentiate_images(self) -> tuple[float, Reals]:
        """Loss of the images, and the derivative by the values."""
        problem, compared = self.problem, []
        problem.set_reals(self.reals)
        for index, (batch, seed) in enumerate(zip(problem.batches, self.seeds, strict=True)):
            compared.append(problem.compare(batch, seed, len(problem.views)))
            # The noise of an image and of a derivative from the same samples is correlated, which would bias J^T W r.
            own = problem.seed_for(0, index, ADJOINT) if problem.noisy else seed
            problem.vjp(batch.sensor, compared[-1].adjoint, own)
        return float(problem.remember(compared)), problem.gradients()

    def curvature(self, direction: Reals) -> Reals:
        """(J^T W J + R'') direction."""
        direction = {k: t * self.slopes[k] for k, t in direction.items()}
        product = self.curve_images(direction)
        for p in self.problem.parameters:
            value = dr.detach(p.from_reals(self.reals[p.name]))
            for prior in p.priors:
                product[p.name] += prior.curvature(value, direction[p.name], p.spacing(value.shape))
        return {k: t * self.slopes[k] for k, t in product.items()}

    def curve_images(self, direction: Reals) -> Reals:
        """J^T W J direction, for a direction of the values."""
        images = self._jvp(direction)
        self.problem.set_reals(self.reals)
        for batch, weight, seed, image in zip(self.problem.batches, self.problem.weights, self.seeds, images, strict=True):
            share = batch.n_views / len(self.problem.views) / len(image.array)
            self.problem.vjp(batch.sensor, weight * image * share, seed)
        return self.problem.gradients()

    def _jvp(self, direction: Reals) -> list[mi.TensorXf]:
        self.problem.set_reals(self.reals)
        pairs = zip(self.problem.batches, self.seeds, strict=True)
        return [self.problem.jvp(batch.sensor, direction, seed) for batch, seed in pairs]


def missing_derivative_error(names: str) -> MivolError:
    """The error for parameters on which no image depends."""
    return MivolError(
        f"the images do not depend on {names}, which would keep its start: remove the parameter from the fit, or make the "
        "images depend on it (set fit.max_depth to 2 or more for scattered light, choose an integrator that renders media)."
    )


@contextmanager
def require_derivative(names: str) -> Iterator[None]:
    """Replace Dr.Jit's error for an image without parameters by a readable error.

    Raises:
        MivolError: the image depends on no parameter.
    """
    try:
        yield
    except RuntimeError as error:
        if "does not depend on the input variable" not in str(error):
            raise
        raise missing_derivative_error(names) from None


def draw_views(iteration: int, n_views: int, per_iteration: int, seed: int) -> list[int]:
    """Numbers of the views of an iteration, in a new random order per epoch; a function of the arguments only."""
    per_iteration = min(per_iteration, n_views)
    drawn = range(iteration * per_iteration, (iteration + 1) * per_iteration)
    orders = {k: np.random.default_rng([seed, k, n_views]).permutation(n_views) for k in {i // n_views for i in drawn}}
    return [int(orders[i // n_views][i % n_views]) for i in drawn]


def _is_untouched(gradient: object) -> bool:
    """Whether a gradient is the literal 0 of Dr.Jit, without contributions."""
    rows = [gradient.array] if dr.is_tensor_v(gradient) else gradient if dr.depth_v(gradient) > 1 else [gradient]
    return all(row.state == dr.VarState.Literal for row in rows)
