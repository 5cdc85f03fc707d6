"""A picture of a radiance field from a place of one's own: no scene and no photographs are needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mivol.errors import MivolError
from mivol.fields.field_archives import load_field
from mivol.fields.sky import Sky, read_sky
from mivol.optim.photographs.field_view import render_view
from mivol.photos import Camera, aim_camera, intrinsics
from mivol.photos.photo_file import decode_srgb

SKY = "sky.exr"
"""What a fit writes beside its field, where it learned what is behind."""


def view_field(path: Path, look_at: Sequence[float], up: Sequence[float], fov: float, size: tuple[int, int]) -> np.ndarray:
    """What a pinhole sees of a field, over the sky beside its file or black: linear light (height, width, 3).

    Args:
        path: the field.
        look_at: where the camera stands and what it looks at, six numbers [length].
        up: the direction that is upwards in the picture, three numbers.
        fov: horizontal field of view [degree].
        size: (width, height) [pixel].

    Raises:
        MivolError: as :func:`mivol.fields.spherical_files.load_field`, or a camera that cannot be.
    """
    camera = camera_at(look_at, up, fov, size)
    field, sky = load_field(path), sky_beside(path)
    seen = render_view(field, camera, np.zeros(3) if sky is None else sky).image
    return np.maximum(seen, 0) if field.space == "linear" else decode_srgb(seen)


def sky_beside(path: Path) -> Sky | None:
    """What a fit learned of what is behind its field, from the file beside the field's; None where there is none.

    Raises:
        MivolError: as :func:`mivol.fields.sky.read_sky`.
    """
    beside = path.with_name(SKY)
    return read_sky(beside) if beside.is_file() else None


def camera_at(look_at: Sequence[float], up: Sequence[float], fov: float, size: tuple[int, int]) -> Camera:
    """The camera of :func:`view_field`.

    Raises:
        MivolError: a view along ``up``, numbers that are not finite, or an angle or a size that no pinhole has.
    """
    if not np.isfinite([*look_at, *up]).all() or not 0 < fov < 180 or min(size) < 1:
        found = f"--look-at {list(look_at)} --up {list(up)} --fov {fov:g} --size {list(size)}"
        raise MivolError(f"{found} is no camera: give finite numbers, an angle between 0 and 180 and at least one pixel.")
    width, height = size
    focal = width / (2 * math.tan(math.radians(fov) / 2))
    like = Camera(intrinsics(focal, focal, width / 2, height / 2), size, np.eye(4))
    return aim_camera(like, np.array(look_at[:3]), np.array(look_at[3:]), np.array(up), "--look-at")
