r"""What the noise of a render does to a loss, told from two halves of its samples, and taken out again.

.. math:: E[f(\bar I)] = f(E[\bar I]) + \tfrac12 f''\,\mathrm{var}(\bar I) + \dots, \qquad \bar I = \sum_k w_k I_k

Conventions. :math:`I_k` are renders of independent seeds with the shares :math:`w_k = n_k / n` of a pixel's samples, f is
the penalty of a pixel. Their variances are :math:`n/n_k` times that of the mean, so that

.. math:: b = \sum_k w_k f(I_k) - f(\bar I), \qquad
    E[b] = \tfrac12 f''\,\mathrm{var}(\bar I)\,\big(\textstyle\sum_k w_k n/n_k - 1\big) = \tfrac12 f''\,\mathrm{var}(\bar I)
    \quad (k = 1, 2)

measures the bias with samples that are paid for anyway, and f - b has none: exactly for a squared loss, where two equal
halves give the product :math:`(I_1 - R)(I_2 - R)`, and to first order in 1/n for a smooth one.

References: Quenouille 1956, Biometrika 43 (the jackknife, here of two groups).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.optim.losses import Loss
from mivol.scene.readings import is_scattering
from mivol.scene.session import Session
from mivol.scene.survey import survey_scene

NOTABLE = 0.05
"""Share of a loss that may be noise before a fit says so."""


@dataclass(frozen=True)
class Comparison:
    """A render beside its reference.

    Attributes:
        loss: mean penalty; without the render's noise where the loss takes pairs.
        noise: estimate of what the noise adds to the mean penalty of the mean image; 0 for a single render.
        adjoint: derivative of ``loss`` by the mean image.
    """

    loss: float
    noise: float
    adjoint: mi.TensorXf


def compare_with_reference(
    loss: Loss, renders: Sequence[mi.TensorXf], shares: Sequence[float], reference: mi.TensorXf, weight: float = 1.0
) -> Comparison:
    r"""Compare one render, or two of independent seeds, with a reference.

    Args:
        loss: one of LOSSES; ``loss.pairs`` takes the noise out.
        renders: one or two images (height, width, channels).
        shares: of the samples, by render; they sum to 1.
        reference: same shape.
        weight: factor on loss, noise and adjoint.

    Returns:
        Loss, its noise, and the adjoint. Carried back by samples that are independent of the renders, J^T adjoint is the
        gradient of the loss without noise, in the mean and to the order to which ``loss`` is unbiased; for a squared loss
        exactly, with and without pairs, whose adjoints are the same.

    Bias: var(I) f''/2 plainly. With pairs none for "l2" and "relative_l2", of order 1/n^2 for smooth penalties; where |r|
        of "l1" is below the noise s, 0.8 s becomes 0.47 s. The reference's own noise stays.
    Variance: of a pixel's squared loss with Gaussian noise s^2 and residual r: 4 r^2 s^2 + 2 s^4 plainly, 4 r^2 s^2 +
        4 s^4 with pairs.
    Cost: the penalty of three images in place of one; no sample more.
    """
    mean = dr.detach(sum(share * image for share, image in zip(shares, renders, strict=True)))
    image = mi.TensorXf(mean)
    dr.enable_grad(image)
    value = loss(image, reference)
    noise = 0.0
    if len(renders) > 1:
        halves = (share * loss(image + dr.detach(part - mean), reference) for share, part in zip(shares, renders, strict=True))
        bias = sum(halves) - value
        noise = float(bias[0]) * weight
        value = value - bias if loss.pairs else value
    value = value * weight
    dr.backward(value)
    return Comparison(float(value[0]), noise, dr.detach(dr.grad(image)))


def split_samples(spp: int, loss: Loss) -> tuple[int, ...]:
    """Samples per pixel of the renders that a noisy image is made of: two halves, as nearly as can be.

    Raises:
        MivolError: the loss takes pairs, and there is a single sample.
    """
    if spp > 1:
        return spp - spp // 2, spp // 2
    if loss.pairs:
        raise MivolError("loss.pairs splits a pixel's samples in two, and fit.spp is 1: set fit.spp to 2 or more.")
    return (spp,)


def make_noise_check(integrator: mi.Integrator, scene: mi.Scene) -> Callable[[], bool]:
    """A question to ask of the scene's present values: do images hold more noise than that of rays' places in a pixel?

    Mivol's do where light may be sampled: with matter that scatters or surfaces that are lit, at depth 2 or more. Those
    of all other integrators may.
    """
    session = getattr(integrator, "session", None)
    if not isinstance(session, Session):
        return lambda: True
    if session.settings.scatterings == 0:
        return lambda: False
    survey = survey_scene(scene)
    if survey.surfaces:
        return lambda: True
    if session.settings.deterministic:
        return lambda: False

    def scatters() -> bool:
        views = ((b.view(survey.places), b.name) for b in survey.boundaries)
        return any(is_scattering(view, survey, name) for view, name in views)

    return scatters


def describe_noise(loss: Loss, value: float, noise: float) -> str:
    """What a reader of the loss must know of its noise, with its size, or "".

    Args:
        loss: what is minimised.
        value: its mean over the views.
        noise: the part of ``value`` that is noise; nan where it is not known.
    """
    if loss.pairs or (not math.isnan(noise) and abs(noise) <= NOTABLE * abs(value)):
        return ""
    if math.isnan(noise):
        return f'the render\'s noise is part of the loss "{loss.label()}", and fit.spp = 1 does not tell how much: set it to 2.'
    sloped = "its gradient is not biased" if loss.is_squared else "its gradient is biased too"
    return (
        f'the render\'s noise makes up {noise:.2g} of the loss "{loss.label()}" of {value:.2g}, {noise / value:.0%} '
        f"({sloped}): set loss.pairs = true to take it out with the same samples, or raise fit.spp, with which it falls as 1/n."
    )
