"""Radiance fields on disk: archives of mivol and of svox2, and refused files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from sampled_fields import CUBE

from mivol.cli import main
from mivol.experiments import field_conversion
from mivol.fields.field_files import read_field, read_grid, write_field
from mivol.fields.harmonics import harmonic_degree
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.nerf import NerfField, NerfSizes
from mivol.fields.sampled_field import Region
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import npy


def arrays(res=(3, 4, 5), basis=9):
    rng = np.random.default_rng(0)
    return rng.normal(size=res).astype(np.float32), rng.normal(size=(*res, basis, 3)).astype(np.float32)


@pytest.mark.parametrize("sparse", [False, True])
def test_what_was_saved_is_read(variant_rgb: str, tmp_path: Path, sparse: bool) -> None:
    density, sh = arrays()
    keep = density > 0 if sparse else None
    field = SphericalGrid.from_dense(density, sh, CUBE, keep, "softplus" if sparse else "relu", 0.25, not sparse)
    write_field(tmp_path / "f.npz", field)
    back = read_field(tmp_path / "f.npz")
    assert (back.res, back.degree, back.activation, back.offset, back.clamp) == (
        field.res, 2, field.activation, 0.25, not sparse,
    )  # fmt: skip
    assert np.array_equal(back.to_world, CUBE) and np.array_equal(back.stored_nodes(), field.stored_nodes())
    for a, b in zip(back.values(), field.values(), strict=True):
        np.testing.assert_allclose(a, b, rtol=2.0**-11, atol=1e-7)  # the rounding of half floats


def test_a_nested_field_is_read_as_it_was_saved(variant_rgb: str, tmp_path: Path) -> None:
    density, sh = arrays()
    outer = CUBE * 2
    outer[3, 3] = 1
    field = SphericalGrid.from_levels([SphericalGrid.from_dense(density, sh, place) for place in (CUBE, outer)])
    write_field(tmp_path / "f.npz", field, half=False)
    back = read_field(tmp_path / "f.npz")
    assert back.levels == 2 and np.array_equal(back.stored_nodes(), field.stored_nodes())
    assert all(np.array_equal(a, b) for a, b in zip(back.values(), field.values(), strict=True))
    assert_refused("2 nested levels", write_field, tmp_path / "f.svox2.npz", field)


def hash_grid() -> HashField:
    """A hash grid with a region, and values of order 1."""
    field = HashField.random(HashSizes(levels=3, log2_table=6, coarsest=2, finest=9, width=4), CUBE, 1, "linear")
    rng = np.random.default_rng(0)
    values = {name: mi.TensorXf(rng.normal(size=shape).astype(np.float32)) for name, shape in field.shapes().items()}
    occupied = mi.UInt8((rng.random(4 * 5 * 6) > 0.5).astype(np.uint8))
    return replace(field.with_parameters(values), region=Region((3, 4, 5), CUBE, occupied, 0.25), white=2.0)


def test_a_hash_grid_is_read_as_it_was_saved(variant_rgb: str, tmp_path: Path) -> None:
    field = hash_grid()
    write_field(tmp_path / "f.npz", field)
    back = read_field(tmp_path / "f.npz")
    assert isinstance(back, HashField) and (back.sizes, back.space, back.white) == (field.sizes, "linear", 2.0)
    assert (back.region.res, back.region.step) == ((3, 4, 5), 0.25)
    assert np.array_equal(np.array(back.region.occupied), np.array(field.region.occupied))
    for name, values in back.parameters().items():
        rounding = 2.0**-11 if name == "table" else 0  # half floats
        np.testing.assert_allclose(np.array(values), np.array(field.parameters()[name]), rtol=rounding, atol=1e-7)
    assert_refused("found a hash grid, expected an .npz", write_field, tmp_path / "f.ply", field)
    assert_refused("found a hash grid, expected a grid of harmonics", read_grid, tmp_path / "f.npz")


def test_a_hash_grid_becomes_a_grid(
    variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By both verbs, which print the loss; the grid keeps the space of the colours."""
    monkeypatch.setattr(field_conversion, "GRID_NODES", 6)
    monkeypatch.setattr(field_conversion, "EDGE", 16)
    write_field(tmp_path / "f.npz", hash_grid())
    assert main(["convert", str(tmp_path / "f.npz"), str(tmp_path / "grid.npz"), "--to", "grid", "--resolution", "8"]) == 0
    assert main(["export", str(tmp_path / "f.npz"), str(tmp_path / "f.vol")]) == 0
    said = capsys.readouterr().out
    assert "8 x 8 x 8 nodes" in said and "6 x 6 x 6 nodes" in said
    assert "dB between views of grid.npz and f.npz" in said and "dB between views of the grid and of the hash grid" in said
    assert read_grid(tmp_path / "grid.npz").space == "linear" and (tmp_path / "f-colour.vol").is_file()
    assert main(["convert", str(tmp_path / "grid.npz"), str(tmp_path / "again.npz"), "--to", "grid"]) == 1
    assert "is a grid of one box already" in capsys.readouterr().err


def nerf() -> NerfField:
    """A NeRF in another frame than that of its box, with a region of four cells in five."""
    sizes = NerfSizes(depth=2, width=6, skip=1, place=2, direction=1, branch=5, relu=1)
    field = replace(NerfField.random(sizes, CUBE, 1, "linear"), white=2.0, frame=(0.5, 0.0, 0.0, 2.0))
    occupied = mi.UInt8((np.arange(4 * 5 * 6) % 5 > 0).astype(np.uint8))
    return replace(field, region=Region((3, 4, 5), CUBE, occupied, 0.25))


def test_a_nerf_is_read_as_it_was_saved(
    variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit; it becomes a grid, and explain names its kind."""
    monkeypatch.setattr(field_conversion, "EDGE", 16)
    field = nerf()
    write_field(tmp_path / "f.npz", field)
    back = read_field(tmp_path / "f.npz")
    assert isinstance(back, NerfField) and (back.sizes, back.space, back.white) == (field.sizes, "linear", 2.0)
    assert back.frame == (0.5, 0.0, 0.0, 2.0) and np.array_equal(np.array(back.weights), np.array(field.weights))
    assert np.array_equal(np.array(back.region.occupied), np.array(field.region.occupied))
    assert_refused("found a NeRF, expected an .npz", write_field, tmp_path / "f.ply", field)
    assert main(["convert", str(tmp_path / "f.npz"), str(tmp_path / "grid.npz"), "--to", "grid", "--resolution", "6"]) == 0
    assert "dB between views of grid.npz and f.npz" in capsys.readouterr().out
    assert main(["explain", str(tmp_path / "f.npz")]) == 0
    said = capsys.readouterr().out
    assert "NeRF        a network of 2 layers x 6" in said and "box         (-1, -1, -1) to (1, 1, 1) [length]" in said
    assert "occupied    96 of 120 cells (80.0%)" in said and "samples     at most 0.25 [length] apart" in said
    occupied = np.array(field.region.occupied) > 0
    middles = mi.Point3f(np.ascontiguousarray(field.region.middles(np.arange(len(occupied))).T, np.float32))
    assert np.array_equal(np.array(field.region.holds(middles)), occupied)
    # The first cells are half as long as the others: 0.1, 1/8 and 1/6 of the box with 5, 4 and 3 nodes.
    assert field.region.middles(np.array([0, 1])) == pytest.approx(np.array([[-0.9, -7 / 8, -5 / 6], [-0.6, -7 / 8, -5 / 6]]))
    density = np.array(field.density(middles))[occupied]
    assert f"extinction  {density.min():.4g} to {density.max():.4g} [1/length]" in said


HOSTILE_NERFS = {
    "other layers": ({"weights": np.zeros(9, np.float32)}, "weights has 9 numbers, expected 375 by the sizes of this NeRF"),
    "weights of nothing": ({"weights": np.full(375, np.nan, np.float32)}, "weights with values that are not finite"),
    "no unit": ({"frame": np.array([0, 0, 0, 0.0])}, "expected finite numbers and a unit above 0"),
    "one round of two": ({"sizes": np.array([2, 6, 1, 2, 1, 5, 1, -1, 8, 0])}, "8 coarse and 0 fine samples, expected both"),
    "a skip behind the trunk": ({"sizes": np.array([2, 6, 2, 2, 1, 5, 1, -1, 0, 0])}, "skip = 2, expected less than its 2"),
}


HOSTILE_HASH_GRIDS = {
    "another kind": ({"kind": np.array("hsah")}, 'a field of the kind "hsah"; the kind "hash" or "nerf" is expected'),
    "weights of nothing": (
        {"colour_weights": np.full(84, np.nan, np.float32)},
        "colour_weights with values that are not finite",
    ),
    "another table": ({"table": np.zeros((5, 2), np.float32)}, "table has 10 numbers, expected 155 x 2"),
    "other layers": ({"density_weights": np.zeros(9, np.float32)}, "density_weights has 9 numbers, expected 88"),
    "levels without end": ({"sizes": np.array([2**31, 2, 6, 2, 9, 4, 1, 1, 16, 2])}, "levels = 2147483648, expected 1 to 32"),
    "other cells": ({"res": np.array([3, 4, 6])}, "15,.* bytes of occupied cells at steps of 0.25 for 140 cells"),
    "no step": ({"step": np.array(0.0)}, "at steps of 0 for 120 cells"),
}


def test_values_that_half_floats_cannot_hold_stay(variant_rgb: str, tmp_path: Path) -> None:
    density, sh = arrays()
    density[0, 0, 0] = 1e6
    write_field(tmp_path / "f.npz", SphericalGrid.from_dense(density, sh, CUBE))
    assert np.array_equal(read_field(tmp_path / "f.npz").values()[0], density.reshape(-1))


def test_densities_of_large_scenes_keep_their_digits(variant_rgb: str, tmp_path: Path) -> None:
    """Extinctions scale as 1 / length: in a box of 1e9 units half floats would round them to 0."""
    density, sh = arrays()
    for small in (1e-4, 1e-9):
        write_field(tmp_path / "f.npz", SphericalGrid.from_dense(density * small, sh, CUBE))
        found, _ = read_field(tmp_path / "f.npz").values()
        np.testing.assert_allclose(found, small * density.reshape(-1), rtol=1e-6, atol=small * 2**-12)


def test_a_checkpoint_of_svox2(variant_rgb: str, tmp_path: Path) -> None:
    """Axes X Y Z, rows in any order, harmonics by channel, a box by centre and radius."""
    rng = np.random.default_rng(1)
    links = -rng.integers(1, 4, (4, 3, 2)).astype(np.int32)
    links[1, 2, 0], links[3, 0, 1] = 1, 0
    sh = np.zeros((2, 3, 4), np.float16)
    sh[1, 0, 0], sh[0, 1, 3] = 1.0, -2.0
    np.savez(
        tmp_path / "ckpt.npz",
        links=links,
        density_data=np.float32([[7.0], [5.0]]),
        sh_data=sh.reshape(2, 12),
        radius=np.float32([1.0, 0.5, 0.25]),
        center=np.float32([0, 1, 2]),
        basis_type=1,
    )
    field = read_field(tmp_path / "ckpt.npz")
    assert field.res == (2, 3, 4) and field.degree == 1 and field.rows == 3
    # Nodes (x, y, z) = (1, 2, 0) and (3, 0, 1): centres of voxels of the box -1..1, 0.5..1.5, 1.75..2.25.
    p = mi.Point3f([-0.25, 0.75], [1 + 1 / 3, 1 - 1 / 3], [1.875, 2.125])
    d = mi.Vector3f([0.0, 1.0], [0.0, 0.0], [1.0, 0.0])
    sigma, colour = field.eval(p, d)
    np.testing.assert_allclose(sigma, [5, 7], rtol=1e-5)
    np.testing.assert_allclose(np.array(colour)[0], [0.5 + 0.28209479, 0.5], rtol=1e-5)
    np.testing.assert_allclose(np.array(colour)[1], [0.5, 0.5 + 2 * 0.48860251], rtol=1e-5)


def test_files_that_are_refused(variant_rgb: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "checkpoint.npz", **{"about": np.array("{}"), "reals/table": np.zeros(3)})
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 and no more")
    (tmp_path / "smoke.vol").write_bytes(b"VOL\x03")
    said_of = {
        "none.npz": "found no file",
        "checkpoint.npz": "found the checkpoint of a fit, expected a radiance field; give field.npz",
        "other.npz": "holds a;",
        "torn.npz": "a damaged archive",
        "smoke.vol": "a file .vol, exp",
    }
    for name, said in said_of.items():
        assert_refused(said, read_field, tmp_path / name)
    assert_refused("found the suffix '.grid'", write_field, tmp_path / "f.grid", SphericalGrid.from_dense(*arrays(), CUBE))


HOSTILE_FIELDS = {
    "nodes below 0": ({"nodes": np.array([-200000000])}, "out of order or beyond"),
    "nodes beyond the grid": ({"nodes": np.array([60])}, "out of order or beyond"),
    "nodes of another type": ({"nodes": np.array([0.5])}, "nodes of type float64"),
    "a grid that wraps": ({"res": np.array([2048, 2048, 2048])}, "2048 x 2048 x 2048 nodes"),
    "a grid that takes too much": ({"res": np.array([1625, 1625, 1625])}, "GiB"),
    "a negative grid": ({"res": np.array([-3, -4, 5])}, "-3 x -4 x 5 nodes"),
    "a flat grid": ({"res": np.array([3, 4])}, r"res of type int64 and shape \(2,\)"),
    "an offset of nothing": ({"offset": np.array(np.nan)}, "offset with values that are not finite"),
    "a place of nothing": ({"to_world": np.full((4, 4), np.inf)}, "to_world with values that are not finite"),
    "a clamp of text": ({"clamp": np.array("yes")}, "clamp of type"),
}


def one_node() -> SphericalGrid:
    """One stored node of 3 x 4 x 5."""
    keep = np.zeros((3, 4, 5), bool)
    keep[0, 0, 0] = True
    return SphericalGrid.from_dense(*arrays(), CUBE, keep)


HOSTILE = [
    pytest.param(make, *case, id=f"{make.__name__}: {name}")
    for make, cases in ((nerf, HOSTILE_NERFS), (hash_grid, HOSTILE_HASH_GRIDS), (one_node, HOSTILE_FIELDS))
    for name, case in cases.items()
]


@pytest.mark.parametrize(("make", "change", "said"), HOSTILE)
def test_hostile_fields_are_refused(
    variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable, change: dict, said: str
) -> None:
    """One wrong array in a field ends in a message; some of them once ended the process."""
    write_field(tmp_path / "f.npz", make())
    with np.load(tmp_path / "f.npz") as stored:
        held = dict(stored)
    np.savez(tmp_path / "f.npz", **held | change)
    monkeypatch.setattr(npy, "available_memory", lambda: 2**33)
    assert_refused(said, read_field, tmp_path / "f.npz")


HOSTILE_CHECKPOINTS = {
    "another basis": ({"basis_type": np.array(4)}, "basis type"),
    "a background": ({"background_data": np.zeros((1, 4))}, "background"),
    "no radius": ({"radius": None}, "radius"),
    "harmonics of another number": ({"sh_data": np.zeros((1, 11), np.float16)}, "do not fit"),
    "links of another type": ({"links": np.zeros((1, 1, 1))}, "links of type float64"),
    "links of one axis": ({"links": np.zeros(3, np.int32)}, r"links of the shape \(3,\)"),
    "no links": ({"links": np.zeros((0, 1, 1), np.int32)}, r"shape \(0, 1, 1\)"),
    "a box of no size": ({"radius": np.zeros(3)}, "numbers above 0"),
    "a box of two numbers": ({"radius": np.ones(2)}, "one or three finite"),
    "a box nowhere": ({"center": np.full(3, np.nan)}, "one or three finite"),
    "harmonics that are none": ({"sh_data": np.full((1, 12), np.nan)}, "not finite"),
    "two bases": ({"basis_type": np.ones(2, int)}, r"basis_type of the shape \(2,\)"),
}


@pytest.mark.parametrize("case", HOSTILE_CHECKPOINTS)
def test_hostile_checkpoints_are_refused(variant_rgb: str, tmp_path: Path, case: str) -> None:
    change, said = HOSTILE_CHECKPOINTS[case]
    good = {"links": np.zeros((1, 1, 1), np.int32), "density_data": np.ones((1, 1)), "sh_data": np.zeros((1, 12))}
    arrays = good | {"radius": np.ones(3), "center": np.zeros(3)} | change
    np.savez(tmp_path / "c.npz", **{name: array for name, array in arrays.items() if array is not None})
    assert_refused(said, read_field, tmp_path / "c.npz")


def test_fields_that_are_refused(variant_rgb: str) -> None:
    density, sh = arrays()
    bad = density.copy()
    bad[1, 0, 0] = np.nan
    for change, said in (
        ({"density": bad}, "node 20"),
        ({"sh": sh[..., :5, :]}, "5 harmonics"),
        ({"sh": sh[:2]}, "are expected"),
        ({"activation": "none"}, "none may be negative"),
        ({"activation": "sigmoid"}, "'sigmoid'"),
        ({"to_world": np.zeros((4, 4))}, "to_world"),
    ):
        assert_refused(said, SphericalGrid.from_dense, **({"density": density, "sh": sh, "to_world": CUBE} | change))
    assert [harmonic_degree(n) for n in (1, 4, 9, 16, 25)] == [0, 1, 2, 3, 4]


def test_degrees_and_sparse_copies(variant_rgb: str) -> None:
    density, sh = arrays(basis=4)
    field = SphericalGrid.from_dense(density, sh, CUBE)
    up = field.with_degree(2).values()[1]
    assert np.array_equal(up[:, :4], sh.reshape(-1, 4, 3)) and (up[:, 4:] == 0).all()
    assert np.array_equal(field.with_degree(0).values()[1], sh.reshape(-1, 4, 3)[:, :1])
    sparse = field.select_nodes(density > 0)
    back = sparse.to_dense()
    assert np.array_equal(back[0], np.where(density > 0, density, 0))
    assert np.array_equal(sparse.select_nodes(density > 1).stored_nodes(), np.flatnonzero(density > 1))
