"""Visibility caches, against Beer's law.

The weights of a visibility cache only guide the sampling of distances, so no weight biases an image; these tests check their
values.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import aimed, pencils, smoke, sun

from mivol.scene.needs import find_needs
from mivol.scene.plan import build_media, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.single_scattering.visibility_cache import (
    MIN_WEIGHT,
    RAY_FRACTION,
    VisibilityCache,
    build_visibility_cache,
)
from mivol.transport.path.estimators import Settings
from mivol.transport.traversal.grid_blocks import coarsen_grid
from scenes import centred

SIZE = (9, 14, 11)

TWO = centred(2 * np.eye(3))


@pytest.mark.parametrize("occupied", [None, 1.0])
@pytest.mark.parametrize("shift", [0, 1, 2, 3])
def test_weights_are_those_of_beer(shift, occupied):
    """In a constant grid, light from above is attenuated by the depth of a block's centre, for any size of blocks."""
    box, _ = smoke(np.full(SIZE, 0.8, np.float32), to_world=TWO)
    emitter, _ = sun([0, 0, -1.0])
    seen = pencils({"smoke": box, "emitter": emitter}, *aimed(3))
    with dr.suspend_grad():
        needs = find_needs(seen.scene, seen.scene.sensors()[0], survey_scene(seen.scene))
        settings = Settings(max_depth=2)
        media = build_media(seen.scene, needs, make_plan(needs, settings), survey_scene(seen.scene))
        blocks = np.array([(n >> shift) + 1 for n in SIZE])
        # As many rays as ask for this lattice and for none that is finer.
        shade = build_visibility_cache(
            media, SceneEmitters(seen.scene), int(np.ceil(1.001 * blocks.prod() / RAY_FRACTION)), occupied, coarsen_grid
        )
    assert shade.blocks == tuple(blocks)
    middle = ((np.arange(blocks[0]) << shift) + 0.5 * (1 << shift) - 0.5) / SIZE[0]
    depth = 2 * (1 - np.clip(middle, 0.25 / SIZE[0], 1 - 0.25 / SIZE[0]))
    weights = np.array(shade.weights).reshape(blocks)
    # The box is 2 high; the optical depth is known to 2e-6 of itself, and float32 adds a few roundings.
    np.testing.assert_allclose(weights, np.broadcast_to((np.exp(-0.8 * depth) + MIN_WEIGHT)[:, None, None], blocks), rtol=1e-5)


@pytest.mark.parametrize("shift", [0, 1, 2])
def test_a_cell_has_the_weight_of_its_block(shift):
    """Cells begin at a lower node of -1, in the order z, y, x; each lane has its own of two emitters."""
    blocks = tuple((n >> shift) + 1 for n in SIZE)
    weights = np.random.default_rng(shift).random((*blocks, 2), dtype=np.float32)
    cache = VisibilityCache(mi.Float(weights.ravel()), blocks, shift, 2)
    lower = np.stack(np.meshgrid(*(np.arange(-1, n) for n in SIZE), indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(lower)) % 2
    found = cache.at(mi.Vector3i(*lower[:, ::-1].T), mi.UInt32(number), mi.Bool(True))
    z, y, x = (lower.T + 1) >> shift
    assert np.array_equal(np.array(found), weights[z, y, x, number])
