"""Four models of one scene: errors and ratios; every model is rendered and differentiated."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from bench_figures import drawn
from readable_figures import assert_readable

from mivol.bench.harness.contests import Contest, Timing
from mivol.bench.studies import ladder
from mivol.bench.studies.ladder import MODELS, STUDY, LadderSize, error_figures, root_mean_square

TINY = replace(LadderSize.quick(), side=4, rounds=2, spp=2, levels=(1, 2))


def test_errors_are_those_of_the_values_that_count() -> None:
    """Two values, of which the second counts: means of 4 and 2, deviations of 1 and 3 (variances of 2 samples: 2 and 18)."""
    swing = np.array([-1.0, 1.0])[:, None]
    mivol = Timing({}, [2.0] * 2, [2.0] * 2, list(np.array([[100.0, 4.0]]) + swing * [50, 1]))
    peer = Timing({}, [6.0] * 2, [6.0] * 2, list(np.array([[100.0, 2.0]]) + swing * [0, 3]))
    contest = Contest({("mivol", 1): mivol, ("peer", 1): peer}, {})
    figures, mean = error_figures(contest, np.array([False, True]), np.mean)
    assert mean.tolist() == [100.0, 4.0]
    assert figures["mivol"] == [{"level": 1, "seconds_median": 2.0, "relative_error": pytest.approx(math.sqrt(2) / 4)}]
    assert figures["peer"][0]["relative_error"] == pytest.approx(math.sqrt(18) / 4)
    assert figures["variance_x_time"] == pytest.approx(27)
    # Means of two values: variances 1 and 9.
    assert figures["agreement"]["z"] == pytest.approx(2 / math.sqrt(10))
    assert root_mean_square(np.array([1.0, -7.0])) == 5


@pytest.mark.parametrize("name", MODELS)
def test_only_emission_has_no_peer(variant_rgb: str, name: str) -> None:
    """Mitsuba's own media cannot emit; the other models are rendered by both integrators, and have no emission."""
    emits = name == "emission"
    assert list(MODELS[name].integrators("volpath")) == (["mivol"] if emits else ["mivol", "volpath"])
    keys = [key for key, _ in mi.traverse(MODELS[name].scene(np.full((2, 3, 4), 0.5, np.float32), 4))]
    assert any("emission" in key for key in keys) == emits


@pytest.mark.slow
def test_every_model_is_measured(variant_rgb: str, tmp_path: Path) -> None:
    """Images and gradients of all four models, by both methods but for emission; the images are not black."""
    answer = ladder.measure(TINY)
    for name, model in MODELS.items():
        for kind, peer in (("image", "volpath"), ("gradient", "prbvolpath")):
            figures = answer[name][kind]
            assert len(figures["mivol"]) == len(TINY.levels)
            assert (peer in figures) == ("variance_x_time" in figures) == (not model.emits)
        assert answer[name]["image"]["picture"].max() > 0.1
    assert len(STUDY.bars("ladder", answer)) == 6
    STUDY.draw({"ladder": answer}, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_figure_of_four_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images up to their brightest hundredth, and errors of both methods if there are two."""
    rows = lambda k: [{"seconds_median": t, "relative_error": k / t} for t in (0.5, 2.0)]  # noqa: E731
    answer = {}
    for k, (name, model) in enumerate(MODELS.items(), 1):
        picture = np.linspace(-0.1, k, 48).reshape(4, 4, 3)
        answer[name] = {"image": {"mivol": rows(k), "picture": picture}, "gradient": {"mivol": rows(2 * k)}}
        if not model.emits:
            answer[name]["image"]["volpath"], answer[name]["gradient"]["prbvolpath"] = rows(3 * k), rows(4 * k)
    assert_readable(drawn(ladder, monkeypatch, {"ladder": answer}, Path()))
