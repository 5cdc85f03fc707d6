"""What transport sees of a medium: its channels, whether it emits, whose cells are walked, and where stock grids end."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.media.box import Box
from mivol.transport.media.constant_extinction import ConstantExtinction
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.medium_view import MediumView
from mivol.transport.traversal.lattice import Lattice
from scenes import centred

pytestmark = pytest.mark.usefixtures("variant_rgb")


def grid(channels: int = 1) -> GridExtinction:
    return GridExtinction("sigma_s", Lattice(mi.TensorXf(np.zeros((2, 2, 2, channels), np.float32)), np.eye(4)))


def view(*parts: object, **more: object) -> MediumView:
    return MediumView(None, list(parts) or [ConstantExtinction("sigma_t", mi.Float(1))], mi.Float(1), **more)


def test_channels_are_those_of_the_richest_part():
    assert view().channels == 1
    assert view(grid(3), ConstantExtinction("sigma_a", mi.Float(1))).channels == 3


def test_light_is_emitted_with_the_extinction_or_beside_it():
    assert not view().emits
    assert view(emission=mi.Float(1)).emits and view(emission_density=mi.Float(1)).emits


def test_cells_are_those_of_the_extinction_and_else_of_the_light():
    light, grids = grid().lattice, [grid(), grid()]
    assert view().walked_lattice is None
    assert view(emission_lattice=light).walked_lattice is light
    assert view(ConstantExtinction("sigma_a", mi.Float(1)), *grids, emission_lattice=light).walked_lattice is grids[0].lattice


def test_a_stock_grid_holds_the_points_of_its_box():
    """[-1, 3] x [-2, 2] x [-3, 1]; a volume that asks this itself holds every point."""
    box, ours = SimpleNamespace(ptr=7), SimpleNamespace(ptr=8)
    found = view(stock_boxes={7: Box(centred(4 * np.eye(3), (1, 0, -1)))})
    inside = np.array([[1, 0, -1], [-0.5, 1.5, -2.5], [2.5, -1.5, 0.5]])
    beyond = [[-1.5, 0, -1], [3.5, 0, -1], [1, -2.5, -1], [1, 2.5, -1], [1, 0, -3.5], [1, 0, 1.5]]
    points = mi.Point3f(np.array([*inside, *beyond]).T.astype(np.float32))
    assert np.array(found.holds(box, points)).tolist() == [True] * 3 + [False] * 6
    assert np.array(found.holds(ours, points)).all()


def test_the_faces_of_a_box_belong_to_it():
    found = view(stock_boxes={7: Box(np.eye(4))})
    ends = mi.Point3f(np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]).T.astype(np.float32))
    assert np.array(found.holds(SimpleNamespace(ptr=7), ends)).all()
