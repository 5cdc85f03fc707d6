"""Storage: the formulas give the bytes of real fields, in memory and on disk."""

from __future__ import annotations

import json
import math
import zipfile
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
    created = field(degree, keep if sparse else None)
    kept = int(keep.sum()) if sparse else math.prod(RES)
    nodes = [created.nodes] if sparse else []
    expected = storage.sparse_bytes(kept, degree) if sparse else storage.dense_bytes(kept, degree)
    assert held(created.density, created.harmonics, *nodes) == created.bytes == expected

    write_field(tmp_path / "field.npz", created)
    with zipfile.ZipFile(tmp_path / "field.npz") as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    # An .npy has a header of 128 bytes.
    stored = sum(sizes[f"{name}.npy"] - 128 for name in ("density", "sh", *(["nodes"] if sparse else [])))
    assert stored == storage.file_bytes(kept, degree, sparse=sparse)


@pytest.mark.parametrize("share", [0.02, 0.3, 1.0])
def test_the_index_is_what_the_walk_reads(variant_rgb, share: float) -> None:
    keep = np.random.default_rng(1).random(RES) <= share
    created = field(0, keep)
    cells = find_occupied_cells(created)
    listed, rows, bricks = storage.count_cells(keep)
    assert (cells.count, dr.width(cells.rows)) == (listed, rows)
    index = created.sparse_index().bytes + cells.index.bytes + held(cells.corners, cells.rows)
    assert index == storage.index_bytes(RES, listed, rows, bricks)


def test_the_lecture_counts_4_gigabytes() -> None:
    """1024^3 cells of 4 bytes; degree 2 is 27 numbers a cell in rows of 28, and the density; sparse falls as 1/N."""
    result = {kind.name: kind for kind in storage.make_layouts(0.1)}
    assert result["dense rgba, 8 bits (the lecture's)"].scenes[1024] == (4 * 2**30, 4 * 2**30)
    assert result["dense SH 2"].per_cell == (4 * 29, 2 * 28)
    assert result["sparse SH 2"].per_cell == (4 * 29 + 4, 2 * 28 + 4)
    ratio = result["sparse SH 2"].scenes[1024][0] / result["dense SH 2"].scenes[1024][0]
    assert ratio == pytest.approx(0.1 / 8 * 30 / 29, rel=1e-6)
    # Hundreds of nodes of 64^3 lie at one distance: a share is met to a thousandth or two.
    assert storage.ball_shell(0.2).mean() == pytest.approx(0.2, abs=2e-3)


def test_the_index_grows_with_the_surface() -> None:
    """A quarter of a byte a node, 4 a brick of the grid and 12 a brick with a listed cell, 32 a listed cell and 4 a row, of
    which a surface has as at 64^3."""
    shell = storage.ball_shell(0.1 * 128 / 64)
    listed, rows, bricks = (count / shell.sum() for count in storage.count_cells(shell))
    result = storage.make_layouts(0.1)[-1]
    for n in (128, 1024):
        near = 0.1 * 128 / n * n**3
        expected = n**3 // 4 + 4 * (n // 4 + 1) ** 3 + 12 * round(bricks * near)
        expected += 32 * round(listed * near) + 4 * round(rows * near)
        assert result.scenes[n] == (expected, 0)
    assert result.per_cell == (result.scenes[128][0] / 128**3, 0)
    assert [kind.sparse for kind in storage.make_layouts(0.1)] == [False] * 6 + [True] * 4 + [False]


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 B"), (1000, "1e+03 B"), (1023, "1.02e+03 B"), (1024, "1 KiB"), (2**50, "1.02e+03 TiB")]
)
def test_bytes_in_units(count: int, text: str) -> None:
    assert storage.format_bytes(count) == text


def test_a_table_with_the_quality_of_runs(variant_rgb, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The PSNR of a run stands in the row of its layout; a run without held-out views and a wrong option are named."""
    run = tmp_path / "a_run"
    run.mkdir()
    write_field(run / "field.npz", field(2, np.ones(RES, bool)))
    (run / "run.json").write_text(json.dumps({"title": "A fit", "results": {"held_out_psnr": 29.54}}))
    options = ["--out", str(tmp_path / "out"), "--variant", variant_rgb]
    assert storage.STUDY.run(["--runs", str(run), *options]) == 0
    printed = capsys.readouterr()
    rows = [line.split("|") for line in printed.err.splitlines() if line.startswith("|")]
    assert all(len(row) == 9 for row in rows)
    quality = {row[1].strip(): row[7].strip() for row in rows}
    assert quality["sparse SH 2"] == "29.5 dB at 7^3 (A fit)"
    assert quality["dense SH 2"] == "not fitted"
    assert "A fit: 7^3, sparse SH 2, 29.54 dB; 210 nodes (1e+02 %)" in printed.err
    (fit,) = json.loads(printed.out)["storage"]["fitted"]
    assert (fit["kept"], fit["share"], fit["file"]) == (210, 1.0, (run / "field.npz").stat().st_size)
    assert storage.describe_fit(fit | {"psnr": None, "sparse": False}).startswith("A fit: 7^3, dense SH 2, no held-out view;")
    for wrong, message in (
        (["--runs", str(tmp_path)], "has no run.json and no field.npz"),
        (["--kept", "1.01"], "is no share"),
    ):
        assert storage.STUDY.run([*wrong, *options]) == 1
        assert message in capsys.readouterr().err
