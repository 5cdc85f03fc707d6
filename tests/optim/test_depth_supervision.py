"""Depth supervision: drawn points, derivatives of the energy, and a fit with points."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, PLAN, draw_tiles, fitted

from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import (
    OUTLIERS,
    POINTS_PER_VIEW,
    UNCERTAINTY,
    DepthRays,
    RayBatches,
    depth_loss_gradient,
    sample_depth_rays,
)
from mivol.photos import Photo
from mivol.transport.line_integrals.radiance_field import find_occupied_cells, make_model, render_rays
from mivol.transport.line_integrals.radiance_source import make_exact

VOXEL = 0.1


def ends_of(sightings: DepthRays) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays end, (2, count, 3), and how far that is."""
    o, d, t = (np.array(a) for a in (sightings.rays.o, sightings.rays.d, sightings.rays.t_max))
    return (o + d * t).T.reshape(2, sightings.count, 3), t.reshape(2, sightings.count)


def test_depth_rays_end_before_and_behind_points(variant_rgb: str) -> None:
    """By a voxel of the box in which they lie, of twice the edge in the next one, and by a share of their distance; points
    beyond all boxes are not drawn, nor are those of a photograph that has none."""
    near, far, beyond = np.array([[0.5, 0, 0.9]]), np.array([[1.0, -1.5, 0]]), np.array([[0, 0, 2.1]])
    origins = np.array([[3.0, 0, 0], [0, 4, 0], [0, 0, 5], [9, 9, 9]])
    points = [near, far, beyond, np.zeros((0, 3))]
    found = sample_depth_rays(points, origins, BOX, 2, VOXEL, np.random.default_rng(0))
    assert found.count == 2 * POINTS_PER_VIEW
    ends, t = ends_of(found)
    for slot, point, voxel in ((0, near, VOXEL), (1, far, 2 * VOXEL)):
        own = np.arange(found.count) // POINTS_PER_VIEW == slot
        away = point[0] - origins[slot]
        d = np.linalg.norm(away)
        off = (voxel + UNCERTAINTY * d) * np.array([[-1.0], [1.0]])
        np.testing.assert_allclose(t[:, own] - d, np.broadcast_to(off, (2, own.sum())), atol=1e-5)
        np.testing.assert_allclose(ends[:, own] - point, np.repeat((off * away / d)[:, None], own.sum(), axis=1), atol=1e-5)
    assert sample_depth_rays(points[2:], origins[2:], BOX, 2, VOXEL, np.random.default_rng(0)) is None
    # A ray to where the photograph was taken has no direction.
    assert sample_depth_rays([near], near, BOX, 2, VOXEL, np.random.default_rng(0)) is None


def energy(T: np.ndarray) -> float:
    """The mean of E over points, of transmittances before (first half) and behind them."""
    before, behind = T.reshape(2, -1)
    return float(np.mean(-np.log((1 - OUTLIERS) * (before - behind) + OUTLIERS)))


def test_depth_loss_gradient_matches_differences(variant_rgb: str) -> None:
    T = np.array([1.0, 0.9, 0.5, 0.2, 1.0, 0.1, 0.5, 0.0])
    found = np.array(depth_loss_gradient(mi.Float(T), 4))
    step = 1e-5
    expected = [(energy(T + step * e) - energy(T - step * e)) / (2 * step) for e in np.eye(8)]
    # Central differences are off by h^2 / 6 times the third derivative, below 2 (0.95 / 0.05)^3 / 4: 6e-8; float32 by 2^-23.
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.fixture
def sighted(photos: list[Photo]) -> list[Photo]:
    """Four of the photographs, in which points of the ball's middle plane were found."""
    rng = np.random.default_rng(5)
    return [replace(photo, points=np.column_stack([rng.uniform(-0.5, 0.5, (9, 2)), np.zeros(9)])) for photo in photos[:4]]


def differentiate_depths(sighted: list[Photo]) -> tuple[RadianceProblem, DepthRays, dict[str, np.ndarray]]:
    """A fit in an even fog, rays to points, and 0.7 times the derivative of their energy by the numbers of the fit."""
    problem = RadianceProblem(RayBatches.from_photos(sighted, (1, 2)), BOX, replace(PLAN, depth=0.7))
    chosen = np.arange(4)
    batch = draw_tiles(problem.batches, 2, chosen, 4, np.random.default_rng(0))
    drawn = problem._draw_depth_rays(chosen, 3)
    with_points, without = (problem.batch_loss_and_gradient(batch, None, points)[1] for points in (drawn, None))
    return problem, drawn, {name: np.array(with_points[name], np.float64) - np.array(without[name]) for name in without}


def test_depth_gradient_of_a_fog_matches_a_closed_form(variant_rgb: str, sighted: list[Photo]) -> None:
    """A fog is even, so that the sum over all nodes is the derivative by its one density s: T = exp(-s l)."""
    problem, drawn, found = differentiate_depths(sighted)
    assert not found["harmonics"].any()
    ends, t = ends_of(drawn)
    o = np.array(drawn.rays.o).T.reshape(2, -1, 3)
    with np.errstate(divide="ignore"):
        planes = (BOX[:, None, None] - o) / ((ends - o) / t[..., None])
    inside = t - planes.min(axis=0).max(axis=-1)
    s = PLAN.start / problem.unit
    before, behind = np.exp(-s * inside)
    by_s = -(1 - OUTLIERS) * (-inside[0] * before + inside[1] * behind) / ((1 - OUTLIERS) * (before - behind) + OUTLIERS)
    # Sums of some thousand numbers of float32 of both signs.
    np.testing.assert_allclose(found["density"].sum(), 0.7 * by_s.mean(), rtol=1e-4)


def test_depth_gradient_belongs_to_its_nodes(variant_rgb: str, sighted: list[Photo]) -> None:
    """Along a density that grows with x, against differences of the energy of the same rays."""
    problem, drawn, found = differentiate_depths(sighted)
    reals, x = problem.initial_reals(), np.float32(problem.field.node_positions()[:, 0] - 0.5)

    def energy_at(step: float) -> float:
        problem.set_reals(reals | {"density": mi.Float(np.array(reals["density"]) + step * x)})
        cells, source = find_occupied_cells(problem.field), make_exact(problem.field, drawn.rays.d)
        return energy(np.array(render_rays(cells, source, make_model(problem.field), drawn.rays).T, float))

    small, large = ((energy_at(step) - energy_at(-step)) / (2 * step) for step in (0.05, 0.1))
    # Richardson takes 1.1 % off; what stays is of the order of its square. A node further along x would be 14 % off.
    np.testing.assert_allclose(found["density"] @ x, 0.7 * (4 * small - large) / 3, rtol=1e-3)


@pytest.mark.slow
def test_depth_supervision_moves_ray_ends_to_the_points(variant_rgb: str, photos: list[Photo]) -> None:
    """Three views, and points of the ball's surface that face them: more of the light of a ray comes from about its point."""
    rng, few = np.random.default_rng(4), []
    for photo in photos[:3]:
        own = rng.normal(size=(40, 3))
        own *= 0.6 / np.linalg.norm(own, axis=1, keepdims=True)
        few.append(replace(photo, points=own[own @ photo.camera.origin > 0.3]))
    ended = []
    for depth in (0.0, 0.01):
        plan = replace(PLAN, stages=PLAN.stages[:1], depth=depth)
        problem = fitted(RayBatches.from_photos(few, (2,)), plan).problem
        points, origins = problem.batches.points, problem.batches.origins
        drawn = sample_depth_rays(points, origins, BOX, 1, 2 / 12, np.random.default_rng(0))
        cells = find_occupied_cells(problem.field)
        T = np.array(render_rays(cells, make_exact(problem.field, drawn.rays.d), make_model(problem.field), drawn.rays).T)
        ended.append(np.mean(T[: drawn.count] - T[drawn.count :]))
    assert ended[1] > ended[0]


def test_points_change_only_fits_with_depth(one_thread: None, photos: list[Photo], sighted: list[Photo]) -> None:
    def slope(some: list[Photo], depth: float) -> np.ndarray:
        problem = RadianceProblem(RayBatches.from_photos(some, (1, 2)), BOX, replace(PLAN, depth=depth))
        return np.array(problem.loss_and_gradient(problem.initial_reals(), 0)[1]["density"])

    # Nothing is walked for a weight of 0.
    plain, asked = (RadianceProblem(RayBatches.from_photos(sighted, (1, 2)), BOX, replace(PLAN, depth=d)) for d in (0, 0.1))
    assert (
        plain._draw_depth_rays(np.arange(4), 0) is None and asked._draw_depth_rays(np.arange(4), 0).count == 4 * POINTS_PER_VIEW
    )
    without = slope(photos[:4], 0.1)
    np.testing.assert_array_equal(slope(sighted, 0.0), without)
    assert np.abs(slope(sighted, 0.1) - without).max() > 0
    digests = {RayBatches.from_photos(some, (1,)).digest() for some in (photos[:4], sighted)}
    assert len(digests) == 2
