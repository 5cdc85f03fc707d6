"""The sum of grids and constants in one cell: a grey part counts in each channel, and the scale multiplies all of it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.activation import activation_of
from mivol.transport.media.activated_grid_extinction import ActivatedGridExtinction
from mivol.transport.media.constant_extinction import ConstantExtinction
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.summed_extinction import SummedExtinction, share_cells
from mivol.transport.traversal.lattice import Lattice

pytestmark = pytest.mark.usefixtures("variant_rgb")


def lattice(channels: int = 1, res: tuple[int, ...] = (2, 2, 2), shift: float = 0.0) -> Lattice:
    place = np.eye(4)
    place[0, 3] = shift
    return Lattice(mi.TensorXf(np.zeros((*res, channels), np.float32)), place)


def corners(*values: float) -> list[list[mi.Float]]:
    """[channel][corner] of a read whose channels are the same everywhere in the cell."""
    return [[mi.Float(v)] * 8 for v in values]


def test_parts_are_summed_for_each_channel():
    """scale (grey grid + rgb grid + grey constant + rgb constant)."""
    parts = [
        GridExtinction("sigma_a", lattice()),
        ConstantExtinction("sigma_a", mi.Float(0.5)),
        GridExtinction("sigma_s", lattice(3)),
        ConstantExtinction("sigma_s", mi.Color3f(1, 2, 4)),
    ]
    found = SummedExtinction(parts, [p.values for p in parts], mi.Float(2))
    assert found.channels == 3 and found.has_constants
    np.testing.assert_array_equal(np.array(found.constant).ravel(), [3, 5, 9])
    points = [mi.Vector3f(0.25), mi.Vector3f(0.75)]
    rows = found.along([corners(8), corners(16, 32, 64)], points)
    np.testing.assert_array_equal(np.array(rows)[:, :, 0], np.repeat([[3 + 48], [5 + 80], [9 + 144]], 2, axis=1))
    assert found.slopes([corners(8)], points) is None


def test_points_of_a_cell_are_interpolated():
    """A cell that is x + 2 y + 4 z at its corners."""
    part = GridExtinction("sigma_t", lattice())
    found = SummedExtinction([part], [part.values], mi.Float(1))
    assert not found.has_constants
    ((value,),) = found.along([[[mi.Float(k) for k in range(8)]]], [mi.Vector3f(0.5, 0.25, 0.125)])
    assert value[0] == 0.5 + 2 * 0.25 + 4 * 0.125


def test_values_are_activated_and_tangents_are_not():
    part = ActivatedGridExtinction("sigma_t", lattice(), activation_of("relu"))
    below, above, point = corners(-3), corners(3), [mi.Vector3f(0.5)]
    values, tangents = (SummedExtinction([part], [part.values], mi.Float(1), linear=k) for k in (False, True))
    assert [values.along([c], point)[0][0][0] for c in (below, above)] == [0, 3]
    assert [tangents.along([c], point)[0][0][0] for c in (below, above)] == [-3, 3]
    assert [values.slopes([c], point)[0][0] for c in (below, above)] == [0, 1]


def test_cells_are_shared_by_grids_of_one_resolution_and_place():
    assert share_cells(lattice(), lattice(3))
    assert not share_cells(lattice(), lattice(res=(2, 2, 3)))
    assert not share_cells(lattice(), lattice(shift=1e-3))
