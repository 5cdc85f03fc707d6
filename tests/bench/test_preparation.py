"""The study of prepared scans: one scan of each cheap question, and how many count as found."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.bench.studies import preparation
from mivol.bench.studies.preparation import RING_CASES, PreparationSize, find_one_axis, find_scatter, join_axes, join_rings


@pytest.mark.parametrize(("label", "level"), [("head, no noise", 1.0), ("head, 10,000 quanta, views divided by air", 1.0207)])
def test_scattered_light_is_found(variant_rgb: str, label: str, level: float) -> None:
    """The square of 1 + 0.2 u - 0.6 u^2 has the mean 0.6853 over -1 <= u <= 1; four outer columns at each end see 0.0207 of
    it, beside the light without object."""
    answer = find_scatter(label, PreparationSize())
    # The mean over 129 columns instead of the integral: less than a hundredth.
    assert answer["scatter"] == pytest.approx(0.05 * np.sqrt(0.6853) / level, rel=0.01)
    assert answer["error"] < answer["scatter"] / 4 and answer["sigma"] < answer["scatter"] / 4
    assert answer["lines after"] < answer["lines before"] / 4 and answer["subtracted"] == 1


@pytest.mark.parametrize(("name", "column"), [("few views", 61.2), ("air .9", 60.8)])
def test_the_axis_of_a_scan_is_found(variant_rgb: str, name: str, column: float) -> None:
    answer = find_one_axis(name, PreparationSize())
    assert answer["column"] == pytest.approx(column) and 0 < abs(answer["error"]) < 0.2 and answer["sigma"] < 0.1


def test_axes_count_as_found_or_told() -> None:
    """Within 0.2 columns, or within two standard deviations."""
    rows = {k: {"error": e, "sigma": s} for k, (e, s) in enumerate([(-0.19, 0), (0.2, 0), (-0.39, 0.2), (0.39, 0.19)])}
    answer = join_axes(PreparationSize(), rows)
    assert (answer["count"], answer["found"], answer["found_or_told"]) == (4, 1, 2)


def test_errors_of_rings_are_means_over_the_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each case has a seed for each scan, and errors over that of the scan without rings."""
    size = PreparationSize(seeds=2)
    found = {(label, seed): {"none": 1.0 + seed, "gain": 3.0 * seed} for label in RING_CASES for seed in (0, 1)}
    assert join_rings(size, found) == {label: {"none": 1.5, "gain": 1.5} for label in RING_CASES}
    errors = iter([2.0, 6.0, 4.0, 3.0, 2.0, 1.0])
    monkeypatch.setattr(preparation, "solve_by_default", lambda *_: None)
    monkeypatch.setattr(preparation, "nrmse", lambda *_: next(errors))
    answer = preparation.measure_ring_errors(("head", 0.53, 1e4), 100)
    assert answer == {"none": 3.0, "gain": 2.0, "fit": 1.5, "gain, no rings": 1.0, "fit, no rings": 0.5}
