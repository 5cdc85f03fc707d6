"""Scans without a TOML file: found by content, told from photographs, and the TOML that says the same."""

from __future__ import annotations

import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
from beamline_files import write_named, write_nxtomo
from photo_sets import write_blender
from PIL import Image
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments import found_scan, kinds, readings
from mivol.experiments.found_scan import draft_scan, find_scan
from mivol.files import read_volume
from mivol.scene.explain import Explanation

FLATS = np.full((2, 2, 32), 1000) + np.arange(2)[:, None, None]
DARKS = np.full((2, 2, 32), 100) + np.arange(2)[:, None, None]


def write_tiffs(folder: Path, views: int = 12) -> Path:
    """A block of 10 columns, a little left of the middle at first, over half a turn; flats near 1000, darks near 100."""
    folder.mkdir(parents=True)
    angle = np.pi * np.arange(views) / views
    place = 15.5 - 4 * np.cos(angle)
    light = np.where(abs(np.arange(32) - place[:, None]) < 4 + np.arange(2)[:, None, None], 0.4, 1.0).transpose(1, 0, 2)
    for name, stack in {
        "scan12": 100 + 900 * light,
        "flat": FLATS,
        "dark": DARKS,
    }.items():
        for number, image in enumerate(stack):
            Image.fromarray(image.astype("u2")).save(folder / f"{name}_{number:04d}.tif")
    return folder


def test_settings_of_a_nexus_file(tmp_path: Path) -> None:
    """What is found, assumed and chosen; a change of the command line comes first."""
    path = write_nxtomo(write_nxtomo(tmp_path / "a.nxs"), "entry2")
    draft = draft_scan(path)
    assert draft.raw["scan"] == {"beam": "parallel", "pitch": [0.004, 0.002]}
    assert draft.raw["data"] == {"source": "measured", "file": str(path), "first_row": "highest"} and draft.raw["unit"] == "mm"
    assert "grid" not in draft.raw
    assert draft.lines[:2] == (
        "found: NXtomo, entry entry: 5 views of 2 x 3 pixels, 2 flats, 2 darks",
        "found: the file has 2 scans, entry, entry2: entry is read, data.group names another",
    )
    assert "found: angles from 0 to 144 degrees" in draft.lines
    assert "chosen: a parallel beam, because rays of the cone part by 8.2e-08 pixels within the sample" in draft.lines
    changed = draft_scan(path, ["data.group=entry2", "data.rows=[1, 2]", "title=mine"]).raw
    assert changed["data"]["group"] == "entry2" and changed["data"]["rows"] == [1, 2] and changed["title"] == "mine"


def test_a_source_nearby_makes_a_cone(tmp_path: Path) -> None:
    """3 pixels of 2 um: rays at the edge, 3 um off, part by 9e-6 mm^2 / D within the sample, half a pixel for D = 9e-3 mm."""
    path = write_nxtomo(tmp_path / "a.nxs")
    for source, beam in ((8e-6, "cone"), (10e-6, "parallel")):
        with h5py.File(path, "a") as file:
            del file["entry/instrument/source/distance"], file["entry/instrument/detector/distance"]
            file["entry/instrument/source/distance"], file["entry/instrument/detector/distance"] = -source, 1e-9
        raw = draft_scan(path).raw
        assert raw["scan"]["beam"] == beam


@pytest.mark.parametrize("kind", ["nxtomo", "named", "tiff"])
def test_the_toml_says_the_same(tmp_path: Path, kind: str) -> None:
    names = ["data.data=scan/camera/frames", "data.flats=before/reference", "data.angles=scan/stage", 'title=a "b"']
    if kind == "tiff":
        path, changes = write_tiffs(tmp_path / "scan"), []
    elif kind == "named":
        path, changes = write_named(tmp_path / "a.h5"), names
    else:
        path, changes = write_nxtomo(tmp_path / "a.he5"), []
    draft = draft_scan(path, changes)
    assert tomllib.loads(draft.toml) == draft.raw
    (tmp_path / "fit.toml").write_text(draft.toml)
    assert config.load(tmp_path / "fit.toml") == config.from_dict(draft.raw)


def test_a_folder_of_images(tmp_path: Path) -> None:
    """Flats and darks by words of their names, whatever else lies there; folders of a kind each serve as well."""
    folder = write_tiffs(tmp_path / "hair_flat")
    Image.fromarray(np.zeros((2, 3), "u2")).save(folder / "preview.tif")
    draft = draft_scan(folder)
    assert draft.raw["data"] == {
        **{"source": "stack", "file": f"{folder}/scan*_*.tif", "reading": "intensity", "first_row": "highest"},
        **{"flats": f"{folder}/flat_*.tif", "darks": f"{folder}/dark_*.tif"},
    }
    assert draft.raw["scan"] == {"beam": "parallel", "arc": 180.0} and "held_out_every" not in draft.raw
    assert any("preview.tif: not used" in line for line in draft.lines)
    (folder / "theta.txt").write_text("\n".join(map(str, np.linspace(0, np.pi, 16)[:13])))
    assert any("no file with 12 angles (theta.txt has 13)" in line for line in draft_scan(folder).lines)
    (folder / "table.csv").write_text("view,angle\n0,0.0\n1,0.1\n")
    assert any("(table.csv is not one column of numbers, theta.txt has 13)" in line for line in draft_scan(folder).lines)
    (folder / "theta.txt").write_text("\n".join(map(str, np.linspace(0, np.pi, 16)[:12])))
    assert draft_scan(folder).raw["data"]["angle_unit"] == "degree"
    for name in ("proj", "Flats", "dark_field"):
        (tmp_path / "two" / name).mkdir(parents=True)
        for file in folder.glob(f"{ {'proj': 'scan12'}.get(name, name[:4].lower()) }_*.tif"):
            file.rename(tmp_path / "two" / name / file.name.replace(file.name[:4], "img_"))
    data = draft_scan(tmp_path / "two").raw["data"]
    assert {Path(data[role]).parent.name for role in ("file", "flats", "darks")} == {"proj", "Flats", "dark_field"}


def test_a_gap_in_the_numbers_is_said(tmp_path: Path) -> None:
    """One of twelve: the views are not spread evenly. Numbers in steps of ten, or after a prefix of digits, have no gap."""
    folder = write_tiffs(tmp_path / "a")
    assert not any("no view with the number" in line for line in draft_scan(folder).lines)
    (folder / "scan12_0005.tif").unlink()
    assert any("found: no view with the number 5: if views were lost" in line for line in draft_scan(folder).lines)
    assert found_scan.missing_numbers([Path(f"a_{10 * k}.tif") for k in range(12)]) == []
    assert found_scan.missing_numbers([Path("a.tif")]) == []


@pytest.mark.parametrize(("flats", "darks"), [("refHST_", "darkend"), ("OpenBeam", "camOffset"), ("I0", "DI_")])
def test_words_in_names_begin_with_a_capital(tmp_path: Path, flats: str, darks: str) -> None:
    """``refHST0000_0000.edf`` and ``darkend0000.edf`` are the names of flats and darks at the ESRF."""
    folder = write_tiffs(tmp_path / "scan")
    for file in folder.glob("[fd]*"):
        word = {"flat_": flats, "dark_": darks}[file.name[:5]]
        file.rename(folder / (word + file.name[5:]))
    data = draft_scan(folder).raw["data"]
    assert flats in data["flats"].replace("*", "0") and darks in data["darks"]


def test_names_that_no_pattern_tells_apart(tmp_path: Path) -> None:
    """``a_*.tif`` and ``a_[0-9]*.tif`` find both ``a_1.tif`` and ``a_1x2.tif``."""
    for name in ("a_1.tif", "a_2.tif", "a_1x2.tif"):
        Image.fromarray(np.zeros((2, 3), "u2")).save(tmp_path / name)
    groups = {group.name: group for group in found_scan.group_images(tmp_path)}
    assert_refused("other images between a_1.tif and its like", groups["a_#.tif"].pattern)
    (tmp_path / "a_1x2.tif").rename(tmp_path / "a_x2.tif")
    (group,) = (group for group in found_scan.group_images(tmp_path) if group.name == "a_#.tif")
    assert group.pattern() == f"{tmp_path}/a_[0-9]*.tif"


def test_flats_before_and_after_the_views_count_together(tmp_path: Path) -> None:
    """One pattern finds both; where it would find other images as well, the larger group is taken, and the other is named."""
    folder = write_tiffs(tmp_path / "scan")
    for file in folder.glob("flat_*"):
        file.rename(folder / file.name.replace("flat_", "I0_before_"))
        Image.fromarray(FLATS[0].astype("u2")).save(folder / file.name.replace("flat_", "I0_after_"))
    draft = draft_scan(folder)
    assert draft.raw["data"]["flats"] == f"{folder}/I0_*.tif"
    assert "found: I#_after_#.tif, I#_before_#.tif: 4 flats" in draft.lines
    (folder / "I0_after_0001.tif").rename(folder / "white_0001.tif")
    draft = draft_scan(folder)
    assert draft.raw["data"]["flats"] == f"{folder}/I*_before_*.tif"
    assert any("I#_after_#.tif, white_#.tif: not used" in line for line in draft.lines)


def test_a_scanner_s_file_is_named(tmp_path: Path) -> None:
    """It tells a scan from slices, though nothing is read from it."""
    folder = write_tiffs(tmp_path / "scan")
    (folder / "bone.log").write_text("[Acquisition]\nObject to Source (mm)=67.1\n")
    assert any(line.startswith("found: bone.log: not read; if distances are in it, set") for line in draft_scan(folder).lines)
    for file in folder.glob("[fd]*_*"):
        file.unlink()
    assert found_scan.has_scan_files(folder)
    (folder / "bone.log").unlink()
    assert not found_scan.has_scan_files(folder)


def test_assumptions_that_changes_replace_are_not_told(tmp_path: Path) -> None:
    folder = write_tiffs(tmp_path / "scan")
    names = ("scan.beam", "scan.pitch", "scan.arc", "data.first_row")
    told = [[name for name in names if any(name in line for line in draft_scan(folder, changes).lines)] for changes in (
        [], ["scan.pitch=2", "scan.arc=360"], ["data.first_row=lowest", 'scan={beam="cone", source_to_axis=1}'],
    )]  # fmt: skip
    assert told == [list(names), ["scan.beam", "data.first_row"], ["scan.pitch", "scan.arc"]]


def test_a_file_of_pages_is_a_scan(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Flats and darks beside it count if their images are as large; without them, explain takes it for a volume."""
    tifffile = pytest.importorskip("tifffile")
    images = write_tiffs(tmp_path / "scan")
    views = np.stack([np.asarray(Image.open(file)) for file in sorted(images.glob("scan12_*"))])
    for name, pages in (("views", views), ("flats", FLATS.astype("u2")), ("dark", np.zeros((2, 3, 4), "u2"))):
        tifffile.imwrite(tmp_path / f"{name}.tif", pages, photometric="minisblack")
    data = draft_scan(tmp_path / "views.tif").raw["data"]
    assert data["file"] == str(tmp_path / "views.tif") and data["flats"] == str(tmp_path / "flats.tif") and "darks" not in data
    assert main(["explain", str(tmp_path / "views.tif")]) == 0
    assert "found: flats.tif: 2 flats" in capsys.readouterr().out
    (tmp_path / "flats.tif").unlink()
    assert main(["explain", str(tmp_path / "views.tif")]) == 0
    assert "mivol optimize takes it as a scan" in capsys.readouterr().out


BLOCKS = {"unlike": ((1, 12, 0), (2, 9, 2)), "even at first": ((1, 12, np.pi / 2), (1, 12, -np.pi / 2), (1, 6, np.pi / 2))}


def test_arrays_of_numpy_are_told_the_way_to_a_scan(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    np.save(tmp_path / "views.npy", np.ones((4, 3, 5)))
    np.savez(tmp_path / "scan.npz", views=np.ones((4, 3, 5)), flats=np.ones((2, 3, 5)))
    for verb, name in (("explain", "views.npy"), ("optimize", "views.npy"), ("optimize", "scan.npz")):
        assert main([verb, str(tmp_path / name)]) == (verb == "optimize")
        assert 'data.file of a TOML file with data.source = "stack"' in "".join(capsys.readouterr())


def test_a_single_image_is_a_sinogram(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """For mivol optimize; mivol explain takes it for a slice, and for a sinogram with --set. Values are those of the image."""
    angle = np.pi * np.arange(24)[:, None] / 24
    lines = np.maximum(0, 1 - ((np.arange(48) - 23.5 - 6 * np.cos(angle)) / 12) ** 2).astype(np.float32)
    path = tmp_path / "slice.tif"
    Image.fromarray(lines).save(path)
    draft = draft_scan(path)
    assert draft.raw["scan"] == {"beam": "parallel", "arc": 180.0}
    assert draft.raw["data"] == {"source": "stack", "file": str(path), "images": "sinograms", "reading": "line_integral"}
    settings = config.from_dict(draft.raw)
    assert readings.detector_size(settings, Path()) == (24, 1, 48)
    found = readings.read_stack_scan(settings, Path(), readings.ALL).transmission.value
    np.testing.assert_allclose(found, np.exp(-lines[:, None]), rtol=1e-6)
    assert main(["explain", str(path)]) == 0
    assert "voxels (x, y, z): 48 x 24 x 1" in (said := capsys.readouterr().out) and "mivol optimize takes it as a scan" in said
    with pytest.raises(MivolError, match="sinograms hold corrected values"):
        config.from_dict({**draft.raw, "data": draft.raw["data"] | {"reading": "intensity", "flats": "f.tif"}})


def test_the_arc_of_a_noisy_row_is_guessed() -> None:
    """One row of 800 columns with noise of a tenth, over a whole turn: slopes of single pixels are noise. Without smoothing,
    each of 40 seeds gives 180 degrees; with it, none."""
    rng, angle = np.random.default_rng(2), 2 * np.pi * np.array([0, 60, 119])[:, None] / 120
    blocks = ((1.0, 200, 0.3), (0.5, 150, 2.0))
    views = sum(h * np.exp(-(((np.arange(800) - 420 - r * np.cos(angle + p)) / 40) ** 2)) for h, r, p in blocks)
    assert found_scan.guess_arc((views + 0.1 * rng.normal(size=views.shape))[:, None])[0] == 360.0


@pytest.mark.parametrize(("arc", "blocks"), [(180.0, "unlike"), (360.0, "unlike"), (180.0, "even at first")])
def test_the_arc_is_guessed_by_likeness(arc: float, blocks: str) -> None:
    """Blocks of a density, at a distance from an axis off the middle, 90 views of three rows.

    An object that is its own mirror image at first resembles itself after half a turn; only the middle view tells. No shift by
    whole columns meets the mirror images, so the last view is more like the first than like the mirror image.
    """
    angle = np.radians(arc) * np.array([0, 45, 89])[:, None] / 90
    views = sum(h * np.exp(-(((np.arange(64) - 34.25 - r * np.cos(angle + p)) / 3) ** 2)) for h, r, p in BLOCKS[blocks])
    assert found_scan.guess_arc(np.stack([views] * 3, axis=1))[0] == arc


@pytest.mark.parametrize("files", [1, 5])
def test_the_first_middle_and_last_view_tell_the_arc(tmp_path: Path, files: int) -> None:
    """Of five views, in a file of five pages or in five files."""
    views = [Image.fromarray(np.full((2, 3), k, "u2")) for k in range(5)]
    step = 5 // files
    paths = [tmp_path / f"{k}.tif" for k in range(files)]
    for k, path in enumerate(paths):
        views[k].save(path, save_all=True, append_images=views[k + 1 : k + step])
    assert found_scan._three_views(paths, None, None)[:, 1, 2].tolist() == [0, 2, 4]


def test_images_of_several_sizes_are_refused(tmp_path: Path) -> None:
    """Found by fuzzing: among the views, and between views and flats."""
    paths = [tmp_path / f"{k}.tif" for k in range(3)]
    for path, width in zip(paths, (3, 3, 4), strict=True):
        Image.fromarray(np.ones((2, width), "u2")).save(path)
    assert_refused("views of 2 x 3, 2 x 3, 2 x 4 pixels", found_scan._three_views, paths, None, None)
    with pytest.raises(MivolError, match="views, flats and darks of 2 x 3, 2 x 4, 2 x 4 pixels"):
        found_scan._three_views(paths[:2], np.ones((2, 4)), None)


def test_readings_without_flats(tmp_path: Path) -> None:
    """Air near 1 is a transmission, air near 0 a line integral. Readings of a camera need air, equally bright at both edges."""
    view = np.ones((2, 40))
    view[:, 10:30] = 0.3
    assert found_scan.guess_reading(tmp_path, view)[0] == {"reading": "transmission"}
    assert found_scan.guess_reading(tmp_path, -np.log(view))[0] == {"reading": "line_integral"}
    found, why = found_scan.guess_reading(tmp_path, 1000 * view)
    assert found == {"reading": "transmission", "air": 2} and "1000 and 1000" in why and "(300)" in why
    uneven = 1000 * view * np.linspace(0.7, 1, 40)
    for other in (uneven, 1300 - 1000 * view, np.full((2, 40), 1000.0)):
        assert_refused("no flats, and edges with a median of", found_scan.guess_reading, tmp_path, other)


def test_photographs_are_no_scan(tmp_path: Path) -> None:
    """Cameras decide, even beside TIFF files; neither are other files, and a folder of several scans is asked about."""
    photos = write_blender(tmp_path / "photos")
    Image.fromarray(np.zeros((2, 3), "u2")).save(photos / "a.tif")
    assert find_scan(photos) is None and find_scan(tmp_path / "nothing") is None
    (tmp_path / "notes.txt").write_text("0")
    assert find_scan(tmp_path / "notes.txt") is None
    folder = tmp_path / "scans"
    folder.mkdir()
    path = write_nxtomo(folder / "a.nxs")
    assert find_scan(folder) == find_scan(path) == "hdf5"
    assert draft_scan(folder).raw["data"]["file"] == str(path)
    write_nxtomo(folder / "b.nxs")
    assert_refused(r"2 scans \(a.nxs, b.nxs\), expected one", draft_scan, folder)


def test_a_grid_that_the_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice 320 bytes for each of 8 x 16 x 16 voxels: half of the edge needs an eighth. Rows keep their whole height."""
    scan = {"beam": "parallel", "pitch": 0.5}
    for free, shape, edges in ((2 * 320 * 2048, [8, 16, 16], 0.5), (2 * 320 * 2047, [4, 8, 8], 1.0)):
        monkeypatch.setattr(found_scan, "available_memory", lambda free=free: free)
        assert found_scan._draft_grid(scan, 8, 16)[0] == {"shape": shape, "voxel_size": edges}
    assert found_scan._draft_grid(scan, 9, 17)[0] == {"shape": [5, 9, 9], "voxel_size": [1.0, 1.0, 0.9]}


def test_the_verbs_take_a_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """explain prints the TOML after the facts; optimize says the lines and keeps them for the page."""
    path, contexts = write_nxtomo(tmp_path / "a.nxs"), []
    monkeypatch.setattr(kinds, "run_experiment", lambda context: contexts.append(context) or "page")
    monkeypatch.setattr(kinds, "explain_experiment", lambda *asked: Explanation(("steps",)))
    draft = draft_scan(path)
    assert main(["explain", str(path)]) == main(["optimize", str(path), "--set", "title=a"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith("\n".join([*draft.lines, "steps"])) and said.out.endswith(f"{draft.toml}\npage\n")
    assert contexts[0].notes == draft.lines and all(line in said.err for line in draft.lines)
    assert main(["explain", str(write_named(tmp_path / "b.he5"))]) == 1
    assert "name the datasets: data.data" in capsys.readouterr().err


@pytest.mark.slow
def test_a_folder_becomes_a_volume(tmp_path: Path, variant_rgb) -> None:
    folder = write_tiffs(tmp_path / "scan", views=48)
    assert main(["optimize", str(folder), "--set", "solve.iterations=1", "-o", str(tmp_path / "run")]) == 0
    volume = tmp_path / "run" / "volumes" / "reconstruction.npz"
    assert read_volume(volume).values.shape == (2, 32, 32, 1)
    assert "evenly over 180 degrees" in (tmp_path / "run" / "run.json").read_text()
