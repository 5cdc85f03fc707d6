"""Every number of a fit has the unit that the experiment gives it, or that its key tells."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_experiment import FIT, TRUTH, files_of, run

from mivol.config import Sought
from mivol.experiments.units import unit_of

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
    assert unit_of(Sought(key=key)) == unit
    assert unit_of(Sought(key=key, unit="1/m")) == "1/m"


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
