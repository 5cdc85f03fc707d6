"""The storage table: its formulas are the bytes of real fields, in memory and on disk."""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from mivol.bench.studies import storage
from mivol.fields.field_files import write_field
from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import find_occupied_cells

RES = (5, 6, 7)


def field(degree: int, keep: np.ndarray | None) -> SphericalGrid:
    """Random numbers; the densities are positive, so that a cell is occupied where a node of it is kept."""
    rng = np.random.default_rng(degree)
    sh = rng.normal(size=(*RES, (degree + 1) ** 2, 3))
    return SphericalGrid.from_dense(rng.random(RES) + 0.1, sh, np.eye(4), keep)


def held(*arrays: object) -> int:
    """Bytes of Dr.Jit arrays of 32-bit numbers."""
    return sum(4 * dr.width(a) for a in arrays)


@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "sparse"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_formulas_are_the_bytes(variant_rgb, tmp_path: Path, degree: int, sparse: bool) -> None:
    keep = np.random.default_rng(9).random(RES) < 0.2
    made = field(degree, keep if sparse else None)
    kept = int(keep.sum()) if sparse else math.prod(RES)
    nodes = [made.nodes] if sparse else []
    expected = storage.sparse_bytes(kept, degree) if sparse else storage.dense_bytes(kept, degree)
    assert held(made.density, made.harmonics, *nodes) == made.bytes == expected

    write_field(tmp_path / "field.npz", made)
    with zipfile.ZipFile(tmp_path / "field.npz") as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    # An .npy has a header of 128 bytes.
    stored = sum(sizes[f"{name}.npy"] - 128 for name in ("density", "sh", *(["nodes"] if sparse else [])))
    assert stored == storage.file_bytes(kept, degree, sparse=sparse)


@pytest.mark.parametrize("share", [0.02, 0.3, 1.0])
def test_the_index_is_what_the_walk_reads(variant_rgb, share: float) -> None:
    keep = np.random.default_rng(1).random(RES) <= share
    made = field(0, keep)
    cells = find_occupied_cells(made)
    listed, rows, bricks = storage.count_cells(keep)
    assert (cells.count, dr.width(cells.rows)) == (listed, rows)
    index = made.sparse_index().bytes + cells.index.bytes + held(cells.corners, cells.rows)
    assert index == storage.index_bytes(RES, listed, rows, bricks)


def test_the_lecture_counts_4_gigabytes() -> None:
    """1024^3 cells of 4 bytes; degree 2 is 27 numbers a cell in rows of 28, and the density; sparse falls as 1/N."""
    found = {kind.name: kind for kind in storage.kinds(0.1)}
    assert found["dense rgba, 8 bits (the lecture's)"].scenes[1024] == (4 * 2**30, 4 * 2**30)
    assert found["dense SH 2"].per_cell == (4 * 29, 2 * 28)
    assert found["sparse SH 2"].per_cell == (4 * 29 + 4, 2 * 28 + 4)
    ratio = found["sparse SH 2"].scenes[1024][0] / found["dense SH 2"].scenes[1024][0]
    assert ratio == pytest.approx(0.1 / 8 * 30 / 29, rel=1e-6)
    # Hundreds of nodes of 64^3 lie at one distance: a share is met to a thousandth or two.
    assert storage.shell(0.2).mean() == pytest.approx(0.2, abs=2e-3)


def test_the_index_grows_with_the_surface() -> None:
    """A quarter of a byte a node, 4 a brick of the grid and 12 a brick with a listed cell, 32 a listed cell and 4 a row, of
    which a surface has as at 64^3."""
    shell = storage.shell(0.1 * 128 / 64)
    listed, rows, bricks = (count / shell.sum() for count in storage.count_cells(shell))
    found = storage.kinds(0.1)[-1]
    for n in (128, 1024):
        near = 0.1 * 128 / n * n**3
        expected = n**3 // 4 + 4 * (n // 4 + 1) ** 3 + 12 * round(bricks * near)
        expected += 32 * round(listed * near) + 4 * round(rows * near)
        assert found.scenes[n] == (expected, 0)
    assert found.per_cell == (found.scenes[128][0] / 128**3, 0)
    assert [kind.sparse for kind in storage.kinds(0.1)] == [False] * 6 + [True] * 4 + [False]


def test_what_is_printed(variant_rgb, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A table, the run's quality in the row of its kind, and JSON with the bytes of its real file."""
    run = tmp_path / "a_run"
    run.mkdir()
    write_field(run / "field.npz", field(2, np.ones(RES, bool)))
    (run / "run.json").write_text(json.dumps({"title": "A fit", "results": {"held_out_psnr": 29.54}}))
    assert storage.main(["--runs", str(run)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(line.count("|") == 8 for line in lines if line.startswith("|"))
    judged = {line.split("|")[1].strip(): line.split("|")[7].strip() for line in lines if line.startswith("|")}
    assert judged["sparse SH 2"] == "29.5 dB at 7^3 (A fit)"
    assert judged["dense SH 2"] == "not fitted"
    fitted = json.loads(lines[-1])["fitted"][0]
    assert (fitted["kept"], fitted["share"], fitted["file"]) == (210, 1.0, (run / "field.npz").stat().st_size)


def test_a_folder_that_holds_no_fit(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "run.json").write_text("{}")
    assert storage.main(["--runs", str(tmp_path)]) == 1
    assert "has no field.npz; give folders of fits to photographs" in capsys.readouterr().err


def test_a_fit_in_a_line():
    """Whether it was judged, and whether it is sparse."""
    dense = storage.Fitted("A fit", 64, 2, False, 262144, 1.0, 29 * 2**20, 14 * 2**20, None)
    assert dense.text == "A fit: 64^3, dense SH 2, no held-out view; 262144 nodes (1e+02 %), 29 MiB, 14 MiB on disk, compressed"
    sparse = replace(dense, sparse=True, kept=2621, share=0.01, psnr=31.426)
    assert sparse.text == "A fit: 64^3, sparse SH 2, 31.43 dB; 2621 nodes (1 %), 29 MiB, 14 MiB on disk, compressed"


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (1000, "1e+03 B"), (1023, "1.02e+03 B"), (1024, "1 KiB"), (2**50, "1.02e+03 TiB")]
)
def test_bytes_in_units(count: int, text: str) -> None:
    assert storage.size(count) == text


def test_shares_are_numbers_up_to_1(capsys: pytest.CaptureFixture) -> None:
    assert storage.arguments([]).kept == 0.1 and storage.arguments(["--kept", "1"]).kept == 1
    for wrong in ("0", "1.01"):
        with pytest.raises(SystemExit):
            storage.arguments(["--kept", wrong])
        assert f"--kept {wrong} is no share" in capsys.readouterr().err
