"""The table of emitted power: densities of points and of directions, against sums over its cells."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean
from media_light_scenes import PLACE, seen
from scattering_scenes import close_up

from mivol.scene.media_light import _estimate_variances, find_emitting_boxes
from mivol.scene.needs import find_needs
from mivol.transport.estimators.lighting.emission_sampling import (
    CELLS_PER_AXIS,
    UNIFORM_SHARE,
    EmissionTable,
    tabulate_emission,
)
from mivol.transport.media.body import Body
from mivol.transport.media.scene_media import SceneMedia
from mivol.validate.statistics import Moments
from scenes import affine, box_of, grid_volume, medium

N = 1 << 14


def table_of(scene: mi.Scene) -> EmissionTable:
    needs = find_needs(scene, scene.sensors()[0])
    bodies = [Body(view, boundary.box) for boundary, view in zip(needs.boundaries, needs.views, strict=True)]
    media = SceneMedia(scene, bodies, has_surfaces=False)
    return tabulate_emission(find_emitting_boxes(media, needs.boundaries), media.channels)


def numbers(n: int, count: int, seed: int) -> list[mi.Float]:
    return [mi.Float(row.astype(np.float32)) for row in np.random.default_rng(seed).uniform(0, 1, (count, n))]


def two() -> mi.Scene:
    """A fire, and a box of constants of another size beside it, a third as bright in every cell."""
    far = affine(np.diag([0.5, 0.5, 0.25]), [1.0, 0.2, 0.1])
    low = medium("mivol_medium", 0.5, 0.0, emission={"type": "rgb", "value": [2.0, 1.0, 0.0]})
    values = np.ones((2, 2, 2, 1), np.float32)
    high = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.25, emission=6.0)
    return close_up({"a": box_of(high, PLACE), "b": box_of(low, far)}, res=4)


def order(table: EmissionTable) -> list[int]:
    """The order of the two boxes: Mitsuba orders shapes as it likes."""
    return [0 if box.box.to_world[0, 0] > 0.6 else 1 for box in table.boxes]


def test_cells_have_their_share_of_the_power() -> None:
    """sigma_t (1 - albedo) Le times the volume of a cell, and the uniform share."""
    table = table_of(two())
    which = order(table)
    power = np.repeat(np.array([1 * 0.75 * 18 * 0.7 * 0.5 * 0.8, 0.5 * 3 * 0.5 * 0.5 * 0.25])[which], CELLS_PER_AXIS**3)
    share = (1 - UNIFORM_SHARE) * power / power.sum() + UNIFORM_SHARE / power.size
    volume = np.repeat(np.array([0.7 * 0.5 * 0.8, 0.5 * 0.5 * 0.25])[which], CELLS_PER_AXIS**3) / CELLS_PER_AXIS**3
    assert np.array(table.density) == pytest.approx(share / volume, rel=1e-4)
    assert np.array(table.cumulative) == pytest.approx(np.cumsum(share), rel=1e-4)
    # Sums in float32 are off by a part of a cell's probability; each cell is drawn as often as its density says.
    drawn = np.diff(np.array(table.cumulative), prepend=0)
    assert drawn == pytest.approx(np.array(table.density) * volume, rel=1e-6)


def test_a_surface_meets_no_light_behind_itself() -> None:
    """The variance of light that is met by chance, on a floor below both boxes that looks up, and down."""
    table, place = table_of(two()), mi.Point3f(0.1, 0.1, -0.7)
    up, down = (_estimate_variances(table, place, mi.Vector3f(0, 0, z), mi.Bool(True))[0] for z in (1, -1))
    assert up > 0 and down == 0


def test_cells_are_told_apart_below_the_digits_of_a_number() -> None:
    """A number has steps of 2^-23 = 1.2e-7, of which the uniform share of a cell of two boxes has 13."""
    table = table_of(two())
    edge = np.array(table.cumulative)[len(table.cumulative) // 2]
    u, beyond = np.divmod(edge * 2.0**23, 1)
    middle = [mi.Float(0.5, 0.5)] * 3
    p = np.array(table.sample_point(mi.Float(u * 2.0**-23), [*middle, mi.Float(0.9 * beyond, min(1.1 * beyond, 0.9999))])).T
    assert np.abs(p[0] - p[1]).max() > 1e-3


def test_where_nothing_emits_all_is_even() -> None:
    scene = close_up({"box": box_of(medium("mivol_medium", 0.0, 0.0, emission=6.0), PLACE)}, res=4)
    assert np.array(table_of(scene).density) == pytest.approx(1 / (0.7 * 0.5 * 0.8), rel=1e-5)


@pytest.mark.statistical
def test_points_are_drawn_with_their_density() -> None:
    """The mean of x^k / density over all points is the integral over the boxes."""
    table = table_of(two())
    u, *inside = numbers(N, 5, 1)
    p = np.array(table.sample_point(u, inside)).T
    near = p[:, 0] < 0.5
    box = np.where(near, 0, 1)
    low, size = np.array([[-0.3, -0.2, -0.5], [1.0, 0.2, 0.1]])[box], np.array([[0.7, 0.5, 0.8], [0.5, 0.5, 0.25]])[box]
    q = (p - low) / size
    assert (q > -1e-5).all() and (q < 1 + 1e-5).all()
    cell = np.clip(np.floor(q * CELLS_PER_AXIS).astype(int), 0, CELLS_PER_AXIS - 1)
    number = np.argsort(order(table))[box]
    density = np.array(table.density)[
        number * CELLS_PER_AXIS**3 + (cell[:, 2] * CELLS_PER_AXIS + cell[:, 1]) * CELLS_PER_AXIS + cell[:, 0]
    ]
    found = np.stack([near / density, ~near / density, near * q[:, 0] / density, near * q[:, 1] * q[:, 2] / density], axis=1)
    truth = [0.28, 0.0625, 0.14, 0.07]
    assert_same_mean(Moments.from_values(found), np.array(truth), rounding=1e-5, what="integrals")


@pytest.mark.statistical
def test_dark_cells_are_seldom_drawn() -> None:
    """The same for a fire with different cells."""
    table = table_of(seen("over a floor", res=4))
    u, *inside = numbers(N, 5, 4)
    q = (np.array(table.sample_point(u, inside)).T - PLACE[:3, 3]) / np.diag(PLACE)[:3]
    cell = np.clip(np.floor(q * CELLS_PER_AXIS).astype(int), 0, CELLS_PER_AXIS - 1)
    each = np.array(table.density)[(cell[:, 2] * CELLS_PER_AXIS + cell[:, 1]) * CELLS_PER_AXIS + cell[:, 0]].astype(np.float64)
    assert_same_mean(
        Moments.from_values(np.stack([1 / each, q[:, 0] / each], axis=1)), [0.28, 0.14], rounding=1e-4, what="integrals"
    )


@pytest.mark.parametrize("origin", [(0.1, 0.05, -0.1), (-2.0, 0.3, 0.4)], ids=["inside", "outside"])
@pytest.mark.statistical
def test_the_density_of_directions_integrates_to_one(origin: tuple) -> None:
    """The density integrates to 1 over the sphere, and each sampled direction has a density."""
    table = table_of(seen("over a floor", res=4))
    o = mi.Point3f(*origin) + dr.zeros(mi.Point3f, N)
    u, v, w, *rest = numbers(N, 7, 2)
    pdf = np.array(
        table.integrate_density(o, mi.warp.square_to_uniform_sphere(mi.Point2f(u, v)), dr.full(mi.Bool, True, N)).pdf
    )
    assert_same_mean(Moments.from_values(4 * np.pi * pdf[:, None].astype(np.float64)), np.ones(1), what="integral")
    d = dr.normalize(table.sample_point(w, rest) - o)
    assert (np.array(table.integrate_density(o, d, dr.full(mi.Bool, True, N)).pdf) > 0).all()


@pytest.mark.statistical
def test_points_of_a_ray_are_drawn_with_their_density() -> None:
    """The mean of t^k / density is the integral of t^k over the ray's intervals in both boxes; ``light`` sums the table along
    the ray."""
    table = table_of(two())
    o, d = mi.Point3f(-1.0, 0.25, 0.15), mi.Vector3f(1, 0, 0)
    on = dr.full(mi.Bool, True, N)
    (u,) = numbers(N, 1, 3)
    line = table.sample_along(o + dr.zeros(mi.Point3f, N), d + dr.zeros(mi.Vector3f, N), u, on)
    t, density, box = (np.array(v).astype(np.float64) for v in (line.t, line.density, line.box))
    box = np.array(order(table))[box.astype(int)]
    inside = np.where(box == 0, (t >= 0.7 - 1e-5) & (t <= 1.4 + 1e-5), (t >= 2 - 1e-5) & (t <= 2.5 + 1e-5))
    assert inside.all()
    assert np.ptp((t[box == 0] - 0.7) / (0.7 / CELLS_PER_AXIS) % 1) > 0.9  # not only the middles of cells
    found = np.stack([(box == 0) / density, (box == 1) / density, t / density], axis=1)
    truth = [0.7, 0.5, (1.4**2 - 0.7**2 + 2.5**2 - 2.0**2) / 2]
    assert_same_mean(Moments.from_values(found), np.array(truth), rounding=1e-5, what="integrals")
    seen_along = table.integrate_density(o + dr.zeros(mi.Point3f, N), d + dr.zeros(mi.Vector3f, N), on)
    assert np.array(seen_along.pdf) == pytest.approx(np.array(line.pdf), rel=1e-5)
    shares = np.array(table.density)[np.argsort(order(table)) * CELLS_PER_AXIS**3]
    assert np.array(seen_along.light) == pytest.approx(0.7 * shares[0] + 0.5 * shares[1], rel=1e-5)
    cubes = [(1.4**3 - 0.7**3) / 3, (2.5**3 - 2.0**3) / 3]
    assert np.array(line.pdf) == pytest.approx(shares @ cubes, rel=1e-5)


def test_a_ray_that_misses_has_no_density() -> None:
    line = table_of(two()).sample_along(mi.Point3f(-1, 0.25, 3), mi.Vector3f(1, 0, 0), mi.Float([0.1, 0.9]), mi.Bool(True))
    assert not np.array(line.pdf).any() and not np.array(line.density).any()
