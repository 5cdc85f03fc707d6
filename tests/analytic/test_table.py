"""Tables of phase functions: from moments and files, and those that are refused."""

from __future__ import annotations

import numpy as np
import oracle_phase as oracle
import pytest

from mivol.errors import MivolError
from mivol.phase.table import Table


def test_table_from_legendre_moments():
    """g^n gives Henyey-Greenstein back, and the table's own moments are those that were put in, to its tolerance."""
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
