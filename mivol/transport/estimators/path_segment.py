"""The segment of a path that lies ahead: its ray, its throughput, and random numbers for media that scatter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

__all__ = ["PathSegment"]


@dataclass
class PathSegment:
    """A stretch ahead of a path.

    Attributes:
        ray, medium: where it begins, and what surrounds its origin.
        beta: throughput to there.
        scatters: lanes whose path may turn once more.
        samples: random numbers for the media to turn it; None where none of them scatters.
    """

    ray: mi.Ray3f
    medium: mi.MediumPtr
    beta: mi.Spectrum
    scatters: mi.Bool
    samples: Any
