"""What a file of points or of Gaussians holds, in a few lines, and one file made of another.

Conventions. Facts come first, whatever is refused: numbers that cannot be drawn are counted and left out of the extents.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.files.source import check_file, refusal, select_by_suffix
from mivol.points.cloud import CLOUD_READERS, CLOUD_WRITERS, PointCloud, read_points, write_points
from mivol.points.conversions import gaussians_of_points, points_of_gaussians
from mivol.points.gaussian_files import READERS, WRITERS, holds_gaussians, read_gaussians, write_gaussians
from mivol.points.gaussians import Gaussians

__all__ = ["KINDS", "SUFFIXES", "Facts", "convert_file", "is_points_file", "read_facts"]

KINDS = ("gaussians", "points")
"""What a file can be written as."""

SUFFIXES = READERS.keys() | CLOUD_READERS.keys()
"""Of files of Gaussians and of points."""

FAINT = 0.05
"""Gaussians of a smaller opacity are counted: they cost time and show little."""


@dataclass(frozen=True)
class Facts:
    """Lines for people; ``refusal`` is the sentence that reading the file would end with, or empty."""

    text: str
    refusal: str


def is_points_file(path: Path) -> bool:
    """Whether the suffix is one of Gaussians or of points."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def read_facts(path: Path) -> Facts:
    """Count, extent, degree, scales and opacities of a file, and what in it cannot be drawn.

    Raises:
        MivolError: the file cannot be read at all.
    """
    path = check_file(path)
    if holds_gaussians(path):
        held, lines = select_by_suffix(path, READERS)(path), _gaussian_lines
    else:
        held, lines = select_by_suffix(path, CLOUD_READERS)(path), _cloud_lines
    try:
        held.checked(path)
        refused = ""
    except MivolError as error:
        refused = str(error)
    return Facts("\n".join([*lines(path, held), *([f"refused\n{refused}"] if refused else [])]), refused)


def convert_file(source: Path, target: Path, kind: str | None = None) -> str:
    """Write the Gaussians or points of a file in another format.

    Args:
        source: any format that :func:`read_gaussians` or :func:`read_points` reads.
        target: what to write; its suffix chooses the format.
        kind: one of :data:`KINDS`; None: what the source holds, or points where the suffix holds no Gaussians.

    Returns:
        What was written, in a line.

    Raises:
        MivolError: as the readers and writers, or another kind.
    """
    if kind not in (None, *KINDS):
        raise refusal("convert_file", f"kind={kind!r}", f"one of {', '.join(KINDS)}", "choose one of those")
    check_file(source)
    has_gaussians = holds_gaussians(source)
    select_by_suffix(target, {**CLOUD_WRITERS, **WRITERS})
    kind = kind or ("gaussians" if has_gaussians and target.suffix.lower() in WRITERS else "points")
    held = read_gaussians(source) if has_gaussians else read_points(source)
    if kind == "gaussians":
        made = gaussians_of_points(held) if isinstance(held, PointCloud) else held
        write_gaussians(target, made)
        return f"{target}: {made.count} Gaussians of degree {made.degree}"
    cloud = held if isinstance(held, PointCloud) else points_of_gaussians(held)
    write_points(target, cloud)
    return f"{target}: {cloud.count} points"


def _gaussian_lines(path: Path, held: Gaussians) -> list[str]:
    scales, opacities = held.scales(), held.opacities()
    faint = np.mean(opacities[np.isfinite(opacities)] < FAINT) if held.count else 0
    return [
        f"{path}: {held.count} Gaussians, harmonics of degree {held.degree}",
        *_extent(held.means),
        f"scales {_spread(scales)}",
        f"opacities {_spread(opacities)}, {100 * faint:.3g} % below {FAINT}",
    ]


def _cloud_lines(path: Path, held: PointCloud) -> list[str]:
    return [f"{path}: {held.count} points, {'without' if held.colours is None else 'with'} colours", *_extent(held.positions)]


def _extent(positions: np.ndarray) -> list[str]:
    """The box of all that are finite, and of the middle 98 %."""
    finite = positions[np.isfinite(positions).all(axis=1)]
    if not len(finite):
        return ["nothing in it has a place"]
    low, high, inner_low, inner_high = np.quantile(finite, [0, 1, 0.01, 0.99], axis=0)
    return [f"box {_corner(low)} to {_corner(high)}; 98 % along each axis {_corner(inner_low)} to {_corner(inner_high)}"]


def _corner(values: np.ndarray) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


def _spread(values: np.ndarray) -> str:
    """Ends and median of the finite ones."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "that are finite: none"
    return f"{finite.min():.4g} to {finite.max():.4g}, median {np.median(finite):.4g}"
