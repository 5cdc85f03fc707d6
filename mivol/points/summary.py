"""The contents of a file of points or Gaussians in a few lines, and conversion between file formats.

Conventions. A summary describes the whole file, also if its numbers are refused. Numbers that no renderer can draw are counted,
and left out of the extents.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mivol.display import format_point
from mivol.errors import MivolError
from mivol.files.source import check_file, refusal, select_by_suffix
from mivol.points.cloud import (
    CLOUD_READERS,
    CLOUD_WRITERS,
    PointCloud,
    gaussians_to_points,
    points_to_gaussians,
    read_points,
    write_points,
)
from mivol.points.gaussian_files import (
    GAUSSIAN_READERS,
    GAUSSIAN_WRITERS,
    is_gaussian_file,
    read_gaussian_view,
    read_gaussians,
    write_gaussians,
)
from mivol.points.gaussians import Gaussians

KINDS = ("gaussians", "points")
"""Contents that a file can be converted to."""

SUFFIXES = GAUSSIAN_READERS.keys() | CLOUD_READERS.keys()
"""Suffixes of files of Gaussians and of points."""

FAINT_OPACITY = 0.05
"""Gaussians below this opacity are counted: they cost time and have little effect."""


@dataclass(frozen=True)
class FileSummary:
    """Lines for people, and the message with which reading the file would fail (empty if reading succeeds)."""

    text: str
    refusal: str


def is_points_file(path: Path) -> bool:
    """Whether a file has the suffix of Gaussians or of points."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def summarize_file(path: Path) -> FileSummary:
    """Count, extent, degree, scales and opacities of a file, and the numbers that no renderer can draw.

    Raises:
        MivolError: an unreadable file.
    """
    path = check_file(path)
    if is_gaussian_file(path):
        contents, lines = select_by_suffix(path, GAUSSIAN_READERS)(path), _describe_gaussians
    else:
        contents, lines = select_by_suffix(path, CLOUD_READERS)(path), _describe_points
    try:
        contents.check(path)
        refused = ""
    except MivolError as error:
        refused = str(error)
    return FileSummary("\n".join([*lines(path, contents), *([f"refused\n{refused}"] if refused else [])]), refused)


def convert_file(source: Path, target: Path, kind: str | None, box: Sequence[float] | None) -> str:
    """Write the Gaussians or points of a file in another format.

    Args:
        source: file in any format of :func:`read_gaussians` or :func:`read_points`.
        target: destination; its suffix selects the format.
        kind: one of :data:`KINDS`; None: the kind of the source, or points for a suffix without Gaussians.
        box: two corners, six numbers [length]: only what has its middle inside is written; None: everything.

    Returns:
        A line that describes the written file.

    Raises:
        MivolError: as the readers and writers, or another kind.
    """
    if kind not in (None, *KINDS):
        raise refusal("convert_file", f"kind={kind!r}", f"one of {', '.join(KINDS)}", "choose one of those")
    check_file(source)
    has_gaussians = is_gaussian_file(source)
    select_by_suffix(source, {**CLOUD_READERS, **GAUSSIAN_READERS})
    select_by_suffix(target, {**CLOUD_WRITERS, **GAUSSIAN_WRITERS})
    kind = kind or ("gaussians" if has_gaussians and target.suffix.lower() in GAUSSIAN_WRITERS else "points")
    contents = read_gaussians(source) if has_gaussians else read_points(source)
    if box is not None:
        contents = crop_cloud(contents, box, source)
    if kind == "gaussians":
        gaussians = points_to_gaussians(contents) if isinstance(contents, PointCloud) else contents
        write_gaussians(target, gaussians, read_gaussian_view(source))
        return f"{target}: {gaussians.count} Gaussians"
    cloud = contents if isinstance(contents, PointCloud) else gaussians_to_points(contents)
    write_points(target, cloud)
    return f"{target}: {cloud.count} points"


def crop_cloud(contents: Gaussians | PointCloud, box: Sequence[float], source: Path) -> Gaussians | PointCloud:
    """The Gaussians or points inside a box.

    Raises:
        MivolError: corners in the wrong order, or nothing inside.
    """
    low, high = np.array(box, np.float64).reshape(2, 3)
    if not (low < high).all():
        raise refusal("--box", f"{list(box)}", "a lower corner, then a higher corner", "exchange numbers")
    places = contents.positions if isinstance(contents, PointCloud) else contents.means
    inside = ((places >= low) & (places <= high)).all(axis=1)
    if not inside.any():
        raise refusal(source, f"nothing of {len(places)} inside --box", "a box around some of it", "see mivol explain")
    if isinstance(contents, Gaussians):
        return contents.select(inside)
    return replace(contents, positions=places[inside], colours=None if contents.colours is None else contents.colours[inside])


def _describe_gaussians(path: Path, contents: Gaussians) -> list[str]:
    scales, opacities = contents.scales(), contents.opacities()
    faint = np.mean(opacities[np.isfinite(opacities)] < FAINT_OPACITY) if contents.count else 0
    return [
        f"{path}: {contents.count} Gaussians, harmonics of degree {contents.degree}",
        *_describe_extent(contents.means),
        f"scales {_describe_spread(scales)}",
        f"opacities {_describe_spread(opacities)}, {100 * faint:.3g} % below {FAINT_OPACITY}",
    ]


def _describe_points(path: Path, contents: PointCloud) -> list[str]:
    return [
        f"{path}: {contents.count} points, {'without' if contents.colours is None else 'with'} colours",
        *_describe_extent(contents.positions),
    ]


def _describe_extent(positions: np.ndarray) -> list[str]:
    """The box of all finite positions, and of their middle 98 % along each axis."""
    finite = positions[np.isfinite(positions).all(axis=1)]
    if not len(finite):
        return ["nothing in it has a place"]
    corners = np.quantile(finite, [0, 1, 0.01, 0.99], axis=0)
    low, high, inner_low, inner_high = (format_point(corner) for corner in corners)
    return [f"box {low} to {high}; 98 % along each axis {inner_low} to {inner_high}"]


def _describe_spread(values: np.ndarray) -> str:
    """Ends and median of the finite values."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return "that are finite: none"
    return f"{finite.min():.4g} to {finite.max():.4g}, median {np.median(finite):.4g}"
