"""Derived values: the textures and tables that plugins compute from their parameters, and that derivatives pass through.

Conventions. A plugin computes them when a parameter changes. Dr.Jit follows the edge from a parameter to a derived value only
once, and never from inside a loop. So before a reverse pass the derived values are computed anew, with fresh edges; for a
forward pass they are computed from copies of the parameters, and the tangents are carried to them before any kernel reads
them. Extinction needs neither: transport reads it from the parameters themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.kernel_recording import is_recording
from mivol.transport.media.medium_view import traverse_medium

__all__ = ["carry_tangents", "recompute_derived"]


@dataclass
class _DifferentiatedParameter:
    """A parameter whose derivative is asked for: a copy of what stands there, since an update may put other arrays there."""

    params: mi.SceneParameters
    key: str
    value: Any

    @property
    def numbers(self) -> Any:
        """The array itself, or the matrix of a transform."""
        return self.value if dr.is_array_v(self.value) else self.value.matrix

    def make_of(self, value: Any) -> None:
        """Set the parameter to a value, and compute all derived values from it."""
        self.params[self.key] = value
        self.params.set_dirty(self.key)
        self.params.update()

    def put_back(self) -> None:
        """Set the parameter to what it was, without an update."""
        self.params[self.key] = self.value


def recompute_derived(scene: mi.Scene) -> None:
    """Compute the derived values of all parameters with gradients anew. While ``dr.freeze`` records, nothing is done."""
    for asked in _find_differentiated(scene):
        asked.make_of(asked.value)
        asked.put_back()


@contextmanager
def carry_tangents(scene: mi.Scene) -> Iterator[None]:
    """Within this context derived values come from copies of the parameters, and have their tangents."""
    with dr.resume_grad():
        found = _find_differentiated(scene)
        copies = [dr.detach(asked.numbers) for asked in found]
        for asked, copy in zip(found, copies, strict=True):
            dr.enable_grad(copy)
            dr.set_grad(copy, dr.grad(asked.numbers))
            asked.make_of(type(asked.value)(copy))
        if copies:
            dr.enqueue(dr.ADMode.Forward, copies)
            dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
    try:
        yield
    finally:
        with dr.resume_grad():
            for asked in found:
                asked.make_of(asked.value)
                asked.put_back()


def _find_differentiated(scene: mi.Scene) -> list[_DifferentiatedParameter]:
    """Arrays with derivatives, by the plugin that they belong to."""
    if is_recording():
        return []
    inside = [shape.interior_medium() for shape in scene.shapes() if shape.interior_medium() is not None]
    owners = [*scene.emitters(), *(s.bsdf() for s in scene.shapes()), *(o for m in inside for o in _find_derived_owners(m))]
    found = []
    for owner in {o.ptr: o for o in owners if o is not None}.values():
        params = mi.traverse(owner)
        asked = [(k, v) for k, v in params if _is_differentiated(v) and not _is_computed(params, k)]
        found += [_DifferentiatedParameter(params, k, type(v)(v)) for k, v in asked]
    return found


def _find_derived_owners(medium: mi.Medium) -> list[mi.Object]:
    """The phase function of a medium, and its volumes but for those whose numbers transport reads where they stand."""
    known = traverse_medium(medium).properties
    volumes = {key.partition(".")[0]: node for key, (_, _, node, _) in known.items() if isinstance(node, mi.Volume)}
    stands = [n for n, v in volumes.items() if n.startswith("sigma_") or hasattr(v, "mivol_extinction")]
    read = [n for n in stands if f"{n}.table" not in known]
    return [medium.phase_function(), *(v for n, v in volumes.items() if n not in read)]


def _is_differentiated(value: Any) -> bool:
    """Whether the derivative of an array or of a transform is asked for."""
    array = value if dr.is_array_v(value) else getattr(value, "matrix", None)
    return array is not None and dr.is_diff_v(array) and dr.grad_enabled(array)


def _is_computed(params: mi.SceneParameters, key: str) -> bool:
    """Whether a parameter is what a plugin makes of its others: the grid of a ``mivol_transfer``."""
    return key == "data" and "table" in params
