"""Fit of an octree to photographs: a grid first, its octree, then the leaves with the topology fixed.

Conventions. The stages of the grid are those of :mod:`mivol.optim.photographs.radiance_problem`, and one more stage follows: an
octree of the grid. A fit may also begin at an octree. A step of the octree uses tiles of a few views, as a step of the grid;
its loss is the mean squared error over rays and rgb. Extinctions are reals of their own, projected to at least 0 after each
step. Without an activation, a leaf at 0 still has a derivative and can return. Leaves begin at values that already look right,
so their learning rates begin low.

The reals of an octree are ``density`` (leaves,) and ``harmonics`` (leaves, width), in the scale of
:mod:`mivol.optim.photographs.photo_colours`.

References: Yu et al. 2021 (PlenOctrees: fine-tuning of the leaves).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.fields.harmonics import basis_size, row_width
from mivol.fields.octree import COLOUR_MAPS, Octree
from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.events import CoarseToFine, DropUnseen, Event, UpdateOccupancy
from mivol.optim.first_order import RMSprop
from mivol.optim.loop import Course
from mivol.optim.photographs.octree_building import OctreeRecipe, build_octree
from mivol.optim.photographs.photo_colours import SCALES
from mivol.optim.photographs.radiance_plan import RadiancePlan
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import TILE, RayBatch, RayBatches
from mivol.optim.priors import decay_view_dependence
from mivol.optim.problem import Divide, DividedProblem, Reals, Refinement, SparseProblem, to_tensors
from mivol.transport.line_integrals.leaf_radiance import (
    LeafPlaces,
    make_leaf_colours,
    render_leaves,
    vjp_leaf_colours,
    vjp_leaves,
)
from mivol.transport.line_integrals.radiance_field import RayBundle, RayGradient
from mivol.transport.traversal.leaf_index import LeafIndex

EACH_RAY = 1.2e-6
"""Seconds of a ray of a step, on two cores that walk 25 million rays a second in ``mivol bench optical_depth``. The fits of
``mivol bench representations`` take 0.9e-6 to 1.8e-6."""


@dataclasses.dataclass(frozen=True)
class LeafPlan:
    """Plan of the steps of an octree.

    Attributes:
        steps: number of steps.
        shrink: edge of the squares of pixels whose means are fitted.
        views, tiles: views per step, and tiles of 4 x 4 pixels per view.
        density_rate: initial learning rate of extinctions, times the edge of a cell: a step changes the optical depth of a
            cell by up to this [1].
        sh_rate: initial learning rate of coefficients [radiance].
        last: factor on both rates in the last step; they fall exponentially.
        memory: memory of the running mean of squared derivatives.
        matte: weight decay of the view-dependent coefficients, as in the fit of a grid [photographs].
        stop: transmittance at which a ray ends.
    """

    steps: int
    shrink: int = 1
    views: int = 4
    tiles: int = 1024
    density_rate: float = 0.03
    sh_rate: float = 0.01
    last: float = 0.05
    memory: float = 0.95
    matte: float = 12.0
    stop: float = 1e-3

    @property
    def minutes(self) -> float:
        """Estimated time of the steps on two cores that walk 25 million rays a second (``EACH_RAY``) [min]."""
        return self.steps * self.views * self.tiles * TILE**2 * EACH_RAY / 60

    def learning_rates(self, step: int) -> tuple[float, float]:
        """Learning rates in a step: of extinctions times the edge of a cell, and of coefficients."""
        fall = self.last ** (step / self.steps)
        return self.density_rate * fall, self.sh_rate * fall


@dataclasses.dataclass(frozen=True)
class OctreePlan:
    """Plan of a fit.

    Attributes:
        grid: stages of the grid; None begins at an octree.
        recipe: how the grid becomes an octree.
        leaves: steps of the octree.
        random_background: whether photographs with alpha get another background in each step of the octree.
    """

    grid: RadiancePlan | None
    recipe: OctreeRecipe
    leaves: LeafPlan
    random_background: bool = True

    @property
    def grid_steps(self) -> int:
        """Steps of the grid."""
        return 0 if self.grid is None else self.grid.steps

    @property
    def steps(self) -> int:
        """Total steps."""
        return self.grid_steps + self.leaves.steps

    @property
    def optimizer(self) -> RMSprop:
        """The optimizer of both."""
        return RMSprop(memory=self.leaves.memory, half=True)

    def course(self, *more: Event) -> Course:
        """All steps, with the events of the grid, the change to an octree, and further events."""
        if self.grid is None:
            return Course(self.steps, events=more)
        stages = CoarseToFine(at=(*self.grid.stage_starts, self.grid.steps))
        own = stages, DropUnseen(at=self.grid.drop_steps), UpdateOccupancy(every=self.grid.occupancy_every)
        return Course(self.steps, events=(*own, *more))


Report = Callable[[str, "SphericalGrid | Octree"], str]
"""Receives the name of a stage and its field; returns a clause for the log."""


@dataclasses.dataclass
class OctreeProblem(SparseProblem, DividedProblem):
    """A grid that becomes an octree, with photographs.

    Attributes:
        batches: the photographs.
        box: (2, 3) [length], box of the field.
        plan: plan of the fit.
        seed: root of the random rays.
        tree: present octree; None while the grid is fitted, given for a plan without a grid.
        divide: computes the views of a step elsewhere; None: in this process.
        grid: problem of the grid; None after the octree was made.
        report: called with the grid and its octree when one becomes the other.
        safe_point: called between views while visible matter is found.
    """

    batches: RayBatches
    box: np.ndarray
    plan: OctreePlan
    seed: int = 0
    tree: Octree | None = None
    divide: Divide | None = None
    grid: RadianceProblem | None = dataclasses.field(init=False, default=None)
    report: Report = lambda name, field: ""
    safe_point: Callable[[], None] = lambda: None

    sky = None
    exposure = None
    has_gains = False

    def __post_init__(self) -> None:
        self.scale = SCALES[self.batches.space]
        if self.tree is None:
            self._begin_grid()
        else:
            self._begin_tree(self.tree)

    def _begin_grid(self) -> None:
        self.tree, self.grid = None, RadianceProblem(self.batches, self.box, self.plan.grid, self.seed)

    def _begin_tree(self, tree: Octree) -> None:
        self.tree, self.grid = tree, None
        self.index, self.places = LeafIndex.find(tree), LeafPlaces.find(tree)
        names = "depth", "to_world", "degree", "codes", "sizes", "colours", "offset", "space"
        self._leaves = {name: getattr(tree, name) for name in names}

    @property
    def field(self) -> SphericalGrid | Octree:
        """Present field."""
        return self.tree if self.grid is None else self.grid.field

    @property
    def stage(self) -> int:
        """Number of the current stage; the octree has the last one."""
        return self.grid.stage if self.grid is not None else 0 if self.plan.grid is None else len(self.plan.grid.stages)

    # -- Values -------------------------------------------------------------------------------------------------------

    def initial_reals(self) -> Reals:
        """Reals of the present field."""
        return self.values()

    def values(self) -> Reals:
        """The nodes of the grid, or the leaves, as tensors of reals."""
        if self.grid is not None:
            return self.grid.values()
        tree = self.tree
        return {
            "density": mi.TensorXf(tree.density, (tree.leaves,)),
            "harmonics": mi.TensorXf(self.scale.to_reals(tree.harmonics), (tree.leaves, tree.width)),
        }

    def set_reals(self, reals: Reals) -> None:
        """Set the values of the nodes or leaves."""
        if self.grid is not None:
            self.grid.set_reals(reals)
        else:
            self.tree = self.tree.with_values(reals["density"].array, self.scale.to_colours(reals["harmonics"].array))

    # -- Loss and gradient --------------------------------------------------------------------------------------------

    def loss_and_gradient(self, reals: Reals, iteration: int, views: int = 0) -> tuple[mi.Float, Reals]:
        """Mean (weighted) squared error of an iteration's rays, and the gradient; 0 views takes the plan's number.

        Noise: from the choice of pixels. Bias: as :func:`mivol.transport.line_integrals.leaf_radiance.make_leaf_colours`.
        """
        if self.grid is not None:
            self.grid.divide = self.divide and (lambda grid, reals, parts: self.divide(self, reals, parts))
            return self.grid.loss_and_gradient(reals, iteration, views)
        if self.divide is None:
            found = self.compute_part(reals, iteration, views)
        else:
            self.set_reals(reals)
            count = min(views or self.plan.leaves.views, len(self.batches.origins))
            found = to_tensors(self.divide(self, reals, [(iteration, views, (number,)) for number in range(count)]))
        return found.pop("loss").array, found

    def compute_part(self, reals: Reals, iteration: int, views: int, only: Sequence[int] | None = None) -> Reals:
        """Loss and derivatives of the rays of some views of a step, as shares of the step's mean.

        Args:
            reals: of the step.
            iteration, views: as :meth:`loss_and_gradient`.
            only: indices of the views among the views of the step; None: all.
        """
        if self.grid is not None:
            return self.grid.compute_part(reals, iteration, views, only)
        self.set_reals(reals)
        plan, rng = self.plan.leaves, np.random.default_rng((self.seed, iteration))
        chosen = self.batches.choose_views(views or plan.views, rng)
        corner = self.batches.draw_corners(plan.shrink, chosen, plan.tiles, rng)
        background = rng.random(3) if self.plan.random_background and self.batches.channels == 4 else None
        numbers = list(range(len(chosen)) if only is None else only)
        share = len(numbers) / len(chosen)
        batch = self.batches.make_tiles(plan.shrink, chosen[numbers], corner[numbers])
        loss, (density, harmonics) = self.batch_loss_and_gradient(batch, background, share)
        slopes = {"density": density, "harmonics": self.scale.gradient_by_reals(harmonics, reals["harmonics"].array)}
        found = {name: mi.TensorXf(slopes[name], value.shape) for name, value in reals.items()}
        return found | {"loss": mi.TensorXf(dr.mean(loss) * share, (1,))}

    def step_state(self) -> dict[str, Any]:
        """The state of the grid, or the octree."""
        if self.grid is not None:
            return self.grid.step_state()
        return self._leaves

    def take_step_state(self, state: dict[str, Any]) -> None:
        """Nodes or leaves of the same problem in another process."""
        if "codes" in state:
            count = len(state["codes"])
            self._begin_tree(
                Octree(
                    **state,
                    density=dr.zeros(mi.Float, count),
                    harmonics=dr.zeros(mi.Float, count * row_width(basis_size(state["degree"]))),
                )
            )
        else:
            if self.grid is None:  # an earlier fit of the same photographs and plan ended as an octree
                self._begin_grid()
            self.grid.take_step_state(state)

    def batch_loss_and_gradient(
        self, batch: RayBatch, background: np.ndarray | None, share: float
    ) -> tuple[mi.Float, tuple[mi.Float, mi.Float]]:
        """Squared error of each ray of a batch, weighted, mean over rgb, and derivatives of the mean over rays.

        Args:
            batch: rays and their target colours.
            background: put behind all photographs (3,); None keeps each photograph's own background.
            share: of the batch in a step, a factor on the derivatives.
        """
        source = make_leaf_colours(self.tree, self.places, batch.origins, batch.slot, slope=True)
        count = dr.width(batch.slot)
        rendered = render_leaves(self.index, source, batch.rays, -math.log(self.plan.leaves.stop))
        own = batch.background
        backdrop = own if background is None else mi.Color3f(*(dr.opaque(mi.Float, float(c)) for c in background))
        colour = rendered.colour + rendered.T * backdrop
        # A transparent pixel of a photograph shows its own background: the error replaces it by the backdrop.
        error = colour - batch.target - (1 - batch.alpha) * (backdrop - own)
        weight = self.scale.weight(colour)
        error *= batch.counted * weight
        by_colour = error * weight * (2 * share / (3 * count))
        by_T = dr.dot(by_colour, backdrop)
        loss = dr.squared_norm(error) * (1 / 3)
        dr.eval(rendered, by_colour, by_T, loss)
        vjp_leaves(self.index, source, rendered, RayGradient(by_colour, by_T))
        dr.eval(source.slope)
        return loss, vjp_leaf_colours(self.tree, self.places, source, batch.origins)

    # -- Steps --------------------------------------------------------------------------------------------------------

    def learning_rates(self, iteration: int) -> dict[str, float]:
        """Learning rates of the reals."""
        if self.grid is not None:
            return self.grid.learning_rates(iteration)
        density, sh = self.plan.leaves.learning_rates(iteration - self.plan.grid_steps)
        return {"density": density / self.tree.cell, "harmonics": sh * self.scale.rate}

    def after_step(self, reals: Reals, iteration: int) -> Reals:
        """Keep the extinctions of leaves at 0 or above, and let view-dependent coefficients decay."""
        if self.grid is not None:
            return self.grid.after_step(reals, iteration)
        density, harmonics = (reals.pop(name) for name in ("density", "harmonics"))
        share = self.plan.leaves.matte * self.learning_rates(iteration)["harmonics"] / len(self.batches.origins)
        return {
            "density": mi.TensorXf(dr.maximum(density.array, 0), density.shape),
            "harmonics": mi.TensorXf(
                decay_view_dependence(harmonics.array, self.tree.width, dr.opaque(mi.Float, 1 - min(share, 1))), harmonics.shape
            ),
        }

    # -- Stages -------------------------------------------------------------------------------------------------------

    def refine(self, stage: int) -> Refinement:
        """Begin a stage of the grid, or make the octree of the grid.

        Raises:
            MivolError: no matter is visible, or as :func:`mivol.optim.photographs.octree_building.build_octree`.
        """
        self.grid.safe_point = self.safe_point
        if stage < len(self.plan.grid.stages):
            return self.grid.refine(stage)
        grid = self.grid.field
        said = [self.report("grid", grid)]
        self._begin_tree(build_octree(grid, self.view_rays, self.plan.recipe))
        said.append(self.report("octree", self.tree))
        shapes = {name: value.shape for name, value in self.values().items()}
        message = f"the grid became an octree of {self.tree.leaves} leaves in {2**self.tree.depth} cells along each axis"
        return Refinement(
            self.values(),
            # A leaf has no node whose means it could take: its first derivative is its mean.
            lambda tensors: {name: dr.zeros(mi.TensorXf, shape) for name, shape in shapes.items()},
            message="; ".join([message, *filter(None, said)]),
        )

    def view_rays(self) -> Iterator[RayBundle]:
        """Rays of all pixels of the photographs, view by view, in the size of the octree's steps."""
        for view in range(len(self.batches.origins)):
            yield self.batches.all_pixels(self.plan.leaves.shrink, view).rays
            self.safe_point()

    def update_occupancy(self) -> None:
        """List the nonempty cells of the grid; the leaves of an octree stay."""
        if self.grid is not None:
            self.grid.update_occupancy()

    # -- On disk ------------------------------------------------------------------------------------------------------

    def pack(self, reals: Reals) -> dict[str, np.ndarray]:
        """The grid's own state, or the leaves of the octree."""
        if self.grid is not None:
            return self.grid.pack(reals)
        self.set_reals(reals)
        tree = self.tree
        names = "depth", "to_world", "codes", "sizes", "degree", "offset"
        return {name: np.array(getattr(tree, name)) for name in names} | {
            "colours": np.array(COLOUR_MAPS.index(tree.colours)),
        }

    def unpack(self, arrays: dict[str, np.ndarray], reals: Reals) -> None:
        """Continue from the arrays of :meth:`pack`, with the same plan and photographs."""
        if "codes" not in arrays:
            return self.grid.unpack(arrays, reals)
        depth, degree, colours = (int(arrays[name]) for name in ("depth", "degree", "colours"))
        values = reals["density"].array, self.scale.to_colours(reals["harmonics"].array)
        settings = COLOUR_MAPS[colours], float(arrays["offset"]), self.batches.space
        self._begin_tree(Octree(depth, arrays["to_world"], degree, arrays["codes"], arrays["sizes"], *values, *settings))
        return None
