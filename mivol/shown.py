"""How objects show themselves: in a line without the numbers of their arrays, and in notebooks as a small picture.

Conventions. HTML is self-contained and has no script; text in it is escaped.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image

__all__ = ["brief", "briefly", "curve_html", "pairs_html", "text_html"]

T = TypeVar("T")

FEW = 4
"""So many entries of a sequence are shown."""

WIDTH, HEIGHT = 320, 100
"""Of a curve [pixel]."""

EDGE, GAP = 160, 4
"""Longest edge of a picture, and between pictures [pixel]."""


def brief(value: object) -> str:
    """A value in a few words: arrays by type and shape, long sequences by their length, other objects by their type."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and shape:
        kind = getattr(value, "dtype", None) or type(value).__name__
        return f"{kind} ({', '.join(map(str, shape))})"
    if isinstance(value, str | int | float | bool | None):
        return repr(value)
    if isinstance(value, Path):
        return repr(value.name)
    if isinstance(value, Mapping):
        return f"{{{len(value)} of {', '.join(map(str, list(value)[:FEW]))}{', ...' if len(value) > FEW else ''}}}"
    if isinstance(value, Sequence):
        if len(value) > FEW:
            return f"[{len(value)} x {type(value[0]).__name__}]"
        return f"[{', '.join(map(brief, value))}]"
    return type(value).__name__


def briefly(cls: type[T]) -> type[T]:
    """A dataclass whose ``repr`` is one line: its public fields by :func:`brief`."""

    def show(self: object) -> str:
        names = [one.name for one in dataclasses.fields(self) if one.repr and not one.name.startswith("_")]
        return f"{type(self).__name__}({', '.join(f'{name}={brief(getattr(self, name))}' for name in names)})"

    cls.__repr__ = show
    return cls


def text_html(text: str) -> str:
    """Lines of text as they are."""
    return f"<pre>{html.escape(text)}</pre>"


def curve_html(values: Sequence[float], says: str) -> str:
    """A curve against its number, on a logarithmic axis where all values are above 0, with a line of text.

    Values that are not finite are left out.
    """
    finite = [(number, float(value)) for number, value in enumerate(values) if math.isfinite(value)]
    if len(finite) < 2:
        return text_html(says)
    is_log = all(value > 0 for _, value in finite)
    heights = [math.log(value) if is_log else value for _, value in finite]
    low, high, last = min(heights), max(heights), finite[-1][0] or 1
    points = " ".join(
        f"{WIDTH * number / last:.1f},{HEIGHT * (1 - (height - low) / ((high - low) or 1)):.1f}"
        for (number, _), height in zip(finite, heights, strict=True)
    )
    picture = (
        f'<svg width="{WIDTH}" height="{HEIGHT}" viewBox="0 -2 {WIDTH} {HEIGHT + 4}" role="img">'
        f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.5"/></svg>'
    )
    return f"{picture}{text_html(says)}"


def pairs_html(pairs: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> str:
    """Views, each as what was seen beside what is rendered of it, with its name below; nothing where there are none.

    Args:
        pairs: of each view its name, and two images (H, W, 1 or 3) of radiance. Both are shown as a screen does, with the
            largest value that was seen as white; what is not finite is black.
    """
    return "".join(_pair_html(*pair) for pair in pairs)


def _pair_html(name: str, seen: np.ndarray, rendered: np.ndarray) -> str:
    white = float(np.nan_to_num(seen, posinf=0.0).max()) or 1.0
    pictures = [_picture(image, white) for image in (seen, rendered)]
    width, height = pictures[0].size
    whole = Image.new("RGB", (2 * width + GAP, height), "white")
    for left, picture in zip((0, width + GAP), pictures, strict=True):
        whole.paste(picture, (left, 0))
    file = io.BytesIO()
    whole.save(file, "PNG")
    data = base64.b64encode(file.getvalue()).decode()
    title = html.escape(f"{name}: seen, rendered")
    return f'<img alt="{title}" title="{title}" src="data:image/png;base64,{data}"/>{text_html(f"{name}: seen, rendered")}'


def _picture(image: np.ndarray, white: float) -> Image.Image:
    """An image in sRGB, small ones with their pixels repeated."""
    values = np.clip(np.nan_to_num(np.asarray(image, np.float64), posinf=0.0, neginf=0.0)[..., :3] / white, 0, 1)
    # IEC 61966-2-1, the transfer function of sRGB.
    codes = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
    if codes.shape[-1] < 3:
        codes = np.repeat(codes[..., :1], 3, axis=2)
    picture = Image.fromarray(np.round(255 * codes).astype(np.uint8))
    factor = EDGE / max(picture.size)
    how = Image.Resampling.NEAREST if factor > 1 else Image.Resampling.BOX
    return picture.resize(tuple(max(1, round(edge * factor)) for edge in picture.size), how)
