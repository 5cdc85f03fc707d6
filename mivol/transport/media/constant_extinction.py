"""An extinction that is the same everywhere in its boundary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.transport.media.extinction import RayInterval
from mivol.transport.traversal.fine_ray import Ray

__all__ = ["ConstantExtinction"]


@dataclass
class ConstantExtinction:
    """A number, grey or rgb (:class:`mivol.transport.media.extinction.ExactExtinction`).

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        constant: its value [1/length], with its derivatives.
    """

    name: str
    constant: mi.Float | mi.Color3f
    exact_line: ClassVar[bool] = True
    is_constant: ClassVar[bool] = True
    lattice: ClassVar[None] = None

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (rgb)."""
        return 3 if dr.size_v(self.constant) == 3 else 1

    @property
    def values(self) -> mi.Float | mi.Color3f:
        """The number."""
        return self.constant

    def scaled(self, scale: mi.Float) -> mi.Float | mi.Color3f:
        return scale * self.constant

    def start_gradient(self) -> mi.Float:
        return dr.zeros(mi.Float, self.channels)

    def deliver(self, scale: mi.Float, gradient: mi.Float) -> mi.Float:
        dr.eval(gradient)
        return dr.sum(dr.ravel(self.scaled(scale)) * gradient)

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        return self._along(dr.detach(self.constant), _length(interval))

    def jvp(self, tangent: mi.Float | mi.Color3f, interval: RayInterval) -> list[mi.Float]:
        return self._along(tangent, _finite(_length(interval)))

    def vjp(self, gradient: mi.Float, weight: list[mi.Float], interval: RayInterval) -> None:
        length = _finite(_length(interval))
        for c, w in enumerate(weight):
            dr.scatter_add(gradient, dr.select(w != 0, w * length, 0), mi.UInt32(c), interval.active)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return self._rows(dr.detach(self.scaled(scale)))

    def jvp_at(self, tangent: mi.Float | mi.Color3f, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return self._rows(tangent)

    def vjp_at(self, gradient: mi.Float, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        for c, w in enumerate(weight):
            dr.scatter_add(gradient, dr.select(active, w, 0), mi.UInt32(c), active)

    def _along(self, value: mi.Float | mi.Color3f, length: mi.Float) -> list[mi.Float]:
        # A ray that never leaves a medium has infinite length: 0 * inf would be NaN.
        return [dr.select(v != 0, v * length, 0) for v in self._rows(value)]

    def _rows(self, value: mi.Float | mi.Color3f) -> list[mi.Float]:
        # A grey value is taken whole: the index of a Dr.Jit array reads it, and bakes it into the kernel.
        return [value] if self.channels == 1 else [value.x, value.y, value.z]


def _length(interval: RayInterval) -> mi.Float:
    return dr.select(interval.active & (interval.t1 > interval.t0), mi.Float(interval.t1 - interval.t0), 0)


def _finite(length: mi.Float) -> mi.Float:
    """A length for derivatives: 0 for an interval without end, whose transmittance stays 0 whatever the constant is."""
    return dr.select(length < 1e30, length, 0)
