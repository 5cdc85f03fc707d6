"""The sensor of a scene that a number names, and whether there is room for its pictures."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.machine import check_memory
from mivol.photos import Camera, intrinsics
from mivol.photos.camera import PIXELS_LOST

__all__ = ["check_film", "find_sensor", "to_camera", "to_sensor"]

FILM_NUMBERS = 5
"""Red, green, blue, alpha and the filter's weight, which a film sums for each pixel."""

PIXEL_BYTES = 4 * (FILM_NUMBERS + 4)
"""Of a picture while it is rendered: the sums, and the picture that is made of them."""

MOST_ENTRIES = 2**32
"""Dr.Jit counts the entries of an array in 32 bits."""


def find_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """A sensor of the scene by its number, or the one that is given.

    Raises:
        MivolError: the scene has none of that number.
    """
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise MivolError(f"the scene has no sensor {sensor}, only {len(sensors)} of them; count from 0, or add one.")
    return sensors[sensor]


def check_film(sensor: mi.Sensor, kept: int = 0) -> None:
    """Refuse a film that is larger than the memory, or than an array can be, before anything is rendered on it.

    Args:
        sensor: with its film, of which the crop is counted.
        kept: bytes a pixel that the caller keeps beside the picture that is rendered.

    Raises:
        MivolError: with the size of the film.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    what, way_out = f"a film of {width} x {height} pixels", "give it fewer pixels, or render it in crops"
    check_memory((PIXEL_BYTES + kept) * width * height, what, way_out)
    if FILM_NUMBERS * width * height >= MOST_ENTRIES:
        raise MivolError(f"{what} has more numbers than Dr.Jit can count in one array (2^32): {way_out}.")


AXES = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Mitsuba's camera axes in ours."""


def to_sensor(camera: Camera, near_far: tuple[float, float] = (1e-2, 1e4), *, pixel_format: str = "rgb") -> dict:
    """A perspective sensor with a box filter, for ``mitsuba.load_dict``.

    Args:
        camera: a pinhole with square pixels (:func:`mivol.photos.rectify` makes one).
        near_far: clipping distances [length].
        pixel_format: of the film.

    Raises:
        MivolError: distortion, or pixels that are not square: Mitsuba has no such camera.
    """
    (fx, _, cx), (_, fy, cy), _ = camera.K
    if camera.distortion or abs(fx / fy - 1) * max(camera.size) / 2 > PIXELS_LOST:
        way = "cut pinholes out of it" if camera.distortion.is_wide else "resample it with mivol.photos.rectify"
        found = "a lens with distortion" if camera.distortion else f"focal lengths {fx:.6g} and {fy:.6g}"
        raise refusal(camera.name, found, "a pinhole with square pixels", way)
    width, height = camera.size
    return {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(width / 2 / fx)),
        "fov_axis": "x",
        "principal_point_offset_x": 0.5 - cx / width,
        "principal_point_offset_y": 0.5 - cy / height,
        "near_clip": near_far[0],
        "far_clip": near_far[1],
        "to_world": mi.ScalarTransform4f(camera.to_world @ AXES),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": pixel_format,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }


def to_camera(sensor: mi.Sensor, name: str = "sensor") -> Camera:
    """The camera of a perspective sensor; of a cropped film, that of the crop.

    Raises:
        MivolError: another kind of sensor.
    """
    if sensor.class_name() != "PerspectiveCamera":
        raise refusal(name, f"a {sensor.class_name()}", "a perspective sensor", "photographs have pinhole cameras")
    params = mi.traverse(sensor)
    film = sensor.film()
    full, crop, size = (np.array(v, float).ravel() for v in (film.size(), film.crop_offset(), film.crop_size()))
    offset = np.array([_number(params[f"principal_point_offset_{axis}"]) for axis in "xy"])
    f = full[0] / 2 / math.tan(math.radians(_number(params["x_fov"])) / 2)
    cx, cy = full * (0.5 - offset) - crop
    pose = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    return Camera(intrinsics(f, f, cx, cy), (int(size[0]), int(size[1])), pose @ AXES, name=name)


def _number(value: object) -> float:
    return float(np.array(value).ravel()[0])
