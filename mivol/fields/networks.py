r"""Dense networks: products with matrices and a ReLU between them, with derivatives.

.. math:: h_0 = x, \qquad h_{k+1} = \max(0,\, W_k h_k), \qquad y = W_{n-1} h_{n-1}

Two evaluations. :meth:`Network.forward` and :meth:`Network.backward` take blocks of rows in memory and multiply matrices by
BLAS, which is several times faster on a CPU than a product in each lane. :meth:`Network.eval_lanes` evaluates the network in
the lanes of a kernel, inside of traced loops and on GPUs, and Dr.Jit differentiates it.

Conventions. There are no biases. The weights of all layers are one array: layer by layer, and in a layer [output][input].

References: Müller et al. 2022 (small networks without biases behind an encoding); Glorot & Bengio 2010 (first weights).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError

__all__ = ["Network"]


@dataclass(frozen=True)
class Network:
    """A dense network.

    Attributes:
        widths: numbers of inputs, of each hidden layer, and of outputs.
    """

    widths: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(self.widths) < 2 or min(self.widths) < 1:
            raise MivolError(f"found a network of the widths {list(self.widths)}, expected inputs and outputs: give both.")

    @property
    def size(self) -> int:
        """Number of weights."""
        return sum(math.prod(shape) for shape in self.shapes)

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """(outputs, inputs) of each layer."""
        return [(b, a) for a, b in zip(self.widths, self.widths[1:], strict=False)]

    def first_weights(self, rng: np.random.Generator) -> np.ndarray:
        """Uniform weights, with the variance of Glorot and Bengio (2010)."""
        bounds = [math.sqrt(6 / (a + b)) for a, b in self.shapes]
        layers = [rng.uniform(-w, w, math.prod(shape)) for w, shape in zip(bounds, self.shapes, strict=True)]
        return np.concatenate(layers).astype(np.float32)

    def layers(self, weights: np.ndarray) -> list[np.ndarray]:
        """Views (outputs, inputs) of the layers in ``weights``."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        return [w.reshape(shape) for w, shape in zip(np.split(weights, ends[:-1]), self.shapes, strict=True)]

    @staticmethod
    def forward(layers: Sequence[np.ndarray], x: np.ndarray) -> list[np.ndarray]:
        """The rows ``x`` (N, inputs), the rows of each hidden layer, and the outputs (N, outputs)."""
        rows = [x]
        for layer in layers[:-1]:
            hidden = multiply(rows[-1], layer.T)
            rows.append(np.maximum(hidden, 0, out=hidden))
        return [*rows, multiply(rows[-1], layers[-1].T)]

    @staticmethod
    def backward(
        layers: Sequence[np.ndarray],
        rows: Sequence[np.ndarray],
        dy: np.ndarray,
        gradient: Sequence[np.ndarray],
    ) -> np.ndarray:
        """Derivatives by the inputs (N, inputs), from the derivatives by the outputs.

        Args:
            layers: from :meth:`layers`.
            rows: from :meth:`forward`.
            dy: (N, outputs).
            gradient: receives the derivatives by the layers, which are added.
        """
        for k in reversed(range(len(layers))):
            gradient[k] += multiply_transposed(dy, rows[k])
            dy = multiply(dy, layers[k])
            if k:
                np.multiply(dy, rows[k] > 0, out=dy)
        return dy

    def pack(self, weights: mi.Float) -> list[nn.MatrixView]:
        """The layers for :meth:`eval_lanes`; attached to ``weights``. Not inside of a traced loop."""
        matrices, first = [], 0
        for shape in self.shapes:
            values = dr.gather(mi.Float, weights, first + dr.arange(mi.UInt32, math.prod(shape)))
            matrices.append(mi.TensorXf(values, shape))
            first += math.prod(shape)
        packed = nn.pack(*matrices, layout="training")
        return [packed] if len(matrices) == 1 else list(packed)

    @staticmethod
    def eval_lanes(layers: Sequence[nn.MatrixView], x: list[mi.Float]) -> list[mi.Float]:
        """The outputs for the inputs of each lane; attached to ``layers`` (from :meth:`pack`) and ``x``."""
        rows = nn.CoopVec(*x)
        for layer in layers[:-1]:
            rows = dr.maximum(nn.matvec(layer, rows), 0)
        return list(nn.matvec(layers[-1], rows))


ALONE = 1 << 18
"""Largest product of the three sizes of a matrix product that OpenBLAS computes in the calling thread. Larger products wake its
threads, which wait for each other: 0.6 M points/s instead of 3.1 on two busy cores."""

FEWEST_ROWS = 32
"""Fewest rows of such a product; with fewer, a product is left whole."""


def _rows_alone(rows: np.ndarray, columns: int) -> int:
    """Rows to multiply at a time by a matrix with ``columns``; 0: all."""
    count = ALONE // (rows.shape[1] * columns)
    return count if count >= FEWEST_ROWS else 0


def multiply(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``rows @ matrix``, in pieces of few rows."""
    at_once, (count, inputs), outputs = _rows_alone(rows, matrix.shape[1]), rows.shape, matrix.shape[1]
    if not at_once:
        return rows @ matrix
    whole = count // at_once * at_once
    product = np.empty((count, outputs), np.float32)
    np.matmul(rows[:whole].reshape(-1, at_once, inputs), matrix, out=product[:whole].reshape(-1, at_once, outputs))
    np.matmul(rows[whole:], matrix, out=product[whole:])
    return product


def multiply_transposed(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``left.T @ right``, in pieces of few rows."""
    at_once = _rows_alone(left, right.shape[1])
    if not at_once:
        return left.T @ right
    whole = len(left) // at_once * at_once
    first, second = (a[:whole].reshape(-1, at_once, a.shape[1]) for a in (left, right))
    return np.matmul(first.transpose(0, 2, 1), second).sum(axis=0) + left[whole:].T @ right[whole:]


# -- Points and outputs of the networks of fields ----------------------------------------------------------------------

MAX_EXPONENT = 15.0
"""Cut of the exponents: exp(15) = 3e6."""

BLOCK = 8192
"""Points that are multiplied together: their rows of all layers stay in the cache of a core."""


def cut_exponent(exponent: mi.Float) -> mi.Float:
    """An exponent of at most ``MAX_EXPONENT``, with a derivative of 1 everywhere: a density beyond can still fall."""
    return exponent - dr.detach(dr.maximum(exponent - MAX_EXPONENT, 0))


def has_blas() -> bool:
    """Whether the arrays lie in the memory of the CPU, where NumPy reads them without a copy."""
    return dr.backend_v(mi.Float) == dr.JitBackend.LLVM


def rows_of(columns: list[mi.Float]) -> np.ndarray:
    """Numbers of points as rows (N, columns) of one array in memory, without a copy of Dr.Jit's memory."""
    count = dr.width(columns)
    rows = dr.empty(mi.Float, count * len(columns))
    dr.scatter(rows, mi.ArrayXf(columns) if len(columns) > 1 else columns[0], dr.arange(mi.UInt32, count))
    dr.eval(rows)
    dr.sync_thread()
    return rows.numpy().reshape(count, len(columns))


def list_blocks(count: int) -> list[slice]:
    """Blocks of points that are multiplied together."""
    return [slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK)]


def colour_rows(raw: np.ndarray, space: str, white: float) -> np.ndarray:
    """Colours of the outputs of a network: the logistic function for sRGB, the cut exponential for radiance."""
    if space == "linear":
        return white * np.exp(np.minimum(raw, MAX_EXPONENT))
    return 1 / (1 + np.exp(-np.clip(raw, -80, 80)))


def colour_lanes(raw: list[mi.Float], space: str, white: float) -> mi.Color3f:
    """:func:`colour_rows` in the lanes of a kernel."""
    if space == "linear":
        return mi.Color3f(*(white * dr.exp(cut_exponent(v)) for v in raw))
    return mi.Color3f(*(dr.rcp(1 + dr.exp(-v)) for v in raw))
