"""Solvers of slices beside astra-toolbox and scikit-image: error against processor time, in one run on one machine.

    scripts/bench_tomography.py --beside     needs nothing else; astra-toolbox takes part where it is installed

The object is a slice of the Shepp-Logan head, its projections are exact chords (float64, no grid), with the noise of quanta
where the kind of data has it: no operator sees data that it made itself. All get the same projections of a parallel beam, whose
grid and detector have odd numbers of cells, so that every program has the axis in the middle of one. Times are of the processor
(user and system, all threads), ours with the storing of matrices and what is done before the first iteration, after a run that
compiles; all is run three times, and medians are shown. nRMSE is |x - truth| / |truth| over the disc in the grid, outside of
which scikit-image finds nothing.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mivol import config
from mivol.bench.harness.bars import say
from mivol.experiments.projections import Projections
from mivol.experiments.scan_fit import start_volume
from mivol.experiments.solver_choice import choose_storage, make_prior, settle_noise, settle_solver
from mivol.optim.projections.inversion import ProjectionProblem
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts
from mivol.optim.projections.solvers import ALL_SOLVERS
from mivol.tomography.filtered import filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid, subdivide, voxel_means
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector
from mivol.tomography.stored import store
from mivol.validate.metrics import nrmse

KINDS = {"few views": (30, 0.0), "noisy": (90, 1e4), "many": (360, 1e4)}
"""Kind of data: views, and quanta a pixel (0: no noise)."""

STEPS = {"cgls": 20, "pcg": 20, "pcg from fbp": 10, "sirt": 60, "sart": 6, "os-sart": 12}
"""Iterations of ours; those of others are as many."""

REPEATS = 3
"""Runs of which times are medians."""

PAIRS = (
    ("mivol cgls", "astra CGLS"),
    ("mivol sirt", "astra SIRT"),
    ("mivol sart", "astra SART"),
    ("mivol fbp", "astra FBP"),
    ("mivol fbp", "scikit-image iradon"),
    ("mivol sart", "scikit-image iradon_sart"),
    ("mivol default", "astra SART"),
)
"""Who is compared with whom at equal error."""


@dataclass(frozen=True)
class Slice:
    """One slice and its projections.

    Attributes:
        beam, grid: lengths in voxels.
        y, weights: (views, 1, columns); weights are inverse variances where there is noise, else 1.
        truth: (1, n, n), averages over voxels; None where it is not known.
        photons: quanta a pixel without an object; 0: no noise.
    """

    beam: ParallelBeam
    grid: VoxelGrid
    y: np.ndarray
    weights: np.ndarray
    truth: np.ndarray | None
    photons: float = 0.0

    def error(self, x: np.ndarray) -> float:
        """nRMSE over the disc inside the grid."""
        at = self.grid.axis("x")
        inside = np.hypot(at[:, None], at) < at[-1]
        return nrmse(np.reshape(x, self.truth.shape)[0][inside], self.truth[0][inside])


class Curve(NamedTuple):
    """Errors after each step, and the processor's seconds up to it."""

    errors: list[float]
    seconds: list[float]


def make_slice(n: int, views: int, photons: float) -> Slice:
    """The head across ``n`` voxels (odd), seen by 3/2 as many pixels."""
    columns = 3 * n // 2 // 2 * 2 + 1
    grid = VoxelGrid((1, n, n))
    beam = ParallelBeam(np.arange(views) * np.pi / views, (1, columns))
    head = shepp_logan("toft-schabel", n / 2)
    scale = 4.0 / n  # so that 1 across the grid has an optical depth of 4
    exact = scale * head.project(beam)
    truth = scale * head.voxelise(VoxelGrid((1, n, n), (1.0, 1.0, 1e-6)), 4)
    if not photons:
        return Slice(beam, grid, exact, np.ones_like(exact), truth)
    counts = np.maximum(np.random.default_rng(0).poisson(photons * np.exp(-exact)), 1.0)
    return Slice(beam, grid, -np.log(counts / photons), counts, truth, photons)


def timed(scan: Slice, states: Iterator[np.ndarray], steps: int) -> Curve:
    """Take steps; judging is not timed. What a generator does before its first step is."""
    errors, seconds, spent = [], [], 0.0
    for _ in range(steps):
        start = time.process_time()
        x = next(states, None)
        spent += time.process_time() - start
        if x is None:
            break
        errors.append(scan.error(x))
        seconds.append(spent)
    return Curve(errors, seconds)


def ours(scan: Slice) -> dict[str, Curve]:
    """Every solver of least squares, and filtered back-projection."""
    walk, found = Projector(scan.beam, scan.grid), {}

    def run(name: str, x0: np.ndarray | None = None) -> Iterator[np.ndarray]:
        wanted = config.SolveSettings(name, iterations=STEPS.get(name, 1))
        a = store(walk) if choose_storage(wanted, walk).is_stored else walk
        problem = LeastSquares(a, scan.y, scan.weights, x0, nonnegative=name not in ("cgls", "fbp"))
        yield from (state.x for state in ALL_SOLVERS[name].run(problem))

    filtered = next(run("fbp"))
    found["fbp"] = timed(scan, run("fbp"), 1)
    for name, steps in STEPS.items():
        solver, start = name.removesuffix(" from fbp"), np.maximum(filtered, 0) if name.endswith("fbp") else None
        next(run(solver, start))
        found[name] = timed(scan, run(solver, start), steps)
    return {f"mivol {name}": curve for name, curve in found.items()}


def default(scan: Slice, solve: config.SolveSettings | None = None) -> Iterator[np.ndarray]:
    """What a file leaves open: ``solve.name = "auto"``, by other settings than none where they are given."""
    wanted, _ = settle_solver(solve or config.SolveSettings(), Projector(scan.beam, scan.grid))
    walk = Projector(scan.beam, subdivide(scan.grid, wanted.supersampling, scan.beam))
    data, all_views = Projections(scan.beam, scan.y, scan.weights, is_noise_known=scan.photons > 0), np.arange(len(scan.y))
    start, prior = start_volume(wanted, walk, data, all_views), make_prior(wanted, walk, data, all_views)
    problem = ProjectionProblem(LeastSquares(walk, scan.y, scan.weights, start, wanted.nonnegative, prior))
    choose_storage(wanted, walk).apply(problem)
    settle_noise(problem, wanted, data)
    for state in ALL_SOLVERS[wanted.name].run(problem.linear_problem):
        yield voxel_means(state.x.reshape(walk.grid.shape), scan.grid.shape)


def likelihood(scan: Slice) -> Iterator[np.ndarray]:
    """ML-TR of the counts, from filtered back-projection."""
    a = store(Projector(scan.beam, scan.grid))
    start = np.maximum(filtered_backprojection(a, scan.y), 0)
    yield from (state.x for state in ALL_SOLVERS["ml-tr"].run(PoissonCounts(a, scan.weights, scan.photons, x0=start)))


def ours_of_noise(scan: Slice) -> dict[str, Curve]:
    """The default, and ML-TR where quanta are counted."""
    wanted = {"default": default, **({"ml-tr from fbp": likelihood} if scan.photons else {})}
    for run in wanted.values():
        next(run(scan))
    return {f"mivol {name}": timed(scan, run(scan), STEPS["pcg"]) for name, run in wanted.items()}


def scikit_image(scan: Slice) -> dict[str, Curve]:
    """``iradon``, and ``iradon_sart`` swept as often as ours; rows of its images run against y."""
    from skimage.transform import iradon, iradon_sart

    sinogram, theta, n = scan.y[:, 0].T.copy(), np.degrees(scan.beam.angles), scan.grid.shape[1]
    margin = (len(sinogram) - n) // 2

    def sweeps() -> Iterator[np.ndarray]:
        image = None
        while True:
            image = iradon_sart(sinogram, theta, image=image)
            yield image[::-1][margin : margin + n, margin : margin + n]

    filtered = (iradon(sinogram, theta, output_size=n)[::-1] for _ in range(1))
    return {"scikit-image iradon": timed(scan, filtered, 1), "scikit-image iradon_sart": timed(scan, sweeps(), STEPS["sart"])}


def astra_toolbox(scan: Slice) -> dict[str, Curve]:
    """FBP, CGLS, SIRT and SART of astra-toolbox on the processor; SART's iterations are views, and are counted in sweeps."""
    astra = importlib.import_module("astra")  # no dependency: only where it is installed

    n, (views, _, columns) = scan.grid.shape[1], scan.beam.shape
    volume = astra.create_vol_geom(n, n)
    projector = astra.create_projector("linear", astra.create_proj_geom("parallel", 1.0, columns, scan.beam.angles), volume)
    sinogram = astra.data2d.create("-sino", astra.create_proj_geom("parallel", 1.0, columns, scan.beam.angles), scan.y[:, 0])

    def run(name: str, each: int) -> Iterator[np.ndarray]:
        target = astra.data2d.create("-vol", volume, 0.0)
        settings = astra.astra_dict(name)
        settings |= {"ProjectorId": projector, "ProjectionDataId": sinogram, "ReconstructionDataId": target}
        if name in ("SIRT", "SART"):
            settings["option"] = {"MinConstraint": 0.0}
        algorithm = astra.algorithm.create(settings)
        while True:
            astra.algorithm.run(algorithm, each)
            yield astra.data2d.get(target)[::-1]

    wanted = {"FBP": (1, 1), "CGLS": (1, STEPS["cgls"]), "SIRT": (1, STEPS["sirt"]), "SART": (views, STEPS["sart"])}
    return {f"astra {name}": timed(scan, run(name, each), steps) for name, (each, steps) in wanted.items()}


PEERS: dict[str, tuple[str, Callable[[Slice], dict[str, Curve]]]] = {
    "astra-toolbox": ("astra", astra_toolbox),
    "scikit-image": ("skimage", scikit_image),
}
"""Package, its module, and what runs it."""


def compare(scans: dict[str, Slice]) -> dict[str, dict[str, Curve]]:
    """Curves by kind of data and method, times as medians; who is missing is said."""
    runs = [package for package, (module, _) in PEERS.items() if importlib.util.find_spec(module) is not None]
    for package in PEERS.keys() - set(runs):
        say(f"{package} is not installed: left out")
    return {kind: median([everyone(scan, runs) for _ in range(REPEATS)]) for kind, scan in scans.items()}


def slices_of_the_head(n: int = 129) -> dict[str, Slice]:
    """By kind of data."""
    return {kind: make_slice(n, views, photons) for kind, (views, photons) in KINDS.items()}


def everyone(scan: Slice, packages: list[str]) -> dict[str, Curve]:
    """Ours and those of packages, once."""
    found = ours(scan) | ours_of_noise(scan)
    for package in packages:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of others' code
            found |= PEERS[package][1](scan)
    return found


def median(runs: list[dict[str, Curve]]) -> dict[str, Curve]:
    """Errors of the first run, and the medians of times; runs are as long as each other, since errors repeat."""
    return {
        name: Curve(curve.errors, np.median([run[name].seconds for run in runs], 0).tolist()) for name, curve in runs[0].items()
    }


def time_to(curve: Curve, error: float) -> float:
    """Seconds until an error is reached."""
    return curve.seconds[int(np.flatnonzero(np.asarray(curve.errors) <= error)[0])]


def ratios(found: dict[str, dict[str, Curve]]) -> list[str]:
    """A table in Markdown: our time over theirs, both at the larger of the two least errors, which both reach."""
    kinds = list(found)
    lines = ["| time at equal error | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for ours, theirs in PAIRS:
        if any(theirs not in found[kind] for kind in kinds):
            continue
        cells = []
        for kind in kinds:
            a, b = found[kind][ours], found[kind][theirs]
            error = max(min(a.errors), min(b.errors))
            cells.append(f"{time_to(a, error) / time_to(b, error):.2f} ({error:.4f})")
        lines.append(f"| {ours} / {theirs} | " + " | ".join(cells) + " |")
    return lines


def rows(found: dict[str, dict[str, Curve]]) -> list[str]:
    """A table in Markdown: the least error of each method and kind, after so many steps and seconds."""
    kinds = list(found)
    lines = ["| method | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for method in dict.fromkeys(name for kind in kinds for name in found[kind]):
        cells = []
        for kind in kinds:
            curve = found[kind].get(method)
            if curve is None:
                cells.append("")
                continue
            best = int(np.argmin(curve.errors))
            cells.append(f"{curve.errors[best]:.4f} ({best + 1}, {curve.seconds[best]:.2f} s)")
        lines.append(f"| {method} | " + " | ".join(cells) + " |")
    return lines
