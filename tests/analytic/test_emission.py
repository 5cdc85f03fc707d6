"""Light that media emit, against closed forms: cells in float64, and pencils through scenes."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_emission as twins
import pytest
from emission_scenes import BOUNDARIES, LE, PLACE, B, aimed, colours, emitting, gradients, interior, light, pencils, put, rough
from oracle import GAUSS_2, box_interval, corner_weights, quadrature_points, trilinear
from scipy.special import erf

from mivol.transport.estimators.scores import FORWARD, IMAGE, REVERSE
from mivol.transport.estimators.segment import PathSegment
from mivol.transport.line_integrals.emission import MAX_PARTS, Emission, count_parts, voxel_to_cell_ratio
from mivol.transport.media.medium_view import MediumView
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.interpolation import share_opacity, weigh_emission_density
from mivol.transport.traversal.lattice import Lattice
from scenes import FRAMES, as_float32, ball_of, box_of, camera, centred, media_of

pytestmark = pytest.mark.usefixtures("traced_balls")

EPS = 2.0**-23


def cell(dt, s1, s2, kind="Float64"):
    """What the code makes of cells."""
    return [rule(*(getattr(mi, kind)(np.ravel(x)) for x in (dt, s1, s2))) for rule in (share_opacity, weigh_emission_density)]


def swept(edges, sigma, c, j):
    """Light of a source function and of an emission density along a row of cells, as the code weighs them."""
    a, dt = edges[:-1], np.diff(edges)
    t1, t2 = (a + g * dt for g in GAUSS_2)
    share, density = cell(dt, sigma(t1), sigma(t2))
    T = np.exp(-np.append(0, np.cumsum(np.array(share.tau))[:-1]))
    w, g = (np.array(x.weights) for x in (share, density))
    return T @ (w[0] * c(t1) + w[1] * c(t2)), T @ (g[0] * j(t1) + g[1] * j(t2))


def sigma(t):
    return 3 + 2 * np.sin(2 * t + 0.3)


def source(t):
    return 1 + np.cos(3 * t)


def depth(t):
    return 3 * t + np.cos(0.3) - np.cos(2 * t + 0.3)


def exact(c, j, length, n=60):
    """Both integrals, to 1e-14: what is integrated is entire, and turns by less than a radian from node to node."""
    u, w = np.polynomial.legendre.leggauss(n)
    t, w = length * (u + 1) / 2, w * length / 2
    T = np.exp(-depth(t))
    return np.array([w @ (sigma(t) * c(t) * T), w @ (j(t) * T)])


def errors(counts, c, j, length=2.0):
    truth = exact(c, j, length)
    return np.array([np.abs(swept(np.linspace(0, length, n + 1), sigma, c, j) - truth) for n in counts])


def test_fourth_order():
    """Halving the cells divides the error by 16; in float64, where the series of phi_1 leaves 1e-8 of a cell's opacity."""
    e = errors([8, 16, 32], source, source)
    slopes = np.log2(e[:-1] / e[1:])
    # The next order is a power of the cell's optical depth, 0.75 to 0.2 here: it shifts a slope by a few tenths at most.
    assert np.all(slopes > 3.5) and np.all(e[-1] > 1e-8), slopes


@pytest.mark.parametrize("n", [16, 32, 64])
def test_a_tenth_of_the_error_of_midpoint_compositing(n):
    """At equal look-ups: two points a cell against twice as many cells of one point."""
    t, dt = (np.arange(2 * n) + 0.5) * 2.0 / (2 * n), 1.0 / n
    T = np.exp(-np.append(0, np.cumsum(sigma(t) * dt)[:-1]))
    midpoint = abs(T @ (-np.expm1(-sigma(t) * dt) * source(t)) - exact(source, source, 2.0)[0])
    assert errors([n], source, source)[0, 0] < 0.1 * midpoint


@pytest.mark.parametrize("k", [-1.5, 0.0, 2.0])
def test_exponentials(k):
    """Constant extinction s, light exp(-k t): s (1 - exp(-(s + k) D)) / (s + k). Cells of 1/32: (s + k) h = 0.1, to the 4th."""
    s, D = 3.0, 2.0
    found = swept(np.linspace(0, D, 65), lambda t: s + 0 * t, lambda t: np.exp(-k * t), lambda t: np.exp(-k * t))
    truth = -np.expm1(-(s + k) * D) / (s + k)
    assert found == pytest.approx([s * truth, truth], rel=1e-5)


def test_gaussian():
    """exp(-(t - m)^2 / 2 w^2) in a constant extinction s: a shifted Gaussian, with erf."""
    s, m, w, D = 1.5, 0.8, 0.3, 2.0
    middle = m - s * w * w
    ends = [erf((t - middle) / (math.sqrt(2) * w)) for t in (0, D)]
    truth = math.exp(-s * m + 0.5 * (s * w) ** 2) * w * math.sqrt(math.pi / 2) * (ends[1] - ends[0])

    def blob(t):
        return np.exp(-0.5 * ((t - m) / w) ** 2)

    found = swept(np.linspace(0, D, 65), lambda t: s + 0 * t, blob, blob)
    # The fourth derivative is 3 / w^4 = 370, the cell 1/32, and the Gauss rule's constant 1/4320: 1e-7.
    assert found == pytest.approx([s * truth, truth], rel=1e-6)


def test_linear_emission_density_in_constant_extinction():
    """(a + b t) exp(-s t): exact in one cell, up to an optical depth of 4 (then the mean place leaves the points)."""
    s, D = np.array([0.0, 1e-6, 0.3, 1.0, 3.0]), 1.2
    _, density = cell(np.full(5, D), s, s)
    t1, t2 = (g * D for g in GAUSS_2)
    a, b = 0.7, 2.0
    g = np.array(density.weights)
    u, w = np.polynomial.legendre.leggauss(30)
    t = D * (u + 1) / 2
    truth = [(w * D / 2) @ ((a + b * t) * np.exp(-x * t)) for x in s]
    # exp_moments: 5e-10 and 5e-10 beside the series.
    assert g[0] * (a + b * t1) + g[1] * (a + b * t2) == pytest.approx(truth, rel=1e-8)


TAUS = np.append(0, np.logspace(-8, 6, 43))


@pytest.mark.parametrize("ratio", [0.0, 1e-6, 0.3, 1.0, 40.0, 1e9])
def test_cells_of_any_optical_depth(ratio):
    """float32 weights against the float64 twin, from an optical depth of 1e-8 to 1e6: finite, never negative, and right."""
    dt, mean = 0.5, TAUS / 0.5
    s1 = as_float32(2 * mean / (1 + ratio))
    s2 = as_float32(s1 * ratio)
    share, density = cell(np.full(len(TAUS), dt), s1, s2, "Float")
    truth, lit = (np.array(rule(np.full(len(TAUS), dt), s1, s2)) for rule in (twins.share, twins.weigh_emission_density))
    # The share to a few roundings and those of phi_1 (4e-7); of the moments the third is known to 8e-7 only.
    assert np.all(np.abs(np.array(share.weights) - truth) <= 1e-6 * (truth + 1e-30) + 2e-7 * truth.sum(0))
    assert np.all(np.abs(np.array(density.weights) - lit) <= 2e-5 * lit.sum(0))
    # 1 - f is a difference of numbers of size 1.
    total = np.array(share.weights).sum(0)
    assert np.all(np.abs(total - truth.sum(0)) <= 1e-6 * truth.sum(0))
    for values in (*share.weights, *share.per_sigma, *density.weights, *share.lean, *np.ravel(density.slopes).tolist()):
        assert np.all(np.isfinite(np.array(values)))
    assert min(np.array(w).min() for w in (*share.weights, *share.per_sigma, *density.weights)) >= 0


@pytest.mark.parametrize("scale", [1e-5, 0.1, 1.0, 10.0, 1e3])
def test_derivatives_of_a_cell(scale):
    """Slopes against central differences in float64, and weights over the extinction against weights."""
    rng = np.random.default_rng(3)
    dt, s1, s2 = np.full(200, 0.7), *(scale * rng.uniform(0.05, 1, (2, 200)))
    c = [mi.Float64(x) for x in rng.uniform(size=(2, 200))]

    def sent(s1, s2):
        share, density = cell(dt, s1, s2)
        return np.array(share.radiance(*c)), np.array(density.weights[0] * c[0] + density.weights[1] * c[1])

    share, density = cell(dt, s1, s2)
    slopes = np.array(share.slopes(*c)), np.array([density.slopes[0][q] * c[0] + density.slopes[1][q] * c[1] for q in (0, 1)])
    h = 1e-4 * scale
    for q, step in enumerate(((h, 0), (0, h))):
        far, near = (sent(s1 + sign * step[0], s2 + sign * step[1]) for sign in (1, -1))
        for kind, found in enumerate(slopes):
            truth = (far[kind] - near[kind]) / (2 * h)
            # A step of 1e-4 leaves 1e-8; a difference of 1e-11 (phi_1 changes its form at 0.5: 1e-8) over it leaves more.
            # Where the mean place of the light leaves the two points it has a kink, which a few differences straddle.
            bad = np.abs(found[q] - truth) > 1e-4 * np.abs(truth).max()
            assert bad.mean() <= 0.01
    w, per = np.array(share.weights), np.array(share.per_sigma)
    assert np.allclose(w, per * [s1, s2], rtol=1e-6)


EXTINCTIONS = {
    "grey": (rough(2, 0, 6), PLACE),
    "rgb": (rough(3, 0, 6, 3) * as_float32([1, 1e-3, 5]), PLACE),
    "constant": 0.8,
    "rgb constant": as_float32([0.3, 0.0, 5.0]),
}
NAMES = [
    pytest.param(b, e, marks=() if (b, e) in (("box", "rgb"), ("ball", "grey")) else pytest.mark.slow)
    for b in BOUNDARIES
    for e in EXTINCTIONS
]


@pytest.mark.slow_for("box-rgb")
@pytest.mark.parametrize(("boundary", "extinction"), NAMES)
def test_constant_source(boundary, extinction):
    """C = Le (1 - T) + B T to rounding; of c = B nothing remains but B, and no gradient."""
    seen = emitting(twins.Medium(EXTINCTIONS[extinction], LE), boundary)
    C = light(seen)
    put(seen.scene, **{"emission.value.value": 0 * LE, "radiance.value": 0 * B + 1})
    T = light(seen)
    assert T.min() < 0.5 and T.max() > 0.05
    # A sum of some twenty cells, each to a rounding or two.
    assert np.abs(C - (LE * (1 - T) + B * T)).max() <= 8 * EPS
    put(seen.scene, **{"emission.value.value": B, "radiance.value": B})
    assert np.abs(light(seen) - B).max() <= 8 * EPS
    name = "sigma_t.data" if isinstance(EXTINCTIONS[extinction], tuple) else "sigma_t.value.value"
    (none,) = gradients(seen, [name], np.ones_like(C))
    put(seen.scene, **{"emission.value.value": 0 * B})
    (some,) = gradients(seen, [name], np.ones_like(C))
    assert np.abs(none).max() <= 1e-6 * np.abs(some).max()


def test_medium_that_never_ends():
    """A camera in a medium without an end sees Le, and an emission density j as j / sigma."""
    j = as_float32([0.2, 0.1, 0.4])
    fog = interior(twins.Medium(0.6, LE, j)) | {"id": "fog"}
    ball = ball_of(fog, [50, 0, 0], 1.0)
    o, d = [[0, 0, 0.0]], [[0, 0.6, 0.8]]
    seen = pencils({"ball": ball, "sky": colours(B)}, o, d)
    scene = mi.load_dict({"type": "scene", "ball": ball, "sky": colours(B), "sensor": _inside(o[0], d[0])})
    assert light(scene)[0, 0] == pytest.approx(LE + j / np.float32(0.6), rel=4 * EPS)
    assert light(seen)[0] == pytest.approx(B)


def _inside(o, d) -> dict:
    from scenes import pencil

    return pencil(o, d) | {"medium": {"type": "ref", "id": "fog"}}


@pytest.mark.slow_for("ball")
@pytest.mark.parametrize("boundary", ["box", "ball"])
def test_camera_inside(boundary):
    """What lies behind the camera neither dims nor adds, in a box and in a boundary that is traced."""
    medium = twins.Medium((rough(5, 0, 4), PLACE), (rough(6, 0, 1, 3), PLACE), (rough(7, 0, 1, 3), PLACE))
    rng = np.random.default_rng(1)
    o, d = as_float32(rng.uniform(-0.4, 0.4, (8, 3))), rng.normal(size=(8, 3))
    seen = emitting(medium, boundary, rays=(o, as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))))
    here = twins.Medium(medium.sigma, medium.source, medium.emission_density, 0.0, BOUNDARIES[boundary][1])
    truth = twins.cell_radiance(here, seen.o, seen.d, B)
    # A traced end is Mitsuba's, in float32: 4e-6 of an extinction of 4.
    assert np.abs(light(seen) - truth).max() <= 2e-5


@pytest.mark.slow
def test_refining_the_grid():
    """The same trilinear field on finer grids, light and extinction: fourth order through all of the integrator."""
    inner = centred(0.9 * np.eye(3))  # within the voxel centres of each: beyond them grids differ
    rays = aimed(4, 8, size=0.2)
    found, truth = [], None
    for n in (4, 8, 16, 32):
        z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 3, indexing="ij")
        sigma = 1 + 3 * x + y * z
        c = np.stack([1 + x - y, 3 * x * z, 2 - z], axis=-1)
        fields = [(as_float32(f if f.ndim == 4 else f[..., None]), PLACE) for f in (sigma, c, 2 * c)]
        medium = twins.Medium(*fields, 0.0, lambda o, d: box_interval(inner, o, d))
        seen = pencils({"box": box_of(interior(medium), inner), "sky": colours(B)}, *rays)
        if truth is None:
            truth = twins.radiance([medium], seen.o, seen.d, B)
        found.append(np.abs(light(seen) - truth).max())
    slopes = np.log2(np.array(found[:-1]) / found[1:])
    # Cells of an optical depth of 0.6 to 0.07, cut by the planes of three axes to lengths that do not halve one by one.
    assert slopes.mean() > 3.5, (found, slopes)


def test_zero_density():
    """No extinction: C = B and the emission density's plain integral, with a derivative of w (c - B)."""
    empty = np.zeros((5, 4, 6, 1))
    source = (rough(8, 0, 1, 3), PLACE)
    seen = emitting(twins.Medium((empty, PLACE), source))
    assert np.abs(light(seen) - B).max() <= 2 * EPS
    (g,) = gradients(seen, ["sigma_t.data"], np.ones((12, 3)))
    truth, size = np.zeros((5, 4, 6)), np.zeros((5, 4, 6))
    for o, d in zip(seen.o, seen.d, strict=True):
        q, weight = quadrature_points(empty, PLACE, o, d, 0, math.inf)
        bright = weight * (trilinear(source[0], q) - B).sum(axis=-1)
        for node, corner in corner_weights((6, 4, 5), q):
            np.add.at(truth, node, bright * corner)
            np.add.at(size, node, np.abs(bright * corner))
    # A share of a cell is one half to a rounding; ends of cells lie where float32 puts them, 1e-6 of a voxel.
    assert np.abs(g[..., 0] - truth).max() <= 4e-6 * size.max()
    vacuum = emitting(twins.Medium((empty, PLACE), 0.0, LE))
    length = np.array([np.diff(BOUNDARIES["box"][1](*ray))[0] for ray in zip(vacuum.o, vacuum.d, strict=True)])
    assert light(vacuum) == pytest.approx(B + LE * length[:, None], rel=8 * EPS, abs=4e-6)


@pytest.mark.slow_for("1e-08")
@pytest.mark.parametrize("tau", [1e-8, 1e-3, 1.0, 1e3, 1e6])
def test_gradients_are_finite_at_any_optical_depth(tau):
    """Cells of an optical depth from 1e-8 to 1e6, empty ones between them: no NaN, no infinity, and C between its sources."""
    values = rough(9, 0, 1) * (rough(10, 0, 1) > 0.4) * tau * 3
    medium = twins.Medium((as_float32(values), PLACE), (rough(11, 0, 1, 3), PLACE), (rough(12, 0, 1, 3), PLACE))
    seen = emitting(medium)
    C = light(seen)
    assert np.isfinite(C).all() and C.min() >= 0 and C.max() < 4
    found = gradients(seen, ["sigma_t.data", "emission.data", "emission_density.data"], np.ones_like(C))
    for g in found:
        assert np.isfinite(g).all() and np.abs(g).max() > 0


SIGMA, SOURCE, BETA = np.array([0.5, 1.0, 2.0]), np.array([1.0, 3.0, 0.5]), np.array([0.5, 0.25, 2.0])
T = np.exp(-SIGMA)
ROUNDING = 8 * 2.0**-23
CHANGE = np.array([1.0, -2.0, 0.5])


@pytest.fixture
def media(variant_rgb: str) -> SceneMedia:
    """A unit cube."""
    sigma_t, emission = ({"type": "constvolume", "value": {"type": "rgb", "value": v.tolist()}} for v in (SIGMA, SOURCE))
    fog = {"type": "mivol_medium", "sigma_t": sigma_t, "emission": emission}
    return media_of(
        mi.load_dict({"type": "scene", "box": box_of(fog, centred(np.eye(3))), "sensor": camera([0, -4, 0], [0, 0, 0])})
    )


def segment() -> PathSegment:
    """Two lanes through the middle of it, of which the second has ended before."""
    ray = mi.Ray3f(mi.Point3f(0, 0, mi.Float(-3, -3)), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    return PathSegment(ray, dr.zeros(mi.MediumPtr, 2), mi.Spectrum(*BETA.tolist()), mi.Bool(True), None, mi.UInt32(0))


ON = (True, False)


def test_light_and_transmittance(media):
    with dr.suspend_grad():
        found = Emission(media).estimate(segment(), IMAGE, mi.Bool(*ON))
    light = BETA * SOURCE * (1 - T)
    np.testing.assert_allclose(np.array(found.light.value), np.c_[light, np.zeros(3)], rtol=ROUNDING)
    np.testing.assert_allclose(np.array(found.T)[:, 0], T, rtol=ROUNDING)
    assert found.light.is_replayed and not np.array(found.end.si.is_valid()).any()


def test_tangents(media):
    """Le T sigma' of the light, and -sigma' of log T."""
    media.bodies[0].tangents = [mi.Color3f(*CHANGE.tolist())]
    with dr.suspend_grad():
        found = Emission(media).estimate(segment(), FORWARD, mi.Bool(*ON))
        light, log = np.array(found.light.jvp()), np.array(found.transmittance.jvp())
    np.testing.assert_allclose(light, np.c_[BETA * SOURCE * T * CHANGE, np.zeros(3)], rtol=ROUNDING)
    np.testing.assert_allclose(log, np.c_[-CHANGE, np.zeros(3)], rtol=ROUNDING)


def test_gradients(media):
    """Of the light, reported first, and of log T: beta Le T dL - dlog."""
    media.start_gradients()
    dL, dlog = np.array([2.0, -1.0, 4.0]), np.array([0.25, 0.5, 1.0])
    with dr.suspend_grad():
        found = Emission(media).estimate(segment(), REVERSE, mi.Bool(*ON))
        found.light.vjp(mi.Spectrum(*dL.tolist()))
        found.transmittance.vjp(mi.Spectrum(*dlog.tolist()))
    np.testing.assert_allclose(np.array(media.bodies[0].gradients[0]), BETA * SOURCE * T * dL - dlog, atol=ROUNDING)


@pytest.mark.parametrize("density", [1e-3, 2.0, 60.0])
def test_random_points_in_cells_have_no_bias(density):
    """A mean over the numbers that place the points is the integral, where two Gauss points miss a steep light.

    The voxels of the source function are smaller than the cells, and it ends inside of them: there the mean of 4096 evenly
    spaced numbers has an error of a 4096th of a voxel's light.
    """
    small = as_float32(PLACE @ centred(0.77 * np.eye(3), [0.5, 0.5, 0.5]))
    source = (as_float32(9 * rough(2, 0, 1, 3, (7, 5, 8)) ** 8), small)
    place = {"albedo": (rough(3, 0, 0.8), PLACE), "emission_density": (as_float32(rough(4, 0, 1, 3) ** 8), PLACE)}
    m = twins.Medium((rough(1, 0, density), PLACE), source, **place)
    o, d = aimed(1, 8)
    media = media_of(
        mi.load_dict({"type": "scene", "box": box_of(interior(m), PLACE), "sensor": camera([0, -4, 0], [0, 0, 0])})
    )
    truth, n = twins.radiance([m], o, d), 4096
    ray = mi.Ray3f(*(kind(np.repeat(x, n, axis=0).T) for kind, x in ((mi.Point3f, o), (mi.Vector3f, d))))
    u = mi.Float((np.arange(8 * n) % n + 0.5) / n)
    here = PathSegment(ray, dr.zeros(mi.MediumPtr, 8 * n), mi.Spectrum(1), mi.Bool(True), u, mi.UInt32(0))
    with dr.suspend_grad():
        found, quadrature = (
            np.array(Emission(media, sampled).estimate(here, IMAGE, mi.Bool(True)).light.value).reshape(3, 8, n)
            for sampled in (True, False)
        )
    error, missed = (np.abs(x.mean(axis=2).T - truth).max() / truth.max() for x in (found, quadrature))
    assert error < 2e-4
    # Nearly all light of the thin medium is of the emission density, a cubic along a ray as Gauss points have it.
    assert missed > 1e-3 or density < 1
    # What is left of the noise: not much more than Gauss points miss.
    assert found.std(axis=2).max() < 20 * max(missed, 1e-2) * truth.max()


# -- Parts of a cell ---------------------------------------------------------------------------------------------------


def shift_along_x(x: float) -> np.ndarray:
    to_world = np.eye(4)
    to_world[0, 3] = x
    return to_world


CASES = {
    "the same voxels": (8, np.eye(4), 1),
    "coarser": (4, np.eye(4), 1),
    "three times as fine": (24, np.eye(4), 3),
    "too fine": (200, np.eye(4), MAX_PARTS),
    "beyond the box": (8, np.diag([2.0, 2, 2, 1]), 1),
    "ends at a voxel's face": (4, np.diag([0.5, 0.5, 0.5, 1]), 2),
    "ends at a voxel's centre": (4, np.diag([0.5625, 0.5625, 0.5625, 1]), 1),
    "begins at a voxel's face": (4, shift_along_x(0.125), 2),
    "ends anywhere": (4, np.diag([0.53, 1, 1, 1]), 4),
    "turned": (4, FRAMES["rotated"], 4),
}
"""Voxels of the emission along an edge, its place; the extinction has 8 on the unit cube."""


@pytest.mark.parametrize("name", CASES)
def test_parts_of_a_cell(name: str) -> None:
    count, place, parts = CASES[name]
    emission = mi.load_dict({"type": "mivol_voxels", "data": dr_zeros(count), "to_world": mi.ScalarTransform4f(place)})
    view = make_view(emission)
    assert count_parts(view) == parts
    if name == "three times as fine":
        assert voxel_to_cell_ratio(emission, view) == pytest.approx(1 / 3)


def dr_zeros(count: int) -> mi.TensorXf:
    return mi.TensorXf(np.zeros((count, count, count, 1), np.float32))


def make_view(emission: mi.Volume | float | None) -> MediumView:
    """The part of a medium's view that counts."""
    view = MediumView.__new__(MediumView)
    values = {
        "emission": emission,
        "albedo": 0.5,
        "stock_boxes": {},
        "parts": [],
        "emission_lattice": Lattice(dr_zeros(8), np.eye(4)),
    }
    for key, value in values.items():
        object.__setattr__(view, key, value)
    return view


def test_numbers_need_no_parts() -> None:
    assert count_parts(make_view(None)) == count_parts(make_view(2.0)) == 1
