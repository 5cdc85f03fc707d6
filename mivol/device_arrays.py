"""Arrays of NumPy for kernels that are recorded once."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

__all__ = ["aligned", "kept_aligned"]

ALIGNMENT = 64
"""Bytes: what Dr.Jit calls aligned."""


def aligned(a: np.ndarray) -> np.ndarray:
    """A copy at an address that is a multiple of ``ALIGNMENT``.

    Dr.Jit reads NumPy's memory in place, and records a function anew for each pattern of aligned and unaligned inputs.
    """
    buffer = np.empty(a.nbytes + ALIGNMENT, np.uint8)
    start = -buffer.ctypes.data % ALIGNMENT
    copy = buffer[start : start + a.nbytes].view(a.dtype)
    copy[:] = a
    return copy


def kept_aligned(a: mi.Float) -> mi.Float:
    """The same array where it is aligned, as every array that Dr.Jit has computed is; else a copy that is."""
    if dr.width(a) == 0 or dr.backend_v(a) != dr.JitBackend.LLVM:
        return a
    dr.eval(a)
    memory = a.numpy()  # in place
    return a if memory.ctypes.data % ALIGNMENT == 0 else mi.Float(aligned(memory))
