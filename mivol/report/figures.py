"""Figures in the house style: units on every axis, and the colour-blind safe colours of Okabe and Ito.

Conventions. A ``plot_*`` function returns a matplotlib figure; :func:`save_figure` writes the figure as .svg or .png, whole or
not at all. No function changes the global state of pyplot. The colours of an :func:`inline_svg` are CSS variables of the page,
so the figure follows the light or dark theme.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import ArrayLike, NDArray

from mivol.errors import MivolError
from mivol.files import read_volume, write_whole
from mivol.report import pixel_scale
from mivol.report.record import Volume, find_quantity

INK, FAINT, GRID = "#1b1f24", "#5b6470", "#d5d9df"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
LEVELS = {"discrepancy": (1.0, "noise level")}
"""Curve -> (level to reach, name of the level)."""
MARKERS = ("o", "s", "^", "D", "v", "P")
CSS = {INK: "var(--ink)", FAINT: "var(--faint)", GRID: "var(--rule)"} | {
    colour: f"var(--series-{i})" for i, colour in enumerate(SERIES)
}
STYLE = {
    "figure.dpi": 100,
    "savefig.dpi": 160,
    "figure.constrained_layout.use": True,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 9,
    "axes.labelsize": 10,
    "axes.labelcolor": FAINT,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 0.8,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "xtick.major.size": 3,
    "ytick.major.size": 3,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "axes.prop_cycle": mpl.cycler(color=SERIES),
    "image.interpolation": "nearest",
    "svg.fonttype": "none",
    "svg.hashsalt": "mivol",
}


def empty_figure(width: float, height: float) -> Figure:
    """Return an empty figure (width and height in inches) with its own canvas. Call inside ``mpl.rc_context(STYLE)``."""
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure as .svg or .png, whole or not at all.

    Raises:
        MivolError: another suffix.
    """
    path = Path(path)
    if path.suffix not in (".svg", ".png"):
        raise MivolError(f'a figure cannot be written as "{path.name}"; choose the suffix .svg or .png.')
    metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    with mpl.rc_context(STYLE):
        write_whole(path, lambda file: figure.savefig(file, format=path.suffix[1:], metadata=metadata))
    return path


def inline_svg(figure: Figure, label: str) -> str:
    """Return the figure as an ``<svg>`` element in the theme of the page. Screen readers read the ``label``."""
    buffer = io.StringIO()
    with mpl.rc_context(STYLE | {"svg.hashsalt": label}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    used = set(re.findall(r'(?:href="|url\()#([^")]+)', svg))
    svg = re.sub(r' id="([^"]+)"', lambda match: match[0] if match[1] in used else "", svg)
    head, body = svg.split(">", 1)
    head = re.sub(r'\s(?:width|height|version|xmlns(?::xlink)?)="[^"]*"', "", head).replace("\n", " ")
    for colour, variable in CSS.items():
        body = body.replace(colour, variable)
    body = re.sub(r"font: (bold )?([\d.]+px)[^;\"]*", lambda m: f"font-size: {m[2]}" + "; font-weight: 600" * bool(m[1]), body)
    return f'{head} role="img" aria-label="{_escape(label)}">{body.strip()}'


def _escape(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")


def plot_curve(rows: Sequence[dict], name: str, *, units: Mapping[str, str] | None = None) -> Figure:
    """Plot one quantity of ``metrics.jsonl`` against iterations, with the last value at the end of the curve.

    Args:
        rows: rows of :func:`mivol.report.record.read_metrics`; rows without the quantity are skipped.
        name: key of the quantity.
        units: units of the run (:class:`mivol.report.record.RunRecord`).

    Raises:
        MivolError: no row has the quantity.
    """
    points = [(row["iteration"], row[name]) for row in rows if row.get(name) is not None and row.get("iteration") is not None]
    if not points:
        raise MivolError(f'no row of the metrics has "{name[:80]}"; choose a recorded quantity.')
    x, y = np.array(points, float).T
    quantity = find_quantity(name, units or {})
    with mpl.rc_context(STYLE):
        figure = empty_figure(4.4, 2.75)
        axes = figure.subplots()
        axes.plot(x, y, color=SERIES[0], marker="o" if len(x) <= 30 else None, markersize=3.5, clip_on=False)
        axes.set_title(quantity.label + (f" [{quantity.unit}]" if quantity.unit else ""))
        axes.set_xlabel("iteration")
        if quantity.log and (y > 0).all():
            _log_axis(axes.yaxis, y)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        end = {"ha": "left", "va": "center", "color": SERIES[0], "weight": "bold", "fontsize": 9.5}
        axes.annotate(f"{y[-1]:.3g}", (x[-1], y[-1]), (6, 0), textcoords="offset points", **end)
        if name in LEVELS:
            _draw_level(axes, *LEVELS[name])
        axes.margins(x=0.02, y=0.12)
    return figure


def _draw_level(axes: Axes, value: float, name: str) -> None:
    """Draw a dashed horizontal line at the level that a curve should reach."""
    axes.axhline(value, color=FAINT, linestyle=(0, (4, 3)), linewidth=1.2)
    place = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "left", "va": "bottom"}
    axes.annotate(name, (0.0, value), (4, 2), color=FAINT, fontsize=9, **place)


NARROW = 5.0
"""Ratio of the largest to the smallest value above which two ticks of 1, 2, 5, 10 fit: their ratios are 2 and 2.5."""


def _log_axis(axis: Axis, values: NDArray) -> None:
    """Make an axis logarithmic, with labels at decades from a range of two decades on, else at 1, 2 and 5.

    A range below ``NARROW`` gets evenly spaced labels.
    """
    getattr(axis.axes, f"set_{axis.axis_name}scale")("log")
    wide, narrow = values.max() >= 100 * values.min(), values.max() < NARROW * values.min()
    axis.set_major_locator(MaxNLocator(5) if narrow else LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(LogFormatterSciNotation() if wide else (lambda value, _: f"{value:.3g}"))


def plot_image_row(reference: NDArray, render: NDArray, z: NDArray | None = None, *, unit: str = "") -> Figure:
    """Plot reference, render, signed difference and, if given, the z-image side by side.

    Args:
        reference: (height, width[, C]).
        render: image of the same shape.
        z: difference divided by its standard error, in the same shape.
        unit: unit of the values.
    """
    label = f"radiance [{unit}]" if unit else "radiance"
    difference = np.asarray(render, float) - np.asarray(reference, float)
    values = pixel_scale.shared_scale(reference)
    panels = [
        ("reference", reference, values),
        ("render", render, values),
        ("render − reference", difference, pixel_scale.signed_scale(difference)),
    ]
    if z is not None:
        panels.append(("z", z, pixel_scale.Scale("signed", -4.0, 4.0)))
    with mpl.rc_context(STYLE):
        # Room for the image at the full width of its panel, a title and a colour bar: matplotlib cuts off titles in less.
        height = 2.6 * min(reference.shape[0] / reference.shape[1], 1.0) + 1.15
        figure = empty_figure(2.6 * len(panels), height)
        for axes, (name, image, scale) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            _show_pixels(axes, pixel_scale.to_pixels(image, scale), image.shape[1] / image.shape[0])
            axes.set_title(name)
            if scale.kind == "colour":
                axes.set_xlabel(f"{label}: white is {scale.high:.3g}")
            _draw_colour_bar(figure, [axes], scale, "difference / standard error" if name == "z" else label, below=True)
    return figure


def plot_ring_removal(before: NDArray, after: NDArray) -> Figure:
    """Plot a sinogram before and after ring removal, and what was removed.

    Args:
        before, after: line integrals (views, columns).
    """
    removed = np.asarray(before, float) - np.asarray(after, float)
    values = pixel_scale.shared_scale(before, after, kind="grey")
    panels = (("before", before, values), ("after", after, values), ("removed", removed, pixel_scale.signed_scale(removed)))
    with mpl.rc_context(STYLE):
        figure = empty_figure(8.4, 3.6)
        for axes, (name, image, scale) in zip(figure.subplots(1, 3), panels, strict=True):
            _show_pixels(axes, pixel_scale.to_pixels(image, scale), 1.0)
            axes.set(title=name, xlabel="column →", ylabel="← view")
            _draw_colour_bar(figure, [axes], scale, "line integral", below=True)
    return figure


def plot_moves(moves: NDArray, before: NDArray, after: NDArray) -> Figure:
    """Plot where the detector stood in each view, and the residual of held-out views without and with it.

    Args:
        moves: (views, 3) along rows and columns [pixel], turn [rad].
        before, after: (held-out views,) mean squared residuals.
    """
    with mpl.rc_context(STYLE):
        figure = empty_figure(8.4, 3.0)
        left, middle, right = figure.subplots(1, 3)
        left.plot(moves[:, 0], label="along the rows")
        left.plot(moves[:, 1], label="along the columns")
        left.set(xlabel="view", ylabel="shift [pixel]")
        left.legend()
        middle.plot(np.degrees(moves[:, 2]))
        middle.set(xlabel="view", ylabel="turn [degree]")
        right.plot(np.sqrt(before), "o", label="as given")
        right.plot(np.sqrt(after), "o", label="fitted")
        right.set(xlabel="held-out view", ylabel="residual (RMS)", ylim=(0, None))
        right.legend()
    return figure


def _show_pixels(axes: Axes, rgb: NDArray[np.uint8], aspect: float) -> None:
    axes.imshow(rgb, aspect=rgb.shape[1] / rgb.shape[0] / aspect)
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set(visible=True, color=GRID)


def _draw_colour_bar(figure: Figure, axes: Sequence[Axes], scale: pixel_scale.Scale, label: str, below: bool) -> None:
    if scale.kind == "colour":
        return
    mappable = mpl.cm.ScalarMappable(
        mpl.colors.Normalize(scale.low, scale.high), pixel_scale.SIGNED if scale.kind == "signed" else "gray"
    )
    bar = figure.colorbar(
        mappable, ax=list(axes), location="bottom" if below else "right", fraction=0.05, pad=0.03, aspect=24, label=label
    )
    bar.outline.set_visible(False)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()


class Series(NamedTuple):
    """Errors of a method against time.

    Attributes:
        name: name of the method.
        seconds: times [s]; a single point for a method without a parameter for its accuracy.
        error: error after each time.
    """

    name: str
    seconds: ArrayLike
    error: ArrayLike


def ratio_at_equal_error(fast: Series, slow: Series) -> tuple[float, float, float] | None:
    """Compare the times of two methods at the smallest error of ``slow``.

    The time of ``fast`` is interpolated between its points in log-log and never extrapolated. If ``fast`` starts below the
    error, its first time counts, and the ratio of the times is a lower bound.

    Returns:
        (error, seconds of ``fast``, seconds of ``slow``), or None if ``fast`` never reaches the error.
    """
    best = int(np.argmin(slow.error))
    error, seconds = float(np.asarray(slow.error)[best]), float(np.asarray(slow.seconds)[best])
    t, e = (np.asarray(v, float)[np.argsort(fast.seconds)] for v in (fast.seconds, fast.error))
    below = np.flatnonzero(e <= error)
    if below.size == 0:
        return None
    first = below[0]
    if first == 0:
        return error, float(t[0]), seconds
    share = np.log(e[first - 1] / error) / np.log(e[first - 1] / e[first])
    return error, float(t[first - 1] * (t[first] / t[first - 1]) ** share), seconds


def plot_error_against_time(
    series: Sequence[Series],
    path: str | Path | None = None,
    *,
    error: str = "relative RMS error",
    title: str = "",
) -> Figure:
    """Plot error against time of several methods in log-log, and compare the first method with the others.

    Args:
        series: methods with times and errors above 0, the judged method first.
        path: file to write (.svg or .png), optional.
        error: label of the vertical axis.
        title: question answered by the figure.

    Returns:
        The figure. The legend gives the ratio of the times at equal error for each other method
        (:func:`ratio_at_equal_error`). An arrow marks the ratio for the most accurate of them.

    Raises:
        MivolError: no series, or a time or an error that is not finite and above 0.
    """
    _check_series(series)
    with mpl.rc_context(STYLE):
        figure = empty_figure(7.2, 4.4)
        axes = figure.subplots()
        ratios = {s.name: ratio_at_equal_error(series[0], s) for s in series[1:]}
        for i, s in enumerate(series):
            order = np.argsort(s.seconds)
            axes.plot(
                np.asarray(s.seconds)[order],
                np.asarray(s.error)[order],
                marker=MARKERS[i % len(MARKERS)],
                color=SERIES[i % len(SERIES)],
                label=_legend(s.name, ratios.get(s.name), series[0].name),
                zorder=3 + (i == 0),
                linewidth=2.4 if i == 0 else 1.5,
                markeredgecolor="white",
                markeredgewidth=0.7,
                markersize=6.5 if len(order) <= 12 else 4,
            )
        axes.set(xlabel="time of a call after the first [s]", ylabel=error, title=title)
        _log_axis(axes.xaxis, np.concatenate([np.ravel(s.seconds) for s in series]))
        _log_axis(axes.yaxis, np.concatenate([np.ravel(s.error) for s in series]))
        _draw_arrow(axes, [ratio for ratio in ratios.values() if ratio])
        axes.margins(0.06, 0.08)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), labelspacing=0.9, handlelength=1.6)
    if path is not None:
        save_figure(figure, path)
    return figure


def _legend(name: str, ratio: tuple[float, float, float] | None, first: str) -> str:
    return f"{name}\n{_format_ratio(ratio)} the time of {first}" if ratio else name


def _format_ratio(ratio: tuple[float, float, float]) -> str:
    return f"{ratio[2] / ratio[1]:,.3g} ×" if ratio[2] < 1000 * ratio[1] else f"{ratio[2] / ratio[1]:,.0f} ×"


def _draw_arrow(axes: Axes, ratios: Sequence[tuple[float, float, float]]) -> None:
    if not ratios:
        return
    error, fast, slow = min(ratios, key=lambda ratio: ratio[0])
    axes.annotate(
        "",
        (fast, error),
        (slow, error),
        arrowprops={"arrowstyle": "<->", "color": INK, "shrinkA": 5, "shrinkB": 5, "linewidth": 1.1},
    )
    axes.annotate(
        _format_ratio((error, fast, slow)),
        (np.sqrt(fast * slow), error),
        (0, 4),
        textcoords="offset points",
        ha="center",
        va="bottom",
        weight="bold",
    )


def _check_series(series: Sequence[Series]) -> None:
    if not series:
        raise MivolError("an error plot needs at least one series; give times and errors of a method.")
    for s in series:
        both = np.array([np.ravel(s.seconds), np.ravel(s.error)], float)
        if both.size == 0 or not (np.isfinite(both) & (both > 0)).all():
            raise MivolError(f'"{s.name}" has a time or an error that is not finite and above 0; remove these points.')


# -- Profiles of volumes ------------------------------------------------------------------------------------------

DASHES = {"reconstruction": "solid", "truth": (0, (3, 2))}


def draw_profiles(folder: Path, volumes: Sequence[Volume]) -> list[str]:
    """Return curves along x, y and z as SVG, for the volumes marked with ``profiles``.

    Raises:
        MivolError: an unreadable file.
    """
    entries = {volume.role: volume for volume in volumes if volume.profiles}
    if "reconstruction" not in entries:
        return []
    grids = {role: read_volume(folder / entries[role].path) for role in DASHES if role in entries}
    values = {role: grid.values[..., 0] for role, grid in grids.items()}
    to_world, entry = grids["reconstruction"].to_world, entries["reconstruction"]
    label = f"{entry.quantity} [{entry.unit}]"
    return [
        inline_svg(plot_profile(values, axis, (to_world[i, 3], to_world[i, i]), label), f"{entry.quantity} along {axis}")
        for i, axis in enumerate("xyz")
    ]


def plot_profile(values: dict[str, NDArray], axis: str, box: tuple[float, float], label: str) -> Figure:
    """Plot the values along one axis through the middle voxel.

    Args:
        values: (Z, Y, X) by role.
        axis: ``x``, ``y`` or ``z``.
        box: lower end and edge of the box along the axis [length].
        label: quantity with its unit.
    """
    with mpl.rc_context(STYLE):
        figure = empty_figure(4.4, 2.75)
        axes = figure.subplots()
        for role, colour in zip(values, SERIES, strict=False):
            line = central_line(values[role], axis)
            x = box[0] + (np.arange(len(line)) + 0.5) * box[1] / len(line)
            axes.plot(x, line, color=colour, label=role, linestyle=DASHES[role], linewidth=1.5)
        axes.set_title(label)
        axes.set_xlabel(f"{axis} [length]")
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.margins(x=0.02, y=0.08)
        if len(values) > 1:
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8.5, borderaxespad=0.2)
    return figure


def central_line(values: NDArray, axis: str) -> NDArray:
    """Return the values along an axis through the middle voxel of a grid (Z, Y, X)."""
    z, y, x = (n // 2 for n in values.shape)
    return {"x": values[z, y, :], "y": values[z, :, x], "z": values[:, y, x]}[axis]
