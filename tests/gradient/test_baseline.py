"""The baseline of flights: its sums and means against NumPy in float64, its blocks against the cells of a grid, and gradients
that do not depend on it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean, fresh
from scattering_gradients import along, upper_half
from scattering_scenes import PLACE, close_up, mivol, rough_grid, sun

from mivol.transport.estimators.flights.baseline import (
    BLOCKS,
    DEPENDENCE,
    PARTS,
    Baseline,
    BaselineSums,
    DirectLightTable,
    MediumBlocks,
)
from mivol.transport.media.body import Body
from mivol.transport.media.extinction import ConstantExtinction
from mivol.transport.media.grid_extinction import GridExtinction
from mivol.transport.media.medium_view import MediumView
from mivol.transport.traversal.box import Box
from mivol.transport.traversal.lattice import Lattice
from scenes import box_of, grid_volume, medium, sky

DENSITY = "smoke.interior_medium.sigma_t.data"


def smoky() -> mi.Scene:
    interior = medium("mivol_medium", grid_volume("mivol_voxels", rough_grid(4, 3.0), PLACE), 0.8)
    return close_up({"smoke": box_of(interior, PLACE), "sun": sun([0.3, 0.2, -1.0])[0], "lit": sky(0.2)}, res=8)


def grid_body(res: tuple[int, int, int]) -> Body:
    lattice = Lattice(mi.TensorXf(np.ones((*res, 1), np.float32)), PLACE)
    return Body(MediumView(None, [GridExtinction("sigma_t", lattice)], mi.Float(1)), Box(PLACE))


def even_body() -> Body:
    return Body(MediumView(None, [ConstantExtinction("sigma_t", mi.Float(1))], mi.Float(1)), Box(PLACE))


class Scene:
    """The media of a scene, as the sums of a baseline see them."""

    def __init__(self, *bodies: Body) -> None:
        self.bodies = list(bodies)

    def bodies_at(self, index: mi.UInt32, on: mi.Bool) -> list[tuple[Body, mi.Bool]]:
        return [(body, on & (index == k)) for k, body in enumerate(self.bodies)]


def shrink(cell: np.ndarray, w: np.ndarray, L: np.ndarray, count: int) -> tuple[np.ndarray, float, float]:
    """The means of blocks drawn to the mean of all, that mean, and the noise, in float64."""
    W, S, Q = (np.bincount(cell, v, count) for v in (w, w * L, w * L**2))
    mean, filled = S.sum() / W.sum(), W > 0
    own = np.where(filled, S / np.where(filled, W, 1), mean)
    inside = (Q - S * own).sum() / W.sum() * len(w) / (len(w) - filled.sum())
    spread = (W * (own - mean) ** 2).sum() / W.sum()
    between = max(spread - DEPENDENCE * inside * filled.sum() / len(w), 0)
    informs = W / W.sum() * len(w) * between
    values = mean + informs / (informs + DEPENDENCE * inside) * (own - mean)
    return values, mean, (w * (L - values[cell]) ** 2).sum() / Q.sum()


@pytest.mark.parametrize("differs", [True, False])
def test_blocks_are_drawn_to_the_mean_of_all(differs: bool) -> None:
    """Collisions of two media, against NumPy; blocks without a difference beyond their noise have the mean of all."""
    rng = np.random.default_rng(fresh(3))
    body, x = rng.integers(0, 2, 4000), rng.uniform(-1, 1, (3, 4000))
    w, L = rng.uniform(0.5, 2, 4000), rng.exponential(1, 4000)
    if differs:
        L = L * (1 + 3 * (x[2] > 0.5)) + 2 * body
    sums = BaselineSums(Scene(grid_body((4, 7, 9)), even_body()))
    ray = mi.Ray3f(mi.Point3f([mi.Float(v) for v in x]), mi.Vector3f(0, 0, 1))
    index, zero, on = mi.UInt32(body.astype(np.uint32)), dr.zeros(mi.Float64, 4000), dr.full(mi.Bool, True, 4000)
    sums.add(ray, zero, index, mi.Spectrum(mi.Float(w)), mi.Spectrum(mi.Float(L)), on)
    found = sums.finish()
    blocks = [np.array(own.at_point(ray, zero, on)) for own in sums.blocks]
    values, mean, noise = shrink(np.where(body == 0, *blocks), w, L, 2 * BLOCKS**3)
    # Sums of 4000 float32 numbers; the variance inside a block is a difference of such sums.
    np.testing.assert_allclose(np.array(found.values).reshape(3, -1), np.tile(values, (3, 1)), rtol=2e-4)
    np.testing.assert_allclose(np.array(found.mean), mean, rtol=1e-5)
    assert found.noise[0] == pytest.approx(noise, rel=1e-4)
    assert (np.ptp(values) > 1) == differs


def find_slope(cell: np.ndarray, w: np.ndarray, L: np.ndarray, D: np.ndarray, count: int) -> float:
    """The slope of L on D inside of cells, by weighted least squares, drawn to 0, in float64."""
    total = np.bincount(cell, w, count)
    own = np.where(total > 0, total, 1)
    L, D = (x - (np.bincount(cell, w * x, count) / own)[cell] for x in (L, D))
    slope = (w * L * D).sum() / (w * D**2).sum()
    noise = DEPENDENCE * (w * (L - slope * D) ** 2).sum() / (len(w) - (total > 0).sum())
    return slope * max(1 - noise / (slope**2 * (w * D**2).sum()), 0)


@pytest.mark.parametrize("answers", [True, False])
def test_the_baseline_follows_the_direct_light(answers: bool) -> None:
    """Collisions whose light follows the direct light of their parts, or not, in a grid beside a medium without parts, against
    NumPy.
    """
    rng = np.random.default_rng(fresh(8))
    n, count = 4000, 2 * BLOCKS**3
    body, x = rng.integers(0, 2, n), rng.uniform(-1, 1, (3, n))
    w, L = rng.uniform(0.5, 2, n), rng.exponential(1, n)
    scene = Scene(grid_body((4, 7, 9)), even_body())
    blocks = MediumBlocks.of(scene, has_parts=True)
    assert [own.parts for own in blocks] == [PARTS, 1] and blocks[1].first == (BLOCKS * PARTS) ** 3
    values = np.concatenate([rng.uniform(0, 3, blocks[1].first), np.zeros(blocks[1].count)])
    ray = mi.Ray3f(mi.Point3f([mi.Float(v) for v in x]), mi.Vector3f(0, 0, 1))
    zero, on = dr.zeros(mi.Float64, n), dr.full(mi.Bool, True, n)
    part = np.where(body == 0, *(np.array(own.at_point(ray, zero, on)) for own in blocks))
    cell = np.where(body == 0, *(np.array(own.block_of(own.at_point(ray, zero, on))) for own in blocks))
    plain = [np.array(own.at_point(ray, zero, on)) for own in MediumBlocks.of(scene)]
    assert np.array_equal(cell, np.where(body == 0, *plain))
    L = L + (2 * values[part] + 3 * (x[2] > 0.5) if answers else 0)
    sums = BaselineSums(scene, DirectLightTable(blocks, mi.Float(np.tile(values, 3))))
    sums.add(ray, zero, mi.UInt32(body), mi.Spectrum(mi.Float(w)), mi.Spectrum(mi.Float(L)), on)
    found = sums.finish()
    slope = find_slope(cell, w, L, values[part], count)
    rest, _, noise = shrink(cell, w, L - slope * values[part], count)
    of_part = np.concatenate([np.array(own.block_of(own.first + dr.arange(mi.UInt32, own.count))) for own in blocks])
    # As without a table; the slope is a ratio of differences of sums too.
    expected = np.tile(rest[of_part] + slope * values, 3)
    np.testing.assert_allclose(np.array(found.values), expected, rtol=1e-3)
    np.testing.assert_allclose([np.array(row)[0] for row in found.average], (w * L).sum() / w.sum(), rtol=1e-5)
    left = (w * (L - slope * values[part]) ** 2).sum() / (w * L**2).sum()
    assert found.noise[0] == pytest.approx(noise * left, rel=1e-3)
    assert (slope > 1.9) == answers and abs(slope) < 2.1


@pytest.mark.parametrize("has_parts", [False, True])
def test_a_walk_and_a_collision_read_the_same_block(has_parts: bool) -> None:
    """Every point in a cell of a grid has the block of the cell, and the blocks or parts divide the grid into equal parts."""
    body = grid_body((12, 18, 6)) if not has_parts else grid_body((72, 108, 36))
    (blocks,) = MediumBlocks.of(Scene(body), has_parts)
    nodes = blocks.lattice.res[::-1]
    lower = np.stack(np.meshgrid(*(np.arange(-1, n) for n in nodes), indexing="ij")).reshape(3, -1)
    inside = np.random.default_rng(fresh(5)).uniform(0.01, 0.99, lower.shape)
    unit = (lower + inside + 0.5) / np.array(nodes)[:, None]
    kept = np.all((unit > 0) & (unit < 1), axis=0)
    lower, world = lower[:, kept], (2 * unit[:, kept] - 1).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f([mi.Float(v) for v in world]), mi.Vector3f(0, 0, 1))
    at = np.array(blocks.at_point(ray, dr.zeros(mi.Float64, lower.shape[1]), dr.full(mi.Bool, True, lower.shape[1])))
    assert np.array_equal(at, np.array(blocks.at_node(mi.Vector3i([mi.Int32(v) for v in lower]))))
    assert len(np.unique(at)) == (BLOCKS * (PARTS if has_parts else 1)) ** 3


def test_a_medium_without_a_grid_has_the_block_where_a_flight_enters_its_box() -> None:
    _, second = MediumBlocks.of(Scene(grid_body((4, 4, 4)), even_body()))
    ray = mi.Ray3f(mi.Point3f([0.9, 0.9, 0.9], [0, 0, 0.5], [-5, 0.99, 7]), mi.Vector3f(0, 0, 1))
    x, y = BLOCKS - 1, BLOCKS // 2
    expected = [(0 * BLOCKS + y) * BLOCKS + x, (x * BLOCKS + y) * BLOCKS + x]
    found = np.array(second.of_flight(ray)) - BLOCKS**3
    assert second.first == BLOCKS**3 and found[:2].tolist() == expected
    assert 0 <= found[2] < BLOCKS**3  # the ray misses the box


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("density", [1.0, 0.0], ids=["smoke", "empty"])
def test_any_baseline_keeps_the_mean(density: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients with a baseline of random values, up to twice the light, equal those without a baseline."""
    scene, integrator = smoky(), mi.load_dict(mivol(max_depth=4, rr_depth=3))
    params = mi.traverse(scene)
    params[DENSITY] = density * params[DENSITY]
    params.update()
    v = upper_half(scene, DENSITY)
    read, size = Baseline._read, 3 * (BLOCKS * PARTS) ** 3
    noise, zero = mi.Float(np.random.default_rng(9).uniform(-2, 2, size)), dr.zeros(mi.Float, size)
    monkeypatch.setattr(Baseline, "_read", lambda self, block, on: read(_of(noise, self), block, on))
    found = along(scene, DENSITY, v, integrator, 512)
    monkeypatch.setattr(Baseline, "_read", lambda self, block, on: read(_of(zero, self), block, on))
    plain = along(scene, DENSITY, v, integrator, 512)
    assert_same_mean(found, plain, rounding=1e-4 * np.abs(plain.mean), what="derivative")


def _of(values: mi.Float, baseline: Baseline) -> Baseline:
    return Baseline(baseline.blocks, values, baseline.count, baseline.mean, baseline.repeats, baseline.noise)
