"""`scripts/bench_single_scattering.py --quick`: every integrator has the same mean in every light, and the judge of that is
able to say no. Ratios of a quick run mean nothing and decide nothing."""

from __future__ import annotations

import math
from types import ModuleType

import bench_script
import numpy as np
import pytest

ASKED = ("smoke", "threads")


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    return bench_script.load("bench_single_scattering")


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What the script prints; it ends with status 1 where means differ."""
    return bench_script.quick("bench_single_scattering", tmp_path_factory.mktemp("bench"), "--only", ",".join(ASKED))


def test_every_light_is_answered(quick: dict, bench: ModuleType) -> None:
    assert len(quick["bars"]) == 2 * len(ASKED) * len(bench.LIGHTS) * len(bench.STOCK)
    for volume in ASKED:
        for light in bench.LIGHTS:
            figures = quick[volume][light]
            assert figures["pixels_that_count"] > 0
            assert all(row["seconds_median"] > 0 for name in (bench.OURS, *bench.STOCK) for row in figures[name])
            assert all(figures[f"mivol over {stock}"]["variance_x_time_mean_over_pixels"] > 0 for stock in bench.STOCK)
    assert (quick["folder"] / "bench_single_scattering.png").read_bytes().startswith(b"\x89PNG")


def test_means_agree_and_are_known_well_enough(quick: dict, bench: ModuleType) -> None:
    """A bound on z says nothing where the standard error is as large as the mean."""
    rows = [row for row in quick["bars"] if row["figure"].startswith("|z|")]
    assert len(rows) == len(ASKED) * len(bench.LIGHTS) * len(bench.STOCK)
    assert all(row["met"] for row in rows)
    errors = [g["relative_standard_error"] for v in ASKED for a in quick[v].values() for k, g in _gains(a)]
    assert np.median(errors) < 0.1


def _gains(answer: object) -> list[tuple[str, dict]]:
    return [(k, g) for k, g in answer.items() if k.startswith("mivol over")] if isinstance(answer, dict) else []


def test_a_bias_of_six_standard_errors_is_seen(bench: ModuleType) -> None:
    """2000 pixels of unit variance, 8 seeds: the mean has the error sqrt(2 / 16000), and the bound is 4.2 of them."""
    rng = np.random.default_rng(3)
    a, b = rng.normal(10, 1, (2, 8, 2000))
    assert abs(bench.difference(a, b)["z"]) < 4.3
    found = bench.difference(a, b + 10 * math.sqrt(2 / 16000))
    assert found["z"] > found["z_bound"]


def test_pixels_that_share_their_noise_are_not_taken_for_many(bench: ModuleType) -> None:
    """The same number in all pixels of a round: the error is that of 8 numbers, not of 16000."""
    rng = np.random.default_rng(6)
    shared = np.repeat(rng.normal(10, 1, (8, 1)), 2000, axis=1)
    assert bench.error_of_mean(shared) == pytest.approx(np.var(shared[:, 0], ddof=1) / 8)


def test_equal_error_weighs_variance_and_time(bench: ModuleType) -> None:
    """Twice the deviation and three times the time: 12, to the 2 % that the variances of 8 x 4000 values are known to."""
    rng = np.random.default_rng(4)
    fast, slow = bench.Timing({}), bench.Timing({})
    for timing, deviation, seconds in ((fast, 1, 1.0), (slow, 2, 3.0)):
        timing.results = list(rng.normal(0, deviation, (8, 4000, 1, 3)))
        timing.seconds = timing.processor = [seconds] * 8
    got = bench.gain(slow, fast, np.ones((4000, 1), bool))
    # the variance of one value is known to sqrt(2/7) of itself, the mean over 12000 of them to 0.5 %, their ratio to 0.7 %
    assert got["variance_x_time_mean_over_pixels"] == pytest.approx(12, rel=0.035)
    # the ratio of two chi-square of 21 degrees of freedom has the median 1, known to 1.25 * 0.44 / sqrt(4000) = 0.9 %
    assert got["variance_x_time_median_over_pixels"] == pytest.approx(12, rel=0.045)


def test_pixels_at_the_lamp_do_not_count(bench: ModuleType, variant_rgb: str) -> None:
    """The brightest pixel of a thin fog is at the lamp; it and its neighbours are left out, no others."""
    import mitsuba as mi

    light = bench.LIGHTS["point light inside"]
    scene = mi.load_dict(bench.box_of(np.full((4, 4, 4), 0.1, np.float32), 24, 0.75, **light.parts()))
    image = np.array(mi.render(scene, integrator=bench.scatters_once("mivol"), spp=64)).mean(axis=-1)
    left_out = bench.seeing(scene, light._replace(inside=None), 24) & ~bench.seeing(scene, light, 24)
    assert left_out[np.unravel_index(image.argmax(), image.shape)]
    # a disc of 1.5 pixels' radius holds the centres of 4 to 9 pixels
    assert 4 <= left_out.sum() <= 9
