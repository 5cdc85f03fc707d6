r"""Prior knowledge of a field: smooth, piecewise constant, sparse, bounded, matte.

.. math:: TV = \sum_k \sqrt{\delta^2 + |\nabla_h v_k|^2}, \qquad S = \sum_k \log(1 + 2 \sigma_k^2)

Conventions. A :class:`Prior` is an energy in the loss. The field is a tensor (Z, Y, X, C) of values at voxel centres with the
spacing (z, y, x) [length]; differences across the border vanish (clamped borders). The energy is a mean over the volume and
does not change on refining the grid. Gradients come from Dr.Jit's AD; :meth:`Prior.value_and_gradient` serves NumPy. A
non-quadratic energy also gives a parabola touching the energy from above (lagged diffusivity), for Gauss-Newton and conjugate
gradients.

A :class:`DecoupledPrior` moves the values of a radiance field after each step, as decoupled weight decay does. Inside RMSprop's
quotient even a weak prior would move an untouched row by a whole learning rate. The move is a share of the learning rate,
because photographs that agree move a value by about one learning rate. Differences go to the next node along each axis (0 at
the border; a node without a row holds the vacuum). PRIORS lists the
energies, DECOUPLED_PRIORS the moves.

References: Rudin, Osher & Fatemi 1992; Fridovich-Keil, Yu et al. 2022 (runs of voxels; the Cauchy prior of Hedman et al. 2021);
Loshchilov & Hutter 2019 (decoupling).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner
from mivol.optim.strategy import Strategy, make_table, setting

Spacing = tuple[float, float, float]


def next_along(x: mi.TensorXf, axis: int) -> mi.Float:
    """The value of the next voxel along ``axis``; at the far border the voxel's own value (clamp)."""
    shape = x.shape
    stride = int(np.prod(shape[axis + 1 :]))
    flat = dr.arange(mi.UInt32, int(np.prod(shape)))
    at = (flat // stride) % shape[axis]
    return dr.gather(mi.Float, x.array, dr.select(at + 1 < shape[axis], flat + stride, flat))


def previous_along(x: mi.TensorXf, axis: int) -> mi.Float:
    """The value of the previous voxel along ``axis``; at the near border the voxel's own value (clamp)."""
    shape = x.shape
    stride = int(np.prod(shape[axis + 1 :]))
    flat = dr.arange(mi.UInt32, int(np.prod(shape)))
    at = (flat // stride) % shape[axis]
    return dr.gather(mi.Float, x.array, dr.select(at > 0, flat - stride, flat))


def squared_gradient(x: mi.TensorXf, spacing: Spacing) -> mi.Float:
    """|grad x|^2 per voxel and channel by forward differences [value^2 / length^2]."""
    terms = [dr.square((next_along(x, axis) - x.array) / spacing[axis]) for axis in range(3)]
    return terms[0] + terms[1] + terms[2]


def laplacian(x: mi.TensorXf, spacing: Spacing) -> mi.Float:
    """The 7-point Laplacian per voxel and channel [value / length^2]."""
    terms = [(next_along(x, axis) + previous_along(x, axis) - 2.0 * x.array) / spacing[axis] ** 2 for axis in range(3)]
    return terms[0] + terms[1] + terms[2]


class Prior(Strategy, tag="prior"):
    """An energy of a field; ``is_spatial`` marks priors that compare neighbours."""

    is_spatial: ClassVar[bool] = True

    weight: Annotated[float, setting("1", "factor on the energy, which is added to the mean loss", ge=0)] = 1.0

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        """Mean energy of the field, without the weight."""
        raise NotImplementedError

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        """1/2 v^T H v, with H >= 0 the curvature of the majorising parabola at ``x`` (detached)."""
        raise NotImplementedError

    def curvature(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.TensorXf:
        """weight * H v for the H of :meth:`quadratic`."""
        v = mi.TensorXf(dr.detach(v))
        dr.enable_grad(v)
        dr.backward(self.weight * self.quadratic(dr.detach(x), v, spacing))
        return dr.grad(v)

    def value_and_gradient(self, x: np.ndarray, spacing: Spacing) -> tuple[float, np.ndarray]:
        """weight * energy and gradient, for solvers with fields in NumPy.

        Args:
            x: field (Z, Y, X, C) or (Z, Y, X).
            spacing: voxel size (z, y, x) [length].

        Returns:
            The energy and the gradient, in the shape of ``x``.

        Raises:
            MivolError: ``x`` has another rank.
        """
        if x.ndim not in (3, 4):
            raise MivolError(f"found a field of shape {x.shape}, expected (Z, Y, X) or (Z, Y, X, C): reshape the field.")
        field = mi.TensorXf(np.ascontiguousarray(x.reshape(*x.shape[:3], -1), dtype=np.float32))
        dr.enable_grad(field)
        energy = self.weight * self.energy(field, spacing)
        dr.backward(energy)
        return float(energy[0]), np.asarray(dr.grad(field)).reshape(x.shape)


class TotalVariation(Prior, tag="tv"):
    """|grad x|, rounded at ``edge``: favours flat regions with sharp borders.

    sqrt(|g|^2 + edge^2) - edge. Source: Rudin, Osher and Fatemi 1992, Physica D 60; quadratic form: Vogel and Oman
    1996, SIAM J. Sci. Comput. 17(1).
    """

    cites = ("rudin_1992",)

    edge: Annotated[float, setting("value/length", "gradients below this value are smoothed quadratically", gt=0)] = 1e-2

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return dr.mean(dr.sqrt(squared_gradient(x, spacing) + self.edge**2) - self.edge)

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(squared_gradient(v, spacing) * dr.rsqrt(squared_gradient(x, spacing) + self.edge**2))


class HuberTotalVariation(Prior, tag="huber_tv"):
    """|g| - edge / 2 for |g| = |grad x| > edge, |g|^2 / (2 edge) below: total variation that is exactly quadratic inside the
    noise.

    Source: Huber 1964 for the function; known as "edge-preserving" penalty (Fessler and others).
    """

    cites = ("rudin_1992", "huber_1964")

    edge: Annotated[float, setting("value/length", "gradient at which the parabola turns into a line", gt=0)] = 1e-1

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        g2 = squared_gradient(x, spacing)
        # sqrt has no slope at 0: its argument is at least edge^2.
        line = dr.sqrt(dr.maximum(g2, self.edge**2)) - 0.5 * self.edge
        return dr.mean(dr.select(g2 <= self.edge**2, g2 / (2.0 * self.edge), line))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        weight = dr.rsqrt(dr.maximum(squared_gradient(x, spacing), self.edge**2))
        return 0.5 * dr.mean(weight * squared_gradient(v, spacing))


class Laplacian(Prior, tag="laplacian"):
    """1/2 (Laplace x)^2: penalises oscillations; straight ramps have no energy."""

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(laplacian(x, spacing)))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(laplacian(v, spacing)))


class Sparse(Prior, tag="l1"):
    """|x|: favours empty regions. The majorising parabola is rounded below ``knee``."""

    is_spatial = False

    knee: Annotated[float, setting("value", "Gauss-Newton pulls smaller values to 0 quadratically", gt=0)] = 1e-3

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return dr.mean(dr.abs(x.array))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(v.array) / dr.maximum(dr.abs(x.array), self.knee))


class Bounds(Prior, tag="bounds"):
    """1/2 distance^2 to [low, high]: a soft bound, which values may cross."""

    is_spatial = False

    low: Annotated[float, setting("value", "lower bound")] = 0.0
    high: Annotated[float, setting("value", "upper bound")] = float("inf")

    def outside(self, x: mi.TensorXf) -> mi.Float:
        """Signed distance to the interval."""
        return dr.maximum(x.array - self.high, 0.0) + dr.minimum(x.array - self.low, 0.0)

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(self.outside(x)))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.select(self.outside(x) != 0.0, dr.square(v.array), 0.0))


@dataclass
class Neighbours:
    """Rows of the nodes beside each node with a row.

    Attributes:
        after: UInt32 each, row of the next node along x, y and z: the vacuum's row for a node that is not stored, the own row
            at the border and at an inner level that covers the next node.
        before: row of the previous node along x, y and z: the own row for an absent node and at the border.
    """

    after: list[mi.UInt32]
    before: list[mi.UInt32]

    @property
    def count(self) -> int:
        """Number of rows with neighbours."""
        return dr.width(self.after[0])

    @classmethod
    def from_field(cls, field: SphericalGrid) -> Neighbours:
        """Find the neighbours of each row of a field."""
        z, y, x = field.res
        node = mi.UInt32(field.stored_nodes().astype(np.uint32))
        own = dr.arange(mi.UInt32, dr.width(node))
        neighbours = cls([], [])
        for stride, n in ((1, x), (x, y), (x * y, z)):
            index = node // stride % n
            following = dr.select(index < n - 1, node + stride, node)
            following = dr.select(is_covered_by_inner(following, field.res), node, following)
            neighbours.after.append(field.look_up_rows(following))
            before = field.look_up_rows(dr.select(index > 0, node - stride, node))
            neighbours.before.append(dr.select(before < dr.width(node), before, own))
        dr.eval(neighbours)
        return neighbours


@dataclass(frozen=True)
class FieldRows:
    """The rows of a parameter of a field, for a decoupled prior.

    Attributes:
        width: numbers per row.
        neighbours: the rows beside each row.
        rate: learning rate over the number of photographs, times ``unit``: move by a single photograph in a step.
        unit: factor for dimensionless values.
        first: first row to move, if a prior moves a share of the rows.
        step: number of the preceding step.
    """

    width: int
    neighbours: Neighbours
    rate: float
    unit: float
    first: int
    step: int = 0


class Move(NamedTuple):
    """A change of a parameter's values, as a function that can be recorded.

    Attributes:
        function: ``function(values, *arguments) -> values``, a function of a module. It reads arrays of its arguments only.
        arguments: numbers that differ from step to step are arrays.
    """

    function: Callable[..., mi.Float]
    arguments: tuple[Any, ...]


class DecoupledPrior(Strategy, tag="decoupled prior"):
    """A move of a parameter's values after each step; ``is_spatial`` marks priors that compare neighbours."""

    is_spatial: ClassVar[bool] = False

    weight: Annotated[float, setting("photograph", "number of agreeing photographs that balance the prior", ge=0)] = 1.0

    def make_move(self, rows: FieldRows) -> Move | None:
        """The move; None leaves all values. A spatial prior takes evaluated values."""
        raise NotImplementedError

    def apply(self, values: mi.Float, rows: FieldRows) -> mi.Float:
        """Values after the move."""
        return move_values(values, self.make_move(rows))


def move_values(values: mi.Float, move: Move | None) -> mi.Float:
    """Values after an optional move."""
    return values if move is None else move.function(values, *move.arguments)


class Smoothness(DecoupledPrior, tag="smoothness"):
    """Total variation, applied to a share of the rows at a time. Source: Rudin, Osher and Fatemi 1992.

    Each application copies all rows. Applying the prior every few steps, to a larger share, costs less for the same effect.
    """

    is_spatial = True
    cites = ("rudin_1992",)

    share: Annotated[float, setting("1", "share of the rows per step", gt=0, le=1)] = 1 / 8
    every: Annotated[int, setting("step", "steps between applications, each to the shares of all these steps", ge=1)] = 1

    def make_move(self, rows: FieldRows) -> Move | None:
        if rows.step % self.every:
            return None
        share, amount = min(self.every * self.share, 1), rows.rate * (self.every * self.weight) / rows.unit
        if amount == 0:
            return None
        run = max(int(rows.neighbours.count * share), 1)
        first, length = dr.opaque(mi.UInt32, rows.first), dr.opaque(mi.Float, amount / share)
        return Move(smooth, (rows.width, rows.neighbours, run, first, length))


class Sparsity(DecoupledPrior, tag="sparsity"):
    """The Cauchy prior on a density. Source: Hedman et al. 2021."""

    def make_move(self, rows: FieldRows) -> Move | None:
        amount = rows.rate * self.weight
        return Move(sparsify, (dr.opaque(mi.Float, 4 * amount), rows.unit)) if amount else None


class ViewDependence(DecoupledPrior, tag="view_dependence"):
    """Weight decay on the view-dependent coefficients. These overfit with few photographs."""

    def make_move(self, rows: FieldRows) -> Move | None:
        share = rows.rate * self.weight
        return Move(decay_view_dependence, (rows.width, dr.opaque(mi.Float, 1 - min(share, 1)))) if share else None


def smooth(values: mi.Float, width: int, neighbours: Neighbours, run: int, first: mi.UInt32, length: mi.Float) -> mi.Float:
    """Values after a run of rows moved down the slope of the total variation.

    A row appears in four terms, its own and the terms of the three previous nodes. Differences below 6 times the length of a
    step count as noise, so no term moves the row by more than a sixth of a difference, and values stay between their former
    minimum and maximum.

    Args:
        values: evaluated; they stay.
        width: numbers per row.
        neighbours: rows beside each row.
        run: number of rows to move.
        first: number of the first row to move.
        length: of a step down a slope of 1: the amount of the prior over the share of the rows, which stand for all rows.

    Cost: all values are copied; 13 rows read and 1 row written per moved row. A row is written by a single lane, without
    atomic addition.
    """
    moved_values, next_rows = mi.Float(values), neighbours.after
    row = (dr.arange(mi.UInt32, run) + first) % neighbours.count

    def numbers(row: mi.UInt32) -> mi.ArrayXf:
        return dr.gather(mi.ArrayXf, values, row, shape=(width, 1))

    own_values = numbers(row)
    terms = [(own_values, [numbers(dr.gather(mi.UInt32, after, row)) for after in next_rows])]
    for axis, before in enumerate(neighbours.before):
        # Without a previous node, `node` is the row itself, and its difference to the row is 0.
        node = dr.gather(mi.UInt32, before, row)
        after = [own_values if a == axis else numbers(dr.gather(mi.UInt32, next_, node)) for a, next_ in enumerate(next_rows)]
        terms.append((numbers(node), after))
    moved = []
    for c in range(width):
        own, *others = (_slopes([end[c] - at[c] for end in ends], 6 * length) for at, ends in terms)
        moved.append(dr.fma(length, sum(own) - sum(slopes[axis] for axis, slopes in enumerate(others)), own_values[c]))
    dr.scatter(moved_values, mi.ArrayXf(moved), row)
    return moved_values


def _slopes(steps: list[mi.Float], delta: mi.Float) -> list[mi.Float]:
    """Derivatives of the length of a difference by its components."""
    return [s * dr.rsqrt(dr.square(delta) + sum(dr.square(s) for s in steps)) for s in steps]


def sparsify(density: mi.Float, step: mi.Float, unit: float) -> mi.Float:
    """Density after the slope of the Cauchy prior times ``step`` / 4 [1], in units of 1 / ``unit``, and at least 0."""
    sigma = dr.maximum(density * unit, 0)
    fall = step * sigma / (1 + 2 * dr.square(sigma))
    return density - dr.minimum(fall, sigma) * (1 / unit)


def decay_view_dependence(harmonics: mi.Float, width: int, factor: mi.Float) -> mi.Float:
    """Coefficients, ``width`` per row, of which all but the three constant ones are multiplied by a factor."""
    return dr.select(dr.arange(mi.UInt32, dr.width(harmonics)) % width < 3, harmonics, harmonics * factor)


PRIORS = make_table(TotalVariation, HuberTotalVariation, Laplacian, Sparse, Bounds)
"""Priors in the loss, which a file can name."""

DECOUPLED_PRIORS = make_table(Smoothness, Sparsity, ViewDependence)
"""Priors of radiance fields, which move values after a step."""
