"""Slices from TIFF to TIFF: the contestant that is always there, and its table."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mivol.bench.studies import scan_size
from mivol.tomography.geometry import ParallelBeam
from mivol.tomography.phantoms import shepp_logan


def test_slices_go_from_tiff_to_tiff(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A head of 48 columns from 48 views is found to half of what an empty volume misses; its skull is a voxel thick."""
    monkeypatch.setattr(scan_size, "PEERS", {})
    answer = scan_size.measure_slices(scan_size.ScanSize(n=48, views=48, slices=3))
    assert set(answer) == {"mivol"} and answer["mivol"]["nrmse"] < 0.5
    assert scan_size.table("slices", answer)[2].startswith("| mivol | ")


def test_tables() -> None:
    slices = {"mivol": {"seconds_a_slice": 0.5}, "astra-toolbox": {"seconds_a_slice": 2.0}}
    assert scan_size.table("slices", slices)[2:] == ["| mivol | 0.500 | 1.00 |", "| astra-toolbox | 2.000 | 4.00 |"]
    whole = scan_size.table("whole", {"slabs": 2, "seconds": 1234.56})
    assert whole == ["| slabs | seconds |", "|---:|---:|", "| 2 | 1235 |"]


@pytest.mark.slow
def test_a_whole_volume_is_stopped_and_resumed(variant_rgb: str) -> None:
    """Sixteen layers fit into the memory: the first of two slabs is written before the stop, the second after it."""
    answer = scan_size.measure_whole(scan_size.ScanSize.quick())
    assert (answer["slabs"], answer["resumed_after"]) == (2, 1)
    assert answer["nrmse"] < 0.5
    assert scan_size.table("whole", answer)[0].startswith("| slabs |")


@pytest.mark.slow
def test_a_whole_volume_in_a_folder_continues(variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed after the first slab, the same command writes the second alone; views stay, and the time is that of both."""
    size = scan_size.ScanSize.quick().changed(folder=str(tmp_path / "whole"))
    watched = scan_size._Watched
    monkeypatch.setattr(scan_size, "_Watched", lambda file: watched(file, 1))
    with pytest.raises(KeyboardInterrupt):
        scan_size.measure_whole(size)
    monkeypatch.undo()
    views = sorted((tmp_path / "whole/views").glob("*.tif"))
    written = [file.stat().st_mtime_ns for file in views]
    first = json.loads((tmp_path / "whole/figures.json").read_text())
    second = scan_size.measure_whole(size)
    assert (second["slabs"], second["resumed_after"]) == (2, 1)
    assert second["nrmse"] < 0.5 and second["seconds"] > first["seconds"] > 0
    assert [file.stat().st_mtime_ns for file in views] == written and len(views) == 32


def test_a_view_at_once_is_that_of_its_rays() -> None:
    """Of a head with a tilted body and a moved detector, to rounding."""
    phantom = shepp_logan("toft-schabel")
    beam = ParallelBeam(np.linspace(0, 3, 5), (7, 12), (0.3, 0.15), axis_offset=0.1, detector_offset=(0.05, 0.0))
    for view in range(5):
        lines = phantom.integrate_lines(*beam.rays([view]), whole_lines=True)[0]
        assert lines.any()
        np.testing.assert_allclose(scan_size.project_view(phantom, beam, view), lines, atol=1e-12)


@pytest.mark.slow
def test_the_default_is_measured_in_its_own_process() -> None:
    """Memory and time are those of the command: more than of a process that does nothing, and a folder with its files."""
    answer = scan_size.measure_default(scan_size.ScanSize.quick())
    assert answer["processor_seconds"] > 0 and 0.1 < answer["peak_gib"] < 1 and 0.01 < answer["folder_mb"] < 40
    assert scan_size.table("default", answer)[0].startswith("| seconds |")
