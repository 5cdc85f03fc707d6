"""What Mitsuba hides of its grids: where they are, and whether values between voxels are trilinear."""

from __future__ import annotations

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

import scenes
from mivol.experiments.script import explain
from mivol.transport.media import stock_grids
from mivol.transport.media.medium_view import view_medium
from mivol.transport.media.stock_grids import StockGrids, find_grid_place
from mivol.transport.traversal.box import Box, fit_box
from scenes import FRAMES, box_of, centred, grid_volume, medium

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


def test_a_grid_is_placed_once_for_each_boundary(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid in two boundaries has two places, and each place is found once."""
    asked = []

    def place(volume: object, boundary: Box | None) -> np.ndarray:
        asked.append((volume.ptr, boundary))
        return np.full((4, 4), len(asked))

    monkeypatch.setattr(stock_grids, "find_grid_place", place)
    one, two = (SimpleNamespace(ptr=number) for number in (1, 2))
    small, large = Box(np.eye(4)), Box(2 * np.diag([1.0, 1, 1, 0.5]))
    grids = StockGrids()
    calls = [(one, None), (one, small), (one, large), (two, None), (two, small)]
    for _ in range(2):
        assert [grids.place(v, b)[0, 0] for v, b in calls] == [1, 2, 3, 4, 5]
    assert asked == [(v.ptr, b) for v, b in calls]


PLACE = centred(2 * np.eye(3))
VOXELS = {c: np.random.default_rng(0).uniform(0.1, 1, (4, 5, 6, c)).astype(np.float32) for c in (1, 3)}
LONE = np.pad(VOXELS[1], ((50, 50), (50, 50), (50, 50), (0, 0)))
ROW = np.random.default_rng(2).uniform(0.1, 1, (1, 1, 90, 1))


def stock(values: np.ndarray, place: np.ndarray = PLACE, **more: object) -> mi.Medium:
    """A medium of a stock grid in a box that is its own."""
    return mi.load_dict(medium("heterogeneous", grid_volume("gridvolume", values, place) | more))


def is_walked(medium: mi.Medium, grids: StockGrids | None = None, place: np.ndarray = PLACE) -> bool:
    """Whether rays cross the cells of the grid, which assumes trilinear values."""
    return view_medium(medium, Box(place), grids).parts[0].exact_line


@pytest.mark.parametrize("more", [{"filter_type": "nearest"}, {"wrap_mode": "repeat"}], ids=["nearest", "repeat"])
@pytest.mark.parametrize("voxels", [VOXELS[1], VOXELS[3], ROW, LONE], ids=["grey", "rgb", "a row", "few of many"])
def test_grids_with_another_filter_or_border_are_read_at_points(voxels: np.ndarray, more: dict) -> None:
    """Where all borders are 0 they are the same in any case."""
    assert is_walked(stock(voxels, **more)) == (voxels is LONE and "wrap_mode" in more)


def test_a_transform_with_a_wrong_inverse_is_named() -> None:
    """Mitsuba's ``rotate`` about an axis that is not normalised; about the same axis of length 1 the grid is walked."""
    for axis, is_named in (([1, 1, 0], True), ([0.5**0.5, 0.5**0.5, 0], False)):
        turn = mi.ScalarTransform4f().rotate(axis, 30)
        grid = {"type": "gridvolume", "grid": mi.VolumeGrid(VOXELS[1].astype(np.float32)), "to_world": turn}
        box = {"type": "cube", "to_world": turn.translate(0.5).scale(0.5), "bsdf": {"type": "null"}}
        interior = {"type": "heterogeneous", "sigma_t": grid, "albedo": 0.5}
        sensor = scenes.camera([3, 3, 3], [0, 0, 0])
        text = explain({"type": "scene", "box": {**box, "interior": interior}, "sky": scenes.sky(), "sensor": sensor})
        assert ("wrong inverse" in str(text)) is is_named


def test_trilinear_grids_are_walked() -> None:
    """In turned boxes, with one voxel, with mirrored borders (which are clamped as far as a grid goes)."""
    turned = centred(1.3 * scenes.rotation([1, 2, 3], 0.7), (90, 50, -3))
    many = np.random.default_rng(1).uniform(0, 1, (70, 80, 90, 1))
    assert is_walked(stock(many, turned), place=turned)
    assert is_walked(stock(VOXELS[1][:1, :1, :1]))
    assert is_walked(stock(VOXELS[1], wrap_mode="mirror"))


def test_a_constant_grid_is_looked_at_again() -> None:
    """It does not tell its filter; with other values it does."""
    grids, changed = StockGrids(), stock(np.full((3, 3, 3, 1), 0.7), filter_type="nearest")
    assert is_walked(changed, grids)
    params = mi.traverse(changed)
    params["sigma_t.data"] = scenes.tensor(VOXELS[1])
    params.update()
    assert not is_walked(changed, grids)
