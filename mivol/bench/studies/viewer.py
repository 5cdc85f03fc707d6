"""How long does a page of the live view wait for its first picture, and how much slower is a fit that is looked at?

    mivol bench viewer [--edge 400] [--rounds 9]
    mivol bench viewer --only cost [--fits 5]

A request is a camera that a page has not asked for before. The coarse picture answers it; the full picture follows when the
camera rests. Subjects are made on the spot: random Gaussians in a ball, a grid with harmonics of degree 2 around the surface of
a ball, and a volume of values. Kernels are warm, as after the start of ``mivol view``. Times are medians over rounds, in
processor time of all threads and in time of the clock; on two idle cores the first is about twice the second. Under load the
painter makes the coarse picture smaller; the processor time of a picture of the whole edge does not depend on the load.

``cost`` repeats a fit of the example demo, alone and with a viewer in turn. The viewer is a process that asks for a new camera
after each picture, more often than a person does. Its times are the clock during the steps of the fit, which needs a machine
without other work, and the processor time of the fit's process.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mivol.back_end import choose_back_end
from mivol.bench.harness.study import AT_MOST, Promise, Size, Study, amount, ask
from mivol.bench.studies.storage import make_field
from mivol.errors import MivolError
from mivol.experiments.examples import copy_example
from mivol.experiments.render import make_camera
from mivol.fields.field_files import write_field
from mivol.files import write_volume
from mivol.points import Gaussians, write_gaussians
from mivol.report.record import RECORD, read_record
from mivol.threads import follow_program, run_child
from mivol.view.painter import Painter
from mivol.view.subjects import open_subject

ASPECT = 4, 3


@dataclass(frozen=True)
class ViewerSize(Size):
    """Options."""

    edge: int = amount(400, 64, doc="longest edge of the picture [pixel]")
    rounds: int = amount(9, 1, doc="cameras asked for")
    gaussians: int = amount(50_000, 500, doc="number of Gaussians")
    nodes: int = amount(96, 16, doc="nodes along an edge of the grid, and voxels of the volume")
    fits: int = amount(5, 1, doc="fits alone, and as many with a viewer")
    iterations: int = amount(24, 2, doc="iterations of a fit")


def write_subject(path: Path, size: ViewerSize) -> Path:
    """A file of the kind of its suffix: Gaussians (.ply), a radiance field (.npz) or a volume (.nrrd) in a box of edge 1."""
    rng = np.random.default_rng(0)
    if path.suffix == ".ply":
        places = rng.normal(size=(size.gaussians, 3))
        places *= 0.35 * rng.uniform(size=(size.gaussians, 1)) ** (1 / 3) / np.linalg.norm(places, axis=1, keepdims=True)
        shape = np.full((size.gaussians, 3), np.log(0.3 * size.gaussians ** (-1 / 3)))
        rest = rng.normal(size=(size.gaussians, 4)), rng.normal(size=size.gaussians), rng.normal(0, 0.5, (size.gaussians, 4, 3))
        write_gaussians(path, Gaussians(places + 0.5, shape, *rest))
    elif path.suffix == ".npz":
        write_field(path, make_field(size.nodes, 2, 0.2))
    else:
        axis = np.linspace(-1, 1, size.nodes, dtype=np.float32)
        values = np.maximum(0, 1 - np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2))
        write_volume(path, values[..., None], np.eye(4))
    return path


def measure_pictures(name: str, size: ViewerSize) -> dict:
    """Median times of the coarse picture, and its size; ``whole`` is the processor time of a picture of ``edge`` pixels."""
    with TemporaryDirectory() as folder:
        subject = open_subject(write_subject(Path(folder) / name, size))
    sent: list[np.ndarray] = []
    painter = Painter(subject, lambda page, picture, is_full: sent.append(picture), subject.first_look())
    extent = size.edge, size.edge * ASPECT[1] // ASPECT[0]
    cameras = [
        make_camera([0.5 + 1.6 * np.sin(a), 0.5 - 1.6 * np.cos(a), 0.9, 0.5, 0.5, 0.5], (0, 0, 1), 40.0, extent)
        for a in np.linspace(0, 1, size.rounds + 2)
    ]
    painter.warm_up(cameras[0])
    clock, processor = [], []
    for camera in cameras[1:]:
        painter.see("page", camera)
        start = time.perf_counter(), time.process_time()
        painter.step()
        clock.append(time.perf_counter() - start[0])
        processor.append(time.process_time() - start[1])
    height, width = sent[-1].shape[:2]
    whole = []
    for camera in cameras[1:]:
        start = time.process_time()
        subject.draw(camera, painter.look)
        whole.append(time.process_time() - start)
    return {"name": name, "width": width, "height": height, "clock": float(np.median(clock[1:])),
            "processor": float(np.median(processor[1:])), "whole": float(np.median(whole[1:]))}  # fmt: skip


# -- Cost of a viewer ----------------------------------------------------------------------------------------------------------

FIT = "import sys, time; from mivol.cli import main; main(sys.argv[1:]); print(time.process_time())"
"""Program of a fit; its last line is its processor time [s]."""

QUIET = "threads=2", 'event=[{name="evaluate", every=4}]', "reference.spp=64"
"""Changes of the example demo."""


def run_fit(folder: Path, size: ViewerSize) -> dict[str, float]:
    """Run the fit in a process of its own; return the time of its steps, and the processor time of the process [s]."""
    changes = [*QUIET, f"fit.iterations={size.iterations}"]
    flags = [word for change in changes for word in ("--set", change)]
    ended = run_child(FIT, "optimize", str(folder / "demo" / "fit.toml"), "-o", str(folder / "run"), *flags, timeout=600)
    if ended.returncode:
        raise MivolError(f"the fit failed: {ended.stderr}")
    seconds = read_record(folder / "run").results["fit_seconds"]
    return {"clock": float(seconds), "processor": float(ended.stdout.split()[-1])}


def look_at_run(run: Path, edge: int) -> None:
    """Be the viewer of a run from its start to the end: one new camera after another; prints the number of pictures."""
    while not (run / RECORD).exists() or read_record(run).status != "running":
        time.sleep(0.05)
    choose_back_end("llvm_ad_rgb", 0)
    subject, count = open_subject(run, say=lambda line: None), 0
    painter = Painter(subject, lambda page, picture, is_full: None, subject.first_look())
    middle, extent = subject.box.mean(axis=0), float(np.ptp(subject.box, axis=0).max())
    while read_record(run).status == "running":
        turn = 0.1 * count
        origin = middle + 1.6 * extent * np.array([np.cos(turn), np.sin(turn), 0.4])
        if subject.refresh():
            painter.change()
        painter.see("page", make_camera([*origin, *middle], (0, 0, 1), 40.0, (edge, edge * ASPECT[1] // ASPECT[0])))
        painter.step()
        count += 1
    print(count)


def measure_cost(size: ViewerSize) -> dict:
    """How much slower is a fit while a viewer asks for one picture after another?"""
    rows: dict[str, list[dict[str, float]]] = {"alone": [], "with a viewer": []}
    pictures = 0
    with TemporaryDirectory() as name:
        folder = Path(name)
        copy_example("demo", folder / "demo")
        run_fit(folder, size)  # renders the references, compiles kernels
        for _ in range(size.fits):
            rows["alone"].append(run_fit(folder, size))
            viewer = follow_program(Path(__file__), str(folder / "run"), str(size.edge), errors=folder / "viewer.txt")
            next(viewer)
            rows["with a viewer"].append(run_fit(folder, size))
            pictures += int(next(viewer))
    ratio = {
        kind: float(np.median([row[kind] for row in rows["with a viewer"]]) / np.median([row[kind] for row in rows["alone"]]))
        for kind in ("clock", "processor")
    }
    return {**ratio, "rows": rows, "pictures": pictures}


def table(question: str, answer: dict) -> list[str]:
    """A line of Markdown."""
    if question == "cost":
        return [
            f"a fit with a viewer takes {answer['clock']:.3f} of the time of one alone, {answer['processor']:.3f} of its "
            f"processor time; {answer['pictures']} pictures in {len(answer['rows']['alone'])} fits"
        ]
    times = f"{1000 * answer['clock']:.0f} ms of the clock, {1000 * answer['processor']:.0f} ms of the processor"
    whole = f"{1000 * answer['whole']:.0f} ms of the processor for the longest edge asked for"
    return [f"{answer['name']}: {answer['width']} x {answer['height']} pixels in {times}; {whole}"]


def _question(name: str) -> Callable[[ViewerSize], dict]:
    return ask(f"How long does a page wait for the first picture of {name}?", partial(measure_pictures, name))


STUDY = Study(
    __name__,
    __doc__,
    ViewerSize,
    {"gaussians": _question("balls.ply"), "grid": _question("field.npz"), "volume": _question("volume.nrrd"),
     "cost": measure_cost},
    table=table,
    promises={"cost": [Promise("time of a fit with a viewer, over one alone", ("clock",), AT_MOST, 1.05)]},
)  # fmt: skip

if __name__ == "__main__":
    print("looking", flush=True)
    look_at_run(Path(sys.argv[1]), int(sys.argv[2]))
