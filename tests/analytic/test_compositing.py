"""A piece of a ray over the pieces behind it: values by hand, derivatives by differences."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.compositing import (
    BodyIntegral,
    CellIntegral,
    ReverseState,
    composite_over,
    pass_cell,
)

PIECES = [(0.5, 2.0), (1.5, 0.25), (0.1, 4.0)]
"""Optical depth and colour of three pieces, the nearest first."""


def light(pieces: list[tuple[float, float]], behind: float) -> float:
    """Radiance of the pieces in front of a light, as seen by the camera."""
    front, total = 0.0, 0.0
    for tau, colour in pieces:
        total += np.exp(-front) * -np.expm1(-tau) * colour
        front += tau
    return total + np.exp(-front) * behind


def integral_of(tau: float, colour: float) -> CellIntegral:
    T = np.exp(-tau)
    return CellIntegral(mi.Float(tau), mi.Float(T), mi.Float(colour * (1 - T)), [mi.Float(1)], [mi.Float(colour * T)])


def test_pieces_are_put_in_front_of_each_other_with_their_tangents() -> None:
    """From the far end, with a tangent of each optical depth and a tangent of N."""
    change, h = [(0.3, 0.2), (-0.7, 0.1), (1.1, -0.5)], 1e-5
    swept = BodyIntegral([mi.Float64(0)] * 2, [mi.Float(0)] * 2)
    for (tau, colour), (dtau, dcolour) in list(zip(PIECES, change, strict=True))[::-1]:
        own = mi.Float(dcolour * -np.expm1(-tau))
        swept = composite_over(swept, [integral_of(tau, colour)], [[mi.Float(dtau)]], [own])
    moved = [[(t + s * h * a, c + s * h * b) for (t, c), (a, b) in zip(PIECES, change, strict=True)] for s in (1, -1)]
    assert float(swept.N[0][0]) == pytest.approx(light(PIECES, 0.0), rel=1e-6)
    assert float(swept.tau[0][0]) == pytest.approx(sum(tau for tau, _ in PIECES), rel=1e-6)
    assert float(swept.N[1][0]) == pytest.approx((light(moved[0], 0) - light(moved[1], 0)) / (2 * h), rel=1e-5)
    assert float(swept.tau[1][0]) == pytest.approx(sum(a for a, _ in change), rel=1e-6)


def test_a_reverse_sweep_finds_what_each_piece_adds() -> None:
    """Behind an optical depth of 0.4 and before a light of 3, with a weight of 1.7: derivatives by each optical depth and N."""
    weight, front, beyond, h = 1.7, 0.4, 3.0, 1e-5
    through = front + sum(tau for tau, _ in PIECES)
    state = ReverseState([mi.Float(0)], [mi.Float64(through)], [mi.Float(0)])
    behind, found = [mi.Float(weight * np.exp(-through) * beyond)], []
    for tau, colour in PIECES[::-1]:
        state, slopes, by_N = pass_cell(state, [integral_of(tau, colour)], [mi.Float(weight)], behind)
        found.append((float(slopes[0][0][0]), float(by_N[0][0])))
    for k, (by_tau, by_N) in enumerate(found[::-1]):
        moved = [[(t + s * h * (j == k), c) for j, (t, c) in enumerate(PIECES)] for s in (1, -1)]
        seen = [weight * np.exp(-front) * light(pieces, beyond) for pieces in moved]
        assert by_tau == pytest.approx((seen[0] - seen[1]) / (2 * h), rel=1e-4)
        assert by_N == pytest.approx(weight * np.exp(-front - sum(tau for tau, _ in PIECES[:k])), rel=1e-6)
    assert float(state.ahead[0][0]) == pytest.approx(front, abs=1e-6)
