"""Mitsuba's media as sums of fields: channels, emission, walked cells, and the place of stock grids."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

import scenes
from mivol.scene.readings import is_scattering
from mivol.scene.survey import SceneSurvey, ShapeFacts
from mivol.transport.media import medium_view
from mivol.transport.media.extinction import ConstantExtinction
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.medium_view import MediumView, find_grid_place, view_medium
from mivol.transport.traversal.box import Box, fit_box
from mivol.transport.traversal.lattice import Lattice
from scenes import FRAMES, box_of, centred, grid_volume, medium, refused

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
    """[-1, 3] x [-2, 2] x [-3, 1]; a volume that tests its own box holds every point."""
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


VALUES = np.ones((3, 4, 5, 1), np.float32)


@pytest.mark.parametrize("draw", range(6))
def test_a_stock_grid_that_fills_its_boundary_is_placed_exactly(draw):
    """The float32 vertices of the boundary replace the six printed digits of a gridvolume."""
    rng = np.random.default_rng(draw)
    turned = scenes.rotation(rng.normal(size=3), rng.uniform(0.3, 3)) @ np.diag(rng.uniform(1, 3, 3))
    place = scenes.centred(turned, rng.uniform(1, 3, 3))
    cube = mi.load_dict(box_of(medium("heterogeneous", grid_volume("gridvolume", VALUES, place)), place))
    found = view_medium(cube.interior_medium(), fit_box(cube)).parts[0].lattice.to_world
    # Vertices of size 6 at most, each rounded to half an ulp (2^-22) once in the transform and once in the product; the fit
    # over 24 of them averages. Six digits would leave 5e-6.
    assert np.abs(found - place).max() <= 2 * 2.0**-22


@pytest.mark.parametrize("frame", FRAMES)
def test_a_stock_grid_elsewhere_is_placed_to_six_digits(frame):
    place = FRAMES[frame]
    volume = mi.load_dict(grid_volume("gridvolume", VALUES, place))
    # The promise of place_of_grid: 5e-6 of the size.
    assert np.abs(find_grid_place(volume) - place).max() <= 5e-6 * np.abs(place).max()


def test_our_grid_knows_its_place():
    place = FRAMES["sheared"]
    volume = mi.load_dict(grid_volume("mivol_voxels", VALUES, place))
    assert np.array_equal(find_grid_place(volume), np.float32(place).astype(np.float64))


def scatters(description: dict) -> bool:
    return is_scattering(view_medium(mi.load_dict(description)), SceneSurvey((), ShapeFacts()), "box")


def test_a_medium_that_scatters_says_so():
    assert scatters(medium("homogeneous", 1.0, 0.5))
    assert not scatters(medium("homogeneous", 1.0, 0.0))
    both = {"type": "mivol_medium", "sigma_a": 1.0, "sigma_s": grid_volume("mivol_voxels", VALUES)}
    assert scatters(both)


def test_a_volume_of_another_kind_is_refused():
    """A medium over a volume that is neither a number nor a grid."""

    class Odd(mi.Volume):
        def max(self):
            return 1.0

        def traverse(self, callback):
            callback.put("strange", mi.Float(1), mi.ParamFlags.Differentiable)

        def to_string(self):
            return "Odd"

    mi.register_texture("odd_volume", lambda props: Odd(props))
    odd = mi.load_dict({"type": "heterogeneous", "sigma_t": {"type": "odd_volume"}, "albedo": 0.0})
    with refused("strange.*gridvolume"):
        view_medium(odd)


def test_a_grid_is_placed_once_for_each_boundary(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid in two boundaries has two places, and each place is found once."""
    asked = []

    def place(volume: object, boundary: Box | None) -> np.ndarray:
        asked.append((volume.ptr, boundary))
        return np.full((4, 4), len(asked))

    monkeypatch.setattr(medium_view, "find_grid_place", place)
    one, two = (SimpleNamespace(ptr=number) for number in (1, 2))
    small, large = Box(np.eye(4)), Box(2 * np.diag([1.0, 1, 1, 0.5]))
    places: dict = {}
    calls = [(one, None), (one, small), (one, large), (two, None), (two, small)]
    for _ in range(2):
        assert [medium_view._place(v, b, places)[0, 0] for v, b in calls] == [1, 2, 3, 4, 5]
    assert asked == [(v.ptr, b) for v, b in calls]
