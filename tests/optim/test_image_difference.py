"""Loss of whole images against scikit-image and a float64 oracle, with gradients against differences."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import correlate1d
from skimage.metrics import structural_similarity

from mivol.optim.gaussians.image_difference import C1, C2, WEIGHTS, ImageShape, image_loss, mean_ssim

HEIGHT, WIDTH = 14, 17


def pictures(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture and a photograph of it with noise, float32."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 3, WIDTH), np.linspace(0, 2, HEIGHT))
    smooth = 0.5 + 0.4 * np.stack([np.sin(x + y), np.cos(2 * x), np.sin(x * y)], axis=-1)
    return smooth.astype(np.float32), (smooth + rng.normal(0, 0.05, smooth.shape)).astype(np.float32)


def twin(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """SSIM (H, W, 3) in float64, with zeros beyond the border."""

    def blur(a: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(a, WEIGHTS, axis=0, mode="constant"), WEIGHTS, axis=1, mode="constant")

    x, y = x.astype(np.float64), y.astype(np.float64)
    mx, my = blur(x), blur(y)
    xx, yy, xy = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    return (2 * mx * my + C1) * (2 * xy + C2) / ((mx**2 + my**2 + C1) * (xx + yy + C2))


def ours(x: np.ndarray, y: np.ndarray, weight: float) -> tuple[float, np.ndarray]:
    """Loss and slope of the module."""
    shape = ImageShape.of(x.shape[1], x.shape[0])
    loss, slope = image_loss(mi.Float(x.ravel()), mi.Float(y.ravel()), shape, weight)
    return float(loss[0]), np.array(slope).reshape(x.shape)


def loss_of(x: np.ndarray, y: np.ndarray, weight: float) -> float:
    """The loss in float64."""
    return (1 - weight) * np.abs(x.astype(np.float64) - y).mean() + weight * (1 - twin(x, y).mean())


def test_oracle_matches_scikit_image_inside(variant_rgb: str) -> None:
    """Where the whole window is inside, zeros beyond the border play no part; both are float64."""
    x, y = (a.astype(np.float64) for a in pictures())
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    theirs = structural_similarity(x, y, data_range=1.0, channel_axis=2, full=True, **window)[1]
    np.testing.assert_allclose(twin(x, y)[5:-5, 5:-5], theirs[5:-5, 5:-5], rtol=1e-10)


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_image_loss_matches_the_oracle(variant_rgb: str, weight: float) -> None:
    """Variances are differences of numbers of about 1 in float32 and divided by C2 = 9e-4 at least: 4 x 2^-24 / 9e-4 = 3e-4 a
    pixel at worst, of random sign; the mean over 714 keeps below a tenth of that."""
    x, y = pictures()
    assert ours(x, y, weight)[0] == pytest.approx(loss_of(x, y, weight), abs=3e-5)


@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_image_loss_gradient_matches_differences(variant_rgb: str, weight: float) -> None:
    """Central differences of the float64 twin at pixels in a corner, on an edge and inside, where x is not y.

    With a step of 1e-5 they are exact to 1e-10 of slopes of 1e-3; the float32 slope has an error as above, 3e-4 relative.
    """
    x, y = pictures()
    slope = ours(x, y, weight)[1]
    largest = np.abs(slope).max()
    for at in [(0, 0, 0), (0, 8, 1), (13, 16, 2), (6, 7, 0), (9, 3, 2), (4, 16, 1)]:
        step = np.zeros(x.shape)
        step[at] = 1e-5
        expected = (loss_of(x + step, y, weight) - loss_of(x - step, y, weight)) / 2e-5
        assert slope[at] == pytest.approx(expected, abs=1e-3 * float(largest)), at


def test_equal_images_have_no_gradient(variant_rgb: str) -> None:
    """SSIM is 1 there and stationary; rounding leaves what 4 x 2^-24 / C2 of the window's weight does."""
    x, _ = pictures()
    loss, slope = ours(x, x, 0.2)
    assert abs(loss) < 1e-6
    assert np.abs(slope).max() < 1e-3 / x.size


def test_recorded_loss_works_for_other_images(variant_rgb: str) -> None:
    """Pictures of another size and content through one recording."""
    frozen = dr.freeze(image_loss)
    for height, width in [(14, 17), (17, 14), (30, 9)]:
        rng = np.random.default_rng(height)
        x, y = rng.random((2, height, width, 3)).astype(np.float32)
        arguments = mi.Float(x.ravel()), mi.Float(y.ravel()), ImageShape.of(width, height), 0.2
        for recorded, traced in zip(frozen(*arguments), image_loss(*arguments), strict=True):
            # The same kernels; sums over pixels may be added in another order: 2^-24 x sqrt(n), bounded by 1e-5.
            np.testing.assert_allclose(np.array(recorded), np.array(traced), rtol=1e-5, atol=1e-9)
    assert mean_ssim(arguments[0], arguments[0], arguments[2])[0][0] == pytest.approx(1, abs=1e-5)
