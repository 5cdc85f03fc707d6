r"""Terms and factors of a path: values with their derivatives in reverse (vjp) and forward mode (jvp).

A path's radiance is a sum of terms, each multiplied by all the factors in front of it:

.. math:: L = t_1 + f_1 (t_2 + f_2 (t_3 + \dots))

In forward mode the tangent of a term is added, and the tangent of a factor's logarithm, f'/f, multiplies all light further
along the path. In reverse mode a term receives d loss / d t = dL, and a factor d loss / d log f = dL L, with L the radiance
from further along the path. Each factor computes the derivative of its logarithm itself, so there is no division by a factor
that has none, and never one by a transmittance.

Conventions. Values are already multiplied by the throughput of the path in front of them. A term is 0 in lanes that do not have
it. :class:`Term` and :class:`Factor` are the protocols that scores use; the classes below are for values whose derivatives
Dr.Jit tracks.

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
            own = tangent_of(self.attached)
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
            own = tangent_of(value)
        f = dr.detach(value)
        return dr.select(self.active & (f != 0), own * dr.rcp(dr.select(f != 0, f, 1)), 0)
