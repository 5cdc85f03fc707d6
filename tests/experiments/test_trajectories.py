"""Helices, several sources and the experiments of scenes/trajectories."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.experiments.projections import make_geometry
from mivol.tomography.geometry import ConeBeam
from mivol.tomography.panel_views import helix

SCENES = Path(__file__).parents[2] / "scenes/trajectories"
BEAM = ConeBeam(np.radians([0.0, 90.0, 360.0, 720.0]), (3, 5), 4.0, 6.0, 0.5, 0.25, (0.125, 0.0))


def test_a_helix_rises_with_the_angle() -> None:
    """A lift of 2 a turn: over two turns the heights of source and detector are -2, -1.5, 0 and 2; nothing else moves."""
    found, flat = helix(BEAM, 2.0).panels(), BEAM.panels()
    rise = np.array([-2.0, -1.5, 0.0, 2.0])[:, None] * [0, 0, 1]
    np.testing.assert_allclose(found.source, flat.source + rise, atol=1e-12)
    np.testing.assert_allclose(found.corner, flat.corner + rise, atol=1e-12)
    np.testing.assert_array_equal(found.along_u, flat.along_u)


def test_sources_have_all_views_one_after_the_other() -> None:
    """Two sources: views 0 and 1 of the first, 2 and 3 of the second; shifted along the columns and z, the detector rests."""
    found, flat = helix(BEAM, 0.0, [(0.5, 0.0), (-1.0, 2.0)]).panels(), BEAM.panels()
    u = flat.along_u / 0.5
    np.testing.assert_allclose(found.source[:2], flat.source[:2] + 0.5 * u[:2], atol=1e-12)
    np.testing.assert_allclose(found.source[2:], flat.source[2:] - 1.0 * u[2:] + [0, 0, 2], atol=1e-12)
    np.testing.assert_allclose(found.corner, flat.corner, atol=1e-12)
    assert_refused("found 4 views of 3 sources, expected as many views of each source", helix, BEAM, 0.0, [(0, 0)] * 3)


def test_settings_spread_the_views_of_each_source() -> None:
    settings = config.load(SCENES / "sources.toml", ["scan.views=5"])
    beam = make_geometry(settings, SCENES)
    assert beam.shape[0] == 15
    heights = beam.panels().source[:, 2].reshape(3, 5)
    np.testing.assert_allclose(heights, np.repeat([[-0.8], [0.0], [0.8]], 5, axis=1), atol=1e-12)
    np.testing.assert_allclose(*beam.panels().corner.reshape(3, 5, 3)[[0, 2]], atol=1e-12)


def test_an_axis_is_found_on_a_circle_only() -> None:
    text = 'title = "t"\nscan = { beam = "cone", lift = 1, source_to_axis = 2, source_to_detector = 3 }\n'
    data = 'data = { source = "stack", file = "a.npy", reading = "transmission", find_axis = true }\n'
    for changed, found in (("", "find_axis"), ("find_axis = true", "grid")):
        raw = text + (data if not changed else data.replace(", find_axis = true", ""))
        assert_refused(found, config.from_dict, tomllib.loads(raw), "t.toml")


LIMITS = {
    "laminography": 0.18,
    "helix": 0.18,
    "sources": 0.142,
    "missing_wedge": 0.324,
    "half_acquisition": 0.26,
    "region_of_interest": 0.66,
}
"""The errors of scenes/trajectories/README.md and 3 %, for other processors: fits without noise have no random numbers."""


@pytest.mark.slow
@pytest.mark.parametrize("name", LIMITS)
def test_errors_of_the_trajectories(variant_rgb: str, tmp_path: Path, name: str) -> None:
    assert main(["optimize", str(SCENES / f"{name}.toml"), "-o", str(tmp_path / "run")]) == 0
    assert 0.5 * LIMITS[name] < json.loads((tmp_path / "run/run.json").read_text())["results"]["nrmse"] < LIMITS[name]


def test_each_trajectory_has_its_limit() -> None:
    assert {file.stem for file in SCENES.glob("*.toml")} == set(LIMITS)
    assert all(len(file.read_text().splitlines()) <= 10 for file in SCENES.glob("*.toml"))
