"""What a reference says of itself: its errors, and whether it is as accurate as was asked for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mivol.validate.reference_file import ReferenceResult, relative_error

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
