"""Everyday scenes: every scene has its parameter, the better peer counts, weak ratios are shown."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bench_figures import drawn
from readable_figures import assert_readable
from refusals import assert_refused

from mivol.bench.harness.contests import Contest, Timing
from mivol.bench.studies import everyday
from mivol.bench.studies.everyday import MITSUBAS_SCENES, SCENES, STUDY, EverydaySize, measure_gradients, measure_images

TINY = replace(EverydaySize.quick(), scenes=("jade_null_sun",), side=2, spp=4, rounds=4)


def contest_of(results: dict[str, np.ndarray], seconds: dict[str, float]) -> Contest:
    """A contest with these results (rounds, ...), and with the same wall-clock and processor times in all rounds."""
    timings = {(n, 1): Timing({}, [seconds[n]] * len(r), [seconds[n]] * len(r), list(r)) for n, r in results.items()}
    return Contest(timings, dict.fromkeys(timings, 4))


SWING = np.array([-1.0, 1, -1, 1])


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_has_its_parameter(variant_rgb: str, name: str) -> None:
    params = mi.traverse(SCENES[name].load(2))
    assert SCENES[name].parameter in params
    # Differentiable, so a gradient exists.
    assert params.flags(SCENES[name].parameter) & mi.ParamFlags.NonDifferentiable == 0


@pytest.mark.slow_for(*list(MITSUBAS_SCENES)[2:])
@pytest.mark.parametrize("name", MITSUBAS_SCENES)
def test_scenes_of_mitsubas_tests_have_their_size_sampler_and_parameter(
    two_threads: None, data_dir: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(everyday, "DATA", data_dir)
    scene = MITSUBAS_SCENES[name].load(7, "multijitter", 9)
    sensor = scene.sensors()[0]
    assert MITSUBAS_SCENES[name].parameter in mi.traverse(scene)
    assert tuple(sensor.film().size()) == (7, 7) and sensor.sampler().sample_count() == 9
    assert sensor.sampler().class_name() == "MultijitterSampler"


def test_a_missing_scene_of_mitsubas_tests_is_named(variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(everyday, "DATA", tmp_path)
    assert_refused("set MIVOL_DATA to the folder that holds", MITSUBAS_SCENES["object_albedo"].load, 7)


def test_images_are_compared_with_the_better_sampler(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Deviations of 1 (mivol), 4 and 2, in 1 s, 2 s and 3 s: ratios of 32 and 12, of which the smaller one counts."""
    loaded = []
    monkeypatch.setattr(everyday, "render_method", lambda scene, integrator: loaded.append(scene.sensors()[0].sampler()))

    def compete(methods: dict, rounds: int, seconds: float, spp: int, seed: int) -> Contest:
        deviations = dict(zip(methods, (1.0, 4.0, 2.0), strict=True))
        images = {name: 9 + d * SWING[:, None, None, None] * np.ones((1, 2, 2, 3)) for name, d in deviations.items()}
        return contest_of(images, dict(zip(methods, (1.0, 2.0, 3.0), strict=True)))

    monkeypatch.setattr(everyday, "compete", compete)
    answer = measure_images(TINY)
    row = answer["scenes"]["jade_null_sun"]
    assert [type(sampler).__name__ or "" for sampler in loaded] and "multijitter" in str(loaded[2]).lower()
    assert row["ratio"] == pytest.approx(12) == row["median_ratio"] == answer["geometric_mean"]
    assert row["peer"] == "volpath, multijitter" and row["means"] == {"volpath, multijitter": 9.0, "mivol": 9.0}


def test_gradients_count_where_the_density_is_large(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second of four voxels has 0.4 of the largest density, the third 0.1: deviations count in the first two.
    The derivatives along the logarithm of the density are sums of gradient times density over all voxels."""

    class Gradient:
        def __init__(self, *_: object) -> None:
            self.params = {SCENES["thin_smoke"].parameter: np.array([1.0, 0.4, 0.1, 0.0])}

        def of_loss(self, *_: object) -> None: ...

    def compete(methods: dict, *_: object, seed: int) -> Contest:
        deviations = {everyday.PEER: [2.0, 4.0, 99.0, 99.0], "mivol": [1.0, 1.0, 1.0, 1.0]}
        results = {name: 5 + SWING[:, None] * np.array(d) for name, d in deviations.items()}
        return contest_of(results, {everyday.PEER: 3.0, "mivol": 1.0})

    monkeypatch.setattr(everyday, "ParameterGradient", Gradient)
    monkeypatch.setattr(everyday, "compete", compete)
    row = measure_gradients(replace(TINY, scenes=("thin_smoke",)))["scenes"]["thin_smoke"]
    assert row["ratio"] == pytest.approx(3 * (4 + 16) / 2)
    assert row["median_ratio"] == pytest.approx(3 * (4 + 16) / 2)
    assert row["means"] == {everyday.PEER: pytest.approx(7.5), "mivol": pytest.approx(7.5)}


def test_geometric_means_leave_out_a_scene_without_a_ratio(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ratios of 2 and 8; a gradient that is always 0 has no ratio."""
    ratios = iter((2.0, None, 8.0))
    monkeypatch.setattr(everyday, "_contend_gradients", lambda scene, size: {"ratio": next(ratios), "z": 0.0})
    assert measure_gradients(replace(TINY, scenes=tuple(SCENES)[:3]))["geometric_mean"] == pytest.approx(4)


def test_unknown_scenes_are_refused(variant_rgb: str) -> None:
    assert_refused('there is no scene "god_ray"', measure_images, replace(TINY, scenes=("god_ray",)))


def made_up(ratios: dict[str, float | None]) -> dict:
    """An answer with these ratios, and with means that differ in the last scene."""
    agreement = {"z": 1.0, "z_bound": 4.0}
    rows = {}
    for name, ratio in ratios.items():
        rows[name] = {"ratio": ratio, "median_ratio": ratio, "means": {"volpath": 1.0, "mivol": 1.0}, **agreement}
        rows[name] |= {"milliseconds": {"volpath": 10.0, "mivol": 20.0}} | {
            f"mivol over {p}": agreement for p in everyday.SAMPLERS
        }
    rows[name] |= {"z": -5.0, "mivol over volpath": {"z": -5.0, "z_bound": 4.0}}
    return {"scenes": rows, "geometric_mean": 3.0}


def test_bars_are_on_ratios_and_on_means_of_images() -> None:
    answer = made_up({"tissue": 12.5, "aquarium": 2.0})
    bars = {bar["figure"]: (bar["bar"], bar["met"]) for bar in STUDY.bars("images", answer)}
    assert bars["variance x time, images: tissue"] == (12, True)
    assert bars["variance x time, images: aquarium"] == (3, False)
    assert [met for figure, (_, met) in bars.items() if figure.startswith("|z|")] == [True, True, False, True]
    assert bars["variance x time, images: geometric mean"] == (8, False)
    # Gradients: prbvolpath is wrong in the aquarium, and its z decides nothing.
    bars = [(bar["figure"], bar["bar"]) for bar in STUDY.bars("gradients", answer)]
    assert bars == [("variance x time, gradients: tissue", 4), ("variance x time, gradients: geometric mean", 5)]


def test_table_says_where_means_differ() -> None:
    rows = STUDY.table("images", made_up({"tissue": 12.5, "aquarium": None}))
    assert rows[2] == "| tissue | 12.50 | 12.50 | volpath | 10 / 20 | 1 / 1 | +1.0 |"
    assert rows[3] == "| aquarium | none | none | volpath | 10 / 20 | 1 / 1 | -5.0 (differs) |"


def test_figure_shows_the_weakest_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    ratios = {name: 98.0 / 1.6**k for k, name in enumerate(SCENES)}
    few = {"tissue": 0.5, "aquarium": 900.0, "thin_smoke": None}
    answers = {"images": made_up(ratios), "gradients": made_up(few)}
    figure = drawn(everyday, monkeypatch, answers, Path())
    ends = [[bar.get_x() + bar.get_width() for bar in axes.patches] for axes in figure.axes]
    assert ends[0] == pytest.approx(sorted(ratios.values())) and ends[1] == pytest.approx([0.5, 900])
    for axes, (low, high) in zip(figure.axes, ((min(ratios.values()), 98.0), (0.5, 900)), strict=True):
        assert axes.get_xscale() == "log" and axes.get_xlim()[0] < low < high < axes.get_xlim()[1]
    assert_readable(figure)


@pytest.mark.slow
def test_a_scene_is_measured_by_all_methods(variant_rgb: str, tmp_path: Path) -> None:
    """A ball of jade: its image and its gradient have noise, and mivol differs from no peer by 1e6 times."""
    answers = {name: question(TINY) for name, question in STUDY.questions.items()}
    for answer in answers.values():
        row = answer["scenes"]["jade_null_sun"]
        assert math.isfinite(math.log(row["ratio"])) and len(row["milliseconds"]) == 2
    assert not [bar for bar in STUDY.bars("images", answers["images"]) if bar["figure"].startswith("|z|") and not bar["met"]]
    STUDY.draw(answers, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
