"""Contests of images: integrators have one mean, the comparison of means can fail, and ratios weigh variance and time.

Renders have fixed samples and seeds. Nothing is concluded from times, nor from the mean with an emitter in the medium, where
single samples have no bound.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import ALPHA, fresh, note

from mivol.bench.harness import contests
from mivol.bench.harness.contests import Contest, Timing
from mivol.bench.scenes import box_scene, make_integrator, milk_in_a_glass
from mivol.bench.studies import media_light, multiple_scattering
from mivol.bench.studies import single_scattering as study
from mivol.bench.studies.media_light import BARS, find_dark_pixels, make_scene
from mivol.bench.studies.multiple_scattering import CONTESTS
from mivol.bench.studies.single_scattering import LIGHTS, PEERS, STUDY, ContestSize, Light, contend, emitter_distances

TINY = replace(ContestSize.quick(), rounds=6, max_pixels=8, spp=64)


def make_fog() -> np.ndarray:
    """An extinction of 0.5 to 1.5, empty at its boundary."""
    return np.pad(np.random.default_rng(1).uniform(0.5, 1.5, (3, 4, 5)), 1).astype(np.float32)


def make_contest(images: dict[str, np.ndarray], processor: dict[str, float] | None = None) -> Contest:
    """A contest with these grey images (rounds, H, W), and with these processor times; the wall clock shows 5 s and 1 s."""
    seconds = processor or dict.fromkeys(images, 1.0)
    timings = {}
    for k, (name, rounds) in enumerate(images.items()):
        rgb = np.repeat(np.asarray(rounds)[..., None], 3, axis=-1)
        timings[name, 1] = Timing({}, [(5.0, 1.0)[k]] * len(rgb), [seconds[name]] * len(rgb), list(rgb))
    return Contest(timings, dict.fromkeys(timings, 1))


def swings(rounds: int, pixels: int) -> np.ndarray:
    """(rounds, pixels, 1): every pixel swings by 1 about 0, neighbours in opposite directions."""
    return np.where(np.add.outer(np.arange(rounds), np.arange(pixels)) % 2, 1.0, -1.0)[..., None]


@pytest.mark.slow
@pytest.mark.statistical
def test_integrators_agree_in_a_sky(variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Radiance is at most 1 and samples are many: t has hundreds of degrees of freedom. A bound on z says nothing if the
    standard error is as large as the mean."""
    comparisons = len(study.VOLUMES) * len(LIGHTS) * len(PEERS)
    monkeypatch.setattr(contests, "FALSE_ALARM", comparisons * ALPHA)
    note(len(PEERS) * ALPHA, "images")
    figures = contend(make_fog(), LIGHTS["constant light"], replace(TINY, seed=fresh(0) % 40_000), (1, 4))
    assert figures["pixels_that_count"] > 0
    assert [[row["spp"] for row in figures[name]] for name in ("mivol", *PEERS)] == [[64, 16]] * 3
    answer = {"smoke": dict.fromkeys(LIGHTS, figures)}
    bars = STUDY.bars("smoke", answer["smoke"])
    agreeing = [bar for bar in bars if bar["figure"].startswith("|z|: ")]
    assert (len(bars), len(agreeing)) == (2 * len(LIGHTS) * len(PEERS), len(LIGHTS) * len(PEERS))
    assert all(bar["met"] for bar in agreeing), agreeing
    for peer in PEERS:
        assert figures[f"mivol over {peer}"]["relative_standard_error"] < 0.05
        assert figures[f"mivol over {peer}"]["variance_x_time_mean_over_pixels"] > 0
    STUDY.draw(answer, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", LIGHTS)
def test_every_light_lights_the_medium(variant_rgb: str, name: str) -> None:
    scene = mi.load_dict(box_scene(make_fog(), 8, study.ALBEDO, **LIGHTS[name].parts()))
    image = np.array(mi.render(scene, integrator=make_integrator("mivol", 2), spp=4, seed=0))
    assert image[study.pixel_depths(make_fog(), LIGHTS[name], 8) > study.MIN_TAU].mean() > 0.01


def test_volumes_have_the_resolution_of_their_size(variant_rgb: str) -> None:
    size = replace(TINY, fine_res=12, sparse_res=16)
    for name, res in (("fine smoke", 12), ("CT", 12), ("threads", 16)):
        assert study.VOLUMES[name](size).values.shape == (res,) * 3


def test_a_bias_of_six_standard_errors_is_seen() -> None:
    """2000 pixels that swing by 1 over 8 rounds: each mean has the variance 1 / (7 x 2000), and t has 28,000 degrees of
    freedom, so the bound is that of the normal distribution, 4.2."""
    a, counts = 10 + swings(8, 2000), np.ones((2000, 1), bool)
    error = math.sqrt(2 / 14000)
    figures = contests.agreement_figures(make_contest({"slow": a, "fast": a[::-1] + 6 * error}), "slow", "fast", counts, 40)
    assert figures["z"] == pytest.approx(6)
    assert figures["z_bound"] == pytest.approx(4.2, abs=0.05)
    assert figures["relative_standard_error"] == pytest.approx(error / 10, rel=0.01)


def test_equal_error_weighs_variance_and_time() -> None:
    """Twice the deviation and three times the processor time: 12. Pixels without noise do not count. If a quarter of the others
    has ten times the deviation, the mean shows it and the median does not."""
    swing, counts = swings(8, 400), np.ones((400, 1), bool)
    swing[:, 200:] = 0
    times = {"slow": 3.0, "fast": 1.0}
    gain = contests.gain_figures(make_contest({"slow": 2 * swing, "fast": swing}, times), "slow", "fast", counts)
    assert gain["variance_x_time_mean_over_pixels"] == pytest.approx(12)
    assert gain["variance_x_time_median_over_pixels"] == pytest.approx(12)
    assert (gain["time"], gain["processor_time"]) == (5, 3)
    uneven = 2 * swing
    uneven[:, 150:] *= 10
    gain = contests.gain_figures(make_contest({"slow": uneven, "fast": swing}, times), "slow", "fast", counts)
    assert gain["variance_x_time_mean_over_pixels"] == pytest.approx(12 * (0.75 + 0.25 * 100))
    assert gain["variance_x_time_median_over_pixels"] == pytest.approx(12)


def test_pixels_without_light_in_the_other_images_count_as_0() -> None:
    """One of three pixels is never lit in the other's images, one in neither: ratios of 0 and 4, with a median of 2."""
    swing, counts = np.array([-1.0, 1, -1, 1]), np.ones((1, 3), bool)
    slow = np.stack([0 * swing, 2 * swing, 0 * swing], axis=1)[:, None]
    fast = np.stack([swing, swing, 0 * swing], axis=1)[:, None]
    gain = contests.gain_figures(make_contest({"slow": slow, "fast": fast}), "slow", "fast", counts)
    assert gain["variance_x_time_median_over_pixels"] == 2


def test_errors_of_images() -> None:
    """Pixels of 2, 4 and 0 that swing by 1, 2 and 0, and one of 100 that does not count: variances 4/3, 16/3 and 0."""
    swing = np.array([-1.0, 1, -1, 1])
    images = np.stack([2 + swing, 4 + 2 * swing, 0 * swing, 100 + 9 * swing], axis=1)[:, None]
    contest = make_contest({"mivol": images})
    contest.spp["mivol", 1] = 3
    errors = contests.image_errors(contest, "mivol", 1, np.array([[True, True, True, False]]))
    assert errors["mean"] == pytest.approx(2)
    assert errors["variance_mean_over_pixels"] == pytest.approx(20 / 9)
    assert errors["variance_median_over_pixels"] == pytest.approx(4 / 3)
    assert errors["relative_error_mean_over_pixels"] == pytest.approx(math.sqrt(20 / 9) / 2)
    assert errors["relative_error_median_over_pixels"] == pytest.approx(math.sqrt(4 / 3) / 2)
    assert errors["samples_per_second_median"] == 4 * 3 / 5


def test_pixels_at_the_emitter_do_not_count(variant_rgb: str) -> None:
    """The brightest pixel of a thin fog is at the emitter; only this pixel and its neighbours are left out."""
    light = LIGHTS["point light inside"]
    scene = mi.load_dict(box_scene(np.full((4, 4, 4), 0.1, np.float32), 24, 0.75, **light.parts()))
    image = np.array(mi.render(scene, integrator=make_integrator("mivol", 2), spp=64)).mean(axis=-1)
    left_out = emitter_distances(scene, light, 24) <= study.EMITTER_PIXELS
    assert left_out[np.unravel_index(image.argmax(), image.shape)]
    # A disc with a radius of 1.5 pixels holds the centres of 4 to 9 pixels.
    assert 4 <= left_out.sum() <= 9
    assert np.isinf(emitter_distances(scene, light._replace(inside=None), 24)).all()


@pytest.mark.parametrize(
    "light", [LIGHTS["point light inside"], Light(milk_in_a_glass, 1, peers=("volpathmis",), has_tails=True)]
)
def test_means_are_compared_in_thin_matter(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, light: Light) -> None:
    """Ratios are of the volume itself; means are compared in the volume thinned to an optical depth of 1 at most, in pixels
    farther than a quarter of the image from an emitter inside. A light with heavy tails has longer renders."""
    rng, side, loaded, used = np.random.default_rng(0), 16, [], {}

    def contest_images(scene: mi.Scene, integrators: dict, size: ContestSize, levels: tuple = (1,)) -> Contest:
        params = mi.traverse(scene)
        grid = "box.interior_medium.sigma_t.data"
        depth = float(np.max(params[grid])) if grid in params else params["box.interior_medium.scale"]
        loaded.append((depth, size.budget))
        names = list(integrators)
        images = {name: rng.uniform(1, 2, (4, side, side)) for name in names}
        timings = {(name, 1): t for name, t in zip(names, make_images(images), strict=True)}
        return Contest(timings, dict.fromkeys(timings, 1))

    def make_images(images: dict[str, np.ndarray]) -> list[Timing]:
        rgb = [np.repeat(rounds[..., None], 3, axis=-1) for rounds in images.values()]
        return [Timing({}, [1.0] * 4, [1.0] * 4, list(one)) for one in rgb]

    monkeypatch.setattr(study, "contest_images", contest_images)
    monkeypatch.setattr(study, "gain_figures", lambda contest, slow, fast, counts: used.setdefault("gain", counts) is None or {
        light.ratio_key: 1.0})  # fmt: skip
    monkeypatch.setattr(study, "agreement_figures", lambda contest, slow, fast, fair, _: used.setdefault(
        "fair", fair) is None or {"z": 0.0, "relative_standard_error": 0.0})  # fmt: skip
    values = np.array([3.0, 6.0, 9.0]) if light.has_tails else np.full((4, 4, 4), 7.0, np.float32)
    albedo = (0.5, 0.6, 0.7) if light.has_tails else 0.75
    figures = contend(values, light._replace(albedo=albedo), replace(TINY, max_pixels=side, budget=1.0))
    assert all(f"mivol over {peer}" in figures for peer in light.peers)
    (depth, budget), (thin, _) = loaded
    assert budget == (study.LONGER if light.has_tails else 1.0)
    # The longest ray through a box with an edge of 2 is a little longer than 2; an rgb medium has a mean extinction of 6.
    longest = 2 * (6.0 if light.has_tails else 7.0)
    assert thin == pytest.approx(depth / longest, rel=0.3)
    if light.inside is not None:
        distance = emitter_distances(mi.load_dict(box_scene(np.ones((2, 2, 2), np.float32), side)), light, side)
        assert study.EMITTER_PIXELS < distance[used["gain"]].min() < 3
        assert distance[used["fair"]].min() > side / 4
        assert 0 < used["fair"].sum() < used["gain"].sum()
    else:
        assert used["gain"][side // 2, side // 2] and not used["gain"][0, -1]


def test_unlimited_depth_is_judged_by_the_median() -> None:
    """Errors of unlimited paths have heavy tails."""
    lights = [light for lights in CONTESTS.values() for light in lights.values()]
    assert all(light.by_pixel == light.has_tails == (light.depth < 0) for light in lights)
    assert set(CONTESTS) == set(multiple_scattering.VOLUMES) == set(multiple_scattering.STUDY.questions)
    assert multiple_scattering.white_box().values.max() * 2 == multiple_scattering.WHITE_DEPTH == 64
    assert np.allclose(multiple_scattering.thin_smoke().values.max() * 20, multiple_scattering.smoke().values.max())


def test_the_milk_is_the_measured_one() -> None:
    """Skim milk scatters 0.70, 1.22 and 1.90 times per millimetre and absorbs 0.0014, 0.0025 and 0.0142 times; the edge of 2 is
    40 mm long."""
    sigma_s, sigma_a = np.array([0.7, 1.22, 1.9]) * 20, np.array([0.0014, 0.0025, 0.0142]) * 20
    (light,) = CONTESTS["milk"].values()
    np.testing.assert_allclose(multiple_scattering.milk().values, sigma_s + sigma_a)
    np.testing.assert_allclose(multiple_scattering.milk().values * light.albedo, sigma_s)
    assert light.peers == ("volpath", "prbvolpath", "volpathmis")


def test_only_volpath_has_a_bar() -> None:
    """Three ratios of the milk with their agreement, of which one is judged."""
    figures = {"variance_x_time_median_over_pixels": 11.0, "z": -1.0, "z_bound": 4.0}
    answer = {name: {f"mivol over {peer}": figures for peer in light.peers} for name, light in CONTESTS["milk"].items()}
    bars = multiple_scattering.STUDY.bars("milk", answer)
    assert [(bar["value"], bar["bar"]) for bar in bars] == [(11.0, 10), (1.0, 4.0), (1.0, 4.0), (1.0, 4.0)]


@pytest.mark.slow
@pytest.mark.statistical
def test_integrators_agree_at_each_depth(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a small fog in each light of the smoke, at the false-alarm rate of the suite."""
    monkeypatch.setattr(contests, "FALSE_ALARM", ALPHA)
    values = np.pad(np.random.default_rng(1).uniform(0.5, 1.5, (3, 4, 5)), 1).astype(np.float32)
    for name, light in CONTESTS["smoke"].items():
        figures = contend(values, light, replace(TINY, seed=fresh(0) % 40_000))
        bars = multiple_scattering.STUDY.bars("smoke", dict.fromkeys(CONTESTS["smoke"], figures))
        note(ALPHA, name)
        assert all(bar["met"] for bar in bars if bar["figure"].startswith("|z|")), name


def test_pixels_that_count_do_not_see_the_medium(variant_rgb: str) -> None:
    """A fire is in the centre of its image; a room fills its image, and all pixels count."""
    dark = find_dark_pixels(make_scene("fire", 12))
    assert not dark[6, 6] and dark[0].all() and dark[:, 0].all()
    assert find_dark_pixels(make_scene("room", 12)).all()


@pytest.mark.slow
def test_every_medium_is_lit_and_timed(variant_rgb: str) -> None:
    for name in BARS:
        answer = media_light.STUDY.questions[name](replace(TINY, max_pixels=6, rounds=2, spp=2))
        assert answer["pixels_that_count"] > 0 and answer["time"] > 0


@pytest.mark.parametrize("name", BARS)
def test_the_median_is_judged(name: str) -> None:
    answer = {"variance_x_time_median_over_pixels": 5.0, "z": -2.0, "z_bound": 3.5}
    bars = [(bar["value"], bar["bar"], bar["met"]) for bar in media_light.STUDY.bars(name, answer)]
    assert bars == [(5.0, BARS[name], name == "room"), (2.0, 3.5, True)]
