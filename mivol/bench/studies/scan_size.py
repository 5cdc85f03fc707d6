"""How long does a slice of a large scan take, from TIFF to TIFF, beside algotom and astra-toolbox on the processor?

    mivol bench scan_size [--n 512] [--views 512] [--slices 32]

Exact views of the Shepp-Logan head are written as TIFF, one file a view, with as many rows as slices. Each contestant reads
them, reconstructs all slices by filtered back-projection (ramp without a window), and writes a TIFF file a slice. mivol takes
slabs within 2 GiB. algotom (``fbp_reconstruction`` on the processor, compiled by numba) and astra-toolbox (FBP, ``linear``) are
left out where they are not installed. Times are processor times of the whole path, the shorter of two runs; the first may
compile.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from mivol import config
from mivol.bench.harness.bars import say_row
from mivol.bench.harness.study import Size, Study, amount
from mivol.experiments.slab_scan import plan_slabs, reconstruct_slab
from mivol.files.image_stack import read_images
from mivol.files.tiff import TiffSlices
from mivol.machine import peak_memory
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.validate.metrics import nrmse

MEMORY = 2.0
"""Memory of mivol's slabs [GiB]."""

Contestant = Callable[[Path, Path], None]
"""Reconstructs the views of a folder into slices of another."""


@dataclass(frozen=True)
class ScanSize(Size):
    """Options."""

    n: int = amount(512, quick=64, doc="columns of the detector, and voxels along x and y")
    views: int = amount(512, quick=64, doc="views over half a turn")
    slices: int = amount(32, quick=4, doc="rows of the detector, and slices")


def write_views(folder: Path, size: ScanSize) -> ParallelBeam:
    """Write the views, a file each."""
    from tifffile import imwrite

    beam = ParallelBeam(np.pi * np.arange(size.views) / size.views, (size.slices, size.n), 2 / size.n)
    for view in range(size.views):
        image = shepp_logan().integrate_lines(*beam.rays([view]), whole_lines=True)[0]
        imwrite(folder / f"view_{view:05d}.tif", image.astype(np.float32), photometric="minisblack")
    return beam


def measure_slices(size: ScanSize) -> dict[str, dict[str, float]]:
    """How long does a slice take, from TIFF to TIFF, and how far is mivol's from the truth?"""
    answer = {}
    with TemporaryDirectory() as folder:
        views = Path(folder) / "views"
        views.mkdir()
        beam = write_views(views, size)
        grid = VoxelGrid((size.slices, size.n, size.n), 2 / size.n)
        truth = shepp_logan().voxelise(grid, 2)
        contestants: dict[str, Contestant] = {"mivol": _mivol(views, size)}
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


def _mivol(views: Path, size: ScanSize) -> Contestant:
    settings = config.from_dict(
        {
            "title": "scan_size",
            "scan": {"beam": "parallel", "pitch": 2 / size.n},
            "data": {
                "source": "stack", "file": str(views / "view_*.tif"), "reading": "line_integral", "find_axis": False, "air": 0
            },
            "slabs": {"memory": MEMORY},
        },
        "scan_size",
    )  # fmt: skip

    def run(_: Path, target: Path) -> None:
        plan = plan_slabs(settings, Path())
        writer = TiffSlices(target, plan.grid.shape)
        for layers in plan.layers:
            writer.write(layers.start, reconstruct_slab(plan, layers))

    return run


def _slice_by_slice(reconstruct: Callable[[np.ndarray], np.ndarray]) -> Contestant:
    def run(views: Path, target: Path) -> None:
        sinograms = read_images(sorted(views.glob("*.tif")))
        writer = TiffSlices(target, (sinograms.shape[1],))
        for row in range(sinograms.shape[1]):
            writer.write(row, reconstruct(np.ascontiguousarray(sinograms[:, row]))[None])

    return run


def _algotom(beam: ParallelBeam) -> Contestant:
    reconstruction = importlib.import_module("algotom.rec.reconstruction")
    centre, options = (beam.detector[1] - 1) / 2, {"apply_log": False, "gpu": False, "ratio": None, "filter_name": None}

    def reconstruct(sinogram: np.ndarray) -> np.ndarray:
        return reconstruction.fbp_reconstruction(sinogram, centre, angles=beam.angles, **options) / beam.pitch[1]

    return _slice_by_slice(reconstruct)


def _astra(beam: ParallelBeam) -> Contestant:
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


PEERS: dict[str, tuple[str, Callable[[ParallelBeam], Contestant]]] = {
    "algotom": ("algotom", _algotom),
    "astra-toolbox": ("astra", _astra),
}
"""Name -> (module, contestant)."""


def table(question: str, answer: dict[str, dict[str, float]]) -> list[str]:
    """Markdown table."""
    ours = answer["mivol"]["seconds_a_slice"]
    rows = ["| fbp | processor time a slice [s] | over mivol |", "|---|---:|---:|"]
    return rows + [
        f"| {name} | {row['seconds_a_slice']:.3f} | {row['seconds_a_slice'] / ours:.2f} |" for name, row in answer.items()
    ]


STUDY = Study(__name__, __doc__, ScanSize, {"slices": measure_slices}, table=table)
