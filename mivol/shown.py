"""How objects show themselves: in a line without the numbers of their arrays, and in notebooks as a small picture.

Conventions. HTML is self-contained and has no script; text in it is escaped.
"""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

__all__ = ["brief", "briefly", "curve_html", "text_html"]

T = TypeVar("T")

FEW = 4
"""So many entries of a sequence are shown."""

WIDTH, HEIGHT = 320, 100
"""Of a curve [pixel]."""


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
