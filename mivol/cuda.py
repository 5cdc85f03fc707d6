"""The CUDA back end: a switch of Dr.Jit before kernels are compiled.

Dr.Jit 1.5 spills registers to shared memory if the driver can (PTX 8.7 and newer). For a kernel with function calls, and so for
every kernel calling a plugin, ptxas refuses ("(C7800) Smem spilling should not be enabled when functions use abi") and aborts
the process. Seen with CUDA 13.0.
"""

from __future__ import annotations


def spill_to_local_memory(variant: str | None = None) -> None:
    """Switch off spills to shared memory in this thread, for CUDA variants.

    Args:
        variant: variant about to become active; None: the active variant.
    """
    import drjit as dr  # loads LLVM, so mivol.llvm chooses the library first
    import mitsuba as mi

    variant = variant or mi.variant()
    if variant is not None and variant.startswith("cuda"):
        dr.set_flag(dr.JitFlag.SpillToSharedMemory, False)
