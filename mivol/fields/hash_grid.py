r"""A radiance field of a multi-resolution hash grid and two small networks.

.. math:: \sigma = s\, e^{h_0}, \qquad h = D(e(x)), \qquad c = S\big(C(h, Y(\omega))\big)

e(x) are the features of the levels, interpolated trilinearly between the nodes of each level; D and C are dense networks, Y the
spherical harmonics of the direction of travel, S the logistic function for sRGB code values and the exponential for radiance.
The exponents are cut at 15: beyond, the value stays and the derivative is that at the cut. ``s`` is 1 over half the longest
edge of the box, so an untrained field has an optical depth of about 1 across the box in any unit of length.

Levels. Level l has about ``coarsest`` (finest / coarsest)^(l / (levels - 1)) cubic cells along the longest edge of the box. The
nodes of a level that has at most 2^``log2_table`` of them are stored one by one. A finer level stores 2^``log2_table`` rows,
and the hash of a node selects a row, which several nodes share.

Conventions. ``table`` is (rows, features), level by level, x fastest; ``density_weights`` and ``colour_weights`` are arrays of
:class:`mivol.fields.networks.Network`. On a CPU the networks multiply matrices of many points by BLAS, and the encoding has
derivatives by hand; on a GPU Dr.Jit differentiates a kernel.

References: Müller, Evans, Schied, Keller 2022 (encoding, hash, activations, first values); Tancik et al. 2023 (truncated
exponential).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import SPACES, basis_size
from mivol.fields.networks import Network
from mivol.fields.sampled_field import PointValues, Region

__all__ = ["HashField", "HashSizes", "Level"]

PRIMES = 1, 2654435761, 805459861
"""Factors of the hash (Müller et al. 2022, eq. 4)."""

MAX_EXPONENT = 15.0
"""Cut of the exponents: exp(15) = 3e6."""

BLOCK = 8192
"""Points that are multiplied together: their rows of all layers stay in the cache of a core."""

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

    def place_levels(self, edges: np.ndarray) -> list[Level]:
        """The levels in a box with the edges (x, y, z)."""
        growth = (self.finest / self.coarsest) ** (1 / max(self.levels - 1, 1))
        placed, first = [], 0
        for number in range(self.levels):
            longest = self.coarsest * growth**number
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

    def encode(self, table: mi.Float, unit: mi.Point3f, active: mi.Bool = True) -> list[mi.Float]:
        """Features of points of the unit cube; attached to the table."""
        width, features = self.sizes.features, []
        for level in self.levels:
            sums = [mi.Float(0)] * width
            for row, weight in _corners(level, unit):
                if width == 1:
                    values = [dr.gather(mi.Float, table, row, active, mode=_reduce_mode())]
                else:
                    values = dr.gather(mi.ArrayXf, table, row, active, mode=_reduce_mode(), shape=(width, 1))
                sums = [dr.fma(values[k], weight, total) for k, total in enumerate(sums)]
            features += sums
        return features

    def add_features(self, unit: mi.Point3f, slopes: list[mi.Float], target: mi.Float, active: mi.Bool = True) -> None:
        """Add derivatives by the features of points to the derivatives by the table: the transpose of :meth:`encode`."""
        width = self.sizes.features
        for number, level in enumerate(self.levels):
            own = slopes[number * width : (number + 1) * width]
            for row, weight in _corners(level, unit):
                values = own[0] * weight if width == 1 else mi.ArrayXf([slope * weight for slope in own])
                dr.scatter_add(target, values, row, active, mode=_reduce_mode())


@dataclass(frozen=True, repr=False)
class HashField:
    """A hash grid with its networks, as a :class:`mivol.fields.sampled_field.SampledField`.

    Attributes:
        sizes: of grid and networks.
        to_world: (4, 4) float64, unit cube to world.
        table: Float, features, [row][feature].
        density_weights, colour_weights: Float, weights of the networks.
        space: "srgb" or "linear", of the colours.
        region: cells in which the field is not 0; None before a fit.
        white: factor on the colours.
    """

    sizes: HashSizes
    to_world: np.ndarray
    table: mi.Float
    density_weights: mi.Float
    colour_weights: mi.Float
    space: str = "srgb"
    region: Region | None = None
    white: float = 1.0

    def __post_init__(self) -> None:
        if self.space not in SPACES:
            raise MivolError(f"found the space {self.space!r}, expected one of {', '.join(SPACES)}.")
        expected = self.shapes()
        for name, shape in expected.items():
            values = getattr(self, name)
            if dr.width(values) != math.prod(shape):
                size = " x ".join(str(n) for n in shape)
                raise MivolError(f"{name} has {dr.width(values)} numbers, expected {size} by the sizes of this hash grid.")

    def __repr__(self) -> str:
        sizes, numbers = self.sizes, sum(math.prod(shape) for shape in self.shapes().values())
        return f"HashField({sizes.levels} levels of {sizes.coarsest} to {sizes.finest} cells, {numbers} numbers, {self.space})"

    @classmethod
    def random(cls, sizes: HashSizes, to_world: np.ndarray, seed: int = 0, space: str = "srgb") -> HashField:
        """An untrained field: small random features, random weights."""
        rng = np.random.default_rng(seed)
        table = HashEncoding(sizes, to_world).first_table(rng).ravel()
        weights = [network.first_weights(rng) for network in (sizes.density_network, sizes.colour_network)]
        return cls(sizes, np.asarray(to_world, np.float64), mi.Float(table), *map(mi.Float, weights), space)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each parameter, by name."""
        return {
            "table": self.encoding.shape,
            "density_weights": (self.sizes.density_network.size,),
            "colour_weights": (self.sizes.colour_network.size,),
        }

    def parameters(self) -> dict[str, mi.TensorXf]:
        return {name: mi.TensorXf(getattr(self, name), shape) for name, shape in self.shapes().items()}

    def with_parameters(self, values: dict[str, mi.TensorXf]) -> HashField:
        return replace(self, **{name: values[name].array for name in self.shapes()})

    def scale_colours(self, white: float) -> HashField:
        """The field with its radiance multiplied by a number; sRGB code values are only multiplied by 1."""
        return replace(self, white=self.white * white)

    @property
    def scale(self) -> float:
        """Density of an untrained field [1/length]."""
        return 2 / float(self.encoding.edges.max())

    @cached_property
    def encoding(self) -> HashEncoding:
        """The levels in the box."""
        return HashEncoding(self.sizes, self.to_world)

    # -- Values in the lanes of a kernel ------------------------------------------------------------------------------

    def eval_density(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float:
        """Extinction at points in the lanes of a kernel; attached to the parameters."""
        return self._lane_density(self._lane_geometry(p, active))

    def eval(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool = True) -> tuple[mi.Float, mi.Color3f]:
        """Extinction and colour at points in the lanes of a kernel; attached to the parameters."""
        geometry = self._lane_geometry(p, active)
        inputs = [*geometry, *dr.sh_eval(d, self.sizes.degree)]
        raw = Network.eval_lanes(self.sizes.colour_network.pack(self.colour_weights), inputs)
        if self.space == "linear":
            return self._lane_density(geometry), mi.Color3f(*(self.white * dr.exp(dr.minimum(v, MAX_EXPONENT)) for v in raw))
        return self._lane_density(geometry), mi.Color3f(*(dr.rcp(1 + dr.exp(-v)) for v in raw))

    def _lane_geometry(self, p: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        layers = self.sizes.density_network.pack(self.density_weights)
        return Network.eval_lanes(layers, self.encoding.encode(self.table, self.encoding.to_unit(p), active))

    def _lane_density(self, geometry: list[mi.Float]) -> mi.Float:
        return self.scale * dr.exp(dr.minimum(geometry[0], MAX_EXPONENT))

    # -- Values of points in memory -----------------------------------------------------------------------------------

    def density(self, p: mi.Point3f) -> mi.Float:
        if not _has_blas():
            return dr.detach(self.eval_density(p))
        x = self._feature_rows(self.encoding.to_unit(p))
        layers = self.sizes.density_network.layers(self.density_weights.numpy())
        sigma = dr.empty(mi.Float, len(x))
        out = sigma.numpy()
        for block in _blocks(len(x)):
            out[block] = self._density_of(Network.forward(layers, x[block])[-1][:, 0])
        return sigma

    def evaluate(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        return self._evaluate_rows(p, d) if _has_blas() else self._evaluate_lanes(p, d)

    def _evaluate_lanes(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        """Values by a kernel, which Dr.Jit differentiates."""
        attached = self.with_parameters(self.parameters())
        arrays = {name: getattr(attached, name) for name in self.shapes()}
        dr.enable_grad(arrays)
        sigma, colour = attached.eval(p, d)

        def vjp(dsigma: mi.Float, dcolour: mi.Color3f) -> dict[str, mi.Float]:
            dr.backward_from(sigma * dsigma + dr.dot(colour, dcolour))
            return {name: dr.grad(array) for name, array in arrays.items()}

        return PointValues(dr.detach(sigma), dr.detach(colour), vjp)

    def _evaluate_rows(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        """Values by products of matrices; the adjoint computes the hidden layers again, block by block."""
        unit = self.encoding.to_unit(p)
        dr.eval(unit)
        x, basis = self._feature_rows(unit), _rows(list(dr.sh_eval(d, self.sizes.degree)))
        sigma, colour = dr.empty(mi.Float, len(x)), dr.empty(mi.Float, 3 * len(x))
        sigma_rows, colour_rows = sigma.numpy(), colour.numpy().reshape(-1, 3)
        density, colours = self._layers()
        for block in _blocks(len(x)):
            geometry = Network.forward(density, x[block])[-1]
            raw = Network.forward(colours, np.concatenate([geometry, basis[block]], axis=1))[-1]
            sigma_rows[block], colour_rows[block] = self._density_of(geometry[:, 0]), self._colour_of(raw)

        def vjp(dsigma: mi.Float, dcolour: mi.Color3f) -> dict[str, mi.Float]:
            return self._vjp_rows(unit, x, basis, dsigma, dcolour)

        return PointValues(sigma, mi.Color3f(dr.unravel(mi.Color3f, colour)), vjp)

    def _vjp_rows(
        self, unit: mi.Point3f, x: np.ndarray, basis: np.ndarray, dsigma: mi.Float, dcolour: mi.Color3f
    ) -> dict[str, mi.Float]:
        by_sigma, by_colour = _rows([dsigma])[:, 0], _rows(list(dcolour))
        density, colours = self._layers()
        gradient = {name: np.zeros(self.shapes()[name], np.float32) for name in ("density_weights", "colour_weights")}
        density_gradient = self.sizes.density_network.layers(gradient["density_weights"])
        colour_gradient = self.sizes.colour_network.layers(gradient["colour_weights"])
        slopes = dr.empty(mi.Float, x.size)
        slope_rows = slopes.numpy().reshape(x.shape)
        for block in _blocks(len(x)):
            rows = Network.forward(density, x[block])
            inputs = np.concatenate([rows[-1], basis[block]], axis=1)
            colour_rows = Network.forward(colours, inputs)
            values = self._colour_of(colour_rows[-1])
            slope = values if self.space == "linear" else values * (1 - values)
            by_inputs = Network.backward(colours, colour_rows, by_colour[block] * slope, colour_gradient)
            by_geometry = by_inputs[:, : self.sizes.geometry]
            by_geometry[:, 0] += by_sigma[block] * self._density_of(rows[-1][:, 0])
            slope_rows[block] = Network.backward(density, rows, by_geometry, density_gradient)
        target, lane, width = dr.zeros(mi.Float, dr.width(self.table)), dr.arange(mi.UInt32, len(x)), x.shape[1]
        dr.eval(target)
        row = dr.gather(mi.ArrayXf, slopes, lane, shape=(width, 1))
        self.encoding.add_features(unit, [row[k] for k in range(width)], target)
        dr.eval(target)
        return {"table": target} | {name: mi.Float(values) for name, values in gradient.items()}

    def _layers(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        return (
            self.sizes.density_network.layers(self.density_weights.numpy()),
            self.sizes.colour_network.layers(self.colour_weights.numpy()),
        )

    def _density_of(self, raw: np.ndarray) -> np.ndarray:
        return self.scale * np.exp(np.minimum(raw, MAX_EXPONENT))

    def _colour_of(self, raw: np.ndarray) -> np.ndarray:
        if self.space == "linear":
            return self.white * np.exp(np.minimum(raw, MAX_EXPONENT))
        return 1 / (1 + np.exp(-np.clip(raw, -80, 80)))

    def _feature_rows(self, unit: mi.Point3f) -> np.ndarray:
        return _rows(self.encoding.encode(self.table, unit))


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


def _has_blas() -> bool:
    """Whether the arrays lie in the memory of the CPU, where NumPy reads them without a copy."""
    return dr.backend_v(mi.Float) == dr.JitBackend.LLVM


def _rows(columns: list[mi.Float]) -> np.ndarray:
    """Numbers of points as rows (N, columns) of one array in memory, without a copy of Dr.Jit's memory."""
    count = dr.width(columns)
    rows = dr.empty(mi.Float, count * len(columns))
    dr.scatter(rows, mi.ArrayXf(columns) if len(columns) > 1 else columns[0], dr.arange(mi.UInt32, count))
    dr.eval(rows)
    dr.sync_thread()
    return rows.numpy().reshape(count, len(columns))


def _blocks(count: int) -> list[slice]:
    return [slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK)]
