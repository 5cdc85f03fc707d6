"""Photographs of radiance: reals, weights of errors, and a fit of a ball of high dynamic range."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, CUBE, PLAN, camera, draw_tiles, fitted

from mivol.fields.spherical_grid import SphericalGrid
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.photo_colours import EPSILON, SCALES
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo
from mivol.transport.line_integrals.radiance_field import make_model, render_rays
from mivol.transport.line_integrals.radiance_source import bake
from mivol.validate.metrics import score_image

GREY = np.full(3, 0.5, np.float32)

Y00 = 0.28209479177387814


def bright_ball(n: int = 24) -> SphericalGrid:
    """A sphere whose radiance goes from 0.02 on one side to 18 on the other."""
    g = (np.arange(n) + 0.5) / n * 2 - 1
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    tint = np.stack([1 + 0.5 * np.sin(5 * y), 1 + 0.5 * np.cos(4 * z), np.ones_like(x)], axis=-1)
    sh = (0.5 * np.exp(6.5 * x)[..., None] * tint)[..., None, :] / Y00
    return SphericalGrid.from_dense(60 * (0.6 - np.sqrt(x * x + y * y + z * z)), sh, CUBE, offset=0.0, space="linear")


def shot(k: float, side: int = 48) -> Photo:
    """What a pinhole sees of the ball, over grey."""
    seen = render_view(bright_ball(), camera(k, side), GREY)
    return Photo(f"view {k}", seen.image, seen.opacity, None, camera(k, side), GREY)


def problem_of(photos: list[Photo], sky: int = 0) -> RadianceProblem:
    with_alpha = None if sky == 0 else False
    return RadianceProblem(RayBatches.from_photos(photos, (1, 2), with_alpha, "linear"), BOX, replace(PLAN, start=1.0, sky=sky))


def test_linear_reals_are_logarithmic_far_from_0(variant_rgb: str) -> None:
    """In float64 asinh; there and back to a few roundings of float32. Codes are their own reals."""
    colours = np.float32([-30, -0.3, 0, 1e-3, 0.4, 90])
    scale = SCALES["linear"]
    reals = np.array(scale.to_reals(mi.Float(colours)))
    np.testing.assert_allclose(reals, np.arcsinh(colours.astype(np.float64)), rtol=2e-6, atol=1e-7)
    # sinh of a rounded number r is off by |r| 6e-8 of itself.
    np.testing.assert_allclose(np.array(scale.to_colours(mi.Float(reals))), colours, rtol=2e-6, atol=1e-7)
    slopes = np.array(scale.gradient_by_reals(mi.Float(2, 2, 2, 2, 2, 2), mi.Float(reals)))
    np.testing.assert_allclose(slopes, 2 * np.sqrt(1 + colours.astype(np.float64) ** 2), rtol=4e-6)
    codes = SCALES["srgb"]
    given = mi.Float(colours)
    for same in (codes.to_reals(given), codes.to_colours(given), codes.gradient_by_reals(given, mi.Float(1))):
        assert np.array_equal(np.array(same), colours)


@pytest.mark.slow
def test_initial_fog_is_not_brighter_than_the_photographs(variant_rgb: str) -> None:
    """Half of the brightest hundredth of each colour, at most grey.

    A dim ball before more light is found (43 dB were seen); a fog of 0.5, brighter than both, goes until no matter is left.
    """
    dim = np.full((400, 3), 0.25)
    dim[:2] = 7  # hot pixels
    scale = SCALES["linear"]
    np.testing.assert_allclose(scale.fog_colour(lambda: dim * [1, 0.4, 8]), [0.125, 0.05, 0.5])
    np.testing.assert_allclose(scale.fog_colour(lambda: dim[:0]), 0.5)
    np.testing.assert_allclose(SCALES["srgb"].fog_colour(lambda: dim), 0.5)
    shots = [shot(k) for k in range(16)]
    around = np.float32([0.25, 0.25, 0.25])
    photos = []
    for one in shots:
        alpha = one.alpha[..., None]
        image = np.float32(alpha * [0.2, 0.02, 0.05] + (1 - alpha) * around)
        photos.append(replace(one, image=image, alpha=None, background=around))
    fit = fitted(RayBatches.from_photos(photos[1:], (1, 2), False, "linear"), PLAN)
    seen = render_view(fit.problem.field, photos[0].camera, around).image
    assert score_image(seen, photos[0].image, space="linear").values["psnr"] > 25


def test_errors_are_weighted_by_the_slope_of_the_tone_curve(variant_rgb: str) -> None:
    """The loss of a ray, in float64, from what the field shows and the photographs hold; of a photograph beyond 1, too."""
    photos = [shot(k, 16) for k in range(3)]
    problem = problem_of(photos)
    batch = draw_tiles(problem.batches, 1, np.array([0, 2]), 6, np.random.default_rng(2))
    target = np.array(batch.target, np.float64).T
    assert target.max() > 3
    loss, slopes = problem.batch_loss_and_gradient(batch)
    source = bake(problem.field, problem._cells, batch.origins, batch.slot)
    seen = render_rays(problem._cells, source, make_model(problem.field, problem.plan.stop), batch.rays)
    shown = np.array(seen.colour + seen.T * batch.background, np.float64).T
    # The photographs have alpha and their own grey behind them, which is behind the field, too: no more is to be taken off.
    wanted = np.mean(((shown - target) / (np.maximum(shown, 0) + EPSILON)) ** 2, axis=1)
    # float32 colours of up to 18: errors of 2e-6, which the weight makes up to 10 times as large, in differences of up to 100.
    np.testing.assert_allclose(np.array(loss), wanted, rtol=1e-5, atol=1e-6)
    assert np.abs(np.array(slopes["harmonics"])).max() > 0


@pytest.mark.parametrize("name", ["harmonics", "sky"])
def test_gradient_matches_the_weighted_error(variant_rgb: str, name: str) -> None:
    """A step along a direction: with the weights held at the first point, as the source holds them."""
    photos = [shot(k, 16) for k in range(3)]
    problem = problem_of(photos, sky=4)
    rng = np.random.default_rng(1)
    reals = problem.values()
    reals = reals | {n: mi.TensorXf(np.float32(rng.normal(0.4, 0.5, reals[n].shape))) for n in ("harmonics", "sky")}
    _, gradient = problem.loss_and_gradient(reals, 3, views=2)
    weights = {}
    by = rng.normal(size=reals[name].shape)

    def loss(h: float) -> float:
        moved = reals | {name: mi.TensorXf(np.float32(np.array(reals[name]) + h * by))}
        weight = problem.scale.weight

        def held(shown: mi.Color3f) -> mi.Color3f:
            return weights.setdefault("at", weight(shown))

        problem.scale = _Held(problem.scale, held)
        found = float(problem.loss_and_gradient(moved, 3, views=2)[0][0])
        problem.scale = problem.scale.scale
        return found

    loss(0.0)
    h = 2.0**-6
    slope = (loss(h) - loss(-h)) / (2 * h)
    along = float(np.sum(np.array(gradient[name], np.float64) * by))
    # The loss is a few units of float32 with errors of 1e-6 of it in sums, over 2 h = 1/32; and h^2 / 6 of a third derivative.
    assert slope == pytest.approx(along, rel=5e-3, abs=3e-4)
    assert abs(along) > 0.05


class _Held:
    """A scale whose weights are those of the first call."""

    def __init__(self, scale, weight) -> None:
        self.scale, self.weight = scale, weight

    def __getattr__(self, name: str):
        return getattr(self.scale, name)


def test_radiance_pixels_are_stored_unchanged(variant_rgb: str) -> None:
    """Beyond 1, below 1/255 and negative, in both sizes; memory counts four bytes a number."""
    photos = [shot(k, 16) for k in range(2)]
    image = photos[0].image.copy()
    image[3, 5] = [70.25, 1e-4, -0.5]
    batches = RayBatches.from_photos([replace(photos[0], image=image), photos[1]], (1, 2), space="linear")
    channels, _ = batches.image(1, 0)
    np.testing.assert_array_equal(np.stack([np.array(c) for c in channels[:3]], axis=-1).reshape(16, 16, 3), image)
    small = np.stack([np.array(c) for c in batches.image(2, 0)[0][:3]], axis=-1).reshape(8, 8, 3)
    np.testing.assert_allclose(small, image.reshape(8, 2, 8, 2, 3).mean(axis=(1, 3)), rtol=1e-6, atol=1e-7)
    assert batches.bytes == 2 * 4 * 4 * (16 * 16 + 8 * 8)
    assert batches.median() == pytest.approx(np.median(np.stack([p.image for p in photos]).reshape(-1, 3), axis=0), rel=0.5)


@pytest.mark.slow
def test_fit_recovers_a_radiance_range_of_800(variant_rgb: str) -> None:
    """As codes the lamp's side, a quarter of the ball, comes out white: 1 of up to 18."""
    train, held = [shot(k) for k in range(16)], [shot(k + 0.5) for k in range(4)]
    image = np.stack([photo.image for photo in train])
    assert image.max() > 600 * image.min()
    found = fitted(RayBatches.from_photos(train, (1, 2), space="linear"), PLAN).problem.field
    assert found.space == "linear"
    quality, ratios = [], []
    for photo in held:
        seen = render_view(found, photo.camera, GREY).image
        quality.append(score_image(seen, photo.image, space="linear").values["psnr"])
        bright = (photo.alpha > 0.99) & (photo.image.min(axis=2) > 2)
        ratios.append(np.median(seen[bright] / photo.image[bright]))
    # 39.8 dB and 1.00 were measured; as codes 25.6 and 0.17, with the learning rates of codes 32.6 and 0.31.
    assert np.mean(quality) > 37
    assert abs(np.log(np.mean(ratios))) < 0.1


def test_resumed_radiance_fit_equals_an_uninterrupted_fit(variant_rgb: str) -> None:
    """What is packed and taken up again shows the same, and is radiance."""
    problem = problem_of([shot(k, 16) for k in range(2)], sky=4)
    rng = np.random.default_rng(5)
    reals = {n: mi.TensorXf(np.float32(rng.normal(0.4, 0.5, value.shape))) for n, value in problem.values().items()}
    arrays = problem.pack(reals)
    again = RadianceProblem(problem.batches, BOX, problem.plan)
    again.unpack(arrays, reals)
    assert again.field.space == "linear"
    for one in (problem, again):
        np.testing.assert_allclose(np.array(one.field.harmonics), np.sinh(np.array(reals["harmonics"]).ravel()), rtol=2e-6)
        np.testing.assert_allclose(np.array(one.sky.texels), np.sinh(np.array(reals["sky"]).ravel()), rtol=2e-6)
        np.testing.assert_allclose(np.array(one.values()["harmonics"]), np.array(reals["harmonics"]), rtol=1e-5, atol=1e-6)
    rates = problem.learning_rates(0)
    assert rates["harmonics"] == pytest.approx(4 * problem.plan.sh_rate)
    assert rates["sky"] == pytest.approx(4 * problem.plan.sky_rate)
