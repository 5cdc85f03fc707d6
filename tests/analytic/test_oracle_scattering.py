"""The twins of single scattering against closed forms, against each other, and against stock volpath where it is right."""

from __future__ import annotations

import math

import numpy as np
import oracle_scattering as twins
import pytest
import scattering_scenes as small
from oracle import tau_twin

from scenes import FRAMES, as_float32, centred, random_rays

WIDE = centred(200 * np.eye(3))


def along(o, d):
    d = np.asarray(d, dtype=np.float64)
    return np.atleast_2d(o).astype(np.float64), np.atleast_2d(d / np.linalg.norm(d))


@pytest.mark.parametrize(
    ("numbers", "answer"),
    [
        ((0.5, 0.7, 2, 1.3, 0.4, 5), 0.14379379536),
        ((1, 1, 1, 0, 1, 3), 0.01537602046),
        ((0.2, 3, 1, 2, 0.1, 4), 7.880153424e-4),
    ],
)
def test_point_light_in_fog_check_values(numbers, answer):
    """The closed form has the ten digits of the published check values, and the quadrature the closed form's."""
    assert twins.point_in_fog(*numbers) == pytest.approx(answer, rel=1e-9)
    sigma_s, sigma_t, intensity, t0, h, D = numbers
    fog = twins.Medium(twins.Box(sigma_t, WIDE), sigma_s / sigma_t)
    emitter = twins.Point([t0, h, 0.0], intensity)
    found = twins.radiance([fog], [emitter], *along([0, 0, 0], [1, 0, 0]), t1=D, order=12)
    assert found[0, 0] == pytest.approx(answer, rel=1e-8)


@pytest.mark.parametrize("name", ["isotropic", "rayleigh"])
def test_thin_limits(name):
    numbers = {"t0": 1.2, "h": 0.3, "D": 4.0}
    fog = twins.Medium(twins.Box(1e-7, WIDE), 0.5, getattr(twins, name))
    found = twins.radiance([fog], [twins.Point([1.2, 0.3, 0])], *along([0, 0, 0], [1, 0, 0]), t1=4.0, order=12)
    # tau of 1e-7 times 6 lengths is left out of the limit.
    assert found[0, 0] == pytest.approx(twins.point_thin(0.5e-7, 1.0, phase=name, **numbers), rel=1e-6)


def test_thin_limit_of_any_phase():
    """sigma_s I / h times the integral of p(-sin theta): theta is the angle at the emitter from the shortest way."""
    h, t0, D = 0.3, 1.2, 4.0
    p = twins.hg(0.6)
    x, w = np.polynomial.legendre.leggauss(60)
    a, b = math.atan(-t0 / h), math.atan((D - t0) / h)
    theta = a + (b - a) * (x + 1) / 2
    limit = 0.5e-7 / h * np.sum(w * (b - a) / 2 * p(-np.sin(theta)))
    fog = twins.Medium(twins.Box(1e-7, WIDE), 0.5, p)
    found = twins.radiance([fog], [twins.Point([t0, h, 0])], *along([0, 0, 0], [1, 0, 0]), t1=D, order=12)
    assert found[0, 0] == pytest.approx(limit, rel=1e-6)


@pytest.mark.parametrize(("mu", "mu0"), [(0.6, 0.9), (0.9, 0.6), (0.7, 0.7), (1.0, 1.0)])
def test_collimated_slab(mu, mu0):
    """A box 4000 wide and 1 high: light and view leave by its top and bottom only."""
    sigma, albedo, g, E0 = 1.7, 0.8, 0.4, 2.0
    box = np.eye(4)
    box[:3, :3], box[:3, 3] = np.diag([4e3, 4e3, 1]), (-2e3, -2e3, 0)
    p = twins.hg(g)
    fog = twins.Medium(twins.Box(sigma, box), albedo, p)
    travel = np.array([math.sqrt(1 - mu0 * mu0), 0, -mu0])
    sun = twins.Directional(travel, E0)
    view = np.array([0, math.sqrt(1 - mu * mu), mu])
    for sign, formula in ((1, twins.slab_reflected), (-1, twins.slab_transmitted)):
        seen_from = view * [1, 1, sign]  # where the camera is, seen from the slab
        d = -seen_from
        found = twins.radiance([fog], [sun], *along(np.array([0, 0, 0.5]) + 5 * seen_from, d), order=12)
        assert found[0, 0] == pytest.approx(formula(albedo, p(-d @ travel), E0, mu, mu0, sigma), rel=1e-9)


def test_transmitted_limit_is_the_limit():
    close = [twins.slab_transmitted(0.8, 0.1, 1, 0.7, 0.7 * (1 + e), 2.0) for e in (0, 1e-13, 1e-9)]
    assert close[0] == pytest.approx(0.8 * 0.1 * 2 / 0.7 * math.exp(-2 / 0.7), rel=1e-14)
    assert close[1:] == pytest.approx([close[0]] * 2, rel=1e-8)


@pytest.mark.parametrize("depth", [0.1, 0.8])
def test_cube_lit_from_above_seen_from_the_side(depth):
    fog = twins.Medium(twins.Box(2.2, np.eye(4)), 0.6)
    found = twins.radiance([fog], [twins.Directional([0, 0, -1], 3.0)], *along([-2, 0.3, 1 - depth], [1, 0, 0]), order=12)
    assert found[0, 0] == pytest.approx(twins.cube_from_the_side(0.6, 1 / (4 * math.pi), 3.0, 2.2, depth, 1.0), rel=1e-9)


def test_ball_in_a_sky():
    """Three ways: symmetry, the general quadrature (5e-5 with 16 x 32 directions), and its own refinement."""
    exact = twins.ball_in_sky(0.6, 1.3, 1.0, 0.4)
    assert exact == pytest.approx(twins.ball_in_sky(0.6, 1.3, 1.0, 0.4, n=500), rel=1e-8)
    ball = twins.Medium(twins.Ball(1.3, [0, 0, 0], 1.0), 0.6)
    found = twins.radiance([ball], [twins.Sky(1.0, 16)], *along([-3, 0.4, 0], [1, 0, 0]), background=1.0, order=16)
    assert found[0, 0] == pytest.approx(exact, rel=1e-4)


def test_optical_depth_of_many_rays():
    """The vectorised depth is that of the twin of absorption, ray by ray, in every frame."""
    for name, frame in FRAMES.items():
        values = np.random.default_rng(1).uniform(0, 2, (4, 1, 5, 2))
        o, d = random_rays(np.random.default_rng(2), frame, 20)
        ends = np.random.default_rng(3).uniform(0, 8, 20)
        found = twins.Grid(values, frame).tau(o, d, ends)
        assert np.allclose(found, tau_twin(values, frame, o, d, 0, ends), rtol=1e-12, atol=1e-12), name


def test_a_grid_of_one_value_is_a_box():
    o, d = small.aimed(4)
    spot = twins.Spot([0, 0, 3.0], 2.0, (0, 0.1, -1), 0.5, 0.3)
    for emitter in (twins.Point([0.3, 0.2, 1.4], 2.0), spot, twins.Directional([1, 2, 3.0])):
        pair = [
            twins.radiance([twins.Medium(field, 0.5, twins.hg(-0.3))], [emitter], o, d, order=12)
            for field in (twins.Box(1.1, small.PLACE), twins.Grid(np.full((2, 3, 2), 1.1), small.PLACE))
        ]
        assert np.allclose(*pair, rtol=1e-5, atol=0)


def test_two_halves_are_one_box():
    """Media attenuate each other's light: a box cut in two is the box."""
    halves = [twins.Medium(twins.Box(0.9, centred(np.diag([2.0, 2, 1]), (0, 0, z))), 0.8, twins.rayleigh) for z in (-0.5, 0.5)]
    whole = twins.Medium(twins.Box(0.9, small.PLACE), 0.8, twins.rayleigh)
    o, d = small.aimed(6)
    emitter = twins.Point([0.4, -0.3, 2.0])
    pair = [twins.radiance(media, [emitter], o, d, background=0.5, order=12) for media in (halves, [whole])]
    assert np.allclose(*pair, rtol=1e-6, atol=0)


def test_reciprocity():
    """A turn counts the same from camera to emitter and back: at one point x, T(a,x) sigma p T(x,b) is symmetric."""
    grid, p = twins.Grid(small.rough_grid(7), small.PLACE), twins.hg(0.5)
    a, b, x = np.array([[-3.0, 0.2, 0.1]]), np.array([[0.5, 2.0, 1.0]]), np.array([[0.2, -0.3, 0.4]])

    def one(eye, emitter):
        d, w = x - eye, emitter - x
        r, s = np.linalg.norm(d), np.linalg.norm(w)
        tau = grid.tau(eye, d / r, [r]) + grid.tau(x, w / s, [s])
        return np.exp(-tau) * p(np.sum(d * w) / (r * s))

    assert one(a, b) == pytest.approx(one(b, a), rel=1e-12)


EMITTERS = {
    "point": twins.Point([0.5, 0.6, 1.7], 2.0),
    "spot": twins.Spot([0.5, 0.6, 1.7], 2.0, (-0.2, -0.3, -1), 0.6, 0.4),
    "sun": twins.Directional([0.3, 0.2, -1]),
    "sky": twins.Sky(1.0, 4),
}


@pytest.mark.slow_for("False-sky", "True-sky")
@pytest.mark.parametrize("name", EMITTERS)
@pytest.mark.parametrize("empty", [False, True])
def test_gradient_is_the_difference(name, empty):
    """Central differences in float64, h = 1e-5: truncation 1e-10, rounding 1e-16/1e-5. Density 0 is not special."""
    values = small.rough_grid(8)[..., 0] * (0 if empty else 1)
    o, d = small.aimed(8, n=3)
    weight = np.array([1.0, -0.4, 2.0])
    emitters, v = [EMITTERS[name]], np.random.default_rng(8).uniform(0.1, 1, values.shape)

    def at(values, albedo=0.7):
        m = twins.Medium(twins.Grid(values, small.PLACE, 1.3), albedo, twins.hg(0.4))
        return weight @ twins.radiance([m], emitters, o, d, background=0.6)[:, 0]

    m = twins.Medium(twins.Grid(values, small.PLACE, 1.3), 0.7, twins.hg(0.4))
    row, slope = twins.radiance_gradient(m, emitters, o, d, weight, background=0.6)
    h = 1e-5
    assert np.sum(row * v) == pytest.approx((at(values + h * v) - at(values - h * v)) / (2 * h), rel=1e-7)
    assert slope == pytest.approx((at(values, 0.8) - at(values, 0.6)) / 0.2, rel=1e-9, abs=1e-14)


def test_zero_density_gradient():
    """In a constant sky of radiance B it is (albedo - 1) B times the row of A: 0 for albedo 1."""
    values = np.zeros((3, 4, 2))
    o, d = small.aimed(9, n=2)
    chord = np.zeros_like(values)
    twins.Grid(values, small.PLACE).weigh_tau(chord, o, d, np.full(2, np.inf), np.ones(2))
    for albedo in (0.0, 0.4, 1.0):
        m = twins.Medium(twins.Grid(values, small.PLACE), albedo)
        row, _ = twins.radiance_gradient(m, [twins.Sky(0.7, 4)], o, d, background=0.7)
        assert np.allclose(row, (albedo - 1) * 0.7 * chord, rtol=1e-12, atol=1e-14)


def test_derivative_of_the_phase_function():
    c = np.linspace(-1, 1, 11)
    for g in (-0.7, 0.0, 0.6):
        assert np.allclose(twins.hg_slope(g)(c), (twins.hg(g + 1e-6)(c) - twins.hg(g - 1e-6)(c)) / 2e-6, rtol=1e-7, atol=1e-9)
    assert np.allclose(twins.hg_slope(0.0)(c), 3 * c / (4 * math.pi))


SKY = ({"type": "constant", "radiance": 0.5}, twins.Sky(0.5, 24))
JUDGED = {
    "point, grid, hg": lambda: (small.smoke(small.rough_grid(1), name="hg", g=0.5), [small.point([1.5, 1, 2.0])], 0),
    "spot, grid": lambda: (small.smoke(small.rough_grid(2)), [small.spot([1.0, -2, 2.5], [0, 0, 0])], 0),
    "sun, box, rayleigh": lambda: (small.fog(0.8, name="rayleigh"), [small.sun([0.3, 0.2, -1.0])], 0),
    "two emitters, grid": lambda: (small.smoke(small.rough_grid(3)), [small.point([0, 2, 2]), small.sun([1, 0, -0.5], 0.2)], 0),
    "sky, box, hg": lambda: (small.fog(0.8, name="hg", g=0.6), [SKY], 0.5),
}


@pytest.mark.slow_for("point, grid, hg")
@pytest.mark.statistical
@pytest.mark.parametrize("name", small.cases(JUDGED, [name for name in JUDGED if name != "point, grid, hg"]))
def test_twins_against_volpath(variant_rgb, name):
    """16 batches of 8192 paths along each of 6 rays; Student's t."""
    (box, m), emitters, background = JUDGED[name]()
    o, d = small.aimed(11, n=6)
    parts = {"smoke": box} | {f"emitter{i}": emitter for i, (emitter, _) in enumerate(emitters)}
    # The sky's 24 x 48 directions leave 1e-4; volpath's spawned rays skip 1e-4 of a length at each boundary.
    small.assert_twin(
        small.pencils(parts, o, d), [m], [twin for _, twin in emitters], small.volpath(), 8192, background=background,
        rounding=2e-5 if not background else 2e-4,
    )  # fmt: skip


def test_as_float32_positions_are_kept():
    """The emitters of both sides stand in the same place."""
    _, emitter = small.point([0.1, 0.2, 0.3])
    assert np.array_equal(emitter.position, as_float32([0.1, 0.2, 0.3]))
