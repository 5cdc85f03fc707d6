"""A picture of a cloud of points or of Gaussians, from a place of one's own or from where all of it is seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib as mpl
import numpy as np

from mivol.errors import MivolError
from mivol.experiments.view_field import camera_at
from mivol.files.source import check_file
from mivol.photos import Camera
from mivol.photos.photo_file import decode_srgb
from mivol.points.cloud import PointCloud, read_points
from mivol.points.conversions import gaussians_of_points
from mivol.points.gaussian_files import holds_gaussians, read_gaussians
from mivol.points.gaussians import Gaussians
from mivol.splatting import Splatter, tensors_of

__all__ = ["DRAWN_AS", "PointLook", "view_points"]

DRAWN_AS = ("discs", "splats")
"""What a point can be drawn as: a disc that faces the camera, or a Gaussian (EWA splatting, Zwicker et al. 2001)."""

FROM = (1.0, -1.5, 0.7)
"""Direction from the middle of a cloud to the camera where none was given; z is up."""

SHARE = 0.01
"""Of the points, by which a cloud may reach out of its picture at either end of each axis."""


@dataclass(frozen=True)
class PointLook:
    """How points are drawn.

    Attributes:
        drawn_as: one of :data:`DRAWN_AS`.
        radius: of a disc, or standard deviation of a splat [length]; None: half the median distance to the nearest points.
        opacity: of a point, above 0 and up to 1.

    Raises:
        MivolError: a number outside its domain.
    """

    drawn_as: str = "discs"
    radius: float | None = None
    opacity: float = 1.0

    def __post_init__(self) -> None:
        if not 0.03 <= self.opacity <= 1:
            raise MivolError(f"points of opacity {self.opacity:g} were asked for; 0.03 to 1 is expected: choose one of those.")
        if self.radius is not None and not 0 < self.radius < math.inf:
            raise MivolError(f"points of radius {self.radius:g} were asked for; a length above 0 is expected.")


def view_points(
    path: Path, look_at: Sequence[float] | None, up: Sequence[float], fov: float, size: tuple[int, int], look: PointLook
) -> np.ndarray:
    """What a pinhole sees of points or Gaussians over black: linear light (height, width, 3).

    Points are sorted by depth and composited front to back. What is smaller than a pixel covers a share of it, so that a
    point's light goes with the inverse square of its distance, however far it is.

    Args:
        path: any format of points or Gaussians; points without colours take theirs from how densely they stand.
        look_at: where the camera stands and what it looks at, six numbers [length]; None: from where nearly all is seen.
        up: the direction that is upwards in the picture, three numbers.
        fov: horizontal field of view [degree].
        size: (width, height) [pixel].
        look: of points; Gaussians have their own sizes and opacities.

    Raises:
        MivolError: as the readers, a camera that cannot be, or a look for Gaussians.
    """
    is_cloud = not holds_gaussians(check_file(path))
    if not is_cloud and look != PointLook():
        raise MivolError(f"{path} holds Gaussians, which have shapes of their own: leave out how points are drawn.")
    held = gaussians_for(read_points(path), look) if is_cloud else read_gaussians(path)
    camera = camera_at(look_at or whole_view(held.means, up, fov, size), up, fov, size)
    return decode_srgb(picture_of(held, camera, is_cloud, is_cloud and look.drawn_as == "discs"))


def gaussians_for(cloud: PointCloud, look: PointLook) -> Gaussians:
    """Round Gaussians of one radius at the points; those without colours are coloured by how densely they stand."""
    made = gaussians_of_points(cloud, look.opacity)
    if cloud.colours is None:
        made = gaussians_of_points(replace(cloud, colours=by_density(made.scales()[:, 0])), look.opacity)
    radius = 0.5 * float(np.median(made.scales())) if look.radius is None else look.radius
    return replace(made, log_scales=np.full((made.count, 3), math.log(radius)))


def by_density(distances: np.ndarray) -> np.ndarray:
    """(N, 3) colours of points by the logarithms of their distances to others: light where they stand densely."""
    height = -np.log(distances.astype(np.float64))
    low, high = np.quantile(height, [SHARE, 1 - SHARE])
    return mpl.colormaps[COLOURS]((height - low) / max(high - low, 1e-12))[:, :3]


COLOURS = "magma"


def whole_view(places: np.ndarray, up: Sequence[float], fov: float, size: tuple[int, int]) -> list[float]:
    """Where a camera stands that sees a ball about the middle 98 % of places along each axis, and the ball's middle."""
    low, high = np.quantile(places.astype(np.float64), [SHARE, 1 - SHARE], axis=0)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    half = min(math.radians(fov) / 2, math.atan(math.tan(math.radians(fov) / 2) * size[1] / size[0]))
    towards = np.array(FROM) / np.linalg.norm(FROM)
    return [*(middle + towards * radius / math.sin(half)), *middle]


def picture_of(held: Gaussians, camera: Camera, compensated: bool, discs: bool) -> np.ndarray:
    """(height, width, 3) code values over black."""
    splatter = Splatter(*camera.size, held.degree, compensated=compensated, discs=discs)
    return np.array(splatter.forward(tensors_of(held), camera, derivatives=False)[0])[..., :3]
