"""Octrees: light along rays against a float64 twin, derivatives against differences, uniform leaves against a grid."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from octrees import PLACE, hard_rays, random_octree, twin
from refusals import assert_refused

from mivol.fields.octree import MAX_DEPTH, Octree, interleave, separate
from mivol.transport.line_integrals.leaf_radiance import (
    HALF_MAX,
    HalfColours,
    LeafColours,
    LeafPlaces,
    make_leaf_colours,
    raise_leaf_weights,
    render_leaves,
    vjp_leaf_colours,
    vjp_leaves,
)
from mivol.transport.line_integrals.radiance_field import RayBundle, RayGradient
from mivol.transport.traversal.leaf_index import LeafIndex


def bundle(o: np.ndarray, d: np.ndarray) -> RayBundle:
    return RayBundle(mi.Point3f(np.ascontiguousarray(o.T)), mi.Vector3f(np.ascontiguousarray(d.T)))


def basis_of(tree: Octree, d: np.ndarray) -> np.ndarray:
    """Harmonics (rays, basis)."""
    rows = tree.eval_basis(mi.Vector3f(np.ascontiguousarray(d.T)))
    return np.stack([np.broadcast_to(np.array(y), len(d)) for y in rows], axis=1).astype(np.float64)


def leaves_along(tree: Octree, d: np.ndarray, slope: bool = False) -> LeafColours:
    """The leaves in the direction of each ray: a block of the table for each ray."""
    density, sh = (np.float64(v) for v in tree.values())
    sums = np.einsum("rb,lbc->rlc", basis_of(tree, d), sh) + tree.offset
    colours = np.maximum(sums, 0) if tree.colours == "clamp" else 1 / (1 + np.exp(-sums))
    table = np.concatenate([np.broadcast_to(density[:, None], (len(d), tree.leaves, 1)), colours], axis=2)
    first = mi.UInt32(np.arange(len(d), dtype=np.uint32) * tree.leaves)
    return LeafColours(mi.Float(np.float32(table.ravel())), first, dr.zeros(mi.Float, table.size) if slope else None)


@pytest.mark.parametrize(
    "depth, split, colours",
    [
        *((1, 0.5, "clamp"), (5, 0.55, "clamp"), (8, 0.3, "clamp"), (9, 0.3, "clamp"), (12, 0.2, "clamp")),
        *((1, 0.5, "sigmoid"), (5, 0.55, "sigmoid")),
    ],
)
def test_agrees_with_the_twin(variant_rgb: str, depth: int, split: float, colours: str) -> None:
    """The index of leaves depends on the depth, and colours do not."""
    tree, (o, d) = random_octree(depth, split=split, colours=colours), hard_rays()
    rays = bundle(o, d)
    rendered = render_leaves(LeafIndex.find(tree), leaves_along(tree, d), rays, distances=True)
    basis, values = basis_of(tree, d), [np.float64(v) for v in tree.values()]
    expected = [twin(tree, *values, *ray) for ray in zip(o, d, basis, strict=True)]
    # Positions err by 2^-23 (X + Y + Z) = 3.6e-7 of the cube, extinctions differ by up to 3 from leaf to leaf; the errors of
    # planes are random, and the walk crosses few of them. One wrong leaf of the finest cells would be 3 / 4096 = 7e-4.
    np.testing.assert_allclose(np.array(rendered.colour).T, [e[0] for e in expected], atol=2e-6)
    np.testing.assert_allclose(np.array(rendered.T), [e[1] for e in expected], atol=2e-6)
    np.testing.assert_allclose(np.array(rendered.distance), [e[2] for e in expected], atol=1e-4)
    # Energy: weights and transmittance sum to 1, so light of leaves at most as bright as 1 stays in [0, 1].
    assert np.array(rendered.T).min() >= 0 and np.array(rendered.T).max() <= 1
    if colours == "sigmoid":
        total = np.array(rendered.colour) + np.array(rendered.T)
        assert total.min() >= 0 and total.max() <= 1 + 1e-6


def test_half_floats_keep_leaves_to_their_rounding(variant_rgb: str) -> None:
    """2^-11 of a number, or half a step of the smallest halves; more than a half float holds stays opaque and finite."""
    tree = random_octree(4)
    density, sh = tree.values()
    density[3] = 1e9
    tree = tree.with_leaves(tree.codes, tree.sizes, density, sh)
    exact = make_leaf_colours(tree, LeafPlaces.find(tree), np.array([[2.0, 3, 1]]), mi.UInt32(0))
    row, on = dr.arange(mi.UInt32, tree.leaves), mi.Bool(True)
    for ours, theirs in zip(*(source.read(row, on) for source in (HalfColours.round(exact, tree.cell), exact)), strict=True):
        ours, theirs, unit = np.array(ours), np.array(theirs), 1.0
        if ours.ndim == 1:
            unit = 1 / tree.cell
            assert ours[3] * tree.cell == pytest.approx(HALF_MAX, rel=1e-6)
            ours, theirs = np.delete(ours, 3), np.delete(theirs, 3)
        assert (np.abs(ours - theirs) <= (2.0**-11 + 2.0**-22) * np.abs(theirs) + 2.0**-25 * unit).all()
        assert (ours != theirs).any()


def uniform(n: int, depth: int) -> tuple[Octree, np.ndarray, np.ndarray]:
    """Leaves in every cell, and their values as arrays [z][y][x]."""
    rng = np.random.default_rng(4)
    density, sh = rng.random((n, n, n)) * 4, rng.normal(size=(n, n, n, 4, 3)) * 0.3
    cells = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    codes = interleave(cells, depth)
    order = np.argsort(codes)
    x, y, z = cells[order].T
    sizes = np.zeros(n**3, np.uint8)
    return Octree.from_rows(depth, PLACE, codes[order], sizes, density[z, y, x], sh[z, y, x]), density, sh


def test_uniform_leaves_are_a_grid_of_nearest_nodes(variant_rgb: str) -> None:
    n = 8
    tree, density, sh = uniform(n, 3)
    o, d = (a[20:] for a in hard_rays(3))
    rays = bundle(o, d)
    rendered = render_leaves(LeafIndex.find(tree), leaves_along(tree, d), rays)
    inverse, basis = np.linalg.inv(PLACE), basis_of(tree, d)
    for i in range(len(o)):
        q, v = inverse[:3] @ np.append(np.float64(o[i]), 1), inverse[:3, :3] @ np.float64(d[i])
        # All planes between nodes along the ray; the nearest node between two of them is constant.
        t = np.unique(np.concatenate([[0.0], *((np.arange(n + 1) / n - q[a]) / v[a] for a in range(3))]))
        t = t[t >= 0]
        L, T = np.zeros(3), 1.0
        for a, b in itertools.pairwise(t):
            place = np.floor((q + v * (a + b) / 2) * n).astype(int)
            if ((place < 0) | (place >= n)).any():
                continue
            node = tuple(place[::-1])
            alpha = -np.expm1(-np.float32(density[node]) * (b - a))
            L += T * alpha * np.maximum(0.5 + basis[i] @ sh[node], 0)
            T *= 1 - alpha
        np.testing.assert_allclose([*np.array(rendered.colour)[:, i], np.array(rendered.T)[i]], [*L, T], atol=1e-6)


@pytest.mark.parametrize("colours", ["clamp", "sigmoid"])
def test_derivatives_are_those_of_the_twin(variant_rgb: str, colours: str) -> None:
    tree, (o, d) = random_octree(5, split=0.55, colours=colours), hard_rays()
    rays, by = bundle(o, d), ([0.3, -0.5, 0.9], 0.7)
    index, source = LeafIndex.find(tree), leaves_along(tree, d, slope=True)
    rendered = render_leaves(index, source, rays)
    dr.eval(rendered)
    vjp_leaves(index, source, rendered, RayGradient(mi.Color3f(*by[0]), mi.Float(by[1])))
    basis, values = basis_of(tree, d), [np.float64(v) for v in tree.values()]
    by_table, table = (np.array(t, np.float64).reshape(len(d), tree.leaves, 4) for t in (source.slope, source.table))
    shown = table[..., 1:]
    by_sums = by_table[..., 1:] * (shown > 0 if colours == "clamp" else shown * (1 - shown))
    slopes = by_table[..., 0].sum(axis=0), np.einsum("rb,rlc->lbc", basis, by_sums)
    rng = np.random.default_rng(5)
    for which in (0, 1):
        move = rng.normal(size=slopes[which].shape)
        ends = []
        for sign in (-1, 1):
            moved = [v + sign * 1e-6 * move if k == which else v for k, v in enumerate(values)]
            seen = [twin(tree, *moved, *ray) for ray in zip(o, d, basis, strict=True)]
            ends.append(sum(np.dot(by[0], L) + by[1] * T for L, T, _ in seen))
        terms = slopes[which] * move
        # Float32 terms err by 1e-6 of themselves; differences of steps 1e-6 err by 1e-10 / 1e-6.
        assert abs(terms.sum() - (ends[1] - ends[0]) / 2e-6) <= 2e-5 * np.sqrt(np.sum(terms**2)) + 2e-4


@pytest.mark.parametrize("colours", ["clamp", "sigmoid"])
def test_derivatives_through_the_table_of_a_pinhole(variant_rgb: str, colours: str) -> None:
    tree = random_octree(4, split=0.6, colours=colours)
    points = np.array([[0.2, -4.0, 0.3], [3.0, 1.0, 0.5]])
    rng = np.random.default_rng(6)
    slot = np.arange(24) % 2
    d = rng.uniform(-0.4, 0.4, (24, 3)) - points[slot]
    rays = bundle(np.float32(points[slot]), np.float32(d / np.linalg.norm(d, axis=1)[:, None]))
    index, places, view = LeafIndex.find(tree), LeafPlaces.find(tree), mi.UInt32(slot.astype(np.uint32))

    def loss(tree: Octree) -> float:
        rendered = render_leaves(index, make_leaf_colours(tree, places, points, view), rays)
        return float(np.array(rendered.colour, np.float64).sum() + 0.5 * np.array(rendered.T, np.float64).sum())

    source = make_leaf_colours(tree, places, points, view, slope=True)
    rendered = render_leaves(index, source, rays)
    dr.eval(rendered)
    vjp_leaves(index, source, rendered, RayGradient(mi.Color3f(1), mi.Float(0.5)))
    dr.eval(source.slope)
    density, harmonics = (np.array(v, np.float64) for v in vjp_leaf_colours(tree, places, source, points))
    moves = rng.normal(size=len(density)), rng.normal(size=len(harmonics))
    for move, slope, name in ((moves[0], density, "density"), (moves[1], harmonics, "harmonics")):
        step = 1e-3
        ends = []
        for sign in (-1.0, 1.0):
            values = {k: getattr(tree, k) for k in ("density", "harmonics")}
            values[name] = values[name] + mi.Float(np.float32(sign * step * move))
            ends.append(loss(tree.with_values(**values)))
        # Sums of 24 rays round to 24 * 6e-8; divided by the step this is 1.5e-3 a quarter of it typical; third order: 1e-6.
        assert abs(slope @ move - (ends[1] - ends[0]) / (2 * step)) <= 3e-3


def test_weights_are_the_largest_of_all_rays(variant_rgb: str) -> None:
    tree, (o, d) = random_octree(4, split=0.6), hard_rays()
    index, weight = LeafIndex.find(tree), dr.zeros(mi.Float, tree.leaves)
    raise_leaf_weights(index, leaves_along(tree, d), bundle(o, d), weight)
    density, sh = (np.float64(v) for v in tree.values())
    largest, basis = np.zeros(tree.leaves), basis_of(tree, d)
    for leaf in np.flatnonzero(np.array(weight) > 0.05)[:10]:
        white = np.zeros_like(sh)
        white[:, 0] = -0.5 / basis[0, 0]
        white[leaf, 0] += 1 / basis[0, 0]
        largest[leaf] = max(twin(tree, density, white, *ray)[0][0] for ray in zip(o, d, basis, strict=True))
        assert abs(float(np.array(weight)[leaf]) - largest[leaf]) < 2e-6


def test_codes_are_separated_and_interleaved() -> None:
    cells = np.random.default_rng(0).integers(0, 2**MAX_DEPTH, (50, 3))
    assert np.array_equal(separate(interleave(cells, MAX_DEPTH), MAX_DEPTH), cells)
    assert interleave(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0]]), 2).tolist() == [1, 2, 4, 8]


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"depth": 13}, "depth 13"),
        ({"codes": np.array([0, 4], np.uint64)}, "overlap"),
        ({"codes": np.array([1, 8], np.uint64)}, "overlap"),
        ({"codes": np.array([0, 512], np.uint64)}, "leave its cube"),
        ({"density": np.array([1, np.nan])}, "leaf 1"),
        ({"density": np.array([1, -2])}, "extinction of -2"),
        ({"sh": np.zeros((2, 2, 3))}, "2 harmonics"),
        ({"sizes": np.array([1, 1, 1], np.uint8)}, "3 sizes"),
        ({"sizes": np.array([4, 0], np.uint8)}, r"a leaf of size 2\^4"),
        ({"codes": np.zeros(0, np.uint64)}, "0 leaves"),
        ({"colours": "relu"}, "'relu'"),
    ],
)
def test_bad_leaves_are_refused_in_a_sentence(variant_rgb: str, changes: dict, words: str) -> None:
    sound = {
        "depth": 3, "to_world": PLACE, "codes": np.array([0, 8], np.uint64), "sizes": np.array([1, 0], np.uint8),
        "density": np.ones(2), "sh": np.zeros((2, 1, 3)),
    }  # fmt: skip
    Octree.from_rows(**sound)
    assert_refused(words, Octree.from_rows, **sound | changes)
