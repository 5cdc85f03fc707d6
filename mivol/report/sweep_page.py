"""The page of a sweep: a table of all runs with links to their pages, and each result against the swept settings.

Conventions. A result is drawn against each setting with at least two numbers as values. A point is a run; the line is the mean
over the other settings. The page is one file and loads nothing.
"""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import jinja2
import matplotlib as mpl
from matplotlib.figure import Figure

from mivol.files import write_whole_text
from mivol.report.figures import CSS, SERIES, STYLE, empty_figure, inline_svg
from mivol.report.record import QUANTITIES, Quantity

PAGE = "sweep.html"

NOT_DRAWN = ("iterations", "views")
"""Results that are settings or counts."""


@dataclass(frozen=True)
class SweepRow:
    """A run of a sweep.

    Attributes:
        name: name of its folder.
        values: swept values by setting, as text.
        status: "waiting", "finished", "stopped", "running" or "refused".
        reason: of a refusal.
        results: numbers of its record.
        units: unit of each result.
    """

    name: str
    values: dict[str, str]
    status: str = "waiting"
    reason: str = ""
    results: dict[str, float | None] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)


def write_sweep_page(folder: Path, title: str, keys: Sequence[str], rows: Sequence[SweepRow]) -> Path:
    """Write ``sweep.html``.

    Args:
        folder: folder of the sweep.
        title: heading.
        keys: swept settings.
        rows: all runs.

    Returns:
        Path of the page.
    """
    units = {name: unit for row in rows for name, unit in row.units.items()}
    results = list(dict.fromkeys(name for row in rows for name in row.results))
    columns = [_describe(name, units) for name in results]
    cells = [[_format(row.results.get(name)) for name in results] for row in rows]
    ended = sum(row.status in ("finished", "refused") for row in rows)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("mivol.report", "."), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    facts = {
        "title": title, "keys": keys, "columns": columns, "rows": list(zip(rows, cells, strict=True)), "ended": ended,
        "figures": draw_results(keys, results, rows, units), "theme": CSS,
    }  # fmt: skip
    write_whole_text(folder / PAGE, environment.get_template("sweep.html.jinja").render(facts))
    return folder / PAGE


def _describe(name: str, units: dict[str, str]) -> str:
    """Label and unit of a result."""
    label = QUANTITIES.get(name, Quantity(name.replace("_", " "))).label
    return f"{label} [{units[name]}]" if units.get(name, "").strip("[]1") else label


def _format(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"


def draw_results(keys: Sequence[str], results: Sequence[str], rows: Sequence[SweepRow], units: dict[str, str]) -> list[str]:
    """Each result against each setting of at least two numbers, as inline SVG; seeds only if nothing else is swept."""
    figures = []
    drawn = [key for key in keys if key.rpartition(".")[2] != "seed"] or keys
    for name in (name for name in results if name not in NOT_DRAWN):
        for key in drawn:
            points = defaultdict(list)
            for row in (row for row in rows if row.results.get(name) is not None):
                with suppress(ValueError):
                    points[float(row.values[key])] += [row.results[name]]
            if len(points) > 1:
                label = f"{_describe(name, units)} against {key}"
                figures.append(inline_svg(plot_points(points, key, _describe(name, units)), label))
    return figures


def plot_points(points: dict[float, list[float]], key: str, title: str) -> Figure:
    """Points of all runs, and the line of their means."""
    with mpl.rc_context(STYLE):
        figure = empty_figure(4.4, 2.75)
        axes = figure.subplots()
        x = sorted(points)
        axes.plot(x, [statistics.fmean(points[value]) for value in x], color=SERIES[0])
        pairs = [(value, result) for value in x for result in points[value]]
        axes.plot(*zip(*pairs, strict=True), "o", color=SERIES[0], markersize=4, alpha=0.6, clip_on=False)
        axes.set_title(title)
        axes.set_xlabel(key)
        if min(x) > 0 and max(x) / min(x) >= 8:
            axes.set_xscale("log", base=2)
            axes.set_xticks(x, [f"{value:g}" for value in x])
        axes.margins(x=0.03, y=0.12)
    return figure
