"""How near to the truth is a scan prepared before and during its inversion: axis, rings, motion, scattered light?

    mivol bench preparation                        every question
    mivol bench preparation --only axis            the rotation axis of twenty computed scans
    mivol bench preparation --only rings           gains of columns: error over that of the scan without rings
    mivol bench preparation --only motion          views shifted by a pixel and turned by half a degree
    mivol bench preparation --only scatter         scattered light, smooth along the detector

axis: twenty computed scans in parallel light, with noise, rings, an object off-centre, a region of interest, air of .5 to 1,
and whole turns with the axis near the edge of the detector. Pixels see the mean light of three parts of a column; no grid takes
part. The way from simulated readings, flats and darks to the column of the axis is under test. An axis counts as found if it is
within 0.2 columns of the truth, and as told if it is within two of its own standard deviations.

rings: slices of 129 columns and 180 views; the gains of the columns scatter by 2 %. The error is nRMSE of the default solver
on the scan, over nRMSE of the same solver on the same scan without rings.

motion: 90 views of 32 x 96 pixels of forty ellipsoids, with shifts of one pixel (RMS, along rows and along columns) and
turns of half a degree. Errors are root mean squares, without the moves of a displaced object, which no view shows.

scatter: scattered light of 5 % of the light, highest beside the middle of the detector; a head and forty ellipsoids in 129
columns and 180 views, ellipsoids in 24 rows, and in a cone beam. Errors are root mean squares over the detector.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from mivol import config
from mivol.bench.harness.study import Size, Study, SweptQuestion, amount, say_row
from mivol.experiments.projections import Projections
from mivol.experiments.scan_fit import start_volume
from mivol.experiments.solver_choice import (
    GAIN_ITERATIONS,
    ITERATIONS,
    choose_matrix_storage,
    estimate_noise,
    make_prior,
    resolve_solver,
)
from mivol.optim.projections.alignment import align_views
from mivol.optim.projections.inversion import LinearSolve, ProjectionProblem
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.optim.projections.scatter import fit_scatter
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid, subdivide_grid, voxel_means
from mivol.tomography.phantoms import random_ellipsoids, shepp_logan
from mivol.tomography.preprocess import correct_transmission, find_air, to_line_integrals
from mivol.tomography.projector import Projector
from mivol.tomography.rings import FIRST_WIDTH, RING_WIDTHS, PixelGains, remove_rings
from mivol.tomography.rotation_axis import find_axis
from mivol.validate.metrics import nrmse


@dataclass(frozen=True)
class PreparationSize(Size):
    """Amount of work."""

    seeds: int = amount(20, 2, "seeds of gains and noise")


# -- Axis -------------------------------------------------------------------------------------------------------------------


def find_one_axis(name: str, size: PreparationSize) -> dict:
    """Column of the axis of a scan, its error [column], and the error that the method tells."""
    scan = AXIS_SCANS[name]
    light = correct_transmission(*scan.readings())
    air = find_air(light)
    y, weights = to_line_integrals(air.normalise(light) if air and air.is_needed else light)
    axis = find_axis(y, weights, scan.beam().angles)
    error = axis.column - scan.column
    say_row(name, error=error, sigma=axis.uncertainty)
    return {"column": scan.column, "error": error, "sigma": axis.uncertainty, "method": axis.method}


def join_axes(size: PreparationSize, rows: dict[str, dict]) -> dict:
    """All scans, and the number of found axes."""
    found = sum(abs(row["error"]) < 0.2 for row in rows.values())
    told = sum(abs(row["error"]) < max(0.2, 2 * row["sigma"]) for row in rows.values())
    return {"scans": rows, "count": len(rows), "found": found, "found_or_told": told}


measure_axis = SweptQuestion(
    "How far is the rotation axis of twenty computed scans from its true column?",
    lambda size: list(AXIS_SCANS),
    find_one_axis,
    join_axes,
)


# -- Rings ------------------------------------------------------------------------------------------------------------------

COLUMNS, VIEWS, PITCH, GAIN_SPREAD = 129, 180, 2.2 / 129, 0.02
BEAM = ParallelBeam(np.arange(VIEWS) * np.pi / VIEWS, (1, COLUMNS), PITCH)
GRID = VoxelGrid((1, COLUMNS, COLUMNS), PITCH)
RING_CASES = {
    "head, no noise": ("head", 0.53, 0.0),
    "head, 10,000 quanta": ("head", 0.53, 1e4),
    "dense head, 10,000 quanta": ("head", 2.12, 1e4),
    "ellipsoids, no noise": ("ellipsoids", 0.53, 0.0),
    "ellipsoids, 10,000 quanta": ("ellipsoids", 0.53, 1e4),
    "dense ellipsoids, 10,000 quanta": ("ellipsoids", 2.12, 1e4),
}
"""Object, largest line integral, quanta of a pixel without object."""


STEPS = {"gain": RING_WIDTHS["gain"], "fit": FIRST_WIDTH}
"""What is done, with the width of the removal from line integrals [column]."""


def make_ring_scan(name: str, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact line integrals (views, 1, columns) up to ``depth``, and the object averaged over voxels."""
    phantom = shepp_logan() if name == "head" else random_ellipsoids(40, 3, 0.92)
    y, volume = phantom.project(BEAM), phantom.voxelise(GRID, 4)
    return y * depth / y.max(), volume * depth / y.max()


def solve_by_default(y: np.ndarray, weights: np.ndarray, is_noise_known: bool, with_gains: bool) -> np.ndarray:
    """The default solver's volume (1, columns, columns), with or without gains of the pixels as unknowns."""
    iterations = GAIN_ITERATIONS if with_gains else ITERATIONS
    solve, _ = resolve_solver(config.SolveSettings(), Projector(BEAM, GRID), iterations)
    walk = Projector(BEAM, subdivide_grid(GRID, solve.supersampling, BEAM))
    walk = choose_matrix_storage(solve, walk).apply(walk)
    data, views = Projections(BEAM, y, weights, is_noise_known=is_noise_known), np.arange(VIEWS)
    start, prior = start_volume(solve, walk, data, views), make_prior(solve, walk, data, views)
    gains = PixelGains(weights) if with_gains else None
    problem = ProjectionProblem(LeastSquares(walk, y, weights, start, solve.nonnegative, prior, gains))
    estimate_noise(problem, solve, data)
    run = LinearSolve().begin(problem)
    for iteration in range(iterations):
        run.step(iteration, 1.0)
    return voxel_means(run.state.x.reshape(walk.grid.shape), GRID.shape)


def measure_ring_errors(case: tuple[str, float, float], seed: int) -> dict[str, float]:
    """nRMSE over that of the scan without rings, by what was done."""
    name, depth, photons = case
    exact, truth = make_ring_scan(name, depth)
    rng = np.random.default_rng(seed)
    gains = 1 + GAIN_SPREAD * rng.standard_normal(COLUMNS)

    def measure(light: np.ndarray) -> np.ndarray:
        return -np.log(rng.poisson(photons * light) / photons if photons else light)

    clean, rings = measure(np.exp(-exact)), measure(gains * np.exp(-exact))
    weights = photons * np.exp(-clean) if photons else np.ones(exact.shape)

    def error(y: np.ndarray, with_gains: bool) -> float:
        return nrmse(solve_by_default(y, weights, photons > 0, with_gains), truth)

    unspoilt = error(clean, False)
    found = {"none": error(rings, False)}
    for (label, y), (step, width) in itertools.product((("", rings), (", no rings", clean)), STEPS.items()):
        removed = remove_rings(y, weights, "gain", width)
        found[step + label] = error(removed, step == "fit" and not np.array_equal(removed, y))
    return {label: value / unspoilt for label, value in found.items()}


def join_rings(size: PreparationSize, found: dict[tuple[str, int], dict[str, float]]) -> dict:
    """Means over the seeds, by case."""
    answer = {}
    for label in RING_CASES:
        errors = [found[label, seed] for seed in range(size.seeds)]
        answer[label] = {step: float(np.mean([one[step] for one in errors])) for step in errors[0]}
        say_row(label, **answer[label])
    return answer


measure_rings = SweptQuestion(
    "What is the error of a slice with rings, over that of the same scan without rings?",
    lambda size: list(itertools.product(RING_CASES, range(size.seeds))),
    lambda piece, size: measure_ring_errors(RING_CASES[piece[0]], 100 + piece[1]),
    join_rings,
)


# -- Motion -----------------------------------------------------------------------------------------------------------------


MOTION_CASES = {"10,000 quanta": (1e4, 1.0), "300 quanta": (300.0, 1.0), "no motion, 10,000 quanta": (1e4, 0.0)}
"""Quanta of a pixel without object, and factor on the moves."""


def measure_moves(label: str, size: PreparationSize) -> dict[str, float]:
    """Errors of the fitted moves of a scan."""
    views, rows, columns = 90, 32, 96
    beam = ParallelBeam(np.arange(views) * np.pi / views, (rows, columns))
    photons, spread = MOTION_CASES[label]
    rng = np.random.default_rng(0)
    moves = spread * rng.standard_normal((views, 3)) * [1.0, 1.0, np.radians(0.5)]
    exact = random_ellipsoids(40, 3, 0.4 * columns).project(replace(beam, moves=moves))
    counts = np.maximum(rng.poisson(photons * np.exp(-2 * exact / exact.max())), 1.0)
    grid, y = VoxelGrid((rows, columns, columns)), -np.log(counts / photons)
    found = align_views(beam, grid, y, counts, ["shift"], np.arange(0))
    error = found.moves - moves
    object_moves = np.stack([np.cos(beam.angles), np.sin(beam.angles)], 1)
    error[:, 1] -= object_moves @ np.linalg.lstsq(object_moves, error[:, 1], rcond=None)[0]
    error[:, 0] -= error[:, 0].mean()
    along_rows, along_columns, turn = np.sqrt(np.mean(error**2, axis=0))
    answer = {
        "rows [pixel]": float(along_rows),
        "columns [pixel]": float(along_columns),
        "turn [degree]": float(np.degrees(turn)),
        "sigma of rows": float(found.sigma[0]),
        "sigma of columns": float(found.sigma[1]),
        "used": float(found.is_needed),
    }
    say_row(label, **answer)
    return answer


measure_motion = SweptQuestion(
    "How near to the truth are fitted shifts and turns of the views?",
    lambda size: list(MOTION_CASES),
    measure_moves,
)


# -- Scattered light --------------------------------------------------------------------------------------------------------

SCATTER_CASES = {
    "head, no noise": (BEAM, True, 0.0, 0.05, 0),
    "head, 10,000 quanta": (BEAM, True, 1e4, 0.05, 0),
    "head, 10,000 quanta, no scatter": (BEAM, True, 1e4, 0.0, 0),
    "head, 10,000 quanta, views divided by air": (BEAM, True, 1e4, 0.05, 4),
    "ellipsoids, no noise": (BEAM, False, 0.0, 0.05, 0),
    "ellipsoids, 10,000 quanta": (BEAM, False, 1e4, 0.05, 0),
    "ellipsoids, 300 quanta": (BEAM, False, 300.0, 0.05, 0),
    "ellipsoids, 24 rows, 10,000 quanta": (replace(BEAM, detector=(24, COLUMNS)), False, 1e4, 0.05, 0),
    "ellipsoids, cone beam, 10,000 quanta": (
        ConeBeam(np.arange(90) * 2 * np.pi / 90, (48, 96), 6.0, 8.0, 2.9 / 96), False, 1e4, 0.05, 0
    ),
}  # fmt: skip
"""Beam, head or ellipsoids, quanta of a pixel without object, largest scattered light, columns of air that divide the views."""


def find_scatter(label: str, size: PreparationSize) -> dict[str, float]:
    """Error of the scattered light of a scan, the error that the method tells, and errors of line integrals."""
    beam, is_head, photons, amplitude, air = SCATTER_CASES[label]
    exact = (shepp_logan(half_width=0.98) if is_head else random_ellipsoids(40, 3, 0.8)).project(beam)
    exact = 2.5 * exact / exact.max()
    rows, columns = beam.detector
    u, v = np.linspace(-1, 1, columns), np.linspace(-1, 1, rows)[:, None] if rows > 1 else np.zeros((1, 1))
    truth = amplitude * (1 - 0.6 * u**2 + 0.2 * u - 0.3 * v**2)
    light = np.exp(-exact) + truth
    if photons:
        light = np.maximum(np.random.default_rng(0).poisson(photons * light), 1) / photons
    if air:
        level = light[..., np.r_[:air, columns - air : columns]].mean()
        light, truth = light / level, truth / level
    y = -np.log(light)
    weights = (photons or 1e8) * light
    found = fit_scatter(beam, y, weights, air)
    straight, _ = found.subtract(y, weights)

    def root_mean_square(a: np.ndarray) -> float:
        return float(np.sqrt(np.mean(a**2)))

    answer = {
        "scatter": root_mean_square(truth),
        "error": root_mean_square(found.light - truth),
        "sigma": root_mean_square(found.sigma),
        "lines before": root_mean_square(y - exact),
        "lines after": root_mean_square(straight - exact),
        "subtracted": float(found.is_needed),
    }
    say_row(label, **answer)
    return answer


measure_scatter = SweptQuestion(
    "How near to the truth is fitted scattered light, over the light without object?",
    lambda size: list(SCATTER_CASES),
    find_scatter,
)


# -- Tables -----------------------------------------------------------------------------------------------------------------


def table(question: str, answer: dict) -> list[str]:
    """Markdown table."""
    if question == "axis":
        rows = [["scan", "column", "error", "sigma", "method"], ["---"] * 5]
        for name, row in answer["scans"].items():
            rows.append([name, f"{row['column']:.1f}", f"{row['error']:+.3f}", f"{row['sigma']:.3f}", row["method"]])
        last = f"within 0.2 columns: {answer['found']} of {answer['count']}; or within two sigma: {answer['found_or_told']}"
        return [*("| " + " | ".join(row) + " |" for row in rows), "", last]
    first = next(iter(answer.values()))
    rows = [["scan", *first], ["---", *["---:"] * len(first)]]
    rows += [[name, *(f"{value:.3g}" for value in row.values())] for name, row in answer.items()]
    return ["| " + " | ".join(row) + " |" for row in rows]


QUESTIONS = {"axis": measure_axis, "rings": measure_rings, "motion": measure_motion, "scatter": measure_scatter}
STUDY = Study(__name__, __doc__, PreparationSize, QUESTIONS, table=table)


# -- Scans ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AxisScan:
    """A computed scan: the axis lies ``offset`` columns beyond the middle, the object reaches ``radius`` columns from it.

    ``gains``: standard deviation of a column's factor that the flats do not have. ``air``: light of the views over the flats'.
    ``depth``: largest line integral.
    """

    offset: float
    radius: float = 44.0
    views: int = 90
    arc: float = 180.0
    columns: int = 120
    photons: float = 1e4
    gains: float = 0.0
    air: float = 1.0
    depth: float = 2.0
    head: bool = True
    rows: int = 2
    seed: int = 0

    @property
    def column(self) -> float:
        """Column of the axis."""
        return self.offset + (self.columns - 1) / 2

    def beam(self) -> ParallelBeam:
        """The beam, with pixels of 1."""
        angles = np.radians(self.arc) * np.arange(self.views) / self.views
        return ParallelBeam(angles, (self.rows, self.columns), 1.0, axis_offset=self.offset)

    def readings(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Views, flats and darks (n, rows, columns)."""
        rng = np.random.default_rng(self.seed)
        phantom = shepp_logan(half_width=self.radius / 0.92) if self.head else random_ellipsoids(40, self.seed + 7, self.radius)
        beam = self.beam()
        fine = replace(beam, detector=(self.rows, 3 * self.columns), pitch=(1.0, 1 / 3))
        y = phantom.project(fine)
        light = np.exp(-self.depth * y / y.max()).reshape(self.views, self.rows, self.columns, 3).mean(-1)
        pattern = self.photons * (1 + 0.2 * np.sin(np.arange(self.columns) / 7)) * np.ones((self.rows, 1))
        factor = 1 + self.gains * rng.normal(size=pattern.shape)
        counts = [rng.poisson(pattern * factor * self.air * light), rng.poisson(np.repeat(pattern[None], 10, 0))]
        dark = rng.normal(100, 2, (10, self.rows, self.columns))
        return (*(0.5 * c + rng.normal(100, 2, c.shape) for c in counts), dark)


AXIS_SCANS: dict[str, AxisScan] = {
    "head": AxisScan(0.3),
    "off-centre": AxisScan(11.4),
    "far off-centre": AxisScan(-14.2, radius=40),
    "blocks": AxisScan(-3.7, head=False),
    "much noise": AxisScan(2.6, photons=300),
    "much noise, blocks": AxisScan(-5.3, photons=300, head=False, seed=1),
    "few views": AxisScan(1.7, views=40, seed=2),
    "rings 2 %": AxisScan(4.4, gains=0.02, seed=3),
    "rings 5 %, off-centre": AxisScan(-9.1, gains=0.05, seed=4),
    "rings 2 %, noise": AxisScan(6.2, gains=0.02, photons=1000, head=False, seed=5),
    "air .9": AxisScan(1.3, air=0.9, seed=6),
    "air .7": AxisScan(-6.6, air=0.7, seed=7),
    "air .5, noise": AxisScan(3.9, air=0.5, photons=1000, head=False, seed=8),
    "region of interest": AxisScan(0.4, radius=90, depth=3, seed=9),
    "region of interest, off-centre": AxisScan(-12.3, radius=85, depth=3, head=False, seed=10),
    "region of interest, many views": AxisScan(5.2, radius=120, views=240, depth=3, seed=11),
    "region of interest, air .8": AxisScan(3.1, radius=90, depth=3, air=0.8, head=False, seed=12),
    "whole turn": AxisScan(2.8, arc=360, views=120, seed=13),
    "half acquisition, overlap 40": AxisScan(39.3, radius=90, arc=360, views=240, depth=3, seed=14),
    "half acquisition, overlap 16": AxisScan(-51.6, radius=100, arc=360, views=240, depth=3, head=False, seed=15),
}
