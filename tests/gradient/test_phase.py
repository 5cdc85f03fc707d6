"""Derivatives of phase functions: by their parameters and by directions, against closed forms and finite differences."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_phase as oracle
import pytest
from phase_angles import EPS, f32, lanes

from mivol.phase.closed_forms import ScatteringAngle, angle_between, eval_draine, eval_hg, normalise_weights
from mivol.phase.table import Lookup, Table

NEAR = np.geomspace(1e-6, 1, 100)
ANGLES = np.concatenate([[0, np.pi], NEAR, np.linspace(1.01, 2.1, 60), np.pi - NEAR])


def slopes(evaluate, *parameters: float) -> list[np.ndarray]:
    """Derivatives of a density by each parameter at every turn, (2, n): in reverse and in forward mode."""
    m, p = oracle.turns(ANGLES)
    turn = ScatteringAngle(*lanes(m, p))
    given = [dr.full(mi.Float, x, len(m)) for x in parameters]
    dr.enable_grad(given)
    dr.backward(evaluate(turn, *given))
    both = [[np.array(dr.grad(x), dtype=np.float64)] for x in given]
    for k in range(len(parameters)):
        given = [dr.full(mi.Float, x, len(m)) for x in parameters]
        dr.enable_grad(given[k])
        value = evaluate(turn, *given)
        dr.forward(given[k])
        both[k].append(np.array(dr.grad(value), dtype=np.float64))
    return [np.array(pair) for pair in both]


@pytest.mark.parametrize("g", [0.0, 1e-7, -1e-7, 1e-3, 0.5, -0.5, 0.9, 0.999, 0.99999, -0.99999])
def test_slope_of_hg_by_g(g):
    (got,) = slopes(eval_hg, g)
    m, p = oracle.turns(ANGLES)
    g = f32(g)
    # It is the difference of -2 g p / (1 - g^2) and of 3/2 dD/dg p / D, where dD/dg is one of 2 m and 2 (1 - |g|) again.
    near = m if g >= 0 else p
    terms = 2 * abs(g) / (1 - g * g) + 3 * (near + 1 - abs(g)) / oracle.hg_d(m, p, g)
    assert np.all(np.abs(got - oracle.hg_slope(m, p, g)) <= 8 * EPS * terms * oracle.hg(m, p, g))


@pytest.mark.parametrize("g", [0.0, 1e-3, 0.6, -0.9])
def test_slope_of_hg_integrates_to_nothing(g):
    """The integral of dp/dg over the sphere is 0, that of cos dp/dg is 1: d(mean cosine)/dg."""
    c, w = oracle.gauss(400)
    x = dr.full(mi.Float, g, len(c))
    dr.enable_grad(x)
    dr.backward(eval_hg(ScatteringAngle(*lanes(1 - c, 1 + c)), x))
    slope = 2 * np.pi * w * np.array(dr.grad(x), dtype=np.float64)
    # Nodes in the peak are rounded by eps/2 of 1 - c against (1 - g), where dp/dg has the slope 1/(1 - g)^3 times the width.
    assert [slope.sum(), slope @ c] == pytest.approx([0, 1], abs=20 * EPS / (1 - abs(g)) ** 2)


@pytest.mark.parametrize(("g", "alpha"), [(0.0, 0.0), (0.6, 0.0), (0.6, 1.0), (-0.8, 27.0), (0.99999, 300.0)])
def test_slopes_of_draine(g, alpha):
    """By g and by alpha, alpha = 0 included, where an optimizer may start."""
    by_g, by_alpha = slopes(eval_draine, g, alpha)
    m, p = oracle.turns(ANGLES)
    g, alpha = f32(g), f32(alpha)
    k, c2 = (1 + 2 * g * g) / 3, ((p - m) / 2) ** 2
    hg, ratio = oracle.hg(m, p, g), (1 + alpha * c2) / (1 + alpha * k)
    terms = (c2 / (1 + alpha * k), ratio * k / (1 + alpha * k))
    assert np.all(np.abs(by_alpha - hg * (terms[0] - terms[1])) <= 16 * EPS * hg * (terms[0] + terms[1]))
    want = oracle.hg_slope(m, p, g) * ratio - hg * ratio * alpha * 4 * g / 3 / (1 + alpha * k)
    terms = np.abs(oracle.hg_slope(m, p, g)) * ratio + hg * ratio * 4 * abs(g)
    # dp_hg/dg is itself a difference, of terms 3/(1 - g) times p at most.
    assert np.all(np.abs(by_g - want) <= 16 * EPS * (terms + 4 * hg * ratio / (1 - abs(g))))


@pytest.mark.parametrize("g", [1e-7, 0.8, -0.8, 0.9999])
def test_slope_by_direction(g):
    """d p / d wo along the sphere, which moves a light: p' (cos) times the change of the cosine."""
    wi = np.array([0.0, 0.0, 1.0])
    angles = np.array([1e-3, 0.1, 1.0, 2.0, 3.0])
    wo = np.stack([np.sin(angles), 0 * angles, -np.cos(angles)])
    tangent = np.stack([np.cos(angles), 0 * angles, np.sin(angles)])  # to larger angles
    x = mi.Vector3f(*lanes(*wo))
    dr.enable_grad(x)
    dr.set_grad(x, mi.Vector3f(*lanes(*tangent)))
    value = eval_hg(angle_between(mi.Vector3f(wi), x), mi.Float(g))
    dr.forward_to(value)
    g = f32(g)
    got, want = np.array(dr.grad(value)), np.empty(5)
    for k, (o, t) in enumerate(zip(as_rounded(wo), as_rounded(tangent), strict=True)):
        m, p = ((o + wi) ** 2).sum() / 2, ((o - wi) ** 2).sum() / 2
        slope = 3 * g * (1 - g * g) / (4 * np.pi) * oracle.hg_d(m, p, g) ** -2.5  # dp / d cos
        # By 1 - cos where that is what p is made of, by 1 + cos for g < 0.
        want[k] = -slope * ((o + wi) @ t) if g >= 0 else slope * ((o - wi) @ t)
    # The slope is right to some roundings, the product with the tangent to that of two terms which do not cancel.
    assert np.all(np.abs(got - want) <= 12 * EPS * np.abs(want))


def as_rounded(vectors: np.ndarray) -> np.ndarray:
    """(3, n) to (n, 3), as float32 holds it."""
    return vectors.astype(np.float32).astype(np.float64).T


def test_slopes_of_a_table():
    """By each value, through the normalisation: a hat function minus its share of the integral, over that integral."""
    cosines, values = np.array([-1, -0.4, 0.1, 0.9, 1.0]), np.array([0.5, 0.0, 2.0, 1.0, 8.0])
    x = mi.Float(values.astype(np.float32))
    dr.enable_grad(x)
    nodes = Lookup.from_table(Table(cosines, values))
    projected, integral, _ = nodes.normalise(x)
    c = np.array([-0.7, -0.2, 0.05, 0.5, 0.95])
    weights = np.array([1.0, -2.0, 0.5, 3.0, 0.25])
    value = nodes.eval(ScatteringAngle(*lanes(1 - c, 1 + c)), projected, integral)
    dr.backward(dr.sum(value * mi.Float(weights.astype(np.float32))))

    def loss(v: np.ndarray) -> float:
        return weights @ np.interp(c, cosines, v) / (2 * np.pi * np.trapezoid(v, cosines))

    step = 1e-6
    want = [(loss(values + step * e) - loss(values - step * e)) / (2 * step) for e in np.eye(5)]
    # Central differences in float64: step^2 and 1e-16/step. float32 sums of five terms of size 1 on the other side.
    assert np.array(dr.grad(x)) == pytest.approx(want, abs=20 * EPS)


def test_slopes_of_shares():
    """d (w_0 / sum) / d w: (sum - w_0) / sum^2 and -w_0 / sum^2, at a weight of 0 as well."""
    weights = [mi.Float(0), mi.Float(3), mi.Float(1)]
    dr.enable_grad(weights)
    dr.backward(normalise_weights(weights)[0])
    assert [float(dr.grad(w)[0]) for w in weights] == pytest.approx([0.25, 0, 0], abs=EPS)
    weights = [mi.Float(2), mi.Float(3)]
    dr.enable_grad(weights)
    dr.backward(normalise_weights(weights)[0])
    assert [float(dr.grad(w)[0]) for w in weights] == pytest.approx([3 / 25, -2 / 25], rel=4 * EPS)
