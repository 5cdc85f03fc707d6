"""Clouds of points and 3D Gaussians as NumPy arrays: the model, file formats, and conversions. Independent of Mitsuba."""

from __future__ import annotations

from mivol.points.cloud import (
    PointCloud,
    gaussians_to_points,
    points_to_density,
    points_to_gaussians,
    read_points,
    sample_points,
    write_points,
)
from mivol.points.gaussian_files import read_gaussians, write_gaussians
from mivol.points.gaussians import Gaussians, concatenate

__all__ = [
    "Gaussians",
    "PointCloud",
    "concatenate",
    "points_to_density",
    "points_to_gaussians",
    "gaussians_to_points",
    "read_gaussians",
    "read_points",
    "sample_points",
    "write_gaussians",
    "write_points",
]
