"""Strata of the unit square: each lane stays in its cell, and the cells cover the square."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.strata import Strata

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_each_lane_stays_in_its_cell():
    """Cell k of 3 by 2 holds the points (k % 3 + u) / 3, (k // 3 + v) / 2."""
    u, v = np.random.default_rng(4).uniform(0, 1, (2, 6)).astype(np.float32)
    found = Strata(dr.arange(mi.UInt32, 6), 3, 2).jitter(mi.Point2f(mi.Float(u), mi.Float(v)))
    k = np.arange(6)
    np.testing.assert_allclose(np.array(found), [(k % 3 + u) / 3, (k // 3 + v) / 2], atol=2.0**-23)
