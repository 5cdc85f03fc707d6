"""How long does a slice of a large scan take, from TIFF to TIFF, beside algotom and astra-toolbox on the processor?

    mivol bench scan_size [--n 512] [--views 512] [--slices 32]
    mivol bench scan_size --only whole [--edge 1024] [--memory 4] [--solver fbp] [--folder DIR]
    mivol bench scan_size --only default [--default-edge 160]

Exact views of the Shepp-Logan head are written as TIFF, one file a view, with as many rows as slices. Each contestant reads
them, reconstructs all slices by filtered back-projection (ramp without a window), and writes a TIFF file a slice. mivol takes
slabs within 2 GiB. algotom (``fbp_reconstruction`` on the processor, compiled by numba) and astra-toolbox (FBP, ``linear``) are
left out where they are not installed. Times are processor times of the whole path, the shorter of two runs; the first may
compile.

default: ``mivol optimize`` in a process of its own, with the settings that a scan gets: a head with noise in a cone beam,
as transmissions; by default 82 views of 135 x 160 pixels, and as many voxels as the detector sees.

whole: a head of ``edge`` voxels along each edge, from as many views, rows and columns, by slabs in a run folder. The
run is stopped after half of its slabs and resumed. The peak is that of the process; slabs are planned for ``memory``. It needs
eight bytes of disk for each voxel. With ``folder``, views and run stay there, and the same command continues after a stop: its
figures cover all processes, the last of which is not stopped.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mivol import config
from mivol.bench.harness.study import Size, Study, amount, say_row
from mivol.errors import MivolError
from mivol.experiments.fit_kind import NullProgress, RunContext
from mivol.experiments.slab_scan import STATE, plan_slabs, reconstruct_slab, run_slabs
from mivol.files.atomic import write_whole, write_whole_text
from mivol.files.image_stack import read_images
from mivol.files.tiff import TiffSlices
from mivol.machine import peak_memory
from mivol.threads import run_child
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import EllipsoidPhantom, shepp_logan
from mivol.validate.metrics import nrmse

MEMORY = 2.0
"""Memory of mivol's slabs [GiB]."""

Reconstructor = Callable[[Path, Path], None]
"""Reconstructs the views of a folder into slices of another."""


@dataclass(frozen=True)
class ScanSize(Size):
    """Options."""

    n: int = amount(512, quick=64, doc="columns of the detector, and voxels along x and y")
    views: int = amount(512, quick=64, doc="views over half a turn")
    slices: int = amount(32, quick=4, doc="rows of the detector, and slices")
    edge: int = amount(1024, quick=32, doc="voxels along each edge of the whole volume, and views, rows and columns")
    memory: float = amount(4.0, quick=0.343, doc="memory of its slabs [GiB]")
    solver: str = amount("fbp", doc="its solver")
    folder: str = amount("", doc="its folder, which stays; empty: a temporary one")
    default_edge: int = amount(160, quick=16, doc="columns of the detector of a scan with all defaults")


def project_view(phantom: EllipsoidPhantom, beam: ParallelBeam, view: int) -> np.ndarray:
    """Exact line integrals (rows, columns) of a view in parallel light, ten times sooner than ray by ray.

    In the frame of a body's unit sphere, the foot of the ray through pixel (i, j) is ``p + i v + j u``. So its square is the
    sum of a number for each row, one for each column, and ``2 i j u . v``.
    """
    panel = beam.panels([view])
    light = beam.rays([view])[1].reshape(-1, 3)[0]
    rows, columns = (np.arange(n, dtype=float) for n in beam.detector)
    total = np.zeros(beam.detector)
    for to_body, centre, value in zip(phantom.to_body, phantom.centres, phantom.values, strict=True):
        e = to_body @ light
        across = [to_body @ step for step in (panel.corner[0] - centre, panel.along_u[0], panel.along_v[0])]
        p, u, v = (q - (q @ e) / (e @ e) * e for q in across)
        square = (2 * (u @ v)) * np.outer(rows, columns)
        square += (2 * (p @ v) * rows + (v @ v) * rows**2)[:, None] + (p @ p + 2 * (p @ u) * columns + (u @ u) * columns**2)
        total += 2 * value * np.sqrt(np.maximum(1 - square, 0, out=square) / (e @ e))
    return total


def write_views(folder: Path, n: int, views: int, slices: int) -> ParallelBeam:
    """Write the views, a file each, unless they are there."""
    from tifffile import imwrite

    beam = ParallelBeam(np.pi * np.arange(views) / views, (slices, n), 2 / n)
    for view in range(views):
        name = folder / f"view_{view:05d}.tif"
        if not name.exists():
            image = project_view(shepp_logan(), beam, view).astype(np.float32)
            write_whole(name, lambda file, image=image: imwrite(file, image, photometric="minisblack"))
    return beam


def measure_slices(size: ScanSize) -> dict[str, dict[str, float]]:
    """How long does a slice take, from TIFF to TIFF, and how far is mivol's from the truth?"""
    answer = {}
    with TemporaryDirectory() as folder:
        views = Path(folder) / "views"
        views.mkdir()
        beam = write_views(views, size.n, size.views, size.slices)
        grid = VoxelGrid((size.slices, size.n, size.n), 2 / size.n)
        truth = shepp_logan().voxelise(grid, 2)
        contestants: dict[str, Reconstructor] = {"mivol": _mivol(slab_settings(views, size.n, MEMORY))}
        contestants |= {name: make(beam) for name, (module, make) in PEERS.items() if importlib.util.find_spec(module)}
        for name, run in contestants.items():
            target = Path(folder) / name.replace(" ", "_")
            seconds = []
            for _ in range(2):
                start = time.process_time()
                run(views, target)
                seconds.append(time.process_time() - start)
            volume = read_images(sorted(target.glob("*.tif")))
            memory = peak_memory()
            figures = {"seconds_a_slice": min(seconds) / size.slices}
            # Peers place their pixels in other ways: only their times are compared.
            figures |= {"nrmse": nrmse(volume, truth)} if name == "mivol" else {}
            answer[name] = figures | ({} if memory is None else {"peak_gib": memory / 2**30})
            say_row(name, **answer[name])
    return answer


def slab_settings(views: Path, n: int, memory: float, **solve: Any) -> config.ScanExperiment:
    """Settings of a scan of ``n`` columns whose views are written, by slabs within ``memory`` [GiB]."""
    return config.from_dict(
        {
            "title": "scan_size",
            "scan": {"beam": "parallel", "pitch": 2 / n},
            "data": {
                "source": "stack", "file": str(views / "view_*.tif"), "reading": "line_integral", "find_axis": False, "air": 0
            },
            "slabs": {"memory": memory},
            "solve": solve,
        },
        "scan_size",
    )  # fmt: skip


def _mivol(settings: config.ScanExperiment) -> Reconstructor:
    def run(_: Path, target: Path) -> None:
        plan = plan_slabs(settings, Path())
        writer = TiffSlices(target, plan.grid.shape)
        for layers in plan.layers:
            writer.write(layers.start, reconstruct_slab(plan, layers))

    return run


# -- All defaults ----------------------------------------------------------------------------------------------------------


def measure_default(size: ScanSize) -> dict[str, float]:
    """What do the defaults take: time, memory and the size of the run folder?"""
    n, rows, views = size.default_edge, max(8, size.default_edge * 135 // 160), max(12, size.default_edge * 82 // 160)
    beam = ConeBeam(2 * np.pi * np.arange(views) / views, (rows, n), 6.0, 8.0, 2.66 / n)
    y = shepp_logan().integrate_lines(*beam.rays(), whole_lines=True)
    counts = np.maximum(np.random.default_rng(0).poisson(1e4 * np.exp(-y)), 1)
    with TemporaryDirectory() as folder:
        np.save(Path(folder) / "views.npy", (counts / 1e4).astype(np.float32))
        lines = [
            'title = "default"', "held_out_every = 20", "[scan]", 'beam = "cone"', "arc = 360", f"pitch = {2.66 / n}",
            "source_to_axis = 6", "source_to_detector = 8", "[data]", 'source = "stack"', 'file = "views.npy"',
            'reading = "transmission"',
        ]  # fmt: skip
        (Path(folder) / "fit.toml").write_text("\n".join(lines))
        run = Path(folder) / "run"
        command = "import sys; from mivol.cli import main; sys.exit(main(sys.argv[1:]))"
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        done = run_child(command, "optimize", str(Path(folder) / "fit.toml"), "--out", str(run), timeout=3600.0)
        if done.returncode:
            raise MivolError(f"found the exit code {done.returncode} of mivol optimize, expected 0: {done.stderr[-200:]}")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        answer = {
            "seconds": time.perf_counter() - start,
            "processor_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
            "peak_gib": after.ru_maxrss / 2**20,
            "folder_mb": sum(file.stat().st_size for file in run.rglob("*") if file.is_file()) / 1e6,
        }
    say_row("default", **answer)
    return answer


# -- A whole volume --------------------------------------------------------------------------------------------------------

JUDGED = 8
"""Slices that are compared with the truth."""


class _Watched(NullProgress):
    """Keeps time and peak memory after each slab in a file, and stops a run after some slabs, as Ctrl-C does."""

    def __init__(self, file: Path, stop_after: int | None = None) -> None:
        self._file, self._stop_after = file, stop_after
        self._before = json.loads(file.read_text()) if file.exists() else {"seconds": 0.0, "peak": 0.0}
        self._start, self._total = time.process_time(), 0

    def keep(self) -> dict[str, float]:
        """Write the figures of all processes so far, and return them."""
        found = {
            "seconds": self._before["seconds"] + time.process_time() - self._start,
            "peak": max(self._before["peak"], peak_memory() or 0.0),
        }
        write_whole_text(self._file, json.dumps(found))
        return found

    def track(self, items: Sequence[Any], label: str) -> Iterator[Any]:
        for count, item in enumerate(items):
            if count == self._stop_after:
                raise KeyboardInterrupt
            yield item
            found = self.keep()
            say_row(f"slab {count + 1} of {len(items)}", seconds=found["seconds"], peak_gib=found["peak"] / 2**30)


def measure_whole(size: ScanSize) -> dict[str, float]:
    """How much memory and time does a large volume take by slabs, stopped and resumed?"""
    with nullcontext(size.folder) if size.folder else TemporaryDirectory() as folder:
        return _measure_whole(size, Path(folder))


def _measure_whole(size: ScanSize, folder: Path) -> dict[str, float]:
    n = size.edge
    views, run, figures = folder / "views", folder / "run", folder / "figures.json"
    views.mkdir(parents=True, exist_ok=True)
    write_views(views, n, n, n)
    settings = slab_settings(views, n, size.memory, name=size.solver)
    is_resumed = (run / STATE).exists()
    count = len(plan_slabs(settings, Path()).layers)
    if not is_resumed and not size.folder:
        try:
            run_slabs(RunContext(settings, Path(), run, progress=_Watched(figures, count // 2)))
        except KeyboardInterrupt:
            is_resumed = True
    done = len(json.loads((run / STATE).read_text())["done"]) if is_resumed else 0
    say_row("begun", slabs=done, of=count)
    watched = _Watched(figures)
    run_slabs(RunContext(settings, Path(), run, progress=watched, resume=is_resumed))
    found = watched.keep()
    answer = {"slabs": float(count), "resumed_after": float(done), "seconds": found["seconds"], "memory": size.memory}
    answer |= {"peak_gib": found["peak"] / 2**30} if found["peak"] else {}
    files, grid = sorted((run / "volumes/slices").glob("*.tif")), VoxelGrid((n, n, n), 2 / n)
    judged = range(n // (2 * JUDGED), n, max(1, n // JUDGED))
    pairs = [(read_images([files[z]])[0], shepp_logan().voxelise(grid.select_layers(slice(z, z + 1)), 2)[0]) for z in judged]
    answer["nrmse"] = nrmse(*(np.stack(part) for part in zip(*pairs, strict=True)))
    say_row("whole", **answer)
    return answer


# -- Peers -----------------------------------------------------------------------------------------------------------------


def _slice_by_slice(reconstruct: Callable[[np.ndarray], np.ndarray]) -> Reconstructor:
    def run(views: Path, target: Path) -> None:
        sinograms = read_images(sorted(views.glob("*.tif")))
        writer = TiffSlices(target, (sinograms.shape[1],))
        for row in range(sinograms.shape[1]):
            writer.write(row, reconstruct(np.ascontiguousarray(sinograms[:, row]))[None])

    return run


def _algotom(beam: ParallelBeam) -> Reconstructor:
    reconstruction = importlib.import_module("algotom.rec.reconstruction")
    centre, options = (beam.detector[1] - 1) / 2, {"apply_log": False, "gpu": False, "ratio": None, "filter_name": None}

    def reconstruct(sinogram: np.ndarray) -> np.ndarray:
        return reconstruction.fbp_reconstruction(sinogram, centre, angles=beam.angles, **options) / beam.pitch[1]

    return _slice_by_slice(reconstruct)


def _astra(beam: ParallelBeam) -> Reconstructor:
    astra = importlib.import_module("astra")
    n = beam.detector[1]
    volume, lines = astra.create_vol_geom(n, n), astra.create_proj_geom("parallel", 1.0, n, beam.angles)
    projector = astra.create_projector("linear", lines, volume)

    def reconstruct(sinogram: np.ndarray) -> np.ndarray:
        numbers = astra.data2d.create("-sino", lines, sinogram), astra.data2d.create("-vol", volume)
        settings = astra.astra_dict("FBP")
        settings |= {"ProjectorId": projector, "ProjectionDataId": numbers[0], "ReconstructionDataId": numbers[1]}
        algorithm = astra.algorithm.create(settings)
        astra.algorithm.run(algorithm)
        found = astra.data2d.get(numbers[1]) / beam.pitch[1]
        astra.algorithm.delete(algorithm)
        astra.data2d.delete(list(numbers))
        return found

    return _slice_by_slice(reconstruct)


PEERS: dict[str, tuple[str, Callable[[ParallelBeam], Reconstructor]]] = {
    "algotom": ("algotom", _algotom),
    "astra-toolbox": ("astra", _astra),
}
"""Name -> (module, contestant)."""


def table(question: str, answer: dict[str, Any]) -> list[str]:
    """Markdown table."""
    if question != "slices":
        return [
            "| " + " | ".join(answer) + " |",
            "|---:" * len(answer) + "|",
            "| " + " | ".join(f"{v:.4g}" for v in answer.values()) + " |",
        ]
    ours = answer["mivol"]["seconds_a_slice"]
    rows = ["| fbp | processor time a slice [s] | over mivol |", "|---|---:|---:|"]
    return rows + [
        f"| {name} | {row['seconds_a_slice']:.3f} | {row['seconds_a_slice'] / ours:.2f} |" for name, row in answer.items()
    ]


QUESTIONS = {"slices": measure_slices, "default": measure_default, "whole": measure_whole}
STUDY = Study(__name__, __doc__, ScanSize, QUESTIONS, table=table, on_request=("default", "whole"))
