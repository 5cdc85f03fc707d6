r"""A start for volumes that scatter: matter that shines by itself and only absorbs, fitted to the same views.

.. math:: x_0 = c \, \bar\sigma, \qquad c = \arg\min_{c \in C} f\big(S^n (c \, \bar\sigma)\big)

with sigma-bar the density of a radiance field that was fitted to the views, averaged over the voxels of the grid that is looked
for and brought to the mean of the grid's own start; C the powers of 2 in :data:`FACTORS`; and S^n the first :data:`TRIAL` steps
of the fit itself.

A dense medium that scatters has local minima: what lies in the shade of other matter is as dark as what is not there. A
radiance field has no light that would have to get in, so its fit carves the shape from the silhouettes and leaves the shading
to the colours. Its density is no extinction of the scattering model (a surface is as opaque as the views allow), hence the
factor. The loss of a start does not tell which factor is best: of the LES cloud at a vertical optical depth of 6.5 the best one
began at 0.0197, a constant fog at 0.0167, and after 20 steps they had 3.4e-4 and 1.9e-3. So each factor gets a few steps.

Bias: none in the fit that follows, whose loss is what it was; only where it starts differs. Cost: a fit of a radiance field
(some 15 s of processor time on 32^3 nodes), and :data:`TRIAL` steps and a loss for each factor.

Reference: Nimier-David, Müller, Keller, Jakob 2022 (Unbiased inverse volume rendering with differential trackers, section 6),
who begin with an emissive volume; the factor is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files.image_files import encode_srgb
from mivol.optim.loop import begin_fit
from mivol.optim.optimizer import Optimizer
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.photos import Photo
from mivol.scene.sensors import camera_of

__all__ = ["FACTORS", "EmissiveStart", "average_density", "find_emissive_start", "fit_emission", "to_photographs"]

FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Means of the start that are tried, in means of the grid's own start."""

TRIAL = 10
"""Steps of the fit that each factor gets."""

PLAN = RadiancePlan((RadianceStage(16, 100, 2, 16, 32), RadianceStage(32, 200, 1, 16, 64)), degree=1, sky=16)
"""Coarse: the scattering fit refines it. Degree 1, since a shaded side is darker in all directions; a sky, since views of a
scene show what is behind."""

BRIGHTEST = 99.5
"""Percentile of the radiance that becomes white: photographs have 8 bits, and a sun's disk would leave none for the rest."""

LEAST = 1e-3
"""Smallest value of the start, in its mean: maps to the logarithm have no 0, and a fit leaves 0 slowly."""

PARTS = 3
"""Points along each edge of a voxel whose mean is the voxel's density."""


@dataclass(frozen=True)
class EmissiveStart:
    """What was found.

    Attributes:
        value: of the grid, (Z, Y, X, C).
        factor: of :data:`FACTORS`.
        losses: of each of them, after its trial.
    """

    value: np.ndarray
    factor: float
    losses: tuple[float, ...]

    @property
    def text(self) -> str:
        """A sentence."""
        tried = ", ".join(f"{loss:.3g} from {factor:g}" for factor, loss in zip(FACTORS, self.losses, strict=True))
        return (
            f"starts from an emissive fit of the same views, at {self.factor:g} times the mean of the given start "
            f"(losses after {TRIAL} steps: {tried})"
        )


def find_emissive_start(
    problem: SceneProblem, name: str, place: np.ndarray, optimiser: Optimizer, seed: int = 0
) -> EmissiveStart:
    """Fit an emissive volume to a problem's views, and scale it so that the fit gets furthest.

    Args:
        problem: with the scene at its own start, whose mean the factors multiply; it holds that start again afterwards.
        name: of the parameter, a grid.
        place: (4, 4) the map of the unit cube to the grid's box.
        optimiser: of the fit.
        seed: of the rays.

    Raises:
        MivolError: a parameter that is no grid, a start that is 0, a sensor that is no perspective camera, or views that show
            nothing in the box.
    """
    own = problem.initial_reals()
    value = np.array(problem.values()[name])
    check_given_start(name, value)
    density = average_density(fit_emission(problem.views, place, seed), place, value.shape[:3])
    if not density.max() > 0:
        raise MivolError(f"the views show nothing in the box of {name}: look at the cameras, or give start instead.")
    density = np.maximum(density / density.mean(), LEAST)[..., None]
    shape = np.broadcast_to(value.mean() * density, value.shape).astype(np.float32)
    losses = [_try(problem, optimiser, _reals(problem, own, name, factor * shape)) for factor in FACTORS]
    problem.set_reals(own)
    best = FACTORS[int(np.argmin(losses))]
    return EmissiveStart(best * shape, best, tuple(losses))


def check_given_start(name: str, value: np.ndarray) -> None:
    """Refuse a start that no emissive one can take the place of.

    Raises:
        MivolError: a parameter that is no grid, or a start that is 0.
    """
    if value.ndim != 4:
        raise MivolError(f"{name} has the shape {value.shape}, an emissive start has that of a grid (Z, Y, X, C): give start.")
    if not value.mean() > 0:
        raise MivolError(f"{name} starts from a mean of {value.mean():.4g}, an emissive start scales one above 0: give start.")


def fit_emission(views: Sequence[View], place: np.ndarray, seed: int = 0) -> SphericalGrid:
    """The radiance field that views show, in the axis-aligned box about ``place``."""
    corners = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ place.T
    box = np.array([corners[:, :3].min(axis=0), corners[:, :3].max(axis=0)])
    batches = RayBatches.of(to_photographs(views), [stage.shrink for stage in PLAN.stages])
    fit = begin_radiance_fit(batches, box, PLAN, seed)
    while not fit.is_done:
        fit.advance()
    return current_field(fit)


def to_photographs(views: Sequence[View]) -> list[Photo]:
    """Views as photographs: sRGB codes of the radiance, white at the percentile :data:`BRIGHTEST` of all views."""
    images = [np.array(view.reference, dtype=np.float32) for view in views]
    images = [image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2) for image in images]
    white = float(np.percentile(np.concatenate([image.ravel() for image in images]), BRIGHTEST))
    black = np.zeros(3, np.float32)
    codes = [encode_srgb(image / max(white, 1e-30)).astype(np.float32) for image in images]
    looks = [camera_of(view.sensor, view.name) for view in views]
    return [Photo(view.name, code, None, None, look, black) for view, code, look in zip(views, codes, looks, strict=True)]


def average_density(field: SphericalGrid, place: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Mean density of a field in each voxel (Z, Y, X) of a grid, by :data:`PARTS`^3 points of it [1/length]."""
    density, _ = field.to_dense()
    sigma = np.array(field.activation_function.value_and_slope(mi.Float(density.reshape(-1)))[0]).reshape(field.res)
    z, y, x = np.meshgrid(*((np.arange(PARTS * n) + 0.5) / (PARTS * n) for n in shape), indexing="ij")
    unit = np.stack([x, y, z, np.ones_like(x)], axis=-1) @ (np.linalg.inv(field.to_world) @ place).T
    nodes = [unit[..., 2 - k] * field.res[k] - 0.5 for k in range(3)]
    inside = np.all([(unit[..., k] >= 0) & (unit[..., k] <= 1) for k in range(3)], axis=0)
    found = np.where(inside, map_coordinates(sigma, nodes, order=1, mode="nearest"), 0)
    return found.reshape(shape[0], PARTS, shape[1], PARTS, shape[2], PARTS).mean(axis=(1, 3, 5))


def _try(problem: SceneProblem, optimiser: Optimizer, reals: dict[str, mi.TensorXf]) -> float:
    """The loss after the first steps of a fit."""
    problem.set_reals(reals)
    fit = begin_fit(problem, optimiser, TRIAL)
    fit.complete()
    return problem.loss_value(fit.run.reals, TRIAL)


def _reals(problem: SceneProblem, own: dict[str, mi.TensorXf], name: str, value: np.ndarray) -> dict[str, mi.TensorXf]:
    """The reals of a problem with another value of one parameter, brought to its domain."""
    parameter = next(p for p in problem.parameters if p.name == name)
    low, high = parameter.domain
    return own | {name: parameter.to_reals(mi.TensorXf(np.clip(value, low, high).astype(np.float32)))}
