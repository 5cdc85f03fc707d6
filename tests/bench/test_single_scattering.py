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

from mivol.bench.harness import agreement
from mivol.bench.harness.agreement import compare_means
from mivol.bench.harness.timing import Budget, Timing
from mivol.bench.scenes import box_scene, milk_in_a_glass, make_integrator
from mivol.bench.studies import single_scattering as bench
from mivol.validate.statistics import Estimate

TINY = replace(bench.QUICK, rounds=6, most_pixels=8, budget=Budget(spp=64))


def fog() -> np.ndarray:
    """An extinction of 0.5 to 1.5, empty at its boundary."""
    return np.pad(np.random.default_rng(1).uniform(0.5, 1.5, (3, 4, 5)), 1).astype(np.float32)


def fake(rounds: np.ndarray, seconds: float = 1.0, processor: float | None = None) -> Timing:
    """A contestant that returned these images (rounds, H, W) and took so long each, by the clock and by its processors."""
    images = np.repeat(np.asarray(rounds)[..., None], 3, axis=-1)
    return Timing({}, [seconds] * len(images), [processor or seconds] * len(images), list(images))


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


@pytest.mark.slow
@pytest.mark.parametrize("name", bench.LIGHTS)
def test_every_light_lights_the_medium(variant_rgb: str, name: str) -> None:
    scene = mi.load_dict(box_scene(fog(), 8, bench.ALBEDO, **bench.LIGHTS[name].parts()))
    image = np.array(mi.render(scene, integrator=make_integrator(bench.OURS, 2), spp=4, seed=0))
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
    """Twice the deviation and three times the processor time: 12. Pixels without any noise count for neither; where a quarter
    of the others has ten times the deviation, the mean shows it and the median does not."""
    swing, counts = swings(8, 400), np.ones((400, 1), bool)
    swing[:, 200:] = 0
    got = bench.gain(fake(2 * swing, 5.0, 3.0), fake(swing), counts)
    assert got["variance_x_time_mean_over_pixels"] == pytest.approx(12)
    assert got["variance_x_time_median_over_pixels"] == pytest.approx(12)
    assert (got["time"], got["processor_time"]) == (5, 3)
    uneven = 2 * swing
    uneven[:, 150:] *= 10
    got = bench.gain(fake(uneven, 3.0), fake(swing), counts)
    assert got["variance_x_time_mean_over_pixels"] == pytest.approx(12 * (0.75 + 0.25 * 100))
    assert got["variance_x_time_median_over_pixels"] == pytest.approx(12)


@pytest.mark.slow
def test_pixels_at_the_emitter_do_not_count(variant_rgb: str) -> None:
    """The brightest pixel of a thin fog is at the emitter; it and its neighbours are left out, no others."""
    light = bench.LIGHTS["point light inside"]
    scene = mi.load_dict(box_scene(np.full((4, 4, 4), 0.1, np.float32), 24, 0.75, **light.parts()))
    image = np.array(mi.render(scene, integrator=make_integrator("mivol", 2), spp=64)).mean(axis=-1)
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


def test_a_volume_behind_glass_counts_where_it_would_be_seen_without(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays end at a surface that bends them: pixels count by the volume alone. Where the light has tails, means are compared in
    the volume thinned to an optical depth of 1."""
    used, depths, side = {}, [], 6
    monkeypatch.setattr(bench, "gain", lambda slow, fast, counts: used.setdefault("gain", counts) is None or {})
    monkeypatch.setattr(bench, "difference", lambda slow, fast, fair: used.setdefault("z", (fast.median, fair)) and {})
    rng = np.random.default_rng(0)

    def rendered(scene: mi.Scene, size: object, levels: object, light: bench.Light) -> tuple[dict, dict]:
        depths.append(mi.traverse(scene)["box.interior_medium.scale"])
        made = fake(rng.uniform(1, 2, (4, side, side)), len(depths))
        names = ("mivol", *light.peers)
        return ({(name, 1): made for name in names}, {(name, 1): 1 for name in names})

    monkeypatch.setattr(bench, "render_in_turns", rendered)
    light = bench.Light(milk_in_a_glass, 1, side=side, albedo=(0.5, 0.6, 0.7), peers=("volpathmis",), has_tails=True)
    found = bench.contend(np.array([3.0, 6.0, 9.0]), light, replace(TINY, most_pixels=side))
    assert "mivol over volpathmis" in found and "mivol over volpath" not in found
    # seen from 4 away, 45 degrees wide: the box covers the middle of the picture and not all of its corners
    assert used["gain"][2:4, 2:4].all() and not used["gain"][0, -1]
    second, fair = used["z"]
    assert second == 2 and fair[2:4, 2:4].all()
    # the mean over channels of 6 per unit of length; the longest of the rays that were drawn goes through a little more than 2
    assert depths[0] == 9 and depths[1] == pytest.approx(9 / (6 * 2.0), rel=0.3)


def test_a_difference_without_noise_is_beyond_every_bound() -> None:
    found = compare_means(Estimate(1.0, 0.0, 5.0), Estimate(2.0, 0.0, 5.0), 1)
    assert found["z"] is None
    assert found["percent"] == pytest.approx(-50)


def test_renders_in_turns_have_seeds_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """12 samples: 12, 3 and 1 (not 0) by level; seeds tell the size, the place of the integrator, the level and the round."""
    asked, raced = [], []
    monkeypatch.setattr(bench, "make_integrator", lambda name, depth: (name, depth))
    monkeypatch.setattr(bench.mi, "render", lambda scene, integrator, spp, seed: asked.append((scene, integrator, spp, seed)))
    monkeypatch.setattr(bench, "race", lambda calls, rounds, keep: raced.append((rounds, keep)) or calls)
    light = bench.LIGHTS["constant light"]
    size = replace(TINY, budget=Budget(spp=12), seed=2)
    calls, spp = bench.render_in_turns("scene", size, (1, 4, 16), light._replace(depth=6))
    names = ("mivol", "volpath", "prbvolpath")
    assert raced == [(6, True)]
    assert spp == {(name, level): n for name in names for level, n in ((1, 12), (4, 3), (16, 1))}
    for place, name in enumerate(names):
        for level in (1, 4, 16):
            calls[name, level](7)
            assert asked.pop() == ("scene", (name, 6), spp[name, level], 20_000 + 1000 * place + 100 * level + 7)
    alone = light._replace(peers=("volpathmis",))
    bench.render_in_turns("scene", replace(TINY, budget=Budget(spp=12)), (1,), alone)[0]["volpathmis", 1](0)
    assert asked == [("scene", ("volpathmis", 2), 12, 1100)]


def test_a_contest_in_a_sky(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As wide as asked for, or as the light's picture; pixels that see an optical depth above 0.01; no picture is thinned."""
    light = bench.LIGHTS["constant light"]._replace(side=6, depth=5)
    tau = np.where(np.arange(36).reshape(6, 6) < 5, 0.01, 0.02)
    heard, timings = [], {(name, k): f"{name} {k}" for name in (bench.OURS, *bench.STOCK) for k in (1, 4)}
    monkeypatch.setattr(bench, "box_scene", lambda values, side, albedo, **parts: (values.max(), side, albedo, set(parts)))
    monkeypatch.setattr(bench.mi, "load_dict", lambda parts: parts)
    monkeypatch.setattr(bench, "optical_depths", lambda scene: tau)
    monkeypatch.setattr(
        bench, "render_in_turns", lambda *asked: heard.append(asked) or (timings, {key: 10 * key[1] for key in timings})
    )
    errors = lambda timing, counts, spp: {"errors of": timing, "pixels": int(counts.sum()), "n": spp}  # noqa: E731
    monkeypatch.setattr(bench, "errors", errors)
    monkeypatch.setattr(bench, "gain", lambda slow, fast, counts: {"gain": (slow, fast, int(counts.sum()))})
    monkeypatch.setattr(bench, "difference", lambda slow, fast, fair: {"z": (slow, fast, int(fair.sum()))})
    found = bench.contend(fog(), light, TINY, (1, 4))
    assert heard == [((fog().max(), 6, 0.75, set(light.parts())), TINY, (1, 4), light)]
    assert found == {
        "pixels_that_count": 31,
        **{
            name: [{"spp": 10 * k, "errors of": f"{name} {k}", "pixels": 31, "n": 10 * k} for k in (1, 4)]
            for name in (bench.OURS, *bench.STOCK)
        },
        **{
            f"mivol over {name}": {"gain": (f"{name} 1", "mivol 1", 31), "z": (f"{name} 1", "mivol 1", 31)}
            for name in bench.STOCK
        },
    }


def test_errors_of_images() -> None:
    """Pixels of 2, 4 and 0 that swing by 1, 2 and 0, and one of 100 that does not count: variances 4/3, 16/3 and 0."""
    swing = np.array([-1.0, 1, -1, 1])
    images = np.stack([2 + swing, 4 + 2 * swing, 0 * swing, 100 + 9 * swing], axis=1)[:, None]
    found = bench.errors(fake(images, 2.0), np.array([[True, True, True, False]]), 5)
    assert found["mean"] == pytest.approx(2)
    assert found["variance_mean_over_pixels"] == pytest.approx(20 / 9)
    assert found["variance_median_over_pixels"] == pytest.approx(4 / 3)
    assert found["relative_error_mean_over_pixels"] == pytest.approx(math.sqrt(20 / 9) / 2)
    assert found["relative_error_median_over_pixels"] == pytest.approx(math.sqrt(4 / 3) / 2)
    assert found["samples_per_second_median"] == 10


def test_pixels_without_light_in_the_other_count_as_nothing() -> None:
    """Of three pixels one never saw light in the other's images, one in neither: ratios of 0 and 4, whose median is 2."""
    swing = np.array([-1.0, 1, -1, 1])
    slow = np.stack([0 * swing, 2 * swing, 0 * swing], axis=1)[:, None]
    fast = np.stack([swing, swing, 0 * swing], axis=1)[:, None]
    got = bench.gain(fake(slow), fake(fast), np.ones((1, 3), bool))
    assert got["variance_x_time_median_over_pixels"] == 2
    fast[:, 0, 0] = 0
    slow[:, 0, 0] = swing
    assert bench.gain(fake(slow), fake(fast), np.ones((1, 3), bool))["variance_x_time_median_over_pixels"] == math.inf


def test_questions_about_volumes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Curves of the smoke only, all lights of each; a line a light."""
    said = []
    found = type("Found", (), {"values": "values", "__str__": lambda self: "grid"})()
    monkeypatch.setattr(bench, "VOLUMES", {name: lambda size: found for name in ("smoke", "CT")})
    monkeypatch.setattr(bench, "contend", lambda values, light, size, levels: (values, light, size, levels))
    monkeypatch.setattr(bench, "said", lambda answer: f"{answer[3]}")
    monkeypatch.setattr(bench, "say", said.append)
    for volume, levels in (("smoke", TINY.levels), ("CT", (1,))):
        answer = bench.ask(volume)(TINY)
        assert answer == {"grid": "grid"} | {name: ("values", light, TINY, levels) for name, light in bench.LIGHTS.items()}
        assert said[-4:] == [f"  {name}: {levels}" for name in bench.LIGHTS]


def test_what_is_said_of_a_contest() -> None:
    seen = {"mivol": 2.5e6, "volpath": 1e7, "prbvolpath": 1e5}
    rates = {name: [{"samples_per_second_median": rate}] for name, rate in seen.items()}
    gains = {
        f"mivol over {name}": {
            "variance_x_time_mean_over_pixels": 60.4, "variance_x_time_median_over_pixels": 12.6, "processor_time": 3.0,
            "time": 2.0, "z": z, "relative_standard_error": 0.00123,
        }
        for name, z in (("volpath", 1.234), ("prbvolpath", -0.5))
    }  # fmt: skip
    assert bench.said(rates | gains) == (
        "volpath 60x mean, 13x median, by the clock 0.67 of that (z +1.23, 1.2e-03); prbvolpath 60x mean, 13x median, "
        "by the clock 0.67 of that (z -0.50, 1.2e-03); M samples/s: mivol 2.5, volpath 10, prbvolpath 0.1"
    )


def test_optical_depths_are_the_fourth_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(bench.mi, "load_dict", lambda parts: parts)
    picture = np.arange(20.0).reshape(2, 2, 5)
    monkeypatch.setattr(bench.mi, "render", lambda *given, **named: asked.append((given, named)) or picture)
    assert bench.optical_depths("scene").tolist() == [[3, 8], [13, 18]]
    assert asked == [(("scene",), {"integrator": {"type": "mivol", "max_depth": 1, "aovs": "tau"}, "spp": 64, "seed": 1})]
