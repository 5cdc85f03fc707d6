"""Shadow rays through surfaces and emitters transmitting part of the light, and the roulette along shadow rays."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import Estimate, assert_rate, assert_same_mean, fresh
from scattering_scenes import PLACE, close_up, point
from volpath_scenes import EMITTERS, RED, area, behind_a_mask, cube, grid_in, same, square

from mivol.transport.estimators.lighting.shadow_rays import (
    FACES_ON_EDGE,
    LOOKUPS,
    ROULETTE_TAU,
    STEPS_PER_LOOKUP,
    find_transmittance,
    segment_transmittance,
)
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.traversal.random_numbers import fork_state, seed_pcg32
from scenes import box_of, grid_volume, media_of, medium


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("emitter", small.cases(["bulb", "emitter", "sky"], ["emitter", "sky"]))
def test_shadow_rays_go_on_through_what_is_partly_clear(emitter):
    """A mask attenuates shadow rays by its transparency, as in volpath, towards all kinds of emitters."""
    sky = EMITTERS["envmap"]()["emitter"]
    shine = {"bulb": point([1.6, -1.3, 1.7])[0], "emitter": area(1.6, -1.3, 1.7), "sky": sky}[emitter]
    same(behind_a_mask() | {"shine": shine})


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("emitter", small.cases(["bulb", "sky"], ["sky"]))
@pytest.mark.parametrize("kind", small.cases(["transmissive", "boundary"], ["boundary"]))
def test_emitters_that_let_light_pass(kind, emitter):
    """A luminous mask in front of another emitter, and a luminous boundary: light from behind passes them."""
    shine = {"bulb": {"bulb": point([1.6, -1.3, 1.7], 40.0)[0]}, "sky": EMITTERS["envmap"]()}[emitter]
    light = {"emitter": {"type": "area", "radiance": 5.0}}
    if kind == "boundary":
        same({"smoke": grid_in(cube(PLACE)) | light, **shine})
        return
    mask = {"type": "mask", "opacity": 0.4, "nested": {"type": "twosided", "nested": RED}}
    same({"smoke": grid_in(cube(PLACE)), "transmissive": square(0.8, -0.65, 0.85, 0.6) | light | {"bsdf": mask}, **shine})


def test_an_open_ray_ends_at_a_lamp_inside_a_homogeneous_medium():
    """The optical depth up to the surface of the lamp, not to the end of the medium behind it."""
    lamp = {"type": "sphere", "radius": 0.25, "emitter": {"type": "area"}}
    media = media_of(close_up({"fog": box_of(medium("mivol_medium", 1.5, 0.5), PLACE), "lamp": lamp}, res=1))
    ray = mi.Ray3f(mi.Point3f(-0.75, 0, 0), mi.Vector3f(1, 0, 0))
    end, tau, _, T = find_transmittance(media, ray, dr.zeros(mi.MediumPtr, 1), mi.Bool(True), None)
    # The surface of a sphere is found to 1e-5 of the radius.
    np.testing.assert_allclose([end.t[0], tau[0][0]], [0.5, 0.75], rtol=1e-5)
    np.testing.assert_allclose(np.array(T).ravel(), np.exp(-0.75), rtol=1e-5)


# -- Roulette --------------------------------------------------------------------------------------------------------------

N = 1 << 16


def through(sigma_t: np.ndarray | float, rng: bool) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance (N, 3) and optical depth (N, channels) along one ray through [-1, 1]^3, N times."""
    sigma = grid_volume("mivol_voxels", sigma_t, PLACE) if isinstance(sigma_t, np.ndarray) else sigma_t
    media = media_of(close_up({"fog": box_of(medium("mivol_medium", sigma, 0.5), PLACE)}, res=1))
    ray = mi.Ray3f(dr.full(mi.Point3f, 0, N) + mi.Point3f(-2, 0.1, 0.2), mi.Vector3f(1, 0, 0))
    state = seed_pcg32(mi.Float((0.3 + 0.618 * fresh(0)) % 1), N) if rng else None
    _, tau, _, T = find_transmittance(media, ray, dr.zeros(mi.MediumPtr, N), mi.Bool(True), state)
    return np.array(T, dtype=np.float64).T, np.array(tau).T


def test_clear_rays_are_not_played_for():
    """Up to the optical depth ROULETTE_TAU the estimate is exact, here at 0.9."""
    assert np.array_equal(through(0.45, True)[0], through(0.45, False)[0])


@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["grid", "rgb grid", "constant"])
def test_roulette_keeps_the_mean(kind):
    """A surviving ray transmits exp(-1) in its clearest channel and less in the others; other rays transmit 0."""
    values = {"grid": [1.2], "rgb grid": [1.2, 0.9, 3.0]}.get(kind)
    sigma = 1.2 if values is None else np.tile(np.float32(values), (2, 2, 2, 1))
    exact, found = through(sigma, False)[0][0], through(sigma, True)[0]
    lives = found.max(axis=1) > 0
    np.testing.assert_allclose(found[lives].max(axis=1), np.exp(-ROULETTE_TAU), rtol=1e-5)
    # Hits of an event of known chance: exp(1) times the clearest channel's transmittance.
    assert_rate(int(lives.sum()), N, float(exact.max()) * np.e)
    np.testing.assert_allclose(found[lives].mean(axis=0) * exact.max() * np.e, exact, rtol=1e-4)


def test_a_ray_that_ends_is_walked_no_further():
    """In a grid of 32 cells along the ray with an optical depth of 64, ended rays have walked a few cells, as their optical
    depth shows.
    """
    _, tau = through(np.full((2, 2, 32, 1), 32.0, np.float32), True)
    # A cell has a depth of 2, and a limit of 1 + ln(2^24) = 17.6 at most is passed by one cell.
    assert tau.min() > ROULETTE_TAU and tau.max() < 20 and tau.mean() < 5


# -- Look-ups in thin grids ------------------------------------------------------------------------------------------------

CELLS = 24
THINNEST = FACES_ON_EDGE * (CELLS / 2) / (LOOKUPS * STEPS_PER_LOOKUP)
"""Extinction [1/length] below which look-ups cost less than a walk of a grid of ``CELLS`` cells of length 2 / ``CELLS``."""


def looked_up(sigma: float, looks_up: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Transmittances (N) along one ray through fog and a grid of one value: as a shadow ray and as a segment of a path,
    with the generators of near light.
    """
    grid = grid_volume("mivol_voxels", np.full((CELLS, CELLS, CELLS, 1), sigma, np.float32), PLACE)
    smoke = box_of(medium("mivol_medium", grid, 0.5), PLACE)
    behind = np.array(PLACE)
    behind[0, 3] += 2.5
    fog = box_of(medium("mivol_medium", 0.2, 0.5), behind)
    media = media_of(close_up({"smoke": smoke, "fog": fog}, res=1))
    part = next(p for body in media.bodies for p in body.view.parts if p.lattice is not None)
    part.largest = mi.Float(sigma)
    ray = mi.Ray3f(dr.full(mi.Point3f, 0, N) + mi.Point3f(-2, 0.1, 0.2), mi.Vector3f(1, 0, 0), 10, mi.Float(0), mi.Color0f())
    nowhere, on = dr.zeros(mi.MediumPtr, N), mi.Bool(looks_up)
    rng = seed_pcg32(mi.Float((0.3 + 0.618 * fresh(0)) % 1), N)
    _, _, _, shadow = find_transmittance(media, ray, nowhere, mi.Bool(True), rng, looks_up=on)
    along = segment_transmittance(media, RaySegment(ray, nowhere, mi.Float(10)), mi.Bool(True), fork_state(rng, 1), on)
    return np.array(shadow[0], np.float64), np.array(along[0], np.float64)


@pytest.mark.statistical
def test_look_ups_of_a_shadow_and_of_a_segment_are_independent():
    """The mean of their product is the product of the means: with the same look-ups it would be exp(tau / LOOKUPS) times as
    large. The square of the product has the mean T^4 exp(2 tau / LOOKUPS).
    """
    tau, beyond = 0.9 * THINNEST * 2, 0.4
    shadow, along = looked_up(0.9 * THINNEST)
    T = np.exp(-tau - beyond)
    assert len(np.unique(along)) > 10
    for found, mean in ((along, T), (shadow, T), (shadow * along, T * T)):
        of_lanes = Estimate(found.mean(), found.var(ddof=1) / found.size, found.size - 1)
        assert_same_mean(of_lanes, mean, what="transmittance")


def test_dense_grids_and_other_lanes_are_walked():
    for sigma, looks_up in ((1.1 * THINNEST, True), (0.9 * THINNEST, False)):
        _, along = looked_up(sigma, looks_up)
        np.testing.assert_allclose(along, np.exp(-2 * sigma - 0.4), rtol=1e-5)
