"""An image beside its reference or the truth: errors, scores, degrees of freedom, refusals, and the report in words."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.files import encode_srgb
from mivol.validate.metrics import METRICS, average_scores, nrmse, psnr, quantise, score_image, ssim
from mivol.validate.reference_file import Comparison, ReferenceResult, compare, relative_error
from mivol.validate.statistics import Estimate, Significance, estimate_bias, smallest_detectable_bias, z_bound

SHAPE = (4, 6, 3)
MEAN, ERROR = 0.5, 1e-3


def reference(batches: int = 32, mean: float = MEAN) -> ReferenceResult:
    """An image of one value, whose pixels all have the same standard error."""
    return ReferenceResult(
        np.full(SHAPE, mean), np.full(SHAPE, ERROR**2), batches, batches * 64, {"scene": "a" * 64}, Path("reference.exr")
    )


def even(value: float, var: float = 0.0) -> Estimate:
    """An image of one value."""
    return Estimate(np.full(SHAPE, value), var)


def beside(change: np.ndarray | float, var: float = 0.0, **more: object) -> Comparison:
    """An image that differs by multiples of the standard error; exact, unless a variance is given."""
    return compare(Estimate(MEAN + ERROR * np.broadcast_to(change, SHAPE), var), reference(), **more)


def test_pixels_are_judged_by_students_t_of_the_batches():
    found = beside(0.0)
    assert found.agrees and found.bound == z_bound(Significance(0.5e-3, 72), 31)
    assert compare(even(MEAN), reference(3)).bound == z_bound(Significance(0.5e-3, 72), 2) > 3 * found.bound


def test_equal_images_without_noise_agree():
    """The interval of their bias is the number 0."""
    assert compare(even(MEAN), replace(reference(), variance=np.zeros(SHAPE))).agrees


def test_the_mean_is_judged_by_students_t_of_all_pixels():
    """72 pixels of one error have 72 times the degrees of freedom, of which channels share their paths three by three."""
    for batches, correlated in ((3, 3), (32, 3), (3, 1)):
        ours = reference(batches)
        found = compare(even(MEAN), ours, correlated=correlated).bias
        freedom = 72 * (batches - 1) / correlated
        error = ERROR * np.sqrt(correlated / 72)
        assert found.standard_error == pytest.approx(error)
        assert found.high == pytest.approx(float(z_bound(Significance(0.5e-3), freedom)) * error)
        assert found.low == -found.high


def test_the_image_has_errors_of_its_own():
    """As large as the reference's: z is 1 / sqrt(2) of what it is of an exact image."""
    exact, noisy = beside(2.5), beside(2.5, ERROR**2)
    np.testing.assert_allclose(exact.z, 2.5)
    np.testing.assert_allclose(noisy.z, 2.5 / np.sqrt(2))
    assert not exact.agrees and exact.beyond == 0 and exact.bias.low > 0
    own = estimate_bias(even(0.5, ERROR**2), even(0.5, ERROR**2))
    assert noisy.bias.standard_error == pytest.approx(np.sqrt(3) * own.standard_error)


def test_one_pixel_is_found_and_named():
    change = np.zeros(SHAPE)
    change[2, 5, 1], change[0, 0, 0] = -20, 3.5
    found = beside(change)
    assert not found.agrees and found.worst == (2, 5, 1) and found.beyond == 1 / 72
    assert found.above_three == 2 / 72
    assert "differs from the reference" in found.text and "row 2, column 5, channel 1" in found.text
    assert "1.4 % of its values lie beyond" in found.text and "2.8 % beyond 3" in found.text and "-20.0" in found.text
    assert "agrees with the reference" in beside(0.0).text


def test_what_chance_may_explain_depends_on_alpha():
    change = np.zeros(SHAPE)
    change[1, 1, 1] = 4.8
    assert not beside(change, alpha=0.1).agrees and beside(change, alpha=1e-6).agrees


def test_the_smallest_bias_that_would_be_found():
    """Of one of 72 values by the same bound, 9 times in 10."""
    expected = smallest_detectable_bias(ERROR**2, level=Significance(0.5e-3, 72), dof=31)
    assert beside(0.0).detectable == pytest.approx(float(expected))
    assert f"{float(expected):.2g} would be found 9 times in 10" in beside(0.0).text


def test_distances():
    """2 standard errors everywhere: 20 log10(0.5 / 2e-3) dB and 2e-3 / 0.5; a black reference has neither."""
    found = beside(2.0)
    assert found.psnr == pytest.approx(20 * np.log10(250)) and found.nrmse == pytest.approx(1 / 250)
    black = compare(even(0.1), reference(mean=0.0))
    assert black.psnr == -np.inf and black.nrmse == np.inf


def test_an_unseen_sample_is_an_error_that_is_not_in_the_variance():
    """One sample of 1 among 32 x 64 may have been missed: its share is a standard error."""
    unseen = reference()
    unseen.variance[:] = 0
    image = even(MEAN + 1 / 2048)
    assert not compare(image, unseen, samples_seen=0.01).agrees
    np.testing.assert_allclose(compare(image, unseen, samples_seen=1.0).z, 1.0)


def test_refusals():
    with pytest.raises(MivolError, match=r"shape \(3, 6, 3\) cannot be compared with a reference of \(4, 6, 3\)"):
        compare(Estimate(np.zeros((3, 6, 3))), reference())
    image = even(MEAN)
    image.mean[0, 0, 0] = np.nan
    assert_refused(r"first mean is nan at \(0, 0, 0\)", compare, image, reference())


RNG = np.random.default_rng(0)
TRUTH = RNG.integers(0, 256, (24, 20, 3)) / 255


def test_quantised_is_what_a_png_holds() -> None:
    image = np.array([[[-0.5, 0.5 / 255 - 1e-9, 0.5 / 255 + 1e-9], [1.7, 0.2, 254.6 / 255]]])
    np.testing.assert_array_equal(quantise(image) * 255, [[[0, 0, 1], [255, 51, 255]]])
    light = RNG.random((4, 4, 3))
    np.testing.assert_array_equal(quantise(light, "linear"), np.round(encode_srgb(light) * 255) / 255)


def test_psnr_by_hand() -> None:
    """Every second value off by 3 of 255: mean square error 9/2 / 255^2."""
    image = TRUTH.copy()
    image.reshape(-1)[::2] += np.where(image.reshape(-1)[::2] < 0.5, 3, -3) / 255
    assert score_image(image, TRUTH).values["psnr"] == pytest.approx(10 * np.log10(2 * 255**2 / 9), abs=1e-9)


def test_the_number_of_a_set_is_the_mean_of_psnr() -> None:
    """Errors of 1/255 and 100/255: the mean of two PSNR, far from that of the mean error; less than half a code is nothing."""
    grey = np.full((12, 12, 3), 100 / 255)
    found = average_scores([score_image(grey + e / 255, grey, name=f"{e}") for e in (1.4, 100)])
    each = [20 * np.log10(255), 20 * np.log10(2.55)]
    assert [image.values["psnr"] for image in found.images] == pytest.approx(each)
    assert found.values["psnr"] == pytest.approx(np.mean(each))
    assert found.text == f"2 images: PSNR [dB] {np.mean(each):.2f} (worst PSNR: 100)"


def test_masked_pixels_do_not_count() -> None:
    image, mask = TRUTH.copy(), np.ones((24, 20), bool)
    image[:, :10] = 0.5
    mask[:, :10] = False
    image[3, 15] += np.where(image[3, 15] < 0.5, 51, -51) / 255
    # One pixel of 24 * 10 is off by 0.2.
    assert score_image(image, TRUTH, mask=mask).values["psnr"] == pytest.approx(10 * np.log10(240 / 0.04))


def test_ssim_against_its_formula() -> None:
    """Wang et al., equation 13, with 11 x 11 Gaussian weights, at one place and over all."""
    image = np.clip(TRUTH + RNG.normal(0, 0.1, TRUTH.shape), 0, 1)
    a, b = quantise(image), quantise(TRUTH)
    line = np.exp(-(np.arange(-5, 6) ** 2) / 2 / 1.5**2)
    weight = np.outer(line, line) / line.sum() ** 2
    windows = [np.lib.stride_tricks.sliding_window_view(x, (11, 11), axis=(0, 1)) for x in (a, b)]
    ma, mb = (np.einsum("ijcyx,yx->ijc", w, weight) for w in windows)
    va, vb = (np.einsum("ijcyx,yx->ijc", w**2, weight) - m**2 for w, m in zip(windows, (ma, mb), strict=True))
    cov = np.einsum("ijcyx,ijcyx,yx->ijc", *windows, weight) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    wanted = ((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))).mean()
    # scipy cuts the same Gaussian at 5 pixels: both in float64.
    assert score_image(image, TRUTH, metrics=["ssim"]).values["ssim"] == pytest.approx(wanted, abs=1e-12)


def test_flip_knows_equal_and_opposite() -> None:
    pytest.importorskip("flip_evaluator")
    black, white = np.zeros((16, 16, 3)), np.ones((16, 16, 3))
    assert score_image(TRUTH, TRUTH, metrics=["flip"]).values["flip"] == 0
    # Andersson et al., section 4: the largest difference, black and white, is told as 1 to 3 %.
    assert 0.9 < score_image(black, white, metrics=["flip"]).values["flip"] <= 1
    near, far = (score_image(np.clip(TRUTH + e, 0, 1), TRUTH, metrics=["flip"]).values["flip"] for e in (0.02, 0.3))
    assert 0 < near < far


def test_scores_of_unlike_images_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    nan = TRUTH.copy()
    nan[2, 3] = np.nan
    cases = {
        "has shape": lambda: score_image(TRUTH[:5], TRUTH),
        "NaN at row 2, column 3": lambda: score_image(nan, TRUTH),
        'no metric "lpips"': lambda: score_image(TRUTH, TRUTH, metrics=["lpips"]),
        "expected \\(height, width, 3\\)": lambda: quantise(TRUTH[..., 0]),
        '"srgb" or "linear"': lambda: quantise(TRUTH, "hsv"),
        "leaves no pixel": lambda: score_image(TRUTH, TRUTH, mask=np.zeros((24, 20), bool)),
        "found no image to score": lambda: average_scores([]),
    }
    for message, call in cases.items():
        assert_refused(message, call)
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert_refused(r"pip install .mivol.metrics", score_image, TRUTH, TRUTH, metrics=list(METRICS))


def test_errors_and_similarity_by_hand():
    """By hand: truth 0..3, error 0.5 everywhere."""
    truth = np.arange(4.0).repeat(16).reshape(8, 8, 1)
    x = truth + 0.5 * (-1) ** np.arange(64).reshape(8, 8, 1)
    assert nrmse(x, truth) == pytest.approx(0.5 * 8 / np.sqrt(16 * (1 + 4 + 9)))
    assert psnr(x, truth) == pytest.approx(20 * np.log10(3 / 0.5))
    assert psnr(x, truth, peak=1) == pytest.approx(20 * np.log10(1 / 0.5))
    assert psnr(truth, truth) == np.inf
    large, other = np.tile(truth, (2, 2, 1)), np.tile(x, (2, 2, 1))
    assert ssim(large, large) == pytest.approx(1)
    assert ssim(other, large) < 0.9


def test_metrics_without_a_scale_are_refused():
    """One sentence each."""
    one = np.ones((3, 3))
    cases = [
        (lambda: psnr(one, 0 * one), "a peak of 0"),
        (lambda: nrmse(one, 0 * one), "0 everywhere"),
        (lambda: ssim(one, one), "11 pixel window"),
    ]
    for call, words in cases:
        assert_refused(words, call)


HOW = {"integrator": "volpath", "max_depth": 2, "channels_alone": False}
FOUND = ReferenceResult(np.full((3, 5, 3), -0.5), np.full((3, 5, 3), 4e-6), 32, 2048, HOW, Path("there/a.exr"), seconds=90.4)


def test_errors_are_those_of_all_pixels():
    """Root mean squares: 2e-3 everywhere, 0.4 % of the mean size of the radiance."""
    assert FOUND.standard_error == pytest.approx(2e-3) and FOUND.relative_error == pytest.approx(4e-3)
    assert relative_error(1.0, np.zeros(3)) == np.inf and relative_error(0.0, np.zeros(3)) == 0


def test_a_paragraph_tells_how_it_was_made():
    expected = (
        "a.exr: 5x3 by volpath (max_depth 2, all channels at once), 2048 samples a pixel in 32 batches, standard error 0.002 "
        "(0.4 % of the mean), 90 s."
    )
    assert FOUND.text == expected
    alone = replace(FOUND, identity={**HOW, "channels_alone": True}, reached=False, doubts=(SimpleNamespace(sentence="Why."),))
    assert alone.text == (
        expected.replace("all channels at once", "each channel alone").replace("of the mean", "of the mean, above the target")
        + " Doubt: Why."
    )


def test_what_a_pixel_has_not_seen_is_known_from_those_around_it():
    """Variances of 0, 9 and 0 in three columns: 3 around the edges (whose neighbour outside repeats them), 9 where it is seen;
    channels apart. Where there is nothing around, one sample of 64 among 2048."""
    columns = np.zeros((3, 3, 2))
    columns[:, 1, 0] = 9.0
    found = replace(FOUND, mean=columns, variance=columns)
    np.testing.assert_allclose(found.variance_with_unseen(64.0)[..., 0], [[3.0, 9.0, 3.0]] * 3, rtol=1e-12)
    np.testing.assert_allclose(found.variance_with_unseen(64.0)[..., 1], 1 / 1024)
