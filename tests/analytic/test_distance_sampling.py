"""The distance drawn in the kept piece of a ray, against the inverse of its optical depth on paper."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean
from hard_scattering import BATCHES, holds_twin
from scattering_scenes import PLACE, aimed, close_up, mivol, pencils, point, rough_grid, smoke, sun

import scenes
from mivol.scene.needs import find_needs
from mivol.scene.plan import build_media, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.estimators.lighting.emitters import ChosenEmitter, make_ball_sampler
from mivol.transport.estimators.lighting.shadow_rays import NEGLIGIBLE_TAU
from mivol.transport.estimators.single_scattering.distance_sampling import (
    Candidate,
    DistanceProposal,
    fill_reservoir,
    lit_length,
    sample_distance,
    start_reservoir,
)
from mivol.transport.path.estimators import Settings
from mivol.transport.traversal.random_numbers import seed_pcg32
from scenes import as_float32, box_of, grid_volume, media_of, medium


@pytest.mark.parametrize("ends", [(0.5, 2.0), (2.0, 0.5), (0.5, 200.0), (1e-3, 0.02)])
def test_collisions_in_a_cell_of_linear_extinction(ends):
    """In a cell of length d, tau(x) = d (a x + (b - a) x^2 / 2) equals -log(1 - u (1 - exp(-tau(1)))) at the drawn x."""
    values = np.repeat(np.float32([ends[0], *ends, ends[1]]), 4).reshape(4, 2, 2, 1)
    scene = close_up({"smoke": smoke(values)[0], "emitter": point([0, 0, 30.0])[0]})
    survey, settings, n = survey_scene(scene), Settings(max_depth=2), 64
    with dr.suspend_grad():
        needs = find_needs(scene, scene.sensors()[0], survey)
        media = build_media(scene, needs, make_plan(needs, settings), survey)
        # Voxels 1 and 2 of 4 along z: between -0.25 and 0.25 of the box [-1, 1].
        begin, length, u = 4.75, 0.5, (np.arange(n) + 0.5) / n
        zero, one = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
        ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -5 + zero), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
        kept = Candidate(one, begin * one, zero, length * one, [zero], zero, mi.UInt32(zero), mi.Bool(True), mi.UInt32(1))
        numbers = mi.Point2f(mi.Float(0.5), mi.Float(np.float32(u)))
        proposal = DistanceProposal(media, ray, ChosenEmitter(mi.UInt32(0), None, None, None), None, 0.0)
        event = sample_distance(proposal, kept, one, numbers, mi.Bool(True))
    a, b = map(float, np.float32(ends))
    goal = -np.log1p(u * np.expm1(-length * (a + b) / 2))
    x = (-a + np.sqrt(a * a + 2 * (b - a) * goal / length)) / (b - a)
    # Optical depths are rounded a few times, and so is 1 - u (1 - exp(-tau)), of which the logarithm is taken; Newton's steps
    # end there, and a distance of 5 is rounded by 2^-22.
    sigma = a + (b - a) * x
    rounding = 2.0**-24 * (8 * length * (a + b) / 2 + 4 * np.exp(goal)) / (sigma * length) + 2.0**-23
    off = np.abs(np.array(event.t, np.float64) - begin - length * x)
    np.testing.assert_array_less(off, 2.0**-22 + length * rounding)
    # Its density is sigma exp(-tau) over what the cell takes; tau is off by sigma times the error of the distance.
    density = sigma * np.exp(-goal) / -np.expm1(-length * (a + b) / 2)
    np.testing.assert_allclose(np.array(event.pdf), density, rtol=1e-4)


@pytest.mark.parametrize("lamp", [(0.6, 1e-3), (0.6, 0.3), (-2.0, 1e-3), (1.5, 5.0)], ids=["near", "beside", "behind", "far"])
@pytest.mark.parametrize("sigma", [0.01, 3.0])
def test_collisions_and_angle_share_the_distances(sigma, lamp):
    """Between z = -1 and 1 in a fog, the density is a mixture of the densities of collisions and angle. The share of collisions
    is (1 - w) / 2 for w = e^-s (1 - f) > 0.5, else 1/2, with f the smallest over the mean 1 / r^2, and s the optical depth over
    the smaller of the length and the distance to the lamp at (z, h)."""
    z, h = map(float, np.float32(lamp))
    scene = close_up({"fog": box_of(medium("homogeneous", sigma, 0.8), PLACE), "lamp": point([0.1 + h, 0.2, z])[0]})
    n, length = 64, 2.0
    with dr.suspend_grad():
        media = media_of(scene)
        zero, one = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
        ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -1 + zero), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
        kept = Candidate(one, zero, zero, length * one, [zero], zero, mi.UInt32(zero), mi.Bool(True), mi.UInt32(1))
        numbers = mi.Point2f(mi.Float(np.float32((np.arange(n) * 0.618) % 1)), mi.Float(np.float32((np.arange(n) + 0.5) / n)))
        chosen = ChosenEmitter(mi.UInt32(0), None, make_ball_sampler(ray, [0.1 + h, 0.2, z, 0.0]), None)
        event = sample_distance(DistanceProposal(media, ray, chosen, None, 0.0), kept, one, numbers, mi.Bool(True))
    t, t0 = np.array(event.t), z + 1
    square = h**2 + 4e-12 * (h**2 + t0**2)
    rho = np.sqrt(square)
    angle = np.arctan((length - t0) / rho) + np.arctan(t0 / rho)
    even = rho * length / angle / (square + max(abs(t0), abs(length - t0)) ** 2)
    nearest = np.hypot(rho, t0 - np.clip(t0, 0, length))
    weight = np.exp(-sigma * min(length, nearest)) * (1 - even)
    share = 0.5 * (1 - weight * (weight > 0.5))
    collisions = sigma * np.exp(-sigma * t) / -np.expm1(-sigma * length)
    density = share * collisions + (1 - share) * rho / angle / (square + (t - t0) ** 2)
    # Coordinates near 1 have errors of 2^-24: 1e-4 of h, of a distance and of an angle.
    np.testing.assert_allclose(np.array(event.pdf), density, rtol=1e-3)


@pytest.mark.statistical
@pytest.mark.parametrize("peak", [20.0, 2000.0])
def test_one_dense_voxel(peak):
    """One voxel 10 or 1000 times denser than the rest, beside the rays and between some rays and the emitter: the same law."""
    values = rough_grid(6)
    values[-1, -1, -1] = peak
    box, m = smoke(values, 0.8, "own")
    emitter = point([1.5, 1, 2.0])
    holds_twin(pencils({"smoke": box, "emitter": emitter[0]}, *aimed(6, 6)), m, emitter[1], quadrature=1e-4, order=16)


def test_noise_does_not_follow_the_majorant():
    """Rays far from the dense voxel have the same radiance with and without the voxel, to the last digits, with the same
    noise."""
    values = rough_grid(6)
    o = as_float32(np.stack([np.full(4, -3.0), np.linspace(-0.8, 0.0, 4), np.full(4, -0.5)], axis=1))
    images = []
    for peak in (1.0, 1000.0):
        values[-1, -1, -1] = peak
        box, _ = smoke(values, 0.8, "own")
        seen = pencils({"smoke": box, "sun": sun([0, 0, 1.0])[0]}, o, [1.0, 0, 0])
        images.append(scenes.render(seen.scene, mivol(), 16, seed=2))
    assert np.allclose(*images, rtol=1e-5, atol=0)


@pytest.mark.slow_for("ratio1", "ratio2")
@pytest.mark.statistical
@pytest.mark.parametrize("ratio", [(1e-3, 1.0, 10.0), (0.0, 1.0, 2.0), (8.0, 8.0, 8e-4)])
def test_channels_of_very_different_extinction(ratio):
    """Each channel equals its own grey image, at ratios of 1e4 and with a channel of vacuum."""
    values = as_float32(rough_grid(7, 1.0) * np.array(ratio))
    interior = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.8, phase={"type": "hg", "g": 0.4})
    emitter = point([1.5, 1, 2.0])
    seen = pencils({"smoke": box_of(interior, PLACE), "emitter": emitter[0]}, *aimed(7, 6))
    m = twins.Medium(twins.Grid(values, PLACE), float(as_float32(0.8)), twins.hg(0.4))
    truth = twins.radiance([m], [emitter[1]], seen.o, seen.d)
    found = seen.moments(mivol(), 4096, BATCHES)
    for c in range(3):
        top = truth[:, c].max()
        channel = Estimate(found.mean[:, c], found.variance_of_mean[:, c], BATCHES - 1)
        assert_same_mean(channel, truth[:, c], rounding=2e-5 * top + 1e-30, what=f"channel {c}")
        bright = truth[:, c] > 0.1 * top
        if top > 0:
            assert_precise(channel._replace(var=channel.var[bright]), 0.03 * truth[bright, c], what=f"channel {c}")
    assert np.all(found.mean >= 0)


@pytest.mark.parametrize(
    ("sigma", "length", "lit"),
    [
        ((2.0,), 1e9, NEGLIGIBLE_TAU / 2),
        ((2.0, 0.5, 4.0), 1e9, NEGLIGIBLE_TAU / 0.5),
        ((2.0, 0.0), 1e9, NEGLIGIBLE_TAU / 2),
        ((2.0,), 3.0, 3.0),
        ((0.0,), 7.0, 0.0),
    ],
    ids=["grey", "rgb", "a channel of 0", "short", "empty"],
)
def test_what_is_behind_the_dark_takes_no_candidates(sigma, length, lit):
    """A region of constant extinction may have no end; its clearest channel determines its lit length. A vacuum needs none."""
    found = lit_length([mi.Float(s) for s in sigma], mi.Float(length))
    assert float(np.array(found).item()) == pytest.approx(lit, rel=1e-6)


@pytest.mark.parametrize(("floor", "tau", "probe"), [(0.0, 1.0, 0.7), (0.25, 1.5, 0.35)], ids=["vacuum", "fog"])
def test_matter_around_a_grid(floor, tau, probe):
    """A grid fills the middle half of a box of length 2. Fog is before, in and behind it. The optical depth of a probe is
    uniform over the length of what is filled: the grid in a vacuum, and the box in fog."""
    grid = np.diag([1.0, 1, 1, 1])
    grid[:3, 3] = -0.5
    place = np.diag([2.0, 2, 2, 1])
    place[:3, 3] = -1
    smoke = grid_volume("mivol_voxels", np.ones((4, 4, 4, 1), np.float32), grid)
    coefficients = {"sigma_s": smoke, "sigma_a": floor} if floor else {"sigma_t": smoke, "albedo": 0.8}
    interior = {"type": "mivol_medium", **coefficients}
    seen = pencils({"smoke": box_of(interior, place), "sun": sun([0, 0, 1.0])[0]}, *aimed(4, 4))
    n = 8
    with dr.suspend_grad():
        media = media_of(seen.scene)
        ray = mi.Ray3f(mi.Point3f(0.1, 0.2, -5 + dr.zeros(mi.Float, n)), mi.Vector3f(0, 0, 1))
        proposal = DistanceProposal(media, ray, ChosenEmitter(mi.UInt32(0), None, None, None), None, 0.7)
        start = start_reservoir(media, [seed_pcg32(mi.Float((np.arange(n) + 0.5) / n), n)])
        _, reservoir = fill_reservoir(proposal, media.medium_at(ray), start, mi.Bool(True))
    (kept,) = reservoir.candidates
    # The length of the grid comes from two slabs in float32.
    np.testing.assert_allclose(np.array(kept.probe_sigma), probe, rtol=1e-5)
    np.testing.assert_allclose(np.array(reservoir.tau[0]), tau, rtol=1e-5)
