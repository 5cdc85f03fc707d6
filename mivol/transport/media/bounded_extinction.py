"""The extinction of a field that is known at points only, and a majorant of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from mivol.fields.protocol import Field
from mivol.transport.media.box import Box
from mivol.transport.media.channels import tangent_of
from mivol.transport.media.extinction import RayInterval
from mivol.transport.traversal.fine_ray import Ray
from mivol.transport.traversal.lattice import slab

__all__ = ["BoundedExtinction"]


@dataclass
class BoundedExtinction:
    """A field of unknown line integrals (:class:`mivol.transport.media.extinction.Extinction`).

    Its gradient is that of the medium's scale; those of the field's parameters are with Dr.Jit.

    Attributes:
        name: ``sigma_t``, ``sigma_a`` or ``sigma_s``.
        field: its values [1/length] for a scale of 1.
        scale: of the medium, without derivatives.
        majorant: the field's largest value [1/length] in any channel; an opaque array, so that kernels do not depend on it.
    """

    name: str
    field: Field
    scale: mi.Float
    majorant: mi.Float
    exact_line: ClassVar[bool] = False
    is_constant: ClassVar[bool] = False
    lattice: ClassVar[None] = None

    def __post_init__(self) -> None:
        self._rows = Box(self.field.to_world).rows()

    @property
    def channels(self) -> int:
        """1 (grey) or 3 (rgb)."""
        return self.field.channels

    def scaled(self, scale: mi.Float) -> mi.Float:
        return scale

    def start_gradient(self) -> mi.Float:
        return dr.zeros(mi.Float, 1)

    def deliver(self, scale: mi.Float, gradient: mi.Float) -> mi.Float:
        dr.eval(gradient)
        return dr.sum(scale * gradient)

    def clip(self, interval: RayInterval) -> tuple[mi.Float, mi.Float]:
        """The part [t0, t1] of an interval of a ray that lies in the field's box; t1 <= t0 where there is none."""
        ray, t0, t1 = interval.ray, mi.Float64(interval.t0), mi.Float64(interval.t1)
        _, _, t0, t1 = slab(self._rows, (0.0,) * 3, (1.0,) * 3, ray.o, ray.d, t0, t1)
        return mi.Float(t0), mi.Float(t1)

    def eval_at(self, scale: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        return [dr.detach(scale) * value for value in dr.detach(self.field.eval(ray(t), ray.d, active))]

    def jvp_at(self, tangent: mi.Float, ray: Ray, t: mi.Float, active: mi.Bool) -> list[mi.Float]:
        with dr.resume_grad():
            values = self.field.eval(ray(t), ray.d, active)
            # One pass for all channels: it clears the edges behind it, which they share.
            changes = tangent_of(mi.Color3f(*values)) if self.channels == 3 else [tangent_of(values[0])]
        pairs = zip(dr.detach(values), changes, strict=True)
        return [dr.select(active, tangent * value + self.scale * change, 0) for value, change in pairs]

    def vjp_at(self, gradient: mi.Float, weight: list[mi.Float], ray: Ray, t: mi.Float, active: mi.Bool) -> None:
        values = dr.detach(self.field.eval(ray(t), ray.d, active))
        by_scale = sum((w * value for w, value in zip(weight, values, strict=True)), mi.Float(0))
        dr.scatter_add(gradient, dr.select(active, by_scale, 0), mi.UInt32(0), active)
        self.field.accumulate(ray(t), ray.d, [self.scale * w for w in weight], active)
