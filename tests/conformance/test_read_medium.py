"""Where the grids of Mitsuba's media lie, and which volumes a medium may have."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

import scenes
from mivol.scene.readings import is_scattering
from mivol.scene.survey import SceneSurvey
from mivol.transport.media import read_medium
from mivol.transport.media.box import Box, box_of_cube
from mivol.transport.media.read_medium import place_of_grid, view_medium
from scenes import FRAMES, box_of, grid_volume, medium, refused

pytestmark = pytest.mark.usefixtures("variant_rgb")


VALUES = np.ones((3, 4, 5, 1), np.float32)


@pytest.mark.parametrize("draw", range(6))
def test_a_stock_grid_that_fills_its_boundary_is_placed_exactly(draw):
    """The six digits that a gridvolume prints are replaced by the boundary's vertices (float32)."""
    rng = np.random.default_rng(draw)
    turned = scenes.rotation(rng.normal(size=3), rng.uniform(0.3, 3)) @ np.diag(rng.uniform(1, 3, 3))
    place = scenes.centred(turned, rng.uniform(1, 3, 3))
    cube = mi.load_dict(box_of(medium("heterogeneous", grid_volume("gridvolume", VALUES, place)), place))
    found = view_medium(cube.interior_medium(), box_of_cube(cube)).parts[0].lattice.to_world
    # Vertices of size 6 at most, each rounded to half an ulp (2^-22) once in the transform and once in the product; the fit
    # over 24 of them averages. Six digits would leave 5e-6.
    assert np.abs(found - place).max() <= 2 * 2.0**-22


@pytest.mark.parametrize("frame", FRAMES)
def test_a_stock_grid_elsewhere_is_placed_to_six_digits(frame):
    place = FRAMES[frame]
    volume = mi.load_dict(grid_volume("gridvolume", VALUES, place))
    # The promise of place_of_grid: 5e-6 of the size.
    assert np.abs(place_of_grid(volume) - place).max() <= 5e-6 * np.abs(place).max()


def test_our_grid_knows_its_place():
    place = FRAMES["sheared"]
    volume = mi.load_dict(grid_volume("mivol_voxels", VALUES, place))
    assert np.array_equal(place_of_grid(volume), np.float32(place).astype(np.float64))


def scatters(description: dict) -> bool:
    return is_scattering(view_medium(mi.load_dict(description)), SceneSurvey((), (), False, (), (), False, ()), "box")


def test_a_medium_that_scatters_says_so():
    assert scatters(medium("homogeneous", 1.0, 0.5))
    assert not scatters(medium("homogeneous", 1.0, 0.0))
    both = {"type": "mivol_medium", "sigma_a": 1.0, "sigma_s": grid_volume("mivol_voxels", VALUES)}
    assert scatters(both)


def test_a_volume_of_another_kind_is_refused():
    """A medium over something that is neither a number nor a grid."""

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
    """The same grid in two boundaries has two places, and each is found once."""
    asked = []

    def place(volume: object, boundary: Box | None) -> np.ndarray:
        asked.append((volume.ptr, boundary))
        return np.full((4, 4), len(asked))

    monkeypatch.setattr(read_medium, "place_of_grid", place)
    one, two = (SimpleNamespace(ptr=number) for number in (1, 2))
    small, large = Box(np.eye(4)), Box(2 * np.diag([1.0, 1, 1, 0.5]))
    places: dict = {}
    calls = [(one, None), (one, small), (one, large), (two, None), (two, small)]
    for _ in range(2):
        assert [read_medium._place(v, b, places)[0, 0] for v, b in calls] == [1, 2, 3, 4, 5]
    assert asked == [(v.ptr, b) for v, b in calls]
