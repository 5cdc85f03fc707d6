"""A scene to an image, pass by pass, by the scene's own integrator or another one.

Conventions. The image is the mean of passes of at most ``SAMPLES_PER_PASS`` samples, so that Ctrl-C acts within seconds;
channels keep the names that Mitsuba gives them, with AOVs after the colour.
"""

from __future__ import annotations

import math
from pathlib import Path

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.files import write_exr, write_png
from mivol.files.atomic import check_destination
from mivol.optim.scenes.views import seed_of
from mivol.scene.explain import settings_of
from mivol.scene.parsing import reason_of
from mivol.scene.sensors import check_film, find_sensor

SAMPLES_PER_PASS = 1 << 21
KEPT = 2 * 4 * 8
"""Bytes a pixel that are kept beside a pass: the sum of four channels in float64, and the pass as it is added."""

COLOURS = {1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}

def check_output(path: Path) -> None:
    """Refuse a name that no image can be written to, before hours are spent on the image.

    Raises:
        MivolError: another suffix than .exr or .png, a folder that is not there, or one that nothing can be written to.
    """
    if path.suffix.lower() not in (".exr", ".png"):
        raise MivolError(f'images are written as .exr or .png, found "{path.name}": change the name of -o.')
    check_destination(path)


def name_of(integrator: mi.Integrator) -> str:
    """The plugin's name of an integrator: ours, or what it prints first."""
    return "mivol" if hasattr(integrator, "session") else str(integrator).partition("[")[0].strip()


def choose_integrator(scene: mi.Scene, name: str | None = None) -> mi.Integrator:
    """The scene's own integrator, or another one with the same ``max_depth`` where it knows that.

    Raises:
        MivolError: the scene has none and none was named, or Mitsuba has none of that name.
    """
    if name is None:
        if scene.integrator() is None:
            raise MivolError("the scene has no integrator: add one to it, or name one (--integrator mivol).")
        return scene.integrator()
    try:
        return mi.load_dict({"type": name, "max_depth": settings_of(scene).max_depth})
    except RuntimeError as error:
        if "max_depth" in str(error):
            return mi.load_dict({"type": name})
        raise MivolError(f'the integrator "{name}" cannot be loaded ({reason_of(error)}): "mivol" is ours.') from None


def render_image(
    scene: mi.Scene, sensor: int, integrator: mi.Integrator | None = None, spp: int | None = None, seed: int = 0
) -> tuple[np.ndarray, list[str]]:
    """Render: image (height, width, channels) and the channels' names.

    Args:
        scene: the scene.
        sensor: number of the sensor.
        integrator: None for the scene's own.
        spp: samples per pixel; None for those of the sensor's sampler.
        seed: of the random numbers.

    Raises:
        MivolError: no such sensor, no integrator, no samples, or a film that is larger than the memory.
    """
    integrator, camera = integrator or choose_integrator(scene), find_sensor(scene, sensor)
    spp = camera.sampler().sample_count() if spp is None else spp
    if spp < 1:
        raise MivolError(f"{spp} samples a pixel make no image: give --spp 1 or more.")
    check_film(camera, KEPT)
    most = max(SAMPLES_PER_PASS // math.prod(int(n) for n in camera.film().crop_size()), 1)
    n = math.ceil(spp / most)
    total = 0.0
    for number in range(n):
        part = spp // n + (number < spp % n)
        root = seed_of(seed, number) if n > 1 else seed
        total = total + part * np.asarray(integrator.render(scene, camera, seed=root, spp=part), dtype=np.float64)
    image = total / spp
    aovs = list(integrator.aov_names())
    return image, [*COLOURS[image.shape[2] - len(aovs)], *aovs]


def write_image(path: Path, image: np.ndarray, names: list[str]) -> None:
    """Write an image whole, in the format that its name asks for.

    Raises:
        MivolError: another suffix than .exr or .png, or what the disk refuses.
    """
    check_output(path)
    if path.suffix.lower() == ".png":
        colours = [number for number, name in enumerate(names) if name in "RGBY"]
        return write_png(path, image[..., colours])
    return write_exr(path, {name: image[..., number].astype(np.float32) for number, name in enumerate(names)})
