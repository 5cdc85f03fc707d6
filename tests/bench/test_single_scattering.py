"""The bench of single scattering: renderers have one mean, the judge of that can say no, and ratios weigh variance and time.

Renders have fixed samples and seeds. Nothing is concluded from times, nor from the mean where an emitter stands in the medium:
single samples have no bound there.
"""

from __future__ import annotations

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import ALPHA, fresh, note

from mivol.bench import agreement
from mivol.bench import single_scattering as bench
from mivol.bench.agreement import compare_means
from mivol.bench.scenes import box_scene, of_depth
from mivol.bench.timing import Budget, Timing
from mivol.validate.statistics import Estimate

TINY = replace(bench.QUICK, rounds=6, most_pixels=8, budget=Budget(spp=64))


def fog() -> np.ndarray:
    """An extinction of 0.5 to 1.5, empty at its boundary."""
    return np.pad(np.random.default_rng(1).uniform(0.5, 1.5, (3, 4, 5)), 1).astype(np.float32)


def fake(rounds: np.ndarray, seconds: float = 1.0) -> Timing:
    """A contestant that returned these images (rounds, H, W) and took so long each."""
    images = np.repeat(np.asarray(rounds)[..., None], 3, axis=-1)
    return Timing({}, [seconds] * len(images), [seconds] * len(images), list(images))


@pytest.mark.slow
@pytest.mark.statistical
def test_renderers_agree_in_a_sky(variant_rgb: str, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Radiance is at most 1 and its samples are many: t has hundreds of degrees of freedom. Of the comparisons that share the
    false alarms of a run, those with two stock integrators are made here. A bound on z says nothing where the standard error
    is as large as the mean."""
    comparisons = len(bench.VOLUMES) * len(bench.LIGHTS) * len(bench.STOCK)
    monkeypatch.setattr(agreement, "FALSE_ALARM", comparisons * ALPHA)
    note(len(bench.STOCK) * ALPHA, "images")
    figures = bench.contend(fog(), bench.LIGHTS["constant light"], replace(TINY, seed=fresh(0) % 100_000), (1, 4))
    assert figures["pixels_that_count"] > 0
    assert [[row["spp"] for row in figures[name]] for name in (bench.OURS, *bench.STOCK)] == [[64, 16]] * 3
    answer = {"smoke": dict.fromkeys(bench.LIGHTS, figures)}
    rows = bench.compare("smoke", answer["smoke"])
    agreeing = [row for row in rows if row["figure"].startswith("|z|: ")]
    assert (len(rows), len(agreeing)) == (2 * len(bench.LIGHTS) * len(bench.STOCK), len(bench.LIGHTS) * len(bench.STOCK))
    assert all(row["met"] for row in agreeing), agreeing
    for stock in bench.STOCK:
        assert figures[f"mivol over {stock}"]["relative_standard_error"] < 0.05
        assert figures[f"mivol over {stock}"]["variance_x_time_mean_over_pixels"] > 0
    bench.draw(answer, tmp_path)
    assert (tmp_path / "bench_single_scattering.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", bench.LIGHTS)
def test_every_light_lights_the_medium(variant_rgb: str, name: str) -> None:
    scene = mi.load_dict(box_scene(fog(), 8, bench.ALBEDO, **bench.LIGHTS[name].parts()))
    image = np.array(mi.render(scene, integrator=of_depth(bench.OURS, 2), spp=4, seed=0))
    assert image[bench.optical_depths(scene) > bench.SEEN].mean() > 0.01


def test_volumes_have_the_resolution_of_their_size(variant_rgb: str) -> None:
    size = replace(TINY, fine_res=12, sparse_res=16)
    for name, res in (("fine smoke", 12), ("CT", 12), ("threads", 16)):
        assert bench.VOLUMES[name](size).values.shape == (res,) * 3


def swings(rounds: int, pixels: int) -> np.ndarray:
    """(rounds, pixels, 1): every pixel swings by 1 about 0, neighbours against each other, so that no round stands out."""
    return np.where(np.add.outer(np.arange(rounds), np.arange(pixels)) % 2, 1.0, -1.0)[..., None]


def test_a_bias_of_six_standard_errors_is_seen() -> None:
    """2000 pixels that swing by 1 over 8 rounds: each mean has the variance 1 / (7 x 2000), and t has 28,000 degrees of
    freedom, so that the bound is the normal law's, 4.2."""
    a, counts = 10 + swings(8, 2000), np.ones((2000, 1), bool)
    error = math.sqrt(2 / 14000)
    found = bench.difference(fake(a), fake(a[::-1] + 6 * error), counts)
    assert found["z"] == pytest.approx(6)
    assert found["z_bound"] == pytest.approx(4.2, abs=0.05)
    assert found["relative_standard_error"] == pytest.approx(error / 10, rel=0.01)


def test_equal_error_weighs_variance_and_time() -> None:
    """Twice the deviation and three times the time: 12. Pixels without any noise count for neither; where a quarter of the
    others has ten times the deviation, the mean shows it and the median does not."""
    swing, counts = swings(8, 400), np.ones((400, 1), bool)
    swing[:, 200:] = 0
    got = bench.gain(fake(2 * swing, 3.0), fake(swing), counts)
    assert got["variance_x_time_mean_over_pixels"] == pytest.approx(12)
    assert got["variance_x_time_median_over_pixels"] == pytest.approx(12)
    assert (got["time"], got["processor_time"]) == (3, 3)
    uneven = 2 * swing
    uneven[:, 150:] *= 10
    got = bench.gain(fake(uneven, 3.0), fake(swing), counts)
    assert got["variance_x_time_mean_over_pixels"] == pytest.approx(12 * (0.75 + 0.25 * 100))
    assert got["variance_x_time_median_over_pixels"] == pytest.approx(12)


def test_pixels_at_the_emitter_do_not_count(variant_rgb: str) -> None:
    """The brightest pixel of a thin fog is at the emitter; it and its neighbours are left out, no others."""
    light = bench.LIGHTS["point light inside"]
    scene = mi.load_dict(box_scene(np.full((4, 4, 4), 0.1, np.float32), 24, 0.75, **light.parts()))
    image = np.array(mi.render(scene, integrator=of_depth("mivol", 2), spp=64)).mean(axis=-1)
    left_out = bench.pixels_from_emitter(scene, light, 24) <= bench.AT_EMITTER
    assert left_out[np.unravel_index(image.argmax(), image.shape)]
    # a disc of 1.5 pixels' radius holds the centres of 4 to 9 pixels
    assert 4 <= left_out.sum() <= 9
    assert np.isinf(bench.pixels_from_emitter(scene, light._replace(inside=None), 24)).all()


def test_an_emitter_inside_is_judged_in_thin_matter_away_from_it(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ratios are of the volume itself, and pixels up to the emitter count; means are compared in the volume thinned to an
    optical depth of 1, in pixels further than a quarter of the picture from it."""
    used, depths, side = {}, [], 16
    monkeypatch.setattr(bench, "gain", lambda slow, fast, counts: used.setdefault("gain", (fast.median, counts)) and {})
    monkeypatch.setattr(bench, "difference", lambda slow, fast, fair: used.setdefault("z", (fast.median, fair)) and {})
    rng = np.random.default_rng(0)

    def rendered(scene: mi.Scene, *_: object) -> tuple[dict, dict]:
        depths.append(bench.optical_depths(scene).max())
        made = fake(rng.uniform(1, 2, (4, side, side)), len(depths))
        return ({(name, 1): made for name in (bench.OURS, *bench.STOCK)}, {(name, 1): 1 for name in (bench.OURS, *bench.STOCK)})

    monkeypatch.setattr(bench, "render_in_turns", rendered)
    light = bench.LIGHTS["point light inside"]
    bench.contend(np.full((4, 4, 4), 7.0, np.float32), light, replace(TINY, most_pixels=side))
    assert depths[0] > 10
    assert depths[1] == pytest.approx(1, rel=1e-3)
    away = bench.pixels_from_emitter(mi.load_dict(box_scene(np.ones((2, 2, 2), np.float32), side)), light, side)
    (first, counts), (second, fair) = used["gain"], used["z"]
    assert (first, second) == (1, 2)
    assert bench.AT_EMITTER < away[counts].min() < 3
    assert away[fair].min() > side / 4
    assert 0 < fair.sum() < counts.sum()


def test_a_difference_without_noise_is_beyond_every_bound() -> None:
    found = compare_means(Estimate(1.0, 0.0, 5.0), Estimate(2.0, 0.0, 5.0), 1)
    assert found["z"] is None
    assert found["percent"] == pytest.approx(-50)
