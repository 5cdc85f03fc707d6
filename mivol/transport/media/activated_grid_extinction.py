"""The extinction of a radiance field: an activation of a grid's trilinear values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.fields.activation import Activation
from mivol.transport.media.grid_extinction import add_to_cell, interpolate_at
from mivol.transport.media.grid_integral import Gradient, backproject_activated, integrate_activated
from mivol.transport.traversal.interpolation import upward_frac, weights
from mivol.transport.traversal.lattice import Lattice, clip, locate

__all__ = ["ActivatedGridExtinction"]


@dataclass
class ActivatedGridExtinction:
    """A grey grid seen through an activation (:class:`mivol.transport.media.extinction.ExactExtinction`).

    It is alone in its medium, whose scale is 1. The integral is a quadrature (:func:`.grid_integral.integrate_activated`).

    Attributes:
        name: ``sigma_t``.
        lattice: node values before the activation, with their derivatives, and their place.
        activation: what makes an extinction [1/length] of an interpolated value.
    """

    name: str
    lattice: Lattice
    activation: Activation
    exact_line: ClassVar[bool] = True
    channels: ClassVar[int] = 1
    volume: ClassVar[None] = None

    @property
    def values(self) -> mi.Float:
        """Node values before the activation."""
        return self.lattice.values.array

    def scaled(self, scale: mi.Float) -> mi.Float:
        return scale * self.values

    def start_gradient(self) -> Gradient:
        return Gradient.zeros(self.lattice)

    def deliver(self, scale: mi.Float, gradient: Gradient) -> mi.Float:
        flat = gradient.fold()
        dr.eval(flat)
        return dr.sum(dr.ravel(self.scaled(scale)) * flat)

    def integrate(
        self, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, active: mi.Bool, enough: mi.Float | None = None
    ) -> list[mi.Float]:
        segment = clip(self.lattice, ray.o, ray.d, t0, t1)
        return integrate_activated(self.lattice, dr.detach(self.values), self.activation, segment, active, enough)

    def jvp(self, tangent: mi.Float, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, active: mi.Bool) -> list[mi.Float]:
        lattice = replace(self.lattice, empty_distances=None)
        segment = clip(lattice, ray.o, ray.d, t0, t1)
        return integrate_activated(lattice, dr.detach(self.values), self.activation, segment, active, None, tangent)

    def vjp(
        self, gradient: Gradient, weight: list[mi.Float], ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, active: mi.Bool
    ) -> None:
        segment = clip(self.lattice, ray.o, ray.d, t0, t1)
        backproject_activated(self.lattice, dr.detach(self.values), self.activation, gradient, weight[0], segment, active)

    def eval_at(self, scale: mi.Float, ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        (value,) = interpolate_at(self.lattice, dr.detach(self.scaled(scale)), ray, t, active)
        # An activation may make more than nothing of the 0 that is read outside of the box.
        inside = locate(self.lattice, ray.o, ray.d, t)[2]
        return [dr.select(inside, self.activation.value_and_slope(value)[0], 0)]

    def jvp_at(self, tangent: mi.Float, ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [self._slope(ray, t, active) * row for row in interpolate_at(self.lattice, tangent, ray, t, active)]

    def vjp_at(self, gradient: Gradient, weight: list[mi.Float], ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> None:
        cell, frac, inside = locate(self.lattice, ray.o, ray.d, t)
        corners = weights(upward_frac(frac, cell, self.lattice.res))
        add_to_cell(gradient, cell, [([self._slope(ray, t, active) * weight[0]], corners)], inside & active)

    def _slope(self, ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> mi.Float:
        """Derivative of the extinction by the interpolated value, at a point of a ray."""
        (value,) = interpolate_at(self.lattice, dr.detach(self.values), ray, t, active)
        return self.activation.value_and_slope(value)[1]
