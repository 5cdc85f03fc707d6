"""What a fit of photographs leaves in its folder, piece by piece."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from mivol.experiments import field_fit, photo_fit, sampled_fit
from mivol.fields.field_files import write_field
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.nerf import NerfField, NerfSizes
from mivol.fields.sampled_field import Region
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_volume
from mivol.optim.photographs.field_view import FieldView
from mivol.photos import Camera, intrinsics
from mivol.validate.metrics import ImageScore

RES = (3, 4, 5)
EDGES = (2.0, 1.0, 0.5)


def field(keep: np.ndarray | None = None) -> SphericalGrid:
    """Densities of 1 to 60, colours of degree 1."""
    sigma = 1 + np.arange(60.0).reshape(RES)
    return SphericalGrid.from_dense(sigma, np.zeros((*RES, 4, 3)), np.diag([*EDGES, 1.0]), keep)


@pytest.mark.parametrize(("model", "sizes"), [(HashField, HashSizes()), (NerfField, NerfSizes())])
def test_the_table_of_a_sampled_field(model, sizes):
    occupied = Region((1, 1, 1), np.eye(4), mi.UInt8([1, 1, 0, 0, 0, 0, 0, 0]), 0.1)
    sampled = replace(model.random(sizes, np.eye(4)), region=occupied)
    noun = {"hash": "Hash grid", "nerf": "NeRF"}[sampled.kind]
    table = sampled_fit.tabulate_field(sampled, 3 << 19)
    assert table.title == f"{noun}: {sampled.numbers} numbers, file 1.50 MiB, 25.0% of the cells occupied"
    assert (table.head, table.rows) == sampled.tabulate()


def camera(width: int = 4, height: int = 2) -> Camera:
    return Camera(intrinsics(width, height, width, height), (width, height), np.eye(4))


@pytest.mark.parametrize("kept", [60, 10])
def test_what_a_field_takes(tmp_path, kept):
    """60 nodes of a box: 4 and 16 bytes each; 4 (1 + 4 x 3) with harmonics of degree 1 in rows of 12."""
    sparse = field(None if kept == 60 else np.arange(60).reshape(RES) < kept)
    write_field(tmp_path / "field.npz", sparse)
    table = field_fit.tabulate_storage(sparse, tmp_path / "field.npz")
    assert table.head[0] == f"{kept} of 60 nodes are kept ({kept / 60:.1%})"
    rows = {name: each for name, _, each in table.rows}
    assert rows["every node: r, g, b and density of 8 bits"] == "4" and rows["every node: four numbers"] == "16"
    assert rows["every node: harmonics of degree 1"] == "52"
    assert rows["this field, in memory"] == f"{sparse.bytes / 60:.3g}"
    assert rows["this field, its file"] == f"{(tmp_path / 'field.npz').stat().st_size / 60:.3g}"
    # Two digits of a MiB say nothing of so few bytes; of a thousand times as many they do.
    big = SimpleNamespace(node_count=256**3, stored_nodes=lambda: range(2**20), degree=0, width=4, bytes=3 * 2**20)
    sizes = {name: size for name, size, _ in field_fit.tabulate_storage(big, tmp_path / "field.npz").rows}
    assert sizes["every node: four numbers"] == "256.00 MiB" and sizes["this field, in memory"] == "3.00 MiB"


def test_densities_are_written_for_other_programs(tmp_path):
    (tmp_path / "volumes").mkdir()
    found = field_fit.write_density(tmp_path, field(), 0)
    assert (found.path, found.role, found.size) == ("volumes/density.npz", "reconstruction", EDGES)
    for name in ("density.vol", "density.npz"):
        np.testing.assert_allclose(read_volume(tmp_path / "volumes" / name).values.ravel(), 1 + np.arange(60), rtol=1e-6)
    outer = field_fit.write_density(tmp_path, field(), 2)
    # A page puts together what has one caption: levels are volumes of their own.
    assert (outer.path, outer.caption) == ("volumes/density-level-2.npz", "level 2, of 4 times the extent")


def test_distance_and_normals_are_pictures(tmp_path):
    (tmp_path / "views").mkdir()
    seen = FieldView(np.zeros((2, 4, 3)), np.ones((2, 4)), np.full((2, 4), 1.5))
    found = field_fit.write_geometry(tmp_path, seen, camera(), (1.0, 2.0))
    assert [(i.path, i.role) for i in found] == [("views/distance.png", "picture"), ("views/normals.png", "picture")]
    assert [i.caption for i in found] == [
        "distance of the first judged view: from light, 1 [length], to dark, 2 [length]",
        "normals of the first judged view: x, y, z from -1 to 1 as red, green, blue",
    ]
    for image in found:
        assert np.array(Image.open(tmp_path / image.path)).shape == (2, 4, 3)


def test_judged_views_are_told_apart_the_worst_first():
    found = [ImageScore("a.jpg", {"psnr": 23.456, "ssim": 0.71234}), ImageScore("b.jpg", {"psnr": 9.0, "ssim": 0.5})]
    table = photo_fit.tabulate_views(camera(135, 240), found, [24.0, 12.345])
    assert table.title == "Judged views, at 135 x 240 pixels, the worst first"
    assert table.rows == (("b.jpg", "9.00", "0.5000", "12.35"), ("a.jpg", "23.46", "0.7123", "24.00"))
    assert table.head[3] == "PSNR [dB], colours fitted to the photograph's"
    bare = photo_fit.tabulate_views(camera(135, 240), found)
    assert bare.head == table.head[:3] and bare.rows == tuple(row[:3] for row in table.rows)


def test_metrics_have_the_names_of_the_record():
    assert photo_fit.rename_metrics({"psnr": 30.0, "ssim": 0.9}) == {"held_out_psnr": 30.0, "ssim": 0.9}


def test_behind_a_field_is_its_sky_or_the_photographs_own_background():
    photo, sky = SimpleNamespace(background="white"), object()
    assert field_fit.find_background(SimpleNamespace(sky=None), photo) == "white"
    assert field_fit.find_background(SimpleNamespace(sky=sky), photo) is sky
