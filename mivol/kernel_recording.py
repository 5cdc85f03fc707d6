"""Kernels that Dr.Jit records once and replays: aligned arrays, no reading of values, no garbage collection meanwhile.

Dr.Jit compiles a virtual call for the plugins that live at the moment of recording. If Python's collector frees an old scene
between two calls, Dr.Jit 1.5.0 records the first call for several plugins and the second for one. If the code of these plugins
is the same, Dr.Jit emits the same function twice, LLVM refuses the kernel ("invalid redefinition of function"), and the process
aborts: callables of several targets and of one target have different keys (``GlobalKey`` in drjit-core) but the same name.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
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
