"""``mivol convert --to octree`` and back, ``mivol explain`` and ``mivol render`` of an octree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mivol.cli import main
from mivol.fields.field_files import read_field, write_field
from mivol.fields.octree import Octree
from mivol.fields.spherical_grid import SphericalGrid
from mivol.photos.camera_path import HomeView


@pytest.fixture
def field(variant_rgb: str, tmp_path: Path) -> Path:
    """A ball of radius 0.6, opaque to a voxel, with smooth colours."""
    n = 16
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n * 2 - 1] * 3, indexing="ij")
    density = 200 * (0.6 - np.sqrt(x * x + y * y + z * z))
    sh = np.zeros((n, n, n, 4, 3))
    sh[..., 0, :] = np.stack([x, y, z], axis=-1)
    sh[..., 2, 0] = 0.2
    place = np.diag([2.0, 2, 2, 1])
    place[:3, 3] = -1
    view = HomeView((0.0, 0.0, 1.0), (0.0, -4.0, 0.5), (0.0, 0.0, 0.0), 40.0, (32, 24))
    write_field(tmp_path / "field.npz", SphericalGrid.from_dense(density, sh, place), view=view)
    return tmp_path / "field.npz"


def test_a_field_becomes_an_octree_and_a_grid_again(field: Path, capsys: pytest.CaptureFixture) -> None:
    tree, grid, image = (field.with_name(name) for name in ("tree.npz", "grid.npz", "view.exr"))
    assert main(["convert", str(field), str(tree), "--to", "octree"]) == 0
    said = capsys.readouterr().out
    octree = read_field(tree)
    assert isinstance(octree, Octree) and octree.depth == 5 and f"{octree.leaves} leaves in 32 cells" in said
    # Half voxels of an opaque ball, one pixel or less in the compared views: better than a difference of 5 %.
    assert float(said.split(" dB")[0].split()[-1]) > 26 and f"{tree.stat().st_size} bytes" in said
    assert main(["explain", str(tree)]) == 0
    assert "octree" in (said := capsys.readouterr().out) and "extinction" in said
    assert main(["render", str(tree), "-o", str(image)]) == 0 and image.is_file()
    assert main(["convert", str(tree), str(grid), "--to", "grid"]) == 0
    assert isinstance(read_field(grid), SphericalGrid)
    svox = field.with_name("tree.svox.npz")
    assert main(["convert", str(tree), str(svox)]) == 0  # the suffix says what it becomes
    assert read_field(svox).colours == "sigmoid" and read_field(svox).leaves == octree.leaves


@pytest.mark.slow
def test_leaves_as_large_as_asked_for(field: Path, capsys: pytest.CaptureFixture) -> None:
    tree = field.with_name("tree.npz")
    for resolution, depth in (("8", 3), ("64", 6)):
        assert main(["convert", str(field), str(tree), "--to", "octree", "--resolution", resolution]) == 0
        assert read_field(tree).depth == depth
    assert "dB" in capsys.readouterr().out


@pytest.mark.parametrize(
    "target, options, words",
    [
        ("tree.npz", [], "--to says what a field becomes: octree"),
        ("tree.ply", ["--to", "octree"], "--to octree makes an .npz: give"),
        ("tree.npz", ["--to", "octree", "--resolution", "8192"], "8192 is no number of leaves along an edge: give 1 to 4096"),
        ("tree.npz", ["--to", "grid"], "is a grid of one box already"),
        ("tree.npz", ["--to", "octree", "--box", "0", "0", "0", "1", "1", "1"], "--box"),
    ],
)
def test_conversions_without_a_meaning_are_refused(
    field: Path, capsys: pytest.CaptureFixture, target: str, options: list[str], words: str
) -> None:
    assert main(["convert", str(field), str(field.with_name(target)), *options]) == 1
    assert words in capsys.readouterr().err
