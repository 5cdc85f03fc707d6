"""Each verb on a tiny scene: what it writes, what it says, and how it refuses."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fit_scene import KEY

from mivol.cli import VERBS, main
from mivol.config import Sought
from mivol.experiments import render
from mivol.experiments.start import make_start
from mivol.fields.procedural import PROCEDURAL, make_procedural
from mivol.files import atomic, read_exr, read_volume, write_exr, write_volume
from mivol.optim.scene_problem import SceneProblem
from mivol.validate.statistics import nrmse

SCENE = """<scene version="3.0.0">
    <default name="spp" value="4"/>
    <integrator type="mivol"><string name="aovs" value="tau"/></integrator>
    <emitter type="constant"/>
    <sensor type="perspective">
        <float name="fov" value="35"/>
        <transform name="to_world"><lookat origin="0, 1, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="8"/><integer name="height" value="6"/>
            <string name="pixel_format" value="rgb"/><rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
    </sensor>
    <shape type="cube" id="cube">
        <bsdf type="null"/>
        <medium type="heterogeneous" name="interior">
            <float name="albedo" value="0"/>
            <volume type="gridvolume" name="sigma_t">
                <string name="filename" value="start.vol"/>
                <transform name="to_world"><scale value="2"/><translate x="-1" y="-1" z="-1"/></transform>
            </volume>
        </medium>
    </shape>
</scene>"""

TRUTH = f'truth = {{ key = "{KEY}", procedural = "tangle", shape = [6, 6, 6], peak = 3.0 }}'
FIT = f"""title = "tiny"
scene.file = "scene.xml"
threads = 1
reference = {{ source = "render", spp = 64, held_out = [1] }}
views = {{ rig = "ring", count = 3, width = 8, height = 8 }}
{TRUTH}
optimiser = {{ name = "adam" }}
fit = {{ iterations = 4, spp = 2 }}
event = [{{ name = "evaluate", every = 2 }}]
[[parameter]]
key = "{KEY}"
start = 0.2
shape = [3, 3, 3]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene, its start volume and an experiment."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "fit.toml").write_text(FIT)
    write_volume(tmp_path / "start.vol", np.full((2, 2, 2, 1), 0.25, "f"))
    for name in "abc":
        write_exr(tmp_path / f"{name}.exr", {"": np.full((8, 8, 3), 0.7, "f")})
    return tmp_path


#: References from files, for tests of what comes after them.
PHOTOS = ["--set", 'reference={source="files", paths=["a.exr", "b.exr", "c.exr"]}', "--set", "event=[]"]


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def refused(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """The one sentence of a run that is refused."""
    assert run(*arguments) == 1
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if line.startswith("mivol: ")]
    assert len(lines) == 1
    assert "Traceback" not in said
    return lines[0]


# -- render, explain, reference -----------------------------------------------------------------------------------


def test_render_writes_what_mitsuba_renders(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Rays through the constant cube: 0.25 x chord, tau beside exp(-tau); the file is named after the XML."""
    assert run("render", "-m", variant_rgb, "-Dspp=9", folder / "scene.xml") == 0
    assert capsys.readouterr().out.strip() == str(folder / "scene.exr")
    channels, _ = read_exr(folder / "scene.exr")
    assert set(channels) == {"R", "G", "B", "tau"}
    image = np.asarray(mi.render(mi.load_file(str(folder / "scene.xml"), spp=9)))
    assert np.allclose(channels["R"], image[..., 0], atol=1e-6)
    # Behind the middle of the picture the chord is 2 / cos(atan(1/4)), at most 4 % more than 2 within the pixel.
    assert np.isclose(channels["tau"][3, 4], 0.5, rtol=0.06)


def test_render_as_png_and_elsewhere(variant_rgb, folder: Path) -> None:
    assert run("render", folder / "scene.xml", "-o", folder / "a.png", "-t", 1) == 0
    assert (folder / "a.png").read_bytes()[:4] == b"\x89PNG"


def test_render_in_passes_is_the_mean(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three passes of 3 samples: interior pixels differ from one pass of 9 only by where samples fall, 4 % of tau."""
    scene = mi.load_file(str(folder / "scene.xml"), spp=9)
    once, names = render.render_image(scene, 0)
    monkeypatch.setattr(render, "SAMPLES_PER_PASS", 3 * 48)
    split, _ = render.render_image(scene, 0)
    assert names == ["R", "G", "B", "tau"]
    assert np.isclose(split[3, 4, 0], once[3, 4, 0], rtol=0.02)
    assert not np.array_equal(split, once)


def test_a_variant_without_its_gpu_is_refused(
    variant_rgb, folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dr, "has_backend", lambda backend: False)
    assert "needs an NVIDIA GPU" in refused(capsys, "render", folder / "scene.xml", "-m", "cuda_ad_rgb")


RENDER_REFUSED = {
    "unused define": (["-Dspq=3"], 'did you mean "spp"'),
    "define without a value": (["-Dspp"], "write -D name=value"),
    "unknown variant": (["-m", "llvm_rgb_ad"], 'no variant "llvm_rgb_ad"'),
    "no such sensor": (["-s", "3"], "no sensor 3"),
    "unknown format": (["-o", "a.jpg"], ".exr or .png"),
    "negative threads": (["-t", "-2"], "-2 threads"),
    "folder that is not there": (["-o", "nowhere/at/all.exr"], "no folder"),
}


@pytest.mark.parametrize("case", RENDER_REFUSED)
def test_render_refuses(variant_rgb, folder: Path, capsys: pytest.CaptureFixture, case: str) -> None:
    flags, sentence = RENDER_REFUSED[case]
    assert sentence in refused(capsys, "render", *flags, folder / "scene.xml")


def test_a_scene_that_is_not_there(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert "no scene file" in refused(capsys, "render", folder / "none.xml")


def test_explain_gives_a_reason_for_each_choice(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("explain", folder / "scene.xml") == 0
    said = capsys.readouterr().out
    assert "cube" in said
    assert said.count("because") >= 4


def test_explain_asks_about_another_depth(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    scene = folder / "scene.xml"
    scene.write_text(SCENE.replace('"albedo" value="0"', '"albedo" value="0.5"'))
    assert "set max_depth to 2" in refused(capsys, "explain", scene)
    assert run("explain", scene, "--max-depth", 2) == 0
    assert "one scattering leaves out" in capsys.readouterr().out


def test_reference_is_rendered_and_said(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    target = folder / "ref.exr"
    assert run("reference", folder / "scene.xml", "-o", target, "--max-depth", 6, "--spp", 64) == 0
    assert "64 samples a pixel" in capsys.readouterr().out
    channels, header = read_exr(target)
    assert "variance.R" in channels
    assert "mivol_reference" in header


# -- optimize -----------------------------------------------------------------------------------------------------


def files_of(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


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
    assert record["config"]["optimiser"]["beta_1"] == 0.9
    assert record["seeds"] == {"fit": 0, "references": 1}
    assert {"mivol", "mitsuba", "drjit"} <= set(record["versions"])
    assert record["plan"]
    assert all(choice["reason"] for choice in record["plan"])
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


def test_references_are_cached(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second fit of the same views renders none again, another truth does; and each row of the metrics is there once."""
    target = folder / "run"
    fewer = ["--set", 'reference={source="render", spp=32}', "--set", 'views={rig="ring", count=1, width=4, height=4}']
    flags = ["optimize", folder / "fit.toml", "-o", target, *fewer]
    assert run(*flags, "--set", "fit.iterations=1") == 0
    before = {path: path.stat().st_mtime_ns for path in (target / "references").iterdir()}
    assert run(*flags, "--set", "fit.iterations=2") == 0
    assert {path: path.stat().st_mtime_ns for path in (target / "references").iterdir()} == before
    assert len((target / "metrics.jsonl").read_text().splitlines()) == 3
    assert run(*flags, "--set", "fit.iterations=1", "--set", "truth.seed=4") == 0
    assert len(list((target / "references").glob("*.exr"))) == 2


def test_references_from_files(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Photographs (no header) are taken as they are; mivol's own must be of this scene."""
    write_exr(folder / "a.exr", {"": np.full((6, 8, 3), 0.7, "f")})
    (folder / "other.xml").write_text(SCENE.replace('value="35"', 'value="36"'))
    changes = ["--set", 'views={rig="scene", indices=[0]}', "--set", "event=[]", "--set", "fit.iterations=2"]
    files = ["--set", 'reference={source="files", paths=["a.exr"]}']
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *changes, *files) == 0
    assert run("reference", folder / "other.xml", "-o", folder / "d.exr", "--max-depth", 6, "--spp", 32) == 0
    capsys.readouterr()
    wrong = ["--set", 'reference={source="files", paths=["d.exr"]}']
    said = refused(capsys, "optimize", folder / "fit.toml", "-o", folder / "run", *changes, *wrong)
    assert "reference of another scene" in said
    right = ["--set", 'reference={source="files", paths=["d.exr"], scene="other.xml"}']
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *changes, *right) == 0


def test_views_that_are_held_out_come_after_the_others(variant_rgb, folder: Path) -> None:
    """A rig of their own: none of its views is fitted, all of them are compared, and their files follow the others'."""
    (folder / "d.exr").write_bytes((folder / "c.exr").read_bytes())
    files = 'reference={source="files", paths=["a.exr", "b.exr", "c.exr", "d.exr"], held_out=[0]}'
    more = 'held_out={rig="ring", count=1, width=8, height=8, elevation=40}'
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", "--set", files, "--set", more) == 0
    record = json.loads((folder / "run" / "run.json").read_text())
    assert {image["view"] for image in record["images"] if image.get("held_out")} == {"view 0", "view 3"}
    assert {image["view"] for image in record["images"] if not image.get("held_out")} == {"view 1", "view 2"}
    assert record["results"]["views"] == 2


def test_images_that_are_compared_may_have_more_samples(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four samples in each image of the fit, 32 in what is compared with held-out views and in what is kept."""
    asked, render = [], SceneProblem.render

    def listen(self: SceneProblem, sensor: mi.Sensor, seed: int, spp: int | None = None) -> mi.TensorXf:
        asked.append(spp or self.spp)
        return render(self, sensor, seed, spp)

    monkeypatch.setattr(SceneProblem, "render", listen)
    flags = ["--set", "fit.spp=4", "--set", "fit.spp_shown=32", "--set", "fit.iterations=1"]
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *flags) == 0
    # An evaluation, the step, an evaluation, and three views that are kept.
    assert asked == [32, 4, 32, 32, 32, 32]


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
    assert "sky.data as found" in (folder / "run" / "report.html").read_text()


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


def test_procedural_points_are_voxel_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe that returns one of its coordinates: x along the last axis, z along the first, centres at (i + 1/2) / n."""
    for axis, name in enumerate("xyz"):
        monkeypatch.setitem(PROCEDURAL, name, lambda p, rng, axis=axis: p[..., axis])
        values = make_procedural(name, (2, 3, 4), seed=0, peak=2.0)[..., 0]
        n = (4, 3, 2)[axis]
        line = np.moveaxis(values, 2 - axis, 0)[:, 0, 0]
        assert np.allclose(line, 2 * (np.arange(n) + 0.5) / n)


def test_procedural_volumes_are_the_same_object_at_every_resolution() -> None:
    """Fine voxels averaged over coarse ones against coarse voxels: they differ by the curvature inside a voxel only; with
    two axes exchanged they would differ by the object's own contrast. And another seed is another object."""
    coarse = make_procedural("tangle", (8, 10, 12), seed=1, peak=2.0)[..., 0]
    fine = make_procedural("tangle", (24, 30, 36), seed=1, peak=2.0)[..., 0]
    mean = fine.reshape(8, 3, 10, 3, 12, 3).mean(axis=(1, 3, 5))
    assert np.corrcoef(mean.ravel(), coarse.ravel())[0, 1] > 0.9
    assert np.corrcoef(make_procedural("tangle", (8, 10, 12), seed=2, peak=2.0).ravel(), coarse.ravel())[0, 1] < 0.8
    assert fine.max() <= 2.0
    assert fine.min() >= 0.0


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
        "is no grid of voxels",
    ),
    "a prior of a number": (
        ['parameter=[{key="cube.interior_medium.albedo.value.value", prior=[{name="tv"}]}]'],
        "compares neighbours",
    ),
}


@pytest.mark.parametrize("case", OPTIMIZE_REFUSED)
def test_optimize_refuses(variant_rgb, folder: Path, capsys: pytest.CaptureFixture, case: str) -> None:
    changes, sentence = OPTIMIZE_REFUSED[case]
    flags = [part for change in changes for part in ("--set", change)]
    assert sentence in refused(capsys, "optimize", folder / "fit.toml", "-o", folder / "run", *flags)


def test_views_of_different_sizes(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    sensor = SCENE[SCENE.index("<sensor") : SCENE.index("</sensor>") + 9]
    (folder / "scene.xml").write_text(SCENE.replace(sensor, sensor + sensor.replace('value="6"', 'value="5"')))
    flags = ["--set", 'views={rig="scene"}', "--set", 'reference={source="render", spp=64}']
    said = refused(capsys, "optimize", folder / "fit.toml", "-o", folder / "run", *flags)
    assert "8 x 5 pixels" in said
    assert "8 x 6" in said


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
    # It stops at the next safe point, in iteration 3 or before the one after.
    assert (folder / "cut" / "metrics.jsonl").read_text().count("\n") in (3, 4)
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
    said = refused(capsys, *flags, "--resume", "--set", "optimiser.beta_1=0.8")
    assert "optimiser.beta_1 is 0.9 there and 0.8 here" in said
    assert "parameter.0.shape.0 is 3 there" in refused(capsys, *flags, "--resume", "--set", f'parameter=[{{key="{KEY}"}}]')
    assert (folder / "run" / "run.json").read_text() == record


def test_a_run_that_is_done_may_be_resumed(variant_rgb, folder: Path) -> None:
    """There is nothing left to do, and nothing is said twice."""
    flags = ["optimize", folder / "fit.toml", "-o", folder / "run", *PHOTOS, "--set", "fit.iterations=2"]
    assert run(*flags) == 0
    metrics = (folder / "run" / "metrics.jsonl").read_text()
    assert run(*flags, "--resume") == 0
    assert (folder / "run" / "metrics.jsonl").read_text() == metrics


# -- The command itself -------------------------------------------------------------------------------------------


def test_report_writes_the_page_again(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("optimize", folder / "fit.toml", "-o", folder / "run", *PHOTOS, "--set", "fit.iterations=1") == 0
    page = (folder / "run" / "report.html").read_bytes()
    (folder / "run" / "report.html").unlink()
    assert run("report", folder / "run") == 0
    assert (folder / "run" / "report.html").read_bytes() == page
    assert "run.json" in refused(capsys, "report", folder)


def test_every_verb_says_what_it_does(capsys: pytest.CaptureFixture) -> None:
    for verb in VERBS:
        with pytest.raises(SystemExit) as done:
            run(verb, "--help")
        assert done.value.code == 0
        assert VERBS[verb][0].__doc__.partition("\n")[0] in capsys.readouterr().out.replace("\n", " ").replace("  ", " ")


def test_wrong_arguments_end_with_2(capsys: pytest.CaptureFixture) -> None:
    for arguments in ([], ["rendr"], ["render"], ["reference", "a.xml"]):
        with pytest.raises(SystemExit) as done:
            run(*arguments)
        assert done.value.code == 2


def test_verbs_are_short() -> None:
    """The house rule: under 30 lines, one function per arrow."""
    import inspect

    assert all(len(inspect.getsource(verb).splitlines()) < 30 for verb, _ in VERBS.values())
