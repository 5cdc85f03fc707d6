"""What a scan's file leaves open, and what is chosen then."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from mivol import config
from mivol.experiments import solver_choice
from mivol.experiments.projections import Projections
from mivol.experiments.solver_choice import PLAIN_ITERATIONS, estimate_noise, make_prior, resolve_solver, tv_strength
from mivol.optim.projections.inversion import ProjectionProblem
from mivol.optim.projections.iterative import projected_cg
from mivol.optim.projections.linear_problems import LeastSquares, scale_tv_to_noise
from mivol.tomography.geometry import ConeBeam, Geometry, ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector

GRID = VoxelGrid((2, 6, 6))
ROUND = np.arange(12) * np.pi / 6
HALF = np.arange(12) * np.pi / 12


def settled(wanted: config.SolveSettings, geometry: Geometry) -> tuple[config.SolveSettings, dict[str, str]]:
    found, lines = resolve_solver(wanted, Projector(geometry, GRID))
    return found, {line.choice: line.reason for line in lines}


@pytest.mark.parametrize("geometry", [ParallelBeam(HALF, (2, 9)), ConeBeam(ROUND, (2, 9), 20.0, 30.0)])
def test_what_is_left_open_is_the_best_of_the_table(variant_rgb: str, geometry: Geometry) -> None:
    found, said = settled(config.SolveSettings(), geometry)
    assert (found.name, found.start, found.supersampling, found.tv, found.tv_unit) == ("pcg", "filtered", 2, 1.0, "noise")
    assert "the table of docs/benchmarks.md" in said["solver: pcg"]
    assert list(said)[1:] == [
        "start: filtered back-projection",
        "unknowns: two along each edge of a voxel; the voxel is their mean",
    ]


@pytest.mark.parametrize(
    ("geometry", "sentence"),
    [
        (ParallelBeam(HALF / 4, (2, 9)), "filtered back-projection refuses: found views with a gap of 138.8 degrees"),
        (ConeBeam(ROUND / 3, (2, 9), 20.0, 30.0), "filtered back-projection refuses: found cone-beam views over 110.0 degrees"),
    ],
)
def test_views_that_cannot_be_filtered_begin_empty(variant_rgb: str, geometry: Geometry, sentence: str) -> None:
    found, said = settled(config.SolveSettings(), geometry)
    assert found.start == "empty"
    assert said["start: empty"].startswith(sentence)


def test_finer_unknowns_are_taken_where_they_fit(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """72 voxels: 288 unknowns in a parallel beam, whose layers stay, 576 in a cone."""
    cone, parallel = ConeBeam(ROUND, (2, 9), 20.0, 30.0), ParallelBeam(HALF, (2, 9))
    monkeypatch.setattr(solver_choice, "MOST_UNKNOWNS", 288)
    assert settled(config.SolveSettings(), parallel)[0].supersampling == 2
    found, said = settled(config.SolveSettings(), cone)
    assert found.supersampling == 1
    assert "solve.supersampling = 2 takes them" in said["unknowns: the voxels"]
    assert settled(config.SolveSettings(supersampling=3), cone)[0].supersampling == 3


@pytest.mark.parametrize(("name", "steps"), [("fbp", 2 * 20 * 12 * 2 * 9 * 24), ("fdk", 2 * 20 * 12 * 2 * 9 * 28)])
def test_long_iterations_over_many_views_become_a_single_step(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch, name: str, steps: int
) -> None:
    """20 iterations of two products, 12 x 2 x 9 rays, and 12 + 12 cells across the light (a cone: 4 along z, too)."""
    geometry = ParallelBeam(HALF, (2, 9)) if name == "fbp" else ConeBeam(ROUND, (2, 9), 20.0, 30.0)

    def chosen(geometry: Geometry, **wishes: object) -> str:
        return resolve_solver(config.SolveSettings(**wishes), Projector(geometry, GRID), may_be_direct=True)[0].name

    monkeypatch.setattr(solver_choice, "MOST_STEPS", steps)
    assert chosen(geometry) == "pcg"
    monkeypatch.setattr(solver_choice, "MOST_STEPS", steps - 1)
    found, (line,) = resolve_solver(config.SolveSettings(), Projector(geometry, GRID), may_be_direct=True)
    assert (found.name, found.supersampling, found.tv, found.start) == (name, 1, 0.0, "empty")
    assert line.choice == f"solver: {name}" and 'solve.name = "pcg" iterates' in line.reason
    assert {chosen(geometry, **wish) for wish in ({"tv": 1.0}, {"iterations": 20}, {"name": "pcg"})} == {"pcg"}
    few, gap = replace(geometry, detector=(2, 13)), replace(geometry, angles=geometry.angles / 4)
    assert chosen(few) == chosen(gap) == "pcg"
    assert settled(config.SolveSettings(), geometry)[0].name == "pcg"


def test_what_a_file_says_holds(variant_rgb: str) -> None:
    """A solver that is named begins empty, at the voxels and without a prior; keys of "auto" that are given stay."""
    cone = ConeBeam(ROUND, (2, 9), 20.0, 30.0)
    found, said = settled(config.SolveSettings("sirt"), cone)
    assert (found.name, found.start, found.supersampling, found.tv) == ("sirt", "empty", 1, 0.0)
    assert list(said) == ["solver: sirt"] and "1 / (ray length)" in said["solver: sirt"]
    found, said = settled(config.SolveSettings(start="empty", supersampling=1, tv=0.0, iterations=7), cone)
    assert (found.name, found.start, found.supersampling, found.tv, found.iterations) == ("pcg", "empty", 1, 0.0, 7)
    assert list(said) == ["solver: pcg"]


def test_the_prior_that_is_meant() -> None:
    """Only in units of the noise is there a strength that needs no choice."""
    assert tv_strength(config.SolveSettings()) == 1
    assert tv_strength(config.SolveSettings(tv_unit="length")) == tv_strength(config.SolveSettings("pcg")) == 0
    assert tv_strength(config.SolveSettings(tv=0.25)) == tv_strength(config.SolveSettings("pcg", tv=0.25)) == 0.25
    assert (config.SolveSettings().solver, config.SolveSettings("ml-tr").solver) == ("pcg", "ml-tr")


COARSE_GRID = VoxelGrid((1, 16, 16), 1 / 8)
BEAM = ParallelBeam(np.arange(20) * np.pi / 20, (1, 20), 1 / 8)


def problem_of(
    weight: float, wanted: config.SolveSettings, is_noise_known: bool = False
) -> tuple[ProjectionProblem, Projections]:
    a, y = Projector(BEAM, COARSE_GRID), shepp_logan().project(BEAM)
    data = Projections(BEAM, y, np.full(y.shape, weight), is_noise_known=is_noise_known)
    prior = make_prior(wanted, a, data, np.arange(20))
    return ProjectionProblem(LeastSquares(a, y, data.weights, nonnegative=True, prior=prior)), data


WANTED = config.SolveSettings(start="filtered", tv=2.0, delta=0.5)


def test_the_noise_is_what_plain_iterations_leave(variant_rgb: str) -> None:
    """The prior is as strong as that of noise of the found size, for weights that know it; the solver goes on from there."""
    problem, data = problem_of(1.0, WANTED)
    plain = replace(problem.linear_problem, prior=None)
    *_, state = itertools.islice(projected_cg(plain), PLAIN_ITERATIONS["filtered"])
    (line,) = estimate_noise(problem, WANTED, data)
    left = state.residual_norm / np.sqrt(data.y.size)
    # Threads add up in any order: five iterations end within 1e-4 of each other; the line has four digits.
    assert line.choice.endswith("times the size implied by the weights")
    assert float(line.choice.split()[1]) == pytest.approx(left, rel=1e-3)
    assert np.abs(problem.linear_problem.x0 - state.x).max() < 1e-4 * state.x.max()
    # Least squares of weights 1 are those of 1 / left^2, times left^2.
    known = scale_tv_to_noise(plain.A, data.y, data.weights / left**2, 2.0, 0.5)
    assert problem.linear_problem.prior.strength == pytest.approx(left**2 * known.strength, rel=1e-3)
    assert problem.linear_problem.prior.delta == pytest.approx(known.delta, rel=1e-5)


def test_weights_in_proportion_find_the_same(variant_rgb: str) -> None:
    """Weights 9 times as large make all of the objective 9 times as large: the strength too."""
    strengths = []
    for weight in (1.0, 9.0):
        problem, data = problem_of(weight, WANTED)
        estimate_noise(problem, WANTED, data)
        strengths.append(problem.linear_problem.prior.strength)
    # Iterates differ by rounding of float32, 1e-6 of a residual that is a hundredth of the projections.
    assert strengths[1] == pytest.approx(9 * strengths[0], rel=1e-4)


@pytest.mark.parametrize(
    ("wanted", "is_noise_known"),
    [(WANTED, True), (config.SolveSettings(tv=2.0, tv_unit="length"), False), (config.SolveSettings(tv=0.0), False)],
)
def test_nothing_is_estimated_where_nothing_is_missing(
    variant_rgb: str, wanted: config.SolveSettings, is_noise_known: bool
) -> None:
    problem, data = problem_of(1.0, wanted, is_noise_known)
    before = problem.linear_problem
    assert estimate_noise(problem, wanted, data) == []
    assert problem.linear_problem is before


def test_projections_of_nothing_leave_no_noise(variant_rgb: str) -> None:
    problem, data = problem_of(1.0, WANTED)
    problem.linear_problem = replace(problem.linear_problem, b=0 * data.y)
    assert estimate_noise(problem, WANTED, data) == []
