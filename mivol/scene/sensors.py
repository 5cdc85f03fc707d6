"""The sensor of a scene that a number names, and whether there is room for its pictures."""

from __future__ import annotations

import mitsuba as mi

from mivol.errors import MivolError
from mivol.machine import check_fits

__all__ = ["check_film", "find_sensor"]

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
    check_fits((PIXEL_BYTES + kept) * width * height, what, way_out)
    if FILM_NUMBERS * width * height >= MOST_ENTRIES:
        raise MivolError(f"{what} has more numbers than Dr.Jit can count in one array (2^32): {way_out}.")
