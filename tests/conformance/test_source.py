"""Checked bytes and numbers: compressed streams, suggested names, tables of numbers."""

from __future__ import annotations

import bz2
import gzip
import zlib
from pathlib import Path

import pytest
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.files import read_columns, source

PATH, DATA = Path("a.nrrd"), bytes(range(200)) * 3
PACK = {"zlib": zlib.compress, "gzip": gzip.compress, "bzip2": bz2.compress}


@pytest.mark.parametrize("codec", [c for c in source.CODECS if c in PACK])
def test_streams_are_joined_up_to_the_limit(codec: str) -> None:
    """Exactly as much as the header promises is taken, and not a byte more; a promise beyond all memory is one, too."""
    packed = PACK[codec](DATA)
    for limit in (len(DATA), 2**70):
        assert source.decompress(packed, codec, limit, PATH) == DATA
    with pytest.raises(MivolError, match=f"more than {len(DATA) - 1} bytes after decompression"):
        source.decompress(packed, codec, len(DATA) - 1, PATH)
    assert source.decompress(packed + packed + b"\0" * 8, codec, 2 * len(DATA), PATH) == 2 * DATA
    assert_refused("more than", source.decompress, packed + packed, codec, 2 * len(DATA) - 1, PATH)


def test_damaged_streams_are_refused() -> None:
    assert_refused("damaged gzip data", source.decompress, b"nothing of that kind", "gzip", 100, PATH)
    with pytest.raises(MivolError):
        source.decompress(gzip.compress(DATA)[:-20], "gzip", len(DATA), PATH)


def test_a_missing_file_suggests_a_similar_name(tmp_path: Path) -> None:
    (tmp_path / "density.nrrd").write_bytes(b"")
    for name, way_out in {
        "densty.nrrd": "did you mean density.nrrd",
        "qqqq": "check the spelling and the folder",
        "no/density.nrrd": "the folder .*no does not exist either",
    }.items():
        assert_refused(way_out, source.read_bytes, tmp_path / name)
    names = ["density", "temperature"]
    assert source.select_dataset(PATH, "density", names) == "density" and source.select_dataset(PATH, None, ["one"]) == "one"
    for asked, way_out in {
        "densty": "did you mean 'density'",
        "qqqq": "choose another array",
        None: r"2 arrays \('density', 'temperature'\).*dataset=",
    }.items():
        assert_refused(way_out, source.select_dataset, PATH, asked, names)
    assert_refused("0 arrays", source.select_dataset, PATH, None, [])
    source.refuse_dataset(PATH, None)
    assert_refused("remove dataset", source.refuse_dataset, PATH, "density")


def test_a_table_skips_comments_and_column_names(tmp_path: Path) -> None:
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
def test_invalid_lines_of_a_table_are_refused(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    assert_refused(sentence, read_columns, tmp_path / "a.txt", 2)
