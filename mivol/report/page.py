"""The report page of a run folder, and the page of a sweep.

Conventions. :func:`write_page` reads a run folder (:mod:`mivol.report.record`) and writes ``report.html`` into it. A page
is one file and loads nothing: styles and curves are inline, images are ``data:`` addresses. All images of a kind share one
scale, printed beside the images. The same folder always gives the same bytes. Sections without data are left out.

A sweep has a table of all runs with links to their pages. A result is drawn against each setting with at least two numbers as
values: a point is a run, the line is the mean over the other settings. While runs are under way, a browser reads the page
again every few seconds. The views of a reference on a cluster have the same page, a view in place of a run.
"""

from __future__ import annotations

import math
import re
import statistics
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from mivol.cite import list_citations
from mivol.display import format_duration, to_toml
from mivol.errors import MivolError
from mivol.files import write_whole_text
from mivol.report import figures
from mivol.report.figures import CSS, SERIES, STYLE, draw_profiles, empty_figure, inline_svg
from mivol.report.page_images import Z_IMAGE, ViewRow, VolumeView, encode_film, encode_image, make_view_rows, make_volume_views
from mivol.report.record import (
    CODES,
    LINES,
    QUANTITIES,
    SINOGRAM,
    Quantity,
    RunRecord,
    Table,
    find_quantity,
    join_channels,
    read_metrics,
    read_record,
)

PAGE = "report.html"
SHOWN_VIEWS = 4
"""Views visible at once; the page folds the others."""

PHOTOGRAPHS = "photos"
"""Table of the settings of a fit to photographs: its page begins with the film, and its volumes are the last figures."""

VERDICTS = {"finished": "Reconstructed in", "stopped": "Stopped after", "running": "Still running after"}


def write_page(folder: str | Path) -> Path:
    """Write ``report.html`` from the record, the metrics, the images and the volumes of a run.

    Args:
        folder: run folder; the page of an unfinished run shows the results so far.

    Returns:
        Path of the page.

    Raises:
        MivolError: no record, a missing or unreadable file of the record, different sizes of images of a view, or an
            unknown citation key.
    """
    folder = Path(folder)
    record, rows = read_record(folder), read_metrics(folder)
    _check_present(folder, record)
    sinograms = [image for image in record.images if image.view == SINOGRAM]
    groups = make_view_rows(folder, [image for image in record.images if image.view != SINOGRAM])
    volumes = make_volume_views(folder, record.volumes)
    facts = {
        "record": record,
        "headline": headline(record, _held_out_psnr(record, groups.rows)),
        "numbers": _numbers(record, groups.rows, volumes),
        "sinograms": make_view_rows(folder, sinograms),
        "are_lines": any(image.quantity == LINES for image in record.images),
        "has_z": any(picture.name == Z_IMAGE for row in groups.rows for picture in row.pictures),
        "are_codes": any(image.quantity == CODES for image in record.images),
        "views": groups,
        "shown": SHOWN_VIEWS,
        "volumes": volumes,
        "of_photographs": PHOTOGRAPHS in record.config,
        "profiles": draw_profiles(folder, record.volumes),
        "curves": _curves(rows, record.units),
        "timings": _timings(record.timings),
        "films": [encode_film(folder, image) for image in record.images if image.role == "film"],
        "others": [encode_image(folder, image) for image in record.images if image.role in ("slice", "picture")],
        "config": _toml(record.config),
        "citations": list_citations(record.citations),
        "theme": figures.CSS,
    }
    template = _environment().get_template("page.html.jinja")
    write_whole_text(folder / PAGE, template.render(facts))
    return folder / PAGE


def headline(record: RunRecord, held_out_psnr: Sequence[float] = ()) -> str:
    """Return the result in one sentence: time, PSNR of the held-out views, error of the volume.

    Args:
        record: supplies ``status``, ``timings`` and ``results``.
        held_out_psnr: PSNR [dB] of each held-out view.
    """
    errors = []
    if held_out_psnr:
        errors.append(f"{np.mean(held_out_psnr):.1f} dB PSNR on held-out views{_judged_by(record)}")
    if record.results.get("nrmse") is not None:
        errors.append(f"a volume nRMSE of {record.results['nrmse']:.3g}")
    cores = f"{record.machine.cores} core" + ("s" if record.machine.cores != 1 else "")
    seconds = _total_seconds(record)
    verdict = f"{VERDICTS[record.status]} {format_duration(seconds)}" if seconds else VERDICTS[record.status].rpartition(" ")[0]
    return f"{verdict} on {cores}" + (": " + ", ".join(errors) if errors else "") + "."


def _judged_by(record: RunRecord) -> str:
    """Number and size of the held-out views in brackets, and their PSNR after colour correction if it was measured."""
    if not record.judged:
        return ""
    corrected = record.results.get("psnr_colour_fitted")
    return f" ({record.judged}{'' if corrected is None else f'; {corrected:.1f} dB after colour correction'})"


def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("mivol.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(duration=format_duration, times=_format_shape, unbroken=_unbroken)
    return environment


def _unbroken(sentence: str) -> str:
    """Keep a number and the unit on one line."""
    return re.sub(r"(\d) (?=\D)", "\\1\u00a0", sentence).replace("held-out", "held\u2011out")


def _check_present(folder: Path, record: RunRecord) -> None:
    for part in (*record.images, *record.volumes):
        if not (folder / part.path).is_file():
            raise MivolError(
                f'the record names "{part.path}", which is missing from the run folder; restore the file or remove '
                "its entry from run.json."
            )


# -- Numbers, curves, times, settings -----------------------------------------------------------------------------------


def _held_out_psnr(record: RunRecord, views: Sequence[ViewRow]) -> list[float]:
    """PSNR [dB] of the held-out views: the mean measured by the run, or a value for each view on the page."""
    mean = record.results.get("held_out_psnr")
    if mean is not None:
        return [mean]
    return [view.psnr for view in views if view.held_out and view.psnr is not None]


def _numbers(record: RunRecord, views: Sequence[ViewRow], volumes: Sequence[VolumeView]) -> list[tuple[str, str, str]]:
    """Tiles under the headline: value, unit, label."""
    held_out = _held_out_psnr(record, views)
    seconds, leading, tiles = _total_seconds(record), ("nrmse", "held_out_psnr", "seconds"), []
    if record.results.get("nrmse") is not None:
        tiles.append(_result_tile("nrmse", record.results["nrmse"], record.units))
    if held_out:
        spread = f" ({min(held_out):.1f} to {max(held_out):.1f})" if len(held_out) > 1 else ""
        judged = f": {record.judged}" if record.judged else ""
        tiles.append((f"{np.mean(held_out):.1f}", "dB", f"PSNR, held-out views{spread}{judged}"))
    if seconds:
        tiles.append((*format_duration(seconds).split(" "), "total time"))
    tiles += join_channels(
        _result_tile(name, value, record.units) for name, value in record.results.items() if name not in leading
    )
    shapes = dict.fromkeys(volume.shape for volume in volumes)
    tiles += [(*_count(math.prod(shape)), f"voxels, {_format_shape(shape)}") for shape in shapes]
    return tiles


def _result_tile(name: str, value: float | None, units: dict[str, str]) -> tuple[str, str, str]:
    quantity = find_quantity(name, units)
    if value is None:
        return "–", "", quantity.label
    return (f"{value:,.0f}" if float(value).is_integer() else f"{value:.3g}"), quantity.symbol, quantity.label


def _curves(rows: Sequence[dict], units: dict[str, str]) -> list[str]:
    """Curves of the quantities in the metrics: first the keys of ``QUANTITIES``, then further quantities by name."""
    names = {name for row in rows for name, value in row.items() if value is not None} - {"iteration", "seconds"}
    ordered = [name for name in QUANTITIES if name in names] + sorted(names - set(QUANTITIES))
    labels = {name: f"{find_quantity(name, units).label} against iterations" for name in ordered}
    return [figures.inline_svg(figures.plot_curve(rows, name, units=units), label) for name, label in labels.items()]


def _total_seconds(record: RunRecord) -> float:
    return record.results.get("seconds") or sum(record.timings.values())


def _timings(timings: dict[str, float]) -> list[tuple[str, float, float]]:
    """Stages with their seconds and their percentage of the longest stage."""
    longest = max(timings.values(), default=0.0) or 1.0
    return [(name, seconds, 100 * seconds / longest) for name, seconds in timings.items()]


def _count(number: int) -> tuple[str, str]:
    """A count with three digits, and its SI prefix."""
    for size, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= size:
            return f"{number / size:.3g}", prefix
    return str(number), ""


def _format_shape(shape: Sequence[int]) -> str:
    return " × ".join(map(str, shape))


def _toml(config: dict[str, Any], prefix: str = "") -> str:
    """The settings as TOML: plain values first, then a table for each group, without unset values."""
    config = {key: value for key, value in config.items() if value is not None}
    plain = [f"{key} = {to_toml(value)}" for key, value in config.items() if not isinstance(value, dict)]
    parts = ["\n".join(([f"[{prefix}]"] if prefix and plain else []) + plain)] if plain else []
    tables = {key: value for key, value in config.items() if isinstance(value, dict)}
    parts += [_toml(value, f"{prefix}.{key}" if prefix else key) for key, value in tables.items()]
    return "\n\n".join(part for part in parts if part)


# -- The page of a sweep -----------------------------------------------------------------------------------------------

SWEEP_PAGE = "sweep.html"

NOT_DRAWN = ("iterations", "views")
"""Results that are settings or counts."""

CLOSEST_TICKS = 1 / 8
"""Smallest distance of swept values that are all written at a linear axis, over the length of the axis."""


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
    folder: Path,
    title: str,
    keys: Sequence[str],
    rows: Sequence[SweepRow],
    news: SweepNews | None = None,
    name: str = SWEEP_PAGE,
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
        "noun": "run" if name == SWEEP_PAGE else "view",
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
        if axes.get_xscale() == "log" or min(np.diff(x)) >= CLOSEST_TICKS * (x[-1] - x[0]):
            axes.set_xticks(x, [f"{value:g}" for value in x])
        axes.margins(x=0.03, y=0.12)
    return figure
