"""Fit of a radiance field to photographs: a sparse grid of density and spherical harmonics, coarse stages first.

Conventions. A step uses tiles of a few views. Its loss is the mean squared error over rays and rgb; for photographs of
radiance, the error is weighted by the slope of a tone curve (:mod:`.photo_colours`). Densities are signed
and pass a ReLU after interpolation, so a cell with negative corners only is vacuum and costs nothing. A stage begins with the
nodes of cells around the visible nodes of the last stage.

The reals are ``density`` (rows,), ``harmonics`` (rows, width) and, if the plan has a sky, ``sky`` (texels, 4). Radiance is
stored in the scale of :mod:`mivol.optim.photographs.photo_colours`. A step depends on the reals, the listed cells, the seed and
its number.

References: Fridovich-Keil, Yu et al. 2022 (Plenoxels: model, optimizer, total variation, pruning by weight); Karnewar et al.
2022 (ReLU after interpolation).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import maximum_filter

from mivol.errors import MivolError
from mivol.fields.activation import select_activation
from mivol.fields.harmonics import basis_size, row_width
from mivol.fields.resampling import resample_field
from mivol.fields.sky import TEXEL, Sky
from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner
from mivol.kernel_recording import RecordedFunctions
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.batch_gradient import (
    FieldModel,
    GradientSettings,
    MovingCameras,
    differentiate_batch,
    differentiate_tiles,
    find_errors,
    keep_free,
    move_numbers,
    move_rows,
)
from mivol.optim.photographs.photo_colours import GAIN_RATE, SCALES, Exposure, pull_at
from mivol.optim.photographs.radiance_plan import RadiancePlan
from mivol.optim.photographs.ray_batches import POINTS_PER_VIEW, DepthRays, RayBatch, RayBatches, sample_depth_rays
from mivol.optim.priors import FieldRows, Neighbours
from mivol.optim.problem import Divide, DividedProblem, Reals, Refinement, SparseProblem, to_tensors
from mivol.photos.camera import Motions
from mivol.photos.region import is_free_space, median_distance
from mivol.space import place_grid
from mivol.transport.line_integrals.radiance_field import find_occupied_cells, make_model, raise_to_max_weights
from mivol.transport.line_integrals.radiance_source import bake
from mivol.transport.traversal.occupied_cells import OccupiedCells


class StepRays(NamedTuple):
    """The random numbers of a step.

    Attributes:
        views: numbers of the chosen views.
        corner: (views, tiles, 2) first pixels of the tiles.
        background: put behind all photographs (3,); None keeps their own.
        first_row: first row that a prior moves, if it moves a share of the rows.
    """

    views: np.ndarray
    corner: np.ndarray
    background: np.ndarray | None
    first_row: int


@dataclasses.dataclass
class RadianceProblem(SparseProblem, DividedProblem):
    """A radiance field in a box, with photographs.

    Attributes:
        batches: the photographs.
        box: (2, 3) [length], box of the field.
        plan: plan of the fit.
        seed: root of the random rays.
        safe_point: called between views while visible nodes are found.
        divide: computes the views of a step elsewhere; None: in this process.
        field: present field; a thin fog at first.
        sky: present background, if the plan has a sky.
        exposure: gains of the photographs, if the plan has gains.
        poses: motions of the cameras, if the plan refines poses.
        has_gains: whether gains are fitted; False, with all gains 1, once the photographs turn out to agree.
        stage: number of the current stage.

    Example:
        >>> problem = RadianceProblem(RayBatches.from_photos(photos.views, (1, 2, 4)), photos.box, PRESETS["cpu"])
        >>> reconstruct(problem, problem.plan.optimizer, problem.plan.course())
        >>> render_view(problem.field, camera, background)
    """

    batches: RayBatches
    box: np.ndarray
    plan: RadiancePlan
    seed: int = 0
    safe_point: Callable[[], None] = lambda: None
    divide: Divide | None = None
    field: SphericalGrid = dataclasses.field(init=False)
    sky: Sky | None = dataclasses.field(init=False, default=None)
    exposure: Exposure | None = dataclasses.field(init=False, default=None)
    poses: MovingCameras | None = dataclasses.field(init=False, default=None)
    has_gains: bool = dataclasses.field(init=False)
    stage: int = dataclasses.field(init=False, default=0)

    def __post_init__(self) -> None:
        self.box = np.asarray(self.box, np.float64)
        if self.box.shape != (2, 3) or not (self.box[1] > self.box[0]).all():
            raise MivolError(f"found the box {self.box.tolist()}, expected its lower and its upper corner: check the box.")
        absent = {stage.shrink for stage in self.plan.stages} - self.batches.levels.keys()
        if absent:
            raise MivolError(f"the plan needs views shrunk by {min(absent)}: give this size to RayBatches.from_photos.")
        if self.plan.sky:
            if self.batches.channels == 4:
                raise MivolError("found a sky and photographs with alpha, which marks their background: set sky = 0.")
            self.sky = Sky.uniform(self.plan.sky, self.batches.median())
        if self.plan.exposure:
            if self.batches.channels == 4:
                raise MivolError("found gains and photographs with alpha, which have equal exposures: set exposure = false.")
            self.exposure = Exposure.neutral(len(self.batches.origins))
        self.has_gains = self.plan.exposure
        if self.plan.poses:
            self.poses = MovingCameras(self.batches, median_distance(self.batches.cameras, self.box.mean(axis=0)))
        self.scale = SCALES[self.batches.space]
        self.unit = float((self.box[1] - self.box[0]).max()) / 2
        self.near = self.plan.near_distance(self.batches.origins, self.box)
        grid, degree = place_grid(self.box, self.plan.stages[0].longest), self.plan.degree_at(0)
        fog = _fog(*grid, degree, self.plan.start / self.unit, self.plan.levels, self.batches.space)
        self.field = _coloured(fog, self.scale.fog_colour(self.batches.pixels))
        self._first_row = 0
        self._drawn: tuple[Any, StepRays] | None = None
        self._recorded = RecordedFunctions()
        self._update_neighbours()

    @property
    def warning(self) -> Callable[[], str]:
        return self._recorded.describe_failure

    # -- Values -------------------------------------------------------------------------------------------------------

    def initial_reals(self) -> Reals:
        """Reals of the present field and sky."""
        return self.values()

    def values(self) -> Reals:
        """Field and sky as tensors of reals."""
        reals = _tensors(self.field)
        if self.sky is not None:
            reals["sky"] = mi.TensorXf(self.sky.texels, (dr.width(self.sky.texels) // TEXEL, TEXEL))
        reals |= {name: mi.TensorXf(self.scale.to_reals(reals[name].array), reals[name].shape) for name in self._colours(reals)}
        return reals if self.exposure is None else reals | {"exposure": self.exposure.tensor}

    @staticmethod
    def _colours(reals: Reals) -> list[str]:
        """Names of the reals that are colours."""
        return [name for name in ("harmonics", "sky") if name in reals]

    def set_reals(self, reals: Reals) -> None:
        """Set the values of the field and the sky."""
        colours = {name: self.scale.to_colours(reals[name].array) for name in self._colours(reals)}
        self.field = self.field.with_values(reals["density"].array, colours["harmonics"])
        if self.sky is not None:
            self.sky = self.sky.with_texels(colours["sky"])
        if self.exposure is not None:
            self.exposure = Exposure(reals["exposure"].array)

    # -- Loss and gradient --------------------------------------------------------------------------------------------

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[mi.Float, Reals]:
        """Mean (weighted) squared error of an iteration's rays, and the gradient; 0 views takes the stage's number.

        Noise: from the choice of pixels. Bias: as :func:`mivol.transport.line_integrals.radiance_source.bake`.
        """
        if self.divide is None:
            found = self.compute_part(reals, iteration, views)
        else:
            self.set_reals(reals)
            count = len(self._draw_step(iteration, views).views)
            found = to_tensors(self.divide(self, reals, [(iteration, views, (number,)) for number in range(count)]))
        self._first_row = self._draw_step(iteration, views).first_row
        return found.pop("loss").array, found

    def compute_part(self, reals: Reals, iteration: int, views: int, only: Sequence[int] | None = None) -> Reals:
        """Loss and derivatives of the rays of some views of a step, as shares of the step's mean.

        Args:
            reals: of the step.
            iteration, views: as :meth:`loss_and_gradient`.
            only: indices of the views among the views of the step; None: all. The first has the step's depth rays.
        """
        self.set_reals(reals)
        step = self._draw_step(iteration, views)
        numbers = list(range(len(step.views)) if only is None else only)
        chosen = step.views[numbers]
        pixels = self.posed.tabulate(self.plan.stages[self.stage].shrink, chosen, step.corner[numbers])
        depth_rays = self._draw_depth_rays(step.views, iteration) if 0 in numbers else None
        if depth_rays is not None:
            depth_rays = dataclasses.replace(depth_rays, count=dr.opaque(mi.UInt32, depth_rays.count))
        return self._recorded.call(
            differentiate_tiles,
            self._gradient_settings(len(numbers) / len(step.views)),
            self._field_model(),
            reals,
            pixels,
            self.field.offsets_from(self.posed.origins[chosen]),
            _opaque_colour(step.background),
            depth_rays,
        )

    def _gradient_settings(self, share: float) -> GradientSettings:
        plan = self.plan
        return GradientSettings(self.scale, plan.stop, plan.beta, plan.depth, self.near, self.has_gains, share)

    def _field_model(self) -> FieldModel:
        return FieldModel(self.field, self._cells, self.sky, self.exposure)

    def _draw_step(self, iteration: int, views: int) -> StepRays:
        """The random numbers of a step; the latest step is kept."""
        stage, key = self.plan.stages[self.stage], (self.seed, self.stage, iteration, views)
        if self._drawn is None or self._drawn[0] != key:
            rng = np.random.default_rng((self.seed, iteration))
            chosen = self.batches.choose_views(views or stage.views, rng)
            corner = self.batches.draw_corners(stage.shrink, chosen, stage.tiles, rng)
            background = self._background(rng)
            first_row = int(rng.integers(self._neighbours.count))
            self._drawn = key, StepRays(chosen, corner, background, first_row)
        return self._drawn[1]

    def step_state(self) -> dict[str, Any]:
        """The nodes, the listed cells and the motions of the cameras."""
        state = {"stage": self.stage, "has_gains": self.has_gains, "nodes": self.field.nodes, "cells": self._cells}
        return state | {"motions": None if self.poses is None else self.poses.motions}

    def take_step_state(self, state: dict[str, Any]) -> None:
        """Nodes and cells of the same problem in another process; the next reals have a value for each node."""
        self.stage, self.has_gains, self._cells = state["stage"], state["has_gains"], state["cells"]
        if self.plan.poses:
            self.poses.set_motions(state["motions"])
        grid, degree = place_grid(self.box, self.plan.stages[self.stage].longest), self.plan.degree_at(self.stage)
        rows = math.prod(grid[0]) if state["nodes"] is None else dr.width(state["nodes"]) + 1
        values = dr.zeros(mi.Float, rows), dr.zeros(mi.Float, rows * row_width(basis_size(degree)))
        self.field = SphericalGrid(*grid, degree, *values, state["nodes"], levels=self.plan.levels, space=self.batches.space)

    def _background(self, rng: np.random.Generator) -> np.ndarray | None:
        random = self.plan.random_background and self.batches.channels == 4
        return rng.random(3) if random else None

    def _draw_depth_rays(self, chosen: np.ndarray, iteration: int) -> DepthRays | None:
        """Points visible in the chosen views, if the plan uses depth."""
        if not (self.plan.depth and self.batches.points):
            return None
        voxel, rng = 2 * self.unit / self.plan.stages[self.stage].longest, np.random.default_rng((self.seed, iteration, 1))
        points = [self.batches.points[view] for view in chosen]
        least = len(points) * POINTS_PER_VIEW
        return sample_depth_rays(points, self.posed.origins[chosen], self.box, self.plan.levels, voxel, rng, least)

    def batch_loss_and_gradient(
        self,
        batch: RayBatch,
        background: np.ndarray | None = None,
        depth_rays: DepthRays | None = None,
    ) -> tuple[mi.Float, dict[str, mi.Float]]:
        """Squared error of each ray of a batch, weighted, mean over rgb, and derivatives of the mean over rays, by parameter.

        Args:
            batch: rays and their target colours.
            background: put behind all photographs (3,); None keeps each photograph's own background.
            depth_rays: points of the same views; only the derivatives contain the plan's weight times their energy.
        """
        settings, colour = self._gradient_settings(1.0), _opaque_colour(background)
        return differentiate_batch(settings, self._field_model(), batch, colour, depth_rays)

    # -- Steps --------------------------------------------------------------------------------------------------------

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Learning rates; the density's rate is relative to half the longest edge of the box."""
        density, sh = self.plan.learning_rates(iteration)
        share, colours = sh / self.plan.sh_rate, self.scale.rate
        sky = {} if self.sky is None else {"sky": colours * self.plan.sky_rate * share}
        gains = {} if self.exposure is None else {"exposure": GAIN_RATE * share}
        return {"density": density / self.unit, "harmonics": colours * sh} | sky | gains

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        """Apply the priors: move values by shares of the learning rate, smaller with more photographs."""
        for function, arguments in self.moves_after_step(iteration):
            # Evaluate: the moves of rows read neighbours, which would compute the step twice.
            dr.eval(reals)
            reals = function(reals, *arguments)
        return reals

    def moves_after_step(self, iteration: int) -> list[tuple[Callable[..., Reals], tuple[Any, ...]]]:
        """:meth:`after_step` as functions: the moves of single numbers, and the moves that compare rows."""
        rows = self._rows(iteration)
        moves = [(name, prior.is_spatial, prior.make_move(rows[name])) for name, prior in self.plan.priors]
        single, spatial = (
            [(name, move) for name, is_spatial, move in moves if move is not None and is_spatial == wanted]
            for wanted in (False, True)
        )
        pull = pull_at(self.learning_rates(iteration)["exposure"]) if self.has_gains else None
        sky = self.sky if self.plan.sky_smooth else None
        found: list[tuple[Callable[..., Reals], tuple[Any, ...]]] = [(move_numbers, (single, pull, sky, self.plan.sky_smooth))]
        return [*found, (move_rows, (spatial, self._free))] if spatial or self._free is not None else found

    def _rows(self, iteration: int) -> dict[str, FieldRows]:
        """Rows for the priors of an iteration, by parameter."""
        density, sh = (rate / len(self.batches.origins) for rate in self.plan.learning_rates(iteration))
        return {
            "density": FieldRows(1, self._neighbours, density, self.unit, self._first_row, iteration),
            "harmonics": FieldRows(self.field.width, self._neighbours, self.scale.rate * sh, 1.0, self._first_row, iteration),
        }

    # -- Poses --------------------------------------------------------------------------------------------------------

    @property
    def posed(self) -> RayBatches:
        """The photographs from where the fit has moved their cameras."""
        return self.batches if self.poses is None else self.poses.posed

    def align_cameras(self, iteration: int) -> str:
        """Correct the poses of the photographs; returns a sentence for the log."""
        stage, rng = self.plan.stages[self.stage], np.random.default_rng((self.seed, iteration, 2))
        settings, model = self._gradient_settings(1.0), self._field_model()

        def find(posed: RayBatches, views: np.ndarray, corner: np.ndarray) -> np.ndarray:
            pixels, offsets = posed.tabulate(stage.shrink, views, corner), self.field.offsets_from(posed.origins[views])
            error = np.array(self._recorded.call(find_errors, settings, model, pixels, offsets), np.float64)
            self.safe_point()
            return error.reshape(3, len(views), -1).transpose(1, 0, 2).reshape(len(views), -1)

        moved = self.poses.correct(find, stage.shrink, stage.views, rng)
        return f"cameras moved by {moved:.2g} pixels so far (root mean square)"

    # -- Stages -------------------------------------------------------------------------------------------------------

    def refine(self, stage: int) -> Refinement:
        """Change to the nodes of a finer stage, or to the visible nodes of the current stage.

        Raises:
            MivolError: no node is visible.
        """
        begins, keep, old = stage != self.stage, self.visible_nodes(), self.field
        if not keep.any():
            raise MivolError("no view shows matter in the box: check the box, the cameras and the background.")
        if not begins:
            # Visible matter may move by a voxel. A finer stage stores all cells around a kept node anyway.
            keep = maximum_filter(keep, (1, 3, 3, 3))
        grid, degree = place_grid(self.box, self.plan.stages[stage].longest), self.plan.degree_at(stage)

        def resampled(field: SphericalGrid) -> SphericalGrid:
            return resample_field(field, *grid, keep).with_degree(degree)

        self.field, self.stage = resampled(old), stage
        # Only the node positions of the old field are used from here on; zeros that are not evaluated take no memory.
        old = old.with_values(dr.zeros(mi.Float, old.rows), dr.zeros(mi.Float, old.rows * old.width))
        self._update_neighbours()
        # Derivatives are proportional to the length of a ray in a voxel.
        shrink = max(old.res) / max(self.field.res)
        counts = self.field.res if old.levels == 1 else (old.levels, *self.field.res)
        nodes = " x ".join(str(n) for n in counts)
        size = f"{nodes} nodes, {self.field.rows - 1} of them stored"
        message = f"refined to {size}{self._compare_exposures(stage)}" if begins else f"unseen nodes removed: {size}"
        return Refinement(
            self.values(),
            lambda tensors: tensors | _tensors(resampled(_with_tensors(old, tensors))),
            {"density": shrink, "harmonics": shrink},
            message,
        )

    def _compare_exposures(self, stage: int) -> str:
        """Remove the gains of photographs that agree after the first stage; returns a clause for the log."""
        if not self.has_gains or stage != 1:
            return ""
        spread = self.exposure.spread
        if spread < self.plan.agree:
            self.exposure, self.has_gains = Exposure.neutral(len(self.batches.origins)), False
            return f"; photographs agree in exposure to {spread:.1%}, so gains are removed"
        return f"; photographs differ in exposure by {spread:.0%}, so each has gains"

    def update_occupancy(self) -> None:
        """List the nonempty cells: all others have neither light nor derivatives."""
        self._cells = None  # frees memory for the new list of the same size
        self._cells = find_occupied_cells(self.field)

    def _find_free_space(self) -> mi.Bool | None:
        """Whether each row is a node in free space; None if the plan has no free space."""
        if not self.plan.free_space:
            return None
        cameras = self.batches.cameras
        free = is_free_space(cameras, self.field.node_positions(), median_distance(cameras, self.box.mean(axis=0)))
        return mi.Bool(np.append(free, np.zeros(self.field.rows - len(free), bool)))

    def _update_neighbours(self) -> None:
        self._free = self._find_free_space()
        self.field = self.field.with_values(keep_free(self.field.density, self._free), self.field.harmonics)
        self._neighbours = Neighbours.from_field(self.field)
        self.update_occupancy()

    def visible_nodes(self) -> np.ndarray:
        """Visible nodes (levels, Z, Y, X): nodes of cells with the plan's minimum weight for some ray of the training views."""
        cells, model = find_occupied_cells(self.field), make_model(self.field, self.plan.stop)
        weight = dr.zeros(mi.Float, max(cells.count, 1))
        shrink = max(self.batches.levels)
        for view, origin in enumerate(self.posed.origins):
            source = bake(self.field, cells, origin[None], mi.UInt32(0))
            raise_to_max_weights(cells, source, model, self.posed.all_pixels(shrink, view).rays, weight)
            dr.eval(weight)
            self.safe_point()
        return _nodes_of(self.field, cells, weight >= self.plan.keep_weight)

    # -- On disk ------------------------------------------------------------------------------------------------------

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """The stage, whether gains are fitted, the nodes of a sparse field; rebuilds the list of cells, as :meth:`unpack`."""
        self.set_reals(reals)
        self.update_occupancy()
        nodes = {} if self.field.nodes is None else {"nodes": np.array(self.field.nodes)}
        poses = {} if self.poses is None else dataclasses.asdict(self.poses.motions)
        return {"stage": np.array(self.stage), "has_gains": np.array(self.has_gains), **nodes, **poses}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        """Continue from the arrays of :meth:`pack`, with the same plan, photographs and box."""
        self.stage, self.has_gains = int(arrays["stage"]), bool(arrays["has_gains"])
        if self.plan.poses:
            self.poses.set_motions(Motions(arrays["motion"], arrays["damping"]))
        grid, degree = place_grid(self.box, self.plan.stages[self.stage].longest), self.plan.degree_at(self.stage)
        nodes = mi.UInt32(arrays["nodes"]) if "nodes" in arrays else None
        values = reals["density"].array, reals["harmonics"].array
        self.field = SphericalGrid(*grid, degree, *values, nodes, levels=self.plan.levels, space=self.batches.space)
        self.set_reals(reals)
        self._update_neighbours()


def _opaque_colour(colour: np.ndarray | None) -> mi.Color3f | None:
    return None if colour is None else mi.Color3f(*(dr.opaque(mi.Float, float(c)) for c in colour))


def _tensors(grid: SphericalGrid) -> Reals:
    return {
        "density": mi.TensorXf(grid.density, (grid.rows,)),
        "harmonics": mi.TensorXf(grid.harmonics, (grid.rows, grid.width)),
    }


def _with_tensors(grid: SphericalGrid, reals: Reals) -> SphericalGrid:
    return grid.with_values(reals["density"].array, reals["harmonics"].array)


def _fog(
    res: tuple[int, int, int], to_world: np.ndarray, degree: int, density: float, levels: int, space: str
) -> SphericalGrid:
    """A thin grey fog in the boxes of every level."""
    nodes, width = None, row_width(basis_size(degree))
    if levels > 1:
        nodes = dr.compress(~is_covered_by_inner(dr.arange(mi.UInt32, levels * math.prod(res)), res))
    rows = math.prod(res) if nodes is None else dr.width(nodes)
    fog = dr.full(mi.Float, density, rows if nodes is None else rows + 1)
    if nodes is not None:
        dr.scatter(fog, mi.Float(select_activation("relu").vacuum), mi.UInt32(rows))
    dr.eval(fog)
    colours = dr.zeros(mi.Float, dr.width(fog) * width)
    return SphericalGrid(res, to_world, degree, fog, colours, nodes, levels=levels, space=space)


def _coloured(fog: SphericalGrid, colour: np.ndarray) -> SphericalGrid:
    """A fog with a constant colour (3,), from a fog with harmonics 0."""
    row = np.zeros(fog.width, np.float32)
    row[:3] = (colour - fog.offset) * math.sqrt(4 * math.pi)  # the first harmonic is 1 / sqrt(4 pi)
    return fog.with_values(fog.density, dr.tile(mi.Float(row), dr.width(fog.density)))


def _nodes_of(field: SphericalGrid, cells: OccupiedCells, chosen: mi.Bool) -> np.ndarray:
    """Nodes (levels, Z, Y, X) of chosen cells."""
    mask = np.zeros(field.node_count, bool)
    index = dr.compress(chosen)
    if cells.count and dr.width(index):
        keep = dr.zeros(mi.UInt8, field.rows)
        for row in cells.node_rows(index, mi.Bool(True)):
            dr.scatter(keep, mi.UInt8(1), row)
        listed = field.stored_nodes()
        mask[listed] = np.array(keep)[: len(listed)] > 0
    return mask.reshape(field.levels, *field.res)


def begin_radiance_fit(batches: RayBatches, box: np.ndarray, plan: RadiancePlan, seed: int = 0) -> Fit:
    """A fit before the first step, for callers that take the steps themselves.

    Args:
        batches: the photographs.
        box: (2, 3) [length], box of the field.
        plan: plan of the fit.
        seed: root of the random rays.

    Raises:
        MivolError: as :class:`mivol.optim.photographs.radiance_problem.RadianceProblem`.

    Example:
        >>> fit = begin_radiance_fit(RayBatches.from_photos(photos.views, (1, 2, 4)), photos.box, PRESETS["cpu"])
        >>> while not fit.is_done:
        ...     fit.advance()
        >>> field = current_field(fit)
    """
    return begin_fit(RadianceProblem(batches, box, plan, seed), plan.optimizer, plan.course())


def current_field(fit: Fit) -> SphericalGrid:
    """The field of a fit after its latest step; the problem's field is the field before this step."""
    fit.problem.set_reals(fit.run.reals)
    return fit.problem.field
