"""An image beside a reference of given errors: what is judged, with how many degrees of freedom, and what is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.validate.compare import Comparison, compare
from mivol.validate.reference_file import ReferenceResult
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
    with pytest.raises(MivolError, match=r"first mean is nan at \(0, 0, 0\)"):
        compare(image, reference())
