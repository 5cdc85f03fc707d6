"""The bench of tomography: every method nears the truth, and what the bench says of the operator is so."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.bench.studies import tomography as bench
from mivol.files import write_volume
from mivol.tomography.geometry import VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector


@pytest.fixture(scope="module")
def head(request: pytest.FixtureRequest) -> bench.Scan:
    """Shepp and Logan's head of 16^3 voxels from 24 views."""
    mi.set_variant(request.config.getoption("--variant"))
    return bench.scan_of_head("yu-ye-wang", 16, 24)


@pytest.mark.slow
def test_every_method_nears_the_truth(variant_rgb: str, head: bench.Scan) -> None:
    """The error of each falls below that of 0, which is 1, within four iterations, and its volume has that error."""
    curves, volumes = bench.reconstruct(head, 4)
    assert set(curves) == set(volumes) == set(bench.methods(head.a, head.y))
    for label, curve in curves.items():
        assert len(curve["nrmse"]) == len(curve["seconds"]) == 4
        assert curve["nrmse"][-1] < 0.9
        error = np.linalg.norm(volumes[label] - head.truth) / np.linalg.norm(head.truth)
        assert error == pytest.approx(curve["nrmse"][-1], rel=1e-6)
    table = bench.table(curves)
    assert set(table["CG"]) == {"seconds_per_iteration"}
    assert bench.table({"x": {"nrmse": [0.5] * 12, "seconds": [24.0] * 12}}) == {
        "x": {"5": 0.5, "10": 0.5, "seconds_per_iteration": 2.0}
    }


def test_the_pair_is_adjoint(head: bench.Scan) -> None:
    """Sums of float32 products: |Ax| |y| times a few 2^-24; a transpose of something else is off by much of it."""
    rng = np.random.default_rng(3)
    x, y = (rng.uniform(size=n).astype(np.float32) for n in head.a.shape[::-1])
    assert bench.adjoint_mismatch(head.a, x, y) < 1e-6
    halved = type("Halved", (SimpleNamespace,), {"__matmul__": lambda self, v: (head.a @ v) / 2})(T=head.a.T)
    assert bench.adjoint_mismatch(halved, x, y) > 0.1


def test_costs(head: bench.Scan) -> None:
    found = bench.costs(head)
    assert set(found) == {
        *("seconds_A", "seconds_AT", "rays_per_second_A", "AT_over_A", "adjoint_mismatch", "voxels_own_error"),
    }
    assert found["rays_per_second_A"] == pytest.approx(24 * 16 * 16 / found["seconds_A"])
    assert 0 < found["voxels_own_error"] < 0.3


def test_a_volume_is_projected_at_twice_the_resolution(variant_rgb: str, tmp_path: Path) -> None:
    """The truth is the mean of 2 x 2 x 2 voxels of the file, over its largest value; the detector sees all of it."""
    values = np.random.default_rng(0).uniform(0, 4, (6, 9, 8)).astype(np.float32)
    write_volume(tmp_path / "a.nrrd", values, np.diag([8.0, 9.0, 6.0, 1.0]))
    scan = bench.scan_of_volume(tmp_path / "a.nrrd", 5)
    assert (scan.name, scan.truth.shape) == ("a.nrrd", (3, 4, 4))
    assert scan.truth[1, 2, 3] == pytest.approx(values[2:4, 4:6, 6:8].mean() / values.max(), rel=1e-6)
    assert scan.y.size == scan.a.shape[0]
    assert scan.y.max() > 1


@pytest.mark.slow
def test_main_writes_what_it_prints(
    variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file has the curves besides; a phantom at 8^3 from 20 views for one iteration of one method."""
    every = bench.methods
    monkeypatch.setattr(bench, "methods", lambda a, y: dict(list(every(a, y).items())[:1]))
    asked = ["--size", "8", "--views", "20", "--iterations", "1", "--out", str(tmp_path), "--variant", variant_rgb]
    assert bench.main(asked) == 0
    printed = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "tomography.json").read_text())
    assert {name: value for name, value in written.items() if name != "curves"} == printed
    assert (printed["grid"], printed["projections"]) == ([8, 8, 8], [20, 8, 8])
    assert set(written["curves"]["Shepp-Logan (yu-ye-wang)"]) == set(printed["nrmse"])
    assert (tmp_path / "tomography.png").read_bytes().startswith(b"\x89PNG")
    assert bench.main([*asked, "--volume", str(tmp_path / "absent.nrrd")]) == 1
    assert "absent.nrrd" in capsys.readouterr().err


def test_sizes_that_are_not_given() -> None:
    """Those of the published table."""
    assert vars(bench.parse([])) == {
        "quick": False, "size": 128, "views": 100, "iterations": 20, "phantom": "yu-ye-wang", "volume": None, "beside": None,
        "only": None, "variant": "llvm_ad_rgb", "out": Path("runs/bench_tomography"),
    }  # fmt: skip


def test_methods_are_those_of_the_table(head: bench.Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Subsets of 20 views, one at least; a prior in the unit of the geometry where the label says so."""
    asked = []
    monkeypatch.setattr(bench, "LeastSquares", lambda a, y, nonnegative=False, prior=None: (a, y, nonnegative, prior))
    monkeypatch.setattr(bench, "SmoothedTV", lambda *given, **named: asked.append((given, named)) or "TV")
    for views, subsets in ((24, 1), (100, 5), (10, 1)):
        a = SimpleNamespace(n_views=views, grid=head.a.grid)
        plain, bounded = (a, "y", False, None), (a, "y", True, None)
        assert bench.methods(a, "y") == {
            "CG": ("cgls", plain, {}),
            "CG, x >= 0": ("pcg", bounded, {}),
            "CG, x >= 0, TV": ("pcg", (a, "y", True, "TV"), {}),
            "OS-SART, x >= 0": ("os-sart", bounded, {"n_subsets": subsets}),
            "SIRT, x >= 0": ("sirt", bounded, {}),
        }
    assert asked[0] == ((head.a.grid.shape,), {"strength": 3.0, "delta": 3e-3, "voxel_size": head.a.grid.voxel_size})


def test_the_scan_of_the_head(head: bench.Scan) -> None:
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
    scan = bench.scan_of_volume(tmp_path / "a.nrrd", 5)
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


def test_the_fastest_call_counts() -> None:
    """Three calls, of 5, 2 and 4 seconds."""
    clock = iter([0.0, 5.0, 10.0, 12.0, 20.0, 24.0])
    calls = []
    assert bench.fastest(lambda: calls.append(0), lambda: next(clock)) == 2
    assert len(calls) == 3


def test_costs_are_of_normal_numbers(head: bench.Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the seed 0; ratios of the times, and the distance of the voxels' own projections from the chords."""
    monkeypatch.setattr(bench, "fastest", lambda call, now: {head.a.shape[0]: 0.5, head.a.shape[1]: 2.0}[np.size(call())])
    seen = []
    monkeypatch.setattr(bench, "adjoint_mismatch", lambda a, x, y: seen.append((x, y)) or 0.25)
    found = bench.costs(head)
    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=n).astype(np.float32) for n in (head.a.shape[1], head.a.shape[0]))
    assert np.array_equal(seen[0][0], x) and np.array_equal(seen[0][1], y)
    own = np.linalg.norm(head.a @ head.truth - head.y) / np.linalg.norm(head.y)
    assert found == {
        "seconds_A": 0.5, "seconds_AT": 2.0, "rays_per_second_A": head.a.shape[0] / 0.5, "AT_over_A": 4.0,
        "adjoint_mismatch": 0.25, "voxels_own_error": pytest.approx(own),
    }  # fmt: skip


def test_a_report_of_the_head_and_of_a_volume(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What is asked for is measured, drawn and said of both; without a volume of the head only."""
    scans = {name: SimpleNamespace(name=name, truth=np.zeros((2, 3, 4))) for name in ("head", "volume")}
    drawn = []
    monkeypatch.setattr(bench, "scan_of_head", lambda *asked: scans["head"] if asked == ("kak-slaney", 9, 7) else None)
    monkeypatch.setattr(bench, "scan_of_volume", lambda *asked: scans["volume"] if asked == (Path("a.nrrd"), 7) else None)
    monkeypatch.setattr(bench, "costs", lambda scan: {"cost of": scan.name})
    curves = {name: {"x": {"nrmse": [k], "seconds": [1.0]}} for k, name in enumerate(scans)}
    monkeypatch.setattr(bench, "reconstruct", lambda scan, iterations: (curves[scan.name], f"{iterations} of {scan.name}"))
    monkeypatch.setattr(bench, "draw", lambda scan, curves, volumes, path: drawn.append((scan.name, volumes, path.name)))
    monkeypatch.setattr(bench, "table", lambda curves: curves["x"]["nrmse"])
    asked = ["--size", "9", "--views", "7", "--iterations", "3", "--phantom", "kak-slaney", "--out", str(tmp_path)]
    report, found = bench.measure(bench.parse(asked))
    assert found == {"head": curves["head"]} and drawn == [("head", "3 of head", "tomography.png")]
    assert report.pop("machine")["variant"] == "llvm_ad_rgb" and set(report.pop("versions")) == {"mivol", "mitsuba", "drjit"}
    expected = {
        "question": "nRMSE against the truth after 5, 10, 20 iterations, projections by ellipsoid chords",
        "grid": [9, 9, 9], "projections": [7, 9, 9], "published_bar": {"TIGRE tests, 20 iterations": 0.2},
        "nrmse": [0], "cost of": "head",
    }  # fmt: skip
    assert report == expected
    drawn.clear()
    report, found = bench.measure(bench.parse([*asked, "--volume", "a.nrrd"]))
    assert found == curves
    assert drawn == [("head", "3 of head", "tomography.png"), ("volume", "3 of volume", "volume.png")]
    assert report["volume"] == {"object": "volume", "grid": (2, 3, 4), "nrmse": [1]}


def test_slices_beside_other_programs_are_all_that_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, variant_rgb: str
) -> None:
    monkeypatch.setattr(bench, "slices_of_the_head", lambda: "the head")
    monkeypatch.setattr(bench, "slice_of_the_tooth", lambda: "a slice")
    monkeypatch.setattr(bench, "compare", str)
    monkeypatch.setattr(bench, "rows", lambda found: [found, "twice"])
    monkeypatch.setattr(bench, "ratios", lambda found: [f"{found} again"])
    monkeypatch.setattr(bench, "measure", None)
    assert bench.main(["--beside", "--out", str(tmp_path / "a" / "b"), "--variant", variant_rgb]) == 0
    assert capsys.readouterr().out == "the head\ntwice\n\nthe head again\n"
    assert (tmp_path / "a" / "b").is_dir()
    assert bench.main(["--beside", "tooth", "--out", str(tmp_path / "a" / "b"), "--variant", variant_rgb]) == 0
    assert capsys.readouterr().out.startswith("{'tooth': 'a slice'}\n")


def test_a_method_that_ends_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its curve is short; errors are of each state, seconds add up."""
    scan = SimpleNamespace(a=None, y=None, truth=np.ones((1, 2, 2)))
    states = [SimpleNamespace(x=np.full(4, value), iteration=k) for k, value in enumerate((0.0, 0.5), 1)]
    said = []
    monkeypatch.setattr(bench, "methods", lambda a, y: {"short": ("s", "problem", {"n_subsets": 3})})
    solver = SimpleNamespace(run=lambda problem, n_subsets: states if (problem, n_subsets) == ("problem", 3) else None)
    monkeypatch.setattr(bench, "SOLVERS", {"s": solver})
    monkeypatch.setattr(bench, "Stopwatch", FakeWatch)
    monkeypatch.setattr(bench, "say", said.append)
    curves, volumes = bench.reconstruct(scan, 5)
    assert curves == {"short": {"nrmse": [1.0, 0.5], "seconds": [1.0, 2.0]}}
    assert volumes["short"].tolist() == np.full((1, 2, 2), 0.5).tolist()
    assert said == ["short              1  nRMSE 1.0000      1.0 s", "short              2  nRMSE 0.5000      2.0 s"]


class FakeWatch:
    """A watch on which each block takes a second."""

    seconds = 0.0

    def __enter__(self) -> None:
        self.seconds += 1

    def __exit__(self, *_: object) -> None:
        pass
