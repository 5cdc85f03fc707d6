"""Does every run on a cluster end, with the same result, if one of two workers is killed at a random moment?

    mivol bench cluster_kills
    mivol bench cluster_kills --only render --kills 5

The study repeats a run of each verb on two local workers of one thread. A signal kills a worker after a random share of the
undisturbed time, and Dask starts a new worker. The results must equal the undisturbed results. A kill after the end of its run
is repeated. Fits stop before the report page, which the owner writes without workers.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol import config
from mivol.back_end import choose_back_end
from mivol.bench.harness.catalogue import answer_on
from mivol.bench.harness.study import AT_MOST, Promise, Size, Study, amount, ask, say
from mivol.bench.studies.preparation import PreparationSize, measure_axis
from mivol.cluster.connection import open_pool
from mivol.cluster.distribution import ClusterDistribution
from mivol.cluster.packages import SceneSource, share_scene
from mivol.cluster.pool import Pool
from mivol.cluster.reference import complete_on, passes_on
from mivol.cluster.sweep import run_on
from mivol.experiments.examples import copy_example
from mivol.experiments.fit_kind import RunContext
from mivol.experiments.kinds import KINDS, complete_fit
from mivol.experiments.run_folder import BestIterate, RunFolder
from mivol.experiments.sweep import plan_sweep, run_sweep
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_volume, write_png
from mivol.files.image_files import decode_srgb
from mivol.optim.photographs.field_view import render_view
from mivol.photos import Camera
from mivol.photos.camera import intrinsics
from mivol.photos.camera_path import aim_camera
from mivol.photos.transforms import write_transforms
from mivol.scene.load import load_scene
from mivol.scene.sensors import Ring
from mivol.validate.reference import render_photographs


@dataclass(frozen=True)
class KillSize(Size):
    """Amount of work."""

    kills: int = amount(20, 1, doc="killed workers for each verb")
    seed: int = amount(0, doc="of the moments and the victims")


MOST_TRIES = 3
"""Runs for each kill: a kill may come too late."""

VerbRun = Callable[[Pool, Path, str], np.ndarray]
"""Runs the work of a verb on a pool into a new folder, by its name; returns the numbers of the result."""

SCENE = ["views.count=4", "views.width=24", "views.height=24", "reference.spp=64", "reference.held_out=[3]", "threads=1",
         "parameter.0.shape=[10, 10, 10]", "event=[]"]  # fmt: skip
"""Changes of the example demo for fits of a second or two."""


def run_reference(pool: Pool, folder: Path, name: str) -> np.ndarray:
    """Mean and variance of four views."""
    path = folder / "demo" / "scene.xml"
    loaded = load_scene(path, {})
    looks = Ring(count=4, width=32, height=32).sensors(loaded.scene)
    complete = complete_on(pool, share_scene(pool, SceneSource(path), loaded))
    found = render_photographs(loaded, folder / name, complete=complete, sensors=looks, max_depth=6, max_spp=1024, target_se=0)
    return np.concatenate([np.ravel([view.mean, view.variance]) for view in found])


def run_render(pool: Pool, folder: Path, name: str) -> np.ndarray:
    """An image of 24 passes."""
    path = folder / "demo" / "scene.xml"
    scene = share_scene(pool, SceneSource(path), load_scene(path, {}))
    passes = passes_on(pool, scene, 0, {"type": "mivol", "max_depth": 6})
    return np.sum([image for image, _ in passes([(number, 16) for number in range(24)])], axis=0)


def run_validate(pool: Pool, folder: Path, name: str) -> np.ndarray:
    """The two streams of work of a validation: a reference, then passes of mivol."""
    return np.concatenate([run_reference(pool, folder, name), np.ravel(run_render(pool, folder, name))])


def run_fit(experiment: str, changes: list[str]) -> VerbRun:
    """All steps of a fit, from its data to its last iterate."""

    def run(pool: Pool, folder: Path, name: str) -> np.ndarray:
        path, workers = folder / experiment, ClusterDistribution(pool)
        settings = config.load(path, changes)
        kind = KINDS[type(settings)](RunContext(settings, path.parent, folder / name, distribution=workers))
        record = RunFolder(folder / name, kind.record)
        with record.at_work():
            kind.load(lambda line: None)
            kind.render_data(record)
            kind.problem = workers.make_problem(kind)
            best = BestIterate(record, kind.best_files())
            kind.prepare(record)
            values = complete_fit(kind, record, best).values()
        return np.concatenate([np.ravel(np.array(values[key])) for key in sorted(values)])

    return run


def run_sweep_of_fits(pool: Pool, folder: Path, name: str) -> np.ndarray:
    """Volumes of three whole fits."""
    over = ["seed=0..2"]
    sweep = plan_sweep(folder / "demo" / "fit.toml", over, [*SCENE, "fit.iterations=2"], folder / name)
    run_sweep(sweep, run_on(pool))
    volumes = [next((folder / name / run.name / "volumes").glob("*.npz")) for run in sweep.runs]
    return np.concatenate([np.ravel(read_volume(volume).values) for volume in volumes])


def run_bench(pool: Pool, folder: Path, name: str) -> np.ndarray:
    """A swept question of the bench: the rotation axes of twenty scans."""
    answer = answer_on(pool, "preparation", "axis", measure_axis, PreparationSize())
    return np.ravel([[row["column"], row["error"], row["sigma"]] for row in answer["scans"].values()])


BALL = """title = "a ball"
threads = 1
[photos]
path = "photographs"
background = "white"
box = [[-1, -1, -1], [1, 1, 1]]
held_out = 0
[show]
every = 1000
"""
HEAD = """title = "a head"
threads = 1
scan = { beam = "cone", views = 32, arc = 360, detector = [24, 24], pitch = 0.125, source_to_axis = 6, source_to_detector = 6 }
data = { source = "shepp_logan", photons = 1e4 }
grid = { shape = [24, 24, 24], voxel_size = 0.083 }
solve = { name = "pcg", iterations = 30, storage = "walk" }
"""
EXPERIMENTS = {
    "grid": BALL + '[field]\npreset = "tiny"\nlongest = 20\ndegree = 1\neffort = 0.2\n',
    "octree": BALL + '[field]\nkind = "octree"\npreset = "tiny"\nlongest = 16\ndegree = 0\neffort = 0.1\nsteps = 60\n',
    "hash": BALL + '[field]\nkind = "hash"\npreset = "tiny"\neffort = 0.15\n',
    "nerf": BALL + '[field]\nkind = "nerf"\npreset = "tiny"\neffort = 0.05\n',
    "gaussians": BALL + '[gaussians]\npreset = "tiny"\nstart = 100\nmost = 200\neffort = 0.1\nviews = 3\n',
    "scan": HEAD,
}
"""Experiments beside the example demo."""

VERBS: dict[str, VerbRun] = {
    "reference": run_reference,
    "render": run_render,
    "validate": run_validate,
    "optimize_scene": run_fit("demo/fit.toml", [*SCENE, "fit.iterations=6"]),
    "sweep": run_sweep_of_fits,
    "bench": run_bench,
} | {f"optimize_{name}": run_fit(f"{name}.toml", []) for name in EXPERIMENTS}


def write_experiments(folder: Path) -> None:
    """The example demo, photographs of a ball of many colours, and a scan."""
    copy_example("demo", folder / "demo")
    for name, text in EXPERIMENTS.items():
        (folder / f"{name}.toml").write_text(text)
    z, y, x = np.meshgrid(*3 * [np.linspace(-1, 1, 16)], indexing="ij")
    colours = np.stack([np.sin(3 * x), np.cos(4 * y), np.sin(3 * z + 1)], axis=-1)[..., None, :]
    ball = SphericalGrid.from_dense(60 * (0.6 - np.sqrt(x * x + y * y + z * z)), colours, np.diag([2.0, 2, 2, 1]) + OFFSET)
    like, cameras = Camera(intrinsics(32, 32, 12, 12), (24, 24), np.eye(4)), {}
    (folder / "photographs").mkdir()
    for number in range(8):
        turn, name = 2 * np.pi * number / 8, f"view_{number}.png"
        origin = np.array([3 * np.cos(turn), 3 * np.sin(turn), 1.5 * np.cos(3 * turn)])
        cameras[name] = aim_camera(like, origin, np.zeros(3), np.array([0, 0, 1.0]), name)
        seen = render_view(ball, cameras[name], np.ones(3))
        image = np.concatenate([decode_srgb(np.clip(seen.image, 0, 1)), seen.opacity[..., None]], axis=2)
        write_png(folder / "photographs" / name, image)
    write_transforms(folder / "photographs" / "transforms.json", cameras, [])


OFFSET = np.pad(-np.ones((3, 1)), ((0, 1), (3, 0)))
"""Moves the unit cube's corner, times two, to -1."""


@contextlib.contextmanager
def strike_after(seconds: float, pid: int) -> Iterator[list[int]]:
    """Kill a process after some seconds by a timer of this process; the list has its number once it was killed."""
    struck: list[int] = []

    def strike(number: int, frame: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            struck.append(pid)

    before = signal.signal(signal.SIGALRM, strike)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield struck
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def measure_kills(verb: str, size: KillSize) -> dict:
    """Undisturbed and disturbed runs of a verb."""
    choose_back_end("llvm_ad_rgb", 1)
    rng, rows = np.random.default_rng((size.seed, list(VERBS).index(verb))), []
    with tempfile.TemporaryDirectory() as name, open_pool("local:2", threads=1, say=lambda line: None) as pool:
        folder = Path(name)
        write_experiments(folder)
        VERBS[verb](pool, folder, "first")  # compiles kernels
        start = time.monotonic()
        expected = VERBS[verb](pool, folder, "undisturbed")
        seconds = time.monotonic() - start
        for number in range(MOST_TRIES * size.kills):
            pids = [worker.facts.pid for worker in pool.workers.values()]
            lost, repeated, share = pool.lost, pool.repeated, rng.random()
            with strike_after(max(1e-3, share * seconds), int(rng.choice(pids))) as struck:
                found = VERBS[verb](pool, folder, f"run{number}")
            if struck:
                difference = float(np.abs(found - expected).max() / np.abs(expected).max())
                row = {"share": share, "repeated": pool.repeated - repeated, "difference": difference}
                rows.append(row | {"is_equal": bool(np.array_equal(found, expected))})
                say(f"{verb} {len(rows)} of {size.kills}: {row}")
                while pool.lost == lost or len(pool.workers) < 2:
                    pool.begin()
                    time.sleep(0.2)
            if len(rows) == size.kills:
                break
    return {
        "kills": rows, "ended": len(rows), "missing": size.kills - len(rows), "seconds": seconds,
        "equal": sum(row["is_equal"] for row in rows), "repeated": sum(row["repeated"] for row in rows),
        "largest_difference": max(row["difference"] for row in rows),
    }  # fmt: skip


def table(question: str, answer: dict) -> list[str]:
    """A line of the answer."""
    return [
        f"{question}: {answer['ended']} of {answer['ended'] + answer['missing']} runs with a killed worker ended, "
        f"{answer['equal']} equal to the bit, largest difference {answer['largest_difference']:.2g}, "
        f"{answer['repeated']} pieces of work repeated"
    ]


PROMISES = [
    Promise("kills without an ended run", ("missing",), AT_MOST, 0),
    Promise("largest difference over largest value", ("largest_difference",), AT_MOST, 1e-6),
]

STUDY = Study(
    __name__, __doc__, KillSize, {verb: ask(f"Does a killed worker change {verb}?", measure_kills, verb) for verb in VERBS},
    table=table, promises=dict.fromkeys(VERBS, PROMISES),
)  # fmt: skip
