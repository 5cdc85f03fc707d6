"""The bench of multiple scattering: renderers have one mean at their own depth, and every contest has its bar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from false_alarms import ALPHA, fresh, note

from mivol.bench.harness import agreement
from mivol.bench.harness.timing import Budget
from mivol.bench.studies import multiple_scattering as bench
from mivol.bench.studies.single_scattering import QUICK

TINY = replace(QUICK, rounds=6, most_pixels=8, budget=Budget(spp=64))


def test_contests_are_those_of_the_published_table():
    """Volume, light, depth, albedo and bar of every row."""
    rows = {(v, n): (light.depth, light.albedo, light.bar) for v, c in bench.CONTESTS.items() for n, light in c.items()}
    assert list(rows.values()) == [
        *((6, 0.75, bar) for bar in (40, 50, 80, 5, 6, 9)),
        (6, 0.999, 80),
        (-1, 0.999, 30),
        *((6, 0.75, bar) for bar in (25, 25, 12)),
        (-1, 0.999, 300),
        (-1, bench.CONTESTS["milk"]["glass, lamp and sky, unlimited"].albedo, 10),
    ]
    assert all(light.by_pixel == light.has_tails == (light.depth < 0) for c in bench.CONTESTS.values() for light in c.values())
    assert bench.white_box().values.max() * 2 == bench.WHITE_DEPTH == 64
    assert np.allclose(bench.thin_smoke().values.max() * 20, bench.smoke().values.max())


def test_samples_take_longer_where_errors_have_heavy_tails():
    """The variance of 8 samples a pixel misses the tails of volpath in the cloud, and with them half of the ratio."""
    six, unlimited = bench.CONTESTS["cloud"].values()
    assert bench.long_enough(QUICK, six) is QUICK
    longer = bench.long_enough(QUICK, unlimited)
    assert longer.budget == Budget(seconds=16 * QUICK.budget.seconds)
    assert longer == replace(QUICK, budget=longer.budget)
    assert bench.long_enough(TINY, unlimited).budget.spp == 64


def test_the_milk_is_the_measured_one() -> None:
    """Skim milk scatters 0.70, 1.22 and 1.90 times a millimetre and absorbs 0.0014, 0.0025 and 0.0142 times; 40 mm are 2."""
    scattered, absorbed = np.array([0.7, 1.22, 1.9]) * 20, np.array([0.0014, 0.0025, 0.0142]) * 20
    (light,) = bench.CONTESTS["milk"].values()
    np.testing.assert_allclose(bench.milk().values, scattered + absorbed)
    np.testing.assert_allclose(bench.milk().values * light.albedo, scattered)
    assert light.peers == ("volpath", "prbvolpath", "volpathmis")


@pytest.mark.slow
@pytest.mark.statistical
def test_renderers_agree(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a small fog of each light; the bench's own judge at the suite's chance of a false alarm."""
    monkeypatch.setattr(agreement, "FALSE_ALARM", ALPHA)
    values = np.pad(np.random.default_rng(1).uniform(0.5, 1.5, (3, 4, 5)), 1).astype(np.float32)
    for name, light in bench.CONTESTS["smoke"].items():
        figures = bench.contend(values, light, replace(TINY, seed=fresh(0) % 100_000))
        bars = bench.compare("smoke", dict.fromkeys(bench.CONTESTS["smoke"], figures))
        note(ALPHA, name)
        assert all(bar["met"] for bar in bars if bar["figure"].startswith("|z|")), name
