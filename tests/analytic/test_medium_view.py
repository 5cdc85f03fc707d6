"""Mitsuba's media as sums of fields: channels, emission, walked cells, and the place of stock grids."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.scene.readings import is_scattering
from mivol.scene.survey import SceneSurvey, ShapeFacts
from mivol.transport.media.extinction import ConstantExtinction
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.medium_view import MediumView, view_medium
from mivol.transport.traversal.box import Box
from mivol.transport.traversal.lattice import Lattice
from scenes import centred, grid_volume, medium, refused


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


def test_cells_of_the_light_are_those_of_its_density_and_else_the_finest():
    """A colour of finer cells does not make the cells of the density finer."""
    coarse, fine = (grid_volume("mivol_voxels", np.ones((3 * k, 4 * k, 5 * k, 1), np.float32)) for k in (1, 2))
    light = {"type": "mivol_medium", "sigma_t": 1.0, "albedo": coarse, "emission": fine}
    assert view_medium(mi.load_dict(light)).emission_lattice.res == (6, 8, 10)
    assert view_medium(mi.load_dict(light | {"emission_density": coarse})).emission_lattice.res == (3, 4, 5)


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


def scatters(description: dict) -> bool:
    return is_scattering(view_medium(mi.load_dict(description)), SceneSurvey((), ShapeFacts()), "box")


def test_a_medium_that_scatters_says_so():
    assert scatters(medium("homogeneous", 1.0, 0.5))
    assert not scatters(medium("homogeneous", 1.0, 0.0))
    both = {"type": "mivol_medium", "sigma_a": 1.0, "sigma_s": grid_volume("mivol_voxels", np.ones((3, 4, 5, 1), np.float32))}
    assert scatters(both)


def test_a_volume_of_another_package_needs_a_box():
    class Flat(mi.Volume):
        def max(self):
            return 1.0

        def traverse(self, callback):
            callback.put("data", mi.Float(1), mi.ParamFlags.Differentiable)  # a name that grids have too

    mi.register_texture("flat_volume", lambda props: Flat(props))
    place = mi.ScalarTransform4f().scale([1, 0, 1])
    with refused("volume Flat has the bounding box.*a finite box"):
        view_medium(mi.load_dict({"type": "heterogeneous", "sigma_t": {"type": "flat_volume", "to_world": place}}))


@pytest.mark.parametrize("name", ["emission", "albedo", "emission_density"])
def test_light_that_is_not_trilinear_is_refused_by_its_name(name: str) -> None:
    """The light of a medium is summed cell by cell, between the values of voxels."""
    voxels = np.random.default_rng(0).uniform(0.1, 1, (3, 4, 5, 1)).astype(np.float32)
    grid = grid_volume("gridvolume", voxels, np.eye(4))
    glows = {"type": "mivol_medium", "sigma_t": 1.0, "emission" if name != "emission_density" else name: 1.0}
    assert view_medium(mi.load_dict({**glows, name: grid}), Box(np.eye(4))).emits
    with refused(f"the {name} of a medium that emits is a gridvolume with another filter_type"):
        view_medium(mi.load_dict({**glows, name: grid | {"filter_type": "nearest"}}), Box(np.eye(4)))
