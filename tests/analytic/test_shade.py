"""Where lamps shine, from blocks of a grid: means and lists against NumPy, weights against Beer's law.

None of it can bias an image: weights only tell where to look. What is held here is that they tell the truth.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
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
from mivol.transport.traversal.empty_blocks import find_empty_distances
from scenes import centred, make_lattice

pytestmark = pytest.mark.usefixtures("variant_rgb")

SIZE = (9, 14, 11)

TWO = centred(2 * np.eye(3))


def sparse(channels: int) -> np.ndarray:
    """A grid with few voxels that are not 0, one of them in a corner."""
    rng = np.random.default_rng(3)
    values = np.where(rng.uniform(size=(*SIZE, channels)) < 4e-3, rng.uniform(0.1, 1, (*SIZE, channels)), 0)
    values[-1, -1, -1] = 0.5
    return values.astype(np.float32)


@pytest.mark.parametrize("shift", [0, 1, 2, 3])
@pytest.mark.parametrize("channels", [1, 3])
def test_coarse_grids_are_means_in_their_place(channels, shift):
    values, edge = sparse(channels), 1 << shift
    coarse = coarsen_grid(make_lattice(mi.TensorXf(values), TWO), shift, True)
    sizes = [-(-n // edge) for n in SIZE]
    index = [np.minimum(np.arange(m * edge), n - 1) for m, n in zip(sizes, SIZE, strict=True)]
    means = values[np.ix_(*index)].reshape(sizes[0], edge, sizes[1], edge, sizes[2], edge, channels).mean((1, 3, 5), np.float64)
    # Sums of 2^(3 shift) numbers of one sign, axis by axis: 3 (2^shift + 1) roundings of 2^-24.
    np.testing.assert_allclose(np.array(coarse.lattice.values), means, rtol=3 * (edge + 1) * 2.0**-24)
    # A voxel is as wide as 2^shift: the far corner of the coarse grid is further out by what was repeated.
    far = TWO @ [*(edge * m / n for m, n in zip(sizes[::-1], SIZE[::-1], strict=True)), 1]
    np.testing.assert_allclose(coarse.lattice.to_world @ np.ones(4), far, rtol=1e-12)


@pytest.mark.parametrize("skip", [False, True])
def test_coarse_grids_skip_what_is_empty_where_the_fine_one_does(skip):
    coarse = coarsen_grid(make_lattice(mi.TensorXf(sparse(1)), TWO, skip), 1, False).lattice
    assert (coarse.empty_distances is not None) == skip
    if skip:
        assert np.array_equal(np.array(coarse.empty_distances), np.array(find_empty_distances(coarse.values)))


@pytest.mark.parametrize("shift", [0, 1, 2, 3])
def test_blocks_that_hold_anything_are_listed(shift):
    """Every block with a node that is not 0; none that is further than a block from one."""
    values, edge = sparse(1)[..., 0], 1 << shift
    held = np.array(coarsen_grid(make_lattice(mi.TensorXf(values[..., None]), TWO), shift, True).held)
    blocks = [(n >> shift) + 1 for n in SIZE]
    nodes = [np.clip(np.arange(b * edge + 1)[None] - 1, 0, n - 1)[0] for b, n in zip(blocks, SIZE, strict=True)]
    padded = values[np.ix_(*nodes)] > 0
    own, wide = np.zeros(blocks, bool), np.zeros(blocks, bool)
    for at in np.ndindex(*blocks):
        own[at] = padded[tuple(slice(b * edge, (b + 1) * edge + 1) for b in at)].any()
        wide[at] = padded[tuple(slice(max(b * edge - edge, 0), (b + 2) * edge + 1) for b in at)].any()
    listed = np.zeros(blocks, bool)
    listed.ravel()[held] = True
    assert np.all(listed[own])
    assert not np.any(listed[~wide])
    assert 0 < own.sum() < own.size


@pytest.mark.parametrize("occupied", [None, 1.0])
@pytest.mark.parametrize("shift", [0, 1, 2, 3])
def test_weights_are_those_of_beer(shift, occupied):
    """In a grid of one value light from above is dimmed by the depth of a block's middle, however coarse the grid."""
    box, _ = smoke(np.full(SIZE, 0.8, np.float32), to_world=TWO)
    lamp, _ = sun([0, 0, -1.0])
    seen = pencils({"smoke": box, "lamp": lamp}, *aimed(3))
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
