"""The fit of a radiance field: its parts against what is known, and a small fit from its first step to its pictures."""

from __future__ import annotations

import re
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.fields.resampling import resample_field
from mivol.fields.sky import Sky
from mivol.fields.spherical import SphericalGrid
from mivol.optim.radiance_fit import RadianceFit, render_view
from mivol.optim.radiance_plan import PRESETS, Plan, Stage, memory_of, place_grid
from mivol.optim.radiance_priors import Neighbours, dull, smooth, thin_out
from mivol.optim.radiance_views import TILE, Views
from mivol.photos import Camera, Lens, Photo, pixel_centres, rays
from mivol.photos.camera import intrinsics
from mivol.transport.line_integrals.radiance_field import bake, cells_of, model_of, render

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])
CUBE = np.array([[2.0, 0, 0, -1], [0, 2, 0, -1], [0, 0, 2, -1], [0, 0, 0, 1]])
WHITE = np.ones(3, np.float32)


def ball(n: int = 24) -> SphericalGrid:
    """A sphere of many colours with a sheen that goes with the direction."""
    g = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    sh = np.zeros((n, n, n, 4, 3))
    sh[..., 0, :] = np.stack([np.sin(3 * x), np.cos(4 * y), np.sin(3 * z + 1)], axis=-1)
    sh[..., 2, :] = 0.4
    return SphericalGrid.from_dense(60 * (0.6 - np.sqrt(x * x + y * y + z * z)), sh, CUBE)


def camera(k: float, side: int = 48) -> Camera:
    back = np.array([np.cos(0.7 * k), np.sin(0.7 * k), 0.9 * np.cos(1.9 * k)]) * 3
    z = back / np.linalg.norm(back)
    x = np.cross([0, 0, 1], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), back
    return Camera(intrinsics(1.3 * side, 1.3 * side, side / 2, side / 2), (side, side), pose)


def photo(field: SphericalGrid, k: float, side: int = 48) -> Photo:
    seen = render_view(field, camera(k, side), WHITE)
    return Photo(f"view {k}", np.clip(seen.image, 0, 1), seen.opacity, None, camera(k, side), WHITE)


PLAN = Plan((Stage(12, 60, 2, 4, 24), Stage(24, 90, 1, 4, 48)), degree=1, random_background=False)


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    mi.set_variant("llvm_ad_rgb")
    return [photo(ball(), k) for k in range(16)]


def error_of(fit: RadianceFit, k: float = 2.5) -> float:
    return float(np.mean((np.clip(render_view(fit.field, camera(k), WHITE).image, 0, 1) - photo(ball(), k).image) ** 2))


def fitted(views: Views, plan: Plan, steps: int | None = None, fit: RadianceFit | None = None) -> RadianceFit:
    fit = fit or RadianceFit(views, BOX, plan)
    while fit.step < (plan.steps if steps is None else steps):
        fit.advance()
    return fit


def test_a_fit_finds_what_it_did_not_see(variant_rgb: str, photos: list[Photo]) -> None:
    fit = fitted(Views.of(photos, (1, 2)), PLAN)
    # 0.0032: 25 dB in a view between those it saw. The mean colour of the views alone gives 11 dB.
    assert error_of(fit) < 0.0032
    assert fit.field.nodes is not None and fit.field.rows < 0.9 * 24**3
    seen = render_view(fit.field, camera(2.5), WHITE)
    truth = render_view(ball(), camera(2.5), WHITE).depth[22:26, 22:26]
    # Two voxels.
    assert np.abs(seen.depth[22:26, 22:26] - truth).max() < 2 * 2 / 24
    assert np.isnan(seen.depth[0, 0]) and seen.opacity[0, 0] == 0


def test_a_finer_stage_goes_on_where_the_last_one_stopped(variant_rgb: str, photos: list[Photo]) -> None:
    """Its first step knows how large derivatives were: begun anew, it would move all that it touches by a whole rate."""
    fit = fitted(Views.of(photos, (1, 2)), replace(PLAN, tv_density=0.0), PLAN.stages[0].steps)
    fit.begin(1)
    before = np.array(fit.field.density)
    fit.advance()
    moved = np.abs(np.array(fit.field.density) - before) * fit.unit
    # Where no more rays than before cross a voxel, and not all agree, steps are below the rate.
    assert 0 < np.median(moved[moved > 0]) < 0.5 * fit.plan.rates(PLAN.stages[0].steps)[0]


def test_a_fit_that_went_on_equals_one_that_did_not_stop(variant_rgb: str, photos: list[Photo]) -> None:
    views = Views.of(photos[:6], (1, 2))
    plan = replace(PLAN, stages=(Stage(8, 10, 2, 3, 8), Stage(16, 10, 1, 3, 8)), tv_density=0.1, first_degree=0)
    whole = fitted(views, plan, 14)
    arrays, about = whole.pack()
    whole = fitted(views, plan, 20, whole)
    resumed = RadianceFit(views, BOX, plan)
    resumed.restore(arrays, about)
    assert resumed.step == 14 and resumed.field.degree == 1
    resumed = fitted(views, plan, 20, resumed)
    for a, b in zip(whole.field.values(), resumed.field.values(), strict=True):
        # RMSprop turns the last bits of sums into steps of up to a learning rate where a derivative is nearly 0: most agree.
        scale = np.abs(a).max()
        assert np.mean(np.abs(a - b) > 1e-3 * scale) < 0.01


def test_backgrounds_that_change_leave_no_white_in_the_air(variant_rgb: str, photos: list[Photo]) -> None:
    views = Views.of(photos, (1, 2), with_alpha=True)
    fit = fitted(views, replace(PLAN, random_background=True))
    assert error_of(fit) < 0.0064
    # A corner of the view is empty whatever stands behind it.
    black = render_view(fit.field, camera(2.5), np.zeros(3)).image
    assert black[:4, :4].max() < 0.05


def slopes_of(photos: list[Photo], shrink: int = 2, background: np.ndarray | None = None) -> list[np.ndarray]:
    """Squared errors and derivatives of the first step of a fog."""
    fit, chosen = RadianceFit(Views.of(photos, (1, 2)), BOX, PLAN), np.arange(len(photos))
    fit.begin(0)
    batch = fit.views.draw(shrink, chosen, 30, np.random.default_rng(3))
    loss, slopes = fit._slopes(batch, fit.views.origins[chosen], background)
    return [np.array(a) for a in (loss, *slopes)]


def test_what_a_mask_leaves_out_is_not_fitted(variant_rgb: str, photos: list[Photo]) -> None:
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
        whole = Views.of(painted[0], (1, 2)).whole(shrink, 1)
        tiles = 48 // shrink // TILE
        counted = np.array(whole.counted).reshape(tiles, tiles, TILE, TILE).transpose(0, 2, 1, 3).reshape(2 * [48 // shrink])
        np.testing.assert_array_equal(counted, mask.reshape(48 // shrink, shrink, 48 // shrink, shrink).all(axis=(1, 3)))
        assert np.any(slopes_of(photos[:3], shrink)[0] != first[0])
    some = [*painted[0][:2], photos[2]]
    assert Views.of(some).bytes == Views.of(photos[:3]).bytes + 3 * 48 * 48
    assert Views.of(some).digest() != Views.of([replace(p, mask=None) for p in some]).digest()


def test_each_photograph_may_lie_over_its_own_colour(variant_rgb: str, photos: list[Photo]) -> None:
    """Photographs over three colours have the derivatives of the same over white, whatever is put behind both."""
    whole = [replace(p, alpha=(p.alpha > 0.5).astype(np.float32)) for p in photos[:3]]
    colours = np.array([[10, 200, 30], [0, 0, 0], [90, 80, 255]], np.float32) / 255

    def over(photo: Photo, colour: np.ndarray) -> Photo:
        return replace(photo, image=np.where(photo.alpha[..., None] > 0, photo.image, colour), background=colour)

    white = slopes_of([over(p, WHITE) for p in whole], 1, np.array([0.3, 0.9, 0.1]))
    other = slopes_of([over(p, c) for p, c in zip(whole, colours, strict=True)], 1, np.array([0.3, 0.9, 0.1]))
    for a, b in zip(white, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(a).max())  # a background added and taken off again
    kept = Views.of([over(p, c) for p, c in zip(whole, colours, strict=True)], with_alpha=False)
    np.testing.assert_array_equal(np.array(kept.whole(1, 2).before).T[0], colours[2])


def test_what_is_behind_is_found_too(variant_rgb: str, photos: list[Photo]) -> None:
    """A ball under a sky of two colours, photographs without alpha: the sky is found where rays pass the ball."""
    v, u = np.meshgrid(np.linspace(0, 1, 8), (np.arange(16) + 0.5) / 16, indexing="ij")
    image = np.stack([0.5 + 0.4 * np.sin(2 * np.pi * u), 0.9 - 0.8 * v, 0.3 + 0 * u], axis=-1)
    sky = Sky.of_image(image)
    images = [np.clip(render_view(ball(), p.camera, sky).image, 0, 1) for p in photos]
    taken = [Photo(p.name, image, None, None, p.camera, WHITE) for p, image in zip(photos, images, strict=True)]
    fit = fitted(Views.of(taken, (1, 2)), replace(PLAN, sky=8))
    seen, truth = render_view(fit.field, camera(2.5), fit.sky), render_view(ball(), camera(2.5), sky)
    # 22 dB between the views; without a sky 16 dB, and the box is full.
    assert np.mean((np.clip(seen.image, 0, 1) - truth.image) ** 2) < 0.0064
    assert seen.opacity[truth.opacity < 0.01].mean() < 0.01
    # A corner of a view that was taken looks past the ball: the sky itself, within 10 steps of a photograph's 255.
    corner = render_view(fit.field, photos[3].camera, fit.sky).image[:4, :4]
    assert np.abs(corner - images[3][:4, :4]).mean() < 10 / 255
    again = RadianceFit(fit.views, BOX, fit.plan)
    again.restore(*fit.pack())
    np.testing.assert_array_equal(again.sky.image(), fit.sky.image())
    with pytest.raises(MivolError, match="alpha, which says what is behind"):
        RadianceFit(Views.of(photos, (1, 2), with_alpha=True), BOX, fit.plan)


def test_a_sky_begins_with_what_most_pixels_show(variant_rgb: str, photos: list[Photo]) -> None:
    """A dark sky begins dark, or the field would have to be what darkens a grey one; what masks leave out says nothing."""
    dark = np.array([20, 30, 60], np.float32) / 255
    images = [np.where(p.alpha[..., None] > 0.5, p.image, dark) for p in photos[:3]]
    masks = [np.ones(p.alpha.shape, bool) for p in photos[:3]]
    images[0][:], masks[0][:] = 1, False
    taken = [Photo(p.name, i, None, m, p.camera, WHITE) for p, i, m in zip(photos, images, masks, strict=False)]
    fit = RadianceFit(Views.of(taken, (1, 2)), BOX, replace(PLAN, sky=8))
    np.testing.assert_allclose(fit.sky.image(), np.broadcast_to(dark, (8, 16, 3)), atol=1e-6)
    blind = [replace(p, mask=np.zeros_like(p.mask)) for p in taken]
    np.testing.assert_array_equal(Views.of(blind).median(), 0.5)


def test_views_know_their_rays_and_pixels(variant_rgb: str, photos: list[Photo]) -> None:
    views = Views.of(photos[:3], (1, 2))
    batch = views.draw(1, np.array([0, 2]), 5, np.random.default_rng(0))
    assert dr.width(batch.slot) == 2 * 5 * TILE**2
    whole = views.whole(1, 1)
    _, d = rays(photos[1].camera, pixel_centres((48, 48)))
    found = np.array(whole.rays.d).T.reshape(12, 12, 4, 4, 3).transpose(0, 2, 1, 3, 4).reshape(48, 48, 3)
    np.testing.assert_allclose(found, d, atol=3e-7)
    image = np.array(whole.target).T.reshape(12, 12, 4, 4, 3).transpose(0, 2, 1, 3, 4).reshape(48, 48, 3)
    np.testing.assert_allclose(image, photos[1].image, atol=0.5 / 255 + 1e-6)
    half = np.array(views.whole(2, 1).rays.d).T[0]
    assert np.abs(half - d[0:2, 0:2].mean(axis=(0, 1))).max() < 1e-3
    assert views.digest() != Views.of(photos[1:4], (1, 2)).digest()


def test_a_field_on_finer_nodes_is_the_same_field(variant_rgb: str) -> None:
    n = 6
    g = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    sh = np.stack([x + 2 * y - z] * 3, axis=-1)[..., None, :]
    field = SphericalGrid.from_dense(1 - x + y * 3, sh, CUBE)
    keep = np.ones((n, n, n), bool)
    keep[:2] = False
    fine = resample_field(field, (12, 12, 12), CUBE, keep)
    density, found = fine.to_dense()
    g = (np.arange(12) + 0.5) / 12
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    inner = np.s_[5:-1, 1:-1, 1:-1]
    np.testing.assert_allclose(density[inner], (1 - x + 3 * y)[inner], atol=1e-5)
    np.testing.assert_allclose(found[..., 0, 0][inner], (x + 2 * y - z)[inner], atol=1e-5)
    # Nodes 0 and 1 are not kept: fine nodes up to 2.5 lie between those only.
    assert (density[:3] == 0).all() and (density[3:] != 0).any(axis=(1, 2)).all()
    with pytest.raises(MivolError, match="other axes"):
        resample_field(field, (12, 12, 12), np.array([[0, -1.0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), keep)


def test_beliefs_move_values_down_their_slopes(variant_rgb: str) -> None:
    rng = np.random.default_rng(0)
    density, sh = rng.normal(size=(4, 5, 6)).astype(np.float32), rng.normal(size=(4, 5, 6, 4, 3)).astype(np.float32)
    field = SphericalGrid.from_dense(density, sh, CUBE)
    around, amount = Neighbours.of(field), 0.05

    def variation(v: np.ndarray) -> float:
        steps = [np.diff(v, axis=a, append=np.take(v, [-1], axis=a)) for a in (0, 1, 2)]
        return float(np.sum(np.sqrt((6 * amount) ** 2 + sum(s * s for s in steps))))

    moved = mi.Float(field.density)
    smooth(moved, 1, around, amount, 1.0, 7)
    way = rng.normal(size=density.shape)
    v = density.astype(np.float64)
    expected = -amount * (variation(v + 1e-6 * way) - variation(v - 1e-6 * way)) / 2e-6
    assert np.sum((np.array(moved).reshape(v.shape) - v) * way) == pytest.approx(expected, rel=1e-4)

    moved = thin_out(field.density, 0.01, 0.5)
    cauchy = lambda v: np.sum(np.log(1 + 2 * np.maximum(0.5 * v, 0) ** 2))  # noqa: E731
    expected = -0.01 * (cauchy(v + 1e-6 * way) - cauchy(v - 1e-6 * way)) / 2e-6 / 0.5**2
    assert np.sum((np.array(moved).reshape(v.shape) - v) * way) == pytest.approx(expected, rel=1e-4)
    assert (np.array(thin_out(field.density, 100.0, 0.5)) <= np.maximum(density.reshape(-1), 0)).all()
    assert np.array(thin_out(field.density, 100.0, 0.5))[density.reshape(-1) > 0] == pytest.approx(0, abs=1e-6)

    kept = np.array(dull(field.harmonics, field.width, 0.25)).reshape(*density.shape, -1)[..., :12].reshape(sh.shape)
    np.testing.assert_array_equal(kept[..., 0, :], sh[..., 0, :])
    np.testing.assert_allclose(kept[..., 1:, :], 0.75 * sh[..., 1:, :], rtol=1e-6)


def test_smoothing_a_sparse_field_is_smoothing_what_is_stored(variant_rgb: str) -> None:
    """Terms are those of the nodes that are stored; what is not stored beyond them is vacuum, before them it has no term."""
    rng = np.random.default_rng(2)
    density, keep, amount = rng.normal(size=(4, 5, 6)).astype(np.float32), rng.random((4, 5, 6)) < 0.6, 0.05
    field = SphericalGrid.from_dense(density, np.zeros((4, 5, 6, 1, 3)), CUBE, keep)
    dense = np.where(keep, density, 0.0)  # the vacuum of a ReLU

    def variation(v: np.ndarray) -> float:
        steps = [np.diff(v, axis=a, append=np.take(v, [-1], axis=a)) for a in (0, 1, 2)]
        return float(np.sum(np.sqrt((6 * amount) ** 2 + sum(s * s for s in steps))[keep]))

    moved = mi.Float(field.density)
    smooth(moved, 1, Neighbours.of(field), amount, 1.0, 7)
    way = rng.normal(size=density.shape) * keep
    expected = -amount * (variation(dense + 1e-6 * way) - variation(dense - 1e-6 * way)) / 2e-6
    # As above: central differences in float64, values moved in float32.
    assert np.sum((np.array(moved)[:-1] - density[keep]) * way[keep]) == pytest.approx(expected, rel=1e-4)


def test_smoothing_however_strong_makes_nothing_new(variant_rgb: str) -> None:
    """What was between the smallest and the largest value stays there, and the vacuum around stays empty."""
    rng = np.random.default_rng(1)
    density = rng.normal(size=(6, 6, 6)).astype(np.float32)
    keep = np.zeros(density.shape, bool)
    keep[1:5, 1:5, 1:5] = True
    field = SphericalGrid.from_dense(density, np.zeros((6, 6, 6, 1, 3)), CUBE, keep)
    values, before = mi.Float(field.density), np.array(field.density)
    for start in range(40):
        smooth(values, 1, Neighbours.of(field), 1e3, 0.5, start)
        after = np.array(values)
        # Rounding of a sum of seven terms.
        assert before.min() - 1e-6 <= after.min() and after.max() <= before.max() + 1e-6
        assert after[-1] == before[-1]
    assert np.ptp(after) < 0.2 * np.ptp(before)


def test_opacities_are_asked_to_be_none_or_all(variant_rgb: str, photos: list[Photo]) -> None:
    """The beta prior's part of the derivatives is that of the mean of log T + log(1 - T) over the rays."""
    views = Views.of(photos[:3], (1, 2))
    fit, chosen, parts = RadianceFit(views, BOX, replace(PLAN, start=1.0)), np.arange(3), {}
    fit.begin(0)  # a fog: no density is at the ReLU's kink
    batch = views.draw(2, chosen, 30, np.random.default_rng(3))
    for beta in (0.0, 0.5):
        fit.plan = replace(PLAN, beta=beta)
        parts[beta] = np.array(fit._slopes(batch, views.origins[chosen], np.ones(3))[1][0], np.float64)
    way = np.random.default_rng(4).normal(size=parts[0.0].shape)

    def prior(density: np.ndarray) -> float:
        field = fit.field.with_values(mi.Float(np.float32(density)), fit.field.harmonics)
        cells = cells_of(field)
        seen = render(cells, bake(field, cells, views.origins[chosen], batch.slot), model_of(field, PLAN.stop), batch.rays)
        T = np.array(seen.T, np.float64)
        near = np.clip(T, 0.01, 0.99)  # beyond, the prior goes on as its tangent
        return float(np.mean(np.log(near) + np.log(1 - near) + (1 / near - 1 / (1 - near)) * (T - near)))

    v, h = np.array(fit.field.density, np.float64), 1e-3
    expected = 0.5 * (prior(v + h * way) - prior(v - h * way)) / (2 * h)
    assert np.sum((parts[0.5] - parts[0.0]) * way) == pytest.approx(expected, rel=1e-3)


def test_memory_is_counted_first(variant_rgb: str, photos: list[Photo]) -> None:
    views = Views.of(photos[:2])
    text = memory_of(PRESETS["cpu"], BOX, views, limit=1 << 40)
    assert "MiB" in text
    with pytest.raises(MivolError, match=r"512 nodes along an edge .* longest = (\d+) fits"):
        memory_of(PRESETS["gpu"], BOX, views, limit=2 << 30)
    with pytest.raises(MivolError, match="no resolution fits"):
        memory_of(PRESETS["gpu"], BOX, views, limit=1000)


TOO_LARGE = [("cpu", 32, 40), ("cpu", 128, 20), ("gpu", 64, 200), ("gpu", 300, 500)]


@pytest.mark.parametrize(("preset", "longest", "limit"), TOO_LARGE)
def test_the_resolution_that_is_said_to_fit_fits(
    variant_rgb: str, photos: list[Photo], preset: str, longest: int, limit: int
) -> None:
    """Taken as the next ``longest``, whichever stage then takes the most; one more is refused. Limits in MiB."""
    views = Views.of(photos[:2])

    def memory(nodes: int) -> str:
        return memory_of(PRESETS[preset].up_to(nodes), BOX, views, limit=limit << 20)

    with pytest.raises(MivolError) as refused:
        memory(longest)
    fits = int(re.search(r"longest = (\d+) fits", str(refused.value)).group(1))
    assert "about" in memory(fits)
    with pytest.raises(MivolError, match=f"longest = {fits} fits"):
        memory(fits + 1)


def test_grids_have_cubic_voxels_and_cover_the_box(variant_rgb: str) -> None:
    box = np.array([[0.0, 1, 2], [1, 1.5, 4]])
    res, to_world = place_grid(box, 20)
    assert res == (20, 5, 10)
    np.testing.assert_allclose(np.diag(to_world)[:3] / res[::-1], 0.1)
    np.testing.assert_allclose(to_world[:3, 3], box[0], atol=1e-12)


def test_fits_that_are_refused(variant_rgb: str, photos: list[Photo]) -> None:
    views = Views.of(photos[:2])
    for box, said in ((BOX[::-1], "lower and its upper"), (np.zeros(3), "lower and its upper")):
        with pytest.raises(MivolError, match=said):
            RadianceFit(views, box, replace(PLAN, stages=PLAN.stages[1:]))
    with pytest.raises(MivolError, match="shrunk by 2"):
        RadianceFit(views, BOX, PLAN)
    bent = replace(photos[0], camera=replace(photos[0].camera, distortion=Lens(k1=0.1)))
    with pytest.raises(MivolError, match="rectify"):
        Views.of([bent])
    with pytest.raises(MivolError, match="no alpha"):
        Views.of([replace(photos[0], alpha=None)], with_alpha=True)
    with pytest.raises(MivolError, match="shrink less"):
        Views.of(photos[:1], (16,))
    empty = [replace(p, image=np.ones_like(p.image)) for p in photos[:4]]
    nothing = RadianceFit(Views.of(empty, (1, 2)), BOX + 50.0, PLAN)
    with pytest.raises(MivolError, match="no view sees"):
        fitted(nothing.views, PLAN, fit=nothing)


def test_schedules() -> None:
    plan = replace(PLAN, delay=0.1, last=0.01)
    assert [plan.stage_at(s) for s in (0, 59, 60, 149, 150)] == [0, 0, 1, 1, 1]
    assert plan.rates(0) == pytest.approx((0.1, 0.05))
    assert plan.rates(150) == pytest.approx((0.1, 0.0005))
    climbing = Plan((Stage(8, 1), Stage(16, 1), Stage(32, 1)), degree=2, first_degree=0)
    assert [climbing.degree_at(k) for k in range(3)] == [0, 1, 2]
    assert [replace(climbing, first_degree=None).degree_at(k) for k in range(3)] == [2, 2, 2]
