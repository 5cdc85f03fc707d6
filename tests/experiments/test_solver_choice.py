"""What a scan's file leaves open, and what is chosen then."""

from __future__ import annotations

import numpy as np
import pytest

from mivol import config
from mivol.experiments import solver_choice
from mivol.experiments.solver_choice import settle_solver, solver_of, strength_of
from mivol.tomography.geometry import ConeBeam, Geometry, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector

GRID = VoxelGrid((2, 6, 6))
ROUND = np.arange(12) * np.pi / 6
HALF = np.arange(12) * np.pi / 12


def settled(wanted: config.Solve, geometry: Geometry) -> tuple[config.Solve, dict[str, str]]:
    found, lines = settle_solver(wanted, Projector(geometry, GRID))
    return found, {line.choice: line.reason for line in lines}


@pytest.mark.parametrize("geometry", [ParallelBeam(HALF, (2, 9)), ConeBeam(ROUND, (2, 9), 20.0, 30.0)])
def test_what_is_left_open_is_the_best_of_the_table(variant_rgb: str, geometry: Geometry) -> None:
    found, said = settled(config.Solve(), geometry)
    assert (found.name, found.start, found.supersampling, found.tv, found.tv_unit) == ("pcg", "filtered", 2, 1.0, "noise")
    assert "the table of docs/benchmarks.md" in said["solver: pcg"]
    assert list(said)[1:] == [
        "start: filtered back-projection",
        "unknowns: two along each edge of a voxel, which is their mean",
    ]


@pytest.mark.parametrize(
    ("geometry", "sentence"),
    [
        (ParallelBeam(HALF / 4, (2, 9)), "filtered back-projection refuses: found views with a gap of 138.8 degrees"),
        (ConeBeam(ROUND / 3, (2, 9), 20.0, 30.0), "filtered back-projection refuses: found cone-beam views over 110.0 degrees"),
    ],
)
def test_views_that_cannot_be_filtered_begin_empty(variant_rgb: str, geometry: Geometry, sentence: str) -> None:
    found, said = settled(config.Solve(), geometry)
    assert found.start == "empty"
    assert said["start: empty"].startswith(sentence)


def test_finer_unknowns_are_taken_where_they_fit(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """72 voxels: 288 unknowns in a parallel beam, whose layers stay, 576 in a cone."""
    cone, parallel = ConeBeam(ROUND, (2, 9), 20.0, 30.0), ParallelBeam(HALF, (2, 9))
    monkeypatch.setattr(solver_choice, "MOST_UNKNOWNS", 288)
    assert settled(config.Solve(), parallel)[0].supersampling == 2
    found, said = settled(config.Solve(), cone)
    assert found.supersampling == 1
    assert "solve.supersampling = 2 takes them" in said["unknowns: the voxels"]
    assert settled(config.Solve(supersampling=3), cone)[0].supersampling == 3


def test_what_a_file_says_holds(variant_rgb: str) -> None:
    """A solver that is named begins empty, at the voxels and without a prior; keys of "auto" that are given stay."""
    cone = ConeBeam(ROUND, (2, 9), 20.0, 30.0)
    found, said = settled(config.Solve("sirt"), cone)
    assert (found.name, found.start, found.supersampling, found.tv) == ("sirt", "empty", 1, 0.0)
    assert list(said) == ["solver: sirt"] and "1 / (ray length)" in said["solver: sirt"]
    found, said = settled(config.Solve(start="empty", supersampling=1, tv=0.0, iterations=7), cone)
    assert (found.name, found.start, found.supersampling, found.tv, found.iterations) == ("pcg", "empty", 1, 0.0, 7)
    assert list(said) == ["solver: pcg"]


def test_the_prior_that_is_meant() -> None:
    """Only in units of the noise is there a strength that needs no choice."""
    assert strength_of(config.Solve()) == 1
    assert strength_of(config.Solve(tv_unit="length")) == strength_of(config.Solve("pcg")) == 0
    assert strength_of(config.Solve(tv=0.25)) == strength_of(config.Solve("pcg", tv=0.25)) == 0.25
    assert (solver_of(config.Solve()), solver_of(config.Solve("ml-tr"))) == ("pcg", "ml-tr")
