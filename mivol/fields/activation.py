"""The map from a stored density to an extinction, applied after interpolation.

Conventions. A medium's density is physical and needs no activation; a fitted radiance field chooses among ``ACTIVATIONS``.
With ``relu`` a signed density has a surface at its zero crossing, anywhere between two nodes; clamping the nodes would put the
surface on nodes. Values are extinctions [1/length].

Quadrature. Along a ray the interpolated density is a cubic in each cell, which two Gauss points integrate exactly. An
activated density is no cubic, and a ReLU has a kink at 0. The table has the relative error (rms) of the light of 150 rays
through 16^3 nodes of noise: mivol / midpoints (two a cell), for median optical depths of a voxel edge from 0.01 to 10.
Extinctions vary by a factor of e; with relu the densities are normal about 0. The last column is the order of convergence at
an optical depth of 0.1::

              0.01               0.1                1                  10                 order
    none      7.2e-05 / 1.9e-03  4.2e-04 / 2.0e-03  5.1e-03 / 7.5e-03  1.8e-02 / 2.1e-02  4.2
    relu      2.2e-03 / 4.6e-03  2.2e-03 / 4.3e-03  5.0e-03 / 7.6e-03  2.4e-02 / 3.1e-02  2.2
    softplus  1.9e-04 / 3.4e-03  4.3e-04 / 2.1e-03  5.1e-03 / 7.5e-03  1.8e-02 / 2.1e-02  4.2
    exp       2.7e-04 / 3.8e-03  4.3e-04 / 2.4e-03  4.7e-03 / 7.1e-03  1.7e-02 / 2.1e-02  4.1

(``pytest -s tests/analytic/test_activation_quadrature.py``). Smooth activations keep the fourth order; a ReLU has second order
in cells with its surface. From an optical depth of 1 a cell all activations have the same error, since rays end in a layer
thinner than a cell.

References: Karnewar et al. 2022 (ReLU fields: interpolate, then clamp); Barron et al. 2021 (softplus, shifted).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError

MAX_EXPONENT = 60.0
"""exp(60) = 1e26 leaves room for a length and a sum in float32."""


@dataclass(frozen=True)
class Activation:
    """A function of the interpolated density.

    Attributes:
        name: key in ``ACTIVATIONS``.
        value_and_slope: extinction and derivative of a density.
        inverse: density of an extinction above 0.
        signed: whether negative densities are allowed.
        vacuum: density of nodes that are not stored; its extinction is 0, or 2e-9 (exp(-20)).
        empty_below: a cell with all corners at or below this density is vacuum and has no derivatives; None: no cell is.
    """

    name: str
    value_and_slope: Callable[[mi.Float], tuple[mi.Float, mi.Float]]
    inverse: Callable[[float], float]
    signed: bool
    vacuum: float
    empty_below: float | None


def _clamp_below_zero(x: mi.Float) -> tuple[mi.Float, mi.Float]:
    # Interpolation can round 0 to -1e-20.
    return dr.maximum(x, 0), mi.Float(1)


def _relu(x: mi.Float) -> tuple[mi.Float, mi.Float]:
    return dr.maximum(x, 0), dr.select(x > 0, mi.Float(1), 0)


def _softplus(x: mi.Float) -> tuple[mi.Float, mi.Float]:
    # log(1 + u) for u = exp(-|x|) <= 1: 2 atanh(u / (2 + u)) keeps the digits that 1 + u would lose.
    u = dr.exp(-dr.abs(x))
    v = u / (2 + u)
    w = v * v
    series = dr.fma(w, dr.fma(w, dr.fma(w, dr.fma(w, dr.fma(w, 2 / 11, 2 / 9), 2 / 7), 2 / 5), 2 / 3), 2) * v
    return dr.maximum(x, 0) + series, dr.select(x > 0, 1, u) / (1 + u)


def _exponential(x: mi.Float) -> tuple[mi.Float, mi.Float]:
    value = dr.exp(dr.minimum(x, MAX_EXPONENT))
    return value, dr.select(x < MAX_EXPONENT, value, 0)


ACTIVATIONS = {
    a.name: a
    for a in (
        Activation("none", _clamp_below_zero, lambda sigma: sigma, False, 0.0, None),
        Activation("relu", _relu, lambda sigma: sigma, True, 0.0, 0.0),
        Activation("softplus", _softplus, lambda sigma: sigma + math.log(-math.expm1(-sigma)), True, -20.0, None),
        Activation("exp", _exponential, math.log, True, -20.0, None),
    )
}


def select_activation(name: str) -> Activation:
    """The activation of a name.

    Raises:
        MivolError: an unknown name.
    """
    if name not in ACTIVATIONS:
        raise MivolError(f"the activation {name!r} was given; one of {', '.join(ACTIVATIONS)} is expected.")
    return ACTIVATIONS[name]
