r"""One additive part of the extinction of a medium, at points of rays and along rays.

.. math:: \sigma_t(x) = s \sum_k f_k(x)

The scale s belongs to the medium; a part is a single f_k. An adapter for each kind of field implements :class:`Extinction`, so
code walking through media does not depend on the kind. An :class:`ExactExtinction` also knows its integral along a ray.
Adapters for grids and for Gaussians are in :mod:`mivol.transport.media.grid_extinction` and
:mod:`mivol.transport.media.gaussian_extinction`.

Conventions. Distances are along the ray, from its origin [length]. Rows are lists with a ``Float`` for each channel of the
part. Values come without derivatives. Tangents and gradients belong to ``scaled(s)``, the array through which Dr.Jit reaches
the scale and the parameters of the part: ``jvp`` multiplies by the derivative, ``vjp`` by its transpose.

Channels are grey (1) or rgb (3) for a medium; a scene has the larger number among its media. A grey medium has the same value
in every channel of an rgb scene, so its derivative is the sum over the channels. In a mono variant the luminance replaces an
rgb medium.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.protocol import Field
from mivol.numerics import minimum
from mivol.transport.traversal.box import Box, clip_to_box
from mivol.transport.traversal.grid_walk import Cell, walk_cells
from mivol.transport.traversal.interpolation import GAUSS_POINT
from mivol.transport.traversal.lattice import Lattice, clip_to_grid
from mivol.transport.traversal.rays import Ray

__all__ = [
    "LUMINANCE",
    "BoundedExtinction",
    "ConstantExtinction",
    "ExactExtinction",
    "Extinction",
    "RayInterval",
    "colours_to_channels",
    "take_tangent",
    "to_components",
    "to_part_channels",
    "to_scene_channels",
    "to_spectrum",
]

LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Weight of each channel of an rgb field in the channel of a mono variant (luminance, ITU-R BT.709, as in Mitsuba)."""


def to_spectrum(rows: list[mi.Float]) -> mi.Spectrum:
    """A number for each channel of the scene, as a spectrum."""
    return mi.Spectrum(*rows) if len(rows) == 3 else mi.Spectrum(rows[0])


def take_tangent(value: mi.Spectrum) -> mi.Spectrum:
    """The tangent of a value computed from parameters; 0 without a tangent.

    Only the edges of the graph are cleared; the tangents of the parameters stay, since other points and passes read them again.
    """
    return dr.forward_to(value, flags=dr.ADFlag.ClearEdges) if dr.grad_enabled(value) else dr.zeros(type(value))


def to_components(value: mi.Spectrum) -> list[mi.Float]:
    """The components of a spectrum, as a list."""
    return [value[c] for c in range(dr.size_v(value))]


def colours_to_channels(value: mi.Spectrum, channels: int) -> list[mi.Float]:
    """Derivatives by the channels of an extinction, from derivatives by the colours of a spectrum: a grey extinction gets the
    sum.
    """
    parts = to_components(value)
    return parts if len(parts) == channels else [sum(parts[1:], parts[0])]


def to_scene_channels(values: list[mi.Float], channels: int) -> list[mi.Float]:
    """The values of a grey or rgb part for each channel of the scene."""
    if len(values) > channels:
        return _grey(values)
    return [values[c % len(values)] for c in range(channels)]


def _grey(rows: list[mi.Float]) -> list[mi.Float]:
    """The luminance of three channels, for a mono variant."""
    return [sum(share * row for share, row in zip(LUMINANCE, rows, strict=True))]


def to_part_channels(weight: list[mi.Float], channels: int) -> list[mi.Float]:
    """Derivatives by the channels of a part, from derivatives by the channels of the scene.

    The transpose of :func:`to_scene_channels`.
    """
    if len(weight) == channels:
        return weight
    return [sum(weight)] if channels == 1 else [share * weight[0] for share in LUMINANCE]


# -- Extinction --------------------------------------------------------------------------------------------------------

Weight = list | Callable
"""d loss / d tau, a number for each channel: a list for all of a ray, or a function from the lower node of a cell (a
``mi.Vector3i``) to the list of the cell."""


def weight_in_cell(weight: Weight, lower: mi.Vector3i) -> list[mi.Float]:
    """The weight in the cell with a lower node."""
    return weight(lower) if callable(weight) else weight


@dataclass
class RayInterval:
    """An interval of a ray for the integration of an extinction.

    Attributes:
        ray: world space, unit direction.
        t0, t1: distances from the origin of the ray [length]; ``t1`` may be infinite.
        active: lanes with the interval.
    """

    ray: Ray
    t0: mi.Float64 | mi.Float
    t1: mi.Float64 | mi.Float
    active: mi.Bool


class Extinction(Protocol):
    """A part of an extinction, known at points.

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        exact_line: whether the part is an :class:`ExactExtinction`.
        is_constant: whether the part is the same number everywhere in its boundary.
        lattice: the cells for a walk to follow; None without cells.
        channels: 1 (grey) or 3 (rgb).
    """

    name: str
    exact_line: bool
    is_constant: bool
    lattice: Lattice | None
    channels: int

    def scaled(self, scale: mi.Float) -> mi.Float | mi.Color3f:
        """The array whose tangents a forward pass takes, attached to the scale and to the parameters."""

    def start_gradient(self, rays: float = math.inf) -> Any:
        """A gradient of zero for the ``vjp`` methods to add to, for so many rays."""

    def fold_gradient(self, gradient: Any) -> mi.Float:
        """The accumulated gradient of ``scaled(s)``, as a flat array."""

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """``scale`` times the coefficient [1/length] at a point of a ray; 0 outside the part."""

    def jvp_at(self, tangent: Any, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """Tangent of :meth:`eval_at`."""

    def vjp_at(self, gradient: Any, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        """Add ``weight`` (d loss / d coefficient) at a point of a ray to a gradient: the transpose of :meth:`jvp_at`."""


class ExactExtinction(Extinction, Protocol):
    """A part whose integral over an interval of a ray is known: in closed form, or cell by cell.

    Attributes:
        rough: a part with fewer cells and nearly the same values, for drawing distances; None without one.
    """

    rough: ExactExtinction | None

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        """Optical depth [1] for a scale of 1; the walk may stop where every channel exceeds ``enough``."""

    def jvp(self, tangent: Any, interval: RayInterval) -> list[mi.Float]:
        """Tangent of the optical depth, the scale included."""

    def vjp(self, gradient: Any, weight: Weight, interval: RayInterval) -> None:
        """Add ``weight`` (d loss / d tau) times the interval to a gradient: the transpose of :meth:`jvp`. Only grids take a
        weight that depends on the cell.
        """


@dataclass
class ConstantExtinction:
    """A constant, grey or rgb (:class:`ExactExtinction`).

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        constant: the value [1/length], with its derivatives.
    """

    name: str
    constant: mi.Float | mi.Color3f
    exact_line: ClassVar[bool] = True
    is_constant: ClassVar[bool] = True
    lattice: ClassVar[None] = None
    rough: ClassVar[None] = None

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (rgb)."""
        return 3 if dr.size_v(self.constant) == 3 else 1

    @property
    def values(self) -> mi.Float | mi.Color3f:
        """The value [1/length]."""
        return self.constant

    def scaled(self, scale: mi.Float) -> mi.Float | mi.Color3f:
        return scale * self.constant

    def start_gradient(self, rays: float = math.inf) -> mi.Float:
        return dr.zeros(mi.Float, self.channels)

    def fold_gradient(self, gradient: mi.Float) -> mi.Float:
        return gradient

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        return self._along(dr.detach(self.constant), _length(interval))

    def jvp(self, tangent: mi.Float | mi.Color3f, interval: RayInterval) -> list[mi.Float]:
        return self._along(tangent, _finite(_length(interval)))

    def vjp(self, gradient: mi.Float, weight: list[mi.Float], interval: RayInterval) -> None:
        length = _finite(_length(interval))
        for c, w in enumerate(weight):
            dr.scatter_add(gradient, dr.select(w != 0, w * length, 0), mi.UInt32(c), interval.active)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return self._rows(dr.detach(self.scaled(scale)))

    def jvp_at(self, tangent: mi.Float | mi.Color3f, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return self._rows(tangent)

    def vjp_at(self, gradient: mi.Float, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        for c, w in enumerate(weight):
            dr.scatter_add(gradient, dr.select(active, w, 0), mi.UInt32(c), active)

    def _along(self, value: mi.Float | mi.Color3f, length: mi.Float) -> list[mi.Float]:
        # A ray that never leaves a medium has infinite length: 0 * inf would be NaN.
        return [dr.select(v != 0, v * length, 0) for v in self._rows(value)]

    def _rows(self, value: mi.Float | mi.Color3f) -> list[mi.Float]:
        # A grey value is taken whole: the index of a Dr.Jit array reads it, and bakes it into the kernel.
        return [value] if self.channels == 1 else [value.x, value.y, value.z]


def _length(interval: RayInterval) -> mi.Float:
    return dr.select(interval.active & (interval.t1 > interval.t0), mi.Float(interval.t1 - interval.t0), 0)


def _finite(length: mi.Float) -> mi.Float:
    """Lengths for derivatives: 0 for an interval without end, whose transmittance stays 0 for every constant."""
    return dr.select(length < 1e30, length, 0)


MOST_CELLS = 512
"""Most cells of a field along an axis that quadrature passes: a ray meets up to 6 times as many points."""


@dataclass
class BoundedExtinction:
    """A field known at points, with a majorant.

    It is an :class:`Extinction`, whose integrals along rays are estimated. With a ``lattice`` it is an
    :class:`ExactExtinction`, which integrates by two Gauss points in each cell.

    The gradient of this part is the gradient of the scale of the medium. Dr.Jit tracks the gradients of the parameters of the
    field.

    Bias: with a ``lattice``, that of the quadrature. It falls with the fourth power of a cell if the field is smooth in each
        cell, with the second power at a kink, with the first at a jump.

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        field: values [1/length] for a scale of 1.
        scale: scale of the medium, without derivatives.
        majorant: largest value of the field [1/length] in all channels; an opaque array, so kernels do not depend on the
            number.
        lattice: the cells of the quadrature, whose values are not read; the cells around the box are empty. None: no
            quadrature.
    """

    name: str
    field: Field
    scale: mi.Float
    majorant: mi.Float
    lattice: Lattice | None = None
    is_constant: ClassVar[bool] = False
    rough: ClassVar[None] = None

    def __post_init__(self) -> None:
        self.rows = Box(self.field.to_world).rows()

    @property
    def exact_line(self) -> bool:
        """Whether this part is an :class:`ExactExtinction`."""
        return self.lattice is not None

    @property
    def values(self) -> mi.Float:
        """The factor on the field."""
        return mi.Float(1)

    def by_quadrature(self) -> BoundedExtinction:
        """The same part, integrated by quadrature in halves of the field's cells.

        Raises:
            MivolError: a field of more cells than quadrature passes.
        """
        cells = np.array(self.field.resolution)
        if cells.max() > MOST_CELLS:
            raise MivolError(
                f"{self.name} has {cells.max()} cells along an axis and is known at points only; quadrature passes at most "
                f"{MOST_CELLS}: leave deterministic and aovs out, or sample it to a mivol_voxels (nodes of a mivol_hash)."
            )
        # The cells of a lattice lie between its nodes: so the first and the last node lie in faces of the box.
        halves = 2 * cells[::-1]
        widen = np.diag([*(1 + 1 / halves), 1.0])
        widen[:3, 3] = -0.5 / halves
        zeros = dr.zeros(mi.TensorXf, (*(halves[::-1] + 1).tolist(), 1))
        return replace(self, lattice=Lattice(zeros, self.field.to_world @ widen))

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (rgb)."""
        return self.field.channels

    def scaled(self, scale: mi.Float) -> mi.Float:
        return scale

    def start_gradient(self, rays: float = math.inf) -> mi.Float:
        return dr.zeros(mi.Float, 1)

    def fold_gradient(self, gradient: mi.Float) -> mi.Float:
        return gradient

    def clip(self, interval: RayInterval) -> tuple[mi.Float, mi.Float]:
        """The part [t0, t1] of an interval of a ray inside the box of the field; t1 <= t0 if the interval misses the box."""
        ray, t0, t1 = interval.ray, mi.Float64(interval.t0), mi.Float64(interval.t1)
        _, _, t0, t1 = clip_to_box(self.rows, (0.0,) * 3, (1.0,) * 3, ray.o, ray.d, t0, t1)
        return mi.Float(t0), mi.Float(t1)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [dr.detach(scale) * value for value in dr.detach(self.field.eval(ray(t), ray.d, active))]

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        with dr.resume_grad():
            values = self.field.eval(ray(t), ray.d, active)
            # One pass for all channels: it clears the edges behind it, which they share.
            changes = take_tangent(mi.Color3f(*values)) if self.channels == 3 else [take_tangent(values[0])]
        pairs = zip(dr.detach(values), changes, strict=True)
        return [dr.select(active, tangent * value + self.scale * change, 0) for value, change in pairs]

    def vjp_at(self, gradient: mi.Float, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        values = dr.detach(self.field.eval(ray(t), ray.d, active))
        by_scale = sum((w * value for w, value in zip(weight, values, strict=True)), mi.Float(0))
        dr.scatter_add(gradient, dr.select(active, by_scale, 0), mi.UInt32(0), active)
        self.field.accumulate(ray(t), ray.d, [self.scale * w for w in weight], active)

    # -- By quadrature -------------------------------------------------------------------------------------------------

    def integrate(self, interval: RayInterval, enough: mi.Float | None = None) -> list[mi.Float]:
        def add(tau: list, t: mi.Float, weight: mi.Float, on: mi.Bool) -> list:
            values = self.eval_at(mi.Float(1), interval.ray, t, on)
            return [dr.fma(weight, value, total) for value, total in zip(values, tau, strict=True)]

        return self._sum(interval, add, self._zeros, None if enough is None else lambda tau: minimum(tau) > enough)

    def jvp(self, tangent: mi.Float, interval: RayInterval) -> list[mi.Float]:
        def add(tau: list, t: mi.Float, weight: mi.Float, on: mi.Bool) -> list:
            values = self.jvp_at(tangent, interval.ray, t, on)
            return [dr.fma(weight, value, total) for value, total in zip(values, tau, strict=True)]

        return self._sum(interval, add, self._zeros)

    def vjp(self, gradient: mi.Float, weight: list[mi.Float], interval: RayInterval) -> None:
        def add(state: None, t: mi.Float, length: mi.Float, on: mi.Bool) -> None:
            self.vjp_at(gradient, [length * w for w in weight], interval.ray, t, on)
            return state

        self._sum(interval, add, None)

    @property
    def _zeros(self) -> list[mi.Float]:
        return [mi.Float(0) for _ in range(self.channels)]

    def _sum(self, interval: RayInterval, add: Callable[..., Any], state: Any, until: Callable | None = None) -> Any:
        """Call ``add(state, t, weight, active)`` for the Gauss points of an interval, with their weights [length]."""
        segment = clip_to_grid(self.lattice, interval.ray.o, interval.ray.d, interval.t0, interval.t1)

        def visit(state: Any, cell: Cell, on: mi.Bool) -> Any:
            for u in (GAUSS_POINT, 1 - GAUSS_POINT):
                t = segment.t0 + dr.fma(cell.dt, u, cell.s)
                state = add(state, t, dr.select(on, 0.5 * cell.dt, 0), on)
            return state

        return walk_cells(self.lattice, segment, visit, state, (), interval.active, until)
