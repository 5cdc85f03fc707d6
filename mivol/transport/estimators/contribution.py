r"""What an estimator adds to a path, and what it multiplies a path by: a value with its derivatives in both directions.

A path's radiance is a sum of terms, each multiplied by all the factors in front of it:

.. math:: L = t_1 + f_1 (t_2 + f_2 (t_3 + \dots))

Forwards the tangent of a term adds dt, and the tangent of a factor f'/f dims or lifts all that lies ahead. In reverse the term
receives d loss / d t = dL, and the factor d loss / d log f = dL L, with L the radiance ahead: no factor is divided by where it
has no derivative of its own, and a transmittance never is.

Conventions. Values are already multiplied by the path's throughput in front of them. Lanes that a term is not for have the
value 0. :class:`Term` and :class:`Factor` are what a score asks for; the classes below serve values that Dr.Jit tracks.

References: Vicini et al. 2021 (replay of a path with a running radiance).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from mivol.transport.media.channels import tangent_of

__all__ = ["Factor", "Term", "TrackedFactor", "TrackedTerm"]


class Term(Protocol):
    """Light that is added to what a path carries.

    Attributes:
        value: radiance as the camera sees it, without derivatives; 0 in lanes that it is not for.
        is_replayed: whether a path that is followed again meets the same value, and counts it down; light that is estimated
            anew for its derivative is not part of the radiance that was known.
    """

    value: mi.Spectrum
    is_replayed: bool

    def vjp(self, dL: mi.Spectrum) -> None:
        """Add the derivatives of the value, weighted by ``dL``, to the gradients of what it was made of."""

    def jvp(self) -> mi.Spectrum:
        """Tangent of the value along that which was set on the parameters."""


class Factor(Protocol):
    """What all light ahead is multiplied by."""

    def vjp(self, dlog: mi.Spectrum) -> None:
        """Add the derivatives of the factor's logarithm, weighted by ``dlog`` (dL times the radiance ahead)."""

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
            own = tangent_of(self.attached)
        return dr.select(self.active, own, 0)


@dataclass
class TrackedFactor:
    """A factor whose derivatives Dr.Jit tracks (a BSDF): 0 has no logarithm, and lets nothing through that could change.

    Attributes:
        evaluate: returns the factor, attached to its parameters; asked only where a derivative is wanted.
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
            own = tangent_of(value)
        f = dr.detach(value)
        return dr.select(self.active & (f != 0), own * dr.rcp(dr.select(f != 0, f, 1)), 0)
