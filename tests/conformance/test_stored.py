"""Stored rows against the float64 twin of the projector, their transpose, their parts, and what they take."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_projector
import pytest
from oracle_projector import ANGLES, GRID, assert_pair_is_adjoint, assert_pair_is_its_twin, numbers
from refusals import assert_refused

from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.tomography import stored
from mivol.tomography.geometry import ConeBeam, Geometry, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector
from mivol.tomography.stored import is_worth_storing, matrix_bytes, store_matrix

pytestmark = pytest.mark.usefixtures("two_threads")


@pytest.fixture(params=["scipy", "kernels"])
def products(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Products of more than one layer by SciPy, as small ones are, and by kernels, as large ones are."""
    monkeypatch.setattr(stored, "SMALL_PRODUCT", 0 if request.param == "kernels" else 1 << 60)
    return request.param


BEAMS = {
    "parallel, rows between layers": ParallelBeam(ANGLES, (7, 9), (0.5, 0.45), axis_offset=0.13, detector_offset=(0.07, -0.2)),
    "parallel, rows are layers": ParallelBeam(ANGLES, (5, 9), (0.6, 0.45), detector_offset=(0.1, 0.01)),
    "fan": ConeBeam(ANGLES, (1, 9), 8.0, 13.0, 0.8, axis_offset=-0.2),
    "fan, source inside": ConeBeam(ANGLES, (1, 9), 0.5, 3.0, 0.4),
}
GRIDS = {"anisotropic": GRID, "one voxel": VoxelGrid((1, 1, 1), 2.0), "narrow": VoxelGrid((3, 2, 9), 0.5)}


FINER = ParallelBeam(np.arange(16) * np.pi / 8, (1, 25)), VoxelGrid((1, 17, 17))
"""Lines along centres and diagonals, and 12 directions between them."""

WIDE = ParallelBeam(np.arange(7) * np.pi / 7 + 0.1, (2, 37)), VoxelGrid((2, 19, 21))
"""More columns and voxels of a line than lanes."""


@pytest.mark.parametrize(
    ("beam", "grid"),
    [
        *(pytest.param(BEAMS[b], GRIDS[g], id=f"{b}-{g}") for b in BEAMS for g in GRIDS),
        pytest.param(*FINER, id="finer"),
        pytest.param(*WIDE, id="wide"),
    ],
)
def test_stored_pair_is_the_float64_twin(beam: Geometry, grid: VoxelGrid, products: str) -> None:
    a = store_matrix(Projector(beam, grid))
    assert_pair_is_its_twin(a, beam, grid)
    assert np.abs(a @ numbers(*grid.shape)).max() > 0.1, "the rays hit the grid"


def test_many_layers_are_multiplied_in_parts(seed: int, products: str) -> None:
    """40 layers, of which 32 go at once, in blocks of one view: each layer is what it is alone."""
    grid = VoxelGrid((40, 4, 3))
    aside = {"detector_offset": (0.0, 0.1)}  # no line in the plane of a face
    a = store_matrix(Projector(ParallelBeam(ANGLES, (40, 5), **aside), grid))
    one = oracle_projector.system_matrix(ParallelBeam(ANGLES, (1, 5), **aside), VoxelGrid((1, 4, 3)))
    x, y = numbers(40, 12, seed=seed), numbers(5, 40, 5, seed=seed + 1)
    expected = (one @ x.T.astype(float)).reshape(5, 5, 40).transpose(0, 2, 1)
    np.testing.assert_allclose(a @ x.reshape(grid.shape), expected, atol=2e-6 * np.abs(x).sum(1).max())
    back = (one.T @ y.transpose(0, 2, 1).reshape(25, 40).astype(float)).T
    np.testing.assert_allclose((a.T @ y).reshape(40, 12), back, atol=2e-6 * np.abs(y).sum((0, 2)).max())


@pytest.mark.parametrize("block", [1, 1 << 19])
def test_a_subset_is_the_rows_of_its_views(monkeypatch: pytest.MonkeyPatch, products: str, block: int) -> None:
    """In any order, over the borders of blocks (a view each, or all in one), and a subset of a subset."""
    monkeypatch.setattr(stored, "PAIRS_PER_BLOCK", block)
    a = store_matrix(Projector(BEAMS["parallel, rows between layers"], GRID))
    x, y = numbers(*GRID.shape), numbers(3, 7, 9)
    part = a.subset([4, 0, 1])
    np.testing.assert_array_equal(part @ x, (a @ x)[[4, 0, 1]])
    np.testing.assert_array_equal(part.subset([2]) @ x, (a @ x)[[1]])
    assert_refused("view 3, expected views from 0 to 2", part.subset, [3])
    spread = np.zeros(a.projection_shape, np.float32)
    spread[[4, 0, 1]] = y
    # Sums in another order: float32 rounding of 3 views of 63 rays.
    np.testing.assert_allclose(part.T @ y, a.T @ spread, atol=2e-6 * np.abs(y).sum())


def test_adjoint_identity(seed: int, products: str) -> None:
    assert_pair_is_adjoint(store_matrix(Projector(BEAMS["parallel, rows between layers"], GRID)), GRID, seed)


def test_tensors_go_through_the_stored_rows() -> None:
    a = store_matrix(Projector(BEAMS["fan"], GRID))
    x, y = numbers(*GRID.shape), numbers(*a.projection_shape)
    tensor = mi.TensorXf(x)
    dr.enable_grad(tensor)
    projections = a.integrate(tensor)
    np.testing.assert_array_equal(np.array(projections), a @ x)
    dr.backward(dr.sum(projections * mi.TensorXf(y), axis=None))
    np.testing.assert_array_equal(np.array(tensor.grad), a.T @ y)


@pytest.mark.parametrize("name", ["sart", "pcg"])
def test_a_solver_finds_what_it_finds_by_walking(products: str, name: str) -> None:
    """Three iterations. Both operators err by 2e-6 at most; an iteration adds such an error, and none of them amplifies it by
    more than the norm of a step, 1 for SART, and below 10 for CG on so few equations."""
    beam, grid = ParallelBeam(np.arange(12) * np.pi / 12, (2, 13)), VoxelGrid((2, 9, 9))
    walk = Projector(beam, grid)
    b = walk @ np.abs(numbers(*grid.shape))
    found = []
    for a in (walk, store_matrix(walk)):
        states = SOLVERS[name].run(LeastSquares(a, b, nonnegative=True))
        found.append([next(states).x for _ in range(3)][-1])
    assert np.abs(found[1] - found[0]).max() < 3 * 10 * 2e-6 * found[0].max()
    assert found[0].max() > 0.5


def test_what_storing_takes_is_counted_beforehand(products: str) -> None:
    """An entry more or less where a line begins, ends, or meets the outermost rows: 8 a line of about 600 entries, 1.3 %.
    Kernels store the transpose too, and sixteen rows take the place of the longest: half of it at two of the 17 strips, 3 %.
    """
    walk = Projector(ParallelBeam(0.03 + np.arange(8) * np.pi / 8, (3, 257)), VoxelGrid((3, 257, 257)))
    stored = store_matrix(walk)
    assert matrix_bytes(walk) == pytest.approx(stored.nbytes, rel=0.05)
    nothing = Projector(BEAMS["parallel, rows are layers"], VoxelGrid((1, 1, 1), centre=(99.0, 99.0, 0.0)))
    assert matrix_bytes(nothing) == 4 * 45 * (2 if products == "kernels" else 1)


def test_only_rays_in_layers_are_stored() -> None:
    for beam in (ConeBeam(ANGLES, (2, 9), 8.0, 13.0), ConeBeam(ANGLES, (1, 9), 8.0, 13.0, detector_offset=(0.1, 0.0))):
        walk = Projector(beam, GRID)
        assert matrix_bytes(walk) is None
        assert_refused("rays that do not lie in layers", store_matrix, walk)


def test_storing_pays_with_layers_iterations_and_subsets() -> None:
    assert is_worth_storing(1, 9, False)
    assert is_worth_storing(9, 1, False)
    assert not is_worth_storing(1, 8, False)
    assert is_worth_storing(1, 1, True)
