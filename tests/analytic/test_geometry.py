"""Where rays, pixels and voxels lie, by hand; what is no geometry; and that of TIGRE's tests, at any resolution."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from mivol import config
from mivol.experiments import projections
from mivol.optim.projections.iterative import projected_cg
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.tomography.filtered import feldkamp
from mivol.tomography.geometry import (
    ConeBeam,
    ParallelBeam,
    PencilRays,
    VoxelGrid,
    subdivide_grid,
    tigre_cone_beam,
    voxel_means,
)
from mivol.tomography.panel_views import PanelViews, panels_from_matrices
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector
from mivol.validate.metrics import nrmse


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
@pytest.mark.parametrize("parallel", [True, False], ids=["parallel", "cone"])
def test_rays_and_panels_of_views(parallel: bool, views: list | int | None) -> None:
    """Column by column, row by row, view by view; float64, a few roundings of numbers of order 5.

    The central ray of a cone passes the axis at its offset; pixels lie 9 from the source, the axis 6.
    """
    source, places, us, ws = by_hand(parallel)
    size = (3, 4), *(() if parallel else (6.0, 9.0)), (2.0, 0.5), 0.7, (0.2, -0.4)
    beam = (ParallelBeam if parallel else ConeBeam)(ANGLES, *size)
    chosen = np.atleast_1d(np.arange(3) if views is None else views)
    o, d = beam.rays(views)
    assert beam.shape == (3, 3, 4) and beam.whole_lines == parallel
    start, away = (places, ws[:, None, None]) if parallel else (source[:, None, None], places - source[:, None, None])
    np.testing.assert_allclose(o, np.broadcast_to(start[chosen], o.shape), atol=1e-14)
    np.testing.assert_allclose(
        d, np.broadcast_to(away[chosen], d.shape) / np.linalg.norm(away[chosen], axis=-1)[..., None], atol=1e-14
    )
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
        (lambda: cone(source_to_axis=2.0, source_to_detector=1.0), "swap source_to_axis and source_to_detector"),
        (lambda: Projector(cone(angles=[0.0, 1.0]), VoxelGrid((1, 1, 1))).subset([0, 2]), "view 2, expected views from 0 to 1"),
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
    assert_refused(sentence, make)


def test_the_least_of_everything_is_taken() -> None:
    """One view, one pixel, one voxel, the first and the last view."""
    assert ParallelBeam([0.0], (1, 1)).rays()[0].tolist() == [[[[0, 0, 0]]]]
    assert cone(detector=(1, 1)).rays(0)[1].tolist() == [[[[0, 1, 0]]]]
    assert cone(angles=[0.0, np.pi]).rays([0, 1])[0].shape == (2, 2, 2, 3)
    assert VoxelGrid((1, 1, 1), 1e-3).size == 1
    assert PencilRays([[0, 0, 0]], [[1, 0, 0]]).shape == (1, 1, 1)


BEAM = ConeBeam(np.array([0.2, 1.9, 4.0]), (5, 4), 7.0, 11.0, (0.3, 0.4), axis_offset=0.6, detector_offset=(-0.2, 0.7))
GOOD = np.array([0, -5, 0, 0, 5, 0, 0.5, 0, 0, 0, 0, 0.25], float)


def table_of(beam: ConeBeam) -> PanelViews:
    panels = beam.panels()
    rows, columns = beam.detector
    middle = panels.corner + (columns - 1) / 2 * panels.along_u + (rows - 1) / 2 * panels.along_v
    return PanelViews(np.hstack([panels.source, middle, panels.along_u, panels.along_v]), beam.detector)


def test_rays_and_panels_are_those_of_a_cone_beam() -> None:
    """A circular scanner with every offset, written as a table: the same rays, to the rounding of float64."""
    table = table_of(BEAM)
    assert table.shape == BEAM.shape
    for found, expected in zip(table.rays([1, 0]), BEAM.rays([1, 0]), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-14)
    np.testing.assert_allclose(table.panels().corner, BEAM.panels().corner, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"columns": 11}, r"shape \(1, 11\), expected \(views, 12\)"),
        ({"at": {3: np.nan}}, "not finite in view 0"),
        ({"at": {11: 0.0}}, "without area in view 0"),
        ({"at": {1: 5.0}}, "source in the detector's plane in view 0"),
    ],
)
def test_tables_that_place_no_detector_are_refused(change: dict, sentence: str) -> None:
    row = GOOD[: change.get("columns", 12)].copy()
    for column, value in change.get("at", {}).items():
        row[column] = value
    assert_refused(sentence, PanelViews, row[None], (3, 3))


def matrices_of(beam: ConeBeam) -> np.ndarray:
    """(views, 3, 4) by way of the camera: intrinsics in pixels, times rotation and translation."""
    found = []
    for angle in beam.angles:
        u, w = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
        source = -beam.axis_offset * u - beam.source_to_axis * w
        turned = np.stack([u, [0.0, 0.0, 1.0], w])
        f_v, f_u = beam.source_to_detector / np.array(beam.pitch)
        # Where the central ray meets the detector, in pixels from the middle of the first.
        c_u = (beam.detector[1] - 1) / 2 - beam.detector_offset[1] / beam.pitch[1]
        c_v = (beam.detector[0] - 1) / 2 - beam.detector_offset[0] / beam.pitch[0]
        inner = np.array([[f_u, 0.0, c_u], [0.0, f_v, c_v], [0.0, 0.0, 1.0]])
        found.append(inner @ np.hstack([turned, -(turned @ source)[:, None]]))
    return np.array(found)


@pytest.mark.parametrize("factor", [1.0, -3e4])
def test_rays_are_those_of_the_equal_table(factor: float) -> None:
    """Inverting a matrix whose condition is about 100 leaves 1e-14 of the lengths of 10 or so."""
    found = panels_from_matrices(factor * matrices_of(BEAM), BEAM.detector)
    for ours, theirs in zip(found.rays([2, 0]), table_of(BEAM).rays([2, 0]), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_pixels_may_be_counted_from_elsewhere() -> None:
    """From the first pixel's corner, and from 1 on."""
    moved = np.array([[1.0, 0.0, 1.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]) @ matrices_of(BEAM)
    found = panels_from_matrices(moved, BEAM.detector, first_pixel=(1.5, 0.5))
    np.testing.assert_allclose(found.rays()[1], table_of(BEAM).rays()[1], atol=1e-12)


def test_the_half_of_a_line_that_is_meant_is_told_by_what_is_seen() -> None:
    """A source between the origin and the object: rays run to the object, and the origin is behind them."""
    beyond = 2 * table_of(BEAM).table[0, :3]
    found = panels_from_matrices(matrices_of(BEAM)[:1], BEAM.detector, seen=beyond)
    np.testing.assert_allclose(found.rays()[1], -table_of(BEAM).rays([0])[1], atol=1e-12)


@pytest.mark.parametrize(
    ("at", "value", "sentence"),
    [
        ((1, 0, 0), np.nan, "not finite in the projection matrix of view 1"),
        ((2, 2, slice(0, 3)), 0.0, "singular left half in the projection matrix of view 2"),
        ((slice(1, 3), slice(None), slice(None)), 0.0, "singular left half in the projection matrix of view 1"),
        ((1, 2, 3), 0.0, r"\(0.0, 0.0, 0.0\) beside the source in the projection matrix of view 1"),
    ],
)
def test_matrices_without_a_source_are_refused(at: tuple, value: float, sentence: str) -> None:
    matrices = matrices_of(BEAM)
    matrices[at] = value
    assert_refused(sentence, panels_from_matrices, matrices, BEAM.detector)


def test_matrices_of_another_shape_are_refused() -> None:
    assert_refused(r"shape \(3, 12\), expected \(views, 3, 4\)", panels_from_matrices, np.ones((3, 12)), (2, 2))


def test_a_file_of_matrices_is_the_beam_of_a_scan(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "matrices.txt", matrices_of(BEAM).reshape(-1, 12))
    chosen = config.from_dict(
        {
            "title": "matrices",
            "scan": {"beam": "matrices", "file": "matrices.txt", "detector": [5, 4]},
            "data": {"source": "shepp_logan"},
            "grid": {"shape": [2, 2, 2]},
        }
    )
    found = projections.make_geometry(chosen, tmp_path)
    np.testing.assert_allclose(found.rays()[1], table_of(BEAM).rays()[1], atol=1e-12)


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


@pytest.mark.parametrize("kind", ["parallel", "cone"])
def test_moved_and_tilted_detectors(kind: str) -> None:
    """Rays by hand: a pixel of a detector that is displaced, turned about its middle, and leans with the light."""
    angles, tilt = np.array([0.3, 1.9]), 0.2
    moves = np.array([[0.5, -1.25, 0.1], [0.0, 2.0, -0.3]])
    more = {"pitch": (0.5, 0.25), "axis_offset": 0.3, "detector_offset": (0.1, 0.2), "tilt": tilt, "moves": moves}
    beam = ConeBeam(angles, (4, 6), 5.0, 9.0, **more) if kind == "cone" else ParallelBeam(angles, (4, 6), **more)
    o, d = beam.rays()
    for view, angle in enumerate(angles):
        row, column, turn = moves[view]
        u = np.array([np.cos(angle), np.sin(angle), 0])
        w = np.array([-np.sin(angle) * np.cos(tilt), np.cos(angle) * np.cos(tilt), np.sin(tilt)])
        v = np.cross(u, w)
        offset = 0.2 - (0.3 if kind == "parallel" else 0.0)
        source = -0.3 * u - 5 * w
        middle = (offset + 0.25 * column) * u + (0.1 + 0.5 * row) * v + (source + 9 * w if kind == "cone" else 0)
        across, up = np.cos(turn) * u + np.sin(turn) * v, np.cos(turn) * v - np.sin(turn) * u
        pixel = middle + (1 - 2.5) * 0.25 * across + (3 - 1.5) * 0.5 * up
        light = w if kind == "parallel" else (pixel - source) / np.linalg.norm(pixel - source)
        np.testing.assert_allclose(d[view, 3, 1], light, atol=1e-14)
        np.testing.assert_allclose(np.cross(pixel - o[view, 3, 1], light), 0, atol=1e-14)
    assert_refused("moves of shape", replace, beam, moves=moves[:, :2])
    assert_refused("tilt of 2 rad", replace, beam, tilt=2)
