r"""Which cells of a grid hold matter of a field that is known only at points: a decayed maximum of sampled densities.

.. math:: v \leftarrow \max(0.95\, v,\; \sigma(x)), \qquad x \text{ uniform in the cell}

A cell is listed if v times a step's length is above a threshold, or above the mean of all cells if the mean is lower. The
maximum falls slowly, so a cell in which matter was found once stays listed for dozens of updates.

Bias. A sampled maximum is no bound. The optical depth lost in an unlisted cell is below the threshold for a cell as long as a
step where the samples found the maximum, and unknown elsewhere.

Conventions. The cells are those of :mod:`mivol.transport.traversal.occupied_cells`: along an axis with N nodes there are N + 1,
the first and the last of half the length. Values are extinctions [1/length].

References: Müller et al. 2022, appendix E.2 (the updates); Li et al. 2023 (nerfacc: the threshold by the mean).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.sampled_field import Region
from mivol.space import lattice_from_world
from mivol.transport.traversal.occupied_cells import CellIndex, OccupiedCells
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32

__all__ = ["Occupancy", "list_cells"]

DECAY = 0.95
THRESHOLD = 0.01
"""Optical depth of a step in a listed cell, unless the mean is lower."""

PASS = 1 << 18
"""Points evaluated at a time."""


@dataclass(frozen=True)
class Occupancy:
    """Decayed maxima of the cells of a grid.

    Attributes:
        res: nodes (Z, Y, X).
        to_world: (4, 4) float64, unit cube to world.
        values: Float, extinction of each cell [1/length], x fastest.
    """

    res: tuple[int, int, int]
    to_world: np.ndarray
    values: mi.Float

    @classmethod
    def full(cls, res: tuple[int, int, int], to_world: np.ndarray) -> Occupancy:
        """All cells are occupied."""
        return cls(res, to_world, dr.full(mi.Float, math.inf, math.prod(n + 1 for n in res)))

    @property
    def count(self) -> int:
        """Number of cells."""
        return math.prod(n + 1 for n in self.res)

    def refreshed(self, density: Callable[[mi.Point3f], mi.Float], u: float, share: float = 1.0) -> Occupancy:
        """Occupancy after an update.

        Args:
            density: extinction at points of the world [1/length].
            u: uniform number in [0, 1), the seed of the points.
            share: share of the cells to evaluate. Half of them are drawn from all cells, half from the cells above 0; 1
                evaluates each cell once.
        """
        if share >= 1:
            chosen = dr.arange(mi.UInt32, self.count)
        else:
            count = max(1, int(share * self.count / 2))
            _, (any_u, own_u) = draw_pcg32(seed_pcg32(dr.opaque(mi.Float, u), count, 1), 2)
            own = dr.compress(self.values > self.threshold())
            chosen = [pick_index(any_u, self.count)]
            if dr.width(own):
                chosen.append(dr.gather(mi.UInt32, own, pick_index(own_u, dr.width(own))))
            chosen = dr.concat(chosen)
        dr.eval(chosen)
        values = DECAY * dr.select(dr.isfinite(self.values), self.values, 0)
        dr.eval(values)
        state = seed_pcg32(dr.opaque(mi.Float, u), dr.width(chosen), 2)
        dr.eval(state)
        for start in range(0, dr.width(chosen), PASS):
            lane = start + dr.arange(mi.UInt32, min(PASS, dr.width(chosen) - start))
            cell = dr.gather(mi.UInt32, chosen, lane)
            _, places = draw_pcg32(dr.gather(mi.UInt32, state, lane), 3)
            p = self._point(cell, places)
            dr.eval(p)
            dr.scatter_reduce(dr.ReduceOp.Max, values, density(p), cell)
            dr.eval(values)
        return Occupancy(self.res, self.to_world, values)

    def threshold(self, step: float | None = None) -> float:
        """Extinction above which a cell is listed [1/length], for steps of a length; None: 0."""
        if step is None:
            return 0.0
        values = np.array(self.values)
        finite = values[np.isfinite(values)]
        return min(THRESHOLD / step, float(finite.mean())) if len(finite) else 0.0

    def region(self, step: float) -> Region:
        """The occupied cells, for samples at a distance of ``step`` [length]."""
        listed = mi.UInt8(self.values > dr.opaque(mi.Float, self.threshold(step)))
        dr.eval(listed)
        return Region(self.res, self.to_world, listed, step)

    def _point(self, cell: mi.UInt32, places: list[mi.Float]) -> mi.Point3f:
        """Points of the world at ``places`` in [0, 1]^3 of cells."""
        z, y, x = self.res
        counts = (x, y, z)
        indices = cell % (x + 1), cell // (x + 1) % (y + 1), cell // ((x + 1) * (y + 1))
        unit = [dr.clip((mi.Float(i) - 0.5 + u) / n, 0, 1) for i, u, n in zip(indices, places, counts, strict=True)]
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in self.to_world[:3]]
        return mi.Point3f(*(dr.fma(r[0], unit[0], dr.fma(r[1], unit[1], dr.fma(r[2], unit[2], r[3]))) for r in rows))


def pick_index(u: mi.Float, count: int) -> mi.UInt32:
    """The index from 0 to ``count`` - 1 of a uniform number."""
    # A number just below 1 is rounded to 1 in float32, once in some ten million draws: an index out of the array.
    return dr.minimum(mi.UInt32(u * count), count - 1)


def list_cells(region: Region) -> OccupiedCells:
    """The occupied cells of a region, for walks."""
    index, cells = CellIndex.find(region.res, 1, lambda cell: dr.gather(mi.UInt8, region.occupied, cell) > 0)
    to_lattice = [[dr.opaque(mi.Float64, float(v)) for v in row] for row in lattice_from_world(region.to_world, region.res)]
    none = mi.UInt32(0)
    return OccupiedCells(region.res, region.to_world, dr.width(cells), index, none, none, to_lattice)
