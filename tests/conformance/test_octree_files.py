"""Octrees on disk: archives of mivol, files of svox made by hand, conversions and refused files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from octrees import PLACE, random_octree
from refusals import assert_refused

from mivol import machine
from mivol.errors import MivolError
from mivol.fields import field_files, octree_files
from mivol.fields.field_files import read_field, read_grid, write_field
from mivol.fields.octree import Octree, edges_of
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import npy


def test_what_was_saved_is_read(variant_rgb: str, tmp_path: Path) -> None:
    tree = random_octree(6, degree=2, colours="sigmoid")
    write_field(tmp_path / "t.npz", tree, half=False)
    back = read_field(tmp_path / "t.npz")
    assert (back.depth, back.degree, back.colours, back.offset, back.space) == (6, 2, "sigmoid", 0.5, "srgb")
    assert np.array_equal(back.codes, tree.codes) and np.array_equal(back.sizes, tree.sizes)
    assert all(np.array_equal(a, b) for a, b in zip(back.values(), tree.values(), strict=True))


def test_rounded_values_err_by_what_the_page_says(variant_rgb: str, tmp_path: Path) -> None:
    tree = random_octree(6, degree=2)
    write_field(tmp_path / "t.npz", tree)
    back = read_field(tmp_path / "t.npz")
    (density, sh), (old, old_sh) = back.values(), tree.values()
    edges = tree.cell * edges_of(tree.sizes)
    assert np.abs(np.exp(-density * edges) - np.exp(-old * edges)).max() <= 0.011
    assert np.abs(sh[:, 0] - old_sh[:, 0]).max() <= 1 / 64 + 1e-6 and np.abs(sh - old_sh).max() <= 1 / 32 + 1e-6


def test_a_single_leaf_is_a_tree(variant_rgb: str, tmp_path: Path) -> None:
    leaf = Octree.from_rows(3, PLACE, np.zeros(1, np.uint64), np.array([3], np.uint8), np.ones(1), np.zeros((1, 1, 3)))
    write_field(tmp_path / "t.npz", leaf)
    back = read_field(tmp_path / "t.npz")
    assert back.leaves == 1 and back.sizes.tolist() == [3]


def svox_arrays() -> dict[str, np.ndarray]:
    """A root whose child at x = 1, y = 0, z = 0 is divided, as svox stores it; two leaves have a density."""
    child = np.zeros((2, 2, 2, 2), np.int32)
    child[0, 1, 0, 0] = 1
    data = np.zeros((2, 2, 2, 2, 13), np.float16)
    data[0, 0, 1, 1, :12], data[0, 0, 1, 1, 12] = np.arange(12) / 16, 2
    data[1, 0, 0, 1, :12], data[1, 0, 0, 1, 12] = -np.arange(12) / 16, 5
    data[1, 1, 1, 1, 12] = -3
    return {
        "child": child, "data": data, "data_dim": np.array(13), "data_format": np.array("SH4"),
        "invradius3": np.array([0.5, 0.25, 0.5], np.float32), "offset": np.array([0.5, 0.5, 0.25], np.float32),
    }  # fmt: skip


def test_a_file_of_svox_is_read(variant_rgb: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", **svox_arrays())
    tree = read_field(tmp_path / "t.npz")
    assert (tree.depth, tree.leaves, tree.degree, tree.colours, tree.offset) == (2, 2, 1, "sigmoid", 0.0)
    # place = offset + invradius p
    np.testing.assert_allclose(tree.to_world, [[2, 0, 0, -1], [0, 4, 0, -2], [0, 0, 2, -0.5], [0, 0, 0, 1]])
    density, sh = tree.values()
    corner = {tuple(c): (s, d, k) for c, s, d, k in zip(tree.corners().tolist(), tree.sizes, density, sh, strict=True)}
    assert corner.keys() == {(0, 2, 2), (2, 0, 1)}
    size, sigma, k = corner[0, 2, 2]
    assert (size, sigma) == (1, 2) and np.array_equal(k, (np.arange(12) / 16).reshape(3, 4).T)
    assert corner[2, 0, 1][:2] == (0, 5)


def test_quantised_colours_of_svox_are_read(variant_rgb: str, tmp_path: Path) -> None:
    plain = svox_arrays()
    np.savez(tmp_path / "plain.npz", **plain)
    arrays = {k: v for k, v in plain.items() if k != "data"}
    colours, places = np.zeros((4, 16, 3), np.float16), np.zeros((4, 2, 2, 2, 2), np.uint16)
    rows = plain["data"][..., :12].reshape(16, 3, 4)
    for b in range(4):
        colours[b] = rows[::-1, :, b]
        places[b] = np.arange(16)[::-1].reshape(2, 2, 2, 2)
    arrays |= {"quant_colors": colours, "quant_map": places, "sigma": plain["data"][..., 12]}
    np.savez(tmp_path / "quantised.npz", **arrays)
    a, b = (read_field(tmp_path / name) for name in ("plain.npz", "quantised.npz"))
    assert np.array_equal(a.codes, b.codes) and all(np.array_equal(x, y) for x, y in zip(a.values(), b.values(), strict=True))


def test_an_octree_goes_to_svox_and_back(variant_rgb: str, tmp_path: Path) -> None:
    tree = random_octree(5, colours="sigmoid")
    density, sh = tree.values()
    tree = Octree.from_rows(5, PLACE, tree.codes, tree.sizes, density, sh, "sigmoid", 0.0)
    write_field(tmp_path / "t.svox.npz", tree)
    back = read_field(tmp_path / "t.svox.npz")
    shift = back.depth - 5
    assert np.array_equal(back.codes, tree.codes << np.uint64(max(3 * shift, 0))) and back.colours == "sigmoid"
    np.testing.assert_allclose(back.to_world, PLACE, atol=1e-6)
    for a, b in zip(back.values(), tree.values(), strict=True):
        np.testing.assert_allclose(a, b, rtol=2.0**-11, atol=1e-7)


def test_colours_of_a_sigmoid_become_clamped_ones(variant_rgb: str) -> None:
    tree = random_octree(3, degree=0)
    there = tree.with_colours("sigmoid")
    back = there.with_colours("clamp")
    # A constant colour is fitted exactly, within the range that a sigmoid shows.
    constant = 0.28209479
    old, new = (np.maximum(0.5 + constant * t.values()[1][:, 0], 0) for t in (tree, back))
    np.testing.assert_allclose(new, np.clip(old, 1 / 512, 511 / 512), atol=1e-5)
    # A grid has no sigmoid, and takes the clamped colours.
    found, expected = there.to_grid(), back.to_grid()
    assert found.offset == expected.offset
    np.testing.assert_array_equal(found.values()[1], expected.values()[1])


def test_a_grid_of_an_octree_has_its_values_at_the_middles(variant_rgb: str, tmp_path: Path) -> None:
    tree = random_octree(4)
    grid = tree.to_grid()
    smallest = int(tree.sizes.min())
    assert grid.rows - 1 == int((8 ** (tree.sizes.astype(int) - smallest)).sum())
    nodes, (z, y, x) = grid.stored_nodes(), grid.res
    middles = np.stack([nodes % x, nodes // x % y, nodes // (x * y)], axis=1) + 0.5
    places = middles / [x, y, z] @ np.diag(np.diagonal(grid.to_world)[:3]) + grid.to_world[:3, 3]
    cell = np.floor((places - PLACE[:3, 3]) / np.diagonal(PLACE)[:3] * 2**tree.depth).astype(int)
    density, corners, edges = tree.values()[0], tree.corners(), edges_of(tree.sizes)
    for row in range(0, len(nodes), 37):
        owner = ((cell[row] >= corners) & (cell[row] < corners + edges[:, None])).all(axis=1)
        assert owner.sum() == 1 and grid.values()[0][row] == density[owner][0]
    write_field(tmp_path / "t.npz", tree)
    assert_refused("found an octree", read_grid, tmp_path / "t.npz")


def test_other_formats_take_the_grid(variant_rgb: str, tmp_path: Path) -> None:
    write_field(tmp_path / "t.svox2.npz", random_octree(4))
    assert isinstance(read_field(tmp_path / "t.svox2.npz"), SphericalGrid)
    with pytest.raises(MivolError, match="an octree, convert it first|expected an octree"):
        write_field(tmp_path / "g.svox.npz", random_octree(4).to_grid())
    assert ".svox.npz" in field_files.FIELD_FORMATS


def cyclic() -> dict[str, np.ndarray]:
    arrays = svox_arrays()
    arrays["child"][1, 0, 0, 0] = -1
    return arrays


def two_parents() -> dict[str, np.ndarray]:
    arrays = svox_arrays()
    arrays["child"][0, 0, 0, 0] = 1
    return arrays


def deep() -> dict[str, np.ndarray]:
    child = np.zeros((13, 2, 2, 2), np.int32)
    child[:12, 0, 0, 0] = 1
    return svox_arrays() | {"child": child, "data": np.ones((13, 2, 2, 2, 13), np.float16)}


def changed(**arrays: np.ndarray) -> dict[str, np.ndarray]:
    return svox_arrays() | arrays


@pytest.mark.parametrize(
    "arrays, words",
    [
        (cyclic, "cycle"),
        (two_parents, "two parents"),
        (deep, "depth above 12"),
        (lambda: changed(child=np.full((2, 2, 2, 2), 7, np.int32)), "names node 7 as a child; nodes 0 to 1 are expected"),
        (lambda: changed(child=np.zeros((2, 3, 3, 3), np.int32)), r"\(nodes, 2, 2, 2\)"),
        (lambda: changed(data=np.full((2, 2, 2, 2, 13), np.nan, np.float16)), "not finite"),
        (lambda: changed(data=np.zeros((2, 2, 2, 2, 12), np.float16)), "3 basis"),
        (lambda: changed(data=np.zeros((2, 2, 2, 2, 13), np.float16)), "no leaf"),
        (lambda: changed(data_format=np.array("SG25")), "SG25"),
        (lambda: changed(data_format=np.array("SH9")), "holds 4 harmonics; 9 are expected"),
        (lambda: changed(invradius3=np.zeros(3)), "above 0"),
        (lambda: changed(quant_colors=np.zeros((4, 8, 3), np.float16)), "lacks quant_map, sigma"),
        (
            lambda: changed(
                quant_colors=np.zeros((4, 8, 3), np.float16), quant_map=np.full((4, 2, 2, 2, 2), 9, np.uint16),
                sigma=np.ones((2, 2, 2, 2), np.float16),
            ),
            "colour 9 of quant_colors; 0 to 7 are expected",
        ),
    ],
)  # fmt: skip
def test_bad_files_of_svox_are_refused_in_a_sentence(variant_rgb: str, tmp_path: Path, arrays, words: str) -> None:
    np.savez(tmp_path / "t.npz", **arrays())
    assert_refused(words, read_field, tmp_path / "t.npz")


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda a: a.update(depth=np.array(13)), "depth 13"),
        (lambda a: a.update(tree=a["tree"][:-1]), "for 391 leaves"),
        (lambda a: a.update(tree=np.concatenate([a["tree"], np.zeros((1, 2), np.uint8)])), "ends at its leaves by depth 4"),
        (lambda a: a["tree"].__setitem__((0, 0), 255), "ends at its leaves by depth 4 is expected"),
        (lambda a: a["tree"].__setitem__((0, 0), 0), "ends at its leaves by depth 4 is expected"),
        (lambda a: a.update(tree=a["tree"][:, :1]), r"shape \(96, 1\); \(nodes, 2\) is expected"),
        (lambda a: a.update(density=a["density"][:-1]), "holds densities"),
        (lambda a: a.update(step=np.array([np.nan, 1])), "not finite"),
        (lambda a: a.pop("constant"), "lacks constant"),
        (lambda a: a.update(colours=np.array("relu")), "relu"),
    ],
)
def test_bad_files_of_mivol_are_refused_in_a_sentence(variant_rgb: str, tmp_path: Path, change, words: str) -> None:
    write_field(tmp_path / "t.npz", random_octree(4))
    with np.load(tmp_path / "t.npz") as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(tmp_path / "bad.npz", **arrays)
    assert_refused(words, read_field, tmp_path / "bad.npz")


def test_leaves_beyond_the_memory_are_refused_before_they_are_made(
    variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few bytes can describe millions of leaves; a large leaf beside a tiny one needs as many nodes in a grid."""
    levels = [np.zeros((8**level, 2), np.uint8) for level in range(7)]
    for level, bits in enumerate(levels):
        bits[:, int(level == 6)] = 255
    write_field(tmp_path / "t.npz", random_octree(4))
    with np.load(tmp_path / "t.npz") as archive:
        arrays = dict(archive)
    monkeypatch.setattr(octree_files, "_leaves_of", lambda *arguments: pytest.fail("leaves were made"))
    with pytest.raises(MivolError, match=r"holds densities \(395,\) .* for 2097152 leaves; \(2097152,\)"):
        octree_files.parse_octree("t.npz", arrays | {"depth": np.array(7), "tree": np.concatenate(levels)})
    monkeypatch.setattr(npy, "available_memory", lambda: 40_000)
    assert_refused("found arrays of .* GiB, expected at most the free memory", octree_files.parse_octree, "t.npz", arrays)
    monkeypatch.setattr(machine, "available_memory", lambda: 10 * 2**30)
    codes, sizes = np.arange(7, dtype=np.uint64) * 8**8, np.array([8] * 6 + [0], np.uint8)
    tree = Octree.from_rows(12, np.eye(4), codes, sizes, np.ones(7), np.zeros((7, 9, 3)))
    assert_refused("a grid of an octree of 100663297 cells needs .* GiB .*: keep it as an octree", tree.to_grid)
