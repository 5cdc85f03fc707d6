"""Weights of a visibility cache, against Beer's law.

No weight can bias an image, since weights only guide the sampling of distances; here it is tested that they are right.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
from scattering_scenes import aimed, pencils, smoke, sun

from mivol.scene.build import build_media
from mivol.scene.needs import find_needs
from mivol.scene.plan import make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.emitters import SceneEmitters
from mivol.transport.estimators.visibility_cache import FLOOR, RAY_FRACTION, build_visibility_cache
from mivol.transport.path.settings import Settings
from mivol.transport.traversal.coarse_grid import coarsen_grid
from scenes import centred

pytestmark = pytest.mark.usefixtures("variant_rgb")

SIZE = (9, 14, 11)

TWO = centred(2 * np.eye(3))


@pytest.mark.parametrize("occupied", [None, 1.0])
@pytest.mark.parametrize("shift", [0, 1, 2, 3])
def test_weights_are_those_of_beer(shift, occupied):
    """In a grid of one value light from above is dimmed by the depth of a block's middle, however coarse the grid."""
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
    np.testing.assert_allclose(weights, np.broadcast_to((np.exp(-0.8 * depth) + FLOOR)[:, None, None], blocks), rtol=1e-5)
