"""Slices from TIFF to TIFF: the contestant that is always there, and its table."""

from __future__ import annotations

import pytest

from mivol.bench.studies import scan_size


def test_slices_go_from_tiff_to_tiff(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A head of 48 columns from 48 views is found to half of what an empty volume misses; its skull is a voxel thick."""
    monkeypatch.setattr(scan_size, "PEERS", {})
    answer = scan_size.measure_slices(scan_size.ScanSize(n=48, views=48, slices=3))
    assert set(answer) == {"mivol"} and answer["mivol"]["nrmse"] < 0.5
    assert scan_size.table("slices", answer)[2].startswith("| mivol | ")


@pytest.mark.slow
def test_a_whole_volume_is_stopped_and_resumed(variant_rgb: str) -> None:
    """Sixteen layers fit into the memory: the first of two slabs is written before the stop, the second after it."""
    answer = scan_size.measure_whole(scan_size.ScanSize.quick())
    assert (answer["slabs"], answer["stopped_after"]) == (2, 1)
    assert answer["nrmse"] < 0.5
    assert scan_size.table("whole", answer)[0].startswith("| slabs |")


@pytest.mark.slow
def test_the_default_is_measured_in_its_own_process() -> None:
    """Memory and time are those of the command: more than of a process that does nothing, and a folder with its files."""
    answer = scan_size.measure_default(scan_size.ScanSize.quick())
    assert answer["processor_seconds"] > 0 and 0.1 < answer["peak_gib"] < 1 and 0.01 < answer["folder_mb"] < 40
    assert scan_size.table("default", answer)[0].startswith("| seconds |")
