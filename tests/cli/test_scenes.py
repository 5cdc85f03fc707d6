"""Every experiment in scenes/ runs, made tiny on the command line, and predicts views that it has not seen."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from mivol.cli import main

SCENES = Path(__file__).resolve().parents[2] / "scenes"
TINY = {
    "demo": [
        *("views.width=16", "views.height=16", "reference.spp=32", "truth.shape=[10,10,10]", "parameter.0.shape=[5,5,5]"),
        *("fit.iterations=3", "event.0.at=[2]"),
    ],
    "shepp_logan": ["solve.iterations=3"],
    "smoke": ["views.width=16", "views.height=16", "reference.spp=32", "fit.iterations=2"],
}


def test_every_scene_is_here():
    """A new scene needs its tiny override."""
    assert sorted(p.parent.name for p in SCENES.glob("*/fit.toml")) == sorted(TINY)
    assert all((SCENES / name / "README.md").is_file() for name in TINY)


@pytest.mark.slow
@pytest.mark.parametrize("name", TINY)
def test_scene_runs(name, tmp_path, request, variant_rgb):
    changes = list(TINY[name])
    if name == "smoke":
        data = request.getfixturevalue("data_dir")
        changes.append(f'truth.file="{data / "volumes_vol" / "tutorials_volume.vol"}"')
    out = tmp_path / "run"
    arguments = ["optimize", str(SCENES / name / "fit.toml"), "-o", str(out)]
    for change in changes:
        arguments += ["--set", change]
    assert main(arguments) == 0
    record = json.loads((out / "run.json").read_text())
    assert (out / "report.html").stat().st_size > 10_000
    # Three steps from nothing: below the error of an empty volume, which is 1 by definition.
    assert record["results"]["nrmse"] < 1
    shutil.rmtree(out)
