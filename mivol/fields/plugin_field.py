r"""A volume of Mitsuba, or of another package, as an extinction: values at points by its own ``eval``, and its own ``max``.

.. math:: \sigma_t(x) = s\, v(x), \qquad 0 \le v(x) \le \max v

Conventions. The place is the bounding box of the volume, as in Mitsuba's ``heterogeneous``; outside of it the extinction is 0.
"""

from __future__ import annotations

from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.protocol import BOUNDED, accumulate_tracked
from mivol.files.volume import frame_from_box
from mivol.scene_graph import list_values, traverse

__all__ = ["PluginField"]


UNKNOWN = 64
"""Cells along each axis of a volume that names no resolution."""


class PluginField:
    """A bounded extinction (:class:`mivol.fields.protocol.Field`) that calls a volume plugin at points.

    The plugin promises that no value lies above ``max()``, as Mitsuba's own integrators assume. A value below 0 counts as 0,
    with the derivative at 0: its collisions would have negative probabilities.

    Args:
        volume: a plugin with ``max()`` and ``eval``. Its values are grey if ``channel_count()`` is 1, else rgb.

    Attributes:
        kind: class of the volume.

    Raises:
        MivolError: a volume without a finite bounding box.
    """

    line: ClassVar[str] = BOUNDED
    may_jump: ClassVar[bool] = True  # as a gridvolume of the nearest voxels does

    def __init__(self, volume: mi.Volume) -> None:
        kind = type(volume).__name__
        # Mitsuba names every plugin in C++ after its base, and every class in Python too.
        self.volume, self.kind = volume, volume.class_name() if kind == "Volume" else kind
        box = mi.Volume.bbox(volume)  # what Mitsuba reads too: it ignores a bbox() of Python
        low, high = np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel()
        if not (np.isfinite(high - low).all() and (high > low).all()):
            found = f"the volume {self.kind} has the bounding box {low} to {high}"
            raise MivolError(f"{found}; a finite box is expected: give to_world.")
        self.to_world = frame_from_box(low, high)
        size = tuple(int(n) for n in volume.resolution())[::-1]
        self.resolution = size if max(size) > 1 else (UNKNOWN,) * 3
        self.channels = 1 if mi.is_monochromatic or volume.channel_count() == 1 else 3

    def eval(self, p: mi.Point3f, w: mi.Vector3f, active: mi.Bool) -> list[mi.Float]:
        it = dr.zeros(mi.Interaction3f, dr.width(p))
        it.p = p
        values = self.volume.eval(it, active)
        rows = (values[channel] for channel in range(self.channels))
        return [dr.select(active, dr.replace_grad(dr.maximum(dr.detach(row), 0), row), 0) for row in rows]

    def accumulate(self, p: mi.Point3f, w: mi.Vector3f, d: list[mi.Float], active: mi.Bool) -> None:
        accumulate_tracked(self, p, w, d, active)

    def bound(self) -> list[float]:
        return [float(self.volume.max())] * self.channels

    def parameters(self) -> dict[str, Any]:
        return dict(list_values(traverse(self.volume)))
