"""Scenes and volumes of the studies, which every renderer takes."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scene_numbers import add_up

from mivol.bench import scenes
from mivol.bench.scenes import (
    StudyExtinction,
    as_dense_as_smoke,
    box_scene,
    ct_scan,
    fine_smoke,
    les_cloud,
    made_up,
    make_integrator,
    point_light,
    smoke,
    sun_and_sky,
    threads_in_space,
)
from mivol.bench.studies import multiple_scattering, random_scenes, single_scattering
from mivol.bench.studies.gradients import CONTESTS, TABLES
from mivol.bench.studies.ladder import MODELS


def test_the_box_holds_its_grid(variant_rgb: str) -> None:
    """Through the middle of a constant box of extinction 0.3, 2 thick, the sky of radiance 1 is seen at exp(-0.6)."""
    scene = mi.load_dict(box_scene(np.full((2, 2, 2), 0.3, np.float32), 8))
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(0.1, -5, 0.2), mi.Vector3f(0, 1, 0)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    radiance, *_ = mi.load_dict({"type": "mivol", "max_depth": 1}).sample(scene, sampler, ray)
    assert radiance.x[0] == pytest.approx(np.exp(-0.6), rel=1e-5)


def test_an_emitter_takes_the_place_of_the_sky(variant_rgb: str) -> None:
    created = box_scene(np.zeros((2, 2, 2), np.float32), 8, 0.5, **point_light((1, 2, 3)))
    assert {"emitter"} == set(created) - {"type", "box", "sensor"}
    assert created["box"]["interior"]["phase"] == {"type": "isotropic"}
    assert created["box"]["interior"]["albedo"] == 0.5


def test_the_sun_gives_a_third_of_the_light(variant_rgb: str) -> None:
    """By the pixels of the map and their solid angles; the sun stands at (0.6, 0.48, 0.64), z up."""
    parts = sun_and_sky(512)
    picture = np.array(parts["emitter"]["bitmap"], np.float64).mean(axis=-1)
    theta = (np.arange(512) + 0.5) / 512 * np.pi
    light = picture * np.sin(theta)[:, None]
    sun = picture > 100
    assert 0.28 < light[sun].sum() / light.sum() < 0.4
    # what the map sees along its y axis, Mitsuba's upward direction, is at z here
    up = np.array(parts["emitter"]["to_world"] @ mi.ScalarVector3f(0, 1, 0)).ravel()
    assert np.allclose(up, [0, 0, 1], atol=1e-6)
    assert np.median(theta[np.nonzero(sun)[0]]) == pytest.approx(np.arccos(0.64 / np.linalg.norm([0.6, 0.48, 0.64])), abs=0.01)


def test_integrators_scatter_once_and_are_made_anew(variant_rgb: str) -> None:
    assert make_integrator("volpath", 2) is not make_integrator("volpath", 2)
    assert "max_depth = 2" in str(make_integrator("volpath", 2))


def test_scenes_of_the_benches_are_those_of_the_published_figures(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sum of all numbers of hard scenes and of the lights of every bench, each times a weight of its place."""
    grids = lambda res: StudyExtinction(np.full((res // 32,) * 3, res / 7, np.float32), "")  # noqa: E731
    monkeypatch.setattr(random_scenes, "smoke", lambda: grids(64))
    monkeypatch.setattr(random_scenes, "threads_in_space", grids)
    monkeypatch.setattr(random_scenes, "as_dense_as_smoke", lambda found: found)
    scenes = {f"hard: {name}": parts() for name, parts in random_scenes.HARD.items()}
    scenes |= {f"single scattering: {name}": light.parts() for name, light in single_scattering.LIGHTS.items()}
    for tables in (TABLES, {name: lights for name, (_, lights) in CONTESTS.items()}, multiple_scattering.CONTESTS):
        for question, lights in tables.items():
            scenes |= {f"{question}: {name}": light.parts() for name, light in lights.items()}
    scenes |= {f"rung: {name}": rung.parts() for name, rung in MODELS.items()}
    sums: dict[str, float] = {}
    for parts in scenes.values():
        add_up(parts, sums)
    # Numbers of float32, which another processor may round otherwise by 1e-7 of each.
    assert sum(sums.values()) == pytest.approx(29345.13992, rel=1e-6)


def test_volumes_without_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, variant_rgb: str) -> None:
    """Made-up ones of the same sizes, which say so; what they are made of is the procedural fields' own test."""
    monkeypatch.setattr(scenes, "DATA", tmp_path)
    constant = lambda kind, shape, seed, peak: np.full((*shape, 1), peak, np.float32)  # noqa: E731
    monkeypatch.setattr(scenes, "make_procedural", constant)
    assert str(smoke()) == "44x45x53, procedural (no data folder)"
    assert str(les_cloud()) == "32x37x26, procedural (no data folder)"
    result = ct_scan(8)
    assert str(result) == "8x8x8, procedural (quick)"
    assert result.values.dtype == np.float32
    assert result.values.max() == pytest.approx(2, rel=1e-6)


def test_volumes_of_the_data(data_dir: Path, variant_rgb: str) -> None:
    """The tutorial's smoke at optical depths of up to 65 along its voxels; the cloud keeps the optical depth of its height."""
    result = smoke()
    assert str(result) == "44x45x53, Mitsuba tutorial, x 40"
    assert np.max(result.values.sum(axis=1) * 2 / result.values.shape[1]) == pytest.approx(65, rel=0.1)
    assert les_cloud().origin.startswith("LES cloud")


def test_fine_smoke_is_the_smoke(variant_rgb: str) -> None:
    """The same field at other points: its mean, to what interpolation of 45 voxels leaves out at the borders."""
    fine, coarse = fine_smoke(64), smoke()
    assert fine.values.shape == (64, 64, 64)
    assert fine.values.mean() == pytest.approx(coarse.values.mean(), rel=0.03)


def test_threads_leave_space_empty() -> None:
    """A hundredth of the voxels at least, and no more than one more curve fills."""
    result = threads_in_space(48)
    share = np.mean(result.values > 0)
    assert 0.01 <= share < 0.06
    assert result.values.max() == pytest.approx(20)
    # As when the benches were last measured; a few nodes may be rounded otherwise elsewhere.
    assert np.count_nonzero(result.values) == pytest.approx(3670, rel=5e-3)
    assert result.values.sum() == pytest.approx(36372, rel=5e-3)


def test_as_dense_as_the_smoke() -> None:
    """Its largest extinction, and nothing in the outermost voxels."""
    result = as_dense_as_smoke(StudyExtinction(np.arange(125, dtype=np.float32).reshape(5, 5, 5), "a ramp"))
    assert result.values.max() == pytest.approx(smoke().values.max(), rel=1e-6)
    border = np.ones((5, 5, 5), bool)
    border[1:-1, 1:-1, 1:-1] = False
    assert np.all(result.values[border] == 0) and np.all(result.values[~border] > 0)
    assert "as dense as the smoke" in result.origin


def test_a_made_up_volume_has_its_peak() -> None:
    result = made_up((5, 6, 7), 3.0)
    assert result.values.shape == (5, 6, 7)
    assert result.values.max() == pytest.approx(3, rel=1e-6)


def test_every_volume_fills_the_box(variant_rgb: str) -> None:
    """The unit cube's corners go to those of [-1, 1]^3."""
    place = mi.ScalarTransform4f(np.float32(scenes.TO_WORLD))
    assert np.allclose(np.ravel(place @ mi.ScalarPoint3f(0, 0, 0)), -1)
    assert np.allclose(np.ravel(place @ mi.ScalarPoint3f(1, 1, 1)), 1)
