"""Fit of a radiance field to photographs: gradients, stages, memory, and small fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, PLAN, WHITE, ball, camera, draw_tiles, error_of, fitted
from refusals import assert_refused
from scipy.ndimage import maximum_filter

from mivol.errors import MivolError
from mivol.fields.sky import Sky
from mivol.kernel_recording import RecordedFunctions
from mivol.optim.checkpoint import CheckpointFile
from mivol.optim.loop import Fit, begin_fit, reconstruct
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import RadianceStage, estimate_bytes
from mivol.optim.photographs.radiance_problem import RadianceProblem, begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import TILE, RayBatches
from mivol.photos import Lens, Photo
from mivol.photos.camera import motion_unit, move_camera
from mivol.transport.line_integrals.radiance_field import find_occupied_cells, make_model, render_rays
from mivol.transport.line_integrals.radiance_source import bake


@pytest.mark.slow
def test_fit_predicts_held_out_views(variant_rgb: str, photos: list[Photo]) -> None:
    # Total variation of an eighth of the rows a step: of a sixteenth, so few steps leave the surface 2.02 voxels deep.
    fit = fitted(RayBatches.from_photos(photos, (1, 2)), replace(PLAN, tv_share=1 / 8))
    # 0.0032: 25 dB in a view between those it saw. The mean colour of the views alone gives 11 dB.
    assert error_of(fit) < 0.0032
    field = fit.problem.field
    assert field.nodes is not None and field.rows < 0.9 * 24**3
    assert fit.log == [f"iteration 60: refined to 24 x 24 x 24 nodes, {field.rows - 1} of them stored"]
    seen = render_view(field, camera(2.5), WHITE)
    truth = render_view(ball(), camera(2.5), WHITE).depth[22:26, 22:26]
    # Two voxels.
    assert np.abs(seen.depth[22:26, 22:26] - truth).max() < 2 * 2 / 24
    assert np.isnan(seen.depth[0, 0]) and seen.opacity[0, 0] == 0


@pytest.mark.slow
def test_finer_stage_continues_the_last_stage(variant_rgb: str, photos: list[Photo]) -> None:
    """Its first step knows how large derivatives were: begun anew, it would move all that it touches by a whole rate."""
    fit = fitted(RayBatches.from_photos(photos, (1, 2)), replace(PLAN, tv_density=0.0), PLAN.stages[0].steps)
    fit.course.events[0].apply(fit)
    fit.events_done = 1
    before = np.array(fit.run.reals["density"])
    fit.advance()
    moved = np.abs(np.array(fit.run.reals["density"]) - before) * fit.problem.unit
    # Where no more rays than before cross a voxel, and not all agree, steps are below the rate.
    assert 0 < np.median(moved[moved > 0]) < 0.5 * PLAN.learning_rates(PLAN.stages[0].steps)[0]


@pytest.mark.slow
@pytest.mark.parametrize("steps", [9, 14], ids=["first stage", "second stage"])
def test_resumed_fit_equals_an_uninterrupted_fit(one_thread, photos: list[Photo], tmp_path: Path, steps: int) -> None:
    """With one thread every value and every mean square is equal to the last bit, and what is forgotten shows in it."""
    batches, path = RayBatches.from_photos(photos[:6], (1, 2)), tmp_path / "checkpoint.npz"
    stages = RadianceStage(8, 10, 2, 3, 8), RadianceStage(16, 10, 1, 3, 8)
    plan = replace(PLAN, stages=stages, tv_density=0.1, first_degree=0, poses=True, align_every=4)

    def begin(store: CheckpointFile) -> Fit:
        return begin_fit(RadianceProblem(batches, BOX, plan), plan.optimizer, plan.course(), checkpoint=store)

    whole = fitted(batches, plan, steps, begin(CheckpointFile(path, {})))
    whole.save()
    whole = fitted(batches, plan, 20, whole)
    resumed = begin(CheckpointFile(path, {}, resume=True))
    assert (resumed.next_iteration, resumed.problem.field.degree) == (steps, int(steps > 10))
    resumed = fitted(batches, plan, 20, resumed)
    kept, found = whole.run.pack(), resumed.run.pack()
    assert kept.keys() == found.keys() == {"reals/density", "reals/harmonics", "roots/density", "roots/harmonics"}
    assert all(np.array_equal(kept[name], found[name]) for name in kept)
    motions = whole.problem.poses.motions, resumed.problem.poses.motions
    assert np.array_equal(motions[0].motion, motions[1].motion) and motions[0].motion.any()
    assert [row["loss"] for row in resumed.history] == [row["loss"] for row in whole.history]
    assert resumed.log == whole.log


def test_cameras_move_to_where_the_field_agrees_with_the_photographs(variant_rgb: str, photos: list[Photo]) -> None:
    """The true field and poses that are off by about a pixel: after four corrections a tenth of the error is left."""
    rng, count = np.random.default_rng(5), 6
    units = np.array([motion_unit(view.camera, 3.0) for view in photos[:count]])
    off = rng.standard_normal((count, 6)) * units
    given = [replace(v, camera=move_camera(v.camera, m[:3], m[3:])) for v, m in zip(photos, off, strict=False)]
    plan = replace(PLAN, stages=(RadianceStage(24, 1, 1, 4),), poses=True)
    problem = RadianceProblem(RayBatches.from_photos(given), BOX, plan)
    problem.field = ball()
    problem.update_occupancy()

    def error() -> float:
        pairs = zip(problem.posed.cameras, given, strict=True)
        return np.sqrt(np.mean([(render_view(problem.field, c, WHITE).image - v.image) ** 2 for c, v in pairs]))

    before = error()
    for iteration in range(4):
        said = problem.align_cameras(iteration)
    assert error() < 0.1 * before
    assert said.startswith("cameras moved by 2")


def test_pixels_are_seen_from_moved_cameras(variant_rgb: str, photos: list[Photo]) -> None:
    """The rays of moved cameras are those of photographs that were taken there."""
    moved = [replace(v, camera=move_camera(v.camera, np.array([0.1, 0, 0.2]), np.array([0, 0.3, 0]))) for v in photos[:3]]
    found = RayBatches.from_photos(photos[:3]).with_cameras([view.camera for view in moved])
    wanted = RayBatches.from_photos(moved)
    assert np.array_equal(found.lenses, wanted.lenses) and np.array_equal(found.origins, wanted.origins)
    assert not np.array_equal(found.origins, RayBatches.from_photos(photos[:3]).origins)


def give_back() -> None:
    """Let Dr.Jit give back the memory that it keeps for later, and forget how much it held."""
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()


def most_held() -> int:
    """Most bytes that Dr.Jit held since."""
    dr.sync_thread()
    return dr.detail.malloc_watermark(dr.backend_v(mi.Float))


@pytest.mark.parametrize(("longest", "views"), [(48, 4), (64, 2)])
def test_steps_take_the_estimated_memory(
    variant_rgb: str, cpu_back_end: None, photos: list[Photo], longest: int, views: int
) -> None:
    """Not more, and more than half: a block that is let go may serve for something else, which is counted as another."""
    plan = replace(PLAN, stages=(RadianceStage(longest, 9, 1, views, 32),), degree=2, tv_every=4)
    batches = RayBatches.from_photos(photos)

    give_back()
    before, fit = most_held(), begin_fit(RadianceProblem(batches, BOX, plan), plan.optimizer, plan.course())
    # What the map of the first fog took is of no use to the steps.
    give_back()
    fit.complete()
    counted = estimate_bytes(plan, plan.stages[0], BOX, fit.problem.field.rows)
    assert counted / 2 < most_held() - before < counted


def test_removing_nodes_takes_no_more_memory_than_steps(variant_rgb: str, cpu_back_end: None, photos: list[Photo]) -> None:
    """Though reals and their means are there of old and new nodes, of which most are kept here."""
    plan = replace(PLAN, stages=(RadianceStage(64, 9, 1, 2, 32),), degree=2, keep_weight=0.0, drop=1 / 3)
    fit = fitted(RayBatches.from_photos(photos), plan, 3)
    rows, dropping = fit.problem.field.rows, fit.course.events[1]
    give_back()
    assert dropping.due(3)
    dropping.apply(fit)
    held = most_held()
    assert 0.7 * rows < fit.problem.field.rows < rows
    assert held < estimate_bytes(plan, plan.stages[0], BOX, rows)


@pytest.mark.slow
def test_invisible_nodes_are_removed(variant_rgb: str, photos: list[Photo]) -> None:
    """What is left are the nodes of seen cells and their neighbours, with the values and the squares that they had; Dr.Jit
    holds nothing back of what was there before."""
    fit = fitted(RayBatches.from_photos(photos, (1, 2)), replace(PLAN, drop=1 / 9), 70)
    problem = fit.problem
    before, squares = problem.field, np.array(fit.run.squares["density"])
    stored = np.zeros(before.node_count, bool)
    stored[before.stored_nodes()] = True
    expected = stored & maximum_filter(problem.visible_nodes()[0], 3).reshape(-1)
    dropping = fit.course.events[1]
    assert dropping.due(70)
    says = dropping.apply(fit)
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()
    held = most_held()
    give_back()
    # Bytes of single numbers may have come and gone.
    assert held - most_held() < 1 << 16
    after = problem.field
    np.testing.assert_array_equal(after.stored_nodes(), np.flatnonzero(expected))
    assert says == f"unseen nodes removed: 24 x 24 x 24 nodes, {after.rows - 1} of them stored"
    assert 100 < after.rows < 0.9 * before.rows
    kept = expected[stored]
    for old, new in zip(before.values(), after.values(), strict=True):
        np.testing.assert_array_equal(new, old[kept])
    np.testing.assert_array_equal(np.array(fit.run.squares["density"])[:-1], squares[:-1][kept])
    fit.advance()


def test_the_vacuum_around_a_sparse_field_stays_empty(variant_rgb: str, photos: list[Photo]) -> None:
    """Its row is a corner of the cells at the edge of what is stored, here of a fog that fills the box's middle: what they
    would have it become, it does not."""
    problem = RadianceProblem(RayBatches.from_photos(photos[:3], (1, 2)), BOX, PLAN)
    middle = np.zeros(problem.field.res, bool)
    middle[3:9, 3:9, 3:9] = True
    problem.field = problem.field.select_nodes(middle)
    problem.update_occupancy()
    batch = draw_tiles(problem.batches, 2, np.arange(3), 30, np.random.default_rng(3))
    _, slopes = problem.batch_loss_and_gradient(batch)
    density = np.array(slopes["density"])
    harmonics = np.array(slopes["harmonics"]).reshape(len(density), -1)
    assert density[-1] == 0 and not harmonics[-1].any()
    # The nodes at the edge, whose cells have the vacuum for corners, do have derivatives.
    assert np.count_nonzero(density) > 100 and np.count_nonzero(harmonics[:, 0]) > 100


@pytest.mark.slow
def test_changing_backgrounds_leave_no_white_matter(variant_rgb: str, photos: list[Photo]) -> None:
    batches = RayBatches.from_photos(photos, (1, 2), with_alpha=True)
    fit = fitted(batches, replace(PLAN, random_background=True))
    assert error_of(fit) < 0.0064
    # A corner of the view is empty whatever stands behind it.
    black = render_view(fit.problem.field, camera(2.5), np.zeros(3)).image
    assert black[:4, :4].max() < 0.05


def slopes_of(photos: list[Photo], shrink: int = 2, background: np.ndarray | None = None) -> list[np.ndarray]:
    """Squared errors and derivatives of the first step of a fog."""
    problem, chosen = RadianceProblem(RayBatches.from_photos(photos, (1, 2)), BOX, PLAN), np.arange(len(photos))
    batch = draw_tiles(problem.batches, shrink, chosen, 30, np.random.default_rng(3))
    loss, slopes = problem.batch_loss_and_gradient(batch, background)
    return [np.array(a) for a in (loss, *slopes.values())]


def test_masked_pixels_are_not_fitted(variant_rgb: str, photos: list[Photo]) -> None:
    """Whatever a masked pixel shows, nothing changes; a shrunk one counts where all that it is the mean of do."""
    rng = np.random.default_rng(8)
    mask = rng.random((48, 48)) > 0.2
    painted = [
        [replace(p, mask=mask, image=np.where(mask[..., None], p.image, rng.random(3))) for p in photos[:3]] for _ in range(2)
    ]
    for shrink in (1, 2):
        first, second = (slopes_of(some, shrink) for some in painted)
        for a, b in zip(first, second, strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.abs(a).max())  # sums in another order
        whole = RayBatches.from_photos(painted[0], (1, 2)).all_pixels(shrink, 1)
        tiles = 48 // shrink // TILE
        counted = np.array(whole.counted).reshape(tiles, tiles, TILE, TILE).transpose(0, 2, 1, 3).reshape(2 * [48 // shrink])
        np.testing.assert_array_equal(counted, mask.reshape(48 // shrink, shrink, 48 // shrink, shrink).all(axis=(1, 3)))
        assert np.any(slopes_of(photos[:3], shrink)[0] != first[0])
    some = [*painted[0][:2], photos[2]]
    assert RayBatches.from_photos(some).bytes == RayBatches.from_photos(photos[:3]).bytes + 3 * 48 * 48
    assert RayBatches.from_photos(some).digest() != RayBatches.from_photos([replace(p, mask=None) for p in some]).digest()


def test_photographs_may_have_different_backgrounds(variant_rgb: str, photos: list[Photo]) -> None:
    """Photographs over three colours have the derivatives of the same over white, whatever is put behind both."""
    whole = [replace(p, alpha=(p.alpha > 0.5).astype(np.float32)) for p in photos[:3]]
    colours = np.array([[10, 200, 30], [0, 0, 0], [90, 80, 255]], np.float32) / 255

    def over(photo: Photo, colour: np.ndarray) -> Photo:
        return replace(photo, image=np.where(photo.alpha[..., None] > 0, photo.image, colour), background=colour)

    white = slopes_of([over(p, WHITE) for p in whole], 1, np.array([0.3, 0.9, 0.1]))
    other = slopes_of([over(p, c) for p, c in zip(whole, colours, strict=True)], 1, np.array([0.3, 0.9, 0.1]))
    for a, b in zip(white, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(a).max())  # a background added and taken off again
    kept = RayBatches.from_photos([over(p, c) for p, c in zip(whole, colours, strict=True)], with_alpha=False)
    np.testing.assert_array_equal(np.array(kept.all_pixels(1, 2).background).T[0], colours[2])


@pytest.mark.slow
def test_sky_is_recovered(variant_rgb: str, photos: list[Photo]) -> None:
    """A ball under a sky of two colours, photographs without alpha: the sky is found where rays pass the ball."""
    v, u = np.meshgrid(np.linspace(0, 1, 8), (np.arange(16) + 0.5) / 16, indexing="ij")
    image = np.stack([0.5 + 0.4 * np.sin(2 * np.pi * u), 0.9 - 0.8 * v, 0.3 + 0 * u], axis=-1)
    sky = Sky.from_image(image)
    images = [np.clip(render_view(ball(), p.camera, sky).image, 0, 1) for p in photos]
    taken = [Photo(p.name, image, None, None, p.camera, WHITE) for p, image in zip(photos, images, strict=True)]
    fit = fitted(RayBatches.from_photos(taken, (1, 2)), replace(PLAN, sky=8))
    seen, truth = render_view(fit.problem.field, camera(2.5), fit.problem.sky), render_view(ball(), camera(2.5), sky)
    # 22 dB between the views; without a sky 16 dB, and the box is full.
    assert np.mean((np.clip(seen.image, 0, 1) - truth.image) ** 2) < 0.0064
    assert seen.opacity[truth.opacity < 0.01].mean() < 0.01
    # A corner of a view that was taken looks past the ball: the sky itself, within 10 steps of a photograph's 255.
    corner = render_view(fit.problem.field, photos[3].camera, fit.problem.sky).image[:4, :4]
    assert np.abs(corner - images[3][:4, :4]).mean() < 10 / 255
    problem = fit.problem
    again = RadianceProblem(problem.batches, BOX, problem.plan)
    again.unpack(problem.pack(fit.run.reals), fit.run.reals)
    np.testing.assert_array_equal(again.sky.image(), problem.sky.image())
    with pytest.raises(MivolError, match="alpha, which marks their background"):
        RadianceProblem(RayBatches.from_photos(photos, (1, 2), with_alpha=True), BOX, problem.plan)


def test_sky_starts_from_the_median_colour(variant_rgb: str, photos: list[Photo]) -> None:
    """A dark sky begins dark, or the field would have to be what darkens a grey one; what masks leave out says nothing."""
    dark = np.array([20, 30, 60], np.float32) / 255
    images = [np.where(p.alpha[..., None] > 0.5, p.image, dark) for p in photos[:3]]
    masks = [np.ones(p.alpha.shape, bool) for p in photos[:3]]
    images[0][:], masks[0][:] = 1, False
    taken = [Photo(p.name, i, None, m, p.camera, WHITE) for p, i, m in zip(photos, images, masks, strict=False)]
    problem = RadianceProblem(RayBatches.from_photos(taken, (1, 2)), BOX, replace(PLAN, sky=8))
    np.testing.assert_allclose(problem.sky.image(), np.broadcast_to(dark, (8, 16, 3)), atol=1e-6)
    blind = [replace(p, mask=np.zeros_like(p.mask)) for p in taken]
    np.testing.assert_array_equal(RayBatches.from_photos(blind).median(), 0.5)


def test_beta_favours_opacities_of_0_or_1(variant_rgb: str, photos: list[Photo]) -> None:
    """The beta prior's part of the derivatives is that of the mean of log T + log(1 - T) over the rays that count."""
    batches, parts = RayBatches.from_photos(photos[:3], (1, 2)), {}
    problem = RadianceProblem(batches, BOX, replace(PLAN, start=1.0))  # a fog: no density is at the ReLU's kink
    batch = draw_tiles(batches, 2, np.arange(3), 30, np.random.default_rng(3))
    counted = np.arange(dr.width(batch.slot)) % 3 > 0
    batch.counted = mi.Float(counted)
    for beta in (0.0, 0.5):
        problem.plan = replace(PLAN, beta=beta)
        parts[beta] = np.array(problem.batch_loss_and_gradient(batch, np.ones(3))[1]["density"], np.float64)
    way = np.random.default_rng(4).normal(size=parts[0.0].shape)

    def prior(density: np.ndarray) -> float:
        field = problem.field.with_values(mi.Float(np.float32(density)), problem.field.harmonics)
        cells = find_occupied_cells(field)
        seen = render_rays(cells, bake(field, cells, batch.origins, batch.slot), make_model(field, PLAN.stop), batch.rays)
        T = np.array(seen.T, np.float64)
        near = np.clip(T, 0.01, 0.99)  # beyond, the prior goes on as its tangent
        return float(np.mean(counted * (np.log(near) + np.log(1 - near) + (1 / near - 1 / (1 - near)) * (T - near))))

    v, h = np.array(problem.field.density, np.float64), 1e-3
    expected = 0.5 * (prior(v + h * way) - prior(v - h * way)) / (2 * h)
    assert np.sum((parts[0.5] - parts[0.0]) * way) == pytest.approx(expected, rel=1e-3)


def test_fits_that_are_refused(variant_rgb: str, photos: list[Photo]) -> None:
    batches = RayBatches.from_photos(photos[:2])
    for box, said in ((BOX[::-1], "lower and its upper"), (np.zeros(3), "lower and its upper")):
        assert_refused(said, RadianceProblem, batches, box, replace(PLAN, stages=PLAN.stages[1:]))
    assert_refused("shrunk by 2", RadianceProblem, batches, BOX, PLAN)
    bent = replace(photos[0], camera=replace(photos[0].camera, distortion=Lens(k1=0.1)))
    assert_refused("rectify", RayBatches.from_photos, [bent])
    assert_refused("no alpha", RayBatches.from_photos, [replace(photos[0], alpha=None)], with_alpha=True)
    assert_refused("shrink less", RayBatches.from_photos, photos[:1], (16,))
    empty = [replace(p, image=np.ones_like(p.image)) for p in photos[:4]]
    nothing = RadianceProblem(RayBatches.from_photos(empty, (1, 2)), BOX + 50.0, PLAN)
    assert_refused("no view shows matter", reconstruct, nothing, PLAN.optimizer, PLAN.course())


@pytest.mark.slow
def test_current_field_follows_the_latest_step(variant_rgb: str, photos: list[Photo]) -> None:
    fit = begin_radiance_fit(RayBatches.from_photos(photos[:4], (1, 2)), BOX, PLAN)
    before = np.array(current_field(fit).density)
    for _ in range(2):
        fit.advance()
        found = current_field(fit)
        assert np.array_equal(found.density, fit.run.reals["density"].array)
        assert not np.array_equal(found.density, before)
        before = np.array(found.density)


def test_steps_are_recorded_once_and_equal_traced_steps(
    one_thread: None, photos: list[Photo], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps differ in views, tiles, background, rates and the rows that the prior moves: each as an array."""
    plan = replace(PLAN, stages=PLAN.stages[:1], random_background=True, tv_density=0.1, sparsity=0.1, beta=0.01)
    batches = RayBatches.from_photos(photos[:4], (2,))
    recorded = fitted(batches, plan, 6)
    assert (recorded.problem._recorded.count, recorded.run._recorded.count) == (1, 2)
    monkeypatch.setattr(RecordedFunctions, "call", lambda self, function, *arguments: function(*arguments))
    traced = fitted(batches, plan, 6)
    assert traced.problem._recorded.count == 0
    assert [row["loss"] for row in recorded.history] == [row["loss"] for row in traced.history]
    for name, value in traced.run.reals.items():
        np.testing.assert_array_equal(np.array(recorded.run.reals[name]), np.array(value))
