"""Functions for scripts: a problem from a scene and images, its optimization, and fits of photographs.

Conventions. Each function combines parts of ``mivol.optim`` and ``mivol.experiments``. Nothing is printed, and only
:func:`fit_photographs` and :func:`fit_gaussians` write files.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol import config
from mivol.errors import MivolError
from mivol.experiments.fit_kind import NullProgress, Progress, RunContext
from mivol.experiments.kinds import run_experiment
from mivol.fields.field_files import read_field
from mivol.fields.sampled_field import SampledField
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_exr, stack_layers
from mivol.optim.first_order import Adam, to_optimizer
from mivol.optim.loop import Fit, Measure, reconstruct
from mivol.optim.losses import L2, Loss
from mivol.optim.optimizer import Optimizer
from mivol.optim.parameters import Parameter
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.points import Gaussians, read_gaussians
from mivol.scene.explain import describe_light, explain_scene
from mivol.scene.load import SceneSource, load_scene
from mivol.scene.sensors import find_sensor

Reference: TypeAlias = "np.ndarray | mi.TensorXf | str | os.PathLike[str]"
"""An image: an array (height, width, channels) of linear radiance, or an OpenEXR file."""


class Problem(SceneProblem):
    """Scene parameters to fit to images.

    Args:
        scene: a scene, a dict, or the path of an XML file.
        references: one image per sensor; or a scene, a dict or the path of an XML file, rendered from the same sensors by its
            own integrator.
        parameters: keys of ``mi.traverse(scene)``, or :class:`Parameter` with domain, rate and priors.
        loss: one of ``mivol.optim.losses``, or any function (image, reference) -> one number, of tensors (height, width,
            channels).
        integrator: an integrator with derivatives; None means the scene's integrator if from mivol, otherwise mivol's
            integrator with the same depth.
        sensors: sensors of the images, or their numbers in the scene; None means the scene's own sensors.
        spp: samples per pixel of an image, and of its derivative.
        seed: root of all random numbers.

    Raises:
        MivolError: different numbers of images and sensors, images of another size than their sensors or not finite, or an
            unknown key.

    Example:
        >>> problem = mivol.Problem("scene.xml", ["a.exr", "b.exr"], ["smoke.interior_medium.sigma_t.data"])
        >>> fit = mivol.optimize(problem, mivol.Adam(), 100)
    """

    def __init__(
        self,
        scene: SceneSource | mi.Scene,
        references: Sequence[Reference] | SceneSource | mi.Scene,
        parameters: Sequence[str | Parameter],
        *,
        loss: Loss | Callable[[mi.TensorXf, mi.TensorXf], mi.Float | mi.TensorXf] = L2(),  # noqa: B008  (frozen)
        integrator: mi.Integrator | None = None,
        sensors: Sequence[int | mi.Sensor] | None = None,
        spp: int = 16,
        seed: int = 0,
    ) -> None:
        check_whole("spp", spp, 1)
        check_whole("seed", seed, 0)
        if not isinstance(integrator, mi.Integrator | None):
            raise MivolError(
                f"integrator: found {type(integrator).__name__}, expected an integrator: write mi.load_dict({{...}}) around it."
            )
        loaded = load_scene(scene).scene
        image_sensors = [find_sensor(loaded, one) for one in (loaded.sensors() if sensors is None else sensors)]
        fit_parameters = make_parameters(parameters)
        views = make_views(references, image_sensors)
        super().__init__(loaded, views, fit_parameters, integrator or choose_own_integrator(loaded), loss, spp, seed=seed)


def check_whole(name: str, value: int, least: int) -> None:
    """Refuse what is no whole number, and numbers below the least.

    Raises:
        MivolError: with the name and the value.
    """
    if not isinstance(value, int | np.integer) or value < least:
        raise MivolError(f"found {value!r} as {name}, expected a whole number from {least} on.")


def choose_own_integrator(scene: mi.Scene) -> mi.Integrator:
    """Return the scene's integrator if from mivol and without AOVs, otherwise mivol's integrator for the same light.

    Images to fit have no AOVs.
    """
    own = scene.integrator()
    if hasattr(own, "session") and not list(own.aov_names()):
        return own
    return mi.load_dict({"type": "mivol", **describe_light(scene)})


def make_parameters(parameters: Sequence[str | Parameter]) -> list[Parameter]:
    """Return the parameters with their settings.

    Raises:
        MivolError: one key without a list, or an entry that is neither a key nor a :class:`Parameter`.
    """
    if isinstance(parameters, str | Parameter):
        raise MivolError(f"parameters: found a single {type(parameters).__name__}, expected a list; give [parameter].")
    strange = next((one for one in parameters if not isinstance(one, str | Parameter)), None)
    if strange is not None:
        kind = type(strange).__name__
        raise MivolError(f"parameters: found {kind} in the list, expected keys of mi.traverse(scene) or mivol.Parameter.")
    return [Parameter(one) if isinstance(one, str) else one for one in parameters]


def load_reference_scene(references: SceneSource | mi.Scene) -> mi.Scene:
    """Load the scene from which references are rendered.

    Raises:
        MivolError: the path of a single image outside a list, or as :func:`mivol.scene.load.load_scene`.
    """
    if isinstance(references, str | os.PathLike) and Path(references).suffix.lower() != ".xml":
        raise MivolError(
            f"references: found the single file {references}, expected a list of images, one a sensor, or a scene (.xml); "
            "put the file in a list."
        )
    return load_scene(references).scene


def make_views(references: Sequence[Reference] | SceneSource | mi.Scene, sensors: Sequence[mi.Sensor]) -> list[View]:
    """Return the sensors with their images.

    Raises:
        MivolError: different numbers of images and sensors, or as :func:`load_reference_scene`.
    """
    if isinstance(references, str | os.PathLike | Mapping | mi.Scene):
        scene = load_reference_scene(references)
        own = scene.integrator()
        integrator = choose_own_integrator(scene) if own is None or list(own.aov_names()) else own
        with dr.suspend_grad():
            images = [mi.render(scene, sensor=sensor, integrator=integrator, seed=n) for n, sensor in enumerate(sensors)]
    else:
        images = [to_image_tensor(one) for one in references]
    if len(images) != len(sensors):
        raise MivolError(f"found {len(images)} references for {len(sensors)} sensors: give one for each (sensors=...).")
    return [View(f"view {number}", sensor, one) for number, (sensor, one) in enumerate(zip(sensors, images, strict=True))]


def to_image_tensor(reference: Reference) -> mi.TensorXf:
    """Return a reference as a tensor (height, width, channels); a file gives its colours.

    Raises:
        MivolError: an unreadable file, or an array of another shape.
    """
    if isinstance(reference, str | os.PathLike):
        values = stack_layers(read_exr(Path(reference))[0])[""][..., :3]
    else:
        values = np.asarray(reference, dtype=np.float32)
    values = values[..., None] if values.ndim == 2 else values
    if values.ndim != 3:
        raise MivolError(f"a reference has the shape {values.shape}, expected (height, width, channels) of an image.")
    return mi.TensorXf(np.ascontiguousarray(values, dtype=np.float32))


def optimize(
    problem: SceneProblem,
    optimizer: Optimizer | mi.ad.Optimizer | None = None,
    iterations: int = 100,
    *,
    measure: Measure | None = None,
    observer: Callable[[Fit], None] = lambda fit: None,
) -> Fit:
    """Minimize the loss of a problem; the scene holds the result afterwards.

    Args:
        problem: the problem.
        optimizer: an optimizer of mivol or of ``mi.ad``, or any object with a method ``begin(problem)``; None for Adam.
        iterations: largest number of iterations.
        measure: function of the problem that returns errors by name, called at the end.
        observer: function of the fit, called after each iteration.

    Returns:
        The fit: ``fit.values()`` has the parameters, ``fit.history`` the losses.

    Raises:
        MivolError: ``problem`` is of another type, settings outside their domains, a loss that is not finite, or a scene that
            cannot be rendered.
        KeyboardInterrupt: Ctrl-C; the scene holds the newest parameters.
    """
    if not hasattr(problem, "initial_reals"):
        raise MivolError(
            f"found {type(problem).__name__}, expected a problem; write mivol.Problem(scene, references, parameters)."
        )
    check_whole("iterations", iterations, 0)
    # An optimizer of mi.ad has a length, and is false before it has parameters.
    chosen = Adam() if optimizer is None else to_optimizer(optimizer)
    return reconstruct(problem, chosen, iterations, measure=measure, observer=observer)


def explain(
    scene: SceneSource | mi.Scene, max_depth: int | None = None, sensor: int | mi.Sensor = 0, noise: float | None = None
) -> str:
    """Say what a scene needs and how mivol would render it. At most small previews are rendered.

    Args:
        scene: a scene, a dict, or the path of an XML file.
        max_depth: longest path; None means the settings of the scene's own integrator.
        sensor: a sensor, or its index.
        noise: noise of a pixel over the mean radiance. Measure the smallest ``max_depth`` that neglects less light than this
            (:mod:`mivol.scene.previews`); None to measure nothing.

    Returns:
        Facts, choices with their reasons, and the reason of a refusal.

    Raises:
        MivolError: a ``max_depth`` that is no whole number from -1 on; otherwise as :func:`mivol.scene.load.load_scene`.
    """
    if max_depth is not None:
        check_whole("max_depth", max_depth, -1)
    loaded = scene if isinstance(scene, mi.Scene) else load_scene(scene).scene
    return explain_scene(loaded, max_depth, sensor, noise).text


def fit_photographs(
    photographs: str | os.PathLike,
    output: str | os.PathLike = "runs/field",
    settings: Mapping[str, object] | None = None,
    progress: Progress | None = None,
) -> SphericalGrid | SampledField:
    """Fit a radiance field to posed photographs; the run folder has ``field.npz`` and the report page.

    Args:
        photographs: a folder, or its file of cameras (Blender, nerfstudio, instant-ngp, COLMAP).
        output: run folder.
        settings: settings of the TOML file by dotted key, as ``{"field.preset": "tiny", "photos.background": "white"}``; with
            ``"field.kind": "hash"`` the field is a hash grid, with "nerf" a NeRF.
        progress: display of the run's progress; may be None.

    Raises:
        MivolError: as ``mivol optimize``.

    Example:
        >>> field = mivol.fit_photographs("photographs", "runs/field", {"field.preset": "tiny"})
    """
    run_photo_experiment(photographs, output, settings, progress, {})
    return read_field(Path(output) / "field.npz")


def fit_gaussians(
    photographs: str | os.PathLike,
    output: str | os.PathLike = "runs/gaussians",
    settings: Mapping[str, object] | None = None,
    progress: Progress | None = None,
) -> Gaussians:
    """Fit 3D Gaussians to posed photographs; the run folder has ``gaussians.ply`` and the report page.

    Args:
        photographs, output, progress: as :func:`fit_photographs`.
        settings: settings of the TOML file by dotted key, as ``{"gaussians.preset": "tiny", "photos.background": "white"}``.

    Raises:
        MivolError: as ``mivol optimize``.

    Example:
        >>> gaussians = mivol.fit_gaussians("photographs", "runs/gaussians", {"gaussians.preset": "tiny"})
    """
    run_photo_experiment(photographs, output, settings, progress, {"gaussians": {}})
    return read_gaussians(Path(output) / "gaussians.ply")


def run_photo_experiment(
    photographs: str | os.PathLike,
    output: str | os.PathLike,
    settings: Mapping[str, Any] | None,
    progress: Progress | None,
    tables: dict[str, Any],
) -> None:
    """Run an experiment on photographs with these additional tables of settings."""
    path = Path(photographs).resolve()
    raw: dict[str, Any] = {"title": path.stem, "photos": {"path": str(path)}, **tables}
    for key, value in (settings or {}).items():
        *tables, last = key.split(".")
        place = raw
        for table in tables:
            place = place.setdefault(table, {})
        place[last] = value
    experiment = config.from_dict(raw, "settings")
    run_experiment(RunContext(experiment, Path(), Path(output), progress=progress or NullProgress()))
