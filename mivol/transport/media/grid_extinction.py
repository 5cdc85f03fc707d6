r"""An extinction stored at the nodes of a grid, and vacuum outside the box of the grid.

An extinction is trilinear between the nodes, or an activation of the trilinear values (a radiance field). The sum of several
parts in a cell includes constants:

.. math:: \sigma(x) = s \sum_k f_k(x)

Conventions. Values are detached arrays; channels are 1 (grey) or 3 (rgb), and a grey part counts in each channel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.activation import Activation
from mivol.transport.media.extinction import ExactExtinction, RayInterval, Weight, weight_in_cell
from mivol.transport.media.grid_integral import NodeGradient, backproject_segment, integrate_segment
from mivol.transport.traversal.grid_walk import Cell, NodeArray, corner_nodes, read_nodes, walk_cells
from mivol.transport.traversal.interpolation import (
    fraction_from_lower,
    gauss_points,
    interpolate,
    node_weights,
    trilinear_weights,
)
from mivol.transport.traversal.lattice import Lattice, Segment, clip_to_grid, locate_cell
from mivol.transport.traversal.rays import Ray

__all__ = [
    "GridExtinction",
    "NodeValues",
    "add_to_cell",
    "clip_interval",
    "interpolate_at",
    "ActivatedGridExtinction",
    "SummedExtinction",
    "activate",
    "have_same_cells",
]


@dataclass
class NodeValues:
    """The part of an extinction at the nodes of a grid, with the gradient of the node values.

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        lattice: place of the grid, and node values with their derivatives.
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

    def start_gradient(self, rays: float = math.inf) -> NodeGradient:
        return NodeGradient.zeros(self.lattice, rays)

    def fold_gradient(self, gradient: NodeGradient) -> mi.Float:
        return gradient.fold()

    def add_at_point(self, gradient: NodeGradient, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d interpolated value of each channel) at a point of a ray to a gradient of the nodes."""
        cell, frac, inside = locate_cell(self.lattice, ray.o, ray.d, t)
        corners = trilinear_weights(fraction_from_lower(frac, cell, self.lattice.res))
        add_to_cell(gradient, cell, [(weight, corners)], inside & active)


@dataclass
class GridExtinction(NodeValues):
    """A grid of extinction [1/length], grey or rgb (:class:`mivol.transport.media.extinction.ExactExtinction`).

    Attributes:
        rough: the means of blocks of voxels as a grid of their own, for drawing distances; None without one.
        floored: the values with 0 in place of negative values; None without negative values.
    """

    rough: GridExtinction | None = None
    floored: mi.Float | None = None
    activation: ClassVar[None] = None

    def floor(self, floored: mi.Float) -> None:
        """Replace negative values by 0, with their derivatives as they are."""
        values = self.lattice.values
        self.lattice.values = mi.TensorXf(dr.replace_grad(floored, values.array), values.shape)
        self.floored = floored

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        segment = clip_interval(self.lattice, interval)
        return integrate_segment(self.lattice, dr.detach(self.values), segment, interval.active, enough)

    def jvp(self, tangent: mi.Float, interval: RayInterval) -> list[mi.Float]:
        lattice = self.lattice.where_derivatives()
        return integrate_segment(lattice, tangent, clip_interval(lattice, interval), interval.active)

    def vjp(self, gradient: NodeGradient, weight: Weight, interval: RayInterval) -> None:
        backproject_segment(self.lattice, gradient, weight, clip_interval(self.lattice, interval), interval.active)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        # No array of scaled values: it would take the memory of the grid, and a kernel at each point of a path.
        return [dr.detach(scale) * v for v in interpolate_at(self.lattice, dr.detach(self.values), ray, t, active)]

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return interpolate_at(self.lattice, tangent, ray, t, active)

    def vjp_at(self, gradient: NodeGradient, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        self.add_at_point(gradient, weight, ray, t, active)


def clip_interval(lattice: Lattice, interval: RayInterval) -> Segment:
    """The part of an interval of a ray inside the box of a grid."""
    return clip_to_grid(lattice, interval.ray.o, interval.ray.d, interval.t0, interval.t1)


def interpolate_at(lattice: Lattice, values: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
    """Each channel of flat node values at a point of a ray; 0 outside the box of the grid."""
    cell, frac, inside = locate_cell(lattice, ray.o, ray.d, t)
    on = inside & active
    (rows,) = read_nodes([NodeArray(values, lattice.channels)], corner_nodes(cell, lattice, on), on)
    return [interpolate(row, frac) for row in rows]


def add_to_cell(gradient: NodeGradient, lower: mi.Vector3i, terms: list[tuple], active: mi.Bool) -> None:
    """Add to the gradient of a grid, in a packet for each channel.

    Args:
        gradient: gradient of the nodes.
        lower: lower node of the cell.
        terms: pairs (d loss / d value of each channel, 8 weights of the corners).
        active: lanes to add.
    """
    for c in range(gradient.channels):
        values = [sum(w[c] * corners[q] for w, corners in terms) for q in range(8)]
        gradient.add(c, lower, values, active)


@dataclass
class ActivatedGridExtinction(NodeValues):
    """An activation of a grey grid (:class:`mivol.transport.media.extinction.ExactExtinction`): the density of a radiance
    field.

    The part is alone in its medium, whose scale is 1. The integral is a quadrature.

    Bias: two points a cell are exact for polynomials of degree 3 only. The error falls with the fourth power of a cell where
        the activation is smooth, and with the second power at the edge of a ``relu``.

    Attributes:
        activation: maps an interpolated value to an extinction [1/length].
    """

    activation: Activation
    rough: ClassVar[None] = None

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        return self._integrate(self.lattice, interval, enough)

    def jvp(self, tangent: mi.Float, interval: RayInterval) -> list[mi.Float]:
        return self._integrate(self.lattice.where_derivatives(), interval, tangent=tangent)

    def vjp(self, gradient: NodeGradient, weight: Weight, interval: RayInterval) -> None:
        def visit(state: None, cell: Cell, on: mi.Bool) -> None:
            row = [mi.Float(0)] * 8
            for p in gauss_points(cell):
                _, slope = self.activation.value_and_slope(interpolate(cell.corners[0][0], p))
                row = [r + slope * w for r, w in zip(row, node_weights(p, cell, self.lattice.res), strict=True)]
            w = 0.5 * cell.dt * weight_in_cell(weight, cell.lower)[0]
            gradient.add(0, cell.lower, [w * r for r in row], on)
            return state

        lattice, reads = self.lattice.where_derivatives(), [NodeArray(dr.detach(self.values))]
        walk_cells(lattice, clip_interval(lattice, interval), visit, None, reads, interval.active)

    def _integrate(
        self,
        lattice: Lattice,
        interval: RayInterval,
        enough: mi.Float | None = None,
        tangent: mi.Float | None = None,
    ) -> list[mi.Float]:
        """Integrate the extinction, or its tangent along a ``tangent`` of the node values, by two Gauss points a cell."""

        def visit(tau: list[mi.Float], cell: Cell, on: mi.Bool) -> list[mi.Float]:
            half, total = dr.select(on, 0.5 * cell.dt, 0), mi.Float(0)
            for p in gauss_points(cell):
                value, slope = self.activation.value_and_slope(interpolate(cell.corners[0][0], p))
                total += value if tangent is None else slope * interpolate(cell.corners[1][0], p)
            return [dr.fma(half, total, tau[0])]

        arrays = [dr.detach(self.values)] if tangent is None else [dr.detach(self.values), tangent]
        until = None if enough is None else lambda tau: tau[0] > enough
        segment, reads = clip_interval(lattice, interval), [NodeArray(a) for a in arrays]
        return walk_cells(lattice, segment, visit, [mi.Float(0)], reads, interval.active, until)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        (value,) = interpolate_at(self.lattice, dr.detach(self.scaled(scale)), ray, t, active)
        # Outside of the box 0 is read, of which an activation may make a positive extinction.
        inside = locate_cell(self.lattice, ray.o, ray.d, t)[2]
        return [dr.select(inside, self.activation.value_and_slope(value)[0], 0)]

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [self._slope(ray, t, active) * row for row in interpolate_at(self.lattice, tangent, ray, t, active)]

    def vjp_at(self, gradient: NodeGradient, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        self.add_at_point(gradient, [self._slope(ray, t, active) * weight[0]], ray, t, active)

    def _slope(self, ray: Ray, t: mi.Float, active: mi.Bool) -> mi.Float:
        """Derivative of the extinction with respect to the interpolated value, at a point of a ray."""
        (value,) = interpolate_at(self.lattice, dr.detach(self.values), ray, t, active)
        return self.activation.value_and_slope(value)[1]


class SummedExtinction:
    """The sum of the parts of an extinction for each channel, in a cell of their grids and outside the grids.

    Args:
        parts: constants, and grids that share their cells.
        values: node values or constant of each part.
        scale: factor on the sum.
        linear: whether the values are tangents, which skip the activation.
    """

    def __init__(self, parts: list[ExactExtinction], values: list, scale: mi.Float, linear: bool = False) -> None:
        self.channels, self.scale = max(p.channels for p in parts), scale
        pairs = list(zip(parts, values, strict=True))
        self.activations = [None if linear else p.activation for p, _ in pairs if p.lattice is not None]
        self.reads = [NodeArray(v, p.channels) for p, v in pairs if p.lattice is not None]
        self.has_constants = len(self.reads) < len(parts)
        constants = [_as_channels(v, p.channels) for p, v in pairs if p.is_constant]
        self.constant = [scale * sum((k[c % len(k)] for k in constants), mi.Float(0)) for c in range(self.channels)]

    def along(self, corners: list, points: list[mi.Vector3f]) -> list[list[mi.Float]]:
        """Values [channel][point] at points of a cell (fractions from its near planes), from [array][channel][corner]
        values.
        """
        pairs = list(zip(corners, self.activations, strict=False))
        grids = [[[activate(a, interpolate(g[c % len(g)], p)) for g, a in pairs] for p in points] for c in range(self.channels)]
        return [
            [dr.fma(self.scale, sum(s, mi.Float(0)), k) for s in sums] for sums, k in zip(grids, self.constant, strict=True)
        ]

    def slopes(self, corners: list, points: list[mi.Vector3f]) -> list[mi.Float] | None:
        """Slope of the activation at points of a cell; None without an activation. A radiance field is the only part of its
        medium.
        """
        if not any(self.activations):
            return None
        return [self.activations[0].value_and_slope(interpolate(corners[0][0], p))[1] for p in points]


def have_same_cells(a: Lattice, b: Lattice) -> bool:
    """Whether two grids have the same resolution and place, and number their nodes alike."""
    alike = a.bricks is b.bricks or (a.bricks is not None and b.bricks is not None and a.bricks.has_same_slots(b.bricks))
    return a.res == b.res and np.array_equal(a.to_world, b.to_world) and alike


def activate(activation: Activation | None, value: mi.Float) -> mi.Float:
    """The extinction of an interpolated value: the value itself without an activation."""
    return value if activation is None else activation.value_and_slope(value)[0]


def _as_channels(value: mi.Float | mi.Color3f, channels: int) -> list[mi.Float]:
    return [value.x, value.y, value.z] if channels == 3 else [mi.Float(value)]
