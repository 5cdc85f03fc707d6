"""Random scenes: what is drawn, what is compared, and a sample of them against volpath."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import ALPHA, note

from mivol.bench import agreement
from mivol.bench.random_scenes import BENCH, QUICK, hard, trials
from mivol.bench.random_scenes.generate import EMITTERS, draw_scene
from mivol.bench.random_scenes.trials import try_scene, try_scenes
from mivol.errors import MivolError

RECORDED = Path(__file__).with_suffix(".json")

TINY = replace(QUICK, scenes=2, rounds=2, spp=1, stock_spp=1, hard_pictures=1)


def volumes_of(parts: dict) -> list[dict]:
    """The extinctions of all media of a scene."""
    media = [shape["interior"] for shape in parts.values() if isinstance(shape, dict) and "interior" in shape]
    return [medium["sigma_t"] for medium in media]


def test_a_seed_decides_everything(variant_rgb: str) -> None:
    one, again, other = draw_scene(5), draw_scene(5), draw_scene(6)
    assert (one.features, one.settings) == (again.features, again.settings)
    assert str(one.parts["sensor"]["to_world"]) == str(again.parts["sensor"]["to_world"])
    assert one.features != other.features


def numbers_of(value: object, name: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """The numbers of a scene, each with the last name on the way to it."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from numbers_of(each, key)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from numbers_of(each, name)
    elif isinstance(value, mi.ScalarTransform4f):
        yield name, np.array(value.matrix, dtype=np.float64)
    elif isinstance(value, str):
        yield (name, np.array(value.split(","), dtype=np.float64)) if "," in value else (value, np.ones(1))
    elif value is not None:
        yield name, np.atleast_1d(np.array(value, dtype=np.float64))


def test_a_number_means_the_same_scene_tomorrow(variant_rgb: str, record: bool) -> None:
    """A scene that was found wrong is named by its seed: sums of all numbers of 80 scenes, by their names, are as recorded."""
    sums: dict[str, float] = {}
    for seed in range(80):
        for name, found in numbers_of(draw_scene(seed).parts | {"settings": draw_scene(seed).settings}):
            sums[name] = sums.get(name, 0.0) + float((found * np.cos(np.arange(found.size)).reshape(found.shape)).sum())
    if record:
        RECORDED.write_text(json.dumps(dict(sorted(sums.items())), indent=1) + "\n", encoding="utf-8")
    # Numbers of float32 that another processor may round otherwise: 1e-6 of each, of at most 1e5 of them.
    assert sums == pytest.approx(json.loads(RECORDED.read_text(encoding="utf-8")), rel=1e-5, abs=1e-3)


def test_everything_is_drawn(variant_rgb: str) -> None:
    """Each kind within 300 seeds; the rarest has a chance of 0.03 a scene, so 300 miss it with one of 1e-4."""
    drawn = {feature for seed in range(300) for feature in draw_scene(seed).features}
    wanted = {"null", "dielectric", "roughdielectric", "thindielectric", "mask", "nested", "side by side", "camera inside"}
    wanted |= {"isotropic", "hg", "rayleigh", "tabphase", "blendphase", "homogeneous", "grid", "rgb grid", "white", "depth -1"}
    assert wanted | set(EMITTERS) <= drawn


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


def test_places_are_quarters_and_colours() -> None:
    """One picture whose quarters are 1, 2, 3 and 4, times 1, 10 and 100 by colour."""
    quarter = np.repeat(np.repeat([[1.0, 2.0], [3.0, 4.0]], 3, axis=0), 3, axis=1)
    found = trials._places((quarter[..., None] * [1.0, 10.0, 100.0])[None])
    assert found.shape == (trials.PLACES, 1)
    assert sorted(found[:, 0]) == [v * s for s in (1, 10, 100) for v in (1, 2, 3, 4)]


def test_refusals_are_counted_by_their_sentence(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers apart; a scene that is refused is no scene that agrees."""

    def refuse(drawn: object, name: str, *_: object) -> None:
        raise MivolError(f"an albedo of {len(drawn.features)} was found.")

    monkeypatch.setattr(trials, "_pictures", refuse)
    found = try_scenes(TINY)
    assert found["refusals"] == {"an albedo of # was found#": 2}
    bars = BENCH.compare("trials", found)
    assert [(row["figure"], row["met"]) for row in bars] == [("refused scenes", False), ("pixels that are no radiance", True)]


def test_samples_that_are_no_radiance_are_counted(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One NaN, one infinity and one negative number among the pictures of mivol."""
    rng = np.random.default_rng(0)

    def picture(drawn: object, name: str, *_: object) -> np.ndarray:
        made = rng.uniform(0, 1, (4, 4, 4, 3))
        if name == "mivol":
            made[0, 0, 0] = np.nan, np.inf, -1e-9
        return made

    monkeypatch.setattr(trials, "_pictures", picture)
    with np.errstate(invalid="ignore"):
        found = try_scene(0, TINY)
    assert found["not_a_radiance"] == 3
    assert found["z"] is None
    answer = {"refusals": {}, "trials": {0: found}}
    assert [row["met"] for row in BENCH.compare("trials", answer)] == [True, False, False]


@pytest.mark.slow
@pytest.mark.statistical
def test_a_sample_of_scenes_agrees_with_volpath(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Ten that the quoted run does not have."""
    monkeypatch.setattr(agreement, "FALSE_ALARM", ALPHA)
    note(ALPHA, "random scenes")
    found = try_scenes(replace(QUICK, scenes=10, first=10_000))
    assert not found["refusals"]
    assert all(row["met"] for row in BENCH.compare("trials", found))
    BENCH.draw({"trials": found}, tmp_path)


@pytest.mark.slow
def test_every_path_of_hard_scenes_is_a_radiance(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """65,536 paths of each."""
    monkeypatch.setattr(hard, "SIDE", 256)
    found = hard.try_hard_scenes(TINY)
    assert {f["paths"] for f in found.values()} == {1 << 16}
    assert all(row["met"] for row in BENCH.compare("hard", found))
    assert all(f["brightest"] > 0.1 for f in found.values())


def test_a_fault_of_a_hard_scene_is_counted(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One NaN and two negative numbers in a picture of 12."""
    bad = np.ones((2, 2, 3))
    bad[0, 0] = np.nan, -1.0, -2.0
    monkeypatch.setattr(hard, "HARD", {"made up": lambda: {"type": "scene"}})
    monkeypatch.setattr(mi, "render", lambda *_, **__: bad)
    found = hard.try_hard_scenes(TINY)
    assert found == {"made up": {"paths": 4, "not_finite": 1, "negative": 2, "brightest": 1.0}}
    assert [row["met"] for row in BENCH.compare("hard", found)] == [False]
