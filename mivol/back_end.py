"""The back end of a run: Mitsuba's variant, the threads of the CPU, and a switch of the GPU.

CUDA. Dr.Jit 1.5 spills registers to shared memory if the driver can (PTX 8.7 and newer). For a kernel with function calls, and
so for every kernel calling a plugin, ptxas refuses ("(C7800) Smem spilling should not be enabled when functions use abi") and
aborts the process. Seen with CUDA 13.0. Therefore spills go to local memory.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import drjit as dr  # loads LLVM, so mivol.llvm chooses the library first
import mitsuba as mi

from mivol import machine
from mivol.errors import MivolError
from mivol.threads import check_one_thread, set_thread_count

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")


def choose_back_end(variant: str, threads: int = 0) -> None:
    """Activate a variant, and set the threads of the CPU back end; 0 threads keep Dr.Jit's choice.

    Raises:
        MivolError: an unknown or unsupported variant, a variant without its GPU, a negative number of threads, or Dr.Jit in use
            by another thread of this process.
    """
    check_one_thread()
    set_variant(variant)
    set_threads(threads)


def set_variant(name: str) -> None:
    """Activate a variant.

    Raises:
        MivolError: an unknown or unsupported variant, or a variant without its GPU.
    """
    if name not in mi.variants():
        raise MivolError(f'Mitsuba has no variant "{name}": choose among {", ".join(mi.variants())}.')
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise MivolError(f'the variant "{name}" needs an NVIDIA GPU and its driver, and none was found: choose llvm_ad_rgb.')
    mi.set_variant(name)
    check_variant()


def set_threads(count: int) -> None:
    """Set the threads of the CPU back end; 0 keeps Dr.Jit's choice.

    Raises:
        MivolError: a negative number.
    """
    if count < 0:
        raise MivolError(f"found {count} threads, expected 0 (all cores) or more: correct -t.")
    if count:
        set_thread_count(count)


def check_variant() -> str:
    """Return the name of the active variant.

    Raises:
        MivolError: no active variant, or an unsupported variant.
    """
    variant = mi.variant()
    if variant is None:
        raise MivolError('no Mitsuba variant is active; call mitsuba.set_variant("llvm_ad_rgb") first.')
    if variant not in VARIANTS:
        raise MivolError(f'the variant "{variant}" is active; mivol works in {", ".join(VARIANTS)}.')
    return variant


def spill_to_local_memory(variant: str | None = None) -> None:
    """Switch off spills to shared memory in this thread, for CUDA variants.

    Args:
        variant: variant about to become active; None: the active variant.
    """
    variant = variant or mi.variant()
    if variant is not None and variant.startswith("cuda"):
        dr.set_flag(dr.JitFlag.SpillToSharedMemory, False)


def free_memory() -> int | None:
    """Memory for the arrays of the active variant [bytes]: of this process, or of the GPU at first; None if unknown."""
    return _free_gpu_memory() if is_on_gpu() else machine.available_memory()


def is_on_gpu() -> bool:
    """Whether the active variant computes on an NVIDIA GPU."""
    return (mi.variant() or "").startswith("cuda")


@functools.cache
def _free_gpu_memory() -> int | None:
    # Asked once: Dr.Jit keeps freed memory, which would count as used later.
    gpu = machine.find_used_gpu(machine.list_gpus())
    return gpu.free if gpu is not None and gpu.total else None


def check_memory(
    needed: float,
    what: str,
    way_out: str | Callable[[float], str],
    limit: float | None = None,
    on_gpu: float | None = None,
) -> None:
    """Refuse a task whose arrays need more than :func:`free_memory`.

    Args:
        needed, what, way_out, limit: as of :func:`mivol.machine.check_memory`.
        on_gpu: memory on a GPU [bytes], if ``needed`` counts arrays of this machine. With the variant of a GPU, both are
            compared with their own free memory. None: all of ``needed`` is on the GPU.

    Raises:
        MivolError: the task needs more than the free memory.
    """
    if limit is None and on_gpu is not None and is_on_gpu():
        machine.check_memory(needed, what, way_out)
        needed = on_gpu
    free = free_memory() if limit is None else limit
    if free is not None:
        machine.check_memory(needed, f"{what} on the GPU" if is_on_gpu() else what, way_out, free)
