r"""The first values of the parameters of a scene fit, with their units and the places of their grids.

Conventions. Memory is checked before the allocation, for the first grids and for the refined grids of later events. ``length``
and ``radiance`` are the units of the scene; ``1`` is a pure number; "" is an unknown unit.

Emissive starts. A scattering volume can start from the density of a radiance field, fitted to the same views:

.. math:: x_0 = c \, \bar\sigma, \qquad c = \arg\min_{c \in C} f\big(S^n (c \, \bar\sigma)\big)

sigma-bar is the density of the radiance field, averaged over the voxels of the grid and scaled to the mean of the grid's own
start. C are the powers of 2 in :data:`FACTORS`, and S^n the first :data:`TRIAL` steps of the fit.

A dense scattering medium has local minima: matter in the shadow of other matter is as dark as empty space. A radiance field
is emissive, and the fit carves the shape from the silhouettes and puts the shading into the colours. Its density is no
extinction of the scattering model (a surface is as opaque as the views allow), hence the factor. The loss of a start does not
predict the best factor; each factor therefore gets a few steps.

Bias: none in the following fit, whose loss is unchanged; only the start differs. Cost: a fit of a radiance field (about 15 s of
processor time on 32^3 nodes), and :data:`TRIAL` steps and a loss for each factor.

Reference: Nimier-David, Müller, Keller, Jakob 2022 (Unbiased inverse volume rendering with differential trackers, section 6),
who begin with an emissive volume; the factor is not theirs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from mivol.back_end import check_memory
from mivol.config import SceneExperiment, Sought
from mivol.errors import MivolError
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import read_volume
from mivol.files.fetch import resolve_path as place_in
from mivol.files.image_files import encode_srgb
from mivol.optim.events import Upsample, check_for_grids
from mivol.optim.loop import begin_fit
from mivol.optim.optimizer import Optimizer
from mivol.optim.parameters import GRID, Parameter, as_tensor, find_key
from mivol.optim.photographs.radiance_plan import RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.photos import Photo
from mivol.scene.sensors import to_camera
from mivol.scene_graph import traverse
from mivol.transport.media.stock_grids import find_grid_place

NUMBER_BYTES = 6 * 4
"""Memory per fitted number [byte]: value, copy in the scene, optimized real, derivative and two moments of the optimizer."""


@dataclass(frozen=True)
class Start:
    """A parameter and its first value."""

    parameter: Parameter
    value: np.ndarray


def make_starts(settings: SceneExperiment, base: Path, scene: mi.Scene) -> list[Start]:
    """Return all parameters of a fit with their first values; the scene is not changed.

    Raises:
        MivolError: as :func:`make_start`, refined grids beyond the memory, or an upsample event without a grid.
    """
    starts = [make_start(entry, base, scene) for entry in settings.parameter]
    grids = [start for start in starts if start.value.ndim == GRID]
    if any(isinstance(event, Upsample) for event in settings.event):
        check_for_grids(len(grids))
    for start in grids:
        check_grid_memory(
            start.parameter.name, final_shape(start.value.shape, settings), "let upsample refine less, or start coarser"
        )
    return starts


def final_shape(shape: Sequence[int], settings: SceneExperiment) -> tuple[int, ...]:
    """Shape of a grid after all events of a fit."""
    factor, last = 1, settings.fit.iterations
    for event in settings.event:
        if isinstance(event, Upsample):
            factor *= event.factor ** sum(0 <= iteration < last for iteration in set(event.at))
    return (*(n * factor for n in shape[:3]), *shape[3:])


def check_grid_memory(key: str, shape: Sequence[int], way_out: str) -> None:
    """Refuse a grid beyond the memory.

    Raises:
        MivolError: with its shape and size.
    """
    size = " x ".join(str(n) for n in shape)
    check_memory(NUMBER_BYTES * math.prod(shape), f"{key} of {size} numbers, with its derivative and the optimizer,", way_out)


def make_start(settings: Sought, base: Path, scene: mi.Scene) -> Start:
    """Return a parameter with its first value; the scene is not changed.

    Raises:
        MivolError: an unknown parameter, a value outside the domain, an unreadable file, or a grid beyond the memory.
    """
    params = traverse(scene)
    start_value = as_tensor(params[find_key(settings.key, params)])
    # A copy: the scene may give the memory behind a view to another tensor when its parameter changes.
    value = np.array(start_value)
    if start_value.ndim < GRID and (settings.shape or settings.start_file):
        raise MivolError(
            f"{settings.key} has the shape {start_value.shape}, which is not a grid of voxels: give start, but neither shape "
            "nor start_file."
        )
    if settings.start_file:
        value = read_volume(place_in(base, settings.start_file)).values
    elif settings.start is not None:
        shape = (*settings.shape, start_value.shape[3]) if settings.shape else start_value.shape
        check_grid_memory(settings.key, shape, "give parameter.shape fewer voxels")
        value = np.full(shape, check_start(settings, shape), dtype=np.float32)
    extent = box_edge_lengths(grid_to_world(settings.key, scene))[::-1] if value.ndim >= GRID else (1.0, 1.0, 1.0)
    parameter = Parameter(settings.key, settings.unit, settings.domain, settings.map, settings.lr, extent, settings.prior)
    parameter.to_reals(mi.TensorXf(np.ascontiguousarray(value)))
    return Start(parameter, value)


def check_start(settings: Sought, shape: Sequence[int]) -> Any:
    """Return the first value in the settings: one number, or one number per channel.

    Raises:
        MivolError: another count of numbers.
    """
    given = np.size(settings.start)
    if given not in (1, shape[-1]):
        raise MivolError(f"{settings.key} starts from {given} numbers and has {shape[-1]} channels: give 1 or {shape[-1]}.")
    return settings.start


def grid_to_world(key: str, scene: mi.Scene) -> np.ndarray:
    """Transform (4, 4) from the unit cube to the world for the grid of a parameter."""
    return find_grid_place(traverse(scene).properties[key][2])


def box_edge_lengths(place: np.ndarray) -> tuple[float, float, float]:
    """Lengths (x, y, z) of the edges of a grid's box."""
    return tuple(float(edge) for edge in np.linalg.norm(place[:3, :3], axis=0))


# -- Emissive starts -------------------------------------------------------------------------------------------------------


FACTORS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Tried means of the start, in means of the grid's own start."""

TRIAL = 10
"""Steps of the fit for each factor."""

PLAN = RadiancePlan((RadianceStage(16, 100, 2, 16, 32), RadianceStage(32, 200, 1, 16, 64)), degree=1, sky=16)
"""A coarse plan, since the scattering fit refines the result. Degree 1, because a shaded side is darker in all directions; a
sky, because views of a scene show its background."""

BRIGHTEST = 99.5
"""Percentile of the radiance shown as white. Photographs have 8 bits, and a sun would use all of them."""

LEAST = 1e-3
"""Smallest value of the start over its mean: maps to the logarithm have no 0, and a fit leaves 0 slowly."""

PARTS = 3
"""Points along each edge of a voxel, whose mean is the voxel's density."""


@dataclass(frozen=True)
class EmissiveStart:
    """A start from an emissive fit.

    Attributes:
        value: of the grid, (Z, Y, X, C).
        factor: best of :data:`FACTORS`.
        losses: loss of each factor after its trial.
    """

    value: np.ndarray
    factor: float
    losses: tuple[float, ...]

    @property
    def description(self) -> str:
        """A sentence for the report."""
        trials = ", ".join(f"{loss:.3g} for {factor:g}" for factor, loss in zip(FACTORS, self.losses, strict=True))
        return (
            f"starts from an emissive fit of the same views, at {self.factor:g} times the mean of the given start "
            f"(losses after {TRIAL} steps: {trials})"
        )


def find_emissive_start(
    problem: SceneProblem, name: str, to_world: np.ndarray, optimizer: Optimizer, seed: int = 0
) -> EmissiveStart:
    """Fit an emissive volume to a problem's views, and scale the density by the best factor.

    Args:
        problem: with the scene at its own start, whose mean the factors multiply; the problem holds this start again
            afterwards.
        name: name of the parameter, a grid.
        to_world: (4, 4) map from the unit cube to the grid's box.
        optimizer: optimizer of the fit.
        seed: root of the random rays.

    Raises:
        MivolError: a parameter that is no grid, a start of 0, a sensor that is no perspective camera, or views that show
            nothing in the box.
    """
    start = problem.initial_reals()
    value = np.array(problem.values()[name])
    check_given_start(name, value)
    density = average_density(fit_emission(problem.views, to_world, seed), to_world, value.shape[:3])
    if not density.max() > 0:
        raise MivolError(f"the views show nothing in the box of {name}: check the cameras, or set start instead of start_fit.")
    density = np.maximum(density / density.mean(), LEAST)[..., None]
    shape = np.broadcast_to(value.mean() * density, value.shape).astype(np.float32)
    losses = [_loss_after_trial(problem, optimizer, _reals_with(problem, start, name, factor * shape)) for factor in FACTORS]
    problem.set_reals(start)
    best = FACTORS[int(np.argmin(losses))]
    return EmissiveStart(best * shape, best, tuple(losses))


def check_given_start(name: str, value: np.ndarray) -> None:
    """Check the start to be replaced by an emissive start.

    Raises:
        MivolError: a parameter without a grid, or a start of 0.
    """
    if value.ndim != 4:
        raise MivolError(f"{name} has the shape {value.shape}, an emissive start needs a grid (Z, Y, X, C): set start instead.")
    if not value.mean() > 0:
        raise MivolError(f"{name} starts from a mean of {value.mean():.4g}, an emissive start needs a mean above 0: set start.")


def fit_emission(views: Sequence[View], to_world: np.ndarray, seed: int) -> SphericalGrid:
    """The radiance field of some views, in the axis-aligned box around the box ``to_world``."""
    corners = np.array([[x, y, z, 1.0] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ to_world.T
    box = np.array([corners[:, :3].min(axis=0), corners[:, :3].max(axis=0)])
    batches = RayBatches.from_photos(to_photographs(views), [stage.shrink for stage in PLAN.stages])
    fit = begin_radiance_fit(batches, box, PLAN, seed)
    while not fit.is_done:
        fit.advance()
    return current_field(fit)


def to_photographs(views: Sequence[View]) -> list[Photo]:
    """Photographs of views: sRGB codes of the radiance, white at the percentile :data:`BRIGHTEST` of the views."""
    images = [np.array(view.reference, dtype=np.float32) for view in views]
    images = [image[..., :3] if image.shape[2] >= 3 else np.repeat(image[..., :1], 3, axis=2) for image in images]
    white = float(np.percentile(np.concatenate([image.ravel() for image in images]), BRIGHTEST))
    black = np.zeros(3, np.float32)
    codes = [encode_srgb(image / max(white, 1e-30)).astype(np.float32) for image in images]
    cameras = [to_camera(view.sensor, view.name) for view in views]
    return [Photo(view.name, code, None, None, camera, black) for view, code, camera in zip(views, codes, cameras, strict=True)]


def average_density(field: SphericalGrid, to_world: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Mean density of a field in each voxel (Z, Y, X) of a grid [1/length], from :data:`PARTS`^3 points per voxel."""
    density, _ = field.to_dense()
    sigma = np.array(field.activation_function.value_and_slope(mi.Float(density.reshape(-1)))[0]).reshape(field.res)
    z, y, x = np.meshgrid(*((np.arange(PARTS * n) + 0.5) / (PARTS * n) for n in shape), indexing="ij")
    unit = np.stack([x, y, z, np.ones_like(x)], axis=-1) @ (np.linalg.inv(field.to_world) @ to_world).T
    nodes = [unit[..., 2 - k] * field.res[k] - 0.5 for k in range(3)]
    inside = np.all([(unit[..., k] >= 0) & (unit[..., k] <= 1) for k in range(3)], axis=0)
    density = np.where(inside, map_coordinates(sigma, nodes, order=1, mode="nearest"), 0)
    return density.reshape(shape[0], PARTS, shape[1], PARTS, shape[2], PARTS).mean(axis=(1, 3, 5))


def _loss_after_trial(problem: SceneProblem, optimizer: Optimizer, reals: dict[str, mi.TensorXf]) -> float:
    """The loss after the first steps of a fit."""
    problem.set_reals(reals)
    fit = begin_fit(problem, optimizer, TRIAL)
    fit.complete()
    return problem.loss_value(fit.run.reals, TRIAL)


def _reals_with(problem: SceneProblem, start: dict[str, mi.TensorXf], name: str, value: np.ndarray) -> dict[str, mi.TensorXf]:
    """The reals of a problem with another value of a parameter, clipped to the domain."""
    parameter = next(p for p in problem.parameters if p.name == name)
    low, high = parameter.domain
    return start | {name: parameter.to_reals(mi.TensorXf(np.clip(value, low, high).astype(np.float32)))}
