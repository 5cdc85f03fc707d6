"""Products with a volume: what is measured, and what is said."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mivol.bench.studies import tomography, tomography_volume


def test_both_beams_are_measured(monkeypatch: pytest.MonkeyPatch, variant_rgb: str, capsys: pytest.CaptureFixture) -> None:
    """The cone's rays miss nothing of the ball in the grid, the calls are the two products, and times become rays a second."""
    shapes = []

    def least(call: object) -> float:
        shapes.append(np.shape(call()))
        return 0.25 * len(shapes)

    monkeypatch.setattr(tomography_volume, "least_seconds", least)
    monkeypatch.setattr(tomography_volume.importlib.util, "find_spec", lambda name: None)
    found = tomography_volume.measure_volume(8, 3)
    assert shapes == 2 * [(3, 8, 8), (8, 8, 8)]
    assert list(found) == ["cone", "parallel"]
    assert found["cone"]["seconds_A"] == 0.25 and found["parallel"]["seconds_AT"] == 1.0
    assert found["parallel"]["rays_per_core_second_A"] == 3 * 8 * 8 / 0.75
    assert 0.05 < found["cone"]["peak_gib"] < 64
    assert "astra-toolbox is not installed" in capsys.readouterr().err


def test_the_quickest_call_counts_without_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = iter([0.0, 5.0, 5.0, 7.0, 7.0, 10.0])
    monkeypatch.setattr(tomography_volume.time, "process_time", lambda: next(ticks))
    calls = []
    assert tomography_volume.least_seconds(lambda: calls.append(1)) == 2.0
    assert len(calls) == 4


def test_it_is_asked_for_by_name(monkeypatch: pytest.MonkeyPatch, tmp_path, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.setattr(tomography, "measure_volume", lambda: {"cone": {"seconds_A": 1.0}})
    monkeypatch.setattr(tomography.mi, "set_variant", lambda name: None)
    assert tomography.main(["--only", "volume256", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out) == {"cone": {"seconds_A": 1.0}}
