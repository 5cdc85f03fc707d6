"""Answers beside the bars of their benches: which figure is judged, by which bar, in which sense."""

from __future__ import annotations

import pytest

from mivol.bench.harness import bars
from mivol.bench.harness.study import Bench
from mivol.bench.studies import depth, gradients, optical_depth, radiance_field
from mivol.bench.studies.gradients.size import CONTESTS, OURS


def judged(bench: Bench, question: str, answer: dict) -> list[tuple]:
    return [(bar["value"], bar["sense"], bar["bar"], bar["met"]) for bar in bench.compare(question, answer)]


OPTICAL_DEPTH = {
    "walk": ({"camera order": {"rays_per_second_median": 2e7}}, [(20, "at least", 15, True)]),
    "image": ({"volpath, max_depth 1": {"mivol_is_faster": 19.0}}, [(19, "at least", 20, False)]),
    "reverse": ({"smoke": {"reverse over forward": 4.5}}, [(4.5, "at most", 4, False)]),
    "memory": ({"a": {"bytes_per_ray": 20.0}, "b": {"bytes_per_ray": 33.0}}, [(33, "at most", 32, False)]),
    "accuracy": (
        {"64^3 noise": {"largest_error": 1e-6}, "64^3 smoke": {"largest_error": 3e-6}, "256^3 noise": {"largest_error": 2e-6}},
        [(3e-6, "at most", 2e-6, False), (2e-6, "at most", 2e-6, True)],
    ),
    "grids": ({}, []),
}


@pytest.mark.parametrize("question", OPTICAL_DEPTH)
def test_optical_depth(question: str) -> None:
    answer, expected = OPTICAL_DEPTH[question]
    assert judged(optical_depth.BENCH, question, answer) == expected


RADIANCE_FIELD = {
    "memory": ({"bytes_per_ray": 512.0}, [(512, "at most", 512, True)]),
    "locality": ({}, []),
    "photographs": (
        {
            "chair at 256": {"psnr": 31.0, "seconds": 300.0, "held_gib": 1.6},
            "chair, fine": {"psnr": 32.0, "seconds": 1201.0, "held_gib": 3.0},
            "wires at 128": {"psnr": 20.0},
            "wires, fine": {"psnr": 20.0},
        },
        [
            (31, "at least", 31.3, False),
            (300, "at most", 300, True),
            (1.6, "at most", 1.5, False),
            (32, "at least", 32, True),
            (1201, "at most", 1200, False),
            (3, "at most", 16, True),
        ],
    ),
    "priors": ({}, []),
    "fit": ({"fog": {"ratio": 9.0}, "shell": {"ratio": 10.0}}, [(9, "at least", 10, False), (10, "at least", 10, True)]),
    "step": (
        {"fog": {kind: {"ratio_of_processor_time": r} for kind, r in (("camera", 7.0), ("pixels", 5.0), ("any", 3.0))}},
        [(7, "at least", 8, False), (5, "at least", 4, True), (3, "at least", 4, False)],
    ),
}


@pytest.mark.parametrize("question", RADIANCE_FIELD)
def test_radiance_field(question: str) -> None:
    answer, expected = RADIANCE_FIELD[question]
    assert judged(radiance_field.BENCH, question, answer) == expected


def test_gradients():
    """A ratio beside its bar, then its agreement; of a table the bias with its error, in percent and in standard errors."""
    dense = {"sigma_t >= 1": {"variance_x_time": 40.0, "z": -2.0, "z_bound": 3.5}}
    smoke = judged(gradients.BENCH, "smoke", {light: {"the sum": dense} for light in CONTESTS["smoke"][1]})
    assert smoke == [
        (40, "at least", 60, False),
        (2, "at most", 3.5, True),
        (40, "at least", 30, True),
        (2, "at most", 3.5, True),
    ]
    row = {OURS: {"bias_percent": -0.3, "known_to_percent": 0.1, "bias_standard_errors": -3.5}}
    table = judged(gradients.BENCH, "estimators", {"sun": {"density 0": row}})
    assert table == [(pytest.approx(0.6), "at most", 0.5, False), (3.5, "at most", 3, False)]
    tutorial = {"to_the_last_loss_of_prbvolpath": {"sooner": 20.0}}
    assert judged(gradients.BENCH, "tutorial", tutorial) == [(20, "at least", 20, True)]


def test_depth_beside_the_table():
    """The largest distance, of whichever sign."""
    cells = [depth.Cell("smoke", "constant", "isotropic", 0.5, 1.0, 1.0, 2.0, error, 0.01, 1.0) for error in (0.2, 0.9)]
    answer = {"cells": [vars(cell) for cell in cells], "lines": depth.QUICK.lines}
    known = depth.depth_two_error(0.5, 1.0, "constant", "isotropic")
    (bar,) = judged(depth.BENCH, "beside", answer)
    assert bar == (pytest.approx(0.9 - known), "at most", 0.2, False)


def test_means_without_noise_that_differ_are_beyond_every_bound(capsys: pytest.CaptureFixture) -> None:
    found = [
        bars.judge_agreement("one", None, 4.0),
        bars.judge_agreement("two", -5.0, 4.0),
        bars.judge_agreement("three", 4, 4.0),
    ]
    assert bars.means_that_differ(found) == ["|z|: one", "|z|: two"]
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and said[1] == "  |z|: two: 5, bar at most 4: MISSED"
