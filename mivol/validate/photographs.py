"""Renders of a scene as photographs: references by Mitsuba, with the file of their cameras.

Conventions. The folder holds a reference per view (:mod:`mivol.validate.reference`), linear radiance in OpenEXR, and a
``transforms.json`` readable by :func:`mivol.photos.load_photos`. A reference has no alpha: the background belongs to the
scene.
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


def render_photographs(
    scene: SceneSource | mi.Scene | LoadedScene,
    folder: str | Path,
    *,
    sensors: Sequence[int | dict | mi.Sensor] | None = None,
    test: Sequence[int] = (),
    **reference: Any,
) -> list[ReferenceResult]:
    """Render each view of a scene as a reference, and write the cameras.

    Existing views in the folder are continued or reused, as :func:`render_reference` does.

    Args:
        scene: as for :func:`render_reference`.
        folder: created if missing; views are named ``view_000.exr`` and so on.
        sensors: numbers, dicts or sensors, all perspective; None: all sensors of the scene.
        test: numbers of the views of the test split.
        reference: settings of :func:`render_reference`, ``max_depth`` among them.

    Raises:
        MivolError: a scene without sensors, a sensor that is not perspective, or as :func:`render_reference`.
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
