"""Where a fit begins: what the file says, or what the scene holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_experiment import FIT, SCENE, TRUTH, files_of, refused, run

from mivol.config import Sought
from mivol.experiments.start import find_unit
from mivol.files import read_volume
from mivol.validate.metrics import nrmse


@pytest.mark.slow
def test_a_colour_is_looked_for_from_a_start_of_its_own(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Each number of what is no grid has its start, and is among the results and curves; steps of 1e-6 leave it there."""
    coloured = '<emitter type="constant" id="sky"><rgb name="radiance" value="0.9, 0.8, 0.7"/></emitter>'
    (folder / "scene.xml").write_text(SCENE.replace('<emitter type="constant"/>', coloured))
    flags = ["optimize", folder / "fit.toml", "-o", folder / "run", "--set", "fit.iterations=1", "--set", "event=[]"]
    (folder / "fit.toml").write_text(FIT.replace(TRUTH, ""))
    sought = 'parameter=[{key="sky.radiance.value", lr=1e-6, start=[0.5, 0.25, 0.125]}]'
    assert run(*flags, "--set", sought) == 0
    results = json.loads((folder / "run" / "run.json").read_text())["results"]
    assert np.allclose([results[f"sky.radiance.value[{i}]"] for i in range(3)], [0.5, 0.25, 0.125], atol=2e-6)
    assert "curves/sky.radiance.value[2].png" in files_of(folder / "run")
    assert "starts from 2 numbers and has 3" in refused(capsys, *flags, "--set", sought.replace(", 0.125", ""))


@pytest.mark.slow
def test_the_fit_does_not_start_at_the_truth(variant_rgb, folder: Path) -> None:
    """Without a start of its own the fit begins where the scene's file says, whatever the references showed: its first
    error is that of 0.25 everywhere, and not 0."""
    text = FIT.replace("start = 0.2\nshape = [3, 3, 3]\n", "").replace("shape = [6, 6, 6]", "shape = [2, 2, 2]")
    (folder / "fit.toml").write_text(text)
    fewer = ["--set", 'reference={source="render", spp=32}', "--set", 'views={rig="ring", count=1, width=4, height=4}']
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *fewer, "--set", "fit.iterations=1") == 0
    truth = read_volume(next((folder / "run" / "volumes").glob("*truth.npz"))).values
    expected = nrmse(np.full(truth.shape, 0.25), truth)
    first = json.loads((folder / "run" / "metrics.jsonl").read_text().splitlines()[0])
    assert np.isclose(first["nrmse"], expected, rtol=1e-5)


ALBEDO = "cube.interior_medium.albedo.value.value"


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("lamp.position", "length"),
        ("smoke.interior_medium.sigma_t.data", "1/length"),
        (ALBEDO, "1"),
        ("cube.interior_medium.phase_function.g", "1"),
        ("sky.radiance.value", "radiance"),
        ("sun.irradiance.value", "radiance sr"),
        ("lamp.intensity.value", "radiance length²"),
        ("wall.bsdf.reflectance.data", "1"),
        ("albedo.position", "length"),
        ("cube.to_world", ""),
    ],
)
def test_a_key_tells_its_unit(key: str, unit: str) -> None:
    """By its last word that has one; what the experiment says goes before."""
    assert find_unit(Sought(key=key)) == unit
    assert find_unit(Sought(key=key, unit="1/m")) == "1/m"


def test_numbers_of_a_fit_are_recorded_with_their_units(variant_rgb, folder: Path) -> None:
    """On record for the page, and in the titles of the curves."""
    (folder / "fit.toml").write_text(FIT.replace(TRUTH, ""))
    fewer = ["--set", 'reference={source="render", spp=32}', "--set", 'views={rig="ring", count=1, width=4, height=4}']
    sought = f'parameter=[{{key="{ALBEDO}", domain=[0, 1], start=0.5}}]'
    flags = [*fewer, "--set", sought, "--set", "fit.iterations=1"]
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *flags) == 0
    record = json.loads((folder / "run" / "run.json").read_text())
    assert record["units"] == {"loss": "radiance²", f"{ALBEDO}[0]": "1"}
    page = (folder / "run" / "report.html").read_text()
    assert f"{ALBEDO}[0] [1]" in page
    assert "Loss [radiance²]" in page
    assert f"curves/{ALBEDO}[0].png" in files_of(folder / "run")
