"""An extinction that is trilinear between the nodes of a grid, and vacuum outside of its box."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.grid_integral import Gradient, backproject_segment, integrate_segment
from mivol.transport.traversal.fine_ray import Ray
from mivol.transport.traversal.grid_walk import box_nodes
from mivol.transport.traversal.interpolation import interpolate, upward_frac, weights
from mivol.transport.traversal.lattice import Lattice, Segment, clip, locate

__all__ = ["GridExtinction", "NodeValues", "add_to_cell", "clip_interval", "interpolate_at"]


@dataclass
class NodeValues:
    """The part of an extinction that is stored at the nodes of a grid, and the gradient of what is stored.

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        lattice: node values, with their derivatives, and their place.
    """

    name: str
    lattice: Lattice
    exact_line: ClassVar[bool] = True
    is_constant: ClassVar[bool] = False

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (rgb)."""
        return self.lattice.channels

    @property
    def values(self) -> mi.Float:
        """Flat node values, channels fastest."""
        return self.lattice.values.array

    def scaled(self, scale: mi.Float) -> mi.Float:
        return scale * self.values

    def start_gradient(self) -> Gradient:
        return Gradient.zeros(self.lattice)

    def deliver(self, scale: mi.Float, gradient: Gradient) -> mi.Float:
        flat = gradient.fold()
        dr.eval(flat)
        return dr.sum(dr.ravel(self.scaled(scale)) * flat)

    def add_at_point(self, gradient: Gradient, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d interpolated value of each channel) at a point of a ray to a gradient of the nodes."""
        cell, frac, inside = locate(self.lattice, ray.o, ray.d, t)
        corners = weights(upward_frac(frac, cell, self.lattice.res))
        add_to_cell(gradient, cell, [(weight, corners)], inside & active)


@dataclass
class GridExtinction(NodeValues):
    """A grid of extinction [1/length], grey or rgb (:class:`mivol.transport.media.extinction.ExactExtinction`).

    Attributes:
        volume: the stock grid that ``lattice`` stands for, which may look its voxels up in another way; None elsewhere.
    """

    volume: mi.Volume | None = None
    activation: ClassVar[None] = None

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        segment = clip_interval(self.lattice, interval)
        return integrate_segment(self.lattice, dr.detach(self.values), segment, interval.active, enough)

    def jvp(self, tangent: mi.Float, interval: RayInterval) -> list[mi.Float]:
        lattice = replace(self.lattice, empty_distances=None)
        return integrate_segment(lattice, tangent, clip_interval(lattice, interval), interval.active)

    def vjp(self, gradient: Gradient, weight: list[mi.Float], interval: RayInterval) -> None:
        backproject_segment(self.lattice, gradient, weight, clip_interval(self.lattice, interval), interval.active)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return interpolate_at(self.lattice, dr.detach(self.scaled(scale)), ray, t, active)

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return interpolate_at(self.lattice, tangent, ray, t, active)

    def vjp_at(self, gradient: Gradient, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        self.add_at_point(gradient, weight, ray, t, active)


def clip_interval(lattice: Lattice, interval: RayInterval) -> Segment:
    """The part of an interval of a ray inside the box of a grid."""
    return clip(lattice, interval.ray.o, interval.ray.d, interval.t0, interval.t1)


def interpolate_at(lattice: Lattice, values: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
    """Each channel of flat node values at a point of a ray; 0 outside the grid's box."""
    cell, frac, inside = locate(lattice, ray.o, ray.d, t)
    upward = dr.full(dr.mask_t(mi.Vector3f), True)
    nodes, on, n = box_nodes(cell, upward, lattice.res), inside & active, lattice.channels
    return [interpolate([dr.gather(mi.Float, values, k * n + c, on) for k in nodes], frac) for c in range(n)]


def add_to_cell(gradient: Gradient, lower: mi.Vector3i, terms: list[tuple], active: mi.Bool) -> None:
    """Add to the gradient of a grid, in one packet for each channel.

    Args:
        gradient: what is added to.
        lower: lower node of the cell.
        terms: (d loss / d value of each channel, 8 weights of the corners) pairs.
        active: lanes that add.
    """
    for c in range(gradient.channels):
        values = [sum(w[c] * corners[q] for w, corners in terms) for q in range(8)]
        gradient.add_at(c, lower, values, active)
