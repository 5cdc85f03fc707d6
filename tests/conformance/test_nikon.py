"""Scans of Nikon laboratory CT: what a file set means, in the laboratory and on disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.experiments import projections, readings
from mivol.files import read_volume
from mivol.files.nikon import read_nikon, read_nikon_angles, read_nikon_transmission
from mivol.tomography.geometry import ConeBeam, VoxelGrid
from mivol.tomography.panel_views import geometry_from_nikon
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector

VIEWS, ROWS, COLUMNS, WHITE = 16, 10, 12, 60000.0
SETTINGS = {
    **{"Name": "bead", "InputSeparator": "_", "SrcToObject": 20, "SrcToDetector": 50, "DetectorPixelsX": COLUMNS},
    **{"DetectorPixelsY": ROWS, "DetectorPixelSizeX": 0.5, "DetectorPixelSizeY": 0.6, "WhiteLevel": WHITE},
    **{"Projections": VIEWS, "InitialAngle": 180, "AngularStep": 22.5, "VoxelsX": 9, "VoxelsY": 8, "VoxelsZ": 7},
    **{"VoxelSizeX": 0.21, "VoxelSizeY": 0.22, "VoxelSizeZ": 0.23},
}
TOML = 'title = "nikon"\nthreads = 1\nscan = { beam = "data" }\ndata = { source = "nikon", file = "bead.xtekct" }\n'
EQUAL = """title = "the same as a cone"
threads = 1
[scan]
beam = "cone"
arc = 360
source_to_axis = 20
source_to_detector = 50
pitch = [0.6, 0.5]
axis_offset = -0.1
[data]
source = "stack"
file = "turned.npy"
reading = "transmission"
find_axis = false
[grid]
shape = [7, 8, 9]
voxel_size = [0.21, 0.22, 0.23]
[solve]
iterations = 4
"""


def write_scan(folder: Path, counts: np.ndarray, **changes: object) -> Path:
    """The files of a scan; ``counts`` as they are stored, (views, rows, cols)."""
    for number, image in enumerate(counts, 1):
        Image.fromarray(image.astype(np.uint16)).save(folder / f"bead_{number:04d}.tif")
    lines = [f"{key}={value}" for key, value in (SETTINGS | changes).items() if value is not None]
    path = folder / "bead.xtekct"
    path.write_text("\n".join(["[XTekCT]", *lines, "[Xrays]", "XraykV=120", ""]))
    return path


def blank() -> np.ndarray:
    return np.full((VIEWS, ROWS, COLUMNS), WHITE)


@pytest.mark.parametrize(("tilt", "roll"), [(0.0, 0.0), (3.0, 0.0), (0.0, 5.0)])
def test_a_bead_is_projected_as_in_the_laboratory(tmp_path: Path, tilt: float, roll: float) -> None:
    """A bead on a stage that turns clockwise, imaged through the source on to a panel that is read from its top right corner.

    Written from the laboratory's side: the light runs along +y from the origin, z is up, the axis at -ObjectOffsetX. The ray
    through the pixel where the bead is seen must go through the bead in the frame of the volume; only float64 rounds.
    """
    scan = read_nikon(write_scan(tmp_path, blank(), ObjectOffsetX=0.3, ObjectTilt=tilt, ObjectRoll=roll))
    geometry = geometry_from_nikon(scan, scan.angles)
    bead = np.array([0.7, -0.4, 0.5])
    t, r = np.radians([-tilt, roll])
    axis = np.array([np.sin(r), -np.sin(t) * np.cos(r), np.cos(t) * np.cos(r)])
    panels = geometry.panels()
    # The stage at rest: z of the volume along the axis; a roll turns about y, a tilt about x, and the least turn is that.
    c, s = np.cos(r), np.sin(r)
    stand = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) if roll else np.array(
        [[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]]
    )  # fmt: skip
    np.testing.assert_allclose(stand @ [0, 0, 1], axis, atol=1e-15)
    for view, turned in enumerate(np.radians(180 + 22.5 * np.arange(VIEWS) - 180)):
        clockwise = np.array([[np.cos(turned), np.sin(turned), 0], [-np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
        x, y, z = stand @ clockwise @ bead + [-0.3, 20, 0]
        column = (COLUMNS - 1) / 2 - 50 * x / y / 0.5  # the first column is on the right, as the source sees it
        row = (ROWS - 1) / 2 - 50 * z / y / 0.6
        pixel = panels.corner[view] + (COLUMNS - 1 - column) * panels.along_u[view] + (ROWS - 1 - row) * panels.along_v[view]
        towards = np.cross(pixel - panels.source[view], bead - panels.source[view])
        assert np.abs(towards).max() < 1e-12 * 50 * 20


def test_images_are_flipped(tmp_path: Path) -> None:
    """A unique reading in each pixel: the first row and column of the file are the last of the detector. The saturation itself
    is saturated."""
    counts = 1000.0 + np.arange(VIEWS * ROWS * COLUMNS).reshape(VIEWS, ROWS, COLUMNS)
    scan = read_nikon(write_scan(tmp_path, counts))
    found = read_nikon_transmission(scan)
    np.testing.assert_array_equal(np.isnan(read_nikon_transmission(scan, 1500.0)), counts[:, ::-1, ::-1] >= 1500)
    for row in range(ROWS):
        for column in range(COLUMNS):
            stored = counts[:, ROWS - 1 - row, COLUMNS - 1 - column]
            np.testing.assert_array_equal(found[:, row, column], stored.astype("f") / np.float32(WHITE))


@pytest.mark.slow
@pytest.mark.usefixtures("plain_figures")
def test_a_scan_equals_the_same_cone_beam(variant_rgb, tmp_path: Path) -> None:
    """The same readings as a stack, flipped by hand, in a cone beam with settings in TOML give the same volume.

    Its line integrals equal the scanned volume's to 16 bits: half a count of at least 0.4 of the white level is 0.5 / 24000.
    """
    beam = ConeBeam(np.arange(VIEWS) * 2 * np.pi / VIEWS, (ROWS, COLUMNS), 20.0, 50.0, (0.6, 0.5), axis_offset=-0.1)
    grid = VoxelGrid((7, 8, 9), (0.21, 0.22, 0.23))
    exact = Projector(beam, grid) @ np.random.default_rng(0).uniform(0, 0.4, grid.shape).astype("f")
    counts = np.round(WHITE * np.exp(-exact))
    assert counts.min() > 0.4 * WHITE
    write_scan(tmp_path, counts[:, ::-1, ::-1], ObjectOffsetX=0.1)
    np.save(tmp_path / "turned.npy", counts.astype("f") / np.float32(WHITE))
    (tmp_path / "nikon.toml").write_text(TOML + "solve = { iterations = 4 }\n")
    (tmp_path / "equal.toml").write_text(EQUAL)
    chosen = config.load(tmp_path / "nikon.toml")
    assert projections.make_voxel_grid(chosen, tmp_path) == grid
    data = projections.make_data(chosen, tmp_path, grid)
    assert np.abs(data.y - exact).max() < 0.5 / 24000 + 1e-6
    for name in ("nikon", "equal"):
        assert main(["optimize", str(tmp_path / f"{name}.toml"), "-o", str(tmp_path / name)]) == 0
    found, expected = (read_volume(tmp_path / name / "volumes/reconstruction.npz").values for name in ("nikon", "equal"))
    assert expected.max() > 0.2
    # Angles pass through degrees here and there: rays differ by the rounding of float64, voxels by that of float32.
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_older_files_give_the_axis_on_the_detector(tmp_path: Path) -> None:
    scan = read_nikon(write_scan(tmp_path, blank(), CentreOfRotationTop=0.5, CentreOfRotationBottom=0.5))
    assert scan.axis_offset == -0.5 * 20 / 50
    assert scan.roll == 0
    rolled = read_nikon(write_scan(tmp_path, blank(), CentreOfRotationTop=0.6, CentreOfRotationBottom=0.0))
    assert np.isclose(rolled.roll, -np.degrees(np.arctan2(0.6, 6.0)))


LISTS = {
    "_ctdata.txt": "Projs\tFrames\tExposure(ms)\n16\t1\t500\nProjection\tAngle(deg)\tTime(s)\n{}",
    "bead.ang": "Proj\tAngle(deg)\n{}",
}


@pytest.mark.parametrize("name", LISTS)
def test_angles_are_read_from_a_list(variant_rgb, tmp_path: Path, name: str) -> None:
    angles = 180 + 22.5 * np.arange(VIEWS) + np.linspace(0, 5, VIEWS)
    separator = ":\t" if name.endswith(".ang") else "\t"
    rows = [f"{number}{separator}{angle}\t0.5" for number, angle in enumerate(angles, 1)]
    write_scan(tmp_path, blank() // 2, DetectorOffsetX=2)
    (tmp_path / name).write_text(LISTS[name].format("\n".join(rows[::-1])))
    (tmp_path / "fit.toml").write_text(TOML)
    chosen = config.load(tmp_path / "fit.toml", [f'data.angles="{name}"'])
    data = projections.make_data(chosen, tmp_path, projections.make_voxel_grid(chosen, tmp_path))
    np.testing.assert_allclose(data.geometry.angles, np.radians(angles - 180), atol=1e-14)
    assert data.notes[0] == "ignored settings: DetectorOffsetX = 2"
    # An even image has no axis.
    assert "the rotation axis is where the scan file has it, 0: found no structure" in data.notes[1]


def test_an_axis_that_the_settings_leave_at_0_is_found(tmp_path: Path) -> None:
    """Computed readings of a head 0.5 mm beside the axis's place in the file; some rows give the same axis as all of them."""
    beam = ConeBeam(np.arange(90) * np.pi / 45, (6, 48), 20.0, 50.0, (0.6, 0.5), axis_offset=0.5)
    counts = np.round(WHITE * np.exp(-0.2 * shepp_logan(half_width=4.0).project(beam)))
    changes = {"DetectorPixelsX": 48, "DetectorPixelsY": 6, "Projections": 90, "AngularStep": 4}
    write_scan(tmp_path, counts[:, ::-1, ::-1], **changes)
    (tmp_path / "fit.toml").write_text(TOML)
    chosen = config.load(tmp_path / "fit.toml")
    for rows, height in ((readings.ALL, 6), (slice(1, 5), 4)):
        data = projections.read_measured(chosen, tmp_path, rows)
        assert data.geometry.detector == (height, 48) and "rotation axis at column" in data.notes[0]
        assert abs(data.geometry.axis_offset - 0.5) < 0.2 * 0.5 * 20 / 50  # 0.2 columns
    write_scan(tmp_path, counts[:, ::-1, ::-1], ObjectOffsetX=-0.4, **changes)
    data = projections.read_measured(chosen, tmp_path)
    assert data.geometry.axis_offset == 0.4
    assert data.notes == ("the rotation axis is where the scan file has it, 0.4: data.find_axis = true looks for it",)


REFUSED = {
    "no distance": ({"SrcToObject": None}, "SrcToObject = ''"),
    "no number": ({"WhiteLevel": "white"}, "WhiteLevel = 'white'"),
    "a negative pitch": ({"DetectorPixelSizeX": -1}, "DetectorPixelSizeX = -1"),
    "half a pixel": ({"DetectorPixelsX": 11.5}, "DetectorPixelsX = 11.5"),
    "images that are missing": ({"Projections": 17}, "16 images for 17 projections"),
    "images of another scan": ({"Name": "shell"}, "0 images for 16 projections"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_invalid_settings_are_refused(tmp_path: Path, case: str) -> None:
    changes, sentence = REFUSED[case]
    assert_refused(sentence, read_nikon, write_scan(tmp_path, blank(), **changes))


def test_foreign_files_are_refused(variant_rgb, tmp_path: Path) -> None:
    path = write_scan(tmp_path, blank()[:, :-1], VoxelsX=0)
    (tmp_path / "fit.toml").write_text(TOML)
    chosen = config.load(tmp_path / "fit.toml")
    assert_refused("give a table", projections.make_voxel_grid, chosen, tmp_path)
    assert_refused("images of 9 x 12 pixels, expected 10 x 12", projections.make_data, chosen, tmp_path, VoxelGrid((2, 2, 2)))
    (tmp_path / "few.txt").write_text("1 0.0\n2 1.0\n")
    assert_refused("2 angles, expected one line for each of 16 views", read_nikon_angles, tmp_path / "few.txt", VIEWS)
    path.write_text("[Other]\nx=1\n")
    assert_refused("XTekCT", read_nikon, path)
    path.write_text("no settings at all\n")
    assert_refused("XTekCT", read_nikon, path)


@pytest.mark.parametrize("change", ['scan={beam="parallel"}', 'data={source="shepp_logan"}'])
def test_geometry_and_data_belong_together(tmp_path: Path, change: str) -> None:
    (tmp_path / "fit.toml").write_text(TOML)
    assert_refused("go together", config.load, tmp_path / "fit.toml", [change])
