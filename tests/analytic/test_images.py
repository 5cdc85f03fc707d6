"""The protocol by which views are judged, against its definition."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.files import encode_srgb
from mivol.validate.images import METRICS, average_scores, quantise, score_image

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


def test_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    nan = TRUTH.copy()
    nan[2, 3] = np.nan
    cases = {
        "has shape": lambda: score_image(TRUTH[:5], TRUTH),
        "NaN at row 2, column 3": lambda: score_image(nan, TRUTH),
        'no metric "lpips"': lambda: score_image(TRUTH, TRUTH, metrics=["lpips"]),
        "give \\(height, width, 3\\)": lambda: quantise(TRUTH[..., 0]),
        '"srgb" or "linear"': lambda: quantise(TRUTH, "hsv"),
        "leaves no pixel": lambda: score_image(TRUTH, TRUTH, mask=np.zeros((24, 20), bool)),
        "no image to judge": lambda: average_scores([]),
    }
    for message, call in cases.items():
        with pytest.raises(MivolError, match=message):
            call()
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(MivolError, match=r"pip install .mivol.metrics"):
        score_image(TRUTH, TRUTH, metrics=list(METRICS))
