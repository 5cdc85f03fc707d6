"""The projector pair against its float64 twin, its transpose, and every way in which it can be called."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_projector
import pytest
import scipy.sparse.linalg
from oracle_projector import ANGLES, GRID, assert_pair_is_adjoint, assert_pair_is_its_twin, numbers
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.threads import set_thread_count
from mivol.tomography import projector as projector_module
from mivol.tomography.geometry import ConeBeam, ParallelBeam, PencilRays, VoxelGrid
from mivol.tomography.phantoms import random_ellipsoids
from mivol.tomography.projector import Projector, order_rays

pytestmark = pytest.mark.usefixtures("two_threads")

BEAMS = {
    "parallel": ParallelBeam(ANGLES, (7, 9), (0.5, 0.45), axis_offset=0.13, detector_offset=(0.07, -0.2)),
    "cone": ConeBeam(ANGLES, (7, 9), 8.0, 13.0, (0.7, 0.8), axis_offset=-0.2, detector_offset=(0.3, 0.1)),
    "source inside": ConeBeam(ANGLES, (7, 9), 0.5, 3.0, (0.3, 0.4)),
    "pencil": PencilRays(*np.random.default_rng(0).normal(size=(2, 60, 3))),
}


@pytest.mark.parametrize("name", BEAMS)
def test_pair_is_its_float64_twin(name):
    a = Projector(BEAMS[name], GRID)
    assert a.projection_shape == BEAMS[name].shape
    assert_pair_is_its_twin(a, BEAMS[name], GRID)
    assert np.abs(a @ numbers(*GRID.shape)).max() > 0.1, "the rays hit the grid"


THIN_AND_LONG = [pytest.param(shape, marks=pytest.mark.slow) for shape in [(1, 7, 6), (5, 1, 6), (5, 7, 1), (40, 3, 4)]]


@pytest.mark.parametrize("shape", [(5, 7, 6), *THIN_AND_LONG])
@pytest.mark.parametrize("along", [0, 1, 2])
def test_walk_between_columns_is_the_float64_twin(monkeypatch, shape, along):
    """Columns along each axis, rays of any direction, from outside, from inside and in the planes of nodes; 2e-6 as above."""
    rng = np.random.default_rng(3)
    grid = VoxelGrid(shape, (0.5, 0.4, 0.6), (0.2, -0.3, 0.1))
    place, direction = rng.normal(size=(2, 90, 3))
    direction[:30] *= rng.integers(0, 2, (30, 3))
    direction[~direction.any(1)] = (0.0, 0.0, 1.0)
    place[:15] = np.array(grid.centre) + np.array(grid.voxel_size) * rng.integers(-2, 3, (15, 3))
    place[20:60] *= 6
    direction[40:60] = -place[40:60] + 0.3 * direction[40:60]
    rays = PencilRays(place, direction)
    monkeypatch.setattr(projector_module, "MIN_CELLS_PER_VOXEL", 0)
    monkeypatch.setattr(Projector, "_along", along)
    a = Projector(rays, grid)
    twin = assert_pair_is_its_twin(a, rays, grid)
    assert any("integrate" in name for name in a._kernels._columns) and (twin @ np.ones(grid.size) > 0).sum() > 20


@pytest.mark.parametrize(("name", "along"), [("parallel", 2), ("cone", 2), ("pencil", None)])
def test_rays_of_a_scanner_seldom_cross_the_axis_of_rotation(cpu_back_end, name, along):
    """Rays of random directions cross each axis as often. Walks by columns are the CPU's."""
    assert Projector(BEAMS[name], VoxelGrid((7, 7, 7), 0.4))._along == along


@pytest.mark.parametrize(("filled", "by_columns"), [(16, True), (5, False)])
def test_what_is_mostly_empty_is_skipped(cpu_back_end, filled, by_columns):
    """A cube of 16 voxels in 16 leaves no block empty, one of 5 has 8 of 125 blocks of 4 cells."""
    grid = VoxelGrid((16, 16, 16), 1.0)
    a = Projector(ParallelBeam(np.arange(30) * 0.1, (16, 16)), grid)
    x = np.zeros(grid.shape, np.float32)
    x[:filled, :filled, :filled] = 1
    a @ x
    assert bool(a._kernels._columns) == by_columns
    assert (a._kernels._integrate.n_recordings == 0) == by_columns


def test_few_rays_prepare_nothing():
    """A margin is copied where rays cross over 16 times as many cells as the grid has: here 3 times a view."""
    grid = VoxelGrid((16, 16, 16), 1.0)
    a = Projector(ParallelBeam(np.arange(12) * 0.1, (16, 16)), grid)
    assert a._pays_to_prepare and not a.subset([3])._pays_to_prepare


LARGER = VoxelGrid((24, 24, 24), 1 / 12), ConeBeam(np.arange(20) * 0.3, (24, 24), 5.0, 8.0, 0.14)
"""1e4 rays: hundreds in each voxel."""


@pytest.mark.parametrize(("grid", "beam"), [*((GRID, beam) for beam in BEAMS.values()), LARGER], ids=[*BEAMS, "larger"])
def test_adjoint_identity(grid, beam, seed):
    assert_pair_is_adjoint(Projector(beam, grid), grid, seed)


def test_a_million_rays_in_one_voxel(monkeypatch):
    """All chords of a box of one voxel: float32 in turn loses 8e-4; passes of 8192 and float64 between them, 3e-5.

    By the walk of any ray, whose sums have fewer places to go to. Hard case 42.
    """
    monkeypatch.setattr(Projector, "_along", None)
    a = Projector(ParallelBeam(np.array([0.3]), (1000, 1000), 1e-3), VoxelGrid((1, 1, 1), 2.0))
    chords = a @ np.ones(1, np.float32)
    assert a.column_sums.sum(dtype=float) == pytest.approx(chords.sum(dtype=float), rel=3e-5)


@pytest.mark.parametrize("name", ["parallel", "cone"])
def test_projects_what_an_ellipsoid_projects(name):
    """Rationale: geometry signs end to end, against chords on paper, no code in common with the walk.

    Expected: voxels of size h blur the edges of ellipsoids with axes of 0.05 to 0.35: an error of order h = 0.125, and of
    half when h is halved.
    """
    phantom, errors = random_ellipsoids(3, seed=4), []
    beam = {
        "parallel": ParallelBeam(ANGLES, (30, 30), 0.07, axis_offset=0.2),
        "cone": ConeBeam(ANGLES, (30, 30), 6.0, 9.0, 0.11, axis_offset=0.15, detector_offset=(0.1, 0.2)),
    }[name]
    truth = phantom.project(beam)
    for n in (16, 32):
        grid = VoxelGrid((n, n, n), 2 / n)
        errors.append(np.linalg.norm(Projector(beam, grid) @ phantom.voxelise(grid, 4) - truth) / np.linalg.norm(truth))
    assert errors[0] < 0.3
    assert errors[1] < 0.6 * errors[0]


def test_axis_aligned_rays_are_row_sums():
    """theta = 0 looks along +y, theta = pi / 2 along -x, rays through voxel centres: voxel size times the sum of a row.

    Hard case 9.
    """
    grid = VoxelGrid((4, 6, 6), 0.5)
    x = numbers(*grid.shape)
    y = Projector(ParallelBeam(np.array([0.0, np.pi / 2]), (4, 6), 0.5), grid) @ x
    np.testing.assert_allclose(y[0], 0.5 * x.sum(axis=1), atol=1e-5)
    np.testing.assert_allclose(y[1], 0.5 * x.sum(axis=2), atol=1e-5)


def test_object_and_source_far_away():
    """The same scan 1e6 units from the world's origin, and from 1e5 grid sizes away: float64 set-up loses nothing.

    Expected: moving grid and rays together changes each float64 coordinate by 1e6 * 1e-16 only. A far cone is the
    parallel beam to 1e-5 (angle of the rays).

    Hard case 15.
    """
    rays = PencilRays(np.array([[-5.0, 0.3, 0.2], [-5.0, -0.4, 0.6]]), np.array([[1.0, 0.01, -0.02], [1.0, 0.05, 0.0]]))
    shift = np.array([1e6, -2e6, 5e5])
    far = PencilRays(rays.o + shift, rays.d)
    x = numbers(8, 8, 8)
    near_grid, far_grid = VoxelGrid((8, 8, 8), 0.25), VoxelGrid((8, 8, 8), 0.25, centre=tuple(shift))
    np.testing.assert_allclose(Projector(far, far_grid) @ x, Projector(rays, near_grid) @ x, atol=2e-6)
    cone = Projector(ConeBeam(ANGLES, (8, 8), 2e5, 2e5, 0.25), near_grid) @ x
    np.testing.assert_allclose(cone, Projector(ParallelBeam(ANGLES, (8, 8), 0.25), near_grid) @ x, atol=1e-4)


def test_parallel_rays_are_whole_lines_and_cones_are_not():
    """A grid behind the rotation axis is still seen in parallel light, whatever its distance; not behind a source."""
    grid = VoxelGrid((2, 2, 2), 1.0, centre=(0.0, -500.0, 0.0))
    x = np.ones(grid.shape, np.float32)
    assert Projector(ParallelBeam(np.zeros(1), (1, 1)), grid) @ x == pytest.approx(2.0, rel=1e-6)
    assert (Projector(ConeBeam(np.zeros(1), (1, 1), 100.0, 200.0), grid) @ x) == 0.0


def test_subset_is_the_rows_of_its_views():
    a = Projector(BEAMS["cone"], GRID)
    x, y = numbers(*GRID.shape), numbers(2, 7, 9)
    part = a.subset([3, 1])
    # Few rays take the walk of any ray, many that between columns: both are exact to 2e-6 of the sums, of order 1.
    np.testing.assert_allclose(part @ x, (a @ x)[[3, 1]], atol=4e-6)
    padded = np.zeros(a.projection_shape, np.float32)
    padded[[3, 1]] = y
    np.testing.assert_allclose(part.T @ y, a.T @ padded, atol=1e-5)
    np.testing.assert_array_equal(part.subset([1]) @ x, (part @ x)[[1]])


def test_subset_compiles_nothing():
    """Kernels have no sizes and no geometry in their code: the same ones (by hash) serve any views and another scanner.

    Few rays take the walk of any ray, many that between columns. Each is traced once for all subsets: one recording of each
    operator of each walk.
    """

    def kernels(a: Projector) -> set[str]:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            a.T @ (a @ x)
            return {k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT}

    a, x = Projector(BEAMS["parallel"], GRID), numbers(*GRID.shape)
    cone = Projector(BEAMS["cone"], GRID)
    many, few = kernels(a), kernels(a.subset([0]))
    assert len(few) >= 2
    assert kernels(cone) == many
    for other in (a.subset([1, 4]), a.subset([3]), cone.subset([2])):
        assert kernels(other) == few
    recorded = (a._kernels._integrate, a._kernels._backproject, *a._kernels._columns.values())
    on_gpu = dr.backend_v(mi.Float) != dr.JitBackend.LLVM  # walks no columns: rays of many views skip what is empty instead
    assert [kernel.n_recordings for kernel in recorded] == ([2, 1] if on_gpu else [1, 1, 1, 1])


def test_threads_may_change():
    """The transpose has a copy of its sums for each thread: more threads than it was recorded with are no danger."""

    before, y = dr.thread_count(), numbers(*BEAMS["cone"].shape)
    try:
        set_thread_count(1)
        a = Projector(BEAMS["cone"], GRID)
        alone = a.T @ y
        set_thread_count(2)
        assert np.abs(a.T @ y - alone).max() < 2e-6 * np.abs(alone).max()
        assert a._kernels._threads == 2
    finally:
        set_thread_count(before)


@pytest.mark.parametrize("cells", [1, 400, 5000])
def test_passes_change_nothing(monkeypatch, cells):
    """Ray by ray, views cut in pieces, several views at once: the same numbers; A^T up to the order of its sums."""
    whole = Projector(BEAMS["cone"], GRID)
    x, y = numbers(*GRID.shape), numbers(*whole.projection_shape)
    expected, expected_back = whole @ x, whole.T @ y
    monkeypatch.setattr(projector_module, "PASS_CELLS", cells)
    monkeypatch.setattr(projector_module, "CACHE_BYTES", 0)
    if cells == 1:
        part = Projector(BEAMS["cone"], GRID).subset([2])
        np.testing.assert_allclose(part @ x, expected[[2]], atol=4e-6)
        return
    a = Projector(BEAMS["cone"], GRID)
    np.testing.assert_array_equal(a @ x, expected)
    np.testing.assert_allclose(a.T @ y, expected_back, atol=2e-6 * np.abs(expected_back).max())


@pytest.mark.parametrize(("cells", "rays"), [(1 << 29, 60), (22, 1), (54, 3)])
def test_rays_of_a_pass(monkeypatch, cells, rays):
    """As many as fill the voxels of a slice across the longest side once; fewer where they would cross too many cells."""
    grid = VoxelGrid((3, 5, 7), (0.5, 0.4, 0.6))
    monkeypatch.setattr(projector_module, "PASS_CELLS", cells)
    monkeypatch.setattr(projector_module, "PASS_SUM", 4)
    a = Projector(ParallelBeam(np.radians([0, 90]), (9, 8), 0.1), grid)
    # 15 voxels a slice, 4 rays each; a ray crosses 3 + 5 + 7 + 3 cells at most.
    passes = [np.array(part.numbers) for part in a._set_up_passes()]
    assert [len(part) for part in passes] == 2 * [min(rays, 72 - start) for start in range(0, 72, rays)]
    assert sorted(np.concatenate(passes)) == list(range(144))


def test_rays_are_kept_up_to_a_bound(monkeypatch):
    """Six float32 numbers a ray and its index: kept where they just fit, and set up anew for each product beyond."""
    x, rays = numbers(*GRID.shape), BEAMS["cone"].shape
    for short, kept in ((0, True), (1, False)):
        monkeypatch.setattr(projector_module, "CACHE_BYTES", 4 * 7 * int(np.prod(rays)) - short)
        a = Projector(BEAMS["cone"], GRID)
        assert a.shape[0] != a.shape[1]
        a @ x
        assert (a._cache is not None) == kept


def test_flat_in_flat_out_and_wrong_shapes_are_refused():
    a = Projector(BEAMS["parallel"], GRID)
    x = numbers(*GRID.shape)
    np.testing.assert_array_equal(a @ x.ravel(), (a @ x).ravel())
    assert a.shape == (5 * 7 * 9, 5 * 7 * 6)
    assert a.T.shape == a.shape[::-1]
    assert a.T.T is a
    with pytest.raises(MivolError, match=r"shape \(6, 7, 5\), expected \(5, 7, 6\)"):
        a @ x.transpose(2, 1, 0)
    with pytest.raises(MivolError, match="one number for each of the rays"):
        a.T @ x
    with pytest.raises(MivolError, match="complex"):
        a @ (1j * x)


def test_scipy_solves_with_it():
    """As a LinearOperator under LSQR: the same answer as the twin's matrix, to what float32 projections allow."""
    phantom, grid = random_ellipsoids(2, seed=1), VoxelGrid((6, 6, 6), 1 / 3)
    beam = ParallelBeam(np.arange(12) * np.pi / 12, (8, 8), 0.25)
    operator, twin = Projector(beam, grid).as_linear_operator(), oracle_projector.system_matrix(beam, grid)
    b = phantom.project(beam).ravel()
    ours = scipy.sparse.linalg.lsqr(operator, b, iter_lim=8)[0]
    theirs = scipy.sparse.linalg.lsqr(twin, b, iter_lim=8)[0]
    np.testing.assert_allclose(ours, theirs, atol=1e-4 * np.abs(theirs).max())
    assert operator.shape == twin.shape


def test_forward_and_reverse_mode_are_the_pair():

    a = Projector(BEAMS["cone"], GRID)
    x, tangent, y = numbers(*GRID.shape), numbers(*GRID.shape, seed=3), numbers(*a.projection_shape, seed=4)
    values = mi.TensorXf(x)
    dr.enable_grad(values)
    dr.set_grad(values, mi.TensorXf(tangent))
    np.testing.assert_array_equal(np.array(dr.forward_to(a.integrate(values))), a @ tangent)
    values = mi.TensorXf(x)
    dr.enable_grad(values)
    dr.backward_from(a.integrate(values) * mi.TensorXf(y))
    np.testing.assert_allclose(np.array(dr.grad(values)), a.T @ y, atol=1e-5)
    assert_refused("expected the grid's", a.integrate, mi.TensorXf(x.ravel(), (7, 5, 6)))


def test_torch_differentiates_through_it(variant_rgb):
    torch = pytest.importorskip("torch", reason="PyTorch is not installed: the torch bridge is not tested")
    a = Projector(BEAMS["parallel"], GRID)
    x, y = numbers(*GRID.shape), numbers(*a.projection_shape, seed=4)
    device = "cpu" if variant_rgb.startswith("llvm") else "cuda"
    tensor = torch.tensor(x, requires_grad=True, device=device)
    projected = a.to_torch()(tensor)
    np.testing.assert_array_equal(projected.detach().cpu().numpy(), a @ x)
    (projected * torch.tensor(y, device=device)).sum().backward()
    np.testing.assert_allclose(tensor.grad.cpu().numpy(), a.T @ y, atol=1e-5)
    assert_refused(f"a tensor on meta, expected one on {device}", a.to_torch(), tensor.to("meta"))


def test_without_torch_the_bridge_says_so(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "torch", None)
    assert_refused("pip install torch", Projector(BEAMS["parallel"], GRID).to_torch)


def test_column_sums_are_what_a_voxel_is_seen():
    """Sum over voxels of A^T 1 is the sum of all chords: every ray's weights add up to its length in the box."""
    a = Projector(BEAMS["cone"], GRID)
    chords = a @ np.ones(GRID.shape, np.float32)
    assert a.column_sums.sum(dtype=float) == pytest.approx(chords.sum(dtype=float), rel=1e-6)


def test_views_that_are_not_there_are_refused():
    assert_refused("from 0 to 4", Projector(BEAMS["cone"], GRID).subset([4]).geometry.rays, [5])
    assert_refused("from 0 to 4", Projector, BEAMS["cone"], GRID, [-1])


def test_scalar_variants_are_refused():
    mi.set_variant("scalar_rgb")
    assert_refused("a variant|expected one that compiles", Projector, BEAMS["cone"], GRID)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ((BEAMS["parallel"], (1, 64, 64)), r"Found tuple for the grid, expected where the voxels lie: mivol.VoxelGrid"),
        ((BEAMS["parallel"], np.zeros((1, 64, 64))), "Found ndarray for the grid"),
        ((GRID, BEAMS["parallel"]), "Found VoxelGrid for the geometry, expected where the rays run"),
        ((np.linspace(0, 3, 8), GRID), "Found ndarray for the geometry"),
        ((None, GRID), "Found NoneType for the geometry"),
        ((BEAMS["parallel"], GRID, []), "Found no views"),
    ],
)
def test_what_is_no_scan_is_refused(variant_rgb: str, given: tuple, sentence: str) -> None:
    """Arrays where a place of voxels or of rays is expected, the two in the wrong order, or no view."""
    assert_refused(sentence, Projector, *given)


def test_rows_of_different_lengths_are_no_volume(variant_rgb: str) -> None:
    with pytest.raises(MivolError, match="Found rows of different lengths"):
        Projector(BEAMS["parallel"], GRID) @ [[1.0], [2.0, 3.0]]


@pytest.mark.parametrize("shape", [(3, 4, 16), (2, 5, 9), (1, 1, 7), (4, 3, 1)])
def test_each_ray_once(shape: tuple[int, int, int]) -> None:
    assert sorted(order_rays(*shape)) == list(range(int(np.prod(shape))))


def test_a_vector_is_a_tile_and_views_follow_each_other() -> None:
    """Sixteen lanes are 2 rows of 8 columns; the second view of two rows comes before the third row of the first."""
    view, row, column = np.unravel_index(order_rays(3, 4, 16), (3, 4, 16))
    assert (set(row[:16]), set(column[:16]), set(view[:16])) == ({0, 1}, set(range(8)), {0})
    assert [(v, r // 2) for v, r in zip(view[::32], row[::32], strict=True)] == [(v, b) for b in (0, 1) for v in (0, 1, 2)]
