"""Line integrals between columns with known closed forms, and the margin of nodes with its transpose."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.tomography.column_integral import (
    PIECE,
    ColumnCell,
    ColumnGrid,
    Corner,
    Hooks,
    Line,
    fold_nodes,
    integrate_columns,
    pad_nodes,
    walk_columns,
)

GRID = ColumnGrid((3, 4, 5), 2)


def test_a_margin_holds_the_outermost_values(variant_rgb: str) -> None:
    values = np.random.default_rng(0).random(GRID.res).astype(np.float32)
    padded = np.array(pad_nodes(mi.Float(values.ravel()), GRID))
    np.testing.assert_array_equal(padded.reshape(GRID.padded), np.pad(values, 1, mode="edge"))


def test_sums_of_the_margin_are_those_of_the_outermost_nodes(variant_rgb: str) -> None:
    """The transpose of the margin: <pad(x), g> = <x, fold(g)>, where g are the sums of feet and heads of columns.

    1e-6: float32 sums of at most 16 numbers between 0 and 1.
    """
    rng = np.random.default_rng(1)
    layer = GRID.strides[2]
    foot, head = np.zeros((2, GRID.size + 2 * layer), np.float32)
    # Columns whose feet are in the uppermost layer have no head.
    foot[layer:-layer], head[layer : -2 * layer] = rng.random(GRID.size), rng.random(GRID.size - layer)
    at_nodes = (foot + np.concatenate([np.zeros(layer), head[:-layer]]))[layer:-layer]
    found = np.array(fold_nodes(mi.Float(np.stack([foot, head], -1).ravel()), GRID))
    x = rng.random(GRID.res).astype(np.float32)
    assert np.isclose(np.pad(x, 1, mode="edge").ravel() @ at_nodes, x.ravel() @ found, rtol=1e-6)


def test_a_slope_is_integrated_exactly(variant_rgb: str) -> None:
    """Trilinear interpolation reproduces a linear function: its integral is the length times its value in the middle."""
    z, y, x = np.ogrid[:3, :4, :5]
    values = (1 + 2 * x - 0.5 * y + 3 * z).astype(np.float32)
    q, v, length = np.array([0.2, 0.3, 0.1]), np.array([0.9, 0.5, 0.4]), 4.0
    line = Line([mi.Float64([c]) for c in q], [mi.Float64([c]) for c in v], mi.Float64([length]))
    found = np.array(integrate_columns(GRID, pad_nodes(mi.Float(values.ravel()), GRID), line))[0]
    middle = q + v * length / 2
    # 2e-6: what the integral promises.
    assert np.isclose(found, length * (1 + middle @ (2, -0.5, 3)), rtol=2e-6)


def test_strides_are_those_of_a_grid_with_a_margin() -> None:
    grid = ColumnGrid((3, 4, 5), 1)
    assert (grid.padded, grid.size, grid.strides, grid.rise, grid.across) == ((5, 6, 7), 210, (1, 7, 42), 7, (0, 2))


def test_a_walk_has_the_length_of_its_line_and_starts_afresh_at_each_layer(variant_rgb: str) -> None:
    """Lengths of cells add up to 1e-6 of the length of the line (32 roundings of 3e-8); a fresh start at each layer and PIECE.

    The first line runs along x through 99 voxels in a single layer of z: ceil(99 / 32) = 4 starts. The second line climbs a
    voxel in ten over 90, from the middle of a layer: a start, and 9 crossed planes less than 32 voxels apart.
    """
    n = 100
    slope = np.array([0.0, 0.1])
    length = np.array([99.0, 90.0])
    q = [mi.Float64([0.25, 0.25]), mi.Float64([2.5, 2.5]), mi.Float64([1.5, 1.5])]
    v = [mi.Float64([1.0, 1.0]), mi.Float64([0.0, 0.0]), mi.Float64(slope)]

    def begin(corner: Corner, on: mi.Bool) -> mi.Float:
        return dr.select(on, mi.Float(1), 0)

    def visit(state: list[mi.Float], started: mi.Float, cell: ColumnCell) -> tuple[list[mi.Float], mi.Float]:
        return [state[0] + cell.dt, state[1] + 1, state[2]], started

    def cross(started: mi.Float, corner: Corner, through: mi.Bool, on: mi.Bool) -> mi.Float:
        return mi.Float(started)

    def close(state: list[mi.Float], started: mi.Float, corner: Corner, on: mi.Bool) -> list[mi.Float]:
        return [state[0], state[1], state[2] + started]

    hooks = Hooks(begin, visit, cross, close)
    state = [mi.Float(0), mi.Float(0), mi.Float(0)]
    walked, cells, starts = walk_columns(ColumnGrid((20, 5, n), 2), Line(q, v, mi.Float64(length)), hooks, state)
    assert np.array(walked) == pytest.approx(length, rel=1e-6)
    assert PIECE == 32
    assert np.array(starts).tolist() == [4, 10]
    # A plane of x a voxel, and a piece more at each fresh start that falls between two.
    assert (np.array(cells) <= length + 1 + np.array(starts)).all() and (np.array(cells) >= length).all()
