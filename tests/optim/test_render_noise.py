"""Noise of renders in a loss: measured, removed by pairs, and logged; exact renders have none."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean, assert_same_variance, assert_within, fresh, note
from fit_scene import KEY, absorbing_scene, frontal, small_problem
from refusals import assert_refused
from scipy import stats

from mivol import config
from mivol.cli.progress import Display
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.first_order import Adam
from mivol.optim.loop import reconstruct
from mivol.optim.losses import L1, L2, LOSSES, Huber, Log, RelativeL2
from mivol.optim.parameters import Parameter
from mivol.optim.scenes.render_noise import compare_with_reference, describe_noise, make_noise_check, split_samples
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.validate.statistics import Moments

SIGMA, SEEN, SPP = 0.4, 0.6, 8
T = math.exp(-2 * SIGMA)
"""Transmittance of the constant cube along the frontal camera's rays; ``SEEN`` is its reference."""


SIX = 2e-9
"""Chance of 6 standard errors of a normal mean, either way."""


def tensor(a: np.ndarray) -> mi.TensorXf:
    return mi.TensorXf(np.ascontiguousarray(a, dtype=np.float32).reshape(-1, 1, 1))


def noisy_halves(n: int, mean: float, s: float, shares: tuple[float, ...], seed: int = 0) -> list[mi.TensorXf]:
    """Images of n pixels whose weighted mean has Gaussian noise s."""
    rng = np.random.default_rng(fresh(seed))
    return [tensor(rng.normal(mean, s / math.sqrt(share), n)) for share in shares]


# -- The estimator ------------------------------------------------------------------------------------------------


@pytest.mark.statistical
@pytest.mark.parametrize("shares", [(0.5, 0.5), (0.6, 0.4)], ids=["equal", "unequal"])
@pytest.mark.parametrize("name", ["l2", "relative_l2"])
def test_pairs_remove_the_noise_of_a_squared_loss(variant_rgb, name: str, shares: tuple[float, ...]) -> None:
    """W/2 (r^2 + s^2) plainly and W/2 r^2 with pairs; the standard errors are those of the docstring, 6 of them allowed.
    Unequal shares w1 w2 make the variance of b 2 s^4 as well, for b = w1 w2 (I1 - I2)^2."""
    n, r, s, reference = 40_000, 0.02, 0.05, 0.5
    halves, seen = noisy_halves(n, reference + r, s, shares), tensor(np.full(n, reference))
    w = {"l2": 1.0, "relative_l2": 1 / (reference**2 + 1e-4)}[name]
    plain = compare_with_reference(LOSSES[name](), halves, shares, seen)
    pairs = compare_with_reference(LOSSES[name](pairs=True), halves, shares, seen)
    error = [w * math.sqrt((4 * r**2 * s**2 + k * s**4) / n) for k in (2, 4)]
    assert_within(plain.loss - w * (r**2 + s**2), 6 * error[0], chance=SIX, what="losses")
    assert_within(pairs.loss - w * r**2, 6 * error[1], chance=SIX, what="losses of pairs")
    assert w * s**2 > 50 * error[1], "the bias is what is tested for: it must stand out"
    assert_within(plain.noise - w * s**2, 6 * w * math.sqrt(2 * s**4 / n), chance=SIX, what="noise")
    # Carried back by samples of its own, the plain gradient is unbiased already: 2 W/2 (mean - R) / n, to rounding.
    expected = 2 * w / n * (sum(np.asarray(h) * share for h, share in zip(halves, shares, strict=True)) - reference)
    for found in (plain, pairs):
        assert np.allclose(np.asarray(found.adjoint), expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_halves_of_a_squared_loss_give_their_product(variant_rgb) -> None:
    """f - b = (I1 - R)(I2 - R), pixel by pixel; rounding of squares of size 4."""
    rng = np.random.default_rng(1)
    for a, b, r in rng.uniform(-1, 1, (8, 3)):
        found = compare_with_reference(L2(pairs=True), [tensor(a), tensor(b)], (0.5, 0.5), tensor(r)).loss
        assert abs(found - (a - r) * (b - r)) <= 16 * 6e-8 * 4


@pytest.mark.statistical
def test_variance_matches_the_docstring(variant_rgb) -> None:
    """Without a residual 2 s^4 plainly and 4 s^4 with pairs, from 300 images of 64 pixels: means of 64 squares (of excess
    kurtosis 12) or products (6) of normal numbers, s^2 and 0 in the mean."""
    s, trials, n = 0.1, 300, 64
    seen = tensor(np.full(n, 0.5))
    values = []
    for trial in range(trials):
        halves = noisy_halves(n, 0.5, s, (0.5, 0.5), trial)
        values.append([compare_with_reference(L2(pairs=pairs), halves, (0.5, 0.5), seen).loss for pairs in (False, True)])
    plain, pairs = np.transpose(values)
    assert_same_variance(plain, 2 * s**4 / n, mean=s**2, excess=12 / n, what="losses")
    assert_same_variance(pairs, 4 * s**4 / n, mean=0.0, excess=6 / n, what="losses of pairs")


@pytest.mark.statistical
def test_pairs_leave_the_next_order_of_a_smooth_loss(variant_rgb) -> None:
    """log^2(1 + x) = x^2 - x^3 + 11/12 x^4 - 5/6 x^5 + 137/180 x^6 ...: for noise s its mean is s^2 + 2.75 s^4 + 11.4 s^6;
    halves have the variance 2 s^2, so that 2 f(mean) - f(halves) leaves (2 - 4) 2.75 s^4 + (2 - 8) 11.4 s^6 = -6.2e-4 of
    1.03e-2 at s = 0.1. The next order is (2 - 16) 68 s^8 = 1e-5, the standard error sqrt(4 s^4 / n)."""
    n, s, reference = 400_000, 0.1, 0.5
    halves, seen = noisy_halves(n, reference, s * reference, (0.5, 0.5)), tensor(np.full(n, reference))
    weight = reference**2 / (reference**2 + 1e-6)
    plain = compare_with_reference(Log(), halves, (0.5, 0.5), seen).loss / weight
    pairs = compare_with_reference(Log(pairs=True), halves, (0.5, 0.5), seen).loss / weight
    error = math.sqrt(4 * s**4 / n)
    assert_within(plain - (s**2 + 2.75 * s**4 + 11.4 * s**6), 6 * error + 70 * s**8, chance=SIX, what="losses")
    assert_within(pairs - (-5.5 * s**4 - 68.5 * s**6), 6 * error + 960 * s**8, chance=SIX, what="losses of pairs")


@pytest.mark.statistical
def test_pairs_at_the_kink_of_l1(variant_rgb) -> None:
    """E|N(0, s)| = sqrt(2 / pi) s = 0.798 s, and of halves sqrt(2) of that: pairs leave 2 - sqrt(2) = 0.59 of it."""
    n, s = 100_000, 0.1
    halves, seen = noisy_halves(n, 0.5, s, (0.5, 0.5)), tensor(np.full(n, 0.5))
    mean = math.sqrt(2 / math.pi) * s
    plain, pairs = (compare_with_reference(L1(pairs=on), halves, (0.5, 0.5), seen).loss for on in (False, True))
    # |N| has the standard deviation 0.6 s, and three such numbers enter with weights 2, 1/2, 1/2: below 2 s.
    assert_within(plain - mean, 6 * s / math.sqrt(n), chance=SIX, what="losses")
    assert_within(pairs - (2 - math.sqrt(2)) * mean, 6 * 2 * s / math.sqrt(n), chance=SIX, what="losses of pairs")


@pytest.mark.parametrize("name", LOSSES)
def test_adjoint_is_the_gradient_by_the_mean_image(variant_rgb, name: str) -> None:
    """Both halves moved by +-h move the loss by the adjoint's sum; differences of float32 values of size 1 with h = 1e-2
    err by h^2 f'''/6 and by 1e-7 / h = 1e-5. The kinks of |r| (pixels within h of it) are left out by a residual of 0.3."""
    n, h = 64, 1e-2
    seen = np.full(n, 0.5)
    halves = [np.asarray(x).ravel() for x in noisy_halves(n, 0.8, 0.02, (0.5, 0.5))]
    loss = LOSSES[name](pairs=True)
    up, down = (compare_with_reference(loss, [tensor(x + e) for x in halves], (0.5, 0.5), tensor(seen)).loss for e in (h, -h))
    found = compare_with_reference(loss, [tensor(x) for x in halves], (0.5, 0.5), tensor(seen))
    assert np.isclose(np.asarray(found.adjoint).sum(), (up - down) / (2 * h), rtol=1e-3)


def test_one_exact_render_has_no_noise(variant_rgb) -> None:
    image, seen = tensor(np.linspace(0, 1, 9)), tensor(np.full(9, 0.4))
    plain, pairs = (compare_with_reference(Huber(pairs=on), [image], (1.0,), seen, weight=0.5) for on in (False, True))
    assert plain.noise == pairs.noise == 0.0
    assert plain.loss == pairs.loss == 0.5 * float(Huber()(image, seen)[0])


# -- Through Mitsuba ----------------------------------------------------------------------------------------------


def cube_problem(integrator: str = "prbvolpath", size: int = 8, **settings: object) -> SceneProblem:
    """A constant cube seen by parallel rays. Delta tracking (``prbvolpath``, albedo 0) sees the sky or nothing: a pixel's
    mean of n samples has the expectation T and the variance T (1 - T) / n; mivol's is T."""
    scene = absorbing_scene(np.full((2, 2, 2, 1), SIGMA))
    view = View("face", frontal(size), mi.TensorXf(np.full((size, size, 3), SEEN, "f")))
    tracer = mi.load_dict({"type": integrator, "max_depth": 2})
    chosen = {"spp": SPP, "integrator": tracer, "seed": fresh(0)} | settings
    return SceneProblem(scene, [view], [Parameter(KEY, domain=(0.0, np.inf), lr=1e-3)], **chosen)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("pairs", [False, True], ids=["plain", "pairs"])
def test_the_renderers_noise_in_the_loss(variant_rgb, pairs: bool) -> None:
    """Rationale: what a fit reports as its loss is the mismatch plus T (1 - T) / n, here as large as the mismatch.
    Expected: the mean of 60 losses is (T - R)^2 plus that, and with pairs without it."""
    problem = cube_problem(loss=L2(pairs=pairs))
    problem.set_reals(problem.initial_reals())
    losses = Moments.from_values(np.array([problem.mean_loss(i) for i in range(60)]))
    bias = T * (1 - T) / SPP
    assert_precise(losses, bias / 20, what="losses")
    assert_same_mean(losses, (T - SEEN) ** 2 + (0 if pairs else bias), what="losses")


@pytest.mark.slow
@pytest.mark.statistical
def test_the_measured_noise_is_the_variance(variant_rgb) -> None:
    """Its mean over 60 iterations is T (1 - T) / n."""
    problem = cube_problem()
    found = []
    for i in range(60):
        problem.loss_and_gradient(problem.initial_reals(), i)
        found.append(problem.newest_loss.noise)
    assert_same_mean(Moments.from_values(np.array(found)), T * (1 - T) / SPP, what="noise")


@pytest.mark.slow
def test_exact_renders_take_no_extra_samples(variant_rgb) -> None:
    """One render a batch, no noise, and pairs change no bit; noisy renders come in two halves of the samples."""
    for integrator, wanted in (("mivol", [SPP]), ("prbvolpath", [SPP // 2, SPP // 2])):
        losses = []
        for pairs in (False, True):
            problem = cube_problem(integrator, loss=L2(pairs=pairs))
            samples: list[int] = []
            problem.integrator = Counting(problem.integrator, samples)
            losses.append(float(problem.loss_and_gradient(problem.initial_reals(), 0)[0]))
            assert samples == wanted
            assert (problem.newest_loss.noise == 0.0) == (integrator == "mivol")
        assert (losses[0] == losses[1]) == (integrator == "mivol")
    assert split_samples(5, L2()) == (3, 2)


class Counting:
    """An integrator that notes the samples of each primal render."""

    def __init__(self, integrator: mi.Integrator, samples: list[int]) -> None:
        self.integrator, self.samples = integrator, samples

    def render(self, *args: object, **keywords: int) -> mi.TensorXf:
        self.samples.append(keywords["spp"])
        return self.integrator.render(*args, **keywords)

    def __getattr__(self, name: str) -> object:
        return getattr(self.integrator, name)


@pytest.mark.slow
def test_gauss_newton_gradient_uses_other_samples_if_noisy(variant_rgb) -> None:
    """Seeds of J^T differ from the image's where there is noise, and are the image's where there is none."""
    for integrator, same in (("mivol", True), ("prbvolpath", False)):
        problem = cube_problem(integrator)
        images, derivatives = [noted(problem, name, place) for name, place in (("compare", 1), ("vjp", 2))]
        reals = problem.initial_reals()
        problem.linearize(reals)
        # The notes hold the problem, and the problem the notes. Were the scene freed by Python's collector while ``prbvolpath``
        # traces, Dr.Jit would abort the process.
        del problem.compare, problem.vjp
        assert len(images) == 1
        assert (images == derivatives) == same


def noted(problem: SceneProblem, method: str, place: int) -> list[int]:
    """The seeds, at that place of the arguments, that a method is called with from now on."""
    seeds, kept = [], getattr(problem, method)
    setattr(problem, method, lambda *given: seeds.append(given[place]) or kept(*given))
    return seeds


def test_noise_check_finds_sampled_light(variant_rgb) -> None:
    """Mivol where light may be sampled, with the values of now; every other integrator."""
    absorbing = absorbing_scene(np.ones((2, 2, 2, 1)))
    medium = {"type": "homogeneous", "albedo": 0.5, "sigma_t": {"type": "rgb", "value": 0.5}}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}
    cloudy = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "cube": cube})
    wall = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "wall": {"type": "sphere"}})
    deep, seen = (mi.load_dict({"type": "mivol", "max_depth": depth}) for depth in (2, 1))
    assert not make_noise_check(deep, absorbing)()
    assert make_noise_check(mi.load_dict({"type": "volpath", "max_depth": 2}), absorbing)()
    assert make_noise_check(deep, wall)()
    assert not make_noise_check(seen, wall)()
    assert not make_noise_check(seen, cloudy)()
    asked = make_noise_check(deep, cloudy)
    assert asked()
    params = mi.traverse(cloudy)
    (key,) = (name for name in params.properties if "albedo" in name)
    params[key] = 0.0 * params[key]
    params.update()
    assert not asked()


# -- What is said -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.statistical
def test_noise_message_is_logged_once(variant_rgb, tmp_path: Path, capsys) -> None:
    """At (T - R)^2 = 0.0227 and T (1 - T) / 8 = 0.031 the noise is 58 % of the loss; both are means over 4096 pixels in one
    iteration: sqrt(2 / 4096) = 2.2 % of the noise, 3 % of the loss, so 8 of their standard errors leave 40 to 75 %."""
    path = tmp_path / "checkpoint.npz"
    with Display(3) as display:
        fit = reconstruct(cube_problem(size=64), Adam(), 3, checkpoint=CheckpointFile(path, {}), observer=display)
    fit.save()
    (line,) = fit.log
    assert line.startswith("iteration 0: the render's noise contributes 0.0")
    share = int(line.partition("%")[0].split()[-1])
    note(2 * stats.norm.sf(8), "share of noise")
    assert 40 <= share <= 75
    assert "the gradient has no bias" in line
    assert "loss.pairs = true" in line
    assert capsys.readouterr().err.count("loss.pairs = true") == 1
    assert reconstruct(cube_problem(size=64), Adam(), 5, checkpoint=CheckpointFile(path, {}, resume=True)).log == [line]


@pytest.mark.slow
def test_exact_renders_and_pairs_have_no_message(variant_rgb) -> None:
    assert reconstruct(cube_problem("mivol"), Adam(), 2).log == []
    assert reconstruct(cube_problem(loss=L2(pairs=True)), Adam(), 2).log == []
    assert reconstruct(small_problem(loss=L1()), Adam(), 2).log == []


def test_single_sample_has_unknown_noise(variant_rgb) -> None:
    (line,) = reconstruct(cube_problem(spp=1), Adam(), 2).log
    assert "of unknown size at fit.spp = 1" in line
    assert_refused("found fit.spp = 1: set fit.spp to 2", reconstruct, cube_problem(spp=1, loss=L2(pairs=True)), Adam(), 1)


def test_noise_message_text(variant_rgb) -> None:
    assert describe_noise(L2(), 1.0, 0.04) == describe_noise(L2(), 0.0, 0.0) == ""
    assert "6%" in describe_noise(RelativeL2(), 1.0, 0.06)
    assert "the gradient is biased too" in describe_noise(Huber(), 1.0, 0.5)
    assert describe_noise(Huber(pairs=True), 1.0, 0.5) == ""


def test_pairs_are_a_setting_of_every_loss() -> None:
    raw = {"title": "a", "scene": {"file": "s.xml"}, "parameter": [{"key": "k"}]}
    for name in LOSSES:
        chosen = config.from_dict(copy.deepcopy(raw) | {"loss": {"name": name, "pairs": True}})
        assert chosen.loss == LOSSES[name](pairs=True)
    assert_refused('did you mean "pairs"', config.from_dict, raw | {"loss": {"name": "l2", "pair": True}})
