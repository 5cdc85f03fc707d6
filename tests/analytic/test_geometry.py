"""Where rays, pixels and voxels lie, by hand; what is no geometry; and that of TIGRE's tests, at any resolution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.tomography.geometry import ConeBeam, ParallelBeam, PencilRays, VoxelGrid, tigre_cone_beam


@pytest.mark.parametrize("n", [256, 64])
def test_the_cone_beam_of_tigre(n: int) -> None:
    """A detector of 409.6 mm and a cube of 256 mm, whatever the number of pixels and voxels."""
    beam, grid = tigre_cone_beam(n, 5)
    np.testing.assert_allclose(beam.angles, np.array([0, 0.5, 1, 1.5, 2]) * np.pi)
    assert beam.detector == (n, n) and grid.shape == (n, n, n)
    assert (beam.source_to_axis, beam.source_to_detector) == (1000, 1536)
    np.testing.assert_allclose(n * np.array(beam.pitch), 409.6)
    np.testing.assert_allclose(n * np.array(grid.voxel_size), 256)
    assert len(tigre_cone_beam()[0].angles) == 100 and tigre_cone_beam()[1].shape == (256,) * 3


ANGLES = np.array([0.3, 2.0, -1.1])


def by_hand(parallel: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(source or direction, places of the pixels, u, w) of a detector of 3 x 4 pixels of 2 x 0.5, its axis off by 0.7 and its
    middle by (0.2, -0.4)."""
    source, places, us, ws = [], [], [], []
    for angle in ANGLES:
        u, w = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        at = np.empty((3, 4, 3))
        for row in range(3):
            for column in range(4):
                right, up = (column - 1.5) * 0.5 - 0.4, (row - 1) * 2 + 0.2
                at[row, column] = (right - 0.7) * u + [0, 0, up] if parallel else right * u + [0, 0, up] + 9 * w
        start = -0.7 * u - 6 * w
        source.append(w if parallel else start)
        places.append(at if parallel else at + start)
        us.append(u)
        ws.append(w)
    return tuple(map(np.array, (source, places, us, ws)))


@pytest.mark.parametrize("views", [None, [2, 0], 1])
def test_rays_of_parallel_light(views: list | int | None) -> None:
    """Column by column, row by row, view by view; float64, a few roundings of numbers of order 5."""
    _, places, us, ws = by_hand(parallel=True)
    beam = ParallelBeam(ANGLES, (3, 4), (2.0, 0.5), 0.7, (0.2, -0.4))
    chosen = np.atleast_1d(np.arange(3) if views is None else views)
    o, d = beam.rays(views)
    assert beam.shape == (3, 3, 4) and beam.whole_lines
    np.testing.assert_allclose(o, places[chosen], atol=1e-14)
    np.testing.assert_allclose(d, np.broadcast_to(ws[chosen][:, None, None], o.shape), atol=1e-15)
    panels = beam.panels(views)
    np.testing.assert_allclose(panels.source, ws[chosen], atol=1e-15)
    np.testing.assert_allclose(panels.corner, places[chosen, 0, 0], atol=1e-14)
    np.testing.assert_allclose(panels.along_u, 0.5 * us[chosen], atol=1e-15)
    assert panels.along_v.tolist() == [[0, 0, 2]] * len(chosen)


@pytest.mark.parametrize("views", [None, [2, 0], 1])
def test_rays_of_a_cone(views: list | int | None) -> None:
    """The central ray passes the axis at its offset; pixels lie 9 from the source, the axis 6."""
    source, places, us, _ = by_hand(parallel=False)
    beam = ConeBeam(ANGLES, (3, 4), 6.0, 9.0, (2.0, 0.5), 0.7, (0.2, -0.4))
    chosen = np.atleast_1d(np.arange(3) if views is None else views)
    o, d = beam.rays(views)
    assert beam.shape == (3, 3, 4) and not beam.whole_lines
    away = places[chosen] - source[chosen][:, None, None]
    np.testing.assert_allclose(o, np.broadcast_to(source[chosen][:, None, None], o.shape), atol=1e-14)
    np.testing.assert_allclose(d, away / np.linalg.norm(away, axis=-1)[..., None], atol=1e-14)
    panels = beam.panels(views)
    np.testing.assert_allclose(panels.source, source[chosen], atol=1e-14)
    np.testing.assert_allclose(panels.corner, places[chosen, 0, 0], atol=1e-14)
    np.testing.assert_allclose(panels.along_u, 0.5 * us[chosen], atol=1e-15)
    assert panels.along_v.tolist() == [[0, 0, 2]] * len(chosen)


def test_a_grid_of_voxels() -> None:
    """2 x 3 x 4 voxels (Z, Y, X) of 0.5 x 1 x 2 around (1, 2, 3)."""
    grid = VoxelGrid((2, 3, 4), (0.5, 1.0, 2.0), (1.0, 2.0, 3.0))
    assert grid.size == 24 and grid.extent.tolist() == [2, 3, 4]
    assert grid.radius == pytest.approx(np.sqrt(29) / 2)
    assert grid.to_world.tolist() == [[2, 0, 0, 0], [0, 3, 0, 0.5], [0, 0, 4, 1], [0, 0, 0, 1]]
    assert grid.axis("x").tolist() == [0.25, 0.75, 1.25, 1.75]
    assert (grid.axis("y").tolist(), grid.axis("z").tolist()) == ([1, 2, 3], [2, 4])
    plain = VoxelGrid((1, 1, 1))
    assert (plain.voxel_size, plain.centre, plain.axis("z").tolist()) == ((1, 1, 1), (0, 0, 0), [0])
    with pytest.raises(ValueError, match="substring"):
        grid.axis("t")


def test_pencils_are_half_lines_of_their_own() -> None:
    rays = PencilRays([[1, 2, 3], [4, 5, 6]], [[0, 3, 4], [0, 0, -2]])
    assert rays.shape == (2, 1, 1) and not rays.whole_lines
    o, d = rays.rays([1])
    assert (o.tolist(), d.tolist()) == ([[[[4, 5, 6]]]], [[[[0, 0, -1]]]])
    np.testing.assert_allclose(rays.d[0], [0, 0.6, 0.8], atol=1e-15)
    with pytest.raises(ValueError, match="read-only"):
        rays.o[0] = 0


def cone(**change: object) -> ConeBeam:
    """A cone beam of 2 x 2 pixels, changed."""
    return ConeBeam(**{"angles": [0.0], "detector": (2, 2), "source_to_axis": 1.0, "source_to_detector": 2.0} | change)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        *[
            (lambda x=x: cone(source_to_axis=x), "expected positive lengths")
            for x in (0, -1, np.inf, np.nan, "a", None, [1, 2])
        ],
        *[(lambda x=x: cone(source_to_detector=x), "expected positive lengths") for x in (0, -1, np.inf, np.nan)],
        *[(lambda x=x: cone(pitch=x), "pixel pitch") for x in (0, (1, -1), (0, 1), np.inf, np.nan, "a", (1, 1, 1))],
        *[(lambda x=x: cone(angles=x), "view angles") for x in ([], [np.nan], [0, np.inf], None, "a")],
        *[
            (lambda x=x: cone(detector=x), r"expected \(rows, columns\)")
            for x in ((2,), (2, 0), (0, 2), (1, 2, 3), 2, "22", None, (2, 1.5))
        ],
        *[(lambda x=x: cone(detector_offset=x), "Found offsets") for x in ((0,), (0, np.nan), (np.inf, 0), None, "aa", 0)],
        (lambda: cone(axis_offset=np.inf), "Found offsets"),
        *[
            (lambda x=x: VoxelGrid(x), "grid shape")
            for x in ((2, 2), (2, 2, 0), (0, 2, 2), (1, 1, 1, 1), (2, 1.5, 2), 2, None, [[1, 2, 3]])
        ],
        *[(lambda x=x: VoxelGrid((1, 1, 1), x), "voxel size") for x in (0, (1, 1, -1), np.inf, np.nan, "a", (1, 2))],
        *[(lambda x=x: VoxelGrid((1, 1, 1), 1, x), "grid centre") for x in ((0, 0), (0, 0, np.nan), (np.inf, 0, 0), "a", None)],
        (lambda: PencilRays([0, 0, 0], [1, 0, 0]), "two equal arrays"),
        (lambda: PencilRays([[0, 0]], [[1, 0]]), "two equal arrays"),
        (lambda: PencilRays(np.zeros((2, 3)), np.ones((1, 3))), "two equal arrays"),
        (lambda: PencilRays(np.zeros((0, 3)), np.ones((0, 3))), "two equal arrays"),
        (lambda: PencilRays(np.zeros((2, 3)), [[1, 0, 0], [0, 0, 0]]), "index 1"),
        (lambda: PencilRays([[0, 0, 0], [0, np.nan, 0]], np.ones((2, 3))), "index 1"),
        (lambda: PencilRays(np.zeros((2, 3)), [[np.inf, 0, 0], [1, 0, 0]]), "index 0"),
        (lambda: cone().rays([0, 1]), "Found view 1, expected views from 0 to 0"),
        (lambda: cone().rays(-1), "Found view -1, expected views from 0 to 0"),
        *[
            (lambda x=x: cone().rays(x), "expected whole numbers in a row")
            for x in ("all", [0.5], [[0]], [np.nan], [[0], [0, 0]])
        ],
    ],
)
def test_what_is_no_geometry_is_refused(make: Callable, sentence: str) -> None:
    with pytest.raises(MivolError, match=sentence):
        make()


def test_the_least_of_everything_is_taken() -> None:
    """One view, one pixel, one voxel, the first and the last view."""
    assert ParallelBeam([0.0], (1, 1)).rays()[0].tolist() == [[[[0, 0, 0]]]]
    assert cone(detector=(1, 1)).rays(0)[1].tolist() == [[[[0, 1, 0]]]]
    assert cone(angles=[0.0, np.pi]).rays([0, 1])[0].shape == (2, 2, 2, 3)
    assert VoxelGrid((1, 1, 1), 1e-3).size == 1
    assert PencilRays([[0, 0, 0]], [[1, 0, 0]]).shape == (1, 1, 1)
