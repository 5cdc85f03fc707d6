"""Visibility caches and transmittance grids, against Beer's law.

The weights of a visibility cache only guide the sampling of distances, so no weight biases an image; these tests check their
values.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import aimed, close_up, mivol, pencils, rough_grid, smoke, sun

from mivol.experiments.script import explain
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_estimators, build_media, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.single_scattering.shadow_tables import (
    MIN_WEIGHT,
    RAY_FRACTION,
    TransmittanceGrid,
    VisibilityCache,
    build_transmittance_grid,
    build_visibility_cache,
    measure_transmittance_bias,
)
from mivol.transport.path.estimators import Settings
from mivol.transport.traversal.grid_blocks import coarsen_grid
from mivol.transport.traversal.lattice import Lattice
from scenes import centred

pytestmark = pytest.mark.usefixtures("variant_rgb")

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


def open_direct(scene: mi.Scene):
    survey, settings = survey_scene(scene), Settings(max_depth=2)
    needs = find_needs(scene, scene.sensors()[0], survey)
    return build_estimators(scene, needs, make_plan(needs, settings), settings, survey, for_images=True).direct


@pytest.mark.slow
def test_light_grid_against_exact_shadows():
    """The error of tau between nodes is h^2: two nodes a cell have at most a quarter of the error of one node in two cells."""
    box, _ = smoke(rough_grid(1, shape=(16, 16, 16)))
    emitter, _ = sun([0.3, 0.2, -1.0])
    scene = close_up({"smoke": box, "emitter": emitter})
    direct = open_direct(scene)
    with dr.suspend_grad():
        grids = (build_transmittance_grid(direct.media, direct.emitters, cells) for cells in (4, 1))
        coarse, fine = (measure_transmittance_bias(direct.media, direct.emitters, grid)[1] for grid in grids)
    assert 0 < fine < 0.5 * coarse < 0.25
    exact, looked_up = (
        np.array(mi.render(scene, integrator=mi.load_dict(mivol(deterministic=True, shadows=s)), spp=16))
        for s in ("exact", "grid")
    )
    # The image is an integral of the same transmittances: it cannot be off by more than some of their rms errors.
    assert 0 < np.abs(exact - looked_up).mean() <= 4 * fine * exact.mean()


@pytest.mark.parametrize(("cells", "nodes"), [(1, (9, 6, 2)), (4, (3, 3, 2)), (3, (4, 3, 2))])
def test_nodes_of_a_light_grid_are_so_many_cells_apart(cells, nodes):
    """At most ``cells`` apart, with nodes in both faces: n cells have ceil(n / cells) steps, and one node more."""
    box, _ = smoke(rough_grid(1, shape=(8, 5, 1)))
    scene = close_up({"smoke": box, "emitter": sun([0.3, 0.2, -1.0])[0]})
    with dr.suspend_grad():
        direct = open_direct(scene)
        assert build_transmittance_grid(direct.media, direct.emitters, cells).nodes == nodes


def test_light_grid_keeps_optical_depth_not_transmittance():
    """Under suns along the axes, tau of a constant grid is linear, and interpolated exactly; T would be 8 % too bright."""
    box, _ = smoke(np.full((4, 3, 5), 2.0, np.float32), to_world=centred(2 * np.eye(3)))
    suns = {f"sun {axis}": sun(-np.eye(3)[axis])[0] for axis in range(3)}
    scene = close_up({"smoke": box, **suns})
    with dr.suspend_grad():
        direct = open_direct(scene)
        grid = build_transmittance_grid(direct.media, direct.emitters)
        bias, rms = measure_transmittance_bias(direct.media, direct.emitters, grid)
    # Nodes in the faces look from 1e-5 of the box inside, where tau is up to 4e-5 off.
    assert abs(bias) <= rms <= 1e-4
    nodes = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 4, 6)), indexing="ij"), axis=-1)
    np.testing.assert_allclose(np.array(grid.tau).reshape(5, 4, 6, 3), 2 * 2 * (1 - nodes[..., ::-1]), atol=5e-5)


def test_a_point_has_the_light_of_its_place():
    """An optical depth linear in x, y and z, for each of two emitters and three channels, at points of a rotated box."""
    to_world = np.array([[2.0, 0.3, 0, -1], [-0.2, 1.5, 0.1, 0.4], [0, 0.1, 3, 2], [0, 0, 0, 1]])
    lattice = Lattice(mi.TensorXf(np.zeros((5, 4, 2, 1), np.float32)), to_world)
    shape, rng = (3, 5, 4), np.random.default_rng(2)
    slope, level = rng.uniform(0, 1, (2, 3, 3)), rng.uniform(0, 1, (2, 3))
    nodes = np.stack(np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij"), axis=-1)[..., ::-1]
    tau = np.einsum("zyxa,eca->zyxec", nodes, slope) + level
    grid = TransmittanceGrid(mi.Float(tau.ravel()), shape, lattice, 2, 3)
    u, number = rng.random((200, 3)), np.arange(200) % 2
    p = u @ to_world[:3, :3].T + to_world[:3, 3]
    found = np.array(grid.transmittance(mi.Point3f(*p.T), mi.UInt32(number), mi.Bool(True)))
    # Places of float32, 1e-6 of the box, and depths of 4 at most.
    np.testing.assert_allclose(-np.log(found.T), np.einsum("na,nca->nc", u, slope[number]) + level[number], atol=2e-5)


def test_explain_measures_the_light_grid():
    box, _ = smoke(rough_grid(1))
    emitter, _ = sun([0.3, 0.2, -1.0])
    text = explain(close_up({"smoke": box, "emitter": emitter}), max_depth=2)
    assert "exact; with deterministic, a light grid" in text and "bias" in text
