"""Clouds of points and of Gaussians as NumPy arrays: the model, formats, checks, conversions. Knows nothing of Mitsuba."""

from __future__ import annotations

from mivol.points.gaussian_files import read_gaussians, write_gaussians
from mivol.points.gaussians import Gaussians, concatenate

__all__ = ["Gaussians", "concatenate", "read_gaussians", "write_gaussians"]
