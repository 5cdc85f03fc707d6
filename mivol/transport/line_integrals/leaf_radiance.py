r"""Emission-absorption rendering of an octree along rays, exact for its constant leaves, and the derivatives.

.. math:: L = \sum_i T_i (1 - e^{-\tau_i})\, c_i, \qquad T_{i+1} = T_i e^{-\tau_i}, \qquad \tau_i = \sigma_i\, \Delta_i

Conventions. Rays start at pinholes. A source reads the extinction and the colour of a leaf from a table of four numbers a leaf
and pinhole. The colour is that of the direction from the pinhole to the middle of the leaf.

Derivatives. Rays are walked back from their last leaf. Let r be the light from behind a leaf, times the derivative of the loss
by this light, as if the leaf began at the eye: r <- (1 - e^-tau) s + e^-tau r, with s = <dL, c>. The derivative by tau is
T e^-tau (s - r). The sweep stores no samples, and divides by no transmittance: only optical depths are carried.

References: Max 1995 (the integral); Yu et al. 2021 (PlenOctrees: the model).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.octree import Octree
from mivol.numerics import fast_max, one_minus_exp, reciprocal
from mivol.transport.line_integrals.radiance_field import MAX_DEPTH, RayBundle, RayGradient
from mivol.transport.line_integrals.radiance_source import add_packet, sum_harmonics
from mivol.transport.traversal.leaf_index import LeafIndex
from mivol.transport.traversal.octree_walk import VisitedLeaf, clip_to_octree, reverse_from, walk_leaves

__all__ = [
    "HalfColours",
    "LeafColours",
    "LeafPlaces",
    "LeafRays",
    "make_leaf_colours",
    "raise_leaf_weights",
    "render_leaves",
    "vjp_leaf_colours",
    "vjp_leaves",
]


@dataclass
class LeafColours:
    """Extinction, and colour as seen from each pinhole: 4 numbers a leaf, read as one packet.

    Attributes:
        table: Float, extinction and rgb of each leaf; one block of all leaves for each pinhole.
        first: start of the block of each lane's pinhole.
        slope: derivative in the layout of ``table``; None without derivatives.
    """

    table: mi.Float
    first: mi.UInt32
    slope: mi.Float | None = None

    def read(self, row: mi.UInt32, on: mi.Bool) -> tuple[mi.Float, list[mi.Float]]:
        """Extinction and colour of leaves."""
        values = dr.gather(mi.ArrayXf, self.table, self.first + row, on, shape=(4, 1))
        return values[0], [values[k] for k in (1, 2, 3)]

    def add(self, row: mi.UInt32, by_sigma: mi.Float, by_colour: list[mi.Float], on: mi.Bool) -> None:
        """Add derivatives by the values of :meth:`read`."""
        add_packet(self.slope, [by_sigma, *by_colour], self.first + row, on)


HALF_MAX = 65504.0
"""Largest number of a half float."""


@dataclass
class HalfColours:
    """Leaves as seen from one pinhole, in 8 bytes each, for views without derivatives.

    Numbers are rounded by at most 2^-11 of their size. An optical depth of a cell or a radiance above ``HALF_MAX`` counts as
    that.

    Attributes:
        table: half floats: optical depth of a smallest cell's edge, and rgb of each leaf.
        cell: edge of a smallest cell [length].
    """

    table: mi.Float
    cell: float

    @classmethod
    def round(cls, colours: LeafColours, cell: float) -> HalfColours:
        """Round the colours of a single pinhole."""
        is_extinction = dr.arange(mi.UInt32, dr.width(colours.table)) % 4 == 0
        values = dr.select(is_extinction, colours.table * dr.opaque(mi.Float, cell), colours.table)
        return cls(dr.float16_array_t(mi.Float)(dr.minimum(values, HALF_MAX)), cell)

    def read(self, row: mi.UInt32, on: mi.Bool) -> tuple[mi.Float, list[mi.Float]]:
        """Extinction and colour of leaves."""
        values = dr.gather(dr.float16_array_t(mi.ArrayXf), self.table, row, on, shape=(4, 1))
        return mi.Float(values[0]) * dr.opaque(mi.Float, 1 / self.cell), [mi.Float(values[k]) for k in (1, 2, 3)]


LeafSource = LeafColours | HalfColours


# -- Sources ---------------------------------------------------------------------------------------------------------------


@dataclass
class LeafPlaces:
    """Middles of leaves for the directions from pinholes.

    Attributes:
        middles: Float, x, y, z of each middle minus the middle of the cube, in the frame of the harmonics [length].
    """

    middles: mi.Float

    @classmethod
    def find(cls, tree: Octree) -> LeafPlaces:
        """Middles of the leaves of an octree; they depend on the topology only."""
        frame = tree.local_rotation() @ tree.to_world[:3, :3]
        return cls(mi.Float(np.float32((tree.middles() - 0.5) @ frame.T).reshape(-1)))


def make_leaf_colours(
    tree: Octree, places: LeafPlaces, points: np.ndarray, view: mi.UInt32, slope: bool = False
) -> LeafColours:
    """Sum the harmonics of each leaf in the directions from pinholes.

    Args:
        tree: octree.
        places: middles of its leaves.
        points: (V, 3) world, the pinholes.
        view: number of each ray's pinhole.
        slope: whether derivatives will be computed.

    Bias: the colour of a leaf is that of the direction to its middle; the direction of a ray differs by at most half the
        diagonal of the leaf over its distance [radian].
    Cost: the octree is read once a pinhole, and 4 numbers a leaf and pinhole are written.
    """
    table = dr.zeros(mi.Float, 4 * tree.leaves * len(points))
    every, count = dr.arange(mi.UInt32, tree.leaves), dr.opaque(mi.UInt32, tree.leaves)
    raw = dr.gather(mi.Float, tree.density, every)
    values = dr.gather(mi.ArrayXf, tree.harmonics, every, shape=(tree.width, 1))
    for number, point in enumerate(points):
        basis = _basis_from(tree, places, point)
        colour = tree.map_colours(sum_harmonics(values, basis, tree.offset))
        dr.scatter(table, mi.ArrayXf([raw, *colour]), every + dr.opaque(mi.UInt32, number) * count)
    return LeafColours(table, view * count, dr.zeros(mi.Float, dr.width(table)) if slope else None)


def _basis_from(tree: Octree, places: LeafPlaces, point: np.ndarray) -> list[mi.Float]:
    """Harmonics of the directions from a point (3,) to the middles of all leaves."""
    start = tree.local_rotation() @ (tree.middle - np.asarray(point, np.float64))
    middles = dr.gather(mi.Vector3f, places.middles, dr.arange(mi.UInt32, tree.leaves))
    d = middles + mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in start))
    length = dr.norm(d)
    return dr.sh_eval(dr.select(length > 0, d / length, mi.Vector3f(0, 0, 1)), tree.degree)


def vjp_leaf_colours(tree: Octree, places: LeafPlaces, source: LeafColours, points: np.ndarray) -> tuple[mi.Float, mi.Float]:
    """Derivatives by extinctions and harmonics, from those by the table: the transpose of :func:`make_leaf_colours`."""
    every, count = dr.arange(mi.UInt32, tree.leaves), dr.opaque(mi.UInt32, tree.leaves)
    density = dr.zeros(mi.Float, tree.leaves)
    harmonics = [dr.zeros(mi.Float, tree.leaves) for _ in range(tree.width)]
    for number, point in enumerate(points):
        at = every + dr.opaque(mi.UInt32, number) * count
        by, value = (dr.gather(mi.ArrayXf, a, at, shape=(4, 1)) for a in (source.slope, source.table))
        density += by[0]
        slopes = tree.colour_slopes([value[k] for k in (1, 2, 3)])
        by_sum = [by[1 + k] * slopes[k] for k in range(3)]
        for b, y in enumerate(_basis_from(tree, places, point)):
            for k in range(3):
                harmonics[3 * b + k] = dr.fma(y, by_sum[k], harmonics[3 * b + k])
    total = dr.zeros(mi.Float, tree.leaves * tree.width)
    dr.scatter(total, mi.ArrayXf(harmonics), every)
    return density, total


# -- Rays ------------------------------------------------------------------------------------------------------------------


@dataclass
class LeafRays:
    """The result of a render, and the state from which the sweep back starts.

    Attributes:
        colour: radiance, without light from behind the octree.
        T: transmittance of the ray; 0 beyond MAX_DEPTH.
        distance: expected depth times opacity [length]; 0 unless asked for.
        tau: optical depth up to the stop of the ray.
        first: distance at which the first leaf begins, from the entry into the cube [length].
        last: distance at which the last leaf ended.
        cell: a cell of the last leaf.
        rays: the rays.
    """

    colour: mi.Color3f
    T: mi.Float
    distance: mi.Float
    tau: mi.Float
    first: mi.Float
    last: mi.Float
    cell: mi.Vector3i
    rays: RayBundle


def render_leaves(
    index: LeafIndex, source: LeafSource, rays: RayBundle, depth: float = MAX_DEPTH, distances: bool = False
) -> LeafRays:
    """Follow rays through an octree.

    Args:
        index: index of the leaves.
        source: reader of the leaves.
        rays: world rays.
        depth: optical depth at which a ray ends; the rest is at most e^-depth of the brightest colour.
        distances: compute the expected depth.

    Error: none but rounding, beside the end at ``depth``. Cost: one packet a leaf with ``LeafColours``.
    """
    segment = clip_to_octree(index, rays.o, rays.d, rays.t_max)

    def visit(state: list, leaf: VisitedLeaf, on: mi.Bool) -> list:
        *light, T, tau, first = state
        sigma, colour = source.read(leaf.row, on)
        own = sigma * leaf.dt  # 0 in lanes without a leaf, whose extinction is read as 0
        # Weights and the transmittance sum to 1 up to rounding. A weight has an absolute error of 6e-8, as the light.
        through = dr.exp(-own)
        behind = T * through
        weight = T - behind
        light = [dr.fma(weight, c, s) for s, c in zip(light, [*colour, *([leaf.t] if distances else [])], strict=True)]
        if distances:
            light[3] = dr.fma(T * leaf.dt, _mean_place(own, through), light[3])
        return [*light, behind, tau + own, dr.select(on & (first < 0), leaf.t, first)]

    state = [*(mi.Float(0) for _ in range(4 if distances else 3)), mi.Float(1), mi.Float(0), mi.Float(-1)]
    state, cell, last = walk_leaves(index, segment, visit, state, True, lambda s: s[-2] > depth)
    *light, T, tau, first = state
    distance = dr.fma(1 - T, segment.t0, light[3]) if distances else mi.Float(0)
    return LeafRays(mi.Color3f(*light[:3]), T, distance, tau, fast_max(first, 0), last, cell, rays)


def _mean_place(tau: mi.Float, T: mi.Float) -> mi.Float:
    """Mean place of the light from a leaf, as a fraction of the way through it, times the opacity 1 - T, with T = e^-tau.

    This is (1 - T) / tau - T. It loses digits at small tau, where the light is weak: rounding of 1 - T is 6e-8 / tau at most,
    below 1.2e-6 from 0.05 on. The series tau / 2 - tau^2 / 3 has an error of tau^3 / 8, below 1.6e-5.
    """
    small = tau < 0.05
    return dr.select(small, tau * (0.5 - tau * (1 / 3)), (1 - T) * reciprocal(dr.select(small, 1, tau)) - T)


def raise_leaf_weights(index: LeafIndex, source: LeafSource, rays: RayBundle, weight: mi.Float) -> None:
    """Raise ``weight``, one number a leaf, to the largest compositing weight T alpha of the leaf on any ray."""

    def visit(state: list, leaf: VisitedLeaf, on: mi.Bool) -> list:
        own = dr.select(on, source.read(leaf.row, on)[0] * leaf.dt, 0)
        dr.scatter_reduce(dr.ReduceOp.Max, weight, dr.exp(-state[0]) * one_minus_exp(own), leaf.row, on)
        return [state[0] + own]

    segment = clip_to_octree(index, rays.o, rays.d, rays.t_max)
    active = dr.full(mi.Bool, True, dr.width(rays.d))
    walk_leaves(index, segment, visit, [mi.Float(0)], active, lambda state: state[0] > MAX_DEPTH)


def vjp_leaves(index: LeafIndex, source: LeafSource, rendered: LeafRays, by: RayGradient) -> None:
    """Add the derivatives of a scalar to the derivatives of the source.

    Args:
        index, source: arguments of :func:`render_leaves`.
        rendered: its result.
        by: derivatives of the scalar by ``colour`` and ``T``; a derivative by ``distance`` is not supported.

    Bias: none. Light from behind the end of a ray is left out. Cost: as :func:`render_leaves`, and a packet written a leaf.
    """
    rays = rendered.rays
    segment = clip_to_octree(index, rays.o, rays.d, rays.t_max)
    back = reverse_from(segment, rendered.cell, rendered.last, rendered.first, index)
    by_colour = [mi.Float(c) for c in by.colour]

    def visit(state: list, leaf: VisitedLeaf, on: mi.Bool) -> list:
        r, behind = state
        sigma, colour = source.read(leaf.row, on)
        own = dr.select(on, sigma * leaf.dt, 0)
        # The optical depth in front of the leaf; rounding of the sums must not make it negative.
        before = fast_max(behind - own, 0)
        front, alpha = dr.exp(-before), one_minus_exp(own)
        s = dr.fma(by_colour[0], colour[0], dr.fma(by_colour[1], colour[1], by_colour[2] * colour[2]))
        T = dr.exp(-own)
        weight = front * alpha
        source.add(leaf.row, front * T * (s - r) * leaf.dt, [weight * c for c in by_colour], on)
        return [dr.select(on, alpha * s + T * r, r), before]

    walk_leaves(index, back, visit, [mi.Float(by.T), mi.Float(rendered.tau)], rendered.last > 0)
