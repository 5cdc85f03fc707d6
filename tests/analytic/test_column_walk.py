"""The walk between columns: how far it goes, and where it begins afresh (what it sums: conformance/test_projector.py)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.traversal.column_walk import PIECE, ColumnCell, ColumnGrid, Corner, Hooks, Line, walk_columns


def test_strides_are_those_of_a_grid_with_a_margin() -> None:
    grid = ColumnGrid((3, 4, 5), 1)
    assert (grid.padded, grid.size, grid.strides, grid.rise, grid.across) == ((5, 6, 7), 210, (1, 7, 42), 7, (0, 2))


def test_a_walk_has_the_length_of_its_line_and_starts_afresh_at_each_layer(variant_rgb: str) -> None:
    """Lengths of cells add up to 1e-6 of the line's (a rounding of 3e-8 a cell, 32 in turn); a fresh start a layer and PIECE.

    The first line runs along x through 99 voxels without leaving its layer of z: ceil(99 / 32) = 4 starts. The second climbs a
    voxel in ten over 90, from the middle of a layer: it begins, and crosses 9 planes, less than 32 from one another.
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
