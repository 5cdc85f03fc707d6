"""Study of tomography: every method nears the truth, and the operator has the reported properties."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.bench.studies import tomography as study
from mivol.files import write_volume
from mivol.tomography.geometry import VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector


@pytest.fixture(scope="module")
def head(request: pytest.FixtureRequest) -> study.Scan:
    """Shepp and Logan's head of 16^3 voxels from 24 views."""
    mi.set_variant(request.config.getoption("--variant"))
    return study.make_head_scan("yu-ye-wang", 16, 24)


@pytest.mark.slow
def test_every_method_nears_the_truth(variant_rgb: str, head: study.Scan) -> None:
    """The error of each falls below that of 0, which is 1, within four iterations, and its volume has that error."""
    answer = study.reconstruct(head, 4)
    curves, volumes = answer["curves"], answer["volumes"]
    assert set(curves) == set(volumes) == set(study.solver_problems(head.a, head.y))
    for label, curve in curves.items():
        assert len(curve["nrmse"]) == len(curve["seconds"]) == 4
        assert curve["nrmse"][-1] < 0.9
        error = np.linalg.norm(volumes[label] - head.truth) / np.linalg.norm(head.truth)
        assert error == pytest.approx(curve["nrmse"][-1], rel=1e-6)
    table = answer["nrmse"]
    assert set(table["CG"]) == {"seconds_per_iteration"}
    assert study.tabulate({"x": {"nrmse": [0.5] * 12, "seconds": [24.0] * 12}}) == {
        "x": {"5": 0.5, "10": 0.5, "seconds_per_iteration": 2.0}
    }


def test_the_pair_is_adjoint(head: study.Scan) -> None:
    """Sums of float32 products: |Ax| |y| times a few 2^-24; a transpose of something else is off by much of it."""
    rng = np.random.default_rng(3)
    x, y = (rng.uniform(size=n).astype(np.float32) for n in head.a.shape[::-1])
    assert study.adjoint_mismatch(head.a, x, y) < 1e-6
    halved = type("Halved", (SimpleNamespace,), {"__matmul__": lambda self, v: (head.a @ v) / 2})(T=head.a.T)
    assert study.adjoint_mismatch(halved, x, y) > 0.1


def test_costs(head: study.Scan) -> None:
    result = study.measure_costs(head)
    assert set(result) == {
        *("seconds_A", "seconds_AT", "rays_per_second_A", "AT_over_A", "adjoint_mismatch", "voxels_own_error"),
    }
    assert result["rays_per_second_A"] == pytest.approx(24 * 16 * 16 / result["seconds_A"])
    assert 0 < result["voxels_own_error"] < 0.3


def test_a_volume_is_projected_at_twice_the_resolution(variant_rgb: str, tmp_path: Path) -> None:
    """The truth is the mean of 2 x 2 x 2 voxels of the file, over its largest value; the detector sees all of it."""
    values = np.random.default_rng(0).uniform(0, 4, (6, 9, 8)).astype(np.float32)
    write_volume(tmp_path / "a.nrrd", values, np.diag([8.0, 9.0, 6.0, 1.0]))
    scan = study.make_volume_scan(tmp_path / "a.nrrd", 5)
    assert (scan.name, scan.truth.shape) == ("a.nrrd", (3, 4, 4))
    assert scan.truth[1, 2, 3] == pytest.approx(values[2:4, 4:6, 6:8].mean() / values.max(), rel=1e-6)
    assert scan.y.size == scan.a.shape[0]
    assert scan.y.max() > 1


def test_the_scan_of_the_head(head: study.Scan) -> None:
    """The phantom in a cube of half width 128, projected by chords, averaged over 4^3 points a voxel."""
    phantom = shepp_logan("yu-ye-wang", 128.0)
    assert head.name == "Shepp-Logan (yu-ye-wang)"
    assert np.array_equal(np.ravel(head.y), np.ravel(phantom.project(head.a.geometry)))
    assert np.array_equal(head.truth, phantom.voxelise(head.a.grid, 4))


def test_the_detector_holds_a_measured_volume(variant_rgb: str, tmp_path: Path) -> None:
    """Voxels of 1 x 2 x 3 of a file of 9 x 8 x 6: odd ends are left out, the grid has twice the spacing. Seen from twice the
    radius, magnified by 3/2, with 1/5 to spare, in pixels that are 3/2 of the least spacing at the object's magnification."""
    values = np.random.default_rng(0).uniform(0, 4, (6, 9, 8)).astype(np.float32)
    write_volume(tmp_path / "a.nrrd", values, np.diag([8.0, 18.0, 18.0, 1.0]))
    scan = study.make_volume_scan(tmp_path / "a.nrrd", 5)
    grid, beam = scan.a.grid, scan.a.geometry
    assert (grid.shape, grid.voxel_size) == ((3, 4, 4), (2, 4, 6))
    radius = np.linalg.norm([8.0, 16.0, 18.0]) / 2
    assert grid.radius == pytest.approx(radius)
    assert (beam.source_to_axis, beam.source_to_detector) == pytest.approx((4 * radius, 6 * radius))
    assert beam.angles == pytest.approx(np.arange(5) * 2 * np.pi / 5)
    assert beam.shape[1:] == (int(np.ceil(1.8 * 18 / 3)), int(np.ceil(1.8 * np.hypot(8, 16) / 3)))
    assert beam.pitch == (3, 3)
    fine = Projector(beam, VoxelGrid((6, 8, 8), (1.0, 2.0, 3.0))) @ (values[:, :8] / values.max())
    assert np.array_equal(scan.y, fine)


def test_the_result_of_the_solvers(
    variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A head of 8^3 from 20 views and a volume, for one iteration of one method: JSON and both figures."""
    every = study.solver_problems
    monkeypatch.setattr(study, "solver_problems", lambda a, y: dict(list(every(a, y).items())[:1]))
    write_volume(tmp_path / "a.nrrd", np.ones((4, 4, 4), np.float32), np.diag([4.0, 4.0, 4.0, 1.0]))
    work = ["--size", "8", "--views", "20", "--iterations", "1", "--variant", variant_rgb, "--out", str(tmp_path)]
    assert study.STUDY.run([*work, "--volume", str(tmp_path / "a.nrrd")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads((tmp_path / "bench_tomography.json").read_text())
    solvers = result["solvers"]
    assert (solvers["grid"], solvers["projections"]) == ([8, 8, 8], [20, 8, 8])
    assert set(solvers["curves"]) == set(solvers["nrmse"]) == set(solvers["volume"]["nrmse"]) == {"CG"}
    assert (solvers["object"], solvers["volume"]["object"]) == ("Shepp-Logan (yu-ye-wang)", "a.nrrd")
    for name in ("bench_tomography.png", "volume.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert study.STUDY.run([*work, "--volume", str(tmp_path / "absent.nrrd")]) == 1
    assert "absent.nrrd" in capsys.readouterr().err


def test_tables_of_slices() -> None:
    """Least errors and ratios of times for slices, the gain of each part for the default solver."""
    curves = {"few": {"mivol fbp": {"errors": [0.5], "seconds": [1.0]}, "astra FBP": {"errors": [0.5], "seconds": [2.0]}}}
    assert study.table("peers", curves)[2:] == [
        "| mivol fbp | 0.5000 (1, 1.00 s) |", "| astra FBP | 0.5000 (1, 2.00 s) |", "",
        "| time at equal error | few |", "|---|---|", "| mivol fbp / astra FBP | 0.50 (0.5000) |",
    ]  # fmt: skip
    assert study.table("parts", {"few": {"a": 0.25}})[2:] == ["| a | 0.250 |"]
    assert study.table("solvers", {}) == []


def test_products_of_a_volume(variant_rgb: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The calls are the two products of each beam, and times become rays per second."""
    shapes = []

    def shortest_time(call: Callable[[], np.ndarray]) -> float:
        shapes.append(np.shape(call()))
        return 0.25 * len(shapes)

    monkeypatch.setattr(study, "shortest_time", shortest_time)
    monkeypatch.setattr(study.importlib.util, "find_spec", lambda name: None)
    answer = study.measure_volume(None, 8, 3)
    assert shapes == 2 * [(3, 8, 8), (8, 8, 8)]
    assert list(answer) == ["cone", "parallel"]
    assert answer["cone"]["seconds_A"] == 0.25 and answer["parallel"]["seconds_AT"] == 1.0
    assert answer["parallel"]["rays_per_core_second_A"] == 3 * 8 * 8 / 0.75
    assert 0.05 < answer["cone"]["peak_gib"] < 64
    assert "astra-toolbox is not installed" in capsys.readouterr().err
