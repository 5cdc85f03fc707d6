"""The sensor of a scene that a number names."""

from __future__ import annotations

import mitsuba as mi

from mivol.errors import MivolError

__all__ = ["find_sensor"]


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
