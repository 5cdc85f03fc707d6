"""Gaussians as one HTML file that shows them in any browser with WebGL 2, without a server and without the internet.

Conventions. ``gaussian_page.html`` draws: projected ellipses with a low-pass filter of 0.3 pixels^2, composited back to front,
as :mod:`mivol.splatting`. The numbers stand in the page in base64: float32 centres; logarithms of scales and coefficients of
degree 0 in 16 bits over their range; quaternions (w, x, y, z) in 16 bits and a sign; opacities in 8 bits; higher harmonics as
128 + 127 k / span in 8 bits.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mivol.files.source import refusal
from mivol.photos.camera_path import HomeView
from mivol.points.gaussians import Gaussians

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
