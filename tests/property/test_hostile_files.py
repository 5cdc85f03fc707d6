"""Broken files of every format are taken or refused in one sentence: a sample of what .ci/fuzz_files.py reads."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from photo_sets import write_colmap
from PIL import Image
from refusals import assert_refused
from script_modules import load
from sound_files import FILES, PACKAGES, SETS
from volume_files import meta_head, nrrd_head, numbered

from mivol import config
from mivol.errors import MivolError
from mivol.files import read_stack, read_volume, write_exr, write_volume
from mivol.photos import Camera, Lens, intrinsics, load_photos
from mivol.points.cloud import read_points
from mivol.report.page import write_page
from mivol.scene.load import load_scene
from mivol.validate.reference_file import read_reference

SAMPLE = 15
"""Files of each format; the script reads 20,000 in all, in processes of their own."""

SHEPP_LOGAN = Path(__file__).resolve().parents[2] / "scenes" / "shepp_logan" / "fit.toml"

fuzz = load("fuzz_files")


def raises(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (lambda: 3, "taken"),
        (lambda: raises(MivolError("found a, expected b; do c.")), "refused"),
        (lambda: raises(MivolError("two\nlines")), "fault"),
        (lambda: raises(MivolError("x" * 1001)), "fault"),
        (lambda: raises(ValueError("found a")), "fault"),
        (lambda: raises(RecursionError("deep")), "fault"),
    ],
)
def test_faults_are_other_errors_than_refusals(read, kind: str) -> None:
    assert fuzz.outcome(read)[0] == kind


def test_a_number_determines_the_damage() -> None:
    """Equal numbers give equal files, different numbers different files; most differ from the sound file."""
    sound = bytes(range(200)) * 3
    made = [fuzz.mutate(sound, np.random.default_rng((1, number))) for number in (0, 0, *range(1, 40))]
    assert made[0] == made[1]
    assert len(set(made)) > 35
    assert sum(one == sound for one in made) < 4


def test_a_tiff_without_a_width_is_refused(tmp_path: Path) -> None:
    """Found by fuzzing: Pillow raised a TypeError at a second page. The tag of the width, 256, is replaced."""
    path = tmp_path / "stack.tif"
    page = Image.fromarray(np.eye(8, 9, dtype=np.float32))
    page.save(path, save_all=True, append_images=[page])
    data, tag = path.read_bytes(), struct.pack("<H", 256)
    _, place = [m.start() for m in re.finditer(re.escape(tag) + rb"[\x03\x04]\x00\x01\x00\x00\x00\x09", data)]
    path.write_bytes(data[:place] + struct.pack("<H", 60000) + data[place + 2 :])
    assert_refused("a damaged or foreign file", read_stack, path)


def test_endless_names_and_keys_are_refused(tmp_path: Path) -> None:
    """A header may name an impossible file, and a key may be as long as its file."""
    (tmp_path / "a.mhd").write_text(
        f"ObjectType = Image\nNDims = 3\nDimSize = 1 1 1\nElementType = MET_FLOAT\nElementDataFile = {'A' * 70000}\n"
    )
    (tmp_path / "long.toml").write_text("A" * 70000 + " = 1\n")
    named = SHEPP_LOGAN.with_name("cone_128.toml").read_text()
    (tmp_path / "value.toml").write_text(named.replace('"pcg"', f'"{"A" * 70000}"'))
    for read, name in ((read_volume, "a.mhd"), (config.load, "long.toml"), (config.load, "value.toml")):
        with pytest.raises(MivolError) as refused:
            read(tmp_path / name)
        assert len(str(refused.value)) <= fuzz.LONGEST


def test_deeply_nested_cameras_are_refused(tmp_path: Path) -> None:
    """Python's JSON parser recurses on brackets."""
    (tmp_path / "transforms.json").write_text('{"frames": ' + "[" * 100_000)
    assert_refused("text that is not JSON", load_photos, tmp_path)


def test_endless_names_of_photographs_are_refused(tmp_path: Path) -> None:
    frame = {"file_path": "A" * 3000 + ".png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 10.0, "w": 12, "h": 8, "frames": [frame]}))
    assert_refused("a name of 3004 characters", load_photos, tmp_path)


@pytest.mark.parametrize(("coefficient", "sound"), [(1e-320, True), (1e5, True), (1e300, False), (np.nan, False)])
def test_extreme_lenses_are_accepted_or_refused(coefficient: float, sound: bool) -> None:
    """A last coefficient near 0 bends nothing; a huge coefficient has no fold: NumPy raised a LinAlgError."""
    K = intrinsics(10.0, 10.0, 6.0, 4.0)
    if sound:
        assert Camera(K, (12, 8), np.eye(4), Lens(k1=0.1, k4=coefficient)).distortion.fold == np.inf
        return
    assert_refused("at most 1e\\+06", Camera, K, (12, 8), np.eye(4), Lens(k1=0.1, k4=coefficient))


@pytest.mark.parametrize(
    "line", ["1", "1 PINHOLE inf 48 9 9 6 4", "1 PINHOLE 64 nan 9 9 6 4", "9" * 5000 + " PINHOLE 64 48 9 9 6 4"]
)
def test_invalid_colmap_cameras_are_refused(tmp_path: Path, line: str) -> None:
    """Short lines, invalid sizes, and numbers beyond Python's limit."""
    write_colmap(tmp_path, encoding="txt")
    (tmp_path / "sparse/0/cameras.txt").write_text(line + "\n")
    with pytest.raises(MivolError):
        load_photos(tmp_path)


def test_deeply_nested_experiments_are_refused(tmp_path: Path) -> None:
    """tomllib recurses on brackets."""
    (tmp_path / "deep.toml").write_text("a = " + "[" * 100_000)
    assert_refused("nests its values deeper", config.load, tmp_path / "deep.toml")


def test_keys_of_many_parts_are_refused_before_parsing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """tomllib takes quadratic time for them. Shorter keys and paths of dots are parsed."""
    for text in ("a." * 50_000 + "b = 1", "[" + '"a" . ' * 200 + "b]"):
        (tmp_path / "deep.toml").write_text(text)
        with monkeypatch.context() as patch, pytest.raises(MivolError, match="nests its values deeper"):
            patch.setattr(config.tomllib, "loads", lambda text: pytest.fail("parsed"))
            config.load(tmp_path / "deep.toml")
    (tmp_path / "some.toml").write_text("a." * 90 + "b = 1\nscene.file = '" + "../" * 200 + "a.xml'\n")
    assert_refused('unknown key "a"', config.load, tmp_path / "some.toml")


def test_a_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbf" + SHEPP_LOGAN.with_name("cone_128.toml").read_bytes())
    assert config.load(tmp_path / "a.toml") == config.load(SHEPP_LOGAN.with_name("cone_128.toml"))


def test_a_refusal_of_an_invalid_name_can_be_printed(tmp_path: Path) -> None:
    """Half of a UTF-16 pair is a valid name in JSON; print() raised a UnicodeEncodeError at the refusal."""
    frame = {"file_path": "\ud800.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 10.0, "w": 12, "h": 8, "frames": [frame]}))
    with pytest.raises(MivolError) as refused:
        load_photos(tmp_path)
    assert rb"\ud800.png" in str(refused.value).encode()


def test_too_many_las_records_are_refused(tmp_path: Path) -> None:
    """Found by fuzzing: laspy reads as many empty records as the header claims, two billion here."""
    pytest.importorskip("laspy")
    path = tmp_path / "a.las"
    FILES["las"][1](path)
    data = path.read_bytes()
    path.write_bytes(data[:100] + struct.pack("<I", 2_000_000_000) + data[104:])
    assert_refused("more variable length records than it has room for", read_points, path)


def test_an_unclosed_array_header_is_refused(tmp_path: Path) -> None:
    """Found by fuzzing: an unclosed bracket in the header of an array raises an error of Python's tokenizer."""
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((4, 3)))
    path.write_bytes(path.read_bytes().replace(b"}", b"{"))
    assert_refused("a damaged array", read_points, path)


def test_an_archive_of_a_volume_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Volumes use the same reader as fields: sizes are checked before memory is allocated."""
    write_volume(tmp_path / "a.npz", np.zeros((32, 32, 32, 1), np.float32))
    monkeypatch.setattr("mivol.files.npy.available_memory", lambda: 100_000)
    assert_refused("at most the free memory", read_volume, tmp_path / "a.npz")


@pytest.mark.parametrize("said", ["{", "[]", '{"identity": {}}'])
def test_a_damaged_reference_is_refused(tmp_path: Path, said: str) -> None:
    """Found by fuzzing: the header is JSON and may be truncated or incomplete."""
    write_exr(tmp_path / "a.exr", {"": np.zeros((2, 2, 3), np.float32)}, {"mivol_reference": said})
    assert_refused("a damaged reference", read_reference, tmp_path / "a.exr")


@pytest.mark.parametrize(
    "inside", [b'<inte\xaa\x89r name="a"/>', b'<emitter type="constant"><string name="\xfd" value="1"/></emitter>']
)
def test_a_scene_of_foreign_bytes_is_refused(variant_rgb: str, tmp_path: Path, inside: bytes) -> None:
    """Found by fuzzing: Mitsuba's errors quote the file, which may be invalid text."""
    (tmp_path / "a.xml").write_bytes(b'<scene version="3.0.0">' + inside + b"</scene>")
    assert_refused("bytes that are not UTF-8", load_scene, tmp_path / "a.xml")


def test_a_scene_with_an_endless_name_is_refused(variant_rgb: str, tmp_path: Path) -> None:
    """Found by fuzzing: Mitsuba's error quotes the whole name."""
    (tmp_path / "a.xml").write_text(f'<scene version="3.0.0" {"A" * 70000}="1"/>')
    with pytest.raises(MivolError) as refused:
        load_scene(tmp_path / "a.xml")
    assert len(str(refused.value).replace(str(tmp_path), "")) <= fuzz.LONGEST


@pytest.mark.parametrize("name", ["run.json", "metrics.jsonl", "a.png"])
def test_a_page_of_damaged_files_is_refused(tmp_path: Path, name: str) -> None:
    """Found by fuzzing: invalid UTF-8 and a damaged image."""
    SETS["run"][0](tmp_path)
    path = tmp_path / name
    whole = path.read_bytes()
    # Inside a string of JSON: elsewhere no JSON begins so, whatever the encoding.
    path.write_bytes(b"\xff" + whole if name == "a.png" else whole.replace(b'"', b'"\xff', 1))
    with pytest.raises(MivolError) as refused:
        write_page(tmp_path)
    assert name in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("listed", ["s%d.raw 0 200000000000 1", "s%099999999d.raw 0 1 1", "s%.0s.raw 0 7 1", "%d%d.raw 0 1 1"])
def test_patterns_of_files_are_bounded(tmp_path: Path, listed: str) -> None:
    """A header of 150 bytes named 200 billion files, whose names alone would fill the memory."""
    (tmp_path / "s.raw").write_bytes(bytes(4))
    (tmp_path / "a.nhdr").write_text(nrrd_head(numbered(), **{"data file": listed}))
    (tmp_path / "a.mhd").write_bytes(meta_head(numbered(), data=listed))
    for name in ("a.nhdr", "a.mhd"):
        assert_refused(r"files numbered from|the pattern", read_volume, tmp_path / name)


def test_numbered_files_are_read_in_order(tmp_path: Path) -> None:
    values = numbered()
    for k, layer in enumerate(values):
        (tmp_path / f"s{k:02d}.raw").write_bytes(layer.astype("<f4").tobytes())
    (tmp_path / "a.nhdr").write_text(nrrd_head(values, **{"data file": "s%02d.raw 0 1 1"}))
    (tmp_path / "a.mhd").write_bytes(meta_head(values, data="s%02d.raw 0 1 1"))
    for name in ("a.nhdr", "a.mhd"):
        np.testing.assert_array_equal(read_volume(tmp_path / name).values, values)


@pytest.mark.parametrize(("skip", "sound"), [("2", True), ("99999999999999", False), ("-1", False)])
def test_skipped_lines_must_exist(tmp_path: Path, skip: str, sound: bool) -> None:
    values = numbered()
    (tmp_path / "s.raw").write_bytes(b"one\ntwo\n" + values.astype("<f4").tobytes())
    (tmp_path / "a.nhdr").write_text(nrrd_head(values, **{"data file": "s.raw", "line skip": skip}))
    if sound:
        np.testing.assert_array_equal(read_volume(tmp_path / "a.nhdr").values, values)
        return
    assert_refused("line skip", read_volume, tmp_path / "a.nhdr")


def test_numbers_of_thousands_of_digits_are_refused(tmp_path: Path) -> None:
    """Python rejects them with a ValueError outside the classes of JSON and TOML errors."""
    (tmp_path / "transforms.json").write_text(f'{{"w": {"9" * 5000}}}')
    (tmp_path / "a.toml").write_text(f"threads = {'9' * 5000}")
    assert_refused("text that is not JSON", load_photos, tmp_path)
    assert_refused("is not TOML", config.load, tmp_path / "a.toml")


def write_sound(name: str, folder: Path) -> None:
    """Write a sound file of a kind; skip the test where the package of the kind is not installed."""
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name], reason=f'{PACKAGES[name]} is not installed: pip install "mivol[lab]"')
    fuzz.write_sound(name, folder)


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("tiff zlib", 206),
        ("hdf5", 565),
        ("projections", 726),
        ("dicom", 188),
        ("edf", 18),
        ("tilt series", 1860),
        ("zarr", 1371),
        ("zarr 3", 461),
    ],
)
def test_damage_that_was_a_fault_is_refused(tmp_path: Path, name: str, number: int) -> None:
    """Found by fuzzing with the seed 42: pages in a circle (tifffile lists them for ever), axes without
    end (fabio), chunks beyond the memory (tensorstore), and errors of h5py, pydicom and mrcfile."""
    write_sound(name, tmp_path)
    assert fuzz.outcome(fuzz.case(name, number, 42, tmp_path)[0])[0] == "refused"


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FILES, *SETS])
def test_damaged_files_are_read_or_refused(variant_rgb: str, tmp_path: Path, name: str) -> None:
    write_sound(name, tmp_path)
    found = [fuzz.outcome(fuzz.case(name, number, 2, tmp_path)[0]) for number in range(SAMPLE)]
    assert [said for kind, said in found if kind == "fault"] == []
    assert any(kind == "refused" for kind, _ in found)


@pytest.mark.slow
def test_the_script_reports_its_files(variant_rgb: str, capsys: pytest.CaptureFixture) -> None:
    """In a child process, as for 20,000 files: three files, each counted."""
    assert fuzz.main(["--files", "3", "--only", "vol"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("vol: 3 files, ")
    assert said[-1] == "3 files, 0 faults"
