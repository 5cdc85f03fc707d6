r"""A radiance field of a multi-resolution hash grid and two small networks.

.. math:: \sigma = s\, e^{h_0}, \qquad h = D(e(x)), \qquad c = S\big(C(h, Y(\omega))\big)

e(x) are the features of the levels, interpolated trilinearly between the nodes of each level; D and C are dense networks, Y the
spherical harmonics of the direction of travel, S the logistic function for sRGB code values and the exponential for radiance.
The exponents are cut at 15: beyond, the value stays and the derivative is that at the cut. ``s`` is 1 over half the longest
edge of the box, so an untrained field has an optical depth of about 1 across the box in any unit of length.

Conventions. ``table`` is that of :mod:`mivol.fields.hash_encoding`; ``density_weights`` and ``colour_weights`` are arrays of
:class:`mivol.fields.networks.Network`. On a CPU the networks multiply matrices of many points by BLAS, and the encoding has
derivatives by hand; on a GPU Dr.Jit differentiates the networks in a kernel.

Half precision. Rays may read the table in half floats (11 bits, 2 bytes a number). A fit keeps its own float32 values, from
which each step rounds the table. Derivatives by the table are float32 sums: so none underflows, and no loss is scaled.

References: Müller, Evans, Schied, Keller 2022 (encoding, hash, activations, first values, half precision); Micikevicius et al.
2018 (float32 values behind half ones); Tancik et al. 2023 (truncated exponential).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.hash_encoding import HashEncoding, HashSizes
from mivol.fields.networks import (
    MAX_EXPONENT,
    Network,
    colour_lanes,
    colour_rows,
    cut_exponent,
    has_blas,
    list_blocks,
    rows_of,
)
from mivol.fields.sampled_field import PointValues, Region, SampledField
from mivol.threads import map_arrays

__all__ = ["HashField"]


@dataclass(frozen=True, repr=False)
class HashField(SampledField):
    """A hash grid with its networks, as a :class:`mivol.fields.sampled_field.SampledField`.

    Attributes:
        sizes: of grid and networks.
        to_world: (4, 4) float64, unit cube to world.
        table: Float (or Float16), features, [row][feature].
        density_weights, colour_weights: Float, weights of the networks.
        space: "srgb" or "linear", of the colours.
        region: cells in which the field is not 0; None before a fit.
        white: factor on the colours.
        precision: "single" or "half", of the table that rays read.
    """

    kind: ClassVar[str] = "hash"
    noun: ClassVar[str] = "hash grid"
    features: ClassVar[tuple[str, ...]] = ("table",)
    own_arrays: ClassVar[dict[str, tuple[str, tuple[int, ...] | None]]] = {"sizes": ("iu", (10,))}

    sizes: HashSizes
    to_world: np.ndarray
    table: mi.Float
    density_weights: mi.Float
    colour_weights: mi.Float
    space: str = "srgb"
    region: Region | None = None
    white: float = 1.0
    precision: str = "single"

    def __post_init__(self) -> None:
        if self.precision == "half":
            object.__setattr__(self, "table", mi.Float16(self.table))
        self.check()

    def __repr__(self) -> str:
        sizes, numbers = self.sizes, self.numbers
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

    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        return "table", "density_weights", "colour_weights"

    def arrays(self) -> dict[str, np.ndarray]:
        return {"sizes": np.array(astuple(self.sizes))}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], parameters: list[mi.Float], region: Region) -> HashField:
        sizes, place = HashSizes(*map(int, arrays["sizes"])), arrays["to_world"].astype(np.float64)
        return cls(sizes, place, *parameters, str(arrays["space"]), region, float(arrays["white"]))

    def tabulate(self) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
        rows = [
            (str(k), " x ".join(map(str, level.cells)), str(level.rows), "its own" if level.is_dense else "by a hash")
            for k, level in enumerate(self.encoding.levels)
        ]
        return ("level", "cells", "rows", "row of a node"), tuple(rows)

    @property
    def scale(self) -> float:
        """Density of an untrained field [1/length]."""
        return 2 / float(self.edges.max())

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
        return self._lane_density(geometry), self._lane_colour(geometry, d)

    def _lane_geometry(self, p: mi.Point3f, active: mi.Bool) -> list[mi.Float]:
        return self._lane_network(self.encoding.encode(self.table, self.encoding.to_unit(p), active))

    def _lane_network(self, features: list[mi.Float]) -> list[mi.Float]:
        return Network.eval_lanes(self.sizes.density_network.pack(self.density_weights), features)

    def _lane_colour(self, geometry: list[mi.Float], d: mi.Vector3f) -> mi.Color3f:
        inputs = [*geometry, *dr.sh_eval(d, self.sizes.degree)]
        raw = Network.eval_lanes(self.sizes.colour_network.pack(self.colour_weights), inputs)
        return colour_lanes(raw, self.space, self.white)

    def _lane_density(self, geometry: list[mi.Float]) -> mi.Float:
        return self.scale * dr.exp(cut_exponent(geometry[0]))

    # -- Values of points in memory -----------------------------------------------------------------------------------

    def density(self, p: mi.Point3f) -> mi.Float:
        if not has_blas():
            return dr.detach(self.eval_density(p))
        x = self._feature_rows(self.encoding.to_unit(p))
        layers = self.sizes.density_network.layers(self.density_weights.numpy())
        sigma = dr.empty(mi.Float, len(x))
        out = sigma.numpy()

        def evaluate(block: slice) -> None:
            out[block] = self._density_of(Network.forward(layers, x[block])[-1][:, 0])

        map_arrays(evaluate, list_blocks(len(x)), dr.thread_count())
        return sigma

    def evaluate(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        return self._evaluate_rows(p, d) if has_blas() else self._evaluate_lanes(p, d)

    def _evaluate_lanes(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        """Values by a kernel. Dr.Jit differentiates the networks, the encoding has its own derivatives."""
        unit, weights = self.encoding.to_unit(p), ("density_weights", "colour_weights")
        features = dr.detach(self.encoding.encode(self.table, unit))
        attached = self.with_parameters(self.parameters())
        arrays = {name: getattr(attached, name) for name in weights}
        dr.enable_grad(features, arrays)
        geometry = attached._lane_network(features)
        sigma, colour = attached._lane_density(geometry), attached._lane_colour(geometry, d)

        def vjp(dsigma: mi.Float, dcolour: mi.Color3f) -> dict[str, mi.Float]:
            dr.backward_from(sigma * dsigma + dr.dot(colour, dcolour))
            target = dr.zeros(mi.Float, dr.width(self.table))
            self.encoding.add_features(unit, dr.grad(features), target)
            return {"table": target} | {name: dr.grad(array) for name, array in arrays.items()}

        return PointValues(dr.detach(sigma), dr.detach(colour), vjp)

    def _evaluate_rows(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        """Values by products of matrices; the adjoint computes the hidden layers again, block by block."""
        unit = self.encoding.to_unit(p)
        dr.eval(unit)
        x, basis = self._feature_rows(unit), rows_of(list(dr.sh_eval(d, self.sizes.degree)))
        sigma, colour = dr.empty(mi.Float, len(x)), dr.empty(mi.Float, 3 * len(x))
        sigma_rows, written = sigma.numpy(), colour.numpy().reshape(-1, 3)
        density, colours = self._layers()

        def evaluate(block: slice) -> None:
            geometry = Network.forward(density, x[block])[-1]
            raw = Network.forward(colours, np.concatenate([geometry, basis[block]], axis=1))[-1]
            sigma_rows[block], written[block] = self._density_of(geometry[:, 0]), colour_rows(raw, self.space, self.white)

        map_arrays(evaluate, list_blocks(len(x)), dr.thread_count())

        def vjp(dsigma: mi.Float, dcolour: mi.Color3f) -> dict[str, mi.Float]:
            return self._vjp_rows(unit, x, basis, dsigma, dcolour)

        return PointValues(sigma, mi.Color3f(dr.unravel(mi.Color3f, colour)), vjp)

    def _vjp_rows(
        self, unit: mi.Point3f, x: np.ndarray, basis: np.ndarray, dsigma: mi.Float, dcolour: mi.Color3f
    ) -> dict[str, mi.Float]:
        by_sigma, by_colour = rows_of([dsigma])[:, 0], rows_of(list(dcolour))
        density, colours = self._layers()
        networks = self.sizes.density_network, self.sizes.colour_network
        slopes = dr.empty(mi.Float, x.size)
        slope_rows = slopes.numpy().reshape(x.shape)

        def differentiate(block: slice) -> list[np.ndarray]:
            """Derivatives by the weights of both networks; those by the features are written."""
            rows = Network.forward(density, x[block])
            inputs = np.concatenate([rows[-1], basis[block]], axis=1)
            rows_of_colour = Network.forward(colours, inputs)
            values = colour_rows(rows_of_colour[-1], self.space, self.white)
            slope = values if self.space == "linear" else values * (1 - values)
            gradients = [np.zeros(network.size, np.float32) for network in networks]
            own, own_colours = (network.layers(g) for network, g in zip(networks, gradients, strict=True))
            by_inputs = Network.backward(colours, rows_of_colour, by_colour[block] * slope, own_colours)
            by_geometry = by_inputs[:, : self.sizes.geometry]
            by_geometry[:, 0] += by_sigma[block] * self._density_of(rows[-1][:, 0])
            slope_rows[block] = Network.backward(density, rows, by_geometry, own)
            return gradients

        # Sums over blocks of one size in one order: the same for any number of threads.
        blocks = map_arrays(differentiate, list_blocks(len(x)), dr.thread_count())
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

    def _feature_rows(self, unit: mi.Point3f) -> np.ndarray:
        return rows_of(self.encoding.encode(self.table, unit))
