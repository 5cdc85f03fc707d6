r"""The contract of a radiance field that is known only at points: hash grids and networks.

.. math:: (\sigma, c) = f(x, \omega; \theta)

Line integrals sample such a field (:mod:`mivol.transport.line_integrals.sampled_rays`). One estimator and one adjoint serve
all of them: the adjoint asks for the products of derivatives at the same points.

Conventions. Points and directions are in the world; directions are those of travel, |d| = 1. The extinction is in 1/length,
colours are sRGB code values or radiance (``space``). A field is 0 outside its box, the unit cube under ``to_world``, and is
asked only inside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["PointValues", "Region", "SampledField"]


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


class SampledField(Protocol):
    """A radiance field that is known at points.

    Attributes:
        to_world: (4, 4) float64, unit cube to world.
        space: "srgb" or "linear".
        region: cells in which the field is not 0; None: everywhere in the box, without a known step.
    """

    to_world: np.ndarray
    space: str
    region: Region | None

    def density(self, p: mi.Point3f) -> mi.Float:
        """Extinction at points, without derivatives; the points are evaluated."""

    def evaluate(self, p: mi.Point3f, d: mi.Vector3f) -> PointValues:
        """Extinction and colour at points, with their derivatives; the points are evaluated."""

    def parameters(self) -> dict[str, mi.TensorXf]:
        """Values by name."""

    def with_parameters(self, values: dict[str, mi.TensorXf]) -> SampledField:
        """The field with other values of the same shapes."""
