r"""One additive part of the extinction of a medium, as transport asks for it: at points of rays and along them.

.. math:: \sigma_t(x) = s \sum_k f_k(x)

The scale s belongs to the medium, a part is one f_k. Each kind of field has an adapter that answers these questions, so that
what walks through media does not ask for the kind. An :class:`ExactExtinction` also knows its integral along a ray.

Conventions. Distances are along the ray, from its origin [length]; rows are lists of one ``Float`` for each channel of the
part. Values come without derivatives. Tangents and gradients are those of ``scaled(s)``, the array that the scale and the
parameters behind the part are found through: ``jvp`` multiplies by the derivative, ``vjp`` by its transpose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from mivol.transport.traversal.fine_ray import Ray
from mivol.transport.traversal.lattice import Lattice

__all__ = ["ExactExtinction", "Extinction", "RayInterval"]


@dataclass
class RayInterval:
    """An interval of a ray, over which an extinction is integrated.

    Attributes:
        ray: world space, unit direction.
        t0, t1: distances from its origin [length]; ``t1`` may be infinite.
        active: lanes that have the interval.
    """

    ray: Ray
    t0: mi.Float64 | mi.Float
    t1: mi.Float64 | mi.Float
    active: mi.Bool


class Extinction(Protocol):
    """A part of an extinction, known at points.

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        exact_line: whether it is an :class:`ExactExtinction`.
        is_constant: whether it is the same number everywhere in its boundary.
        lattice: the cells that one walk may follow; None where it needs none.
        channels: 1 (grey) or 3 (rgb).
    """

    name: str
    exact_line: bool
    is_constant: bool
    lattice: Lattice | None
    channels: int

    def scaled(self, scale: mi.Float) -> mi.Float | mi.Color3f:
        """What tangents are taken from in a forward pass, attached to the scale and to the parameters."""

    def start_gradient(self) -> Any:
        """A gradient of zero, which the ``vjp`` methods add to."""

    def deliver(self, scale: mi.Float, gradient: Any) -> mi.Float:
        """A scalar whose derivative by the scale and the parameters is what was added to a gradient."""

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """``scale`` times the coefficient [1/length] at a point of a ray; 0 outside of the part."""

    def jvp_at(self, tangent: Any, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """Tangent of :meth:`eval_at`."""

    def vjp_at(self, gradient: Any, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d coefficient) at a point of a ray to a gradient: the transpose of :meth:`jvp_at`."""


class ExactExtinction(Extinction, Protocol):
    """A part whose integral over an interval of a ray is known: in closed form, or cell by cell."""

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        """Optical depth [1] for a scale of 1; it may stop where every channel has more than ``enough``."""

    def jvp(self, tangent: Any, interval: RayInterval) -> list[mi.Float]:
        """Tangent of the optical depth, the scale included."""

    def vjp(self, gradient: Any, weight: list[mi.Float], interval: RayInterval) -> None:
        """Add ``weight`` (d loss / d tau) times the interval to a gradient: the transpose of :meth:`jvp`."""
