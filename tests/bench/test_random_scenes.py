"""Random scenes: drawn features, compared means, and a sample of scenes against volpath."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bench_figures import drawn
from false_alarms import ALPHA, note
from scene_numbers import add_up

from mivol.bench.harness import contests
from mivol.bench.harness.contests import mean_of_rounds
from mivol.bench.studies import random_scenes
from mivol.bench.studies.random_scenes import (
    EMITTERS,
    PLACES,
    STUDY,
    RandomScene,
    RandomSize,
    draw_built_scene,
    draw_scene,
    measure_built,
    measure_hard,
    measure_trials,
    quarter_means,
    try_scene,
)
from mivol.errors import MivolError

TINY = replace(RandomSize.quick(), scenes=2, rounds=2, spp=1, stock_spp=1, hard_pictures=1)


def volumes_of(parts: dict) -> list[dict]:
    """The extinctions of all media of a scene."""
    media = [shape["interior"] for shape in parts.values() if isinstance(shape, dict) and "interior" in shape]
    return [medium["sigma_t"] for medium in media]


def test_a_seed_decides_everything(variant_rgb: str) -> None:
    one, again, other = draw_scene(5), draw_scene(5), draw_scene(6)
    assert (one.features, one.settings) == (again.features, again.settings)
    assert str(one.parts["sensor"]["to_world"]) == str(again.parts["sensor"]["to_world"])
    assert one.features != other.features


@pytest.mark.parametrize(("draw", "total"), [(draw_scene, 11530.70497), (draw_built_scene, 21368.17969)])
def test_a_seed_names_the_same_scene_in_every_release(
    variant_rgb: str, draw: Callable[[int], RandomScene], total: float
) -> None:
    """The sum of all numbers of 80 scenes, each times a weight of its place; seeds name the scenes that were found wrong."""
    sums: dict[str, float] = {}
    for seed in range(80):
        scene = draw(seed)
        add_up(scene.parts | {"settings": scene.settings}, sums)
    # Numbers of float32, which another processor may round otherwise by 1e-7 of each.
    assert sum(sums.values()) == pytest.approx(total, rel=1e-6)


def test_everything_is_drawn(variant_rgb: str) -> None:
    """Each kind within 300 seeds; the rarest has a chance of 0.03 a scene, so 300 miss it with one of 1e-4."""
    drawn = {feature for seed in range(300) for feature in draw_scene(seed).features}
    wanted = {"null", "dielectric", "roughdielectric", "thindielectric", "mask", "nested", "side by side", "camera inside"}
    wanted |= {"isotropic", "hg", "rayleigh", "tabphase", "blendphase", "homogeneous", "grid", "rgb grid", "white", "depth -1"}
    assert wanted | set(EMITTERS) <= drawn


def test_a_camera_inside_is_in_the_body_of_its_medium(variant_rgb: str) -> None:
    """Within 0.4 of its centre, in the first of two bodies side by side as well; half an edge is 0.7 or more."""
    drawn = [scene for scene in map(draw_scene, range(60)) if "camera inside" in scene.features]
    assert {"other" in scene.parts for scene in drawn} == {False, True}
    for scene in drawn:
        body = mi.load_dict({"type": "scene", "body": scene.parts["body"]}).shapes()[0]
        camera = scene.parts["sensor"]["to_world"] @ mi.ScalarPoint3f(0)
        assert np.linalg.norm(camera - body.bbox().center()) < 0.4
        assert scene.parts["sensor"]["medium"]["id"] == "m1"


def test_a_channel_is_that_of_the_rgb_extinction(variant_rgb: str) -> None:
    """The grey scenes of the channels have the grids of the colours, and all else alike."""
    seed = next(seed for seed in range(50) if draw_scene(seed).is_rgb)
    whole = [np.array(volume["grid"]) for volume in volumes_of(draw_scene(seed).parts) if isinstance(volume, dict)]
    (colours,) = [values for values in whole if values.shape[-1] == 3][:1]
    place = next(k for k, values in enumerate(whole) if values.shape[-1] == 3)
    for c in range(3):
        grey = draw_scene(seed, c)
        assert grey.is_rgb and grey.features == draw_scene(seed).features
        volumes = [np.array(volume["grid"]) for volume in volumes_of(grey.parts) if isinstance(volume, dict)]
        np.testing.assert_array_equal(volumes[place].reshape(colours.shape[:-1]), colours[..., c])


def test_scenes_as_people_build_them_hold_everything(variant_rgb: str) -> None:
    """Each kind within 80 seeds; the rarest has a chance of 0.1 a scene, so 80 miss it with one of 2e-4. Lamps stand inside
    the medium or at most 1.9 from its centre, and each scene has one medium at least."""
    drawn: set[str] = set()
    for seed in range(80):
        scene = draw_built_scene(seed)
        drawn |= set(scene.features)
        media = [part for part in scene.parts.values() if isinstance(part, dict) and ("interior" in part or "sigma_t" in part)]
        lamps = [part for name, part in scene.parts.items() if name.startswith("lamp")]
        assert media and len(lamps) in (1, 3, 16)
        places = [np.array(mi.traverse(mi.load_dict(lamp))["position"]) for lamp in lamps if lamp["type"] == "point"]
        assert all(abs(d - 0.2) < 1e-4 or 1.49 < d < 1.91 for d in map(np.linalg.norm, places))
    wanted = {"homogeneous", "rgb homogeneous", "grid", "rgb grid", "null", "dielectric", "one lamp", "sixteen lamps"}
    assert wanted | {"lamp inside", "point lamp", "spot lamp", "lamp with a shape"} | set(PLACES) <= drawn
    assert draw_built_scene(5).features == draw_built_scene(5).features != draw_scene(5).features


def test_places_are_quarters_and_colours() -> None:
    """One picture whose quarters are 1, 2, 3 and 4, times 1, 10 and 100 by colour."""
    quarter = np.repeat(np.repeat([[1.0, 2.0], [3.0, 4.0]], 3, axis=0), 3, axis=1)
    result = quarter_means((quarter[..., None] * [1.0, 10.0, 100.0])[None])
    assert result.shape == (random_scenes.MEANS, 1)
    assert sorted(result[:, 0]) == [v * s for s in (1, 10, 100) for v in (1, 2, 3, 4)]


def test_refusals_are_counted_by_their_sentence(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers apart; a scene that is refused is no scene that agrees."""

    def refuse(drawn: object, name: str, *_: object) -> None:
        raise MivolError(f"an albedo of {len(drawn.features)} was found.")

    monkeypatch.setattr(random_scenes, "render_rounds", refuse)
    result = measure_trials(TINY)
    assert result["refusals"] == {"an albedo of # was found#": 2}
    bars = STUDY.bars("trials", result)
    assert [(row["figure"], row["met"]) for row in bars] == [("refused scenes", False), ("pixels that are no radiance", True)]


def test_samples_that_are_no_radiance_are_counted(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One NaN, one infinity and one negative number among the pictures of mivol."""
    rng = np.random.default_rng(0)

    def picture(drawn: object, name: str, *_: object) -> np.ndarray:
        created = rng.uniform(0, 1, (4, 4, 4, 3))
        if name == "mivol":
            created[0, 0, 0] = np.nan, np.inf, -1e-9
        return created

    monkeypatch.setattr(random_scenes, "render_rounds", picture)
    with np.errstate(invalid="ignore"):
        result = try_scene(0, TINY, draw_scene)
    assert result["not_a_radiance"] == 3
    assert result["z"] is None
    answer = {"refusals": {}, "trials": {0: result}}
    assert [row["met"] for row in STUDY.bars("trials", answer)] == [True, False, False]


@pytest.mark.slow
@pytest.mark.statistical
def test_a_sample_of_scenes_agrees_with_volpath(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Ten that the quoted run does not have."""
    monkeypatch.setattr(contests, "FALSE_ALARM", ALPHA)
    note(ALPHA, "random scenes")
    result = measure_trials(replace(RandomSize.quick(), scenes=10, first=10_000))
    assert not result["refusals"]
    assert all(row["met"] for row in STUDY.bars("trials", result))
    STUDY.draw({"trials": result}, tmp_path / "a.png")


@pytest.mark.slow
@pytest.mark.statistical
def test_a_sample_of_built_scenes_agrees_with_volpath(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six that the quoted run does not have."""
    monkeypatch.setattr(contests, "FALSE_ALARM", ALPHA)
    note(ALPHA, "random scenes as people build them")
    result = measure_built(replace(RandomSize.quick(), built_scenes=6, first=10_000))
    assert len(result["trials"]) == 6 and not result["refusals"]
    assert all(row["met"] for row in STUDY.bars("built", result))


@pytest.mark.slow
def test_every_path_of_hard_scenes_is_a_radiance(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """65,536 paths of each."""
    monkeypatch.setattr(random_scenes, "HARD_SIDE", 256)
    result = measure_hard(TINY)
    assert {f["paths"] for f in result.values()} == {1 << 16}
    assert all(row["met"] for row in STUDY.bars("hard", result))
    assert all(f["brightest"] > 0.1 for f in result.values())


def test_a_fault_of_a_hard_scene_is_counted(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One NaN and two negative numbers in a picture of 12."""
    bad = np.ones((2, 2, 3))
    bad[0, 0] = np.nan, -1.0, -2.0
    monkeypatch.setattr(random_scenes, "HARD", {"made up": lambda: {"type": "scene"}})
    monkeypatch.setattr(mi, "render", lambda *_, **__: bad)
    result = measure_hard(TINY)
    assert result == {"made up": {"paths": 4, "not_finite": 1, "negative": 2, "brightest": 1.0}}
    assert [row["met"] for row in STUDY.bars("hard", result)] == [False]


@pytest.mark.parametrize("is_rgb", [False, True])
def test_a_scene_is_judged_by_what_differs_most(monkeypatch: pytest.MonkeyPatch, is_rgb: bool) -> None:
    """Colours of an rgb extinction are those of the grey scenes of their channels; the bound allows for all comparisons."""
    rng, calls = np.random.default_rng(4), []
    mivol, noise = rng.uniform(1, 2, (4, 4, 4, 3)), rng.uniform(1, 2, (4, 4, 4, 3))
    noise[:, 2:, 2:, 1] += 3

    def pictures(drawn: RandomScene, name: str, rounds: int, spp: int) -> np.ndarray:
        calls.append((drawn.parts["channel"], name, rounds, spp))
        return mivol if name == "mivol" else noise

    def draw(seed: int, channel: int | None) -> RandomScene:
        return RandomScene({"channel": channel}, {}, ["f"], is_rgb)

    monkeypatch.setattr(random_scenes, "render_rounds", pictures)
    size = replace(TINY, scenes=5, rounds=4, spp=2, stock_spp=3)
    result = try_scene(9, size, draw)
    channels = (0, 1, 2) if is_rgb else (None,)
    assert calls == [(None, "mivol", 4, 2), *((c, "volpath", 4, 3) for c in channels)]
    one, other = (mean_of_rounds(p[:, 2:, 2:, 1].mean(axis=(1, 2))) for p in (mivol, noise))
    wanted = contests.compare_means(one, other, 12 * 5)
    assert result == {"features": ["f"], "not_a_radiance": 0, "mean": pytest.approx(noise.mean()), **wanted}
    mivol[0, 0, 0, 0], mivol[0, 0, 0, 1] = 0.0, -1e-30
    assert try_scene(9, size, draw)["not_a_radiance"] == 1


def test_a_figure_of_the_largest_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of the bounds, of scenes that have one."""
    judged = {number: {"z": z, "z_bound": 4.0} for number, z in enumerate((-2.0, None, 1.0))}
    result = judged | {3: {"refused": ["no"]}}
    figure = drawn(random_scenes, monkeypatch, {"trials": {"trials": result}}, Path())
    (axes,) = figure.axes
    bars = {round(p.get_x() + p.get_width() / 2, 3): p.get_height() for p in axes.patches if p.get_height()}
    assert bars == {0.275: 1, 0.525: 1} and len(axes.patches) == 30
    assert axes.patches[-1].get_x() + axes.patches[-1].get_width() == pytest.approx(1.5)
    assert [line.get_xdata()[0] for line in axes.lines] == [1]
    assert not any(p.get_height() for p in drawn(random_scenes, monkeypatch, {"hard": {}}, Path()).axes[0].patches)


def test_bars_of_scenes_and_of_paths() -> None:
    """No refusal, no sample that is no radiance, and z within its bound."""
    result = {1: {"z": 3.0, "z_bound": 4.0, "not_a_radiance": 0}, 2: {"z": -5.0, "z_bound": 4.0, "not_a_radiance": 2}}
    rows = STUDY.bars("trials", {"refusals": {"a": 1, "b": 2}, "trials": result | {3: {"refused": ["a"]}}})
    assert [(row["value"], row["met"]) for row in rows] == [(3, False), (2, False), (3.0, True), (5.0, False)]
    almost = {"refusals": {"a": 1}, "trials": {1: result[1] | {"not_a_radiance": 1}}}
    assert [row["met"] for row in STUDY.bars("trials", almost)] == [False, False, True]
    assert not STUDY.bars("hard", {"a": {"not_finite": 0, "negative": 1}})[0]["met"]
    faults = {"a": {"not_finite": 1, "negative": 2}, "b": {"not_finite": 0, "negative": 0}}
    assert [(row["value"], row["met"]) for row in STUDY.bars("hard", faults)] == [(3, False), (0, True)]
