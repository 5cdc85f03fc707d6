"""The Mitsuba variant and the number of threads of a run."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.errors import MivolError
from mivol.scene.description import check_variant
from mivol.threads import check_one_thread, set_thread_count


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
