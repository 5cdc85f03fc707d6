"""The hash grid and its networks: a float64 twin in NumPy, and derivatives against its finite differences."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from sampled_fields import OBLONG, random_points

from mivol.fields import hash_grid, networks
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.networks import Network
from mivol.threads import map_arrays

SIZES = HashSizes(levels=4, features=2, log2_table=8, coarsest=3, finest=20, width=8, geometry=5, degree=1)
PRIMES = 1, 2654435761, 805459861


def make(sizes: HashSizes = SIZES, space: str = "srgb") -> HashField:
    """A field with values of order 1."""
    field = HashField.random(sizes, OBLONG, 3, space)
    rng = np.random.default_rng(1)
    table = rng.normal(size=dr.width(field.table)).astype(np.float32)
    return field.with_parameters(field.parameters() | {"table": mi.TensorXf(table, field.shapes()["table"])})


def twin(field: HashField, values: dict[str, np.ndarray], p: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density (N,) and colour (N, 3), written for reading."""
    sizes, table = field.sizes, values["table"].reshape(-1, field.sizes.features)
    unit = (p - OBLONG[:3, 3]) / np.diag(OBLONG)[:3]
    features = []
    for level in field.encoding.levels:
        total = np.zeros((len(p), sizes.features))
        place = unit * level.cells
        node = np.minimum(place.astype(int), np.array(level.cells) - 1)
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (node + corner).T
            share = np.prod(np.where(corner, place - node, 1 - (place - node)), axis=1)
            if level.is_dense:
                row = x + (level.cells[0] + 1) * (y + (level.cells[1] + 1) * z)
            else:
                row = np.array([(a * PRIMES[0] ^ b * PRIMES[1] ^ c * PRIMES[2]) % level.rows for a, b, c in zip(
                    map(int, x), map(int, y), map(int, z), strict=True)])  # fmt: skip
            total += share[:, None] * table[level.first + row]
        features.append(total)

    def network(which: Network, weights: np.ndarray, x: np.ndarray) -> np.ndarray:
        layers = which.layers(weights)
        for layer in layers[:-1]:
            x = np.maximum(x @ layer.T, 0)
        return x @ layers[-1].T

    geometry = network(sizes.density_network, values["density_weights"], np.concatenate(features, axis=1))
    x, y, z = d.T
    basis = np.stack([0 * x + 0.28209479177, -0.48860251190 * y, 0.48860251190 * z, -0.48860251190 * x], axis=1)
    raw = network(sizes.colour_network, values["colour_weights"], np.concatenate([geometry, basis], axis=1))
    return 2 / 3 * np.exp(geometry[:, 0]), np.exp(raw) if field.space == "linear" else 1 / (1 + np.exp(-raw))


def values_of(field: HashField) -> dict[str, np.ndarray]:
    return {name: np.array(value, np.float64).ravel() for name, value in field.parameters().items()}


def test_levels_are_dense_while_their_nodes_fit() -> None:
    levels = SIZES.place_levels(np.array([2.0, 1.5, 3.0]))
    assert levels[0].cells == (2, 2, 3) and levels[-1].cells == (13, 10, 20)
    assert [level.rows for level in levels] == [3 * 3 * 4, 5 * 4 * 7, 256, 256]
    assert [level.is_dense for level in levels] == [True, True, False, False]
    assert [level.first for level in levels] == [0, 36, 176, 432]


@pytest.mark.parametrize("space", ["srgb", "linear"])
@pytest.mark.parametrize("which", ["rows", "lanes"])
def test_values_and_derivatives_equal_a_twin_in_float64(variant_rgb: str, which: str, space: str) -> None:
    """By matrices in memory and in the lanes of a kernel: table entries, weights, with the cut of no exponent near."""
    field, n = make(space=space), 40
    p, d = random_points(n)
    dr.eval(p, d)
    found = (field._evaluate_rows if which == "rows" else field._evaluate_lanes)(p, d)
    values, at = values_of(field), (np.array(p, np.float64).T, np.array(d, np.float64).T)
    sigma, colour = twin(field, values, *at)
    # float32 sums of at most 20 terms of order 1 in five layers, then an exponential of at most e^4.
    np.testing.assert_allclose(np.array(found.sigma), sigma, rtol=2e-5)
    np.testing.assert_allclose(np.array(found.colour).T, colour, rtol=2e-5, atol=1e-6)
    np.testing.assert_allclose(np.array(field.density(p)), sigma, rtol=2e-5)
    rng = np.random.default_rng(4)
    gs, gc = rng.normal(size=n), rng.normal(size=(n, 3))
    gradient = found.vjp(mi.Float(np.float32(gs)), mi.Color3f(np.float32(gc.T)))

    def loss(changed: dict[str, np.ndarray]) -> float:
        sigma, colour = twin(field, changed, *at)
        return float((gs * sigma).sum() + (gc * colour).sum())

    h = 1e-6
    for name, slopes in gradient.items():
        slopes = np.array(slopes, np.float64)
        largest = np.argsort(-np.abs(slopes))[:3]
        for k in {*largest.tolist(), *rng.integers(0, len(slopes), 5).tolist()}:
            step = np.zeros(len(slopes))
            step[k] = h
            expected = (loss(values | {name: values[name] + step}) - loss(values | {name: values[name] - step})) / (2 * h)
            # Float32 sums over 40 points, relative to the largest derivative; differences round by 2^-52 x 100 / h.
            np.testing.assert_allclose(slopes[k], expected, rtol=1e-4, atol=2e-5 * np.abs(slopes).max())


@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_both_evaluations_agree_beyond_the_cut_of_exponents(variant_rgb: str, space: str) -> None:
    """The value stays at exp(15), and the derivative is that at the cut."""
    field, (p, d) = make(space=space), random_points(40)
    values = field.parameters()
    large = {name: mi.TensorXf(30 * np.array(values[name])) for name in ("density_weights", "colour_weights")}
    field = field.with_parameters(values | large)
    dr.eval(p, d)
    rows, lanes = field._evaluate_rows(p, d), field._evaluate_lanes(p, d)
    assert np.array(rows.sigma).max() == pytest.approx(field.scale * np.exp(15), rel=1e-5)
    np.testing.assert_allclose(np.array(rows.sigma), np.array(lanes.sigma), rtol=1e-4, atol=1e-30)
    ones = dr.ones(mi.Float, 40), dr.ones(mi.Color3f, 40)
    by_rows, by_lanes = rows.vjp(*ones), lanes.vjp(*ones)
    for name, slopes in by_rows.items():
        expected = np.array(by_lanes[name], np.float64)
        # Exponents of up to 15 in float32 sums of terms up to 1000: 1e-4 of the largest value. Logistic functions saturate.
        np.testing.assert_allclose(np.array(slopes, np.float64), expected, atol=1e-3 * np.abs(expected).max() + 1e-20)


@pytest.mark.parametrize("which", ["_evaluate_rows", "_evaluate_lanes"])
def test_a_table_in_half_floats_is_the_rounded_table(variant_rgb: str, which: str) -> None:
    """Values and derivatives are those of single precision at the rounded numbers, to the bit; derivatives are float32."""
    single = make()
    half = replace(single, precision="half")
    table = np.array(single.table)
    rounded = single.with_parameters(
        single.parameters() | {"table": mi.TensorXf(np.float32(np.float16(table)), single.shapes()["table"])}
    )
    assert half.table.numpy().nbytes * 2 == table.nbytes
    # 11 bits, to nearest; below 2^-14 the spacing is 2^-24.
    assert (np.abs(np.array(rounded.table) - table) <= np.maximum(2.0**-11 * np.abs(table), 2.0**-25)).all()
    p, d = random_points(500)
    by_sigma, by_colour = mi.Float(np.linspace(-1, 1, 500)), mi.Color3f(*np.random.default_rng(2).normal(size=(3, 500)))
    found, expected = (getattr(field, which)(p, d) for field in (half, rounded))
    assert np.array_equal(np.array(found.sigma), np.array(expected.sigma))
    assert np.array_equal(np.array(found.colour), np.array(expected.colour))
    assert not np.array_equal(np.array(found.sigma), np.array(getattr(single, which)(p, d).sigma))
    slopes, others = (values.vjp(by_sigma, by_colour) for values in (found, expected))
    for name, slope in slopes.items():
        assert type(slope) is mi.Float
        np.testing.assert_array_equal(np.array(slope), np.array(others[name]))


def test_blocks_in_threads_give_the_same_bits(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results keep the order of the blocks; a fault in a thread reaches the caller."""
    field, (p, d) = make(), random_points(100)
    dr.eval(p, d)
    monkeypatch.setattr(networks, "BLOCK", 16)

    def derive(count: int) -> dict[str, np.ndarray]:
        monkeypatch.setattr(hash_grid.dr, "thread_count", lambda: count)
        values = field._evaluate_rows(p, d)
        slopes = values.vjp(dr.ones(mi.Float, 100), dr.ones(mi.Color3f, 100))
        return {"sigma": np.array(values.sigma)} | {name: np.array(slopes[name]) for name in slopes if name != "table"}

    one, three = derive(1), derive(3)
    assert all(np.array_equal(one[name], three[name]) for name in one)
    assert map_arrays(lambda k: k * k, range(7), 3) == [k * k for k in range(7)]
    with pytest.raises(ZeroDivisionError):
        map_arrays(lambda k: 1 // k, [1, 0, 2], 3)


@pytest.mark.parametrize("features", [1, 4, 8])
def test_rows_of_any_width_are_read_and_added_to(variant_rgb: str, features: int) -> None:
    """The transpose: sum of slopes times features equals the sum of gradient times table, since features are linear in it."""
    field = make(HashSizes(levels=3, features=features, log2_table=7, coarsest=2, finest=9))
    p, _ = random_points(50)
    unit = field.encoding.to_unit(p)
    found = field.encoding.encode(field.table, unit)
    rng = np.random.default_rng(0)
    slopes = [mi.Float(rng.normal(size=50)) for _ in found]
    target = dr.zeros(mi.Float, dr.width(field.table))
    field.encoding.add_features(unit, slopes, target)
    left = sum(float(np.dot(np.array(a, np.float64), np.array(b, np.float64))) for a, b in zip(found, slopes, strict=True))
    right = float(np.dot(np.array(target, np.float64), np.array(field.table, np.float64)))
    # 1200 products of order 1, each rounded by at most 8 half spacings.
    assert left == pytest.approx(right, abs=1200 * 8 * 2**-24)


def test_products_in_pieces_equal_whole_products() -> None:
    """More rows than a piece has, and a remainder."""
    network, rng = Network((16, 32, 3)), np.random.default_rng(0)
    weights, x, dy = (rng.normal(size=n).astype(np.float32) for n in (network.size, (1000, 16), (1000, 3)))
    layers = network.layers(weights)
    rows = network.forward(layers, x)
    hidden = np.maximum(x.astype(np.float64) @ layers[0].T, 0)
    np.testing.assert_allclose(rows[1], hidden, atol=16 * 8 * 2**-23)
    gradient = network.layers(np.zeros(network.size, np.float32))
    by_x = network.backward(layers, rows, dy, gradient)
    by_hidden = (dy.astype(np.float64) @ layers[1]) * (rows[1] > 0)
    np.testing.assert_allclose(by_x, by_hidden @ layers[0], atol=35 * 16 * 2**-23)
    np.testing.assert_allclose(gradient[0], by_hidden.T @ x, atol=1000 * 16 * 2**-24)
    np.testing.assert_allclose(gradient[1], dy.T.astype(np.float64) @ rows[1], atol=1000 * 16 * 2**-24)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"features": 3}, "features = 3, expected 1, 2, 4 or 8"),
        ({"levels": 0}, "levels = 0, expected 1 to 32"),
        ({"coarsest": 30}, "30 to 20 cells, expected the coarsest first"),
    ],
)
def test_sizes_that_contradict_are_refused(change: dict[str, int], said: str) -> None:
    from dataclasses import replace

    assert_refused(said, replace, SIZES, **change)


def test_tables_and_weights_of_other_sizes_are_refused(variant_rgb: str) -> None:
    field = make()
    for name in ("table", "density_weights", "colour_weights"):
        values = field.parameters() | {name: dr.zeros(mi.TensorXf, (7,))}
        assert_refused(f"{name} has 7 numbers, expected", field.with_parameters, values)
