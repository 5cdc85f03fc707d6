r"""A tabulated phase function: linear in the cosine between nodes at arbitrary positions.

.. math:: p(c) = \frac{f(c)}{2\pi \int_{-1}^1 f\,dc}, \qquad f \text{ linear between } (c_i, f_i)

Conventions. Nodes rise from exactly -1 to exactly 1. :class:`mivol.phase.table.Table` is the checked data, float64 NumPy;
:class:`Lookup` is the same on Dr.Jit arrays. A node is stored as 1 - c and as 1 + c, so that the nodes of a forward peak of a
width of 1e-4 remain distinct in float32.

Source of the inversion inside a segment: the smaller root of the quadratic, written without cancellation as in Press et al.,
Numerical Recipes, section 5.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.phase.domain import LARGEST, WEIGHT
from mivol.phase.table import Table
from mivol.phase.turn import INV_TWO_PI, Turn

__all__ = ["Lookup"]


@dataclass
class Lookup:
    """The nodes of a table on Dr.Jit arrays. Its methods take the values as an argument, since they may be a parameter.

    Attributes:
        below_one, above_minus_one: (n,) 1 - c and 1 + c of the nodes.
        ratio: (n,) (1 + c) / (1 - c), rising from 0 to infinity: the key of the binary search.
        width: (n - 1,) differences of the cosines.
    """

    below_one: mi.Float
    above_minus_one: mi.Float
    ratio: mi.Float
    width: mi.Float

    @classmethod
    def of(cls, table: Table) -> Lookup:
        """Round a table's nodes."""
        c = table.cosines
        with np.errstate(divide="ignore"):
            ratio = (1 + c) / (1 - c)
        return cls(*(mi.Float(x.astype(np.float32)) for x in (1 - c, 1 + c, ratio, np.diff(c))))

    def normalise(self, values: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Projected values (0 to 1e30; all 1 where none is above 1e-30), their integral and their cumulative distribution.

        Args:
            values: (n,) as given.

        Returns:
            values (n,) and integral (1,) with derivatives; cumulative (n,), 0 to 1, without.
        """
        values = WEIGHT.project(values)
        values = dr.select(dr.max(dr.detach(values)) >= 1 / LARGEST, values, 1)
        i = dr.arange(mi.UInt32, len(self.width))
        parts = 0.5 * (dr.gather(mi.Float, values, i) + dr.gather(mi.Float, values, i + 1)) * self.width
        # In float32 the sum over a table of 1000 nodes would lose the digits of its narrow segments.
        sums = dr.cumsum(mi.Float64(dr.detach(parts)))
        total = dr.gather(mi.Float64, sums, len(self.width) - 1)
        cumulative = dr.zeros(mi.Float, len(self.ratio))
        dr.scatter(cumulative, mi.Float(sums / total), i + 1)
        return values, dr.sum(parts), cumulative

    def eval(self, turn: Turn, values: mi.Float, integral: mi.Float, active: mi.Bool = True) -> mi.Float:
        """Density [1/sr] at a turn: the first two results of :meth:`normalise` are its values and integral.

        Error: 1e-6 of the larger of the two values around it.
        """
        # The comparison is ratio (1 - c) < 1 + c, without a quotient: in inactive lanes both directions may be 0, and it 0/0.
        below, above = dr.detach(turn.below_one), dr.detach(turn.above_minus_one)
        n = len(self.width)
        i = dr.binary_search(0, n, lambda k: dr.gather(mi.Float, self.ratio, k, active) * below < above)
        i = dr.clip(dr.detach(mi.Int32(i)) - 1, 0, n - 1)
        part = self._offset(turn, i, active) * dr.rcp(dr.gather(mi.Float, self.width, i, active))
        part = dr.clip(part, 0, 1)
        left, right = (dr.gather(mi.Float, values, k, active) for k in (i, i + 1))
        return INV_TWO_PI * dr.fma(part, right - left, left) * dr.rcp(integral)

    def sample(
        self, u: mi.Float, values: mi.Float, integral: mi.Float, cumulative: mi.Float, active: mi.Bool = True
    ) -> Turn:
        """Draw a scattering angle with density :meth:`eval`, by exact inversion: a quadratic equation in each segment."""
        n = len(self.width)
        i = dr.binary_search(0, n, lambda k: dr.gather(mi.Float, cumulative, k, active) <= u)
        i = dr.clip(mi.Int32(i) - 1, 0, n - 1)
        width, left, right = (
            dr.gather(mi.Float, a, k, active) for a, k in ((self.width, i), (values, i), (values, i + 1))
        )
        area = (u - dr.gather(mi.Float, cumulative, i, active)) * integral
        slope = (right - left) * dr.rcp(width)
        # 2 area / (left + root) is the same as (root - left) / slope, which is 0/0 on a level segment.
        root = dr.sqrt(dr.maximum(dr.fma(2 * area, slope, left * left), 0))
        offset = 2 * area * dr.rcp(dr.select(left + root > 0, left + root, 1))
        offset = dr.clip(offset, 0, width)
        return Turn(
            dr.maximum(dr.gather(mi.Float, self.below_one, i, active) - offset, 0),
            dr.maximum(dr.gather(mi.Float, self.above_minus_one, i, active) + offset, 0),
        )

    def _offset(self, turn: Turn, i: mi.Int32, active: mi.Bool) -> mi.Float:
        """Difference of the cosine and node i, computed from 1 - c or 1 + c, whichever is smaller and so more accurate."""
        ahead = dr.gather(mi.Float, self.below_one, i, active) - turn.below_one
        behind = turn.above_minus_one - dr.gather(mi.Float, self.above_minus_one, i, active)
        return dr.select(turn.below_one < turn.above_minus_one, ahead, behind)
