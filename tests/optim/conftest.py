"""What the tests of several modules of the room share."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import ball, photo
from small_scan import Views, small_scan

from mivol.photos import Photo
from mivol.threads import set_thread_count


@pytest.fixture(scope="session")
def photos() -> list[Photo]:
    """16 photographs of a ball."""
    mi.set_variant("llvm_ad_rgb")
    return [photo(ball(), k) for k in range(16)]


@pytest.fixture
def one_thread(cpu_back_end: None) -> Iterator[None]:
    """One Dr.Jit thread: sums have a fixed order."""
    before = dr.thread_count()
    set_thread_count(1)
    yield
    set_thread_count(before)


@pytest.fixture(scope="session")
def scan() -> tuple[Views, np.ndarray, np.ndarray]:
    """A small scan: its matrix, the truth, and exact line integrals."""
    return small_scan()
