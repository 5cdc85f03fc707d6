r"""A radiance field of a multi-resolution hash grid and two small networks.

.. math:: \sigma = s\, e^{h_0}, \qquad h = D(e(x)), \qquad c = S\big(C(h, Y(\omega))\big)

e(x) are the features of the levels, interpolated trilinearly between the nodes of each level; D and C are dense networks, Y the
spherical harmonics of the direction of travel, S the logistic function for sRGB code values and the exponential for radiance.
The exponents are cut at 15: beyond, the value stays and the derivative is that at the cut. ``s`` is 1 over half the longest
edge of the box, so an untrained field has an optical depth of about 1 across the box in any unit of length.

Conventions. ``table`` is that of :mod:`mivol.fields.hash_encoding`; ``density_weights`` and ``colour_weights`` are arrays of
:class:`mivol.fields.networks.Network`. On a CPU the networks multiply matrices of many points by BLAS, and the encoding has
derivatives by hand; on a GPU Dr.Jit differentiates a kernel.

References: Müller, Evans, Schied, Keller 2022 (encoding, hash, activations, first values); Tancik et al. 2023 (truncated
exponential).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import SPACES
from mivol.fields.hash_encoding import HashEncoding, HashSizes
from mivol.fields.networks import Network
from mivol.fields.sampled_field import PointValues, Region
from mivol.threads import map_arrays

__all__ = ["HashField"]

MAX_EXPONENT = 15.0
"""Cut of the exponents: exp(15) = 3e6."""

BLOCK = 8192
"""Points that are multiplied together: their rows of all layers stay in the cache of a core."""


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
            return self._lane_density(geometry), mi.Color3f(*(self.white * dr.exp(_cut(v)) for v in raw))
        return self._lane_density(geometry), mi.Color3f(*(dr.rcp(1 + dr.exp(-v)) for v in raw))

    def _lane_geometry(self, p: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        layers = self.sizes.density_network.pack(self.density_weights)
        return Network.eval_lanes(layers, self.encoding.encode(self.table, self.encoding.to_unit(p), active))

    def _lane_density(self, geometry: list[mi.Float]) -> mi.Float:
        return self.scale * dr.exp(_cut(geometry[0]))

    # -- Values of points in memory -----------------------------------------------------------------------------------

    def density(self, p: mi.Point3f) -> mi.Float:
        if not _has_blas():
            return dr.detach(self.eval_density(p))
        x = self._feature_rows(self.encoding.to_unit(p))
        layers = self.sizes.density_network.layers(self.density_weights.numpy())
        sigma = dr.empty(mi.Float, len(x))
        out = sigma.numpy()

        def evaluate(block: slice) -> None:
            out[block] = self._density_of(Network.forward(layers, x[block])[-1][:, 0])

        map_arrays(evaluate, _blocks(len(x)), dr.thread_count())
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

        def evaluate(block: slice) -> None:
            geometry = Network.forward(density, x[block])[-1]
            raw = Network.forward(colours, np.concatenate([geometry, basis[block]], axis=1))[-1]
            sigma_rows[block], colour_rows[block] = self._density_of(geometry[:, 0]), self._colour_of(raw)

        map_arrays(evaluate, _blocks(len(x)), dr.thread_count())

        def vjp(dsigma: mi.Float, dcolour: mi.Color3f) -> dict[str, mi.Float]:
            return self._vjp_rows(unit, x, basis, dsigma, dcolour)

        return PointValues(sigma, mi.Color3f(dr.unravel(mi.Color3f, colour)), vjp)

    def _vjp_rows(
        self, unit: mi.Point3f, x: np.ndarray, basis: np.ndarray, dsigma: mi.Float, dcolour: mi.Color3f
    ) -> dict[str, mi.Float]:
        by_sigma, by_colour = _rows([dsigma])[:, 0], _rows(list(dcolour))
        density, colours = self._layers()
        networks = self.sizes.density_network, self.sizes.colour_network
        slopes = dr.empty(mi.Float, x.size)
        slope_rows = slopes.numpy().reshape(x.shape)

        def differentiate(block: slice) -> list[np.ndarray]:
            """Derivatives by the weights of both networks; those by the features are written."""
            rows = Network.forward(density, x[block])
            inputs = np.concatenate([rows[-1], basis[block]], axis=1)
            colour_rows = Network.forward(colours, inputs)
            values = self._colour_of(colour_rows[-1])
            slope = values if self.space == "linear" else values * (1 - values)
            gradients = [np.zeros(network.size, np.float32) for network in networks]
            own, own_colours = (network.layers(g) for network, g in zip(networks, gradients, strict=True))
            by_inputs = Network.backward(colours, colour_rows, by_colour[block] * slope, own_colours)
            by_geometry = by_inputs[:, : self.sizes.geometry]
            by_geometry[:, 0] += by_sigma[block] * self._density_of(rows[-1][:, 0])
            slope_rows[block] = Network.backward(density, rows, by_geometry, own)
            return gradients

        # Sums over blocks of one size in one order: the same for any number of threads.
        blocks = map_arrays(differentiate, _blocks(len(x)), dr.thread_count())
        by_density, by_colours = (np.sum(each, axis=0) for each in zip(*blocks, strict=True))
        target, lane, width = dr.zeros(mi.Float, dr.width(self.table)), dr.arange(mi.UInt32, len(x)), x.shape[1]
        dr.eval(target)
        row = dr.gather(mi.ArrayXf, slopes, lane, shape=(width, 1))
        self.encoding.add_features(unit, [row[k] for k in range(width)], target)
        dr.eval(target)
        return {"table": target, "density_weights": mi.Float(by_density), "colour_weights": mi.Float(by_colours)}

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


def _cut(exponent: mi.Float) -> mi.Float:
    """An exponent of at most ``MAX_EXPONENT``, with a derivative of 1 everywhere: a density beyond can still fall."""
    return exponent - dr.detach(dr.maximum(exponent - MAX_EXPONENT, 0))


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
