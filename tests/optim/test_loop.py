"""The fit loop: every optimizer finds a known optimum, derivatives are consistent, and seeds control all randomness."""

from __future__ import annotations

import dataclasses
import os
import signal

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, fresh
from fit_scene import KEY, absorbing_scene, camera, film, frontal, small_problem, views_of_truth
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.optim import loop
from mivol.optim.events import Evaluate, Upsample
from mivol.optim.first_order import OPTIMIZERS, Adam, RMSprop
from mivol.optim.interrupt import Interrupted, InterruptGuard
from mivol.optim.loop import Course, reconstruct
from mivol.optim.losses import Huber, Log
from mivol.optim.optimizer import Cosine, OptimizerRun
from mivol.optim.parameters import Parameter
from mivol.optim.priors import Laplacian, TotalVariation
from mivol.optim.scenes import scene_problem
from mivol.optim.scenes.scene_problem import SceneProblem, draw_views
from mivol.optim.scenes.views import View, derive_seed, make_batches
from mivol.optim.second_order import GaussNewton, Lbfgs, Packing, conjugate_gradients
from mivol.validate.statistics import Moments

EPS = float(np.finfo(np.float32).eps)

#: optimizer -> (settings, iterations, relative error of both optima that it must reach in a two-parameter problem).
#: Gauss-Newton and L-BFGS converge superlinearly to the float32 noise of the loss (its square root: 3e-4); Adam's and RMSprop's
#: steps of lr times the last cosine factors (below 1e-2 of 0.2) end within 1e-2.
EXACT = {
    "adam": (Adam(), 80, 1e-2),
    "rmsprop": (RMSprop(), 80, 1e-2),
    "lbfgs": (Lbfgs(), 25, 1e-3),
    "gauss_newton": (GaussNewton(), 12, 1e-3),
}


def two_cubes(start: float) -> mi.Scene:
    """Two homogeneous cubes, one behind the left half of the image and one behind the right half."""
    cubes = {}
    for name, x in (("left", -1.0), ("right", 1.0)):
        medium = {"type": "homogeneous", "albedo": 0.0, "sigma_t": {"type": "rgb", "value": start}}
        place = mi.ScalarTransform4f().translate([x, 0, 0])
        cubes[name] = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium}
    scene = {"type": "scene", "sky": {"type": "constant"}, "integrator": {"type": "mivol"}, **cubes}
    return mi.load_dict(scene, optimize=False)  # else equal cubes, and their media, become one


@pytest.mark.slow_for("adam", "rmsprop")
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_finds_a_known_optimum(variant_rgb, name: str) -> None:
    """Two unknown extinctions, each seen through a chord of 2: I = exp(-2 sigma), wanted 0.7 and 0.2, from 0.35."""
    optimizer, iterations, bound = EXACT[name]
    scene = two_cubes(0.35)
    keys = [f"{side}.interior_medium.sigma_t.value.value" for side in ("left", "right")]
    pose = mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]).scale([1.5, 0.8, 1])
    sensor = mi.load_dict({"type": "orthographic", "to_world": pose, "film": film(4)})
    # Seen along -z with y up, x grows to the right: the left half of the image shows the cube at x = -1.
    tau = 2 * np.repeat([[0.7, 0.7, 0.2, 0.2]], 4, axis=0)[..., None].repeat(3, axis=2)
    view = View("both", sensor, mi.TensorXf(np.exp(-tau).astype(np.float32)))
    parameters = [Parameter(key, domain=(0.0, 10.0), lr=0.2) for key in keys]
    fit = reconstruct(SceneProblem(scene, [view], parameters, spp=4), optimizer, Course(iterations, Cosine()))
    values = [float(np.asarray(fit.values()[key]).ravel()[0]) for key in keys]
    assert np.allclose(values, [0.7, 0.2], rtol=bound)


# -- Derivatives --------------------------------------------------------------------------------------------------


def vectors(problem: SceneProblem, seed: int = 0) -> tuple[dict, Packing, np.ndarray, np.ndarray]:
    reals = problem.initial_reals()
    packing = Packing(problem, reals)
    v, w = np.random.default_rng(seed).standard_normal((2, len(packing.low)))
    return reals, packing, v, w


def test_scene_gradient_matches_differences(variant_rgb) -> None:
    """Central differences of f along random directions, with fixed samples: h^2 f''' and the rounding of f, eps f / h,
    balanced at h = 1e-2: 1e-3 of |g| |v| is ample. A TV prior and a softplus map are in between."""
    parameter = Parameter(KEY, "1", (0.0, np.inf), "softplus", lr=0.1, priors=(TotalVariation(weight=0.01, edge=1.0),))
    problem = small_problem(parameters=[parameter])
    reals, packing, v, _ = vectors(problem)
    gradient = packing.vector(problem.linearize(reals).gradient, 1)
    x, h = packing.vector(reals), 1e-2
    ends = [problem.loss_value(packing.tensors(x + sign * h * v), 0) for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * h)
    assert abs(gradient @ v - expected) <= 1e-3 * np.linalg.norm(gradient) * np.linalg.norm(v)


@pytest.mark.slow
def test_gradient_of_a_sky(variant_rgb) -> None:
    """Mitsuba's envmap puts another array in the place of the one it was given: the derivative is that by the given one.

    Differences are exact for a quadratic; but picture and derivative have samples of their own.
    """
    texels = np.random.default_rng(1).uniform(0.2, 1, (4, 8, 3)).astype(np.float32)
    parts = {"sky": {"type": "envmap", "bitmap": mi.Bitmap(texels)}, "ball": {"type": "sphere", "radius": 0.1}}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "mivol"}, **parts})
    views = [View(f"view {i}", camera(i), dr.zeros(mi.TensorXf, (8, 8, 3))) for i in range(2)]
    problem = SceneProblem(scene, views, [Parameter("sky.data", "1", (0.0, np.inf), lr=0.1)], spp=64)
    (key, x), h = next(iter(problem.initial_reals().items())), 1e-2
    v = mi.TensorXf(np.random.default_rng(2).uniform(0.5, 1, x.shape).astype(np.float32))
    ends = [problem.loss_value({key: x + sign * h * v}, 0) for sign in (1, -1)]
    gradient = problem.loss_and_gradient({key: x}, 0)[1][key]
    assert dr.sum(gradient * v, axis=None).array[0] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=0.02)


def test_the_host_waits_for_large_passes_only(variant_rgb, monkeypatch: pytest.MonkeyPatch) -> None:
    """While a small pass is computed, it prepares the next one."""
    waits, problem = [], small_problem()
    monkeypatch.setattr(scene_problem.dr, "sync_thread", lambda: waits.append(1))
    problem.loss_and_gradient(problem.initial_reals(), 0)
    assert not waits
    monkeypatch.setattr(scene_problem, "LARGE_PASS", 1)
    problem.loss_and_gradient(problem.initial_reals(), 0)
    assert len(waits) >= 2


def test_parameter_without_derivative_is_refused(variant_rgb) -> None:
    """An albedo at depth 1 would stay as it is without a word."""
    problem = small_problem(parameters=[Parameter("cube.interior_medium.albedo.value.value", domain=(0.0, 1.0), lr=0.1)])
    problem.integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    with pytest.raises(MivolError, match="the images do not depend on cube.interior_medium.albedo"):
        problem.loss_and_gradient(problem.initial_reals(), 0)


def test_gauss_newton_product_matches_the_jacobian(variant_rgb) -> None:
    """<v, J^T W J v> is the weighted square of J v, which differences of images give; and the product is symmetric."""
    problem = small_problem()
    reals, packing, v, w = vectors(problem, 1)
    linear = problem.linearize(reals)
    x, h, batch, seed = packing.vector(reals), 1e-2, problem.batches[0], linear.seeds[0]
    images = []
    for sign in (1, -1):
        problem.set_reals(packing.tensors(x + sign * h * v))
        images.append(np.asarray(problem.render(batch.sensor, seed), dtype=np.float64))
    jv = (images[0] - images[1]) / (2 * h)
    product, other = (packing.vector(linear.curvature(packing.tensors(p)), 1) for p in (v, w))
    # Differences err by h^2 and by the rounding of images, eps / h = 1e-5 of each pixel.
    assert np.isclose(product @ v, 2 * np.mean(jv**2), rtol=2e-3)
    assert np.isclose(product @ w, other @ v, rtol=1e-4, atol=1e-6 * abs(product @ v))


def test_priors_enter_the_gauss_newton_product(variant_rgb) -> None:
    plain = small_problem()
    reals, packing, v, _ = vectors(plain)
    prior = Laplacian(weight=0.3)
    with_prior = small_problem(parameters=[dataclasses.replace(plain.parameters[0], priors=(prior,))])
    products = []
    for problem in (plain, with_prior):
        products.append(packing.vector(problem.linearize(reals).curvature(packing.tensors(v)), 1))
    direction = packing.tensors(v)[KEY]
    extra = np.asarray(prior.curvature(reals[KEY], direction, (0.25, 0.25, 0.25))).ravel() * 0.1
    assert np.allclose(products[1] - products[0], extra, atol=1e-4 * np.abs(extra).max())


def test_conjugate_gradients_solve(variant_rgb) -> None:
    """n steps solve an n by n system in exact arithmetic; float64 and a condition number of 1e2 leave 1e-10."""
    rng = np.random.default_rng(0)
    q, _ = np.linalg.qr(rng.standard_normal((6, 6)))
    a = q @ np.diag(np.geomspace(1, 100, 6)) @ q.T
    b = rng.standard_normal(6)
    x = conjugate_gradients(lambda d: a @ d, b, np.diag(a).copy(), 12)
    assert np.allclose(a @ x, b, atol=1e-6 * np.abs(b).max())


# -- Randomness, passes, batches ---------------------------------------------------------------------------------


def test_seeds_are_a_function_of_their_key() -> None:
    """Same key, same seed; all keys of a small run differ (a collision has probability 2000^2 / 2^33 = 5e-4)."""
    keys = [(0, i, v, p, n) for i in range(25) for v in range(5) for p in range(4) for n in range(4)]
    seeds = [derive_seed(*key) for key in keys]
    assert seeds == [derive_seed(*key) for key in keys]
    assert len(set(seeds)) == len(seeds)


def test_each_epoch_shows_each_view_once() -> None:
    drawn = [view for i in range(6) for view in draw_views(i, 9, 3, seed=1)]
    assert sorted(drawn[:9]) == list(range(9))
    assert sorted(drawn[9:]) == list(range(9))
    assert drawn[:9] != drawn[9:]
    assert draw_views(4, 9, 3, seed=1) == draw_views(4, 9, 3, seed=1)
    assert draw_views(0, 3, 99, seed=1) != [] and sorted(draw_views(0, 3, 99, seed=1)) == [0, 1, 2]


def test_passes_sum_to_the_samples(variant_rgb) -> None:
    problem = small_problem(spp=10, samples_per_pass=3 * 64)
    sensor = problem.views[0].sensor
    assert sum(problem.passes(sensor, 10)) == 10
    assert max(problem.passes(sensor, 10)) * 64 <= problem.samples_per_pass
    assert max(problem.passes(sensor, 10)) - min(problem.passes(sensor, 10)) <= 1


@pytest.mark.slow
@pytest.mark.statistical
def test_nonlinear_loss_is_independent_of_passes(variant_rgb) -> None:
    """Parallel rays through a constant cube: each sample is exp(-2 sigma), so loss and gradient are known whatever the
    passes. A loss taken pass by pass would be the same here for any noise-free image; so noise is put in by cameras at
    the silhouette. There 4 passes of one sample have a quarter of the excess loss that single samples have, to 3 %: the loss is
    quadratic but for residuals above 0.02."""
    scene = absorbing_scene(np.full((2, 2, 2, 1), 0.4))
    wanted = mi.TensorXf(np.full((4, 4, 3), 0.6, "f"))
    parameter = Parameter(KEY, domain=(0.0, np.inf))
    for most in (1 << 20, 16):
        problem = SceneProblem(scene, [View("a", frontal(), wanted)], [parameter], loss=Log(), spp=8, samples_per_pass=most)
        loss, gradients = problem.loss_and_gradient(problem.initial_reals(), 0)
        r = -0.8 - np.log(0.6)
        weight = 0.36 / (0.36 + 1e-6)
        assert np.isclose(float(loss), weight * r**2, rtol=1e-5)
        assert np.isclose(np.asarray(gradients[KEY]).sum(), weight * 2 * r * -2.0, rtol=1e-5)
    losses = {}
    for spp, most in ((1, 1 << 20), (4, 3 * 64), (256, 1 << 20)):
        problem = small_problem(spp=spp, samples_per_pass=most, loss=Huber(delta=0.02))
        problem.set_reals(problem.initial_reals())
        losses[spp] = np.array([problem.mean_loss(fresh(i)) for i in range(24)])
    clean = losses[256].mean()
    single, split = (Moments.from_values(losses[spp] - clean) for spp in (1, 4))
    assert_same_mean(Moments.from_values(4 * (losses[4] - clean)), single, rounding=0.03 * single.mean, what="excess losses")
    assert_precise(split, 0.1 * float(single.mean), what="losses")


def test_views_side_by_side_are_the_views(variant_rgb) -> None:
    """One shot of three views: each third is the view, up to the samples' places (all rays of a pixel of the frontal
    camera are equal, so there exactly)."""
    truth = np.random.default_rng(0).uniform(0, 2, (1, 1, 1, 1))
    scene = absorbing_scene(truth)
    tau = 2 * truth.item()
    views = [View(str(i), frontal(), mi.TensorXf(np.full((4, 4, 3), i, "f"))) for i in range(3)]
    (batch,) = make_batches(views, 1 << 20)
    image = np.asarray(mi.render(scene, sensor=batch.sensor, spp=4))
    assert image.shape == (4, 12, 3)
    assert np.allclose(image, np.exp(-tau), rtol=4 * EPS)
    assert np.array_equal(np.asarray(batch.reference)[:, 4:8], np.ones((4, 4, 3)))
    assert [s.n_views for s in make_batches(views, 2 * 16)] == [2, 1]


def test_cameras_side_by_side_keep_their_order_and_orientation(variant_rgb) -> None:
    """Random volume, three cameras: batch against single renders. Both estimate pixel means with 64 samples; a pixel's
    samples span at most the whole range 1, so their means differ by less than 8 / sqrt(64) / 2 of it, and on average by
    far less than two different views do."""
    problem = small_problem(spp=64)
    problem.set_reals(problem.initial_reals())
    (batch,) = problem.batches
    batch = np.split(np.asarray(problem.render(batch.sensor, 1)), 3, axis=1)
    single = [np.asarray(problem.render(view.sensor, 2)) for view in problem.views]
    own = max(np.abs(a - b).mean() for a, b in zip(batch, single, strict=True))
    other = min(np.abs(batch[i] - single[(i + 1) % 3]).mean() for i in range(3))
    assert own < 0.01
    assert other > 0.0
    assert own < 0.5 * other


def test_views_with_wide_filters_are_rendered_one_by_one(variant_rgb) -> None:
    views = [View(str(i), camera(i, 8, "gaussian"), mi.TensorXf(np.ones((8, 8, 3), "f"))) for i in range(2)]
    assert [batch.n_views for batch in make_batches(views, 1 << 20)] == [1, 1]


# -- The loop -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_coarse_to_fine_keeps_the_image(variant_rgb) -> None:
    """Refining conserves the mass; the loss right after it stays within a factor of the loss before, far below the
    start, and the result lies on the fine grid."""
    problem = small_problem()
    measured: list[int] = []
    course = Course(6, events=(Upsample(at=(4,)), Evaluate(every=2)))

    def measure(problem: SceneProblem) -> dict[str, float]:
        measured.append(1)
        return {"voxels": float(np.asarray(problem.values()[KEY]).size)}

    fit = reconstruct(problem, GaussNewton(), course, measure=measure)
    losses = [record["loss"] for record in fit.history]
    assert fit.values()[KEY].shape == (8, 8, 8, 1)
    assert losses[4] < 0.2 * losses[0]
    assert fit.log == ["iteration 4: refined to 8 x 8 x 8"]
    assert [m["iteration"] for m in fit.evaluations] == [0, 2, 4, 6]
    assert len(measured) == 4


def test_adam_is_mitsubas_adam(variant_rgb) -> None:
    """Three steps against mi.ad.Adam by hand on the same gradients. Dividing gradients by a constant changes an Adam
    step only through epsilon, 1e-6 of the largest gradient here, absolute 1e-8 there."""
    problem = small_problem()
    fit = reconstruct(problem, Adam(), 3)
    again = small_problem()
    reals = again.initial_reals()
    adam = mi.ad.Adam(lr=0.1, params=reals)
    for iteration in range(3):
        _, gradients = again.loss_and_gradient({KEY: adam[KEY]}, iteration)
        dr.set_grad(adam[KEY], gradients[KEY])
        adam.step()
        adam[KEY] = dr.maximum(adam[KEY], 0.0)
    assert np.allclose(np.asarray(fit.run.reals[KEY]), np.asarray(adam[KEY]), atol=1e-3 * 0.1)


def test_bounds_hold(variant_rgb) -> None:
    for optimizer in (Adam(), Lbfgs(), GaussNewton()):
        problem = small_problem(parameters=[Parameter(KEY, domain=(0.2, 0.6), lr=0.3)])
        values = np.asarray(reconstruct(problem, optimizer, 4).values()[KEY])
        assert values.min() >= np.float32(0.2)
        assert values.max() <= np.float32(0.6)
        assert np.ptp(values) > 0.01


def test_stop_waits_for_a_safe_point(ctrl_c) -> None:
    with InterruptGuard() as stop:
        stop.check()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.is_requested
        with pytest.raises(Interrupted):
            stop.check()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ignored_signals_stay_ignored(ctrl_c) -> None:
    """A shell starts what it puts into the background with Ctrl-C ignored: that is meant for the job in front."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with InterruptGuard() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert not stop.is_requested
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.is_requested
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def bad_views() -> dict:
    one = mi.TensorXf(np.ones((8, 8, 3), "f"))
    nan = np.ones((8, 8, 3), "f")
    nan[2, 5] = np.nan
    return {
        "no views": ([], "no views"),
        "views of different sizes": (
            [View("a", camera(0), one), View("b", camera(1, 6), mi.TensorXf(np.ones((6, 6, 3), "f")))],
            'view "b" is 6 x 6 pixels and view "a" 8 x 8',
        ),
        "reference of another size": ([View("a", camera(0), mi.TensorXf(np.ones((6, 8, 3), "f")))], "its sensor 8 x 8"),
        "reference with NaN": ([View("a", camera(0), mi.TensorXf(nan))], r"row 2, column 5"),
    }


@pytest.mark.parametrize("case", ["no views", "views of different sizes", "reference of another size", "reference with NaN"])
def test_refused_views(variant_rgb, case: str) -> None:
    views, sentence = bad_views()[case]
    assert_refused(sentence, SceneProblem, absorbing_scene(np.ones((2, 2, 2, 1))), views, [Parameter(KEY)])


def test_nonfinite_loss_stops_the_run(variant_rgb) -> None:
    """And what was found before it is kept."""
    problem = small_problem()
    reals, kept = problem.initial_reals(), problem.loss_and_gradient
    problem.loss_and_gradient = lambda r, i, views=0: (np.nan if i == 1 else kept(r, i, views)[0], kept(r, i, views)[1])
    assert_refused("became nan in iteration 1: lower the learning rate", reconstruct, problem, Adam(), 4)
    assert not np.array_equal(np.asarray(problem.values()[KEY]), np.asarray(reals[KEY]))


def test_gauss_newton_refuses_other_losses(variant_rgb) -> None:
    assert_refused('"l2" or "relative_l2"', reconstruct, small_problem(loss=Huber()), GaussNewton(), 1)


@pytest.mark.parametrize("references", ["rgb", "rgba"])
def test_the_alpha_of_a_film_is_not_fitted(variant_rgb, references: str) -> None:
    """Loss, gradient and curvature are those of the film without alpha, with references that have alpha or not."""
    truth, start = np.random.default_rng(3).uniform(0, 2, (4, 4, 4, 1)), np.full((4, 4, 4, 1), 0.3)
    found = {}
    for pixel_format in ("rgb", "rgba"):
        sensor = camera(0.3, rfilter="tent", pixel_format=pixel_format)
        (view,) = views_of_truth(truth, [sensor])
        (seen,) = views_of_truth(truth, [camera(0.3, rfilter="tent", pixel_format=references)])
        view = View(view.name, sensor, seen.reference if pixel_format == "rgba" else view.reference)
        problem = SceneProblem(absorbing_scene(start), [view], [Parameter(KEY, "1/length", (0.0, np.inf), lr=0.1)], spp=4)
        reals = problem.initial_reals()
        loss, gradient = problem.loss_and_gradient(reals, 0)
        curved = problem.linearize(reals).curvature({KEY: mi.TensorXf(np.ones((4, 4, 4, 1), np.float32))})
        found[pixel_format] = float(loss), np.array(gradient[KEY]), np.array(curved[KEY])
    for plain, with_alpha in zip(found["rgb"], found["rgba"], strict=True):
        # Threads add the 64 x 4 samples to 9 pixels each in any order: each addition rounds by 2^-24 of the sum.
        rounding = 64 * 4 * 9 * 2**-24 * np.abs(plain).max()
        np.testing.assert_allclose(with_alpha, plain, rtol=0, atol=rounding)
        assert np.abs(plain).max() > 0


class LateLosses(SceneProblem):
    """A problem without a scene, whose losses note when they are read."""

    def __init__(self, losses: dict[int, float] | None = None) -> None:
        self.losses, self.read, self.newest = losses or {}, [], -1

    def initial_reals(self) -> dict:
        return {}

    @property
    def warning(self):
        iteration = self.newest
        return lambda: f"noise of {iteration}" if iteration == 3 else ""


class LateLoss:
    def __init__(self, problem: LateLosses, iteration: int) -> None:
        self.problem, self.iteration = problem, iteration

    def __float__(self) -> float:
        self.problem.read.append(self.iteration)
        return self.problem.losses.get(self.iteration, 1.0)


class LateRun(OptimizerRun):
    def step(self, iteration: int, factor: float) -> LateLoss:
        self.problem.newest = iteration
        return LateLoss(self.problem, iteration)


class Clock:
    """A clock on which each look takes so many seconds."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.now = seconds, 0.0

    def perf_counter(self) -> float:
        self.now += self.seconds
        return self.now


@pytest.mark.parametrize(("seconds", "read"), [(1e-3, [0, *range(1, 9)]), (1.0, list(range(12)))])
def test_losses_of_quick_steps_are_read_late(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch, seconds: float, read: list[int]
) -> None:
    """The first loss at once, then eight together; slow steps one by one. The history waits for all of them, and messages about
    noise name the iteration of their loss."""
    monkeypatch.setattr(loop, "time", Clock(seconds))
    problem = LateLosses()
    fit = loop.Fit(problem, LateRun(problem), Course(20))
    for _ in range(12):
        fit.advance()
    assert problem.read == read
    assert [row["iteration"] for row in fit.history] == list(range(12)) == problem.read
    assert np.all(np.diff([row["seconds"] for row in fit.history]) >= 0)
    assert fit.history[-1]["seconds"] == fit.seconds
    assert fit.log == ["iteration 3: noise of 3"]


def test_a_late_loss_that_is_not_finite_names_its_iteration(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "time", Clock(1e-3))
    problem = LateLosses({3: np.nan})
    fit = loop.Fit(problem, LateRun(problem), Course(20))
    assert_refused("the loss became nan in iteration 3:", fit.complete)
    assert fit.next_iteration == 9
