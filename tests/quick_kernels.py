"""Kernels of the tests are compiled without the optional passes of LLVM, which take two thirds of the time of compiling.

A run on a fresh machine compiles about 6000 kernels, most for a few thousand lanes, which run as fast without. Dr.Jit's own
simplifications stay, and so does the code that LLVM is given: tests of mivol lose nothing. ``MIVOL_TESTS=optimised`` compiles
kernels as users' are.

The kernels are kept in a folder of their own: Dr.Jit does not tell them from optimised ones. Import this before Dr.Jit, which
reads the name of the folder once.
"""

from __future__ import annotations

import ctypes
import mmap
import os
from pathlib import Path

LIBRARY = "DRJIT_LIBLLVM_PATH"
QUICK = os.environ.get("MIVOL_TESTS") != "optimised"

if QUICK:
    folder = Path.home() / ".cache" / "mivol" / "test-kernels"
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["DRJIT_CACHE_DIR"] = str(folder)


def can_leave_out(library: str | None) -> bool:
    """Whether LLVM leaves out passes in silence. It ends a process that names an option it does not know."""
    if not QUICK or library is None:
        return False
    with Path(library).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(b"opt-bisect-verbose\0") >= 0


def leave_out_passes() -> None:
    """Tell the LLVM that Dr.Jit loads to leave out each pass that is optional; an old one compiles as for users."""
    if can_leave_out(library := os.environ.get(LIBRARY)):
        words = [b"tests", b"-opt-bisect-limit=0", b"-opt-bisect-verbose=0"]
        ctypes.CDLL(library).LLVMParseCommandLineOptions(len(words), (ctypes.c_char_p * len(words))(*words), None)
