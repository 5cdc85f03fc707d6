"""Mitsuba's sensors: found by number, checked against memory, and converted to and from cameras of photographs.

Conventions. Mitsuba's camera has x to the left in the image, y up and z into the scene. Its principal point offset is a
fraction of the film, positive for an optical axis left of (above) the middle of the image. Pixels are square.
"""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.files.source import refusal
from mivol.machine import check_memory
from mivol.photos import Camera, intrinsics
from mivol.photos.camera import PIXELS_LOST
from mivol.scene_graph import traverse

FILM_NUMBERS = 5
"""Numbers summed by a film for each pixel: red, green, blue, alpha and the weight of the filter."""

PIXEL_BYTES = 4 * (FILM_NUMBERS + 4)
"""Memory of a rendered image per pixel [byte]: the sums and the developed image."""

SMALL_FILM = 1 << 24
"""Memory of a film [byte] up to which it is not compared with the free memory."""

MOST_ENTRIES = 2**32
"""Limit of Dr.Jit, which counts entries of an array in 32 bits."""


def find_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """Find a sensor of the scene by number; a given sensor is returned unchanged.

    Raises:
        MivolError: no sensor with the number.
    """
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise MivolError(f"the scene has no sensor {sensor}, only {len(sensors)} of them; count from 0, or add one.")
    return sensors[sensor]


def check_film(sensor: mi.Sensor, kept: int = 0) -> None:
    """Refuse a film larger than the memory or than an array, before a render.

    Args:
        sensor: the sensor; the crop of its film counts.
        kept: memory kept by the caller besides the image [byte per pixel].

    Raises:
        MivolError: a film that does not fit; the sentence names its size.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    # Asking for the free memory takes half of the time of a recorded render.
    needed = (PIXEL_BYTES + kept) * width * height
    if needed < SMALL_FILM:
        return
    what, way_out = f"a film of {width} x {height} pixels", "give it fewer pixels, or render it in crops"
    check_memory(needed, what, way_out)
    if FILM_NUMBERS * width * height >= MOST_ENTRIES:
        raise MivolError(f"{what} has more numbers than Dr.Jit can count in one array (2^32): {way_out}.")


AXES = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Mitsuba's camera axes in the axes of :class:`mivol.photos.Camera`."""


def to_sensor(camera: Camera, near_far: tuple[float, float] = (1e-2, 1e4), *, pixel_format: str = "rgb") -> dict:
    """Convert a camera to a perspective sensor with a box filter, for ``mitsuba.load_dict``.

    Args:
        camera: a pinhole with square pixels (see :func:`mivol.photos.rectify`).
        near_far: clipping distances [length].
        pixel_format: pixel format of the film.

    Raises:
        MivolError: lens distortion, or pixels that are not square; Mitsuba has no such camera.
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
    """Convert a perspective sensor to a camera. For a cropped film the camera sees the crop.

    Raises:
        MivolError: another kind of sensor.
    """
    if sensor.class_name() != "PerspectiveCamera":
        raise refusal(name, f"a {sensor.class_name()}", "a perspective sensor", "photographs have pinhole cameras")
    params = traverse(sensor)
    film = sensor.film()
    full, crop, size = (np.array(v, float).ravel() for v in (film.size(), film.crop_offset(), film.crop_size()))
    offset = np.array([_number(params[f"principal_point_offset_{axis}"]) for axis in "xy"])
    f = full[0] / 2 / math.tan(math.radians(_number(params["x_fov"])) / 2)
    cx, cy = full * (0.5 - offset) - crop
    pose = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    return Camera(intrinsics(f, f, cx, cy), (int(size[0]), int(size[1])), pose @ AXES, name=name)


def _number(value: object) -> float:
    return float(np.array(value).ravel()[0])
