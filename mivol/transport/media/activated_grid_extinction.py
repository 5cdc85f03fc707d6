"""The extinction of a radiance field: an activation of a grid's trilinear values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.fields.activation import Activation
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.grid_extinction import NodeValues, clip_interval, interpolate_at
from mivol.transport.media.grid_integral import ActivatedNodes, Gradient, backproject_activated, integrate_activated
from mivol.transport.traversal.fine_ray import Ray
from mivol.transport.traversal.lattice import locate

__all__ = ["ActivatedGridExtinction"]


@dataclass
class ActivatedGridExtinction(NodeValues):
    """A grey grid seen through an activation (:class:`mivol.transport.media.extinction.ExactExtinction`).

    It is alone in its medium, whose scale is 1. The integral is a quadrature (:func:`.grid_integral.integrate_activated`).

    Attributes:
        activation: what makes an extinction [1/length] of an interpolated value.
    """

    activation: Activation
    volume: ClassVar[None] = None

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        return integrate_activated(self._nodes(), clip_interval(self.lattice, interval), interval.active, enough)

    def jvp(self, tangent: mi.Float, interval: RayInterval) -> list[mi.Float]:
        nodes = replace(self._nodes(), lattice=replace(self.lattice, empty_distances=None))
        return integrate_activated(nodes, clip_interval(nodes.lattice, interval), interval.active, None, tangent)

    def vjp(self, gradient: Gradient, weight: list[mi.Float], interval: RayInterval) -> None:
        backproject_activated(self._nodes(), gradient, weight[0], clip_interval(self.lattice, interval), interval.active)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        (value,) = interpolate_at(self.lattice, dr.detach(self.scaled(scale)), ray, t, active)
        # Outside of the box 0 is read, of which an activation may make a positive extinction.
        inside = locate(self.lattice, ray.o, ray.d, t)[2]
        return [dr.select(inside, self.activation.value_and_slope(value)[0], 0)]

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [self._slope(ray, t, active) * row for row in interpolate_at(self.lattice, tangent, ray, t, active)]

    def vjp_at(self, gradient: Gradient, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        self.add_at_point(gradient, [self._slope(ray, t, active) * weight[0]], ray, t, active)

    def _nodes(self) -> ActivatedNodes:
        return ActivatedNodes(self.lattice, dr.detach(self.values), self.activation)

    def _slope(self, ray: Ray, t: mi.Float, active: mi.Bool) -> mi.Float:
        """Derivative of the extinction with respect to the interpolated value, at a point of a ray."""
        (value,) = interpolate_at(self.lattice, dr.detach(self.values), ray, t, active)
        return self.activation.value_and_slope(value)[1]
