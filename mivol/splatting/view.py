"""The camera of a picture as numbers on the device, so that kernels do not depend on where it stands."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.device_arrays import aligned
from mivol.errors import MivolError
from mivol.photos.camera import FLIP, Camera

__all__ = ["View", "numbers_of"]

REACH = 0.3
"""How far beyond the border of the image, in units of the tangent of half its angle, the perspective is linearised where a
Gaussian stands; beyond that, where it would be at that limit (Kerbl et al. 2023: 1.3 times the tangent)."""


@dataclass
class View:
    """A pinhole camera on the device.

    Attributes:
        origin: where it stands.
        right, down, forward: its axes in the world.
        focal, centre: [pixel].
        low, high: between which x / z and y / z the perspective is linearised.
        turn, shift: a small motion of the camera, 0, by which the picture can be derived: a rotation vector about the
            camera's place, in the world's axes [rad], and a translation in the world [length].
    """

    origin: mi.Point3f
    right: mi.Vector3f
    down: mi.Vector3f
    forward: mi.Vector3f
    focal: mi.Vector2f
    centre: mi.Vector2f
    low: mi.Vector2f
    high: mi.Vector2f
    turn: mi.Vector3f
    shift: mi.Vector3f

    @classmethod
    def of(cls, numbers: mi.Float) -> View:
        """The view of the 20 numbers of :func:`numbers_of`."""
        read = [dr.gather(mi.Float, numbers, mi.UInt32(k)) for k in range(20)]
        axes = [mi.Vector3f(*read[k : k + 3]) for k in (3, 6, 9)]
        plane = [mi.Vector2f(*read[k : k + 2]) for k in (12, 14, 16, 18)]
        return cls(mi.Point3f(*read[:3]), *axes, *plane, dr.zeros(mi.Vector3f), dr.zeros(mi.Vector3f))


def numbers_of(camera: Camera, size: tuple[int, int]) -> mi.Float:
    """A camera as one array on the device: the numbers of a :class:`View`, in the order of its attributes.

    Args:
        camera: without a distorting lens.
        size: (width, height) of the picture [pixel].

    Raises:
        MivolError: the camera's image is of another size, or its lens distorts.
    """
    if camera.size != size:
        raise MivolError(
            f"{camera.name}: found an image of {camera.size[0]} x {camera.size[1]} pixels, expected the splatter's "
            f"{size[0]} x {size[1]}: call camera.resized, or make a Splatter of that size."
        )
    if camera.distortion:
        raise MivolError(
            f"{camera.name}: found a lens that distorts, expected a pinhole, since Gaussians are splatted as ellipses: "
            f"{'cut pinholes out of it' if camera.distortion.is_wide else 'rectify the photographs (mivol.photos.dataset)'}."
        )
    axes = camera.to_world[:3, :3] * FLIP
    focal, centre = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    beyond = REACH * 0.5 * np.array(size) / focal
    numbers = [camera.origin, *axes.T, focal, centre, -centre / focal - beyond, (size - centre) / focal + beyond]
    return mi.Float(aligned(np.concatenate(numbers).astype(np.float32)))
