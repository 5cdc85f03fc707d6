"""``mivol convert --to hash`` and ``--to nerf``: a fit to views of a field or of Gaussians, with its loss, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ball_photos import ball

from mivol.cli import main
from mivol.experiments import field_conversion
from mivol.experiments.field_conversion import convert_to_network
from mivol.fields.field_files import read_field, write_field
from mivol.fields.gaussian_grid import grid_to_gaussians
from mivol.optim.photographs.sampled_problem import PRESETS
from mivol.points import write_gaussians


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"LOOKS": 12, "LOOK_EDGE": 24, "EDGE": 16}.items():
        monkeypatch.setattr(field_conversion, name, value)


@pytest.mark.slow
@pytest.mark.parametrize(("source", "kind"), [("grid.npz", "hash"), ("grid.npz", "nerf"), ("cloud.ply", "hash")])
def test_a_network_shows_its_source(variant_rgb: str, small: None, tmp_path: Path, source: str, kind: str) -> None:
    write_field(tmp_path / "grid.npz", ball())
    write_gaussians(tmp_path / "cloud.ply", grid_to_gaussians(ball(), None))
    plan = replace(PRESETS[kind]["tiny"], steps=150, samples=1 << 12)
    said = convert_to_network(tmp_path / source, tmp_path / "field.npz", kind, variant_rgb, plan)
    assert read_field(tmp_path / "field.npz").kind == kind
    loss = float(said.split("\n")[1].split()[0])
    # Black views have about 12 dB.
    assert loss > 17, said


def test_a_network_is_written_as_a_field(variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_field(tmp_path / "grid.npz", ball())
    assert main(["convert", str(tmp_path / "grid.npz"), str(tmp_path / "a.ply"), "--to", "hash"]) == 1
    assert "--to hash writes an .npz, fitted to views of the source" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "grid.npz"), str(tmp_path / "a.npz"), "--to", "hash", "--resolution", "4"]) == 1
    assert "leave out other flags" in capsys.readouterr().err
    write_field(tmp_path / "radiance.npz", replace(ball(), space="linear"))
    assert main(["convert", str(tmp_path / "radiance.npz"), str(tmp_path / "a.npz"), "--to", "nerf"]) == 1
    assert "has colours of radiance" in capsys.readouterr().err
    assert np.array_equal(sorted(p.name for p in tmp_path.iterdir()), ["grid.npz", "radiance.npz"])
