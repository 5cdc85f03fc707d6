r"""Free flights in one part of an extinction by delta tracking: tentative collisions with a majorant, of which some are real.

A tentative collision at x is real with the probability sigma(x) / M, M the majorant there. In a grid M is the largest value of
each block of cells, and one of the eight corners of the cell is read, drawn with its trilinear weight as probability: a
collision is then real with the mean of corner / M, which is sigma(x) / M.

Conventions. The comparison is ``u M <= sigma``, with u in (0, 1): where sigma is M every collision is real, whatever u is.

References: Woodcock et al. 1965 (delta tracking); Szirmay-Kalos et al. 2011 (majorants of blocks); Hofmann et al. 2021 (a
corner in place of eight).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.transport.estimators.ratio_tracking import CoarseLattice, coarse_segment
from mivol.transport.media.bounded_extinction import BoundedExtinction
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.grid_extinction import GridExtinction, clip_interval
from mivol.transport.traversal.grid_walk import Cell, walk
from mivol.transport.traversal.random_numbers import draw_pcg32

__all__ = ["collide_in_blocks", "collide_in_bounded"]


def collide_in_blocks(
    part: GridExtinction,
    scale: mi.Float,
    interval: RayInterval,
    rng: mi.UInt32,
) -> tuple[mi.Float64, mi.UInt32]:
    """Find the first collision with a grey grid whose block ranges are known.

    Args:
        part: the grid.
        scale: factor on its values.
        interval: of the ray.
        rng: state of the generator.

    Returns:
        Distance of the collision on the ray [length], infinite where there is none; and the state of the generator.

    Bias: none. Cost: one step a block, and one read for each tentative collision: int M dt of them, at most.
    """
    lattice = part.lattice
    segment = clip_interval(lattice, interval)
    blocks, res, values = lattice.block_ranges, lattice.res, dr.detach(part.values)
    shift, ahead = blocks.shift, segment.d > 0
    speed = dr.abs(segment.d) * 2.0**-shift

    def visit(state: tuple, cell: Cell, on: mi.Bool) -> tuple[tuple, mi.Float]:
        left, s, found, rng = state
        (least,), above = blocks.at(cell.lower + 1, on)
        majorant = least + above
        rate = scale * majorant
        # -- To the end of the block, or to the next tentative collision --------------------------------------------------
        meets = on & (left < rate * cell.dt)
        dt = dr.select(meets, dr.minimum(left / rate, cell.dt), cell.dt)
        # -- Is it real? One corner of the cell there tells ------------------------------------------------------------------
        near = dr.fma(speed, dt, cell.frac)
        inside = dr.select(ahead, near, 1 - near) * (1 << shift)
        rng, u = draw_pcg32(rng, 5)
        node = (cell.lower + 1) * (1 << shift) - 1 + mi.Vector3i(dr.floor(inside + mi.Vector3f(*u[:3])))
        node = dr.clip(node, 0, mi.Vector3i(res[2] - 1, res[1] - 1, res[0] - 1))
        value = dr.gather(mi.Float, values, mi.UInt32((node.z * res[1] + node.y) * res[2] + node.x), meets)
        real = meets & (u[3] * majorant <= value)
        left = dr.select(meets, -dr.log(u[4]), dr.maximum(left - dr.select(on, rate * dt, 0), 0))
        return (left, dr.select(real, cell.s + dt, s), found | real, rng), dt

    width = dr.width(interval.ray)
    rng, (u,) = draw_pcg32(rng, 1)
    start = (-dr.log(u), dr.zeros(mi.Float, width), dr.full(mi.Bool, False, width), rng)
    coarse = CoarseLattice(tuple(n - 1 for n in blocks.res))
    _, s, found, rng = walk(
        coarse, coarse_segment(segment, shift), visit, start, (), interval.active, until=lambda state: state[2], halts=True
    )
    return dr.select(found, segment.start + mi.Float64(s), dr.inf), rng


def collide_in_bounded(
    part: BoundedExtinction,
    scale: mi.Float,
    interval: RayInterval,
    rng: mi.UInt32,
) -> tuple[mi.Float64, mi.UInt32]:
    """Find the first collision with a grey field of which no more than a majorant is known; as :func:`collide_in_blocks`.

    Cost: int M dt look-ups in the field's box.
    """
    ray = interval.ray
    begin, end = part.clip(interval)
    rate = scale * part.majorant

    def look(t: mi.Float, found: mi.Bool, rng: mi.UInt32, on: mi.Bool) -> tuple:
        rng, (u, chance) = draw_pcg32(rng, 2)
        # Where the majorant is 0 the next point is infinitely far.
        t = t - dr.log(u) / rate
        on &= t < end
        (value,) = part.eval_at(scale, ray, t, on)
        real = on & (chance * rate <= value)
        return t, found | real, rng, on & ~real

    none = dr.full(mi.Bool, False, dr.width(ray))
    start = (mi.Float(begin), none, mi.UInt32(rng), interval.active & (end > begin))
    t, found, rng, _ = dr.while_loop(start, lambda t, found, rng, on: on, look, label="collisions with a bounded medium")
    return dr.select(found, mi.Float64(t), dr.inf), rng
