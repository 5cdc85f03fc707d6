r"""What a path is walked for: its radiance, the gradients of its parameters, or the tangent of its radiance.

The walk reports two things to its score, in the order of the path: terms, which are added to the radiance, and factors, which
multiply all light from further along the path (:mod:`mivol.transport.estimators.contribution`). There are three scores:

* ``Primal`` sums the radiance.
* ``Replay`` (path replay backpropagation) follows a path whose radiance ``L`` is known. Each term is subtracted from ``L`` when
  it is reached, so ``L`` is the radiance ahead when a factor is reported, and d loss / d log f = dL L. After the walk ``L`` is
  0, to rounding.
* ``Tangent`` carries the tangent of the logarithm of the product of all factors along the path.

Terms and factors know their own derivatives, so a score knows no estimator.

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
    """Sum the radiance of a path."""

    L: mi.Spectrum
    purpose = PICTURE

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
