"""AOVs of the integrator: optical depth, opacity and mean distance against closed forms and the float64 twin."""

from __future__ import annotations

import itertools
import math
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aov_scenes import CUBE, EPS, grid, rays, see
from oracle import box_interval, depth_twin, overlap, sphere_interval, tau_scale, tau_twin, to_lattice, trilinear
from refusals import assert_refused

from mivol.transport.line_integrals import aovs
from scenes import as_float32, ball_of, box_of, camera, centred, grid_volume, medium, render, rotation, sky

TURNED = as_float32(centred(rotation([1, 2, 0], 0.5), (0.1, 0, 0)))
SMALL = as_float32(centred(0.5 * rotation([1, 2, 0], 0.5), (0.05, 0, 0)))
RGB = [0.9, 0.2, 3.0]


# -- The twin: media as pairs (interval(o, d), sigma(o, d, t)): where along a ray, and how much (m, C) ---


def grid_field(values, place, interval=None):
    def sigma(o, d, t):
        q, dq = to_lattice(values, place, o, d)
        inside = overlap((0, math.inf), box_interval(place, o, d))
        return trilinear(values, q + t[:, None] * dq) * ((t >= inside[0]) & (t <= inside[1]))[:, None]

    return interval or (lambda o, d: box_interval(place, o, d)), sigma


def constant_field(value, interval):
    return interval, lambda o, d, t: np.broadcast_to(np.atleast_1d(value), (len(t), np.size(value)))


def in_box(place):
    return lambda o, d: box_interval(place, o, d)


def in_ball(centre, radius):
    return lambda o, d: sphere_interval(centre, radius, o, d)


def twin(fields, o, d, channels, surface=None, n=3000):
    """Alpha and depth along one ray through media; breaks at every end of a medium."""
    pieces = [(overlap((0, math.inf), interval(o, d)), sigma) for interval, sigma in fields]
    ends = sorted({t for ab, _ in pieces for t in ab})

    def sigma(t):
        total = np.zeros((len(t), channels))
        for (a, b), f in pieces:
            total = total + f(o, d, t) * ((t >= a) & (t <= b))[:, None]
        return total

    return depth_twin(sigma, ends, surface, n)


SCENES = {
    "grid": lambda: (
        {"box": box_of(medium("mivol_medium", grid_volume("mivol_voxels", grid(1), TURNED)), TURNED)},
        [grid_field(grid(1), TURNED)],
    ),
    "rgb": lambda: (
        {"box": box_of(medium("mivol_medium", grid_volume("mivol_voxels", grid(2, 3), CUBE)), CUBE)},
        [grid_field(grid(2, 3), CUBE)],
    ),
    "stock, scaled": lambda: (
        {"box": box_of(medium("heterogeneous", grid_volume("gridvolume", grid(3), CUBE), scale=3.0), CUBE)},
        [grid_field(3 * grid(3), CUBE)],
    ),
    "grid and constant": lambda: (
        {
            "box": box_of(
                {
                    "type": "mivol_medium",
                    "sigma_a": grid_volume("mivol_voxels", grid(4), SMALL),
                    "sigma_s": {"type": "rgb", "value": RGB},
                },
                CUBE,
            )
        },
        [grid_field(grid(4), SMALL), constant_field(as_float32(RGB), in_box(CUBE))],
    ),
    "two boxes, the near one last, and balls": lambda: (
        {
            "a": box_of(medium("mivol_medium", grid_volume("mivol_voxels", grid(5), CUBE)), CUBE),
            "ball": ball_of(medium("homogeneous", 0.9), [0, 0, -1.5], 0.6),
            "small": ball_of(medium("homogeneous", 1.4), [0, 0, 2.6], 0.4),
            "b": box_of(medium("mivol_medium", {"type": "rgb", "value": RGB}), centred(0.8 * np.eye(3), (0, 0, 1.3))),
        },
        [
            grid_field(grid(5), CUBE),
            constant_field(0.9, in_ball([0, 0, -1.5], 0.6)),
            constant_field(1.4, in_ball([0, 0, 2.6], 0.4)),
            constant_field(as_float32(RGB), in_box(centred(0.8 * np.eye(3), (0, 0, 1.3)))),
        ],
    ),
    "grid in a ball": lambda: (
        {"ball": ball_of(medium("mivol_medium", grid_volume("mivol_voxels", grid(6), CUBE)), [0, 0, 0], 0.4)},
        [grid_field(grid(6), CUBE, in_ball([0, 0, 0], 0.4))],
    ),
}


@pytest.mark.slow_for(
    "grid and constant-False", "grid in a ball-False", "rgb-False", "two boxes, the near one last, and balls-False"
)
@pytest.mark.parametrize("walled", [False, True])
@pytest.mark.parametrize("name", SCENES)
def test_depth_and_alpha_against_the_twin(name, walled):
    parts, fields = SCENES[name]()
    height = -0.21
    if walled:
        parts["wall"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, height]).scale(9)}
    image, o, d = see(parts, *rays(), "depth,alpha")
    for i in range(len(o)):
        end = (height - o[i, 2]) / d[i, 2] if walled else None
        alpha, depth = twin(fields, o[i], d[i], 3, end)
        # The twin's midpoints err by 1e-6; the scheme by the sixth power of a cell's optical depth (at most 1: 2e-5 of a cell
        # of 0.1); the ends of balls are Mitsuba's, to a few EPS of 4 lengths; depth itself is a float32 number of 4.
        assert image[i, 1] == pytest.approx(alpha, abs=4e-6)
        assert image[i, 0] == pytest.approx(depth, abs=8e-6)
    assert np.ptp(image[:, 0]) > 0.01


def test_camera_inside():
    """Hard case 45."""
    fog = {**medium("mivol_medium", grid_volume("mivol_voxels", grid(7), CUBE)), "id": "fog"}
    parts = {"fog": fog, "box": box_of({"type": "ref", "id": "fog"}, CUBE)}
    o = as_float32(np.random.default_rng(7).uniform(-0.4, 0.4, (6, 3)))
    d = np.random.default_rng(8).normal(size=(6, 3))
    d = as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    image, o, d = see(parts, o, d, "depth,alpha", inside="fog")
    for i in range(6):
        alpha, depth = twin([grid_field(grid(7), CUBE)], o[i], d[i], 1)
        assert image[i] == pytest.approx([depth, alpha], abs=4e-6)


def test_nothing_there():
    # 0 where alpha is 0: beside the medium, in an empty one, and in a scene without media.
    image, *_ = see({"box": box_of(medium("homogeneous", 1.0), CUBE)}, [[3.0, 3, 3]], [[0, 0, -1.0]], "tau,alpha,depth")
    assert np.array_equal(image, np.zeros((1, 3)))
    empty = medium("mivol_medium", grid_volume("mivol_voxels", np.zeros((4, 4, 4)), CUBE))
    image, *_ = see({"box": box_of(empty, CUBE)}, *rays(2), "tau,alpha,depth")
    assert np.array_equal(image, np.zeros((2, 3)))
    image, o, _ = see({"wall": {"type": "sphere"}}, [[0.0, 0, 3], [0, 2, 3]], [[0, 0, -1.0], [0, 0, -1]], "tau,alpha,depth")
    assert image == pytest.approx(np.array([[0, 1, o[0, 2] - 1], [0, 0, 0]]), abs=8 * EPS)


def test_a_wall_ends_the_optical_depth():
    parts, _ = SCENES["grid"]()
    parts["wall"] = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.21]).scale(9)}
    image, o, d = see(parts, *rays(), "tau")
    end = (-0.21 - o[:, 2]) / d[:, 2]
    tau, scale = (f(grid(1), TURNED, o, d, 0, end) for f in (tau_twin, tau_scale))
    # The distance of the wall is Mitsuba's, known to a few EPS of 4 lengths.
    assert np.all(np.abs(image - tau) <= 2e-6 * scale + 1e-6 * grid(1).max())


def test_behind_a_wall_is_nothing():
    place = centred(np.eye(3), (0, 0, -2))
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(9)}
    image, o, _ = see(
        {"box": box_of(medium("homogeneous", 1.0), place), "wall": wall}, [[0.1, 0, 2]], [[0, 0, -1.0]], "tau,alpha,depth"
    )
    assert image[0] == pytest.approx([0, 1, o[0, 2]], abs=8 * EPS)


def test_rgb_names_and_their_order():
    values = grid(9, 3)
    parts = {"box": box_of(medium("mivol_medium", grid_volume("mivol_voxels", values, CUBE)), CUBE)}
    names = "tau.B,depth,tau,alpha,tau.G,tau.R"
    image, o, d = see(parts, *rays(), names)
    tau = tau_twin(values, CUBE, o, d)
    bound = 2e-6 * tau_scale(values, CUBE, o, d)
    assert np.all(np.abs(image[:, [5, 4, 0]] - tau) <= bound)
    assert np.all(np.abs(image[:, 2] - tau.mean(axis=1)) <= bound.mean(axis=1))
    assert np.all(np.abs(image[:, 3] + np.expm1(-tau).mean(axis=1)) <= bound.max(axis=1) + 4 * EPS)
    assert mi.load_dict({"type": "mivol", "aovs": names}).aov_names() == names.split(",")


def test_channels_of_a_grey_extinction_are_one():
    parts = {"box": box_of(medium("homogeneous", 1.3), CUBE)}
    image, *_ = see(parts, *rays(), "tau,tau.R,tau.G,tau.B")
    assert np.all(image == image[:, :1])
    assert image.max() > 1


def test_channels_come_after_the_colours_with_their_names():
    parts = {"box": box_of(medium("homogeneous", 1.3), CUBE), "sky": sky(), "sensor": camera([0, 0.5, 3], [0, 0, 0], res=6)}
    parts["sensor"]["film"]["pixel_format"] = "rgba"
    scene = mi.load_dict({"type": "scene", **parts})
    plain = render(scene, {"type": "mivol"}, 4)
    image = render(scene, {"type": "mivol", "aovs": "depth, tau"}, 4)
    assert (plain.shape[2], image.shape[2]) == (4, 6)
    assert np.array_equal(image[..., :4], plain)
    struct = scene.sensors()[0].film().bitmap().struct_()
    assert [struct[i].name for i in range(6)] == ["R", "G", "B", "A", "depth", "tau"]


def test_hide_emitters_does_not_touch_them():
    parts = {"box": box_of(medium("homogeneous", RGB[0]), CUBE), "sky": sky()}
    shown, *_ = see(parts, *rays(), "tau,alpha,depth")
    hidden, *_ = see(parts, *rays(), "tau,alpha,depth", hide_emitters=True)
    assert np.array_equal(shown, hidden)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_a_crop_is_a_piece_of_the_whole(rfilter):
    # A box filter sees the same pixels of a constant picture; what a wide one sees differs by its samples only.
    def pixels(**crop):
        sensor = camera([0.0, 0.0, 300.0], [0, 0, 0], res=6, fov=0.02)
        sensor["film"] |= {"rfilter": {"type": rfilter}, **crop}
        parts = {"box": box_of(medium("homogeneous", 0.9), centred(np.diag([40.0, 40, 1]))), "sensor": sensor}
        return render(mi.load_dict({"type": "scene", **parts}), {"type": "mivol", "aovs": "alpha,depth,tau"}, 8)

    whole = pixels()
    piece = pixels(crop_width=3, crop_height=1, crop_offset_x=2, crop_offset_y=4)
    assert piece.shape == (1, 3, 6)
    # A depth of 300 is known to 16 EPS of it; a quotient of weighted sums adds a few.
    assert piece == pytest.approx(whole[4:5, 2:5], rel=32 * EPS)


def test_a_sample_of_a_nested_integrator():
    # Integrators that nest this one call sample(): `moment` puts the AOVs after its own channels.
    parts = {"box": box_of(medium("homogeneous", 0.9), CUBE), "sky": sky(), "sensor": camera([0, 0.5, 3], [0, 0, 0], res=4)}
    scene = mi.load_dict({"type": "scene", **parts})
    integrator = mi.load_dict({"type": "mivol", "aovs": "tau,depth"})
    sampler = mi.load_dict({"type": "independent"})
    o, d = rays(5)
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    sampler.seed(0, 5)
    L, _, aovs, state = integrator.sample(scene, sampler, ray)
    assert len(aovs) == 2 and state is None
    assert np.array(dr.exp(-aovs[0])) == pytest.approx(np.array(L.x), rel=8 * EPS)
    masked = integrator.sample(scene, sampler, ray, None, mi.Bool([True, False, True, True, False]))[2]
    assert np.array_equal(np.array(masked[0]) == 0, [False, True, False, False, True])


# -- What it costs, and what is refused --------------------------------------------------------------------------------


def kernels(aovs, backward=False):
    """IR of all kernels of a render, or of a gradient step."""
    values = grid(10)
    box = box_of(medium("mivol_medium", grid_volume("mivol_voxels", values, CUBE)), CUBE)
    scene = mi.load_dict({"type": "scene", "box": box, "sky": sky(), "sensor": camera([0, 0.5, 3], [0, 0, 0], res=4)})
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1, "aovs": aovs})
    params = mi.traverse(scene)
    channels = 3 + len(integrator.aov_names())
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        if backward:
            dr.enable_grad(params["box.interior_medium.sigma_t.data"])
            integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (4, 4, channels)), spp=1)
        else:
            integrator.render(scene, spp=1)
        dr.eval()
        return "".join(k["ir"].getvalue() for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT)


@pytest.mark.slow_for("True-expected1")
@pytest.mark.parametrize(("backward", "expected"), [(False, (2, 3, 4)), (True, (3, 5, 8))])
def test_nothing_runs_that_was_not_asked_for(backward, expected, monkeypatch):
    # Walks are the loops of this scene, and one loop reads the extremes of the grid's blocks. Without AOVs there is the
    # radiance's walk, and its replay; tau and alpha share one, and its transpose; the depth is a sweep, its derivative a sweep
    # that measures and one that pulls. Where a depth is not asked for, its formula is not even traced.
    def loops(aovs):
        return len(re.findall(r"^l_\d+_cond:", kernels(aovs, backward), re.MULTILINE))

    assert (loops(""), loops("tau,alpha"), loops("tau,alpha,depth")) == expected

    def forbidden(*_, **__):
        raise AssertionError("a depth that nobody asked for")

    monkeypatch.setattr(aovs, "integrate_distance_in_cell", forbidden)
    assert (loops(""), loops("tau,alpha")) == expected[:2]
    with pytest.raises(RuntimeError, match="while_loop"):
        loops("depth")


@pytest.mark.parametrize(("aovs", "match"), [("tau,taau", "did you mean"), ("tau, depth, tau", "2 times")])
def test_wrong_names_are_refused(aovs, match):
    with pytest.raises(Exception, match=match):
        mi.load_dict({"type": "mivol", "aovs": aovs})


@pytest.mark.parametrize("sigma", [1e-8, 1e-3, 0.7, 20.0, 1e3, 1e6])
@pytest.mark.parametrize("kind", ["homogeneous", "grid"])
def test_depth_of_a_slab_at_any_optical_depth(sigma, kind):
    # 1/sigma - L T / (1 - T) behind the entry: L/2 where it is thin, 1/sigma where it is thick.
    """Hard case 1."""
    sigma = float(as_float32(sigma))
    values = np.full((7, 3, 2), sigma)
    inside = medium("heterogeneous", grid_volume("gridvolume", values))
    if kind == "homogeneous":
        inside = medium("homogeneous", sigma)
    image, o, _ = see({"box": box_of(inside, np.eye(4))}, [[0.3, 0.4, -1]], [[0, 0, 1]], "tau,alpha,depth")
    behind = 0.5 - sigma / 12 if sigma < 1e-2 else 1 / sigma - (1 / math.expm1(sigma) if sigma < 500 else 0)
    assert image[0, 0] == pytest.approx(sigma, rel=16 * EPS)
    assert image[0, 1] == pytest.approx(-math.expm1(-sigma), rel=16 * EPS)
    assert image[0, 2] == pytest.approx(-o[0, 2] + behind, rel=16 * EPS)


def test_depth_where_a_medium_never_ends():
    # The camera in a fog without a boundary in front of it, 1/sigma; a surface at 2 cuts it: (1 - T)/sigma.
    sigma = 0.8
    fog = {**medium("homogeneous", sigma), "id": "fog"}
    ball = ball_of({"type": "ref", "id": "fog"}, [0, 0, -50], 1.0)
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 2.0]).scale(0.5)}
    o, d = np.zeros((2, 3)), np.array([[0, 0, 1.0], [0, 1.0, 0]])
    image, o, _ = see({"fog": fog, "ball": ball, "wall": wall}, o, d, "depth,alpha", inside="fog")
    length = 2.0 - o[0, 2]
    assert image[0] == pytest.approx([-math.expm1(-sigma * length) / sigma, 1.0], rel=16 * EPS)
    assert image[1] == pytest.approx([1 / sigma, 1.0], rel=16 * EPS)


def test_depth_is_of_sixth_order():
    # A smooth field on a line, twice as fine twice: the error falls by 2^6 = 64 each time. In the cell formula's own
    # terms, in float64, since float32 ends at 1e-7: the very function that the walk calls, on a double variant of lanes.
    def depth(n: int) -> float:
        edges = np.linspace(0, 3, n + 1)
        points = edges[:-1, None] + np.diff(edges)[:, None] * (0.5 + math.sqrt(15) / 10 * np.array([-1, 0, 1]))
        lanes = [mi.Float64(np.ascontiguousarray(c)) for c in (1 + 0.8 * np.sin(2 * points + 0.3)).T]
        stop = aovs.integrate_distance_in_cell(mi.Float64(edges[:-1]), mi.Float64(np.diff(edges)), *lanes)
        T, N = np.array(stop.T), np.array(stop.N)
        front = np.cumprod(np.concatenate([[1], T]))
        return float((front[:-1] * N).sum() / (1 - front[-1]))

    _, exact = depth_twin(lambda t: (1 + 0.8 * np.sin(2 * t + 0.3))[:, None], np.linspace(0, 3, 31), n=40_000)
    errors = [abs(depth(n) - exact) for n in (5, 10, 20)]
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert min(orders) > 5.5, errors


def test_two_grids_that_differ_are_refused_for_depth_only():
    inside = {
        "type": "mivol_medium",
        "sigma_a": grid_volume("mivol_voxels", grid(11), CUBE),
        "sigma_s": grid_volume("mivol_voxels", grid(12, shape=(4, 4, 4)), CUBE),
    }
    parts = {"box": box_of(inside, CUBE)}
    image, o, d = see(parts, *rays(3), "tau,alpha")
    tau = tau_twin(grid(11), CUBE, o, d) + tau_twin(grid(12, shape=(4, 4, 4)), CUBE, o, d)
    assert image[:, :1] == pytest.approx(tau, rel=1e-5)
    assert_refused("depth was asked for and a medium sums grids", see, parts, *rays(3), "depth")
