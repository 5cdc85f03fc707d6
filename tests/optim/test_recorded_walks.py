"""Walks that are recorded once give what walks give that are traced each time."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import BOX, PLAN, ball

from mivol.optim.radiance_problem import RadianceProblem
from mivol.optim.ray_batches import RayBatch, RayBatches
from mivol.photos import Photo
from mivol.transport.line_integrals.radiance_field import RayBundle, RayGradient, backward, model_of, render
from mivol.transport.line_integrals.radiance_source import bake, fold


def traced(problem: RadianceProblem, batch: RayBatch) -> list[np.ndarray]:
    """Squared errors over white and derivatives of their mean, of walks that are traced now."""
    cells, model, before = problem._cells, model_of(problem.field, problem.plan.stop), mi.Color3f(1)
    source = bake(problem.field, cells, batch.origins, batch.slot, slope=True)
    seen = render(cells, source, model, RayBundle(batch.rays.o, batch.rays.d))
    error = seen.colour + seen.T * before - batch.target
    by = error * (2 / (3 * dr.width(batch.slot)))
    loss, through = dr.squared_norm(error) * (1 / 3), dr.dot(by, before)
    dr.eval(seen, loss, by, through)
    backward(cells, source, model, seen, RayGradient(by, through))
    slopes = fold(problem.field, cells, source, batch.origins)
    return [np.array(a) for a in (loss, *map(problem._stored, slopes))]


@pytest.mark.parametrize("sparse", [False, True])
def test_recorded_walks_are_the_walks(one_thread, photos: list[Photo], sparse: bool) -> None:
    """To the last bit with one thread: of other values, other pinholes, other numbers of both and of rays, and other cells."""
    problem, rng = RadianceProblem(RayBatches.of(photos, (1, 2)), BOX, PLAN), np.random.default_rng(5)

    def check(views: list[int], tiles: int) -> None:
        batch = problem.batches.draw(2, np.array(views), tiles, rng)
        loss, slopes = problem.slopes(batch)
        expected = traced(problem, batch)
        for a, b in zip((loss, slopes["density"], slopes["harmonics"]), expected, strict=True):
            np.testing.assert_array_equal(np.array(a), b)
        assert np.count_nonzero(expected[1]) > 50

    problem.field = ball(12)
    if sparse:
        problem.field = problem.field.sparse(np.array(problem.field.density).reshape(12, 12, 12) > -20)
    problem.update_occupancy()
    check([0, 1, 2], 30)
    check([3, 5, 6], 30)
    problem.field = problem.field.with_values(problem.field.density * 0.5, problem.field.harmonics * 0.7)
    check([1, 2, 4], 30)
    check([2, 6], 45)
    check([1, 2, 3, 4], 30)
    problem.field = problem.field.with_values(problem.field.density + 5, problem.field.harmonics)
    problem.update_occupancy()
    check([0, 1, 2, 6], 30)
