r"""Free flights through Gaussians: one in each, in closed form, of which the shortest counts.

.. math:: t = t_p + \frac{1}{|W\omega|}\,\Phi^{-1}\!\Big(\Phi(s_0) - \frac{\log(1 - u)}{s\,\tau}\Big)

Collisions with different Gaussians are independent, so a flight through their sum is the shortest of their own flights: nothing
is sorted, and no sum is inverted. A Gaussian is met in the cell where the ray enters it, so the walk ends in the cell of the
shortest flight.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mivol.fields.gaussian_line import Line
from mivol.numerics import greater, lesser
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.traversal.grid_walk import Cell
from mivol.transport.traversal.random_numbers import draw_pcg32

__all__ = ["collide_in_gaussians"]


def collide_in_gaussians(
    part: GaussianExtinction, scale: mi.Float, interval: RayInterval, rng: mi.UInt32
) -> tuple[mi.Float64, mi.UInt32]:
    """Find the first collision with Gaussians on an interval of a ray.

    Args:
        part: the Gaussians.
        scale: factor on their extinction.
        interval: of the ray; its end may be infinite.
        rng: state of the generator.

    Returns:
        Distance of the collision on the ray [length], infinite where there is none, and the next state.

    Bias: none but rounding. Cost: one walk to the collision, with a number drawn for each Gaussian that is met.
    """
    passage = part.enter(interval)

    def add(state: tuple, line: Line, index: mi.UInt32, ends: tuple[mi.Float, mi.Float]) -> tuple:
        nearest, reached, rng = state
        rng, (u,) = draw_pcg32(rng, 1)
        before = line.share_before(ends[0])
        goal = before - dr.log(1 - u) / (scale * line.depth)
        hits = goal < before + line.share(*ends)
        own = line.peak + math.sqrt(2) * dr.erfinv(dr.select(hits, 2 * goal - 1, 0)) / line.speed
        # Between its ends: in the tails a share of 1e-7 is a long way.
        own = lesser(greater(own, ends[0]), ends[1])
        return dr.select(hits & (own < nearest), own, nearest), reached, rng

    def leave(state: tuple, cell: Cell) -> tuple:
        return state[0], cell.s + cell.dt, state[2]

    width = dr.width(passage.d)
    start = (dr.full(mi.Float, dr.inf, width), dr.zeros(mi.Float, width), mi.UInt32(rng))
    nearest, _, rng = part.each_along(passage, start, add, lambda state: state[0] <= state[1], leave)
    return dr.select(dr.isfinite(nearest), passage.segment.start + mi.Float64(nearest), dr.inf), rng
