"""Gains of photographs: derivatives, removal of equal exposures, and their effect on a fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import capture_photos
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, PLAN, draw_tiles

from mivol import config
from mivol.errors import MivolError
from mivol.experiments.field_fit import GAINS, explain_plan, make_radiance_plan
from mivol.experiments.photo_fit import tabulate_gains
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.loop import begin_fit
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.photo_colours import GAIN_PULL, GAIN_RATE, Exposure, pull_at
from mivol.optim.photographs.radiance_plan import PRESETS, RadiancePlan, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo
from mivol.transport.line_integrals.radiance_field import make_model, render_rays
from mivol.transport.line_integrals.radiance_source import bake

MIDDLE = np.array([[-0.9] * 3, [0.9] * 3])
"""About the ball of :mod:`capture_photos`."""

SMALL = replace(PRESETS["capture"], stages=(RadianceStage(8, 6, 1, 3, 8), RadianceStage(16, 6, 1, 3, 8)))


def logs_of(photographs: int, spread: float, seed: int = 3) -> np.ndarray:
    """(photographs, 3) logarithms of a mean of 0 and a root mean square of ``spread``."""
    logs = np.random.default_rng(seed).normal(size=(photographs, 3))
    logs -= logs.mean(axis=0)
    return np.float32(logs * spread / np.sqrt(np.mean(logs**2)))


def problem_of(plan: RadiancePlan = SMALL, count: int = 5, uneven: float = 0.0) -> RadianceProblem:
    return RadianceProblem(RayBatches.from_photos(capture_photos.capture(count, uneven)), MIDDLE, plan)


# -- Gains --------------------------------------------------------------------------------------------------------


def test_regularized_gains_move_towards_1_with_mean_1(variant_rgb: str) -> None:
    logs = np.random.default_rng(1).normal(size=(7, 3)).astype(np.float32)
    found = Exposure(mi.Float(logs.ravel())).regularized(pull_at(0.3))
    wanted = (logs - logs.mean(axis=0)) * (1 - 0.3 * GAIN_PULL)
    # float32: a mean of seven numbers of up to 3, and two products: a few times 3 x 6e-8.
    np.testing.assert_allclose(np.array(found.tensor), wanted, atol=1e-6)
    np.testing.assert_allclose(found.table(), np.exp(wanted), atol=1e-5)
    assert found.spread == pytest.approx(np.sqrt(np.mean(wanted**2)), rel=1e-6)
    seen = np.array(found.gains(mi.UInt32([6, 2]))).T
    np.testing.assert_allclose(seen, np.exp(wanted[[6, 2]]), rtol=2e-6)
    assert np.array_equal(Exposure.neutral(4).table(), np.ones((4, 3)))


def test_gain_gradient_matches_the_squared_error(variant_rgb: str) -> None:
    """(g s - t)^2, mean over rays and rgb, differentiated by log g in float64 from what the field shows."""
    problem, logs = problem_of(), logs_of(5, 0.2)
    problem.exposure = Exposure(mi.Float(logs.ravel()))
    batch = draw_tiles(problem.batches, 1, np.array([0, 2, 3]), 5, np.random.default_rng(2))
    loss, slopes = problem.batch_loss_and_gradient(batch)
    source = bake(problem.field, problem._cells, batch.origins, batch.slot)
    seen = render_rays(problem._cells, source, make_model(problem.field, problem.plan.stop), batch.rays)
    shown = np.array(seen.colour + seen.T * problem.sky.eval(batch.rays.d), np.float64).T
    view, target = np.array(batch.view), np.array(batch.target, np.float64).T
    assert set(view) == {0, 2, 3}
    error = np.exp(logs[view]) * shown - target
    # float32 colours of about 1: errors of 1e-6 in a difference, and of a few 1e-7 in the mean over 80 rays of a view.
    np.testing.assert_allclose(np.array(loss), np.mean(error**2, axis=1), atol=2e-6)
    wanted = np.zeros((5, 3))
    np.add.at(wanted, view, 2 / error.size * error * np.exp(logs[view]) * shown)
    np.testing.assert_allclose(np.array(slopes["exposure"]).reshape(5, 3), wanted, atol=2e-6)
    assert not wanted[[1, 4]].any() and np.abs(wanted[[0, 2, 3]]).min() > 1e-4


def test_gain_cancels_the_exposure_of_a_brighter_photograph(variant_rgb: str) -> None:
    """Targets and gains times g: errors are g times as large, and derivatives by the field and the sky g^2 times."""
    problem, gain = problem_of(), 1.7
    batch = draw_tiles(problem.batches, 1, np.array([1, 4]), 6, np.random.default_rng(4))
    _, before = problem.batch_loss_and_gradient(batch)
    problem.exposure = Exposure(dr.full(mi.Float, np.log(gain), 15))
    _, after = problem.batch_loss_and_gradient(replace(batch, target=batch.target * gain))
    for name in ("density", "harmonics", "sky"):
        wanted = gain**2 * np.array(before[name], np.float64)
        # Sums of float32 numbers in another order: a few times 6e-8 of the largest.
        np.testing.assert_allclose(np.array(after[name]), wanted, atol=1e-5 * np.abs(wanted).max())
        assert np.abs(wanted).max() > 0


# -- Whether there are any ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spread", "said"),
    [(0.9 * SMALL.agree, "photographs agree in exposure to 3.6%, so gains are removed"), (1.1 * SMALL.agree, "")],
    ids=["agree", "differ"],
)
def test_gains_of_equal_exposures_are_removed(variant_rgb: str, spread: float, said: str) -> None:
    problem, logs = problem_of(replace(SMALL, stages=(*SMALL.stages, RadianceStage(24, 2)))), logs_of(5, spread)
    problem.exposure = Exposure(mi.Float(logs.ravel()))
    refinement = problem.refine(1)
    assert (said or "photographs differ in exposure by 4%, so each has gains") in refinement.message
    assert problem.has_gains != bool(said)
    np.testing.assert_array_equal(np.array(refinement.reals["exposure"]), 0 * logs if said else logs)
    batch = draw_tiles(problem.batches, 1, np.array([0, 2]), 5, np.random.default_rng(2))
    slopes = np.array(problem.batch_loss_and_gradient(batch)[1]["exposure"])
    assert slopes.shape == (15,) and slopes.any() != bool(said)
    reals = problem.values() | {"exposure": mi.TensorXf(logs)}
    pulled = np.array(problem.after_step(reals, 0)["exposure"])
    wanted = logs if said else np.array(Exposure(mi.Float(logs.ravel())).regularized(pull_at(GAIN_RATE)).tensor)
    np.testing.assert_allclose(pulled, wanted, atol=1e-8)
    problem.exposure = Exposure(mi.Float(logs.ravel()))
    assert "exposure" not in problem.refine(2).message and problem.has_gains != bool(said)


def test_gains_need_cameras(variant_rgb: str, photos: list[Photo]) -> None:
    with pytest.raises(MivolError, match="photographs with alpha, which have equal exposures: set exposure = false"):
        RadianceProblem(RayBatches.from_photos(photos[:2], (1, 2)), BOX, replace(PLAN, exposure=True))


def test_preset_or_file_sets_gains() -> None:
    def plan(preset: str, **settings: object) -> RadiancePlan:
        return make_radiance_plan(
            config.from_dict({"title": "x", "photos": {"path": "x"}, "field": {"preset": preset, **settings}})
        )

    assert plan("capture").exposure and not plan("cpu").exposure
    assert plan("cpu", exposure=True).exposure and not plan("capture", exposure=False).exposure
    assert problem_rates_fall()


def problem_rates_fall() -> bool:
    """The rate of gains falls with that of the coefficients."""
    return (
        SMALL.learning_rates(0)[1] == SMALL.sh_rate
        and GAIN_RATE * SMALL.learning_rates(SMALL.steps)[1] / SMALL.sh_rate == GAIN_RATE * SMALL.last
    )


def test_plan_names_gains(variant_rgb: str) -> None:
    shown = capture_photos.capture(3)
    survey = type("Survey", (), {"box_from": "as given", "points": None})
    photos = type("Photos", (), {"views": shown, "box": MIDDLE, "survey": survey})
    batches = RayBatches.from_photos(shown)
    assert GAINS in explain_plan(SMALL, photos, batches)
    assert GAINS not in explain_plan(replace(SMALL, exposure=False), photos, batches)


def test_report_sorts_gains_by_distance_from_1() -> None:
    table = tabulate_gains(["a", "b", "c"], np.array([[1.0, 1.05, 1.0], [0.5, 1.0, 1.0], [1.0, 1.0, 1.3]]))
    assert table.head == ("photograph", "red", "green", "blue")
    assert table.rows == (("b", "0.500", "1.000", "1.000"), ("c", "1.000", "1.000", "1.300"), ("a", "1.000", "1.050", "1.000"))


# -- Fits ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("agree", [1.0, 0.0], ids=["agree", "differ"])
def test_resumed_fit_equals_an_uninterrupted_fit(one_thread, tmp_path: Path, agree: float) -> None:
    """To the last bit, before and after gains were left out."""
    batches, path = RayBatches.from_photos(capture_photos.capture(6, 0.3)), tmp_path / "checkpoint.npz"

    def run(store: CheckpointFile, until: int) -> object:
        fit = begin_fit(RadianceProblem(batches, MIDDLE, plan), plan.optimizer, plan.course(), checkpoint=store)
        while fit.next_iteration < until:
            fit.advance()
        return fit

    plan = replace(SMALL, agree=agree, stages=(RadianceStage(8, 10, 1, 3, 8), RadianceStage(16, 10, 1, 3, 8)))
    for stop in (7, 14):
        whole = run(CheckpointFile(path, {}), stop)
        whole.save()
        while whole.next_iteration < 20:
            whole.advance()
        resumed = run(CheckpointFile(path, {}, resume=True), 20)
        kept, found = whole.run.pack(), resumed.run.pack()
        assert kept.keys() == found.keys() and all(np.array_equal(kept[name], found[name]) for name in kept)
        assert whole.problem.has_gains == resumed.problem.has_gains == kept["reals/exposure"].any() == (agree == 0)
        assert resumed.log == whole.log


@pytest.mark.slow
def test_fit_recovers_gains_and_field(variant_rgb: str) -> None:
    """Photographs whose gains are spread by exp(0.15): clipping at 1 and the pull take some of that back. Views that were not
    fitted, of the mean exposure, have 0.54 of the error of a fit without gains; 0.75 allows for runs that differ by a tenth."""
    plan = replace(PRESETS["capture"], stages=(RadianceStage(16, 60, 1, 8, 32), RadianceStage(32, 90, 1, 8, 32)))
    gains = np.exp(0.15 * np.random.default_rng(7).normal(size=24))
    errors = {}
    for exposure in (False, True):
        problem = problem_of(replace(plan, exposure=exposure), 24, 0.15)
        fit = begin_fit(problem, plan.optimizer, replace(plan, exposure=exposure).course())
        while not fit.is_done:
            fit.advance()
        problem.set_reals(fit.run.reals)
        mean = np.exp(np.mean(np.log(gains)))
        others = capture_photos.cameras(30)[24:]
        pairs = [(render_view(problem.field, one, problem.sky).image, mean * capture_photos.trace_image(one)) for one in others]
        errors[exposure] = np.mean([np.square(seen - wanted) for seen, wanted in pairs])
    assert errors[True] < 0.75 * errors[False]
    found = np.log(problem.exposure.table()).mean(axis=1)
    assert np.corrcoef(found, np.log(gains))[0, 1] > 0.8  # 0.93 measured: what is clipped at 1 tells no gain
    assert any("photographs differ in exposure by" in line for line in fit.log)
