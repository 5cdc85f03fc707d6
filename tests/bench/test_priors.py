"""Study of priors: the small plan, the gain of a prior, and the photographs of a fold."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mivol.bench.studies.radiance_field import RadianceSize, priors
from mivol.bench.studies.radiance_field.priors import FOLDS, WITHOUT, load_captures, mean_gain, measure_priors, small_plan
from mivol.bench.studies.radiance_field.room import (
    FEWEST,
    RADIUS,
    WALLS,
    WILD,
    hit_distance,
    make_cameras,
    make_points,
    trace_image,
)
from mivol.optim.photographs.radiance_plan import PRESETS
from mivol.photos import project, rays

SIZE = RadianceSize.quick()


def test_a_plan_is_the_preset_but_for_its_size_and_one_prior() -> None:
    plan, preset = small_plan(SIZE), PRESETS["capture"]
    assert (plan.tv_density, plan.near, plan.levels, plan.sky, plan.matte) == (
        preset.tv_density, preset.near, preset.levels, preset.sky, preset.few_matte,
    )  # fmt: skip
    assert plan.degree == preset.few_degree and plan.stages[-1].longest == SIZE.prior_resolution
    changed = [{n for n in vars(plan) if vars(plan)[n] != vars(without(plan))[n]} for without in WITHOUT.values()]
    assert changed == [{"tv_density"}, {"tv_sh"}, {"near"}, {"matte"}, {"depth"}, {"degree"}, {"first_degree"}]


def test_a_gain_is_a_mean_over_folds_with_its_error() -> None:
    """Differences 1, 2 and 3: a mean of 2, a standard error of 1 / sqrt(3); one fold has none."""
    assert mean_gain([21.0, 23.0, 25.0], [20.0, 21.0, 22.0]) == {"gain": 2.0, "error": pytest.approx(1 / np.sqrt(3))}
    assert mean_gain([21.0], [20.0])["error"] is None


def test_a_fold_is_judged_by_what_it_holds_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points that lie no farther than three half edges need three nested boxes."""
    fitted, judged = [], []
    fit = SimpleNamespace(course=SimpleNamespace(iterations=2), advance=lambda: None, problem=SimpleNamespace(sky=None))
    monkeypatch.setattr(priors, "begin_radiance_fit", lambda views, box, plan, seed: fitted.append((views, plan, seed)) or fit)
    monkeypatch.setattr(priors, "current_field", lambda fit: "field")
    monkeypatch.setattr(priors, "rectify", lambda photo: photo)
    monkeypatch.setattr(priors, "RayBatches", SimpleNamespace(from_photos=lambda photos, shrinks: list(photos)))
    monkeypatch.setattr(priors, "held_out_psnr", lambda photos, render: judged.append(list(photos)) or 20.0)
    box, points = np.array([[-1.0] * 3, [1.0] * 3]), np.tile([[0, 3.0, 0], [0, 0, 0]], (50, 1))
    place = SimpleNamespace(views=list(range(12)), box=box, survey=SimpleNamespace(points=points))
    monkeypatch.setattr(priors, "load_captures", lambda size: {"place": place})
    answer = measure_priors(SIZE)
    assert len(fitted) == 1 + len(WITHOUT)
    views, plan, seed = fitted[0]
    assert (views, plan.levels, seed) == ([k for k in range(12) if k % FOLDS], 3, 0)
    assert judged[0] == [0, 5, 10]
    assert answer["place"]["psnr"] == [20.0] and set(answer["place"]["priors"]) == set(WITHOUT)
    place.survey.points = None
    measure_priors(SIZE)
    assert fitted[-1][1].levels == PRESETS["capture"].levels


def test_the_room_is_read_as_a_model_of_colmap() -> None:
    """Photographs of 8 bits and cameras as they were traced; every point is found by the photographs that its track names."""
    result = load_captures(SIZE)["room"]
    assert len(result.views) == 25 and result.views[0].image.shape == (12, 16, 3)
    traced = {camera.name: camera for camera in make_cameras(25, (16, 12))}
    for view in result.views:
        camera = traced[view.name]
        np.testing.assert_allclose(view.camera.to_world, camera.to_world, atol=1e-12)
        np.testing.assert_allclose(view.image, trace_image(camera), atol=0.51 / 255)
    places, by = make_points([traced[view.name] for view in result.views], np.random.default_rng(11))
    np.testing.assert_array_equal(result.survey.points, places)
    for view, own in zip(result.views, by, strict=True):
        np.testing.assert_array_equal(view.points, places[own])


def test_points_of_the_room_are_where_photographs_show_them() -> None:
    """Triangulated to a pixel or so, but for a few whose distance is wrong; and none behind what hides it."""
    cameras = make_cameras(25, (80, 60))
    places, by = make_points(cameras, np.random.default_rng(0))
    off = []
    for camera, own in zip(cameras, by, strict=True):
        o, d = rays(camera, project(camera, places[own])[0])
        far = np.linalg.norm(places[own] - camera.origin, axis=1)
        off.append(np.abs(hit_distance(o, d) - far) / far)
    off = np.concatenate(off)
    # A wrong point is seen by several; those at the ball's rim miss it by any distance.
    assert np.median(off) < 0.03 and 0.01 < np.mean(off > 0.3) < 3 * WILD
    assert by.sum(axis=0).min() >= FEWEST


def test_the_fox_is_fitted_where_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(priors, "DATA", tmp_path)
    assert list(load_captures(SIZE)) == ["room"]
    (tmp_path / "multiview" / "fox").mkdir(parents=True)
    monkeypatch.setattr(priors, "load_photos", lambda path, largest=None, box=None: (path.name, largest, box))
    assert load_captures(SIZE)["fox"] == ("fox", SIZE.prior_side, "middle")


def test_the_room_has_a_ball_before_walls() -> None:
    """In the middle of a picture stands the ball, with the pattern of its surface there; cameras are 2 away, among walls."""
    camera = make_cameras(3, (64, 48))[1]
    image = trace_image(camera)
    towards = RADIUS * camera.origin / np.linalg.norm(camera.origin)
    x, y, z = 3.0 * towards
    expected = 0.5 + 0.4 * np.array([np.sin(x + 2 * y), np.sin(2 * z - y + 1), np.sin(x - z + 2)])
    np.testing.assert_allclose(image[23:25, 31:33].mean(axis=(0, 1)), expected, atol=0.02)
    assert np.linalg.norm(camera.origin) == pytest.approx(2.0) and WALLS > 2
