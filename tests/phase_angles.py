"""Scattering angles, uniform numbers and roundings for tests of phase functions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_phase as oracle

from mivol.phase.closed_forms import ScatteringAngle

EPS = 2.0**-23
NEAR = np.geomspace(1e-6, 1, 200)
ANGLES = np.concatenate([NEAR, np.linspace(1, np.pi - 1, 50), np.pi - NEAR, [0, np.pi]])


def f32(x: float) -> float:
    """The float32 number that a parameter becomes, as float64: both sides see the same g."""
    return float(np.float32(x))


def lanes(*arrays: np.ndarray) -> tuple[mi.Float, ...]:
    return tuple(mi.Float(np.ascontiguousarray(a, dtype=np.float32)) for a in arrays)


def turns() -> tuple[ScatteringAngle, np.ndarray, np.ndarray]:
    m, p = oracle.turns(ANGLES)
    return ScatteringAngle(*lanes(m, p)), m, p


def as64(x: object) -> np.ndarray:
    return np.array(dr.detach(x), dtype=np.float64)


def uniforms(n: int) -> np.ndarray:
    """Midpoints of n equal parts of [0, 1], in the multiples of 2^-24 that float32 holds there."""
    return (np.arange(n) + 0.5) / n


def cosines_of(turn: ScatteringAngle) -> np.ndarray:
    return (as64(turn.above_minus_one) - as64(turn.below_one)) / 2


def integrals(evaluate, powers: int = 4) -> np.ndarray:
    """Moments <cos^k>, k = 0 ..., by Gauss-Legendre over the cosine."""
    c, w = oracle.gauss(400)
    values = as64(evaluate(ScatteringAngle(*lanes(1 - c, 1 + c)))) * 2 * np.pi * w
    return np.array([(values * c**k).sum() for k in range(powers)])


U = np.concatenate([[0, 2.0**-24, 1e-6], uniforms(4096), [1 - 1e-6, 1 - 2.0**-24]]).astype(np.float32).astype(np.float64)
