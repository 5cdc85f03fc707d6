"""No garbage collection while a kernel is recorded.

A virtual call is recorded for the plugins that live at that moment. If Python's collector frees an old scene between two calls,
the first is recorded for several plugins and the second for one; where their code is the same, Dr.Jit 1.5.0 emits one function
twice, LLVM refuses the kernel ("invalid redefinition of function"), and the process is aborted. (Multi-target and single-target
callables have different keys and the same name: ``GlobalKey`` in drjit-core.)
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["without_collections"]


@contextmanager
def without_collections() -> Iterator[None]:
    """Put off Python's automatic garbage collections for a while."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
