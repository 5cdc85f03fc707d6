r"""Priors of a radiance field that act apart from the gradient: it varies little, most of it is empty, most of it is matte.

.. math:: TV = \sum_k \sqrt{\delta^2 + |\nabla_h v_k|^2}, \qquad S = \sum_k \log(1 + 2 \sigma_k^2)

Conventions. A prior moves values by itself, after the step that the photographs asked for, as decoupled weight decay does:
inside RMSprop's quotient the weakest prior would move a row that no ray touched by a whole learning rate (measured on the
still life from 12 views: 24.4 dB so, 25.7 dB without, 30.5 dB with all three moved apart). How far is a share of the learning
rate, for that is how far photographs that agree move a value. Differences go to the next node along each axis (0 at the
border; nodes that are not stored hold the vacuum).

References: Rudin, Osher & Fatemi 1992; Fridovich-Keil, Yu et al. 2022 (runs of voxels; the Cauchy prior is that of Hedman et
al. 2021); Loshchilov & Hutter 2019 (decoupling).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.spherical import SphericalGrid, is_covered
from mivol.optim.strategy import Strategy, of


@dataclass
class Neighbours:
    """Rows of the nodes around those that have a row.

    Attributes:
        after: UInt32 each, of the next node along x, y and z: the vacuum's where that is not stored, its own at the border and
            where an inner level covers the next.
        before: of the last node along x, y and z: its own where that is not stored and at the border.
    """

    after: list[mi.UInt32]
    before: list[mi.UInt32]

    @classmethod
    def of(cls, field: SphericalGrid) -> Neighbours:
        """Look them up."""
        z, y, x = field.res
        node = mi.UInt32(field.listed().astype(np.uint32))
        own = dr.arange(mi.UInt32, dr.width(node))
        found = cls([], [])
        for stride, n in ((1, x), (x, y), (x * y, z)):
            place = node // stride % n
            following = dr.select(place < n - 1, node + stride, node)
            following = dr.select(is_covered(following, field.res), node, following)
            found.after.append(field.row_of(following))
            before = field.row_of(dr.select(place > 0, node - stride, node))
            found.before.append(dr.select(before < dr.width(node), before, own))
        dr.eval(found)
        return found


@dataclass(frozen=True)
class Rows:
    """Where a prior acts: one parameter of a field, of so many numbers a row.

    Attributes:
        width: numbers a row.
        neighbours: the rows beside each row.
        rate: learning rate over the number of photographs, times ``unit``: what one photograph is worth in a step.
        unit: values times this have no unit.
        first: the row at which a prior begins that looks at a share of them.
        step: number of the step after which it acts.
    """

    width: int
    neighbours: Neighbours
    rate: float
    unit: float
    first: int
    step: int = 0


class DecoupledPrior(Strategy, tag="decoupled prior"):
    """A move of the values of one parameter after each step; ``is_spatial`` tells that it compares neighbours."""

    is_spatial: ClassVar[bool] = False

    weight: Annotated[float, of("photograph", "how many photographs, all asking for the same, hold against it", ge=0)] = 1.0

    def apply(self, values: mi.Float, rows: Rows) -> mi.Float:
        """Values after the move; a spatial prior takes them evaluated."""
        raise NotImplementedError


class Smoothness(DecoupledPrior, tag="smoothness"):
    """Total variation over a share of the rows at a time. Source: Rudin, Osher and Fatemi 1992.

    To look at a share of the rows copies all of them: every few steps, at as many shares at once, says the same for less.
    """

    is_spatial = True
    cites = ("rudin_1992",)

    share: Annotated[float, of("1", "of the rows that are looked at, a step", gt=0, le=1)] = 1 / 8
    every: Annotated[int, of("step", "from one look to the next, which takes the shares of all between", ge=1)] = 1

    def apply(self, values: mi.Float, rows: Rows) -> mi.Float:
        if rows.step % self.every:
            return values
        moved = mi.Float(values)
        smooth(moved, rows, self.every * self.weight, min(self.every * self.share, 1))
        return moved


class Sparsity(DecoupledPrior, tag="sparsity"):
    """The Cauchy prior on a density. Source: Hedman et al. 2021."""

    def apply(self, values: mi.Float, rows: Rows) -> mi.Float:
        return sparsify(values, rows.rate * self.weight, rows.unit)


class ViewDependence(DecoupledPrior, tag="view_dependence"):
    """Decay of what goes with the direction: few photographs say more about it than there is."""

    def apply(self, values: mi.Float, rows: Rows) -> mi.Float:
        return decay_view_dependence(values, rows.width, rows.rate * self.weight)


def smooth(values: mi.Float, rows: Rows, weight: float, share: float) -> None:
    """Move a run of rows down the slope of the total variation.

    A step down a slope of 1 has the length amount = rate * weight / unit. A row is in four terms, its own and those of the
    three nodes before it. With delta = 6 amount / share none of them moves it by more than a sixth of a difference, so what
    was between the smallest and the largest value stays there.

    Args:
        values: moved in place.
        rows: how they lie.
        weight: of the prior; 0 moves nothing.
        share: of the rows that are moved; they stand for all.

    Cost: 13 rows read a row that is moved, and one written: by one lane, so nothing is added at once.
    """
    amount = rows.rate * weight / rows.unit
    if amount == 0:
        return
    around, width = rows.neighbours, rows.width
    count = dr.width(around.after[0])
    row = (dr.arange(mi.UInt32, max(int(count * share), 1)) + dr.opaque(mi.UInt32, rows.first)) % count
    length = dr.opaque(mi.Float, amount / share)

    def numbers(row: mi.UInt32) -> mi.ArrayXf:
        return dr.gather(mi.ArrayXf, values, row, shape=(width, 1))

    here = numbers(row)
    terms = [(here, [numbers(dr.gather(mi.UInt32, after, row)) for after in around.after])]
    for axis, before in enumerate(around.before):
        # Where there is none it is the row itself, and its difference to the row 0.
        node = dr.gather(mi.UInt32, before, row)
        ends = [here if a == axis else numbers(dr.gather(mi.UInt32, after, node)) for a, after in enumerate(around.after)]
        terms.append((numbers(node), ends))
    moved = []
    for c in range(width):
        own, *others = (_slopes([end[c] - at[c] for end in ends], 6 * length) for at, ends in terms)
        moved.append(dr.fma(length, sum(own) - sum(slopes[axis] for axis, slopes in enumerate(others)), here[c]))
    dr.scatter(values, mi.ArrayXf(moved), row)


def _slopes(steps: list[mi.Float], delta: mi.Float) -> list[mi.Float]:
    """Derivatives of the length of a difference with respect to its parts."""
    return [s * dr.rsqrt(dr.square(delta) + sum(dr.square(s) for s in steps)) for s in steps]


def sparsify(density: mi.Float, amount: float, unit: float) -> mi.Float:
    """Density after a step of ``amount`` [1] down the Cauchy prior's slope, in units of 1 / ``unit``; it ends at 0."""
    if amount == 0:
        return density
    sigma = dr.maximum(density * unit, 0)
    step = dr.opaque(mi.Float, 4 * amount) * sigma / (1 + 2 * dr.square(sigma))
    return density - dr.minimum(step, sigma) * (1 / unit)


def decay_view_dependence(harmonics: mi.Float, width: int, share: float) -> mi.Float:
    """Coefficients, ``width`` a row, of which all but the three constant ones have lost a share."""
    if share == 0:
        return harmonics
    kept = dr.opaque(mi.Float, 1 - min(share, 1))
    return dr.select(dr.arange(mi.UInt32, dr.width(harmonics)) % width < 3, harmonics, harmonics * kept)
