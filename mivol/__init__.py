"""Differentiable and inverse volume rendering on Mitsuba 3. Importing this needs no variant."""

from __future__ import annotations

__version__ = "0.1.0"
