"""Images of Gaussians and their derivatives, compared with an image in float64 without tiles and without an end of lanes."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_splats
import pytest
from clouds import cloud, looking, tensors

from mivol.photos.camera import Camera, intrinsics
from mivol.splatting import Splatter
from mivol.splatting.compositing import STOP
from mivol.splatting.splatter import _capacity

WIDTH, HEIGHT = 40, 37
SIZES = {1: 0.2, 8: 0.05, 50: 0.15}
"""Gaussians -> their scale: one, a few that hardly meet, many that overlap."""

ROUNDING = 4e-5
"""Of a derivative, relative to the largest of its kind. A centre of up to 40 pixels is rounded three times, by 40 * 3 * 2^-24 =
7e-6 pixels. alpha changes with it by d / sigma^2 <= 3.3 / sigma of itself (alpha >= 1/255 ends at 3.3 sigma), and sigma is
sqrt(0.3) at least: 4e-5. All else is rounded by a few 2^-24."""

STEP = 1e-6
"""Of central differences in float64: 1e-12 is left out, 1e-10 is rounding."""


@pytest.fixture
def splatter(variant_rgb: str) -> Splatter:
    return Splatter(WIDTH, HEIGHT, 2, depth=True)


def slopes(arrays: dict[str, np.ndarray], weights: np.ndarray, frozen: oracle_splats.Drawn, **options: object) -> dict:
    """Derivatives of the weighted sum of the image by six numbers of each kind: (index, central difference)."""
    rng, camera = np.random.default_rng(2), looking(WIDTH, HEIGHT)
    arrays = {name: value.astype(float) for name, value in arrays.items()}

    def at(motion: np.ndarray) -> float:
        return (oracle_splats.draw(arrays, oracle_splats.moved(camera, motion), frozen=frozen, **options)[0] * weights).sum()

    found = {"pose": [(j, (at(e) - at(-e)) / (2 * STEP)) for j, e in enumerate(STEP * np.eye(6))]}
    for name, value in arrays.items():
        flat, found[name] = value.reshape(-1), []
        for j in rng.permutation(flat.size)[:6]:
            before, ends = flat[j], []
            for side in (1, -1):
                flat[j] = before + side * STEP
                ends.append(at(np.zeros(6)))
            flat[j] = before
            found[name].append((j, (ends[0] - ends[1]) / (2 * STEP)))
    return found


def compare(splatter: Splatter, n: int, degree: int, **options: object) -> None:
    """Image and derivatives of a cloud equal those of the oracle."""
    arrays, camera = cloud(n, degree, SIZES[n], seed=n), looking(WIDTH, HEIGHT)
    picture, kept = splatter.forward(tensors(arrays), camera)
    truth, frozen = oracle_splats.draw(arrays, camera, **options)
    # What is not drawn any more is below STOP times the largest colour or depth.
    np.testing.assert_allclose(np.array(picture), truth, atol=STOP * truth.max() * 1e-1 + ROUNDING, rtol=0)
    weights = np.random.default_rng(1).normal(size=truth.shape).astype(np.float32)
    gradient, _ = splatter.backward(kept, mi.TensorXf(weights))
    for name, pairs in slopes(arrays, weights, frozen, **options).items():
        index, slope = np.array(pairs).T
        found = np.array(gradient[name]).reshape(-1)
        np.testing.assert_allclose(found[index.astype(int)], slope, rtol=0, atol=ROUNDING * np.abs(found).max(), err_msg=name)


def test_pictures_and_derivatives(splatter: Splatter) -> None:
    """A single splatter draws all clouds: its recordings keep nothing of the first cloud."""
    for n in SIZES:
        compare(splatter, n, 2)


def test_the_derivatives_are_those_of_one_function(splatter: Splatter) -> None:
    """Reverse against forward: along a direction of all parameters at once, the oracle changes by the dot product of the
    direction with the gradient. The bound of rounding is shared by all numbers, and grows as the root of their count."""
    arrays, camera = cloud(8, 2, SIZES[8], seed=8), looking(WIDTH, HEIGHT)
    picture, kept = splatter.forward(tensors(arrays), camera)
    _, frozen = oracle_splats.draw(arrays, camera)
    rng = np.random.default_rng(5)
    weights = rng.normal(size=picture.shape).astype(np.float32)
    gradient, _ = splatter.backward(kept, mi.TensorXf(weights))
    way = {name: rng.normal(size=value.shape) for name, value in arrays.items()}
    motion = rng.normal(size=6)
    ends = []
    for step in (STEP, -STEP):
        moved = {name: value + step * way[name] for name, value in arrays.items()}
        ends.append((oracle_splats.draw(moved, oracle_splats.moved(camera, step * motion), frozen=frozen)[0] * weights).sum())
    products = [(np.array(gradient[name]) * (way | {"pose": motion})[name]).ravel() for name in gradient]
    dot = np.concatenate(products)
    assert abs(dot.sum() - (ends[0] - ends[1]) / (2 * STEP)) < ROUNDING * np.linalg.norm(dot)


def test_small_gaussians_are_splatted_as_they_are_ray_traced(variant_rgb: str) -> None:
    """The perspective is linearised over a Gaussian, with an error proportional to its size over its distance. The error halves
    with the size, to a tenth (the next term of the expansion), in an image magnified as much as the Gaussian shrinks."""
    splatter = Splatter(32, 32, 0, low_pass=1e-6)
    arrays = {
        "means": np.array([[0.3, -0.2, 0.1]]),
        "quaternions": np.array([[0.8, 0.3, -0.4, 0.5]]),
        "opacity_logits": np.array([1.5]),
        "harmonics": np.zeros((1, 1, 3)),
    }
    errors = []
    for size in (0.1, 0.05, 0.025):
        focal, pose = 16 / size, np.eye(4)
        pose[2, 3] = 1.8
        camera = Camera(intrinsics(focal, focal, 16 - focal * 0.3 / 1.7, 16 - focal * 0.2 / 1.7), (32, 32), pose)
        arrays["log_scales"] = np.log(size * np.array([[1.0, 0.5, 0.3]]))
        picture, _ = splatter.forward({name: mi.TensorXf(np.float32(value)) for name, value in arrays.items()}, camera)
        truth = oracle_splats.peaks(arrays, camera)[0]
        errors.append(np.abs(np.array(picture)[..., 3] - truth)[truth > 0.1].max())
    assert errors[0] < 0.05
    assert np.array(errors[:-1]) / errors[1:] == pytest.approx(2, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
def test_pictures_and_derivatives_with_compensated_opacity(variant_rgb: str, degree: int) -> None:
    splatter = Splatter(WIDTH, HEIGHT, degree, depth=True, compensated=True)
    for n in SIZES:
        compare(splatter, n, degree, compensated=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_factor_on_higher_harmonics(variant_rgb: str, degree: int) -> None:
    """The image equals that of higher harmonics times the factor; derivatives by these harmonics are times the factor, too.

    Tables of 3, 12, 27 and 48 numbers a Gaussian are read one, four, one and sixteen at a time. A product is rounded once more.
    """
    arrays, camera, sheen = cloud(8, degree, SIZES[8], seed=8), looking(WIDTH, HEIGHT), 0.3
    factor = np.array([1.0] + [sheen] * ((degree + 1) ** 2 - 1), np.float32)[:, None]
    smaller = {**arrays, "harmonics": arrays["harmonics"] * factor}
    found = []
    for given, splatter in ((arrays, Splatter(WIDTH, HEIGHT, degree, sheen=sheen)), (smaller, Splatter(WIDTH, HEIGHT, degree))):
        picture, kept = splatter.forward(tensors(given), camera)
        weights = np.random.default_rng(1).normal(size=picture.shape).astype(np.float32)
        found.append((np.array(picture), splatter.backward(kept, mi.TensorXf(weights))[0]))
    (picture, gradient), (plain, slopes) = found
    np.testing.assert_allclose(picture, plain, rtol=0, atol=1e-6 * plain.max())
    for name in arrays:
        expected = np.array(slopes[name]) * (factor if name == "harmonics" else 1)
        np.testing.assert_allclose(np.array(gradient[name]), expected, rtol=0, atol=ROUNDING * np.abs(expected).max())


def test_kernels_are_recorded_once(splatter: Splatter) -> None:
    """Another number of Gaussians, another pose and other lists compile and record nothing."""
    recorded = (splatter._project, splatter._write, splatter._composite, splatter._project_adjoint)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for n, distance in ((60, 1.8), (50, 1.6), (200, 1.7), (333, 2.0)):
            dr.kernel_history_clear()
            picture, kept = splatter.forward(tensors(cloud(n, 2, 0.05, seed=n)), looking(WIDTH, HEIGHT, distance))
            dr.eval(splatter.backward(kept, picture)[0])
            compiled = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT and not k["cache_hit"]]
            assert n == 60 or len(compiled) == 0, n
    assert [f.n_recordings for f in recorded] == [1, 1, 1, 1]


def test_derivatives_without_the_camera(splatter: Splatter) -> None:
    image, saved = splatter.forward(tensors(cloud(20, 2, 0.05, seed=1)), looking(WIDTH, HEIGHT))
    with_pose, without = (splatter.backward(saved, dr.ones(mi.TensorXf, image.shape), pose)[0] for pose in (True, False))
    assert with_pose.keys() - without.keys() == {"pose"}
    for name, value in without.items():
        # Sums over at most some hundred pixels, by threads in another order.
        most = np.abs(np.array(with_pose[name])).max()
        np.testing.assert_allclose(np.array(value), np.array(with_pose[name]), rtol=0, atol=WIDTH * HEIGHT * 2**-24 * most)


def test_room_for_gaussians_is_a_power_of_two() -> None:
    """Kernels are then compiled a few times in a fit, instead of with every clone."""
    assert [_capacity(n) for n in (1, 4096, 4097, 8192, 8193)] == [4096, 4096, 8192, 8192, 16384]


def test_what_light_is_left_is_kept_for_derivatives_alone(splatter: Splatter) -> None:
    """A number a pixel and chunk of a list; an image without derivatives keeps the numbers of a single chunk."""
    chunks = mi.UInt32([*range(splatter.n_tiles), 37])
    widths = [dr.width(splatter._frame(SimpleNamespace(chunks=chunks), asked).transmittance) for asked in (False, True)]
    assert widths[1] == 37 * widths[0]
