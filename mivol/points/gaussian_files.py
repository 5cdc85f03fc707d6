"""Files of Gaussians: the tables of formats, and one function to read and one to write any of them.

A new format is one reader and one line in :data:`GAUSSIAN_READERS`. Every number is checked before Gaussians are returned.

A page is one HTML file that shows Gaussians in any browser with WebGL 2, without a server and without the internet.
``gaussian_page.html`` draws: projected ellipses with a low-pass filter of 0.3 pixels^2, composited back to front, as
:mod:`mivol.splatting`. The numbers stand in the page in base64: float32 centres; logarithms of scales and coefficients of
degree 0 in 16 bits over their range; quaternions (w, x, y, z) in 16 bits and a sign; opacities in 8 bits; higher harmonics as
128 + 127 k / span in 8 bits.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.files.atomic import write_whole
from mivol.files.ply import read_comments, read_layout, read_tables
from mivol.files.source import check_file, parse_reals, refusal, select_by_suffix
from mivol.photos.camera_path import HomeView
from mivol.points.compact_files import read_ksplat, read_splat, read_spz, write_ksplat, write_splat, write_spz
from mivol.points.gaussian_gltf import read_gaussian_glb, write_gaussian_glb
from mivol.points.gaussian_ply import is_compressed, parse_compressed_tables, parse_tables, write_gaussian_ply
from mivol.points.gaussians import Gaussians
from mivol.points.sog import read_sog, write_sog

TEMPLATE = Path(__file__).with_name("gaussian_page.html")

MOST = 1 << 20
"""Largest number of Gaussians: rows of 256 in the texture of harmonics, which has 4096 rows on any device with WebGL 2."""

CLIPPED = 0.9999
"""Quantile of the absolute values of higher harmonics at which their range ends."""

TOWARDS = np.array([1.0, -1.5, 0.7])
"""Direction from the middle to the first camera without a view; z is up."""

ANGLE = 50.0
"""Field of view of the first camera without a view [degree]."""


def write_gaussian_page(file: BinaryIO, gaussians: Gaussians, view: HomeView | None = None) -> None:
    """Write the page.

    Args:
        file: destination.
        gaussians: contents.
        view: first view; None: a view of everything.

    Raises:
        MivolError: no Gaussians, or more than ``MOST``.
    """
    if not 0 < gaussians.count <= MOST:
        way_out = "remove faint ones, or write a .sog for a larger viewer"
        raise refusal("a page", f"{gaussians.count} Gaussians", f"1 to {MOST}", way_out)
    unit = gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)
    scales, scale_ends = _to_steps(gaussians.log_scales)
    colours, colour_ends = _to_steps(gaussians.harmonics[:, 0])
    higher = gaussians.harmonics[:, 1:]
    span = max(float(np.quantile(np.abs(higher), CLIPPED)), 1e-6) if higher.size else 1.0
    parts = [
        gaussians.means.astype("<f4"),
        scales,
        np.round(unit * 32767).astype("<i2"),
        colours,
        np.round(gaussians.opacities() * 255).astype(np.uint8),
        np.round(128 + 127 * np.clip(higher / span, -1, 1)).astype(np.uint8),
    ]
    view = view or _view_everything(gaussians)
    about = {
        "count": gaussians.count,
        "degree": gaussians.degree,
        "scales": scale_ends,
        "colours": colour_ends,
        "span": span,
        "view": {"up": view.up, "origin": view.origin, "target": view.target, "fov": view.fov, "size": view.size},
    }
    text = TEMPLATE.read_text(encoding="utf-8").replace("ABOUT", json.dumps(about), 1)
    before, after = text.split("DATA", 1)
    file.write(before.encode())
    file.write(base64.b64encode(b"".join(part.tobytes() for part in parts)))
    file.write(after.encode())


def _to_steps(values: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Values in 16 bits over their range, and the ends of the range."""
    low, high = float(values.min()), float(values.max())
    return np.round((values - low) / max(high - low, 1e-30) * 65535).astype("<u2"), (low, high)


def _view_everything(gaussians: Gaussians) -> HomeView:
    """A view of the middle 98 % of the centres along each axis."""
    low, high = np.quantile(gaussians.means.astype(np.float64), [0.01, 0.99], axis=0)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 3 * float(np.median(gaussians.scales())))
    origin = middle + TOWARDS / np.linalg.norm(TOWARDS) * radius / np.sin(np.radians(ANGLE) / 2)
    return HomeView((0.0, 0.0, 1.0), tuple(origin.tolist()), tuple(middle.tolist()), ANGLE, (1, 1))


def _read_ply(path: Path) -> Gaussians:
    tables = read_tables(path)
    return (parse_compressed_tables if is_compressed(tables) else parse_tables)(tables, path)


GAUSSIAN_READERS: dict[str, Callable[[Path], Gaussians]] = {
    ".ply": _read_ply,
    ".spz": read_spz,
    ".splat": read_splat,
    ".ksplat": read_ksplat,
    ".sog": read_sog,
    ".glb": read_gaussian_glb,
}
"""Suffix -> reader(path)."""

GAUSSIAN_WRITERS: dict[str, Callable[[BinaryIO, Gaussians], None]] = {
    ".ply": write_gaussian_ply,
    ".spz": write_spz,
    ".splat": write_splat,
    ".ksplat": write_ksplat,
    ".sog": write_sog,
    ".glb": write_gaussian_glb,
    ".html": write_gaussian_page,
}
"""Suffix -> writer(file, gaussians). A ``.html`` is a page that shows the Gaussians; it is not read."""


def is_gaussian_file(path: Path) -> bool:
    """Whether a file holds Gaussians: by its suffix, and for a ``.ply`` by the properties in its header.

    Raises:
        MivolError: a ``.ply`` with an unreadable header.
    """
    if path.suffix.lower() != ".ply":
        return path.suffix.lower() in GAUSSIAN_READERS
    return not {"opacity", "packed_position"}.isdisjoint(read_layout(path).get("vertex", ()))


def read_gaussians(path: str | os.PathLike) -> Gaussians:
    """Read Gaussians in any format of :data:`GAUSSIAN_READERS`.

    Raises:
        MivolError: a missing, foreign, truncated or inconsistent file, an unknown suffix, or numbers that no renderer can draw
            (the message names the first index).

    Example:
        >>> read_gaussians("point_cloud.ply").degree
        3
    """
    path = check_file(path)
    return select_by_suffix(path, GAUSSIAN_READERS)(path).check(path)


def write_gaussians(path: str | os.PathLike, gaussians: Gaussians, view: HomeView | None = None) -> None:
    """Write Gaussians, whole or not at all; the suffix selects the format (:data:`GAUSSIAN_WRITERS`).

    Args:
        path: destination.
        gaussians: contents.
        view: first view; a ``.ply`` keeps it as a comment, a ``.html`` begins with it, other formats leave it out.

    Raises:
        MivolError: an unknown suffix, numbers that no renderer can draw, or a full disk.
    """
    path = Path(path)
    writer = select_by_suffix(path, GAUSSIAN_WRITERS)
    if path.name.lower().endswith(".compressed.ply"):
        raise refusal(path, "a name for PlayCanvas' compressed .ply, which is read only", "another", "write a .sog or an .spz")
    gaussians.check(path)
    if view is not None and writer is write_gaussian_page:
        writer = partial(write_gaussian_page, view=view)
    if view is not None and writer is write_gaussian_ply:
        comment = " ".join([VIEW_COMMENT, *(f"{number:.9g}" for number in view.numbers)])
        writer = partial(write_gaussian_ply, comment=comment)
    write_whole(path, lambda file: writer(file, gaussians))


VIEW_COMMENT = "mivol_view"
"""First word of the comment with the first view in a ``.ply``."""


def read_gaussian_view(path: Path) -> HomeView | None:
    """Read the first view in a file of Gaussians; None without a view.

    Raises:
        MivolError: a ``.ply`` with an unreadable header, or numbers of no camera.
    """
    if path.suffix.lower() != ".ply":
        return None
    words = next((comment.split() for comment in read_comments(path) if comment.startswith(f"{VIEW_COMMENT} ")), None)
    if words is None:
        return None
    return HomeView.from_numbers(parse_reals(" ".join(words[1:]), len(words) - 1, path, VIEW_COMMENT), path)
