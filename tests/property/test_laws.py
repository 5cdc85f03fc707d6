"""Laws that every line integral obeys, on seeded random grids, frames and rays, beyond those that follow from the equality with
the float64 twin (tests/hard, and tests/gradient for rows): of sign, of order, and of factors that float32 multiplies exactly.

Each side of an equation errs by at most 2e-6 * integral of (sigma + h |grad sigma|), so a law with k terms is granted k times
that.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import tau_scale

from scenes import FRAMES, as_float32, random_rays, tau_fast

BOUND = 2e-6
N_RAYS = 64


def draw(seed, name, channels=1):
    """A grid, its place, and rays through it."""
    rng = np.random.default_rng([seed, *name.encode()])
    values = as_float32(rng.uniform(0, 1, (9, 6, 7, channels)) ** 3)
    return rng, values, FRAMES[name], *random_rays(rng, FRAMES[name], N_RAYS)


def slack(values, to_world, o, d, t1=math.inf):
    """What one integral may err by."""
    return BOUND * tau_scale(values, to_world, o, d, 0.0, t1) + 1e-37


@pytest.mark.parametrize("name", FRAMES)
def test_monotone_in_sigma(seed, name):
    rng, values, to_world, o, d = draw(seed, name)
    more = as_float32(values + rng.uniform(0, 0.5, values.shape))
    assert np.all(tau_fast(more, to_world, o, d) >= tau_fast(values, to_world, o, d))
    assert np.all(tau_fast(values, to_world, o, d) >= 0)


@pytest.mark.parametrize("name", FRAMES)
def test_linear_in_sigma(seed, name):
    rng, values, to_world, o, d = draw(seed, name)
    other = as_float32(rng.uniform(0, 1, values.shape))
    both = as_float32(values - 0.25 * other)  # a tangent may be negative: the integral takes any sign
    a, b, c = (tau_fast(v, to_world, o, d) for v in (values, other, both))
    allowed = slack(np.abs(values), to_world, o, d) + 2 * slack(other, to_world, o, d)
    assert np.all(np.abs(a - 0.25 * b - c) <= allowed)
    assert np.array_equal(tau_fast(8 * values, to_world, o, d), 8 * a)
    assert np.array_equal(tau_fast(-values, to_world, o, d), -a)


def test_width_one_broadcasts(seed):
    # One ray against many ends: lanes of width 1 mean the same for all.
    from mivol.transport.media.grid_extinction import integrate_tau
    from scenes import make_lattice

    lattice = make_lattice(np.ones((3, 3, 3)), np.eye(4))
    ends = mi.Float(0.5, 1.0, 1.5, 2.5)
    tau = integrate_tau(lattice, mi.Point3f(-1, 0.5, 0.5), mi.Vector3f(1, 0, 0), ends, mi.Bool(True))
    assert dr.width(tau) == 4
    assert np.allclose(np.asarray(tau), [0, 0, 0.5, 1], rtol=0, atol=BOUND)
