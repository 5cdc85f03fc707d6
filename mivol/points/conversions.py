"""Points to Gaussians and back.

Source: Kerbl et al. 2023, section 5.1: Gaussians begin as balls as wide as the three nearest neighbours are away.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mivol.files.source import refusal
from mivol.points.byte_codes import harmonics_of_colours
from mivol.points.cloud import PointCloud
from mivol.points.gaussians import Gaussians, logit

__all__ = ["gaussians_of_points", "points_of_gaussians"]

NEIGHBOURS = 3

SMALLEST = 1e-3
"""Of a scale over the median: points that coincide get it, so that no scale is 0."""

GREY = 0.5
"""The colour of points that have none."""


def gaussians_of_points(cloud: PointCloud, opacity: float = 0.1) -> Gaussians:
    """A ball of a Gaussian at each point: its scale is the root mean square distance to the three nearest points.

    Args:
        cloud: at least four points.
        opacity: of every Gaussian, 0..1.

    Returns:
        N Gaussians of degree 0, with the colours of the points, or grey.

    Raises:
        MivolError: fewer than four points, points that mostly coincide, or an opacity outside 0..1.
    """
    if not 0 <= opacity <= 1:
        raise refusal("gaussians_of_points", f"opacity={opacity}", "0 to 1", "choose one of those")
    if cloud.count <= NEIGHBOURS:
        found = f"{cloud.count} points"
        raise refusal("gaussians_of_points", found, f"at least {NEIGHBOURS + 1}, for the distances among them", "add some")
    distances = cKDTree(cloud.positions).query(cloud.positions, NEIGHBOURS + 1)[0][:, 1:]
    scales = np.sqrt((distances**2).mean(axis=1))
    median = float(np.median(scales))
    if median == 0:
        raise refusal("gaussians_of_points", "points that mostly coincide", "points apart", "remove what is there twice")
    scales = np.maximum(scales, SMALLEST * median)
    colours = np.full((cloud.count, 3), GREY) if cloud.colours is None else cloud.colours
    return Gaussians(
        cloud.positions,
        np.repeat(np.log(scales)[:, None], 3, axis=1),
        np.tile([1.0, 0, 0, 0], (cloud.count, 1)),
        np.full(cloud.count, logit(opacity)),
        harmonics_of_colours(colours)[:, None],
    )


def points_of_gaussians(gaussians: Gaussians) -> PointCloud:
    """The centres, with the mean colour over all directions, clipped to 0..1; sizes and opacities are lost."""
    return PointCloud(gaussians.means, np.clip(gaussians.base_colours(), 0, 1))
