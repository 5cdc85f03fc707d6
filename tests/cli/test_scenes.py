"""Every experiment in scenes/ runs, made tiny on the command line, and finds more than nothing."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from mivol.cli import main
from mivol.fields.field_files import write_field
from mivol.fields.procedural import make_procedural
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_exr, read_sparse_volume, read_volume, write_volume
from mivol.points import write_gaussians

SCENES = Path(__file__).resolve().parents[2] / "scenes"
SMALL_VIEWS = ("views.width=16", "views.height=16")
FEW_VIEWS = (*SMALL_VIEWS, "views.count=8", "reference.held_out=[2]", "reference.spp=32")
SMALL_HELD_OUT = ("held_out.width=16", "held_out.height=16", "held_out.count=2", "reference.spp=64", "fit.spp_shown=32")
TINY = {
    "bonsai": ["grid.shape=[32,32,32]", "grid.voxel_size=8", "solve.iterations=6"],
    "cloud": [*SMALL_VIEWS, *SMALL_HELD_OUT, "views.count=8", "fit.iterations=16", "event.0.at=[8]", "event.1.every=8"],
    "demo": [*FEW_VIEWS, "truth.shape=[10,10,10]", "parameter.0.shape=[5,5,5]", "fit.iterations=3", "event.0.at=[2]"],
    "lamp": [*SMALL_VIEWS, *SMALL_HELD_OUT, "fit.iterations=40", "event.0.every=40"],
    "shepp_logan": ["solve.iterations=3"],
    "smoke": [*FEW_VIEWS, "fit.iterations=2"],
    "tooth": ["solve.iterations=4", "data.drift=2", "grid.shape=[2,95,95]", "grid.voxel_size=4.0", "solve.tv=0"],
    "still_life": ['field.preset="tiny"', "field.longest=32", "field.effort=0.3", "show.frames=4"],
    "white_smoke": [*SMALL_VIEWS, *SMALL_HELD_OUT, "views.count=8", "fit.iterations=16", "event.0.at=[8]", "event.1.every=8"],
}
DATA = {
    "cloud": ("truth.file", "clouds_les/rico32x37x26.txt"),
    "lamp": ("scene.define.volume", "volumes_vol/tutorials_volume.vol"),
    "smoke": ("truth.file", "volumes_vol/tutorials_volume.vol"),
    "tooth": ("data.file", "ct_projections/tooth.h5"),
    "white_smoke": ("truth.file", "volumes_vol/tutorials_volume.vol"),
}
"""Which setting names the data beside the project, and which file it is."""

MADE = {
    "bonsai": (
        ("--views", 30, "--columns", 30),
        ("scan.file=panels.txt", "data.file=readings.npy", "data.flats=flats.npy", "data.darks=darks.npy"),
    ),
    "still_life": (("--views", 20, "--size", 48, "--spp", 16), ("photos.path=",)),
}
"""What is made by the scene's own script, tiny, before it is fitted, and the settings that name it, below the folder of it."""

NOWHERE = {"MIVOL_DATA": "", "MIVOL_CACHE": "nowhere"}
"""No public data is there: what stands in for it is small."""

SCRIPTS = {
    "big_cloud": "render.py",
    "bonsai": "scan.py",
    "cloud": "models.py",
    "explosion": "render.py",
    "fire": "render.py",
    "fog": "render.py",
    "knot": "render.py",
    "relit_smoke": "relight.py",
    "showcase": "render.py",
    "scan_view": "tables.py",
    "still_life": "photographs.py",
    "tank": "fit.py",
    "white_smoke": "views.py",
}
MORE_SCRIPTS = {"tank": ("glass.py",)}
"""Beside those of :data:`SCRIPTS`."""


def test_every_scene_is_here():
    """A new scene needs its tiny override, or a script that a test below makes tiny."""
    assert sorted(p.parent.name for p in SCENES.glob("*/fit.toml")) == sorted(TINY)
    all_scripts = [*SCRIPTS.items(), *((name, script) for name, more in MORE_SCRIPTS.items() for script in more)]
    assert sorted(p.relative_to(SCENES).as_posix() for p in SCENES.glob("*/*.py")) == sorted(
        f"{name}/{script}" for name, script in all_scripts
    )
    # The scans of trajectories run in the tests of tomography.
    assert {p.parent.name for p in SCENES.glob("*/README.md")} == {*TINY, *SCRIPTS, "trajectories"}


@pytest.mark.parametrize("name", sorted({*TINY, *SCRIPTS}))
def test_its_readme_is_five_lines_with_the_command(name):
    lines = (SCENES / name / "README.md").read_text().splitlines()
    assert len(lines) == 5
    assert lines[0].startswith("# ")
    assert lines[1].startswith(("    mivol optimize scenes/", "    python scenes/"))


@pytest.mark.slow
@pytest.mark.usefixtures("plain_figures")
@pytest.mark.parametrize("name", TINY)
def test_scene_runs(name, tmp_path, request, script):
    changes = list(TINY[name])
    if name in DATA:
        key, file = DATA[name]
        changes.append(f'{key}="{request.getfixturevalue("data_dir") / file}"')
    if name in MADE:
        arguments, named = MADE[name]
        made = tmp_path / "made"
        script(name, *arguments, "-o", made, **NOWHERE)
        changes += [f'{key}="{made / file}"' for key, file in (setting.split("=") for setting in named)]
    out = tmp_path / "run"
    arguments = ["optimize", str(SCENES / name / "fit.toml"), "-o", str(out)]
    for change in changes:
        arguments += ["--set", change]
    assert main(arguments) == 0
    record = json.loads((out / "run.json").read_text())
    assert (out / "report.html").stat().st_size > 10_000
    FOUND[name](record["results"])
    shutil.rmtree(out)


def better_than_nothing(results):
    """A few steps from nothing: below the error of an empty volume, which is 1 by definition."""
    assert results["nrmse"] < 1


def nearer_the_lamp(results):
    """Forty steps of at most 0.1 at a falling rate, 2 in all for each coordinate: from 3.0 of the true place to below half."""
    place = [results[f"lamp.position[{i}]"] for i in range(3)]
    assert np.linalg.norm(np.subtract(place, (1.1, 1.4, -0.6))) < 1.5


def more_than_white(results):
    """A field of nothing shows the white behind it, 10 dB from the held-out photographs."""
    assert results["held_out_psnr"] > 12


def explains_something(results):
    """The truth is not known: below the residual of an empty volume, which is 1 by definition."""
    assert results["residual"] < 1


FOUND = dict.fromkeys(TINY, better_than_nothing) | {
    **{"lamp": nearer_the_lamp, "still_life": more_than_white},
    **dict.fromkeys(("bonsai", "tooth"), explains_something),
}


Script = Callable[..., str]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, two_threads: None) -> Script:
    """A function that runs a script of a scene as a program, in this process, and returns what it prints."""

    def run(name: str, *arguments: object, file: str = "", **environment: str) -> str:
        path = SCENES / name / (file or SCRIPTS[name])
        with monkeypatch.context() as patch:
            patch.setattr(sys, "argv", [str(path), *map(str, arguments)])
            patch.syspath_prepend(str(path.parent))
            for key, value in environment.items():
                patch.setenv(key, value)
            capsys.readouterr()
            runpy.run_path(str(path), run_name="__main__")
        sys.modules.pop("fit", None)  # glass.py imports fit.py from its own folder
        return capsys.readouterr().out

    return run


@pytest.mark.slow
def test_tank(tmp_path, script):
    """One channel is fitted as the others are; 5 iterations at 16 x 16 pixels come within a fifth of g and a half of the
    coefficients, from starts that are a third to a half of them."""
    tiny = ("--size", 16, "--spp", 32, "--photo-spp", 512, "--dilutions", 0.05, 0.1, "--iterations", 5)
    said = script("tank", *tiny, "-o", tmp_path)
    off = {k: float(v) / 100 for k, v in re.findall(r"^(green \w+).* off by ([\d.]+)%", said, re.MULTILINE)}
    assert off["green g"] < 0.2
    assert max(off["green sigma_s"], off["green sigma_a"]) < 0.5
    assert (tmp_path / "tank.png").stat().st_size > 10_000


@pytest.mark.slow
def test_tank_of_milk(tmp_path):
    """Published with g = 0, from which nothing is off by a percentage. A script in a process of its own, as users run it."""
    tiny = ("--liquid", "skim milk", "--size", 8, "--spp", 8, "--photo-spp", 64, "--dilutions", 0.02, "--iterations", 2)
    command = [sys.executable, str(SCENES / "tank" / "fit.py"), *map(str, tiny), "-o", str(tmp_path)]
    env = os.environ | {"PYTHONWARNINGS": "error::RuntimeWarning"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr[-2000:]
    assert len(re.findall(r"^\w+ +g .*off by [\d.]+, ", done.stdout, re.MULTILINE)) == 3


def moments_by(glass, offset, seed):
    """The sums of one photograph (24, 24) at u = offset from the truth, with an image linear in u, and noise in everything.

    Each of 8 rounds of derivatives has a noise of twice their size.
    """
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.arange(24) / 24, np.arange(24) / 24, indexing="ij")
    slopes = np.stack([np.cos(np.pi * x), np.cos(np.pi * y), np.cos(2 * np.pi * x)], axis=-1) / 4
    photo = glass["Photograph"](0.1, 0, 2 + 0.1 * rng.normal(size=x.shape), np.full(x.shape, 0.01), 0.1)
    images = 2 + slopes @ offset + 0.3 * rng.normal(size=(8, *x.shape))
    return glass["moments_of"](photo, glass["Look"](images, slopes + 0.35 * rng.normal(size=(8, *slopes.shape))))


@pytest.fixture
def glass(monkeypatch):
    """What scenes/tank/glass.py defines; it imports fit.py from its own folder."""
    monkeypatch.syspath_prepend(str(SCENES / "tank"))
    yield runpy.run_path(str(SCENES / "tank" / "glass.py"))
    sys.modules.pop("fit", None)


def test_steps_in_the_tank_of_glass_go_all_the_way_though_derivatives_are_noisy(glass):
    """A step of 0.3 is right on average to a hundredth of it, over 200 seeds.

    The noise of a derivative, 4 / 8 of its square in the mean of 8 rounds (a third of that after the blur), would make J^T J a
    sixth too large and steps so much too short. The steps differ by some 0.03 each, their mean by 0.002.
    """
    offset = np.array([0.3, -0.3, 0.3])
    steps = [moments_by(glass, offset, seed).step for seed in range(200)]
    assert np.abs(np.mean(steps, axis=0) + offset).max() < 0.01


def test_standard_errors_in_the_tank_of_glass_are_those_of_the_steps(glass):
    """At the true u: the spread of 200 steps is known to 5 %, so 20 % are four standard errors."""
    found = [moments_by(glass, np.zeros(3), seed) for seed in range(200)]
    spread = np.std([moments.step for moments in found], axis=0, ddof=1)
    said = np.sqrt(np.mean([moments.errors**2 for moments in found], axis=0))
    assert np.abs(said / spread - 1).max() < 0.2


def test_a_pixel_of_the_tank_is_not_weighed_by_its_own_noise(glass):
    """At the true u the sums vanish on average, where pixels are noisy: by 4 standard errors of the mean of 300.

    Weights of 1 / m by the same m would favour pixels that came out too dark.
    """
    sums = []
    for seed in range(300):
        photo = glass["Photograph"](0.1, 0, np.ones((12, 12)), np.zeros((12, 12)), 0.0)
        images = np.random.default_rng(seed).gamma(0.5, 2.0, size=(4, 12, 12))
        sums.append(glass["moments_of"](photo, glass["Look"](images, np.ones((4, 12, 12, 3)))).misfit[0])
    assert abs(np.mean(sums)) < 4 * np.std(sums, ddof=1) / np.sqrt(len(sums))


@pytest.mark.slow
def test_tank_in_glass(tmp_path, glass, variant_rgb):
    """A channel of few pixels, from a start that is a quarter off: nearer than the start, and within 5 standard errors.

    The errors are some 4 % for sigma_s and 0.4 % for sigma_a (3 seeds). Some seeds end far off with a quarter of the samples,
    and one of three with 8 x 8 pixels.
    """
    truth = np.array([0.154, 0.183, 0.929])
    given = SimpleNamespace(
        output=tmp_path, dilutions=[0.1, 0.2], size=10, photo_spp=4096, max_depth=-1, iterations=4, rounds=4, seed=0
    )
    photographs = glass["photographs_of"](glass["XML"], truth, 2, 0, given)
    sought = np.array([np.log(truth[0]), np.log(truth[1]), np.arctanh(truth[2])])
    start = np.array([np.log(1.25 * truth[0]), np.log(0.8 * truth[1]), np.arctanh(0.9)])
    u, errors = glass["fit"](glass["Model"](glass["XML"], given.size, 512), photographs, start, given)
    off = np.abs(u - sought)
    assert np.all(off < np.abs(start - sought))
    assert np.all(off < 5 * errors) and errors.max() < 0.1


@pytest.mark.slow
def test_what_is_said_of_the_tank_in_glass(tmp_path, script):
    """All coefficients of all channels beside the published, a warning where steps have not settled, and the figure."""
    # Fewer samples may leave a coefficient without a derivative: blue light hardly leaves the juice.
    tiny = ("--size", 8, "--spp", 16, "--photo-spp", 64, "--rounds", 2, "--iterations", 1, "--dilutions", 0.1)
    said = script("tank", *tiny, "-o", tmp_path, file="glass.py")
    assert len(re.findall(r"^\w+ +(?:sigma_s|sigma_a|g) .* off by [\d.]+%, [\d.]+ s.e.$", said, re.MULTILINE)) == 9
    assert "not settled in 1 steps" in said
    assert (tmp_path / "tank.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.usefixtures("plain_figures")
def test_models_of_a_cloud(tmp_path, data_dir, script):
    """A few steps of both models from the same photographs, rendered once."""
    tiny = ("--models", "single", "all", "--size", 8, "--photo-spp", 32, "--iterations", 6)
    said = script("cloud", *tiny, "-o", tmp_path, MIVOL_DATA=str(data_dir))
    rows = re.findall(r"scattering: ([\d.]+) dB .*nRMSE of the volume ([\d.]+), optical depth of columns ([\d.]+)", said)
    assert len(rows) == 2
    assert all(float(psnr) > 15 and float(columns) < 1 for psnr, _, columns in rows)
    references = [sorted((tmp_path / name / "references").iterdir()) for name in ("single", "all")]
    assert [p.name for p in references[0]] == [p.name for p in references[1]]


@pytest.mark.slow
def test_fire(tmp_path, data_dir, script):
    """A flame of some hundred cd/m2 (a black body of 1318 K has 835) before a dusk of some tens."""
    said = script("fire", "--size", 48, "--spp", 16, "-o", tmp_path, MIVOL_DATA=str(data_dir))
    median, most = map(float, re.search(r"luminance ([\d.]+) cd/m2 in the median, ([\d.]+) cd/m2 at most", said).groups())
    assert 10 < median < 80 and 200 < most < 835
    assert (tmp_path / "fire.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_big_cloud(tmp_path: Path, script: Script) -> None:
    """The script says what it stores, and the cloud is brighter than the sky around it."""
    said = script("big_cloud", "--voxels", 96, "--size", 24, "--spp", 4, "--gradient", "--vdb", "-o", tmp_path)
    bricks = int(re.search(r"^(\d+) bricks, [\d.]+% of 96\^3 voxels above 0", said, re.MULTILINE).group(1))
    assert 50 < bricks < 12**3 and f"derivatives by {512 * bricks} voxels" in said
    assert read_sparse_volume(tmp_path / "cloud.vdb").values.shape[0] == bricks
    assert (tmp_path / "cloud.png").stat().st_size > 500


@pytest.mark.slow
def test_an_explosion(tmp_path: Path, script: Script) -> None:
    """Two grids of one file, with their own boxes; hot gas lies where there is soot, and shines."""
    said = script("explosion", "--cells", 48, "--size", 24, "--spp", 32, "-o", tmp_path)
    hottest = float(re.search(r"up to (\d+) K", said).group(1))
    assert 1200 < hottest < 2050
    soot, heat = (read_volume(tmp_path / "fire.vdb", name) for name in ("density", "temperature"))
    assert soot.values.shape != heat.values.shape and 0.1 < soot.values.max() < 2 and heat.values.max() > 1200
    centres = [volume.to_world[:3, :3] @ [0.5, 0.5, 0.5] + volume.to_world[:3, 3] for volume in (soot, heat)]
    assert np.abs(centres[0][:2]).max() < 1.5 and np.linalg.norm(centres[0] - centres[1]) < 3
    image = read_exr(tmp_path / "explosion.exr")[0]
    assert image["R"].max() > 4 * 0.08  # of the dusk


def test_an_exposure_is_chosen_by_the_brightest_hundredth() -> None:
    """Radiances of any scale are shown alike: of a hundred and one pixels the second brightest at nine tenths of white."""
    render = runpy.run_path(str(SCENES / "fire" / "render.py"))
    image = np.stack([np.linspace(0, 1, 101), np.linspace(0, 0.5, 101), np.zeros(101)], axis=-1)[None]
    for scale in (1e-3, 40):
        exposure = render["find_exposure"](scale * image)
        assert 1 - np.exp(-exposure * scale * 0.99) == pytest.approx(0.9, rel=1e-9)


def test_a_made_up_fire_is_hot_in_its_soot() -> None:
    """The same numbers each time, no hotter than the simulation's 1318 K, extinction wherever light is made."""
    plume = runpy.run_path(str(SCENES / "fire" / "render.py"))["plume"]
    (temperature, soot), again = plume(), plume()
    assert np.array_equal(temperature, again[0]) and np.array_equal(soot, again[1])
    assert temperature.shape == soot.shape == (21, 41, 81)
    assert 1000 < temperature.max() <= 1318 and soot[temperature > 800].min() > 1


@pytest.mark.slow
def test_what_stands_in_for_the_data_of_scripts(tmp_path: Path, script: Script) -> None:
    """Where nothing was fetched, each script runs to its picture and says in one sentence what it shows."""
    runs = {
        "fire": ("--size", 16, "--spp", 4),
        "fog": ("--size", 16, "--spp", 4),
        "scan_view": ("--size", 48, "--spp", 1, "--iterations", 1),
        "relit_smoke": ("--volume", tmp_path / "found.vol", "--size", 8, "--spp", 4, "--reference-spp", 32),
    }
    write_volume(tmp_path / "found.vol", make_procedural("tangle", (53, 45, 44), 2, 1.8))
    for name, small in runs.items():
        said = script(name, *small, "-o", tmp_path / name, **NOWHERE)
        assert len(re.findall("^.*(?:not here|not on this machine): .*(?:stands in for|replaces).*$", said, re.MULTILINE)) == 1
        assert sum(path.stat().st_size > 200 for path in (tmp_path / name).glob("*.png")) > 0


@pytest.mark.slow
def test_gaussians_in_fog_cast_a_shadow(tmp_path: Path, variant_rgb: None) -> None:
    """A ball of splats takes light of the spot from the floor behind it, and next to none from what is seen above it.

    The seeds are fixed and medians are compared. The ratio is 1 where no light is taken, and 0.4 in the shadow (fog before the
    floor and the sky stay): 0.7 and 0.9 lie between the two.
    """
    scene = runpy.run_path(str(SCENES / "fog" / "render.py"))
    write_gaussians(tmp_path / "ball.ply", scene["ball"](1000))
    shown = scene["load"](tmp_path / "ball.ply", scene["BOX"], width=48, height=32, spp=64, blur=0.02)
    with_them = np.array(mi.render(shown, seed=0)).mean(axis=-1)
    values = mi.traverse(shown)
    values["gaussians.interior_medium.emission.opacity_logits"] -= 40
    values.update()
    ratio = with_them / np.array(mi.render(shown, seed=0)).mean(axis=-1)
    assert np.median(ratio[16:20, 30:36]) < 0.7
    assert 0.9 < np.median(ratio[:8]) < 1.1


@pytest.mark.slow
def test_a_knot_of_gaussians_is_lit_and_casts_a_shadow(tmp_path: Path, script: Script) -> None:
    """Beside the picture without them: less light on the floor behind, more where the lamp shines on them, the same elsewhere.

    The seed is fixed. The ratio is 1 where nothing changes, and about 0.4 in the shadow, where the sky stays.
    """
    script("knot", "--count", 300, "--size", 16, "--spp", 2, "-o", tmp_path)
    assert (tmp_path / "knot.png").stat().st_size > 200
    scene = runpy.run_path(str(SCENES / "knot" / "render.py"))
    write_gaussians(tmp_path / "many.ply", scene["knot"](1500))
    sizes = {"width": 48, "height": 32, "spp": 16}
    shown = mi.load_file(str(SCENES / "knot" / "scene.xml"), cloud=str(tmp_path / "many.ply"), **sizes)
    with_them = np.array(mi.render(shown, seed=0)).mean(axis=-1)
    values = mi.traverse(shown)
    values["knot.interior_medium.sigma_t.opacity_logits"] -= 40
    values.update()
    ratio = with_them / np.array(mi.render(shown, seed=0)).mean(axis=-1)
    assert np.median(ratio[26:, 15:18]) < 0.75
    assert np.median(ratio[6:10, 14:18]) > 1.05
    assert 0.95 < np.median(ratio[:5]) < 1.05


@pytest.mark.slow
def test_the_showcase_shows_four_things_and_how_the_smoke_changes_the_image(tmp_path: Path, script: Script) -> None:
    """A denser smoke changes the image most within the smoke's own pixels (upper left), and hardly at the Gaussians (right).

    The seed is fixed and absolute means are compared.
    """
    write_gaussians(tmp_path / "needles.ply", runpy.run_path(str(SCENES / "knot" / "render.py"))["knot"](300))
    rng = np.random.default_rng(0)
    box = np.array([[2.0, 0, 0, -1], [0, 2, 0, -1], [0, 0, 0.8, -0.2], [0, 0, 0, 1]])
    field = SphericalGrid.from_dense(rng.uniform(0, 9, (4, 6, 6)), rng.normal(0.5, 0.2, (4, 6, 6, 1, 3)), box)
    write_field(tmp_path / "field.npz", field)
    files = ("--field", tmp_path / "field.npz", "--needles", tmp_path / "needles.ply")
    script("showcase", *files, "--size", 32, "--spp", 4, "--tangent-spp", 16, "-o", tmp_path)
    assert (tmp_path / "image.png").stat().st_size > 200 and (tmp_path / "tangent.png").stat().st_size > 200
    channels, _ = read_exr(tmp_path / "tangent.exr")
    change = np.abs(np.mean([channels[c] for c in "RGB"], axis=0))
    assert np.isfinite(change).all() and change[2:12, 5:18].mean() > 4 * change[2:12, 55:70].mean()


@pytest.mark.slow
def test_scan_view(tmp_path, data_dir, script):
    """Twenty steps of Adam bring the view nearer than the grey ramp that they start from (14 dB)."""
    said = script("scan_view", "--size", 48, "--spp", 8, "--iterations", 20, "-o", tmp_path, MIVOL_DATA=str(data_dir))
    assert float(re.search(r"found: ([\d.]+) dB", said).group(1)) > 22
    shown = {name: np.array(Image.open(tmp_path / f"{name}.png")) / 255 for name in ("tooth", "tooth_found")}
    assert not np.array_equal(shown["tooth"], shown["tooth_found"])
    # The scan fills some of the picture, on a ground of less than 0.02 (sRGB code 0.15), and enamel is bright.
    assert 0.05 < np.mean(shown["tooth"].max(axis=-1) > 0.3) < 0.5


@pytest.mark.slow
def test_relit_smoke(tmp_path, data_dir, script):
    """A blurred truth in place of a reconstruction: nearer the true smoke under the new lamps than its mean in its hull."""
    values = read_volume(data_dir / "volumes_vol" / "tutorials_volume.vol", frame="unit").values
    blurred = sum(np.roll(values, step, axis) for axis in range(3) for step in (-1, 0, 1)) / 9
    write_volume(tmp_path / "found.vol", blurred.astype(np.float32))
    sizes = ("--size", 24, "--spp", 64, "--reference-spp", 128)
    said = script("relit_smoke", "--volume", tmp_path / "found.vol", *sizes, "-o", tmp_path, MIVOL_DATA=str(data_dir))
    psnr = {name: float(value) for name, value in re.findall(r"^(\w[\w ]*): ([\d.]+) dB", said, re.MULTILINE)}
    assert psnr["reconstruction"] > psnr["its mean in its hull"] + 1
    assert (tmp_path / "relit_smoke.png").stat().st_size > 10_000


@pytest.mark.slow
def test_more_views_of_the_smoke(tmp_path, data_dir, script):
    """Ten views predict held-out ones better than two do."""
    tiny = ("--counts", 2, 10, "--size", 10, "--iterations", 16)
    said = script("white_smoke", *tiny, "-o", tmp_path, MIVOL_DATA=str(data_dir))
    psnr = {int(n): float(value) for n, value in re.findall(r"^ *(\d+) views: ([\d.]+) dB", said, re.MULTILINE)}
    assert psnr[10] > psnr[2]
    assert (tmp_path / "views.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_slice_of_the_bonsai(tmp_path, script):
    """Both solvers come nearer to the layer than nothing, which errs by 1."""
    said = script("bonsai", "--slice", "--views", 30, "--columns", 60, **NOWHERE)
    assert "a procedural volume stands in" in said
    errors = {name: float(value) for name, value in re.findall(r"^mivol (\w+).*nRMSE ([\d.]+)$", said, re.MULTILINE)}
    assert errors.keys() == {"cgls", "pcg"}
    assert max(errors.values()) < 0.7
