"""``mivol optimize`` on photographs: from a folder of views to a page, stopped and resumed, and what it refuses."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from photo_sets import orbit, write_blender
from PIL import Image
from refusals import assert_refused
from tiny_experiment import assert_explained, resume_stopped_fit

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments import field_fit, photo_data
from mivol.experiments.field_fit import FieldFit
from mivol.experiments.fit_kind import RunContext
from mivol.experiments.photo_fit import PhotoFit
from mivol.fields.field_files import read_field
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_exr, write_exr, write_png
from mivol.files.image_files import decode_srgb
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import FEW_PHOTOGRAPHS, PRESETS, RadiancePlan, RadianceStage, scale_longest
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.photos import Camera, Photos, intrinsics
from mivol.photos.region import FEWEST_VIEWS, find_free_distances
from mivol.photos.transforms import write_transforms
from mivol.validate.metrics import score_image

SIZE, VIEWS = 48, 20


def ball(res: int = 12) -> SphericalGrid:
    """A ball of radius 0.6 in the cube from -1 to 1, its colour a ramp along x."""
    axis = (np.arange(res) + 0.5) / res * 2 - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    density = 60 * (0.6 - np.sqrt(x**2 + y**2 + z**2))
    sh = np.zeros((res, res, res, 1, 3))
    sh[..., 0, 0], sh[..., 0, 1] = x, -x
    place = np.diag([2.0, 2, 2, 1])
    place[:3, 3] = -1
    return SphericalGrid.from_dense(density, sh, place)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Views of the ball over white, all around it."""
    import mitsuba as mi

    import mivol.plugins  # noqa: F401

    mi.set_variant("llvm_ad_rgb")
    folder, truth = tmp_path_factory.mktemp("photographs"), ball()
    cameras = orbit("view_{}.png", VIEWS, 1.0, Camera(intrinsics(60, 60, SIZE / 2, SIZE / 2), (SIZE, SIZE), np.eye(4)))
    for name, camera in cameras.items():
        write_png(folder / name, decode_srgb(np.clip(render_view(truth, camera, np.ones(3)).image, 0, 1)))
    write_transforms(folder / "transforms.json", cameras, ["view_3.png", "view_8.png"])
    return folder


@pytest.fixture(scope="module")
def photos(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Photos:
    """The photographs that the experiment fits."""
    folder = tmp_path_factory.mktemp("experiment")
    return photo_data.read_photos(config.load(toml(folder, photographs)), folder)[0]


def toml(folder: Path, photographs: Path, more: str = "") -> Path:
    path = folder / "fit.toml"
    path.write_text(
        f"""
        title = "A ball"
        checkpoint_every = 10
        [photos]
        path = "{photographs}"
        background = "white"
        box = [[-1, -1, -1], [1, 1, 1]]
        held_out = 0
        judged = "test"
        [field]
        preset = "tiny"
        longest = 26
        degree = 0
        effort = 0.5
        [show]
        frames = 3
        views = 1
        every = 20
        {more}
        """
    )
    return path


@pytest.mark.slow
def test_photographs_become_a_field_and_a_page(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The field is as good on views that it has not seen as the ball's edge, a pixel wide, lets a grid of 24 be."""
    path = toml(tmp_path, photographs)
    assert main(["optimize", str(path), "-o", str(tmp_path / "run")]) == 0
    printed = capsys.readouterr()
    assert printed.out.strip().endswith("report.html")
    before, _, after = printed.err.partition(" iterations in ")
    assert "loss" in after
    facts = "box (-1, -1, -1) to (1, 1, 1), as given", "behind the box: photos.background", "cameras: 1.", "MiB: photographs"
    for text in facts:
        assert text in before
    record = json.loads((tmp_path / "run/run.json").read_text())
    # A white picture would have 9 dB, a grey ball 15.
    assert record["results"]["held_out_psnr"] > 26
    shown = [image["view"] for image in record["images"] if image["role"] == "render"]
    assert sorted(shown) == ["view_3.png", "view_8.png"]  # all that are judged, the worst first
    made = read_field(tmp_path / "run/field.npz")
    assert made.nodes is not None
    assert record["results"]["nodes"] == len(made.stored_nodes())
    page = (tmp_path / "run/report.html").read_text().replace("\u2011", "-").replace("\xa0", " ")
    assert "PSNR compares 8-bit sRGB values; its peak is 1." in page
    assert "largest value as its peak" not in page
    assert f"{record['results']['held_out_psnr']:.1f} dB PSNR on held-out views" in page
    shown = ("data:video/mp4;base64,", "distance of the first held-out view", "Cameras, and the box of the matter", "Storage")
    for text in (*shown, "view_3.png"):
        assert text in page
    rows = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["iteration"] == record["results"]["iterations"] == field_fit.make_radiance_plan(config.load(path)).steps
    assert all({"loss", "held_out_psnr"} <= row.keys() for row in rows)


@pytest.mark.slow
def test_a_film_without_ffmpeg_is_an_animated_image(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit that is done is not lost for want of a program: its film is written otherwise, which is said once."""
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    path = toml(tmp_path, photographs)
    assert main(["optimize", str(path), "-o", str(tmp_path / "run"), "--set", "field.effort=0.02"]) == 0
    assert capsys.readouterr().err.count("imageio-ffmpeg") == 1
    with Image.open(tmp_path / "run/film/turntable.webp") as film:
        assert film.n_frames == 3
    page = (tmp_path / "run/report.html").read_text()
    assert '<img alt="3 views around the box" src="data:image/webp;base64,' in page and "<video" not in page


def test_what_a_field_takes_is_told_in_bytes_a_node(tmp_path: Path, variant_rgb: str) -> None:
    """Of 6^3 nodes: 4 numbers of a byte, 4 of four bytes; a density and 3 colours, in rows of 4, of four bytes."""
    (tmp_path / "field.npz").write_bytes(bytes(864))
    table = field_fit.tabulate_storage(ball(6), tmp_path / "field.npz")
    assert [row[2] for row in table.rows] == ["4", "16", "20", "20", "4"]
    assert [row[1] for row in table.rows][-1] == f"{864 / 2**20:.2f} MiB"
    assert table.head[0] == "216 of 216 nodes are kept (100.0%)"


@pytest.mark.slow
def test_the_best_field_is_kept_beside_the_last(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Judged best in the middle: that field lies in field_best.npz, which is said last but one and noted; the last line of
    the console is what was saved."""
    path, seen = toml(tmp_path, photographs), []

    def judged(fit: PhotoFit) -> dict[str, float]:
        seen.append(fit.problem.field.to_dense()[0])
        return {"few_psnr": {2: 25.0}.get(len(seen), 20.0)}

    monkeypatch.setattr(PhotoFit, "judge_few", judged)
    short = ["--set", "field.effort=0.1", "--set", "show.every=10"]
    assert main(["optimize", str(path), "-o", str(tmp_path / "run"), *short]) == 0
    assert len(seen) == 3

    def nearest(name: str) -> int:
        """Which look saw the field of a file; files hold it in fewer digits."""
        found = read_field(tmp_path / f"run/{name}.npz").to_dense()[0]
        return min(range(3), key=lambda i: np.abs(seen[i] - found).max() if seen[i].shape == found.shape else np.inf)

    assert (nearest("field_best"), nearest("field")) == (1, 2)
    record = json.loads((tmp_path / "run/run.json").read_text())
    risen, saved = capsys.readouterr().err.strip().splitlines()[-2:]
    assert "was best at iteration 20, 25 dB, and is 20 dB at the end: field_best.npz holds the best iterate" in risen
    assert risen in record["notes"]
    assert saved.startswith("result: ")
    assert f"PSNR of the held-out views {record['results']['held_out_psnr']:.4g} dB" in saved


@pytest.mark.slow
def test_what_is_behind_is_learned(photographs: Path, tmp_path: Path) -> None:
    """Views over white, said to be over black: a sky finds the white, and is kept as an image beside the field."""
    path = toml(tmp_path, photographs)
    more = ["--set", "photos.background=black", "--set", "field.sky=4"]
    assert main(["optimize", str(path), "-o", str(tmp_path / "run"), *more]) == 0
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["results"]["held_out_psnr"] > 22
    channels, _ = read_exr(tmp_path / "run/sky.exr")
    # Cameras are all around, so most of the sky was seen; what was not has stayed what most pixels show.
    assert all(np.median(channels[name]) > 0.9 for name in "RGB")


@pytest.mark.slow
def test_a_stopped_fit_goes_on(photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle keeps what was done; the resumed fit ends with all steps, and says nothing twice."""
    started = resume_stopped_fit(toml(tmp_path, photographs), RadianceProblem, "field.degree=1", monkeypatch)
    assert started[0] == 45
    rows = [json.loads(line)["iteration"] for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert rows == sorted(set(rows))


def test_what_the_file_says_overrides_the_preset(tmp_path: Path) -> None:
    raw = {"title": "x", "photos": {"path": "p"}}
    assert field_fit.make_radiance_plan(config.from_dict(raw)) == PRESETS["cpu"]
    raw["field"] = {"preset": "cpu", "longest": 40, "degree": 1, "effort": 0.5, "tv_sh": 1e-3}
    plan = field_fit.make_radiance_plan(config.from_dict(raw))
    assert [stage.longest for stage in plan.stages] == [32, 40]
    raw["field"]["longest"] = 200
    assert [stage.longest for stage in field_fit.make_radiance_plan(config.from_dict(raw)).stages] == [32, 64, 128, 200]
    assert plan.stages[0].steps == round(PRESETS["cpu"].stages[0].steps / 2)
    assert (plan.degree, plan.tv_sh, plan.tv_density) == (1, 1e-3, PRESETS["cpu"].tv_density)


def test_what_was_done_to_linear_photographs_is_said(photographs: Path, tmp_path: Path) -> None:
    text = (photographs / "transforms.json").read_text().replace(".png", ".exr")
    (tmp_path / "transforms.json").write_text(text)
    for frame in json.loads(text)["frames"]:
        write_exr(tmp_path / frame["file_path"], {name: np.full((SIZE, SIZE), 2.0, np.float32) for name in "RGB"})
    said = []
    for folder in (photographs, tmp_path):
        photos, _ = photo_data.read_photos(config.load(toml(tmp_path, folder), ["photos.space=srgb"]), tmp_path)
        said.append(" ".join(photo_data.describe_photos(photos)))
    assert ["Photographs of radiance were encoded" in note for note in said] == [False, True]
    assert all("sRGB values" in note for note in said)


def test_what_is_taken_to_be_behind_is_said(photographs: Path, tmp_path: Path) -> None:
    """The ball fills the middle of each view: its edges are white, whatever colour the file says is behind it."""
    chosen = config.load(toml(tmp_path, photographs), ["photos.background=[0, 0.5, 0]"])
    photos, _ = photo_data.read_photos(chosen, tmp_path)
    plan = field_fit.make_radiance_plan(chosen)
    said = field_fit.explain_background(plan, photos)
    assert said.choice == "the colour (0, 0.5, 0) behind the box"
    assert "edges of the photographs is (1, 1, 1)" in said.reason
    assert "sky of 8 rows" in field_fit.explain_background(replace(plan, sky=8), photos).choice
    clear = replace(photos, views=tuple(replace(v, alpha=np.ones((SIZE, SIZE))) for v in photos.views))
    assert "alpha" in field_fit.explain_background(plan, clear).reason


@pytest.mark.parametrize(
    ("background", "preset", "levels", "sky"),
    [("", "tiny", 1, 0), ("sky", "tiny", 1, 32), ("nested", "tiny", 5, 32), ("white", "tiny", 1, 0), ("", "capture", 5, 32),
     ("sky", "capture", 5, 32), ("black", "capture", 5, 0), ("nested", "capture", 5, 32)],
)  # fmt: skip
def test_what_is_behind_has_a_name(
    photographs: Path, tmp_path: Path, background: str, preset: str, levels: int, sky: int
) -> None:
    """A name says what is learned; a number of rows or of boxes that is given counts all the same."""
    named = [f'photos.background="{background}"']
    chosen = config.load(toml(tmp_path, photographs), [f"field.preset={preset}", *named])
    plan = field_fit.make_radiance_plan(chosen)
    assert (plan.levels, plan.sky, plan.near > 0) == (levels, sky, levels > 1)
    given = config.load(toml(tmp_path, photographs), [f"field.preset={preset}", "field.sky=6", "field.levels=2", *named])
    assert (field_fit.make_radiance_plan(given).levels, field_fit.make_radiance_plan(given).sky) == (2, 6)
    colour = [1.0] * 3 if background == "white" else [0.0] * 3
    photos, judged = photo_data.read_photos(chosen, tmp_path)
    assert judged is not None
    for view in (*photos.views, *judged.views):
        assert view.background.tolist() == colour


def test_nested_boxes_by_name_begin_between_the_cameras(photographs: Path, tmp_path: Path) -> None:
    """As those of the preset for captures, where no box is given."""
    found = []
    for change in ("photos.background=nested", "photos.box=middle"):
        path = toml(tmp_path, photographs)
        path.write_text(path.read_text().replace("box = [[-1, -1, -1], [1, 1, 1]]", ""))
        found.append(photo_data.read_photos(config.load(path, [change]), tmp_path)[0].box)
    assert np.array_equal(*found) and not np.array_equal(found[0], [[-1] * 3, [1] * 3])


@pytest.mark.parametrize(
    ("background", "said"),
    [("sky", "is not for photographs with alpha: white, black, random or an rgb triple"), ("skies", "is unknown")],
)
def test_what_alpha_shows_has_no_sky(tmp_path: Path, background: str, said: str) -> None:
    write_blender(tmp_path / "set")
    chosen = config.load(toml(tmp_path, tmp_path / "set"), [f"photos.background={background}"])
    assert_refused(said, photo_data.read_photos, chosen, tmp_path)


def test_random_backgrounds_have_a_colour_a_photograph(tmp_path: Path) -> None:
    """Of photographs that are fitted, and of those that judge."""
    write_blender(tmp_path / "set")
    chosen = config.load(toml(tmp_path, tmp_path / "set"), ["photos.background=random", 'show.metrics=["psnr"]'])
    photos, judged = photo_data.read_photos(chosen, tmp_path)
    assert judged is not None
    for views in (photos.views, judged.views):
        assert len({tuple(view.background) for view in views}) == len(views) > 1
    view = photos.views[0]
    at = view.alpha == 0
    assert at.any() and np.array_equal(view.image[at], np.broadcast_to(view.background, view.image[at].shape))


def test_photographs_are_shrunk_to_half_a_voxel(photos: Photos) -> None:
    """Pixels of 3.5 / 60 = 0.058 at the ball: half a voxel of 2 / 4 holds 4.3, of 2 / 8 two, of 2 / 11 1.6, of 2 / 13 1.3.

    The nearest power of two is taken, in octaves: 2 for 1.6 and 1 for 1.3. Of 48 pixels at least 16 stay, so 4 becomes 2.
    """
    plan = RadiancePlan((RadianceStage(4, 1), RadianceStage(8, 1), RadianceStage(11, 1), RadianceStage(13, 1, shrink=4)))
    assert [stage.shrink for stage in field_fit.adapt_plan(plan, photos).stages] == [2, 2, 2, 1]


def test_stages_look_at_each_pixel_so_often_at_most(photos: Photos, photographs: Path, tmp_path: Path) -> None:
    """20 epochs of V photographs: of 24 x 24 by 2 tiles of 16 pixels of 3 of them, and of 48 x 48 by one tile of each."""
    count = len(photos.views)
    stages = (
        RadianceStage(11, 10_000, views=3, tiles=2),
        RadianceStage(13, 10_000, views=1000, tiles=1),
        RadianceStage(13, 5, views=1, tiles=1),
    )
    plan = RadiancePlan(stages, epochs=20.0)
    expected = [20 * count * 24**2 // 96, 20 * 48**2 // 16, 5]
    assert [stage.steps for stage in field_fit.adapt_plan(plan, photos).stages] == expected
    few, least = field_fit.adapt_plan(replace(plan, stages=stages[:2], epochs=0.1), photos), field_fit.FEWEST_STEPS
    # So many steps of the last stage look at each pixel least / 144 times.
    assert [stage.steps for stage in few.stages] == [least * count * 24**2 // (96 * 144), least]
    assert [stage.steps for stage in field_fit.adapt_plan(RadiancePlan(stages), photos).stages] == [10_000, 10_000, 5]
    asked = field_fit.make_radiance_plan(config.load(toml(tmp_path, photographs), ["field.preset=fine", "field.effort=3"]))
    assert asked.epochs == 3 * PRESETS["fine"].epochs < math.inf  # who asks for more gets more
    assert "each pixel is used at most 20 times" in field_fit.explain_steps(plan).reason
    assert field_fit.explain_steps(RadiancePlan(stages)).reason == "the preset's, times field.effort"


def test_a_long_box_has_as_many_nodes_as_a_cube(photos: Photos, photographs: Path, tmp_path: Path) -> None:
    """A box of 2 x 0.5 x 0.25 with 8 nodes along it has 8 x 2 x 1; with 8 / (2^-2 2^-3)^(1/3) = 25.4 it has 8^3.

    Voxels are no smaller than two pixels of 0.058 for that (17 along 2), or what the plan says (one and a half: 22); never
    smaller than a pixel (34), for a few nodes more than that (16); and as they are where a file says so.
    """
    slab = np.array([[-1, -0.25, -0.125], [1, 0.25, 0.125]])
    assert scale_longest(8, slab) == 25 and scale_longest(8, photos.box) == 8
    long = replace(photos, survey=replace(photos.survey, box=slab))
    plan = RadiancePlan((RadianceStage(4, 1), RadianceStage(8, 1), RadianceStage(40, 1)))
    assert [stage.longest for stage in field_fit.adapt_plan(plan, long).stages] == [13, 17, 34]
    assert [stage.longest for stage in field_fit.adapt_plan(replace(plan, voxel=1.5), long).stages] == [13, 22, 34]
    quarter = np.diag([0.25, 0.25, 1])
    cameras = [replace(view.camera, K=quarter @ view.camera.K) for view in long.views]
    far = replace(long, views=tuple(replace(v, camera=c) for v, c in zip(long.views, cameras, strict=True)))
    assert [stage.longest for stage in field_fit.adapt_plan(plan, far).stages] == [4, 8, 16]
    assert field_fit.adapt_plan(field_fit.adapt_plan(plan, long), long) == field_fit.adapt_plan(plan, long)
    assert [stage.longest for stage in field_fit.adapt_plan(replace(plan, cubic=False), long).stages] == [4, 8, 40]
    assert not field_fit.make_radiance_plan(config.load(toml(tmp_path, photographs), ["field.longest=26"])).cubic


def test_few_photographs_are_smoothed_each_step(photographs: Path, tmp_path: Path) -> None:
    """Many are looked at every fourth step, where one move would be several learning rates of a few."""
    chosen = config.load(toml(tmp_path, photographs), ["field.preset=cpu"])
    photos, _ = photo_data.read_photos(chosen, tmp_path)
    plan = field_fit.make_radiance_plan(chosen)
    assert plan.tv_every == 4 and len(photos.views) < FEW_PHOTOGRAPHS
    assert field_fit.adapt_plan(plan, photos).tv_every == 1
    many = replace(photos, views=photos.views * (FEW_PHOTOGRAPHS // len(photos.views) + 1))
    assert field_fit.adapt_plan(plan, many).tv_every == 4


def test_colours_of_few_photographs_do_not_decay(photos: Photos) -> None:
    """The preset for captures asks few for less than many, of the degree too; what the file says holds for both."""
    many = replace(photos, views=photos.views * (FEW_PHOTOGRAPHS // len(photos.views) + 1))

    def found(**field: float) -> list[tuple[float, int]]:
        raw = {"title": "x", "photos": {"path": "p"}, "field": {"preset": "capture", **field}}
        plan = field_fit.make_radiance_plan(config.from_dict(raw))
        return [(one.matte, one.degree) for one in (field_fit.adapt_plan(plan, photos), field_fit.adapt_plan(plan, many))]

    assert found() == [(0, 1), (12, 2)]
    assert found(matte=3.0) == [(3, 1), (3, 2)]
    assert found(degree=2) == [(0, 2), (12, 2)]
    assert found(preset="cpu") == [(12, 2), (12, 2)]


def test_the_degree_of_the_first_stage_is_named() -> None:
    plan = replace(PRESETS["capture"], degree=1, first_degree=0)
    assert field_fit.explain_degree(plan, 60).choice == "harmonics of degree 1, 0 in the first stage"
    assert field_fit.explain_degree(replace(plan, first_degree=None), 60).choice == "harmonics of degree 1"


def test_nested_boxes_are_those_that_points_and_cameras_need(photos: Photos, photographs: Path, tmp_path: Path) -> None:
    """Points up to 6 half edges from the middle need 4 boxes of 5, and so do cameras at half that distance; the plan says what
    is left out, and where cameras stand."""
    chosen = config.load(toml(tmp_path, photographs))
    half = (photos.box[1] - photos.box[0]) / 2
    points = photos.box.mean(axis=0) + half * np.concatenate([np.tile([0, 6, 0], (997, 1)), np.tile([0, 0, 9], (3, 1))])
    plan = replace(field_fit.make_radiance_plan(chosen), levels=5, near=1.0)
    assert field_fit.adapt_plan(plan, photos).levels == 5
    stands = max(np.abs((view.camera.origin - photos.box.mean(axis=0)) / half).max() for view in photos.views)
    assert 2 < stands < 4

    def said(points: np.ndarray, plan: RadiancePlan) -> str:
        known = replace(photos, survey=replace(photos.survey, points=points))
        fitting = field_fit.adapt_plan(plan, known)
        lines = field_fit.explain_plan(fitting, known, field_fit.make_batches(fitting, known))
        return "\n".join(f"{line.choice}: {line.reason}" for line in lines)

    text = said(points, plan)
    assert (
        "4 nested boxes" in text
        and "no more than points and cameras need" in text
        and f"0 of {len(photos.views)} cameras stand in the innermost" in text
    )
    assert "3 of 1000 points of the reconstruction left out: they lie outside the largest box, where the model is empty" in text
    distances = [np.linalg.norm(view.camera.origin - photos.box.mean(axis=0)) for view in photos.views]
    assert f"nearer to a camera than {np.median(distances):.4g} [length]" in text
    assert "4 nested boxes" in said(points * 0.1, plan) and "5 nested boxes" in said(points[:99], plan)
    assert "5 nested boxes" in said(points, replace(plan, fewer_levels=False))
    assert "no matter nearer" not in text
    clear, within = find_free_distances([view.camera for view in photos.views], float(np.median(distances)))
    free = (
        f"no matter nearer to a camera than {clear:.4g} [length], nor nearer than {within:.4g} where fewer than {FEWEST_VIEWS}"
    )
    assert free in said(points, replace(plan, free_space=True))
    overfit = "fewer than 50 photographs overfit higher degrees"
    assert overfit in said(points, replace(plan, few_degree=1)) and overfit not in said(points, plan)
    seen = replace(photos, views=tuple(replace(view, points=points[:7]) for view in photos.views))
    batches = field_fit.make_batches(plan, seen)
    lines = [line.choice for line in field_fit.explain_plan(replace(plan, depth=0.5), seen, batches)]
    assert f"{7 * len(photos.views)} points seen in photographs give the depths of rays, with a weight of 0.5" in lines
    assert field_fit.explain_depths(plan, batches) == []
    one = said(points, replace(plan, levels=1, near=0.0, sky=8))
    assert "1000 of 1000 points" in one and "outside the box, in the sky" in one
    assert "nested" not in one and "nearer to a camera" not in one
    told = field_fit.make_radiance_plan(config.load(toml(tmp_path, photographs), ["field.levels=2", "field.depth=0.5"]))
    assert (told.levels, told.fewer_levels, told.depth) == (2, False, 0.5)
    assert_refused("field.levels = 13: expected `int` <= 12", config.load, toml(tmp_path, photographs), ["field.levels=13"])


def test_cameras_side_by_side_look_at_the_box_that_is_given(photographs: Path, tmp_path: Path) -> None:
    """Views of one direction have no box of their own; the file's stands in for it, and cameras that miss it are refused."""
    table = json.loads((photographs / "transforms.json").read_text())
    first = np.array(table["frames"][0]["transform_matrix"])
    for number, frame in enumerate(table["frames"]):
        moved = first.copy()
        moved[:3, 3] += 0.02 * number * first[:3, 0]
        frame["transform_matrix"] = moved.tolist()
        frame["file_path"] = str(photographs / frame["file_path"])
    (tmp_path / "transforms.json").write_text(json.dumps(table | {"train_filenames": [], "test_filenames": []}))
    path = toml(tmp_path, tmp_path)
    photos, _ = photo_data.read_photos(config.load(path, ["photos.judged=held_out"]), tmp_path)
    np.testing.assert_array_equal(photos.box, [[-1, -1, -1], [1, 1, 1]])
    for box, said in (("cameras", "look in one direction"), ([[90, 90, 90], [91, 91, 91]], "looking away from the box")):
        with pytest.raises(MivolError, match=said):
            photo_data.read_photos(config.load(path, ["photos.judged=held_out", f"photos.box={json.dumps(box)}"]), tmp_path)


def test_each_look_is_at_the_same_views(photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of a curve are means over one fixed set. Only where that is all views is it called that of the held-out views."""
    chosen, names = config.load(toml(tmp_path, photographs)), []
    _, judged = photo_data.read_photos(chosen, tmp_path)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[:, :7] = True
    kept = replace(judged, views=tuple(replace(view, mask=mask) for view in judged.views))
    nothing = SphericalGrid.from_dense(np.zeros((2, 2, 2)), np.zeros((2, 2, 2, 1, 3)), np.eye(4))
    problem = SimpleNamespace(field=nothing, sky=None)
    monkeypatch.setattr(
        field_fit, "score_image", lambda *images, **asked: names.append(asked["name"]) or score_image(*images, **asked)
    )

    def judge_few(judged: Photos | None, *changes: str) -> dict[str, float]:
        fit = FieldFit(RunContext(config.load(toml(tmp_path, photographs), changes), tmp_path, tmp_path))
        fit.problem, fit.judged = problem, judged
        return fit.judge_few()

    for _ in range(2):
        # The columns that count show nothing but what is behind.
        assert judge_few(kept) == {"held_out_psnr": np.inf}
    assert names == ["view_3.png", "view_8.png"] * 2
    one = judge_few(judged, "show.judged=1")
    both = judge_few(judged)
    alone = [field_fit.judge_view(problem, judged, view, ("psnr",))[1].values["psnr"] for view in judged.views]
    assert one == {"few_psnr": alone[0]}
    assert both == {"held_out_psnr": np.mean(alone)}
    assert judge_few(None) == {}
    assert any("over the 2 held-out views (the first has 48" in note for note in photo_data.describe_photos(judged, judged))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("field.preset=cpus", 'did you mean "cpu"'),
        ("field.degree=5", "field.degree = 5: expected `int` <= 4"),
        ("field.longest=4", "field.longest = 4: expected `int` >= 8"),
        ("field.tv_sh=-1", "field.tv_sh = -1: expected `float` >= 0"),
        ("field.beta=nan", "field.beta = nan: expected `float` >= 0"),
        ("field.matte=inf", "field.matte = inf: expected a finite number"),
        ("field.effort=inf", "field.effort = inf: expected a finite number"),
        ("photos.background=[255, 255, 255]", "background is [255.0, 255.0, 255.0]: three numbers from 0 to 1"),
        ("photos.background=[0, nan, 0]", "from 0 to 1"),
        ("photos.background=whit", 'did you mean "white"'),
        ("photos.background=random", "is not for photographs without alpha: white, black, sky, nested or an rgb triple"),
        ("field.sky=30000", "field.sky = 30000: expected `int` <= 4096"),
        ("field.first_degree=5", "expected `int` <= 4"),
        ("field.sky=1", "0, or 2 to 4096 rows"),
        ("photos.box=silhouette", 'did you mean "silhouettes"'),
        ("photos.path=nowhere", "nowhere"),
        ("variant=scalar_rgb", "mivol works in llvm_ad_rgb"),
        ("photos.judged=val", "val"),
        ("photos.backgroud=white", 'did you mean "background"'),
        ("photos.box=[[1, -1, -1], [-1, 1, 1]]", "low below high"),
        ('show.metrics=["pnsr"]', 'did you mean "psnr"'),
        ("photos.scale=0.2", "an image of 10 x 10 pixels is smaller than the 11 pixel window of SSIM"),
        ("show.frames=2000000000", "expected `int` <= 65536"),
        ("field.longest=2000000000", "a fit with 2000000000 nodes along an edge needs"),
    ],
)
def test_refusals(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture, change: str, said: str) -> None:
    assert main(["optimize", str(toml(tmp_path, photographs)), "-o", str(tmp_path / "run"), "--set", change]) == 1
    refused = capsys.readouterr().err
    assert said in refused
    assert refused.startswith("mivol: ")  # before a step was taken
    assert_explained(tmp_path / "fit.toml", [change], refused)


@pytest.mark.parametrize("background", ["", "white"])
def test_mixed_alpha_of_a_judged_photograph_is_answered_once(tmp_path: Path, background: str) -> None:
    """Without a background, that one was asked for first, and the mixture told only then."""
    write_blender(tmp_path / "set")
    odd = tmp_path / "set/train/r_0.png"
    Image.open(odd).convert("RGB").save(odd)
    judged = ["photos.held_out=8", 'photos.judged="held_out"']
    chosen = config.load(toml(tmp_path, tmp_path / "set"), [f'photos.background="{background}"', *judged])
    assert_refused(r"found alpha here but not in r_0\.png", photo_data.read_photos, chosen, tmp_path)


def test_a_box_of_silhouettes_needs_alpha(photographs: Path, tmp_path: Path) -> None:
    chosen = config.load(toml(tmp_path, photographs), ["photos.box=silhouettes"])
    photos, _ = photo_data.read_photos(chosen, tmp_path)
    assert_refused("alpha", photo_data.add_box, chosen, photos)


def test_the_box_is_about_silhouettes_where_all_photographs_have_alpha(photographs: Path, tmp_path: Path) -> None:
    """Without a word the box is the tight one where it can be, and that of the cameras where one view has no alpha."""
    chosen = config.load(toml(tmp_path, photographs), ["photos.box=found"])
    photos, _ = photo_data.read_photos(chosen, tmp_path)
    assert photo_data.add_box(chosen, photos) is photos
    cut = [replace(view, alpha=(view.image < 0.99).any(axis=2).astype(np.float32)) for view in photos.views]
    tight = photo_data.add_box(chosen, replace(photos, views=tuple(cut)))
    # The ball's radius is 0.6 and no camera is nearer than 2.9 to it; two cells of the second search are 0.1.
    assert (np.abs(tight.box) > 0.55).all() and (np.abs(tight.box) < 0.75).all() and (np.abs(photos.box) > 0.9).all()
    assert tight.survey.box_from == "around the opaque pixels"
    mixed = replace(photos, views=(photos.views[0], *cut[1:]))
    assert photo_data.add_box(chosen, mixed) is mixed
