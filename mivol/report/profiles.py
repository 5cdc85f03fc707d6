"""Values of a volume along the three lines through its middle, beside those of the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mivol.files import read_volume
from mivol.report.figures import SERIES, STYLE, empty_figure, inline_svg
from mivol.report.record import Volume

DASHES = {"reconstruction": "solid", "truth": (0, (3, 2))}


def profiles_of(folder: Path, volumes: Sequence[Volume]) -> list[str]:
    """Curves along x, y and z, as SVG, of the volumes that are to be drawn so.

    Raises:
        MivolError: a file that cannot be read.
    """
    wanted = {volume.role: volume for volume in volumes if volume.profiles}
    if "reconstruction" not in wanted:
        return []
    read = {role: read_volume(folder / wanted[role].path) for role in DASHES if role in wanted}
    values = {role: volume.values[..., 0] for role, volume in read.items()}
    place, about = read["reconstruction"].to_world, wanted["reconstruction"]
    named = f"{about.quantity} [{about.unit}]"
    return [
        inline_svg(plot_profile(values, axis, (place[i, 3], place[i, i]), named), f"{about.quantity} along {axis}")
        for i, axis in enumerate("xyz")
    ]


def plot_profile(values: dict[str, NDArray], axis: str, box: tuple[float, float], named: str) -> Figure:
    """One line through the middle voxel.

    Args:
        values: (Z, Y, X) by role.
        axis: ``x``, ``y`` or ``z``.
        box: where the box begins along it, and its edge [length].
        named: the quantity with its unit.
    """
    with mpl.rc_context(STYLE):
        figure = empty_figure(4.4, 2.75)
        axes = figure.subplots()
        for role, colour in zip(values, SERIES, strict=False):
            line = line_through_the_middle(values[role], axis)
            at = box[0] + (np.arange(len(line)) + 0.5) * box[1] / len(line)
            axes.plot(at, line, color=colour, label=role, linestyle=DASHES[role], linewidth=1.5)
        axes.set_title(named)
        axes.set_xlabel(f"{axis} [length]")
        axes.xaxis.set_major_locator(MaxNLocator(6))
        axes.margins(x=0.02, y=0.08)
        if len(values) > 1:
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8.5, borderaxespad=0.2)
    return figure


def line_through_the_middle(values: NDArray, axis: str) -> NDArray:
    """The voxels along an axis through the one in the middle of (Z, Y, X)."""
    z, y, x = (n // 2 for n in values.shape)
    return {"x": values[z, y, :], "y": values[z, :, x], "z": values[:, y, x]}[axis]
