"""Clouds of points and of Gaussians as NumPy arrays: the model, formats, checks, conversions. Knows nothing of Mitsuba."""

from __future__ import annotations

from mivol.points.gaussians import Gaussians, concatenate

__all__ = ["Gaussians", "concatenate"]
