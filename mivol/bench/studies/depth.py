"""How much of the light that a medium scatters is missing where it may scatter once only (max_depth 2)?

    scripts/bench_depth.py              # about 4 minutes on 2 cores
    scripts/bench_depth.py --quick      # 20 seconds: fewer lines, three optical depths

A unit cube stands in constant light or in a beam along -z, homogeneous, isotropic or forward-scattering (Henyey and
Greenstein, g = 0.8). Mitsuba's ``volpath`` with ``hide_emitters`` follows lines that cross it, spread evenly over all
places and directions, and returns the radiance that was scattered towards the eye: S2 with max_depth 2, S without a limit.
Printed is what depth 2 leaves out, e = 1 - S2 / S, with its standard error; both see the same random numbers, so that what
they share cancels. Optical depth is E[tau^2] / E[tau] over the same lines (mivol/scene/depth_two.py says why).

Beside the table, to see where it holds: the smoke of the Mitsuba tutorial (or a made-up one, and the JSON says so) in both
lights, and the cube below a point light one edge above its top. Prints JSON, with the table as mivol/scene/depth_two.py
holds it; writes bench_depth.json and bench_depth.png.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from mivol.bench.extinctions import smoke
from mivol.bench.harness.bars import AT_MOST, Bar, judge, say
from mivol.bench.harness.figures import drawn
from mivol.bench.harness.study import Bench
from mivol.scene.depth_two import ALBEDOS, TAUS, depth_two_error, draw_lines, scattering_depth
from mivol.transport.media.medium_view import view_medium
from mivol.transport.traversal.box import Box

__all__ = ["BENCH", "FULL", "QUICK", "Cell", "Size", "Subject", "left_out", "main", "measure", "table_lines", "tabled_cube"]

LIGHTS = {
    "constant": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}},
    "collimated": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "uniform", "value": 1.0}},
    "point": {"type": "point", "position": [0.5, 0.5, 2.0], "intensity": {"type": "uniform", "value": 1.0}},
}
PHASES = {"isotropic": {"type": "isotropic"}, "forward": {"type": "hg", "g": 0.8}}
TABLED = [(light, phase) for light in ("constant", "collimated") for phase in PHASES]
BESIDE = {"smoke": ("constant", "collimated"), "cube": ("point",)}
"""Media and lights that are measured beside the table, with isotropic scattering and two albedos."""
BESIDE_ALBEDOS = (0.5, 0.9)

MARKS = {("smoke", "constant"): "^", ("smoke", "collimated"): "^", ("cube", "point"): "s"}
"""In the figure, of those."""

UNIT = Box(np.eye(4))
CUBE_DEPTH = 0.8966336
"""E[l^2] / E[l] of lines through the unit cube, = 8 int prod(1 - u_i) / |u|^2 du / (2 pi) over [0, 1]^3, by quadrature."""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes:
        name: for the JSON.
        lines: for each cell of the table; media beside it get an eighth of them.
        taus: optical depths.
    """

    name: str = "full"
    lines: int = 1 << 18
    taus: tuple[float, ...] = TAUS


FULL = Size()
QUICK = Size("quick", 1 << 14, (0.1, 1.0, 10.0))
SEED = 0


@dataclass(frozen=True)
class Cell:
    """One measurement: what depth 2 leaves out of the scattered light, and its standard error."""

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


# -- Scenes ---------------------------------------------------------------------------------------------------------------


def cube(light: str, phase: str = "isotropic", values: np.ndarray | None = None) -> mi.Scene:
    """The unit cube in that light, with a homogeneous medium of extinction 1 or with a grid (Z, Y, X)."""
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


def fill(scene: mi.Scene, albedo: float, scale: float) -> None:
    """Give the medium an albedo, and its extinction a factor."""
    params = mi.traverse(scene)
    for key in params.properties:
        if key.startswith("cube.interior_medium.albedo."):
            params[key] = dr.opaque(mi.Float, albedo)
    params["cube.interior_medium.scale"] = scale
    params.update()


# -- Measurements ----------------------------------------------------------------------------------------------------------


def scattered(scene: mi.Scene, max_depth: int, n: int, seed: int) -> np.ndarray:
    """Scattered radiance along n lines (n,). Roulette starts late: it adds more noise than it saves time."""
    tracer = mi.load_dict({"type": "volpath", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True})
    o, d, _ = draw_lines(UNIT, n, seed)
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray((o - d).T, np.float32)), mi.Vector3f(np.ascontiguousarray(d.T, np.float32)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    radiance, _, _ = tracer.sample(scene, sampler, mi.RayDifferential3f(ray), None, True)
    return np.asarray(radiance.x, dtype=np.float64)


def left_out(once: np.ndarray, every: np.ndarray) -> tuple[float, float]:
    """1 - mean(once) / mean(every) of paired samples, and its standard error by the delta method."""
    ratio = once.mean() / every.mean()
    return float(1 - ratio), float((once - ratio * every).std() / every.mean() / np.sqrt(len(once)))


class Subject(NamedTuple):
    """A medium in a light.

    Attributes:
        scene: of :func:`cube`.
        medium, light, phase: what they are called.
        depth: optical depth of the medium with the factor 1.
    """

    scene: mi.Scene
    medium: str
    light: str
    phase: str
    depth: float


def measure(subject: Subject, albedo: float, tau: float, n: int, seed: int = SEED) -> Cell:
    """One cell, from n lines, with the medium scaled to the optical depth tau."""
    start = time.perf_counter()
    fill(subject.scene, albedo, tau / subject.depth)
    once, every = (scattered(subject.scene, limit, n, seed) for limit in (2, -1))
    seconds = round(time.perf_counter() - start, 2)
    names = subject.medium, subject.light, subject.phase
    return Cell(*names, albedo, tau, once.mean(), every.mean(), *left_out(once, every), seconds)


def tabled_cube(light: str, phase: str) -> Subject:
    """The homogeneous cube of the table."""
    return Subject(cube(light, phase), "cube", light, phase, CUBE_DEPTH)


def measure_table(size: Size) -> Iterator[Cell]:
    """The cells of the table."""
    for light, phase in TABLED:
        subject = tabled_cube(light, phase)
        for tau in size.taus:
            for albedo in ALBEDOS:
                yield measure(subject, albedo, tau, size.lines)


def measure_beside(size: Size) -> Iterator[Cell]:
    """Cells of other media and lights, with isotropic scattering."""
    for medium, lights in BESIDE.items():
        values = smoke().values if medium == "smoke" else None
        for light in lights:
            scene = cube(light, values=values)
            depth = scattering_depth(view_medium(scene.shapes()[0].interior_medium(), UNIT), UNIT)
            for tau in size.taus:
                for albedo in BESIDE_ALBEDOS:
                    yield measure(Subject(scene, medium, light, "isotropic", depth), albedo, tau, size.lines // 8)


def said(cells: Iterator[Cell]) -> Iterator[Cell]:
    """Cells, each said as it comes."""
    for c in cells:
        place = f"{c.medium}, {c.light} light, {c.phase}, albedo {c.albedo:g}, tau {c.tau:g}"
        say(f"  {place}: {c.error:.4f} +- {c.standard_error:.4f} in {c.seconds} s")
        yield c


def ask_table(size: Size) -> dict:
    """What does depth 2 leave out, e = 1 - S2 / S, by light, phase function, albedo and optical depth?"""
    cells = list(said(measure_table(size)))
    lines = table_lines(cells) if size.taus == TAUS else []
    return {"lines": size.lines, "cells": [asdict(c) for c in cells], "as the module holds it": lines}


def ask_beside(size: Size) -> dict:
    """Does the table hold for clumps and for a point light?"""
    return {"smoke": str(smoke()), "cells": [asdict(c) for c in said(measure_beside(size))]}


QUESTIONS = {"table": ask_table, "beside": ask_beside}


# -- What is shown ---------------------------------------------------------------------------------------------------------


def draw(answers: dict, folder: Path) -> None:
    """Lines of the cube by albedo, marks of what was measured beside it; a panel for each light and phase function."""
    cells = [Cell(**c) for answer in answers.values() for c in answer["cells"]]
    with drawn(folder / "bench_depth.png", 10, 8) as figure:
        panels = figure.subplots(2, 2, sharex=True, sharey=True)
        for axes, key in zip(panels.ravel(), TABLED, strict=True):
            draw_table(axes, cells, *key)
        for marker, label in (("^", "smoke"), ("s", "cube, point light")):
            panels[0, 0].plot([], [], marker, color="gray", mfc="none", ms=8, label=label)
        panels[0, 0].legend(fontsize=8)
        for axes in panels[1]:
            axes.set_xlabel("optical depth as scattered light sees it [1]")
        for axes in panels[:, 0]:
            axes.set_ylabel("share of scattered light left out by depth 2 [1]")


def draw_table(axes: Axes, cells: list[Cell], light: str, phase: str) -> None:
    """What the cube leaves out in one light, a line for each albedo, and marks of what is compared with it."""
    for albedo, colour in zip(ALBEDOS, colormaps["viridis"](np.linspace(0, 0.92, len(ALBEDOS))), strict=True):
        line = [c for c in cells if (c.medium, c.light, c.phase, c.albedo) == ("cube", light, phase, albedo)]
        columns = [[getattr(c, name) for c in line] for name in ("tau", "error", "standard_error")]
        axes.errorbar(*columns[:2], yerr=columns[2], fmt="o-", color=colour, ms=3.5, lw=1.2, label=f"albedo {albedo:g}")
        for c in cells:
            if (c.medium, c.light) in MARKS and (light, phase) == tabled(c) and c.albedo == albedo:
                axes.plot(c.tau, c.error, MARKS[c.medium, c.light], color=colour, mfc="none", ms=8)
    axes.set(title=f"{light} light, {phase}", xscale="log", ylim=(0, 1))


def tabled(cell: Cell) -> tuple[str, str]:
    """The table that a cell is compared with: emitters count as collimated."""
    return "constant" if cell.light == "constant" else "collimated", cell.phase


def table_lines(cells: list[Cell]) -> list[str]:
    """The lines of mivol/scene/depth_two.py that hold the table."""
    lines = []
    for light, phase in TABLED:
        found = {(c.albedo, c.tau): c.error for c in cells if (c.light, c.phase) == (light, phase)}
        rows = [", ".join(f"{found[albedo, tau]:.3f}" for tau in TAUS) for albedo in ALBEDOS]
        lines += [f'    ("{light}", "{phase}"): np.array(', "        [", *(f"            [{row}]," for row in rows)]
        lines += ["        ]", "    ),"]
    return lines


def compare(question: str, answer: dict) -> list[Bar]:
    """How sure the table is, how far mivol's is from what was measured now, and how far other media are from it."""
    cells = [Cell(**c) for c in answer["cells"]]
    gaps = [c.error - depth_two_error(c.albedo, c.tau, *tabled(c)) for c in cells]
    if question == "beside":
        return [judge("largest distance from the table", max(map(abs, gaps)), AT_MOST, 0.2)]
    # Half a digit of rounding, and the table's own error: at the lines it was made with, that of this measurement.
    errors = [(abs(gap) - 5e-4) / c.standard_error for c, gap in zip(cells, gaps, strict=True)]
    bar = 0.04 * (QUICK.lines / answer["lines"]) ** 0.5
    return [
        judge("largest standard error", max(c.standard_error for c in cells), AT_MOST, bar),
        judge("largest distance from mivol's table [standard errors]", max(errors), AT_MOST, 5.0),
    ]


BENCH = Bench("bench_depth", __doc__, QUESTIONS, FULL, QUICK, compare, draw)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the bench with these arguments (by default the process's own); its exit code."""
    return BENCH.run(argv)
