"""Hard clouds for splatting: opaque and clear, tiny and huge, behind the camera, empty, too many."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import oracle_splats
import pytest
from clouds import cloud, looking, tensors
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.photos.camera import Camera, intrinsics
from mivol.splatting import Splatter
from mivol.splatting import splatter as module
from mivol.splatting.compositing import STOP
from mivol.splatting.projection import check_memory, nearest_first

SIDE = 24
ROUNDING = 4e-5
"""As in tests/gradient/test_splatter.py: of a centre's place, times how fast alpha changes with it."""


@pytest.fixture
def splatter(variant_rgb: str) -> Splatter:
    return Splatter(SIDE, SIDE, 2)


@pytest.fixture
def camera() -> Camera:
    return looking(SIDE, SIDE)


def straight(side: int = SIDE) -> Camera:
    """A camera a unit of length from the origin, whose axis goes through the centre of a pixel."""
    pose = np.eye(4)
    pose[2, 3] = 1.0
    return Camera(intrinsics(side, side, side / 2 + 0.5, side / 2 + 0.5), (side, side), pose)


def stack(opacity_logits: list[float], depths: list[float], scale: float = 0.2) -> dict[str, np.ndarray]:
    """Round Gaussians one behind the other on the axis of :func:`straight`, of different greys."""
    n = len(opacity_logits)
    arrays = cloud(n, 2, scale)
    arrays["means"] = np.array([[0, 0, -z] for z in depths], np.float32)
    arrays["log_scales"][:] = np.log(scale)
    arrays["opacity_logits"] = np.array(opacity_logits, np.float32)
    arrays["harmonics"][:] = 0
    arrays["harmonics"][:, 0] = np.linspace(-1, 1, n)[:, None]
    return arrays


def assert_drawn(picture: mi.TensorXf, arrays: dict[str, np.ndarray], camera: Camera, rounding: float = ROUNDING) -> None:
    truth, _ = oracle_splats.draw(arrays, camera)
    np.testing.assert_allclose(np.array(picture), truth[..., [0, 1, 2, 4]], rtol=0, atol=STOP * truth.max() + rounding)


def test_the_median_depth_is_that_of_the_splat_at_which_half_of_the_light_is_lost(variant_rgb: str) -> None:
    """Three splats of opacity 0.4 on the axis leave 0.6, 0.36 and 0.216 of the light, so half of it is lost at the second.

    Beside the axis, where each alpha is below 1 - 0.5^(1/3) = 0.206, more than half passes all three: the median depth is 0,
    as in an empty pixel.
    """
    splatter = Splatter(SIDE, SIDE, 2, median=True)
    reals = tensors(stack([np.log(0.4 / 0.6)] * 3, [0.0, 0.3, 0.6], scale=0.05))
    picture, kept = splatter.forward(reals, straight())
    depth, alpha = np.array(picture)[..., 3], np.array(picture)[..., 4]
    assert depth[SIDE // 2, SIDE // 2] == pytest.approx(1.3, rel=1e-6)
    assert (depth[alpha < 0.5 - 1e-6] == 0).all() and (depth[alpha > 0.5 + 1e-6] > 0).all()
    assert_refused("median depth, which has no derivatives", splatter.backward, kept, picture)


def disc_picture(radius: float, depth: float = 0.0, beside: float = 0.0, opacity: float = 20.0) -> np.ndarray:
    """Alpha of a disc of a radius [pixel at the origin], at a distance behind the origin and an offset of pixels from the
    axis."""
    arrays = stack([opacity], [depth], scale=radius / SIDE)
    arrays["means"][0, 0] = beside / SIDE * (1 + depth)
    splatter = Splatter(SIDE, SIDE, 2, compensated=True, discs=True)
    return np.array(splatter.forward(tensors(arrays), straight())[0])[..., 3]


def test_a_disc_covers_its_area_and_nothing_else(variant_rgb: str) -> None:
    """Radius 6 pixels, widened to sqrt(36.3) with an opacity of 36 / 36.3: pi 36 pixels in all.

    The share of a pixel is linear in the distance of its centre from the border, and exact only for a border parallel to an
    edge. The error is at most 6 % of a pixel, of either sign, in the 2 pi 6 pixels of the border: less than 1 % of the area.
    """
    for beside in (0.0, 0.3, 0.5):
        alpha = disc_picture(6, beside=beside)
        assert alpha.sum() == pytest.approx(np.pi * 36, rel=0.01)
        x = np.arange(SIDE) - SIDE // 2
        away = np.hypot(x[None, :] - beside, x[:, None])
        np.testing.assert_allclose(alpha[away < 5.5], 36 / 36.3, atol=1e-3)
        assert (alpha[away > 6.6] == 0).all() and alpha[np.abs(away - 6) < 0.2].min() > 0


def test_the_light_of_a_small_disc_falls_with_the_square_of_its_distance(variant_rgb: str) -> None:
    """Radii of 2 to 0.25 pixels. The smallest disc is drawn with a radius of 0.6, whose border is not straight in any pixel: an
    error of a quarter of its area, at every place in a pixel. Without the widened radius one pixel or none would show the
    disc."""
    for depth in (0.0, 1.0, 3.0, 7.0):
        for beside in (0.0, 0.25, 0.5):
            area = np.pi * (2 / (1 + depth)) ** 2
            assert disc_picture(2, depth, beside).sum() == pytest.approx(area, rel=0.25), (depth, beside)


def test_nearer_discs_hide_those_behind_and_have_no_derivatives(variant_rgb: str) -> None:
    splatter = Splatter(SIDE, SIDE, 2, discs=True)
    reals = tensors(stack([20.0, 20.0], [0.3, 0.0], scale=0.2))  # greys of 0.22 behind and 0.78 in front
    picture, kept = splatter.forward(reals, straight())
    assert np.array(picture)[SIDE // 2, SIDE // 2, 0] == pytest.approx(0.5 + 0.5 / np.sqrt(np.pi), abs=1e-4)
    assert_refused("of discs, which have no derivatives", splatter.backward, kept, picture)


def test_derivatives_at_an_opacity_of_one(splatter: Splatter) -> None:
    """In the pixel of alpha 1 everything behind is hidden, and yet the derivative by the place of the front splat depends on
    the hidden colour. A logit of 20 is an opacity of 1 in float32; the splat of logit 30 behind it is hidden, and hides the
    third."""
    compare_derivatives(splatter, stack([20.0, 30.0, 0.0], [0.0, 0.3, 0.6]))


def test_derivatives_behind_a_wall(splatter: Splatter) -> None:
    """A wall hides 1 - 1e-5 of nine other splats in all pixels. The derivative by its size still includes all nine."""
    arrays = stack([20.0] + [-0.5] * 9, [0.1 * k for k in range(10)], scale=0.5)
    arrays["log_scales"][0] = np.log(20)
    compare_derivatives(splatter, arrays)


def compare_derivatives(splatter: Splatter, arrays: dict[str, np.ndarray]) -> None:
    """Image and derivatives of a cloud on the axis equal those of the oracle."""
    picture, kept = splatter.forward(tensors(arrays), straight())
    truth, frozen = oracle_splats.draw(arrays, straight())
    truth = truth[..., [0, 1, 2, 4]]
    np.testing.assert_allclose(np.array(picture), truth, rtol=0, atol=STOP + ROUNDING)
    assert np.array(picture)[..., 3].max() == 1
    weights = np.random.default_rng(3).normal(size=truth.shape).astype(np.float32)
    gradient, _ = splatter.backward(kept, mi.TensorXf(weights))
    five = np.insert(weights, 3, 0, axis=-1)
    for name in ("means", "log_scales", "harmonics"):
        found, slopes = np.array(gradient[name]).reshape(-1), []
        for at in range(3):
            ends = []
            for side in (1e-6, -1e-6):
                moved = {key: value.astype(float) for key, value in arrays.items()}
                moved[name].reshape(-1)[at] += side
                ends.append((oracle_splats.draw(moved, straight(), frozen=frozen)[0] * five).sum())
            slopes.append((ends[0] - ends[1]) / 2e-6)
        # What is left out of c_i - rho_i is STOP times a colour below 1, and their difference is a quarter and more.
        atol = (ROUNDING + 4 * STOP) * np.abs(found).max()
        np.testing.assert_allclose(found[:3], slopes, rtol=0, atol=atol, err_msg=name)


def test_opacities_of_zero_and_one_by_infinite_logits(splatter: Splatter) -> None:
    """A clear Gaussian leaves no trace; an opaque Gaussian has finite derivatives."""
    arrays = stack([-np.inf, np.inf, 0.0], [0.0, 0.3, 0.6])
    picture, kept = splatter.forward(tensors(arrays), straight())
    alone, _ = splatter.forward(tensors({name: value[1:] for name, value in arrays.items()}), straight())
    np.testing.assert_array_equal(np.array(picture), np.array(alone))
    gradient, statistics = splatter.backward(kept, picture)
    assert all(np.isfinite(np.array(g)).all() for g in gradient.values())
    assert not statistics.visible[0]
    assert statistics.visible[1:].all()
    assert not np.array(gradient["means"])[0].any()


@pytest.mark.parametrize("scale", [1e-6, 1e3])
def test_tiny_and_huge_scales(splatter: Splatter, camera: Camera, scale: float) -> None:
    """A tiny Gaussian is as wide as the low-pass filter, a huge one has the alpha of its opacity in every pixel. A huge
    covariance is a sum of squares up to (1e3 * 22 pixels)^2, in which the low-pass filter disappears without effect: alpha
    changes by 1e-9 across the image."""
    arrays = cloud(20, 2, scale, seed=4)
    picture, kept = splatter.forward(tensors(arrays), camera)
    assert_drawn(picture, arrays, camera)
    gradient, _ = splatter.backward(kept, picture)
    assert all(np.isfinite(np.array(g)).all() for g in gradient.values())


def test_needles(splatter: Splatter, camera: Camera) -> None:
    """A million times as long as thick. Products of their covariance would cancel to 1e-7 and are not formed. The exponent is a
    sum of terms up to 24^2 / 0.6 = 1000, each rounded by a few 2^-24, that cancel: 3e-4."""
    arrays = cloud(20, 2, 1.0, seed=6)
    arrays["log_scales"] = np.log(np.full((20, 3), [300.0, 3e-4, 3e-4], np.float32))
    picture, kept = splatter.forward(tensors(arrays), camera)
    assert_drawn(picture, arrays, camera, 1e-3)
    assert all(np.isfinite(np.array(g)).all() for g in splatter.backward(kept, picture)[0].values())


def test_nothing_behind_the_camera_is_drawn(splatter: Splatter, camera: Camera) -> None:
    """A Gaussian is drawn only if its mean is in front of the near plane, even if it reaches across the camera."""
    arrays = cloud(3, 2, 0.1)
    forward = camera.forward
    arrays["means"] = np.float32(camera.origin + np.array([[-0.5], [0.005], [0.05]]) * forward)
    picture, kept = splatter.forward(tensors(arrays), camera)
    last, _ = splatter.forward(tensors({name: value[2:] for name, value in arrays.items()}), camera)
    np.testing.assert_array_equal(np.array(picture), np.array(last))
    assert np.array(picture)[..., 3].max() > 0
    gradient, statistics = splatter.backward(kept, picture)
    assert statistics.visible.tolist() == [False, False, True]
    assert all(np.isfinite(np.array(g)).all() for g in gradient.values())


def test_layers_without_end(splatter: Splatter) -> None:
    """The last of 200 veils is visible, and learns. Mitsuba's ``volprim_rf_basic`` ends a ray after 64 Gaussians and at a
    hundredth of its light. The derivative by the colour of the last veil is Y_0 times its weight, a fiftieth of the light."""
    n = 200
    arrays = stack([-3.9] * n, [0.002 * k for k in range(n)], scale=0.5)
    picture, kept = splatter.forward(tensors(arrays), straight())
    truth, _ = oracle_splats.draw(arrays, straight())
    np.testing.assert_allclose(np.array(picture), truth[..., [0, 1, 2, 4]], rtol=0, atol=STOP + ROUNDING)
    alphas = oracle_splats.alphas({k: v.astype(float) for k, v in arrays.items()}, straight(), 0.3)
    weights = alphas[-1] * (1 - alphas[:-1]).prod(axis=0)
    found = np.array(splatter.backward(kept, mi.TensorXf(d_red(picture.shape)))[0]["harmonics"])[-1, 0]
    expected = 0.28209479177387814 * np.where(alphas[-1] >= 1 / 255, weights, 0).sum()
    # Each of 200 factors of T is rounded by 2^-24, and so is each alpha, a few times.
    assert found == pytest.approx([expected, 0, 0], rel=200 * 4 * 2**-24, abs=0)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e4])
def test_the_unit_of_length_is_free(variant_rgb: str, unit: float) -> None:
    """Scaling everything by a length, near plane included, gives the same image and divides the derivative by places.
    Logarithms of scales up to 12 are rounded by 12 * 2^-24 = 7e-7, and alpha by at most 11 times this error (q <= 2 ln 255)."""
    arrays, camera = cloud(50, 2, 0.15, seed=4), looking(SIDE, SIDE)
    pose = camera.to_world.copy()
    pose[:3, 3] *= unit
    splatter = Splatter(SIDE, SIDE, 2, near=0.01 * unit)
    scaled = arrays | {
        "means": arrays["means"] * np.float32(unit),
        "log_scales": arrays["log_scales"] + np.float32(np.log(unit)),
    }
    picture, kept = splatter.forward(tensors(scaled), Camera(camera.K, camera.size, pose))
    assert_drawn(picture, arrays, camera)
    found = np.array(splatter.backward(kept, picture)[0]["means"]).astype(float) * unit
    splatter = Splatter(SIDE, SIDE, 2)
    picture, kept = splatter.forward(tensors(arrays), camera)
    expected = np.array(splatter.backward(kept, picture)[0]["means"])
    np.testing.assert_allclose(found, expected, rtol=0, atol=4 * ROUNDING * np.abs(expected).max())


def test_the_camera_inside_gaussians(splatter: Splatter, camera: Camera) -> None:
    """Means close in front of the camera and beside it, with scales reaching across its plane, are drawn with the perspective
    linearised at the border of the image (as in the float64 twin). Mitsuba's ``volprim_rf_basic`` drops every Gaussian around
    the origin of a ray. Centres are up to 130 pixels away and rounded three times (2e-5 pixels), and an ellipse is at least 7
    pixels wide: the error of alpha is 3.3 / 7 of 2e-5, 1e-5."""
    rng = np.random.default_rng(7)
    arrays = cloud(20, 2, 0.2, seed=4)
    right, down = camera.to_world[:3, 0], -camera.to_world[:3, 1]
    x, y, z = *rng.uniform(-0.3, 0.3, (2, 20)), rng.uniform(0.05, 0.3, 20)
    arrays["means"] = np.float32(camera.origin + np.outer(x, right) + np.outer(y, down) + np.outer(z, camera.forward))
    picture, kept = splatter.forward(tensors(arrays), camera)
    truth, frozen = oracle_splats.draw(arrays, camera)
    assert frozen.mask.any(axis=(1, 2)).sum() > 10
    np.testing.assert_allclose(np.array(picture), truth[..., [0, 1, 2, 4]], rtol=0, atol=STOP * truth.max() + ROUNDING)
    assert all(np.isfinite(np.array(g)).all() for g in splatter.backward(kept, picture)[0].values())


def test_a_black_channel_has_no_derivative_and_the_rest_has(splatter: Splatter) -> None:
    """A colour below 0 is 0, with a derivative of 0: in the red of a Gaussian only. In front of a grey Gaussian, opacity and
    size of a black Gaussian are learnt from the hidden light."""
    arrays = stack([0.0, 1.0], [0.0, 0.3])
    arrays["harmonics"][0, 0] = [-1.8, -1.7, 0.4]
    picture, kept = splatter.forward(tensors(arrays), straight())
    truth, _ = oracle_splats.draw(arrays, straight())
    np.testing.assert_allclose(np.array(picture), truth[..., [0, 1, 2, 4]], rtol=0, atol=STOP + ROUNDING)
    gradient, _ = splatter.backward(kept, mi.TensorXf(np.ones(picture.shape, np.float32)))
    harmonics = np.array(gradient["harmonics"])
    assert not harmonics[0, :, 0].any()
    assert harmonics[0, 0, 1:].all()
    assert harmonics[1, 0].all()
    arrays["harmonics"][0, 0] = -1.8
    gradient, _ = splatter.backward(splatter.forward(tensors(arrays), straight())[1], mi.TensorXf(d_red(picture.shape)))
    assert not np.array(gradient["harmonics"])[0].any()
    assert np.array(gradient["opacity_logits"])[0] < 0  # at a logit of 0, where |x| has no derivative
    assert np.array(gradient["log_scales"])[0].any()


def d_red(shape: tuple[int, ...]) -> np.ndarray:
    """The derivative of the sum of the red of an image."""
    d_picture = np.zeros(shape, np.float32)
    d_picture[..., 0] = 1
    return d_picture


@pytest.mark.slow_for("3")
@pytest.mark.parametrize("n", [0, 3])
def test_no_gaussian_is_seen(splatter: Splatter, camera: Camera, n: int) -> None:
    arrays = cloud(n, 2, 0.01)
    arrays["means"] = np.float32(arrays["means"] + camera.origin - 5 * camera.forward)
    picture, kept = splatter.forward(tensors(arrays), camera)
    assert not np.array(picture).any()
    gradient, statistics = splatter.backward(kept, picture)
    assert {name: g.shape for name, g in gradient.items()} == {name: v.shape for name, v in arrays.items()} | {"pose": (6,)}
    assert not any(np.array(g).any() for g in gradient.values())
    assert statistics.visible.shape == (n,)
    assert not statistics.visible.any()


@pytest.mark.parametrize("name", ["means", "log_scales", "quaternions", "opacity_logits", "harmonics"])
def test_nan_is_named_by_its_index(splatter: Splatter, camera: Camera, name: str) -> None:
    arrays = cloud(9, 2, 0.1)
    arrays[name].reshape(9, -1)[[5, 7], -1] = np.nan
    assert_refused("Gaussian 5 and 1 others: found NaN", splatter.forward, tensors(arrays), camera)


@pytest.mark.parametrize("value", [0, 1e-40, np.inf])
def test_a_quaternion_of_no_direction_is_refused(splatter: Splatter, camera: Camera, value: float) -> None:
    arrays = cloud(9, 2, 0.1)
    arrays["quaternions"][4] = value
    assert_refused("Gaussian 4: found NaN, or a quaternion that is 0 or infinite", splatter.forward, tensors(arrays), camera)


@pytest.mark.parametrize("length", [1e-29, 1e-20, 1e20, 1e30])
def test_quaternions_of_any_length(splatter: Splatter, camera: Camera, length: float) -> None:
    """A rotation depends on the direction of its quaternion; squares of these lengths are 0 or infinite in float32. Scaling
    rounds components by 2^-24, relative. The derivative shrinks as the quaternion grows."""
    arrays = cloud(20, 2, 0.1, seed=4)
    arrays["quaternions"] /= np.linalg.norm(arrays["quaternions"], axis=1, keepdims=True)
    scaled = arrays | {"quaternions": arrays["quaternions"] * np.float32(length)}
    picture, kept = splatter.forward(tensors(scaled), camera)
    assert_drawn(picture, arrays, camera)
    found = np.array(splatter.backward(kept, picture)[0]["quaternions"]).astype(float) * length
    picture, kept = splatter.forward(tensors(arrays), camera)
    unit = np.array(splatter.backward(kept, picture)[0]["quaternions"])
    np.testing.assert_allclose(found, unit, rtol=0, atol=2 * ROUNDING * np.abs(unit).max())


def test_lists_that_do_not_fit_are_refused_with_their_size(splatter: Splatter, monkeypatch: pytest.MonkeyPatch) -> None:
    """The refusal comes before the lists are made. A Gaussian in a tile takes 80 bytes: an entry, its sorting, and T of 64
    pixels / 4."""
    monkeypatch.setattr(module, "free_memory", lambda: 15 << 20)
    monkeypatch.setattr(module, "SMALL_LISTS", 7 << 20)
    made = []
    monkeypatch.setattr(splatter, "_write", lambda *args: made.append(args))
    arrays = {name: np.repeat(value, 10**5, axis=0) for name, value in stack([0.0], [0.0], 1e-4).items()}
    assert_refused(r"100,000 entries.*take 0\.0075 GiB.*at most 0\.0073 GiB", splatter.forward, tensors(arrays), straight())
    assert made == []


def test_entries_that_32_bits_do_not_count_are_refused() -> None:
    """Even with enough memory; the last fitting number of entries is accepted."""
    check_memory(0, None, 1 << 28, "many")
    assert_refused("Found 268,435,457 entries", check_memory, 0, None, (1 << 28) + 1, "many")


def test_splats_are_in_order_of_depth_and_of_their_number_at_a_tie() -> None:
    """Depths of many orders of magnitude, each three times; every other row is requested."""
    depth = np.tile(10.0 ** np.random.default_rng(0).uniform(-2, 20, 500), 3).astype(np.float32)
    rows = np.arange(0, len(depth), 2)
    expected = rows[np.lexsort((rows, depth[rows]))]
    assert np.array_equal(nearest_first(depth, rows), expected)


def test_the_jump_of_a_swap_is_bounded(splatter: Splatter) -> None:
    """Two Gaussians whose depths are swapped exchange their order: a pixel jumps by T a_1 a_2 (c_1 - c_2), and no more."""
    arrays = stack([0.0, 1.0], [0.0, 1e-4])
    pictures = []
    for z in (1e-4, -1e-4):
        arrays["means"][1, 2] = z
        pictures.append(np.array(splatter.forward(tensors(arrays), straight())[0]).astype(float))
    jump = np.abs(pictures[0] - pictures[1])
    alphas = oracle_splats.alphas({k: v.astype(float) for k, v in arrays.items()}, straight(), 0.3)
    colours = oracle_splats.colours({k: v.astype(float) for k, v in arrays.items()}, straight())
    bound = alphas.prod(axis=0)[..., None] * np.abs(colours[0] - colours[1])
    # The place moves by 2e-4 of the distance 1, which changes alpha by less than 4e-4 of itself (q e^-q/2 < 1), and takes it
    # across 1/255, where it is skipped, in a few pixels.
    assert (jump[..., :3] <= bound + 1 / 255 + 4e-4).all()
    assert jump[..., :3].max() > 0.9 * bound.max()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda r: {name: v for name, v in r.items() if name != "harmonics"}, "Found no tensor harmonics"),
        (lambda r: r | {"harmonics": r["harmonics"][:, :4]}, r"Found harmonics of shape \(5, 4, 3\), expected \(5, 9, 3\)"),
        (lambda r: r | {"quaternions": r["quaternions"][:, :3]}, r"Found quaternions of shape \(5, 3\)"),
    ],
)
def test_tensors_of_the_wrong_shape(splatter: Splatter, camera: Camera, change: object, sentence: str) -> None:
    with pytest.raises(MivolError, match=sentence):
        splatter.forward(tensors({k: np.ascontiguousarray(v) for k, v in change(cloud(5, 2, 0.1)).items()}), camera)


def test_cameras_and_derivatives_that_do_not_fit(splatter: Splatter, camera: Camera) -> None:
    reals = tensors(cloud(5, 2, 0.1))
    with pytest.raises(MivolError, match="found an image of 12 x 24 pixels, expected the splatter's 24 x 24"):
        splatter.forward(reals, camera.resized((12, SIDE)))
    picture, kept = splatter.forward(reals, camera, derivatives=False)
    assert_refused("drawn with derivatives=False", splatter.backward, kept, picture)
    assert_refused(r"Found a derivative of shape \(24, 24, 3\)", splatter.backward, kept, picture[..., :3])


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"width": 0}, "an image of 0 x 8 pixels"),
        ({"degree": 10}, "degree 10, expected 0 to 9"),
        ({"low_pass": 0.0}, "low_pass = 0"),
        ({"near": -1.0}, "near = -1"),
        ({"sheen": 0.0}, "sheen = 0"),
        ({"least_alpha": 1.0}, "least_alpha = 1"),
    ],
)
def test_settings_that_make_no_sense(variant_rgb: str, settings: dict, sentence: str) -> None:
    assert_refused(sentence, Splatter, **({"width": 8, "height": 8, "degree": 0} | settings))
