r"""The protocol of a field that transport uses as an extinction: values and derivatives at points, and bounds.

.. math:: \sigma_t(x, \omega) = s\, f(x, \omega; \theta)

``line`` declares the knowledge along a ray. ``EXACT_LINE``: transport computes the optical depth, and the distance at which a
ray reaches it, cell by cell or in closed form. ``BOUNDED``: transport knows only f at points and a majorant; it estimates
transmittance with the majorant, and derivatives at random points. Where noise is not asked for (``deterministic``, AOVs, a
moving emitter), it integrates f by Gauss points in the cells of ``resolution``.

Conventions. A field is 0 outside the box, the unit cube under ``to_world``. A plugin (:mod:`mivol.plugins`) hands the field to
transport as ``mivol_extinction``, and its parameters to ``mi.traverse``.
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

EXACT_LINE, BOUNDED = "exact_line", "bounded"


class Field(Protocol):
    """A field of extinction in space.

    Attributes:
        line: EXACT_LINE or BOUNDED.
        channels: 1 (grey) or 3 (rgb).
        to_world: (4, 4) float64, unit cube to world.
        resolution: of a BOUNDED field, the number of cells along its axes (Z, Y, X) that show its finest detail.
        may_jump: whether values of a BOUNDED field may jump inside the box; otherwise it has ``slopes``.
    """

    line: str
    channels: int
    to_world: np.ndarray
    resolution: tuple[int, int, int]
    may_jump: bool

    def eval(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Float]:
        """Values of each channel at world points for light travelling along ``w``; attached to the parameters.

        Inactive lanes have the value 0.
        """

    def accumulate(self, p: mi.Point3f, w: mi.Vector3f, d: list[mi.Float], active: mi.Bool) -> None:
        """Add ``d`` (d loss / d value of each channel) at points to the gradients of the parameters: the transpose of eval."""

    def slopes(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Vector3f]:
        """Derivative of each channel by the world point, of a BOUNDED field without jumps inside its box; no derivatives."""

    def bound(self) -> list[float]:
        """An upper bound of each channel over the box. Reads values, which ``dr.freeze`` cannot record."""

    def parameters(self) -> dict[str, Any]:
        """Differentiable arrays by name."""


def accumulate_tracked(field: Field, p: mi.Point3f, w: mi.Vector3f, d: list[mi.Float], active: mi.Bool) -> None:
    """Implement :meth:`Field.accumulate` for a field whose ``eval`` Dr.Jit differentiates."""
    with dr.resume_grad():
        values = field.eval(p, w, active)
        if dr.grad_enabled(values):
            dr.backward_from(sum((weight * value for weight, value in zip(d, values, strict=True)), mi.Float(0)))


class GridValues:
    """What a dense and a sparse grid of voxels share: a field with its values in ``tensor``, which Dr.Jit differentiates."""

    tensor: mi.TensorXf

    def eval_colour(self, p: mi.Point3f, active: mi.Bool = True) -> list[mi.Float]:
        """Values as :meth:`eval`; in a mono variant an rgb grid has one channel, its luminance, as in ``gridvolume``."""
        values = self.eval(p, None, active)
        return [mi.luminance(mi.Color3f(*values))] if mi.is_monochromatic and len(values) == 3 else values

    def accumulate(self, p: mi.Point3f, w: mi.Vector3f | None, d: list[mi.Float], active: mi.Bool = True) -> None:
        """Add ``d`` (d loss / d value of each channel) at world points to the gradient of the stored voxels."""
        accumulate_tracked(self, p, w, d, active)

    def parameters(self) -> dict[str, mi.TensorXf]:
        """The stored values, ``data``."""
        return {"data": self.tensor}
