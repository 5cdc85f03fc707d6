"""Unknowns finer than voxels: the same box, exact means, and edges that do not ripple."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mivol.optim.projections.iterative import projected_cg
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.tomography.filtered import feldkamp
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid, subdivide_grid, voxel_means
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector
from mivol.validate.metrics import nrmse

GRID = VoxelGrid((2, 3, 4), (0.5, 0.25, 0.75), (1.0, 2.0, 3.0))
CONE = ConeBeam(np.arange(4.0), (2, 2), 20.0, 30.0)
PARALLEL = ParallelBeam(np.arange(4.0), (2, 2))


@pytest.mark.parametrize(
    ("geometry", "shape", "edges"),
    [(CONE, (6, 9, 12), (0.5 / 3, 0.25 / 3, 0.25)), (PARALLEL, (2, 9, 12), (0.5 / 3, 0.25 / 3, 0.75))],
)
def test_a_subdivided_grid_is_the_same_box(geometry: ConeBeam | ParallelBeam, shape: tuple, edges: tuple) -> None:
    """Three parts an edge; rows of a parallel beam see one height each, and z stays as it is."""
    fine = subdivide_grid(GRID, 3, geometry)
    assert fine.shape == shape
    assert fine.voxel_size == pytest.approx(edges)
    assert fine.extent == pytest.approx(GRID.extent) and fine.centre == GRID.centre


@pytest.mark.parametrize("geometry", [CONE, PARALLEL])
def test_means_are_those_of_blocks(geometry: ConeBeam | ParallelBeam) -> None:
    """A field that is linear in world coordinates has the mean of its value at the middle of a voxel."""
    fine = subdivide_grid(GRID, 2, geometry)
    z, y, x = (3.0 * fine.axis("z")[:, None, None], 5.0 * fine.axis("y")[:, None], 7.0 * fine.axis("x"))
    expected = 3.0 * GRID.axis("z")[:, None, None] + 5.0 * GRID.axis("y")[:, None] + 7.0 * GRID.axis("x")
    found = voxel_means(z + y + x, GRID.shape)
    assert found == pytest.approx(expected)
    assert voxel_means(np.ones(fine.shape, np.float32), GRID.shape).dtype == np.float32
    assert np.array_equal(voxel_means(expected, GRID.shape), expected)


@pytest.mark.slow
def test_edges_do_not_ripple_in_finer_unknowns(variant_rgb: str) -> None:
    """The head from exact chords, 24^3 voxels of 60 views, from FDK: after 16 iterations the voxels' own error is past its
    least value, by a third and more; the means of halves have a lower one, and keep it to a tenth."""
    angles = np.arange(60) * np.pi / 30
    beam, grid, head = ConeBeam(angles, (24, 24), 6.0, 6.0, 1 / 8), VoxelGrid((24, 24, 24), 1 / 12), shepp_logan()
    y, truth = head.project(beam), head.voxelise(grid, 4)
    errors = {}
    for parts in (1, 2):
        a = Projector(beam, subdivide_grid(grid, parts, beam))
        start = np.maximum(feldkamp(a, y), 0)
        states = itertools.islice(projected_cg(LeastSquares(a, y, x0=start, nonnegative=True)), 16)
        errors[parts] = [nrmse(voxel_means(state.x.reshape(a.grid.shape), grid.shape), truth) for state in states]
    assert errors[1][-1] > 1.33 * min(errors[1])
    assert errors[2][-1] < 1.1 * min(errors[2]) < 1.1 * min(errors[1])
