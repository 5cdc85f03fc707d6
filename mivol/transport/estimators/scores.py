r"""Scores: how a walked path accumulates radiance, gradients of parameters, or the tangent of the radiance.

The radiance of a path is a sum of terms, each multiplied by the factors in front:

.. math:: L = t_1 + f_1 (t_2 + f_2 (t_3 + \dots))

The walk reports terms and factors to a score, in the order of the path. The three scores are:

* ``Primal`` sums the radiance.
* ``Replay`` (path replay backpropagation) follows a path whose radiance is known. It subtracts each term from ``L``, so ``L``
  is the radiance from further along the path when the walk reports a factor. A term receives d loss / d t = dL, and a factor
  receives d loss / d log f = dL L. After the walk ``L`` is 0, up to rounding.
* ``Tangent`` adds the tangents of terms, and carries the tangent of the logarithm of the product of the factors, f'/f.

Terms and factors compute their own derivatives in reverse mode (vjp) and forward mode (jvp), so a score depends on no
estimator. A factor differentiates its logarithm, so nothing is divided by a factor without a derivative, and never by a
transmittance.

Conventions. The values of terms contain the throughput of the path in front of them, and are 0 in lanes without the term.

References: Vicini et al. 2021 (replay with a running difference); Nimier-David et al. 2020 (adjoint radiance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.media.extinction import take_tangent

__all__ = [
    "FORWARD",
    "IMAGE",
    "REVERSE",
    "Factor",
    "Primal",
    "Replay",
    "Rest",
    "Tangent",
    "Term",
    "TrackedFactor",
    "TrackedTerm",
]


IMAGE, REVERSE, FORWARD = "image", "reverse", "forward"
"""Purposes of a walk: the radiance, the gradients of parameters, or the tangent of the radiance."""


# -- Terms and factors ---------------------------------------------------------------------------------------------------


class Term(Protocol):
    """Radiance added to a path.

    Attributes:
        value: radiance at the camera, without derivatives; 0 in lanes without the term.
        is_replayed: whether a replay finds the same value again, and subtracts the value from the known radiance. False for
            light sampled anew for derivatives.
    """

    value: mi.Spectrum
    is_replayed: bool

    def vjp(self, dL: mi.Spectrum) -> None:
        """Add the derivatives of the value, weighted by ``dL``, to the gradients of the parameters."""

    def jvp(self) -> mi.Spectrum:
        """Tangent of the value, from the tangents of the parameters."""


class Factor(Protocol):
    """A factor on all light from further along the path."""

    def vjp(self, dlog: mi.Spectrum) -> None:
        """Add the derivatives of the factor's logarithm, weighted by ``dlog`` = dL L, to the gradients of the parameters."""

    def jvp(self) -> mi.Spectrum:
        """Tangent of the factor's logarithm."""


class TrackedTerm:
    """A radiance differentiated by Dr.Jit (an emitter seen by the path).

    Args:
        value: radiance, with or without derivatives.
        active: lanes with the term.
    """

    is_replayed = True

    def __init__(self, value: mi.Spectrum, active: mi.Bool) -> None:
        self.attached, self.active = value, active
        self.value = dr.select(active, dr.detach(value), 0)

    def vjp(self, dL: mi.Spectrum) -> None:
        with dr.resume_grad():
            if dr.grad_enabled(self.attached):
                dr.backward_from(dr.select(self.active, dL * self.attached, 0))

    def jvp(self) -> mi.Spectrum:
        with dr.resume_grad():
            tangent = take_tangent(self.attached)
        return dr.select(self.active, tangent, 0)


@dataclass
class TrackedFactor:
    """A factor differentiated by Dr.Jit (a BSDF). A factor of 0 has no logarithm; its derivative counts as 0.

    Attributes:
        evaluate: returns the factor with derivatives; called only for derivatives.
        active: lanes with the factor.
    """

    evaluate: Callable[[], mi.Spectrum]
    active: mi.Bool

    def vjp(self, dlog: mi.Spectrum) -> None:
        with dr.resume_grad():
            value = self.evaluate()
            if dr.grad_enabled(value):
                f = dr.detach(value)
                ratio = dr.select(f != 0, value * dr.rcp(dr.select(f != 0, f, 1)), 0)
                dr.backward_from(dr.select(self.active, dlog * ratio, 0))

    def jvp(self) -> mi.Spectrum:
        with dr.resume_grad():
            value = self.evaluate()
            tangent = take_tangent(value)
        f = dr.detach(value)
        return dr.select(self.active & (f != 0), tangent * dr.rcp(dr.select(f != 0, f, 1)), 0)


# -- Scores --------------------------------------------------------------------------------------------------------------


@dataclass
class Primal:
    """Sum the radiance of a path."""

    L: mi.Spectrum
    purpose = IMAGE

    def add(self, term: Term) -> Primal:
        """The score after a term of the path."""
        return Primal(self.L + term.value)

    def scale(self, factor: Factor) -> Primal:
        """The score after a factor on all light from further along the path; the values of terms contain the factor already."""
        return self


@dataclass
class Rest:
    """Follow a path again, and report the radiance behind each of its factors to a function, without derivatives.

    Attributes:
        L: radiance from further along the path.
        report: called with each factor and the radiance behind the factor.
    """

    L: mi.Spectrum
    report: Callable[[Factor, mi.Spectrum], None]
    purpose = IMAGE

    def add(self, term: Term) -> Rest:
        return Rest(self.L - term.value, self.report)

    def scale(self, factor: Factor) -> Rest:
        self.report(factor, self.L)
        return self


@dataclass
class Replay:
    """Follow a path again, and add the derivatives to the gradients of media, surfaces and emitters.

    Attributes:
        L: radiance from further along the path. A path with a single segment does not need it (None): the only light behind its
            factor is the emission at the end, so the factor waits for this term.
        dL: d loss / d L.
        pending: the waiting factor.
    """

    L: mi.Spectrum | None
    dL: mi.Spectrum
    pending: Factor | None = None
    purpose = REVERSE

    def add(self, term: Term) -> Replay:
        term.vjp(self.dL)
        if self.L is not None:
            return Replay(self.L - term.value, self.dL) if term.is_replayed else self
        if self.pending is not None:
            self.pending.vjp(self.dL * term.value)
        return Replay(None, self.dL)

    def scale(self, factor: Factor) -> Replay:
        if self.L is None:
            return Replay(None, self.dL, factor)
        factor.vjp(self.dL * self.L)
        return self


@dataclass
class Tangent:
    """Carry the tangent of a path along with it.

    Attributes:
        dL: tangent of the radiance so far.
        dlog: tangent of the logarithm of the product of the factors so far.
    """

    dL: mi.Spectrum
    dlog: mi.Spectrum
    purpose = FORWARD

    def add(self, term: Term) -> Tangent:
        return Tangent(self.dL + term.jvp() + self.dlog * term.value, self.dlog)

    def scale(self, factor: Factor) -> Tangent:
        return Tangent(self.dL, self.dlog + factor.jvp())
