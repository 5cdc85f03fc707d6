"""PSNR, relative error and structural similarity by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.validate.metrics import nrmse, psnr, ssim


def test_distances():
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


def test_refusals():
    """One sentence each."""
    one = np.ones((3, 3))
    cases = [
        (lambda: psnr(one, 0 * one), "a peak of 0"),
        (lambda: nrmse(one, 0 * one), "0 everywhere"),
        (lambda: ssim(one, one), "11 pixel window"),
    ]
    for call, words in cases:
        with pytest.raises(MivolError, match=words):
            call()
