r"""Fit of a radiance field that is known only at points to photographs: a hash grid or a network.

Conventions. A step has about as many samples as the plan asks for: the number of rays follows from the samples of a ray in the
last steps. The loss is the mean squared error over rays and rgb, weighted as for grids (:mod:`.photo_colours`). Every few steps
densities at random points refresh the map of occupied cells (:mod:`mivol.transport.traversal.occupancy`). Photographs with
alpha get another background colour in each step. A step depends on the reals, the map, the samples of a ray, the seed and its
number.

References: Müller et al. 2022 (learning rate, decay of the weights, samples a step); Li et al. 2023 (times of the decay).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol import back_end
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.nerf import NerfField, NerfSizes
from mivol.fields.sampled_field import FieldSizes, SampledField
from mivol.optim.events import Event
from mivol.optim.first_order import Adam
from mivol.optim.loop import Course
from mivol.optim.photographs.photo_colours import SCALES, compare_rays
from mivol.optim.photographs.radiance_plan import allocated_bytes
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.optim.problem import Divide, DividedProblem, Reals, to_tensors
from mivol.space import place_grid
from mivol.transport.line_integrals.radiance_field import RayGradient
from mivol.transport.line_integrals.sampled_rays import SampledModel, render_hierarchical, render_samples, vjp_samples
from mivol.transport.traversal.occupancy import Occupancy, list_cells

__all__ = ["PRESETS", "SampledPlan", "SampledProblem", "check_memory", "find_region"]


@dataclass(frozen=True)
class SampledPlan:
    """Plan of a fit of a field that is known at points.

    Attributes:
        sizes: of the field.
        model: class of the field.
        steps: number of steps.
        samples: samples of a step whose colour is evaluated, on average.
        views: most photographs of a step.
        cells: cells of the occupancy map along the longest edge of the box.
        samples_a_cell: samples along the edge of such a cell.
        rate: initial learning rate of all parameters.
        warm_up: steps in which the rate rises, linearly from a hundredth.
        decay: factor on the rate at 50, 75 and 90 % of the steps.
        fall: factor on the rate over all steps, exponentially.
        memory: Adam's memory of the squared gradient.
        weight_decay: L2 decay of the weights of the networks [1].
        stop: transmittance at which a ray ends.
        refresh_every: steps between two refreshes of the occupancy map.
        refresh_all: first steps, in which a refresh evaluates all cells; later ones evaluate a fourth at random and a fourth
            among the occupied.
        random_background: whether photographs with alpha get another background colour in each step.
        precision: "single" or "half", of the table of a hash grid that rays read.
    """

    sizes: FieldSizes = dataclasses.field(default_factory=HashSizes)
    model: type[SampledField] = HashField
    steps: int = 1000
    samples: int = 1 << 16
    views: int = 64
    cells: int = 64
    samples_a_cell: float = 2.0
    rate: float = 1e-2
    warm_up: int = 100
    decay: float = 0.33
    fall: float = 1.0
    memory: float = 0.99
    weight_decay: float = 1e-6
    stop: float = 1e-4
    refresh_every: int = 16
    refresh_all: int = 256
    random_background: bool = True
    precision: str = "single"

    @property
    def optimizer(self) -> Adam:
        """The optimizer of the plan."""
        return Adam(beta_1=0.9, beta_2=self.memory, epsilon=1e-15)

    def course(self, *more: Event) -> Course:
        """All steps, with further events."""
        return Course(self.steps, events=more)

    @property
    def minutes(self) -> float:
        """Estimated time of the fit on two cores that walk 25 million rays a second (``EACH_WEIGHT``) [min]."""
        each = EACH_WEIGHT * self.sizes.weights + EACH_LEVEL * getattr(self.sizes, "levels", 0)
        return self.steps * self.samples * each / 60

    def learning_rate(self, step: int) -> float:
        """Learning rate in a step."""
        passed = sum(step >= share * self.steps for share in (0.5, 0.75, 0.9))
        rise = min(1.0, 0.01 + 0.99 * step / self.warm_up) if self.warm_up else 1.0
        return self.rate * rise * self.decay**passed * self.fall ** (step / self.steps)


EACH_WEIGHT, EACH_LEVEL = 2.2e-10, 7e-8
"""Seconds that a sample of a step takes for a weight, and for a level of a hash grid, on two cores that walk 25 million rays a
second in ``mivol bench optical_depth``. From the fits of ``mivol bench representations``, which take 0.75 to 1.2 of it."""

HASH_GRIDS: dict[str, SampledPlan] = {
    "tiny": SampledPlan(HashSizes(levels=6, log2_table=13, finest=64, width=16), steps=200, samples=1 << 13, cells=24),
    "minute": SampledPlan(HashSizes(log2_table=18, finest=512), cells=96),
    "minutes": SampledPlan(HashSizes(log2_table=18, finest=512), steps=5000, cells=96),
    "gpu": SampledPlan(
        HashSizes(log2_table=19, finest=2048, features=4, width=64), steps=20000, samples=1 << 18, cells=128, precision="half"
    ),
}
"""``tiny`` takes seconds, ``minute`` a minute on two cores, ``minutes`` five. ``gpu`` has the sizes and the precision of Müller
et al. (not measured)."""

NERF = SampledPlan(NerfSizes(), NerfField, rate=5e-4, decay=1.0, fall=0.1, memory=0.999, weight_decay=0.0)
"""Published sizes, rate and decay (Mildenhall et al. 2020): a tenth of the rate at the end."""

SMALL = NerfSizes(depth=4, width=64, skip=2, place=8, branch=32)

NERFS: dict[str, SampledPlan] = {
    "tiny": replace(NERF, sizes=replace(SMALL, depth=3, width=32, place=5), steps=200, samples=1 << 13, cells=24, rate=5e-3),
    "minutes": replace(NERF, sizes=SMALL, steps=2000, samples=1 << 14, cells=48, rate=5e-3),
    "gpu": replace(NERF, steps=50000, samples=1 << 18, cells=128),
}
"""``tiny`` takes seconds, ``minutes`` six of processor time; their small networks take ten times the published
rate. ``gpu`` has the sizes and the rate of Mildenhall et al. (not measured)."""

PRESETS: dict[str, dict[str, SampledPlan]] = {HashField.kind: HASH_GRIDS, NerfField.kind: NERFS}
"""Presets by the kind of the field."""


MOST_PARTS = 8
"""Parts of a step at most: each launches kernels of its own."""

SAMPLES = "statistics/samples"
"""Result of a part: number of its samples."""


@dataclasses.dataclass
class SampledProblem(DividedProblem):
    """A field that is known at points in a box, with photographs.

    Attributes:
        batches: the photographs, at full size (shrink 1).
        box: (2, 3) [length], box of the field.
        plan: plan of the fit.
        seed: root of the first values, rays and samples.
        safe_point: not called; a step is short.
        divide: computes the views of a step elsewhere; None: in this process.
        field: present field.
        occupancy: map of the cells that rays sample.
        sky: None; what photographs show behind the box is known.
    """

    batches: RayBatches
    box: np.ndarray
    plan: SampledPlan
    seed: int = 0
    safe_point: Callable[[], None] = lambda: None
    divide: Divide | None = None
    field: SampledField = dataclasses.field(init=False)
    occupancy: Occupancy = dataclasses.field(init=False)
    sky: ClassVar[None] = None

    def __post_init__(self) -> None:
        to_world = np.diag([*(self.box[1] - self.box[0]), 1.0])
        to_world[:3, 3] = self.box[0]
        self.field = self.plan.model.random(self.plan.sizes, to_world, self.seed, self.batches.space)
        if self.plan.precision != "single":
            self.field = replace(self.field, precision=self.plan.precision)
        self.scale = SCALES[self.batches.space]
        res, place = place_grid(self.box, self.plan.cells)
        self.step = float(place[0, 0] / res[2]) / self.plan.samples_a_cell
        self.occupancy = Occupancy.full(res, place)
        self.samples_a_ray = self.plan.cells * self.plan.samples_a_cell
        self._list_cells()

    @property
    def model(self) -> SampledModel:
        """The present field with its occupied cells."""
        return SampledModel(self.field, self._cells, self.step, self.plan.stop)

    # -- Values -------------------------------------------------------------------------------------------------------

    def initial_reals(self) -> Reals:
        return self.values()

    def values(self) -> Reals:
        return self.field.parameters()

    def set_reals(self, reals: Reals) -> None:
        self.field = self.field.with_parameters(reals)

    # -- Loss and gradient --------------------------------------------------------------------------------------------

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[mi.Float, Reals]:
        """Mean (weighted) squared error of an iteration's rays, and the gradient; 0 views takes the plan's number.

        Noise: from the choice of pixels and of samples.
        """
        self.set_reals(reals)
        is_hierarchical = self.field.coarse is not None
        if not is_hierarchical and iteration % self.plan.refresh_every == 0:
            self.refresh_occupancy(iteration, np.random.default_rng((self.seed, iteration)))
        count = min(views or self.plan.views, len(self.batches.origins))
        tiles = max(1, round(self.plan.samples / self.samples_a_ray / (TILE**2 * count)))
        if self.divide is None:
            found = self.compute_part(reals, iteration, count, tiles, 0, 1)
        else:
            parts = min(count, MOST_PARTS)
            found = to_tensors(self.divide(self, reals, [(iteration, count, tiles, n, parts) for n in range(parts)]))
        self._follow_samples(float(found.pop(SAMPLES).array[0]) / (count * tiles * TILE**2))
        loss, decay = found.pop("loss").array, self.plan.weight_decay
        weights = [name for name in reals if name not in self.field.features]
        for name in weights:
            found[name] = mi.TensorXf(dr.fma(decay, reals[name].array, found[name].array), reals[name].shape)
        return loss, found

    def compute_part(self, reals: Reals, iteration: int, views: int, tiles: int, number: int, parts: int) -> Reals:
        """Loss, derivatives and number of samples of some views of a step, as shares of the step's mean.

        Args:
            reals: of the step.
            iteration: selects the random numbers.
            views, tiles: views of the step, and tiles of each.
            number, parts: of the part, and of all parts; the views are dealt to the parts in turn.
        """
        self.set_reals(reals)
        rng = np.random.default_rng((self.seed, iteration))
        is_hierarchical = self.field.coarse is not None
        if not is_hierarchical and iteration % self.plan.refresh_every == 0:
            rng.random()  # drew the points of the map
        chosen = self.batches.choose_views(views, rng)
        corner = self.batches.draw_corners(1, chosen, tiles, rng)
        batch = self.batches.make_tiles(1, chosen[number::parts], corner[number::parts])
        share = len(chosen[number::parts]) / len(chosen)
        dr.eval(batch.rays)
        u = float(rng.random())
        if is_hierarchical:
            renders = render_hierarchical(self.model, batch.rays, u)
        else:
            renders = (render_samples(self.model, batch.rays, u),)
        random = self.plan.random_background and self.batches.channels == 4
        backdrop = mi.Color3f(*(dr.opaque(mi.Float, float(c)) for c in rng.random(3))) if random else batch.background
        # The coarse field has a loss of its own (Mildenhall et al. 2020, eq. 6); the reported one is of the field.
        compared = [compare_rays(batch, one.colour, one.T, backdrop, self.scale) for one in renders]
        dr.eval(compared)
        pairs = zip(renders, compared, strict=True)
        each = [vjp_samples(one, RayGradient(errors.by_radiance * share, errors.by_T * share)) for one, errors in pairs]
        slopes = join_slopes(each)
        kept = sum(0 if one.samples is None else one.samples.size for one in renders)
        found = {"loss": mi.TensorXf(dr.mean(compared[0].loss) * share, (1,)), SAMPLES: mi.TensorXf(mi.Float(kept), (1,))}
        for name, value in reals.items():
            found[name] = mi.TensorXf(slopes.get(name, dr.zeros(mi.Float, dr.width(value.array))), value.shape)
        return found

    def step_state(self) -> dict[str, Any]:
        """The map of occupied cells."""
        return {"occupancy": self.occupancy}

    def take_step_state(self, state: dict[str, Any]) -> None:
        """The map of the same problem in another process."""
        self.occupancy = state["occupancy"]
        self._list_cells()

    def _follow_samples(self, samples_a_ray: float) -> None:
        """Follow the mean number of samples of a ray; a step changes it by at most a factor of 2."""
        known = self.samples_a_ray
        self.samples_a_ray = min(max(samples_a_ray, known / 2, 0.25), known * 2) * 0.2 + known * 0.8

    def refresh_occupancy(self, iteration: int, rng: np.random.Generator) -> None:
        """Update the map with densities at random points, and list the occupied cells."""
        share = 1.0 if iteration < self.plan.refresh_all else 0.5
        self.occupancy = self.occupancy.refreshed(self.field.density, float(rng.random()), share)
        self._list_cells()

    def _list_cells(self) -> None:
        self.field = replace(self.field, region=self.occupancy.region(self.step))
        self._cells = list_cells(self.field.region)

    # -- Steps --------------------------------------------------------------------------------------------------------

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """The rate of the plan for each parameter."""
        return dict.fromkeys(self.field.parameters(), self.plan.learning_rate(iteration))

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        return reals

    # -- On disk ------------------------------------------------------------------------------------------------------

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """The occupancy map and the mean number of samples of a ray."""
        return {"occupancy": np.array(self.occupancy.values), "samples_a_ray": np.array(self.samples_a_ray)}

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        self.occupancy = replace(self.occupancy, values=mi.Float(arrays["occupancy"]))
        self.samples_a_ray = float(arrays["samples_a_ray"])
        self.set_reals(reals)
        self._list_cells()


def join_slopes(each: list[dict[str, mi.Float]]) -> dict[str, mi.Float]:
    """Derivatives of a field, and of its coarse one behind them in the same arrays."""
    if len(each) == 1:
        return each[0]
    joined, coarse = each
    for name, slope in joined.items():
        own = dr.width(coarse[name])
        dr.scatter_add(slope, coarse[name], dr.arange(mi.UInt32, own) + own)
    return joined


def find_region(field: SampledField, cells: int) -> SampledField:
    """A field with its occupied cells, as rays and files need them: of a network that was not fitted here.

    Args:
        field: hash grid or NeRF in an upright box.
        cells: along the longest edge of the box.

    Bias: as of :mod:`mivol.transport.traversal.occupancy`; matter that all eight points of a cell miss is lost.
    """
    low = field.to_world[:3, 3]
    res, place = place_grid(np.array([low, low + field.edges]), cells)
    occupancy = Occupancy.full(res, place)
    for u in np.random.default_rng(0).random(8):
        occupancy = occupancy.refreshed(field.density, float(u))
    return replace(field, region=occupancy.region(float(place[0, 0] / res[2]) / SampledPlan.samples_a_cell))


SAMPLE = 4 * 160
"""Bytes of a sample: places, values, derivatives, features and harmonics, with their copies by rows."""


def estimate_bytes(plan: SampledPlan, box: np.ndarray) -> int:
    """Dr.Jit's memory in a step [bytes]: parameters with two moments, derivatives and one copy per thread, perhaps a table in
    half floats; map; samples."""
    threads = dr.thread_count() if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else 0
    table = allocated_bytes(4 * plan.sizes.count_numbers(box[1] - box[0]))
    cells = math.prod(n + 1 for n in place_grid(box, plan.cells)[0])
    tables = 8 + threads + (0.5 if plan.precision == "half" else 0)
    return round(tables * table) + 40 * cells + SAMPLE * 4 * plan.samples


def check_memory(plan: SampledPlan, box: np.ndarray, batches: RayBatches, limit: int | None = None) -> str:
    """Check that a fit has enough memory; returns one sentence about its memory.

    Args:
        plan, box, batches: plan, box and photographs of the fit.
        limit: [bytes]; None takes the free memory of the machine, or of the GPU.

    Raises:
        MivolError: the fit needs more memory.
    """
    own = estimate_bytes(plan, box)
    advice = "give field.log2_table or field.samples less" if plan.model is HashField else "give field.samples less"
    back_end.check_memory(batches.bytes + own, f"a fit of a {plan.model.noun}", advice, limit)
    return f"about {(batches.bytes + own) / 2**20:.0f} MiB: photographs {batches.bytes / 2**20:.0f}, the fit {own / 2**20:.0f}"
