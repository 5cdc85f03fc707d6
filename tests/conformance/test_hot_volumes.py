"""Volumes of production: several grids of one file in a medium, factors on values, temperatures as light, velocity refused."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from emission_scenes import light, pencils
from scattering_scenes import PLACE

from mivol.fields.blackbody import blackbody_rgb, planck, tabulated_rgb
from mivol.files import SparseVolumeData, VolumeData, frame_from_steps, read_volume, write_grids
from scenes import box_of, refused


def hot(values: np.ndarray, **more: object) -> np.ndarray:
    """The colours (Z, Y, X, 3) of a ``mivol_blackbody``."""
    volume = mi.load_dict({"type": "mivol_blackbody", "data": mi.TensorXf(np.float32(values)[..., None]), **more})
    return np.array(mi.traverse(volume)["data"])


def test_a_temperature_shines_as_a_black_body() -> None:
    celsius = np.array([-300.0, 20, 900, 1500, 2500]).reshape(1, 1, 5)
    truth = blackbody_rgb(np.maximum(celsius + 273.15, 0))
    found = hot(celsius, offset=-273.15)
    # Linear between 4096 temperatures: the second derivative of the radiance is below (c_2 / 400 nm / T)^2 of it.
    assert np.abs(found - truth).max() <= (1.44e7 / 400 / 4096 / 2773) ** 2 * 4096 / 8 * truth.max() + 1e-6 * truth.max()
    assert not found[0, 0, 0].any() and found[0, 0, 1].max() < 1e-9
    np.testing.assert_allclose(hot(celsius / 100, kelvin=100.0, offset=-2.7315, scale="2, 1, 0"), found * [2, 1, 0], rtol=1e-4)


def test_normalized_spectra_have_the_peak_1() -> None:
    """As pbrt-v4 defines its blackbody spectrum: the power of a temperature is divided out, its colour stays."""
    kelvin = np.array([[[800.0, 3000, 6500]]])
    wavelengths = np.arange(300.0, 6000, 0.5)
    peaks = np.array([planck(wavelengths, T).max() for T in kelvin.ravel()])
    np.testing.assert_allclose(hot(kelvin, normalize=True)[0, 0], blackbody_rgb(kelvin)[0, 0] / peaks[:, None], rtol=2e-4)


def test_a_table_is_its_function() -> None:
    kelvin = np.random.default_rng(0).uniform(0, 4000, (7, 8, 9))
    assert np.abs(tabulated_rgb(kelvin) - blackbody_rgb(kelvin)).max() <= 1e-5 * blackbody_rgb(np.array(4000.0)).max()


def make_fire(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Constant soot on a fine grid, and a constant temperature on a coarse grid in the middle of it."""
    soot = SparseVolumeData.from_dense(
        np.full((16, 16, 16, 1), 0.5, np.float32), frame_from_steps((16,) * 3, np.eye(3) / 8, [-0.9375] * 3)
    )
    heat = VolumeData(np.full((2, 2, 2, 1), 1400.0, np.float32), frame_from_steps((2,) * 3, np.eye(3) / 2, [-0.25] * 3))
    colour = VolumeData(np.full((1, 1, 2, 3), 0.5, np.float32), PLACE)
    write_grids(path, {"density": soot, "temperature": heat, "Cd": colour})
    return soot.to_world, heat.to_world


@pytest.mark.parametrize("suffix", [".vdb", ".nvdb"])
def test_grids_of_one_file_are_one_medium(tmp_path: Path, suffix: str) -> None:
    """A ray through the middle meets sigma 0.5 x scale 2 over a length of 2, of which the middle of the length 1 shines."""
    path = tmp_path / f"fire{suffix}"
    places = make_fire(path)
    for name, place in zip(("density", "temperature"), places, strict=True):
        np.testing.assert_allclose(read_volume(path, name).to_world, place, rtol=0, atol=1e-12)
    grid = {"type": "mivol_voxels", "filename": str(path), "use_grid_bbox": True}
    medium = {
        "type": "mivol_medium",
        "sigma_t": grid | {"grid": "density"},
        "albedo": grid | {"grid": "Cd", "scale": "1, 0.5, 0"},
        "scale": 2.0,
        "emission": grid | {"type": "mivol_blackbody", "grid": "temperature", "scale": "1e-3"},
    }
    seen = pencils({"box": box_of(medium, PLACE)}, np.array([[0.1, 0.2, -4.0]]), np.array([[0.0, 0, 1]]))
    T = np.exp(-1.0)
    Le = 1e-3 * blackbody_rgb(np.array(1400.0))
    # (1 - albedo) Le through 0.5 of dark matter in front.
    expected = (1 - 0.5 * np.array([1, 0.5, 0])) * Le * np.exp(-0.5) * (1 - T)
    np.testing.assert_allclose(light(seen)[0], expected, rtol=1e-5)


def test_a_factor_makes_channels_and_keeps_bricks(tmp_path: Path) -> None:
    make_fire(tmp_path / "fire.vdb")
    given = {"type": "mivol_voxels", "filename": str(tmp_path / "fire.vdb"), "grid": "density", "storage": "sparse"}
    volume = mi.load_dict(given | {"scale": "2, 1, 0.5"})
    assert volume.channel_count() == 3 and volume.mivol_bricks.count == 8
    assert np.allclose(np.unique(np.array(mi.traverse(volume)["data"]), axis=None), [0.25, 0.5, 1])
    assert mi.load_dict(given | {"scale": 3.0}).max() == 1.5
    warm = mi.load_dict(given | {"type": "mivol_blackbody", "kelvin": 3000.0})
    assert warm.mivol_bricks.count == 8 and warm.channel_count() == 3
    # What is 0 in the file shines if its offset says so, and needs the dense grid.
    assert mi.load_dict(given | {"type": "mivol_blackbody", "kelvin": 3000.0, "offset": -1.0}).mivol_bricks is None


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"scale": "1, 2"}, "scale '1, 2', expected a number or three numbers"),
        ({"scale": -1.0}, "scale -1.0, expected a number or three numbers"),
        ({"scale": "red"}, "scale 'red'"),
        ({"type": "mivol_blackbody", "kelvin": 0.0}, "kelvin 0 and offset 0, expected a factor above 0"),
        ({"type": "mivol_blackbody", "grid": "Cd"}, "3 channels, expected 1, the temperature"),
    ],
)
def test_wrong_factors_are_refused(tmp_path: Path, more: dict, words: str) -> None:
    make_fire(tmp_path / "fire.vdb")
    with pytest.raises(RuntimeError, match=words):
        mi.load_dict({"type": "mivol_voxels", "filename": str(tmp_path / "fire.vdb"), "grid": "density"} | more)


def test_velocity_is_refused_by_name() -> None:
    with pytest.raises(RuntimeError, match="velocity; motion blur is not there yet"):
        mi.load_dict({"type": "mivol_medium", "sigma_t": 1.0, "velocity": {"type": "constvolume", "value": 1.0}})


def test_what_a_file_of_grids_cannot_hold_is_refused(tmp_path: Path) -> None:
    volume = VolumeData(np.ones((2, 2, 2, 2), np.float32), np.eye(4))
    for grids, name, words in (
        ({}, "a.vdb", "no grid"),
        ({"a": volume}, "a.nvdb", "2 channels"),
        ({"a": volume}, "a.npz", "'.npz'"),
    ):
        with refused(words):
            write_grids(tmp_path / name, grids)
