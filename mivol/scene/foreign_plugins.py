"""Python plugins of other packages: what their results depend on.

Dr.Jit follows the arrays among the attributes of a Python plugin, also in lists, tuples and dicts. Everything else that the
methods of a plugin read is compared before each render: numbers and texts among attributes, class attributes and globals. A
plugin that keeps its state in other objects, which may change unseen, is not recorded.
"""

from __future__ import annotations

from collections.abc import Container, Hashable
from dis import get_instructions
from functools import cache
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

PLAIN = int, float, complex, bool, str, bytes, type(None)
KNOWN = "mitsuba", "drjit", "numpy", "mivol"
"""Packages whose functions keep no state."""


class UnfollowedStateError(Exception):
    """A plugin reads an object that may change unseen. The message names it."""


def is_foreign(node: mi.Object) -> bool:
    """Whether an object is a Python plugin of another package."""
    return _package(type(node)) not in KNOWN


def describe_foreign(node: mi.Object, known: Container[mi.Object]) -> Hashable:
    """All that the results of a plugin depend on, besides arrays among its attributes.

    Args:
        node: the plugin.
        known: objects whose parameters are compared elsewhere.

    Raises:
        UnfollowedStateError: a kind of plugin that was not tried, or one that reads an object which may change unseen.
    """
    kind = type(node)
    if not isinstance(node, mi.PhaseFunction | mi.BSDF | mi.Emitter | mi.Texture | mi.Volume):
        raise UnfollowedStateError(f"{kind.__name__} is a Python plugin of a kind whose recordings have not been tried")
    reader = _StateReader(kind.__name__, known)
    bases = [base for base in kind.__mro__ if _package(base) not in (*KNOWN, "builtins")]
    members = {f"{base.__name__}.{name}": vars(base)[name] for base in bases for name in vars(base) if _is_member(name, base)}
    return kind, reader.describe("self", vars(node)), reader.describe("class", members)


def _package(thing: Any) -> str:
    return thing.__module__.partition(".")[0]


def _is_member(name: str, base: type) -> bool:
    return isinstance(vars(base)[name], FunctionType) or not name.startswith("__")


class _StateReader:
    """Reads values of a plugin as keys.

    Args:
        plugin: name of its class.
        known: as in :func:`describe_foreign`.
    """

    def __init__(self, plugin: str, known: Container[mi.Object]) -> None:
        self._plugin, self._known = plugin, known
        self._functions: set[FunctionType] = set()

    def describe(self, name: str, value: Any) -> Hashable:
        """The value under a name as a key."""
        kind = type(value)
        value = getattr(value, "matrix", value)
        if kind in PLAIN:
            return kind, value
        if dr.is_array_v(value):
            return kind if dr.is_jit_v(value) else (kind, np.array(value).tobytes())
        if isinstance(value, np.ndarray) and value.dtype != object:
            return value.shape, value.dtype.str, value.tobytes()
        if kind is dict:
            return kind, tuple([(key, self.describe(f"{name}.{key}", part)) for key, part in value.items()])
        if kind in (list, tuple):
            return kind, tuple([self.describe(f"{name}[{k}]", part) for k, part in enumerate(value)])
        if kind in (staticmethod, classmethod, property):
            return self.describe(name, value.fget if kind is property else value.__func__)
        if isinstance(value, FunctionType):
            return self._describe_function(name, value)
        if isinstance(value, ModuleType | type | BuiltinFunctionType) or (
            isinstance(value, mi.Object) and value in self._known
        ):
            return id(value)
        raise UnfollowedStateError(
            f"{self._plugin} is a Python plugin that reads {name}, a {kind.__name__}, which may change unseen"
        )

    def _describe_function(self, name: str, function: FunctionType) -> Hashable:
        """A function with the globals, defaults and enclosed values that it reads."""
        if function in self._functions or _package(function) in KNOWN:
            return id(function)
        self._functions.add(function)
        given = function.__globals__
        used = {key: given[key] for key in sorted(_list_globals(function.__code__)) if key in given}
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        used |= {key: cell.cell_contents for key, cell in cells if key != "__class__"}
        read = {"globals": used, "defaults": [function.__defaults__, function.__kwdefaults__]}
        return function.__code__, tuple([self.describe(key, part) for key, part in read.items()])


@cache
def _list_globals(code: CodeType) -> frozenset[str]:
    """The names of globals in code, also in functions inside of it."""
    names = {instruction.argval for instruction in get_instructions(code) if instruction.opname == "LOAD_GLOBAL"}
    return frozenset(names).union(*(_list_globals(part) for part in code.co_consts if isinstance(part, CodeType)))
