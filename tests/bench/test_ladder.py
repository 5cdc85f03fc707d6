"""The bench of four models: errors, ratios, and that every rung is rendered and differentiated."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from bench_figures import drawn
from readable_figures import assert_readable

from mivol.bench.harness.timing import Budget, Timing
from mivol.bench.studies import ladder
from mivol.bench.studies.ladder import BENCH, QUICK, RUNGS, climb

TINY = replace(QUICK, side=4, rounds=2, budget=Budget(spp=2), levels=(1, 2))


def test_errors_are_those_of_what_counts() -> None:
    """Two values, of which the second counts: means of 4 and 2, deviations of 1 and 3 (variances of 2 samples: 2 and 18)."""
    swing = np.array([-1.0, 1.0])[:, None]
    ours = Timing({}, [2.0] * 2, [2.0] * 2, list(np.array([[100.0, 4.0]]) + swing * [50, 1]))
    theirs = Timing({}, [6.0] * 2, [6.0] * 2, list(np.array([[100.0, 2.0]]) + swing * [0, 3]))
    timings = {("mivol", 1): ours, ("other", 1): theirs}
    found, mean = ladder._figures(timings, TINY, np.array([False, True]), np.mean)
    assert mean.tolist() == [100.0, 4.0]
    assert found["mivol"] == [{"level": 1, "seconds_median": 2.0, "relative_error": pytest.approx(math.sqrt(2) / 4)}]
    assert found["other"][0]["relative_error"] == pytest.approx(math.sqrt(18) / 4)
    assert found["variance_x_time"] == pytest.approx(27)
    # means of two: variances 1 and 9
    assert found["agreement"]["z"] == pytest.approx(2 / math.sqrt(10))


@pytest.mark.parametrize("name", RUNGS)
def test_only_what_shines_has_no_rival(variant_rgb: str, name: str) -> None:
    """Mitsuba's own media cannot shine; the others are rendered by both, and none of them has emission."""
    shines = name == "emission"
    assert RUNGS[name].rivals("volpath") == (("mivol",) if shines else ("mivol", "volpath"))
    keys = [key for key, _ in mi.traverse(RUNGS[name].scene(np.full((2, 3, 4), 0.5, np.float32), 4))]
    assert any("emission" in key for key in keys) == shines


def test_each_level_has_its_share_of_the_samples_and_seeds_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 samples in all: 12, 3 and 1 (not 0) of them; no seed is used twice."""
    asked = {}

    def keep(calls: dict, rounds: int, keep: bool) -> None:
        assert (rounds, keep) == (2, True)
        asked.update({key: [call(number) for number in range(3)] for key, call in calls.items()})

    monkeypatch.setattr(ladder, "race", keep)
    size = replace(TINY, budget=Budget(spp=12), levels=(1, 4, 16))
    ladder._race({name: lambda seed, spp, name=name: (name, seed, spp) for name in ("mivol", "other")}, size)
    assert {key: {(name, spp) for name, _, spp in calls} for key, calls in asked.items()} == {
        (name, level): {(name, spp)} for name in ("mivol", "other") for level, spp in ((1, 12), (4, 3), (16, 1))
    }
    seeds = [seed for calls in asked.values() for _, seed, _ in calls]
    assert len(set(seeds)) == len(seeds) == 18 and np.ptp([seed for _, seed, _ in asked["mivol", 4]]) == 2


def test_what_is_said_and_judged_of_a_rung() -> None:
    """A ratio where there is a rival, and a bar for each agreement."""
    rival = {"variance_x_time": 12.4, "agreement": {"z": 1.0, "z_bound": 4.0}}
    answer = {name: {"image": rival, "gradient": {} if RUNGS[name].emits else rival} for name in RUNGS}
    assert ladder.said(answer["emission"]) == "image 12x; gradient alone"
    bars = ladder.compare("ladder", answer)
    assert len(bars) == 2 * len(RUNGS) - 1 and all(bar["met"] for bar in bars)
    assert ladder._root_mean_square(np.array([1.0, -7.0])) == 5


@pytest.mark.slow
def test_every_rung_is_climbed(variant_rgb: str, tmp_path: Path) -> None:
    """Images and gradients of all four models, both methods but for the emission; the pictures are not black."""
    answer = climb(TINY)
    for name, rung in RUNGS.items():
        for what, stock in (("image", "volpath"), ("gradient", "prbvolpath")):
            figures = answer[name][what]
            assert len(figures["mivol"]) == len(TINY.levels)
            assert (stock in figures) == ("variance_x_time" in figures) == (not rung.emits)
        assert answer[name]["image"]["picture"].max() > 0.1
    assert len(BENCH.compare("ladder", answer)) == 6
    BENCH.draw({"ladder": answer}, tmp_path)
    assert (tmp_path / "bench_ladder.png").read_bytes().startswith(b"\x89PNG")


def test_a_rung_is_rendered_and_differentiated(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its integrators at its depth; all pixels count in an image, and of a gradient the voxels from 1 on, over their mean
    square; the picture is mivol's mean."""
    values = np.array([0.5, 1.0, 2.0, 0.0]).reshape(1, 2, 2)
    heard, asked = [], []
    rung = replace(RUNGS["multiple scattering"], depth=7)
    monkeypatch.setattr(ladder.Rung, "scene", lambda self, values, side: ("scene", side))
    monkeypatch.setattr(ladder, "make_integrator", lambda name, depth: (name, depth))
    monkeypatch.setattr(ladder, "Subject", lambda scene, integrator: SimpleNamespace(of_mean=("step", scene, integrator)))
    monkeypatch.setattr(ladder.mi, "render", lambda scene, **named: asked.append((scene, named)))
    monkeypatch.setattr(ladder, "_race", lambda steps, size: steps)

    def figures(timings: dict, size: object, counts: np.ndarray, scale: object) -> tuple:
        heard.append((timings, counts.tolist(), scale(np.array([3.0, 5.0]))))
        return {"figures": len(heard)}, np.arange(48.0)

    monkeypatch.setattr(ladder, "_figures", figures)
    image = ladder._image(rung, values, TINY)
    assert np.array_equal(image.pop("picture"), np.arange(48.0).reshape(4, 4, 3)) and image == {"figures": 1}
    assert ladder._gradient(rung, values, TINY) == {"figures": 2}
    (steps, pixels, mean), (slopes, voxels, root) = heard
    assert (pixels, mean, voxels, root) == ([True] * 48, 4, [False, True, True, False], pytest.approx(math.sqrt(17)))
    assert list(steps) == ["mivol", "volpath"]
    steps["volpath"](3, 5)
    assert asked == [(("scene", 4), {"integrator": ("volpath", 7), "spp": 5, "seed": 3})]
    assert slopes == {name: ("step", ("scene", 4), (name, 7)) for name in ("mivol", "prbvolpath")}


def test_all_rungs_are_climbed_in_the_smoke(monkeypatch: pytest.MonkeyPatch) -> None:
    found, said = type("Found", (), {"values": "values", "__str__": lambda self: "grid"})(), []
    monkeypatch.setattr(ladder, "smoke", lambda: found)
    monkeypatch.setattr(ladder, "_image", lambda rung, values, size: ("image", rung, values, size))
    monkeypatch.setattr(ladder, "_gradient", lambda rung, values, size: ("gradient", rung, values, size))
    monkeypatch.setattr(ladder, "said", lambda answer: answer["image"][1].depth)
    monkeypatch.setattr(ladder, "say", said.append)
    assert climb(TINY) == {"grid": "grid"} | {
        name: {what: (what, rung, "values", TINY) for what in ("image", "gradient")} for name, rung in RUNGS.items()
    }
    assert said == [f"  {name}: {rung.depth}" for name, rung in RUNGS.items()]


@pytest.mark.slow
def test_a_figure_of_four_rungs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures up to their brightest hundredth, and errors of both methods where there are two."""
    rows = lambda k: [{"seconds_median": t, "relative_error": k / t} for t in (0.5, 2.0)]  # noqa: E731
    answer = {}
    for k, (name, rung) in enumerate(RUNGS.items(), 1):
        picture = np.linspace(-0.1, k, 48).reshape(4, 4, 3)
        answer[name] = {"image": {"mivol": rows(k), "picture": picture}, "gradient": {"mivol": rows(2 * k)}}
        if not rung.emits:
            answer[name]["image"]["volpath"], answer[name]["gradient"]["prbvolpath"] = rows(3 * k), rows(4 * k)
    assert_readable(drawn(ladder, monkeypatch, {"ladder": answer}, Path()))
