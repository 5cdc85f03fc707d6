"""Does the wheel work where nothing else of this checkout is? Build it, install it alone, and run every verb of it once.

The wheel is installed with its extra ``llvm`` and no other, as ``pip install "mivol[llvm]"`` does it, into an environment of
its own, with the versions of constraints.txt. There this script runs once more, on scenes and photographs of a few pixels
that it makes itself: each verb must end with the exit code, the files and the sentences that are written down here.

    .ci/smoke_wheel.py                  all of it, about two minutes with pip's cache
    .ci/smoke_wheel.py --wheel W.whl    of a wheel that is built already
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERB_LIMIT = 300.0
"""Seconds after which a verb hangs: none takes ten of them."""


class Failed(Exception):
    """What was expected, and what was found."""


def check(holds: bool, sentence: str) -> None:
    """Stop with a sentence unless something holds."""
    if not holds:
        raise Failed(sentence)


# -- Outside: an environment that holds the wheel -------------------------------------------------------------------------


def build_wheel(folder: Path) -> Path:
    """Build the wheel of this checkout."""
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder], cwd=ROOT, check=True)
    (wheel,) = folder.glob("mivol-*.whl")
    return wheel


def bare_environment() -> dict[str, str]:
    """This process's environment without what would lead Python or Dr.Jit back to this checkout."""
    left_out = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "DRJIT_LIBLLVM_PATH")
    return {key: value for key, value in os.environ.items() if key not in left_out}


def install(wheel: Path, folder: Path) -> Path:
    """Make an environment with the wheel and what it asks for; its Python."""
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    what = ["--quiet", "--no-input", "--constraint", ROOT / "constraints.txt", f"{wheel}[llvm]"]
    subprocess.run([python, "-m", "pip", "install", *what], check=True, env=bare_environment())
    return python


# -- Inside: every verb ------------------------------------------------------------------------------------------------


def mivol(*arguments: str | Path, code: int = 0) -> str:
    """Run the command that the wheel installed; what it printed, output and errors.

    Raises:
        Failed: another exit code, or a traceback.
    """
    command = [Path(sys.executable).with_name("mivol"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=VERB_LIMIT, env=bare_environment(), check=False)
    printed, said = done.stdout + done.stderr, " ".join(map(str, ["mivol", *arguments]))
    check(done.returncode == code, f"{said}: expected exit code {code}, found {done.returncode}:\n{printed}")
    check("Traceback" not in printed, f"{said}: a traceback:\n{printed}")
    return printed


def camera(x: float, y: float, z: float, fov: float, pixels: int) -> str:
    """A sensor that looks at the origin."""
    return f"""<sensor type="perspective"><float name="fov" value="{fov}"/>
        <transform name="to_world"><lookat origin="{x}, {y}, {z}" target="0, 0, 0" up="0, 0.1, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="{pixels}"/><integer name="height" value="{pixels}"/>
            <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
        <sampler type="independent"><integer name="sample_count" value="16"/></sampler></sensor>"""


FOG = f"""<scene version="3.0.0"><integrator type="mivol"/><emitter type="constant"/>{camera(0, 0, 4, 1, 4)}
    <shape type="cube"><bsdf type="null"/><medium type="homogeneous" name="interior">
        <float name="albedo" value="0"/><float name="sigma_t" value="1"/></medium></shape></scene>"""
"""Black fog of optical depth 2, seen through two opposite faces along rays up to 0.71 degrees off the axis: exp(-2) to 2e-4."""

SMOKE = f"""<scene version="3.0.0"><integrator type="mivol"/><emitter type="constant"/>{camera(0, 1, 4, 35, 8)}
    <shape type="cube" id="cube"><bsdf type="null"/><medium type="heterogeneous" name="interior">
        <float name="albedo" value="0"/>
        <volume type="gridvolume" name="sigma_t"><string name="filename" value="start.vol"/>
            <transform name="to_world"><scale value="2"/><translate x="-1" y="-1" z="-1"/></transform></volume>
    </medium></shape></scene>"""

SMOKE_FIT = """title = "smoke"
scene.file = "smoke.xml"
reference = { source = "render", spp = 32, held_out = [1] }
views = { rig = "ring", count = 3, width = 8, height = 8 }
truth = { key = "cube.interior_medium.sigma_t.data", procedural = "tangle", shape = [6, 6, 6], peak = 3.0 }
optimizer = { name = "adam" }
fit = { iterations = 2, spp = 2 }
parameter = [{ key = "cube.interior_medium.sigma_t.data", domain = [0, inf], start = 0.1, shape = [6, 6, 6] }]
"""

SCAN_FIT = """title = "scan"
scan = { beam = "cone", views = 8, arc = 360, detector = [10, 10], pitch = 0.3, source_to_axis = 6, source_to_detector = 6 }
data = { source = "shepp_logan", scale = 2.0 }
grid = { shape = [8, 8, 8], voxel_size = 0.25 }
solve = { name = "pcg", iterations = 3 }
"""

PHOTO_FIT = """title = "a ball"
photos = { path = "photographs", background = "white", box = [[-1, -1, -1], [1, 1, 1]], held_out = 6, space = "srgb" }
field = { preset = "tiny", longest = 12, degree = 0, effort = 0.2 }
show = { frames = 3, views = 1 }
"""

VIEWS, FILM_FRAMES = 12, 3


def ball() -> str:
    """A red ball before white, and cameras around it."""
    around = (2 * math.pi * k / VIEWS for k in range(VIEWS))
    cameras = "".join(camera(4 * math.cos(a), 4 * math.sin(a), 0.8 * math.sin(3 * a), 35, 24) for a in around)
    return f"""<scene version="3.0.0"><emitter type="constant"/>{cameras}<shape type="sphere">
        <float name="radius" value="0.6"/><bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf>
        </shape></scene>"""


def mean_of(path: Path) -> float:
    """Mean of the colours of an EXR."""
    from mivol.files import read_exr

    channels, _ = read_exr(path)
    return sum(float(channels[name].mean()) for name in "RGB") / 3


def smoke_doctor(folder: Path) -> None:
    """This machine can render, and the wheel is the one that runs."""
    import mivol as package

    check(Path(package.__file__).is_relative_to(sys.prefix), f"mivol was imported from {package.__file__}")
    check(package.__version__ in mivol("--version"), "the version is not that of the package")
    mivol("doctor")


def smoke_explain(folder: Path) -> None:
    """Of a scene, with a reason; of photographs, with a picture: they are made by the verb before."""
    check("because albedo 0" in mivol("explain", "fog.xml"), "explain gives no reason for what it leaves out")
    check(f"{VIEWS} photographs" in mivol("explain", "photographs", "-o", "cameras.png"), "explain does not count photographs")
    check((folder / "cameras.png").read_bytes().startswith(b"\x89PNG"), "cameras.png is no PNG")


def smoke_demo(folder: Path) -> None:
    """The examples are in the wheel: listed, copied, and one of them run, small."""
    check("shepp_logan" in mivol("demo"), "demo does not list the head")
    mivol("demo", "cloud", "--into", "my_cloud")
    check((folder / "my_cloud" / "scene.xml").is_file(), "demo --into copies no scene")
    small = ["grid.shape=[8,8,8]", "grid.voxel_size=0.25", "scan.views=8", "scan.detector=[8,8]", "scan.pitch=0.4"]
    flags = [part for one in (*small, "solve.iterations=2") for part in ("--set", one)]
    page = folder / mivol("demo", "shepp_logan", "-o", "head", *flags).splitlines()[-1]
    check((folder / "head" / "report.html").is_file(), f"no page {page}")


def smoke_fetch(folder: Path) -> None:
    """The sets are listed; none is fetched here."""
    check("licence: BSD-3-Clause" in mivol("fetch"), "fetch tells no licence")
    check("no data set" in mivol("fetch", "frog", code=1), "a set that is not there is not named")


def smoke_validate(folder: Path) -> None:
    """Fog agrees with Mitsuba's own, and both files are there."""
    said = mivol("validate", "fog.xml", "-o", "fog_validation", "--spp", "16", "--reference-spp", "64")
    check("mivol agrees with Mitsuba's volpath" in said, f"fog is not validated:\n{said}")
    found = {path.suffix for path in (folder / "fog_validation").iterdir()}
    check({".png", ".json", ".exr"} <= found, f"expected a picture, figures and a reference, found {found}")


def smoke_bench(folder: Path) -> None:
    """The studies are listed, and the quickest is run."""
    check("optical_depth" in mivol("bench"), "bench lists no study")
    mivol("bench", "tomography", "--size", "16", "--views", "8", "--iterations", "2", "--out", "tomography")
    check((folder / "tomography" / "bench_tomography.json").is_file(), "bench tomography writes no figures")


def smoke_render(folder: Path) -> None:
    """An EXR with the right answer, a PNG, and a refusal."""
    mivol("render", "fog.xml", "-o", "fog.exr")
    found, expected = mean_of(folder / "fog.exr"), math.exp(-2)
    check(abs(found / expected - 1) < 2e-4, f"fog.exr: expected a mean of {expected}, found {found}")
    mivol("render", "fog.xml", "-o", "fog.png")
    check((folder / "fog.png").read_bytes().startswith(b"\x89PNG"), "fog.png is no PNG")
    check("no scene file frog.xml" in mivol("render", "frog.xml", code=1), "a scene that is not there is not named")


def smoke_reference(folder: Path) -> None:
    """An image of one camera, and photographs of all."""
    mivol("reference", "fog.xml", "--max-depth", "2", "--spp", "64", "-o", "reference.exr")
    # 64 samples of 16 pixels, each 0 or 1: a standard error of sqrt(T (1 - T) / 1024) = 0.0107, six of which are 0.065.
    found = mean_of(folder / "reference.exr")
    check(abs(found - math.exp(-2)) < 0.065, f"reference.exr: expected a mean of 0.135, found {found}")
    mivol("reference", "ball.xml", "-s", "all", "--max-depth", "2", "--spp", "32", "-o", "photographs")
    check((folder / "photographs" / "transforms.json").is_file(), "photographs have no file of cameras")


def check_run(folder: Path, *quantities: str) -> None:
    """A run folder has its page, and a record of finite results."""
    check("</html>" in (folder / "report.html").read_text(), f"{folder.name}: no whole page")
    results = json.loads((folder / "run.json").read_text())["results"]
    wrong = [name for name in quantities if not math.isfinite(results.get(name, math.nan))]
    check(not wrong, f"{folder.name}: no finite {', '.join(wrong)} among the results {results}")


def smoke_optimize(folder: Path) -> None:
    """Images, projections and photographs; and metrics that need an extra, which is named."""
    from PIL import Image

    mivol("optimize", "smoke.toml", "-o", "smoke")
    check_run(folder / "smoke", "nrmse")
    mivol("optimize", "scan.toml", "-o", "scan")
    check_run(folder / "scan", "nrmse")
    printed = mivol("optimize", "photos.toml", "-o", "photos")
    check_run(folder / "photos", "held_out_psnr", "ssim")
    check(printed.count("imageio-ffmpeg") == 1, f"what films are without ffmpeg is not said once:\n{printed}")
    with Image.open(folder / "photos" / "film" / "turntable.webp") as film:
        check(film.n_frames == FILM_FRAMES, f"the film has {film.n_frames} frames, not {FILM_FRAMES}")
    refused = mivol("optimize", "photos.toml", "-o", "judged", "--set", 'show.metrics=["flip"]', code=1)
    check('pip install "mivol[metrics]"' in refused, f"the extra that FLIP needs is not named:\n{refused}")


def smoke_export(folder: Path) -> None:
    """Every kind of file that a radiance field becomes; .svox.npz is of octrees."""
    from mivol.fields.field_files import FIELD_FORMATS

    check("expected an octree" in mivol("export", "photos/field.npz", "out.svox.npz", code=1), "a grid is taken for an octree")
    for suffix in sorted(FIELD_FORMATS.keys() - {".svox.npz"}):
        for path in mivol("export", "photos/field.npz", f"out{suffix}").split():
            check((folder / path).stat().st_size > 100, f"{path} is empty")
    check((folder / "out.ply").read_bytes().startswith(b"ply"), "out.ply is no PLY")


def smoke_convert(folder: Path) -> None:
    """Points become Gaussians, and what comes of them is explained."""
    import numpy as np

    np.save(folder / "points.npy", np.eye(4, 3))
    mivol("convert", "points.npy", "gaussians.ply", "--to", "gaussians")
    check("4 Gaussians" in mivol("explain", "gaussians.ply"), "four points are not four Gaussians")


def smoke_poses(folder: Path) -> None:
    """The wheel alone has no pycolmap: the extra that brings it is named."""
    refused = mivol("poses", "photographs", code=1)
    check('pip install "mivol[poses]"' in refused, f"the extra that poses need is not named:\n{refused}")


def smoke_view(folder: Path) -> None:
    """The wheel alone has no viser: the extra that brings it is named."""
    refused = mivol("view", "gaussians.ply", code=1)
    check('pip install "mivol[viewer]"' in refused, f"the extra that the viewer needs is not named:\n{refused}")


def smoke_sweep(folder: Path) -> None:
    """Two fits in turn, and a table of both; the wheel alone has no Dask, and the extra that brings it is named."""
    mivol("sweep", "smoke.toml", "--over", "seed=0,1", "-o", "sweep")
    check("2 of 2 runs" in (folder / "sweep" / "sweep.html").read_text(), "the page of the sweep does not have both runs")
    check_run(folder / "sweep" / "seed=1", "nrmse")
    refused = mivol("sweep", "smoke.toml", "--over", "seed=2,3", "-o", "sweep", "--cluster", "local:1", code=1)
    check('pip install "mivol[cluster]"' in refused, f"the extra that clusters need is not named:\n{refused}")


def smoke_report(folder: Path) -> None:
    """The same page again."""
    page = folder / "photos" / "report.html"
    before = page.read_bytes()
    page.unlink()
    mivol("report", "photos")
    check(page.read_bytes() == before, "the page of the same folder is another one")


SMOKES: tuple[Callable[[Path], None], ...] = (
    smoke_doctor, smoke_render, smoke_reference, smoke_explain, smoke_optimize, smoke_sweep, smoke_export, smoke_convert,
    smoke_poses, smoke_view, smoke_report, smoke_demo, smoke_fetch, smoke_validate, smoke_bench,
)  # fmt: skip
"""In the order in which each finds what it needs."""


def smoke(folder: Path) -> None:
    """Write the inputs and run every verb.

    Raises:
        Failed: what a verb did otherwise.
    """
    from mivol.cli import VERBS
    from mivol.files import write_volume

    import numpy as np

    left = set(VERBS) - {one.__name__.removeprefix("smoke_") for one in SMOKES}
    check(not left, f"no smoke for {', '.join(sorted(left))}: add one to SMOKES")
    os.chdir(folder)
    for name, text in {
        "fog.xml": FOG, "smoke.xml": SMOKE, "ball.xml": ball(),
        "smoke.toml": SMOKE_FIT, "scan.toml": SCAN_FIT, "photos.toml": PHOTO_FIT,
    }.items():  # fmt: skip
        (folder / name).write_text(text)
    write_volume(folder / "start.vol", np.full((4, 4, 4, 1), 0.1, np.float32))
    for one in SMOKES:
        start = time.perf_counter()
        one(folder)
        print(f"{one.__name__.removeprefix('smoke_'):<10}{time.perf_counter() - start:6.1f} s", flush=True)


def main() -> int:
    """Build, install and smoke; with --installed, smoke what is installed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wheel", type=Path, help="a wheel that is built already")
    parser.add_argument("--installed", action="store_true", help="smoke the mivol of this Python")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mivol-smoke-") as name:
        folder = Path(name).resolve()
        if args.installed:
            try:
                smoke(folder)
            except Failed as failure:
                print(f"smoke_wheel: {failure}", file=sys.stderr)
                return 1
            return 0
        python = install(args.wheel or build_wheel(folder), folder / "venv")
        inside = [python, "-I", Path(__file__).resolve(), "--installed"]
        return subprocess.run(inside, env=bare_environment(), cwd=folder, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
