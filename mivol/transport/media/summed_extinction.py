r"""The sum of the parts of an extinction in one cell: grids that share their cells, and constants.

.. math:: \sigma(x) = s \sum_k f_k(x)

Conventions. Values are detached arrays; channels are 1 (grey) or 3 (rgb), and a grey part counts in each of them.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.activation import Activation
from mivol.transport.media.extinction import ExactExtinction
from mivol.transport.traversal.grid_walk import Nodes
from mivol.transport.traversal.interpolation import interpolate
from mivol.transport.traversal.lattice import Lattice

__all__ = ["SummedExtinction", "activate", "share_cells"]


class SummedExtinction:
    """The sum of the parts of an extinction for each channel: in a cell of their grids, and outside the grids.

    Args:
        parts: constants, and grids that share their cells.
        values: node values or constant of each part.
        scale: factor on the sum.
        linear: whether the values are tangents, which no activation is applied to.
    """

    def __init__(self, parts: list[ExactExtinction], values: list, scale: mi.Float, linear: bool = False) -> None:
        self.channels, self.scale = max(p.channels for p in parts), scale
        pairs = list(zip(parts, values, strict=True))
        self.activations = [None if linear else p.activation for p, _ in pairs if p.lattice is not None]
        self.reads = [Nodes(v, p.channels) for p, v in pairs if p.lattice is not None]
        self.has_constants = len(self.reads) < len(parts)
        constants = [_as_channels(v, p.channels) for p, v in pairs if p.is_constant]
        self.constant = [scale * sum((k[c % len(k)] for k in constants), mi.Float(0)) for c in range(self.channels)]

    def along(self, corners: list, points: list[mi.Vector3f]) -> list[list[mi.Float]]:
        """[channel][point] values at points of a cell (fractions from its near planes), from [read][channel][corner]."""
        pairs = list(zip(corners, self.activations, strict=False))
        grids = [
            [[activate(a, interpolate(g[c % len(g)], p)) for g, a in pairs] for p in points] for c in range(self.channels)
        ]
        return [
            [dr.fma(self.scale, sum(s, mi.Float(0)), k) for s in sums] for sums, k in zip(grids, self.constant, strict=True)
        ]

    def slopes(self, corners: list, points: list[mi.Vector3f]) -> list[mi.Float] | None:
        """Slope of the activation at points of a cell; None without one. A radiance field is the only part of its medium."""
        if not any(self.activations):
            return None
        return [self.activations[0].value_and_slope(interpolate(corners[0][0], p))[1] for p in points]


def share_cells(a: Lattice, b: Lattice) -> bool:
    """Whether two grids have the same resolution and place."""
    return a.res == b.res and np.array_equal(a.to_world, b.to_world)


def activate(activation: Activation | None, value: mi.Float) -> mi.Float:
    """The extinction of an interpolated value: the value itself without an activation."""
    return value if activation is None else activation.value_and_slope(value)[0]


def _as_channels(value: mi.Float | mi.Color3f, channels: int) -> list[mi.Float]:
    return [value.x, value.y, value.z] if channels == 3 else [mi.Float(value)]
