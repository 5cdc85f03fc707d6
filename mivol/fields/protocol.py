r"""What transport asks of a field that is an extinction: values and derivatives at points, and how much may be known of a line.

.. math:: \sigma_t(x, \omega) = s\, f(x, \omega; \theta)

A field declares in ``line`` what is known along a ray. ``EXACT_LINE``: the optical depth, and the distance at which it is
reached, cell by cell or in closed form; transport walks its lattice. ``BOUNDED``: no more than f at a point and a majorant;
transmittance is estimated against it, and a derivative at a point that is drawn.

Conventions. A field is 0 outside of its box, the unit cube under ``to_world``. A shell in :mod:`mivol.plugins` hands its field
to transport as ``mivol_extinction`` and its parameters to ``mi.traverse``.
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["BOUNDED", "EXACT_LINE", "Field", "accumulate_tracked"]

EXACT_LINE, BOUNDED = "exact_line", "bounded"


class Field(Protocol):
    """A field in space.

    Attributes:
        line: EXACT_LINE or BOUNDED.
        channels: 1 (grey) or 3 (rgb).
        to_world: (4, 4) float64 map of the unit cube to the world.
    """

    line: str
    channels: int
    to_world: np.ndarray

    def eval(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Float]:
        """Values of each channel at world points, for light that travels along ``w``; attached to the parameters.

        Lanes that are not active have the value 0.
        """

    def accumulate(self, p: mi.Point3f, w: mi.Vector3f, d: list[mi.Float], active: mi.Bool) -> None:
        """Add ``d`` (d loss / d value of each channel) at points to the gradients of the parameters: the transpose."""

    def bound(self) -> list[float]:
        """An upper bound of each channel over the box. Reads values: not while ``dr.freeze`` records."""

    def parameters(self) -> dict[str, Any]:
        """The arrays that derivatives are taken of, by name."""


def accumulate_tracked(field: Field, p: mi.Point3f, w: mi.Vector3f, d: list[mi.Float], active: mi.Bool) -> None:
    """Do what :meth:`Field.accumulate` promises, for a field whose ``eval`` Dr.Jit differentiates."""
    with dr.resume_grad():
        values = field.eval(p, w, active)
        if dr.grad_enabled(values):
            dr.backward_from(sum((weight * value for weight, value in zip(d, values, strict=True)), mi.Float(0)))
