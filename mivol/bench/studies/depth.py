"""How much scattered light is missing if light may scatter only once (max_depth 2)?

    mivol bench depth              # about 4 minutes on 2 cores
    mivol bench depth --quick      # 20 seconds: fewer lines, three optical depths

A unit cube stands in constant light or in a beam along -z. Its medium is homogeneous, and isotropic or forward-scattering
(Henyey-Greenstein, g = 0.8). Mitsuba's ``volpath`` with ``hide_emitters`` traces lines through the cube, evenly over all places
and directions, and returns the scattered radiance: S2 with ``max_depth`` 2, S without a limit. The study reports the missing
share at depth 2, e = 1 - S2 / S, with its standard error. Both renders use the same random numbers, so common noise cancels.
Optical depth is E[tau^2] / E[tau] over the same lines; mivol/scene/depth_two.py explains why. The JSON also holds the table as
source text for this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from matplotlib import colormaps

from mivol.bench.harness.figures import new_figure
from mivol.bench.harness.study import AT_MOST, Bar, Size, Study, SweptQuestion, amount, judge, say_row
from mivol.scene.depth_two import ALBEDOS, TAUS, depth_two_error, sample_lines
from mivol.transport.traversal.box import Box

LIGHTS = {
    "constant": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}},
    "collimated": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "uniform", "value": 1.0}},
}
PHASES = {"isotropic": {"type": "isotropic"}, "forward": {"type": "hg", "g": 0.8}}
TABLES = [(light, phase) for light in LIGHTS for phase in PHASES]

CUBE_DEPTH = 0.8966336
"""E[l^2] / E[l] of lines through the unit cube, = 8 int prod(1 - u_i) / |u|^2 du / (2 pi) over [0, 1]^3, by quadrature."""

QUICK_LINES = 1 << 14


@dataclass(frozen=True)
class DepthSize(Size):
    """Amount of work."""

    lines: int = amount(1 << 18, QUICK_LINES, "lines for each cell of the table")
    taus: tuple[float, ...] = amount(TAUS, (0.1, 1.0, 10.0), "optical depths")


def make_cube(light: str, phase: str, albedo: float, sigma_t: float) -> mi.Scene:
    """The unit cube of a homogeneous medium in a light."""
    medium = {"type": "homogeneous", "sigma_t": sigma_t, "albedo": albedo, "phase": PHASES[phase]}
    place = mi.ScalarTransform4f().translate(0.5).scale(0.5)
    cube = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}
    return mi.load_dict({"type": "scene", "light": LIGHTS[light], "cube": cube})


def trace_lines(scene: mi.Scene, max_depth: int, n: int, seed: int) -> np.ndarray:
    """Scattered radiance along n lines (n,). Russian roulette starts late, because the added noise outweighs the saved time."""
    tracer = mi.load_dict({"type": "volpath", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True})
    o, d, _ = sample_lines(Box(np.eye(4)), n, seed)
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray((o - d).T, np.float32)), mi.Vector3f(np.ascontiguousarray(d.T, np.float32)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    radiance, _, _ = tracer.sample(scene, sampler, mi.RayDifferential3f(ray), None, True)
    return np.asarray(radiance.x, dtype=np.float64)


def missing_share(once: np.ndarray, every: np.ndarray) -> tuple[float, float]:
    """1 - mean(once) / mean(every) of paired samples, and its standard error by the delta method."""
    ratio = once.mean() / every.mean()
    return float(1 - ratio), float((once - ratio * every).std() / every.mean() / np.sqrt(len(once)))


def measure_cell(light: str, phase: str, albedo: float, tau: float, n: int, seed: int = 0) -> dict:
    """Measure one cell of the table from n lines."""
    scene = make_cube(light, phase, albedo, tau / CUBE_DEPTH)
    once, every = (trace_lines(scene, limit, n, seed) for limit in (2, -1))
    error, standard_error = missing_share(once, every)
    say_row(f"{light}, {phase}, albedo {albedo:g}, tau {tau:g}", error=error, standard_error=standard_error)
    return {
        **{"medium": "cube", "light": light, "phase": phase, "albedo": albedo, "tau": tau},
        **{"once": once.mean(), "all": every.mean(), "error": error, "standard_error": standard_error},
    }


def join_cells(size: DepthSize, found: dict[tuple, dict]) -> dict:
    """The whole table."""
    cells = list(found.values())
    return {"lines": size.lines, "cells": cells, "as the module holds it": table_source(cells) if size.taus == TAUS else []}


measure_table = SweptQuestion(
    "Which share is missing at depth 2, e = 1 - S2 / S, by light, phase function, albedo and optical depth?",
    lambda size: [(*table, albedo, tau) for table in TABLES for tau in size.taus for albedo in ALBEDOS],
    lambda cell, size: measure_cell(*cell, size.lines),
    join_cells,
)


def cells_of(cells: list[dict], light: str, phase: str) -> dict[tuple[float, float], dict]:
    """Cells of one table by albedo and optical depth."""
    return {(c["albedo"], c["tau"]): c for c in cells if (c["light"], c["phase"]) == (light, phase)}


def table_source(cells: list[dict]) -> list[str]:
    """Lines of the table in mivol/scene/depth_two.py."""
    lines = []
    for table in TABLES:
        chosen = cells_of(cells, *table)
        rows = [", ".join(f"{chosen[albedo, tau]['error']:.3f}" for tau in TAUS) for albedo in ALBEDOS]
        lines += ['    ("{}", "{}"): np.array('.format(*table), "        [", *(f"            [{row}]," for row in rows)]
        lines += ["        ]", "    ),"]
    return lines


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the noise of the table, and the distance of mivol's table from the measurement."""
    # 5e-4 is the rounding of the table. Its own noise equals the noise of a measurement with as many lines.
    gaps = [
        (abs(c["error"] - depth_two_error(c["albedo"], c["tau"], c["light"], c["phase"])) - 5e-4) / c["standard_error"]
        for c in answer["cells"]
    ]
    bar = 0.04 * (QUICK_LINES / answer["lines"]) ** 0.5
    return [
        judge("largest standard error", max(c["standard_error"] for c in answer["cells"]), AT_MOST, bar),
        judge("largest distance from mivol's table [standard errors]", max(gaps), AT_MOST, 5.0),
    ]


def draw(answers: dict, path: Path) -> None:
    """A panel for each light and phase function, with a line for each albedo."""
    with new_figure(path, 10, 8) as figure:
        panels = figure.subplots(2, 2, sharex=True, sharey=True)
        for axes, (light, phase) in zip(panels.ravel(), TABLES, strict=True):
            chosen = cells_of(answers["table"]["cells"], light, phase).values()
            for albedo, colour in zip(ALBEDOS, colormaps["viridis"](np.linspace(0, 0.92, len(ALBEDOS))), strict=True):
                x, y, e = zip(
                    *((c["tau"], c["error"], c["standard_error"]) for c in chosen if c["albedo"] == albedo), strict=True
                )
                axes.errorbar(x, y, yerr=e, fmt="o-", color=colour, ms=3.5, lw=1.2, label=f"albedo {albedo:g}")
            axes.set(title=f"{light} light, {phase}", xscale="log", ylim=(0, 1))
        panels[0, 0].legend(fontsize=8)
        for axes in panels[1]:
            axes.set_xlabel("optical depth as scattered light sees it [1]")
        for axes in panels[:, 0]:
            axes.set_ylabel("share of scattered light left out by depth 2 [1]")


STUDY = Study(__name__, __doc__, DepthSize, {"table": measure_table}, compare, draw)
