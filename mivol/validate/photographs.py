"""A scene's own renders as photographs: references by Mitsuba, and the file of cameras beside them.

Conventions. The folder holds one reference per view (:mod:`mivol.validate.reference`), linear radiance in OpenEXR, and a
``transforms.json`` that :func:`mivol.photos.load_photos` reads like any other data set. A reference has no alpha: the
background is what the scene shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi

from mivol.errors import MivolError
from mivol.photos.transforms import write_transforms
from mivol.scene.load import LoadedScene, SceneSource, load_scene
from mivol.scene.sensors import find_sensor, to_camera
from mivol.validate.reference import render_reference
from mivol.validate.reference_file import ReferenceResult

__all__ = ["render_photographs"]


def render_photographs(
    scene: SceneSource | mi.Scene | LoadedScene,
    folder: str | Path,
    *,
    sensors: Sequence[int | dict | mi.Sensor] | None = None,
    test: Sequence[int] = (),
    **reference: Any,
) -> list[ReferenceResult]:
    """Render each view of a scene as a reference, and write where the cameras stood.

    Views that the folder holds already are continued or fetched, as :func:`render_reference` does.

    Args:
        scene: as for :func:`render_reference`.
        folder: is made where it is missing; views are named ``view_000.exr`` and so on.
        sensors: numbers, dicts or sensors, all perspective; None: all of the scene's.
        test: numbers of the views that are the test split.
        reference: settings of :func:`render_reference`, ``max_depth`` among them.

    Raises:
        MivolError: a scene without sensors, one that is not perspective, or as :func:`render_reference`.
    """
    loaded = scene if isinstance(scene, LoadedScene) else load_scene(scene, reference.pop("overrides", None))
    looks = list(range(len(loaded.scene.sensors()))) if sensors is None else list(sensors)
    if not looks:
        raise MivolError("the scene has no sensor to photograph it with; add one, or give sensors.")
    names = [f"view_{number:03d}.exr" for number in range(len(looks))]
    cameras = {name: to_camera(_sensor(loaded.scene, look), name) for name, look in zip(names, looks, strict=True)}
    folder = Path(folder)
    if folder.suffix == ".exr":
        raise MivolError(f"{folder} names one image for {len(looks)} views; name a folder.")
    folder.mkdir(parents=True, exist_ok=True)
    made = [render_reference(loaded, folder / name, sensor=look, **reference) for name, look in zip(names, looks, strict=True)]
    write_transforms(folder / "transforms.json", cameras, [names[number] for number in test])
    return made


def _sensor(scene: mi.Scene, look: int | dict | mi.Sensor) -> mi.Sensor:
    return mi.load_dict(dict(look)) if isinstance(look, Mapping) else find_sensor(scene, look)
