"""The bench of tomography: every method nears the truth, and what the bench says of the operator is so."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.bench import tomography as bench
from mivol.files import write_volume


@pytest.fixture(scope="module")
def head(request: pytest.FixtureRequest) -> bench.Scan:
    """Shepp and Logan's head of 16^3 voxels from 24 views."""
    mi.set_variant(request.config.getoption("--variant"))
    return bench.scan_of_head("yu-ye-wang", 16, 24)


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
