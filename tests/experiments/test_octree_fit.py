"""``mivol optimize`` of an octree: from a field of a file or a grid of its own, with its stages on the page, and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ball_photos import WHITE, ball, camera
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments.octree_fit import NETWORKS, find_preset, make_network_plan, make_octree_plan, read_start
from mivol.experiments.run_folder import FIRST_CHECKPOINT
from mivol.fields.field_files import read_field, write_field
from mivol.fields.octree import Octree
from mivol.files import decode_srgb, write_png
from mivol.optim.loop import Fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import PRESETS
from mivol.optim.photographs.sampled_problem import PRESETS as SAMPLED
from mivol.photos.transforms import write_transforms


@pytest.fixture
def photographs(variant_rgb: str, tmp_path: Path) -> Path:
    """Ten views of the ball over white, two of them to be judged by, and its grid."""
    cameras = {}
    for k in range(10):
        cameras[f"view_{k}.png"] = camera(k)
        write_png(tmp_path / f"view_{k}.png", decode_srgb(np.clip(render_view(ball(), camera(k), WHITE).image, 0, 1)))
    write_transforms(tmp_path / "transforms.json", cameras, ["view_3.png", "view_8.png"])
    write_field(tmp_path / "grid.npz", ball())
    return tmp_path


def toml(folder: Path, field: str, photos: str = 'background = "white"') -> Path:
    path = folder / "fit.toml"
    path.write_text(
        f"""
        title = "A ball"
        [photos]
        path = "."
        box = [[-1, -1, -1], [1, 1, 1]]
        held_out = 0
        judged = "test"
        {photos}
        [field]
        kind = "octree"
        {field}
        [show]
        frames = 0
        """
    )
    return path


@pytest.mark.parametrize("start", ["hash", "nerf"])
def test_the_first_level_is_a_network_of_its_preset(
    photographs: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, start: str
) -> None:
    """``mivol explain`` describes the network; a run counts its time, and a continued one keeps it."""
    path = toml(photographs, f'start = "{start}"\npreset = "tiny"\neffort = 0.01\nsteps = 100\ndepth = 4')
    assert main(["explain", str(path)]) == 0
    said = capsys.readouterr().out
    assert "steps: traced in each step" in said and "refused" not in said
    tiny = SAMPLED[start]["tiny"]
    assert make_network_plan(config.load(path)) == replace(tiny, steps=max(1, round(tiny.steps * 0.01)))
    with pytest.raises(MivolError, match='"cpu" is no preset of the (hash|nerf) network: choose one of tiny'):
        make_octree_plan(config.load(toml(photographs, f'start = "{start}"\npreset = "cpu"')))
    assert find_preset(config.load(toml(photographs, f'start = "{start}"')).field) == NETWORKS[start]
    assert main(["explain", str(toml(photographs, 'start = "hsah"'))]) == 1
    assert 'hsah, expected a field (.npz), "hash" or "nerf"' in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "field, names",
    [
        ('start = "grid.npz"\nsteps = 20', ["grid", "octree", "octree, its leaves fitted"]),
        (
            'start = "hash"\neffort = 0.03\nsteps = 400\ndepth = 5',
            ["hash grid", "its occupied cells", "octree", "octree, its leaves fitted"],
        ),
        (
            'preset = "tiny"\nlongest = 24\ndegree = 1\neffort = 0.3\nsteps = 100',
            ["grid", "octree", "octree, its leaves fitted"],
        ),
    ],
)
def test_stages_stand_on_the_page(photographs: Path, field: str, names: list[str]) -> None:
    run = photographs / "run"
    assert main(["optimize", str(toml(photographs, field)), "-o", str(run)]) == 0
    rows = json.loads((run / "stages" / "stages.json").read_text())
    assert [row[0] for row in rows] == names
    assert isinstance(read_field(run / "field.npz"), Octree) and "its leaves fitted" in (run / "report.html").read_text()
    before, after = (float(row[2]) for row in rows[-2:])
    # Rounded values are read again for both.
    assert after > before - 0.5
    times, network = json.loads((run / "run.json").read_text())["timings"], rows[0]
    assert ("hash grid" in times) == (network[0] == "hash grid")
    if network[0] == "hash grid":
        assert int(network[-1]) <= times["hash grid"] + 1 and int(network[-1]) <= int(rows[-1][-1])
        assert main(["optimize", str(photographs / "fit.toml"), "-o", str(run), "--resume"]) == 0
        assert json.loads((run / "stages" / "stages.json").read_text())[0] == network
        assert "hash grid" in json.loads((run / "run.json").read_text())["timings"]


@pytest.mark.slow
def test_an_interrupted_network_goes_on(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within its own fit: a resumed run has the network of a run that was not interrupted."""
    path = toml(photographs, 'start = "hash"\npreset = "tiny"\neffort = 0.1\nsteps = 2\ndepth = 4')
    assert make_network_plan(config.load(path)).steps > 4
    advance, begun = Fit.advance, []

    def stop(fit: Fit) -> None:
        if fit.next_iteration == 3:
            raise KeyboardInterrupt
        advance(fit)

    stopped, whole = photographs / "stopped", photographs / "whole"
    monkeypatch.setattr(Fit, "advance", stop)
    assert main(["optimize", str(path), "-o", str(stopped)]) == 130
    assert (stopped / FIRST_CHECKPOINT).is_file()
    monkeypatch.setattr(Fit, "advance", lambda fit: (begun.append(fit.next_iteration), advance(fit)))
    assert main(["optimize", str(path), "-o", str(stopped), "--resume"]) == 0
    assert begun[0] == 3 and not (stopped / FIRST_CHECKPOINT).exists()
    assert main(["optimize", str(path), "-o", str(whole)]) == 0
    networks = [np.load(folder / "stages" / "hash.npz") for folder in (stopped, whole)]
    for name in (key for key in networks[1].files if networks[1][key].dtype.kind == "f"):
        # Threads add derivatives in no fixed order, and values are written in half precision: its last place is 2^-10.
        np.testing.assert_allclose(networks[0][name], networks[1][name], rtol=2**-10, atol=1e-6)


def test_explain_begins_an_octree_at_a_file(photographs: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["explain", str(toml(photographs, 'start = "grid.npz"\nsteps = 1'))]) == 0
    assert "begins at grid.npz" in capsys.readouterr().out


def test_an_octree_needs_one_box_and_a_known_background(photographs: Path) -> None:
    for field, photos in (('preset = "capture"', ""), ("", 'background = "sky"')):
        assert_refused("one box and a known background", make_octree_plan, config.load(toml(photographs, field, photos)))
    assert_refused("cpv", make_octree_plan, config.load(toml(photographs, 'preset = "cpv"')))
    assert_refused("srgb and the photographs are linear", read_start, photographs / "grid.npz", "linear", 1.0)


def test_settings_become_a_plan(photographs: Path) -> None:
    """Effort counts for all steps; a start leaves out the grid; what is absent is the preset's."""
    words = 'preset = "tiny"\neffort = 0.5\ndegree = 1\ntolerance = 0.25\nsteps = 9'
    settings = config.load(toml(photographs, words))
    plan = make_octree_plan(settings)
    tiny, grid = PRESETS["tiny"], plan.grid
    assert [stage.steps for stage in grid.stages] == [max(1, round(stage.steps * 0.5)) for stage in tiny.stages]
    assert grid.epochs == tiny.epochs * 0.5 and (grid.degree, grid.few_degree) == (1, None)
    assert (plan.recipe.depth, plan.recipe.keep_weight, plan.recipe.tolerance) == (0, 0.015, 0.25)
    assert plan.leaves.steps == 5 and plan.grid_steps == grid.steps and plan.random_background == grid.random_background
    small = make_octree_plan(config.load(toml(photographs, 'preset = "tiny"\nlongest = 16'))).grid
    assert small.stages[-1].longest == 16 and not small.cubic and small.few_degree == tiny.few_degree
    begun = make_octree_plan(config.load(toml(photographs, 'start = "grid.npz"\ndepth = 4')))
    assert begun.grid is None and begun.recipe.depth == 4 and begun.grid_steps == 0 and begun.leaves.steps == 400
