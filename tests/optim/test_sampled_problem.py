"""Fit of a hash grid or a NeRF to photographs: gradients, resumed fits, memory, and a small fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, error_of
from refusals import assert_refused

from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.nerf import NerfField, NerfSizes
from mivol.fields.sampled_field import SampledField
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.loop import Fit, begin_fit
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.optim.photographs.sampled_problem import PRESETS, SampledPlan, SampledProblem, check_memory
from mivol.photos import Photo

SIZES = HashSizes(levels=4, log2_table=10, coarsest=4, finest=24, width=16, degree=1)
NERF = NerfSizes(depth=3, width=16, skip=1, place=3, direction=1, branch=8)
PLAN = SampledPlan(SIZES, steps=8, samples=2000, cells=12, warm_up=2, refresh_every=2, refresh_all=3, random_background=False)


def taken(fit: Fit, steps: int) -> Fit:
    while fit.next_iteration < steps:
        fit.advance()
    fit.problem.set_reals(fit.run.reals)
    return fit


def begin(photos: list[Photo], plan: SampledPlan = PLAN, store: CheckpointFile | None = None) -> Fit:
    problem = SampledProblem(RayBatches.from_photos(photos), BOX, plan, seed=1)
    return begin_fit(problem, plan.optimizer, plan.course(), checkpoint=store)


@pytest.mark.parametrize("model", [HashField, NerfField])
def test_the_gradient_is_the_slope_of_the_loss(variant_rgb: str, photos: list[Photo], model: type[SampledField]) -> None:
    """Along a random direction of each parameter, with the rays and samples of one step."""
    sizes = PLAN.sizes if model is HashField else NERF
    plan = replace(PLAN, sizes=sizes, model=model, weight_decay=0.0, refresh_every=1000, stop=0.0)
    problem = SampledProblem(RayBatches.from_photos(photos[:4]), BOX, plan, seed=1)
    rng = np.random.default_rng(0)
    reals = {
        name: mi.TensorXf(np.array(value) + 0.3 * rng.normal(size=value.shape).astype(np.float32))
        for name, value in problem.values().items()
    }
    known = problem.samples_a_ray

    def loss_at(changed: dict) -> tuple[float, dict]:
        problem.samples_a_ray = known
        loss, gradient = problem.loss_and_gradient(changed, 1)
        return float(loss[0]), gradient

    _, gradient = loss_at(reals)
    for name, value in reals.items():
        along = np.array(gradient[name])
        along /= np.linalg.norm(along)
        h = 2e-2 if model is HashField else 2e-3
        ends = [loss_at(reals | {name: mi.TensorXf(np.array(value) + np.float32(s * h * along))})[0] for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * h)
        # Rounding: 2^-23 of the loss over h. Central differences err by h^2 / 6 of a third derivative, and at kinks of ReLU.
        assert float((along * np.array(gradient[name])).sum()) == pytest.approx(slope, rel=0.02, abs=2.0**-22 / h)


@pytest.mark.parametrize("precision", ["single", "half"])
def test_a_resumed_fit_equals_an_uninterrupted_fit(one_thread, photos: list[Photo], tmp_path: Path, precision: str) -> None:
    """Values, moments and losses, to the last bit with one thread; the map of occupied cells is among what is kept."""
    path, plan = tmp_path / "checkpoint.npz", replace(PLAN, precision=precision)
    whole = taken(begin(photos, plan, store=CheckpointFile(path, {})), 5)
    whole.save()
    whole = taken(whole, 8)
    resumed = begin(photos, plan, store=CheckpointFile(path, {}, resume=True))
    assert resumed.next_iteration == 5
    resumed = taken(resumed, 8)
    kept, found = whole.run.pack(), resumed.run.pack()
    assert kept.keys() == found.keys() and all(np.array_equal(kept[name], found[name]) for name in kept)
    assert [row["loss"] for row in resumed.history] == [row["loss"] for row in whole.history]
    assert resumed.problem.samples_a_ray == whole.problem.samples_a_ray


def test_half_precision_rounds_what_rays_read_and_keeps_what_a_fit_steps(variant_rgb: str, photos: list[Photo]) -> None:
    """Loss and gradient are those of single precision at the rounded table; steps below its rounding are not lost."""
    half = SampledProblem(RayBatches.from_photos(photos[:4]), BOX, replace(PLAN, precision="half"), seed=1)
    single = SampledProblem(RayBatches.from_photos(photos[:4]), BOX, PLAN, seed=1)
    reals = half.values() | {"table": mi.TensorXf(np.random.default_rng(0).normal(size=half.values()["table"].shape))}
    rounded = reals | {"table": mi.TensorXf(np.float32(np.float16(np.array(reals["table"]))))}
    found, expected = half.loss_and_gradient(reals, 1), single.loss_and_gradient(rounded, 1)
    assert float(found[0][0]) == float(expected[0][0])
    for name, value in expected[1].items():
        np.testing.assert_array_equal(np.array(found[1][name]), np.array(value))
    fit = begin(photos[:4], replace(PLAN, precision="half", rate=1e-9))
    before = np.array(fit.run.reals["table"])
    table = np.array(taken(fit, 8).run.reals["table"])
    changed = table != before  # by 8e-9 at most, of numbers of up to 1e-4, between which half floats lie 6e-8 apart
    assert changed.any() and (np.float16(table) == np.float16(before))[changed].mean() > 0.5


def test_rates_rise_and_fall_as_published() -> None:
    plan = SampledPlan(steps=1000)
    rates = [plan.learning_rate(step) for step in (0, 50, 100, 499, 500, 750, 900)]
    np.testing.assert_allclose(rates, [1e-4, 0.505e-2, 1e-2, 1e-2, 0.33e-2, 0.33**2 * 1e-2, 0.33**3 * 1e-2], rtol=1e-12)


def test_rates_of_a_nerf_fall_to_a_tenth() -> None:
    plan = replace(PRESETS["nerf"]["gpu"], steps=1000, warm_up=0)
    assert [plan.learning_rate(step) for step in (0, 500, 1000)] == pytest.approx([5e-4, 5e-4 / 10**0.5, 5e-5], rel=1e-12)


def test_memory_is_refused_before_the_fit(variant_rgb: str, photos: list[Photo]) -> None:
    batches = RayBatches.from_photos(photos[:2])
    assert "MiB: photographs 0, the fit" in check_memory(PLAN, BOX, batches, 2**40)
    large = replace(PLAN, sizes=HashSizes(log2_table=24, finest=2048, levels=16, features=8))
    assert_refused(r"give field.log2_table or field.samples less", check_memory, large, BOX, batches, 2**30)


@pytest.mark.slow
def test_a_fit_predicts_a_view_between_those_it_saw(variant_rgb: str, photos: list[Photo]) -> None:
    """25 dB, as for a grid; the mean colour of the views gives 11 dB. Samples concentrate: most cells end up empty."""
    plan = SampledPlan(SIZES, steps=300, samples=1 << 13, cells=24, warm_up=50, refresh_every=4, refresh_all=128)
    fit = taken(begin(photos, plan), plan.steps)
    assert error_of(fit) < 0.0032
    assert np.array(fit.problem.field.region.occupied).mean() < 0.5
    assert fit.problem.samples_a_ray < 24


@pytest.mark.slow
def test_a_nerf_predicts_a_view_between_those_it_saw(variant_rgb: str, photos: list[Photo]) -> None:
    """20 dB, where the mean colour of the views gives 11 dB."""
    plan = replace(PRESETS["nerf"]["tiny"], warm_up=50, refresh_every=4, refresh_all=128)
    fit = taken(begin(photos, plan), plan.steps)
    assert error_of(fit) < 0.01
    assert np.array(fit.problem.field.region.occupied).mean() < 0.9
