"""The coordinate network: a float64 twin in NumPy, its finite differences, and weights in the published layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from sampled_fields import OBLONG, random_points

from mivol.fields.nerf import NerfField, NerfSizes
from mivol.files.npy import read_safetensors, write_safetensors
from mivol.optim.photographs.sampled_problem import find_region

FRAME = 0.0, 0.25, 1.5, 1.5
SIZES = NerfSizes(depth=4, width=8, skip=2, place=3, direction=2, branch=6)
SPHERICAL = NerfSizes(depth=4, width=8, skip=2, place=3, direction=0, branch=1, harmonics=1)
Weights = dict[str, np.ndarray]


def published(sizes: NerfSizes = SIZES) -> Weights:
    """Made-up weights in the layout of the published program."""
    rng = np.random.default_rng(0)
    arrays = {}
    for name, (out, inputs) in sizes.layers.items():
        arrays[f"{name}.weight"] = rng.normal(size=(out, inputs)).astype(np.float32) / np.float32(np.sqrt(inputs))
        arrays[f"{name}.bias"] = rng.normal(size=out).astype(np.float32) / 4
    arrays["alpha_linear.bias"] += 0.5
    return arrays


def twin(arrays: Weights, p: np.ndarray, d: np.ndarray, relu: bool, linear: bool) -> tuple[np.ndarray, np.ndarray]:
    """Density (N,) and colour (N, 3) of the four layers, written for reading."""
    w = {name: np.asarray(value, np.float64) for name, value in arrays.items()}

    def layer(name: str, x: np.ndarray) -> np.ndarray:
        return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]

    def encode(x: np.ndarray, frequencies: list[int]) -> np.ndarray:
        return np.hstack([x] + [f(n * x) for n in frequencies for f in (np.sin, np.cos)])

    x = encode((p - FRAME[:3]) / FRAME[3], [1, 2, 4])
    h = np.maximum(layer("pts_linears.0", x), 0)
    h = np.maximum(layer("pts_linears.1", h), 0)
    h = np.maximum(layer("pts_linears.2", np.hstack([x, h])), 0)
    h = np.maximum(layer("pts_linears.3", h), 0)
    y = layer("alpha_linear", h)[:, 0]
    sigma = np.maximum(y, 0) if relu else np.log1p(np.exp(y - 1))
    if "sh_linear.weight" in arrays:  # degree 1, channel by channel
        a, (x, y, z) = np.sqrt(3 / (4 * np.pi)), d.T
        basis = np.stack([np.full(len(d), 1 / np.sqrt(4 * np.pi)), -a * y, a * z, -a * x], axis=1)
        raw = np.einsum("ncb,nb->nc", layer("sh_linear", h).reshape(-1, 3, 4), basis)
        return sigma / FRAME[3], np.exp(raw) if linear else 1 / (1 + np.exp(-raw))
    seen = np.hstack([layer("feature_linear", h), encode(d, [1, 2])])
    raw = layer("rgb_linear", np.maximum(layer("views_linears.0", seen), 0))
    return sigma / FRAME[3], np.exp(raw) if linear else 1 / (1 + np.exp(-raw))


@pytest.mark.parametrize("relu", [False, True])
@pytest.mark.parametrize("space", ["srgb", "linear"])
@pytest.mark.parametrize("which", ["rows", "lanes"])
@pytest.mark.parametrize("head", ["branch", "harmonics"])
def test_values_and_derivatives_equal_a_twin_in_float64(
    variant_rgb: str, head: str, which: str, space: str, relu: bool
) -> None:
    """By matrices in memory and in the lanes of a kernel: all outputs, and weights and biases of each layer."""
    from dataclasses import replace

    arrays, n, linear = published(SIZES if head == "branch" else SPHERICAL), 40, space == "linear"
    p, d = random_points(n)
    dr.eval(p, d)
    field = replace(NerfField.from_published(arrays, OBLONG, FRAME), space=space)
    field = replace(field, sizes=replace(field.sizes, relu=int(relu)))
    found = (field._evaluate_rows if which == "rows" else field._evaluate_lanes)(p, d)
    at = np.array(p, np.float64).T, np.array(d, np.float64).T
    sigma, colour = twin(arrays, *at, relu, linear)
    # float32 sums of at most 30 terms of order 1 in seven layers.
    np.testing.assert_allclose(np.array(found.sigma), sigma, rtol=2e-5, atol=4e-6)
    np.testing.assert_allclose(np.array(found.colour).T, colour, rtol=2e-5, atol=4e-6)
    np.testing.assert_allclose(np.array(field.density(p)), sigma, rtol=2e-5, atol=4e-6)
    rng = np.random.default_rng(4)
    gs, gc = rng.normal(size=n), rng.normal(size=(n, 3))
    gradient = np.array(found.vjp(mi.Float(np.float32(gs)), mi.Color3f(np.float32(gc.T)))["weights"], np.float64)

    def loss(changed: Weights) -> float:
        sigma, colour = twin(changed, *at, relu, linear)
        return float((gs * sigma).sum() + (gc * colour).sum())

    h = 1e-7
    for name, parts in field.sizes.split(gradient).items():
        for part, slopes in zip(("weight", "bias"), parts, strict=True):
            key, values = f"{name}.{part}", arrays[f"{name}.{part}"].astype(np.float64)
            for k in {int(np.abs(slopes).argmax()), *rng.integers(0, slopes.size, 3).tolist()}:
                step = np.zeros(slopes.size)
                step[k] = h
                ends = [loss(arrays | {key: values + sign * step.reshape(values.shape)}) for sign in (1, -1)]
                # Float32 sums over 40 points, relative to the largest derivative; differences round by 2^-52 x 100 / h.
                np.testing.assert_allclose(
                    slopes.flat[k], (ends[0] - ends[1]) / (2 * h), rtol=2e-4, atol=2e-5 * np.abs(gradient).max()
                )


def test_a_published_network_is_read_from_an_npz(variant_rgb: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "network.npz", **published())
    with np.load(tmp_path / "network.npz") as arrays:
        field = NerfField.from_published(arrays, OBLONG)
    assert field.frame == (0, 0, 0, 1)
    assert (field.sizes.depth, field.sizes.width, field.sizes.skip, field.sizes.branch) == (4, 8, 2, 6)
    assert (field.sizes.place, field.sizes.direction, field.sizes.relu) == (3, 2, 1)


@pytest.mark.parametrize("sizes", [SIZES, SPHERICAL])
def test_weights_survive_a_safetensors_file(variant_rgb: str, tmp_path: Path, sizes: NerfSizes) -> None:
    arrays = published(sizes)
    field = NerfField.from_published(arrays, OBLONG, FRAME)
    write_safetensors(tmp_path / "weights.safetensors", field.to_published())
    read = read_safetensors(tmp_path / "weights.safetensors")
    assert set(read) == set(arrays) and all(np.array_equal(read[name], value) for name, value in arrays.items())
    again = NerfField.from_published(read, OBLONG, FRAME)
    assert again.sizes.harmonics == sizes.harmonics and np.array_equal(again.weights, field.weights)


def with_header(text: bytes) -> bytes:
    return len(text).to_bytes(8, "little") + text


def test_a_safetensors_file_of_another_program_is_read(tmp_path: Path) -> None:
    """Written byte by byte: a header with metadata, a BF16 and an I64 array."""
    header = b'{"__metadata__":{"a":"b"},"x":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]},'
    header += b'"n":{"dtype":"I64","shape":[1],"data_offsets":[4,12]}}'
    numbers = b"\x80\x3f\x00\xc0" + (7).to_bytes(8, "little")  # 1 and -2 as upper halves of float32
    (tmp_path / "a.safetensors").write_bytes(with_header(header) + numbers)
    read = read_safetensors(tmp_path / "a.safetensors")
    assert read["x"].tolist() == [1.0, -2.0] and read["n"].tolist() == [7]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"PK\x03\x04 no such file at all", "no header of safetensors"),
        (b"\x02\0\0\0\0\0\0\0[]", "no header of safetensors"),
        (with_header(b'{"x":{"dtype":"F32","shape":[9],"data_offsets":[0,4]}}') + bytes(4), "against its shape"),
        (with_header(b'{"x":{"dtype":"C8","shape":[1],"data_offsets":[0,4]}}') + bytes(4), "of the type C8"),
    ],
)
def test_broken_safetensors_are_refused(tmp_path: Path, data: bytes, said: str) -> None:
    (tmp_path / "a.safetensors").write_bytes(data)
    assert_refused(said, read_safetensors, tmp_path / "a.safetensors")


def test_a_network_gets_its_occupied_cells(variant_rgb: str) -> None:
    """Density 10 max(x, 0) in the cube from -1 to 1: cells are occupied where x is above 0."""
    arrays = {
        "pts_linears.0.weight": np.array([[1.0, 0, 0]]), "alpha_linear.weight": np.array([[10.0]]),
        "feature_linear.weight": np.ones((1, 1)), "views_linears.0.weight": np.ones((1, 4)),
        "rgb_linear.weight": np.ones((3, 1)),
    }  # fmt: skip
    arrays |= {name.replace("weight", "bias"): np.zeros(len(value)) for name, value in arrays.items()}
    field = NerfField.from_published(arrays, np.array([[2.0, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]]))
    region = find_region(field, cells=8).region
    occupied = np.array(region.occupied).reshape([n + 1 for n in region.res])
    # Eight nodes, nine cells: the middle one is cut in two by x = 0, and eight points miss its right half with 2^-8.
    assert not occupied[..., :4].any() and occupied[..., 5:].all()
    assert region.step == pytest.approx(2 / 8 / 2)


def test_the_default_sizes_are_those_published() -> None:
    layers = NerfSizes().layers
    assert NerfSizes().inputs == (63, 27) and layers["pts_linears.0"] == (256, 63) and layers["pts_linears.4"] == (256, 256)
    assert layers["pts_linears.5"] == (256, 319) and layers["views_linears.0"] == (128, 283) and len(layers) == 12


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda a: a.pop("feature_linear.bias"), "found no feature_linear.bias among the weights"),
        (lambda a: a.pop("pts_linears.1.weight"), "found no pts_linears.1.weight among the weights"),
        (lambda a: a.update({"alpha_linear.weight": np.zeros((1, 7))}), r"alpha_linear.weight of the shape \(1, 7\), expected"),
        (lambda a: a.update({"pts_linears.3.weight": np.zeros(8)}), r"the shape \(8,\), expected \(outputs, inputs\)"),
        (lambda a: a.update({"rgb_linear.bias": np.full(3, np.nan)}), "rgb_linear.bias with values that are not finite"),
        (lambda a: a.clear(), "found no pts_linears.0.weight"),
    ],
)
def test_weights_that_contradict_are_refused(variant_rgb: str, change: Callable[[Weights], object], said: str) -> None:
    arrays = published()
    change(arrays)
    assert_refused(said, NerfField.from_published, arrays, OBLONG)


@pytest.mark.parametrize(
    ("change", "said"), [({"skip": 4}, "skip = 4, expected less than its 4 layers"), ({"width": 0}, "width = 0, expected 1 to")]
)
def test_sizes_that_contradict_are_refused(change: dict[str, int], said: str) -> None:
    from dataclasses import replace

    assert_refused(said, replace, SIZES, **change)
