"""The reference of each view of a scene: rendered from the scene with the true volume, or read from a file."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mivol.config import Files, SceneExperiment
from mivol.errors import MivolError
from mivol.experiments.fit_kind import RunContext
from mivol.fields.procedural import make_procedural
from mivol.files import read_exr, read_volume, stack_layers
from mivol.files.fetch import PREFIX, resolve_path
from mivol.machine import check_memory
from mivol.optim.parameters import find_key, to_type_of
from mivol.optim.scenes.views import View, check_image_sizes
from mivol.scene.explain import describe_light
from mivol.scene.load import LoadedScene, load_scene
from mivol.scene.sensors import check_film
from mivol.scene_graph import traverse
from mivol.validate.reference import Complete, prepare_reference
from mivol.validate.reference_file import ReferenceResult, read_reference

SEEN = 2 * 3 * 4
"""Memory per pixel of a view [byte]: the reference in three channels, and the standard error or a batch."""


@dataclass
class References:
    """References of the views.

    Attributes:
        held_out_numbers: indices of the held-out views.
        fitted: views to fit.
        held_out: held-out views.
        standard_errors: standard errors of the references by view name, if known.
    """

    held_out_numbers: frozenset[int]
    fitted: list[View] = field(default_factory=list)
    held_out: list[View] = field(default_factory=list)
    standard_errors: dict[str, np.ndarray] = field(default_factory=dict)

    def add(self, sensor: dict | mi.Sensor, mean: np.ndarray, error: np.ndarray | None = None) -> None:
        """Add the next view."""
        index = len(self.fitted) + len(self.held_out)
        view = View(f"view {index}", to_sensor(sensor), mi.TensorXf(np.ascontiguousarray(mean, dtype=np.float32)))
        (self.held_out if index in self.held_out_numbers else self.fitted).append(view)
        if error is not None:
            self.standard_errors[view.name] = error

    def digest(self) -> str:
        """SHA-256 of the references."""
        h = hashlib.sha256()
        for view in (*self.fitted, *self.held_out):
            h.update(np.ascontiguousarray(view.reference).tobytes())
        return h.hexdigest()


def find_references(
    context: RunContext,
    settings: SceneExperiment,
    loaded: LoadedScene,
    truth: np.ndarray | None,
    sensors: Sequence[Any],
    held_out: frozenset[int],
    complete: Complete | None,
) -> References:
    """Render or read the reference of each view; renders show the truth if known.

    Args:
        context: base folder, run folder and progress.
        settings: all settings, with a number for ``fit.max_depth``.
        loaded, truth: scene, and true volume (Z, Y, X, C) or None.
        sensors, held_out: from :func:`find_sensors`.
        complete: renders references on workers; None: in this process.

    Raises:
        MivolError: unreadable files, or files of other sizes than the views.
    """
    if isinstance(settings.reference, Files):
        return read_references(settings, context.base, loaded, sensors, held_out)
    references = References(held_out)
    if truth is None:
        render_views(references, context, settings, loaded, sensors, complete)
    else:
        with hold_values(loaded.scene, settings.truth.key, truth):
            render_views(references, context, settings, load_scene(loaded.scene), sensors, complete)
    return references


def find_sensors(settings: SceneExperiment, scene: mi.Scene) -> tuple[list[Any], frozenset[int]]:
    """Return the sensors of the views, and the indices of the held-out views.

    Raises:
        MivolError: no views, views of different sizes, more views than memory, or unknown held-out views.
    """
    sensors = list(settings.views.sensors(scene))
    more = list(settings.held_out.sensors(scene)) if settings.held_out is not None else []
    check_held_out(settings.reference.held_out, len(sensors))
    held_out = (*settings.reference.held_out, *range(len(sensors), len(sensors) + len(more)))
    sensors += more
    check_film(to_sensor(sensors[0]), SEEN * len(sensors))
    check_image_sizes({f"view {index}": to_sensor(sensor) for index, sensor in enumerate(sensors)})
    return sensors, frozenset(held_out)


def load_experiment_scene(settings: SceneExperiment, base: Path) -> LoadedScene:
    """Load the scene of an experiment with its defines; a define may name public data (``data:NAME``).

    Raises:
        MivolError: as :func:`mivol.scene.load.load_scene`, or missing public data.
    """
    given = settings.scene.define.items()
    is_data = {key: isinstance(value, str) and value.startswith(PREFIX) for key, value in given}
    defines = {key: str(resolve_path(base, value)) if is_data[key] else value for key, value in given}
    return load_scene(base / settings.scene.file, defines)


def to_sensor(sensor: dict | mi.Sensor) -> mi.Sensor:
    """Return a sensor of a camera rig as a Mitsuba sensor."""
    return mi.load_dict(dict(sensor)) if isinstance(sensor, dict) else sensor


def check_held_out(held_out: Sequence[int], count: int) -> None:
    """Refuse unknown held-out views, and a split without a view to fit.

    Raises:
        MivolError: with the index.
    """
    wrong = next((i for i in held_out if not 0 <= i < count), None)
    if wrong is not None:
        raise MivolError(f"found no view {wrong} to hold out, there are {count}: count from 0 in reference.held_out.")
    if len(set(held_out)) == count:
        raise MivolError(f"all {count} views are held out, expected one to fit: shorten reference.held_out.")


def render_views(
    references: References,
    context: RunContext,
    settings: SceneExperiment,
    loaded: LoadedScene,
    sensors: Sequence[Any],
    complete: Complete | None = None,
) -> None:
    """Render references by Mitsuba's path tracer, cached in ``references/`` for other fits of the same views."""
    cache, reference_settings = context.folder / "references", settings.reference
    cache.mkdir(exist_ok=True)
    depth = settings.fit.max_depth if reference_settings.max_depth is None else reference_settings.max_depth
    options = {
        **describe_light(loaded.scene, depth), "target_se": reference_settings.standard_error or None,
        "max_spp": reference_settings.spp, "seed": reference_settings.seed,
    }  # fmt: skip
    prepared = (prepare_reference(loaded, cache, sensor=sensor, **options) for sensor in sensors)
    renders = (reference.complete() for reference in prepared) if complete is None else complete(prepared)
    for sensor in context.progress.track(sensors, "references"):
        render = next(renders)
        references.add(sensor, render.mean, standard_error(render))


def standard_error(reference: ReferenceResult) -> np.ndarray:
    """Standard error of each pixel's mean, with an allowance for light missed by all samples."""
    return np.sqrt(reference.variance_with_unseen(float(reference.mean.max())))


def read_references(
    settings: SceneExperiment, base: Path, loaded: LoadedScene, sensors: Sequence[Any], held_out: frozenset[int]
) -> References:
    """Read references from OpenEXR files. A file of mivol must show the named scene.

    Raises:
        MivolError: different numbers of files and views, or a file of another scene.
    """
    reference_settings, references = settings.reference, References(held_out)
    if len(reference_settings.paths) != len(sensors):
        raise MivolError(f"found {len(reference_settings.paths)} reference files for {len(sensors)} views: give as many files.")
    scene_hash = load_scene(base / reference_settings.scene).content_hash if reference_settings.scene else loaded.content_hash
    for name, sensor in zip(reference_settings.paths, sensors, strict=True):
        channels, header = read_exr(base / name)
        if "mivol_reference" in header:
            reference = read_reference(base / name, scene_hash)
            references.add(sensor, reference.mean, standard_error(reference))
        else:
            references.add(sensor, select_colours(base / name, stack_layers(channels)))
    return references


def select_colours(path: Path, channels: dict[str, np.ndarray]) -> np.ndarray:
    """Return the channels rendered by the variant: colours (height, width, 3), or luminance (height, width, 1).

    Raises:
        MivolError: channels of other names.
    """
    name, expected = ("Y", "Y (luminance)") if "mono" in mi.variant() else ("", "R, G and B")
    if name not in channels:
        names = ", ".join(one or "R, G, B" for one in sorted(channels))
        raise MivolError(f"{path}: found the channels {names}, expected {expected}; write the image with these channels.")
    return channels[name][..., None] if channels[name].ndim == 2 else channels[name][..., :3]


VOXEL_BYTES = 9 * 8
"""Memory per voxel during the computation of a procedural volume [byte]: the position twice, and three numbers, in float64."""


def make_truth(settings: SceneExperiment, base: Path, scene: mi.Scene) -> np.ndarray | None:
    """Return the true volume (Z, Y, X, C) of an experiment; None if unknown.

    Raises:
        MivolError: an unknown key, an unreadable file, or a volume beyond the memory.
    """
    if settings.truth is None:
        return None
    find_key(settings.truth.key, traverse(scene))
    if settings.truth.file:
        return read_volume(resolve_path(base, settings.truth.file)).values
    truth_settings = settings.truth
    shape = " x ".join(str(n) for n in truth_settings.shape)
    check_memory(VOXEL_BYTES * math.prod(truth_settings.shape), f"a truth of {shape} voxels", "give truth.shape fewer voxels")
    return make_procedural(truth_settings.procedural, truth_settings.shape, truth_settings.seed, truth_settings.peak)


def check_truth(settings: SceneExperiment) -> None:
    """Refuse a true volume of an unfitted parameter: references and renders would show different volumes.

    Raises:
        MivolError: with the key.
    """
    if settings.truth is not None and settings.truth.key not in [parameter.key for parameter in settings.parameter]:
        raise MivolError(
            f"truth.key is {settings.truth.key}, which is no parameter of the fit, so the references would show another volume "
            "than the renders: fit it too, or put the known values into the scene (scene.define) and remove the truth."
        )


@contextmanager
def hold_values(scene: mi.Scene, key: str, values: np.ndarray) -> Iterator[None]:
    """Replace the values of a parameter in the scene within a block."""
    params = traverse(scene)
    before = type(params[key])(params[key])
    set_parameter(params, key, values)
    try:
        yield
    finally:
        params[key] = before
        params.update()


def set_parameter(params: mi.SceneParameters, key: str, values: np.ndarray) -> None:
    """Set a parameter, in the type of the scene's parameter."""
    params[key] = to_type_of(mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32)), params[key])
    params.update()
