"""Line integrals between columns where they are known in closed form, and the margin of nodes and its transpose."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mivol.transport.media.column_integral import fold_nodes, integrate_columns, pad_nodes
from mivol.transport.traversal.column_walk import ColumnGrid, Line

GRID = ColumnGrid((3, 4, 5), 2)


def test_a_margin_holds_the_outermost_values(variant_rgb: str) -> None:
    values = np.random.default_rng(0).random(GRID.res).astype(np.float32)
    padded = np.array(pad_nodes(mi.Float(values.ravel()), GRID))
    np.testing.assert_array_equal(padded.reshape(GRID.padded), np.pad(values, 1, mode="edge"))


def test_sums_of_the_margin_are_those_of_the_outermost_nodes(variant_rgb: str) -> None:
    """The transpose of the margin: <pad(x), g> = <x, fold(g)>, where g is what feet and heads of columns have got.

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
    """Trilinear interpolation holds a linear function as it is: its integral is the length times its value in the middle."""
    z, y, x = np.ogrid[:3, :4, :5]
    values = (1 + 2 * x - 0.5 * y + 3 * z).astype(np.float32)
    q, v, length = np.array([0.2, 0.3, 0.1]), np.array([0.9, 0.5, 0.4]), 4.0
    line = Line([mi.Float64([c]) for c in q], [mi.Float64([c]) for c in v], mi.Float64([length]))
    found = np.array(integrate_columns(GRID, pad_nodes(mi.Float(values.ravel()), GRID), line))[0]
    middle = q + v * length / 2
    # 2e-6: what the integral promises.
    assert np.isclose(found, length * (1 + middle @ (2, -0.5, 3)), rtol=2e-6)
