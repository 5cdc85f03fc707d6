"""How long do the projections of a volume of 256^3 take, there and back, and how much memory?

    scripts/bench_tomography.py --only volume256     128 cone views of 256^2 through 256^3

The unit of work is one product with A and one with its transpose, of random voxels (none is empty). The same work of parallel
beams follows. Beside it astra-toolbox on the processor, which has no cones there: its parallel projector (``linear``,
Joseph's), layer by layer, on every sixteenth layer, times sixteen. Times are of the processor (user and system, all threads),
the least of three; memory is the most that the process has had up to then.
"""

from __future__ import annotations

import importlib
import importlib.util
import resource
import time
from collections.abc import Callable

import numpy as np

from mivol.bench.harness.bars import say
from mivol.bench.harness.timing import fastest
from mivol.tomography.geometry import ConeBeam, Geometry, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector

__all__ = ["measure_volume"]

EVERY = 16
"""Which layers astra-toolbox projects."""


def least_seconds(call: Callable[[], object]) -> float:
    """Processor seconds of the quickest of three calls after a first one, which may compile."""
    call()
    return fastest(call, time.process_time)


def measure_volume(n: int = 256, views: int = 128) -> dict[str, dict[str, float]]:
    """Processor seconds, rays a second and core, and memory, by beam.

    Args:
        n: voxels along an edge, and pixels along a detector's.
        views: of either beam; cones on a full circle, parallel ones on half of it.
    """
    grid, turns = VoxelGrid((n, n, n)), (np.arange(views) + 0.5) * 2 * np.pi / views
    beams = {
        "cone": ConeBeam(turns, (n, n), 1000 * n / 256, 1536 * n / 256, 1.6),
        "parallel": ParallelBeam(turns / 2, (n, n)),
    }
    x = np.random.default_rng(0).random(grid.shape, dtype=np.float32)
    found = {name: measure_beam(name, beam, grid, x) for name, beam in beams.items()}
    if importlib.util.find_spec("astra") is None:
        say("astra-toolbox is not installed: left out")
        return found
    return found | {"parallel, astra-toolbox": figures("parallel, astra-toolbox", views * n * n, *by_astra(turns / 2, x))}


def measure_beam(name: str, beam: Geometry, grid: VoxelGrid, x: np.ndarray) -> dict[str, float]:
    """Ours."""
    a = Projector(beam, grid)
    y = a @ x
    return figures(name, a.shape[0], least_seconds(lambda: a @ x), least_seconds(lambda: a.T @ y))


def figures(name: str, rays: int, forward: float, back: float) -> dict[str, float]:
    """What is reported, and said."""
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    say(f"{name}: A {forward:.2f} s, its transpose {back:.2f} s, {rays / forward / 1e6:.2f} M rays/s a core, {memory:.2f} GiB")
    return {"seconds_A": forward, "seconds_AT": back, "rays_per_core_second_A": rays / forward, "peak_gib": memory}


def by_astra(angles: np.ndarray, x: np.ndarray) -> tuple[float, float]:
    """Seconds for all layers, there and back."""
    astra = importlib.import_module("astra")  # no dependency: only where it is installed

    n = x.shape[1]
    volume, beam = astra.create_vol_geom(n, n), astra.create_proj_geom("parallel", 1.0, n, angles)
    projector = astra.create_projector("linear", beam, volume)

    def run(name: str, image_is: str) -> Callable[[], None]:
        def all_layers() -> None:
            for layer in x[::EVERY]:
                image, sinogram = astra.data2d.create("-vol", volume, layer), astra.data2d.create("-sino", beam, 1.0)
                settings = astra.astra_dict(name)
                settings |= {"ProjectorId": projector, image_is: image, "ProjectionDataId": sinogram}
                astra.algorithm.run(astra.algorithm.create(settings))

        return all_layers

    forward, back = least_seconds(run("FP", "VolumeDataId")), least_seconds(run("BP", "ReconstructionDataId"))
    return forward * len(x) / len(x[::EVERY]), back * len(x) / len(x[::EVERY])
