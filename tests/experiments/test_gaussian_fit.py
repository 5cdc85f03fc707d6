"""``mivol optimize`` with Gaussians: first Gaussians by hand, a run from views to a page, stopped, resumed, refused."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from ball_photos import camera
from photo_sets import orbit
from refusals import assert_refused
from tiny_experiment import assert_explained, resume_stopped_fit

from mivol import config
from mivol.cli import main
from mivol.experiments.gaussian_fit import (
    adapt_to_few,
    explain_capture,
    find_start_points,
    make_background_cloud,
    make_gaussian_plan,
    make_start_cloud,
)
from mivol.experiments.photo_fit import PhotoFit
from mivol.files import write_png
from mivol.files.image_files import decode_srgb
from mivol.optim.gaussians.gaussian_plan import PRESETS, scene_extent
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.photos import Camera, Photo, intrinsics, load_photos, project, rays
from mivol.photos.region import find_free_distances, is_free_space, viewing_distance
from mivol.photos.transforms import write_transforms
from mivol.points import read_gaussians
from mivol.splatting import Splatter

SIZE, VIEWS = 40, 14


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Views with alpha of a ball of opaque Gaussians of many colours, all around it."""
    import mivol.plugins  # noqa: F401

    mi.set_variant("llvm_ad_rgb")
    drawn = np.random.default_rng(5).normal(size=(400, 3))
    cloud = make_start_cloud(0.6 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True), [], 0)
    cloud["opacity_logits"][:] = 4
    cloud["log_scales"] -= 0.7
    cloud["harmonics"][:, 0] = 1.5 * np.sin(4 * cloud["means"])
    tensors, splatter = {name: mi.TensorXf(array) for name, array in cloud.items()}, Splatter(SIZE, SIZE, 0)
    folder = tmp_path_factory.mktemp("photographs")
    like = Camera(intrinsics(55, 55, SIZE / 2, SIZE / 2), (SIZE, SIZE), np.eye(4))
    cameras = orbit("view_{:02d}.png", VIEWS, 0.8, like)
    for name, pose in cameras.items():
        seen = np.clip(np.array(splatter.forward(tensors, pose, derivatives=False)[0]), 0, 1)
        colour = seen[..., :3] / np.maximum(seen[..., 3:], 1e-6)
        write_png(folder / name, np.concatenate([decode_srgb(np.clip(colour, 0, 1)), seen[..., 3:]], axis=2))
    write_transforms(folder / "transforms.json", cameras, ["view_03.png", "view_08.png"])
    return folder


def toml(folder: Path, photographs: Path, **changes: object) -> Path:
    """An experiment of 100 steps."""
    path = folder / "fit.toml"
    settings = {"preset": '"tiny"', "effort": 0.2, "start": 150, "most": 300} | changes
    lines = "\n".join(f"{name} = {value}" for name, value in settings.items())
    path.write_text(
        f"""
        title = "A ball of Gaussians"
        [photos]
        path = "{photographs}"
        background = "white"
        box = [[-1, -1, -1], [1, 1, 1]]
        held_out = 0
        judged = "test"
        [gaussians]
        {lines}
        [show]
        frames = 3
        views = 1
        every = 40
        """
    )
    return path


@pytest.mark.slow
def test_photographs_become_gaussians_and_a_page(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The held-out views are far nearer than a white picture (about 6 dB), and the file holds what the page counts."""
    assert main(["optimize", str(toml(tmp_path, photographs)), "-o", str(tmp_path / "run")]) == 0
    said = capsys.readouterr()
    assert said.out.strip().endswith("report.html")
    for text in ("that no view shows as transparent", "estimated before the allocation", "alpha marks the object"):
        assert text in said.err
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["results"]["held_out_psnr"] > 18
    found = read_gaussians(tmp_path / "run/gaussians.ply")
    assert found.count == record["results"]["gaussians"]
    assert found.degree == 1
    page = (tmp_path / "run/report.html").read_text()
    for text in ("data:video/mp4;base64,", "Fitted Gaussians", "view_03.png", "Kerbl"):
        assert text in page
    rows = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == [40, 80, 100]
    assert all({"loss", "held_out_psnr"} <= row.keys() for row in rows)


@pytest.mark.slow
def test_the_best_gaussians_are_kept_beside_the_last(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Judged best in the middle: that cloud lies in gaussians_best.ply, which is said and noted."""
    path, seen = toml(tmp_path, photographs), []

    def judged(fit: PhotoFit) -> dict[str, float]:
        seen.append(fit.problem.cloud["means"].copy())
        return {"few_psnr": {2: 25.0}.get(len(seen), 20.0)}

    monkeypatch.setattr(PhotoFit, "judge_few", judged)
    assert main(["optimize", str(path), "-o", str(tmp_path / "run")]) == 0
    assert len(seen) == 3
    made = [read_gaussians(tmp_path / f"run/{name}.ply").means for name in ("gaussians_best", "gaussians")]
    assert [np.array_equal(one, seen[number]) for one in made for number in (1, -1)] == [True, False, False, True]
    risen, saved = capsys.readouterr().err.strip().splitlines()[-2:]
    assert "was best at iteration 80, 25 dB, and is 20 dB at the end: gaussians_best.ply holds the best iterate" in risen
    assert risen in json.loads((tmp_path / "run/run.json").read_text())["notes"]
    assert saved.startswith("result: ")


@pytest.mark.slow
def test_a_stopped_fit_goes_on(photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle keeps what was done; the resumed fit begins there and ends with all steps."""
    started = resume_stopped_fit(toml(tmp_path, photographs), GaussianProblem, "gaussians.degree=2", monkeypatch)
    assert started == list(range(45, 100))


def test_what_the_file_says_overrides_the_preset() -> None:
    raw = {"title": "x", "photos": {"path": "p"}, "gaussians": {}}
    assert make_gaussian_plan(config.from_dict(raw)) == PRESETS["minute"]
    given = {"preset": "tiny", "effort": 2.0, "degree": 0, "most": 77, "control": "relocation", "ssim": 0.0, "mip": True}
    raw["gaussians"] = given
    plan = make_gaussian_plan(config.from_dict(raw))
    assert [stage.degree for stage in plan.stages] == [0, 0]
    assert plan.steps == 2 * PRESETS["tiny"].steps
    assert (plan.most, plan.control, plan.ssim, plan.start) == (77, "relocation", 0.0, PRESETS["tiny"].start)
    assert plan.mip and not plan.exposure


def test_minutes_are_said_before_anything_is_fitted(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = toml(tmp_path, photographs, effort=1.0, minutes=0.25)
    assert main(["explain", str(path)]) == 0
    assert "about 15 s: on two idle cores" in capsys.readouterr().out


def test_the_example_is_one_of_gaussians() -> None:
    """The settings of the still life are read, and name the photographs that the radiance field beside them is fitted to."""
    folder = Path(__file__).resolve().parents[2] / "scenes/still_life"
    chosen, field = config.load(folder / "gaussians.toml"), config.load(folder / "fit.toml")
    assert isinstance(chosen, config.GaussianExperiment)
    assert chosen.photos == field.photos
    assert make_gaussian_plan(chosen) == PRESETS["minute"]


@pytest.mark.slow_for('gaussians.preset="minut"-gaussians.preset = "minut" is unknown: did you mean "minute"')
@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ('gaussians.preset="minut"', 'gaussians.preset = "minut" is unknown: did you mean "minute"'),
        ('gaussians.control="mcmc"', 'gaussians.control = "mcmc" is unknown: known are: clone_split, relocation'),
        ("gaussians.degree=4", "gaussians.degree = 4: expected `int` <= 3"),
        ("gaussians.start=3", "gaussians.start = 3: expected `int` >= 4"),
        ("gaussians.ssim=1.5", "gaussians.ssim = 1.5: expected `float` <= 1"),
        ("gaussians.effort=inf", "gaussians.effort = inf: expected a finite number"),
        ("gaussians.minutes=1", "minutes is 1.0 beside effort 0.2"),
        ("gaussians.exposure=true", "found gains and photographs with alpha"),
        ("gaussians.most=2000000000", "most = "),
        ("photos.background=sky", 'photos.background = "sky" is not for Gaussians: white, black, random or an rgb triple'),
        ("variant=scalar_rgb", "mivol works in llvm_ad_rgb"),
    ],
)
def test_refusals(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture, setting: str, says: str) -> None:
    path = toml(tmp_path, photographs)
    assert main(["optimize", str(path), "-o", str(tmp_path / "run"), "--set", setting]) == 1
    said = capsys.readouterr().err
    assert says in said.replace("\n", " ")
    assert_explained(path, [setting], said)


def test_photographs_from_one_place_are_refused(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """They tell no distance. What the problem itself refuses is said by explain, too."""
    path = toml(tmp_path, shutil.copytree(photographs, tmp_path / "set"))
    listed = json.loads((tmp_path / "set/transforms.json").read_text())
    for frame in listed["frames"]:
        frame["transform_matrix"] = listed["frames"][0]["transform_matrix"]
    (tmp_path / "set/transforms.json").write_text(json.dumps(listed))
    assert main(["optimize", str(path), "-o", str(tmp_path / "run")]) == 1
    said = capsys.readouterr().err
    assert "all cameras are at one position" in said
    assert_explained(path, [], said)


def test_points_begin_where_no_view_sees_through(photographs: Path) -> None:
    """A ball of radius 0.6, 0.2 more until its rim of Gaussians has an alpha below 1/510, and 0.06 for a pixel; its hull by 14
    views reaches a fifth further. The corners of the box are 1.7 away, so of 200 points in all of it some lie beyond 1.1."""
    photos = load_photos(photographs, background="white", box=np.array([[-1.0] * 3, [1.0] * 3]))
    places, whence = find_start_points(photos, 200, 0)
    assert len(places) == 200
    assert np.linalg.norm(places, axis=1).max() < 1.1
    assert "that no view shows as transparent" in whence
    assert np.array_equal(places, find_start_points(photos, 200, 0)[0])
    colours = make_start_cloud(places, photos.views, 1)["harmonics"]
    assert not colours[:, 1:].any()
    assert colours[:, 0].std() > 0.05


BOX = np.array([[-0.5, -0.4, -0.3], [0.5, 0.6, 0.7]])


def photo(k: float, seed: int, alpha: bool = True) -> Photo:
    """A view of 40 x 40 pixels of noise, transparent in its left part."""
    image = np.random.default_rng(seed).uniform(0, 1, (40, 40, 3)).astype(np.float32)
    clear = np.ones((40, 40), np.float32)
    clear[:, :18] = 0
    return Photo(f"view {k}", image, clear if alpha else None, None, camera(k, 40), np.ones(3, np.float32))


def photos(views: list[Photo], points: np.ndarray | None = None) -> SimpleNamespace:
    return SimpleNamespace(survey=SimpleNamespace(points=points), box=BOX, views=views)


def seen_pixel(view: Photo, point: np.ndarray) -> tuple[int, int] | None:
    """Row and column of the pixel that shows a point; None for none."""
    (x, y), depth = project(view.camera, point)
    if not depth > 0 or not (0 <= x < 40 and 0 <= y < 40):
        return None
    return int(y), int(x)


def test_reconstruction_points_are_used_unchanged() -> None:
    """Those in the box, whose faces belong to it; fewer than 100 points say nothing."""
    points = np.random.default_rng(1).uniform(-1, 1, (120, 3))
    points[0], points[1] = BOX
    inside = [p for p in points if all(low <= x <= high for low, x, high in zip(BOX[0], p, BOX[1], strict=True))]
    found, says = find_start_points(photos([], points), 7, 3)
    np.testing.assert_array_equal(found, inside)
    assert says == f"{len(inside)} points of the reconstruction in the box"
    for few in (points[:99], None):
        found, says = find_start_points(photos([photo(0.0, 0, alpha=False)], few), 7, 3)
        np.testing.assert_array_equal(found, np.random.default_rng((3, 1)).uniform(*BOX, (7, 3)))
        assert says == "7 random points in the box"
    assert len(find_start_points(photos([], points[:100]), 7, 3)[0]) < 100


def test_surroundings_stand_along_rays_of_the_photographs() -> None:
    """After the points in the box, which stay: in the frame of a photograph, neither too near nor too far, and not in free
    space, where no point of two photographs may stand."""
    views = [photo(k, k, alpha=False) for k in range(5)]
    points = np.random.default_rng(1).uniform(*BOX, (120, 3))
    found, says = find_start_points(photos(views, points), 300, 3, has_surroundings=True)
    around = found[120:]
    assert np.array_equal(found[:120], points) and 100 < len(around) < 300
    assert says == f"120 points of the reconstruction, {len(around)} along random rays of the photographs"
    outside = np.concatenate([points, 100 * points])
    assert np.array_equal(find_start_points(photos(views, outside), 300, 3, has_surroundings=True)[0][:240], outside)
    all_cameras = [view.camera for view in views]
    reach = viewing_distance(all_cameras, BOX)
    for point in around:
        distances = [np.linalg.norm(point - view.camera.origin) / reach for view in views if seen_pixel(view, point)]
        assert distances and max(distances) >= 0.5 and min(distances) <= 8
    assert np.linalg.norm(around - all_cameras[0].origin, axis=1).max() > 4 * reach
    assert not is_free_space(all_cameras, around, reach).any()
    few, _ = find_start_points(photos(views[:2], points), 300, 3, has_surroundings=True)
    within = find_free_distances(all_cameras[:2], viewing_distance(all_cameras[:2], BOX))[1]
    assert all(min(np.linalg.norm(p - c.origin) for c in all_cameras[:2]) >= within for p in few[120:])


def test_the_background_covers_what_the_photographs_see() -> None:
    """Behind each pixel stands a Gaussian within its scale; none stands where no photograph looks."""
    views = [photo(k, k, alpha=False) for k in range(5)]
    made = make_background_cloud(views, 1)
    origins = np.array([view.camera.origin for view in views])
    middle, extent = origins.mean(axis=0), scene_extent([view.camera for view in views])
    places, scale = made["means"].astype(np.float64), float(np.exp(made["log_scales"][0, 0]))
    np.testing.assert_allclose(np.linalg.norm(places - middle, axis=1), 9 * extent, rtol=1e-6)
    assert all(any(seen_pixel(view, place) for view in views) for place in places)
    for view in views:
        o, d = rays(view.camera, np.stack(np.meshgrid([1.0, 20, 39], [1.0, 20, 39]), axis=-1).reshape(-1, 2))
        b = (d * (o - middle)).sum(axis=-1)
        t = -b + np.sqrt(b**2 - ((o - middle) ** 2).sum(axis=-1) + (9 * extent) ** 2)
        hits = o + t[:, None] * d
        # Points of the spiral are at most 1.05 root areas from any place; one more for the border of the frames.
        assert np.linalg.norm(hits[:, None] - places, axis=-1).min(axis=1).max() < 2.1 * scale / 0.7
    assert made["harmonics"].shape[1:] == (4, 3)
    np.testing.assert_allclose(made["opacity_logits"], math.log(9), rtol=1e-6)


def test_few_photographs_of_a_capture_get_a_lower_degree() -> None:
    plan = PRESETS["minutes"]
    assert [stage.degree for stage in adapt_to_few(plan, 49).stages] == [0, 1]
    assert adapt_to_few(plan, 50) == plan and [stage.degree for stage in plan.stages] == [0, 3]
    few, many = (explain_capture(replace(plan, reach=2.0), count) for count in (49, 50))
    assert few[0].reason == "fewer than 50 photographs overfit higher degrees" != many[0].reason
    assert "no scale above 0.1 of the cameras' extent" in few[1].choice
    # Relocation removes no Gaussian, and a box of one object is no capture.
    assert len(explain_capture(replace(plan, reach=2.0, control="relocation"), 49)) == 1 and explain_capture(plan, 49) == []


def test_random_points_avoid_transparent_pixels() -> None:
    """Points count where half of the views show them, and none shows them where it is transparent."""
    views = [photo(k, k) for k in range(3)]
    # A camera that looks the other way shows nothing of the box and says nothing against it.
    away = camera(1.0, 40)
    turned = away.to_world @ np.diag([-1.0, 1, -1, 1])
    views.append(Photo("away", views[0].image, views[0].alpha, None, type(away)(away.K, away.size, turned), np.ones(3)))
    rng, kept = np.random.default_rng((5, 1)), []
    while len(kept) < 60:
        for point in rng.uniform(*BOX, (60, 3)):
            at = [seen_pixel(view, point) for view in views]
            shown = [(view, pixel) for view, pixel in zip(views, at, strict=True) if pixel]
            if len(shown) >= 2 and all(view.alpha[pixel] > 0 for view, pixel in shown):
                kept.append(point)
    found, says = find_start_points(photos(views), 60, 5)
    np.testing.assert_allclose(found, kept[:60], rtol=1e-14)
    assert says == "60 random points that no view shows as transparent"
    assert len(find_start_points(photos(views[:1] + views[3:]), 20, 5)[0]) == 20
    clear = [Photo("clear", v.image, np.zeros_like(v.alpha), None, v.camera, v.background) for v in views]
    assert_refused("alpha leaves no part of the box", find_start_points, photos(clear), 10, 5)


def test_scale_is_the_distance_of_neighbours() -> None:
    """The root mean square of the three nearest distances; of points that coincide, a thousandth of the median."""
    places = np.random.default_rng(2).uniform(-0.4, 0.4, (30, 3))
    places = np.concatenate([places, np.repeat([[0.45, 0.5, 0.6]], 5, axis=0)])
    far = np.sort(np.linalg.norm(places[:, None] - places, axis=-1), axis=1)[:, 1:4]
    views = [photo(k, k) for k in range(3)]
    made = make_start_cloud(places, views, 2)
    scale = np.maximum(np.sqrt((far**2).mean(axis=1)), 1e-3 * np.median(far))
    np.testing.assert_allclose(made["log_scales"], np.log(scale)[:, None].repeat(3, axis=1), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(made["means"], places.astype(np.float32))
    np.testing.assert_array_equal(made["quaternions"], [[1, 0, 0, 0]] * 35)
    np.testing.assert_allclose(made["opacity_logits"], [math.log(0.1 / 0.9)] * 35, rtol=1e-6)
    # The mean of what the views show there and of one grey: times the constant harmonic, 1 / (2 sqrt(pi)).
    wanted = []
    for place in places:
        shown = [view.image[pixel] for view in views if (pixel := seen_pixel(view, place))]
        wanted.append((0.5 + np.sum(shown, axis=0)) / (1 + len(shown)) if shown else np.full(3, 0.5))
    np.testing.assert_allclose(made["harmonics"][:, 0] / (2 * math.sqrt(math.pi)), np.array(wanted) - 0.5, rtol=0, atol=1e-6)
    assert made["harmonics"].shape == (35, 9, 3) and not made["harmonics"][:, 1:].any()
    assert all(array.dtype == np.float32 for array in made.values())


def test_fewer_than_four_points_are_refused() -> None:
    assert len(make_start_cloud(np.eye(4, 3), [], 0)["means"]) == 4
    assert_refused("found 3 initial points, expected at least 4", make_start_cloud, np.eye(3), [], 0)
