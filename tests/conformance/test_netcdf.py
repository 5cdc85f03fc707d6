"""Volumes of atmospheric models in NetCDF: axes, places, units, times, stretched levels, and files that are refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from netcdf_files import WRITERS, write_classic, write_hdf5
from refusals import assert_refused
from tiny_experiment import run

from mivol.errors import MivolError
from mivol.files import netcdf, read_volume

VALUES = np.arange(1, 61, dtype=np.float32).reshape(3, 4, 5)
"""(z, y, x)."""

METRES = {"units": "m"}


def even(name: str, length: int, step: float = 40.0, **attributes: object) -> dict:
    """A coordinate with centres at step / 2, 3 step / 2, ..."""
    return {name: ((name,), step * (np.arange(length) + 0.5), {"units": "m", **attributes})}


def model(**more: object) -> dict:
    """Coordinates of 20, 30 and 40 m, and a variable."""
    return {**even("z", 3, 40.0), **even("y", 4, 30.0), **even("x", 5, 20.0), "ql": (("z", "y", "x"), VALUES, {}), **more}


@pytest.fixture(params=WRITERS)
def write(request: pytest.FixtureRequest) -> Callable:
    return WRITERS[request.param]


def assert_placed(path: Path, values: np.ndarray, dataset: str | None = None) -> None:
    """The values, on voxels of 20 x 30 x 40 m from the origin."""
    volume = read_volume(path, dataset)
    np.testing.assert_array_equal(volume.values[..., 0], values)
    np.testing.assert_allclose(volume.spacing, (20, 30, 40), rtol=1e-12)
    np.testing.assert_allclose(volume.to_world[:3, 3], 0, atol=1e-9)
    assert (volume.meta["unit"], volume.meta["notes"]) == ("m", ())


def test_a_variable_is_placed_by_its_coordinates(tmp_path: Path, write: Callable) -> None:
    write(tmp_path / "a.nc", model())
    assert_placed(tmp_path / "a.nc", VALUES)


NAMES = {
    "large-eddy simulations": ("zt", "yt", "xt"),
    "levels of a soil model": ("zu_3d", "yv", "xu"),
    "spelt out": ("height", "northing", "easting"),
}


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES.keys())
def test_axes_are_found_by_names(tmp_path: Path, names: tuple[str, str, str]) -> None:
    """In any order: here x, y, z."""
    z, y, x = names
    arrays = {**even(z, 3, 40.0), **even(y, 4, 30.0), **even(x, 5, 20.0), "ql": ((x, y, z), VALUES.T, {})}
    write_hdf5(tmp_path / "a.nc", arrays)
    assert_placed(tmp_path / "a.nc", VALUES)


@pytest.mark.parametrize("key", ["axis", "standard_name"])
def test_axes_are_found_by_attributes(tmp_path: Path, key: str) -> None:
    said = {"axis": ("Z", "Y", "X"), "standard_name": ("height", "projection_y_coordinate", "projection_x_coordinate")}[key]
    arrays = {}
    for name, length, step, word in zip("abc", (3, 4, 5), (40.0, 30.0, 20.0), said, strict=True):
        arrays |= even(name, length, step, **{key: word})
    write_hdf5(tmp_path / "a.nc", {**arrays, "ql": (("c", "a", "b"), VALUES.transpose(2, 0, 1), {})})
    assert_placed(tmp_path / "a.nc", VALUES)


def test_nameless_axes_are_z_y_x(tmp_path: Path) -> None:
    write_classic(tmp_path / "a.nc", {"ql": (("a", "b", "c"), VALUES, {})})
    volume = read_volume(tmp_path / "a.nc")
    np.testing.assert_array_equal(volume.values[..., 0], VALUES)
    np.testing.assert_array_equal(volume.spacing, 1)
    assert volume.meta["notes"] == (
        "the dimensions a, b, c are z, y and x, by their order.", "the axes have no coordinates: a voxel counts as 1.",
    )  # fmt: skip


def test_units_of_lengths_and_descending_axes(tmp_path: Path, write: Callable) -> None:
    """Kilometres become metres, and depths and rows from the north are turned around."""
    arrays = model(
        z=(("z",), 0.04 * (np.arange(3) - 2.5), {"units": "kilometers", "positive": "down"}),
        y=(("y",), 30 * (3.5 - np.arange(4)), METRES),
    )
    write(tmp_path / "a.nc", arrays)
    # Of depths -.1, -.06 and -.02 km the first is the highest.
    volume = read_volume(tmp_path / "a.nc")
    np.testing.assert_array_equal(volume.values[..., 0], VALUES[::-1, ::-1])
    np.testing.assert_allclose(volume.spacing, (20, 30, 40), rtol=1e-12)
    np.testing.assert_allclose(volume.to_world[:3, 3], 0, atol=1e-9)


@pytest.mark.parametrize(
    ("units", "factor"),
    [
        ("km-1", 1e-3),
        ("1/km", 1e-3),
        ("km^-1", 1e-3),
        ("Mm-1", 1e-6),
        ("mm-1", 1e3),
        ("/cm", 100.0),
        ("m-1", 1.0),
        ("kg-1", 1.0),
    ],
)
def test_values_per_length_become_values_per_metre(tmp_path: Path, units: str, factor: float) -> None:
    """As their coordinates do, so that optical depths stay; voxels without coordinates keep their values."""
    write_classic(tmp_path / "a.nc", model(ql=(("z", "y", "x"), VALUES, {"units": units})))
    volume = read_volume(tmp_path / "a.nc")
    np.testing.assert_allclose(volume.values[..., 0], VALUES * factor, rtol=2**-23)
    assert volume.meta["notes"] == ((f"values in {units} became values in 1/m.",) if factor != 1 else ())
    write_classic(tmp_path / "b.nc", {"ql": (("z", "y", "x"), VALUES, {"units": units})})
    np.testing.assert_array_equal(read_volume(tmp_path / "b.nc").values[..., 0], VALUES)


def test_one_of_several_times(tmp_path: Path, write: Callable) -> None:
    both = np.stack([VALUES, 2 * VALUES])
    write(tmp_path / "a.nc", model(ql=(("time", "z", "y", "x"), both, {}), time=(("time",), np.array([0.0, 60.0]), {})))
    assert_placed(tmp_path / "a.nc", 2 * VALUES, "ql[1]")
    assert_refused(r"ql with 2 entries along time, .*name an entry: ql\[1\] is the last", read_volume, tmp_path / "a.nc")
    with pytest.raises(MivolError, match=r"no entry \[2\] of ql with 2 entries .*up to ql\[1\]; count from 0"):
        read_volume(tmp_path / "a.nc", "ql[2]")


def test_a_single_time_needs_no_choice(tmp_path: Path, write: Callable) -> None:
    write(tmp_path / "a.nc", model(ql=(("time", "z", "y", "x"), VALUES[None], {})))
    assert_placed(tmp_path / "a.nc", VALUES)
    assert_placed(tmp_path / "a.nc", VALUES, "ql[0]")
    with pytest.raises(MivolError, match=r"ql with one entry and the choice \[1, 2\].*name it without a choice: ql"):
        read_volume(tmp_path / "a.nc", "ql[1,2]")


def test_packed_numbers_and_missing_ones(tmp_path: Path, write: Callable) -> None:
    packing = {"scale_factor": 0.25, "add_offset": -3.0, "_FillValue": np.int16(-1)}
    stored = VALUES.astype("i2")
    stored[0, 1, 2] = -1
    write(tmp_path / "a.nc", model(ql=(("z", "y", "x"), stored, packing)))
    expected = 0.25 * VALUES - 3
    expected[0, 1, 2] = np.nan
    assert_placed(tmp_path / "a.nc", expected)


def test_stretched_levels_keep_their_integrals(tmp_path: Path, write: Callable) -> None:
    """Levels of 10, 15 and 20 m become four of 11.25 m; a missing voxel stays in its level."""
    values = VALUES.copy()
    values[2, 0, 0] = np.nan
    stretched = model(z=(("z",), np.array([5.0, 15.0, 35.0]), METRES), ql=(("z", "y", "x"), values, {}))
    write(tmp_path / "a.nc", stretched)
    volume = read_volume(tmp_path / "a.nc")
    # Edges in the middle of centres.
    edges, count = np.array([0, 10, 25, 45]), 4
    assert volume.values.shape == (count, 4, 5, 1)
    np.testing.assert_allclose(volume.spacing, (20, 30, 45 / count), rtol=1e-12)
    np.testing.assert_allclose(volume.to_world[:3, 3], 0, atol=1e-9)
    integral = (values * np.diff(edges)[:, None, None]).sum(axis=0)
    np.testing.assert_allclose(volume.values[..., 0].sum(axis=0)[1:] * 45 / count, integral[1:], rtol=1e-6)
    np.testing.assert_allclose(volume.values[0, 0, 0, 0], (10 * values[0, 0, 0] + 1.25 * values[1, 0, 0]) / 11.25, rtol=1e-6)
    assert np.isnan(volume.values[2:, 0, 0, 0]).all() and np.isfinite(volume.values[:2, 0, 0, 0]).all()
    assert volume.meta["notes"] == ("uneven steps along z became 4 even ones of 11.25 m, integrals kept.",)


def test_water_of_at3d_has_an_extinction(tmp_path: Path, write: Callable) -> None:
    """1.5 lwc / reff, in kilometres where no unit is given; a dry cell has no radius."""
    axes = {name: ((name,), 0.02 * (np.arange(n) + 0.5), {}) for name, n in zip("xyz", (5, 4, 3), strict=True)}
    radius = np.full(VALUES.shape, 10.0)
    radius[0, 0, 0] = np.nan
    water = {"lwc": (("z", "y", "x"), VALUES, {}), "reff": (("z", "y", "x"), radius, {})}
    write(tmp_path / "a.nc", {**axes, **water})
    volume = read_volume(tmp_path / "a.nc", "extinction")
    expected = 0.15 * VALUES
    expected[0, 0, 0] = 0
    np.testing.assert_allclose(volume.values[..., 0], expected, rtol=1e-6)
    np.testing.assert_allclose(volume.spacing, 20, rtol=1e-12)
    assert volume.meta["notes"] == ("coordinates without a unit are in km.",)
    assert_refused("3 arrays", read_volume, tmp_path / "a.nc")


REFUSED = {
    "degrees": (model(x=(("x",), np.arange(5.0), {"units": "degrees_east"})), "x in degrees_east, expected a length"),
    "pressures": (model(z=(("z",), np.arange(3.0), {"units": "hPa"})), "z in hPa, expected a length"),
    "half a place": ({k: v for k, v in model().items() if k != "y"}, "no coordinate along y, expected a"),
    "no order": (model(z=(("z",), np.array([0.0, 2.0, 1.0]), METRES)), "a coordinate z that does not rise or fall throughout"),
    "steps beyond reason": (model(z=(("z",), np.array([0.0, 1e-9, 1.0]), METRES)), "steps of 1e-09 to 1 m, expected an"),
    "text": (model(ql=(("z", "y", "x"), np.full((3, 4, 5), b"a"), {})), "numbers of type"),
    "no volume": ({**even("z", 3)}, "0 arrays"),
}  # fmt: skip


@pytest.mark.parametrize(("arrays", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_what_has_no_place_is_refused(tmp_path: Path, write: Callable, arrays: dict, said: str) -> None:
    write(tmp_path / "a.nc", arrays)
    assert_refused(said, read_volume, tmp_path / "a.nc")


def test_other_kinds_of_files_are_refused(tmp_path: Path) -> None:
    write_classic(tmp_path / "a.nc", model())
    data = (tmp_path / "a.nc").read_bytes()
    (tmp_path / "wide.nc").write_bytes(netcdf.WIDE + data[4:])
    assert_refused("64-bit data .CDF-5..*nccopy -k nc4", read_volume, tmp_path / "wide.nc")
    (tmp_path / "cut.nc").write_bytes(data[: len(data) // 2])
    assert_refused("a damaged NetCDF file", read_volume, tmp_path / "cut.nc")
    (tmp_path / "a.vol2").write_bytes(data)
    assert_refused("name it .nc", read_volume, tmp_path / "a.vol2")


def test_verbs_take_netcdf(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_classic(tmp_path / "a.nc", model(qr=(("z", "y", "x"), 2 * VALUES, {})))
    assert run("explain", tmp_path / "a.nc", "--dataset", "qr") == 0
    assert "a.nc: NetCDF, array 'qr'" in capsys.readouterr().out
    assert run("convert", tmp_path / "a.nc", tmp_path / "a.vti", "--dataset", "qr") == 0
    back = read_volume(tmp_path / "a.vti")
    np.testing.assert_array_equal(back.values[..., 0], 2 * VALUES)
    np.testing.assert_allclose(back.spacing, (20, 30, 40), rtol=1e-6)


def test_even_cells_of_an_even_axis_are_the_voxels() -> None:
    values, centres = netcdf.make_even(Path("a"), VALUES, np.arange(3) * 2.0, 0)
    np.testing.assert_array_equal(values, VALUES)
    np.testing.assert_array_equal(centres, [0, 2, 4])
