r"""The contract of a radiance field known only at points: hash grids and networks.

.. math:: (\sigma, c) = f(x, \omega; \theta)

Line integrals sample the field (:mod:`mivol.transport.line_integrals.sampled_rays`). One estimator and one adjoint serve every
sampled field: the adjoint evaluates the products with derivatives at the same points.

Conventions. Points and directions are in the world; directions point along the travel, |d| = 1. The extinction is in 1/length,
colours are sRGB code values or radiance (``space``). A field is 0 outside the box, the unit cube under ``to_world``, and is
evaluated only inside.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import SPACES

__all__ = ["FieldSizes", "PointValues", "Region", "SampledField"]


@dataclass(frozen=True)
class Region:
    """The cells in which a field is not 0, and how densely rays sample it.

    Cells are those between the nodes of a grid: along an axis with N nodes there are N + 1, the first and the last of half the
    length.

    Attributes:
        res: nodes (Z, Y, X).
        to_world: (4, 4) float64, unit cube of the grid to world.
        occupied: UInt8, 1 for a cell with matter, x fastest.
        step: longest distance between two samples of a ray [length].
    """

    res: tuple[int, int, int]
    to_world: np.ndarray
    occupied: mi.UInt8
    step: float

    def holds(self, p: mi.Point3f) -> mi.Bool:
        """Whether points of the world lie in occupied cells."""
        rows = [[dr.opaque(mi.Float, float(v)) for v in row] for row in np.linalg.inv(self.to_world)[:3]]
        unit = [dr.fma(r[0], p.x, dr.fma(r[1], p.y, dr.fma(r[2], p.z, r[3]))) for r in rows]
        place, inside, stride = mi.UInt32(0), mi.Bool(True), 1
        for u, nodes in zip(unit, self.res[::-1], strict=True):
            inside &= (u >= 0) & (u <= 1)
            place += mi.UInt32(dr.clip(dr.fma(u, nodes, 0.5), 0, nodes)) * stride
            stride *= nodes + 1
        return dr.gather(mi.UInt8, self.occupied, place, inside) > 0

    def middles(self, cells: np.ndarray) -> np.ndarray:
        """Middles (n, 3) of cells by their numbers (n,), world."""
        ends = [np.concatenate([[0], (np.arange(n) + 0.5) / n, [1]]) for n in self.res]
        places = np.unravel_index(cells, [n + 1 for n in self.res])
        unit = [0.5 * (end[place] + end[place + 1]) for end, place in zip(ends, places, strict=True)]
        return np.stack(unit[::-1], axis=1) @ self.to_world[:3, :3].T + self.to_world[:3, 3]


@dataclass
class PointValues:
    """Values of a field at points.

    Attributes:
        sigma: extinction [1/length].
        colour: in the space of the field.
        vjp: maps d loss / d sigma and d loss / d colour of each point to d loss / d parameter, by the name of the parameter.
    """

    sigma: mi.Float
    colour: mi.Color3f
    vjp: Callable[[mi.Float, mi.Color3f], dict[str, mi.Float]]


class FieldSizes(Protocol):
    """Sizes of a field that is known at points: a frozen dataclass of integers."""

    @property
    def weights(self) -> int:
        """Weights of the networks that a sample passes."""

    def count_numbers(self, edges: np.ndarray) -> int:
        """Number of fitted numbers, in a box with the edges (x, y, z)."""

    def describe(self, edges: np.ndarray) -> tuple[str, str]:
        """The model in a box with the edges (x, y, z), and its numbers."""


class SampledField(ABC):
    """A radiance field that is known at points: a frozen dataclass with the attributes below and its parameters.

    Attributes:
        kind: word of ``field.kind`` and of files.
        noun: the kind in a sentence.
        features: names of parameters that are features of places; other parameters are weights of networks.
        own_arrays: arrays of a file beside those of all kinds -> allowed kinds of NumPy types, and the shape.
        sizes: sizes of the field, a frozen dataclass.
        to_world: (4, 4) float64, unit cube to world.
        space: "srgb" or "linear".
        region: cells in which the field is not 0; None: everywhere in the box, without a known step.
        white: factor on the colours.
    """

    kind: ClassVar[str]
    noun: ClassVar[str]
    features: ClassVar[tuple[str, ...]] = ()
    own_arrays: ClassVar[dict[str, tuple[str, tuple[int, ...] | None]]]
    sizes: FieldSizes
    to_world: np.ndarray
    space: str
    region: Region | None
    white: float

    @property
    def coarse(self) -> SampledField | None:
        """The field that tells where rays are sampled more densely; None: samples follow the occupied cells."""
        return None

    @property
    def rounds(self) -> tuple[int, int]:
        """Samples of a ray in the rounds of coarse and fine; 0 without a coarse field."""
        return 0, 0

    @classmethod
    @abstractmethod
    def random(cls, sizes: FieldSizes, to_world: np.ndarray, seed: int = 0, space: str = "srgb") -> Self:
        """An untrained field."""

    @abstractmethod
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each parameter, by name."""

    @abstractmethod
    def density(self, p: mi.Point3f) -> mi.Float:
        """Extinction at points, without derivatives; the points are evaluated."""

    @abstractmethod
    def eval_density(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Float:
        """Extinction at points in the lanes of a kernel; attached to the parameters."""

    @abstractmethod
    def eval(self, p: mi.Point3f, d: mi.Vector3f, active: mi.Bool = True) -> tuple[mi.Float, mi.Color3f]:
        """Extinction and colour at points in the lanes of a kernel; attached to the parameters."""

    @abstractmethod
    def evaluate(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        """Extinction and colour at points, with their derivatives; the points are evaluated."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays ``own_arrays`` of a file."""

    @classmethod
    @abstractmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray], parameters: list[mi.Float], region: Region) -> Self:
        """The field of a file's arrays; raises :class:`mivol.errors.MivolError` if they contradict each other."""

    @classmethod
    @abstractmethod
    def parameter_names(cls) -> tuple[str, ...]:
        """Names of the parameters."""

    @abstractmethod
    def tabulate(self) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
        """Heads and rows of a table of the field's parts."""

    def check(self) -> None:
        """Check the space and the numbers of each parameter.

        Raises:
            MivolError: an unknown space, or a parameter of another size.
        """
        if self.space not in SPACES:
            raise MivolError(f"found the space {self.space!r}, expected one of {', '.join(SPACES)}.")
        for name, shape in self.shapes().items():
            found = dr.width(getattr(self, name))
            if found != math.prod(shape):
                size = " x ".join(str(n) for n in shape)
                wanted = f"expected {size} by the sizes of this {self.noun}"
                raise MivolError(f"{name} has {found} numbers, {wanted}: write the file again.")

    def parameters(self) -> dict[str, mi.TensorXf]:
        """Values by name."""
        return {name: mi.TensorXf(mi.Float(getattr(self, name)), shape) for name, shape in self.shapes().items()}

    def with_parameters(self, values: dict[str, mi.TensorXf]) -> Self:
        """The field with other values of the same shapes."""
        return replace(self, **{name: values[name].array for name in self.shapes()})

    def scale_colours(self, white: float) -> Self:
        """The field with its radiance multiplied by a number; sRGB code values are only multiplied by 1."""
        return replace(self, white=self.white * white)

    @property
    def numbers(self) -> int:
        """Number of fitted numbers."""
        return sum(math.prod(shape) for shape in self.shapes().values())

    @property
    def edges(self) -> np.ndarray:
        """Edges of the box (x, y, z) [length]."""
        return np.linalg.norm(self.to_world[:3, :3], axis=0)

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
