"""A scene to an image, pass by pass, by the scene's own integrator.

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
from mivol.optim.seeds import seed_of
from mivol.scene.load import find_sensor

SAMPLES_PER_PASS = 1 << 21
COLOURS = {1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}

def render_image(scene: mi.Scene, sensor: int) -> tuple[np.ndarray, list[str]]:
    """The scene's own integrator, sensor and sample count: image (height, width, channels) and the channels' names.

    Raises:
        MivolError: no such sensor, or no integrator.
    """
    integrator, camera = scene.integrator(), find_sensor(scene, sensor)
    if integrator is None:
        raise MivolError("the scene has no integrator: add one to it.")
    spp = camera.sampler().sample_count()
    most = max(SAMPLES_PER_PASS // math.prod(int(n) for n in camera.film().crop_size()), 1)
    n = math.ceil(spp / most)
    total = 0.0
    for number in range(n):
        part = spp // n + (number < spp % n)
        seed = seed_of(number) if n > 1 else 0
        total = total + part * np.asarray(integrator.render(scene, camera, seed=seed, spp=part), dtype=np.float64)
    image = total / spp
    aovs = list(integrator.aov_names())
    return image, [*COLOURS[image.shape[2] - len(aovs)], *aovs]


def write_image(path: Path, image: np.ndarray, names: list[str]) -> None:
    """Write an image whole, in the format that its name asks for.

    Raises:
        MivolError: another suffix than .exr or .png, or what the disk refuses.
    """
    if path.suffix.lower() == ".png":
        colours = [number for number, name in enumerate(names) if name in "RGBY"]
        return write_png(path, image[..., colours])
    if path.suffix.lower() != ".exr":
        raise MivolError(f'images are written as .exr or .png, found "{path.name}": change the name of -o.')
    return write_exr(path, {name: image[..., number].astype(np.float32) for number, name in enumerate(names)})
