r"""The levels of a hash grid: features of points, interpolated in tables of several resolutions.

Level l has about ``coarsest`` (finest / coarsest)^(l / (levels - 1)) cubic cells along the longest edge of the box. The nodes
of a level that has at most 2^``log2_table`` of them are stored one by one. A finer level stores 2^``log2_table`` rows, and the
hash of a node selects a row, which several nodes share.

Conventions. A table is (rows, features), level by level, x fastest. Features of points in the unit cube of the box are
trilinear between the nodes of each level.

Reference: Müller, Evans, Schied, Keller 2022.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import basis_size
from mivol.fields.networks import Network

__all__ = ["HashEncoding", "HashSizes", "Level"]

PRIMES = 1, 2654435761, 805459861
"""Factors of the hash (Müller et al. 2022, eq. 4)."""

FIRST = 1e-4
"""Bound of the first values of the table."""

LIMITS = {
    "levels": (1, 32), "features": (1, 8), "log2_table": (4, 24), "coarsest": (1, 1 << 20), "finest": (1, 1 << 20),
    "width": (1, 1024), "density_layers": (0, 16), "colour_layers": (0, 16), "geometry": (1, 256), "degree": (0, 4),
}  # fmt: skip
"""Smallest and largest values of :class:`HashSizes`."""


@dataclass(frozen=True)
class Level:
    """A level of a hash grid: cells (x, y, z), first row, stored rows, and whether each node has its own row."""

    cells: tuple[int, int, int]
    first: int
    rows: int
    is_dense: bool


@dataclass(frozen=True)
class HashSizes:
    """Sizes of a hash grid and its networks.

    Attributes:
        levels: number of levels.
        features: numbers a row, 1, 2, 4 or 8.
        log2_table: logarithm of the most rows of a level.
        coarsest, finest: cells along the longest edge of the box, of the first and of the last level.
        width: neurons of a hidden layer.
        density_layers, colour_layers: hidden layers of the networks.
        geometry: outputs of the density's network; the first is the logarithm of the density, and all enter the colour's.
        degree: of the harmonics of the direction.
    """

    levels: int = 8
    features: int = 2
    log2_table: int = 17
    coarsest: int = 16
    finest: int = 256
    width: int = 32
    density_layers: int = 1
    colour_layers: int = 1
    geometry: int = 16
    degree: int = 2

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            if not low <= getattr(self, name) <= high:
                raise MivolError(f"found a hash grid with {name} = {getattr(self, name)}, expected {low} to {high}.")
        if self.features not in (1, 2, 4, 8):
            raise MivolError(f"found a hash grid with features = {self.features}, expected 1, 2, 4 or 8.")
        if self.coarsest > self.finest:
            raise MivolError(f"found levels from {self.coarsest} to {self.finest} cells, expected the coarsest first.")

    @property
    def density_network(self) -> Network:
        """The network from features to density and geometry."""
        return Network((self.levels * self.features, *[self.width] * self.density_layers, self.geometry))

    @property
    def colour_network(self) -> Network:
        """The network from geometry and harmonics to colour."""
        return Network((self.geometry + basis_size(self.degree), *[self.width] * self.colour_layers, 3))

    @property
    def weights(self) -> int:
        """Weights of both networks."""
        return self.density_network.size + self.colour_network.size

    @property
    def growth(self) -> float:
        """Cells of a level along an edge over those of the level before."""
        return (self.finest / self.coarsest) ** (1 / max(self.levels - 1, 1))

    def count_numbers(self, edges: np.ndarray) -> int:
        """Number of fitted numbers, in a box with the edges (x, y, z)."""
        rows = sum(level.rows for level in self.place_levels(edges))
        return rows * self.features + self.weights

    def describe(self, edges: np.ndarray) -> tuple[str, str]:
        """Levels in a box with the edges (x, y, z), and their numbers."""
        numbers = self.count_numbers(edges) - self.weights
        return (
            f"{self.levels} levels of {self.coarsest} to {self.finest} cells, {self.features} features each",
            f"{numbers} numbers in at most {1 << self.log2_table} rows a level, and {self.weights} weights of networks",
        )

    def place_levels(self, edges: np.ndarray) -> list[Level]:
        """The levels in a box with the edges (x, y, z)."""
        placed, first = [], 0
        for number in range(self.levels):
            longest = self.coarsest * self.growth**number
            cells = tuple(max(1, round(float(longest * edge / edges.max()))) for edge in edges)
            nodes = math.prod(n + 1 for n in cells)
            is_dense = nodes <= 1 << self.log2_table
            placed.append(Level(cells, first, nodes if is_dense else 1 << self.log2_table, is_dense))
            first += placed[-1].rows
        return placed


@dataclass(frozen=True)
class HashEncoding:
    """The levels of a hash grid in a box, and the features of points.

    Attributes:
        sizes: of the hash grid.
        to_world: (4, 4) float64, unit cube to world.
    """

    sizes: HashSizes
    to_world: np.ndarray

    @cached_property
    def edges(self) -> np.ndarray:
        """Edges of the box (x, y, z) [length]."""
        return np.linalg.norm(self.to_world[:3, :3], axis=0)

    @cached_property
    def levels(self) -> list[Level]:
        """The levels in the box."""
        return self.sizes.place_levels(self.edges)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the table, (rows, features)."""
        return sum(level.rows for level in self.levels), self.sizes.features

    def first_table(self, rng: np.random.Generator) -> np.ndarray:
        """Small random features."""
        return rng.uniform(-FIRST, FIRST, self.shape).astype(np.float32)

    def to_unit(self, p: mi.Point3f) -> mi.Point3f:
        """Points of the world in the unit cube."""
        rows = np.linalg.inv(self.to_world)[:3]
        opaque = [[dr.opaque(mi.Float, float(v)) for v in row] for row in rows]
        return mi.Point3f(*(dr.fma(r[0], p.x, dr.fma(r[1], p.y, dr.fma(r[2], p.z, r[3]))) for r in opaque))

    def encode(self, table: mi.Float | mi.Float16, unit: mi.Point3f, active: mi.Bool = True) -> list[mi.Float]:
        """Features of points of the unit cube; attached to the table."""
        width, features = self.sizes.features, []
        packet = dr.replace_type_t(mi.ArrayXf, dr.type_v(table))
        for level in self.levels:
            sums = [mi.Float(0)] * width
            for row, weight in _corners(level, unit):
                if width == 1:
                    values = [dr.gather(type(table), table, row, active, mode=_reduce_mode())]
                else:
                    values = dr.gather(packet, table, row, active, mode=_reduce_mode(), shape=(width, 1))
                sums = [dr.fma(mi.Float(values[k]), weight, total) for k, total in enumerate(sums)]
            features += sums
        return features

    def add_features(self, unit: mi.Point3f, slopes: list[mi.Float], target: mi.Float) -> None:
        """Add derivatives by the features of points to the derivatives by the table: the transpose of :meth:`encode`."""
        width = self.sizes.features
        for number, level in enumerate(self.levels):
            own = slopes[number * width : (number + 1) * width]
            for row, weight in _corners(level, unit):
                values = own[0] * weight if width == 1 else mi.ArrayXf([slope * weight for slope in own])
                dr.scatter_add(target, values, row, mode=_reduce_mode())


def _corners(level: Level, unit: mi.Point3f) -> Iterator[tuple[mi.UInt32, mi.Float]]:
    """Rows of the 8 nodes around points of the unit cube, and their trilinear weights."""
    lower, upper, weights, stride = [], [], [], 1
    for axis, cells in enumerate(level.cells):
        place = dr.clip(unit[axis], 0, 1) * cells
        node = dr.minimum(mi.UInt32(place), cells - 1)
        share = place - mi.Float(node)
        factor = stride if level.is_dense else PRIMES[axis]
        lower.append(node * mi.UInt32(factor))
        upper.append(lower[-1] + mi.UInt32(factor))
        weights.append((1 - share, share))
        stride *= cells + 1
    for corner in range(8):
        bits = [corner >> axis & 1 for axis in range(3)]
        x, y, z = (upper[a] if bit else lower[a] for a, bit in enumerate(bits))
        row = x + y + z if level.is_dense else (x ^ y ^ z) & mi.UInt32(level.rows - 1)
        yield row + level.first, weights[0][bits[0]] * weights[1][bits[1]] * weights[2][bits[2]]


def _reduce_mode() -> dr.ReduceMode:
    """How derivatives are added: on a CPU each thread adds to a copy of its own, without atomics."""
    return dr.ReduceMode.Expand if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else dr.ReduceMode.Auto
