"""Short representations of objects: one line without array contents, values as TOML, and small images for notebooks.

Conventions. HTML is self-contained, has no script, and escapes its text.
"""

from __future__ import annotations

import dataclasses
import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

FEW = 4
"""Largest number of sequence entries in a summary."""

WIDTH, HEIGHT = 320, 100
"""Size of a curve [pixel]."""


def summarize(value: object) -> str:
    """Describe a value in a few words: arrays by type and shape, long sequences by length, other objects by type."""
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
        return f"[{', '.join(map(summarize, value))}]"
    return type(value).__name__


def format_point(values: Iterable[float]) -> str:
    """Write coordinates with four digits: ``(1, 2.5, -0.3333)``."""
    return f"({', '.join(f'{value:.4g}' for value in values)})"


def format_duration(seconds: float) -> str:
    """Write a time with its unit: ``350 ms``, ``2.5 s``, ``90 s``, ``5.0 min``, ``2.5 h``."""
    if seconds < 0.95:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 120:
        return f"{seconds:.{int(seconds < 9.95)}f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def to_toml(value: object) -> str:
    """Write a value of a setting as TOML does: lists and tables on one line, entries of None left out."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {to_toml(entry)}" for key, entry in value.items() if entry is not None) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(to_toml, value))}]"
    # TOML writes inf and nan as Python does; JSON would write Infinity.
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def with_short_repr(cls: type[T]) -> type[T]:
    """Give a dataclass a ``repr`` of one line: its public fields by :func:`summarize`."""

    def show(self: object) -> str:
        names = [field.name for field in dataclasses.fields(self) if field.repr and not field.name.startswith("_")]
        return f"{type(self).__name__}({', '.join(f'{name}={summarize(getattr(self, name))}' for name in names)})"

    cls.__repr__ = show
    return cls


def text_html(text: str) -> str:
    """Show lines of text unchanged."""
    return f"<pre>{html.escape(text)}</pre>"


def curve_html(values: Sequence[float], caption: str) -> str:
    """Draw values against their index above a line of text; the axis is logarithmic if all values are positive.

    Non-finite values are left out.
    """
    finite = [(number, float(value)) for number, value in enumerate(values) if math.isfinite(value)]
    if len(finite) < 2:
        return text_html(caption)
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
    return f"{picture}{text_html(caption)}"
