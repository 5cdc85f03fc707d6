r"""A radiance field of one coordinate network (NeRF).

.. math:: h = T(\gamma_{10}(x)), \qquad \sigma = A(w \cdot h + b) / u, \qquad c = S\big(C(F h, \gamma_4(\omega))\big)

.. math:: \gamma_n(x) = (x, \sin 2^0 x, \cos 2^0 x, \dots, \sin 2^{n-1} x, \cos 2^{n-1} x)

The trunk T has layers with a ReLU. After layer ``skip`` the encoded place is put before the layer's outputs. F is linear, and
C has one hidden layer with a ReLU. A is the ReLU, or softplus(y - 1), from which fits begin: a ReLU that is 0 in the whole box
has no derivative. S is the logistic function for sRGB code values and the cut exponential for radiance.

Conventions. Frequencies are 2^k, as in the published program and its weights; the article writes 2^k pi. x is the place in
``frame``, (x, y, z) of its origin and the length u of its unit: the middle and half the longest edge of the box by default, so
a fit does not depend on the unit of length. ``weights`` holds layer by layer (:attr:`NerfSizes.layers`) the weights
[output][input], then the biases. On a CPU blocks of points are multiplied by BLAS; on a GPU Dr.Jit differentiates a kernel.

References: Mildenhall, Srinivasan, Tancik, Barron, Ramamoorthi, Ng 2020; Barron et al. 2021 (softplus, shifted by 1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from typing import ClassVar

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import basis_size, harmonic_degree
from mivol.fields.networks import colour_lanes, colour_rows, has_blas, list_blocks, multiply, multiply_transposed, rows_of
from mivol.fields.sampled_field import PointValues, Region, SampledField
from mivol.threads import map_arrays

__all__ = ["NerfField", "NerfSizes"]

PARTS = "weight", "bias"
"""Published names of the parts of a layer."""

LIMITS = {
    "depth": (1, 16), "width": (1, 1024), "skip": (0, 15), "place": (0, 16), "direction": (0, 16), "branch": (1, 1024),
    "relu": (0, 1), "harmonics": (-1, 4), "coarse": (0, 1024), "fine": (0, 1024),
}  # fmt: skip
"""Smallest and largest values of :class:`NerfSizes`."""


@dataclass(frozen=True)
class NerfSizes:
    """Sizes of a coordinate network.

    Attributes:
        depth: layers of the trunk.
        width: neurons of such a layer.
        skip: layer of the trunk, counted from 1, before whose outputs the encoded place is put again; 0: none.
        place, direction: frequencies of their encodings.
        branch: neurons of the hidden layer of the colours.
        relu: 1 for a density max(0, y), 0 for softplus(y - 1).
        harmonics: degree of the harmonics of the direction that the trunk's last layer gives (NeRF-SH); -1: a branch sees the
            direction.
        coarse, fine: samples of a ray by a coarse network of the same sizes, and samples that follow from them; 0: one network,
            whose samples follow a map of occupied cells.
    """

    depth: int = 8
    width: int = 256
    skip: int = 5
    place: int = 10
    direction: int = 4
    branch: int = 128
    relu: int = 0
    harmonics: int = -1
    coarse: int = 0
    fine: int = 0

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            if not low <= getattr(self, name) <= high:
                raise MivolError(f"found a NeRF with {name} = {getattr(self, name)}, expected {low} to {high}.")
        if self.skip >= self.depth:
            raise MivolError(f"found a NeRF with skip = {self.skip}, expected less than its {self.depth} layers; 0 is none.")
        if (self.coarse > 0) != (self.fine > 0):
            raise MivolError(f"found a NeRF with {self.coarse} coarse and {self.fine} fine samples, expected both or none.")

    @property
    def inputs(self) -> tuple[int, int]:
        """Numbers of an encoded place and of an encoded direction."""
        return 3 + 6 * self.place, 3 + 6 * self.direction

    @property
    def layers(self) -> dict[str, tuple[int, int]]:
        """(outputs, inputs) of each layer, by its published name."""
        place, direction = self.inputs
        shapes = {f"pts_linears.{k}": (self.width, self.width + place * (k == self.skip)) for k in range(self.depth)}
        shapes["pts_linears.0"] = self.width, place
        shapes |= {"alpha_linear": (1, self.width)}
        if self.harmonics >= 0:
            return shapes | {"sh_linear": (3 * basis_size(self.harmonics), self.width)}
        shapes |= {"feature_linear": (self.width, self.width)}
        return shapes | {"views_linears.0": (self.branch, self.width + direction), "rgb_linear": (3, self.branch)}

    @property
    def size(self) -> int:
        """Number of weights and biases of a network."""
        return sum(out * (inputs + 1) for out, inputs in self.layers.values())

    @property
    def weights(self) -> int:
        """Weights that a sample passes: the weights of a network."""
        return self.size

    @property
    def networks(self) -> int:
        """Number of networks: the fine one comes first."""
        return 2 if self.coarse else 1

    def split(self, weights: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Views of the weights (outputs, inputs) and biases (outputs,) of each layer."""
        views, first = {}, 0
        for name, (out, inputs) in self.layers.items():
            matrix = weights[first : first + out * inputs].reshape(out, inputs)
            views[name] = matrix, weights[first + out * inputs : first + out * (inputs + 1)]
            first += out * (inputs + 1)
        return views

    def first_weights(self, rng: np.random.Generator) -> np.ndarray:
        """Uniform weights with the variance of Glorot and Bengio (2010), and biases of 0."""
        weights = np.zeros((self.networks, self.size), np.float32)
        for network in weights:
            for matrix, _ in self.split(network).values():
                bound = math.sqrt(6 / sum(matrix.shape))
                matrix[:] = rng.uniform(-bound, bound, matrix.shape)
        return weights.ravel()

    def count_numbers(self, edges: np.ndarray) -> int:
        """Number of fitted numbers, in a box with any edges."""
        return self.networks * self.size

    def describe(self, edges: np.ndarray) -> tuple[str, str]:
        """Layers, and their numbers."""
        joined = f", the position again after layer {self.skip}" if self.skip else ""
        seen = f"{self.direction} of the direction"
        head = f"{self.branch} neurons for the colours"
        if self.harmonics >= 0:
            head, seen = f"harmonics of degree {self.harmonics} for the colours", "no direction"
        rounds = f"; {self.coarse} samples of a ray by a coarse network, {self.fine} more" if self.coarse else ""
        number = "a network" if self.networks == 1 else "two networks"
        return (
            f"{number} of {self.depth} layers x {self.width}{joined}, {head}{rounds}",
            f"{self.networks * self.size} weights; {self.place} frequencies of the position, {seen}",
        )


@dataclass(frozen=True, repr=False)
class NerfField(SampledField):
    """A coordinate network, as a :class:`mivol.fields.sampled_field.SampledField`.

    Attributes:
        sizes: of the network.
        to_world: (4, 4) float64, unit cube to world.
        weights: Float, weights and biases.
        space: "srgb" or "linear", of the colours.
        region: cells in which the field is not 0; None before a fit.
        white: factor on the colours.
        frame: (x, y, z, unit) of the encoded places [length]; None: middle and half the longest edge of the box.
    """

    kind: ClassVar[str] = "nerf"
    noun: ClassVar[str] = "NeRF"
    own_arrays: ClassVar[dict[str, tuple[str, tuple[int, ...] | None]]] = {"sizes": ("iu", (10,)), "frame": ("f", (4,))}

    sizes: NerfSizes
    to_world: np.ndarray
    weights: mi.Float
    space: str = "srgb"
    region: Region | None = None
    white: float = 1.0
    frame: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        self.check()
        if self.frame is None:
            middle = self.to_world[:3] @ np.array([0.5, 0.5, 0.5, 1])
            object.__setattr__(self, "frame", (*map(float, middle), float(self.edges.max()) / 2))
        if not (np.isfinite(self.frame).all() and self.frame[3] > 0):
            raise MivolError(f"found the frame {self.frame} of a NeRF, expected finite numbers and a unit above 0.")

    def __repr__(self) -> str:
        return f"NerfField({self.sizes.depth} layers x {self.sizes.width}, {self.numbers} numbers, {self.space})"

    @classmethod
    def random(cls, sizes: NerfSizes, to_world: np.ndarray, seed: int = 0, space: str = "srgb") -> NerfField:
        weights = sizes.first_weights(np.random.default_rng(seed))
        return cls(sizes, np.asarray(to_world, np.float64), mi.Float(weights), space)

    @classmethod
    def from_published(
        cls, arrays: Mapping[str, np.ndarray], to_world: np.ndarray, frame: tuple[float, float, float, float] = (0, 0, 0, 1)
    ) -> NerfField:
        """The field of weights in the published layout of PyTorch, with a ReLU for the density.

        Args:
            arrays: ``pts_linears.0.weight`` (outputs, inputs), ``pts_linears.0.bias`` (outputs,), ..., ``alpha_linear``,
                ``feature_linear``, ``views_linears.0`` and ``rgb_linear``, as ``np.load`` reads them from an ``.npz`` and
                :func:`mivol.files.npy.read_safetensors` from a safetensors file. A NeRF-SH has ``sh_linear``
                (3 basis, inputs), channel by channel, in place of the last three.
            to_world: (4, 4), unit cube to world: the box outside of which the field is 0.
            frame: origin (x, y, z) and unit of the places that the network was trained with [length].

        Raises:
            MivolError: a missing layer, shapes that disagree, or values that are not finite.
        """
        depth = sum(name.startswith("pts_linears.") and name.endswith(".weight") for name in arrays)
        has_harmonics = "sh_linear.weight" in arrays
        heads = ["alpha_linear", *(["sh_linear"] if has_harmonics else ["feature_linear", "views_linears.0", "rgb_linear"])]
        for layer in [*(f"pts_linears.{k}" for k in range(max(depth, 1))), *heads]:
            for part in PARTS:
                if f"{layer}.{part}" not in arrays:
                    raise MivolError(f"found no {layer}.{part} among the weights of a NeRF, expected all layers: export it.")
        shape = {name: np.shape(arrays[name]) for name in arrays}
        flat = [name for name in shape if name.endswith(".weight") and len(shape[name]) != 2]
        if flat:
            raise MivolError(f"found {flat[0]} of the shape {shape[flat[0]]}, expected (outputs, inputs): export it again.")
        width, place = shape["pts_linears.0.weight"]
        skip = next((k for k in range(1, depth) if shape[f"pts_linears.{k}.weight"][1] != width), 0)
        if has_harmonics:
            degree = harmonic_degree(shape["sh_linear.weight"][0] // 3)
            sizes = NerfSizes(depth, width, skip, (place - 3) // 6, 0, 1, 1, degree)
        else:
            branch, seen = shape["views_linears.0.weight"]
            sizes = NerfSizes(depth, width, skip, (place - 3) // 6, (seen - width - 3) // 6, branch, 1)
        weights = np.empty(sizes.size, np.float32)
        for layer, parts in sizes.split(weights).items():
            for part, target in zip(PARTS, parts, strict=True):
                name = f"{layer}.{part}"
                if shape[name] != target.shape:
                    raise MivolError(f"found {name} of the shape {shape[name]}, expected {target.shape} by the other layers.")
                target[:] = arrays[name]
                if not np.isfinite(target).all():
                    raise MivolError(f"found {name} with values that are not finite, expected numbers: export it again.")
        return cls(sizes, np.asarray(to_world, np.float64), mi.Float(weights), frame=tuple(map(float, frame)))

    def to_published(self) -> dict[str, np.ndarray]:
        """The weights of the (fine) network in the layout of :meth:`from_published`."""
        parts = self.sizes.split(self.weights.numpy())
        named = ((f"{name}.{kind}", part) for name, own in parts.items() for kind, part in zip(PARTS, own, strict=True))
        return {name: part.copy() for name, part in named}

    @property
    def coarse(self) -> NerfField | None:
        if not self.sizes.coarse:
            return None
        own = dr.gather(mi.Float, self.weights, dr.arange(mi.UInt32, self.sizes.size) + self.sizes.size)
        dr.eval(own)
        return replace(self, sizes=replace(self.sizes, coarse=0, fine=0), weights=own)

    @property
    def rounds(self) -> tuple[int, int]:
        return self.sizes.coarse, self.sizes.fine

    @classmethod
    def parameter_names(cls) -> tuple[str, ...]:
        return ("weights",)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"weights": (self.sizes.networks * self.sizes.size,)}

    def arrays(self) -> dict[str, np.ndarray]:
        return {"sizes": np.array(astuple(self.sizes)), "frame": np.array(self.frame, np.float64)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], parameters: list[mi.Float], region: Region) -> NerfField:
        sizes, place = NerfSizes(*map(int, arrays["sizes"])), arrays["to_world"].astype(np.float64)
        frame = tuple(map(float, arrays["frame"]))
        return cls(sizes, place, *parameters, str(arrays["space"]), region, float(arrays["white"]), frame)

    def tabulate(self) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
        rows = tuple((name, str(inputs), str(out)) for name, (out, inputs) in self.sizes.layers.items())
        return ("layer", "inputs", "outputs"), rows

    # -- Values in the lanes of a kernel ------------------------------------------------------------------------------

    def eval_density(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float:
        """Extinction at points in the lanes of a kernel; attached to the weights."""
        return self._lane_density(*self._lane_trunk(p))

    def eval(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool = True) -> tuple[mi.Float, mi.Color3f]:
        layers, h = self._lane_trunk(p)
        if self.sizes.harmonics >= 0:
            basis, sums = dr.sh_eval(d, self.sizes.harmonics), list(nn.matvec(*_view(layers, "sh_linear", h)))
            raw = [sum((y * s for y, s in zip(basis, sums[c * len(basis) :], strict=False)), mi.Float(0)) for c in range(3)]
            return self._lane_density(layers, h), colour_lanes(raw, self.space, self.white)
        seen = nn.CoopVec(*nn.matvec(*_view(layers, "feature_linear", h)), *encode_lanes(list(d), self.sizes.direction))
        hidden = dr.maximum(nn.matvec(*_view(layers, "views_linears.0", seen)), 0)
        raw = list(nn.matvec(*_view(layers, "rgb_linear", hidden)))
        return self._lane_density(layers, h), colour_lanes(raw, self.space, self.white)

    def _lane_trunk(self, p: mi.Point3f) -> tuple[dict[str, tuple[nn.MatrixView, nn.MatrixView]], nn.CoopVec]:
        """Packed layers, and the outputs of the trunk."""
        parts, first = [], 0
        for out, inputs in self.sizes.layers.values():
            for shape in ((out, inputs), (out,)):
                count = math.prod(shape)
                values = dr.gather(mi.Float, self.weights, first + dr.arange(mi.UInt32, count))
                parts.append(mi.TensorXf(values, shape))
                first += count
        packed = list(nn.pack(*parts, layout="training"))
        layers = dict(zip(self.sizes.layers, zip(packed[::2], packed[1::2], strict=True), strict=True))
        origin, unit = self.frame[:3], dr.opaque(mi.Float, self.frame[3])
        place = [(v - dr.opaque(mi.Float, o)) / unit for v, o in zip(p, origin, strict=True)]
        x = encode_lanes(place, self.sizes.place)
        h = nn.CoopVec(*x)
        for k in range(self.sizes.depth):
            h = dr.maximum(nn.matvec(*_view(layers, f"pts_linears.{k}", h)), 0)
            if k + 1 == self.sizes.skip:
                h = nn.CoopVec(*x, *h)
        return layers, h

    def _lane_density(self, layers: dict[str, tuple[nn.MatrixView, nn.MatrixView]], h: nn.CoopVec) -> mi.Float:
        (raw,) = nn.matvec(*_view(layers, "alpha_linear", h))
        if self.sizes.relu:
            return dr.maximum(raw, 0) / self.frame[3]
        y = raw - 1
        return (dr.maximum(y, 0) + dr.log(1 + dr.exp(-dr.abs(y)))) / self.frame[3]

    # -- Values of points in memory -----------------------------------------------------------------------------------

    def density(self, p: mi.Point3f) -> mi.Float:
        if not has_blas():
            return dr.detach(self.eval_density(p))
        places, layers = rows_of(list(p)), self.sizes.split(self.weights.numpy())
        sigma = dr.empty(mi.Float, len(places))
        out = sigma.numpy()

        def evaluate(block: slice) -> None:
            h = self._trunk_rows(layers, self._encode_places(places[block]))[-1]
            out[block] = self._density_and_slope(_apply(layers["alpha_linear"], h)[:, 0])[0]

        map_arrays(evaluate, list_blocks(len(places)), dr.thread_count())
        return sigma

    def evaluate(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        return self._evaluate_rows(p, d) if has_blas() else self._evaluate_lanes(p, d)

    def _evaluate_rows(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        """Values by products of matrices; the adjoint computes all layers again, block by block."""
        seen = list(d) if self.sizes.harmonics < 0 else dr.sh_eval(d, self.sizes.harmonics)
        places, directions, layers = rows_of(list(p)), self._spread(seen, dr.width(p)), self.sizes.split(self.weights.numpy())
        sigma, colour = dr.empty(mi.Float, len(places)), dr.empty(mi.Float, 3 * len(places))
        sigma_rows, written = sigma.numpy(), colour.numpy().reshape(-1, 3)

        def evaluate(block: slice) -> None:
            h = self._trunk_rows(layers, self._encode_places(places[block]))[-1]
            sigma_rows[block] = self._density_and_slope(_apply(layers["alpha_linear"], h)[:, 0])[0]
            raw = self._branch_rows(layers, h, directions[block])[-1]
            written[block] = colour_rows(raw, self.space, self.white)

        map_arrays(evaluate, list_blocks(len(places)), dr.thread_count())

        def vjp(dsigma: mi.Float, dcolour: mi.Color3f) -> dict[str, mi.Float]:
            by_sigma, by_colour = rows_of([dsigma])[:, 0], rows_of(list(dcolour))

            def differentiate(block: slice) -> np.ndarray:
                return self._vjp_block(layers, places[block], directions[block], by_sigma[block], by_colour[block])

            # Sums over blocks of one size in one order: the same for any number of threads.
            total = np.sum(map_arrays(differentiate, list_blocks(len(places)), dr.thread_count()), axis=0)
            return {"weights": mi.Float(np.pad(total, (0, (self.sizes.networks - 1) * self.sizes.size)))}

        return PointValues(sigma, mi.Color3f(dr.unravel(mi.Color3f, colour)), vjp)

    def _vjp_block(
        self, layers: dict, places: np.ndarray, directions: np.ndarray, by_sigma: np.ndarray, by_colour: np.ndarray
    ) -> np.ndarray:
        """Derivatives by the weights, of a block of points."""
        gradient = np.zeros(self.sizes.size, np.float32)
        own = self.sizes.split(gradient)
        rows = self._trunk_rows(layers, self._encode_places(places))
        h = rows[-1]
        seen, hidden, raw = self._branch_rows(layers, h, directions)
        values = colour_rows(raw, self.space, self.white)
        by_raw = by_colour * (values if self.space == "linear" else values * (1 - values))
        if self.sizes.harmonics >= 0:
            by_sums = (by_raw[:, :, None] * directions[:, None]).reshape(len(h), -1)
            by_h = _transpose(layers["sh_linear"], own["sh_linear"], h, by_sums)
        else:
            by_h = self._vjp_branch(layers, own, h, (seen, hidden), by_raw)
        self._vjp_trunk(layers, own, rows, by_h, by_sigma)
        return gradient

    def _vjp_branch(
        self, layers: dict, own: dict, h: np.ndarray, branch: tuple[np.ndarray, np.ndarray], by_raw: np.ndarray
    ) -> np.ndarray:
        """Derivatives of the colours by the outputs of the trunk; ``branch`` has the branch's inputs and hidden layer."""
        seen, hidden = branch
        by_hidden = _transpose(layers["rgb_linear"], own["rgb_linear"], hidden, by_raw) * (hidden > 0)
        by_seen = _transpose(layers["views_linears.0"], own["views_linears.0"], seen, by_hidden)
        by_feature = np.ascontiguousarray(by_seen[:, : self.sizes.width])
        return _transpose(layers["feature_linear"], own["feature_linear"], h, by_feature)

    def _vjp_trunk(self, layers: dict, own: dict, rows: list[np.ndarray], by_h: np.ndarray, by_sigma: np.ndarray) -> None:
        """Add the derivatives by the weights of the trunk and of the density, from those by the outputs of the trunk."""
        h = rows[-1]
        slope = self._density_and_slope(_apply(layers["alpha_linear"], h)[:, 0])[1]
        by_h += _transpose(layers["alpha_linear"], own["alpha_linear"], h, (by_sigma * slope)[:, None])
        for k in reversed(range(self.sizes.depth)):
            output = rows[k + 1]
            if k + 1 == self.sizes.skip:  # the first columns are the encoded place, which has no derivative
                by_h, output = by_h[:, self.sizes.inputs[0] :], output[:, self.sizes.inputs[0] :]
            name = f"pts_linears.{k}"
            by_h = _transpose(layers[name], own[name], rows[k], by_h * (output > 0))

    def _spread(self, columns: list[mi.Float], count: int) -> np.ndarray:
        """Rows of columns, of which some may be one number for all points."""
        return rows_of([column + dr.zeros(mi.Float, count) for column in columns])

    def _encode_places(self, places: np.ndarray) -> np.ndarray:
        frame = np.float32(self.frame)
        return encode_rows((places - frame[:3]) / frame[3], self.sizes.place)

    def _trunk_rows(self, layers: dict, x: np.ndarray) -> list[np.ndarray]:
        """Inputs of each layer of the trunk, and its outputs."""
        rows = [x]
        for k in range(self.sizes.depth):
            h = np.maximum(_apply(layers[f"pts_linears.{k}"], rows[-1]), 0)
            rows.append(np.concatenate([x, h], axis=1) if k + 1 == self.sizes.skip else h)
        return rows

    def _branch_rows(self, layers: dict, h: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inputs and hidden layer of the colours, and their raw values; ``directions`` are harmonics for a NeRF-SH."""
        if self.sizes.harmonics >= 0:
            sums = _apply(layers["sh_linear"], h).reshape(len(h), 3, -1)
            return h, h, np.einsum("ncb,nb->nc", sums, directions)
        feature = _apply(layers["feature_linear"], h)
        seen = np.concatenate([feature, encode_rows(directions, self.sizes.direction)], axis=1)
        hidden = np.maximum(_apply(layers["views_linears.0"], seen), 0)
        return seen, hidden, _apply(layers["rgb_linear"], hidden)

    def _density_and_slope(self, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Extinction of the outputs of the trunk, and the derivative."""
        unit = np.float32(self.frame[3])
        if self.sizes.relu:
            return np.maximum(raw, 0) / unit, (raw > 0) / unit
        y = raw - 1
        return np.logaddexp(0, y) / unit, 1 / (1 + np.exp(-np.clip(y, -80, 80))) / unit


def encode_rows(x: np.ndarray, count: int) -> np.ndarray:
    """The encoding of rows (N, 3) with ``count`` frequencies: (N, 3 + 6 count)."""
    waves = [wave(x * np.float32(1 << k)) for k in range(count) for wave in (np.sin, np.cos)]
    return np.concatenate([x, *waves], axis=1)


def encode_lanes(x: list[mi.Float], count: int) -> list[mi.Float]:
    """:func:`encode_rows` in the lanes of a kernel."""
    return [*x, *(wave(v * (1 << k)) for k in range(count) for wave in (dr.sin, dr.cos) for v in x)]


def _view(layers: dict, name: str, x: nn.CoopVec) -> tuple[nn.MatrixView, nn.CoopVec, nn.MatrixView]:
    """Arguments of ``nn.matvec`` for a layer."""
    return layers[name][0], x, layers[name][1]


def _apply(layer: tuple[np.ndarray, np.ndarray], rows: np.ndarray) -> np.ndarray:
    return multiply(rows, layer[0].T) + layer[1]


def _transpose(
    layer: tuple[np.ndarray, np.ndarray], own: tuple[np.ndarray, np.ndarray], rows: np.ndarray, dy: np.ndarray
) -> np.ndarray:
    """Derivatives by the inputs of a layer; those by its weights are added to ``own``."""
    own[0][:] += multiply_transposed(dy, rows)
    own[1][:] += dy.sum(axis=0)
    return multiply(dy, layer[0])
