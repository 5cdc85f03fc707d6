"""How much scattered light is missing if light may scatter only once (max_depth 2)?

    mivol bench depth              # about 4 minutes on 2 cores
    mivol bench depth --quick      # 20 seconds: fewer lines, three optical depths

A unit cube stands in constant light or in a beam along -z. Its medium is homogeneous, and isotropic or forward-scattering
(Henyey-Greenstein, g = 0.8). Mitsuba's ``volpath`` with ``hide_emitters`` traces lines through the cube, evenly over all places
and directions, and returns the scattered radiance: S2 with ``max_depth`` 2, S without a limit. The study reports the missing
share at depth 2, e = 1 - S2 / S, with its standard error. Both renders use the same random numbers, so common noise cancels.
Optical depth is E[tau^2] / E[tau] over the same lines; mivol/scene/depth_two.py explains why.

Question ``beside`` tests the table elsewhere: in the smoke of the Mitsuba tutorial (or a made-up smoke, and the JSON records
this) in both lights, and in the cube below a point light one edge above its top. The JSON also holds the table as source text
for mivol/scene/depth_two.py.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from mivol.bench.extinctions import smoke
from mivol.bench.harness.bars import AT_MOST, Bar, judge, say_row
from mivol.bench.harness.figures import new_figure
from mivol.bench.harness.study import Size, Study, amount
from mivol.scene.depth_two import ALBEDOS, TAUS, depth_two_error, sample_lines, scattering_depth
from mivol.transport.media.medium_view import view_medium
from mivol.transport.traversal.box import Box

__all__ = ["STUDY", "Cell", "DepthSize", "Subject", "measure_cell", "missing_share", "table_cube", "table_source"]

LIGHTS = {
    "constant": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}},
    "collimated": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "uniform", "value": 1.0}},
    "point": {"type": "point", "position": [0.5, 0.5, 2.0], "intensity": {"type": "uniform", "value": 1.0}},
}
PHASES = {"isotropic": {"type": "isotropic"}, "forward": {"type": "hg", "g": 0.8}}
TABLES = [(light, phase) for light in ("constant", "collimated") for phase in PHASES]
BESIDE = (("smoke", "constant"), ("smoke", "collimated"), ("cube", "point"))
"""Media and lights beside the table, with isotropic scattering and two albedos."""
BESIDE_ALBEDOS = (0.5, 0.9)

MARKERS = {("smoke", "constant"): "^", ("smoke", "collimated"): "^", ("cube", "point"): "s"}
"""Markers of these in the figure."""

UNIT_BOX = Box(np.eye(4))
CUBE_DEPTH = 0.8966336
"""E[l^2] / E[l] of lines through the unit cube, = 8 int prod(1 - u_i) / |u|^2 du / (2 pi) over [0, 1]^3, by quadrature."""

QUICK_LINES = 1 << 14


@dataclass(frozen=True)
class DepthSize(Size):
    """Amount of work."""

    lines: int = amount(1 << 18, QUICK_LINES, "lines for each cell of the table; media beside the table get an eighth")
    taus: tuple[float, ...] = amount(TAUS, (0.1, 1.0, 10.0), "optical depths")


@dataclass(frozen=True)
class Cell:
    """One measurement: radiance at depth 2 and without limit, the missing share, and its standard error."""

    medium: str
    light: str
    phase: str
    albedo: float
    tau: float
    once: float
    all: float
    error: float
    standard_error: float
    seconds: float

    @property
    def table(self) -> tuple[str, str]:
        """Light and phase function of the table for this cell; emitters count as collimated."""
        return "constant" if self.light == "constant" else "collimated", self.phase


class Subject(NamedTuple):
    """A medium in a light.

    Attributes:
        scene: scene of :func:`make_cube`.
        medium, light, phase: their names.
        depth: optical depth of the medium at scale 1.
    """

    scene: mi.Scene
    medium: str
    light: str
    phase: str
    depth: float


# -- Measurement ------------------------------------------------------------------------------------------------------------


def make_cube(light: str, phase: str = "isotropic", values: np.ndarray | None = None) -> mi.Scene:
    """The unit cube in a light, with a homogeneous medium of extinction 1 or with a grid (Z, Y, X)."""
    medium = {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.5}
    if values is not None:
        grid = mi.VolumeGrid(values)
        medium |= {"type": "heterogeneous", "sigma_t": {"type": "gridvolume", "grid": grid, "raw": True}}
    boundary = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate(0.5).scale(0.5),
        "bsdf": {"type": "null"},
        "interior": {**medium, "phase": PHASES[phase]},
    }
    return mi.load_dict({"type": "scene", "light": LIGHTS[light], "cube": boundary})


def set_medium(scene: mi.Scene, albedo: float, scale: float) -> None:
    """Set the albedo of the medium and the scale of its extinction."""
    params = mi.traverse(scene)
    for key in params.properties:
        if key.startswith("cube.interior_medium.albedo."):
            params[key] = dr.opaque(mi.Float, albedo)
    params["cube.interior_medium.scale"] = scale
    params.update()


def trace_lines(scene: mi.Scene, max_depth: int, n: int, seed: int) -> np.ndarray:
    """Scattered radiance along n lines (n,). Russian roulette starts late, because the added noise outweighs the saved time."""
    tracer = mi.load_dict({"type": "volpath", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True})
    o, d, _ = sample_lines(UNIT_BOX, n, seed)
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray((o - d).T, np.float32)), mi.Vector3f(np.ascontiguousarray(d.T, np.float32)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    radiance, _, _ = tracer.sample(scene, sampler, mi.RayDifferential3f(ray), None, True)
    return np.asarray(radiance.x, dtype=np.float64)


def missing_share(once: np.ndarray, every: np.ndarray) -> tuple[float, float]:
    """1 - mean(once) / mean(every) of paired samples, and its standard error by the delta method."""
    ratio = once.mean() / every.mean()
    return float(1 - ratio), float((once - ratio * every).std() / every.mean() / np.sqrt(len(once)))


def measure_cell(subject: Subject, albedo: float, tau: float, n: int, seed: int = 0) -> Cell:
    """Measure one cell from n lines, with the medium scaled to the optical depth tau."""
    start = time.perf_counter()
    set_medium(subject.scene, albedo, tau / subject.depth)
    once, every = (trace_lines(subject.scene, limit, n, seed) for limit in (2, -1))
    seconds = round(time.perf_counter() - start, 2)
    names = subject.medium, subject.light, subject.phase
    cell = Cell(*names, albedo, tau, once.mean(), every.mean(), *missing_share(once, every), seconds)
    say_row(f"{', '.join(names)}, albedo {albedo:g}, tau {tau:g}", error=cell.error, standard_error=cell.standard_error)
    return cell


def table_cube(light: str, phase: str) -> Subject:
    """The homogeneous cube of the table."""
    return Subject(make_cube(light, phase), "cube", light, phase, CUBE_DEPTH)


def subjects_beside() -> Iterator[Subject]:
    """Other media and lights, with isotropic scattering."""
    for medium, light in BESIDE:
        scene = make_cube(light, values=smoke().values if medium == "smoke" else None)
        depth = scattering_depth(view_medium(scene.shapes()[0].interior_medium(), UNIT_BOX), UNIT_BOX)
        yield Subject(scene, medium, light, "isotropic", depth)


def measure_table(size: DepthSize) -> dict:
    """Which share is missing at depth 2, e = 1 - S2 / S, by light, phase function, albedo and optical depth?"""
    subjects = [table_cube(light, phase) for light, phase in TABLES]
    cells = [measure_cell(s, albedo, tau, size.lines) for s in subjects for tau in size.taus for albedo in ALBEDOS]
    source = table_source(cells) if size.taus == TAUS else []
    return {"lines": size.lines, "cells": [asdict(c) for c in cells], "as the module holds it": source}


def measure_beside(size: DepthSize) -> dict:
    """Does the table hold for clumps and for a point light?"""
    cells = [
        measure_cell(s, albedo, tau, size.lines // 8)
        for s in subjects_beside()
        for tau in size.taus
        for albedo in BESIDE_ALBEDOS
    ]
    return {"smoke": str(smoke()), "cells": [asdict(c) for c in cells]}


def table_source(cells: list[Cell]) -> list[str]:
    """Lines of the table in mivol/scene/depth_two.py."""
    lines = []
    for light, phase in TABLES:
        errors = {(c.albedo, c.tau): c.error for c in cells if (c.light, c.phase) == (light, phase)}
        rows = [", ".join(f"{errors[albedo, tau]:.3f}" for tau in TAUS) for albedo in ALBEDOS]
        lines += [f'    ("{light}", "{phase}"): np.array(', "        [", *(f"            [{row}]," for row in rows)]
        lines += ["        ]", "    ),"]
    return lines


# -- Bars and figure --------------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the noise of the table, the distance of mivol's table from the measurement, and the distance of other media."""
    cells = [Cell(**c) for c in answer["cells"]]
    gaps = [c.error - depth_two_error(c.albedo, c.tau, *c.table) for c in cells]
    if question == "beside":
        return [judge("largest distance from the table", max(map(abs, gaps)), AT_MOST, 0.2)]
    # 5e-4 is the rounding of the table. Its own noise equals the noise of a measurement with as many lines.
    errors = [(abs(gap) - 5e-4) / c.standard_error for c, gap in zip(cells, gaps, strict=True)]
    bar = 0.04 * (QUICK_LINES / answer["lines"]) ** 0.5
    return [
        judge("largest standard error", max(c.standard_error for c in cells), AT_MOST, bar),
        judge("largest distance from mivol's table [standard errors]", max(errors), AT_MOST, 5.0),
    ]


def draw(answers: dict, path: Path) -> None:
    """Plot the cube as lines and other media as markers, in a panel for each light and phase function."""
    cells = [Cell(**c) for answer in answers.values() for c in answer["cells"]]
    with new_figure(path, 10, 8) as figure:
        panels = figure.subplots(2, 2, sharex=True, sharey=True)
        for axes, table in zip(panels.ravel(), TABLES, strict=True):
            plot_table(axes, cells, *table)
        for marker, label in (("^", "smoke"), ("s", "cube, point light")):
            panels[0, 0].plot([], [], marker, color="gray", mfc="none", ms=8, label=label)
        panels[0, 0].legend(fontsize=8)
        for axes in panels[1]:
            axes.set_xlabel("optical depth as scattered light sees it [1]")
        for axes in panels[:, 0]:
            axes.set_ylabel("share of scattered light left out by depth 2 [1]")


def plot_table(axes: Axes, cells: list[Cell], light: str, phase: str) -> None:
    """Plot one table: a line for each albedo of the cube, and markers for the media compared with it."""
    for albedo, colour in zip(ALBEDOS, colormaps["viridis"](np.linspace(0, 0.92, len(ALBEDOS))), strict=True):
        line = [c for c in cells if (c.medium, c.light, c.phase, c.albedo) == ("cube", light, phase, albedo)]
        columns = [[getattr(c, name) for c in line] for name in ("tau", "error", "standard_error")]
        axes.errorbar(*columns[:2], yerr=columns[2], fmt="o-", color=colour, ms=3.5, lw=1.2, label=f"albedo {albedo:g}")
        for c in cells:
            if (c.medium, c.light) in MARKERS and (light, phase) == c.table and c.albedo == albedo:
                axes.plot(c.tau, c.error, MARKERS[c.medium, c.light], color=colour, mfc="none", ms=8)
    axes.set(title=f"{light} light, {phase}", xscale="log", ylim=(0, 1))


STUDY = Study(__name__, __doc__, DepthSize, {"table": measure_table, "beside": measure_beside}, compare, draw)
