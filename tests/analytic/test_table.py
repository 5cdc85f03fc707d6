"""Tables of phase functions: moments, files, values and sampling, and refusals."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import oracle_phase as oracle
import pytest
from phase_angles import EPS, U, as64, lanes, turns

from mivol.errors import MivolError
from mivol.phase.table import Lookup, Table


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
    with pytest.raises(MivolError, match=words):
        Table.from_csv(tmp_path / "bad.csv")


def test_bad_moments_and_files_are_refused(tmp_path):
    with pytest.raises(MivolError, match="chi_0"):
        Table.from_moments([0.9, 0.5])
    with pytest.raises(MivolError, match="cos = -1"):
        Table.from_moments([1.0, 0.9])
    with pytest.raises(MivolError, match="cannot be read"):
        Table.from_csv(tmp_path / "missing.csv")


COSINES = np.array([-1, -0.93, -0.2, -0.15, 0.4, 0.999, 0.99999, 0.9999999, 1.0])


VALUES = np.array([0.3, 0.0, 0.0, 1.0, 1.0, 2.0, 40.0, 300.0, 1000.0])


def lookup(table: Table) -> tuple[Lookup, mi.Float, mi.Float, mi.Float]:
    nodes = Lookup.from_table(table)
    return nodes, *nodes.normalise(mi.Float(table.values.astype(np.float32)))


@pytest.mark.usefixtures("variant_rgb")
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


@pytest.mark.usefixtures("variant_rgb")
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


@pytest.mark.usefixtures("variant_rgb")
def test_table_of_a_stock_size():
    """Equally spaced values as for tabphase: (0.5, 1, 1.5) is (2 + c) / (8 pi)."""
    nodes, values, integral, _ = lookup(Table.regular([0.5, 1.0, 1.5]))
    turn, m, p = turns()
    assert np.max(np.abs(as64(nodes.eval(turn, values, integral)) * 8 * np.pi - (2 + (p - m) / 2))) <= 8 * EPS
