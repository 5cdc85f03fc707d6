"""What is known of a field before anything is measured: smooth, piecewise constant, sparse, bounded.

Conventions. A field is a tensor (Z, Y, X, C) of values at voxel centres with spacing (z, y, x) [length]; differences
across the border vanish (clamped borders). An energy is the mean over the volume, an integral per volume, so that
refining the grid does not change it. Gradients come from Dr.Jit's AD; :meth:`Prior.value_and_gradient` serves NumPy.
Non-quadratic energies also give the quadratic form that touches them from above at a field (lagged diffusivity), which
Gauss-Newton and conjugate gradients need. PRIORS lists them, and those that act apart from the gradient
(:mod:`mivol.optim.decoupled_priors`).
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.optim.decoupled_priors import Smoothness, Sparsity, ViewDependence
from mivol.optim.strategy import Strategy, of, table

Spacing = tuple[float, float, float]


def next_along(x: mi.TensorXf, axis: int) -> mi.Float:
    """The value one voxel further along ``axis``; at the far border the voxel's own (clamp)."""
    shape = x.shape
    stride = int(np.prod(shape[axis + 1 :]))
    flat = dr.arange(mi.UInt32, int(np.prod(shape)))
    at = (flat // stride) % shape[axis]
    return dr.gather(mi.Float, x.array, dr.select(at + 1 < shape[axis], flat + stride, flat))


def previous_along(x: mi.TensorXf, axis: int) -> mi.Float:
    """The value one voxel back along ``axis``; at the near border the voxel's own (clamp)."""
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
    """An energy of a field; ``is_spatial`` tells that it compares neighbours."""

    is_spatial: ClassVar[bool] = True

    weight: Annotated[float, of("1", "factor in front of the energy, beside the mean loss", ge=0)] = 1.0

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        """Mean energy of the field, without the weight."""
        raise NotImplementedError

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        """1/2 v^T H v, H >= 0 the curvature of the majorising parabola at ``x`` (detached)."""
        raise NotImplementedError

    def curvature(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.TensorXf:
        """weight * H v for the H of :meth:`quadratic`."""
        v = mi.TensorXf(dr.detach(v))
        dr.enable_grad(v)
        dr.backward(self.weight * self.quadratic(dr.detach(x), v, spacing))
        return dr.grad(v)

    def value_and_gradient(self, x: np.ndarray, spacing: Spacing) -> tuple[float, np.ndarray]:
        """weight * energy and its gradient, for solvers that keep their field in NumPy.

        Args:
            x: field (Z, Y, X, C) or (Z, Y, X).
            spacing: voxel size (z, y, x) [length].

        Returns:
            The energy and its gradient, in the shape of ``x``.

        Raises:
            MivolError: ``x`` has another rank.
        """
        if x.ndim not in (3, 4):
            raise MivolError(f"a prior takes a field (Z, Y, X) or (Z, Y, X, C), found shape {x.shape}: reshape it.")
        field = mi.TensorXf(np.ascontiguousarray(x.reshape(*x.shape[:3], -1), dtype=np.float32))
        dr.enable_grad(field)
        energy = self.weight * self.energy(field, spacing)
        dr.backward(energy)
        return float(energy[0]), np.asarray(dr.grad(field)).reshape(x.shape)


class TotalVariation(Prior, tag="tv"):
    """|grad x|, rounded off at ``edge``: flat regions with sharp borders.

    sqrt(|g|^2 + edge^2) - edge. Source: Rudin, Osher and Fatemi 1992, Physica D 60; quadratic form: Vogel and Oman
    1996, SIAM J. Sci. Comput. 17(1).
    """

    cites = ("rudin_1992",)

    edge: Annotated[float, of("value/length", "gradients below this are smoothed quadratically", gt=0)] = 1e-2

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return dr.mean(dr.sqrt(squared_gradient(x, spacing) + self.edge**2) - self.edge)

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(squared_gradient(v, spacing) * dr.rsqrt(squared_gradient(x, spacing) + self.edge**2))


class HuberTotalVariation(Prior, tag="huber_tv"):
    """|g| - edge / 2 where |g| = |grad x| > edge, |g|^2 / (2 edge) below: as tv, but exactly quadratic in the noise.

    Source: Huber 1964 for the function; Fessler and others use it as "edge-preserving" penalty.
    """

    cites = ("rudin_1992", "huber_1964")

    edge: Annotated[float, of("value/length", "gradient at which the parabola goes over into a line", gt=0)] = 1e-1

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        g2 = squared_gradient(x, spacing)
        # sqrt has no slope at 0: the branch that uses it never sees less than edge^2.
        line = dr.sqrt(dr.maximum(g2, self.edge**2)) - 0.5 * self.edge
        return dr.mean(dr.select(g2 <= self.edge**2, g2 / (2.0 * self.edge), line))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        weight = dr.rsqrt(dr.maximum(squared_gradient(x, spacing), self.edge**2))
        return 0.5 * dr.mean(weight * squared_gradient(v, spacing))


class Laplacian(Prior, tag="laplacian"):
    """1/2 (Laplace x)^2: no wiggles; straight ramps cost nothing."""

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(laplacian(x, spacing)))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(laplacian(v, spacing)))


class Sparse(Prior, tag="l1"):
    """|x|: empty where nothing says otherwise. Its majorising parabola rounds off below ``knee``."""

    is_spatial = False

    knee: Annotated[float, of("value", "values below this are pulled to 0 quadratically by Gauss-Newton", gt=0)] = 1e-3

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return dr.mean(dr.abs(x.array))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(v.array) / dr.maximum(dr.abs(x.array), self.knee))


class Bounds(Prior, tag="bounds"):
    """1/2 distance^2 to [low, high]: a soft wall for values that should, but need not, stay inside."""

    is_spatial = False

    low: Annotated[float, of("value", "lower wall")] = 0.0
    high: Annotated[float, of("value", "upper wall")] = float("inf")

    def outside(self, x: mi.TensorXf) -> mi.Float:
        """Signed distance to the interval."""
        return dr.maximum(x.array - self.high, 0.0) + dr.minimum(x.array - self.low, 0.0)

    def energy(self, x: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.square(self.outside(x)))

    def quadratic(self, x: mi.TensorXf, v: mi.TensorXf, spacing: Spacing) -> mi.Float:
        return 0.5 * dr.mean(dr.select(self.outside(x) != 0.0, dr.square(v.array), 0.0))


PRIORS = table(
    *(TotalVariation, HuberTotalVariation, Laplacian, Sparse, Bounds),
    *(Smoothness, Sparsity, ViewDependence),
)
