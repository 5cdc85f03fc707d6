"""Zarr, EDF and tilt series in MRC: files of their own libraries, and ours read by them."""

from __future__ import annotations

import json
import warnings
import weakref
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused
from sound_files import his_bytes

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments.found_scan import draft_scan
from mivol.experiments.readings import read_angles
from mivol.files import image_stack, read_volume, write_volume
from mivol.files.image_stack import read_header_angles, read_stack, stack_shape
from mivol.files.mrc import read_tilt_angles
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan

VALUES = np.arange(2 * 3 * 4, dtype=np.float32).reshape(2, 3, 4)
PLACE = VoxelGrid((2, 3, 4), (0.5, 1.0, 2.0), (3.0, 0.0, -1.0)).to_world


def test_ours_is_read_by_tensorstore_and_by_us(tmp_path: Path) -> None:
    store = pytest.importorskip("tensorstore")
    write_volume(tmp_path / "a.zarr", VALUES, PLACE, metadata={"unit": "um"})
    spec = {"driver": "zarr", "kvstore": {"driver": "file", "path": str(tmp_path / "a.zarr/0")}}
    np.testing.assert_array_equal(store.open(spec).result().read().result(), VALUES)
    about = json.loads((tmp_path / "a.zarr/.zattrs").read_text())["multiscales"][0]
    assert about["datasets"][0]["coordinateTransformations"][0]["scale"] == [2.0, 1.0, 0.5]
    assert about["datasets"][0]["coordinateTransformations"][1]["translation"] == [-2.0, -1.0, 2.25]
    found = read_volume(tmp_path / "a.zarr")
    np.testing.assert_array_equal(found.values[..., 0], VALUES)
    np.testing.assert_allclose(found.to_world, PLACE, atol=1e-12)
    assert found.meta["unit"] == "um"
    assert about["name"] == "a"
    assert main(["convert", str(tmp_path / "a.zarr"), str(tmp_path / "b.npz")]) == 0
    assert main(["convert", str(tmp_path / "b.npz"), str(tmp_path / "b.zarr")]) == 0
    assert read_volume(tmp_path / "b.zarr").meta["unit"] == "um"
    colours = np.stack([VALUES, 2 * VALUES], -1)
    write_volume(tmp_path / "a.zarr", colours, PLACE)
    np.testing.assert_array_equal(read_volume(tmp_path / "a.zarr").values, colours)


@pytest.mark.parametrize("driver", ["zarr", "zarr3"])
def test_zarr_of_tensorstore(tmp_path: Path, driver: str) -> None:
    """A plain array; then a group (OME-Zarr 0.5 with axes t, z, y, x and two levels) around the same numbers."""
    store = pytest.importorskip("tensorstore")
    for name, values in (("p", VALUES.astype(np.uint16)), ("g/0", VALUES[None].astype(np.uint16)), ("g/1", VALUES[None, :1])):
        spec = {"driver": driver, "kvstore": {"driver": "file", "path": str(tmp_path / name)}}
        dtype = "uint16" if values.dtype == np.uint16 else "float32"
        store.open(spec, create=True, dtype=getattr(store, dtype), shape=values.shape).result().write(values).result()
    np.testing.assert_array_equal(read_volume(tmp_path / "p").values[..., 0], VALUES)
    levels = [
        {"path": str(k), "coordinateTransformations": [{"type": "scale", "scale": [1, 2 * (k + 1), 3, 4]}]} for k in (0, 1)
    ]
    axes = [{"name": n, "type": "time" if n == "t" else "space"} for n in "tzyx"]
    scales = [{"axes": axes, "datasets": levels}]
    if driver == "zarr3":
        about = {"zarr_format": 3, "node_type": "group", "attributes": {"ome": {"version": "0.5", "multiscales": scales}}}
        (tmp_path / "g/zarr.json").write_text(json.dumps(about))
    else:
        (tmp_path / "g/.zgroup").write_text('{"zarr_format": 2}')
        (tmp_path / "g/.zattrs").write_text(json.dumps({"multiscales": scales}))
    found = read_volume(tmp_path / "g")
    np.testing.assert_array_equal(found.values[..., 0], VALUES)
    np.testing.assert_allclose(found.spacing, (4, 3, 2))
    assert read_volume(tmp_path / "g", "1").values.shape == (1, 3, 4, 1)
    assert main(["explain", str(tmp_path / "g")]) == 0
    assert main(["convert", str(tmp_path / "g"), str(tmp_path / "g.nrrd")]) == 0


def test_zarr_says_what_is_missing(tmp_path: Path) -> None:
    """A chunk without a file, a damaged one, and metadata that are no JSON."""
    pytest.importorskip("tensorstore")
    write_volume(tmp_path / "a.zarr", VALUES)
    chunk = tmp_path / "a.zarr/0/0/0/0"
    chunk.write_bytes(chunk.read_bytes()[:20])
    assert_refused("a damaged chunk", read_volume, tmp_path / "a.zarr")
    chunk.unlink()
    assert "1 of 1 chunks have no file" in read_volume(tmp_path / "a.zarr").meta["notes"][0]
    (tmp_path / "a.zarr/.zattrs").write_text("{")
    assert_refused("damaged JSON", read_volume, tmp_path / "a.zarr")
    with pytest.raises(MivolError, match="turned axes for Zarr"):
        write_volume(tmp_path / "b.zarr", VALUES, np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))


def test_frames_of_edf(tmp_path: Path) -> None:
    """EDF written by fabio, a file a view."""
    edf = pytest.importorskip("fabio.edfimage")
    for k, image in enumerate(VALUES):
        edf.EdfImage(data=image, header={"k": str(k)}).write(str(tmp_path / f"a_{k}.edf"))
    np.testing.assert_array_equal(read_stack(tmp_path / "a_*.edf"), VALUES)
    np.testing.assert_array_equal(read_stack(tmp_path / "a_*.edf", rows=slice(1, 3)), VALUES[:, 1:3])
    assert stack_shape(tmp_path / "a_*.edf") == (2, 3, 4)
    (tmp_path / "a_0.edf").write_bytes((tmp_path / "a_0.edf").read_bytes()[:100])
    assert_refused(r"a_0\.edf: found a damaged or foreign file", read_stack, tmp_path / "a_*.edf")


def test_a_sequence_of_a_hamamatsu_camera(tmp_path: Path) -> None:
    """All frames, each after its own header and comment; fabio reads the first one, with the same values."""
    frames = np.arange(84).reshape(2, 6, 7)
    path = tmp_path / "a.his"
    path.write_bytes(his_bytes(frames))
    np.testing.assert_array_equal(read_stack(path), frames)
    assert stack_shape(path) == (2, 6, 7)
    first = pytest.importorskip("fabio").open(str(path)).data
    np.testing.assert_array_equal(first, frames[0])
    whole = path.read_bytes()
    for damaged, said in (
        (whole[:-1], "which end in frame 1"),
        (whole + b"IM", "no frame at byte"),
        (whole[:12] + b"\x09" + whole[13:], "pixels of type 9 in frame 0"),
        (whole + his_bytes(frames[:1, :3]), "frames of 2 sizes"),
    ):
        path.write_bytes(damaged)
        assert_refused(said, read_stack, path)


def write_series(folder: Path) -> np.ndarray:
    """A tilt series of a head: 41 transmissions over 120 degrees in MRC, by mrcfile; returns the angles."""
    mrcfile = pytest.importorskip("mrcfile")
    angles = np.linspace(-60, 60, 41)
    beam = ParallelBeam(np.radians(angles), (12, 32), 0.07)
    with mrcfile.new(folder / "series.mrc") as file:
        file.set_data(np.exp(-shepp_logan().project(beam)).astype(np.float32))
        file.voxel_size = 7.0
    return angles


@pytest.mark.parametrize("suffix", [".rawtlt", ".tlt", ".mdoc", ".mrc.mdoc"])
def test_a_tilt_series_needs_no_toml(tmp_path: Path, capsys, suffix: str) -> None:
    angles = write_series(tmp_path)
    lines = "\n".join(f"{a:.3f}" for a in angles)
    if suffix.endswith("mdoc"):
        lines = "PixelSpacing = 7\n" + "".join(
            f"\n[ZValue = {k}]\nTiltAngle = {a:.3f}\nStage = 1 2\n" for k, a in enumerate(angles)
        )
    (tmp_path / f"series{suffix}").write_text(lines)
    assert main(["explain", str(tmp_path / "series.mrc")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "a tilt series in MRC: 41 views of 12 x 32 pixels" in said and "angles from -60 to 60 degrees" in said
    assert "pixels of 7 x 7 angstrom" in said and 'reading = "transmission"' in said
    (tmp_path / f"series{suffix}").write_text(lines.rpartition("\n[ZValue" if suffix.endswith("mdoc") else "\n")[0])
    assert main(["explain", str(tmp_path / "series.mrc")]) != 0
    assert "found 40 angles, expected 41" in " ".join("".join(capsys.readouterr()).split())


@pytest.mark.usefixtures("plain_figures")
def test_a_tilt_series_becomes_a_volume(variant_rgb: str, tmp_path: Path) -> None:
    write_series(tmp_path)
    (tmp_path / "series.rawtlt").write_text("\n".join(map(str, np.linspace(-60, 60, 41))))
    flags = ["-o", str(tmp_path / "run"), "--set", "solve.iterations=3", "--set", "held_out_every=0"]
    assert main(["optimize", str(tmp_path / "series.mrc"), *flags]) == 0
    volume = read_volume(tmp_path / "run/volumes/reconstruction.npz")
    assert volume.values.shape == (12, 32, 32, 1) and volume.meta["unit"] == "A"
    assert "[1/A]" in (tmp_path / "run/report.html").read_text()


def test_a_tilt_series_without_air_or_without_angles(tmp_path: Path, capsys) -> None:
    """The brightest of 60 to 100 counts is the light. Without angles the sentence names their file. A folder holds a series."""
    mrcfile = pytest.importorskip("mrcfile")
    with mrcfile.new(tmp_path / "thin.st") as file:
        file.set_data((60 + 40 * np.random.default_rng(3).random((20, 4, 32))).astype(np.float32))
    assert main(["explain", str(tmp_path / "thin.st")]) == 0
    assert "a tilt series has a file thin.rawtlt or thin.tlt or thin.mdoc beside it" in capsys.readouterr().out
    assert main(["optimize", str(tmp_path / "thin.st")]) == 1
    assert "found a volume, for want of angles" in capsys.readouterr().err
    (tmp_path / "thin.tlt").write_text("\n".join(map(str, range(-40, 60, 5))))
    draft = draft_scan(tmp_path)
    assert draft.raw["data"]["reading"] == "intensity" and 99 < draft.raw["data"]["light"] <= 100
    assert draft.lines[0] == f"found: thin.st in {tmp_path}"
    assert draft_scan(tmp_path, ["data.reading=line_integral"]).raw["data"]["reading"] == "line_integral"


def test_a_folder_of_edf_is_a_scan(tmp_path: Path, capsys) -> None:
    edf = pytest.importorskip("fabio.edfimage")
    beam = ParallelBeam(np.pi * np.arange(20) / 20, (4, 32), 0.07)
    readings = 1000 * np.exp(-shepp_logan().project(beam))
    for k, image in enumerate(readings):
        edf.EdfImage(data=image.astype(np.float32)).write(str(tmp_path / f"scan_{k:03d}.edf"))
    for k in range(2):
        edf.EdfImage(data=np.full((4, 32), 1000 + k, np.float32)).write(str(tmp_path / f"ref_{k}.edf"))
    assert main(["explain", str(tmp_path)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "scan_#.edf: 20 views of 4 x 32 pixels" in said and "ref_#.edf: 2 flats" in said


@pytest.mark.parametrize("kind", ["motors", "key", "frames"])
def test_angles_in_the_headers_of_edf(tmp_path: Path, kind: str) -> None:
    """A motor of the ESRF's lists, a key, and a file of several frames; the TOML finds them again."""
    edf = pytest.importorskip("fabio.edfimage")
    degrees, images = np.arange(20) * 9.0, np.full((20, 4, 32), 500, np.uint16)
    heads = [
        {"motor_mne": "sx srot name", "motor_pos": f"2 {angle} x"} if kind == "motors" else {"Omega": str(angle), "rot": "1"}
        for angle in degrees
    ]
    if kind == "frames":
        file = edf.EdfImage(data=images[0], header=heads[0])
        for image, head in zip(images[1:], heads[1:], strict=True):
            file.append_frame(data=image, header=head)
        file.write(str(tmp_path / "scan.edf"))
    else:
        for k, head in enumerate(heads):
            edf.EdfImage(data=images[k], header=head).write(str(tmp_path / f"scan_{k:02d}.edf"))
    edf.EdfImage(data=2 * images[0]).write(str(tmp_path / "flat.edf"))
    draft = draft_scan(tmp_path)
    name = "srot" if kind == "motors" else "Omega"
    assert any(f"found: {name} in the headers: angles from 0 to 171, taken as degrees" in line for line in draft.lines)
    assert draft.raw["data"]["angles"] == draft.raw["data"]["file"] and "arc" not in draft.raw["scan"]
    found = read_angles(config.from_dict(draft.raw), Path(), 20)
    np.testing.assert_allclose(found, np.radians(degrees))


def test_headers_of_edf_without_an_angle(tmp_path: Path) -> None:
    """No motor that moves, and two that move."""
    edf = pytest.importorskip("fabio.edfimage")
    for name, heads in {
        "still": ({"rot": "1"}, {"rot": "1"}),
        "two": ({"rot": "1", "theta": "2"}, {"rot": "3", "theta": "4"}),
    }.items():
        for k, head in enumerate(heads):
            edf.EdfImage(data=np.ones((3, 4), np.uint16), header=head).write(str(tmp_path / f"{name}_{k}.edf"))
        assert read_header_angles(tmp_path / f"{name}_*.edf") is None
    edf.EdfImage(data=np.ones((3, 4), np.uint16)).write(str(tmp_path / "flat.edf"))
    data = {"source": "stack", "file": "still_*.edf", "angles": "still_*.edf", "reading": "intensity", "flats": "flat.edf"}
    scan = config.from_dict({"title": "a", "scan": {"beam": "parallel"}, "data": data})
    assert_refused("no motor of a rotation that moves", read_angles, scan, tmp_path, 2)


def test_angles_of_an_mdoc_without_angles_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mdoc").write_text("[ZValue = 0]\nStage = 3\n")
    assert_refused("found 1 sections ZValue, expected a number TiltAngle in each", read_tilt_angles, tmp_path / "a.mdoc")


def test_a_broken_image_among_others_is_named(tmp_path: Path) -> None:
    """One of another size; one that is truncated, of which Pillow would warn besides."""
    tifffile = pytest.importorskip("tifffile")
    for view in range(3):
        tifffile.imwrite(tmp_path / f"view_{view}.tif", np.zeros((8, 6 + (view == 1)), np.float32), photometric="minisblack")
    assert_refused(r"view_1\.tif: found images of shapes \[\(8, 6\), \(8, 7\)\]", read_stack, tmp_path / "view_*.tif")
    (tmp_path / "view_1.tif").write_bytes((tmp_path / "view_2.tif").read_bytes()[:200])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert_refused(r"view_1\.tif: found a damaged or foreign file", read_stack, tmp_path / "view_*.tif")
    assert said == []


def test_a_file_is_unmapped_before_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of a thousand float32 files: the pages of files that stay mapped would count as memory of the process."""
    tifffile = pytest.importorskip("tifffile")
    for view in range(3):
        tifffile.imwrite(tmp_path / f"view_{view}.tif", np.full((8, 6), view, np.float32), photometric="minisblack")
    maps: list[weakref.ref] = []
    map_pages = image_stack._map_pages

    def watch(file: Path) -> np.ndarray | None:
        assert all(earlier() is None for earlier in maps)
        mapped = map_pages(file)
        maps.append(weakref.ref(mapped._mmap))
        return mapped

    monkeypatch.setattr(image_stack, "_map_pages", watch)
    stack = image_stack.read_stack(tmp_path / "view_*.tif", rows=slice(1, 8, 4))
    assert len(maps) == 3 and np.array_equal(stack, np.arange(3)[:, None, None] * np.ones((3, 2, 6)))
