"""A small absorbing cube as an experiment in files: scene, start and settings, and the command run on them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from fit_scene import KEY

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments.kinds import explain_experiment
from mivol.files import write_exr, write_volume

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
optimizer = {{ name = "adam" }}
fit = {{ iterations = 4, spp = 2 }}
event = [{{ name = "evaluate", every = 2 }}]
[[parameter]]
key = "{KEY}"
start = 0.2
shape = [3, 3, 3]
"""

#: References from files, for tests of what comes after them.
PHOTOS = ["--set", 'reference={source="files", paths=["a.exr", "b.exr", "c.exr"]}', "--set", "event=[]"]


def write_experiment(folder: Path) -> Path:
    """A scene, its start volume, an experiment, and photographs for it."""
    (folder / "scene.xml").write_text(SCENE)
    (folder / "fit.toml").write_text(FIT)
    write_volume(folder / "start.vol", np.full((2, 2, 2, 1), 0.25, "f"))
    for name in "abc":
        write_exr(folder / f"{name}.exr", {"": np.full((8, 8, 3), 0.7, "f")})
    return folder


def run(*arguments: object) -> int:
    """The exit code of a command."""
    return main([str(argument) for argument in arguments])


def refused(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """The one sentence of a run that is refused."""
    assert run(*arguments) == 1
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if line.startswith("mivol: ")]
    assert len(lines) == 1
    assert "Traceback" not in said
    return lines[0]


def assert_explained(path: Path, changes: list[str], said: str) -> None:
    """``explain`` refuses an experiment with changes by the sentence that ``optimize`` said, free memory apart."""
    try:
        found = explain_experiment(config.load(path, changes), path.parent).refusal
    except MivolError as error:
        found = str(error)
    assert without_memory(found) == without_memory(said.rpartition("mivol: ")[2].rstrip("\n"))


def without_memory(sentence: str) -> str:
    """A sentence without what changes with the memory that is free."""
    return re.sub(r"[\d.,]+ (?=GiB|fits|are)", "", sentence)


def files_of(folder: Path) -> set[str]:
    """All files below a folder, relative to it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def resume_stopped_fit(path: Path, problem: type, change: str, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The iterations of a fit that Ctrl-C stopped in iteration 45 and that goes on; with another setting it does not."""
    whole, started = problem.loss_and_gradient, []

    def stop(self: object, reals: object, iteration: int, views: int) -> object:
        if iteration == 45:
            raise KeyboardInterrupt
        return whole(self, reals, iteration, views)

    def note(self: object, reals: object, iteration: int, views: int) -> object:
        started.append(iteration)
        return whole(self, reals, iteration, views)

    fit = ["optimize", path, "-o", path.parent / "run"]
    monkeypatch.setattr(problem, "loss_and_gradient", stop)
    assert run(*fit) == 130
    monkeypatch.setattr(problem, "loss_and_gradient", note)
    assert run(*fit, "--resume") == 0
    assert run(*fit, "--resume", "--set", change) == 1
    return started
