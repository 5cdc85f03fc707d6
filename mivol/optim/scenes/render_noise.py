r"""Noise of a render in a loss: measured from two halves of the samples, and removed on request.

.. math:: E[f(\bar I)] = f(E[\bar I]) + \tfrac12 f''\,\mathrm{var}(\bar I) + \dots, \qquad \bar I = \sum_k w_k I_k

Conventions. :math:`I_k` are renders with independent seeds and the shares :math:`w_k = n_k / n` of a pixel's samples; f is the
penalty of a pixel. The variance of :math:`I_k` is :math:`n/n_k` times the variance of the mean, so

.. math:: b = \sum_k w_k f(I_k) - f(\bar I), \qquad
    E[b] = \tfrac12 f''\,\mathrm{var}(\bar I)\,\big(\textstyle\sum_k w_k n/n_k - 1\big) = \tfrac12 f''\,\mathrm{var}(\bar I)
    \quad (k = 1, 2)

estimates the bias without additional samples. f - b has no bias: exactly for a squared loss, where two equal halves give the
product :math:`(I_1 - R)(I_2 - R)`, and to first order in 1/n for a smooth loss.

References: Quenouille 1956, Biometrika 43 (the jackknife, here with two groups).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.optim.losses import Loss
from mivol.scene.readings import is_scattering
from mivol.scene.session import Session
from mivol.scene.survey import survey_scene

NOTABLE = 0.05
"""Share of noise in a loss above which a fit logs a message."""


@dataclass(frozen=True)
class ViewLoss:
    """The loss of a render. The host reads mean and noise at the first access, which waits for the render.

    Attributes:
        value: Float, ``mean`` on the device.
        bias: Float, the noise on the device without the weight; None for a single render.
        weight: factor on the noise.
    """

    value: mi.Float
    bias: mi.Float | None
    weight: float

    @cached_property
    def mean(self) -> float:
        """Mean penalty; without the render's noise if the loss takes pairs."""
        return float(self.value[0])

    @cached_property
    def noise(self) -> float:
        """Estimated contribution of the noise to the mean penalty of the mean image; 0 for a single render."""
        return 0.0 if self.bias is None else float(self.bias[0]) * self.weight


@dataclass(frozen=True)
class RenderDifference:
    """The difference between a render and its reference.

    Attributes:
        view: mean penalty and its noise.
        adjoint: derivative of ``loss`` by the mean image.
    """

    view: ViewLoss
    adjoint: mi.TensorXf

    @property
    def loss(self) -> float:
        """Mean penalty; waits for the render."""
        return self.view.mean

    @property
    def noise(self) -> float:
        """Noise in the mean penalty; waits for the render."""
        return self.view.noise


@dataclass(frozen=True)
class RenderLoss:
    """The loss of a fit, of its views and of its priors; ``float(loss)`` waits for the renders.

    Attributes:
        views: losses of the batches of views.
        energies: energies of priors, arrays of one number.
        is_noise_known: whether the noise of the renders was measured.
    """

    views: Sequence[ViewLoss] = ()
    energies: Sequence[mi.Float] = ()
    is_noise_known: bool = True

    def __float__(self) -> float:
        return self.of_views + math.fsum(float(energy[0]) for energy in self.energies)

    @property
    def of_views(self) -> float:
        """The loss without the priors."""
        return math.fsum(view.mean for view in self.views)

    @property
    def noise(self) -> float:
        """Noise in the loss; nan if unknown."""
        return math.fsum(view.noise for view in self.views) if self.is_noise_known else math.nan


def compare_with_reference(
    loss: Loss, renders: Sequence[mi.TensorXf], shares: Sequence[float], reference: mi.TensorXf, weight: float = 1.0
) -> RenderDifference:
    r"""Compare a render, or two renders with independent seeds, with a reference.

    Args:
        loss: of LOSSES; ``loss.pairs`` removes the noise.
        renders: 1 or 2 images (height, width, channels).
        shares: share of the samples of each render, with a sum of 1.
        reference: same shape.
        weight: factor on loss, noise and adjoint.

    Returns:
        Loss, its noise, and the adjoint. With samples independent of the renders, the mean of J^T adjoint is the gradient of
        the loss without noise, to the order to which ``loss`` is unbiased. For a squared loss this is exact, with and without
        pairs, whose adjoints are equal.

    Bias: var(I) f''/2 without pairs. With pairs none for "l2" and "relative_l2", of order 1/n^2 for smooth penalties; for |r|
        of "l1" below the noise s, 0.8 s becomes 0.47 s. The reference's own noise stays.
    Variance: of a pixel's squared loss with Gaussian noise s^2 and residual r: 4 r^2 s^2 + 2 s^4 without pairs, 4 r^2 s^2 +
        4 s^4 with pairs.
    Cost: the penalty of three images instead of a single image; no additional sample.
    """
    mean = dr.detach(sum(share * image for share, image in zip(shares, renders, strict=True)))
    image = mi.TensorXf(mean)
    dr.enable_grad(image)
    value = loss(image, reference)
    bias = None
    if len(renders) > 1:
        halves = (share * loss(image + dr.detach(part - mean), reference) for share, part in zip(shares, renders, strict=True))
        bias = sum(halves) - value
        value = value - bias if loss.pairs else value
    value = value * weight
    dr.backward(value)
    value, adjoint = dr.detach(value), dr.detach(dr.grad(image))
    bias = None if bias is None else dr.detach(bias)
    dr.eval(value, bias, adjoint)
    return RenderDifference(ViewLoss(value, bias, weight), adjoint)


def split_samples(spp: int, loss: Loss) -> tuple[int, ...]:
    """Samples per pixel of the renders of a noisy image: two nearly equal halves.

    Raises:
        MivolError: the loss takes pairs, and a pixel has a single sample.
    """
    if spp > 1:
        return spp - spp // 2, spp // 2
    if loss.pairs:
        raise MivolError("loss.pairs needs two samples per pixel, found fit.spp = 1: set fit.spp to 2 or more.")
    return (spp,)


def make_noise_check(integrator: mi.Integrator, scene: mi.Scene) -> Callable[[], bool]:
    """A function of the scene's present values: do images hold noise besides the noise of pixel sampling?

    Images of mivol's integrators do if light is sampled: with scattering matter or lit surfaces, at depth 2 or more. Images of
    all other integrators may.
    """
    session = getattr(integrator, "session", None)
    if not isinstance(session, Session):
        return lambda: True
    if session.settings.scatterings == 0:
        return lambda: False
    survey = survey_scene(scene)
    if survey.facts.surfaces:
        return lambda: True
    if session.settings.deterministic:
        return lambda: False

    def scatters() -> bool:
        views = ((b.view(survey.grids), b.name) for b in survey.boundaries)
        return any(is_scattering(view, survey, name) for view, name in views)

    return scatters


def describe_noise(loss: Loss, value: float, noise: float) -> str:
    """A sentence about the noise in a loss, with the size, or "".

    Args:
        loss: the loss to minimise.
        value: the mean over the views.
        noise: noise in ``value``; nan if unknown.
    """
    if loss.pairs or (not math.isnan(noise) and abs(noise) <= NOTABLE * abs(value)):
        return ""
    if math.isnan(noise):
        return f'the loss "{loss.label()}" contains the render\'s noise, of unknown size at fit.spp = 1: set fit.spp to 2.'
    gradient = "the gradient has no bias" if loss.is_squared else "the gradient is biased too"
    return (
        f'the render\'s noise contributes {noise:.2g} to the loss "{loss.label()}" of {value:.2g}, {noise / value:.0%} '
        f"({gradient}): set loss.pairs = true to remove the noise with the same samples, or raise fit.spp (noise ~ 1/spp)."
    )
