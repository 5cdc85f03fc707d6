"""How long does a page of the live view wait for its first picture?

    mivol bench viewer [--edge 400] [--rounds 9]

A request is a camera that a page has not asked for before. The coarse picture answers it; the full picture follows when the
camera rests. Subjects are made on the spot: random Gaussians in a ball, a grid with harmonics of degree 2 around the surface of
a ball, and a volume of values. Kernels are warm, as after the start of ``mivol view``. Times are medians over rounds, in
processor time of all threads and in time of the clock; on two idle cores the first is about twice the second.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mivol.bench.harness.study import Size, Study, amount, ask
from mivol.bench.studies.storage import make_field
from mivol.experiments.render import make_camera
from mivol.fields.field_files import write_field
from mivol.files import write_volume
from mivol.points import Gaussians, write_gaussians
from mivol.view.painter import Painter
from mivol.view.runs import open_subject

ASPECT = 4, 3


@dataclass(frozen=True)
class ViewerSize(Size):
    """Options."""

    edge: int = amount(400, 64, doc="longest edge of the picture [pixel]")
    rounds: int = amount(9, 1, doc="cameras asked for")
    gaussians: int = amount(50_000, 500, doc="number of Gaussians")
    nodes: int = amount(96, 16, doc="nodes along an edge of the grid, and voxels of the volume")


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
    """Median times of the coarse picture, and its size."""
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
    return {"name": name, "width": width, "height": height, "clock": float(np.median(clock[1:])),
            "processor": float(np.median(processor[1:]))}  # fmt: skip


def table(question: str, answer: dict) -> list[str]:
    """A line of Markdown."""
    times = f"{1000 * answer['clock']:.0f} ms of the clock, {1000 * answer['processor']:.0f} ms of the processor"
    return [f"{answer['name']}: {answer['width']} x {answer['height']} pixels in {times}"]


def _question(name: str) -> Callable[[ViewerSize], dict]:
    return ask(f"How long does a page wait for the first picture of {name}?", partial(measure_pictures, name))


STUDY = Study(
    __name__,
    __doc__,
    ViewerSize,
    {"gaussians": _question("balls.ply"), "grid": _question("field.npz"), "volume": _question("volume.nrrd")},
    table=table,
)
