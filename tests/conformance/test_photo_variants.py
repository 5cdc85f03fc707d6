"""Data sets of photographs as strangers have them: smaller folders, turned or masked photographs, poses of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from photo_sets import edit, pixels, png_of_16_bits, ring, write_colmap, write_transforms
from PIL import Image
from refusals import assert_refused
from scipy.spatial.transform import Rotation

from mivol.cli import main
from mivol.files import ply
from mivol.photos import load_photos, survey_photos
from mivol.photos.camera import intrinsics
from mivol.photos.camera_path import HomeView
from mivol.photos.lens import Lens
from mivol.photos.listing import find_shrink
from mivol.photos.photo_file import ORIENTATION, TURNS
from mivol.points import read_gaussians, write_gaussians
from mivol.points.gaussian_files import read_gaussian_view, write_gaussian_ply
from mivol.points.gaussians import Gaussians

BOX = np.array([[-1.0] * 3, [1.0] * 3])


def test_sizes_are_a_half_a_quarter_or_an_eighth_rounded_up_or_down() -> None:
    sizes = {(33, 25): 1, (16, 12): 2, (17, 13): 2, (8, 6): 4, (9, 7): 4, (5, 4): 8, (18, 13): None, (11, 8): None}
    assert {size: find_shrink(size, (33, 25)) for size in sizes} == sizes


@pytest.mark.parametrize("shrink", [2, 4])
def test_a_folder_of_smaller_photographs_scales_the_cameras(tmp_path: Path, shrink: int) -> None:
    """``images_2`` in the place of ``images``, with another suffix: each pixel keeps its rays."""
    folder = write_colmap(tmp_path / "set", "PINHOLE")
    whole = survey_photos(folder, box=BOX).frames
    small = folder / f"images_{shrink}"
    (folder / "images").rename(small)
    for file in list(small.iterdir()):
        with Image.open(file) as image:
            image.resize((64 // shrink, 48 // shrink)).save(file.with_suffix(".jpg"))
        file.unlink()
    survey = survey_photos(folder, box=BOX)
    assert f"4 photographs have 1/{shrink} of the size in the file of cameras" in survey.describe()
    for frame, before in zip(survey.frames, whole, strict=True):
        assert frame.camera.size == (64 // shrink, 48 // shrink)
        np.testing.assert_allclose(frame.camera.K[:2] * shrink, before.camera.K[:2])


@pytest.mark.parametrize("head", ["/home/ann/box/", "C:\\data\\box\\", "../../box/", ""])
@pytest.mark.parametrize("suffix", [".png", ".JPG"])
def test_photographs_of_another_machine_are_found(tmp_path: Path, head: str, suffix: str) -> None:
    """The file of cameras names folders and suffixes that are elsewhere; splits and masks follow the photographs."""
    folder = write_transforms(tmp_path / "set", {"fl_x": 20})
    (folder / "masks").mkdir()
    Image.fromarray(np.full((8, 12), 255, np.uint8)).save(folder / "masks" / "3.png")
    before = [frame.camera.to_world for frame in survey_photos(folder, box=BOX).frames]

    def rename(table: dict) -> None:
        for number, frame in enumerate(table["frames"]):
            frame["file_path"] = f"{head}images/{number:04d}{suffix}"
        table["frames"][3]["mask_path"] = f"{head}masks/3.png"
        table["test_filenames"] = [table["frames"][1]["file_path"]]

    edit(folder / "transforms.json", rename)
    survey = survey_photos(folder, box=BOX)
    moved = bool(head) or suffix != ".png"
    assert ("no photograph has its listed name" in survey.describe()) == moved
    assert [frame.file for frame in survey.frames] == [folder / "images" / f"{number:04d}.png" for number in range(4)]
    assert [frame.split for frame in survey.frames] == ["train", "test", "train", "train"]
    assert [frame.mask for frame in survey.frames] == [None, None, None, folder / "masks" / "3.png"]
    for frame, old in zip(survey.frames, before, strict=True):
        np.testing.assert_array_equal(frame.camera.to_world, old)


def test_cameras_that_look_around_get_the_box_in_their_middle(tmp_path: Path) -> None:
    """Turned by half a turn about the vertical, the cameras of the ring have no place in common."""
    folder = write_transforms(tmp_path / "set", {"fl_x": 20}, n=6)
    assert "because no place is in view" not in survey_photos(folder).describe()

    def turn(table: dict) -> None:
        for frame in table["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1, 1, -1, 1])).tolist()

    edit(folder / "transforms.json", turn)
    survey = survey_photos(folder)
    assert "because no place is in view of at least 90 % of 6 cameras" in survey.describe()
    np.testing.assert_array_equal(survey.box, survey_photos(folder, box="middle").box)


def test_a_matrix_of_the_camera_in_each_frame(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "set", {"K": [[20, 0, 5.5], [0, 21, 4.5], [0, 0, 1]]})
    edit(folder / "transforms.json", lambda table: table["frames"][1].update(K=[[30, 0, 6], [0, 31, 4], [0, 0, 1.0]]))
    frames = survey_photos(folder, box=BOX).frames
    np.testing.assert_array_equal(frames[0].camera.K, intrinsics(20, 21, 5.5, 4.5))
    np.testing.assert_array_equal(frames[1].camera.K, intrinsics(30, 31, 6, 4))


@pytest.mark.parametrize("K", [[[20, 1, 6], [0, 21, 4], [0, 0, 1]], [[20, 0, 6], [0, 21, 4]], "20", [[20], [0, 1]]])
def test_other_matrices_are_refused(tmp_path: Path, K: object) -> None:
    folder = write_transforms(tmp_path / "set", {"K": K})
    assert_refused("expected 3 x 3 numbers fx, 0, cx; 0, fy, cy; 0, 0, 1", survey_photos, folder)


def test_three_rows_of_a_transform_are_enough(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 20})
    before = survey_photos(folder).frames
    edit(folder / "transforms.json", lambda t: [f.update(transform_matrix=f["transform_matrix"][:3]) for f in t["frames"]])
    for frame, old in zip(survey_photos(folder).frames, before, strict=True):
        np.testing.assert_array_equal(frame.camera.to_world, old.camera.to_world)


@pytest.mark.parametrize("orientation", TURNS)
def test_pixels_are_turned_as_pillow_turns_them(tmp_path: Path, orientation: int) -> None:
    """Half turns and mirrors follow the quarter turn of another photograph, whose size shows what the cameras describe."""
    from PIL import ImageOps

    folder = write_transforms(tmp_path / "set", {"fl_x": 20})
    files = sorted((folder / "images").iterdir())
    for file, turn in zip(files, (orientation, 6, 6, 6), strict=True):
        size = (8, 12) if turn > 4 else (12, 8)
        image = Image.fromarray(pixels(*size, 3, alpha=False))
        tags = image.getexif()
        tags[ORIENTATION] = turn
        image.save(file, exif=tags)
    with Image.open(files[0]) as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(np.round(load_photos(folder).views[0].image * 255), expected)


def test_photographs_without_a_pose_are_named(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "set")
    assert "without a pose" not in survey_photos(folder, box=BOX).describe()
    (folder / "images" / "left").mkdir()
    for name in ("left/b.jpg", "a view 7.png"):
        Image.fromarray(pixels(64, 48, alpha=False)).save(folder / "images" / name)
    said = survey_photos(folder, box=BOX).describe()
    assert "4 of 6 photographs have a pose in" in said and "without a pose: a view 7.png, left/b.jpg" in said
    write_colmap(tmp_path / "other", n=5)
    (tmp_path / "other" / "sparse" / "0").rename(folder / "sparse" / "1")
    larger = folder / "sparse" / "1"
    assert f"{larger} has poses of 5 photographs: name that folder" in survey_photos(folder, box=BOX).describe()


@pytest.mark.parametrize("name", ["left/0001.png", "left/0001.jpg.png", "left/0001.jpg"])
def test_masks_stand_in_a_folder_beside_nested_photographs(tmp_path: Path, name: str) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 20})
    (folder / "images" / "left").mkdir()
    (folder / "images" / "0001.png").unlink()
    Image.fromarray(pixels(12, 8, 1, alpha=False)).save(folder / "images" / "left" / "0001.jpg")
    edit(folder / "transforms.json", lambda table: table["frames"][1].update(file_path="images/left/0001.jpg"))
    mask = np.full((16, 24), 255, np.uint8)
    mask[:, :5] = 0
    path = folder / "masks" / name
    path.parent.mkdir(parents=True)
    Image.fromarray(mask).save(path, format="png")
    photos = load_photos(folder)
    assert [view.mask is None for view in photos.views] == [True, False, True, True]
    np.testing.assert_array_equal(photos.views[1].mask, np.broadcast_to(np.arange(12) >= 3, (8, 12)))
    assert "1 of 4 photographs have masks" in photos.describe()


def write_llff(folder: Path, n: int = 5) -> Path:
    """Poses on a ring in LLFF's axes (down, right, backwards), photographs of 24 x 16 pixels at half size, distances 3 to 5."""
    (folder / "images_2").mkdir(parents=True)
    rows = []
    for k, pose in enumerate(ring(n)):
        Image.fromarray(pixels(12, 8, k, alpha=False)).save(folder / "images_2" / f"{k}.png")
        matrix = np.column_stack([-pose[:3, 1], pose[:3, 0], pose[:3, 2], pose[:3, 3], [16, 24, 20]])
        rows.append([*matrix.ravel(), 3.0, 5.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def test_poses_of_llff(tmp_path: Path) -> None:
    folder = write_llff(tmp_path / "set")
    photos = load_photos(folder)
    assert photos.survey.format == "LLFF"
    for view, pose in zip(photos.views, ring(5), strict=True):
        np.testing.assert_allclose(view.camera.to_world, pose, atol=1e-15)
        np.testing.assert_allclose(view.camera.K, [[10, 0, 6], [0, 10, 4], [0, 0, 1]])
    assert "in view of at least" in photos.survey.box_from


def test_parallel_cameras_of_llff_have_a_box_by_their_distances(tmp_path: Path) -> None:
    """Frusta from 3 to 5 along -z, whose corners are 5 * 12 / 20 and 5 * 8 / 20 across; cameras stand 0 to 4 along x."""
    folder = write_llff(tmp_path / "set")
    rows = np.load(folder / "poses_bounds.npy")
    for k, row in enumerate(rows):
        row[:15].reshape(3, 5)[:, :4] = [[0, 1, 0, k], [-1, 0, 0, 0], [0, 0, 1, 0]]
    np.save(folder / "poses_bounds.npy", rows)
    survey = survey_photos(folder)
    np.testing.assert_allclose(survey.box, [[-3, -2, -5], [7, 2, -3]])
    assert "nearest and farthest distance" in survey.describe()


BAD_ROWS = {
    "photographs": (lambda rows: rows[:4], "found 4 poses and 5 photographs in images_2"),
    "columns": (lambda rows: rows[:, :15], r"float64 of shape \(5, 15\), expected 17 numbers"),
    "distances": (
        lambda rows: rows * np.where(np.arange(17) == 15, 2, 1),
        "row 0 with .* expected finite numbers and 0 < near",
    ),
}


@pytest.mark.parametrize("case", BAD_ROWS)
def test_wrong_poses_of_llff_are_refused(tmp_path: Path, case: str) -> None:
    folder, (change, message) = write_llff(tmp_path / "set"), BAD_ROWS[case]
    np.save(folder / "poses_bounds.npy", change(np.load(folder / "poses_bounds.npy")))
    assert_refused(message, load_photos, folder)


ROLL = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
"""Rotation of the world of :func:`ring`, with z up, to one with y up, as ARKit's."""


def write_export(folder: Path, kind: str, n: int = 3) -> Path:
    """Raw data of an app with numbers past 9: photographs of 24 x 16 pixels, focal lengths 20 and 21, middle at (11, 9)."""
    for k, pose in enumerate(ring(n)):
        pose, number = np.block([[ROLL.T @ pose[:3]], [np.array([[0.0, 0, 0, 1]])]]), 8 + k
        image = {
            "polycam": folder / "keyframes" / "corrected_images" / f"{number}.jpg",
            "record3d": folder / "rgb" / f"{k}.jpg",
            "arkit": folder / f"frame_{number}.jpg",
        }[kind]
        image.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels(24, 16, k, alpha=False)).save(image)
        lens = {"fx": 20, "fy": 21, "cx": 11, "cy": 9}
        if kind == "polycam":
            rows = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
            file = folder / "keyframes" / "corrected_cameras" / f"{number}.json"
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps({**lens, "width": 24, "height": 16, **rows}))
        elif kind == "record3d":
            file = folder / "metadata.json"
            table = json.loads(file.read_text()) if file.exists() else {"w": 24, "h": 16, "poses": []}
            row = [*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]]
            table |= {"K": [20, 0, 0, 0, 21, 0, 11, 9, 1], "poses": [*table["poses"], row]}
            file.write_text(json.dumps(table))
        else:
            rounded = [*pose.ravel()[:-1], 0.99999988079071045]  # a product of matrices of float32, as the app writes it
            table = {"intrinsics": [20, 0, 11, 0, 21, 9, 0, 0, 1], "cameraPoseARFrame": rounded}
            (folder / f"frame_{number}.json").write_text(json.dumps(table))
            (folder / "frame_90.json").write_text(json.dumps(table))  # a pose without a photograph
    return folder


@pytest.mark.parametrize(
    ("kind", "name"), [("polycam", "Polycam"), ("record3d", "Record3D"), ("arkit", "ARKit (3D Scanner App)")]
)
def test_exports_of_phones(tmp_path: Path, kind: str, name: str) -> None:
    survey = survey_photos(write_export(tmp_path / "scan", kind))
    assert survey.format == name and len(survey.frames) == 3 and not survey.skipped
    for k, (frame, pose) in enumerate(zip(survey.frames, ring(3), strict=True)):
        assert frame.file.stem.endswith(str(k if kind == "record3d" else 8 + k))
        np.testing.assert_allclose(frame.camera.to_world[:3], ROLL.T @ pose[:3], atol=1e-12)
        np.testing.assert_allclose(frame.camera.K, [[20, 0, 11], [0, 21, 9], [0, 0, 1]])


def test_record3d_may_have_a_lens_for_each_frame(tmp_path: Path) -> None:
    folder = write_export(tmp_path / "scan", "record3d")
    edit(folder / "metadata.json", lambda table: table.update(perFrameIntrinsicCoeffs=[]))
    assert [frame.camera.K[0, 0] for frame in survey_photos(folder).frames] == [20, 20, 20]
    edit(folder / "metadata.json", lambda table: table.update(perFrameIntrinsicCoeffs=[[30 + k, 31, 12, 8] for k in range(3)]))
    assert [frame.camera.K[0, 0] for frame in survey_photos(folder).frames] == [30, 31, 32]


def test_polycam_without_corrected_cameras_has_those_of_the_phone(tmp_path: Path) -> None:
    """Long scans have empty folders of corrected cameras."""
    keyframes = write_export(tmp_path / "scan", "polycam") / "keyframes"
    for part in ("cameras", "images"):
        (keyframes / f"corrected_{part}").rename(keyframes / part)
        (keyframes / f"corrected_{part}").mkdir()
    assert [frame.file.parent.name for frame in survey_photos(tmp_path / "scan").frames] == ["images"] * 3


def write_reality_capture(folder: Path, lens: tuple[str, ...], values: tuple[float, ...]) -> Path:
    """The ring as RealityCapture writes it: bearings from +y to +x, pitch from straight down; focal length 30 of 24 pixels."""
    (folder / "images").mkdir(parents=True)
    lines = ["#cameras 3", ",".join(["#name", "x", "y", "alt", "heading", "pitch", "roll", "f", *lens])]
    for k, pose in enumerate(ring(3)):
        Image.fromarray(pixels(24, 16, k, alpha=False)).save(folder / "images" / f"{k}.jpg")
        x, y, z = pose[:3, 3]
        pitch = 90 - np.degrees(np.arctan2(z, np.hypot(x, y)))
        row = [f"{k}.jpg", x, y, z, np.degrees(np.arctan2(-x, -y)), pitch, 0, 45.0, *values]
        lines.append(",".join(map(str, row)))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_cameras_of_reality_capture(tmp_path: Path) -> None:
    """45 mm on 36 mm of film is 30 of 24 pixels; 1/24 of the longer edge is a pixel."""
    folder = write_reality_capture(tmp_path / "bare", (), ())
    for name, middle, lens in (("bare", (12, 8), Lens()), ("lens", (13, 7), Lens(k1=0.01, k4=0.02, p1=0.003, p2=0.004))):
        if name == "lens":
            columns = ("px", "py", "k1", "k4", "t1", "t2")
            folder = write_reality_capture(tmp_path / "lens", columns, (1 / 24, -1 / 24, 0.01, 0.02, 0.003, 0.004))
        survey = survey_photos(folder)
        assert survey.format == "RealityCapture" and [frame.file.name for frame in survey.frames] == ["0.jpg", "1.jpg", "2.jpg"]
        for frame, pose in zip(survey.frames, ring(3), strict=True):
            np.testing.assert_allclose(frame.camera.to_world, pose, atol=1e-12)
            np.testing.assert_allclose(frame.camera.K, [[30, 0, middle[0]], [0, 30, middle[1]], [0, 0, 1]])
            assert frame.camera.distortion == lens
    assert survey_photos(folder / "cameras.csv").format == "RealityCapture"


@pytest.mark.parametrize("options", [(), ("--as", "gaussians")])
@pytest.mark.parametrize("name", ["cameras.csv", "poses_bounds.npy", "transforms.json"])
def test_commands_take_the_file_of_cameras(tmp_path: Path, name: str, options: tuple, capsys: pytest.CaptureFixture) -> None:
    """Suffixes of points and arrays hold cameras as well. A fit of so small photographs is refused, after its facts."""
    writers = {"cameras.csv": lambda folder: write_reality_capture(folder, (), ()), "poses_bounds.npy": write_llff}
    write = writers.get(name, lambda folder: write_transforms(folder, {"fl_x": 20}))
    main(["explain", str(write(tmp_path / "set") / name), *options])
    assert ("experiment  set" if options else " photographs (") in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "message"),
    [(",1,2,3,0,90,0,45", "the row ,1,2,3"), ("3.jpg,1,2,3,0,ninety,0,45", "pitch of 1 values, or not of numbers")],
)
def test_wrong_rows_of_reality_capture_are_refused(tmp_path: Path, line: str, message: str) -> None:
    file = write_reality_capture(tmp_path / "set", (), ()) / "cameras.csv"
    file.write_text(file.read_text() + line + "\n")
    assert_refused(message, survey_photos, tmp_path / "set")


BAD_EXPORTS = {
    "no JSON": ("polycam", "keyframes/corrected_cameras/9.json", None, "text that is not JSON"),
    "a missing number": ("polycam", "keyframes/corrected_cameras/9.json", lambda t: t.pop("t_13"), "found no t_13"),
    "half a pixel": ("polycam", "keyframes/corrected_cameras/9.json", lambda t: t.update(width=2.5), "2.5 x 16 pixels"),
    "too few numbers": ("arkit", "frame_9.json", lambda t: t.update(intrinsics=[1, 2]), "intrinsics of 2 .* 9 finite numbers"),
    "words": ("record3d", "metadata.json", lambda t: t.update(poses=[["a"] * 7]), "poses of 1 .* any x 7 finite numbers"),
    "no rotation": ("record3d", "metadata.json", lambda t: t["poses"].__setitem__(1, [0] * 7), "pose 1 with the quaternion"),
}


@pytest.mark.parametrize("case", BAD_EXPORTS)
def test_wrong_exports_of_phones_are_refused(tmp_path: Path, case: str) -> None:
    kind, name, change, message = BAD_EXPORTS[case]
    file = write_export(tmp_path / "scan", kind) / name
    file.write_text("{") if change is None else edit(file, change)
    assert_refused(message, survey_photos, tmp_path / "scan")


@pytest.mark.parametrize("suffix", ["webp", "png"])
def test_names_without_suffix_are_webp_or_png_of_16_bits(tmp_path: Path, suffix: str) -> None:
    folder, image = write_transforms(tmp_path / "set", {"fl_x": 20}), pixels(12, 8, 5, alpha=False)
    (folder / "images" / "0001.png").unlink()
    edit(folder / "transforms.json", lambda table: table["frames"][1].update(file_path="images/0001"))
    file = folder / "images" / f"0001.{suffix}"
    if suffix == "png":
        file.write_bytes(png_of_16_bits(257 * image.astype(np.uint16)))
    else:
        Image.fromarray(image).save(file, lossless=True)
    np.testing.assert_allclose(load_photos(folder).views[1].image * 255, image, atol=1e-4)


# -- Gaussians -----------------------------------------------------------------------------------------------------


def make_gaussians(n: int = 6) -> Gaussians:
    rng = np.random.default_rng(0)
    turns = np.eye(4, dtype=np.float32)[np.zeros(n, int)]
    reals = [rng.normal(size=shape).astype(np.float32) for shape in ((n, 3), (n, 3), n, (n, 16, 3))]
    return Gaussians(reals[0], reals[1], turns, reals[2], reals[3])


def write_columns(path: Path, drop: tuple[str, ...], more: dict[str, np.ndarray]) -> Gaussians:
    """Write Gaussians without some properties, and with other columns."""
    gaussians = make_gaussians()
    with path.open("wb") as file:
        write_gaussian_ply(file, gaussians)
    table = ply.read_tables(path)["vertex"]
    kept = [name for name in table.dtype.names if not name.startswith(drop)] if drop else list(table.dtype.names)
    new = np.empty(len(table), [*((name, "<f4") for name in kept), *((name, column.dtype) for name, column in more.items())])
    for name in kept:
        new[name] = table[name]
    for name, column in more.items():
        new[name] = column
    with path.open("wb") as file:
        ply.write_table(file, new)
    return gaussians


def test_gaussians_with_colours_in_bytes(tmp_path: Path) -> None:
    """nerfstudio's mode rgb has red, green, blue of 0..255 in the place of f_dc and f_rest."""
    codes = np.array([[0, 51, 255]] * 6, np.uint8)
    write_columns(tmp_path / "a.ply", ("f_dc", "f_rest"), dict(zip(("red", "green", "blue"), codes.T, strict=True)))
    read = read_gaussians(tmp_path / "a.ply")
    assert read.degree == 0
    np.testing.assert_allclose(read.base_colours(), codes / 255, atol=1e-6)


def test_harmonics_of_degree_4_are_cut_and_the_cut_is_said(tmp_path: Path) -> None:
    """24 numbers a channel, channel by channel; the first 15 of each are those of degree 3."""
    rest = np.random.default_rng(1).normal(size=(6, 3, 24)).astype(np.float32)
    columns = {f"f_rest_{k}": column for k, column in enumerate(rest.reshape(6, 72).T)}
    write_columns(tmp_path / "a.ply", ("f_rest",), columns)
    with pytest.warns(RuntimeWarning, match="degree 4 are cut to degree 3"):
        read = read_gaussians(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.harmonics[:, 1:], np.swapaxes(rest[:, :, :15], 1, 2))


def test_a_file_of_gaussians_keeps_its_first_view_and_a_box_crops_it(tmp_path: Path) -> None:
    """Other programs skip comments; a converted file keeps the view."""
    view = HomeView((0.0, -1.0, 0.0), (0.0, -1.0, -4.0), (1.0, -1.0, 0.0), 40.0, (8, 4))
    gaussians = make_gaussians()
    write_gaussians(tmp_path / "a.ply", gaussians, view)
    inside = (np.abs(gaussians.means) <= 1).all(axis=1)
    assert 0 < inside.sum() < len(inside)
    box = ["--box", "-1", "-1", "-1", "1", "1", "1"]
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), *box]) == 0
    assert read_gaussian_view(tmp_path / "b.ply") == view
    np.testing.assert_array_equal(read_gaussians(tmp_path / "b.ply").means, gaussians.means[inside])
    write_gaussians(tmp_path / "c.ply", gaussians)
    assert read_gaussian_view(tmp_path / "c.ply") is None
