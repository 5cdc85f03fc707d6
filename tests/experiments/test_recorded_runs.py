"""Commands on tiny scenes, scans and photographs compute what was recorded: every file they write, and what they print.

``pytest tests/experiments/test_recorded_runs.py -m slow --record`` records anew, when a change of the numbers is meant.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
import recorded_results
from ball_photos import WHITE, ball, camera
from gaussian_sets import random_gaussians
from tiny_experiment import FIT, SCENE, write_experiment

from mivol.cli import main
from mivol.fields.field_files import write_field
from mivol.files import decode_srgb, write_png, write_volume
from mivol.optim.photographs.field_view import render_view
from mivol.photos.transforms import write_transforms
from mivol.points import write_gaussians

RECORDED = Path(__file__).with_suffix(".json")

SCAN = """title = "tiny head"
held_out_every = 6
threads = 1
scan = { beam = "cone", views = 12, arc = 360, detector = [8, 10], pitch = 0.25, source_to_axis = 6, source_to_detector = 6 }
data = { source = "shepp_logan", scale = 2.0 }
grid = { shape = [8, 9, 10], voxel_size = 0.2 }
solve = { name = "pcg", iterations = 3 }
"""
PARALLEL = """title = "tiny slice"
threads = 1
scan = { beam = "parallel", views = 20, arc = 180, detector = [3, 20], pitch = 0.1 }
data = { source = "shepp_logan", scale = 2.0, photons = 1e4 }
grid = { shape = [3, 20, 20], voxel_size = 0.1 }
solve = { name = "fbp" }
"""
PHOTOS = """title = "A ball"
threads = 1
photos = { path = ".", background = "white", box = [[-1, -1, -1], [1, 1, 1]], held_out = 0, judged = "test" }
show = { frames = 2, views = 1, every = 2 }
"""
SMALL_FIELDS = {
    "grid": 'field = { preset = "tiny", longest = 10, degree = 1, effort = 0.02 }',
    "octree": 'field = { kind = "octree", start = "field.npz", steps = 8, preset = "tiny", effort = 0.02 }',
    "hash": 'field = { kind = "hash", preset = "tiny", effort = 0.02 }',
    "nerf": 'field = { kind = "nerf", preset = "tiny", effort = 0.02 }',
    "gaussians": 'gaussians = { preset = "tiny", effort = 0.02, start = 60, most = 120 }',
}


def write_photographs() -> None:
    """Eight views of a ball of many colours."""
    cameras = {f"view_{k}.png": camera(k, 20) for k in range(8)}
    for name, one in cameras.items():
        write_png(Path(name), decode_srgb(np.clip(render_view(ball(12), one, WHITE).image, 0, 1)))
    write_transforms(Path("transforms.json"), cameras, ["view_3.png", "view_6.png"])


def write_inputs() -> None:
    """The files that the commands read."""
    write_experiment(Path())
    Path("scattering.xml").write_text(
        SCENE.replace('name="albedo" value="0"', 'name="albedo" value="0.7"').replace(
            '<string name="aovs" value="tau"/>', '<string name="aovs" value="tau"/><integer name="max_depth" value="4"/>'
        )
    )
    Path("scattering.toml").write_text(FIT.replace("scene.xml", "scattering.xml").replace("spp = 64", "spp = 32"))
    for name, text in (("cone", SCAN), ("parallel", PARALLEL)):
        Path(f"{name}.toml").write_text(text)
    for name, text in SMALL_FIELDS.items():
        Path(f"{name}.toml").write_text(f"{PHOTOS}{text}\n")
    write_photographs()
    write_field(Path("field.npz"), ball(8))
    write_gaussians(Path("cloud.ply"), random_gaussians(9, 0))
    values = np.random.default_rng(3).random((4, 5, 6, 1), np.float32)
    write_volume(Path("box.nrrd"), values, np.diag([6.0, 5, 4, 1]))


SIZE = ("--size", "8", "6")
RUNS: dict[str, list[tuple[str, ...]]] = {
    "scene fit": [("explain", "fit.toml"), ("optimize", "fit.toml", "-o", "run")],
    "scattering fit": [("explain", "scattering.toml"), ("optimize", "scattering.toml", "-o", "run")],
    "scans": [
        ("explain", "cone.toml"),
        ("optimize", "cone.toml", "-o", "run"),
        ("optimize", "cone.toml", "-o", "fdk", "--set", "solve={name='fdk'}"),
        ("optimize", "cone.toml", "-o", "prior", "--set", "solve.tv=0.01"),
        ("explain", "parallel.toml"),
        ("optimize", "parallel.toml", "-o", "fbp"),
        ("optimize", "parallel.toml", "-o", "sirt", "--set", "solve={name='sirt', iterations=3}"),
    ],
    **{
        f"photographs, {kind}": [("explain", f"{kind}.toml"), ("optimize", f"{kind}.toml", "-o", "run")]
        for kind in SMALL_FIELDS
    },
    "pictures": [
        ("explain", "scattering.xml"),
        ("render", "scattering.xml", "-o", "scene.exr", "--spp", "2"),
        ("render", "scattering.xml", "-o", "scene.png", "--spp", "2"),
        ("reference", "scattering.xml", "-o", "reference.exr", "--spp", "32", "--max-depth", "4"),
        ("render", "field.npz", "-o", "field.exr", "--look-at", "2", "1", "2", "0", "0", "0", *SIZE),
        ("render", "cloud.ply", "-o", "cloud.exr", *SIZE),
        ("render", "box.nrrd", "-o", "box.exr", "--spp", "2", *SIZE),
    ],
    "files": [
        *(("explain", name) for name in ("field.npz", "cloud.ply", "box.nrrd", "start.vol", "transforms.json")),
        ("export", "field.npz", "scene.xml"),
        ("export", "field.npz", "mesh.ply"),
        ("export", "cloud.ply", "gaussians.xml"),
        ("convert", "field.npz", "octree.npz", "--to", "octree"),
        ("convert", "field.npz", "made.ply", "--to", "gaussians"),
        ("convert", "cloud.ply", "cloud.spz"),
        ("convert", "cloud.ply", "cloud.splat"),
        *(
            ("convert", "box.nrrd", f"box{suffix}")
            for suffix in (".vol", ".mhd", ".nii", ".vdb", ".nvdb", ".vti", ".mrc", ".npz")
        ),
    ],
    "sweep and validation": [
        ("sweep", "fit.toml", "-o", "sweep", "--over", "fit.spp=1,2"),
        ("validate", "scattering.xml", "-o", "validation", "--spp", "16", "--reference-spp", "32", "--max-depth", "4"),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_command_computes_what_was_recorded(
    cpu_back_end: None, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: bool
) -> None:
    places = iter(("one", "two"))

    def run() -> dict:
        folder = tmp_path / next(places)
        folder.mkdir()
        monkeypatch.chdir(folder)
        write_inputs()
        inputs = {path.name for path in folder.iterdir()}
        for k, words in enumerate(RUNS[name]):
            said = io.StringIO()
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
                assert main(list(words)) == 0, words
            Path(f"said {k}.txt").write_text(said.getvalue())
        for given in inputs:
            Path(given).unlink()
        return dict(recorded_results.read_results(folder))

    recorded_results.check(RECORDED, name, run, record)
