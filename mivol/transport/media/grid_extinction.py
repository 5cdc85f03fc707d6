"""An extinction that is trilinear between the nodes of a grid, and vacuum outside of its box."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.transport.media.grid_integral import Gradient, backproject_segment, integrate_segment
from mivol.transport.traversal.grid_walk import box_nodes
from mivol.transport.traversal.interpolation import interpolate, upward_frac, weights
from mivol.transport.traversal.lattice import Lattice, clip, locate

__all__ = ["GridExtinction", "add_to_cell", "interpolate_at"]


@dataclass
class GridExtinction:
    """A grid, grey or rgb (:class:`mivol.transport.media.extinction.ExactExtinction`).

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        lattice: its values [1/length], with their derivatives, and their place.
        volume: the stock grid that ``lattice`` stands for, which may look its voxels up in another way; None elsewhere.
    """

    name: str
    lattice: Lattice
    volume: mi.Volume | None = None
    exact_line: ClassVar[bool] = True
    activation: ClassVar[None] = None

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

    def integrate(
        self, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, active: mi.Bool, enough: mi.Float | None = None
    ) -> list[mi.Float]:
        segment = clip(self.lattice, ray.o, ray.d, t0, t1)
        return integrate_segment(self.lattice, dr.detach(self.values), segment, active, enough)

    def jvp(self, tangent: mi.Float, ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, active: mi.Bool) -> list[mi.Float]:
        lattice = replace(self.lattice, empty_distances=None)
        return integrate_segment(lattice, tangent, clip(lattice, ray.o, ray.d, t0, t1), active)

    def vjp(
        self, gradient: Gradient, weight: list[mi.Float], ray: mi.Ray3f, t0: mi.Float, t1: mi.Float, active: mi.Bool
    ) -> None:
        backproject_segment(self.lattice, gradient, weight, clip(self.lattice, ray.o, ray.d, t0, t1), active)

    def eval_at(self, scale: mi.Float, ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return interpolate_at(self.lattice, dr.detach(self.scaled(scale)), ray, t, active)

    def jvp_at(self, tangent: mi.Float, ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return interpolate_at(self.lattice, tangent, ray, t, active)

    def vjp_at(self, gradient: Gradient, weight: list[mi.Float], ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> None:
        cell, frac, inside = locate(self.lattice, ray.o, ray.d, t)
        corners = weights(upward_frac(frac, cell, self.lattice.res))
        add_to_cell(gradient, cell, [(weight, corners)], inside & active)


def interpolate_at(lattice: Lattice, values: mi.Float, ray: mi.Ray3f, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
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
