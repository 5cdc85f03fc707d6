"""The state of a scene's parameters: changes since a plan was made, and changes that a recording follows.

Conventions. A plan holds as long as no parameter has changed. A recording (:mod:`mivol.kernel_recording`) holds longer: it
reads the values of volumes, textures, phase functions, BSDFs, emitters and cameras anew in every call. All other parameters
are part of its key, since parameters such as the place of a shape or the ``scale`` of a stock medium decide on the host which
code is traced.

Python plugins of other packages. Dr.Jit follows the arrays among the attributes of a plugin, also in lists, tuples and dicts.
Everything else that the methods of a plugin read is compared before each render: numbers and texts among attributes, class
attributes and globals. A plugin that keeps its state in other objects, which may change unseen, is not recorded.
"""

from __future__ import annotations

from collections.abc import Container, Hashable
from contextlib import suppress
from dataclasses import dataclass, field
from dis import get_instructions
from functools import cache
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.scene.stand_in import RECORDED_FILM, describe_kind, is_found
from mivol.scene_graph import list_values, read_value, traverse
from mivol.transport.media.medium_view import STOCK
from mivol.transport.media.phases import find_plugins

FOLLOWED = ("data", "value")
"""Names of the parameters of volumes and textures whose values a recording follows."""

PLACES = ("position", "to_world")
"""Names of the parameters that place an emitter."""

WEIGHT = "sampling_weight"
"""Name of the parameter by which emitters are chosen: a number in Mitsuba."""

SHAPE_PLACES = ("to_world", "vertex_positions", "vertex_normals", "vertex_texcoords", "control_points")
"""Names of the parameters that place a shape."""

PLACED_SHAPES = ("Sphere", "Disk", "Cylinder", "Rectangle", "Instance", "BSplineCurve", "LinearCurve")
"""Classes of the shapes besides meshes whose places a recording follows."""

RECORDED_BACK_ENDS = ("llvm",)
"""Back ends on which renders are recorded. On a GPU, Dr.Jit 1.5 reads the handle of a hardware texture from memory that other
textures leave uninitialised, and aborts the process; nobody has tried recordings there."""

HIDING = "BlendPhaseFunction", "TabulatedPhaseFunction", "SGGXPhaseFunction"
"""Phase functions whose arrays Mitsuba 3.9.1 hides from Dr.Jit (their sources lack ``MI_TRAVERSE_CB``). A recording that calls
them fails, or aborts the process while it fails."""


@dataclass
class SceneState:
    """The state of all parameters of a scene and of a sensor.

    Attributes:
        sensor: the sensor.
        values: the arrays that a recording follows, by their indices in Dr.Jit and with their shapes.
        others: all other arrays and numbers.
        of_sensor: the arrays and numbers of the sensor among both.
        lamps, shapes: the places and weights of the emitters, and the places of shapes that a recording follows, among both.
        scales: the scales of stock media, which are numbers, among ``values``.
        held: the arrays. Dr.Jit would give the index of a freed array to another array.
        differentiated: keys of the scene's parameters with gradients enabled, with their owners.
    """

    sensor: mi.Sensor
    values: list = field(default_factory=list)
    others: list = field(default_factory=list)
    of_sensor: list = field(default_factory=list)
    lamps: list = field(default_factory=list)
    shapes: list = field(default_factory=list)
    scales: list[float] = field(default_factory=list)
    held: list = field(default_factory=list)
    differentiated: list[tuple[str, mi.Object]] = field(default_factory=list)

    @classmethod
    def of(
        cls, scene: mi.Scene, sensor: mi.Sensor, attached: list[Any] | None = None, before: SceneState | None = None
    ) -> SceneState:
        """Read the state of a scene and of the sensor to render, which may lie outside of the scene.

        A value that Dr.Jit knows as a number, and that was another one before, becomes an array in the scene: kernels hold
        numbers, so each new number would be compiled anew.

        Args:
            before: an earlier state of the scene.
            attached: list for the arrays, and the matrices of transforms, of the scene with gradients enabled. The state itself
                holds none: it would keep the derivatives of an earlier step.
        """
        state, attached = cls(sensor), [] if attached is None else attached
        params, known = traverse(scene), [] if before is None else before.values
        state.differentiated = state._add(params, attached, known)
        if sensor not in params.hierarchy:
            state._add(traverse(sensor), [], known)
        state.others.append(_describe_sensor(sensor))
        return state

    @property
    def key(self) -> tuple:
        """The part of the state that a recording does not follow."""
        shapes = tuple(shape for _, shape, _ in self.values)
        followed = tuple(is_followed for _, _, is_followed in self.values)
        return (*self.others, shapes, followed)

    @property
    def sensor_kind(self) -> str | None:
        """The kind of the sensor (:func:`mivol.scene.stand_in.describe_kind`)."""
        return self.others[-1][-1]

    def is_same(self, other: SceneState) -> bool:
        """Whether no parameter differs, and the sensor is the same."""
        return self.sensor is other.sensor and self.values == other.values and self.others == other.others

    def has_same_rest(self, other: SceneState) -> bool:
        """Whether the states differ at most in the sensor and in values followed by a recording."""
        return self.others[:-1] == other.others[:-1]

    def has_same_numbers(self, other: SceneState) -> bool:
        """Whether no parameter differs except by gradients that a recording follows, and the sensor is the same."""
        numbers, others = ([value[:2] for value in state.values] for state in (self, other))
        return self.sensor is other.sensor and numbers == others and self.others == other.others

    def _add(self, params: mi.SceneParameters, attached: list[Any], before: list) -> list[tuple[str, mi.Object]]:
        """Add parameters; returns the keys with gradients enabled, and their owners, and appends their arrays.

        Args:
            before: ``values`` of an earlier state.
        """
        differentiated = []
        for node in filter(is_foreign, params.hierarchy):
            with suppress(UnfollowedStateError):
                self._sort(node, False, describe_foreign(node, params.hierarchy))
        for key in params.properties:
            value, owner = read_value(params, key), params.properties[key][2]
            numbers = value if dr.is_array_v(value) else getattr(value, "matrix", None)
            if isinstance(value, float) and owner.class_name() in STOCK:
                self.scales.append(value)
                self._sort(owner, True, ((value,), (), False))
                continue
            if isinstance(value, float) and isinstance(owner, mi.Emitter) and key.rpartition(".")[2] == WEIGHT:
                self.lamps.append((value,))
                self._sort(owner, True, ((value,), (), False))
                continue
            if numbers is None or not dr.is_jit_v(numbers):
                self._sort(owner, False, value if isinstance(value, int | float | str | bool) else str(value))
                continue
            is_followed, kept = _is_followed(params, key), dr.detach(numbers)
            indices = tuple(dr.detail.collect_indices(kept))
            known = before[len(self.values)][0] if is_followed and len(self.values) < len(before) else indices
            if indices != known and kept.state in (dr.VarState.Literal, dr.VarState.Mixed):
                dr.make_opaque(value)  # a transform with its inverse
                kept = dr.detach(numbers)
                indices = tuple(dr.detail.collect_indices(kept))
            self.held.append(kept)
            state = (indices, dr.shape(kept), dr.grad_enabled(numbers))
            self._sort(owner, is_followed, state)
            if isinstance(owner, mi.Emitter) and key.rpartition(".")[2] in PLACES:
                self.lamps.append(indices)
            if is_followed and isinstance(owner, mi.Shape) and key.rpartition(".")[2] in SHAPE_PLACES:
                self.shapes.append(indices)
            if state[2]:
                differentiated.append((key, owner))
                attached.append(numbers)
        return differentiated

    def _sort(self, owner: mi.Object, is_followed: bool, state: Any) -> None:
        """Note the state of a parameter."""
        (self.values if is_followed else self.others).append(state)
        if owner.ptr == self.sensor.ptr:
            self.of_sensor.append(state)


def find_hidden_arrays(scene: mi.Scene, sensor: mi.Sensor) -> str | None:
    """Reason why a recording would miss arrays or derivatives of a scene; None if it finds every array.

    A recording must find every array. Dr.Jit finds the arrays of Mitsuba's plugins and the attributes of Python plugins. At an
    array outside both it raises an error, or aborts the process if a plugin of Mitsuba hides the array.
    """
    if mi.variant().partition("_")[0] not in RECORDED_BACK_ENDS:
        return f"recordings have not been tried with {mi.variant()}"
    if sensor.film().class_name() != RECORDED_FILM:
        return f"the film is a {sensor.film().class_name()}"
    if not is_found(sensor) and describe_kind(sensor) is None:
        with_sampler = f"with a sampler of the kind {sensor.sampler().class_name()}"
        return f"the sensor is a {sensor.class_name()} {with_sampler if sensor.get_medium() is None else 'in a medium'}"
    params = traverse(scene)
    try:
        for node in filter(is_foreign, params.hierarchy):
            describe_foreign(node, params.hierarchy)
    except UnfollowedStateError as error:
        return str(error)
    if any(node.class_name() == "RawConstantTexture" for node in params.hierarchy):
        return "Dr.Jit cannot record a RawConstantTexture; the texture uniform can be recorded"
    media = [sensor.get_medium(), *(node for node in params.hierarchy if isinstance(node, mi.Medium))]
    for plugin in (plugin for medium in media if medium is not None for plugin in find_plugins(medium.phase_function())):
        hiding = sorted({node.class_name() for node in traverse(plugin).hierarchy} & set(HIDING))
        if hiding:
            return f"Dr.Jit cannot record a call of a {hiding[0]} (in a mixture, or with a matrix that varies in space)"
    lost = [
        key for key, value in list_values(params) if find_gradient_array(value) is not None and not _is_followed(params, key)
    ]
    return f"a recording does not follow the derivative by {lost[0]}" if lost else None


def list_fixed_numbers(scene: mi.Scene) -> list[str]:
    """Keys of BSDF numbers inside Mitsuba's kernels, for example a refractive index."""
    params = traverse(scene)
    numbers = ((key, params.properties[key][2], value) for key, value in list_values(params))
    return [key for key, owner, value in numbers if isinstance(owner, mi.BSDF) and isinstance(value, float)]


def find_gradient_array(value: Any) -> Any | None:
    """The array of a parameter, or the matrix of a transform, if its gradients are enabled."""
    array = value if dr.is_array_v(value) else getattr(value, "matrix", None)
    return array if array is not None and dr.is_diff_v(array) and dr.grad_enabled(array) else None


def _is_followed(params: mi.SceneParameters, key: str) -> bool:
    """Whether a recording follows the values of a parameter."""
    owner = params.properties[key][2]
    if _is_of_mivol(owner):
        return True
    if is_foreign(owner):
        return True
    if isinstance(owner, mi.PhaseFunction):
        # Of a medium: its arrays are inputs. A lobe of a mixture is called as an object, whose arrays are hidden.
        parent = params.hierarchy[owner][0]
        while parent is not None and parent.class_name() == "BlendPhaseFunction":
            parent = params.hierarchy[parent][0]
        return isinstance(parent, mi.Medium)
    name = key.rpartition(".")[2]
    if isinstance(owner, mi.Volume | mi.Texture):
        return name in FOLLOWED
    if isinstance(owner, mi.BSDF | mi.Emitter):
        return True
    if isinstance(owner, mi.Shape):
        return is_painted(name) or (name in SHAPE_PLACES and (owner.is_mesh() or owner.class_name() in PLACED_SHAPES))
    return isinstance(owner, mi.Sensor)


def is_painted(name: str) -> bool:
    """Whether a parameter of a mesh is an attribute of its vertices or faces, such as a colour, and does not place the mesh."""
    return name.startswith(("vertex_", "face_")) and name not in ("vertex_positions", "vertex_normals", "vertex_texcoords")


def _is_of_mivol(node: mi.Object) -> bool:
    """Whether an object is a plugin of mivol, which decides nothing by values while Dr.Jit records."""
    return type(node).__module__.partition(".")[0] == "mivol"


def _describe_sensor(sensor: mi.Sensor) -> tuple:
    """What the samples of a sensor depend on besides arrays."""
    film, sampler = sensor.film(), sensor.sampler()
    return (
        sensor.class_name(),
        sensor.needs_aperture_sample(),
        sensor.get_medium().ptr if sensor.get_medium() is not None else None,
        str(film),
        sampler.class_name(),
        sampler.sample_count(),
        describe_kind(sensor),
    )


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
