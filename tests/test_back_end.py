"""What Dr.Jit is told before it compiles for a GPU; the flags are there without one."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import pytest

import mivol


@pytest.fixture
def spills() -> Iterator[None]:
    """Spills to shared memory are on, as Dr.Jit begins, and are what they were afterwards."""
    with dr.scoped_set_flag(dr.JitFlag.SpillToSharedMemory, True):
        yield


@pytest.mark.parametrize(("variant", "expected"), [("cuda_ad_rgb", False), ("cuda_ad_mono", False), ("llvm_ad_rgb", True)])
def test_a_variant_of_a_gpu_spills_to_local_memory(spills: None, variant: str, expected: bool) -> None:
    """Where a variant becomes active, kernels that call plugins would abort ptxas otherwise."""
    mivol._on_variant_change(None, variant)
    assert dr.flag(dr.JitFlag.SpillToSharedMemory) == expected
