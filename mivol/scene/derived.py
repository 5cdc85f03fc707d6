"""Derived values: textures and tables that plugins compute from their parameters, on the way of derivatives.

Conventions. A plugin computes derived values when a parameter changes. Dr.Jit follows the edge from a parameter to a derived
value only once, and never from inside a loop. So a reverse pass first recomputes the derived values with fresh edges. A
forward pass computes them from copies of the parameters, and carries the tangents to them before any kernel reads them.
Extinction needs neither: transport reads extinction from the parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.kernel_recording import is_recording
from mivol.scene_graph import list_values, traverse
from mivol.transport.media.medium_view import traverse_medium

__all__ = ["carry_tangents", "recompute_derived"]


@dataclass
class _DifferentiatedParameter:
    """A parameter with gradients enabled, with a copy of its value: an update may replace the array."""

    params: mi.SceneParameters
    key: str
    value: Any

    @property
    def numbers(self) -> Any:
        """The array, or the matrix of a transform."""
        return self.value if dr.is_array_v(self.value) else self.value.matrix

    def assign(self, value: Any) -> None:
        """Set the parameter, and compute all derived values from the new value."""
        self.params[self.key] = value
        self.params.set_dirty(self.key)
        self.params.update()

    def restore(self) -> None:
        """Restore the original value without an update."""
        self.params[self.key] = self.value


def recompute_derived(scene: mi.Scene) -> None:
    """Recompute the derived values of all parameters with gradients. Does nothing while ``dr.freeze`` records."""
    for parameter in _find_differentiated(scene):
        parameter.assign(parameter.value)
        parameter.restore()


@contextmanager
def carry_tangents(scene: mi.Scene) -> Iterator[None]:
    """Compute derived values from copies of the parameters, with tangents, inside a ``with`` block."""
    with dr.resume_grad():
        parameters = _find_differentiated(scene)
        copies = [dr.detach(parameter.numbers) for parameter in parameters]
        for parameter, copy in zip(parameters, copies, strict=True):
            dr.enable_grad(copy)
            dr.set_grad(copy, dr.grad(parameter.numbers))
            parameter.assign(type(parameter.value)(copy))
        if copies:
            dr.enqueue(dr.ADMode.Forward, copies)
            dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    try:
        yield
    finally:
        with dr.resume_grad():
            for parameter in parameters:
                parameter.assign(parameter.value)
                parameter.restore()


def _find_differentiated(scene: mi.Scene) -> list[_DifferentiatedParameter]:
    """Find the parameters with gradients of emitters, BSDFs, phase functions and volumes."""
    if is_recording():
        return []
    inside = [shape.interior_medium() for shape in scene.shapes() if shape.interior_medium() is not None]
    owners = [*scene.emitters(), *(s.bsdf() for s in scene.shapes()), *(o for m in inside for o in _find_derived_owners(m))]
    parameters = []
    for owner in {o.ptr: o for o in owners if o is not None}.values():
        params = traverse(owner)
        followed = [(k, v) for k, v in list_values(params) if _is_differentiated(v) and not _is_computed(params, k)]
        parameters += [_DifferentiatedParameter(params, k, type(v)(v)) for k, v in followed]
    return parameters


def _find_derived_owners(medium: mi.Medium) -> list[mi.Object]:
    """The phase function of a medium, and its volumes except those read directly by transport."""
    known = traverse_medium(medium).properties
    volumes = {key.partition(".")[0]: node for key, (_, _, node, _) in known.items() if isinstance(node, mi.Volume)}
    stands = [n for n, v in volumes.items() if n.startswith("sigma_") or hasattr(v, "mivol_extinction")]
    read = [n for n in stands if f"{n}.table" not in known]
    return [medium.phase_function(), *(v for n, v in volumes.items() if n not in read)]


def _is_differentiated(value: Any) -> bool:
    """Whether an array or a transform has gradients enabled."""
    array = value if dr.is_array_v(value) else getattr(value, "matrix", None)
    return array is not None and dr.is_diff_v(array) and dr.grad_enabled(array)


def _is_computed(params: mi.SceneParameters, key: str) -> bool:
    """Whether a plugin computes the parameter from its other parameters, such as the grid of a ``mivol_transfer``."""
    return key == "data" and "table" in params
