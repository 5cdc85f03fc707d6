"""Grids and rays for the hard cases of line integrals, and what their sums may err by."""

from __future__ import annotations

import math

import numpy as np
from oracle import tau_scale, tau_twin

from scenes import as_float32, tau_fast

BOUND = 2e-6
"""Error asked for, relative to the integral of sigma + h |grad sigma|."""

EPS = 2.0**-23
"""Spacing of float32 at 1."""


def positive(rng, shape):
    """Voxels in [0, 1), a third of them empty, as float32 holds them."""
    values = rng.uniform(0, 1, shape)
    return as_float32(np.where(rng.uniform(size=shape) < 1 / 3, 0, values))


def assert_tau(values, to_world, o, d, t_max=math.inf, skip=False):
    """The code under test agrees with the twin on every ray."""
    o, d = np.broadcast_arrays(np.atleast_2d(as_float32(o)), np.atleast_2d(as_float32(d)))
    t_max = as_float32(t_max)
    fast = tau_fast(values, to_world, o, d, t_max, skip)
    twin = tau_twin(values, to_world, o, d, 0.0, t_max)
    allowed = BOUND * tau_scale(values, to_world, o, d, 0.0, t_max)
    assert np.isfinite(fast).all()
    worst = np.unravel_index(np.argmax(np.abs(fast - twin) - allowed), fast.shape)
    assert np.all(np.abs(fast - twin) <= allowed), (
        f"ray {o[worst[0]].tolist()} + t {d[worst[0]].tolist()}: {fast[worst]!r}, the twin says {twin[worst]!r} "
        f"+- {allowed[worst]:.2g}"
    )
    return fast
