"""The study of the live view, in small."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mivol.bench.studies import viewer
from mivol.files import read_volume
from mivol.points import read_gaussians
from mivol.view.subjects import open_subject


@pytest.mark.parametrize("name", ["balls.ply", "field.npz", "volume.nrrd"])
def test_pictures_are_drawn_and_timed(variant_rgb: str, name: str) -> None:
    answer = viewer.measure_pictures(name, viewer.ViewerSize.quick())
    assert answer["clock"] > 0 and 48 <= answer["width"] <= 64 and name in viewer.table("", answer)[0]


def test_the_cameras_look_at_what_is_drawn(tmp_path: Path) -> None:
    """They turn about (0.5, 0.5, 0.5), the middle of the Gaussians and of the volume."""
    size = viewer.ViewerSize.quick()
    balls = read_gaussians(viewer.write_subject(tmp_path / "balls.ply", size))
    assert np.abs(balls.means - 0.5).max() <= 0.35 + 1e-6
    volume = read_volume(viewer.write_subject(tmp_path / "volume.nrrd", size))
    np.testing.assert_array_equal(volume.to_world, np.eye(4))


def test_cost_is_a_ratio_of_medians(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit to warm up, then alone and with a viewer in turn: 3 s and 2 s of the clock, 4 s and 5 s of the processor."""
    times = [(9.0, 9.0), *3 * [(2.0, 5.0), (3.0, 4.0)]]
    monkeypatch.setattr(viewer, "run_fit", lambda folder, size: dict(zip(("clock", "processor"), times.pop(0), strict=True)))
    monkeypatch.setattr(viewer, "follow_program", lambda *words, errors: iter(["looking", "7"]))
    answer = viewer.measure_cost(viewer.ViewerSize(fits=3))
    assert (answer["clock"], answer["processor"], answer["pictures"]) == (1.5, 0.8, 21)
    assert "takes 1.500 of the time of one alone, 0.800 of its processor time; 21 pictures" in viewer.table("cost", answer)[0]


def test_a_viewer_looks_until_the_run_ends(cpu_back_end: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """It waits for the run, draws while the record says "running", and prints the number of its pictures."""
    path = viewer.write_subject(tmp_path / "volume.nrrd", viewer.ViewerSize.quick())
    (tmp_path / "run.json").write_text("")
    statuses = ["finished", "running", "running", "running", "finished"]
    monkeypatch.setattr(viewer, "read_record", lambda run: SimpleNamespace(status=statuses.pop(0)))
    monkeypatch.setattr(viewer, "choose_back_end", lambda variant, threads: None)
    monkeypatch.setattr(viewer, "open_subject", lambda run, say: open_subject(path))
    viewer.look_at_run(tmp_path, 32)
    assert capsys.readouterr().out == "2\n"
