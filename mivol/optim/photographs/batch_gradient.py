"""Loss and gradient of a batch of rays through a radiance field, and the moves of a field after a step, for recordings.

Conventions. A step is three functions of arrays: the gradient (:func:`differentiate_tiles`), the step of the optimizer with the
moves of single numbers (:func:`move_numbers`), and the moves that compare neighbours (:func:`move_rows`). Each is recorded once
and replayed while its settings and the sizes of its arrays stay the same
(:class:`mivol.kernel_recording.RecordedFunctions`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.photographs.photo_colours import Exposure, LinearScale, RayErrors, SrgbScale, compare_rays, mean_of
from mivol.optim.photographs.ray_batches import DepthRays, PixelTable, RayBatch, depth_loss_gradient
from mivol.optim.priors import Move, move_values
from mivol.optim.problem import Reals
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
    """The loss of the tiles of a step and its derivatives by the reals, as shares of the step's mean.

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
