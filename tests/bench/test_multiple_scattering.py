"""Multiple scattering: integrators have one mean at each depth, and the contests are those of the published table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from false_alarms import ALPHA, fresh, note

from mivol.bench.harness import agreement
from mivol.bench.studies import multiple_scattering as study
from mivol.bench.studies.multiple_scattering import CONTESTS, STUDY
from mivol.bench.studies.single_scattering import ContestSize, contend

TINY = replace(ContestSize.quick(), rounds=6, max_pixels=8, spp=64)


def test_unlimited_depth_is_judged_by_the_median() -> None:
    """Errors of unlimited paths have heavy tails."""
    lights = [light for lights in CONTESTS.values() for light in lights.values()]
    assert all(light.by_pixel == light.has_tails == (light.depth < 0) for light in lights)
    assert set(CONTESTS) == set(study.VOLUMES) == set(STUDY.questions)
    assert study.white_box().values.max() * 2 == study.WHITE_DEPTH == 64
    assert np.allclose(study.thin_smoke().values.max() * 20, study.smoke().values.max())


def test_the_milk_is_the_measured_one() -> None:
    """Skim milk scatters 0.70, 1.22 and 1.90 times per millimetre and absorbs 0.0014, 0.0025 and 0.0142 times; the edge of 2 is
    40 mm long."""
    sigma_s, sigma_a = np.array([0.7, 1.22, 1.9]) * 20, np.array([0.0014, 0.0025, 0.0142]) * 20
    (light,) = CONTESTS["milk"].values()
    np.testing.assert_allclose(study.milk().values, sigma_s + sigma_a)
    np.testing.assert_allclose(study.milk().values * light.albedo, sigma_s)
    assert light.peers == ("volpath", "prbvolpath", "volpathmis")


def test_only_volpath_has_a_bar() -> None:
    """Three ratios of the milk with their agreement, of which one is judged."""
    figures = {"variance_x_time_median_over_pixels": 11.0, "z": -1.0, "z_bound": 4.0}
    answer = {name: {f"mivol over {peer}": figures for peer in light.peers} for name, light in CONTESTS["milk"].items()}
    bars = STUDY.bars("milk", answer)
    assert [(bar["value"], bar["bar"]) for bar in bars] == [(11.0, 10), (1.0, 4.0), (1.0, 4.0), (1.0, 4.0)]


@pytest.mark.slow
@pytest.mark.statistical
def test_integrators_agree(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a small fog in each light of the smoke, at the false-alarm rate of the suite."""
    monkeypatch.setattr(agreement, "FALSE_ALARM", ALPHA)
    values = np.pad(np.random.default_rng(1).uniform(0.5, 1.5, (3, 4, 5)), 1).astype(np.float32)
    for name, light in CONTESTS["smoke"].items():
        figures = contend(values, light, replace(TINY, seed=fresh(0) % 40_000))
        bars = STUDY.bars("smoke", dict.fromkeys(CONTESTS["smoke"], figures))
        note(ALPHA, name)
        assert all(bar["met"] for bar in bars if bar["figure"].startswith("|z|")), name
