"""A radiance field from photographs: a spherical-harmonics grid, coarse first, then finer where something is seen.

Conventions. A fit is a list of stages. Each begins with nodes where the last one's field gave some ray a weight (and their
neighbours), and takes its steps: tiles of a few views, squared error, RMSprop on the rows that were touched. Densities are
signed and pass a ReLU after interpolation, so a cell whose corners are all negative is vacuum and costs nothing.

What happens in a step is a function of the field, the optimiser's state, the seed and the step's number; a resumed fit equals
one that was saved at the same step, to the rounding of float sums in another order.

Momentum is not used: rows are touched by a few views at a time, and what a row remembers of others pulls it away (measured on
the chair at 32^3, 400 steps: 25.7 dB without, 21.0 dB with Adam's).

References: Fridovich-Keil, Yu et al. 2022 (Plenoxels: model, optimiser, total variation, pruning by weight); Karnewar et al.
2022 (ReLU after interpolation); Hinton 2012 (RMSprop).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import maximum_filter

from mivol.errors import MivolError
from mivol.fields.resampling import resample_field
from mivol.fields.sky import Sky
from mivol.fields.spherical import SphericalGrid, basis_size, row_width
from mivol.optim.radiance_plan import PRESETS, Plan, Stage, memory_of, place_grid
from mivol.optim.radiance_priors import Neighbours, dull, smooth, thin_out
from mivol.optim.radiance_views import Batch, Views
from mivol.photos import Camera, pixel_centres, rays
from mivol.transport.line_integrals.radiance_field import (
    RayBatch,
    backward,
    bake,
    brightest_weights,
    cells_of,
    fold,
    model_of,
    render,
)
from mivol.transport.traversal.occupied_cells import Cells

__all__ = ["PRESETS", "Plan", "RadianceFit", "Seen", "Stage", "memory_of", "render_view"]


@dataclass
class RadianceFit:
    """A fit at work, or done.

    Attributes:
        views: what is looked at.
        box: (2, 3) [length], where the field may be.
        plan: how the fit goes.
        seed: of the rays.
        field: what was found so far; None before the first step.
        sky: what was found behind it, where the plan asks for that.
        step: the next step.
        stage: the stage at work.
        seconds: time spent, told by who runs it.

    Example:
        >>> fit = RadianceFit(Views.of(photos.views, (1, 2, 4)), photos.box, PRESETS["cpu"])
        >>> while fit.step < fit.plan.steps:
        ...     loss = fit.advance()
    """

    views: Views
    box: np.ndarray
    plan: Plan
    seed: int = 0
    field: SphericalGrid | None = None
    sky: Sky | None = None
    step: int = 0
    stage: int = -1
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self.box = np.asarray(self.box, np.float64)
        if self.box.shape != (2, 3) or not (self.box[1] > self.box[0]).all():
            raise MivolError(f"the box {self.box.tolist()} was given; its lower and its upper corner are expected.")
        absent = {stage.shrink for stage in self.plan.stages} - self.views.levels.keys()
        if absent:
            raise MivolError(f"views shrunk by {min(absent)} are asked for; take them over in that size (Views.of).")
        if self.plan.sky:
            if self.views.channels == 4:
                raise MivolError("a sky was asked for and the photographs have alpha, which says what is behind: sky = 0.")
            self.sky = Sky.even(self.plan.sky, self.views.median())
            self.sky_squares = dr.zeros(mi.Float, dr.width(self.sky.texels))
        self.unit = float((self.box[1] - self.box[0]).max()) / 2

    # -- Stages -------------------------------------------------------------------------------------------------------

    def begin(self, number: int) -> None:
        """Begin a stage: a dense grid, or a finer one where the last one's field is seen.

        Raises:
            MivolError: nothing is seen.
        """
        place, degree = place_grid(self.box, self.plan.stages[number].longest), self.plan.degree_at(number)
        if self.field is None:
            self.field = _fog(*place, degree, self.plan.start / self.unit)
            self.squares = [dr.zeros(mi.Float, dr.width(a)) for a in (self.field.density, self.field.harmonics)]
        else:
            keep = self.seen_nodes()
            if not keep.any():
                raise MivolError("no view sees anything in the box: check the box, the cameras and the background.")
            # Without the squares the first step would move every row by a whole rate: a fog does not come back from that.
            squares, longest = self.field.with_values(*self.squares), max(self.field.res)
            self.field, squares = (resample_field(f, *place, keep).with_degree(degree) for f in (self.field, squares))
            # Derivatives go with the length of a ray in a voxel.
            shorter = dr.opaque(mi.Float, (longest / max(self.field.res)) ** 2)
            self.squares = [squares.density * shorter, squares.harmonics * shorter]
        self.stage = number
        self._survey()

    def _survey(self) -> None:
        self.neighbours = Neighbours.of(self.field)
        self.cells = cells_of(self.field)

    def seen_nodes(self) -> np.ndarray:
        """Nodes (Z, Y, X) of cells to which some ray of the training views gives the plan's weight, and their neighbours."""
        cells, model = cells_of(self.field), model_of(self.field, self.plan.stop)
        weight = dr.zeros(mi.Float, max(cells.count, 1))
        shrink = max(self.views.levels)
        for view, origin in enumerate(self.views.origins):
            source = bake(self.field, cells, origin[None], mi.UInt32(0))
            brightest_weights(cells, source, model, self.views.whole(shrink, view).rays, weight)
            dr.eval(weight)
        return maximum_filter(_nodes_of(self.field, cells, weight >= self.plan.keep_weight), 3)

    # -- Steps --------------------------------------------------------------------------------------------------------

    def advance(self) -> mi.Float:
        """Take one step, and begin a stage where one is due; the squared error of each ray, mean over rgb.

        Raises:
            MivolError: as :meth:`begin`.
        """
        number = self.plan.stage_at(self.step)
        if number != self.stage:
            self.begin(number)
        stage = self.plan.stages[number]
        if self.step % self.plan.survey == 0:
            self.cells = cells_of(self.field)
        rng = np.random.default_rng((self.seed, self.step))
        count = len(self.views.origins)
        chosen = np.sort(rng.choice(count, min(stage.views, count), replace=False))
        batch = self.views.draw(stage.shrink, chosen, stage.tiles, rng)
        loss, slopes = self._slopes(batch, self.views.origins[chosen], self._background(rng))
        if self.sky is not None:
            self._update_sky(slopes.pop())
        self._update(slopes, rng)
        self.step += 1
        return loss

    def _background(self, rng: np.random.Generator) -> np.ndarray | None:
        random = self.plan.random_background and self.views.channels == 4
        return rng.random(3) if random else None

    def _slopes(self, batch: Batch, points: np.ndarray, background: np.ndarray | None) -> tuple[mi.Float, list[mi.Float]]:
        """Squared errors, and the derivatives of their mean: density, harmonics, and the sky's where there is one.

        ``background`` is put behind all photographs; None: each has its own.
        """
        source = bake(self.field, self.cells, points, batch.slot, slope=True)
        model, count = model_of(self.field, self.plan.stop), dr.width(batch.slot)
        seen = render(self.cells, source, model, batch.rays)
        before = batch.before
        behind = before if background is None else mi.Color3f(*(dr.opaque(mi.Float, float(c)) for c in background))
        behind = behind if self.sky is None else self.sky.seen(batch.rays.d)
        # Where a photograph was transparent, it shows what it is over: put what is behind there instead.
        error = seen.colour + seen.T * behind - batch.target - (1 - batch.alpha) * (behind - before)
        error *= batch.counted
        by = error * (2 / (3 * count))
        through = dr.dot(by, behind)
        if self.plan.beta > 0:
            # Bounded: at 0 and 1 the prior is satisfied, and its derivative infinite.
            T = dr.clip(seen.T, 0.01, 0.99)
            through += self.plan.beta / count * batch.counted * (dr.rcp(T) - dr.rcp(1 - T))
        loss = dr.squared_norm(error) * (1 / 3)
        dr.eval(seen, by, through, loss)
        backward(self.cells, source, model, seen, by, through)
        dr.eval(source.slope)
        slopes = list(fold(self.field, self.cells, source, points))
        return loss, slopes if self.sky is None else [*slopes, self.sky.slopes(batch.rays.d, by * seen.T)]

    def _update(self, slopes: list[mi.Float], rng: np.random.Generator) -> None:
        """A step of the field: down its derivatives, then towards what is believed."""
        field = self.field
        own = field.rows if field.nodes is None else field.rows - 1  # the last row is the vacuum around
        density, sh = self.plan.rates(self.step)
        values = [field.density, field.harmonics]
        for k, rate in enumerate((density / self.unit, sh)):
            mine = dr.arange(mi.UInt32, dr.width(slopes[k])) < own * (dr.width(slopes[k]) // field.rows)
            values[k], self.squares[k] = self._descend(values[k], self.squares[k], dr.select(mine, slopes[k], 0), rate)
        self._believe(values, rng)
        dr.eval(values)
        self.field = field.with_values(*values)

    def _update_sky(self, slope: mi.Float) -> None:
        plan = self.plan
        rate = plan.sky_rate * plan.rates(self.step)[1] / plan.sh_rate
        texels, self.sky_squares = self._descend(self.sky.texels, self.sky_squares, slope, rate)
        dr.eval(texels, self.sky_squares)
        self.sky = self.sky.with_texels(texels)

    def _descend(self, values: mi.Float, squares: mi.Float, slope: mi.Float, rate: float) -> tuple[mi.Float, mi.Float]:
        """RMSprop where there is a derivative, the first one its own mean: values, and means of squares."""
        square = dr.square(slope)
        mean = dr.select(squares == 0, square, dr.fma(self.plan.memory, squares - square, square))
        touched = mean > 0
        step = dr.opaque(mi.Float, rate) * slope * dr.rsqrt(dr.select(touched, mean, 1))
        return dr.select(touched, values - step, values), dr.select(slope == 0, squares, mean)

    def _believe(self, values: list[mi.Float], rng: np.random.Generator) -> None:
        """Move values towards what is believed: by shares of the learning rate, fewer the more photographs there are."""
        plan, width = self.plan, self.field.width
        density, sh = (rate / len(self.views.origins) for rate in plan.rates(self.step))
        values[0] = thin_out(values[0], density * plan.sparsity, self.unit)
        values[1] = dull(values[1], width, sh * plan.matte)
        # Evaluated here, or the neighbours that are read next would make the step be taken twice.
        dr.eval(values, self.squares)
        where = plan.tv_share, int(rng.integers(dr.width(self.neighbours.after[0])))
        smooth(values[0], 1, self.neighbours, density * plan.tv_density / self.unit, *where)
        smooth(values[1], width, self.neighbours, sh * plan.tv_sh, *where)

    # -- On disk ------------------------------------------------------------------------------------------------------

    def pack(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and facts from which :meth:`restore` goes on; makes the map of cells anew, as that does."""
        about = {"step": self.step, "stage": self.stage, "seconds": self.seconds}
        if self.field is None:
            return {}, about
        arrays = {"density": self.field.density, "harmonics": self.field.harmonics}
        arrays |= {f"square_{k}": square for k, square in enumerate(self.squares)}
        arrays |= {} if self.field.nodes is None else {"nodes": self.field.nodes}
        arrays |= {} if self.sky is None else {"sky": self.sky.texels, "sky_squares": self.sky_squares}
        self.cells = cells_of(self.field)
        return {name: np.array(array) for name, array in arrays.items()}, about

    def restore(self, arrays: dict[str, np.ndarray], about: dict) -> None:
        """Go on from what :meth:`pack` gave; the plan, the views and the box must be the same."""
        self.step, self.stage, self.seconds = int(about["step"]), int(about["stage"]), float(about["seconds"])
        if self.stage < 0:
            return
        res, to_world = place_grid(self.box, self.plan.stages[self.stage].longest)
        nodes = mi.UInt32(arrays["nodes"]) if "nodes" in arrays else None
        values = mi.Float(arrays["density"]), mi.Float(arrays["harmonics"])
        self.field = SphericalGrid(res, to_world, self.plan.degree_at(self.stage), *values, nodes)
        self.squares = [mi.Float(arrays[f"square_{k}"]) for k in range(2)]
        if self.sky is not None:
            self.sky, self.sky_squares = self.sky.with_texels(mi.Float(arrays["sky"])), mi.Float(arrays["sky_squares"])
        self._survey()


def _fog(res: tuple[int, int, int], to_world: np.ndarray, degree: int, density: float) -> SphericalGrid:
    """A thin grey fog that fills the box."""
    rows = math.prod(res)
    width = row_width(basis_size(degree))
    return SphericalGrid(res, to_world, degree, dr.full(mi.Float, density, rows), dr.zeros(mi.Float, rows * width))


def _nodes_of(field: SphericalGrid, cells: Cells, chosen: mi.Bool) -> np.ndarray:
    """Nodes (Z, Y, X) of the listed cells that are chosen."""
    mask = np.zeros(math.prod(field.res), bool)
    index = dr.compress(chosen)
    if cells.count and dr.width(index):
        keep = dr.zeros(mi.UInt8, field.rows)
        for row in cells.node_rows(index, mi.Bool(True)):
            dr.scatter(keep, mi.UInt8(1), row)
        listed = field.listed()
        mask[listed] = np.array(keep)[: len(listed)] > 0
    return mask.reshape(field.res)


# -- Pictures ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Seen:
    """A picture of a field: ``image`` (H, W, 3) over its background, ``opacity`` (H, W), ``depth`` (H, W) [length].

    ``depth`` is the mean distance of what is seen from the camera; NaN where nothing is.
    """

    image: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray


PASS = 1 << 20
"""Rays of a picture that are followed at once."""


def render_view(field: SphericalGrid, camera: Camera, background: np.ndarray | Sky, stop: float = 0.0) -> Seen:
    """Render what a camera sees.

    Args:
        field: what is there.
        camera: with or without distortion.
        background: behind the field: a colour (3,), or a sky.
        stop: a ray ends at this transmittance.

    Bias: O(h^4) in a cell, and that of :func:`mivol.transport.line_integrals.radiance_field.bake`.
    """
    cells, model = cells_of(field), model_of(field, stop)
    source = bake(field, cells, camera.origin[None], mi.UInt32(0))
    width, height = camera.size
    order = _by_tiles(width, height)
    pixels = pixel_centres(camera.size).reshape(-1, 2)[order]
    found = np.empty((width * height, 5), np.float32)
    for start in range(0, len(order), PASS):
        o, d = rays(camera, pixels[start : start + PASS])
        o = np.broadcast_to(o, d.shape)
        sent = RayBatch(*(kind(np.ascontiguousarray(np.float32(a.T))) for kind, a in ((mi.Point3f, o), (mi.Vector3f, d))))
        seen = render(cells, source, model, sent)
        behind = background.seen(sent.d) if isinstance(background, Sky) else mi.Color3f(*map(float, background))
        colour = seen.colour + seen.T * behind
        dr.eval(colour, seen.T, seen.distance)
        found[order[start : start + PASS]] = np.stack([*np.array(colour), np.array(seen.T), np.array(seen.distance)], axis=1)
    found = found.reshape(height, width, 5)
    opacity = 1 - found[..., 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.where(opacity > 0, found[..., 4] / opacity, np.nan)
    return Seen(found[..., :3], opacity, depth)


def _by_tiles(width: int, height: int) -> np.ndarray:
    """Flat numbers of pixels, tile by tile of 4 x 4."""
    row, column = np.divmod(np.arange(width * height), width)
    return np.lexsort((column % 4, row % 4, column // 4, row // 4))
