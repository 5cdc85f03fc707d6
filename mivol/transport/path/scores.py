r"""What is done with a path: its radiance, its tangent, or the derivatives of what it carries.

A path tells its score two things, in the order of the path: a term that it adds to the light it carries, and a factor that all
light ahead is multiplied by (:mod:`mivol.transport.estimators.contribution`). Three scores answer:

* ``Primal`` sums the light.
* ``Replay`` follows a path whose radiance ``L`` is known. ``L`` counts down as terms are passed, so that it is the radiance
  ahead where a factor is told: d loss / d log f = dL L. In the end it is 0, to rounding.
* ``Tangent`` carries the derivative of the logarithm of all factors along with the path.

Terms and factors hold their own derivatives, so no score knows an estimator.

References: Vicini et al. 2021 (replay with a running difference); Nimier-David et al. 2020 (adjoint radiance).
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from mivol.transport.estimators.contribution import Factor, Term
from mivol.transport.estimators.segment import FORWARD, PICTURE, REVERSE

__all__ = ["Primal", "Replay", "Tangent"]


@dataclass
class Primal:
    """Sum the light that a path carries."""

    L: mi.Spectrum
    purpose = PICTURE

    def add(self, term: Term) -> Primal:
        return Primal(self.L + term.value)

    def scale(self, factor: Factor) -> Primal:
        return self


@dataclass
class Replay:
    """Follow a path again and add its derivatives to the gradients of media, surfaces and emitters.

    Attributes:
        L: the light that it carried, which counts down as it is passed. A path of one segment need not be known beforehand
            (None): all its light is met at its end, and the segment's factor waits for it.
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
        dL: tangent of the light so far.
        dlog: tangent of the logarithm of all factors so far.
    """

    dL: mi.Spectrum
    dlog: mi.Spectrum
    purpose = FORWARD

    def add(self, term: Term) -> Tangent:
        return Tangent(self.dL + term.jvp() + self.dlog * term.value, self.dlog)

    def scale(self, factor: Factor) -> Tangent:
        return Tangent(self.dL, self.dlog + factor.jvp())
