"""Plans of radiance field fits: stages, learning rates and priors, and the memory of a fit.

Conventions. Lengths are in world units. Learning rates and priors of the density are relative to half the longest edge of the
box, and do not depend on the unit. ``PRESETS`` lists plans by name.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol import back_end
from mivol.fields.harmonics import basis_size, row_width
from mivol.optim.events import AlignCameras, CoarseToFine, DropUnseen, Event, UpdateOccupancy
from mivol.optim.first_order import RMSprop
from mivol.optim.loop import Course
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.optim.priors import DecoupledPrior, Smoothness, Sparsity, ViewDependence
from mivol.space import place_grid

FEW_PHOTOGRAPHS = 50
"""Number of photographs below which view-dependent colours overfit."""


@dataclass(frozen=True)
class RadianceStage:
    """Steps on a grid of fixed resolution.

    Attributes:
        longest: nodes along the longest edge of the box; voxels are cubes. For a ``cubic`` plan, nodes along the edge of a
            cube.
        steps: number of steps.
        shrink: edge of the squares of pixels whose means are fitted. If voxels are larger than pixels, a mean gives the same
            information with fewer rays.
        views, tiles: views per step, and tiles of 4 x 4 pixels per view. Each view has a table of the nodes, made and folded in
            every step, and the same number of rays from fewer views takes less time and memory.
        rate: factor on the plan's rate of the density. In a voxel of twice the edge a step changes the optical depth twice as
            much, and thin structures are lost if it makes a coarse voxel opaque or empty.
    """

    longest: int
    steps: int
    shrink: int = 1
    views: int = 4
    tiles: int = 1024
    rate: float = 1.0


@dataclass(frozen=True)
class RadiancePlan:
    """Plan of a radiance field fit.

    Attributes:
        stages: in their order.
        degree: of the harmonics, in the last stage.
        few_degree: degree for fewer than ``FEW_PHOTOGRAPHS`` photographs; None takes ``degree``.
        first_degree: degree of the first stage; degrees between rise evenly. None takes ``degree`` in every stage.
        density_rate, sh_rate: initial learning rates: of the density times half the longest edge [1], of coefficients
            [radiance].
        last: factor on both rates in the last step; they fall exponentially.
        delay: share of the steps over which the density's rate rises from a hundredth (a quarter of a sine).
        memory: memory of the running mean of squared derivatives.
        tv_density, tv_sh: total variation of the density and of the coefficients [photographs]: number of agreeing photographs
            that balance the prior. With V photographs, a step moves values by this / V of a learning rate.
        tv_share: share of the rows that total variation moves per step.
        tv_every: steps between two applications of total variation, each with the shares of these steps. 1 for fewer than
            ``FEW_PHOTOGRAPHS`` photographs: an application moves values by this / V times the weight in learning rates, and
            must stay below 1.
        sparsity: Cauchy prior on the density [photographs].
        matte: weight decay of the view-dependent coefficients [1 / radiance]: they fall by this / V times their learning rate
            per step, to avoid overfitting.
        few_matte: ``matte`` for fewer than ``FEW_PHOTOGRAPHS`` photographs; None takes ``matte``.
        depth: weight of the distances to the points of a reconstruction (:mod:`mivol.optim.photographs.ray_batches`),
            beside the mean squared error.
        beta: weight of log T + log(1 - T), mean over the rays, which favours rays that are opaque or empty.
        stop: transmittance at which a ray ends; the neglected light is at most this share of the brightest colour.
        keep_weight: a node stays if some ray gives a cell of the node this weight.
        start: initial density times half the longest edge.
        occupancy_every: steps between updates of the map of occupied cells.
        drop: share of the last stage's steps after which nodes are removed if no view sees the node or a neighbour by
            ``keep_weight``; 0 removes none. A stage begins with nodes up to two voxels beyond the visible nodes of the last
            stage.
        sky: rows of a map of the background, fitted with the field (:mod:`mivol.fields.sky`); 0 takes the photographs' colour.
        sky_rate: initial learning rate of the sky [radiance]; a low rate would let the field fill the box with the background.
        sky_smooth: share by which a texel moves to its neighbours per step; no texel then stays at its start.
        exposure: whether photographs have a gain per channel (:mod:`mivol.optim.photographs.photo_colours`), if they disagree.
        agree: spread of the gains (root mean square of the logarithms) after the first stage below which photographs count as
            equally exposed, and the gains are removed. A tenth of a stop is 0.03.
        poses: whether the cameras of the photographs move with the fit.
        align_every: steps between two corrections of the cameras, if they move.
        levels: number of nested boxes, each of twice the extent (:mod:`mivol.fields.spherical_grid`).
        fewer_levels: whether fewer levels suffice if they hold the points of a reconstruction and the cameras.
        near: distance in medians of the camera distances from the box's centre, below which derivatives fall with the square of
            the distance (Philip & Deschaintre 2023); 0 keeps all derivatives.
        free_space: whether nodes before the cameras that few photographs see stay empty
            (:func:`mivol.photos.region.is_free_space`).
        voxel: pixels along a voxel, seen from the median camera. Photographs are shrunk to this size within a factor of
            sqrt(2), and no box of a ``cubic`` plan is finer.
        cubic: whether a box that is no cube gets as many nodes as a cube with ``longest`` nodes along its edge, since memory
            and time follow the number of nodes (:func:`scale_longest`); False takes ``longest`` literally.
        epochs: maximum number of times that a stage uses each pixel of its photographs. Small sets take fewer steps (at least
            230 in the last stage), or they would overfit.
        random_background: whether photographs with alpha get another background colour in each step, so that no matter takes
            the colour of the background.
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
    agree: float = 0.04
    poses: bool = False
    align_every: int = 25
    levels: int = 1
    fewer_levels: bool = True
    near: float = 0.0
    free_space: bool = False
    voxel: float = 2.0
    cubic: bool = True
    epochs: float = math.inf
    random_background: bool = True

    @property
    def steps(self) -> int:
        """Total steps."""
        return sum(stage.steps for stage in self.stages)

    @property
    def minutes(self) -> float:
        """Estimated time of the fit on two cores that walk 25 million rays a second (``EACH_NODE``) [min]."""
        rays = (stage.steps * stage.views * stage.tiles * TILE**2 * stage.longest for stage in self.stages)
        return sum(rays) * self.levels * EACH_NODE / 60

    @property
    def stage_starts(self) -> tuple[int, ...]:
        """First steps of the stages after the first."""
        return tuple(int(n) for n in np.cumsum([stage.steps for stage in self.stages])[:-1])

    @property
    def drop_steps(self) -> tuple[int, ...]:
        """Steps before which unseen nodes are removed."""
        last = self.stages[-1].steps
        return (self.steps - last + max(1, round(self.drop * last)),) if self.drop > 0 else ()

    @property
    def optimizer(self) -> RMSprop:
        """The optimizer of the plan."""
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
        """All steps, with the events of the plan and further events."""
        own = (CoarseToFine(at=self.stage_starts), DropUnseen(at=self.drop_steps), UpdateOccupancy(every=self.occupancy_every))
        align = (AlignCameras(every=self.align_every),) if self.poses else ()
        return Course(self.steps, events=(*own, *align, *more))

    def with_longest(self, longest: int) -> RadiancePlan:
        """The plan with another number of nodes along the longest edge at the end; coarser stages stay.

        If all stages are coarser, the last one takes half its steps: it only has to find empty regions and initial colours.
        """
        coarser = [stage for stage in self.stages if stage.longest < longest]
        if len(coarser) == len(self.stages):
            coarser[-1] = replace(coarser[-1], steps=max(1, coarser[-1].steps // 2))
        return replace(self, stages=(*coarser, replace(self.stages[-1], longest=longest)))

    def near_distance(self, origins: np.ndarray, box: np.ndarray) -> float:
        """Distance from a camera below which derivatives fall [length], for cameras at ``origins`` (V, 3)."""
        return self.near * float(np.median(np.linalg.norm(origins - box.mean(axis=0), axis=1)))

    def degree_at(self, number: int) -> int:
        """Degree of the harmonics in a stage."""
        if self.first_degree is None or len(self.stages) == 1:
            return self.degree
        return round(self.first_degree + (self.degree - self.first_degree) * number / (len(self.stages) - 1))

    def learning_rates(self, step: int) -> tuple[float, float]:
        """Learning rates in a step: of the density times half the longest edge, and of coefficients."""
        share = step / self.steps
        rise = 1.0
        if self.delay > 0:
            rise = 0.01 + 0.99 * math.sin(math.pi / 2 * min(share / self.delay, 1))
        stage = self.stages[sum(step >= begin for begin in self.stage_starts)]
        return stage.rate * self.density_rate * self.last**share * rise, self.sh_rate * self.last**share


EACH_NODE = 8e-9
"""Seconds that a ray of a step takes for a node along the longest edge of each box, on two cores that walk 25 million rays a
second in ``mivol bench optical_depth``. The fits of ``mivol bench representations`` take 0.7 to 1.4 of the estimate; the fox,
which fills its only box, 2.7."""

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
        free_space=True,
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
"""``tiny`` takes seconds, ``cpu`` a minute on two cores. ``fine`` takes twenty minutes, for many sharp photographs. ``capture``
takes minutes, for photographs of a place without bounds. ``gpu`` has the resolutions of Plenoxels (256, then 512; not
measured).

Rates and priors were chosen on views held out of training sets. The delay matters most with few views: a field that starts at
the full rate is opaque before it has a shape. With the rates of ``cpu`` a voxel's optical depth changes equally in all stages,
and colours move twice as far as by default, so half the steps suffice. Few views need lower rates, so these are no defaults."""


def scale_longest(longest: int, box: np.ndarray) -> int:
    """Nodes along the longest edge of a box (2, 3) for the total of a cube with ``longest`` nodes along each edge."""
    edges = box[1] - box[0]
    return round(longest * edges.max() / float(np.cbrt(edges.prod())))


NESTED_FILLED = 0.4
"""Assumed share of stored nodes in a finer stage of nested boxes, which hold the surroundings (0.37 for a room)."""

SHELL = 50
"""Assumed number of stored nodes in a finer stage, per node of a slice of the box. Visible matter is a shell, so its share of a
grid falls with the edge (the chair in the box of its silhouettes: 30, 38 and 52 at 64, 128 and 256 nodes, the last value after
short stages)."""

INDEX = 90
"""Bytes per row while cells are listed, beside the stored list (56 to 98 measured: the chair, the fox, a shell, a fog)."""

RAY = 256
"""Bytes per ray: state and result (128 measured), target, and temporaries."""


def expected_fill(plan: RadiancePlan, stage: RadianceStage) -> float:
    """Assumed share of stored nodes in a finer stage."""
    return min(1.0, SHELL / stage.longest) if plan.levels == 1 else NESTED_FILLED


def estimate_bytes(plan: RadiancePlan, stage: RadianceStage, box: np.ndarray, rows: int | None = None) -> int:
    """Dr.Jit's memory in a stage [bytes]: reals, tables of pinholes, neighbours, cells, rays.

    The end of a step holds the most arrays of the size of the reals: values and their means in half precision, before and after
    the step, and derivatives. A table of pinholes exists with its derivative and, on the CPU, one derivative per thread. The
    index of rows and cells takes half a byte per node of the box.

    Args:
        plan, stage, box: plan, stage and box of the fit.
        rows: number of stored nodes; None estimates it. About as many cells are listed.
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
    """Bytes that Dr.Jit allocates for an array of ``count`` bytes: the next power of two."""
    return 1 << (count - 1).bit_length() if count else 0


def check_memory(plan: RadiancePlan, box: np.ndarray, batches: RayBatches, limit: int | None = None) -> str:
    """Check that a fit has enough memory; returns one sentence about its memory.

    Args:
        plan, box, batches: plan, box and photographs of the fit.
        limit: [bytes]; None takes the free memory of the machine, or of the GPU.

    Raises:
        MivolError: the fit needs more memory; the message names the largest resolution that fits.
    """

    def needed(plan: RadiancePlan) -> int:
        return batches.bytes + max(estimate_bytes(plan, stage, box) for stage in plan.stages)

    most, last = needed(plan), plan.stages[-1]

    def advise(free: float) -> str:
        # Memory never falls with the number of nodes, so bisection finds the largest fit even below 2^31 nodes.
        fitting = 7 + bisect.bisect_right(range(8, last.longest), free, key=lambda n: needed(plan.with_longest(n)))
        return f"longest = {fitting} fits" if fitting > 7 else "no resolution fits: read the photographs smaller"

    back_end.check_memory(most, f"a fit with {last.longest} nodes along an edge", advise, limit)
    first = estimate_bytes(plan, plan.stages[0], box)
    return (
        f"about {most / 2**20:.0f} MiB: photographs {batches.bytes / 2**20:.0f}, the first grid {first / 2**20:.0f}, "
        f"the last {estimate_bytes(plan, last, box) / 2**20:.0f} if it fills {expected_fill(plan, last):.0%} of its box"
    )
