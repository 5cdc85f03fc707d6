"""``mivol render``: a scene to an image, pass by pass, with the flags of the command ``mitsuba``.

Conventions. The image is the mean of passes of at most ``SAMPLES_PER_PASS`` samples, so that Ctrl-C acts within seconds;
channels keep the names that Mitsuba gives them, with AOVs after the colour.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.files import write_exr, write_png
from mivol.optim.problem import seed_of
from mivol.scene.load import LoadedScene, check_variant, find_sensor, load_scene
from mivol.threads import check_one_thread

SAMPLES_PER_PASS = 1 << 21
COLOURS = {1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def load(arguments: argparse.Namespace) -> LoadedScene:
    """The scene of the flags, its variant and threads set.

    Raises:
        MivolError: an unknown variant, a define without "=", or a scene that cannot be loaded.
    """
    check_one_thread()
    set_variant(arguments.mode)
    set_threads(arguments.threads)
    mi.set_log_level(mi.LogLevel.Debug if arguments.verbose else mi.LogLevel.Warn)
    for folder in filter(None, arguments.a.split(";")):
        mi.file_resolver().append(folder)
    return load_scene(arguments.scene, defines(arguments.define))


def defines(pairs: list[str]) -> dict[str, str]:
    """``name=value`` pairs as a dict.

    Raises:
        MivolError: one has no "=".
    """
    wrong = next((pair for pair in pairs if "=" not in pair), None)
    if wrong is not None:
        raise MivolError(f'-D "{wrong}" defines nothing: write -D name=value.')
    return dict(pair.split("=", 1) for pair in pairs)


def set_variant(name: str) -> None:
    """Activate a variant.

    Raises:
        MivolError: this Mitsuba has none of that name, there is no GPU for it, or mivol does not work in it.
    """
    if name not in mi.variants():
        raise MivolError(f'Mitsuba has no variant "{name}": choose among {", ".join(mi.variants())}.')
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise MivolError(f'the variant "{name}" needs an NVIDIA GPU and its driver, and none was found: choose llvm_ad_rgb.')
    mi.set_variant(name)
    check_variant()


def set_threads(count: int) -> None:
    """Threads of the CPU back end; 0 leaves Dr.Jit's choice.

    Raises:
        MivolError: a negative number.
    """
    if count < 0:
        raise MivolError(f"found {count} threads, expected 0 (all cores) or more: correct -t.")
    if count:
        dr.set_thread_count(count)


def render(scene: mi.Scene, sensor: int) -> tuple[np.ndarray, list[str]]:
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


def write(path: Path, image: np.ndarray, names: list[str]) -> None:
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
