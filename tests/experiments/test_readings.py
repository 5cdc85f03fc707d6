"""Readings of a scan: detectors whose rows are upside down, which scans tell, and what is said."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from mivol import config
from mivol.config import Measured, Nikon, Stack
from mivol.experiments import projections, readings
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.panel_views import PanelViews
from mivol.tomography.phantoms import shepp_logan

GRID = VoxelGrid((16, 16, 16), 2 / 16)
CIRCLE = ConeBeam(np.arange(24) * np.pi / 12, (24, 24), 6.0, 6.0, 0.12)


def table(rise: float) -> PanelViews:
    """Twice around, rising by so much in all."""
    panels = replace(CIRCLE, angles=np.arange(40) * np.pi / 10, detector=(1, 1)).panels()
    rows = np.hstack([panels.source, panels.corner, panels.along_u, panels.along_v])
    rows[:, [2, 5]] += np.linspace(-rise / 2, rise / 2, 40)[:, None]
    return PanelViews(rows, (24, 24))


def scan_of(geometry: ConeBeam | PanelViews) -> np.ndarray:
    """A head by 1000 quanta a pixel."""
    counts = np.random.default_rng(3).poisson(1000 * np.exp(-2 * shepp_logan().project(geometry)))
    return -np.log(np.maximum(counts, 1) / 1000)


STACK = Stack(file="y.npy", reading="line_integral")
TOLD = {
    "a displaced detector": (
        replace(CIRCLE, detector_offset=(0.25, 0.0)),
        STACK,
        'set data.first_row = "highest", or turn the sign of scan.detector_offset along v',
    ),
    "a helix": (table(1.0), Stack(file="y.npy", reading="line_integral", first_row="highest"), '= "lowest"'),
    "an HDF5 file": (table(1.0), Measured(file="y.h5"), 'set data.first_row = "highest"'),
    "another file": (table(1.0), Nikon(file="y.xtekct"), "turn the sign of the geometry's steps along v"),
}


@pytest.mark.parametrize("case", TOLD)
def test_rows_that_are_upside_down_are_said(variant_rgb, case: str) -> None:
    """Read as they were measured nothing is said; upside down, one sentence with the way out."""
    geometry, wanted, way_out = TOLD[case]
    y = scan_of(geometry)
    weights = np.ones_like(y)
    assert readings.note_rows(wanted, geometry, GRID, y, weights) == []
    (said,) = readings.note_rows(wanted, geometry, GRID, y[:, ::-1], weights)
    assert said.startswith("the detector's rows seem to be upside down: a small reconstruction misses ")
    assert said.endswith(way_out)


@pytest.mark.parametrize("chosen", ["", "rows = [1, 7], "])
@pytest.mark.parametrize("part", [readings.ALL, slice(1, 5, 2), slice(2, 3)])
def test_rows_of_an_hdf5_file_are_counted_upwards(tmp_path: Path, part: slice, chosen: str) -> None:
    """With the highest row first in the file, views, flats and darks are turned, and rows are read alone."""
    frames = np.random.default_rng(1).integers(10, 1000, (9, 8, 5))
    names = {"data": frames[:5], "flats": 2000 + frames[5:7], "darks": frames[7:] // 10}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.update(names)
    data = ", ".join(f'{role} = "{role}"' for role in names)
    text = f'title = "t"\nscan = {{ beam = "parallel" }}\ndata = {{ source = "measured", file = "a.h5", {data}, {chosen}'
    settings = config.from_dict(tomllib.loads(text + 'first_row = "highest" }'))
    found = readings.read_scan(settings, tmp_path, part).intensity
    for role, rows in zip(names, found, strict=True):
        whole = names[role][:, 1:7] if chosen else names[role]
        np.testing.assert_array_equal(rows, whole[:, ::-1][:, part])


def test_a_circle_of_views_cannot_tell(variant_rgb) -> None:
    """The mirrored object explains it as well, to rounding: a table of a circle is looked at, a centred cone need not be."""
    y = scan_of(table(0.0))
    found = [readings.compare_rows(table(0.0), GRID, rows, np.ones_like(y)) for rows in (y, y[:, ::-1])]
    for one in found:
        assert abs(one.excess) < 1
        assert one.as_read == pytest.approx(one.upside_down, rel=1e-4)
    assert found[0].as_read == pytest.approx(found[1].upside_down, rel=1e-4)


@pytest.mark.parametrize(
    ("geometry", "height", "tells"),
    [
        (CIRCLE, 0.0, False),
        (CIRCLE, 0.1, True),
        (replace(CIRCLE, detector_offset=(0.1, 0.0)), 0.0, True),
        (replace(CIRCLE, detector=(1, 24), detector_offset=(0.1, 0.0)), 0.0, False),
        (ParallelBeam(np.arange(4.0), (24, 24), detector_offset=(0.1, 0.0)), 0.1, False),
        (table(0.0), 0.0, True),
    ],
)
def test_which_scans_can_tell(geometry: object, height: float, tells: bool) -> None:
    assert readings.can_tell(geometry, VoxelGrid((4, 4, 4), centre=(0.0, 0.0, height))) is tells


def test_views_and_pixels_are_few() -> None:
    """51 rows make 17 blocks of 3, 50 columns 16 of 3 in their middle; of 70 views 32 are taken, the first and the last too.

    Blocks are means of the pixels that are used, and lie where these lie.
    """
    beam = replace(CIRCLE, angles=np.arange(70) * 0.1, detector=(51, 50), detector_offset=(0.2, 0.1))
    y = np.arange(70.0)[:, None, None] + np.arange(51.0)[:, None] * 100 + np.arange(50.0) * 1e4
    weights = np.ones_like(y)
    weights[0, 0, 1] = weights[-1, 3:6, 1:4] = 0
    small, seen = readings._coarse(beam, y, weights)
    assert small.geometry.shape == small.y.shape == seen.shape == (32, 17, 16)
    assert seen.sum() == seen.size - 1 and seen[-1, 1, 0] == 0
    assert small.y[0, 1, 2] == 400 + 8e4
    assert small.y[0, 0, 0] == pytest.approx((9 * (100 + 2e4) - 1e4) / 8)
    assert small.y[-1, 16, 15] == 69 + 4900 + 47e4
    np.testing.assert_allclose(small.geometry.rays([31])[1][0, 16, 15], beam.rays([69])[1][0, 49, 47], atol=1e-14)


def test_measured_projections_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """And what is found stands with what else is to be said; simulated ones are what they are."""
    read = projections.Projections("geometry", np.ones(3), np.ones(3), notes=("noted",))
    monkeypatch.setattr(projections, "read_measured", lambda chosen, base: read)
    monkeypatch.setattr(projections, "Projector", lambda *asked: None)
    monkeypatch.setattr(projections, "check_hits", lambda projector: None)
    monkeypatch.setattr(projections, "note_rows", lambda *asked: [f"{asked[1]} upside down"])
    chosen = SimpleNamespace(data=STACK, solve=config.SolveSettings("pcg"))
    assert projections.make_data(chosen, Path(), GRID).notes == ("noted", "geometry upside down")
