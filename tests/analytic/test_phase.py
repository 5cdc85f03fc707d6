"""Phase functions against float64 closed forms: values, moments, inversions, tables, mixtures, measured media.

eps is 2^-23. A float32 expression of k roundings is within k eps/2 of its float64 twin, where nothing cancels.
"""

from __future__ import annotations

import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_phase as oracle
import pytest
from phase_angles import EPS, U, as64, cosines_of, f32, integrals, lanes, turns
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.phase import mie
from mivol.phase.closed_forms import (
    ASYMMETRY,
    NEXT_TO_ONE,
    WEIGHT,
    ScatteringAngle,
    angle_between,
    choose_lobe,
    droplets,
    eval_draine,
    eval_hg,
    eval_rayleigh,
    mean_cosine,
    normalise_weights,
    sample_draine,
    sample_hg,
    sample_rayleigh,
    scattered_direction,
)
from mivol.phase.measured import ALIASES, NAMES, named_medium
from mivol.phase.table import Lookup, Table


def test_moments_of_rayleigh_and_draine():
    assert np.max(np.abs(integrals(eval_rayleigh) - [1, 0, 0.4, 0])) <= 4 * EPS
    for g, alpha in ((0.0, 1.0), (0.6, 1.0), (-0.6, 27.0), (0.8, 300.0)):
        got = integrals(lambda t, g=g, a=alpha: eval_draine(t, mi.Float(g), mi.Float(a)), 2)
        assert np.max(np.abs(got - [1, mean_cosine(g, alpha)])) <= 20 * EPS / (1 - abs(g))


@pytest.mark.parametrize("bad", [1.0, -1.0, 0.99999999, 2.0, np.nan, np.inf])
def test_asymmetry_outside_is_refused(bad):
    assert_refused("above -1 and below 1", ASYMMETRY.check, np.array([bad]), "g")
    assert_refused(r"g is .* at 1;", ASYMMETRY.check, np.array([0.0, bad]), "g")


def test_projection_to_the_nearest_allowed_value():
    x = mi.Float(-3, -NEXT_TO_ONE, 0, 0.5, 1, np.inf)
    assert list(ASYMMETRY.project(x)) == [-NEXT_TO_ONE, -NEXT_TO_ONE, 0, 0.5, NEXT_TO_ONE, NEXT_TO_ONE]
    assert list(WEIGHT.project(mi.Float(-1, 0, 5))) == [0, 0, 5]
    x = mi.Float(0, 2, -2)
    dr.enable_grad(x)
    dr.backward(ASYMMETRY.project(x) + WEIGHT.project(x))
    assert list(dr.grad(x)) == [2, 1, 0]  # on a bound the derivative is that of the parameter; outside it is 0


def test_turn_between_directions_keeps_small_angles():
    """An angle of 1e-3 between float32 directions: 1 - cos to a few roundings of itself, where 1 - dot keeps 12 bits."""
    rng = np.random.default_rng(0)
    wi = rng.normal(size=(4096, 3))
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    side = np.cross(wi, rng.normal(size=(4096, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    for sign in (-1, 1):
        wo = sign * wi * np.cos(1e-3) + side * np.sin(1e-3)
        a, b = (x.astype(np.float32).astype(np.float64) for x in (wi, wo))
        turn = angle_between(mi.Vector3f(a.T), mi.Vector3f(b.T))
        # A difference of neighbours is exact; three squares, two sums and a product are six roundings.
        for x, want in ((turn.below_one, ((a + b) ** 2).sum(1) / 2), (turn.above_minus_one, ((a - b) ** 2).sum(1) / 2)):
            assert np.max(np.abs(as64(x) / want - 1)) <= 3 * EPS


def test_direction_after_turns_by_the_angle():
    """Straight on is -wi, straight back is wi, and the sine is right down to 1e-6."""
    turn, m, p = turns()
    wi = mi.Vector3f(0.6, 0.0, 0.8)
    wo = as64(scattered_direction(wi, turn, mi.Float(0.3))).T
    # The three products of each component and the frame are a few roundings of 1.
    assert np.max(np.abs(wo @ [0.6, 0, 0.8] + (p - m) / 2)) <= 4 * EPS
    # Across the axis the vector is sin times a unit vector with its own roundings, plus those of cos wi.
    across = np.linalg.norm(wo + ((p - m) / 2)[:, None] * [0.6, 0, 0.8], axis=1)
    assert np.max(np.abs(across - np.sqrt(m * p))) <= 4 * EPS
    assert turn.sin[0] == pytest.approx(1e-6, rel=4 * EPS)


def test_shares_and_choice():
    shares = normalise_weights([mi.Float(1), mi.Float(0), mi.Float(3)])
    assert [float(s[0]) for s in shares] == [0.25, 0, 0.75]
    chosen, inside = choose_lobe(shares, *lanes([0, 0.1, 0.2499, 0.25, 0.5, 1 - 2.0**-24]))
    assert list(chosen) == [0, 0, 0, 2, 2, 2]
    # u / 0.25 is exact; (u - 0.25) / 0.75 has two roundings.
    assert as64(inside) == pytest.approx([0, 0.4, 0.9996, 0, 1 / 3, 1], abs=2 * EPS)
    assert np.all(as64(inside) < 1)


def test_a_lobe_without_a_share_is_never_chosen():
    """Neither at the ends: u = 0 before a first such lobe, u = 1 (rounded shares may sum to less) after a last such lobe."""
    for weights, want in (([0, 1, 0], [1, 1, 1]), ([2, 0, 0], [0, 0, 0]), ([0, 0, 3], [2, 2, 2])):
        chosen, _ = choose_lobe(normalise_weights([mi.Float(w) for w in weights]), mi.Float(0, 0.5, 1))
        assert list(chosen) == want


def test_shares_without_any_weight_are_equal():
    """With a derivative of 0 by weights summing to 0, where the derivative of w / 0 does not exist."""
    weights = [mi.Float(0, 1), mi.Float(0, 3)]
    dr.enable_grad(weights)
    shares = normalise_weights(weights)
    assert [list(s) for s in shares] == [[0.5, 0.25], [0.5, 0.75]]
    dr.backward(shares[0])
    # Of 1 / (1 + 3): 3/16 by the first weight and -1/16 by the second.
    assert [list(dr.grad(w)) for w in weights] == [[0, 0.1875], [0, -0.0625]]


SMALL = (1e-7, 1e-5, 1e-3)
LARGE = (0.2, 0.6, 0.9, 0.99, 0.9999, 0.99999, NEXT_TO_ONE)
ALL_G = (0.0, *SMALL, *LARGE, *(-g for g in SMALL), *(-g for g in LARGE))


@pytest.mark.parametrize("g", ALL_G)
def test_hg_values(g):
    turn, m, p = turns()
    got, want = as64(eval_hg(turn, mi.Float(g))), oracle.hg(m, p, f32(g))
    # 1 - a is exact; D has 3 roundings and enters to the power 3/2, the quotient and root add 4 (a reciprocal of Dr.Jit has 2).
    assert np.max(np.abs(got / want - 1)) <= 6 * EPS


def test_legendre_moments_and_backscatter_of_hg():
    g = 0.7
    c, w = oracle.gauss(400)
    values = as64(eval_hg(ScatteringAngle(*lanes(1 - c, 1 + c)), mi.Float(g))) * 2 * np.pi * w
    moments = [(values * np.polynomial.legendre.Legendre.basis(k)(c)).sum() for k in range(10)]
    assert np.max(np.abs(moments - g ** np.arange(10.0))) <= 40 * EPS
    c, w = (c - 1) / 2, w / 2
    back = (as64(eval_hg(ScatteringAngle(*lanes(1 - c, 1 + c)), mi.Float(g))) * 2 * np.pi * w).sum()
    assert back == pytest.approx((1 - g) / (2 * g) * ((1 + g) / np.sqrt(1 + g * g) - 1), rel=10 * EPS)


@pytest.mark.parametrize("g", ALL_G)
def test_inversion_of_hg(g):
    """The probability of a smaller cosine than the sample is u, and of a larger cosine 1 - u, both to a few roundings."""
    turn = sample_hg(*lanes(U), mi.Float(g))
    m, p = as64(turn.below_one), as64(turn.above_minus_one)
    assert np.all(np.isfinite(m) & np.isfinite(p) & (m >= 0) & (p >= 0))
    below, above = oracle.hg_below(m, p, f32(g))
    # m and p are right to 4e-7 of themselves. A chance has the slope 1 (d log / d log) in the one that is
    # small with it, and at most 1/2 and 1/2 in the other, through q: 8e-7 of the chance.
    small = U < 0.5
    assert np.all(np.abs(below[small] - U[small]) <= 8e-7 * U[small])
    assert np.all(np.abs(above[~small] - (1 - U[~small])) <= 8e-7 * (1 - U[~small]))
    assert np.max(np.abs(as64(turn.sin) ** 2 - m * p)) <= 2 * EPS


def test_rayleigh_values():
    turn, m, p = turns()
    assert np.max(np.abs(as64(eval_rayleigh(turn)) / oracle.rayleigh((p - m) / 2) - 1)) <= 3 * EPS


def test_inversion_of_rayleigh():
    c = cosines_of(sample_rayleigh(*lanes(U)))
    # F = (c^3 + 3 c + 4)/8 with slope 3/4 at most, and c to 3 roundings of 1.
    assert np.max(np.abs((c**3 + 3 * c + 4) / 8 - U)) <= 3 * EPS


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0, 27.0, 1e4])
@pytest.mark.parametrize("g", [0.0, 1e-7, 0.6, -0.6, 0.99, 0.99999])
def test_draine_values(g, alpha):
    turn, m, p = turns()
    got, want = as64(eval_draine(turn, mi.Float(g), mi.Float(alpha))), oracle.draine(m, p, f32(g), f32(alpha))
    # As Henyey-Greenstein's, and 1 + alpha c^2 with a rounded c (relative error: that of c^2 at most), over a rounded norm.
    assert np.max(np.abs(got / want - 1)) <= 10 * EPS


def test_draine_has_henyey_greenstein_rayleigh_and_cornette_shanks_as_cases():
    turn, m, p = turns()
    c = (p - m) / 2
    assert np.array_equal(as64(eval_draine(turn, mi.Float(0.7), mi.Float(0))), as64(eval_hg(turn, mi.Float(0.7))))
    got = as64(eval_draine(turn, mi.Float(0), mi.Float(1)))
    assert np.max(np.abs(got / as64(eval_rayleigh(turn)) - 1)) <= 4 * EPS
    g = f32(0.6)
    shanks = 3 / (8 * np.pi) * (1 - g * g) * (1 + c * c) / ((2 + g * g) * (1 + g * g - 2 * g * c) ** 1.5)
    assert np.max(np.abs(as64(eval_draine(turn, mi.Float(0.6), mi.Float(1))) / shanks - 1)) <= 10 * EPS


@pytest.mark.parametrize("g", [0.0, 1e-7, 0.3, 0.9, 0.99999, -0.3, -0.99])
@pytest.mark.parametrize("alpha", [0.0, 1.0, 27.0, 1e4, 1e9])
def test_inversion_of_draine(g, alpha):
    u = U[::5]
    turn = sample_draine(*lanes(u), mi.Float(g), mi.Float(alpha))
    m, p = as64(turn.below_one), as64(turn.above_minus_one)
    below = oracle.draine_below(m, p, f32(g), f32(alpha))
    # The polynomial in y has five terms of size up to 5, so u is met to about 10 roundings of 1.
    assert np.max(np.abs(below - u)) <= 10 * EPS


def test_droplets_of_jendersie_and_deon():
    """The mean cosine of the fit agrees with Mie's for clouds, 0.85 to 0.88; diameters outside the range are refused."""
    fit = droplets(20.0)
    share = fit["weight_draine"]
    g = (1 - share) * fit["g_hg"] + share * mean_cosine(fit["g_draine"], fit["alpha"])
    assert 0.85 < g < 0.89
    # Their equations 4 to 7 at 10 micrometre, by hand: exp(-0.0118937), exp(-0.587579), exp(3.090839) and exp(-0.729904).
    numbers = {"g_hg": 0.988177, "g_draine": 0.555671, "alpha": 21.9955, "weight_draine": 0.481955}
    assert droplets(10.0) == pytest.approx(numbers, rel=1e-5)
    assert_refused("5 to 50", droplets, 1.0)


def test_table_from_legendre_moments():
    """Moments g^n give Henyey-Greenstein, and the moments of the table equal the given moments, to its tolerance."""
    given = 0.6 ** np.arange(40)
    table = Table.from_moments(given, tolerance=1e-4)
    c = np.linspace(-1, 1, 301)
    want = 2 * np.pi * oracle.hg(1 - c, 1 + c, 0.6)
    # The series is cut at 0.6^40 = 1e-9; lines miss by 1e-4 of the peak halfway in angle, and by little more elsewhere.
    assert np.max(np.abs(np.interp(c, table.cosines, table.density) - want)) <= 2e-4 * want.max()
    # A convex function lies below its chords by 2/3 of the largest miss on average: moments move by less than that.
    assert np.max(np.abs(table.moments(10) - given[:10])) <= 4e-4
    assert table.mean_cosine == pytest.approx(0.6, abs=2e-4)


def test_moments_of_a_table_are_exact():
    table = Table.regular([0.5, 1.0, 1.5])
    assert table.moments(3) == pytest.approx([1, 1 / 6, 0], abs=1e-14)


def test_table_from_csv(tmp_path):
    (tmp_path / "angle.csv").write_text("# measured\nangle,value\n0,3\n60,2\n180,1\n")
    (tmp_path / "cos.csv").write_text("-1,1\n0.5,2\n1,3\n  \n")
    (tmp_path / "spreadsheet.csv").write_text("cos,value\r\n-1,1\r\n0.5,2\r\n1,3\r\n", encoding="utf-8-sig")
    for name in ("angle.csv", "cos.csv", "spreadsheet.csv"):
        table = Table.from_csv(tmp_path / name)
        assert table.cosines == pytest.approx([-1, 0.5, 1], abs=1e-15)
        assert list(table.values) == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("-1,1\n1,2,3\n", "'1,2,3'; two columns"),
        ("-1,1,1,2\n", "two columns"),
        ("angle,value,error\n0,3,180\n90,2,1\n", "'angle,value,error'; two columns"),
        ("-1;1\n1;2\n", "'-1;1'; two columns"),
        ("angle,value\n0,3\n90,2\n180,1\n270,2\n", "0 to 270 degrees; 0 .straight on. to 180"),
        ("-1,3e38\n1,3e38\n", "3e.38; 1e-30 to 1e30"),
        ("-1,1e-40\n1,0\n", "1e-40; 1e-30 to 1e30"),
        ("-1,1\n1,x\n", "two columns"),
        ("degrees,value\n0,1\n180,1\n", "'degrees'"),
        ("-1,1\n0.5,1\n", "-1 to 0.5"),
        ("-1,1\n0,1\n0,2\n1,1\n", "rise"),
        ("-1,1\n1,-2\n", "-2 at 1"),
        ("-1,0\n1,0\n", "0 everywhere"),
        ("-1,1\n1,nan\n", "nan at 1"),
        ("", "0 cosines"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, words):
    (tmp_path / "bad.csv").write_text(text)
    assert_refused(words, Table.from_csv, tmp_path / "bad.csv")


def test_bad_moments_and_files_are_refused(tmp_path):
    assert_refused("chi_0", Table.from_moments, [0.9, 0.5])
    assert_refused("cos = -1", Table.from_moments, [1.0, 0.9])
    assert_refused("cannot be read", Table.from_csv, tmp_path / "missing.csv")


COSINES = np.array([-1, -0.93, -0.2, -0.15, 0.4, 0.999, 0.99999, 0.9999999, 1.0])
VALUES = np.array([0.3, 0.0, 0.0, 1.0, 1.0, 2.0, 40.0, 300.0, 1000.0])


def lookup(table: Table) -> tuple[Lookup, mi.Float, mi.Float, mi.Float]:
    nodes = Lookup.from_table(table)
    return nodes, *nodes.normalise(mi.Float(table.values.astype(np.float32)))


def test_values_between_irregular_nodes():
    nodes, values, integral, _ = lookup(Table(COSINES, VALUES))
    turn, m, p = turns()
    got = as64(nodes.eval(turn, values, integral))
    want = np.interp(p - 1, COSINES, VALUES)
    near = m < 1
    want[near] = np.interp(-m[near], COSINES - 1, VALUES)  # 1 - c of the peak is not lost
    total = 2 * np.pi * np.trapezoid(VALUES, COSINES)
    # The place in a segment is rounded by eps/2 of 1 - c (of 1 + c behind): 1.01 segments at most in the peak, 17 in the narrow
    # one from -0.2 to -0.15. Values follow by as much of the larger end.
    after = np.clip(np.searchsorted(COSINES, p - 1), 1, len(COSINES) - 1)
    larger = np.maximum(VALUES[after - 1], VALUES[after])
    assert np.all(np.abs(got * total - want) <= 17 * EPS * larger)


def test_samples_of_a_table_invert_its_distribution():
    nodes, values, integral, cumulative = lookup(Table(COSINES, VALUES))
    turn = nodes.sample(*lanes(U), values, integral, cumulative)
    m = as64(turn.below_one)
    assert np.all(m >= 0)
    assert np.all(np.diff(m) <= 0)
    # Both are rounded once as sums of a node and an offset of 2 at most.
    assert np.max(np.abs(m + as64(turn.above_minus_one) - 2)) <= 4 * EPS
    # Above each sample: whole segments and a trapezoid, from 1 downwards, so that the peak is judged by its own size.
    d, f = (1 - COSINES)[::-1], VALUES[::-1] / np.trapezoid(VALUES, COSINES)
    sums = np.concatenate([[0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(d))])
    i = np.clip(np.searchsorted(d, m, side="right") - 1, 0, len(d) - 2)
    here = np.interp(m, d, f)
    above = sums[i] + (f[i] + here) / 2 * (m - d[i])
    # The cumulative sums are rounded to eps/2 of 1, and so is u's place between two of them; the rest is a few of those.
    assert np.max(np.abs(above - (1 - U))) <= 4 * EPS
    # No sample where the function is 0: between -0.93 and -0.2.
    assert not np.any((m > 1.2001) & (m < 1.9299))


@pytest.fixture
def twin(monkeypatch):
    """Mie's theory from the book in place of miepython, which need not be installed."""
    monkeypatch.setitem(sys.modules, "miepython", oracle.Mie)
    return oracle.Mie


def test_mie_of_small_particles_is_rayleigh(twin, monkeypatch):
    monkeypatch.setattr(mie, "RADII", 16)
    table = mie.aerosol(1e-3, 1.05, 1.5, tolerance=1e-4)
    c = np.linspace(-1, 1, 101)
    # The next term is of relative size x^2 = (2 pi 1e-3 / 0.55)^2 = 1.3e-4; lines miss by 1e-4.
    assert np.max(np.abs(np.interp(c, table.cosines, table.density) / (2 * np.pi * oracle.rayleigh(c)) - 1)) <= 5e-4


def test_mie_of_one_size_is_the_theory(twin, monkeypatch):
    """A very narrow distribution is a single size: values and mean cosine of this sphere."""
    monkeypatch.setattr(mie, "RADII", 8)
    table = mie.aerosol(0.5, 1 + 1e-6, 1.5 - 0.01j, tolerance=1e-3)
    x = 2 * np.pi * 0.5 / 0.55
    want = 2 * np.pi * twin.i_unpolarized(1.5 - 0.01j, x, table.cosines, norm="one")
    # Chords lie off by 1e-3, so their integral does by less; sizes differ by 1e-5, times x.
    assert np.max(np.abs(table.density / want - 1)) <= 2e-3
    assert table.mean_cosine == pytest.approx(twin.efficiencies_mx(1.5 - 0.01j, np.array([x]))[3][0], abs=1e-3)


def test_droplets_of_a_cloud(twin, monkeypatch):
    """A forward peak, and the mean cosine of the sizes, weighted by their scattered light."""
    monkeypatch.setattr(mie, "RADII", 200)
    table = mie.water_droplets(2.0)
    r = np.linspace(0.05, 8, 200)
    _, q_sca, _, g = twin.efficiencies_mx(mie.WATER_INDEX, 2 * np.pi * r / 0.55)
    share = r ** (1 / 0.1 - 1) * np.exp(-r / (2.0 * 0.1)) * q_sca
    # Both sums step over narrow resonances; 128 radii against 1024 differ by 7e-4, and chords by 3e-4 (measured).
    assert table.mean_cosine == pytest.approx((share @ g) / share.sum(), abs=3e-3)
    assert table.density[-1] > 50 * np.interp(0.9, table.cosines, table.density)
    assert np.diff(table.cosines).min() > 0


def test_ends_of_a_lognormal_distribution():
    """Each end leaves out the fraction CUT: of the area r^2 n(r) below, and of the light of small particles, r^6 n(r),
    above."""
    median, s = 0.3, np.log(1.8)
    low, high = np.log(mie._ends_of_lognormal(median, s))

    def share(k, a, b):
        log_r = np.log(median) + s * np.linspace(-20, 30, 500001)
        weight = np.exp(k * log_r - 0.5 * ((log_r - np.log(median)) / s) ** 2)
        return weight[(log_r >= a) & (log_r <= b)].sum() / weight.sum()

    # The rectangle rule in steps of s / 10000 is exact but for the step in which the end lies: the hazard rate of a normal
    # distribution 5.2 deviations out is 5.4 a deviation, so that step holds 5.4e-4 of the share.
    assert share(2, -np.inf, low) == pytest.approx(mie.CUT, rel=1e-3)
    assert share(6, high, np.inf) == pytest.approx(mie.CUT, rel=1e-3)


def test_the_twin_is_miepython():
    """If miepython is installed, its coefficients equal those of the twin."""
    real = pytest.importorskip("miepython", reason='miepython is not installed: pip install "mivol[mie]"')
    for index, x in ((1.333 + 0j, 0.1), (1.5 - 0.01j, 10.0), (1.333 + 0j, 114.0)):
        ours, theirs = oracle.Mie.coefficients(index, x), np.atleast_2d(real.coefficients(index, x))
        n = min(ours.shape[1], theirs.shape[1])
        # Waves turn the other way round in miepython. One of them recurs upwards, which grows 1e-16 to 1e-10 (measured).
        assert np.max(np.abs(ours[:, :n] - theirs[:, :n].conj())) <= 1e-8


def test_without_miepython_there_is_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "miepython", None)
    assert_refused(r'pip install "mivol\[mie\]"', mie.water_droplets, 5.0)


@pytest.mark.parametrize(
    "call",
    [
        lambda: mie.water_droplets(-1.0),
        lambda: mie.water_droplets(5.0, effective_variance=0.6),
        lambda: mie.aerosol(0.1, 0.9, 1.5),
        lambda: mie.aerosol(0.1, 1.5, 1.5, wavelength=np.nan),
        lambda: mie.aerosol(0.1, 1.5, 1.0),
        lambda: mie.aerosol(0.1, 1.5, -1.5 - 0.1j),
        lambda: mie.aerosol(1.0, 5.0, 1.5),
        lambda: mie.water_droplets(1000.0),
    ],
)
def test_particles_that_cannot_be_are_refused(twin, call):
    assert_refused("expected", call)


def test_the_largest_particles_are_limited_in_wavelengths(twin, monkeypatch):
    """The limit is set to the size 2 pi r / wavelength of the largest particles in light of a micrometre."""
    monkeypatch.setattr(mie, "RADII", 2)
    largest = mie._ends_of_lognormal(0.1, np.log(1.2))[1]
    monkeypatch.setattr(mie, "LARGEST_SIZE", 2 * np.pi * largest)
    assert mie.aerosol(0.1, 1.2, 1.5, wavelength=1.01).density.min() > 0
    assert_refused("largest particles", mie.aerosol, 0.1, 1.2, 1.5, wavelength=0.99)


def test_named_media_are_the_published_ones():
    """A few numbers of each table; the scattering coefficients of the second table as printed, computed from the reduced
    ones."""
    sigma_a, sigma_s, g = named_medium("Skim milk")
    assert (sigma_a, sigma_s, g) == ((0.0014, 0.0025, 0.0142), (0.70, 1.22, 1.90), (0.0, 0.0, 0.0))
    sigma_a, sigma_s, g = named_medium("lowfat_milk")
    assert sigma_a == (0.002875, 0.00575, 0.0115)
    assert g == (0.932, 0.902, 0.859)
    assert sigma_s == pytest.approx((13.1157, 15.4445, 17.9572), rel=5e-5)  # five digits were printed
    sigma_a, sigma_s, g = named_medium("red wine")
    assert sigma_a == (0.11632, 0.25191, 0.29434)
    assert sigma_s == pytest.approx((0.00081, 0, 0), abs=5e-6)
    assert named_medium("chicken 1").sigma_a[0] == 0.015


def test_every_number_of_the_tables_of_media_is_as_printed():
    """Sums over the media of absorption, reduced scattering and mean cosine. Scattering coefficients are rounded to
    1e-9, which changes a sum of reduced ones by at most 5e-10 times the sum of 1 - g, below 21."""
    media = [named_medium(name) for name in NAMES]
    found = [[m.sigma_a, np.multiply(m.sigma_s, np.subtract(1, m.g)), m.g] for m in media]
    printed = [
        [65.6054923, 96.9113527, 126.0023755],
        [46.6936281606, 61.2961491339, 61.5780880864],
        [31.386, 29.407, 26.652],
    ]
    np.testing.assert_allclose(np.sum(found, axis=0), printed, rtol=0, atol=1.1e-8)


def test_every_named_medium_is_physical():
    for name in (*NAMES, *ALIASES):
        medium = named_medium(name)
        assert all(x >= 0 for x in (*medium.sigma_a, *medium.sigma_s))
        ASYMMETRY.check(np.array(medium.g), name)
        assert min(medium.g) <= medium.mean_g() <= max(medium.g)
    assert len(NAMES) == 47


def test_unknown_medium_is_refused():
    assert_refused("lowfat milk", named_medium, "lofat milk")


def test_named_medium_as_a_plugin():
    medium = named_medium("regular milk")
    rgb = medium.to_dict(mm_per_unit=10.0, dilution=0.1)
    assert rgb["sigma_a"]["value"] == pytest.approx(medium.sigma_a)
    grey = medium.to_dict(mm_per_unit=1000.0, channel=2)
    assert grey["sigma_s"] == pytest.approx(1000 * medium.sigma_s[2])
    assert grey["phase"] == {"type": "mivol_hg", "g": 0.681}
    # The mean is weighted by scattering: (18.2052 0.75 + 20.3826 0.714 + 22.3698 0.681) / 60.9576.
    assert rgb["phase"]["g"] == pytest.approx(0.712641, abs=1e-5)
    for wrong in ({"mm_per_unit": 0}, {"mm_per_unit": 1, "dilution": 2}, {"mm_per_unit": 1, "channel": 3}):
        with pytest.raises(MivolError):
            medium.to_dict(**wrong)
    for given in (rgb, grey):
        mi.load_dict(given)
