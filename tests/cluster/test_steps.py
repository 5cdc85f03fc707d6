"""Steps as sums over parts on workers that live in this process: the same loss and gradient as at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, PLAN, ball, camera, photo
from refusals import assert_refused

from mivol.back_end import set_threads
from mivol.cluster.pool import Unit
from mivol.cluster.steps import SharedProjector, StepTimes, make_view_blocks, share_problem, share_projector
from mivol.cluster.workplace import Workplace
from mivol.fields.hash_encoding import HashSizes
from mivol.optim.gaussians.gaussian_plan import GaussianPlan, GaussianStage
from mivol.optim.gaussians.gaussian_problem import GaussianProblem
from mivol.optim.photographs.octree_building import OctreeRecipe, build_octree
from mivol.optim.photographs.octree_problem import LeafPlan, OctreePlan, OctreeProblem
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import SampledPlan, SampledProblem
from mivol.optim.problem import DividedProblem
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector
from mivol.tomography.stored import store_matrix

VIEWS, SIDE = 5, 24
LEAVES = OctreePlan(None, OctreeRecipe(4), LeafPlan(steps=4, views=3, tiles=8))
HASH = SampledPlan(HashSizes(levels=3, log2_table=10, finest=16, width=8), steps=20, samples=1 << 10, views=4, cells=12)
GAUSSIANS = GaussianPlan((GaussianStage(24, 8, 0), GaussianStage(24, 12, 1)), start=60, most=80, views=3)


@pytest.fixture
def batches(cpu_back_end: None) -> Iterator[RayBatches]:
    """Photographs of the ball over white, without alpha, and one thread: several add numbers in no fixed order."""
    before = dr.thread_count()
    set_threads(1)
    yield RayBatches.from_photos([photo(ball(12), k, SIDE) for k in range(VIEWS)], (1, 2), with_alpha=False)
    set_threads(before)


def make_problem(kind: str, batches: RayBatches) -> DividedProblem:
    """A problem of each kind, with all that a plan may add to a step."""
    if kind == "grid":
        plan = replace(PLAN, exposure=True, beta=0.1, sky=8)
        return RadianceProblem(batches, BOX, plan)
    if kind == "hash":
        return SampledProblem(batches, BOX, HASH)
    if kind == "octree":
        tree = build_octree(ball(12), lambda: (batches.all_pixels(1, view).rays for view in range(VIEWS)), LEAVES.recipe)
        return OctreeProblem(batches, BOX, LEAVES, tree=tree)
    rng = np.random.default_rng(3)
    cloud = {
        "means": rng.uniform(-0.6, 0.6, (60, 3)).astype(np.float32),
        "log_scales": np.full((60, 3), -2, np.float32),
        "quaternions": np.tile(np.float32([1, 0, 0, 0]), (60, 1)),
        "opacity_logits": np.zeros(60, np.float32),
        "harmonics": rng.normal(0, 0.3, (60, 1, 3)).astype(np.float32),
    }
    return GaussianProblem(batches, [camera(k, SIDE) for k in range(VIEWS)], cloud, GAUSSIANS)


class PoolHere:
    """A :class:`mivol.cluster.pool.Pool` whose workers live in this process, with inputs of their own."""

    def __init__(self, count: int) -> None:
        self.workers = {number: Workplace() for number in range(count)}
        self.inputs: dict[str, bytes] = {}
        self.counts: list[int] = []
        self.counted: list[int] = []

    def check_room(self, size: int) -> None:
        self.counted.append(size)

    def share(self, digest: str, value: bytes, size: int) -> str:
        assert size == len(value)
        self.inputs[digest] = value
        return digest

    def forget(self, digest: str) -> None:
        del self.inputs[digest]
        for place in self.workers.values():
            place.forget(digest)

    def run(self, units: Iterable[Unit], **options: object) -> Iterator[tuple[object, object]]:
        """Results in another order than the units."""
        for unit in reversed(list(units)):
            place = self.workers[unit.key]
            for digest in unit.needs:
                place.keep(digest, self.inputs[digest])
            self.counts.append(len(unit.args[-1]))
            yield unit.key, unit.function(place, *unit.args)


@pytest.mark.parametrize("kind", ["grid", "octree", "hash", "gaussians"])
def test_a_step_is_the_sum_of_its_parts(kind: str, batches: RayBatches) -> None:
    """Workers know the fields and the state of the problem only, also after a change of both reals and state.

    Tolerance: float32 sums of some thousand terms in another order err by 1e3^(1/2) 6e-8 of the largest; 2e-5 has a margin of
    10. Samples of a hash grid are drawn by the number of a ray in its part, so its losses agree to 10 % only. With 2 and 3
    workers the sums are equal to the bit.
    """
    found = []
    for count in (2, 3):
        problem, pool = make_problem(kind, batches), PoolHere(count)
        steps = share_problem(pool, problem)
        for iteration in (0, 1):
            reals = problem.initial_reals()
            problem.divide = None
            loss, gradient = problem.loss_and_gradient(reals, iteration)
            problem.divide = steps.divide
            divided_loss, divided = problem.loss_and_gradient(reals, iteration)
            assert sum(pool.counts[-count:]) >= 3
            assert float(divided_loss[0]) == pytest.approx(float(loss[0]), rel=0.1 if kind == "hash" else 2e-5)
            assert gradient.keys() == divided.keys() == reals.keys()
            for name, value in gradient.items():
                expected = np.array(value)
                if kind != "hash":
                    close = {"rtol": 0, "atol": 2e-5 * np.abs(expected).max()}
                    np.testing.assert_allclose(np.array(divided[name]), expected, **close)
            change_state(kind, problem, gradient)
        assert len(pool.inputs) == 2
        assert pool.counted[-1] == sum(np.array(value).nbytes for value in reals.values())
        found.append({name: np.array(value) for name, value in divided.items()})
    assert any(np.abs(value).max() > 0 for value in found[0].values())
    for other in found[1:]:
        assert all(np.array_equal(found[0][name], other[name]) for name in other)


def change_state(kind: str, problem: DividedProblem, gradient: dict[str, mi.TensorXf]) -> None:
    """Go on to another stage or another map of occupied cells, where the kind has one."""
    if kind in ("grid", "gaussians"):
        problem.refine(1)
    if kind == "hash":
        problem.refresh_occupancy(16, np.random.default_rng(1))


def test_a_worker_begins_another_fit_of_the_same_octree(batches: RayBatches) -> None:
    """A worker keeps its problem for a fit of equal data and plan; that one begins with the grid again."""
    tree = make_problem("octree", batches).step_state()
    new, used = (OctreeProblem(batches, BOX, replace(LEAVES, grid=PLAN)) for _ in range(2))
    used.take_step_state(tree)
    assert used.grid is None
    used.take_step_state(new.step_state())
    reals = new.initial_reals()
    expected, found = (one.compute_part(reals, 0, 0, (0,)) for one in (new, used))
    assert all(np.array_equal(np.array(value), np.array(found[name])) for name, value in expected.items())


def test_several_photographs_a_step_are_their_mean(batches: RayBatches) -> None:
    """The loss and gradient of a step of three photographs are the means of three steps of one; each view counts once."""
    three, ones = make_problem("gaussians", batches), make_problem("gaussians", batches)
    reals = three.initial_reals()
    loss, gradient = three.loss_and_gradient(reals, 1)
    found = [ones.loss_and_gradient(reals, number, 1) for number in (3, 4, 5)]
    assert float(loss[0]) == pytest.approx(np.mean([float(one[0]) for one, _ in found]), rel=1e-6)
    for name, value in gradient.items():
        mean = np.mean([np.array(each[name]) for _, each in found], axis=0)
        np.testing.assert_allclose(np.array(value), mean, rtol=0, atol=1e-6 * np.abs(mean).max())
    assert np.array_equal(three._times, ones._times)
    assert three._times.max() == 3


def test_times_of_steps_are_means() -> None:
    times = StepTimes()
    for wall, computing in ((0.3, 0.2), (0.5, 0.4)):
        times.add(wall, computing)
    assert times.describe() == "a step takes 400 ms, 300 of them on the slowest worker"


def test_a_plan_with_several_photographs_a_step() -> None:
    """As many photographs in total, rates by the root of their number in a step, moments that forget per photograph."""
    plan = replace(GAUSSIANS, views=1, control_every=10, reset_every=9)
    four = plan.with_views(4)
    assert (four.steps, four.views, four.control_every, four.reset_every) == (5, 4, 3, 3)
    assert four.learning_rates(0, 1.0)["means"] == pytest.approx(2 * plan.learning_rates(0, 1.0)["means"])
    assert (four.optimizer.beta_1, four.optimizer.beta_2) == pytest.approx((0.9**4, 0.999**4))


@pytest.mark.parametrize("is_stored", [False, True])
def test_products_of_a_scan_by_blocks_of_views(variant_rgb: str, is_stored: bool) -> None:
    """A and its transpose by two workers, whole and for a subset, are those of one process to rounding."""
    walk = Projector(ParallelBeam(np.arange(7) * np.pi / 7, (2, 12), 0.2), VoxelGrid((2, 8, 8), (0.25, 0.25, 0.25)))
    pool = PoolHere(2)
    shared = share_projector(pool, walk)
    shared = store_matrix(shared) if is_stored else shared
    assert isinstance(shared, SharedProjector)
    assert [block.stop - block.start for block in make_view_blocks(walk)] == [3, 4]
    rng = np.random.default_rng(0)
    for a, b in ((walk, shared), (walk.subset([5, 1, 2]), shared.subset([5, 1, 2]))):
        x, y = rng.random(a.grid.shape, np.float32), rng.random(a.projection_shape, np.float32)
        np.testing.assert_allclose(b @ x, a @ x, rtol=2e-6)
        np.testing.assert_allclose(b.T @ y, a.T @ y, rtol=0, atol=2e-6 * np.abs(a.T @ y).max())
    assert len(pool.inputs) == 1


def test_rays_of_the_caller_are_refused(variant_rgb: str) -> None:
    """A worker cannot make a geometry whose class is defined in the owner's script."""

    class Rays(ParallelBeam):
        """Rays of a script."""

    walk = Projector(Rays(np.arange(3) * 1.0, (1, 4), 0.2), VoxelGrid((1, 4, 4)))
    assert_refused("the rays are a Rays of this process", share_projector, PoolHere(1), walk)
