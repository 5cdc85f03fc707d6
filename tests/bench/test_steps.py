"""Study of steps: the same loop by two integrators, with the launches of each."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.bench.studies import steps as study
from mivol.errors import MivolError
from mivol.threads import set_thread_count


def test_launches_are_those_of_the_call() -> None:
    """Two kernels and a sum, none of what is computed before or after."""
    x = dr.arange(mi.Float, 1000)
    dr.eval(x * 2)

    def call() -> None:
        a, b = x + 1, dr.sin(x)
        dr.eval(a)
        dr.eval(b)

    assert study.count_launches(call) == 2
    assert study.count_launches(lambda: None) == 0


def test_a_step_renders_another_value_and_its_gradient() -> None:
    loop = study._Loop(study.chosen_scenes(["jade_null_sun"])["jade_null_sun"], "mivol", 4, 1)
    values = []
    for differentiates in (False, True, True):
        loop.step(differentiates)
        value = loop.params[loop.key]
        values.append(np.array(value).ravel()[0])
        if differentiates:
            assert np.abs(np.array(dr.grad(value))).max() > 0
    assert np.allclose(values, np.array(loop.start).ravel()[0] * (1 - 1e-4 * np.arange(1, 4)))


@pytest.mark.slow
def test_a_gradient_makes_few_launches() -> None:
    """An image of the tutorial at depth 6 with its gradient; with two threads, Dr.Jit folds arrays of each thread."""
    set_thread_count(2)
    loop = study._Loop(study.TUTORIAL, "mivol", 64, 4)
    for _ in range(study.WARM):
        loop.step(True)
    assert loop.count_render_launches(True) <= 60


def test_a_study_counts_and_compares(tmp_path: Path) -> None:
    size = study.StepsSize(scenes=("tutorial",), sides=(2,), spp=(1, 2), steps=1)
    assert list(study.measure_steps(False, size)["rows"]) == ["tutorial, 2^2 x 1", "tutorial, 2^2 x 2"]
    size = study.StepsSize(scenes=("jade_null_sun",), sides=(4,), steps=2)
    answer = study.STUDY.questions["gradients"](size)
    (row,) = answer["rows"].values()
    assert row["ratio"] == answer["least_ratio"] > 0 and row["milliseconds"]["mivol"] > 0
    # A replay of three kernels: the image, the light again, and its derivatives, with their fills and sums.
    assert 0 < row["render_launches"]["mivol"] < row["launches"]["mivol"] < 250
    study.draw({"gradients": answer}, tmp_path / "steps.png")
    assert (tmp_path / "steps.png").stat().st_size > 1000
    (bar,) = study.compare("gradients", {"least_ratio": 0.9})
    assert not bar["met"]


def test_a_loop_fits_its_parameter() -> None:
    """Adam's first step moves each number with a derivative by its rate, and values stay at 0 or above."""
    loop = study._FitLoop(study.chosen_scenes(["jade_null_sun"])["jade_null_sun"], "mivol", 4, 1)
    before = np.array(loop.start)
    loop.fit()
    after = np.array(loop.params[loop.key])
    assert np.allclose(np.abs(after - before).max(), 1e-3, rtol=1e-3) and after.min() >= 0


def test_loops_have_a_row_for_each_film(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "FILMS", ((2, 1), (4, 2)))
    answer = study.measure_loops(study.StepsSize(loop_scenes=("tutorial",), films=2, loop_steps=1))
    assert list(answer["rows"]) == ["tutorial, 2^2 x 1", "tutorial, 4^2 x 2"]
    assert answer["least_ratio"] == min(row["ratio"] for row in answer["rows"].values()) > 0


def test_first_steps_are_timed_in_processes_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with an empty folder for kernels; a failed process is named."""
    calls = []

    def run(code: str, *args: str, env: dict, timeout: float) -> SimpleNamespace:
        assert list(Path(env["DRJIT_CACHE_DIR"]).iterdir()) == []
        calls.append(args)
        slow = args[2] == "mivol"
        line = json.dumps({"milliseconds": 3000.0 if slow else 1500.0, "launches": 7})
        return SimpleNamespace(returncode=args[1] == "jade_null_sun", stdout=f"a warning\n{line}\n", stderr="no memory")

    monkeypatch.setattr(study, "run_child", run)
    answer = study.measure_first(study.StepsSize(loop_scenes=("tutorial",)))
    assert calls == [(mi.variant(), "tutorial", who) for who in (study.PEER, "mivol")]
    assert answer["most_seconds"] == 3 and answer["rows"]["tutorial, first step"]["ratio"] == 0.5
    assert [bar["met"] for bar in study.compare("first", answer)] == [False]
    with pytest.raises(MivolError, match="first step of prbvolpath ended with True: no memory"):
        study.measure_first(study.StepsSize(loop_scenes=("jade_null_sun",)))


def test_the_chair_is_left_out_without_its_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "find_photographs", lambda name, size: None)
    answer = study.measure_chair(study.StepsSize())
    assert answer == {"rows": {}} and study.compare("chair", answer) == [] and len(study.table("chair", answer)) == 2
    slow = {"rows": {"the chair": {"milliseconds": {"mivol": 51.0}}}}
    assert [bar["met"] for bar in study.compare("chair", slow)] == [False]


def test_a_scene_that_is_misspelt_is_named() -> None:
    with pytest.raises(MivolError, match='there is no scene "jade_null_sum": .*jade_null_sun'):
        study.measure_steps(False, study.StepsSize(scenes=("jade_null_sum",)))


@pytest.mark.slow
def test_steps_of_fits_have_a_peer_where_there_is_one() -> None:
    answer = study.measure_fits(study.StepsSize(steps=1))
    assert list(answer["rows"]) == ["a scene with Adam", "a grid", "Gaussians"]
    assert answer["least_ratio"] == answer["rows"]["a scene with Adam"]["ratio"] > 0
    assert all(row["milliseconds"]["mivol"] > 0 and row["launches"]["mivol"] > 10 for row in answer["rows"].values())
    assert len(study.table("fits", answer)) == 5
