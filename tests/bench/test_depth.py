"""Study of depth 2: it measures the table of mivol.scene.depth_two again, with its standard error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from false_alarms import Estimate, assert_same_mean, assert_same_variance, fresh

from mivol.bench.studies import depth as study
from mivol.scene import depth_two
from mivol.scene.depth_two import ALBEDOS, TABLES, TAUS
from mivol.validate.statistics import Moments

ROUNDING = 5e-4
"""Of a table of three digits."""


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("light", ["constant", "collimated"])
def test_a_cell_is_measured_again(variant_rgb: str, light: str, seed: int) -> None:
    """Albedo 0.9 at tau = 1 by other lines and samples than the table's: within the noise of this measurement, the table's own
    (0.0014, a quarter of this one's with 16 times the lines) and its rounding; 16,384 lines: normal."""
    key = (light, "isotropic")
    cell = study.measure_cell(*key, 0.9, 1.0, n=1 << 14, seed=77 + seed)
    wanted = TABLES[key][ALBEDOS.index(0.9), TAUS.index(1.0)]
    assert cell["standard_error"] < 0.01, "else the test sees nothing"
    measured = Estimate(cell["error"], cell["standard_error"] ** 2 * (1 + 1 / 16))
    assert_same_mean(measured, wanted, rounding=ROUNDING, what="light left out")


@pytest.mark.statistical
def test_standard_error_of_a_ratio() -> None:
    """2000 ratios of 400 pairs each scatter as the delta method says, which errs by O(1 / n) = a few per mille."""
    rng = np.random.default_rng(fresh(0))
    every = rng.exponential(1.0, (2000, 400))
    once = 0.6 * every * rng.random((2000, 400))
    result = [study.missing_share(a, b) for a, b in zip(once, every, strict=True)]
    errors, standard_errors = np.array(result).T
    assert_same_mean(Moments.from_values(errors), 0.7, rounding=1e-3, what="ratios")
    assert_same_variance(errors, np.mean(standard_errors**2), what="ratios")


def cells_of_the_module() -> list[dict]:
    """The table as measured cells, with a standard error of 0.001."""
    return [
        {"light": key[0], "phase": key[1], "albedo": albedo, "tau": tau, "error": TABLES[key][i, j], "standard_error": 0.001}
        for key in TABLES for i, albedo in enumerate(ALBEDOS) for j, tau in enumerate(TAUS)
    ]  # fmt: skip


def test_the_table_is_printed_as_the_module_holds_it() -> None:
    cells = cells_of_the_module()
    assert "\n".join(study.table_source(cells)) in Path(depth_two.__file__).read_text()


@pytest.mark.slow
def test_a_table_that_is_off_is_seen(tmp_path: Path) -> None:
    """Cells that are the table meet their bars and are drawn; one that is off by six of its standard errors does not."""
    size = replace(study.DepthSize.quick(), taus=TAUS)
    answer = {"lines": size.lines, "cells": cells_of_the_module()}
    assert all(bar["met"] for bar in study.STUDY.bars("table", answer))
    study.draw({"table": answer}, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 20_000
    answer["cells"][7]["error"] -= 0.0066
    assert [bar["met"] for bar in study.STUDY.bars("table", answer)] == [True, False]


@pytest.mark.slow
def test_every_cell_is_measured(variant_rgb: str) -> None:
    """With a standard error that falls with the root of the lines; those are too few here for bars."""
    size = replace(study.DepthSize.quick(), lines=1 << 10, taus=(1.0,))
    answers = study.STUDY.answer(("table",), size)
    assert len(answers["table"]["cells"]) == len(TABLES) * len(ALBEDOS)
    assert all(0 < cell["standard_error"] < 0.2 for cell in answers["table"]["cells"])
    assert len(answers["bars"]) == 2
