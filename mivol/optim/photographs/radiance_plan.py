"""How a radiance field is fitted: stages, rates and priors, and the memory that they take.

Conventions. Lengths are the world's; learning rates and priors of the density count in half the longest edge of the box, so
nothing depends on the unit. ``PRESETS`` lists plans by name.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.fields.harmonics import basis_size, row_width
from mivol.machine import available_memory
from mivol.optim.events import CoarseToFine, DropUnseen, Event, UpdateOccupancy
from mivol.optim.first_order import RMSprop
from mivol.optim.loop import Course
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.optim.priors import DecoupledPrior, Smoothness, Sparsity, ViewDependence

FEW_PHOTOGRAPHS = 50
"""Photographs below which colours that go with the direction are more than they tell (SH 1 against 2: 23.9 and 23.2 dB)."""


@dataclass(frozen=True)
class RadianceStage:
    """Some steps on a grid of one resolution.

    Attributes:
        longest: nodes along the longest edge of the box; voxels are cubes. Where the plan says ``cubic``, along that of a cube.
        steps: how many.
        shrink: edge of the squares of pixels whose means are looked at: where voxels are larger than pixels, a mean says the
            same with fewer rays.
        views, tiles: views a step, and tiles of 4 x 4 pixels of each. Each view has a table of all nodes, made and folded in
            every step: as many rays of fewer views take less time and memory (128^3, 65,536 rays of the chair: 101 ms of
            processor time from 16 views, 83 ms from 4; held-out views the same to 0.04 dB).
        rate: factor on the plan's rate of the density. In a voxel of twice the edge a step is twice the optical depth, and thin
            things are lost where it makes a coarse voxel opaque or empty (rods in 64^3 nodes: 24.6 dB at a rate of 50 in all
            stages, 28.0 dB at 7.5, 15 and 30 in three).
    """

    longest: int
    steps: int
    shrink: int = 1
    views: int = 4
    tiles: int = 1024
    rate: float = 1.0


@dataclass(frozen=True)
class RadiancePlan:
    """How a fit goes.

    Attributes:
        stages: in their order.
        degree: of the harmonics, in the last stage.
        few_degree: the degree where there are fewer than ``FEW`` photographs; None: ``degree`` too.
        first_degree: in the first one; those between climb evenly. None for ``degree`` in all.
        density_rate, sh_rate: first learning rates: of the density times half the longest edge [1], of coefficients [radiance].
        last: factor on both in the last step; they fall exponentially.
        delay: share of the steps over which the density's rate rises from a hundredth (a quarter of a sine).
        memory: of the running mean of squared derivatives.
        tv_density, tv_sh: total variation of the density and of the coefficients, in photographs: how many of them, all asking
            for the same, it takes to hold against it. With V photographs a step goes this / V of a learning rate.
        tv_share: share of the rows that total variation looks at, a step.
        tv_every: steps from one look to the next, which takes the shares of all between: 1 where there are fewer than ``FEW``
            photographs, for a look moves values by this / V times the weight in learning rates, and must stay below one.
        sparsity: Cauchy prior on the density, in photographs.
        matte: coefficients beyond the constant fall by this / V times their learning rate a step [1 / radiance]: what
            photographs say about directions is soon more than there is (a room in 52 photographs: 39.2 dB, without 38.2).
        few_matte: the same where there are fewer than ``FEW`` photographs; None: ``matte`` too. Few gain
            nothing by it (20 photographs of the fox, and of a room: 23.4 and 28.3 dB with 12, 23.4 and 31.7 with 0).
        depth: weight of the distances to the points of a reconstruction (:mod:`mivol.optim.photographs.depth_supervision`),
            beside the mean squared error.
        beta: of log T + log(1 - T), which asks rays to end in matter or to pass; mean over the rays.
        stop: a ray ends at this transmittance; what is left out is at most that share of the brightest colour.
        keep_weight: a node is kept where some ray gives a cell of it this weight.
        start: the first density, times half the longest edge.
        occupancy_every: steps after which the map of occupied cells is made anew.
        drop: share of the last stage's steps after which nodes are left out that no view sees, nor a neighbour of theirs, by
            ``keep_weight``; 0: none are. A stage begins with nodes two voxels beyond what the last one saw.
        sky: rows of a map of what is behind the field, learned with it (:mod:`mivol.fields.sky`); 0: the photographs' colour.
        sky_rate: first learning rate of the sky [radiance]; it must lead, or the field fills the box with what is behind.
        sky_smooth: share of the way that a texel goes to its neighbours in a step, so that none stays as it began.
        exposure: a gain for each channel of each photograph (:mod:`mivol.optim.photographs.exposure`), where they disagree.
        levels: nested boxes, each of twice the extent (:mod:`mivol.fields.spherical_grid`).
        fewer_levels: only as many of them as the points of a reconstruction need, where these are known.
        near: derivatives of what is nearer to a camera than so many medians of the cameras' distances from the box's middle go
            down with the square of the distance (Philip & Deschaintre 2023); 0: none do.
        voxel: pixels along a voxel, seen from the median camera: what photographs are made smaller to, within a factor of
            sqrt(2), and no box of a ``cubic`` plan is finer. (With 1.2, 2.3 and 4.7 of them held-out training views of the
            chair came to 30.9, 31.6 and 31.0 dB in as many steps; fits that take longer gain by finer ones.)
        cubic: a box that is no cube gets as many nodes in all as its stages have in a cube, for memory and time go with them
            (:func:`scale_longest`); False: ``longest`` is meant as it stands.
        epochs: times that a stage looks at each pixel of its photographs, at most: few and small ones take fewer steps (230
            in the last at least), or they are learned by heart (three made-up scenes, 60 photographs of 200 pixels, with 4, 8,
            16 and 70: 32.5, 33.2, 32.8 and 31.7 dB).
        random_background: photographs with alpha are seen over another colour each step, so that nothing stands in the air in
            the background's colour.
    """

    stages: tuple[RadianceStage, ...]
    degree: int = 2
    few_degree: int | None = None
    first_degree: int | None = None
    density_rate: float = 10.0
    sh_rate: float = 0.05
    last: float = 0.02
    delay: float = 0.2
    memory: float = 0.95
    tv_density: float = 0.1
    tv_sh: float = 1.0
    tv_share: float = 1 / 16
    tv_every: int = 1
    sparsity: float = 0.0
    matte: float = 12.0
    few_matte: float | None = None
    depth: float = 0.0
    beta: float = 0.0
    stop: float = 1e-3
    keep_weight: float = 0.01
    start: float = 0.1
    occupancy_every: int = 64
    drop: float = 0.0
    sky: int = 0
    sky_rate: float = 0.1
    sky_smooth: float = 0.0
    exposure: bool = False
    levels: int = 1
    fewer_levels: bool = True
    near: float = 0.0
    voxel: float = 2.0
    cubic: bool = True
    epochs: float = math.inf
    random_background: bool = True

    @property
    def steps(self) -> int:
        """Steps of all stages."""
        return sum(stage.steps for stage in self.stages)

    @property
    def stage_starts(self) -> tuple[int, ...]:
        """Steps before which the stages after the first begin."""
        return tuple(int(n) for n in np.cumsum([stage.steps for stage in self.stages])[:-1])

    @property
    def drop_steps(self) -> tuple[int, ...]:
        """Steps before which unseen nodes are left out."""
        last = self.stages[-1].steps
        return (self.steps - last + max(1, round(self.drop * last)),) if self.drop > 0 else ()

    @property
    def optimizer(self) -> RMSprop:
        """What takes the steps."""
        return RMSprop(memory=self.memory, half=True)

    @property
    def priors(self) -> tuple[tuple[str, DecoupledPrior], ...]:
        """Parameters, and the priors that act on them after each step, in this order."""
        return (
            ("density", Sparsity(weight=self.sparsity)),
            ("harmonics", ViewDependence(weight=self.matte)),
            ("density", Smoothness(weight=self.tv_density, share=self.tv_share, every=self.tv_every)),
            ("harmonics", Smoothness(weight=self.tv_sh, share=self.tv_share, every=self.tv_every)),
        )

    def course(self, *more: Event) -> Course:
        """All steps, with the stages, the surveys and what else is to happen between them."""
        between = (
            CoarseToFine(at=self.stage_starts),
            DropUnseen(at=self.drop_steps),
            UpdateOccupancy(every=self.occupancy_every),
        )
        return Course(self.steps, events=(*between, *more))

    def with_longest(self, longest: int) -> RadiancePlan:
        """The plan that ends with so many nodes along the longest edge; stages that are coarser stay.

        Where all are, the last of them takes half its steps: it is to find what is empty, and where colours begin (the chair
        with the nodes of 256^3, in a like time: 31.29 dB with 1159 and 1159 steps of the last two stages, 31.40 with 500 and
        1400).
        """
        coarser = [stage for stage in self.stages if stage.longest < longest]
        if len(coarser) == len(self.stages):
            coarser[-1] = replace(coarser[-1], steps=max(1, coarser[-1].steps // 2))
        return replace(self, stages=(*coarser, replace(self.stages[-1], longest=longest)))

    def near_distance(self, origins: np.ndarray, box: np.ndarray) -> float:
        """The distance from a camera below which derivatives fall [length], of cameras at ``origins`` (V, 3)."""
        return self.near * float(np.median(np.linalg.norm(origins - box.mean(axis=0), axis=1)))

    def degree_at(self, number: int) -> int:
        """The degree of the harmonics in a stage."""
        if self.first_degree is None or len(self.stages) == 1:
            return self.degree
        return round(self.first_degree + (self.degree - self.first_degree) * number / (len(self.stages) - 1))

    def learning_rates(self, step: int) -> tuple[float, float]:
        """Learning rates in a step: of the density times half the longest edge, and of coefficients."""
        share = step / max(self.steps, 1)
        rise = 1.0
        if self.delay > 0:
            rise = 0.01 + 0.99 * math.sin(math.pi / 2 * min(share / self.delay, 1))
        stage = self.stages[sum(step >= begin for begin in self.stage_starts)]
        return stage.rate * self.density_rate * self.last**share * rise, self.sh_rate * self.last**share


CPU = RadiancePlan(
    (
        RadianceStage(32, 130, 4, tiles=256, rate=1 / 4),
        RadianceStage(64, 195, 4, tiles=512, rate=1 / 2),
        RadianceStage(128, 700, 2, tiles=1024),
    ),
    density_rate=60.0,
    sh_rate=0.1,
    tv_sh=0.2,
    tv_every=4,
    drop=1 / 4,
)
"""The preset ``cpu``."""

PRESETS: dict[str, RadiancePlan] = {
    "tiny": RadiancePlan((RadianceStage(24, 100, 4, tiles=128), RadianceStage(48, 200, 2, tiles=256))),
    "cpu": CPU,
    "fine": replace(
        CPU,
        stages=(
            RadianceStage(32, 150, 4, tiles=256, rate=1 / 4),
            RadianceStage(64, 250, 4, tiles=512, rate=1 / 2),
            RadianceStage(128, 400, 2, tiles=1024),
            RadianceStage(256, 600, 1, tiles=1024),
            RadianceStage(352, 2600, 1, tiles=1024),
        ),
        last=0.006,
        voxel=4 / 3,
        epochs=8.0,
    ),
    "capture": RadiancePlan(
        (RadianceStage(32, 150, 1, 8, 64), RadianceStage(64, 450, 1, 8, 128)),
        few_degree=1,
        few_matte=0.0,
        tv_density=1.0,
        tv_share=1 / 8,
        stop=1e-4,
        sky=32,
        depth=0.003,
        sky_smooth=0.05,
        levels=5,
        near=1.0,
        exposure=True,
    ),
    "gpu": RadiancePlan(
        (
            RadianceStage(64, 300, 4, 16, 512),
            RadianceStage(128, 700, 2, 16, 1024),
            RadianceStage(256, 3000, 1, 16, 2048),
            RadianceStage(512, 4000, 1, 16, 2048),
        )
    ),
}
"""``tiny`` takes seconds, ``cpu`` a minute on two cores, ``fine`` twenty, for many sharp photographs; ``capture`` takes
minutes too and is for photographs of a place without bounds; ``gpu`` has the resolutions of Plenoxels (256, then 512; not
measured).

Rates and priors were chosen on views held out of the chair's training split (32^3 and 64^3), on the still life from 12 and
60 views and on seven views of the three fields of mivol bench radiance_field. The delay is what few views need most: from
the first step at the full rate a field is opaque before it has a shape (seven views of a thin shell: 14 dB, with it 28).

With the rates of ``cpu`` a voxel's optical depth moves alike in all stages, and colours move twice as far as by default: half
the steps end as well. They were chosen on the chair's held-out training views (64^3: densities at 10, 30, 100 and 300, colours
at 0.05, 0.1 and 0.2), on glossy and on thin things. Few views want lower ones (seven of a thin shell, 64^3, densities at 50 in
all stages: 1.1 dB less), so they are no default of a plan."""


def place_grid(box: np.ndarray, longest: int) -> tuple[tuple[int, int, int], np.ndarray]:
    """Resolution (Z, Y, X) and place of a grid of cubic voxels that fills a box (2, 3), and a little more where it must."""
    edges = box[1] - box[0]
    h = edges.max() / longest
    counts = np.maximum(np.ceil(edges / h - 1e-9), 1).astype(int)
    to_world = np.diag([*(counts * h), 1.0])
    to_world[:3, 3] = box.mean(axis=0) - counts * h / 2
    return (int(counts[2]), int(counts[1]), int(counts[0])), to_world


def scale_longest(longest: int, box: np.ndarray) -> int:
    """Nodes along the longest edge of a box (2, 3) that has as many in all as a cube with ``longest`` along each edge."""
    edges = box[1] - box[0]
    return round(longest * edges.max() / float(np.cbrt(edges.prod())))


NESTED_FILLED = 0.4
"""Share of the nodes of a finer stage of nested boxes that are taken to be kept: they hold what is around (0.37 of a room)."""

SHELL = 50
"""Nodes of a finer stage that are taken to be kept, before it is known, for each node of a slice of its box: what is seen is a
shell, so its share of a grid falls as the edge grows (the chair in the box of its silhouettes: 30, 38 and 52 at 64, 128 and 256
nodes, the last after short stages)."""

INDEX = 90
"""Bytes a row while its cells are listed, beside what stays of them (56 to 98 measured: the chair, the fox, a shell, a fog)."""

RAY = 256
"""Bytes a ray: its state and what it saw (128 measured), its target, and what is in flight."""


def expected_fill(plan: RadiancePlan, stage: RadianceStage) -> float:
    """Share of the nodes of a finer stage that are taken to be kept."""
    return min(1.0, SHELL / stage.longest) if plan.levels == 1 else NESTED_FILLED


def estimate_bytes(plan: RadiancePlan, stage: RadianceStage, box: np.ndarray, rows: int | None = None) -> int:
    """Memory of a stage as Dr.Jit holds it [bytes]: reals, tables of pinholes, neighbours, cells, rays.

    The end of a step has the most of what is as large as the reals: values and their means in half precision, both before and
    after the step, and derivatives. A table of pinholes is there with its derivative and, on the CPU, that of each thread. The
    index of rows and cells takes half a byte a node of the box.

    Args:
        plan, stage, box: what is asked for.
        rows: nodes that are stored; None to estimate them. About as many cells are listed.
    """
    nodes = plan.levels * math.prod(place_grid(box, stage.longest)[0])
    rows = (nodes if stage is plan.stages[0] else int(expected_fill(plan, stage) * nodes)) if rows is None else rows
    width = row_width(basis_size(plan.degree))
    reals = sum(3 * allocated_bytes(4 * n) + 2 * allocated_bytes(2 * n) for n in (rows, rows * width))
    table = 16 * rows * stage.views
    threads = dr.thread_count() if dr.backend_v(mi.Float) == dr.JitBackend.LLVM else 0
    tables = 2 * allocated_bytes(table) + allocated_bytes(threads * table)
    places = 6 * allocated_bytes(4 * rows) + allocated_bytes(32 * rows)
    return reals + tables + places + INDEX * rows + nodes // 2 + stage.views * stage.tiles * TILE**2 * RAY


def allocated_bytes(count: int) -> int:
    """Bytes that Dr.Jit takes for an array of so many: the next power of two."""
    return 1 << (count - 1).bit_length() if count else 0


def check_memory(plan: RadiancePlan, box: np.ndarray, batches: RayBatches, limit: int | None = None) -> str:
    """What a fit will take, in a sentence.

    Args:
        plan, box, batches: what is asked for.
        limit: [bytes]; None for what the machine has left (on a GPU nothing is checked).

    Raises:
        MivolError: more than there is; the largest resolution that fits is said.
    """

    def needed(some: RadiancePlan) -> int:
        return batches.bytes + max(estimate_bytes(some, stage, box) for stage in some.stages)

    most, last = needed(plan), plan.stages[-1]
    if limit is None and dr.backend_v(mi.Float) == dr.JitBackend.LLVM:
        limit = available_memory()
    if limit is not None and most > limit:
        # More nodes never take less, so what fits is found by halving: a longest of 2^31 has that many below it.
        fitting = 7 + bisect.bisect_right(range(8, last.longest), limit, key=lambda n: needed(plan.with_longest(n)))
        advice = f"longest = {fitting} fits" if fitting > 7 else "no resolution fits: read the photographs smaller"
        taken, left = f"{most / 2**30:.1f} GiB", f"{limit / 2**30:.1f}"
        raise MivolError(f"a fit with {last.longest} nodes along an edge takes about {taken} and {left} are left; {advice}.")
    first = estimate_bytes(plan, plan.stages[0], box)
    return (
        f"about {most / 2**20:.0f} MiB: photographs {batches.bytes / 2**20:.0f}, the first grid {first / 2**20:.0f}, "
        f"the last {estimate_bytes(plan, last, box) / 2**20:.0f} if it fills {expected_fill(plan, last):.0%} of its box"
    )
