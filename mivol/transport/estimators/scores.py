r"""What a path is walked for: its radiance, the gradients of its parameters, or the tangent of its radiance.

The walk reports two things to its score, in the order of the path: terms, which are added to the radiance, and factors, which
multiply all light from further along the path (:mod:`mivol.transport.estimators.scores`). There are three scores:

* ``Primal`` sums the radiance.
* ``Replay`` (path replay backpropagation) follows a path whose radiance ``L`` is known. Each term is subtracted from ``L`` when
  it is reached, so ``L`` is the radiance ahead when a factor is reported, and d loss / d log f = dL L. After the walk ``L`` is
  0, to rounding.
* ``Tangent`` carries the tangent of the logarithm of the product of all factors along the path.

Terms and factors know their own derivatives, so a score knows no estimator.

References: Vicini et al. 2021 (replay with a running difference); Nimier-David et al. 2020 (adjoint radiance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.media.channels import take_tangent

__all__ = [
    "Primal",
    "Replay",
    "Tangent",
    "Factor",
    "Term",
    "TrackedFactor",
    "TrackedTerm",
    "IMAGE",
    "REVERSE",
    "FORWARD",
]


IMAGE, REVERSE, FORWARD = "picture", "reverse", "forward"
"""Purposes of a walk: the radiance, the gradients of its parameters, or its tangent."""


@dataclass
class Primal:
    """Sum the radiance of a path."""

    L: mi.Spectrum
    purpose = IMAGE

    def add(self, term: Term) -> Primal:
        """The score after a term of the path was reached."""
        return Primal(self.L + term.value)

    def scale(self, factor: Factor) -> Primal:
        """The score after a factor of all light further along the path was reached; term values contain it already."""
        return self


@dataclass
class Replay:
    """Follow a path again and add its derivatives to the gradients of media, surfaces and emitters.

    Attributes:
        L: radiance of the part of the path that is still ahead. It need not be known for a path of one segment (None): the only
            light behind its factor is the emission at its end, so the factor is kept until that is reached.
        dL: d loss / d L.
        waiting: that factor.
    """

    L: mi.Spectrum | None
    dL: mi.Spectrum
    waiting: Factor | None = None
    purpose = REVERSE

    def add(self, term: Term) -> Replay:
        term.vjp(self.dL)
        if self.L is not None:
            return Replay(self.L - term.value, self.dL) if term.is_replayed else self
        if self.waiting is not None:
            self.waiting.vjp(self.dL * term.value)
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
        dlog: tangent of the logarithm of the product of all factors so far.
    """

    dL: mi.Spectrum
    dlog: mi.Spectrum
    purpose = FORWARD

    def add(self, term: Term) -> Tangent:
        return Tangent(self.dL + term.jvp() + self.dlog * term.value, self.dlog)

    def scale(self, factor: Factor) -> Tangent:
        return Tangent(self.dL, self.dlog + factor.jvp())


class Term(Protocol):
    """Radiance that is added to a path.

    Attributes:
        value: radiance as the camera sees it, without derivatives; 0 in lanes that do not have it.
        is_replayed: whether the replay of a path finds the same value again and subtracts it from the known radiance. Light
            that is estimated anew for its derivative is not part of that radiance.
    """

    value: mi.Spectrum
    is_replayed: bool

    def vjp(self, dL: mi.Spectrum) -> None:
        """Add the derivatives of the value, weighted by ``dL``, to the gradients of its parameters."""

    def jvp(self) -> mi.Spectrum:
        """Tangent of the value, from the tangents of its parameters."""


class Factor(Protocol):
    """A factor of all light further along the path."""

    def vjp(self, dlog: mi.Spectrum) -> None:
        """Add the derivatives of the factor's logarithm, weighted by ``dlog`` = dL L, to the gradients of its parameters."""

    def jvp(self) -> mi.Spectrum:
        """Tangent of the factor's logarithm."""


class TrackedTerm:
    """A radiance whose derivatives Dr.Jit tracks (an emitter seen by the path).

    Args:
        value: attached to its parameters, or not.
        active: lanes that see it.
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
            own = take_tangent(self.attached)
        return dr.select(self.active, own, 0)


@dataclass
class TrackedFactor:
    """A factor whose derivatives Dr.Jit tracks (a BSDF). Where it is 0 it has no logarithm, and its derivative counts as 0.

    Attributes:
        evaluate: returns the factor, attached to its parameters; called only where a derivative is needed.
        active: lanes that are multiplied by it.
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
            own = take_tangent(value)
        f = dr.detach(value)
        return dr.select(self.active & (f != 0), own * dr.rcp(dr.select(f != 0, f, 1)), 0)
