r"""Regular tracking: free flights in one part of an extinction, by inverting its exact optical depth.

.. math:: \int_{t_0}^{t} s f(x_{t'})\,dt' = -\log(1 - u), \qquad
          t = t_p + \frac{1}{|W\omega|}\,\Phi^{-1}\!\Big(\Phi(s_0) - \frac{\log(1 - u)}{s\,\tau}\Big)

The first equation is inverted cell by cell in grids. The second is its closed form for a Gaussian of optical depth tau with its
peak at t_p. Collisions with different Gaussians are independent, so the shortest of their own flights is the flight through
their sum: nothing is sorted, and no sum is inverted. A Gaussian is flown through in the cell where the ray enters it, so the
walk ends in the cell of the shortest flight.

References: Sutton et al. 1999 (regular tracking); Amanatides & Woo 1987 (the walk).
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mivol.fields.gaussian_line import WhitenedLine
from mivol.numerics import fast_max, fast_min
from mivol.transport.media.channels import to_scene_channels
from mivol.transport.media.extinction import ExactExtinction, RayInterval
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.grid_extinction import activate, clip_interval
from mivol.transport.traversal.grid_walk import Cell, NodeArray, corner_nodes, read_nodes, walk_cells
from mivol.transport.traversal.interpolation import (
    fit_cubic,
    gauss_points,
    integrate_cubic,
    interpolate,
    invert_cubic_integral,
)
from mivol.transport.traversal.lattice import points_of_piece
from mivol.transport.traversal.random_numbers import draw_pcg32

__all__ = ["regular_tracking", "sample_gaussian_flight"]


def regular_tracking(
    part: ExactExtinction,
    scale: mi.Float,
    interval: RayInterval,
    goal: mi.Float,
    channel: mi.UInt32,
) -> mi.Float64:
    """Find the first collision with a constant or a grid on an interval of a ray.

    Args:
        part: part of the extinction.
        scale: factor on its values.
        interval: interval of the ray; its end may be infinite.
        goal: optical depth up to the collision [1]: -log(1 - u) of a uniform random number u.
        channel: channel of an rgb extinction.

    Returns:
        Distance of the collision on the ray [length]; infinite without a collision.

    Bias: none, except for an extinction with an activation, interpolated by a cubic through four points of a cell. Cost: one
    walk up to the collision.
    """
    if part.is_constant:
        return _collide_in_constant(part, scale, interval, goal, channel)
    return _collide_in_grid(part, scale, interval, goal, channel)


def _collide_in_constant(
    part: ExactExtinction, scale: mi.Float, interval: RayInterval, goal: mi.Float, channel: mi.UInt32
) -> mi.Float64:
    sigma = _select_channel(part.eval_at(scale, interval.ray, interval.t0, interval.active), channel)
    t = mi.Float64(interval.t0) + mi.Float64(goal / sigma)
    return dr.select(interval.active & (sigma > 0) & (t < interval.t1), t, dr.inf)


def _collide_in_grid(
    part: ExactExtinction,
    scale: mi.Float,
    interval: RayInterval,
    goal: mi.Float,
    channel: mi.UInt32,
) -> mi.Float64:
    lattice, ray = part.lattice, interval.ray
    segment, width = clip_interval(lattice, interval), dr.width(ray)
    reads = [NodeArray(dr.detach(part.values), part.channels)]

    def visit(state: tuple, cell: Cell, on: mi.Bool) -> tuple:
        remaining, s, dt, collides = state
        corners = [_select_channel([row[q] for row in cell.corners[0]], channel) for q in range(8)]
        a, b = (activate(part.activation, interpolate(corners, p)) for p in gauss_points(cell))
        tau = 0.5 * cell.dt * scale * (a + b)
        ends = on & (tau >= remaining)
        s, dt = dr.select(ends, cell.s, s), dr.select(ends, cell.dt, dt)
        return dr.select(on & ~ends, remaining - tau, remaining), s, dt, collides | ends

    zero = dr.zeros(mi.Float, width)
    start = (mi.Float(goal), zero, zero, dr.full(mi.Bool, False, width))
    remaining, s, dt, collides = walk_cells(
        lattice, segment, visit, start, reads, interval.active, until=lambda state: state[3]
    )

    # -- The position of the collision inside its cell ---------------------------------------------------------------------
    begin = segment.start + mi.Float64(s)
    cell, points, inside = points_of_piece(lattice, ray, begin, dt, collides)
    nodes = corner_nodes(cell, dr.full(dr.mask_t(mi.Vector3f), True), lattice.res)
    rows = read_nodes(reads, nodes, inside)[0]
    corners = [_select_channel([row[q] for row in rows], channel) for q in range(8)]
    curve = fit_cubic(*(scale * activate(part.activation, interpolate(corners, p)) for p in points))
    x = invert_cubic_integral(curve, dt, remaining, integrate_cubic(curve, dt, mi.Float(1)))
    return dr.select(collides, begin + mi.Float64(x) * mi.Float64(dt), dr.inf)


def _select_channel(rows: list[mi.Float], channel: mi.UInt32) -> mi.Float:
    """Select the value of a channel; a grey part has one channel, and a mono variant uses the luminance of three."""
    rows = to_scene_channels(rows, 1) if mi.is_monochromatic else rows
    value = rows[0]
    for k, row in enumerate(rows[1:], 1):
        value = dr.select(channel == k, row, value)
    return value


def sample_gaussian_flight(
    part: GaussianExtinction, scale: mi.Float, interval: RayInterval, rng: mi.UInt32
) -> tuple[mi.Float64, mi.UInt32]:
    """Find the first collision with Gaussians on an interval of a ray.

    Args:
        part: the Gaussians.
        scale: factor on their extinction.
        interval: interval of the ray; its end may be infinite.
        rng: state of the random number generator.

    Returns:
        Distance of the collision on the ray [length], infinite without a collision, and the next state of the generator.

    Bias: none but rounding. Cost: one walk up to the collision, and one random number for each Gaussian on the way.
    """
    passage = part.enter(interval)

    def add(state: tuple, line: WhitenedLine, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> tuple:
        nearest, reached, rng = state
        rng, (u,) = draw_pcg32(rng, 1)
        before = line.share_up_to(ends[0])
        goal = before - dr.log(1 - u) / (scale * line.depth)
        hits = goal < before + line.share(*ends)
        t = line.peak + math.sqrt(2) * dr.erfinv(dr.select(hits, 2 * goal - 1, 0)) / line.speed
        # Clamp to the ends: in the tails, a share of 1e-7 is a long way.
        t = fast_min(fast_max(t, ends[0]), ends[1])
        return dr.select(hits & (t < nearest), t, nearest), reached, rng

    def leave(state: tuple, cell: Cell) -> tuple:
        return state[0], cell.s + cell.dt, state[2]

    width = dr.width(passage.d)
    start = (dr.full(mi.Float, dr.inf, width), dr.zeros(mi.Float, width), mi.UInt32(rng))
    nearest, _, rng = part.visit_gaussians(passage, start, add, lambda state: state[0] <= state[1], leave)
    return dr.select(dr.isfinite(nearest), passage.segment.start + mi.Float64(nearest), dr.inf), rng
