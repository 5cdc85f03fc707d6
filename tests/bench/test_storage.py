"""Storage: bytes of real fields, in memory and on disk, and their table."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mivol.bench.studies import storage
from mivol.fields.field_files import write_field
from mivol.fields.spherical_grid import SphericalGrid


@pytest.fixture(scope="module")
def kinds(request: pytest.FixtureRequest) -> dict[str, dict]:
    """The layouts, with a tenth of the nodes kept at 128^3."""
    mi.set_variant(request.config.getoption("--variant"))
    return {kind["name"]: kind for kind in storage.measure_storage(storage.StorageSize())["kinds"]}


def test_bytes_of_a_cell_are_numbers_of_its_rows(variant_rgb: str, kinds: dict[str, dict]) -> None:
    """Degree 2 has 27 numbers in rows of 28, and the density, 4 bytes each; halves without padding on disk; a kept node has its
    number of 4 bytes besides. The row of vacuum is one of more than 10,000."""
    assert kinds["dense SH 2"]["per_cell"] == (4 * 29, 2 * 28)
    assert kinds["sparse SH 2"]["per_cell"] == pytest.approx((4 * 30, 2 * 28 + 4), rel=1e-4)
    assert kinds["dense SH 0"]["per_cell"] == (4 * 5, 2 * 4)
    assert [kind["sparse"] for kind in kinds.values()] == [False] * 6 + [True] * 4 + [False]


def test_a_surface_grows_with_the_square(kinds: dict[str, dict]) -> None:
    """The lecture's 4 GiB at 1024^3; there an eighth of a tenth of the nodes is kept."""
    assert kinds["dense rgba, 8 bits (the lecture's)"]["scenes"][1024] == (4 * 2**30, 4 * 2**30)
    assert kinds["sparse SH 2"]["scenes"][1024][0] == pytest.approx(0.1 / 8 * 2**30 * 120, rel=1e-4)


def test_the_index_is_the_one_of_a_field(variant_rgb: str, kinds: dict[str, dict]) -> None:
    """128^3 is a resolution that is measured. There a share of 0.1 is met to 3e-3, because hundreds of 210,000 nodes lie at one
    distance. The index of a cell falls with the resolution towards the part of all cells, which has two bits a node."""
    index = kinds["beside it: the walk's index"]
    assert index["scenes"][128][0] == pytest.approx(storage.index_bytes(storage.make_field(128, 0, 0.1)), rel=4e-3)
    assert index["per_cell"][0] == pytest.approx(index["scenes"][128][0] / 128**3, rel=1e-6)
    each = [memory / n**3 for n, (memory, _) in index["scenes"].items()]
    assert each == sorted(each, reverse=True) and each[-1] > 0.25


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (1000, "1e+03 B"), (1023, "1.02e+03 B"), (1024, "1 KiB"), (2**50, "1.02e+03 TiB")]
)
def test_bytes_in_units(count: int, text: str) -> None:
    assert storage.format_bytes(count) == text


def test_a_run_is_described(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Its memory is that of its field; a run without held-out views and wrong options are named."""
    run, keep = tmp_path / "a_run", np.random.default_rng(0).random((5, 6, 7)) < 0.5
    run.mkdir()
    field = SphericalGrid.from_dense(np.ones(keep.shape), np.zeros((*keep.shape, 9, 3)), np.eye(4), keep)
    write_field(run / "field.npz", field)
    (run / "run.json").write_text(json.dumps({"title": "A fit", "results": {"held_out_psnr": 29.54}}))
    options = ["--out", str(tmp_path / "out"), "--variant", variant_rgb]
    assert storage.STUDY.run(["--runs", str(run), *options]) == 0
    printed = capsys.readouterr()
    assert {line.count("|") for line in printed.err.splitlines() if line.startswith("|")} == {7}
    assert f"A fit: 7^3, sparse SH 2, 29.54 dB; {keep.sum()} nodes" in printed.err
    (fit,) = json.loads(printed.out)["storage"]["fitted"]
    assert (fit["kept"], fit["share"], fit["memory"]) == (keep.sum(), keep.mean(), field.bytes)
    assert fit["file"] == (run / "field.npz").stat().st_size
    assert storage.describe_fit(fit | {"psnr": None, "sparse": False}).startswith("A fit: 7^3, dense SH 2, no held-out view;")
    for wrong, message in (
        (["--runs", str(tmp_path)], "has no run.json and no field.npz"),
        (["--kept", "1.01"], "is no share"),
    ):
        assert storage.STUDY.run([*wrong, *options]) == 1
        assert message in capsys.readouterr().err
