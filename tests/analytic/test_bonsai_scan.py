"""The scan of scenes/bonsai: an independent projector, the table of its panels, and how a run is judged."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from mivol.files import write_volume

SCRIPT = Path(__file__).resolve().parents[2] / "scenes" / "bonsai" / "scan.py"
SPREAD, PLACE = 6.0, np.array([5.0, -9.0, 3.0])


@pytest.fixture(scope="module")
def scan() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bonsai_scan", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("turn", [0, 3, 7])
def test_sums_are_the_integrals_of_a_blob(scan: ModuleType, turn: int) -> None:
    """A Gaussian has the integral sqrt(2 pi) s exp(-b^2 / 2 s^2) along a line that passes it at a distance b.

    Sums over the planes are exact to exp(-(pi s)^2), which is nothing; linear interpolation in a plane adds at most h^2 / 8
    (f_uu + f_vv), which is 2 / (8 s^2) of the peak.
    """
    n = 64
    z, y, x = np.ogrid[:n, :n, :n]
    middle = (n - 1) / 2
    r2 = (x - middle - PLACE[0]) ** 2 + (y - middle - PLACE[1]) ** 2 + (z - middle - PLACE[2]) ** 2
    blob = np.exp(-r2 / (2 * SPREAD**2))
    panel, shape = scan.panels(n, 11, 20)[turn], (12, 20)
    ray = panel.pixels(shape) - panel.source
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    off = PLACE - panel.source
    b2 = off @ off - (ray @ off) ** 2
    exact = np.sqrt(2 * np.pi) * SPREAD * np.exp(-b2 / (2 * SPREAD**2))
    found = scan.joseph(blob, panel, shape)
    assert exact.max() > 14
    assert np.abs(found - exact).max() < exact.max() / (4 * SPREAD**2)


def test_the_shadow_of_the_cylinder_falls_on_the_detector(scan: ModuleType) -> None:
    """Tangents to the cylinder end inside of the outermost columns, on either side, though the detector is off the middle."""
    edge, columns = 64, 40
    panel = scan.panels(edge, 5, columns)[2]
    ends = panel.pixels((1, columns))[0, [0, -1]] - panel.source
    ends /= np.linalg.norm(ends, axis=-1, keepdims=True)
    distances = [np.linalg.norm(np.cross(panel.source, end)) for end in ends]
    # 1.02 of the shadow's half, less half a column at the edge and 1.5 off the middle.
    assert min(distances) > edge / 2 * (1.02 - 4 / columns - 0.01)
    assert max(distances) < edge / 2 * (1.02 + 4 / columns)


def test_readings_become_a_table_and_a_stack(scan: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Flats are the light and the dark level, darks the dark level, a shadow lies between; a line of the table is a panel."""
    write_volume(tmp_path / "object.npz", np.ones((64, 64, 64, 1), np.float32))
    small = ["--views", "3", "--columns", "8", "--object", str(tmp_path / "object.npz")]
    monkeypatch.setattr(sys, "argv", ["scan.py", *small, "-o", str(tmp_path)])
    scan.main()
    readings, flats, darks = (np.load(tmp_path / f"{name}.npy") for name in ("readings", "flats", "darks"))
    # Means of 10 x 8 x rows readings: noise of sqrt(3e4) and 2 a reading, over sqrt(640) at least; six standard errors.
    assert abs(flats.mean() - 3.01e4) < 6 * np.sqrt(3e4) / np.sqrt(640)
    assert abs(darks.mean() - 100) < 6 * 2 / np.sqrt(640)
    # A cylinder as high as it is wide, of an optical depth of 9 across: no light to speak of within, all of it beside.
    assert readings.min() < 150 and readings.max() > 0.9 * flats.mean()
    table = np.loadtxt(tmp_path / "panels.txt")
    assert table.shape == (3, 12)
    assert np.allclose(table[1], np.concatenate(scan.panels(64, 3, 8)[1]), rtol=1e-12, atol=1e-9)


def test_a_run_is_judged_by_its_volume(scan: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A volume that is a tenth too large errs by 0.1."""
    truth = np.random.default_rng(0).random((4, 4, 4, 1)).astype(np.float32)
    (tmp_path / "volumes").mkdir()
    write_volume(tmp_path / "truth.npz", truth)
    write_volume(tmp_path / "volumes" / "reconstruction.npz", np.float32(1.1) * truth)
    scan.judge(tmp_path, tmp_path)
    assert capsys.readouterr().out == "nRMSE 0.1000\n"


def test_a_slice_is_halved_in_its_mean(scan: ModuleType) -> None:
    values = np.arange(64.0).reshape(4, 4, 4)
    # The mean of corners 0, 1, 4, 5, 16, 17, 20, 21.
    assert scan.halved(values)[0, 0, 0] == 10.5
    assert scan.halved(values).mean() == values.mean()
