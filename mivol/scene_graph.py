"""The objects of a scene and their parameters, read without leaving garbage for Python's collector.

Conventions. Each call of ``mi.traverse`` and each loop over ``mi.SceneParameters`` defines a class. A class refers to itself,
so only the collector frees the class and all that it refers to. The collector may run while Dr.Jit traces; freeing the plugins
of an old scene then aborts the process (:mod:`mivol.kernel_recording`). The functions here share one class.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi


def traverse(node: mi.Object) -> mi.SceneParameters:
    """Find the parameters of an object and of the objects in it: the result of ``mi.traverse``."""
    found = mi.SceneParameters()
    _add_object(found, set(), node, None, "", +mi.ParamFlags.Differentiable)
    return found


def traverse_children(node: mi.Object) -> mi.SceneParameters:
    """Find the parameters of an object, and those of each object directly in it under its own name.

    :func:`traverse` visits an object once, and lists an object with two names under the first.
    """
    found = mi.SceneParameters()
    found.hierarchy[node] = (None, 0)
    own_flags = +mi.ParamFlags.Differentiable
    for name, value, flags, kind in _list_entries(node):
        if isinstance(value, mi.Object):
            child = mi.SceneParameters()
            child.hierarchy[node] = (None, 0)
            _add_object(child, set(), value, node, name, own_flags)
            found.properties |= child.properties
            found.hierarchy = child.hierarchy | found.hierarchy
        else:
            found.properties[name] = (value, kind, node, _parameter_flags(own_flags, flags))
    return found


def list_values(params: mi.SceneParameters) -> list[tuple[str, Any]]:
    """The keys and values of parameters: the pairs of ``list(params)``."""
    return [(key, read_value(params, key)) for key in params.properties]


def read_value(params: mi.SceneParameters, key: str) -> Any:
    """The value of a parameter. ``params[key]`` also notes its arrays, for an update after a change in place."""
    value, kind, node, _ = params.properties[key]
    return value if kind is None else mi.get_property(value, kind, node)


def put_value(params: mi.SceneParameters, key: str, value: Any) -> None:
    """Set a parameter that does not hold the very same arrays. For the same arrays ``params[key] = value`` changes nothing,
    but first waits for all kernels and compares the numbers."""
    if dr.detail.collect_indices(params[key]) != dr.detail.collect_indices(value):
        params[key] = value


def find_children(node: mi.Object) -> dict[str, mi.Object]:
    """The objects directly in an object, by name; the same object may occur under several names."""
    return {name: value for name, value, _, _ in _list_entries(node) if isinstance(value, mi.Object)}


def _add_object(
    found: mi.SceneParameters, names: set[str], node: mi.Object, parent: mi.Object | None, name: str, flags: int
) -> None:
    """Add an object, its parameters, and the new objects inside.

    Args:
        found: parameters to add to.
        names: names of the objects found so far, without the root.
        node, parent: object, and its owner; None for the root.
        name: path of the object; empty for the root.
        flags: flags that the object passes on to its parameters.
    """
    if name:
        stem, count = name, 1
        while name in names:
            name, count = f"{stem}_{count}", count + 1
        names.add(name)
    found.hierarchy[node] = (parent, 0 if parent is None else found.hierarchy[parent][1] + 1)
    for own_name, value, own_flags, kind in _list_entries(node):
        path = f"{name}.{own_name}" if name else own_name
        if not isinstance(value, mi.Object):
            found.properties[path] = (value, kind, node, _parameter_flags(flags, own_flags))
        elif value not in found.hierarchy:
            _add_object(found, names, value, node, path, flags | own_flags)


def _parameter_flags(inherited: int, own: int) -> int:
    """Flags of a parameter; without derivatives, it is discontinuous only if its object is."""
    own |= inherited
    return inherited | (own & ~mi.ParamFlags.Discontinuous if own & mi.ParamFlags.NonDifferentiable else own)


def _list_entries(node: mi.Object) -> list[tuple[str, Any, int, Any]]:
    """The objects and parameters directly in an object: name, value or its address, flags, and type behind an address."""
    callback = _entries_class(mi.variant())()
    node.traverse(callback)
    return callback.entries


@cache
def _entries_class(variant: str) -> type:
    """The class of the callbacks that list entries; each variant of Mitsuba has a base class of its own."""

    class Entries(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.entries: list[tuple[str, Any, int, Any]] = []

        def put(self, name: str, value: object, flags: int, cpptype: object = None) -> None:
            self.entries.append((name, value, flags, cpptype))

    return Entries
