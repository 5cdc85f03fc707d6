"""What a fit of a scene leaves: each view, each volume where it lies, skies as images."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY
from tiny_experiment import FIT, SCENE, TRUTH, run

from mivol.config import Sought
from mivol.experiments.scene_outputs import SceneOutputs
from mivol.experiments.start import make_start
from mivol.files import read_exr, read_volume, write_exr
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import FINAL, derive_seed


@pytest.mark.slow
def test_images_that_are_compared_may_have_more_samples(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four samples in each image of the fit, 32 in what is compared with held-out views and in what is kept, of which the
    noise is found from 16 renders of two."""
    asked, render = [], SceneProblem.render

    def listen(self: SceneProblem, sensor: mi.Sensor, seed: int, spp: int | None = None) -> mi.TensorXf:
        asked.append(spp or self.spp)
        return render(self, sensor, seed, spp)

    monkeypatch.setattr(SceneProblem, "render", listen)
    flags = ["--set", "fit.spp=4", "--set", "fit.spp_shown=32", "--set", "fit.iterations=1"]
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *flags) == 0
    # An evaluation, the step, an evaluation, and three views that are kept.
    assert asked == [32, 4, 32, *[2] * 16 * 3]


def outputs_of(render: Callable[[str, int, int], np.ndarray], errors: dict[str, np.ndarray]) -> SceneOutputs:
    """Those of a fit whose views are rendered so, with known standard errors of their references."""
    chosen = SimpleNamespace(seed=3, fit=SimpleNamespace(spp=40, spp_shown=0))
    fit = SimpleNamespace(problem=SimpleNamespace(render=render))
    return SceneOutputs(chosen, None, fit, SimpleNamespace(standard_errors=errors), None, None)


def test_what_only_the_render_saw_is_in_its_noise() -> None:
    """Two pixels that no path of the reference has lit: the render sees a light of 16 in one of its 16 batches of 3 samples, by
    chance, in one pixel, and always 1 in the other. A mean of 1 each; variance (15^2 + 15) / 15 / 16 = 1 in the one, 0 in the
    other: with a reference known to 0.1 (brightest pixel over samples) that is z = 0.995, which is nothing, and z = 10."""
    asked = []

    def render(sensor: str, seed: int, spp: int) -> np.ndarray:
        asked.append((seed, spp))
        return np.array([16.0 if len(asked) == 5 else 0.0, 1.0])

    image, error = outputs_of(render, {"v": np.full(2, 0.1)}).render_last(SimpleNamespace(name="v", sensor="s"), 0)
    np.testing.assert_allclose(image / error, [1 / math.sqrt(1.01), 10], rtol=1e-6)
    assert [spp for _, spp in asked] == [3] * 16 and len({seed for seed, _ in asked}) == 16


def test_a_reference_of_unknown_noise_has_one_render_beside_it() -> None:
    asked = []
    outputs = outputs_of(lambda *given: asked.append(given) or np.zeros(2), {})
    assert outputs.render_last(SimpleNamespace(name="v", sensor="s"), 7)[1] is None
    assert asked == [("s", derive_seed(3, 0, 7, FINAL), 40)]


@pytest.mark.slow
def test_a_sky_that_was_found_is_an_image(variant_rgb, folder: Path) -> None:
    """Without the columns that Mitsuba's envmap adds: what is written has the shape of what was given, and is read again to
    the same parameter. A soft wall is a prior that needs no neighbours."""
    write_exr(folder / "sky.exr", {"": np.random.default_rng(1).uniform(0.5, 1, (4, 6, 3)).astype(np.float32)})
    sky = '<emitter type="envmap" id="sky"><string name="filename" value="{}"/></emitter>'
    (folder / "scene.xml").write_text(SCENE.replace('<emitter type="constant"/>', sky.format("sky.exr")))
    flags = ["optimize", folder / "fit.toml", "-o", folder / "run", "--set", "fit.iterations=2", "--set", "event=[]"]
    (folder / "fit.toml").write_text(FIT.replace(TRUTH, ""))
    sought = 'parameter=[{key="sky.data", lr=0.01, prior=[{name="bounds", high=0.9}]}]'
    assert run(*flags, "--set", sought) == 0
    with np.load(folder / "run" / "checkpoint.npz") as stored:
        found = next(stored[name] for name in stored.files if stored[name].shape == (4, 8, 3))
    planes = read_exr(folder / "run" / "images" / "sky_data.exr")[0]
    image = np.stack([planes[channel] for channel in "RGB"], axis=-1)
    assert image.shape == (4, 6, 3)
    again = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image)})
    np.testing.assert_allclose(np.array(mi.traverse(again)["data"])[:, 1:-1], found[:, 1:-1], rtol=1e-6)
    assert "fitted sky.data" in (folder / "run" / "report.html").read_text()


@pytest.mark.slow
def test_volumes_lie_where_the_scene_has_them(variant_rgb, folder: Path) -> None:
    """A grid that is turned, beside another medium: its file and its priors know its own box, not that around all media.
    A .vol has no room for turned boxes and holds the unit cube. 1e-5: Mitsuba prints the place of a stock grid to 6 digits."""
    turned = '<scale x="2" y="1" z="4"/><rotate y="1" angle="30"/><translate x="-1" y="-1" z="-1"/>'
    place = mi.ScalarTransform4f().translate(-1).rotate([0, 1, 0], 30).scale([2, 1, 4])
    other = '<shape type="cube"><transform name="to_world"><translate x="9"/></transform><bsdf type="null"/>'
    other += '<medium type="homogeneous" name="interior"><float name="albedo" value="0"/></medium></shape></scene>'
    fill = f'<transform name="to_world"><scale value=".5"/><translate x=".5" y=".5" z=".5"/>{turned}</transform>'
    text = SCENE.replace('<scale value="2"/><translate x="-1" y="-1" z="-1"/>', turned).replace("</scene>", other)
    text = text.replace('<bsdf type="null"/>', f'{fill}<bsdf type="null"/>', 1)
    (folder / "scene.xml").write_text(text)
    fewer = ["--set", 'reference={source="render", spp=32}', "--set", 'views={rig="ring", count=1, width=4, height=4}']
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *fewer, "--set", "fit.iterations=1") == 0
    files = {path.suffix: read_volume(path) for path in (folder / "run" / "volumes").glob("*reconstruction.*")}
    np.testing.assert_allclose(files[".npz"].to_world, np.array(place.matrix), atol=1e-5)
    np.testing.assert_array_equal(files[".vol"].to_world, np.eye(4))
    sizes = [volume["size"] for volume in json.loads((folder / "run" / "run.json").read_text())["volumes"]]
    np.testing.assert_allclose(sizes, [[2, 1, 4]] * 2, rtol=1e-5)
    start = make_start(Sought(key=KEY), folder, mi.load_file(str(folder / "scene.xml")))
    np.testing.assert_allclose(start.parameter.extent, [4, 1, 2], rtol=1e-5)
