"""The Rayleigh phase function: values and inversion."""

from __future__ import annotations

import numpy as np
import oracle_phase as oracle
import pytest
from phase_angles import EPS, U, as64, cosines_of, lanes, turns

from mivol.phase.rayleigh import eval_rayleigh, sample_rayleigh

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_rayleigh_values():
    turn, m, p = turns()
    assert np.max(np.abs(as64(eval_rayleigh(turn)) / oracle.rayleigh((p - m) / 2) - 1)) <= 3 * EPS


def test_inversion_of_rayleigh():
    c = cosines_of(sample_rayleigh(*lanes(U)))
    # F = (c^3 + 3 c + 4)/8 with slope 3/4 at most, and c to 3 roundings of 1.
    assert np.max(np.abs((c**3 + 3 * c + 4) / 8 - U)) <= 3 * EPS
