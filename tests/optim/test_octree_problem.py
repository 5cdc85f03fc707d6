"""An octree of a fitted grid: its leaves, the fit of their values, checkpoints, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, CUBE, PLAN, WHITE, ball, camera, error_of, photo
from refusals import assert_refused

from mivol import machine
from mivol.errors import MivolError
from mivol.fields.field_files import write_field
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.octree_building import (
    OctreeRecipe,
    build_octree,
    build_octree_of_points,
    max_weights,
    merge_siblings,
)
from mivol.optim.photographs.octree_problem import LeafPlan, OctreePlan, OctreeProblem
from mivol.optim.photographs.radiance_plan import RadianceStage
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import find_region
from mivol.photos import Photo


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    mi.set_variant("llvm_ad_rgb")
    return [photo(ball(), k) for k in range(8)]


def looks(batches: RayBatches):
    return lambda: (batches.all_pixels(1, view).rays for view in range(len(batches.origins)))


def psnr(field, k: float = 2.5) -> float:
    error = np.clip(render_view(field, camera(k), WHITE).image, 0, 1) - photo(ball(), k).image
    return float(-10 * np.log10(np.mean(error**2)))


def test_leaves_are_means_of_the_grid(variant_rgb: str, photos: list[Photo]) -> None:
    # A single voxel of extinction 8 and colour 0.9 beside vacuum: the mean of a half voxel from its Gauss points.
    density = np.zeros((4, 4, 4))
    density[1, 2, 1] = 8
    sh = np.full((4, 4, 4, 1, 3), 0.4 / 0.28209479)
    grid = SphericalGrid.from_dense(density, sh, CUBE)
    tree = build_octree(grid, looks(RayBatches.from_photos(photos)), OctreeRecipe(keep_weight=0.0, tolerance=0.0))
    values, colours = tree.values()
    corners = {tuple(c): v for c, v in zip(tree.corners().tolist(), values, strict=True)}
    # Hats: a half voxel next to the node has the mean weight 3/4 along each axis, the next one 1/4.
    assert tree.depth == 3 and len(corners) == 64
    np.testing.assert_allclose(corners[2, 4, 2], 8 * 0.75**3, rtol=1e-5)
    np.testing.assert_allclose(corners[1, 4, 2], 8 * 0.75**2 * 0.25, rtol=1e-5)
    np.testing.assert_allclose(0.5 + 0.28209479 * colours, 0.9, rtol=1e-5)


def test_an_octree_shows_the_grid(variant_rgb: str, photos: list[Photo]) -> None:
    batches, grid = RayBatches.from_photos(photos), ball()
    tree = build_octree(grid, looks(batches), OctreeRecipe(keep_weight=0.005, tolerance=0.0))
    assert tree.depth == 6 and 0 < tree.leaves < 48**3
    # The ball fills 40 pixels and 29 voxels: leaves of 0.7 pixel. Found 40.6 dB.
    assert psnr(tree) > 35
    finer = build_octree(grid, looks(batches), OctreeRecipe(depth=7, keep_weight=0.005, tolerance=0.0))
    assert psnr(finer) > psnr(tree) and finer.depth == 7
    coarser = build_octree(grid, looks(batches), OctreeRecipe(depth=4))
    assert coarser.depth == 4 and coarser.leaves < tree.leaves / 8
    # The same amount of matter: sums of extinction times volume.
    amounts = [float((t.values()[0] * (8.0**t.sizes) * 8.0**-t.depth).sum()) for t in (tree, coarser)]
    np.testing.assert_allclose(amounts[0], amounts[1], rtol=0.25)


def test_an_octree_shows_a_hash_grid(variant_rgb: str, photos: list[Photo]) -> None:
    """Straight from points: the extinction of a leaf is the mean over its points, and views differ little."""
    place = np.diag([2.0, 2, 2, 1])
    place[:3, 3] = -1
    sizes = HashSizes(levels=2, log2_table=10, coarsest=2, finest=4, width=8, geometry=4)
    field = HashField.random(sizes, place, seed=1)
    field = field.with_parameters(field.parameters() | {"table": field.parameters()["table"] * 1e4})
    field = find_region(field, 16)
    tree = build_octree_of_points(field, looks(RayBatches.from_photos(photos, [1])), OctreeRecipe(4, 0.0, 0.0), degree=2)
    assert (tree.sizes == 0).all() and tree.depth == 4
    middles = tree.middles() @ tree.to_world[:3, :3].T + tree.to_world[:3, 3]
    own = np.array(field.density(mi.Point3f(np.ascontiguousarray(middles.T, np.float32))))
    # The mean over a leaf of an eighth of a cell's volume differs from its middle by the curvature of the density.
    assert np.abs(tree.values()[0] - own).max() < 0.05 * own.max()
    views = [render_view(one, camera(2.5), WHITE).image for one in (tree, field)]
    assert np.sqrt(np.mean((views[0] - views[1]) ** 2)) < 0.02
    assert views[1].std() > 0.02


def test_equal_siblings_become_one_leaf(variant_rgb: str, photos: list[Photo]) -> None:
    grid = SphericalGrid.from_dense(np.full((8, 8, 8), 2.0), np.zeros((8, 8, 8, 1, 3)), CUBE)
    batches = RayBatches.from_photos(photos)
    tree = build_octree(grid, looks(batches), OctreeRecipe(keep_weight=0.0, tolerance=1e-5))
    assert (tree.leaves, int(tree.sizes[0])) == (1, 4) and tree.values()[0][0] == 2
    fine = build_octree(ball(), looks(batches), OctreeRecipe(tolerance=0.0))
    weights = max_weights(fine, looks(batches))
    counts = [merge_siblings(fine, weights, tolerance).leaves for tolerance in (0.0, 0.1, 0.5)]
    assert counts[0] >= counts[1] > counts[2]


def begin(photos: list[Photo], store: CheckpointFile | None = None, grid: bool = True) -> Fit:
    plan = replace(PLAN, stages=(RadianceStage(8, 40, 2, 4, 24), RadianceStage(16, 40, 1, 4, 48)))
    leaves = LeafPlan(steps=30, tiles=48)
    octree = OctreePlan(plan, OctreeRecipe(tolerance=0.05), leaves, random_background=False)
    problem = OctreeProblem(RayBatches.from_photos(photos, (1, 2)), BOX, octree)
    return begin_fit(problem, octree.optimizer, octree.course(), checkpoint=store)


def take(fit: Fit, steps: int) -> Fit:
    while fit.next_iteration < steps:
        fit.advance()
    fit.problem.set_reals(fit.run.reals)
    return fit


def test_the_leaves_become_better_than_the_grid(variant_rgb: str, photos: list[Photo]) -> None:
    names: list[str] = []
    fit = begin(photos)
    fit.problem.report = lambda name, field: names.append(name) or f"{name} seen"
    take(fit, 80)
    grid = error_of(fit)
    take(fit, 81)
    first = error_of(fit)
    take(fit, 110)
    assert names == ["grid", "octree"] and "grid seen; octree seen" in fit.log[-1]
    assert error_of(fit) < first and error_of(fit) < grid
    assert float(dr.min(fit.problem.tree.density)[0]) >= 0


@pytest.mark.slow
@pytest.mark.parametrize("steps", [50, 95])
def test_resumed_fit_equals_an_uninterrupted_fit(one_thread, photos: list[Photo], tmp_path: Path, steps: int) -> None:
    path = tmp_path / "checkpoint.npz"
    whole = take(begin(photos, CheckpointFile(path, {})), steps)
    whole.save()
    take(whole, 110)
    resumed = begin(photos, CheckpointFile(path, {}, resume=True))
    assert resumed.next_iteration == steps and (resumed.problem.tree is None) == (steps < 80)
    take(resumed, 110)
    kept, found = whole.run.pack(), resumed.run.pack()
    assert all(np.array_equal(kept[name], found[name]) for name in kept)
    assert [row["loss"] for row in resumed.history] == [row["loss"] for row in whole.history]


def test_grids_that_no_octree_shows_are_refused(
    variant_rgb: str, photos: list[Photo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rays = looks(RayBatches.from_photos(photos))
    shear = CUBE.copy()
    shear[0, 1] = 1.0
    flat = ball(8).to_dense()
    bad = {
        "no matter": SphericalGrid.from_dense(-np.ones((4, 4, 4)), np.zeros((4, 4, 4, 1, 3)), CUBE),
        "clamp": SphericalGrid.from_dense(*flat, CUBE, clamp=False),
        "sheared": SphericalGrid.from_dense(np.ones((2, 2, 4)), np.zeros((2, 2, 4, 1, 3)), shear),
        "no view": SphericalGrid.from_dense(np.full((4, 4, 4), 1e-6), np.zeros((4, 4, 4, 1, 3)), CUBE),
    }
    for words, grid in bad.items():
        assert_refused(words, build_octree, grid, rays, OctreeRecipe())
    write_field(tmp_path / "grid.npz", ball(8))
    assert_refused("depth 13", build_octree, ball(8), rays, OctreeRecipe(depth=13))
    monkeypatch.setattr(machine, "available_memory", lambda: 2**20)
    with pytest.raises(MivolError, match=r"an octree of \d+ leaves at depth 6 needs .* GiB .*: choose a smaller depth"):
        build_octree(ball(8), rays, OctreeRecipe(depth=6, keep_weight=0.0))
