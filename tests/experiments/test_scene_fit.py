"""A scene fitted to images of it: a whole run folder, its outputs, refusals, interruption and resumption."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY
from refusals import assert_refused
from tiny_experiment import FIT, PHOTOS, SCENE, TRUTH, assert_explained, files_of, refused, run

from mivol import config
from mivol.config import Sought
from mivol.config.scenes import Scene as SceneFile
from mivol.experiments import scene_fit, start
from mivol.experiments.scene_fit import SceneOutputs
from mivol.experiments.start import make_start
from mivol.files import atomic, read_exr, read_volume, write_exr
from mivol.optim.loop import MAX_UNREAD
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import FINAL, derive_seed


def test_optimize_leaves_a_whole_run_folder(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Everything that the issue names: record, volumes, renders with held-out views, curves, page; nothing half-written."""
    target = folder / "run"
    assert run("optimize", folder / "fit.toml", "-o", target, "--set", "fit.iterations=5") == 0
    assert capsys.readouterr().out.strip() == str(target / "report.html")
    names = files_of(target)
    stem = "volumes/" + KEY.replace(".", "_")
    assert {"run.json", "metrics.jsonl", "report.html", "checkpoint.npz"} <= names
    assert {f"{stem}_reconstruction.vol", f"{stem}_reconstruction.npz", f"{stem}_truth.npz"} <= names
    assert {f"views/view_{i}.{kind}" for i in range(3) for kind in ("exr", "png")} <= names
    assert {"curves/loss.png", "curves/nrmse.png", "curves/held_out_psnr.png"} <= names
    assert not any(name.endswith(".part") for name in names)
    record = json.loads((target / "run.json").read_text())
    assert record["status"] == "finished"
    assert record["config"]["fit"]["iterations"] == 5
    assert record["config"]["optimizer"]["beta_1"] == 0.9
    assert record["seeds"] == {"fit": 0, "references": 1}
    assert {"mivol", "mitsuba", "drjit"} <= set(record["versions"])
    assert record["plan"]
    assert all(choice["reason"] for choice in record["plan"])
    assert {"mitsuba3", "kingma_2015", "amanatides_1987"} <= set(record["citations"])
    assert set(record["timings"]) == {"scene", "references", "fit", "images and volumes"}
    assert [image["view"] for image in record["images"] if image.get("held_out")] == ["view 1"] * 3
    rows = [json.loads(line) for line in (target / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == [0, 1, 2, 3, 4, 5]
    assert [("nrmse" in row) for row in rows] == [True, False, True, False, True, True]
    assert rows[4]["loss"] < rows[0]["loss"]
    values = read_volume(target / f"{stem}_reconstruction.vol")
    assert values.values.shape == (3, 3, 3, 1)
    assert np.allclose(values.to_world[:3, 3], -1)
    page = (target / "report.html").read_text()
    assert "tiny" in page
    assert str(folder) not in page


@pytest.mark.slow
def test_an_emissive_start_is_noted_and_not_made_again(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run begins from another volume than without it, says what was tried, and goes on from its checkpoint."""
    stages = tuple(replace(stage, steps=4) for stage in start.PLAN.stages)
    monkeypatch.setattr(start, "PLAN", replace(start.PLAN, stages=stages))
    monkeypatch.setattr(start, "TRIAL", 2)
    plain, shaped = folder / "plain", folder / "shaped"
    few = ("--set", "fit.iterations=1")
    emissive = ("--set", 'parameter.0.start_fit="emission"')
    assert run("optimize", folder / "fit.toml", "-o", plain, *few) == 0
    assert run("optimize", folder / "fit.toml", "-o", shaped, *few, *emissive) == 0
    losses = [json.loads((target / "metrics.jsonl").read_text().splitlines()[0])["loss"] for target in (plain, shaped)]
    assert losses[0] != losses[1]
    record = json.loads((shaped / "run.json").read_text())
    assert any("emissive fit of the same views" in note for note in record["notes"])
    assert "nimier_david_2022" in record["citations"]
    monkeypatch.setattr(scene_fit, "find_emissive_start", lambda *given: pytest.fail("the start is made again"))
    assert run("optimize", folder / "fit.toml", "-o", shaped, "--set", "fit.iterations=2", *emissive, "--resume") == 0
    rows = [json.loads(line) for line in (shaped / "metrics.jsonl").read_text().splitlines()]
    assert rows[0]["loss"] == losses[1] and rows[-1]["iteration"] == 2


PHOTO = 'reference={{source="files", paths=["a.exr", "b.exr", "{}"]}}'

OPTIMIZE_REFUSED = {
    "misspelt key": (["fit.iteratons=3"], 'did you mean "iterations"'),
    "no views": (["views.count=0"], "views.count = 0"),
    "all views held out": (["reference.held_out=[0,1,2]"], "all 3 views are held out"),
    "a view to hold out that is not there": (["reference.held_out=[7]"], "no view 7"),
    "unknown parameter": (['parameter.0.key="cube.interior_medium.sigma_t.dat"'], f'did you mean "{KEY}"'),
    "start outside its domain": (["parameter.0.start=-1.0"], r"[0, 0, 0, 0] = -1"),
    "scene that is not there": (['scene.file="none.xml"'], "no scene file"),
    "truth that is not there": ([f'truth={{key="{KEY}", file="none.vol"}}'], "none.vol"),
    "more views than files": (['reference={source="files", paths=["a.exr"]}'], "1 reference files for 3 views"),
    "unknown integrator": (['fit.integrator="mivoll"'], "mivoll"),
    "unknown variant": (['variant="llvm_rgb"'], 'no variant "llvm_rgb"'),
    "a parameter twice": ([f'parameter=[{{key="{KEY}"}}, {{key="{KEY}", start=0.1}}]'], "twice"),
    "a truth that nobody looks for": (
        ['parameter=[{key="cube.interior_medium.albedo.value.value", domain=[0, 1]}]'],
        "which is no parameter of the fit",
    ),
    "voxels of a number": (
        ['parameter=[{key="cube.interior_medium.albedo.value.value", shape=[3,3,3], start=0.0}]'],
        "not a grid of voxels",
    ),
    "a prior of a number": (
        ['parameter=[{key="cube.interior_medium.albedo.value.value", prior=[{name="tv"}]}]'],
        "compares neighbours",
    ),
    "a photograph of another size": ([PHOTO.format("small.exr")], '"view 2" has shape (4, 4, 3), its sensor 8 x 8 pixels'),
    "a photograph with a hole": ([PHOTO.format("hole.exr")], "not finite at pixel (row 2, column 3)"),
    "a photograph without colours": ([PHOTO.format("grey.exr")], "found the channels Y, expected R, G and B"),
    "a loss that is not squared": (['optimizer={name="gauss_newton"}', 'loss={name="l1"}'], "quadratic in the image"),
    "an emissive start of nothing": ([f'parameter=[{{key="{KEY}", start=0.0, start_fit="emission"}}]'], "a mean of 0"),
    "an integrator that sees no media": (['fit.integrator="path"'], "the images do not depend on cube"),
    "no grid to refine": (
        ['parameter=[{key="cube.interior_medium.albedo.value.value"}]', 'event=[{name="upsample", at=[1]}]'],
        "the event 'upsample' found no grid",
    ),
    "a grid beyond the memory": (["parameter.0.shape=[20000,20000,20000]"], "of 20000 x 20000 x 20000 x 1 numbers"),
    "a grid without voxels": (["parameter.0.shape=[3,0,3]"], "parameter.0.shape.1 = 0"),
    "a grid refined beyond the memory": (
        ["fit.iterations=9", 'event=[{name="upsample", at=[0,3,6,8,9], factor=8}]'],
        "of 12288 x 12288 x 12288 x 1 numbers",
    ),
    "a truth beyond the memory": (["truth.shape=[20000,20000,20000]"], "a truth of 20000 x 20000 x 20000 voxels needs"),
    "views beyond the memory": (["views.width=60000", "views.height=60000"], "a film of 60000 x 60000 pixels needs"),
}


@pytest.mark.parametrize("case", OPTIMIZE_REFUSED)
def test_optimize_refuses(variant_rgb, folder: Path, capsys: pytest.CaptureFixture, case: str) -> None:
    changes, sentence = OPTIMIZE_REFUSED[case]
    flags = [part for change in changes for part in ("--set", change)]
    write_exr(folder / "small.exr", {"": np.full((4, 4, 3), 0.7, "f")})
    write_exr(folder / "grey.exr", {"Y": np.full((8, 8), 0.7, "f")})
    hole = np.full((8, 8, 3), 0.7, "f")
    hole[2, 3] = np.nan
    write_exr(folder / "hole.exr", {"": hole})
    said = refused(capsys, "optimize", folder / "fit.toml", "-o", folder / "run", *flags)
    assert sentence in said
    assert_explained(folder / "fit.toml", changes, said)


def test_more_views_than_can_be_listed_are_refused(folder: Path) -> None:
    """Two milliards of cameras filled the memory before anything was counted."""
    assert config.load(folder / "fit.toml", ["views.count=65536"]).views.count == 65536
    assert_refused("views.count = 65537: expected `int` <= 65536", config.load, folder / "fit.toml", ["views.count=65537"])


def test_disk_full(variant_rgb, folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fills up at the first checkpoint: one sentence, nothing half-written, and a second try ends well."""
    sync, target = atomic._sync, folder / "run"

    def full(path: Path) -> None:
        if "checkpoint" in path.name:
            raise OSError(28, "No space left on device")
        sync(path)

    with monkeypatch.context() as patch:
        patch.setattr(atomic, "_sync", full)
        said = refused(capsys, "optimize", folder / "fit.toml", "-o", target, *PHOTOS)
    assert "no space left" in said
    record = json.loads((target / "run.json").read_text())
    assert record["status"] == "stopped"
    assert any("no space left" in note for note in record["notes"])
    assert not any(name.endswith(".part") for name in files_of(target))
    assert run("optimize", folder / "fit.toml", "-o", target, *PHOTOS) == 0


STOPPED_AFTER_THREE = """
import os, signal, sys
from mivol.cli import main
from mivol.experiments import run_folder

write = run_folder.append_metrics

def write_and_stop(folder, iteration, seconds, **values):
    write(folder, iteration, seconds, **values)
    if iteration == 2:
        os.kill(os.getpid(), signal.SIGTERM)

run_folder.append_metrics = write_and_stop
sys.exit(main(sys.argv[1:]))
"""
"""The command line in a process that is asked to stop once it has written its third row, of iteration 2; whatever the load."""


@pytest.mark.slow
def test_interrupted_run_is_resumed(variant_rgb, folder: Path) -> None:
    """Rationale: SIGTERM is how clusters stop jobs. Expected: exit code 130, one sentence, a checkpoint, status
    "stopped"; --resume ends with the very metrics of a run that was not stopped (one thread), each row once."""
    long = [*PHOTOS, "--set", "fit.iterations=20"]
    assert run("optimize", folder / "fit.toml", "-o", folder / "whole", *long) == 0
    command = [sys.executable, "-c", STOPPED_AFTER_THREE, "optimize", folder / "fit.toml", "-o", folder / "cut", *long]
    child = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    assert child.returncode == 130
    assert "mivol: stopped" in child.stderr
    assert "Traceback" not in child.stderr
    # Rows are written in groups of up to MAX_UNREAD: the one of iteration 2 may be the first of its group. It stops at the next
    # safe point, so at most one more iteration runs.
    assert 3 <= (folder / "cut" / "metrics.jsonl").read_text().count("\n") <= 2 + MAX_UNREAD + 1
    assert json.loads((folder / "cut" / "run.json").read_text())["status"] == "stopped"
    assert run("optimize", folder / "fit.toml", "-o", folder / "cut", *long, "--resume") == 0
    texts = [(folder / name / "metrics.jsonl").read_text() for name in ("whole", "cut")]
    rows = [[(row["iteration"], row.get("loss")) for row in map(json.loads, text.splitlines())] for text in texts]
    assert rows[0] == rows[1]
    assert [iteration for iteration, _ in rows[0]] == list(range(21))
    assert json.loads((folder / "cut" / "run.json").read_text())["status"] == "finished"


def test_resume_refuses_other_settings(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Before anything of the run is touched: its folder is not made, and its record stays that of what was done."""
    flags = ["optimize", folder / "fit.toml", "-o", folder / "run", *PHOTOS, "--set", "fit.iterations=2"]
    assert "without --resume first" in refused(capsys, *flags, "--resume")
    assert not (folder / "run").exists()
    assert run(*flags) == 0
    record = (folder / "run" / "run.json").read_text()
    said = refused(capsys, *flags, "--resume", "--set", "optimizer.beta_1=0.8")
    assert "optimizer.beta_1 is 0.9 there and 0.8 here" in said
    assert "parameter.0.shape.0 is 3 there" in refused(capsys, *flags, "--resume", "--set", f'parameter=[{{key="{KEY}"}}]')
    assert (folder / "run" / "run.json").read_text() == record


def test_a_run_that_is_done_may_be_resumed(variant_rgb, folder: Path) -> None:
    """There is nothing left to do, and nothing is said twice."""
    flags = ["optimize", folder / "fit.toml", "-o", folder / "run", *PHOTOS, "--set", "fit.iterations=2"]
    assert run(*flags) == 0
    metrics = (folder / "run" / "metrics.jsonl").read_text()
    assert run(*flags, "--resume") == 0
    assert (folder / "run" / "metrics.jsonl").read_text() == metrics


@pytest.mark.slow
def test_a_stretched_schedule_is_said(variant_rgb, folder: Path) -> None:
    """A run goes on with more iterations; where the schedule knew how many there would be, the record says what that means."""
    flags = ["optimize", folder / "fit.toml", "-o", folder / "run", *PHOTOS, "--set", 'schedule={name="cosine", final=0.5}']
    assert run(*flags, "--set", "fit.iterations=2") == 0
    assert run(*flags, "--resume", "--set", "fit.iterations=3") == 0
    record = json.loads((folder / "run" / "run.json").read_text())
    assert record["results"]["iterations"] == 3
    assert any("the schedule was planned for 2 iterations and continues for 3" in note for note in record["notes"])
    rows = [json.loads(line)["iteration"] for line in (folder / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[:3] == [0, 1, 2]


ONE = ["--set", 'fit.max_depth="auto"', "--set", "fit.iterations=1", "--set", "reference.spp=32"]


def record_of(folder: Path) -> dict:
    return json.loads((folder / "run" / "run.json").read_text())


def whiten(folder: Path, albedo: float) -> None:
    """Give the medium an albedo, where it had none."""
    scene = folder / "scene.xml"
    scene.write_text(scene.read_text().replace('name="albedo" value="0"', f'name="albedo" value="{albedo}"'))


@pytest.mark.slow
@pytest.mark.parametrize(("albedo", "noise", "limit"), [(0.0, 0.02, 2), (0.99, 1e-6, -1)])
def test_the_depth_is_measured_in_the_truth(variant_rgb, folder: Path, albedo: float, noise: float, limit: int) -> None:
    """What only absorbs needs no more than 2, whatever noise is asked for; the start is empty, the truth is not."""
    whiten(folder, albedo)
    more = ["--set", f"fit.noise={noise}", "--set", "parameter.0.start=0.0"]
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *ONE, *more) == 0
    first = record_of(folder)["plan"][0]
    assert first["choice"] == f"max_depth: {limit}"
    assert "depth 2 leaves out" in first["reason"]


def test_of_photographs_nothing_is_known(variant_rgb, folder: Path) -> None:
    """Paths have no limit where the references are files and no truth is given."""
    text = (folder / "fit.toml").read_text()
    (folder / "fit.toml").write_text("\n".join(line for line in text.splitlines() if not line.startswith("truth")))
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *ONE[:4], *PHOTOS) == 0
    first = record_of(folder)["plan"][0]
    assert (first["choice"], first["reason"]) == ("max_depth: -1", "the references are files of an unknown volume")


def test_other_words_are_refused(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    said = refused(capsys, "optimize", folder / "fit.toml", "--set", 'fit.max_depth="atuo"')
    assert 'max_depth is "atuo": expected a whole number from -1 on, or "auto"' in said


@pytest.mark.parametrize("truth", [None, "values"])
def test_the_first_view_is_measured_with_the_truth_in_the_scene(monkeypatch: pytest.MonkeyPatch, truth: str | None) -> None:
    """Where there is one; the noise is that of the fit, and the task has a number then."""
    held, asked = [], []
    chosen = SimpleNamespace()
    chosen.fit = SimpleNamespace(max_depth=scene_fit.AUTO, noise=0.125)
    chosen.reference, chosen.truth = config.Rendered(), SimpleNamespace(key="k")
    chosen.views = SimpleNamespace(sensors=lambda scene: iter([f"first of {scene}", "second"]))

    @contextmanager
    def holding(scene: str, key: str, values: str) -> Iterator[None]:
        held.append((scene, key, values))
        yield
        held.append("given back")

    def measured(scene: str, sensor: str, settings: object, noise: float) -> SimpleNamespace:
        asked.append((scene, sensor, noise, len(held)))
        return SimpleNamespace(depth=5, reason="so")

    monkeypatch.setattr(scene_fit, "hold_values", holding)
    monkeypatch.setattr(scene_fit, "to_sensor", lambda sensor: f"camera {sensor}")
    monkeypatch.setattr(scene_fit, "find_sufficient_depth", measured)
    monkeypatch.setattr(scene_fit.msgspec.structs, "replace", lambda given, **change: SimpleNamespace(**change))
    settled, (line,) = scene_fit.resolve_depth(chosen, SimpleNamespace(scene="scene"), truth)
    assert settled.fit.max_depth == 5 and (line.choice, line.reason) == ("max_depth: 5", "so")
    assert asked == [("scene", "camera first of scene", 0.125, 0 if truth is None else 1)]
    assert held == ([] if truth is None else [("scene", "k", "values"), "given back"])


@pytest.mark.parametrize(("name", "depth"), [("volpath", -1), ("prbvolpath", 3)])
def test_an_absent_depth_is_the_depth_of_the_scene(variant_rgb, name: str, depth: int) -> None:
    """The fit renders the same light as the scene's integrator: emitters hidden there are hidden here."""
    wanted = {"type": name, "max_depth": depth, "hide_emitters": True}
    scene = mi.load_dict({"type": "scene", "integrator": wanted})
    chosen = config.SceneExperiment(title="t", scene=SceneFile(file="s.xml"), parameter=(Sought(key="k"),))
    settled, (line,) = scene_fit.resolve_depth(chosen, SimpleNamespace(scene=scene), None)
    assert settled.fit.max_depth == depth and line.choice == f"max_depth: {depth}"
    drawn = scene_fit.make_integrator(settled, scene).session.settings
    assert (drawn.max_depth, drawn.hide_emitters) == (depth, True)


def test_a_depth_that_is_given_is_not_measured() -> None:
    settings = SimpleNamespace(fit=SimpleNamespace(max_depth=3))
    assert scene_fit.resolve_depth(settings, None, None) == (settings, [])


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
