"""Solvers of slices beside astra-toolbox and scikit-image: error against processor time.

All programs get the same slices. Times are processor times (user and system, all
threads). mivol's times include storing matrices and all work before the first iteration, after a run that compiles. Each method
runs three times, and medians are reported. astra-toolbox and scikit-image take part if they are installed.

The head. Projections of a parallel beam are exact chords (float64, no grid), with the noise of quanta for some kinds of data,
so no operator reconstructs data of its own. Grid and detector have odd numbers of cells, so every program has the rotation axis
in the middle of a cell. The error is |x - truth| / |truth| over the disc inside the grid; outside, scikit-image reconstructs
nothing.

The tooth. A layer from a synchrotron, with the settings of ``scenes/tooth``, but without the drift of the light, which other
programs do not model. Views are moved along the detector by a fraction of a pixel (cubic interpolation), so that the rotation
axis is in the middle of a column for every program. The truth is unknown: every tenth view is predicted from the slice by exact
chords, and the error is the root mean square difference to this view over the standard deviation of the noise. A perfect
prediction has an error of 1.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import shift

from mivol import config
from mivol.bench.harness.study import say
from mivol.experiments.examples import examples_folder
from mivol.experiments.projections import Projections, fitted_views, held_out_views, make_data, make_voxel_grid
from mivol.experiments.scan_fit import start_volume
from mivol.experiments.solver_choice import choose_matrix_storage, estimate_noise, make_prior, resolve_solver
from mivol.optim.projections.inversion import ALL_SOLVERS, ProjectionProblem
from mivol.optim.projections.linear_problems import LeastSquares, PoissonCounts
from mivol.tomography.filtered import filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid, subdivide_grid, voxel_means
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector
from mivol.tomography.stored import store_matrix
from mivol.validate.metrics import nrmse


@dataclass(frozen=True)
class Slice:
    """A slice and its projections.

    Attributes:
        beam, grid: geometry; lengths in voxels.
        y, weights: projections and their weights (views, 1, columns); weights are inverse variances, or 1 without noise.
        truth: averages over voxels (1, n, n); None if unknown.
        photons: quanta per pixel without an object; 0: no noise.
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


@dataclass(frozen=True)
class MeasuredSlice(Slice):
    """A slice without a known truth.

    Attributes:
        held_out: projector of the predicted views.
        measured, certainty: the predicted views and their inverse variances (views, 1, columns).
    """

    held_out: Projector | None = None
    measured: np.ndarray | None = None
    certainty: np.ndarray | None = None

    def error(self, x: np.ndarray) -> float:
        """Root mean square error of the prediction over the noise."""
        missed = self.held_out @ np.ascontiguousarray(x, np.float32).reshape(self.grid.shape) - self.measured
        return float(np.sqrt(np.sum(self.certainty * missed**2) / np.count_nonzero(self.certainty)))


def make_slice(n: int, views: int, photons: float) -> Slice:
    """Slice of the head with ``n`` x ``n`` voxels (odd) and 3/2 as many detector pixels."""
    columns = 3 * n // 2 // 2 * 2 + 1
    beam = ParallelBeam(np.arange(views) * np.pi / views, (1, columns))
    head = shepp_logan("toft-schabel", n / 2)
    scale = 4.0 / n  # so that the value 1 across the grid has an optical depth of 4
    exact = scale * head.project(beam)
    truth = scale * head.voxelise(VoxelGrid((1, n, n), (1.0, 1.0, 1e-6)), 4)
    grid = VoxelGrid((1, n, n))
    if not photons:
        return Slice(beam, grid, exact, np.ones_like(exact), truth)
    counts = np.maximum(np.random.default_rng(0).poisson(photons * np.exp(-exact)), 1.0)
    return Slice(beam, grid, -np.log(counts / photons), counts, truth, photons)


def centre_axis(values: np.ndarray, column: float, order: int) -> np.ndarray:
    """Move the rotation axis of projections to the middle of an odd number of columns.

    Args:
        values: (views, rows, columns).
        column: column of the axis.
        order: order of the interpolation: 3 for values, 0 for weights.
    """
    middle = round(column)
    reach = min(middle, values.shape[2] - 1 - middle)
    moved = shift(values, (0, 0, middle - column), order=order, mode="nearest")
    return np.ascontiguousarray(moved[..., middle - reach : middle + reach + 1])


def load_tooth() -> MeasuredSlice:
    """The first layer of the tooth, in a grid with the number of voxels of the scene, or one more if this number is even.

    Raises:
        MivolError: the data is not on this machine.
    """
    path = examples_folder() / "tooth" / "fit.toml"
    chosen = config.load(path)
    edge = chosen.grid.shape[1] // 2 * 2 + 1
    data = make_data(chosen, path.parent, make_voxel_grid(chosen, path.parent))
    beam = data.geometry
    column = beam.axis_offset / np.broadcast_to(beam.pitch, 2)[1] + (beam.detector[1] - 1) / 2
    y, weights = (centre_axis(a[:, :1], column, order) for a, order in ((data.y, 3), (data.weights, 0)))
    held_out = held_out_views(chosen, len(y))
    kept, grid = fitted_views(held_out, len(y)), VoxelGrid((1, edge, edge))
    fitted, predicted = (ParallelBeam(beam.angles[views], y.shape[1:]) for views in (kept, held_out))
    return MeasuredSlice(
        fitted, grid, y[kept], weights[kept], None,
        held_out=Projector(predicted, grid), measured=y[held_out], certainty=weights[held_out],
    )  # fmt: skip


KINDS = {"few views": (30, 0.0), "noisy": (90, 1e4), "many": (360, 1e4)}
"""Kind of data: number of views, quanta per pixel (0: no noise)."""

STEPS = {"cgls": 20, "pcg": 20, "pcg from fbp": 10, "sirt": 60, "sart": 6, "os-sart": 12}
"""Iterations of mivol's solvers; other programs take as many."""

REPEATS = 3

PAIRS = (
    ("mivol cgls", "astra CGLS"),
    ("mivol sirt", "astra SIRT"),
    ("mivol sart", "astra SART"),
    ("mivol fbp", "astra FBP"),
    ("mivol fbp", "scikit-image iradon"),
    ("mivol sart", "scikit-image iradon_sart"),
    ("mivol default", "astra SART"),
)
"""Methods compared at equal error."""

Curve = dict[str, list[float]]
"""``errors`` after each step, and ``seconds`` of processor time up to it."""


def time_states(scan: Slice, states: Iterator[np.ndarray], steps: int) -> Curve:
    """Take steps of a method. Errors are not timed; work before the first step is."""
    errors, seconds, spent = [], [], 0.0
    for _ in range(steps):
        start = time.process_time()
        x = next(states, None)
        spent += time.process_time() - start
        if x is None:
            break
        errors.append(scan.error(x))
        seconds.append(spent)
    return {"errors": errors, "seconds": seconds}


# -- Methods ----------------------------------------------------------------------------------------------------------------


def run_solvers(scan: Slice) -> dict[str, Curve]:
    """mivol: every solver of least squares, and filtered back-projection."""
    walk = Projector(scan.beam, scan.grid)

    def states(name: str, x0: np.ndarray | None = None) -> Iterator[np.ndarray]:
        wanted = config.SolveSettings(name, iterations=STEPS.get(name, 1))
        a = choose_matrix_storage(wanted, walk).apply(walk)
        problem = LeastSquares(a, scan.y, scan.weights, x0, nonnegative=name not in ("cgls", "fbp"))
        yield from (state.x for state in ALL_SOLVERS[name].run(problem))

    filtered = next(states("fbp"))
    curves = {"mivol fbp": time_states(scan, states("fbp"), 1)}
    for name, steps in STEPS.items():
        solver, start = name.removesuffix(" from fbp"), np.maximum(filtered, 0) if name.endswith("fbp") else None
        next(states(solver, start))  # compiles
        curves[f"mivol {name}"] = time_states(scan, states(solver, start), steps)
    return curves


def default_states(scan: Slice) -> Iterator[np.ndarray]:
    """States of the solver that mivol chooses (``solve.name = "auto"``)."""
    wanted, _ = resolve_solver(config.SolveSettings(), Projector(scan.beam, scan.grid))
    walk = Projector(scan.beam, subdivide_grid(scan.grid, wanted.supersampling, scan.beam))
    walk = choose_matrix_storage(wanted, walk).apply(walk)
    data, all_views = Projections(scan.beam, scan.y, scan.weights, is_noise_known=scan.photons > 0), np.arange(len(scan.y))
    start, prior = start_volume(wanted, walk, data, all_views), make_prior(wanted, walk, data, all_views)
    problem = ProjectionProblem(LeastSquares(walk, scan.y, scan.weights, start, wanted.nonnegative, prior))
    estimate_noise(problem, wanted, data)
    for state in ALL_SOLVERS[wanted.name].run(problem.linear_problem):
        yield voxel_means(state.x.reshape(walk.grid.shape), scan.grid.shape)


def likelihood_states(scan: Slice) -> Iterator[np.ndarray]:
    """States of ML-TR of the counts, from filtered back-projection."""
    a = store_matrix(Projector(scan.beam, scan.grid))
    start = np.maximum(filtered_backprojection(a, scan.y), 0)
    yield from (state.x for state in ALL_SOLVERS["ml-tr"].run(PoissonCounts(a, scan.weights, scan.photons, x0=start)))


def run_default(scan: Slice) -> dict[str, Curve]:
    """mivol: the default solver, and ML-TR for data with counted quanta."""
    methods = {"mivol default": default_states, **({"mivol ml-tr from fbp": likelihood_states} if scan.photons else {})}
    for states in methods.values():
        next(states(scan))  # compiles
    return {name: time_states(scan, states(scan), STEPS["pcg"]) for name, states in methods.items()}


def run_scikit_image(scan: Slice) -> dict[str, Curve]:
    """scikit-image: ``iradon``, and ``iradon_sart`` with as many sweeps; rows of its images run against y."""
    from skimage.transform import iradon, iradon_sart

    sinogram, theta, n = scan.y[:, 0].T.copy(), np.degrees(scan.beam.angles), scan.grid.shape[1]
    margin = (len(sinogram) - n) // 2

    def sweeps() -> Iterator[np.ndarray]:
        image = None
        while True:
            image = iradon_sart(sinogram, theta, image=image)
            yield image[::-1][margin : margin + n, margin : margin + n]

    filtered = (iradon(sinogram, theta, output_size=n)[::-1] for _ in range(1))
    return {
        "scikit-image iradon": time_states(scan, filtered, 1),
        "scikit-image iradon_sart": time_states(scan, sweeps(), STEPS["sart"]),
    }


def run_astra(scan: Slice) -> dict[str, Curve]:
    """astra-toolbox on the processor: FBP, CGLS, SIRT and SART; an iteration of SART is a view, and sweeps are counted."""
    astra = importlib.import_module("astra")  # optional: used only if it is installed

    n, (views, _, columns) = scan.grid.shape[1], scan.beam.shape
    volume = astra.create_vol_geom(n, n)
    beam = astra.create_proj_geom("parallel", 1.0, columns, scan.beam.angles)
    projector = astra.create_projector("linear", beam, volume)
    sinogram = astra.data2d.create("-sino", beam, scan.y[:, 0])

    def states(name: str, each: int) -> Iterator[np.ndarray]:
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
    return {f"astra {name}": time_states(scan, states(name, each), steps) for name, (each, steps) in wanted.items()}


PEERS: dict[str, tuple[str, Callable[[Slice], dict[str, Curve]]]] = {
    "astra-toolbox": ("astra", run_astra),
    "scikit-image": ("skimage", run_scikit_image),
}
"""Package -> module and methods."""


# -- Questions --------------------------------------------------------------------------------------------------------------


def measure_peers(size: object, n: int = 129) -> dict:
    """How small is the error of slices, and after how long, beside astra-toolbox and scikit-image?"""
    return compare_methods({kind: make_slice(n, views, photons) for kind, (views, photons) in KINDS.items()})


def measure_tooth(size: object) -> dict:
    """How well does a measured slice predict held-out views, beside astra-toolbox and scikit-image?"""
    return compare_methods({"tooth": load_tooth()})


def compare_methods(scans: dict[str, Slice]) -> dict[str, dict[str, Curve]]:
    """Curves by kind of data and method; times are medians. Missing packages are printed."""
    packages = [package for package, (module, _) in PEERS.items() if importlib.util.find_spec(module) is not None]
    for package in PEERS.keys() - set(packages):
        say(f"{package} is not installed: left out")
    return {kind: median_times([run_all(scan, packages) for _ in range(REPEATS)]) for kind, scan in scans.items()}


def run_all(scan: Slice, packages: list[str]) -> dict[str, Curve]:
    """Run all methods of mivol and of packages once."""
    curves = run_solvers(scan) | run_default(scan)
    for package in packages:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of other packages
            curves |= PEERS[package][1](scan)
    return curves


def median_times(runs: list[dict[str, Curve]]) -> dict[str, Curve]:
    """Errors of the first run, and medians of the times; errors repeat, so all runs have the same length."""
    return {
        name: {"errors": curve["errors"], "seconds": np.median([run[name]["seconds"] for run in runs], 0).tolist()}
        for name, curve in runs[0].items()
    }


# -- Tables -----------------------------------------------------------------------------------------------------------------


def _table(title: str, kinds: dict, rows: dict[str, list[str]]) -> list[str]:
    head = [f"| {title} | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    return head + [f"| {label} | " + " | ".join(cells) + " |" for label, cells in rows.items()]


def error_rows(answer: dict[str, dict[str, Curve]]) -> list[str]:
    """Markdown table: smallest error of each method (after so many steps and seconds)."""

    def cell(curve: Curve | None) -> str:
        if curve is None:
            return ""
        best = int(np.argmin(curve["errors"]))
        return f"{curve['errors'][best]:.4f} ({best + 1}, {curve['seconds'][best]:.2f} s)"

    methods = dict.fromkeys(name for curves in answer.values() for name in curves)
    return _table("method", answer, {name: [cell(curves.get(name)) for curves in answer.values()] for name in methods})


def ratio_rows(answer: dict[str, dict[str, Curve]]) -> list[str]:
    """Markdown table: time of mivol over time of the peer, at the larger of the two smallest errors, which both reach."""

    def time_to(curve: Curve, error: float) -> float:
        return curve["seconds"][int(np.flatnonzero(np.asarray(curve["errors"]) <= error)[0])]

    def cell(a: Curve, b: Curve) -> str:
        error = max(min(a["errors"]), min(b["errors"]))
        return f"{time_to(a, error) / time_to(b, error):.2f} ({error:.4f})"

    pairs = [(mivol, peer) for mivol, peer in PAIRS if all(peer in curves for curves in answer.values())]
    rows = {f"{mivol} / {peer}": [cell(curves[mivol], curves[peer]) for curves in answer.values()] for mivol, peer in pairs}
    return _table("time at equal error", answer, rows)
