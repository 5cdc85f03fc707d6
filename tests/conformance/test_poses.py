"""Poses of photographs: what COLMAP is given, what is kept of its models, and what is said when it finds nothing."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from photo_sets import pixels, write_colmap, write_transforms
from PIL import Image, ImageOps
from refusals import assert_refused

from mivol.cli import main
from mivol.photos import colmap_process, poses, survey_photos
from mivol.photos.camera import directions
from mivol.photos.colmap import CAMERA_MODELS, read_colmap
from mivol.photos.listing import list_photographs
from mivol.photos.photo_file import ORIENTATION, is_damaged, read_lens_facts, read_photo_header
from mivol.report import cameras


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Five photographs of 64 x 48 pixels, three of them in a folder below."""
    for number, name in enumerate(("a.jpg", "b.png", "near/c.webp", "near/d.jpg", "near/e.jpg")):
        path = tmp_path / "walk" / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels(64, 48, number, alpha=False)).save(path)
    return tmp_path / "walk"


def set_exif(path: Path, tags: dict[int, object]) -> None:
    """Set tags of EXIF; those of lenses lie in a directory of their own."""
    with Image.open(path) as image:
        exif = image.getexif()
        for tag, value in tags.items():
            (exif.get_ifd(0x8769) if tag in (0xA434, 0x920A, 0xA405) else exif)[tag] = value
        image.save(path, exif=exif)


@pytest.fixture
def job(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict:
    """What COLMAP is asked, in the place of COLMAP: two models, of three photographs and of one."""
    asked = {}

    def run(given: dict, work: Path, say: object) -> tuple[list[dict], dict]:
        asked.update(given)
        for name in (name for group in given["names"] for name in group):
            with Image.open(Path(given["images"]) / name) as image:
                asked[name] = np.asarray(image, np.float64)
        models = []
        for k, names in enumerate((["near/e.jpg"], ["a.jpg", "b.png", "near/d.jpg"])):
            model = write_colmap(tmp_path / f"model{k}") / "sparse" / "0"
            facts = {"error": 0.5, "points": asked.get("points", 70), "cameras": 1, "against": asked.get("against", (0, 3))}
            models.append({"folder": str(model), "names": names, **facts})
        return models, asked.get("matches", {})

    monkeypatch.setattr(poses, "_run", run)
    monkeypatch.setattr(poses.importlib.util, "find_spec", lambda name: object())
    return asked


def test_the_largest_model_is_kept_and_the_rest_is_named(
    folder: Path, job: dict, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cameras, "write_poses_page", lambda folder, found: folder / "poses.html")
    job["matches"] = {"pairs": 3, "best": {"near/c.webp": ["a.jpg", 21]}}
    assert main(["poses", str(folder)]) == 0
    said = capsys.readouterr().out
    for fact in (
        f"{folder / 'sparse' / '0'}: 3 of 5 photographs have poses, 70 points, 1 camera, reprojection error 0.50 pixels",
        "1 photographs (near/e.jpg, ...) have poses in separate models",
        "photograph what lies between near/e.jpg and near/d.jpg, or put another place into a folder of its own",
        "without a pose: near/c.webp (few matches: 21 points in common with a.jpg); photograph again",
        f"mivol optimize {folder} fits Gaussians",
    ):
        assert fact in said
    assert sorted(file.name for file in (folder / "sparse" / "0").iterdir()) == ["cameras.bin", "images.bin", "points3D.bin"]
    assert [path.name for path in (folder / "sparse").iterdir()] == ["0"]
    assert (job["masks"], job["sequential"]) == ("", False)
    assert main(["poses", str(folder)]) == 1
    assert "poses in it already (COLMAP)" in capsys.readouterr().err


def test_an_empty_folder_of_models_is_filled(folder: Path, job: dict) -> None:
    (folder / "sparse").mkdir()
    poses.find_poses(folder)
    assert (folder / "sparse" / "0" / "images.bin").is_file()


def test_a_lens_by_exif_is_a_camera(folder: Path, job: dict) -> None:
    set_exif(folder / "images" / "near" / "d.jpg", {0x010F: "Maker", 0x920A: 4.2})
    set_exif(folder / "images" / "near" / "e.jpg", {0x010F: "Maker", 0x920A: 4.2})
    set_exif(folder / "images" / "a.jpg", {0x010F: "Maker", 0x920A: 9.0})
    poses.find_poses(folder)
    assert sorted(job["names"]) == [["a.jpg"], ["b.png", "near/c.webp"], ["near/d.jpg", "near/e.jpg"]]


def test_colmap_sees_upright_photographs_in_formats_that_it_reads(folder: Path, job: dict) -> None:
    """If a photograph has a quarter turn, also half turns are undone; the survey of the model reads the same pixels."""
    set_exif(folder / "images" / "b.png", {ORIENTATION: 6})
    set_exif(folder / "images" / "near" / "d.jpg", {ORIENTATION: 3})
    poses.find_poses(folder)
    for name in ("b.png", "near/c.webp"):
        with Image.open(folder / "images" / name) as image:
            np.testing.assert_array_equal(job[name], np.asarray(ImageOps.exif_transpose(image)))
    with Image.open(folder / "images" / "near" / "d.jpg") as image:
        turned = np.asarray(ImageOps.exif_transpose(image), np.float64)
    seen = job["near/d.jpg"]
    assert np.abs(seen - turned).mean() < np.abs(seen[::-1, ::-1] - turned).mean() / 2
    assert read_lens_facts(folder / "images" / "b.png")[0] == (48, 64)


@pytest.mark.parametrize(("name", "is_said"), [("near/c.webp", True), ("near/d.jpg", False)])
def test_mirror_images_without_a_pose_are_named(folder: Path, job: dict, name: str, is_said: bool) -> None:
    """Right tags of mirror images are undone, so that those may have poses."""
    set_exif(folder / "images" / name, {ORIENTATION: 4})
    said = []
    poses.find_poses(folder, said.append)
    assert any(f"1 of 5 photographs ({name}, ...) are mirrored by their EXIF orientation" in line for line in said) == is_said


def test_a_folder_without_poses_is_refused_with_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("optimize", "explain"):
        assert main([name, str(folder)]) == 1
        said = capsys.readouterr().err
        assert "found 5 photographs without cameras" in said and f"mivol poses {folder} finds them" in said


def test_what_cannot_have_poses_is_refused(folder: Path, job: dict, tmp_path: Path) -> None:
    assert_refused("poses in it already", poses.find_poses, write_transforms(tmp_path / "posed", {"fl_x": 20}))
    (tmp_path / "few").mkdir()
    Image.fromarray(pixels(8, 8)).save(tmp_path / "few" / "a.png")
    assert_refused("found 1 photograph in .*few, expected at least 3", poses.find_poses, tmp_path / "few")
    assert_refused("found no folder", poses.find_poses, tmp_path / "none")
    (tmp_path / "days" / "one").mkdir(parents=True)
    assert_refused("found 0 photographs .* name the folder that holds them", poses.find_poses, tmp_path / "days")
    Image.fromarray(pixels(8, 8)).save(tmp_path / "days" / "one" / "a.png")
    assert_refused(r"in folders of it only \(one\), expected them in .*images", poses.find_poses, tmp_path / "days")


def test_a_model_with_few_points_is_none(folder: Path, job: dict) -> None:
    """COLMAP poses three photographs by a single point, and the reprojection error is 0."""
    job["points"] = poses.FEWEST_POINTS - 1
    assert_refused("found 5 photographs without enough overlap", poses.find_poses, folder)
    assert not (folder / "sparse").exists() and not (folder / poses.WORK).exists()


def test_damaged_photographs_are_left_out_and_named(folder: Path, job: dict) -> None:
    """Half of a JPEG and a text are left out; with too few others the search is refused before it begins."""
    images, said = folder / "images", []
    whole = (images / "near" / "d.jpg").read_bytes()
    (images / "a.jpg").write_bytes(b"no image")
    (images / "near" / "e.jpg").write_bytes(whole[: len(whole) // 2])
    assert poses.find_poses(folder, said.append).left_out == ("a.jpg", "near/e.jpg")
    assert any(line.startswith("2 of 5 photographs are damaged and left out: a.jpg, near/e.jpg; copy") for line in said)
    assert job["order"] == ["b.png", "near/c.webp", "near/d.jpg"]
    shutil.rmtree(folder / "sparse")
    (images / "b.png").write_bytes(b"")
    assert_refused("found 2 photographs without damage, expected at least 3", poses.find_poses, folder)


@pytest.mark.parametrize("options", [{}, {"subsampling": 0, "optimize": True}, {"restart_marker_rows": 1}])
def test_a_foreign_piece_inside_a_jpeg_is_damage(tmp_path: Path, options: dict) -> None:
    """Sectors of a card that were lost are zeros; Pillow decodes them without a word. What follows the image does not count."""
    file, rng = tmp_path / "a.jpg", np.random.default_rng(0)
    coarse = Image.fromarray(rng.integers(0, 256, (80, 100, 3), np.uint8))
    coarse.resize((400, 320), Image.Resampling.BICUBIC).save(file, quality=90, **options)
    whole = file.read_bytes()
    for sound in (whole, whole + bytes(4096), whole + whole[:2000]):
        file.write_bytes(sound)
        assert not is_damaged(file)
    for start in np.linspace(0.2, 0.7, 6):
        at = int(start * len(whole))
        file.write_bytes(whole[:at] + bytes(4096) + whole[at + 4096 :])
        assert is_damaged(file), start


@pytest.mark.parametrize("options", [{"progressive": True}, {"quality": 60}])
def test_jpegs_with_a_grey_half_are_sound(tmp_path: Path, options: dict) -> None:
    """They end with the grey that a decoder shows where codes are missing."""
    image = Image.new("RGB", (640, 480), (128, 128, 128))
    image.paste(Image.fromarray(pixels(640, 100, alpha=False)))
    image.save(tmp_path / "a.jpg", **options)
    assert not is_damaged(tmp_path / "a.jpg")


def test_images_that_are_not_read_are_named(folder: Path, job: dict) -> None:
    said = []
    for name in ("x.tif", "near/y.DNG"):
        (folder / "images" / name).write_bytes(b"")
    poses.find_poses(folder, said.append)
    assert said[0].startswith("2 images are not read as photographs (near/y.DNG, x.tif): save them as PNG or JPEG")


def test_a_damaged_mask_is_refused(folder: Path, job: dict) -> None:
    (folder / "masks").mkdir()
    (folder / "masks" / "a.png").write_bytes(b"no image")
    assert_refused(r"masks/a.png: found a damaged or foreign file", poses.find_poses, folder)


def test_copies_are_left_out(folder: Path, job: dict) -> None:
    """Of equal files the first counts; with too few others the search is refused before it begins."""
    images, said = folder / "images", []
    (images / "near" / "f.jpg").write_bytes((images / "a.jpg").read_bytes())
    found = poses.find_poses(folder, said.append)
    assert "1 of 6 photographs are copies of others and left out" in said and found.left_out == ("near/f.jpg",)
    assert sorted([*found.posed, *found.unposed]) == ["a.jpg", "b.png", "near/c.webp", "near/d.jpg", "near/e.jpg"]
    shutil.rmtree(folder / "sparse")
    for name in ("b.png", "near/c.webp", "near/d.jpg", "near/e.jpg"):
        (images / name).unlink()
    (images / "g.jpg").write_bytes((images / "a.jpg").read_bytes())
    assert_refused("found 1 photograph without copies of others, expected at least 3", poses.find_poses, folder)


def test_names_with_blanks_have_aliases_and_masks_go_along(folder: Path, job: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP's lists of pairs know no blanks. A mask turns with its photograph."""
    (folder / "images" / "b.png").rename(folder / "images" / "b 2.png")
    Image.fromarray(pixels(64, 48, 3)).save(folder / "images" / "b 10.png")
    set_exif(folder / "images" / "b 2.png", {ORIENTATION: 6})
    (folder / "masks").mkdir()
    Image.fromarray(np.arange(64 * 48, dtype=np.uint8).reshape(48, 64)).save(folder / "masks" / "b 2.png")
    masks = []

    def look(given: dict, work: Path, say: object) -> tuple[list, dict]:
        masks.extend((file.name, read_photo_header(file).size) for file in Path(given["masks"]).iterdir())
        job.update(given)
        return [], {}

    monkeypatch.setattr(poses, "_run", look)
    assert_refused("without enough overlap", poses.find_poses, folder)
    assert [job["aliases"].get(name, name) for name in job["order"]][:3] == ["a.jpg", "b 2.png", "b 10.png"]
    assert all(" " not in name for name in job["order"])
    ((name, size),) = masks
    assert job["aliases"][name.removesuffix(".png")] == "b 2.png" and size == (48, 64)


FAULTS = {
    "still": ({"pairs": 10, "still": 3, "turned": 0}, "3 of 10 pairs .* background that does not move: walk around"),
    "turned": ({"pairs": 10, "still": 0, "turned": 3}, "between 3 of 10 pairs .* turned on the spot.*step to the side"),
    "neither": ({"pairs": 10, "still": 2, "turned": 2}, "photograph again in small steps"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_pairs_without_parallax_are_the_reason(folder: Path, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    """Without a model the refusal says what the pairs show, and what to photograph."""
    facts, message = FAULTS[case]
    monkeypatch.setattr(poses.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(poses, "_run", lambda job, work, say: ([], facts))
    assert_refused(message, poses.find_poses, folder)


class Features:
    """A database of COLMAP with descriptors alone."""

    def __init__(self, descriptors: list[np.ndarray]) -> None:
        self._descriptors = descriptors

    def read_all_images(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(image_id=k, name=f"{k}.jpg") for k in range(len(self._descriptors))]

    def read_descriptors(self, number: int) -> SimpleNamespace:
        return SimpleNamespace(data=self._descriptors[number])


def test_photographs_of_the_same_place_look_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 24 photographs of 12 places, seen twice with half of the features, the twin is the most alike."""
    rng = np.random.default_rng(1)
    places = rng.integers(0, 128, (12, 200, 128))
    seen = [places[k % 12][rng.permutation(200)[:100]] + rng.integers(0, 9, (100, 128)) for k in range(24)]
    alike = colmap_process.find_alike(Features([rows.astype(np.uint8) for rows in seen]))
    assert [alike[f"{k}.jpg"][0] for k in range(24)] == [f"{(k + 12) % 24}.jpg" for k in range(24)]
    assert colmap_process.find_alike(Features([np.zeros((0, 128), np.uint8)] * 3)) == {}


@pytest.mark.parametrize(("offset", "is_turn"), [(0.0, True), (0.3, False)])
def test_a_turn_on_the_spot_is_told_from_a_plane(offset: float, is_turn: bool) -> None:
    """R + t n^T, seen with a focal length of 0.9 widths, by 25 degrees: t = 0, or a plane seen from the side."""
    K, angle = np.array([[576.0, 0, 320], [0, 576, 240], [0, 0, 1]]), np.radians(25)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turn += np.outer([offset, 0.1 * offset, 0], [0, 0, 1])
    assert colmap_process.is_turn(3.7 * K @ turn @ np.linalg.inv(K), (640, 480)) == is_turn


@pytest.mark.parametrize(("shift", "turned"), [(0.08, 0), (0.15, 1)])
def test_a_turn_moves_points_by_a_tenth_of_the_width(shift: float, turned: int) -> None:
    """With less, a homography without parallax may belong to a camera that stands still."""
    pair = SimpleNamespace(inlier_matches=np.tile(np.arange(30)[:, None], 2), config="PANORAMIC", H=np.eye(3))
    database = contextlib.nullcontext(
        SimpleNamespace(
            read_all_images=lambda: [SimpleNamespace(image_id=k, name=f"{k}.jpg", camera_id=1) for k in (1, 2)],
            read_keypoints=lambda number: np.full((30, 2), 640 * shift * number) * [1, 0],
            read_camera=lambda number: SimpleNamespace(width=640, height=480),
            read_two_view_geometries=lambda: ([3], [pair]),
        )
    )
    pycolmap = SimpleNamespace(
        TwoViewGeometryConfiguration=SimpleNamespace(PANORAMIC="PANORAMIC", PLANAR_OR_PANORAMIC="PLANAR_OR_PANORAMIC"),
        Database=SimpleNamespace(open=lambda path: database),
        pair_id_to_image_pair=lambda number: (1, 2),
    )
    facts = colmap_process.describe_matches(pycolmap, Path("a.db"), {})
    assert (facts["pairs"], facts["still"], facts["turned"]) == (1, 0, turned)


def test_a_sequence_is_matched_with_neighbours_and_with_what_looks_alike() -> None:
    names = [f"{k}" for k in range(40)]
    pairs = colmap_process.list_pairs(names, {"0": ["1", "39"], "39": ["0"]})
    steps = {int(b) - int(a) for a, b in pairs}
    assert steps == {*range(1, 11), 16, 32, 39} and len(pairs) == len({frozenset(pair) for pair in pairs})
    assert len(colmap_process.list_pairs(names, None)) == 40 * 39 // 2


def test_a_page_shows_cameras_and_errors(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "a b")
    found = poses.Poses(folder / "sparse" / "0", ("a.png", "b.png"), ("c<d>.png",), 0.734, 12, 1, left_out=("half.jpg",))
    text = cameras.write_poses_page(folder, found).read_text()
    for fact in (
        "2 of 3",
        "0.73 pixels",
        "c&lt;d&gt;.png",
        "half.jpg",
        "data:image/png;base64,",
        f"mivol view &#x27;{folder}&#x27;",
    ):
        assert fact in text
    assert "http" not in text


def test_an_interrupted_search_continues(folder: Path, job: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its features stay for the same photographs, and go with other ones."""
    run = poses._run

    def interrupt(*given: object) -> None:
        (folder / poses.WORK / "database.db").write_text("features")
        raise KeyboardInterrupt

    monkeypatch.setattr(poses, "_run", interrupt)
    with pytest.raises(KeyboardInterrupt):
        poses.find_poses(folder)
    seen: list[bool] = []

    def look(*given: object) -> object:
        seen.append((folder / poses.WORK / "database.db").exists())
        if len(seen) == 1:
            raise KeyboardInterrupt
        return run(*given)

    monkeypatch.setattr(poses, "_run", look)
    with pytest.raises(KeyboardInterrupt):
        poses.find_poses(folder)
    Image.fromarray(pixels(8, 8)).save(folder / "images" / "new.png")
    poses.find_poses(folder)
    assert seen == [True, False] and not (folder / poses.WORK).exists()


def test_pycolmap_is_asked_for(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(poses.importlib.util, "find_spec", lambda name: None)
    assert_refused(r'pip install "mivol\[poses\]"', poses.find_poses, folder)


@pytest.mark.parametrize(
    ("together", "one_by_one", "kept"),
    [
        ((5, 0.5, 7), None, 7),
        ((3, 0.5, 7), (4, 0.5, 6), 6),
        ((3, 0.5, 7), (2, 0.5, 9), 7),
        ((0, 0.5, 0), (4, 0.5, 9), 9),
        ((5, 0.9, 7), (5, 0.4, 9), 9),
        ((5, 0.9, 7), (5, 0.8, 6), 7),
        ((5, 0.5, 7, 2), None, 7),
        ((5, 0.5, 7, 3), (5, 0.5, 6, 0), 6),
        ((5, 0.5, 7, 3), (4, 0.5, 9, 0), 7),
        ((5, 0.5, 7, 30), (4, 0.5, 6, 0), 6),
    ],
)
def test_poses_are_found_one_by_one_if_photographs_are_left_out_or_points_disagree(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    together: tuple[float, ...],
    one_by_one: tuple[float, ...] | None,
    kept: int,
) -> None:
    """Photographs, error, points and contradicting pairs (of 100) of the models, and the points of the model that is kept.

    If all photographs have poses of a small error that the pairs agree with, the second search does not run.
    """

    def make(found: tuple[float, ...] | None) -> Callable[..., dict]:
        count, error, points, against = (*(found or (None, 0.0, 0)), 0)[:4]

        def search(database: Path, images: Path, models: Path, options: object) -> dict:
            assert count is not None and options.random_seed == 0 and models.is_dir()
            model = SimpleNamespace(
                images={k: SimpleNamespace(name=f"{k}.png", has_pose=k < count) for k in range(5)},
                write=lambda folder: (folder / "cameras.bin").write_text(str(points)),
                compute_mean_reprojection_error=lambda: error,
                num_points3D=lambda: points,
                num_cameras=lambda: 1,
                against=(against, 100),
            )
            return {0: model} if count else {}

        return search

    monkeypatch.setattr(colmap_process, "count_contradictions", lambda pycolmap, database, model: model.against)
    library = MagicMock(global_mapping=make(together), incremental_mapping=make(one_by_one))
    monkeypatch.setitem(sys.modules, "pycolmap", library)
    (tmp_path / "models").mkdir()
    names = [f"{k}.png" for k in range(5)]
    job = {
        "images": "images",
        "names": [names],
        "order": names,
        "masks": "",
        "sequential": False,
        "longest": 100,
        "aliases": {},
    }
    colmap_process.run(job | {"database": str(tmp_path / "db"), "models": str(tmp_path / "models")})
    said = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (model,) = said[-1]["models"]
    assert model["points"] == kept and (Path(model["folder"]) / "cameras.bin").read_text() == str(kept)
    assert any("one by one" in facts.get("stage", "") for facts in said) == (one_by_one is not None)


def test_a_photograph_of_another_thing_is_named() -> None:
    said = poses.Poses(Path("m"), ("a", "b", "c"), ("d", "e"), 0.5, 9, 1, best={"d": ("a", 0), "e": ("b", 80)}).describe()
    assert "without a pose: d (shows no part of another photograph), e; " in said and "each other" not in said


def test_photographs_of_another_place_are_named() -> None:
    """Those whose best partner has no pose either; COLMAP makes models of ten photographs and more alone."""
    best = {"d": ("e", 50), "e": ("d", 50), "f": ("a", 80), "g": ("d", 49)}
    said = poses.Poses(Path("m"), ("a", "b", "c"), ("d", "e", "f", "g"), 0.5, 9, 1, best=best).describe()
    assert "without a pose: d, e, which match each other better than photographs with poses; photograph what lies" in said
    assert "between them and c, or put another place into a folder of its own" in said
    assert "without a pose: f, g (few matches: 49 points in common with d); photograph again" in said


@pytest.mark.parametrize(("against", "is_said"), [(12, False), (13, True)])
def test_poses_that_pairs_contradict_are_doubted(tmp_path: Path, folder: Path, job: dict, against: int, is_said: bool) -> None:
    """More than ``AGAINST`` of 630 pairs are said on the terminal and on the page, with what to photograph."""
    job["against"] = (against, 630)
    found = poses.find_poses(folder)
    page = cameras.write_poses_page(write_colmap(tmp_path / "posed"), found).read_text(encoding="utf-8")
    for text in (found.describe(), page):
        assert (f"{against} of 630 pairs of photographs contradict these poses" in text) == is_said
    assert f"<td>{against} of 630</td>" in page


def test_pairs_contradict_a_camera_on_the_wrong_side(tmp_path: Path) -> None:
    """Ten cameras around points, by pycolmap: of 45 pairs none contradicts, but the nine of a camera that is moved."""
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_points3D = 120
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(tmp_path / "db") as database:
        model = pycolmap.synthesize_dataset(options, database)
    assert colmap_process.count_contradictions(pycolmap, tmp_path / "db", model) == (0, 45)
    first = next(iter(model.frames.values()))
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0.2, 0, 1])), np.zeros(3))
    first.rig_from_world = turn * first.rig_from_world
    assert colmap_process.count_contradictions(pycolmap, tmp_path / "db", model) == (9, 45)


@pytest.mark.parametrize(("count", "sizes", "expected"), [(100, (0.3, 0.3), 1), (99, (0.3, 0.3), 0), (100, (0.3, 0.2), 0)])
def test_a_small_part_that_is_there_twice_contradicts_nothing(count: int, sizes: tuple[float, float], expected: bool) -> None:
    """A line of a size has a spread of its size over the square root of 12."""
    line = np.stack([np.linspace(0, 1, count), np.zeros(count)], axis=1) * np.sqrt(12)
    assert colmap_process.is_spread([size / 2.9 * line for size in sizes]) == expected


def test_a_full_disk_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "colmap_process.py").write_text("raise SystemExit(1)")
    monkeypatch.setattr(poses, "__file__", str(tmp_path / "poses.py"))
    monkeypatch.setattr(poses.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(poses.shutil, "disk_usage", lambda path: SimpleNamespace(free=2**24 - 1))
    assert_refused("filled the disk: free some space, about 2 MB for each photograph", poses.find_poses, folder)


PROGRAMS = {
    "nothing": ('print(\'{"stage": "matches"}\\n{"models": []}\')', "found 5 photographs without enough overlap"),
    "an error": ("raise RuntimeError('out of disk')", "COLMAP ended early .RuntimeError: out of disk."),
}


@pytest.mark.parametrize("case", PROGRAMS)
def test_a_program_that_finds_nothing_or_fails(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, case: str
) -> None:
    program, message = PROGRAMS[case]
    (tmp_path / "colmap_process.py").write_text(program)
    monkeypatch.setattr(poses, "__file__", str(tmp_path / "poses.py"))
    monkeypatch.setattr(poses.importlib.util, "find_spec", lambda name: object())
    stages = []
    assert_refused(message, poses.find_poses, folder, stages.append)
    assert stages == (["matches"] if case == "nothing" else [])
    assert not (folder / "sparse").exists()


def test_photographs_beside_the_model(tmp_path: Path) -> None:
    """Without a folder ``images`` the names count from the folder of ``sparse``."""
    folder = write_colmap(tmp_path / "set")
    for file in list((folder / "images").iterdir()):
        file.rename(folder / file.name)
    (folder / "images").rmdir()
    box = np.array([[-1.0] * 3, [1.0] * 3])
    for path in (folder, folder / "sparse" / "0"):
        assert len(survey_photos(path, box=box).frames) == 4
    assert list_photographs(folder) == (folder, [f"a view {k}.png" for k in range(4)])


def test_half_turns_of_colmap_are_of_stored_pixels(tmp_path: Path) -> None:
    """COLMAP ignores EXIF, so without another proof its cameras describe the pixels as stored."""
    folder = write_colmap(tmp_path / "set")
    set_exif(folder / "images" / "a view 1.png", {ORIENTATION: 3})
    frames = survey_photos(folder, box=np.array([[-1.0] * 3, [1.0] * 3])).frames
    assert [frame.orientation for frame in frames] == [1] * 4


@pytest.mark.parametrize("suffix", ["binary", "text"])
@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_rigs_of_pycolmap(tmp_path: Path, model: str, suffix: str) -> None:
    """Each pixel of two cameras of a rig has the ray that pycolmap gives it, which composes the poses of frame and rig.

    pycolmap's search for a ray ends at steps of 1e-10.
    """
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera.create_from_model_id(1, getattr(pycolmap.CameraModelId, model), 40.0, 64, 48)
    terms = zip(CAMERA_MODELS[model], camera.params, strict=True)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=2,
        num_frames_per_rig=2,
        num_points3D=10,
        camera_width=64,
        camera_height=48,
        camera_model_id=camera.model,
        camera_params=[0.01 if name[0] in "kp" else value for name, value in terms],
        sensor_from_rig_translation_stddev=0.5,
        sensor_from_rig_rotation_stddev=20.0,
    )
    made = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    getattr(made, f"write_{suffix}")(tmp_path / "sparse" / "0")
    listing = read_colmap(tmp_path)
    images = {image.name: image for image in made.images.values()}
    assert len(listing.entries) == len(images) == 4 and {image.camera_id for image in images.values()} == {1, 2}
    corners = np.array([[0.5, 0.5], [60.0, 10.0], [20.0, 44.0]])
    for entry in listing.entries:
        image, ours = images[entry.name], entry.camera(entry.size)
        turn = image.cam_from_world().rotation.inverse().matrix()
        expected = np.array([turn @ image.camera.cam_ray_from_img(corner) for corner in corners])
        np.testing.assert_allclose(directions(ours, corners) @ ours.to_world[:3, :3].T, expected, atol=1e-9)
        np.testing.assert_allclose(ours.origin, image.projection_center(), atol=1e-12)


@pytest.mark.slow
def test_rendered_photographs_have_the_poses_of_their_cameras(variant_rgb: str, tmp_path: Path) -> None:
    """Ten views of textured boxes: all have poses, and positions equal the true ones up to a similarity.

    The mean error of a feature is below 1 pixel of 440, and a camera sees hundreds of them; so positions are within 1 % of the
    distance of 2.6.
    """
    if poses.importlib.util.find_spec("pycolmap") is None:
        pytest.skip("poses need pycolmap: pip install mivol[poses]")
    import mitsuba as mi

    def texture(seed: int) -> dict:
        rng, image = np.random.default_rng(seed), np.zeros((256, 256, 3))
        for n in (8, 16, 32, 64, 128):
            image += np.kron(rng.random((n, n, 3)), np.ones((256 // n, 256 // n, 1)))
        bitmap = mi.Bitmap((image / image.max()).astype(np.float32))
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap}}}

    place = mi.ScalarTransform4f
    shapes = {
        f"box{k}": {"type": "cube", "to_world": place().translate([x, y, 0.3]).scale(0.3), "bsdf": texture(k)}
        for k, (x, y) in enumerate([(-0.4, 0.0), (0.5, 0.3), (0.1, -0.7)])
    }
    floor = {"type": "rectangle", "to_world": place().scale(1.6), "bsdf": texture(9)}
    scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, "floor": floor, **shapes})
    (tmp_path / "images").mkdir()
    origins = []
    for k in range(10):
        angle = -2.0 + 0.1 * k
        origins.append([2.6 * np.cos(angle), 2.6 * np.sin(angle), 0.9 + 0.3 * np.sin(1.9 * k)])
        film = {"type": "hdrfilm", "width": 480, "height": 360}
        view = place().look_at(origins[-1], [0, 0, 0.3], [0, 0, 1])
        sensor = mi.load_dict({"type": "perspective", "fov": 55.0, "to_world": view, "film": film})
        image = mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "direct"}), spp=16, seed=k)
        mi.util.write_bitmap(str(tmp_path / "images" / f"{k}.png"), image, write_async=False)
    assert poses.find_poses(tmp_path).unposed == ()
    found = np.array([frame.camera.origin for frame in survey_photos(tmp_path).frames])
    true = np.array(origins)
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(a.T @ b)
    signs = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    aligned = a @ (u @ signs @ vt) * (s * np.diag(signs)).sum() / (a**2).sum()
    assert np.linalg.norm(aligned - b, axis=1).max() < 0.026
