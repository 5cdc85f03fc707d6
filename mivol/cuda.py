"""The CUDA back end: what Dr.Jit has to be told before it compiles a kernel.

Dr.Jit 1.5 asks for registers to be spilled to shared memory where the driver can (PTX 8.7 and newer). ptxas refuses that of a
kernel that calls functions, as one does that calls plugins ("(C7800) Smem spilling should not be enabled when functions use
abi"), and the process is aborted. Seen with CUDA 13.0.
"""

from __future__ import annotations

__all__ = ["spill_to_local_memory"]


def spill_to_local_memory(variant: str | None = None) -> None:
    """Switch spills to shared memory off, for this thread, where kernels are compiled for a GPU of NVIDIA's.

    Args:
        variant: the variant that becomes active; by default the one that is.
    """
    import drjit as dr  # loads LLVM, which mivol.llvm has to choose before
    import mitsuba as mi

    variant = variant or mi.variant()
    if variant is not None and variant.startswith("cuda"):
        dr.set_flag(dr.JitFlag.SpillToSharedMemory, False)
