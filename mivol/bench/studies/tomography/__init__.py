"""How near to the truth are CG and ordered subsets after 5, 10 and 20 iterations, and what does an iteration cost?

    mivol bench tomography                         128^3, 100 cone-beam views of 128^2 pixels
    mivol bench tomography --size 256              the size of TIGRE's own tests
    mivol bench tomography --volume tooth.nrrd     with a measured volume as second truth
    mivol bench tomography --only peers            slices beside astra-toolbox and scikit-image
    mivol bench tomography --only tooth            a measured slice beside them (first: mivol fetch tooth_projections)
    mivol bench tomography --only volume256        128 cone-beam views through 256^3, time and memory

solvers: the geometry is TIGRE's test "configuration 1" (cone beam, 100 views on a full circle). The object is the Shepp-Logan
head. Its projections are sums of ellipsoid chords (float64, no grid), so no operator reconstructs data of its own. A measured
volume is projected at twice the resolution of the reconstruction. nRMSE is |x - truth| / |truth|, with the truth averaged over
voxels. TIGRE's tests accept 0.2 after 20 iterations (0.3 for SIRT) of a head projected by the tested operator itself.

peers, tooth: see :mod:`mivol.bench.studies.tomography.peers`.

volume256: one product with A and one with its transpose, of random voxels (none is empty), for cone beams and for parallel
beams. Beside it astra-toolbox on the processor, which has no cones there: its parallel projector (``linear``, Joseph's), layer
by layer, on every sixteenth layer, times sixteen. Times are processor times of all threads, the shortest of three; memory is
the largest memory of the process so far.
"""

from __future__ import annotations

import importlib
import importlib.util
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator

from mivol.bench.harness.contests import Stopwatch, fastest
from mivol.bench.harness.figures import new_figure, use_plain_ticks
from mivol.bench.harness.study import Size, Study, amount, say, say_row
from mivol.bench.studies.tomography.peers import error_rows, measure_peers, measure_tooth, ratio_rows
from mivol.files import read_volume
from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares, SmoothedTV
from mivol.tomography.geometry import ConeBeam, Geometry, ParallelBeam, VoxelGrid, tigre_cone_beam
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector
from mivol.validate.metrics import nrmse

REPORTED = (5, 10, 20)
ACCEPTED = 0.2
"""nRMSE that TIGRE's own tests accept after 20 iterations."""

LAYER_STEP = 16
"""astra-toolbox projects every such layer."""


@dataclass(frozen=True)
class TomographySize(Size):
    """Amount of work."""

    size: int = amount(128, 32, "voxels along an edge, and pixels along an edge of the detector")
    views: int = amount(100, 24, "number of views")
    iterations: int = amount(20, 5, "iterations of each solver")
    phantom: str = amount("yu-ye-wang", doc="table of Shepp and Logan's head")
    volume: str = amount("", doc="volume file to use as second truth")


# -- Solvers ----------------------------------------------------------------------------------------------------------------


class Scan(NamedTuple):
    """Projections of a known object.

    Attributes:
        name: name of the object.
        a: projector of the reconstructed grid.
        y: projections, a.shape[0] values.
        truth: averages over the voxels of the grid (Z, Y, X).
    """

    name: str
    a: Projector
    y: np.ndarray
    truth: np.ndarray


def make_head_scan(phantom: str, size: int, n_views: int) -> Scan:
    """Scan of Shepp and Logan's head, with projections in closed form."""
    beam, grid = tigre_cone_beam(size, n_views)
    head = shepp_logan(phantom, 128.0)
    return Scan(f"Shepp-Logan ({phantom})", Projector(beam, grid), head.project(beam), head.voxelise(grid, 4))


def make_volume_scan(path: Path, n_views: int) -> Scan:
    """Simulated cone-beam scan of a measured volume, in the unit of length of the file, projected at twice the resolution."""
    data = read_volume(path)
    fine = data.values[..., 0] / data.values.max()
    fine = fine[tuple(slice(0, n // 2 * 2) for n in fine.shape)]
    truth = fine.reshape([m for n in fine.shape for m in (n // 2, 2)]).mean((1, 3, 5))
    spacing = tuple(map(float, data.spacing))
    grid = VoxelGrid(truth.shape, tuple(2 * s for s in spacing))
    reach, pitch = 2 * grid.radius, 2 * min(spacing) * 1.5
    rows = int(np.ceil(1.5 * 1.2 * grid.extent[2] / pitch))
    columns = int(np.ceil(1.5 * 1.2 * np.hypot(*grid.extent[:2]) / pitch))
    beam = ConeBeam(np.arange(n_views) * 2 * np.pi / n_views, (rows, columns), 2 * reach, 3 * reach, pitch)
    return Scan(path.name, Projector(beam, grid), Projector(beam, VoxelGrid(fine.shape, spacing)) @ fine, truth)


def solver_problems(a: Projector, y: np.ndarray) -> dict[str, tuple[str, LeastSquares, dict]]:
    """Label -> (solver, problem, options). Subsets have 20 views, as in TIGRE's configuration."""
    plain, bounded = LeastSquares(a, y), LeastSquares(a, y, nonnegative=True)
    # In the unit of the geometry (mm): calms the misfit of voxels at edges, and does not blur them (3 to 10 tried).
    prior = SmoothedTV(a.grid.shape, strength=3.0, delta=3e-3, voxel_size=a.grid.voxel_size)
    return {
        "CG": ("cgls", plain, {}),
        "CG, x >= 0": ("pcg", bounded, {}),
        "CG, x >= 0, TV": ("pcg", LeastSquares(a, y, nonnegative=True, prior=prior), {}),
        "OS-SART, x >= 0": ("os-sart", bounded, {"n_subsets": max(1, a.n_views // 20)}),
        "SIRT, x >= 0": ("sirt", bounded, {}),
    }


def reconstruct(scan: Scan, iterations: int) -> dict:
    """Curves of error and time of each solver, and their last volumes; errors are not timed.

    Returns:
        ``object``, ``nrmse`` (a table), ``curves``; for the figure ``truth`` and ``volumes``.
    """
    curves, volumes = {}, {}
    for label, (solver, problem, options) in solver_problems(scan.a, scan.y).items():
        errors, seconds, watch = [], [], Stopwatch()
        states = iter(SOLVERS[solver].run(problem, **options))
        for _ in range(iterations):
            with watch:
                state = next(states, None)
            if state is None:
                break
            errors.append(nrmse(state.x, scan.truth.reshape(-1)))
            seconds.append(watch.seconds)
            volumes[label] = state.x.reshape(scan.truth.shape)
        curves[label] = {"nrmse": errors, "seconds": seconds}
        say_row(f"{scan.name}, {label}", nRMSE=errors[-1], seconds=seconds[-1])
    return {"object": scan.name, "nrmse": tabulate(curves), "curves": curves, "truth": scan.truth, "volumes": volumes}


def tabulate(curves: dict) -> dict:
    """nRMSE after the reported iterations, and seconds per iteration."""
    return {
        label: {str(n): round(c["nrmse"][n - 1], 4) for n in REPORTED if n <= len(c["nrmse"])}
        | {"seconds_per_iteration": round(c["seconds"][-1] / len(c["seconds"]), 3)}
        for label, c in curves.items()
    }


def measure_costs(scan: Scan) -> dict:
    """Seconds of warm A and A^T, the mismatch of the pair, and the distance of A truth from the true projections."""
    a, rng = scan.a, np.random.default_rng(0)
    x, y = (rng.normal(size=n).astype(np.float32) for n in a.shape[::-1])
    forward, back = (fastest(lambda operand=operand, v=v: operand @ v, time.perf_counter) for operand, v in ((a, x), (a.T, y)))
    return {
        "seconds_A": forward,
        "seconds_AT": back,
        "rays_per_second_A": a.shape[0] / forward,
        "AT_over_A": back / forward,
        "adjoint_mismatch": adjoint_mismatch(a, x, y),
        "voxels_own_error": float(np.linalg.norm((a @ scan.truth) - scan.y) / np.linalg.norm(scan.y)),
    }


def adjoint_mismatch(a: Projector, x: np.ndarray, y: np.ndarray) -> float:
    """|<Ax, y> - <x, A^T y>| over |Ax| |y|: only rounding, if A^T is the transpose of A."""
    ax, aty = (a @ x).astype(float), (a.T @ y).astype(float)
    return float(abs(ax @ y - x @ aty) / (np.linalg.norm(ax) * np.linalg.norm(y)))


def measure_solvers(size: TomographySize) -> dict:
    """What is the nRMSE after 5, 10 and 20 iterations, with projections by ellipsoid chords?"""
    head = make_head_scan(size.phantom, size.size, size.views)
    answer = {
        "grid": [size.size] * 3,
        "projections": [size.views, size.size, size.size],
        "published_bar": {"TIGRE tests, 20 iterations": ACCEPTED},
        **measure_costs(head),
        **reconstruct(head, size.iterations),
    }
    if size.volume:
        volume = make_volume_scan(Path(size.volume), size.views)
        answer["volume"] = {"grid": list(volume.truth.shape), **reconstruct(volume, size.iterations)}
    return answer


# -- One large volume -------------------------------------------------------------------------------------------------------


def measure_volume(size: TomographySize, n: int = 256, views: int = 128) -> dict:
    """How long do the projections of a volume of 256^3 and their transpose take, and how much memory?

    Args:
        size: unused; the size of this question is fixed.
        n: voxels along an edge, and pixels along an edge of the detector.
        views: number of views; cones on a full circle, parallel beams on half a circle.
    """
    grid, angles = VoxelGrid((n, n, n)), (np.arange(views) + 0.5) * 2 * np.pi / views
    beams = {
        "cone": ConeBeam(angles, (n, n), 1000 * n / 256, 1536 * n / 256, 1.6),
        "parallel": ParallelBeam(angles / 2, (n, n)),
    }
    x = np.random.default_rng(0).random(grid.shape, dtype=np.float32)
    answer = {name: time_beam(name, beam, grid, x) for name, beam in beams.items()}
    if importlib.util.find_spec("astra") is None:
        say("astra-toolbox is not installed: left out")
        return answer
    name = "parallel, astra-toolbox"
    return answer | {name: volume_figures(name, views * n * n, *time_astra(angles / 2, x))}


def shortest_time(call: Callable[[], object]) -> float:
    """Processor time of the shortest of three calls [s], after a first call that may compile."""
    call()
    return fastest(call, time.process_time)


def time_beam(name: str, beam: Geometry, grid: VoxelGrid, x: np.ndarray) -> dict[str, float]:
    """Times of mivol's projector."""
    a = Projector(beam, grid)
    y = a @ x
    return volume_figures(name, a.shape[0], shortest_time(lambda: a @ x), shortest_time(lambda: a.T @ y))


def volume_figures(name: str, rays: int, forward: float, back: float) -> dict[str, float]:
    """Times of both products [s], rays per second and core, and memory of the process [GiB]."""
    import resource  # not on Windows

    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    figures = {"seconds_A": forward, "seconds_AT": back, "rays_per_core_second_A": rays / forward, "peak_gib": memory}
    say_row(name, **figures)
    return figures


def time_astra(angles: np.ndarray, x: np.ndarray) -> tuple[float, float]:
    """Times of both products by astra-toolbox, for all layers [s]."""
    astra = importlib.import_module("astra")  # optional: used only if it is installed

    n = x.shape[1]
    volume, beam = astra.create_vol_geom(n, n), astra.create_proj_geom("parallel", 1.0, n, angles)
    projector = astra.create_projector("linear", beam, volume)

    def run(name: str, image_key: str) -> Callable[[], None]:
        def all_layers() -> None:
            for layer in x[::LAYER_STEP]:
                image, sinogram = astra.data2d.create("-vol", volume, layer), astra.data2d.create("-sino", beam, 1.0)
                settings = astra.astra_dict(name)
                settings |= {"ProjectorId": projector, image_key: image, "ProjectionDataId": sinogram}
                astra.algorithm.run(astra.algorithm.create(settings))

        return all_layers

    scale = len(x) / len(x[::LAYER_STEP])
    return scale * shortest_time(run("FP", "VolumeDataId")), scale * shortest_time(run("BP", "ReconstructionDataId"))


# -- Tables and figure ------------------------------------------------------------------------------------------------------


def table(question: str, answer: dict) -> list[str]:
    """Markdown tables of the slices."""
    if question in ("peers", "tooth"):
        return [*error_rows(answer), "", *ratio_rows(answer)]
    return []


def draw(answers: dict, path: Path) -> None:
    """Draw the head, and the volume in a figure of its own, ``volume.png``."""
    if (solvers := answers.get("solvers")) is not None:
        draw_scan(solvers, path)
        if "volume" in solvers:
            draw_scan(solvers["volume"], path.with_name("volume.png"))


def draw_scan(answer: dict, path: Path) -> None:
    """Plot error against iterations and time, and show a slice of the truth and of each volume."""
    truth, volumes = answer["truth"], answer["volumes"]
    with new_figure(path, 18, 8) as figure:
        axes = figure.subplots(2, max(3, len(volumes)))
        for label, curve in answer["curves"].items():
            axes[0, 0].plot(range(1, len(curve["nrmse"]) + 1), curve["nrmse"], "o-", ms=3, label=label)
            axes[0, 1].plot(curve["seconds"], curve["nrmse"], "o-", ms=3, label=label)
        for ax, label in zip(axes[0], ("iteration", "time [s]"), strict=False):
            ax.axhline(ACCEPTED, color="gray", ls=":", label="accepted in TIGRE's tests")
            ax.set(xlabel=label, ylabel="nRMSE [1]", yscale="log")
            use_plain_ticks(ax.yaxis)
            ax.xaxis.set_major_locator(MaxNLocator(6, integer=label == "iteration"))
        axes[0, 0].legend()
        k, top = truth.shape[0] * 3 // 8, float(np.percentile(truth, 99.9)) * 0.6
        flat = [*axes[0, 2:], *axes[1]]
        slices = list(({"truth": truth} | volumes).items())[: len(flat)]
        for ax, (label, volume) in itertools.zip_longest(flat, slices, fillvalue=("", None)):
            ax.axis("off")
            if volume is not None:
                ax.imshow(volume[k], cmap="gray", vmin=0, vmax=top, origin="lower")
                ax.set_title(label)
        title = f"{answer['object']}, {' x '.join(map(str, truth.shape))}; slices: black is 0, white {top:.3g} [1/length]"
        figure.suptitle(title, x=0.01, ha="left", weight="bold")


QUESTIONS = {"solvers": measure_solvers, "peers": measure_peers, "tooth": measure_tooth, "volume256": measure_volume}
STUDY = Study(__name__, __doc__, TomographySize, QUESTIONS, draw=draw, table=table, on_request=("peers", "tooth", "volume256"))
