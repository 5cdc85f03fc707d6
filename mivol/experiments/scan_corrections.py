"""Corrections of a scan that need its geometry: scattered light, beam hardening, and a fitted geometry.

Each returns the projections with a line that says what was done. Without the setting the same projections return.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates

from mivol import config
from mivol.errors import MivolError
from mivol.experiments.projections import Projections, grid_of_detector
from mivol.optim.projections.alignment import Alignment, align_views
from mivol.optim.projections.inversion import ALL_SOLVERS
from mivol.optim.projections.linear_problems import PoissonCounts
from mivol.optim.projections.scatter import fit_scatter
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector
from mivol.tomography.single_material import fit_hardening

CUT_OFF = 0.1
"""Share of the mean mass of a row above which the first or last row is said to cut the object off."""

MOST_ROWS = 8
"""Rows in the middle of a parallel beam's detector by which beam hardening is fitted."""


def correction_citations(settings: config.ScanExperiment) -> list[str]:
    """Keys of ``mivol.cite.CITATIONS`` of the corrections that the settings ask for."""
    asked = {
        "paganin_2002": getattr(settings.data, "phase", None),
        "krumm_2008": getattr(settings.data, "hardening", 0),
        "golub_1973": getattr(settings.data, "scatter", False) and not getattr(settings.data, "hardening", 0),
        "penczek_1994": getattr(settings.scan, "refine", ()),
    }
    return [key for key, is_set in asked.items() if is_set]


def straighten_lines(settings: config.ScanExperiment, data: Projections) -> Projections:
    """Correct line integrals for scattered light and beam hardening, if the settings ask for it.

    Scatter alone is a smooth term that makes the views consistent; with hardening it is a constant behind one material.

    Raises:
        MivolError: a degree of 1, ml-tr, another beam than a circle, or as :func:`fit_hardening` and :func:`fit_scatter`.
    """
    degree, with_scatter = getattr(settings.data, "hardening", 0), getattr(settings.data, "scatter", False)
    if not degree and not with_scatter:
        return data
    name = "data.hardening" if degree else "data.scatter"
    if degree == 1:
        raise MivolError("found data.hardening = 1, which changes nothing, expected a degree of 2 to 5, or 0.")
    if ALL_SOLVERS[settings.solve.solver].problem is PoissonCounts:
        raise MivolError(f"found {name} with {settings.solve.name}, which takes counts, not line integrals: choose pcg.")
    beam = data.geometry
    if not isinstance(beam, ParallelBeam | ConeBeam):
        raise MivolError(f"found {name} with a table of views, expected a beam on a circle: leave it out.")
    return _straighten(data, beam, degree, with_scatter) if degree else _subtract_scatter(data, beam, settings.data.air or 0)


def _subtract_scatter(data: Projections, beam: ParallelBeam | ConeBeam, air_columns: int) -> Projections:
    """Subtract any smooth term of scattered light."""
    found = fit_scatter(beam, data.y, data.weights, air_columns)
    size = f"{found.light.min():.3g} to {found.light.max():.3g} +- {np.median(found.sigma):.1g} of the light"
    if not found.is_needed:
        return replace(data, notes=(*data.notes, f"scattered light of {size} is not above its noise: none is subtracted"))
    y, weights = found.subtract(data.y, data.weights)
    note = f"scattered light of {size}, smooth along the detector, is subtracted (data.scatter)"
    return _with_picture(data, "scatter", y, weights, note)


def _with_picture(data: Projections, name: str, y: np.ndarray, weights: np.ndarray, note: str) -> Projections:
    middle = y.shape[1] // 2
    picture = (name, data.y[:, middle], y[:, middle])
    return replace(data, y=y, weights=weights, notes=(*data.notes, note), pictures=(*data.pictures, picture))


def _straighten(data: Projections, beam: ParallelBeam | ConeBeam, degree: int, with_scatter: bool) -> Projections:
    part = slice(None)
    if isinstance(beam, ParallelBeam) and beam.is_upright and data.y.shape[1] > MOST_ROWS:
        first = (data.y.shape[1] - MOST_ROWS) // 2
        part = slice(first, first + MOST_ROWS)
        beam = replace(beam.select_rows(part), detector_offset=(0.0, beam.detector_offset[1]))
    found = fit_hardening(Projector(beam, grid_of_detector(beam)), data.y[:, part], data.weights[:, part], degree, with_scatter)
    if not found.is_needed:
        note = "line integrals get no straighter by a polynomial: nothing is changed (data.hardening, for one material)"
        return replace(data, notes=(*data.notes, note))
    y, weights = found.straighten(data.y, data.weights)
    terms = " ".join(f"{c:+.3g} y^{k}" for k, c in enumerate(found.coefficients, 2))
    light = f", scattered light {found.scatter:.3g} of the light" if with_scatter else ""
    note = (
        f"line integrals y are straightened to y {terms}{light} (data.hardening = {degree}): their misfit to one material "
        f"falls to {found.misfit:.2f} of what it was"
    )
    return _with_picture(data, "hardening", y, weights, note)


def is_cut_off(y: np.ndarray, weights: np.ndarray) -> bool:
    """Whether the first or the last row of the views sees more than a tenth of the mass that a row sees on average."""
    mass = np.where(weights > 0, y, 0.0).sum((0, 2))
    return bool(max(mass[0], mass[-1]) > CUT_OFF * mass.mean())


def refine_geometry(
    settings: config.ScanExperiment, grid: VoxelGrid, data: Projections, held_out: np.ndarray
) -> tuple[Projections, Alignment | None]:
    """Fit the geometry as unknowns, if the settings ask for it.

    Raises:
        MivolError: as :func:`align_views`.
    """
    names = getattr(settings.scan, "refine", ())
    if not names:
        return data, None
    if not isinstance(data.geometry, ParallelBeam | ConeBeam):
        raise MivolError("found scan.refine on another trajectory, expected a parallel or cone beam on a circle: leave it out.")
    found = align_views(data.geometry, grid, data.y, data.weights, names, held_out)
    lines = []
    if "shift" in names:
        size = np.sqrt(np.mean((found.moves - found.moves.mean(0)) ** 2, axis=0))
        lines.append(
            f"views shifted by {size[0]:.2g} +- {found.sigma[0]:.1g} (rows) and {size[1]:.2g} +- {found.sigma[1]:.1g} pixels "
            f"(columns), turned by {np.degrees(size[2]):.2g} +- {np.degrees(found.sigma[2]):.1g} degrees (RMS)"
        )
    if "axis" in names:
        lines.append(f"the axis {found.axis[0]:+.3f} +- {found.axis[1]:.3f} pixels from where it was")
    if "tilt" in names:
        (along, across), (along_sigma, across_sigma) = np.degrees(found.tilt)
        lines.append(
            f"the axis tilted by {along:.3f} +- {along_sigma:.3f} degrees along the light and {across:.3f} +- "
            f"{across_sigma:.3f} across it"
        )
        if "shift" in names and is_cut_off(data.y, data.weights):
            lines.append(
                "the object goes on beyond the first or last rows, so the tilt is wrong by up to several of these deviations: "
                "leave shift out to see the tilt alone"
            )
    ratio = np.sqrt(found.after.mean() / max(found.before.mean(), 1e-30))
    judged = f"the residual of {len(found.after)} held-out views falls to {ratio:.2f}"
    used = judged if found.is_needed else f"{judged}, no more than by chance: the geometry stays as it was"
    note = f"fitted geometry (scan.refine): {'; '.join(lines)}; {used}"
    shown = show_moves(data.y, _moves_between(data.geometry, found.beam))
    return replace(data, geometry=found.beam, notes=(*data.notes, note), pictures=(*data.pictures, shown)), found


def _moves_between(given: ParallelBeam | ConeBeam, fitted: ParallelBeam | ConeBeam) -> np.ndarray:
    """The fitted moves of the detector less the given ones, (views, 3)."""
    before, after = (np.zeros((len(b.angles), 3)) if b.moves is None else b.moves for b in (given, fitted))
    return after - before


def show_moves(y: np.ndarray, moves: np.ndarray) -> tuple[str, np.ndarray, np.ndarray]:
    """A picture of fitted moves for the report: the middle row as measured, and at the same places of an unmoved detector.

    Args:
        y: line integrals (views, rows, cols).
        moves: (views, 3) displacement of the detector along rows and columns [pixel], and turn [rad]; pixels count as square.
    """
    middle = (np.array(y.shape[1:]) - 1) / 2
    row, column, turn = moves.T[..., None]
    row, column = y.shape[1] // 2 - middle[0] - row, np.arange(y.shape[2]) - middle[1] - column
    c, s = np.cos(turn), np.sin(turn)
    places = c * row - s * column + middle[0], c * column + s * row + middle[1]
    views = np.broadcast_to(np.arange(len(y))[:, None], places[0].shape)
    return "motion", y[:, y.shape[1] // 2], map_coordinates(y, (views, *places), order=1, mode="nearest")
