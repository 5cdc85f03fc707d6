"""Tables of numbers as text."""

from __future__ import annotations

from pathlib import Path

import pytest

from mivol.errors import MivolError
from mivol.files import read_columns


def test_names_and_remarks_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x, y\n# a remark\n1, 2\n\n3 4e-1\n")
    assert read_columns(tmp_path / "a.csv", 2).tolist() == [[1.0, 2.0], [3.0, 0.4]]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1 2\n3\n", "'3' in line 2, expected 2 finite numbers"),
        ("1 nan\n", "'1 nan' in line 1, expected 2 finite numbers"),
        ("1 2\n3 four\n", "'3 four' in line 2, expected numbers"),
        ("x y\n", "no line of numbers"),
    ],
)
def test_other_lines_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(MivolError, match=sentence):
        read_columns(tmp_path / "a.txt", 2)
