"""First values of a scene fit: from the file, the scene, or an emissive fit."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY, absorbing_scene, camera, frontal, views_of_truth
from refusals import assert_refused
from tiny_experiment import FIT, SCENE, TRUTH, files_of, refused, run

from mivol.errors import MivolError
from mivol.experiments import start
from mivol.experiments.start import FACTORS, LEAST, PARTS, average_density, find_emissive_start, to_photographs
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_volume
from mivol.optim.first_order import Adam
from mivol.optim.parameters import Parameter
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.validate.metrics import nrmse


@pytest.mark.slow
def test_a_colour_is_looked_for_from_a_start_of_its_own(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Each number of what is no grid has its start, and is among the results and curves; steps of 1e-6 leave it there."""
    coloured = '<emitter type="constant" id="sky"><rgb name="radiance" value="0.9, 0.8, 0.7"/></emitter>'
    (folder / "scene.xml").write_text(SCENE.replace('<emitter type="constant"/>', coloured))
    flags = ["optimize", folder / "fit.toml", "-o", folder / "run", "--set", "fit.iterations=1", "--set", "event=[]"]
    (folder / "fit.toml").write_text(FIT.replace(TRUTH, ""))
    sought = 'parameter=[{key="sky.radiance.value", lr=1e-6, start=[0.5, 0.25, 0.125]}]'
    assert run(*flags, "--set", sought) == 0
    results = json.loads((folder / "run" / "run.json").read_text())["results"]
    assert np.allclose([results[f"sky.radiance.value[{i}]"] for i in range(3)], [0.5, 0.25, 0.125], atol=2e-6)
    assert "curves/sky.radiance.value[2].png" in files_of(folder / "run")
    assert "starts from 2 numbers and has 3" in refused(capsys, *flags, "--set", sought.replace(", 0.125", ""))


@pytest.mark.slow
def test_the_fit_does_not_start_at_the_truth(variant_rgb, folder: Path) -> None:
    """Without a start of its own the fit begins where the scene's file says, whatever the references showed: its first
    error is that of 0.25 everywhere, and not 0."""
    text = FIT.replace("start = 0.2\nshape = [3, 3, 3]\n", "").replace("shape = [6, 6, 6]", "shape = [2, 2, 2]")
    (folder / "fit.toml").write_text(text)
    fewer = ["--set", 'reference={source="render", spp=32}', "--set", 'views={rig="ring", count=1, width=4, height=4}']
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *fewer, "--set", "fit.iterations=1") == 0
    truth = read_volume(next((folder / "run" / "volumes").glob("*truth.npz"))).values
    expected = nrmse(np.full(truth.shape, 0.25), truth)
    first = json.loads((folder / "run" / "metrics.jsonl").read_text().splitlines()[0])
    assert np.isclose(first["nrmse"], expected, rtol=1e-5)


ALBEDO = "cube.interior_medium.albedo.value.value"


def test_numbers_of_a_fit_are_recorded_with_their_units(variant_rgb, folder: Path) -> None:
    """On record for the page, and in the titles of the curves."""
    (folder / "fit.toml").write_text(FIT.replace(TRUTH, ""))
    fewer = ["--set", 'reference={source="render", spp=32}', "--set", 'views={rig="ring", count=1, width=4, height=4}']
    sought = f'parameter=[{{key="{ALBEDO}", domain=[0, 1], start=0.5}}]'
    flags = [*fewer, "--set", sought, "--set", "fit.iterations=1"]
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *flags) == 0
    record = json.loads((folder / "run" / "run.json").read_text())
    assert record["units"] == {"loss": "radiance²", f"{ALBEDO}[0]": "1"}
    page = (folder / "run" / "report.html").read_text()
    assert f"{ALBEDO}[0] [1]" in page
    assert "Loss [radiance²]" in page
    assert f"curves/{ALBEDO}[0].png" in files_of(folder / "run")


PLACE = np.array([[2.0, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]])


def field_of(density: np.ndarray, place: np.ndarray) -> SphericalGrid:
    """A dense field of one colour with these densities (Z, Y, X)."""
    return SphericalGrid.from_dense(density, np.zeros((*density.shape, 1, 3)), place)


def problem_of(value: np.ndarray, truth: np.ndarray, cameras: int) -> SceneProblem:
    """A cube whose grid starts from ``value``, and what cameras on a circle see of a true one."""
    sensors = [camera(2 * np.pi * k / cameras, 16) for k in range(cameras)]
    views = views_of_truth(truth, sensors, 16)
    parameter = Parameter(KEY, "1/m", (0.0, 10.0), extent=(2.0, 2.0, 2.0))
    return SceneProblem(absorbing_scene(value), views, [parameter], spp=4, seed=3)


def test_voxel_density_is_the_mean_of_the_field(variant_rgb):
    """A density that is linear along the axes has at a voxel's middle its mean; the grid's axes are turned by a quarter."""
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (8, 8, 8)), indexing="ij")
    turned = PLACE @ np.array([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    found = average_density(field_of(1 + 4 * x + 2 * y + z, PLACE), turned, (2, 2, 4))
    # The outer half voxel is clamped, so only points of voxels that end within the nodes have the linear value.
    k, j, i = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (2, 2, 4)), indexing="ij")
    truth = 1 + 4 * (1 - j) + 2 * i + k
    # Of PARTS = 3 points an axis the outermost may lie 1/48 beyond the last node, where 4 + 2 + 1 units a box are lost.
    assert np.abs(found - truth).max() <= 7 / 48
    assert np.abs(found[:, :, 1:3] - truth[:, :, 1:3]).max() <= 5 / 48
    assert PARTS == 3


def test_density_is_0_outside_the_field(variant_rgb):
    """A grid that is twice as long as the field's box has matter in one half of it."""
    longer = PLACE @ np.diag([2.0, 1, 1, 1])
    found = average_density(field_of(np.full((2, 2, 2), 3.0), PLACE), longer, (1, 1, 4))
    assert np.allclose(found, [[[3, 3, 0, 0]]], atol=1e-6)


def test_views_share_a_white_level(variant_rgb):
    """The brightest percentile of all views is white; one channel is grey."""
    values = np.linspace(0, 2, 48, dtype=np.float32).reshape(4, 4, 3)
    sensor = camera(0.0, 4)
    views = [View("a", sensor, mi.TensorXf(values)), View("b", sensor, mi.TensorXf(values[..., :1] / 4))]
    first, second = to_photographs(views)
    white = np.percentile(np.concatenate([values.ravel(), np.repeat(values[..., :1] / 4, 3, axis=2).ravel()]), 99.5)
    linear = np.where(first.image <= 0.04045, first.image / 12.92, ((first.image + 0.055) / 1.055) ** 2.4)
    assert np.abs(linear - np.minimum(values / white, 1)).max() <= 1e-5
    assert np.array_equal(second.image[..., 0], second.image[..., 2])


@pytest.mark.slow
def test_best_factor_has_the_least_loss(variant_rgb, monkeypatch):
    """The density of the emissive fit, of which only the shape counts, is brought to the scale that the views ask for."""
    truth = np.full((2, 2, 2, 1), 0.05)
    truth[0, 0, 0] = 1.0
    shape = np.where(truth[..., 0] > 0.5, 20.0, 1.0)
    monkeypatch.setattr(start, "fit_emission", lambda views, place, seed: field_of(shape, PLACE))
    monkeypatch.setattr(start, "average_density", lambda field, place, size: shape)
    problem = problem_of(np.full((2, 2, 2, 1), truth.mean() / 4), truth, 4)
    before = problem.values()[KEY]
    found = find_emissive_start(problem, KEY, PLACE, Adam(views=2))
    assert found.factor == 4.0 and found.losses[FACTORS.index(4.0)] == min(found.losses)
    # truth is 20 to 1 as the shape is: at the right mean it is the truth itself, to float32.
    assert np.abs(found.value - truth).max() <= 1e-6
    assert np.array_equal(np.array(problem.values()[KEY]), np.array(before))
    assert "4 times" in found.description


@pytest.mark.slow
def test_start_values_are_positive(variant_rgb, monkeypatch):
    """Where the emissive volume is empty the start is a thousandth of the mean: maps to the logarithm have no 0."""
    shape = np.zeros((2, 2, 2))
    shape[0, 0, 0] = 8.0
    monkeypatch.setattr(start, "fit_emission", lambda views, place, seed: None)
    monkeypatch.setattr(start, "average_density", lambda field, place, size: shape)
    monkeypatch.setattr(start, "TRIAL", 1)
    problem = problem_of(np.full((2, 2, 2, 1), 0.1), np.full((2, 2, 2, 1), 0.1), 1)
    found = find_emissive_start(problem, KEY, PLACE, Adam(views=2))
    assert np.isclose(found.value.min(), found.factor * 0.1 * LEAST, rtol=1e-5)


@pytest.mark.parametrize(
    ("value", "density", "says"),
    [(np.zeros((2, 2, 2, 1)), 1.0, "starts from a mean of 0"), (np.full((2, 2, 2, 1), 0.1), 0.0, "the views show nothing")],
)
def test_refusals(variant_rgb, monkeypatch, value, density, says):
    monkeypatch.setattr(start, "fit_emission", lambda views, place, seed: None)
    monkeypatch.setattr(start, "average_density", lambda field, place, size: np.full((2, 2, 2), density))
    assert_refused(says, find_emissive_start, problem_of(value, np.full((2, 2, 2, 1), 0.1), 1), KEY, PLACE, Adam())


def test_other_cameras_are_refused(variant_rgb):
    """An emissive fit looks through pinholes."""
    with pytest.raises(MivolError, match="a perspective sensor"):
        to_photographs([View("flat", frontal(), mi.TensorXf(np.ones((4, 4, 3), np.float32)))])


@pytest.mark.slow
def test_emissive_fit_recovers_the_shape(variant_rgb):
    """One dark corner of a cube under a white sky, from 8 views: most of the found density lies in that octant, which has an
    eighth of the box."""
    truth = np.zeros((4, 4, 4, 1))
    truth[:2, :2, :2] = 6.0
    problem = problem_of(np.full((4, 4, 4, 1), 0.2), truth, 8)
    found = find_emissive_start(problem, KEY, PLACE, Adam(views=2)).value[..., 0]
    assert found[:2, :2, :2].sum() >= 0.5 * found.sum()
