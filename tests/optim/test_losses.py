"""Losses against float64 values and gradients; SSIM against scikit-image, an oracle and differences."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from scipy.ndimage import correlate1d
from skimage.metrics import structural_similarity

from mivol.optim.losses import C1, C2, L2, LOSSES, WEIGHTS, Huber, ImageShape, Log, RelativeL2, image_loss, mean_ssim
from mivol.optim.strategy import choose

EPS = float(np.finfo(np.float32).eps)


def log_twin(x: np.ndarray, floor: float) -> np.ndarray:
    return np.where(x >= floor, np.log(np.maximum(x, floor)), np.log(floor) + (x - floor) / floor)


def log_penalty(i: np.ndarray, r: np.ndarray, floor: float = 1e-3) -> np.ndarray:
    seen = np.maximum(r, 0) ** 2
    return seen / (seen + floor**2) * (log_twin(i, floor) - log_twin(r, floor)) ** 2


def huber_penalty(i: np.ndarray, r: np.ndarray, delta: float = 0.1) -> np.ndarray:
    size = np.abs(i - r)
    return np.where(size <= delta, size**2 / 2, delta * (size - delta / 2))


TWINS = {
    "l1": lambda i, r: np.abs(i - r),
    "l2": lambda i, r: (i - r) ** 2,
    "relative_l2": lambda i, r: (i - r) ** 2 / (r**2 + 1e-4),
    "huber": huber_penalty,
    "log": log_penalty,
}


def images(n: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Pairs from far below 0 to far above the light, float32 values in float64."""
    rng = np.random.default_rng(0)
    image, reference = rng.normal(0.5, 0.7, (2, n, 1, 3)).astype(np.float32).astype(np.float64)
    return image, reference


def value_and_slope(loss, image: np.ndarray, reference: np.ndarray) -> tuple[float, np.ndarray]:
    x = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(x)
    value = loss(x, mi.TensorXf(reference.astype(np.float32)))
    dr.backward(value)
    return float(value[0]), np.asarray(dr.grad(x))


@pytest.mark.parametrize("name", LOSSES)
def test_loss_value_matches_the_oracle(variant_rgb, name: str) -> None:
    """The residual of two float32 images of size s has absolute error 2 eps s; a square doubles it, a log or a division
    by floor (1e-3, 1e-2) multiplies it by 1 / floor at most."""
    image, reference = images()
    expected = TWINS[name](image, reference)
    found, _ = value_and_slope(LOSSES[name](), image, reference)
    assert abs(found - expected.mean()) <= 64 * EPS * np.abs(expected).max()


@pytest.mark.parametrize("name", LOSSES)
def test_loss_gradient_matches_the_oracle(variant_rgb, name: str) -> None:
    """Central differences of the float64 twin: h^2 third derivatives (1e-10 times 1e6 for the log) and 1e-16 / h.
    Pairs closer than 2 h to a kink are left out."""
    image, reference = images()
    h, twin = 1e-6, TWINS[name]
    expected = (twin(image + h, reference) - twin(image - h, reference)) / (2 * h) / image.size
    _, found = value_and_slope(LOSSES[name](), image, reference)
    size = np.abs(image - reference)
    smooth = (size > 1e-4) & (np.abs(size - 0.1) > 1e-4) & (np.abs(image - 1e-3) > 1e-4) & (np.abs(reference) > 1e-2)
    assert smooth.mean() > 0.9
    bound = 1e-5 * np.abs(expected) + 1e-5 * np.abs(expected).max()
    assert np.all(np.abs(found - expected)[smooth] <= bound[smooth])


@pytest.mark.parametrize("name", LOSSES)
def test_zero_where_images_agree(variant_rgb, name: str) -> None:
    image, _ = images()
    value, slope = value_and_slope(LOSSES[name](), image, image)
    assert value == 0.0
    assert np.all(slope == 0.0)


def test_huber_negative_residual(variant_rgb) -> None:
    """A residual of -r costs what +r costs, and its slope is the line's, not the parabola's. Hard case 51."""
    r = np.array([0.05, 0.2, 3.0, 100.0]).reshape(-1, 1, 1)
    up, slope_up = value_and_slope(Huber(delta=0.1), r, 0 * r)
    down, slope_down = value_and_slope(Huber(delta=0.1), -r, 0 * r)
    assert up == down
    assert np.array_equal(slope_up, -slope_down)
    # Beyond delta the slope is delta / n exactly, whatever the residual: one rounding of each.
    assert np.allclose(slope_down[1:] * 4, -0.1, rtol=2 * EPS, atol=0)


def test_underflow_of_transmittance(variant_rgb) -> None:
    """exp(-104) is 0 in float32: the log loss stays finite, leads back up, and a saturated reference counts for nothing.

    Hard case 39.
    """
    dark, lit = np.zeros((1, 1, 3)), np.full((1, 1, 3), 0.5)
    value, slope = value_and_slope(Log(floor=1e-3), dark, lit)
    assert np.isfinite(value)
    assert np.all(slope < 0)
    assert np.all(np.isfinite(slope))
    _, slope = value_and_slope(Log(floor=1e-3), lit, dark)
    assert np.all(slope == 0)
    # At a reference of 1e-30 the weight is 1e-54: 0 in float32.
    value, _ = value_and_slope(Log(floor=1e-3), dark, np.full((1, 1, 3), 1e-30))
    assert value == 0.0


def test_pixel_brighter_than_the_light(variant_rgb) -> None:
    """log(1.3) > 0 is a negative optical depth: finite, kept, and the image is pulled towards it, not to the light.

    Hard case 40.
    """
    light, brighter, negative = (np.full((1, 1, 3), value) for value in (1.0, 1.3, -0.02))
    value, slope = value_and_slope(Log(), light, brighter)
    assert abs(value - np.log(1.3) ** 2) <= 1e-6 + 4 * EPS  # the weight is 1 - 6e-7
    assert np.all(slope < 0)
    value, slope = value_and_slope(Log(), light, negative)
    assert value == 0.0
    assert np.all(slope == 0)


@pytest.mark.parametrize("loss", [L2(), RelativeL2(floor=0.05)], ids=["l2", "relative_l2"])
def test_weight_is_the_second_derivative(variant_rgb, loss) -> None:
    """1/2 W r^2 is the penalty of a quadratic loss, to rounding."""
    image, reference = images()
    x, y = (mi.TensorXf(a.astype(np.float32)) for a in (image, reference))
    quadratic = 0.5 * np.asarray(loss.weight(y)) * np.asarray(x - y) ** 2
    assert np.allclose(quadratic, np.asarray(loss.penalty(x, y)), rtol=4 * EPS, atol=0)


def test_refusals(variant_rgb) -> None:
    assert_refused("shape", L2(), mi.TensorXf(np.zeros((2, 2, 3), "f")), mi.TensorXf(np.zeros((2, 3, 3), "f")))
    assert_refused('found "huber"', Huber().weight, mi.TensorXf(np.zeros((1, 1, 3), "f")))
    assert_refused('did you mean "huber"', choose, LOSSES, "hubert", "loss")
    assert_refused("> 0.0", choose, LOSSES, "huber", "loss", delta=-1.0)


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
