"""Each verb on a tiny scene: what it writes, what it says, and how it refuses."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

import drjit as dr
import mitsuba as mi
import msgspec
import numpy as np
import pytest
from tiny_experiment import PHOTOS, SCENE, refused, run, write_experiment

from mivol.cli import VERBS, describe_error, load_named_scene, main, parse
from mivol.config import EXPERIMENTS, ScanExperiment, SceneExperiment, Sought
from mivol.errors import MivolError, MivolWarning
from mivol.files import read_exr
from mivol.optim.events import Checkpoint, Evaluate, UpdateOccupancy
from mivol.optim.first_order import Adam
from mivol.optim.losses import L2
from mivol.optim.optimizer import Constant
from mivol.optim.priors import DecoupledPrior, Smoothness, Sparsity, ViewDependence
from mivol.optim.projections.inversion import LinearSolve


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene, its start volume and an experiment."""
    return write_experiment(tmp_path)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MivolError("no grid"), "no grid"),
        (FileNotFoundError("no file"), "no file"),
        (
            OSError(28, "No space left on device"),
            "no space is left on the disk ([Errno 28] No space left on device): free some "
            "space, or write elsewhere; finished files are kept.",
        ),
        (MemoryError(), "the memory does not suffice (nothing more is known): take fewer voxels, pixels or views."),
    ],
)
def test_an_error_is_said_in_its_own_words(error: Exception, said: str) -> None:
    assert describe_error(error) == said


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


@pytest.mark.parametrize(("flag", "level"), [([], "Warn"), (["-v"], "Debug")])
def test_messages_of_mitsuba_are_asked_for(monkeypatch: pytest.MonkeyPatch, flag: list[str], level: str) -> None:
    """Its warnings are shown always, and what it does where it is asked for; the scene is looked for in more folders."""
    told, folders = [], []
    for name in ("mivol.back_end.choose_back_end", "mivol.scene.load.load_scene"):
        monkeypatch.setattr(name, lambda *asked: asked)
    monkeypatch.setattr(mi, "set_log_level", told.append)
    monkeypatch.setattr(mi, "file_resolver", lambda: folders)
    arguments = parse(["render", "a.xml", "-a", "one;two", "-Dspp=9", *flag])
    assert load_named_scene(arguments) == (Path("a.xml"), {"spp": "9"})
    assert (told, folders) == ([getattr(mi.LogLevel, level)], ["one", "two"])


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


def test_a_film_beyond_the_memory_is_refused(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """By every verb that renders, whatever integrator, before anything is rendered; 100000^2 pixels were tracebacks."""
    scene, text = folder / "scene.xml", (folder / "scene.xml").read_text()
    scene.write_text(text.replace('"width" value="8"', '"width" value="100000"').replace('value="6"', 'value="100000"'))
    renders = [["render", scene], ["render", scene, "--integrator", "volpath"], ["validate", scene, "-o", folder / "judged"]]
    for command in [*renders, ["reference", scene, "--max-depth", "2", "-o", folder / "a.exr"]]:
        said = refused(capsys, *command)
        assert "a film of 100000 x 100000 pixels needs" in said and "give it fewer pixels" in said
    assert run("explain", scene) == 1
    facts, _, refusal = capsys.readouterr().out.partition("refused\n")
    assert "optical depth at most" in facts
    assert "a film of 100000 x 100000 pixels needs" in refusal


def test_memory_that_runs_out_is_a_sentence(
    folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no count had foreseen it: NumPy's own words, and no traceback."""

    def full(*given: object) -> None:
        raise MemoryError("Unable to allocate 58.2 TiB")

    monkeypatch.setattr("mivol.report.page.write_page", full)
    said = refused(capsys, "report", folder)
    assert said == "mivol: the memory does not suffice (Unable to allocate 58.2 TiB): take fewer voxels, pixels or views."


def test_a_scene_that_is_not_there(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert "no scene file" in refused(capsys, "render", folder / "none.xml")


@pytest.mark.parametrize("verb", ["render", "optimize", "validate"])
def test_a_volume_that_is_not_there(capsys: pytest.CaptureFixture, folder: Path, verb: str) -> None:
    """Not that the file is a volume, which its suffix would say."""
    said = refused(capsys, verb, folder / "none.vdb")
    assert "none.vdb: found nothing there, expected an existing file" in said


def test_explain_gives_a_reason_for_each_choice(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("explain", folder / "scene.xml") == 0
    said = capsys.readouterr().out
    assert "cube" in said
    assert said.count("because") >= 4


def test_explain_asks_about_another_depth(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    scene = folder / "scene.xml"
    scene.write_text(SCENE.replace('"albedo" value="0"', '"albedo" value="0.5"'))
    assert run("explain", scene) == 0
    assert "free flights" in capsys.readouterr().out
    assert run("explain", scene, "--max-depth", 2) == 0
    assert "max_depth 2 leaves out" in capsys.readouterr().out


def test_reference_is_rendered_and_said(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    target = folder / "ref.exr"
    assert run("reference", folder / "scene.xml", "-o", target, "--max-depth", 6, "--spp", 64) == 0
    assert "64 samples a pixel" in capsys.readouterr().out
    channels, header = read_exr(target)
    assert "variance.R" in channels
    assert "mivol_reference" in header


# -- What render is told ------------------------------------------------------------------------------------------


def test_render_by_another_integrator_with_samples_and_seed(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """The image is Mitsuba's own of that integrator, sample count and seed; what is not ours is named."""
    flags = ["--integrator", "volpath", "--spp", 3, "--seed", 5, "-o", folder / "a.exr"]
    assert run("render", folder / "scene.xml", *flags) == 0
    assert "rendered by VolumetricSimplePathIntegrator" in capsys.readouterr().err
    scene = mi.load_file(str(folder / "scene.xml"))
    stock = mi.load_dict({"type": "volpath", "max_depth": 6})
    image = np.asarray(mi.render(scene, integrator=stock, spp=3, seed=5))
    assert np.array_equal(read_exr(folder / "a.exr")[0]["R"], image[..., 0])
    assert run("render", folder / "scene.xml", "-o", folder / "b.exr") == 0
    assert capsys.readouterr().err == ""


def test_render_checks_where_it_writes_before_it_renders(
    variant_rgb, folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mivol.experiments.render.render_image", lambda *given: pytest.fail("rendered first"))
    assert ".exr or .png" in refused(capsys, "render", folder / "scene.xml", "-o", "a.jpg")
    assert "no folder" in refused(capsys, "render", folder / "scene.xml", "-o", folder / "nowhere" / "a.exr")


def test_render_refuses_an_unknown_integrator(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert '"volpat" cannot be loaded' in refused(capsys, "render", folder / "scene.xml", "--integrator", "volpat")
    assert "0 samples a pixel" in refused(capsys, "render", folder / "scene.xml", "--spp", 0)


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
        said = capsys.readouterr().out
        assert VERBS[verb].summary in said.replace("\n", " ").replace("  ", " ")
        assert said.count("\n") <= 80  # two screens
    with pytest.raises(SystemExit) as done:
        run("bench", "representations", "--help")
    assert done.value.code == 0 and "--fox-edge" in capsys.readouterr().out


def test_settings_are_listed_by_a_word_in_their_names(capsys: pytest.CaptureFixture) -> None:
    """Below each kind of experiment that takes them; a word in the meaning alone ("memory") chooses nothing."""
    with pytest.raises(SystemExit) as done:
        run("optimize", "--settings", "beta_1")
    heading, line = capsys.readouterr().out.splitlines()
    assert (done.value.code, heading) == (0, "A fit of scene parameters to images: a file with a table [scene]:")
    assert line == "  optimizer[adam].beta_1 = 0.9: memory of the gradient (at least 0, below 1)"
    with pytest.raises(SystemExit) as done:
        run("optimize", "--settings")
    assert done.value.code == 0 and sum(line[0] != " " for line in capsys.readouterr().out.splitlines()) == len(EXPERIMENTS)
    with pytest.raises(SystemExit) as done:
        run("optimize", "--settings", "gradient")
    assert done.value.code == 2 and "found no setting with gradient in its name" in capsys.readouterr().err


def test_wrong_arguments_end_with_2(capsys: pytest.CaptureFixture) -> None:
    for arguments in ([], ["rendr"], ["render"], ["reference", "a.xml"], ["doctor", "--quik"]):
        with pytest.raises(SystemExit) as done:
            run(*arguments)
        assert done.value.code == 2


@pytest.mark.parametrize("length", [10, 100_000])
def test_a_reader_that_has_gone_ends_quietly(capsys: pytest.CaptureFixture, monkeypatch, length: int) -> None:
    """As in ``mivol bench | head -1``: no message and no traceback, also when Python flushes the output at its end, and for a
    text that does not fit into Python's buffer."""

    def answer(arguments: object) -> None:
        """Print a text."""
        print("x" * length)

    monkeypatch.setitem(VERBS, "bench", VERBS["bench"]._replace(run=answer))
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        assert main(["bench"]) == 141
    assert capsys.readouterr().err == ""


def test_verbs_are_short() -> None:
    """The house rule: under 30 lines, one function per arrow."""
    import inspect

    assert all(len(inspect.getsource(verb.run).splitlines()) < 30 for verb in VERBS.values())


def test_a_doubt_of_mivol_is_one_sentence_without_a_line_of_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """A warning of another package keeps its place, which a report of a fault needs."""
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    monkeypatch.setattr(sys, "argv", ["mivol", "demo"])
    assert main() == 0
    assert warnings.formatwarning(MivolWarning("a is cut."), MivolWarning, "ply.py", 3, "code") == "mivol: a is cut.\n"
    assert warnings.formatwarning(RuntimeWarning("1 / 0"), RuntimeWarning, "ply.py", 3, "code").startswith("ply.py:3: Runtime")


# -- Defaults of flags -------------------------------------------------------------------------------------------------

DEFAULTS = {
    SceneExperiment: {
        **{"held_out": None, "truth": None, "optimizer": Adam(), "schedule": Constant(), "loss": L2()},
        "event": (Checkpoint(every=10), Evaluate(every=10)),
    },
    ScanExperiment: {"grid": None},
    Sought: {"prior": ()},
    DecoupledPrior: {"weight": 1.0},
    Smoothness: {"weight": 1.0, "share": 0.125, "every": 1},
    Sparsity: {"weight": 1.0},
    ViewDependence: {"weight": 1.0},
    UpdateOccupancy: {"every": 64},
    LinearSolve: {
        **{"solver": "pcg", "subsets": 10, "drift": 0, "relaxation": 1.0, "decay": 0.99, "window": "ram-lak", "cutoff": 1.0},
        "stop_norm": 0.0,
    },
}


@pytest.mark.parametrize("kind", DEFAULTS, ids=lambda kind: kind.__name__)
def test_defaults(kind: type) -> None:
    defaults = {field.name: field.default for field in msgspec.structs.fields(kind)}
    assert {name: defaults[name] for name in DEFAULTS[kind]} == DEFAULTS[kind]
