"""Terms and factors differentiated by Dr.Jit: the derivatives of a square, in reverse and forward mode."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.transport.estimators.scores import TrackedFactor, TrackedTerm

ON = (True, False, True)


def parameter(tangent: float | None = None) -> mi.Float:
    """3, 3 and 0."""
    x = mi.Float(3, 3, 0)
    dr.enable_grad(x)
    if tangent is not None:
        dr.set_grad(x, tangent)
    return x


def square(x: mi.Float) -> mi.Spectrum:
    return mi.Spectrum(x * x, 2 * x * x, x * x)


def test_a_term_is_seen_by_its_lanes_only():
    term = TrackedTerm(square(parameter()), mi.Bool(*ON))
    assert term.is_replayed and not dr.grad_enabled(term.value)
    np.testing.assert_array_equal(np.array(term.value), [[9, 0, 0], [18, 0, 0], [9, 0, 0]])


def test_a_term_has_the_derivative_of_its_value():
    """The derivatives of x^2, 2 x^2 and x^2 are 2 x, 4 x and 2 x."""
    x = parameter()
    term = TrackedTerm(square(x), mi.Bool(*ON))
    with dr.suspend_grad():
        term.vjp(mi.Spectrum(1, 2, 0.5))
    np.testing.assert_array_equal(np.array(dr.grad(x)), [6 + 24 + 3, 0, 0])
    term = TrackedTerm(square(parameter(0.5)), mi.Bool(*ON))
    with dr.suspend_grad():
        found = term.jvp()
    np.testing.assert_array_equal(np.array(found), [[3, 0, 0], [6, 0, 0], [3, 0, 0]])


def test_a_factor_has_the_derivative_of_its_logarithm():
    """2 / x in each colour; 0 for a factor of 0."""
    x = parameter()
    with dr.suspend_grad():
        TrackedFactor(lambda: square(x), mi.Bool(*ON)).vjp(mi.Spectrum(1, 2, 0.5))
    rounding = 4 * 2.0**-23  # of a quotient that is made by a reciprocal
    np.testing.assert_allclose(np.array(dr.grad(x)), [3.5 * 2 / 3, 0, 0], rtol=rounding)
    y = parameter(0.5)
    with dr.suspend_grad():
        found = TrackedFactor(lambda: square(y), mi.Bool(*ON)).jvp()
    np.testing.assert_allclose(np.array(found), [[1 / 3, 0, 0]] * 3, rtol=rounding)


def test_what_has_no_parameter_has_no_derivative():
    fixed, on = mi.Spectrum(2), mi.Bool(True)
    for found in (TrackedTerm(fixed, on), TrackedFactor(lambda: fixed, on)):
        found.vjp(mi.Spectrum(1))
        assert not np.array(found.jvp()).any()
