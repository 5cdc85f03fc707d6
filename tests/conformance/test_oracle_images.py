"""Pictures by the integrator `mivol` against closed forms, the float64 twin, and stock Mitsuba.

Pencil rays (a radiancemeter for each) have no footprint, so an absorbing scene has one right answer for each of them;
cameras are compared by tests whose rate of false alarms is set. Stock Mitsuba is a judge only where it is right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import pytest
from aov_scenes import shoot
from false_alarms import Estimate, assert_precise, assert_same_mean, difference, fresh
from oracle import box_interval, overlap, pixel_means, sphere_interval, tau_scale, tau_twin
from scattering_scenes import cases

from mivol.validate.statistics import Moments
from scenes import (
    FRAMES,
    affine,
    as_float32,
    ball_of,
    box_of,
    camera,
    centred,
    grid_volume,
    medium,
    pixel_rays,
    render,
    rotation,
    sky,
)

BOUND = 2e-6
EPS = 2.0**-23
ODD_FRAMES = ("stretched", "rotated", "sheared", "mirrored")
KINDS = {"stock": ("heterogeneous", "gridvolume"), "own": ("mivol_medium", "mivol_voxels")}
MIXED = {"mixed": ("heterogeneous", "mivol_voxels")}


def mivol(**more):
    return {"type": "mivol", **more}


@dataclass
class Seen:
    """What was seen, (n, channels), along which rays (n, 3): those that the sensor sent out, to the last bit."""

    image: np.ndarray
    o: np.ndarray
    d: np.ndarray


def see(parts, o, d, integrator=None, inside=None, spp=1, seed=0):
    """What an integrator sees along rays (n, 3), one pixel for each; `inside` names the medium around the sensor."""
    return Seen(*shoot(parts, o, d, integrator or mivol(), inside, spp, seed))


def random_grid(seed, channels=1, top=4.0):
    return as_float32(top * np.random.default_rng(seed).uniform(0, 1, (5, 6, 7, channels)) ** 2)


def aimed_rays(seed, centre, size, n=12, away=3.0):
    """Rays from `away` sizes away, aimed into a ball around the centre."""
    rng = np.random.default_rng([seed, 99])
    o = rng.normal(size=(n, 3))
    o = as_float32(np.asarray(centre) + away * size * o / np.linalg.norm(o, axis=1, keepdims=True))
    d = np.asarray(centre) + size * rng.uniform(-0.4, 0.4, (n, 3)) - o
    return o, as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))


def unmirrored(to_world):
    """The same box by a frame of positive determinant: a mirrored boundary shape would turn its inside out."""
    to_world = np.asarray(to_world)
    return to_world if np.linalg.det(to_world[:3, :3]) > 0 else to_world @ affine(np.diag([-1.0, 1, 1]), (1, 0, 0))


def in_frame(kind, values, to_world, boundary=None):
    """A grid in its own box (or in another), under a constant sky."""
    medium_type, volume_type = (KINDS | MIXED)[kind]
    interior = medium(medium_type, grid_volume(volume_type, values, to_world))
    return {"sky": sky(), "smoke": box_of(interior, unmirrored(to_world) if boundary is None else boundary)}


def assert_transmittance(seen, tau, slack, radiance=1.0):
    """What was seen is exp(-tau), where tau may err by `slack` and exp and the film by a few EPS."""
    exact = np.broadcast_to(np.exp(-tau), (len(tau), 3)) * radiance
    error = np.abs(seen.image[:, :3] - exact)
    allowed = exact * (slack + 8 * EPS) + 1e-37
    worst = np.unravel_index(np.argmax(error / allowed), error.shape)
    assert np.all(error <= allowed), (
        f"ray {seen.o[worst[0]].tolist()} + t {seen.d[worst[0]].tolist()}, channel {worst[1]}: {seen.image[worst]!r} was "
        f"seen, {exact[worst]!r} +- {allowed[worst]:.2g} expected"
    )


def assert_grid_is_seen(seen, values, to_world, t_max=math.inf, factor=1.0, more=0.0, radiance=1.0):
    """Transmittance of one grid; `more` is what tau may err by beyond the bound of the walk."""
    tau = tau_twin(values, to_world, seen.o, seen.d, 0, t_max)
    slack = BOUND * tau_scale(values, to_world, seen.o, seen.d, 0, t_max)
    assert_transmittance(seen, factor * tau, factor * slack + more, radiance)


def chords(seen, interval):
    """Length (n, 1) of the part of each ray ahead of its origin that lies in an interval(o, d)."""
    return np.diff([overlap((0, math.inf), interval(*ray)) for ray in zip(seen.o, seen.d, strict=True)], axis=1)


# -- Closed forms and the twin, ray by ray -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "inside"),
    [
        (FRAMES["stretched"], medium("homogeneous", 0.7)),
        (FRAMES["rotated"], medium("homogeneous", 0.7)),
        (np.eye(4), medium("heterogeneous", {"type": "constvolume", "value": 0.7})),
    ],
    ids=["stretched", "rotated", "constvolume"],
)
def test_homogeneous_box(frame, inside):
    to_world = as_float32(unmirrored(frame))
    size = np.linalg.norm(to_world[:3, :3] @ np.ones(3))
    seen = see(
        {"sky": sky(), "box": box_of(inside, to_world)},
        *aimed_rays(1, to_world[:3] @ [0.5, 0.5, 0.5, 1], size / 4, away=8),
    )
    chord = chords(seen, lambda o, d: box_interval(to_world, o, d))
    assert chord.max() > 0
    # The box is the one that Mitsuba's cube holds: its float32 matrix, found in float64.
    assert_transmittance(seen, 0.7 * chord, 0.7 * BOUND * (chord + size))


def test_homogeneous_sphere():
    # Mitsuba intersects the boundary in float32 at 1.5 radii of distance, to a few EPS of the coordinates (up to 4); its
    # spawned rays start 1e-4 beside the line, which the length of a chord must not show.
    seen = see({"sky": sky(), "ball": ball_of(medium("homogeneous", 2.5), [1, 2, 3], 0.5)}, *aimed_rays(2, [1, 2, 3], 0.5))
    chord = chords(seen, lambda o, d: sphere_interval([1, 2, 3], 0.5, o, d))
    assert_transmittance(seen, 2.5 * chord, 2.5 * 4e-6)


@pytest.mark.parametrize(("kind", "name"), [*((kind, name) for name in ODD_FRAMES for kind in KINDS), ("mixed", "rotated")])
def test_grid_in_any_frame(kind, name):
    to_world, values = as_float32(FRAMES[name]), random_grid(3)
    size = np.linalg.norm(to_world[:3, :3] @ np.ones(3))
    o, d = aimed_rays(3, to_world[:3] @ [0.5, 0.5, 0.5, 1], size / 4, away=8)
    assert_grid_is_seen(see(in_frame(kind, values, to_world), o, d), values, to_world)


@pytest.mark.slow_for("stock")
@pytest.mark.parametrize("kind", KINDS)
def test_rgb_extinction(kind):
    to_world, values = as_float32(FRAMES["rotated"]), random_grid(4, 3)
    values[..., 1] = as_float32(1e-4 * values[..., 1])
    values[..., 2] = 0
    o, d = aimed_rays(4, to_world[:3] @ [0.5, 0.5, 0.5, 1], 1.0)
    seen = see(in_frame(kind, values, to_world), o, d)
    assert_grid_is_seen(seen, values, to_world)
    # Each channel is its own grey picture.
    for c in range(3):
        grey = see(in_frame(kind, values[..., c : c + 1], to_world), o, d)
        assert np.all(np.abs(grey.image - seen.image[:, c : c + 1]) <= 4 * EPS)


def test_homogeneous_rgb_extinction():
    sigma_t, to_world = np.array([0.2, 0.9, 0.0]), centred(np.eye(3))
    parts = {"sky": sky(), "box": box_of(medium("homogeneous", {"type": "rgb", "value": list(sigma_t)}), to_world)}
    seen = see(parts, *aimed_rays(5, [0, 0, 0], 0.5))
    chord = chords(seen, lambda o, d: box_interval(to_world, o, d))
    assert_transmittance(seen, chord * as_float32(sigma_t), BOUND * (chord + 1))


@pytest.mark.parametrize("kind", KINDS)
def test_scale_multiplies_the_extinction(kind):
    values = random_grid(6)
    medium_type, volume_type = KINDS[kind]
    interior = medium(medium_type, grid_volume(volume_type, values), scale=2.5)
    seen = see({"sky": sky(), "smoke": box_of(interior, np.eye(4))}, *aimed_rays(6, [0.5, 0.5, 0.5], 1))
    assert_grid_is_seen(seen, values, np.eye(4), factor=2.5)


@pytest.mark.parametrize("kinds", [("stock", "stock"), ("stock", "own"), ("own", "own")])
def test_several_media_along_a_ray(kinds):
    frames = [as_float32(centred(rotation([0, 0, 1], 0.3), (0, 0, 2.0 * i))) for i in range(2)]
    grids = [random_grid(7 + i, top=2.0) for i in range(2)]
    o = np.array([[0.1, 0.2, -3], [-0.2, 0.1, 6], [0.0, 0, 1.0], [2, 0, 0]])
    d = np.array([[0.01, -0.02, 1], [0.02, 0.01, -1], [0.1, 0, 1], [-1, 0.1, 0.0]])
    parts = {"ball": ball_of(medium("homogeneous", 0.5), [0, 0, 4], 0.5)}
    for i, (kind, values, frame) in enumerate(zip(kinds, grids, frames, strict=True)):
        parts |= {k + (str(i) if k != "sky" else ""): v for k, v in in_frame(kind, values, frame).items()}
    seen = see(parts, o, d / np.linalg.norm(d, axis=1, keepdims=True))
    tau = 0.5 * chords(seen, lambda o, d: sphere_interval([0, 0, 4], 0.5, o, d))
    tau = tau + sum(tau_twin(v, f, seen.o, seen.d) for v, f in zip(grids, frames, strict=True))
    scale = sum(tau_scale(v, f, seen.o, seen.d) for v, f in zip(grids, frames, strict=True))
    assert_transmittance(seen, tau, BOUND * scale + 0.5 * 8e-6)


@pytest.mark.parametrize("shapes", ["sphere", "cube", "sphere cube"])
def test_many_equal_media_along_a_ray(shapes):
    # Mitsuba's loader makes one object of media that are equal: each boundary must still count once. And there are more
    # of them than max_depth: boundaries are not scattering.
    build = {
        "sphere": lambda fog, middle: ball_of(fog, middle, 1.0),
        "cube": lambda fog, middle: box_of(fog, centred(2 * np.eye(3), middle)),
    }
    parts = {"sky": sky()}
    for i in range(12):
        shape = shapes.split()[i % len(shapes.split())]
        parts[f"fog{i:02d}"] = build[shape](medium("homogeneous", 0.1), np.array([0, 0, 3.0 * i]))
    seen = see(parts, [0, 0, -5], [0, 0, 1], mivol(max_depth=2))
    # 24 ends at coordinates of up to 34, each known to a few EPS of that.
    assert_transmittance(seen, np.array([[0.1 * 2 * 12]]), 0.1 * 24 * 34 * 4 * EPS)


def test_one_grid_in_two_boundaries():
    # The grid fills both boxes and the gap between them; the gap is vacuum.
    values, place = random_grid(29), centred(np.diag([1.0, 1, 4]))
    interior = medium("heterogeneous", grid_volume("gridvolume", values, place))
    boxes = [centred(np.eye(3), (0, 0, z)) for z in (-1.0, 1.0)]
    parts = {"sky": sky(), "upper": box_of(interior, boxes[1]), "lower": box_of(interior, boxes[0])}
    seen = see(parts, *aimed_rays(29, [0, 0, 0], 0.8, away=6))
    tau = sum(
        np.array([tau_twin(values, place, *ray, *box_interval(box, *ray)) for ray in zip(seen.o, seen.d, strict=True)])
        for box in boxes
    )
    assert_transmittance(seen, tau, 2 * BOUND * tau_scale(values, place, seen.o, seen.d) + values.max() * 8 * EPS)


# -- Boundaries that are not the grid's box ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_vacuum_between_boundary_and_dense_grid(kind):
    # Majorant 500 over 10 lengths of empty boundary: 1, where tracking with a global majorant underflows to 0.
    """Hard case 3."""
    values = np.full((4, 4, 4, 1), 500.0)
    parts = in_frame(kind, values, np.eye(4), boundary=centred(10 * np.eye(3)))
    image = see(parts, [[-9, 3, 3], [0.5, 0.5, -9]], [[1, 0, 0], [0, 0, 1]]).image
    assert np.array_equal(image[0, :3], np.ones(3))
    assert np.array_equal(image[1, :3], np.zeros(3))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ODD_FRAMES[1:])
def test_boundary_larger_than_the_grid(kind, name):
    # Outside its own box a grid is vacuum, even where stock Mitsuba fills a rotated grid's bounding box.
    """Hard case 4."""
    to_world, values = as_float32(FRAMES[name]), random_grid(8)
    middle, size = to_world[:3] @ [0.5, 0.5, 0.5, 1], np.linalg.norm(to_world[:3, :3] @ np.ones(3))
    boundary = as_float32(centred(3 * size * rotation([1, 0, 1], 0.4), middle))
    seen = see(in_frame(kind, values, to_world, boundary), *aimed_rays(8, middle, size / 3, away=12))
    # A stock grid tells its place to 6 digits only, and no boundary helps: half a digit of the box's coordinates.
    digits = 5e-6 * np.abs(middle).max() + 1e-6 * size if kind == "stock" else 0
    h = size / math.sqrt(3) / 7
    scale = tau_scale(values, to_world, seen.o, seen.d)
    assert_grid_is_seen(seen, values, to_world, more=digits / h * (scale + values.max() * h))


@pytest.mark.parametrize("kind", KINDS)
def test_boundary_smaller_than_the_grid(kind):
    """Hard case 4."""
    to_world, values = as_float32(FRAMES["rotated"]), random_grid(9)
    medium_type, volume_type = KINDS[kind]
    centre = as_float32(to_world[:3] @ [0.5, 0.5, 0.5, 1])
    interior = medium(medium_type, grid_volume(volume_type, values, to_world))
    seen = see({"sky": sky(), "ball": ball_of(interior, centre, 0.3)}, *aimed_rays(9, centre, 0.35))
    rays = list(zip(seen.o, seen.d, strict=True))
    tau = np.array([tau_twin(values, to_world, *ray, *sphere_interval(centre, 0.3, *ray)) for ray in rays])
    # The ends are Mitsuba's float32 intersections with a sphere about one length away: a few EPS each.
    assert_transmittance(seen, tau, BOUND * tau_scale(values, to_world, seen.o, seen.d) + values.max() * 4e-6)


# -- Cameras inside, surfaces, lights -------------------------------------------------------------------------------------


def test_camera_inside_a_sphere():
    # sigma = 1, R = 1, camera in the middle: e^-1.
    """Hard case 45."""
    ball = ball_of({"type": "ref", "id": "fog"}, [0, 0, 0], 1)
    parts = {"fog": {**medium("homogeneous", 1.0), "id": "fog"}, "sky": sky(), "ball": ball}
    seen = see(parts, np.zeros((3, 3)), [[0, 0, 1], [0.6, 0.8, 0], [-1, 0, 0]], inside="fog")
    # The radiancemeter starts its rays a RayEpsilon ahead of where it stands, 9e-5.
    assert_transmittance(seen, 1 - np.linalg.norm(seen.o, axis=1)[:, None], 4 * EPS)
    assert np.all(np.abs(seen.image - math.exp(-1)) < 1e-4)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sigma", [1.0, 60.0])
def test_camera_inside_a_dense_grid(kind, sigma):
    """Hard case 45."""
    values, to_world = sigma * random_grid(10, top=1.0), np.eye(4)
    medium_type, volume_type = KINDS[kind]
    fog = {**medium(medium_type, grid_volume(volume_type, values)), "id": "fog"}
    parts = {"fog": fog, "sky": sky(), "box": box_of({"type": "ref", "id": "fog"}, to_world)}
    rng = np.random.default_rng(10)
    o, d = as_float32(rng.uniform(0.1, 0.9, (8, 3))), rng.normal(size=(8, 3))
    d = as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    assert_grid_is_seen(see(parts, o, d, inside="fog"), values, to_world)


def wall(height, bsdf=None, **more):
    """A square of edge 2 in the plane z = height, facing up."""
    shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, height]), **more}
    return shape if bsdf is None else {**shape, "bsdf": bsdf}


@pytest.mark.slow_for("-0.21-own", "-0.21-stock")
@pytest.mark.parametrize(
    ("height", "kind"),
    cases(
        [(z, kind) for z in (-2.0, -0.21, 0.13) for kind in KINDS],
        [(z, kind) for z in (-2.0, 0.13) for kind in KINDS if (z, kind) != (0.13, "own")],
    ),
)
def test_luminous_wall_in_or_behind_the_medium(kind, height):
    # The wall stops the ray: its own radiance through what lies in front, nothing of what lies behind.
    to_world, values = as_float32(centred(np.eye(3))), random_grid(11)
    parts = in_frame(kind, values, to_world)
    parts["wall"] = wall(height, emitter={"type": "area", "radiance": 2.0})
    o = as_float32(np.column_stack([np.random.default_rng(11).uniform(-0.3, 0.3, (8, 2)), np.full(8, 3.0)]))
    d = as_float32(np.tile(np.array([0.04, -0.03, -1]) / np.linalg.norm([0.04, -0.03, -1]), (8, 1)))
    for depth in (1, 2, -1):
        seen = see(parts, o, d, mivol(max_depth=depth))
        # The wall's distance is Mitsuba's, known to a few EPS of 3 lengths.
        end = (as_float32(height) - seen.o[:, 2]) / seen.d[:, 2]
        assert_grid_is_seen(seen, values, to_world, end, more=values.max() * 12 * EPS, radiance=2.0)


@pytest.mark.parametrize("kind", KINDS)
def test_surface_in_the_medium_lit_by_a_point_light(kind):
    # L = rho/pi I cos/r^2 T(light) T(camera), at depth 2; at depth 1 the wall is black.
    to_world, values = as_float32(centred(2 * np.eye(3))), random_grid(12, top=0.7)
    rho, power, light, height = 0.6, 5.0, np.array([0.3, -0.2, 1.9]), -0.37
    parts = in_frame(kind, values, to_world)
    del parts["sky"]
    parts["wall"] = wall(height, {"type": "diffuse", "reflectance": {"type": "uniform", "value": rho}})
    parts["light"] = {"type": "point", "position": list(light), "intensity": power}
    o = np.column_stack([np.random.default_rng(12).uniform(-0.6, 0.6, (8, 2)), np.full(8, 3.0)])
    o, d = as_float32(o), as_float32(np.tile(np.array([0.1, 0.05, -1]) / np.linalg.norm([0.1, 0.05, -1]), (8, 1)))
    seen = see(parts, o, d, mivol(max_depth=2))
    o, d = seen.o, seen.d
    end = (height - o[:, 2]) / d[:, 2]
    x = o + end[:, None] * d
    r = np.linalg.norm(light - x, axis=1)
    towards = (light - x) / r[:, None]
    tau = tau_twin(values, to_world, o, d, 0, end) + tau_twin(values, to_world, x, towards, 0, r)
    exact = rho / math.pi * power * towards[:, 2:] / r[:, None] ** 2 * np.exp(-tau)
    # r^2 and the cosine are float32 numbers, to a few EPS; Mitsuba starts a shadow ray up to 2e-4 above the surface, so
    # that much of sigma may be lost.
    assert np.all(np.abs(seen.image - exact) <= exact * (16 * EPS + 2e-4 * values.max()))
    assert np.array_equal(see(parts, o, d, mivol(max_depth=1)).image, np.zeros((8, 3)))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(("kind", "depth"), cases([("own", 2), ("stock", 3), ("stock", -1)], [("own", 2), ("stock", -1)]))
def test_corner_in_the_medium_lit_by_the_sky(kind, depth):
    # Two white walls that light each other under a constant sky, no closed form: the mean over the picture against stock
    # volpath at the same depth, from independent batches, by Student's t.
    to_world, values = as_float32(centred(2 * np.eye(3))), random_grid(13, 3 if kind == "own" else 1, top=0.7)
    values[...] = values[..., :1]
    parts = in_frame(kind, values, to_world)
    white = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.8}}
    upright = mi.ScalarTransform4f().translate([-0.4, 0, 0]).rotate([0, 1, 0], 90)
    parts |= {"floor": wall(-0.37, white), "side": {"type": "rectangle", "to_world": upright, "bsdf": white}}
    scene = mi.load_dict({"type": "scene", **parts, "sensor": camera([1.5, 0.5, 3], [-0.3, 0, -0.3], res=8, fov=10)})
    seeds = range(16)
    ours = np.array([render(scene, mivol(max_depth=depth, rr_depth=99), 32, fresh(seed)) for seed in seeds])
    stock = {"type": "volpath", "max_depth": depth, "rr_depth": 99}
    theirs = np.array([render(scene, stock, 256, fresh(100 + seed)) for seed in seeds])
    ours, theirs = (Moments.from_values(x.mean(axis=(1, 2, 3))) for x in (ours, theirs))
    assert_same_mean(ours, theirs, what="lit by the sky")
    assert_precise(difference(ours, theirs), 0.01 * theirs.mean, what="lit by the sky")


# -- Cameras with pixels -----------------------------------------------------------------------------------------------------


def framed(parts, centre, distance):
    """A scene whose camera sees nothing but the box."""
    target = np.asarray(centre, dtype=float)
    origin = target + distance * np.array([0.48, -0.8, 0.36])
    return mi.load_dict({"type": "scene", **parts, "sensor": camera(origin, target, res=10, fov=5)})


@pytest.mark.slow_for("own")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", cases(KINDS, ["stock"]))
def test_pixel_means_of_a_camera(kind):
    # A pixel averages T, not tau: the twin's mean over 6 x 6 rays of each pixel, whose error is of second order in 1/6.
    to_world, values = as_float32(centred(np.eye(3))), random_grid(19, top=8.0)
    scene = framed(in_frame(kind, values, to_world), (0, 0, 0), 6)
    k, spp = 6, 256
    o, d = pixel_rays(scene.sensors()[0], k)
    mean, variance = pixel_means(lambda o, d: np.exp(-tau_twin(values, to_world, o, d)), o, d)
    image = render(scene, mivol(), spp, fresh(0))
    assert variance.max() > 1e-6
    known = Estimate(mean, variance / k**4)
    assert_same_mean(Estimate(image[..., :1], variance / spp), known, rounding=1e-6, what="pixel means")
    assert np.array_equal(image[..., 0], image[..., 1])


def test_no_noise_along_pencils():
    to_world, values = as_float32(FRAMES["rotated"]), random_grid(20)
    o, d = aimed_rays(20, (1, 0, 0), 1.0, n=4)
    parts = in_frame("own", values, to_world)
    one = see(parts, o, d, spp=1, seed=0).image
    # A mean of 16 equal float32 numbers: one rounding of the sum and one of the division by the weight.
    assert np.all(np.abs(see(parts, o, d, spp=16, seed=5).image - one) <= 4 * EPS)


# -- AOVs -----------------------------------------------------------------------------------------------------------------


def test_tau_and_alpha_at_any_optical_depth():
    # tau never passes through exp: 1e4 is 1e4; alpha = 1 - T to 4 EPS even at 1e-8; T below float32 is 0, not NaN.
    """Hard case 1."""
    for power in (-8, -4, 0, 2, 4):
        values = np.full((3, 3, 3, 1), 10.0**power)
        for kind in KINDS:
            parts = in_frame(kind, values, np.eye(4))
            image = see(parts, [0.5, 0.5, -1], [0, 0, 1], mivol(aovs="tau,alpha")).image[0]
            tau = as_float32(10.0**power)
            assert image[3] == pytest.approx(tau, rel=8 * EPS)
            assert image[4] == pytest.approx(-math.expm1(-tau), rel=8 * EPS)
            assert np.all(np.abs(image[:3] - math.exp(-tau)) <= math.exp(-tau) * (tau + 1) * 8 * EPS + 1e-37)


# -- Refusals ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_what_scatters_is_seen_through_at_depth_1(kind):
    medium_type, volume_type = KINDS[kind]
    values = random_grid(23)
    interior = medium(medium_type, grid_volume(volume_type, values), albedo=0.5)
    parts = {"sky": sky(), "smoke": box_of(interior, np.eye(4))}
    o, d = aimed_rays(23, [0.5, 0.5, 0.5], 1.0, n=4)
    assert_grid_is_seen(see(parts, o, d, mivol(max_depth=1)), values, np.eye(4))


def test_hidden_emitters():
    to_world, values = np.eye(4), random_grid(24)
    o, d = aimed_rays(24, [0.5, 0.5, 0.5], 1.0, n=4)
    parts = in_frame("own", values, to_world)
    assert np.array_equal(see(parts, o, d, mivol(hide_emitters=True)).image, np.zeros((4, 3)))
