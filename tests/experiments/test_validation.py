"""mivol beside Mitsuba's path tracer: the verdict, its exit code, its files, and that a fault is found."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY
from refusals import assert_refused
from scipy.stats import t as student_t
from tiny_experiment import run

from mivol.experiments import validation
from mivol.experiments.validation import DIFFERS, UNTRUSTED, Validation, validate_scene
from mivol.optim.scenes.views import derive_seed
from mivol.scene.load import load_scene
from mivol.validate import reference
from mivol.validate.statistics import Significance
from mivol.validate.trust import Doubt

FEW = Validation(spp=64, reference_spp=64, parameters=(KEY,))


@pytest.fixture
def scene(folder: Path) -> Path:
    """The absorbing cube."""
    return folder / "scene.xml"


@pytest.mark.slow
def test_mivol_agrees_with_volpath(variant_rgb, scene: Path, capsys: pytest.CaptureFixture) -> None:
    """An absorbing cube, where both are right: the seeds are fixed, and with them there is no false alarm."""
    target = scene.parent / "validation"
    flags = ["--spp", 64, "--reference-spp", 256, "--parameter", KEY]
    assert run("validate", scene, "-o", target, *flags) == 0
    said = capsys.readouterr().out
    assert "mivol agrees with Mitsuba's volpath on this scene." in said
    assert "relMSE" in said
    found = json.loads((target / "validation.json").read_text())
    assert (target / "validation.png").read_bytes()[:4] == b"\x89PNG"
    assert found["code"] == 0
    assert found["bias"]["low"] <= 0 <= found["bias"]["high"]
    times = found["time ratio"]
    # volpath draws whether light is absorbed; mivol's pixels vary with the place in the pixel only.
    assert times["variance"] < times["reference_variance"]
    assert f"volpath takes {times['gain']:.3g} times the time of mivol" in said
    (slope,) = found["gradients"]
    # The image darkens where there is more extinction.
    assert slope["agrees"]
    assert slope["ours"] < 0


def test_the_picture_shows_what_was_judged(variant_rgb, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its z is that of the verdict: where a reference has not seen a path, its noise is not 0."""
    drawn = []
    row = validation.figures.plot_image_row
    monkeypatch.setattr(validation.figures, "plot_image_row", lambda *given: drawn.append(given) or row(*given))
    verdict = validate_scene(load_scene(scene), scene.parent / "a", Validation(spp=16, reference_spp=64))
    ((reference, image, z),) = drawn
    np.testing.assert_array_equal(z, verdict.comparison.z)
    assert reference.shape == image.shape == z.shape
    floor = 0.01 * np.mean(reference**2)
    assert verdict.rel_mse == pytest.approx(np.mean((image - reference) ** 2 / (reference**2 + floor)), rel=1e-6)


@pytest.mark.slow
def test_a_wrong_renderer_is_found(variant_rgb, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ours is given half the extinction for a while, and its gradient half the slope."""
    loaded = load_scene(scene)
    real_image, real_slope = validation.render_batches, validation.MeanRadiance.slope

    def halved(*given: object) -> object:
        params = mi.traverse(loaded.scene)
        params[KEY] = params[KEY] * 0.5
        params.update()
        try:
            return real_image(*given)
        finally:
            params[KEY] = params[KEY] * 2.0
            params.update()

    with monkeypatch.context() as patch:
        patch.setattr(validation, "render_batches", halved)
        verdict = validate_scene(loaded, scene.parent / "a", FEW)
    assert verdict.code == DIFFERS
    assert not verdict.comparison.agrees
    with monkeypatch.context() as patch:
        patch.setattr(validation.MeanRadiance, "slope", lambda *given: 0.5 * real_slope(*given))
        verdict = validate_scene(loaded, scene.parent / "a", FEW)
    assert verdict.code == DIFFERS
    assert verdict.comparison.agrees
    assert not verdict.slopes[0].agrees


def test_a_reference_that_cannot_be_trusted_decides_nothing(variant_rgb, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "find_doubts", lambda scene, sensors: [Doubt("rotated", "the grid is turned.")])
    verdict = validate_scene(load_scene(scene), scene.parent / "a", Validation(spp=16, reference_spp=32))
    assert verdict.code == UNTRUSTED
    assert "is no reference here, so nothing is decided" in verdict.text
    assert "Doubt: the grid is turned." in verdict.text


@pytest.mark.parametrize(("sampler", "most", "expected"), [
    ("independent", 33, 33), ("multijitter", 33, 25), ("stratified", 64, 64), ("orthogonal", 60, 49), ("ldsampler", 60, 16),
    ("orthogonal", 3, 1),
])  # fmt: skip
def test_passes_suit_samplers_that_round_numbers_up(variant_rgb, sampler: str, most: int, expected: int) -> None:
    """A pass has no more samples than the reference may have in all, over the number of batches."""
    sensor = mi.load_dict({"type": "perspective", "sampler": {"type": sampler}})
    assert reference._choose_pass_spp(sensor, 1, most * reference.MIN_BATCHES) == expected


def test_what_cannot_be_validated_is_refused(variant_rgb, scene: Path) -> None:
    assert_refused("too few", Validation, spp=3)
    assert_refused("no parameter", validate_scene, load_scene(scene), scene.parent / "a", Validation(parameters=("cube.none",)))


def slope(ours: float, bound: float = 0.5) -> validation.Slope:
    """One whose central difference is 2."""
    return validation.Slope("a.key", ours, 2.0, 0.126, 0.034, bound)


def test_slopes_agree_within_their_bound() -> None:
    assert [slope(x).agrees for x in (1.5, 2.5, 1.49, 2.51)] == [True, True, False, False]
    assert slope(2.5).text == (
        "The derivative by a.key along a random direction agrees with central differences: +2.5 and +2, 0.13 of noise and "
        "0.034 of the step's own."
    )
    assert "direction differs from central differences: -3 and +2" in slope(-3.0).text


@pytest.mark.parametrize(
    ("fatal", "image", "slopes", "code", "words"),
    [
        ((), True, (), 0, "mivol agrees with"),
        ((False,), True, (2.0,), 0, "mivol agrees with"),
        ((), False, (2.0,), 3, "mivol differs from"),
        ((), True, (2.0, 3.0), 3, "mivol differs from"),
        ((False, True), True, (2.0,), 4, "so nothing is decided"),
        ((True,), False, (3.0,), 4, "so nothing is decided"),
    ],
)
def test_a_verdict_is_that_of_all_its_parts(fatal: tuple, image: bool, slopes: tuple, code: int, words: str) -> None:
    """What cannot be believed decides nothing; one part that differs is enough."""
    doubts = tuple(SimpleNamespace(fatal=each, sentence="It is odd.") for each in fatal)
    compared = SimpleNamespace(agrees=image, text="Images.")
    times = validation.Efficiency(1e-4, 1e-3, 2.0, 5.0)
    found = validation.Verdict(compared, 0.0123456, times, tuple(map(slope, slopes)), doubts, (Path("a.json"), Path("b.png")))
    assert found.code == code and words in found.words
    assert found.text.splitlines() == [
        *["Doubt: It is odd."] * len(fatal), "Images.", "relMSE 0.0123.", *(slope(x).text for x in slopes), found.words,
        times.text, "a.json", "b.png",
    ]  # fmt: skip


def test_times_are_compared_at_equal_error() -> None:
    """A tenth of the variance in two fifths of the time is 25 times ahead; without noise nothing is said."""
    found = validation.Efficiency(1e-4, 1e-3, 2.0, 5.0)
    assert found.gain == pytest.approx(25.0)
    assert "volpath takes 25 times the time of mivol" in found.text and "2 s and 5 s" in found.text
    for empty in range(4):
        given = [1.0, 1.0, 1.0, 1.0]
        given[empty] = 0.0
        assert validation.Efficiency(*given).gain is None
    assert "cannot be compared" in validation.Efficiency(0.0, 1e-3, 2.0, 5.0).text


def test_renders_are_independent(variant_rgb: str) -> None:
    """16 renders with seeds of their own, of a sixteenth of the samples each, rounded up; no derivative is followed."""
    asked = []

    def render(scene: object, camera: object, seed: int, spp: int) -> np.ndarray:
        asked.append((scene, camera, seed, spp))
        return np.full((2, 2, 3), float(len(asked)))

    passes = validation.render_in_turn("scene", "camera", SimpleNamespace(render=render))
    found, seconds = validation.render_batches(passes, Validation(spp=33, seed=5))
    assert seconds >= 0
    assert asked == [("scene", "camera", derive_seed(5, validation.IMAGE, batch), 3) for batch in range(16)]
    assert (found.n, float(found.mean[0, 0, 0])) == (16, 8.5)
    assert float(found.variance[1, 1, 2]) == pytest.approx(np.var(np.arange(1, 17), ddof=1))


def test_a_gradient_is_checked_by_differences(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Derivatives of 6 -+ 1/10, differences of 0.1 -+ 0.01 of the step and 0.22 of twice the step: 5 and 5.5 of the slope; a
    sixth of a half is what the step leaves out. Seeds and directions are their own."""
    values, heard, put_back = np.array([0.0, 1.0, 2.0]), [], []
    swing = iter(0.1 * (-1.0) ** k for k in range(16))
    monkeypatch.setattr(validation, "traverse", lambda scene: {"a.key": values})
    monkeypatch.setattr(validation, "as_tensor", lambda value: value)
    monkeypatch.setattr(validation, "set_parameter", lambda params, key, start: put_back.append((key, start.tolist())))

    def slope(self: validation.MeanRadiance, direction: np.ndarray, *seeds: int) -> float:
        assert (self.scene, self.camera, self.integrator) == ("scene", "camera", "ours")
        heard.append(("slope", direction, self.spp, seeds))
        return 6 + next(swing)

    def difference(self: validation.MeanRadiance, start: np.ndarray, step: np.ndarray, seed: int) -> float:
        heard.append((self.key, start.tolist(), step, self.spp, seed))
        return 0.1 if len(heard) % 3 == 2 else 0.22

    monkeypatch.setattr(validation.MeanRadiance, "slope", slope)
    monkeypatch.setattr(validation.MeanRadiance, "difference", difference)
    chosen = Validation(spp=33, seed=5, parameters=("a.key", "b"))
    level = Significance(1e-3, 2)
    found = validation.check_gradient("scene", "camera", "ours", "a.key", chosen, level)
    direction = np.random.default_rng([5, 5]).uniform(0, 2, 3) * values
    for batch in range(16):
        seeds = [derive_seed(5, validation.GRADIENT, batch, which) for which in range(4)]
        (_, along, spp, pair), near, far = heard[3 * batch : 3 * batch + 3]
        assert np.array_equal(along, direction) and (spp, pair) == (3, tuple(seeds[:2]))
        assert near[:2] == far[:2] == ("a.key", [0.0, 1.0, 2.0]) and near[3:] == (3, seeds[2]) and far[3:] == (3, seeds[3])
        np.testing.assert_allclose(near[2], 0.02 * direction)
        np.testing.assert_allclose(far[2], 0.04 * direction)
    assert put_back == [("a.key", [0.0, 1.0, 2.0])]
    error = 0.1 * np.sqrt(16 / 15) / 4
    assert (found.ours, found.differences, found.error) == pytest.approx((6, 5, error))
    assert found.left_out == pytest.approx(0.5 / 3)
    # Two raise a false alarm with a chance of 1e-3 together: Sidak's share of each, on two sides, at 15 degrees of freedom.
    bound = student_t.isf((1 - (1 - 1e-3) ** 0.5) / 2, 15)
    assert found.bound == pytest.approx(bound * error + 0.5 / 3, rel=1e-6)
    values[:] = 0
    assert_refused("a.key is 0 everywhere", validation.check_gradient, "scene", "camera", "ours", "a.key", chosen, level)


def test_every_parameter_is_checked_at_its_share_of_the_level(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "check_gradient", lambda *asked: asked[3:])
    for names in ((), ("a", "b")):
        chosen = Validation(parameters=names)
        level = Significance(1e-3, max(len(names), 1))
        assert validation.check_gradients("scene", "camera", "ours", chosen) == tuple((name, chosen, level) for name in names)


def test_a_difference_is_half_of_both_sides(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step on, a step back with the same seed, and the values as they were."""
    placed, asked = [], []
    monkeypatch.setattr(validation, "traverse", lambda scene: "params")
    monkeypatch.setattr(validation, "set_parameter", lambda params, key, values: placed.append((params, key, values.tolist())))

    def render(scene: object, camera: object, seed: int, spp: int) -> np.ndarray:
        asked.append((seed, spp))
        return np.array([[[7.0, 9.0]], [[1.0, 1.0]]][len(asked) - 1])

    integrator = SimpleNamespace(render=render)
    mean = validation.MeanRadiance("scene", "camera", integrator, "k", 4)
    found = mean.difference(np.array([1.0, 2.0]), np.array([0.5, 0.25]), 9)
    assert found == 3.5 and asked == [(9, 4), (9, 4)]
    assert placed == [("params", "k", values) for values in ([1.5, 2.25], [0.5, 1.75], [1.0, 2.0])]
