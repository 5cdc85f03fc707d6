"""A radiance field and photographs of it as a problem: a sparse grid of density and spherical harmonics, coarse first.

Conventions. A step looks at tiles of a few views; its loss is the squared error of a ray, mean over rgb and rays, where the
photographs hold radiance weighted by the slope of a tone curve (:mod:`mivol.optim.photographs.colour_scale`). Densities are
signed and pass a ReLU after interpolation, so a cell whose corners are all negative is vacuum and costs nothing. A stage begins
with the nodes of cells about those to which the last one's field gave some ray a weight.

The reals are ``density`` (rows,), ``harmonics`` (rows, width) and, where the plan asks for one, ``sky`` (texels, 4); radiance
is there in the scale of :mod:`mivol.optim.photographs.colour_scale`. What a step does is a function of them, of the listed
cells, the seed and the step's number.

References: Fridovich-Keil, Yu et al. 2022 (Plenoxels: model, optimiser, total variation, pruning by weight); Karnewar et al.
2022 (ReLU after interpolation).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

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
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.colour_scale import SCALES
from mivol.optim.photographs.depth_supervision import DepthRays, depth_loss_gradient, sample_depth_rays
from mivol.optim.photographs.exposure import AGREE, RATE, Exposure
from mivol.optim.photographs.radiance_plan import RadiancePlan, place_grid
from mivol.optim.photographs.ray_batches import RayBatch, RayBatches
from mivol.optim.priors import Neighbours, Rows
from mivol.optim.problem import Reals, Refinement
from mivol.transport.line_integrals.radiance_field import (
    Model,
    RayGradient,
    find_occupied_cells,
    make_model,
    raise_to_max_weights,
    render_rays,
    vjp_rays,
)
from mivol.transport.line_integrals.radiance_source import Baked, bake, vjp_bake
from mivol.transport.traversal.occupied_cells import OccupiedCells


@dataclasses.dataclass
class RadianceProblem:
    """A radiance field in a box, fitted to photographs.

    Attributes:
        batches: what is looked at.
        box: (2, 3) [length], where the field may be.
        plan: how the fit goes.
        seed: of the rays.
        safe_point: called between the views that are asked what they see.
        field: what was found so far; a thin fog at first.
        sky: what was found behind it, where the plan asks for that.
        exposure: gains of the photographs, where the plan asks for them.
        has_gains: whether they are found; False, and all gains 1, from when photographs were seen to agree.
        stage: the stage at work.

    Example:
        >>> problem = RadianceProblem(RayBatches.of(photos.views, (1, 2, 4)), photos.box, PRESETS["cpu"])
        >>> reconstruct(problem, problem.plan.optimizer, problem.plan.course())
        >>> render_view(problem.field, camera, background)
    """

    batches: RayBatches
    box: np.ndarray
    plan: RadiancePlan
    seed: int = 0
    safe_point: Callable[[], None] = lambda: None
    field: SphericalGrid = dataclasses.field(init=False)
    sky: Sky | None = dataclasses.field(init=False, default=None)
    exposure: Exposure | None = dataclasses.field(init=False, default=None)
    has_gains: bool = dataclasses.field(init=False)
    stage: int = dataclasses.field(init=False, default=0)

    def __post_init__(self) -> None:
        self.box = np.asarray(self.box, np.float64)
        if self.box.shape != (2, 3) or not (self.box[1] > self.box[0]).all():
            raise MivolError(f"the box {self.box.tolist()} was given; its lower and its upper corner are expected.")
        absent = {stage.shrink for stage in self.plan.stages} - self.batches.levels.keys()
        if absent:
            raise MivolError(f"views shrunk by {min(absent)} are asked for; take them over in that size (RayBatches.of).")
        if self.plan.sky:
            if self.batches.channels == 4:
                raise MivolError("a sky was asked for and the photographs have alpha, which says what is behind: sky = 0.")
            self.sky = Sky.uniform(self.plan.sky, self.batches.median())
        if self.plan.exposure:
            if self.batches.channels == 4:
                raise MivolError("gains were asked for and the photographs have alpha, as renders have: exposure = false.")
            self.exposure = Exposure.even(len(self.batches.origins))
        self.has_gains = self.plan.exposure
        self.scale = SCALES[self.batches.space]
        self.unit = float((self.box[1] - self.box[0]).max()) / 2
        self.near = self.plan.near_distance(self.batches.origins, self.box)
        place, degree = place_grid(self.box, self.plan.stages[0].longest), self.plan.degree_at(0)
        fog = _fog(*place, degree, self.plan.start / self.unit, self.plan.levels, self.batches.space)
        self.field = _coloured(fog, self.scale.fog(self.batches.pixels))
        self._first_row = 0
        self._look_around()

    # -- Values -------------------------------------------------------------------------------------------------------

    def initial_reals(self) -> Reals:
        """The reals of the field and the sky that are there now."""
        return self.values()

    def values(self) -> Reals:
        """Field and sky as tensors of reals."""
        found = _tensors(self.field)
        if self.sky is not None:
            found["sky"] = mi.TensorXf(self.sky.texels, (dr.width(self.sky.texels) // TEXEL, TEXEL))
        found |= {name: mi.TensorXf(self.scale.reals_of(found[name].array), found[name].shape) for name in self._colours(found)}
        return found if self.exposure is None else found | {"exposure": self.exposure.tensor}

    @staticmethod
    def _colours(reals: Reals) -> list[str]:
        """Names of the reals that are colours."""
        return [name for name in ("harmonics", "sky") if name in reals]

    def set_reals(self, reals: Reals) -> None:
        """Put values into the field and the sky."""
        colours = {name: self.scale.colours_of(reals[name].array) for name in self._colours(reals)}
        self.field = self.field.with_values(reals["density"].array, colours["harmonics"])
        if self.sky is not None:
            self.sky = self.sky.with_texels(colours["sky"])
        if self.exposure is not None:
            self.exposure = Exposure(reals["exposure"].array)

    # -- Loss and gradient --------------------------------------------------------------------------------------------

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[mi.Float, Reals]:
        """Mean (weighted) squared error of the rays of an iteration, and its gradient; 0 views: as many as the stage says.

        Noise: of which pixels were drawn. Bias: that of :func:`mivol.transport.line_integrals.radiance_source.bake`.
        """
        self.set_reals(reals)
        stage = self.plan.stages[self.stage]
        rng = np.random.default_rng((self.seed, iteration))
        chosen = self.batches.choose(views or stage.views, rng)
        batch = self.batches.draw(stage.shrink, chosen, stage.tiles, rng)
        loss, slopes = self.slopes(batch, self._background(rng), self._sightings(chosen, iteration))
        slopes |= {name: self.scale.by_reals(slopes[name], reals[name].array) for name in self._colours(reals)}
        self._first_row = int(rng.integers(dr.width(self._neighbours.after[0])))
        return dr.mean(loss), {name: mi.TensorXf(slopes[name], value.shape) for name, value in reals.items()}

    def _background(self, rng: np.random.Generator) -> np.ndarray | None:
        random = self.plan.random_background and self.batches.channels == 4
        return rng.random(3) if random else None

    def _sightings(self, chosen: np.ndarray, iteration: int) -> DepthRays | None:
        """Points that were found in the chosen views, where the plan asks for them."""
        if not (self.plan.depth and self.batches.points):
            return None
        voxel, rng = 2 * self.unit / self.plan.stages[self.stage].longest, np.random.default_rng((self.seed, iteration, 1))
        points = [self.batches.points[view] for view in chosen]
        return sample_depth_rays(points, self.batches.origins[chosen], self.box, self.plan.levels, voxel, rng)

    def slopes(
        self, batch: RayBatch, background: np.ndarray | None = None, sightings: DepthRays | None = None
    ) -> tuple[mi.Float, dict[str, mi.Float]]:
        """Squared error of each ray of a batch, weighted, mean over rgb, and derivatives of the mean over rays, by parameter.

        Args:
            batch: rays and what they should see.
            background: put behind all photographs (3,); None: each has its own.
            sightings: points of the same views; the plan's weight times their energy is in the derivatives only.
        """
        source = bake(self.field, self._cells, batch.origins, batch.slot, slope=True)
        model, count = make_model(self.field, self.plan.stop), dr.width(batch.slot)
        seen = render_rays(self._cells, source, model, batch.rays)
        before = batch.before
        behind = before if background is None else mi.Color3f(*(dr.opaque(mi.Float, float(c)) for c in background))
        behind = behind if self.sky is None else self.sky.eval(batch.rays.d)
        # Where a photograph was transparent, it shows what it is over: put what is behind there instead.
        gain = self.exposure.of(batch.view) if self.has_gains else mi.Color3f(1)
        shown = gain * (seen.colour + seen.T * behind)
        error = shown - batch.target - (1 - batch.alpha) * (behind - before)
        weight = self.scale.weight(shown)
        error *= batch.counted * weight
        by_shown = error * weight * (2 / (3 * count))
        by = by_shown * gain
        through = dr.dot(by, behind)
        if self.plan.beta > 0:
            # Bounded: at 0 and 1 the prior is satisfied, and its derivative infinite.
            T = dr.clip(seen.T, 0.01, 0.99)
            through += self.plan.beta / count * batch.counted * (dr.rcp(T) - dr.rcp(1 - T))
        loss = dr.squared_norm(error) * (1 / 3)
        dr.eval(seen, by, through, loss)
        vjp_rays(self._cells, source, model, seen, RayGradient(by, through), near=self.near)
        if sightings is not None:
            self._add_sightings(source, model, sightings)
        dr.eval(source.slope)
        density, harmonics = vjp_bake(self.field, self._cells, source, batch.origins)
        slopes = {"density": self._stored(density), "harmonics": self._stored(harmonics)}
        if self.sky is not None:
            slopes["sky"] = self.sky.texel_gradient(batch.rays.d, by * seen.T)
        if self.exposure is not None:
            by_log = by_shown * shown if self.has_gains else mi.Color3f(0)
            slopes["exposure"] = self.exposure.slopes(batch.view, by_log)
        return loss, slopes

    def _add_sightings(self, source: Baked, model: Model, sightings: DepthRays) -> None:
        """Add the derivatives of the energy of points to those of the field."""
        # Densities are the same in the table of any pinhole.
        source = dataclasses.replace(source, first=mi.UInt32(0))
        seen = render_rays(self._cells, source, model, sightings.rays)
        by = RayGradient(mi.Color3f(0), self.plan.depth * depth_loss_gradient(seen.T, sightings.count))
        dr.eval(seen, by)
        vjp_rays(self._cells, source, model, seen, by, near=self.near)

    def _stored(self, slope: mi.Float) -> mi.Float:
        """Derivatives of the nodes that are stored: the last row of a sparse field is the vacuum around, and stays."""
        own = self.field.rows if self.field.nodes is None else self.field.rows - 1
        return dr.select(dr.arange(mi.UInt32, dr.width(slope)) < own * (dr.width(slope) // self.field.rows), slope, 0)

    # -- Steps --------------------------------------------------------------------------------------------------------

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Learning rates; those of the density count in half the longest edge of the box."""
        density, sh = self.plan.learning_rates(iteration)
        share, colours = sh / self.plan.sh_rate, self.scale.rate
        sky = {} if self.sky is None else {"sky": colours * self.plan.sky_rate * share}
        gains = {} if self.exposure is None else {"exposure": RATE * share}
        return {"density": density / self.unit, "harmonics": colours * sh} | sky | gains

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        """Move values as the priors ask: by shares of the learning rate, fewer the more photographs there are."""
        shapes = {name: value.shape for name, value in reals.items()}
        # Taken out: a step that is not evaluated yet holds the gradient, which is as large as the reals.
        arrays = {name: reals.pop(name).array for name in shapes}
        where = self._rows(iteration)
        for name, prior in self.plan.priors:
            if not prior.is_spatial:
                arrays[name] = prior.apply(arrays[name], where[name])
        if self.has_gains:
            arrays["exposure"] = Exposure(arrays["exposure"]).pulled(self.learning_rates(iteration)["exposure"]).logs
        # Evaluated here, or the neighbours that are read next would make the step be taken twice.
        if self.sky is not None and self.plan.sky_smooth:
            arrays["sky"] = self.sky.with_texels(arrays["sky"]).smooth(self.plan.sky_smooth).texels
        dr.eval(arrays)
        for name, prior in self.plan.priors:
            if prior.is_spatial:
                arrays[name] = prior.apply(arrays[name], where[name])
        return {name: mi.TensorXf(array, shapes[name]) for name, array in arrays.items()}

    def _rows(self, iteration: int) -> dict[str, Rows]:
        """Where priors act in an iteration, by parameter."""
        density, sh = (rate / len(self.batches.origins) for rate in self.plan.learning_rates(iteration))
        return {
            "density": Rows(1, self._neighbours, density, self.unit, self._first_row, iteration),
            "harmonics": Rows(self.field.width, self._neighbours, self.scale.rate * sh, 1.0, self._first_row, iteration),
        }

    def warning(self) -> str:
        """Nothing: what noise there is is that of drawn pixels, and has no bias."""
        return ""

    # -- Stages -------------------------------------------------------------------------------------------------------

    def refine(self, stage: int) -> Refinement:
        """Go over to the nodes of a finer stage, or to those of the stage at work, where the field is seen now.

        Raises:
            MivolError: nothing is seen.
        """
        begins, keep, old = stage != self.stage, self.seen_nodes(), self.field
        if not keep.any():
            raise MivolError("no view sees anything in the box: check the box, the cameras and the background.")
        if not begins:
            # What is seen may move by a voxel. Finer nodes are stored in all cells around a kept one: two voxels as it is.
            keep = maximum_filter(keep, (1, 3, 3, 3))
        place, degree = place_grid(self.box, self.plan.stages[stage].longest), self.plan.degree_at(stage)

        def resampled(grid: SphericalGrid) -> SphericalGrid:
            return resample_field(grid, *place, keep).with_degree(degree)

        self.field, self.stage = resampled(old), stage
        # Of the old field only the places of its nodes are of use from here on; zeros that are not evaluated take no memory.
        old = old.with_values(dr.zeros(mi.Float, old.rows), dr.zeros(mi.Float, old.rows * old.width))
        self._look_around()
        # Derivatives go with the length of a ray in a voxel.
        shrink = max(old.res) / max(self.field.res)
        counts = self.field.res if old.levels == 1 else (old.levels, *self.field.res)
        nodes = " x ".join(str(n) for n in counts)
        kept = f"{nodes} nodes, of which {self.field.rows - 1} are kept"
        says = f"refined to {kept}{self._compare_exposures(stage)}" if begins else f"unseen nodes left out: {kept}"
        return Refinement(
            self.values(),
            lambda tensors: tensors | _tensors(resampled(_with_tensors(old, tensors))),
            {"density": shrink, "harmonics": shrink},
            says,
        )

    def _compare_exposures(self, stage: int) -> str:
        """Leave out the gains of photographs that agree after the first stage; what was found, for the log."""
        if not self.has_gains or stage != 1:
            return ""
        spread = self.exposure.spread
        if spread < AGREE:
            self.exposure, self.has_gains = Exposure.even(len(self.batches.origins)), False
            return f"; photographs agree in exposure to {spread:.1%}, so gains are left out"
        return f"; photographs differ in exposure by {spread:.0%}, so each has gains"

    def update_occupancy(self) -> None:
        """List the cells that hold anything: the others have neither light nor derivatives."""
        self._cells = None  # as large as what is made, and of no more use
        self._cells = find_occupied_cells(self.field)

    def _look_around(self) -> None:
        self._neighbours = Neighbours.from_field(self.field)
        self.update_occupancy()

    def seen_nodes(self) -> np.ndarray:
        """Nodes (levels, Z, Y, X) of cells to which some ray of the training views gives the plan's weight."""
        cells, model = find_occupied_cells(self.field), make_model(self.field, self.plan.stop)
        weight = dr.zeros(mi.Float, max(cells.count, 1))
        shrink = max(self.batches.levels)
        for view, origin in enumerate(self.batches.origins):
            source = bake(self.field, cells, origin[None], mi.UInt32(0))
            raise_to_max_weights(cells, source, model, self.batches.whole(shrink, view).rays, weight)
            dr.eval(weight)
            self.safe_point()
        return _nodes_of(self.field, cells, weight >= self.plan.keep_weight)

    # -- On disk ------------------------------------------------------------------------------------------------------

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """The stage, whether there are gains, the nodes of a sparse field; makes the list of cells anew, as :meth:`unpack`."""
        self.set_reals(reals)
        self.update_occupancy()
        nodes = {} if self.field.nodes is None else {"nodes": np.array(self.field.nodes)}
        return {"stage": np.array(self.stage), "has_gains": np.array(self.has_gains), **nodes}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        """Go on from what :meth:`pack` gave; the plan, the batches and the box must be the same."""
        self.stage, self.has_gains = int(arrays["stage"]), bool(arrays["has_gains"])
        place, degree = place_grid(self.box, self.plan.stages[self.stage].longest), self.plan.degree_at(self.stage)
        nodes = mi.UInt32(arrays["nodes"]) if "nodes" in arrays else None
        values = reals["density"].array, reals["harmonics"].array
        self.field = SphericalGrid(*place, degree, *values, nodes, levels=self.plan.levels, space=self.batches.space)
        self.set_reals(reals)
        self._look_around()


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
    """A thin grey fog that fills the boxes of all levels."""
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
    """A fog of one colour (3,) in all directions, whose harmonics are 0."""
    row = np.zeros(fog.width, np.float32)
    row[:3] = (colour - fog.offset) * math.sqrt(4 * math.pi)  # the first harmonic is 1 / sqrt(4 pi)
    return fog.with_values(fog.density, dr.tile(mi.Float(row), dr.width(fog.density)))


def _nodes_of(field: SphericalGrid, cells: OccupiedCells, chosen: mi.Bool) -> np.ndarray:
    """Nodes (levels, Z, Y, X) of the listed cells that are chosen."""
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
    """A fit before its first step, for those who take the steps themselves.

    Args:
        batches: what is looked at.
        box: (2, 3) [length], where the field may be.
        plan: how the fit goes.
        seed: of the rays.

    Raises:
        MivolError: as :class:`mivol.optim.photographs.radiance_problem.RadianceProblem`.

    Example:
        >>> fit = begin_radiance_fit(RayBatches.of(photos.views, (1, 2, 4)), photos.box, PRESETS["cpu"])
        >>> while not fit.is_done:
        ...     fit.advance()
        >>> field = newest_field(fit)
    """
    return begin_fit(RadianceProblem(batches, box, plan, seed), plan.optimizer, plan.course())


def current_field(fit: Fit) -> SphericalGrid:
    """The field of a fit after its newest step; the problem holds it as that step found it."""
    fit.problem.set_reals(fit.run.reals)
    return fit.problem.field
