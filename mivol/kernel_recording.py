"""Kernels that Dr.Jit records once and replays: aligned arrays, no reading of values, no garbage collection meanwhile.

Dr.Jit compiles a virtual call for the plugins that live at the moment of recording. If Python's collector frees an old scene
between two calls, Dr.Jit 1.5.0 records the first call for several plugins and the second for one. If the code of these plugins
is the same, Dr.Jit emits the same function twice, LLVM refuses the kernel ("invalid redefinition of function"), and the process
aborts: callables of several targets and of one target have different keys (``GlobalKey`` in drjit-core) but the same name.
If the collector frees a scene of Mitsuba while Dr.Jit records, the process aborts as well: the call that frees the scene's tree
"cannot be recorded".
"""

from __future__ import annotations

import copy
import gc
import itertools
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

ALIGNMENT = 64
"""Alignment that Dr.Jit assumes for its arrays [byte]."""


def is_recording() -> bool:
    """Whether ``dr.freeze`` records the running function. The host must not read values of arrays then."""
    return bool(dr.flag(dr.JitFlag.FreezingScope))


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Pause Python's automatic garbage collection inside a ``with`` block."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class RecordedKernel:
    """``dr.freeze`` of a function with its first arguments given, without garbage collection in the calls.

    Args:
        function: function of a module. ``dr.freeze`` keeps it in a reference cycle: a method would keep its object, with all
            recorded kernels, until Python's collector runs.
        settings: first arguments, without arrays.
    """

    def __init__(self, function: Callable, *settings: Any) -> None:
        self._frozen = dr.freeze(lambda *given: function(*settings, *given))

    @property
    def n_recordings(self) -> int:
        """Number of recordings made so far."""
        return self._frozen.n_recordings

    def __call__(self, *given: Any) -> Any:
        with without_garbage_collection():
            return self._frozen(*given)


def begin_kernel(*inputs: Any) -> None:
    """Evaluate arrays, and let the code that follows begin a kernel of its own.

    Two kernels that compute the same from arrays in memory have the same instructions, so Dr.Jit compiles them once. The new
    scope keeps them from using constants of earlier code, which would change the order of the instructions.

    Args:
        inputs: arrays, or data classes of arrays.
    """
    dr.eval(inputs)
    dr.detail.new_scope(dr.backend_v(mi.Float))


class CannotRecordError(Exception):
    """Dr.Jit cannot record a task. The task has run in part: gradients may have been added."""


class RecordedTask:
    """A function whose kernels are recorded, with all that is the same in every call.

    Subclasses define ``__call__(*inputs)``. They hold no arrays: a recording keeps what an array was.
    """

    _numbers = itertools.count()

    def __init__(self) -> None:
        # Dr.Jit tells objects apart by their hash. By default the hash is an address, which a later object may have too.
        self._number = next(RecordedTask._numbers)
        # What ended the last call, in words: an exception would hold all arrays of its frames.
        self.failure, self.is_interrupted = "", False

    def __hash__(self) -> int:
        return self._number

    def __eq__(self, other: object) -> bool:
        return self is other

    def __call__(self, *inputs: Any) -> Any:
        raise NotImplementedError


MAX_FAILURES = 2
"""Failures after which tasks of a class are recorded no more. A plugin that makes its tables at the first use, such as a
textured emitter, fails once."""


class Recordings:
    """Tasks that Dr.Jit records in their first call and replays in later calls.

    Args:
        most: largest number of recordings; the least recently used is dropped.
        keeps_literals: whether a recording holds the values of inputs that Dr.Jit knows as numbers, which makes faster kernels;
            an input that changes is recorded anew, once, as an array. False: all inputs are arrays.

    Attributes:
        failures: why Dr.Jit could not record tasks, by the class of the task.
    """

    def __init__(self, most: int, keeps_literals: bool = True) -> None:
        self.most = most
        self.failures: dict[type[RecordedTask], list[str]] = {}
        self._tasks: dict[Hashable, RecordedTask] = {}
        # dr.freeze defines a class in each call, which only Python's collector can free.
        self._frozen = dr.detail.FrozenFunction(_run_task, most, 1 << 30, dr.JitBackend.Invalid, keeps_literals)

    @property
    def count(self) -> int:
        """Number of recordings made so far."""
        return self._frozen.n_recordings

    def clear(self) -> None:
        """Drop all recordings."""
        self.failures, self._tasks = {}, {}
        self._frozen.clear()

    def call(self, kind: type[RecordedTask], key: Hashable, make: Callable[[], RecordedTask], *inputs: Any) -> Any:
        """Replay the recording of a task, or record it.

        Args:
            kind: class of the task.
            key: tells tasks of a class apart. Tasks with the same key must do the same with the same inputs.
            make: makes the task, called for a new key.
            inputs: PyTrees and Mitsuba objects. Their arrays may differ from call to call.

        Returns:
            The result of the task.

        Raises:
            CannotRecordError: the task failed, perhaps only because Dr.Jit recorded it.
        """
        failures = self.failures.setdefault(kind, [])
        if len(failures) >= MAX_FAILURES:
            raise CannotRecordError(failures[-1])
        # The key of the last call is the last.
        task = self._tasks.pop((kind, key), None) or make()
        self._tasks[kind, key] = task
        self._tasks = dict(list(self._tasks.items())[-self.most :])
        try:
            with without_garbage_collection():
                return self._frozen({"task": task, "inputs": inputs})
        except RuntimeError as error:
            if task.is_interrupted:
                raise KeyboardInterrupt from None
            failures.append(task.failure or str(error.__cause__ or error))
        raise CannotRecordError(failures[-1])


class RecordedFunctions:
    """Functions of structures of arrays, whose kernels are recorded in the first call and replayed in later calls.

    A call is recorded anew for another function, for other values in the structures that are no arrays, and for other sizes of
    arrays, since a recording holds sizes as numbers. A function that Dr.Jit cannot record is run, and :meth:`describe_failure`
    says so.

    The least recently used of more than eight recordings is dropped.
    """

    def __init__(self) -> None:
        self._recordings = Recordings(8, keeps_literals=False)
        self._failure = ""

    @property
    def count(self) -> int:
        """Number of recordings made so far."""
        return self._recordings.count

    def call(self, function: Callable, *arguments: Any) -> Any:
        """The result of ``function(*arguments)``.

        Args:
            function: function of a module. It changes no array of its arguments, and reads arrays of its arguments only.
            arguments: arrays, hashable values, and dataclasses, lists, tuples and dicts of these. Values may be small NumPy
                arrays. What differs from call to call must be in a Dr.Jit array.
        """
        arrays: list[Any] = []
        key = _list_arrays(arguments, arrays)
        make = partial(_FunctionTask, function, arguments)
        try:
            return self._recordings.call(_FunctionTask, (function, key), make, arrays)
        except CannotRecordError as error:
            self._failure = f"{function.__name__}: {error}"
            return function(*arguments)

    def describe_failure(self) -> str:
        """A sentence about the last function that could not be recorded, or ""."""
        if not self._failure:
            return ""
        return f"Dr.Jit could not record a part of the step: it is traced anew in each step and takes longer ({self._failure})"


class _FunctionTask(RecordedTask):
    """A function with the parts of its arguments that are no arrays."""

    def __init__(self, function: Callable, arguments: tuple[Any, ...]) -> None:
        super().__init__()
        self._function, self._arguments = function, _replace_arrays(arguments, itertools.repeat(_Place()))

    def __call__(self, arrays: list[Any]) -> Any:
        return self._function(*_replace_arrays(self._arguments, iter(arrays)))


class _Place:
    """The place of an array in a structure."""


PLAIN = frozenset({int, float, bool, str, type(None)})


def _list_arrays(value: Any, arrays: list[Any]) -> Hashable:
    """Append the arrays of a structure to a list; returns all other values as a key."""
    kind = type(value)
    if kind in PLAIN:
        return value
    if dr.is_array_v(kind):
        arrays.append(value)
        return kind, value.shape
    if kind is dict:
        return tuple([(name, _list_arrays(part, arrays)) for name, part in value.items()])
    if isinstance(value, (list, tuple)):
        return kind, tuple([_list_arrays(part, arrays) for part in value])
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if is_dataclass(kind):
        return kind, tuple([(name, _list_arrays(part, arrays)) for name, part in vars(value).items()])
    return value


def _replace_arrays(value: Any, others: Iterator[Any]) -> Any:
    """A structure with other arrays, or with places, in the order of :func:`_list_arrays`: of its arrays or its places."""
    kind = type(value)
    if kind is _Place or dr.is_array_v(kind):
        return next(others)
    if kind is dict:
        return {name: _replace_arrays(part, others) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        parts = [_replace_arrays(part, others) for part in value]
        return kind(*parts) if hasattr(kind, "_fields") else kind(parts)
    if is_dataclass(kind):
        whole = copy.copy(value)  # the parts are checked
        for name, part in vars(value).items():
            object.__setattr__(whole, name, _replace_arrays(part, others))
        return whole
    return value


def _run_task(given: dict[str, Any]) -> Any:
    """Run a task inside of a recording. Dr.Jit replaces every exception by its own."""
    task = given["task"]
    try:
        return task(*given["inputs"])
    except BaseException as error:
        task.failure, task.is_interrupted = str(error), isinstance(error, KeyboardInterrupt)
        raise


def copy_aligned(array: np.ndarray) -> np.ndarray:
    """Copy an array to an address that is a multiple of ``ALIGNMENT``.

    Dr.Jit reads NumPy's memory in place, and records a function anew for each pattern of aligned and unaligned inputs.
    """
    buffer = np.empty(array.nbytes + ALIGNMENT, np.uint8)
    start = -buffer.ctypes.data % ALIGNMENT
    copy = buffer[start : start + array.nbytes].view(array.dtype)
    copy[:] = array
    return copy


def ensure_aligned(array: mi.Float) -> mi.Float:
    """Return the array itself if its address is aligned, else an aligned copy.

    Arrays computed by Dr.Jit are always aligned.
    """
    if dr.width(array) == 0 or dr.backend_v(array) != dr.JitBackend.LLVM:
        return array
    dr.eval(array)
    memory = array.numpy()  # in place
    return array if memory.ctypes.data % ALIGNMENT == 0 else mi.Float(copy_aligned(memory))
