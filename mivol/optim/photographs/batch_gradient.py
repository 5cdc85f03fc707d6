"""Loss and gradient of a batch of rays through a radiance field, and the moves of a field after a step, for recordings.

Conventions. A step is three functions of arrays: the gradient (:func:`differentiate_tiles`), the step of the optimizer with the
moves of single numbers (:func:`move_numbers`), and the moves that compare neighbours (:func:`move_rows`). Each is recorded once
and replayed while its settings and the sizes of its arrays stay the same
(:class:`mivol.kernel_recording.RecordedFunctions`).

Cameras may move with a fit. From time to time each camera takes a damped least-squares step
(:class:`mivol.photos.camera.Motions`) on random tiles of its photograph, while the model is constant. Between these corrections
the model is fitted, while the cameras are constant. A turn and a shift can look alike, so only their sum is known. A prior on
both keeps each small. The scene then stays where the held-out photographs see it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.photographs.photo_colours import Exposure, LinearScale, RayErrors, SrgbScale, compare_rays, mean_of
from mivol.optim.photographs.ray_batches import DepthRays, PixelTable, RayBatch, RayBatches, depth_loss_gradient
from mivol.optim.priors import Move, move_values
from mivol.optim.problem import Reals
from mivol.photos import Camera
from mivol.photos.camera import Motions, motion_unit, move_camera
from mivol.transport.line_integrals.radiance_field import Model, RayGradient, RenderedRays, make_model, render_rays, vjp_rays
from mivol.transport.line_integrals.radiance_source import Baked, bake, vjp_bake
from mivol.transport.traversal.occupied_cells import OccupiedCells


@dataclass(frozen=True)
class GradientSettings:
    """What is the same in all steps of a stage.

    Attributes:
        scale: of the photographs' values.
        stop, beta, depth: as in the plan (:class:`mivol.optim.photographs.radiance_plan.RadiancePlan`).
        near: distance from a camera below which derivatives fall [length].
        has_gains: whether gains are fitted.
        share: of the batch in a step, a factor on the derivatives of rays.
    """

    scale: SrgbScale | LinearScale
    stop: float
    beta: float
    depth: float
    near: float
    has_gains: bool
    share: float


@dataclass
class FieldModel:
    """A field with its occupied cells, its background, and the gains of the photographs.

    Attributes:
        field: the radiance field.
        cells: its occupied cells.
        sky: background, if it is fitted.
        exposure: gains of the photographs, if the plan has gains.
    """

    field: SphericalGrid
    cells: OccupiedCells
    sky: Sky | None
    exposure: Exposure | None


def differentiate_tiles(
    settings: GradientSettings,
    model: FieldModel,
    reals: Reals,
    pixels: PixelTable,
    offsets: mi.Float,
    background: mi.Color3f | None,
    depth_rays: DepthRays | None,
) -> Reals:
    """The loss of the tiles of a step and the derivatives by the reals, as shares of the step's mean.

    Args:
        model: with the values of ``reals``.
        reals: of the step.
        pixels: tiles of the step.
        offsets: of the pinholes from the field (:meth:`mivol.fields.spherical_grid.SphericalGrid.offsets_from`).
        background, depth_rays: as :func:`differentiate_batch`.
    """
    loss, slopes = differentiate_batch(settings, model, pixels.make_tiles(offsets), background, depth_rays)
    for name in ("harmonics", "sky"):
        if name in reals:
            slopes[name] = settings.scale.gradient_by_reals(slopes[name], reals[name].array)
    found = {name: mi.TensorXf(slopes[name], value.shape) for name, value in reals.items()}
    return found | {"loss": mi.TensorXf(mean_of(loss) * settings.share, (1,))}


def differentiate_batch(
    settings: GradientSettings,
    model: FieldModel,
    batch: RayBatch,
    background: mi.Color3f | None,
    depth_rays: DepthRays | None,
) -> tuple[mi.Float, dict[str, mi.Float]]:
    """Squared error of each ray of a batch, weighted, mean over rgb, and derivatives of the mean over rays, by parameter.

    Args:
        batch: rays and their target colours.
        background: put behind all photographs; None keeps each photograph's own background.
        depth_rays: points of the same views; only the derivatives contain the plan's weight times their energy.
    """
    field, cells, sky, exposure, share = model.field, model.cells, model.sky, model.exposure, settings.share
    source = bake(field, cells, batch.origins, batch.slot, slope=True)
    colours, count = make_model(field, settings.stop), dr.width(batch.slot)
    rendered = render_rays(cells, source, colours, batch.rays)
    errors = _compare_batch(settings, model, batch, rendered, background)
    by_radiance, by_T, loss = errors.by_radiance * share, errors.by_T * share, errors.loss
    if settings.beta > 0:
        # Bounded: at 0 and 1 the prior is satisfied, and its derivative is infinite.
        T = dr.clip(rendered.T, 0.01, 0.99)
        by_T += settings.beta * share / count * batch.counted * (dr.rcp(T) - dr.rcp(1 - T))
    dr.eval(rendered, by_radiance, by_T, loss)
    vjp_rays(cells, source, colours, rendered, RayGradient(by_radiance, by_T), near=settings.near)
    if depth_rays is not None:
        _add_depth_gradient(settings, cells, source, colours, depth_rays)
    dr.eval(source.slope)
    density, harmonics = vjp_bake(field, cells, source, batch.origins)
    gradient = {"density": _stored(field, density), "harmonics": _stored(field, harmonics)}
    if sky is not None:
        gradient["sky"] = sky.texel_gradient(batch.rays.d, by_radiance * rendered.T)
    if exposure is not None:
        by_log_gain = errors.by_colour * errors.colour * share if settings.has_gains else mi.Color3f(0)
        gradient["exposure"] = exposure.gradient(batch.view, by_log_gain)
    return loss, gradient


def find_errors(settings: GradientSettings, model: FieldModel, pixels: PixelTable, offsets: mi.Float) -> mi.Color3f:
    """Weighted differences of rays from their photographs, over the photographs' own backgrounds; arguments as
    :func:`differentiate_tiles`.
    """
    batch = pixels.make_tiles(offsets)
    source = bake(model.field, model.cells, batch.origins, batch.slot)
    rendered = render_rays(model.cells, source, make_model(model.field, settings.stop), batch.rays)
    return _compare_batch(settings, model, batch, rendered).error


def _compare_batch(
    settings: GradientSettings,
    model: FieldModel,
    batch: RayBatch,
    rendered: RenderedRays,
    background: mi.Color3f | None = None,
) -> RayErrors:
    """Compare rendered rays, over the sky or a background, with their photographs."""
    backdrop = batch.background if background is None else background
    backdrop = backdrop if model.sky is None else model.sky.eval(batch.rays.d)
    gain = model.exposure.gains(batch.view) if settings.has_gains else None
    return compare_rays(batch, rendered.colour, rendered.T, backdrop, settings.scale, gain)


def _add_depth_gradient(
    settings: GradientSettings, cells: OccupiedCells, source: Baked, model: Model, depth_rays: DepthRays
) -> None:
    """Add the derivatives of the points' energy to the field's derivatives."""
    # The tables of all pinholes hold the same densities.
    source = dataclasses.replace(source, first=mi.UInt32(0))
    rendered = render_rays(cells, source, model, depth_rays.rays)
    by = RayGradient(mi.Color3f(0), settings.depth * depth_loss_gradient(rendered.T, depth_rays.count))
    dr.eval(rendered, by)
    vjp_rays(cells, source, model, rendered, by, near=settings.near)


def _stored(field: SphericalGrid, slope: mi.Float) -> mi.Float:
    """Derivatives of stored nodes: the last row of a sparse field is the surrounding vacuum and stays constant."""
    own = field.rows if field.nodes is None else field.rows - 1
    return dr.select(dr.arange(mi.UInt32, dr.width(slope)) < own * (dr.width(slope) // field.rows), slope, 0)


def move_numbers(reals: Reals, moves: list[tuple[str, Move]], pull: mi.Float | None, sky: Sky | None, share: float) -> Reals:
    """Reals after the priors that act on single numbers, on gains and on texels of the sky.

    Args:
        moves: parameters and their moves.
        pull: share by which gains are pulled towards 1; None keeps gains.
        sky: the sky of the fit; None keeps texels.
        share: share by which a texel moves to its neighbours.
    """
    arrays = {name: value.array for name, value in reals.items()}
    for name, move in moves:
        arrays[name] = move_values(arrays[name], move)
    if pull is not None:
        arrays["exposure"] = Exposure(arrays["exposure"]).regularized(pull).logs
    if sky is not None:
        arrays["sky"] = sky.with_texels(arrays["sky"]).smooth(share).texels
    return {name: mi.TensorXf(arrays[name], value.shape) for name, value in reals.items()}


def move_rows(reals: Reals, moves: list[tuple[str, Move]], free: mi.Bool | None) -> Reals:
    """Reals, which are evaluated, after the priors that compare rows; densities of rows in free space are 0."""
    arrays = {name: value.array for name, value in reals.items()}
    for name, move in moves:
        arrays[name] = move_values(arrays[name], move)
    arrays["density"] = keep_free(arrays["density"], free)
    return {name: mi.TensorXf(arrays[name], value.shape) for name, value in reals.items()}


def keep_free(density: mi.Float, free: mi.Bool | None) -> mi.Float:
    """Densities of rows, 0 at nodes in free space."""
    return density if free is None else dr.select(free, 0, density)


# -- Moving cameras ----------------------------------------------------------------------------------------------------

TILES = 64
"""Tiles of a photograph that correct its pose: 1024 pixels for six numbers."""

EXPECTED = 3.0
"""Expected size of each number of a motion [pixel]."""

FindErrors = Callable[[RayBatches, np.ndarray, np.ndarray], np.ndarray]
"""Photographs, numbers of some views, first pixels of their tiles (views, tiles, 2) -> differences of renders and photographs
(views, n)."""


@dataclass
class MovingCameras:
    """Photographs with cameras that move.

    Attributes:
        given: the photographs with their given poses.
        distance: of the subject from the cameras [length].
        motions: motion of each camera.
        posed: the photographs with the moved cameras.
    """

    given: RayBatches
    distance: float
    motions: Motions = field(init=False)
    posed: RayBatches = field(init=False)

    def __post_init__(self) -> None:
        self._units = np.array([motion_unit(camera, self.distance) for camera in self.given.cameras])
        self.set_motions(Motions.none(len(self._units)))

    def set_motions(self, motions: Motions) -> None:
        """Move all cameras from their given poses."""
        self.motions = motions
        self.posed = self.given.with_cameras(self._move(np.arange(len(self._units)), motions.motion))

    def table(self) -> np.ndarray:
        """Motions (photographs, 6) in the axes of the world: rotation vectors about the cameras [rad], and shifts [length]."""
        return self.motions.motion * self._units

    def _move(self, views: np.ndarray, motion: np.ndarray) -> list[Camera]:
        """All given cameras, some after motions (views, 6) [pixel]."""
        cameras = list(self.given.cameras)
        for view, move in zip(views, motion * self._units[views], strict=True):
            cameras[view] = move_camera(cameras[view], move[:3], move[3:])
        return cameras

    def correct(self, find: FindErrors, shrink: int, together: int, rng: np.random.Generator) -> float:
        """Correct each pose by a step of least squares.

        Args:
            find: compares the model with photographs.
            shrink: size of the photographs.
            together: most views in a call of ``find``.
            rng: draws the pixels.

        Returns:
            Root mean square of the motions so far, of their six numbers together [pixel].
        """
        count, parts = len(self._units), []
        for views in np.array_split(np.arange(count), -(-count // together)):
            corner = self.given.draw_corners(shrink, views, TILES, rng)

            def error(motion: np.ndarray, views: np.ndarray = views, corner: np.ndarray = corner) -> np.ndarray:
                return find(self.given.with_cameras(self._move(views, motion)), views, corner)

            parts.append(Motions(self.motions.motion[views], self.motions.damping[views]).improve(error, EXPECTED))
        motion, damping = (np.concatenate([getattr(part, name) for part in parts]) for name in ("motion", "damping"))
        self.set_motions(Motions(motion, damping))
        return float(np.sqrt((motion**2).sum(axis=1).mean()))
