"""Gradients under a constant sky, with a constant control variate."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, fresh
from scattering_gradients import (
    BATCHES,
    DENSITIES,
    GRID,
    vjp,
)
from scattering_scenes import PLACE, aimed, fog, mivol, pencils, rough_grid

import scenes
from mivol.validate.moments import Moments
from scenes import as_float32, box_of, centred, grid_volume, medium

pytestmark = pytest.mark.usefixtures("variant_rgb")


WHITE = {
    "a box": lambda interior: {"smoke": box_of(interior, PLACE)},
    "a ball": lambda interior: {"smoke": scenes.ball_of(interior, (0, 0, 0), 1.2)},
    "two boxes": lambda interior: {"smoke": box_of(interior, PLACE), "fog": fog(0.0, 1.0, centred(np.eye(3), (0, 0, 1.6)))[0]},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "place"),
    small.cases([("stock", "a box"), *(("own", place) for place in WHITE)], [("own", "a box"), ("own", "two boxes")]),
)
def test_white_smoke_of_no_density_in_a_constant_sky_has_no_gradient(kind, place):
    """In-scattering equals out-scattering: 0 in each sample, up to the rounding of the two (a few EPS of their size)."""
    gradients = []
    for albedo in (0.0, 1.0):
        medium_type, volume_type = small.KINDS[kind]
        interior = medium(medium_type, grid_volume(volume_type, as_float32(DENSITIES["empty"]()), PLACE), albedo)
        seen = pencils({**WHITE[place](interior), "sky": scenes.sky(0.7)}, *aimed(1, 8))
        integrator = mi.load_dict(mivol())
        gradients.append([vjp(seen.scene, GRID, np.ones((1, 8, 3)), 1, seed, integrator) for seed in range(8)])
    black, white = (np.abs(g).max() for g in gradients)
    assert black > 0.1
    assert white <= 4e-6 * black


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("alone", [True, False])
def test_a_ball_under_a_constant_sky(alone):
    """Density in a traced boundary, alone and behind a box shading it, against differences."""
    interior = medium("mivol_medium", grid_volume("mivol_voxels", 0.2 + rough_grid(1), PLACE), 0.8)
    parts = {"smoke": scenes.ball_of(interior, (0, 0, 0), 1.0), "sky": scenes.sky(0.7)}
    if not alone:
        parts["fog"] = fog(0.8, 0.3, centred(np.eye(3), (0.9, -0.9, 1.3)))[0]
    scene, integrator, w = small.close_up(parts, res=8), mi.load_dict(mivol()), np.ones((8, 8, 3))
    params = mi.traverse(scene)
    start, h = np.array(params[GRID]), 0.02
    v = np.random.default_rng(2).uniform(0.2, 1, start.shape)

    def at(x: float, seed: int) -> float:
        params[GRID] = mi.TensorXf((start + x * v).astype(np.float32))
        params.update()
        return np.array(integrator.render(scene, seed=seed, spp=256), dtype=np.float64).sum()

    seeds = [fresh(s) for s in range(BATCHES)]
    differences = np.array([(at(h, s) - at(-h, s)) / (2 * h) for s in seeds])
    at(0, 0)
    found = np.array([np.sum(v * vjp(scene, GRID, w, 256, s, integrator)) for s in seeds])
    m, level = Moments.of((differences - found)[:, None]), abs(differences.mean())
    # Truncation as below.
    assert_same_mean(m, rounding=2e-3 * level, what="ball")
    assert_precise(m, 0.02 * level, what="ball")
