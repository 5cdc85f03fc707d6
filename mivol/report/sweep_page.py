"""The page of a sweep: a table of all runs with links to their pages, and each result against the swept settings.

Conventions. A result is drawn against each setting with at least two numbers as values. A point is a run; the line is the mean
over the other settings. The page is one file and loads nothing; while runs are under way, a browser reads it again every few
seconds. The views of a reference on a cluster have the same page, a view in place of a run.
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
from mivol.report.record import QUANTITIES, Quantity, Table

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
        reason: of a refusal; progress of a running run.
        results: numbers of its record.
        units: unit of each result.
    """

    name: str
    values: dict[str, str]
    status: str = "waiting"
    reason: str = ""
    results: dict[str, float | None] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SweepNews:
    """How the work proceeds: what the page shows beside the runs.

    Attributes:
        progress: of the runs under way, by name.
        lines: sentences about workers.
        workers: table of workers; None without a cluster.
        is_running: whether work is under way.
    """

    progress: dict[str, str] = field(default_factory=dict)
    lines: tuple[str, ...] = ()
    workers: Table | None = None
    is_running: bool = False


def write_sweep_page(
    folder: Path, title: str, keys: Sequence[str], rows: Sequence[SweepRow], news: SweepNews | None = None, name: str = PAGE
) -> Path:
    """Write ``sweep.html``.

    Args:
        folder: folder of the sweep.
        title: heading.
        keys: swept settings.
        rows: all runs.
        news: how the work proceeds; None: no work is under way.
        name: of the page; the noun of its rows is "run" for a sweep, otherwise "view".

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
        "figures": draw_results(keys, results, rows, units), "theme": CSS, "news": news or SweepNews(),
        "noun": "run" if name == PAGE else "view",
    }  # fmt: skip
    write_whole_text(folder / name, environment.get_template("sweep.html.jinja").render(facts))
    return folder / name


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
