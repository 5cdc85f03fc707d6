r"""An extinction stored at the nodes of a grid, and its exact optical depth along rays; vacuum outside the box of the grid.

An extinction is trilinear between the nodes, or an activation of the trilinear values (a radiance field). The sum of several
parts in a cell includes constants:

.. math:: \sigma(x) = s \sum_k f_k(x)

The optical depth has a tangent and a transpose:

.. math:: \tau = \int_{t_0}^{t_1} \sigma(o + t\,\omega)\,dt = (A \sigma)_{ray}

Along a line a trilinear function is a cubic in each cell, so two Gauss points a cell integrate it exactly. The sum over the
cells is linear in the values at the nodes. ``A``, its tangent (``A`` again) and the transpose are visitors of the same walk.
Functions return optical depth instead of transmittance: in float32 exp(-tau) underflows to 0 beyond tau = 103.

References: Amanatides & Woo 1987 (the walk); Abramowitz & Stegun 25.4.30 (Gauss points); De Man & Basu 2004 (matched
adjoints).

Conventions. Values are detached arrays; channels are 1 (grey) or 3 (rgb), and a grey part counts in each channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.activation import Activation
from mivol.numerics import minimum
from mivol.transport.media.extinction import BoundedExtinction, ExactExtinction, RayInterval, Weight, weight_in_cell
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
    "ActivatedGridExtinction",
    "GridExtinction",
    "NodeGradient",
    "NodeValues",
    "SummedExtinction",
    "activate",
    "add_to_cell",
    "backproject_segment",
    "clip_interval",
    "have_same_cells",
    "integrate_segment",
    "integrate_tau",
    "interpolate_at",
]

PACKED_LIMIT = 4 << 30
"""Largest size of a packed gradient [bytes]; a larger grid adds to its nodes individually."""

FEW_RAYS = 0.125
"""Rays for each cell of a face of a grid up to which the grid adds to its nodes individually. Few rays meet a small share of
the cells, and a packed gradient is cleared and folded as a whole. (Grids of 128^3 and 256^3 break even at 0.2. At 0.06 a
gradient at depth 6 in a grid of 256^3 takes 215 ms in place of 345 ms of the processor.)"""


def integrate_tau(
    lattice: Lattice,
    o: mi.Point3f,
    d: mi.Vector3f,
    t_max: mi.Float = math.inf,
    active: mi.Bool = True,
) -> mi.Float | mi.Color3f:
    """Integrate a grid along rays: the optical depth if the grid is an extinction.

    Args:
        lattice: values [1/length] of 1 or 3 channels, and their place. Derivatives (reverse and forward) reach
            ``lattice.values``; outside the box the grid is vacuum.
        o, d: world rays, |d| = 1; neither the rays nor ``t_max`` carry derivatives.
        t_max: end of the interval [0, t_max] of the ray [length]; may be infinite.
        active: lanes to integrate; the other lanes return 0.

    Returns:
        tau [1]: ``Float`` for one channel, ``Color3f`` for three.

    Raises:
        MivolError: another number of channels, or rays with gradients enabled.

    Bias: none but rounding, |error| <= 2e-6 int (sigma + h |grad sigma|) dt, h the size of a voxel.
    Cost: 4 reads a cell and channel forwards, a packed write of 8 a cell and channel in reverse.

    Example:
        >>> tau = integrate_tau(Lattice(mi.TensorXf(sigma_t), to_world), ray.o, ray.d)
    """
    if lattice.channels not in (1, 3):
        raise MivolError(f"a grid of {lattice.channels} channels was given; 1 (grey) or 3 (rgb) are expected: split it.")
    if dr.grad_enabled(o, d, t_max):
        raise MivolError("rays with gradients were given; rays without gradients are expected: detach the rays.")
    segment = clip_to_grid(lattice, o, d, 0, t_max)
    tau = dr.custom(_OpticalDepth, lattice.values.array, lattice, segment, mi.Bool(active))
    return tau[0] if lattice.channels == 1 else mi.Color3f(*tau)


def integrate_segment(
    lattice: Lattice, values: mi.Float, segment: Segment, active: mi.Bool = True, enough: mi.Float | None = None
) -> list[mi.Float]:
    """Integrate node values along a segment: a row of ``A`` for each lane.

    Args:
        lattice: place and empty blocks of the grid.
        values: flat node values (the values of the lattice, or a tangent of these).
        segment: from :func:`mivol.transport.traversal.lattice.clip_to_grid`.
        active: lanes to integrate; the other lanes return 0.
        enough: number at which the walk may stop, once every channel exceeds it; None to walk to the end.

    Returns:
        The integral for each channel. Dr.Jit tracks no derivatives.

    Bias, cost: as of :func:`integrate_tau`.
    """

    def visit(tau: list[mi.Float], cell: Cell, on: mi.Bool) -> list[mi.Float]:
        a, b = gauss_points(cell)
        half = dr.select(on, 0.5 * cell.dt, 0)
        return [dr.fma(half, interpolate(c, a) + interpolate(c, b), t) for t, c in zip(tau, cell.corners[0], strict=True)]

    zero = [mi.Float(0) for _ in range(lattice.channels)]

    until = None if enough is None else lambda tau: minimum(tau) > enough
    return walk_cells(lattice, segment, visit, zero, [NodeArray(values, lattice.channels)], active, until)


@dataclass
class NodeGradient:
    """The derivative of a scalar with respect to the nodes of a grid, for the transpose to add to.

    On the CPU a cell adds its 8 corners as a packet to a buffer with 8 numbers a cell and a copy for each thread, without
    atomics. The cells are summed to the nodes once, at the end (5 times faster than adding 8 numbers to the nodes). On a GPU,
    for few rays, or if the buffer is too large, the corners are added to the nodes directly.

    Attributes:
        buffer: flat sums; corners of cells if ``packed``, else nodes.
        lattice: the grid.
        channels: channels of the grid.
        packed: whether the buffer holds cells.
    """

    buffer: mi.Float
    lattice: Lattice
    channels: int
    packed: bool

    @classmethod
    def zeros(cls, lattice: Lattice, rays: float = math.inf) -> NodeGradient:
        """A gradient of zero for the nodes of ``lattice``, to which so many rays add."""
        z, y, x = lattice.res
        cells = (z + 1) * (y + 1) * (x + 1) * lattice.channels
        on_cpu = dr.backend_v(mi.Float) == dr.JitBackend.LLVM
        packed = on_cpu and lattice.bricks is None and packs_gradient(lattice.res, lattice.channels, rays)
        buffer = dr.zeros(mi.Float, 8 * cells if packed else dr.width(lattice.values.array))
        return cls(buffer, lattice, lattice.channels, packed)

    def add(self, channel: int, lower: mi.Vector3i, corners: list[mi.Float], active: mi.Bool) -> None:
        """Add 8 values, in the order of the axes of the grid, to the corners of the cell with the lower node ``lower``."""
        if self.packed:
            _, y, x = self.lattice.res
            index = ((lower.z + 1) * (y + 1) + lower.y + 1) * (x + 1) + lower.x + 1
            index = mi.UInt32(index) * self.channels + channel
            dr.scatter_add(self.buffer, mi.ArrayXf(corners), index, active, mode=dr.ReduceMode.Expand)
            return
        nodes = corner_nodes(lower, self.lattice, active)
        for node, value, on in zip(nodes.index, corners, nodes.select(active), strict=True):
            dr.scatter_add(self.buffer, value, node * self.channels + channel, on)

    def fold(self) -> mi.Float:
        """The derivative at each node (flat, channels fastest)."""
        if not self.packed:
            return self.buffer
        z, y, x = self.lattice.res
        entry = dr.arange(mi.UInt32, z * y * x * self.channels)
        node, channel = entry // self.channels, entry % self.channels
        i, j, k = node % x, (node // x) % y, node // (x * y)
        total = mi.Float(0)
        for q in range(8):
            # This node is corner q of the cell whose lower node is (i, j, k) minus the bits of q; cells are numbered from 1
            # on for lower node 0.
            a, b, c = i + 1 - (q & 1), j + 1 - (q >> 1 & 1), k + 1 - (q >> 2)
            cell = (c * (y + 1) + b) * (x + 1) + a
            total += dr.gather(mi.Float, self.buffer, (cell * self.channels + channel) * 8 + q)
        return total


def packs_gradient(res: tuple[int, int, int], channels: int, rays: float) -> bool:
    """Whether a processor packs the gradient of a grid, to which so many rays add."""
    few = FEW_RAYS * math.prod(n + 1 for n in res) ** (2 / 3)
    return rays > few and gradient_bytes(res, channels) <= PACKED_LIMIT


def gradient_bytes(res: tuple[int, int, int], channels: int) -> int:
    """Size of a packed gradient [bytes]: its buffer, and a copy for each thread."""
    z, y, x = res
    return 32 * (z + 1) * (y + 1) * (x + 1) * channels * (1 + dr.thread_count())


def backproject_segment(
    lattice: Lattice, target: NodeGradient, weight: Weight, segment: Segment, active: mi.Bool = True
) -> None:
    """Add ``weight`` times the row of ``A`` of each lane to a gradient: the transpose ``A^T``.

    Args:
        lattice: place of the grid. Empty blocks are walked too, since an empty voxel has a derivative if it is stored.
        target: the gradient.
        weight: d loss / d tau of each lane.
        segment: from :func:`mivol.transport.traversal.lattice.clip_to_grid`.
        active: lanes to project back.

    Cost: a packed write of 8 a cell and channel.
    """

    def visit(state: None, cell: Cell, on: mi.Bool) -> None:
        a, b = (node_weights(p, cell, lattice.res) for p in gauss_points(cell))
        row = [0.5 * cell.dt * (wa + wb) for wa, wb in zip(a, b, strict=True)]
        for channel, w in enumerate(weight_in_cell(weight, cell.lower)):
            target.add(channel, cell.lower, [w * r for r in row], on)
        return state

    walk_cells(lattice.where_derivatives(), segment, visit, None, (), active)


class _OpticalDepth(dr.CustomOp):
    """tau = A values, with its tangent and the transpose."""

    def eval(self, values: mi.Float, lattice: Lattice, segment: Segment, active: mi.Bool) -> list[mi.Float]:
        self.lattice, self.segment, self.active = lattice, segment, active
        return integrate_segment(lattice, dr.detach(values), segment, active)

    def forward(self) -> None:
        # The tangent may be nonzero where the values are 0, so no block may be skipped.
        whole = self.lattice.where_derivatives()
        self.set_grad_out(integrate_segment(whole, self.grad_in("values"), self.segment, self.active))

    def backward(self) -> None:
        target = NodeGradient.zeros(self.lattice)
        backproject_segment(self.lattice, target, list(self.grad_out()), self.segment, self.active)
        self.set_grad_in("values", target.fold())

    def name(self) -> str:
        return "optical depth"


# -- The extinction ----------------------------------------------------------------------------------------------------


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
        largest: largest value, for look-ups in place of a walk (:func:`.tracking.ratio_tracking_in_grid`); None to walk.
        floored: the values with 0 in place of negative values; None without negative values.
    """

    rough: GridExtinction | None = None
    largest: mi.Float | None = None
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
        parts: constants, and grids and fields known at points that share their cells.
        values: node values, constant or factor of each part.
        scale: factor on the sum.
        linear: whether the values are tangents, which skip the activation.
        ray: the ray; needed for fields known at points.
    """

    def __init__(
        self, parts: list[ExactExtinction], values: list, scale: mi.Float, linear: bool = False, ray: Ray | None = None
    ) -> None:
        self.channels, self.scale, self.ray, self.linear = max(p.channels for p in parts), scale, ray, linear
        pairs = list(zip(parts, values, strict=True))
        self.at_points = [(p, v) for p, v in pairs if isinstance(p, BoundedExtinction)]
        grids = [(p, v) for p, v in pairs if isinstance(p, NodeValues)]
        self.activations = [None if linear else p.activation for p, _ in grids]
        self.reads = [NodeArray(v, p.channels) for p, v in grids]
        constants = [_as_channels(v, p.channels) for p, v in pairs if p.is_constant]
        self.has_constants = len(constants) > 0
        self.constant = [scale * sum((k[c % len(k)] for k in constants), mi.Float(0)) for c in range(self.channels)]

    def along(self, corners: list, points: list[mi.Vector3f], distances: Sequence[mi.Float] = ()) -> list[list[mi.Float]]:
        """Values [channel][point] at points of a cell, from [array][channel][corner] values.

        Args:
            corners: values at the corners of the cell.
            points: fractions from the near planes of the cell.
            distances: of the same points along the ray [length]; needed for fields known at points.
        """
        pairs = list(zip(corners, self.activations, strict=False))
        sums = [[[activate(a, interpolate(g[c % len(g)], p)) for g, a in pairs] for p in points] for c in range(self.channels)]
        for part, value in self.at_points:
            for k, t in enumerate(distances):
                on = mi.Bool(True)
                row = part.jvp_at(value, self.ray, t, on) if self.linear else part.eval_at(value, self.ray, t, on)
                for c in range(self.channels):
                    sums[c][k].append(row[c % len(row)])
        return [[dr.fma(self.scale, sum(s, mi.Float(0)), k) for s in each] for each, k in zip(sums, self.constant, strict=True)]

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
