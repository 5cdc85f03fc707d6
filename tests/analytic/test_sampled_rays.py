"""Emission and absorption of fields known at points: Beer-Lambert, a float64 twin, the adjoint, and skipped cells."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean
from sampled_fields import CUBE, Cloud, Slab, chords, random_rays

from mivol.fields.sampled_field import Region
from mivol.transport.line_integrals.radiance_field import RayGradient
from mivol.transport.line_integrals.sampled_rays import (
    RaySamples,
    SampledModel,
    SampledRays,
    draw_samples,
    render_samples,
    vjp_samples,
)
from mivol.transport.traversal.occupancy import list_cells
from mivol.validate.statistics import Moments

RES = (8, 8, 8)
RAYS = 200
ROUNDING = 2.0**-23
"""Spacing of float32 around 1."""


def region(occupied: np.ndarray | None = None, step: float = 0.1) -> Region:
    mask = np.ones((9, 9, 9), np.uint8) if occupied is None else occupied.astype(np.uint8)
    return Region(RES, CUBE, mi.UInt8(mask.ravel()), step)


def model(field: Slab, step: float = 0.1, stop: float = 0.0, occupied: np.ndarray | None = None) -> SampledModel:
    return SampledModel.from_field(replace(field, region=region(occupied, step)), stop)


@pytest.mark.parametrize("step", [0.01, 0.3, 50.0])
@pytest.mark.parametrize("u", [None, 0.37])
def test_a_constant_density_has_beer_lamberts_transmittance_for_any_step(
    variant_rgb: str, step: float, u: float | None
) -> None:
    rays = random_rays(RAYS)
    rendered = render_samples(model(Slab(), step), rays, u)
    tau = 1.5 * chords(rays)
    # Each ray adds strata of float32, at most 4 / step + 30 of them; each sum rounds by half a spacing of at most 8.
    n = 4 / step + 30
    np.testing.assert_allclose(np.array(rendered.T), np.exp(-tau), rtol=8 * n * ROUNDING)
    colour = (1 - np.exp(-tau))[:, None] * [0.2, 0.5, 0.9]
    np.testing.assert_allclose(np.array(rendered.colour).T, colour, atol=8 * n * ROUNDING)


def twin(samples: RaySamples, sigma: np.ndarray, colour: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour, transmittance and distance of each ray, sample by sample in float64."""
    t, dt = np.array(samples.t, np.float64), np.array(samples.dt, np.float64)
    first, count = np.array(samples.first), np.array(samples.count)
    colours, T, distance = np.zeros((len(first), 3)), np.ones(len(first)), np.zeros(len(first))
    for ray in range(len(first)):
        for k in range(first[ray], first[ray] + count[ray]):
            alpha = -np.expm1(-sigma[k] * dt[k])
            colours[ray] += T[ray] * alpha * colour[k]
            distance[ray] += T[ray] * alpha * t[k]
            T[ray] *= 1 - alpha
    return colours, T, distance


def values_of(rendered: SampledRays) -> tuple[np.ndarray, np.ndarray]:
    return np.array(rendered.values.sigma, np.float64), np.array(rendered.values.colour, np.float64).T


def test_rays_equal_a_twin_in_float64(variant_rgb: str) -> None:
    """Samples lie in their strata, and strata fill the rays; the sums are those of the textbook."""
    rays = random_rays(RAYS)
    rendered = render_samples(model(Cloud(4.0)), rays, 0.6)
    colour, T, distance = twin(rendered.samples, *values_of(rendered))
    lengths = np.bincount(np.array(rendered.samples.ray), np.array(rendered.samples.dt, np.float64), RAYS)
    np.testing.assert_allclose(lengths, chords(rays), atol=1e-5)
    # 60 samples a ray, values up to 5: each of the sums rounds by at most 60 x 5 half spacings.
    for found, expected in ((rendered.colour, colour.T), (rendered.T, T), (rendered.distance, distance)):
        np.testing.assert_allclose(np.array(found), expected, atol=150 * ROUNDING)


@pytest.mark.parametrize("sigma", [2.0, 300.0])
def test_the_adjoint_is_the_derivative_of_the_twin(variant_rgb: str, sigma: float) -> None:
    """By every sample's density and colour; behind an optical depth of hundreds derivatives vanish without a NaN."""
    rays = random_rays(20, 3)
    rendered = render_samples(model(Cloud(sigma)), rays, 0.3)
    rng = np.random.default_rng(5)
    g, gT, gt = rng.normal(size=(20, 3)), rng.normal(size=20), 0.2 * rng.normal(size=20)
    gradient = RayGradient(mi.Color3f(np.float32(g.T)), mi.Float(np.float32(gT)), mi.Float(np.float32(gt)))
    found = {name: np.array(value, np.float64) for name, value in vjp_samples(rendered, gradient).items()}
    densities, colours = values_of(rendered)

    def loss(densities: np.ndarray, colours: np.ndarray) -> float:
        colour, T, distance = twin(rendered.samples, densities, colours)
        return float((g * colour).sum() + (gT * T).sum() + (gt * distance).sum())

    h = 1e-5
    for k in rng.integers(0, len(densities), 25):
        step = np.zeros(len(densities))
        step[k] = h
        slope = (loss(densities + step, colours) - loss(densities - step, colours)) / (2 * h)
        # Central differences of float64: rounding 2^-52 x 100 / h, and h^2 x a third derivative below 1.
        np.testing.assert_allclose(found["sigma"][k], slope, atol=2e-6)
        change = np.zeros((len(densities), 3))
        change[k, 1] = 1
        slope = loss(densities, colours + change) - loss(densities, colours)
        np.testing.assert_allclose(found["colour"][3 * k + 1], slope, atol=2e-6)


def test_cells_without_matter_are_skipped_without_a_change(variant_rgb: str) -> None:
    """A slab between two planes of cells: Beer-Lambert with all cells skipped beside it, and fewer samples."""
    slab = Slab(low=-0.625, high=0.375)
    rays = random_rays(RAYS, 1)
    inside = np.zeros((9, 9, 9), bool)
    # Cell i lies between the nodes i - 1 and i, at x = (i - 1/2) / 4 - 1 and a voxel of 1/4 further.
    inside[:, :, 2:6] = True
    skipping, all_cells = model(slab, 0.05, occupied=inside), model(slab, 0.05)
    rendered, whole = render_samples(skipping, rays, 0.4), render_samples(all_cells, rays, 0.4)
    assert rendered.samples.size < 0.7 * whole.samples.size
    tau = 1.5 * chords(rays, -0.625, 0.375)
    np.testing.assert_allclose(np.array(rendered.T), np.exp(-tau), rtol=8 * 110 * ROUNDING)


@pytest.mark.statistical
def test_optical_depth_has_the_same_mean_with_and_without_skipping(variant_rgb: str) -> None:
    """Over the seeds: without skipping, strata cross the planes of the slab and are noisy."""
    slab = Slab(low=-0.625, high=0.375)
    rays = random_rays(RAYS, 1)
    inside = np.zeros((9, 9, 9), bool)
    inside[:, :, 1:7] = True

    def depths(occupied: np.ndarray | None) -> Moments:
        """Means over the rays, for each seed."""
        renders = [render_samples(model(slab, 0.3, occupied=occupied), rays, (seed + 0.5) / 24) for seed in range(24)]
        means = np.array([-np.log(np.array(rendered.T, np.float64)).mean() for rendered in renders])
        return Moments(len(means), means.mean(), ((means - means.mean()) ** 2).sum())

    truth = 1.5 * chords(rays, -0.625, 0.375).mean()
    for occupied in (None, inside):
        assert_same_mean(depths(occupied), truth, rounding=30 * ROUNDING, what="optical depths")


def test_samples_behind_the_stop_are_dropped_alone(variant_rgb: str) -> None:
    rays = random_rays(RAYS, 2)
    whole, stopped = (render_samples(model(Cloud(30.0), stop=stop), rays, 0.2) for stop in (0.0, 1e-3))
    assert stopped.drawn == whole.samples.size > 1.5 * stopped.samples.size
    assert np.abs(np.array(stopped.colour) - np.array(whole.colour)).max() < 1e-3
    opaque = np.array(stopped.T) > 0
    assert opaque.any() and (np.array(stopped.samples.count) <= np.array(whole.samples.count)).all()


def test_rays_beside_all_cells_are_empty(variant_rgb: str) -> None:
    rays = random_rays(5)
    assert draw_samples(list_cells(region(np.zeros((9, 9, 9)))), rays, 0.1, None) is None
    rendered = render_samples(model(Slab(), occupied=np.zeros((9, 9, 9))), rays)
    assert np.array(rendered.T).tolist() == [1.0] * 5 and not np.array(rendered.colour).any()
    assert vjp_samples(rendered, RayGradient(mi.Color3f(1), dr.ones(mi.Float, 5))) == {}
