"""Kernels that Dr.Jit records once and replays: aligned arrays, no reading of values, no garbage collection meanwhile.

Dr.Jit compiles a virtual call for the plugins that live at the moment of recording. If Python's collector frees an old scene
between two calls, Dr.Jit 1.5.0 records the first call for several plugins and the second for one. If the code of these plugins
is the same, Dr.Jit emits the same function twice, LLVM refuses the kernel ("invalid redefinition of function"), and the process
aborts: callables of several targets and of one target have different keys (``GlobalKey`` in drjit-core) but the same name.
"""

from __future__ import annotations

import gc
import itertools
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

ALIGNMENT = 64
"""Alignment that Dr.Jit assumes for its arrays [byte]."""


def is_recording() -> bool:
    """Whether ``dr.freeze`` records the running function. The host must not read values of arrays then."""
    return bool(dr.flag(dr.JitFlag.FreezingScope))


def record_kernels(function: Callable, *settings: Any) -> Callable:
    """``dr.freeze`` of a function with its first arguments given.

    Args:
        function: function of a module. ``dr.freeze`` keeps it in a reference cycle: a method would keep its object, with all
            recorded kernels, until Python's collector runs.
        settings: first arguments, without arrays.
    """
    return dr.freeze(lambda *given: function(*settings, *given))


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

    Attributes:
        failures: why Dr.Jit could not record tasks, by the class of the task.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.failures: dict[type[RecordedTask], list[str]] = {}
        self._tasks: dict[Hashable, RecordedTask] = {}
        # dr.freeze defines a class in each call, which only Python's collector can free.
        self._frozen = dr.detail.FrozenFunction(_run_task, most, 1 << 30, dr.JitBackend.Invalid, True)

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
            return self._frozen({"task": task, "inputs": inputs})
        except RuntimeError as error:
            if task.is_interrupted:
                raise KeyboardInterrupt from None
            failures.append(task.failure or str(error.__cause__ or error))
        raise CannotRecordError(failures[-1])


def _run_task(given: dict[str, Any]) -> Any:
    """Run a task inside of a recording. Dr.Jit replaces every exception by its own."""
    task = given["task"]
    try:
        return task(*given["inputs"])
    except BaseException as error:
        task.failure, task.is_interrupted = str(error), isinstance(error, KeyboardInterrupt)
        raise


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
