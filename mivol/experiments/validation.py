"""Comparison of mivol with Mitsuba's path tracer on a scene: images, gradients and a verdict.

Conventions. Both images are means of independent renders with known variances; :func:`mivol.validate.comparison.compare`
compares them. A gradient is checked along a random direction v by Student's t. The mean radiance of mivol's image is
differentiated in reverse mode, g . v, and by central differences of the same image (differences of Mitsuba's image are hundreds
of times noisier). A double step measures the truncation error of the differences.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.experiments.references import set_parameter
from mivol.experiments.render import Passes, render_in_turn
from mivol.files import write_whole_text
from mivol.optim.parameters import as_tensor, find_key
from mivol.optim.scenes.views import derive_seed
from mivol.report import figures
from mivol.scene.explain import describe_light
from mivol.scene.load import LoadedScene
from mivol.scene.sensors import find_sensor
from mivol.scene_graph import traverse
from mivol.validate.reference import Complete, complete_quietly, prepare_reference
from mivol.validate.reference_file import Comparison, ReferenceResult, compare
from mivol.validate.statistics import BATCHES, Estimate, Moments, Significance, effective_dof, z_bound
from mivol.validate.trust import Doubt, find_doubts

AGREES, DIFFERS, UNTRUSTED = 0, 3, 4
"""Exit codes."""

ALPHA = 1e-3
"""Probability that a correct renderer fails, for the image and for the gradients each."""

STEP = 0.02
"""Relative step of central differences. For e^-tau their relative error is (STEP tau)^2 / 6."""

IMAGE, GRADIENT = 1, 2
"""Purposes of random numbers."""


@dataclass(frozen=True)
class Validation:
    """Settings of a validation.

    Attributes:
        max_depth: longest path; None means the scene's own integrator.
        spp: samples per pixel of mivol.
        reference_spp: samples per pixel of Mitsuba's ``volpath``.
        seed: root of all random numbers.
        sensor: index of the sensor.
        parameters: keys of ``mi.traverse(scene)`` whose gradients are checked.
    """

    max_depth: int | None = None
    spp: int = 256
    reference_spp: int = 1024
    seed: int = 0
    sensor: int = 0
    parameters: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.spp < BATCHES:
            raise MivolError(f"{self.spp} samples a pixel are too few: a variance takes {BATCHES} renders of one or more.")


@dataclass(frozen=True)
class Slope:
    """A derivative of the mean radiance along a random direction of a parameter.

    Attributes:
        key: key of the parameter.
        ours: g . v by reverse mode.
        differences: central difference.
        error: standard error of their difference.
        left_out: truncation error: the difference between central differences of double and single step, over 3.
        bound: largest difference that counts as noise.
    """

    key: str
    ours: float
    differences: float
    error: float
    left_out: float
    bound: float

    @property
    def agrees(self) -> bool:
        """Whether both derivatives agree."""
        return abs(self.ours - self.differences) <= self.bound

    @property
    def text(self) -> str:
        """The comparison in a sentence."""
        verdict = "agrees with" if self.agrees else "differs from"
        return (
            f"The derivative by {self.key} along a random direction {verdict} central differences: {self.ours:+.4g} and "
            f"{self.differences:+.4g}, {self.error:.2g} of noise and {self.left_out:.2g} of the step's own."
        )


@dataclass(frozen=True)
class Efficiency:
    """Variance and time of the images of both integrators.

    Attributes:
        variance, reference_variance: mean variance of the two images over pixels and channels.
        seconds, reference_seconds: wall time of the renders, with the compilation of their kernels [s].
    """

    variance: float
    reference_variance: float
    seconds: float
    reference_seconds: float

    @property
    def gain(self) -> float | None:
        """Time of volpath over time of mivol at equal error: the ratio of variance x time; None without noise to compare."""
        if min(self.variance, self.reference_variance, self.seconds, self.reference_seconds) <= 0:
            return None
        return self.reference_variance * self.reference_seconds / (self.variance * self.seconds)

    @property
    def text(self) -> str:
        """The comparison in a sentence."""
        times = f"renders of {self.seconds:.2g} s and {self.reference_seconds:.2g} s, with the compilation of kernels"
        if self.gain is None:
            return f"Times at equal error cannot be compared: an image has no noise ({times})."
        return f"At equal error volpath takes {self.gain:.3g} times the time of mivol (variance x time; {times})."


@dataclass(frozen=True)
class Verdict:
    """Result of a validation.

    Attributes:
        comparison: comparison of the images.
        rel_mse: mean over pixels and channels of (ours - reference)^2 / (reference^2 + 1e-2 of its mean square).
        efficiency: variance and time of both images.
        slopes: derivatives of the named parameters.
        doubts: reasons to distrust the reference.
        files: written files.
    """

    comparison: Comparison
    rel_mse: float
    efficiency: Efficiency
    slopes: tuple[Slope, ...]
    doubts: tuple[Doubt, ...]
    files: tuple[Path, ...] = ()

    @property
    def code(self) -> int:
        """Exit code: 0 for agreement, 4 for an untrusted reference, 3 for a difference."""
        if any(doubt.fatal for doubt in self.doubts):
            return UNTRUSTED
        return AGREES if self.comparison.agrees and all(slope.agrees for slope in self.slopes) else DIFFERS

    @property
    def words(self) -> str:
        """The verdict in a sentence."""
        reason = "; the doubt above may be the reason" if self.doubts else ""
        return {
            AGREES: "mivol agrees with Mitsuba's volpath on this scene.",
            DIFFERS: f"mivol differs from Mitsuba's volpath on this scene{reason}.",
            UNTRUSTED: f"Mitsuba {mi.__version__} is no reference here, so nothing is decided.",
        }[self.code]

    @property
    def text(self) -> str:
        """All results in lines."""
        lines = [f"Doubt: {doubt.sentence}" for doubt in self.doubts]
        lines += [self.comparison.text, f"relMSE {self.rel_mse:.3g}.", *(slope.text for slope in self.slopes)]
        lines += [self.words, self.efficiency.text]
        return "\n".join([*lines, *(str(path) for path in self.files)])


def validate_scene(
    loaded: LoadedScene,
    folder: Path,
    settings: Validation,
    complete: Complete = complete_quietly,
    make_passes: Callable[..., Passes] = render_in_turn,
) -> Verdict:
    """Compare mivol with Mitsuba's path tracer; write ``validation.json``, ``validation.png`` and the reference.

    Args:
        loaded: the scene.
        folder: folder of the results; created if missing.
        settings: settings.
        complete: renders the reference, in this process or on workers.
        make_passes: makes the function that renders mivol's image from scene, sensor and integrator.

    Raises:
        MivolError: a scene that mivol or Mitsuba cannot render, or an unknown parameter.
    """
    scene, camera = loaded.scene, find_sensor(loaded.scene, settings.sensor)
    for key in settings.parameters:
        find_key(key, traverse(scene))
    folder.mkdir(parents=True, exist_ok=True)
    light = describe_light(scene, settings.max_depth)
    integrator = mi.load_dict({"type": "mivol", **light})
    image, seconds = render_batches(make_passes(scene, camera, integrator), settings)
    doubts = tuple(find_doubts(scene, [camera]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # doubts are part of the verdict
        prepared = prepare_reference(
            loaded, folder, **light, max_spp=settings.reference_spp, seed=settings.seed + 1, sensor=camera, accept_doubts=True
        )  # fmt: skip
        (reference,) = complete(iter([prepared]))
    estimate = Estimate.from_result(image)
    # Our spread of a pixel that saw nothing is 0, and so may be volpath's: one missed event a pixel is allowed for.
    compared = compare(estimate, reference, alpha=ALPHA, samples_seen=float(reference.mean.max()), correlated=27)
    slopes = check_gradients(scene, camera, integrator, settings)
    floor = 1e-2 * float(np.mean(reference.mean**2)) or 1.0
    rel_mse = float(np.mean((estimate.mean - reference.mean) ** 2 / (reference.mean**2 + floor)))
    efficiency = Efficiency(float(estimate.var.mean()), float(reference.variance.mean()), seconds, reference.seconds)
    verdict = Verdict(compared, rel_mse, efficiency, slopes, doubts)
    return write_verdict(verdict, estimate, reference, folder, settings)


def render_batches(passes: Passes, settings: Validation) -> tuple[Moments, float]:
    """Render the colour channels in independent batches; also returns their time [s]."""
    spp = math.ceil(settings.spp / BATCHES)
    found = list(passes([(derive_seed(settings.seed, IMAGE, batch), spp) for batch in range(BATCHES)]))
    return Moments.from_batches(image for image, _ in found), math.fsum(seconds for _, seconds in found)


# -- Gradients ----------------------------------------------------------------------------------------------------


def check_gradients(scene: mi.Scene, camera: mi.Sensor, integrator: mi.Integrator, settings: Validation) -> tuple[Slope, ...]:
    """Check the derivative of the mean radiance along one random direction of each parameter."""
    level = Significance(ALPHA, max(len(settings.parameters), 1))
    return tuple(check_gradient(scene, camera, integrator, key, settings, level) for key in settings.parameters)


def check_gradient(
    scene: mi.Scene, camera: mi.Sensor, integrator: mi.Integrator, key: str, settings: Validation, level: Significance
) -> Slope:
    """Check one direction of one parameter: each value times a random number from 0 to 2.

    So no step passes 0, and the effects of the values do not cancel.
    """
    params = traverse(scene)
    start = np.array(as_tensor(params[key]), dtype=np.float64)
    direction = np.random.default_rng([settings.seed, len(key)]).uniform(0.0, 2.0, start.shape) * start
    if not direction.any():
        raise MivolError(f"{key} is 0 everywhere, where a central difference would step below 0: put values into the scene.")
    mean = MeanRadiance(scene, camera, integrator, key, math.ceil(settings.spp / BATCHES))
    slopes, near, far = Moments.empty(), Moments.empty(), Moments.empty()
    for batch in range(BATCHES):
        seeds = [derive_seed(settings.seed, GRADIENT, batch, which) for which in range(4)]
        slopes = slopes.add(mean.slope(direction, seeds[0], seeds[1]))
        near = near.add(mean.difference(start, STEP * direction, seeds[2]) / STEP)
        far = far.add(mean.difference(start, 2 * STEP * direction, seeds[3]) / (2 * STEP))
    set_parameter(params, key, start)
    g, d = Estimate.from_result(slopes), Estimate.from_result(near)
    error = float(np.sqrt(g.var + d.var))
    left_out = abs(float(far.mean - near.mean)) / 3
    dof = effective_dof(np.array([g.var, d.var]), np.array([g.dof, d.dof]))
    return Slope(key, float(g.mean), float(d.mean), error, left_out, float(z_bound(level, dof)) * error + left_out)


@dataclass(frozen=True)
class MeanRadiance:
    """The mean radiance of a render as a function of one parameter.

    Attributes:
        scene, camera, integrator: the render.
        key: parameter, a key of ``mi.traverse(scene)``.
        spp: samples per pixel of one render.
    """

    scene: mi.Scene
    camera: mi.Sensor
    integrator: mi.Integrator
    key: str
    spp: int

    def slope(self, direction: np.ndarray, seed: int, seed_grad: int) -> float:
        """d mean / d t of the parameter x + t v, by reverse mode."""
        params = traverse(self.scene)
        dr.enable_grad(params[self.key])
        params.update()
        how = {"integrator": self.integrator, "sensor": self.camera, "spp": self.spp}
        image = mi.render(self.scene, params, seed=seed, seed_grad=seed_grad, **how)
        dr.backward(dr.mean(image, axis=None))
        gradient = np.array(as_tensor(dr.grad(params[self.key])), dtype=np.float64)
        dr.disable_grad(params[self.key])
        return float(np.sum(gradient * direction))

    def difference(self, start: np.ndarray, step: np.ndarray, seed: int) -> float:
        """Half the difference of the means one step forward and one step back, with the same random numbers."""
        params, means = traverse(self.scene), []
        for sign in (1.0, -1.0):
            set_parameter(params, self.key, start + sign * step)
            with dr.suspend_grad():
                image = self.integrator.render(self.scene, self.camera, seed=seed, spp=self.spp)
            means.append(float(np.mean(np.asarray(image), dtype=np.float64)))
        set_parameter(params, self.key, start)
        return (means[0] - means[1]) / 2


# -- Files --------------------------------------------------------------------------------------------------------


def write_verdict(verdict: Verdict, image: Estimate, reference: ReferenceResult, folder: Path, settings: Validation) -> Verdict:
    """Write ``validation.json`` and ``validation.png``; return the verdict with their paths."""
    compared = verdict.comparison
    picture = figures.save_figure(figures.plot_image_row(reference.mean, image.mean, compared.z), folder / "validation.png")
    about = {
        "verdict": verdict.words,
        "code": verdict.code,
        "bias": asdict(compared.bias),
        "z": {"bound": compared.bound, "share beyond": compared.beyond, "worst": float(np.max(np.abs(compared.z)))},
        "relMSE": verdict.rel_mse,
        "psnr": compared.psnr,
        "time ratio": asdict(verdict.efficiency) | {"gain": verdict.efficiency.gain},
        "gradients": [asdict(slope) | {"agrees": slope.agrees} for slope in verdict.slopes],
        "doubts": [asdict(doubt) for doubt in verdict.doubts],
        "settings": asdict(settings),
        "reference": reference.path.name,
    }
    path = folder / "validation.json"
    write_whole_text(path, json.dumps(about, indent=2) + "\n")
    return replace(verdict, files=(path, picture))
