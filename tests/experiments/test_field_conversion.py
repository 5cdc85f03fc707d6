"""``mivol convert`` between representations: each shows its source, with its loss, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ball_photos import CUBE, ball, camera

from mivol.cli import main
from mivol.experiments import field_conversion
from mivol.experiments.field_conversion import Representation, convert_to_network, views_psnr
from mivol.fields import resampling
from mivol.fields.field_files import read_field, write_field
from mivol.fields.gaussian_grid import grid_to_gaussians
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.octree_building import OctreeRecipe, build_octree_of_levels
from mivol.optim.photographs.sampled_problem import PRESETS
from mivol.points import write_gaussians
from mivol.space import bounds_of, place_grid
from mivol.transport.line_integrals.radiance_field import RayBundle


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = {"FITTED_VIEWS": 12, "FITTED_EDGE": 24, "LEAF_VIEWS": 12, "LEAF_EDGE": 96, "EDGE": 48, "TURNS": 1, "TIMED_EDGE": 16}
    sizes["GRID_NODES"] = 24
    for name, value in sizes.items():
        monkeypatch.setattr(field_conversion, name, value)


def constant_levels(n: int, densities: tuple[float, ...] = (1.5, 0.4)) -> SphericalGrid:
    """A nested grid of constant levels, each of a grey of its own; the innermost box is the cube."""
    levels = []
    for number, density in enumerate(densities):
        place = CUBE @ np.diag([1, 0.8, 0.6, 1])
        place[:3] *= 2.0**number
        sh = np.full((n, n, n, 1, 3), 0.5 - 0.6 * number)
        levels.append(SphericalGrid.from_dense(np.full((n, n, n), density), sh, place))
    first = levels[0]
    levels = [replace(level, to_world=first.level_to_world(k)) for k, level in enumerate(levels)]
    return SphericalGrid.from_levels(levels)


def views_of(field: SphericalGrid) -> list[RayBundle]:
    """The rays of three views."""
    return list(field_conversion.look_around(Representation.from_field(field), 16)())[:3]


@pytest.mark.parametrize("n", [8, 6])
def test_levels_become_leaves_in_their_places(variant_rgb: str, n: int) -> None:
    """Where each level is constant, grid and octree are integrated exactly, but for half floats in views of octrees: optical
    depths and colours, at most 1, are off by 2^-11, so a pixel by 2^-11 (1 + max tau e^-tau) = 2^-11 (1 + 1/e)."""
    field = constant_levels(n)
    tree = build_octree_of_levels(field, lambda: views_of(field), OctreeRecipe(keep_weight=0, tolerance=0))
    assert tree.depth == 5 and set(tree.sizes) >= {1}
    for k in range(3):
        images = [render_view(one, camera(k, 24), np.zeros(3)) for one in (field, tree)]
        np.testing.assert_allclose(images[1].opacity, images[0].opacity, rtol=0, atol=1.4 * 2.0**-11)
        np.testing.assert_allclose(images[1].image, images[0].image, rtol=0, atol=1.4 * 2.0**-11)


@pytest.fixture
def sources(variant_rgb: str, small: None, tmp_path: Path) -> Path:
    """A ball as grid, Gaussians, and in the inner box of a nested grid of two levels."""
    write_field(tmp_path / "grid.npz", ball(24))
    write_gaussians(tmp_path / "cloud.ply", grid_to_gaussians(ball(24), None))
    density, sh = ball(24).to_dense()
    empty = replace(SphericalGrid.from_dense(-np.ones_like(density), 0 * sh, CUBE), to_world=ball(24).level_to_world(1))
    write_field(tmp_path / "nested.npz", SphericalGrid.from_levels([ball(24), empty]))
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "target", "flags"),
    [
        ("cloud.ply", "octree", []),
        ("cloud.ply", "grid", ["--resolution", "32"]),
        ("cloud.ply", "nested", ["--resolution", "32"]),
        ("nested.npz", "octree", []),
        ("nested.npz", "grid", []),
        ("nested.npz", "gaussians", []),
        ("tree.npz", "gaussians", []),
    ],
)
def test_what_is_converted_shows_its_source(
    sources: Path, capsys: pytest.CaptureFixture[str], source: str, target: str, flags: list[str]
) -> None:
    made = sources / ("made.ply" if target == "gaussians" else "made.npz")
    if source == "tree.npz":
        assert main(["convert", str(sources / "grid.npz"), str(sources / source), "--to", "octree"]) == 0
    capsys.readouterr()
    assert main(["convert", str(sources / source), str(made), "--to", target, *flags]) == 0
    said = capsys.readouterr().out
    loss = next(float(line.split(" dB")[0].split()[-1]) for line in said.splitlines() if " dB" in line)
    # Half of the error of black views at least: 6 dB.
    black = Representation.from_field(SphericalGrid.from_dense(np.zeros((2, 2, 2)), np.zeros((2, 2, 2, 1, 3)), CUBE))
    assert loss > 6 + views_psnr(black, Representation.open(sources / source)), said


@pytest.mark.slow
@pytest.mark.parametrize(("source", "kind"), [("grid.npz", "hash"), ("nested.npz", "nerf"), ("cloud.ply", "hash")])
def test_a_network_shows_its_source(sources: Path, variant_rgb: str, source: str, kind: str) -> None:
    plan = replace(PRESETS[kind]["tiny"], steps=150, samples=1 << 12)
    said = convert_to_network(sources / source, sources / "field.npz", kind, variant_rgb, plan)
    assert read_field(sources / "field.npz").kind == kind
    loss = float(said.split("\n")[1].split()[0])
    # Black views have about 12 dB.
    assert loss > 17, said


def test_an_octree_has_leaves_that_many_fine_views_see(variant_rgb: str) -> None:
    """As many views, and as fine, as the docs say: coarse ones look past leaves."""
    source = Representation.from_field(ball(128))
    rays = field_conversion.look_around(source, min(field_conversion.LEAF_EDGE, 4 * 128))
    cameras = rays.__closure__[0].cell_contents
    assert len(cameras) == 48 and {camera.size for camera in cameras} == {(512, 512)}


@pytest.mark.parametrize(
    ("source", "target", "flags", "words"),
    [
        ("grid.npz", "a.ply", ["--to", "hash"], "--to hash writes an .npz, fitted to views of the source"),
        ("grid.npz", "a.npz", ["--to", "hash", "--resolution", "4"], "leave out other flags"),
        ("radiance.npz", "a.npz", ["--to", "nerf"], "has colours of radiance"),
        ("grid.npz", "a.npz", ["--to", "nested"], "a radiance field of one box has nothing there"),
        ("cloud.ply", "a.ply", ["--to", "nested"], "--to nested makes an .npz"),
        ("cloud.ply", "a.npz", ["--to", "octree", "--box", *"000111"], "crop them first"),
        ("cloud.ply", "a.ply", ["--to", "octree"], "--to octree makes an .npz"),
        ("nested.npz", "a.npz", ["--to", "octree", "--resolution", "4096"], "at most 7 is expected"),
        ("nested.npz", "a.npz", ["--to", "grid", "--resolution", "1"], "expected at least 2"),
        ("nested.npz", "a.npz", ["--to", "grid", "--resolution", "2048"], "expected at most 1073741824"),
        ("grid.npz", "a.npz", ["--to", "octree", "--resolution", "-3"], "give 1 to 4096"),
        ("grid.npz", "a.npz", ["--to", "grid"], "is a grid of one box already"),
    ],
)
def test_conversions_without_a_meaning_are_refused(
    sources: Path, capsys: pytest.CaptureFixture[str], source: str, target: str, flags: list[str], words: str
) -> None:
    write_field(sources / "radiance.npz", replace(ball(24), space="linear"))
    assert main(["convert", str(sources / source), str(sources / target), *flags]) == 1
    assert words in capsys.readouterr().err
    assert not (sources / target).exists()


@pytest.mark.parametrize("nodes", [13, 40])
def test_voxels_far_from_matter_are_not_sampled(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, nodes: int) -> None:
    """Coarser and finer than the levels, the voxels near matter are all that hold matter; both are as symmetric."""
    density, sh = ball(12).to_dense()
    outer = replace(SphericalGrid.from_dense(np.roll(density, 4, axis=0), sh, CUBE), to_world=ball(12).level_to_world(1))
    field = SphericalGrid.from_levels([ball(12), outer])
    res, place = place_grid(bounds_of(field.level_to_world(1)), nodes)
    near = resampling._nodes_near_matter(field, res, place)
    found = resampling.sample_voxels(field, res, place)[0]
    monkeypatch.setattr(resampling, "_nodes_near_matter", lambda *_: np.arange(np.prod(res)))
    np.testing.assert_array_equal(found, resampling.sample_voxels(field, res, place)[0])
    assert len(near) < 0.9 * np.prod(res)
    is_near = np.isin(np.arange(np.prod(res)), near).reshape(res)
    for axis in (1, 2):
        np.testing.assert_array_equal(is_near, np.flip(is_near, axis))
