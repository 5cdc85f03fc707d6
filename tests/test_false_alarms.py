"""The count of false alarms: what a run adds up, what ends red, and that each law keeps its rate and sees what is wrong."""

from __future__ import annotations

import ast
import contextlib
import io
import sys
from pathlib import Path
from unittest import mock

import false_alarms
import numpy as np
import pytest
from false_alarms import (
    Estimate,
    assert_apart,
    assert_precise,
    assert_rate,
    assert_same_bounded_mean,
    assert_same_mean,
    assert_same_median,
    assert_same_spread,
    assert_same_variance,
    assert_within,
    difference,
    fresh,
    over_pixels,
)

from mivol.validate.statistics import Moments

TESTS = Path(__file__).parent

# -- A run of pytest ---------------------------------------------------------------------------------------------------

CONFTEST = """
import json
import false_alarms
import pytest

def pytest_configure(config):
    config.addinivalue_line("markers", "statistical: compares noise")
    config.pluginmanager.register(false_alarms.Count())

@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    "A report goes the way that it takes from a worker of pytest-xdist: as numbers, strings, lists and dictionaries."
    report, hook = (yield), item.config.hook
    sent = json.loads(json.dumps(hook.pytest_report_to_serializable(config=item.config, report=report)))
    return hook.pytest_report_from_serializable(config=item.config, data=sent)

def pytest_generate_tests(metafunc):
    if "seed" in metafunc.fixturenames:
        metafunc.parametrize("seed", range(2))
"""

QUIET = ("cacheprovider", "faulthandler", "xdist", "hypothesispytest", "unraisableexception", "threadexception")
"""Plugins of the run that would touch what the run around it holds, or collect garbage."""


def outcome(folder: Path, tests: str) -> tuple[int, str]:
    """Exit code and output of a run of these tests, in this process: one of its own would import Mitsuba again."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_it.py").write_text("from false_alarms import *\nimport pytest\nnoise = pytest.mark.statistical\n" + tests)
    (folder / "pytest.ini").write_text("[pytest]\naddopts = --import-mode=importlib\n")
    # Modules are forgotten: those of the next run have the same names.
    with contextlib.redirect_stdout(io.StringIO()) as said, mock.patch.dict(sys.modules):
        code = pytest.main(["--capture=no", *(f"-pno:{name}" for name in QUIET), "--rootdir", str(folder), str(folder)])
    return int(code), said.getvalue()


def test_chances_of_a_run_add_up(tmp_path):
    """Over workers, tests and comparisons; of several rounds of seeds, each by itself."""
    tests = """
@noise
def test_one():
    note(3e-7, "one", 0.2)
    note(1e-7, "two")

@noise
def test_two(seed):
    note(2e-7, "three", 0.05 * (1 + seed))
    assert seed == 0 or fresh(5) == 5 + ROUND

def test_silent():
    pass
"""
    code, said = outcome(tmp_path, tests)
    assert code == 0, said
    assert "4 comparisons of noise in 3 tests: a false alarm with a chance of at most 6e-07 in each of 2 rounds" in said
    assert "smallest of 3 p-values: 0.05 (as small with a chance of 0.14)" in said


def test_a_run_that_is_red_too_often_by_chance_ends_red(tmp_path):
    code, said = outcome(tmp_path, "@noise\ndef test():\n    note(2e-5, 'a')")
    assert code == 1, said
    assert "1 passed" in said and "a chance of at most 2e-05" in said
    assert "the largest chance is 2e-05, of " in said and "test_it.py::test" in said


def test_a_mark_without_a_comparison_and_a_comparison_without_a_mark_are_red(tmp_path):
    tests = "@noise\ndef test_silent():\n    pass\n\ndef test_without_a_mark():\n    note(1e-9, 'a')"
    code, said = outcome(tmp_path, tests)
    assert code == 1, said
    assert "2 failed" in said
    assert "marked statistical and compares nothing" in said and "mark the test with @pytest.mark.statistical" in said


JUDGES = {"mivol.validate.statistics"}


def test_all_comparisons_are_counted():
    """No test compares noise by functions that nobody counts; the benches' own figures are theirs."""
    uncounted = {"assert_same_mean", "assert_same_bounded_mean", "z_image", "z_bound", "bounded_p_value"}
    for path in TESTS.rglob("*.py"):
        if path.name in ("false_alarms.py", "test_statistics.py", "test_compare.py"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module in JUDGES:
                assert not uncounted & {name.name for name in node.names}, path


# -- The laws --------------------------------------------------------------------------------------------------------------


def raised(comparison, *given, **how) -> bool:
    try:
        comparison(*given, **how)
    except AssertionError:
        return True
    return False


@pytest.fixture
def noted(monkeypatch) -> list[float]:
    """The chances noted from now on, which are those of values made for this test and not of the suite."""
    chances = []
    monkeypatch.setattr(false_alarms, "note", lambda chance, what, p=None: chances.append(chance))
    return chances


RUNS, OFTEN = 400, 0.05


@pytest.mark.statistical
def test_comparisons_keep_their_rate(monkeypatch):
    """Each law on values that it is made for, 400 times at a level of 0.05: not more alarms than it says, and not far fewer
    but where it is cautious (Hoeffding's bound; counts that jump; degrees of freedom that are estimated)."""
    rng = np.random.default_rng(fresh(1))
    draws = {
        "mean": lambda: raised(assert_same_mean, Moments.from_values(rng.normal(2, 1, (8, 3))), 2.0),
        "difference": lambda: raised(
            assert_same_mean,
            difference(Moments.from_values(rng.normal(2, 1, (8, 2))), Moments.from_values(rng.normal(2, 5, (4, 2)))),
        ),
        "pixels": lambda: raised(assert_same_mean, over_pixels(Moments.from_values(rng.normal(2, 1, (4, 6, 5, 1)))), 2.0),
        "bounded": lambda: raised(assert_same_bounded_mean, rng.binomial(50, 0.3, 3) / 50, 50, 0.3),
        "median": lambda: raised(assert_same_median, rng.standard_cauchy((40, 2)) + 3, 3.0),
        "precision": lambda: raised(assert_precise, Moments.from_values(rng.normal(0, 1, (8, 3))), 8**-0.5),
        "variance": lambda: raised(assert_same_variance, rng.normal(0, 2, (30, 2)), 4.0, what="v"),
        "variance about a known mean": lambda: raised(assert_same_variance, rng.normal(1, 2, 30), 4.0, mean=1.0, what="v"),
    }
    lowest = {"difference": 0.02, "pixels": 0.02, "bounded": 0.0, "median": 0.01}
    with monkeypatch.context() as patch:
        patch.setattr(false_alarms, "ALPHA", OFTEN)
        patch.setattr(false_alarms, "note", lambda *_: None)
        hits = {name: sum(draw() for _ in range(RUNS)) for name, draw in draws.items()}
    for name, count in hits.items():
        assert_rate(count, RUNS, OFTEN, at_least=lowest.get(name, OFTEN))


def test_what_is_wrong_is_seen(noted):
    """Each comparison on values that break its claim by far."""
    rng = np.random.default_rng(2)
    batches, even = Moments.from_values(rng.normal(2, 1, (16, 3))), Estimate(0, np.ones(300), 9)
    wrong = [
        (assert_same_mean, (batches, 8.0), {}),
        (assert_same_mean, (Estimate(np.array([1.0]), np.array([0.01])), 2.0), {}),
        (assert_same_bounded_mean, (0.5, 1000, 0.3), {}),
        (assert_same_median, (rng.standard_cauchy(100) + 3, 0.0), {}),
        (assert_precise, (batches, 0.05), {}),
        (assert_precise, (Estimate(1.0, 0.04), 0.1), {}),
        (assert_same_variance, (rng.normal(0, 2, 300), 1.0), {"what": "v"}),
        (assert_same_variance, (rng.normal(0, 1, 300), 4.0), {"what": "v"}),
        (assert_same_spread, (even, even), {"high": 0.5, "expected": 0.2, "what": "v"}),
        (assert_same_spread, (even, even), {"low": 2.0, "high": 9.0, "expected": 4.0, "what": "v"}),
        (assert_apart, (batches_of(rng, 2.0), batches_of(rng, 2.0)), {"expected": 5.0, "what": "v"}),
        (assert_within, (np.array([0.1, -3.0]), 1.0), {"chance": 1e-9, "what": "v"}),
    ]
    for comparison, given, how in wrong:
        assert raised(comparison, *given, **how), comparison.__name__
    assert len(noted) == len(wrong), "a comparison is noted before it raises"


def batches_of(rng: np.random.Generator, mean: float) -> Moments:
    return Moments.from_values(rng.normal(mean, 1, 32))


def test_the_chance_noted_is_that_of_the_claim(noted):
    """Two variances of 9 degrees of freedom in the ratio of 1, between 1/4 and 4: by F; two means 4 standard errors from half
    of what is expected: by Student's t."""
    one = Estimate(0.0, 1.0, 9)
    assert_same_spread(one, one, low=0.25, high=4.0, what="spread")
    assert_apart(Estimate(8.0, 0.5, 7), Estimate(0.0, 0.5, 7), expected=8.0, what="apart")
    assert_apart(Estimate(8.0, 1.0), 0.0, expected=8.0, what="apart, of known variance")
    # Tables: F(9, 9) > 4 with 0.02548, t(14) > 4 with 6.59e-4, normal > 4 with 3.167e-5.
    assert noted == pytest.approx([2 * 0.02548, 6.59e-4, 3.167e-5], rel=5e-3)
