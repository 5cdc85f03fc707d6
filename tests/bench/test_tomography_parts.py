"""What each part of the default solver is worth: rows differ by what they name, and the default's row is the default."""

from __future__ import annotations

from itertools import islice

import pytest

from mivol.bench.studies import tomography, tomography_parts
from mivol.bench.studies.tomography_peers import default, make_slice


@pytest.mark.slow
def test_rows_are_what_they_name(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, tmp_path, capsys) -> None:
    """On a slice of 33^2 with noise: no row is another, and the last but one is what a file without a word asks for."""
    monkeypatch.setattr(tomography_parts, "DATA", {"noisy": (20, 1e3)})
    monkeypatch.setattr(tomography, "measure_parts", lambda: tomography_parts.measure_parts(33))
    assert tomography.main(["--only", "parts", "--out", str(tmp_path)]) == 0
    head, rule, *lines = capsys.readouterr().out.splitlines()
    assert head == "| pcg, nRMSE after 20 iterations | noisy |" and rule == "|---|---|"
    shown = {name: float(error) for name, error in (line.strip("| ").split(" | ") for line in lines)}
    assert list(shown) == list(tomography_parts.PARTS) and len(set(shown.values())) == len(shown)
    scan = make_slice(33, 20, 1e3)
    *_, last = islice(default(scan), 20)
    # Three digits are printed.
    assert shown["from fbp, twice as fine, tv = 1"] == pytest.approx(scan.error(last), abs=5.1e-4)


def test_a_table_of_parts() -> None:
    found = {"few": {"a": 0.25, "b": 0.5}, "many": {"a": 0.125, "b": 1.0}}
    assert tomography_parts.rows_of_parts(found)[2:] == ["| a | 0.250 | 0.125 |", "| b | 0.500 | 1.000 |"]
