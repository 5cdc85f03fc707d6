"""Light that turns once, by the integrator `mivol`, against closed forms and the float64 twin.

Each ray is a pencil without a footprint; its radiance is the mean of 16 independent renders and held against the exact
one by Student's t (tests/false_alarms.py). Where nothing is sampled (no noise at all) what is left is float32 rounding,
which `rounding` names: 2e-5 of the largest radiance, a few EPS for each of about 50 operations on cells and emitters.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from scattering_scenes import PLACE, aimed, assert_twin, fog, mivol, pencils, point, rough_grid, smoke, spot, sun

import scenes
from mivol.transport.estimators.single_scattering.distance_sampling import MediumEvent
from mivol.transport.estimators.single_scattering.single_scattering import (
    Scattering,
    event_coefficients,
    event_interaction,
)
from mivol.transport.media.scene_media import SceneMedia
from mivol.validate.statistics import Estimate, Moments
from scenes import affine, as_float32, ball_of, box_of, camera, centred, grid_volume, media_of, medium

SPP = 1024


def check(parts, media, emitters, o, d, spp=SPP, integrator=None, level=2e-5, **more):
    """Compare with the exact radiance; rounding is `level` times the largest radiance."""
    seen = pencils(parts | {f"emitter{i}": emitter for i, (emitter, _) in enumerate(emitters)}, o, d)
    known = [twin for _, twin in emitters]
    background = more.get("background", 0.0)
    top = twins.radiance(media, known, seen.o, seen.d, background=background).max()
    assert_twin(seen, media, known, integrator or mivol(), spp, rounding=level * top, **more)


EMITTERS = {
    "point outside": lambda: [point([1.5, 1, 2.0])],
    "point inside": lambda: [point([0.3, -0.2, 0.35])],
    "spot outside": lambda: [spot([1.0, -2, 2.5], [0, 0, 0])],
    "spot inside": lambda: [spot([0.1, 0.2, -0.6], [0.3, 0, 0.5], cutoff=50, beam=10)],
    "sun": lambda: [sun([0.3, 0.2, -1.0])],
    "three": lambda: [point([1.5, 1, 2.0]), spot([1.0, -2, 2.5], [0, 0, 0]), sun([0.3, 0.2, -1.0], 0.3)],
}
PHASES = {"isotropic": ("isotropic", 0.0), "hg": ("hg", 0.6), "backward": ("hg", -0.4), "rayleigh": ("rayleigh", 0.0)}


@pytest.mark.slow_for("point outside-own", "spot inside-own", "spot outside-own", "three-own", "three-stock")
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("emitters", "kind"),
    small.cases(
        [(emitters, kind) for emitters in EMITTERS for kind in small.KINDS],
        [(emitters, "stock") for emitters in EMITTERS if emitters != "three"],
    ),
)
def test_grid_and_emitters(emitters, kind):
    box, m = smoke(rough_grid(1), kind=kind, name="hg", g=0.4)
    check({"smoke": box}, [m], EMITTERS[emitters](), *aimed(1))


@pytest.mark.slow_for("hg")
@pytest.mark.statistical
@pytest.mark.parametrize("name", small.cases(PHASES, ["isotropic", "backward"]))
def test_phase_functions(name):
    box, m = smoke(rough_grid(2), 0.9, "own", PLACE, *PHASES[name])
    check({"smoke": box}, [m], EMITTERS["three"](), *aimed(2))


@pytest.mark.statistical
@pytest.mark.parametrize("emitters", ["point outside", "point inside", "sun"])
def test_homogeneous_box(emitters):
    box, m = fog(1.1, 0.8, name="hg", g=-0.3)
    check({"fog": box}, [m], EMITTERS[emitters](), *aimed(3))


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["stretched", "rotated", "sheared"])
def test_frames(name):
    frame = as_float32(scenes.FRAMES[name])
    middle = frame[:3] @ [0.5, 0.5, 0.5, 1]
    size = float(np.linalg.norm(frame[:3, :3] @ np.ones(3))) / 4
    values = rough_grid(4, 1 / size)
    box, m = smoke(values, 0.9, "own", frame)
    o, d = aimed(4, size=0.8)
    check({"smoke": box}, [m], [point(middle + size * np.array([1.0, 3, 2]))], as_float32(middle + size * o), d)


@pytest.mark.slow_for("stock")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", small.KINDS)
def test_albedo_grid(kind):
    """An albedo on another grid than the extinction."""
    values, albedo = rough_grid(5), rough_grid(6, 1.0, (2, 3, 4))
    medium_type, volume_type = small.KINDS[kind]
    interior = medium(medium_type, grid_volume(volume_type, values, PLACE), grid_volume(volume_type, albedo, PLACE))
    m = twins.Medium(twins.Grid(values, PLACE), twins.trilinear_albedo(albedo, PLACE))
    check({"smoke": box_of(interior, PLACE)}, [m], EMITTERS["point outside"](), *aimed(5))


@pytest.mark.statistical
def test_rgb_albedo_and_rgb_extinction():
    """Three channels, each with its own extinction and albedo."""
    values = rough_grid(7, 1.0) * np.array([0.2, 1.0, 4.0])
    albedo = as_float32([0.9, 0.3, 0.6])
    grid = grid_volume("mivol_voxels", as_float32(values), PLACE)
    interior = medium("mivol_medium", grid, {"type": "rgb", "value": list(albedo)})
    m = twins.Medium(twins.Grid(as_float32(values), PLACE), albedo)
    check({"smoke": box_of(interior, PLACE)}, [m], EMITTERS["point outside"](), *aimed(7))


@pytest.mark.statistical
def test_rgb_homogeneous():
    """A homogeneous rgb box: each channel is its own exponential."""
    sigma = as_float32([0.1, 0.5, 0.9])
    interior = medium("homogeneous", {"type": "rgb", "value": list(sigma)}, 0.8)
    m = twins.Medium(twins.Box(sigma, PLACE), 0.8)
    check({"fog": box_of(interior, PLACE)}, [m], EMITTERS["sun"](), *aimed(8))


@pytest.mark.statistical
def test_absorption_and_scattering_grids():
    """sigma_a and sigma_s on grids of different resolution: a medium of albedo 0 and one of albedo 1 in one place."""
    absorb, scatter = rough_grid(9, 1.0, (2, 3, 4)), rough_grid(10, 1.5)
    interior = {
        "type": "mivol_medium",
        "sigma_a": grid_volume("mivol_voxels", absorb, PLACE),
        "sigma_s": grid_volume("mivol_voxels", scatter, PLACE),
        "phase": {"type": "rayleigh"},
    }
    media = [twins.Medium(twins.Grid(absorb, PLACE), 0.0), twins.Medium(twins.Grid(scatter, PLACE), 1.0, twins.rayleigh)]
    check({"smoke": box_of(interior, PLACE)}, media, EMITTERS["point outside"](), *aimed(9))


@pytest.mark.statistical
def test_two_media_shade_each_other():
    lower, upper = (as_float32(centred(np.diag([2.0, 2, 1]), (0, 0, z))) for z in (-0.5, 0.5))
    parts, media = {}, []
    for i, frame in enumerate((lower, upper)):
        parts[f"smoke{i}"], m = smoke(rough_grid(11 + i), 0.5 + 0.4 * i, ("stock", "own")[i], frame, *PHASES["hg"])
        media.append(m)
    parts["ball"] = ball_of(medium("homogeneous", 0.8, 0.9), (0, 0, 2.0), 0.7)
    media.append(twins.Medium(twins.Ball(0.8, [0, 0, 2.0], 0.7), 0.9))
    check(parts, media, [point([0.3, 0.2, 3.5])], *aimed(11, 10, 1.0, 6.0))


@pytest.mark.slow
@pytest.mark.statistical
def test_background_shines_through():
    """A grid in a constant sky: in-scattered light and the transmitted background."""
    box, m = smoke(rough_grid(12), 0.9, name="hg", g=0.7)
    # 12 x 24 directions see kinks of the shadow depth: 5e-4 of the radiance, measured by refining them.
    sky = ({"type": "constant", "radiance": 0.6}, twins.Sky(0.6, 12))
    check({"smoke": box}, [m], [sky], *aimed(12, 2), background=0.6, quadrature=5e-4, order=3)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("sigma_s", "sigma_t", "intensity", "t0", "h", "D", "answer"),
    [
        (0.5, 0.7, 2.0, 1.3, 0.4, 5.0, 0.14379379536),
        (1.0, 1.0, 1.0, 0.0, 1.0, 3.0, 0.01537602046),
        (0.2, 3.0, 1.0, 2.0, 0.1, 4.0, 7.880153424e-4),
    ],
)
def test_point_light_in_fog(sigma_s, sigma_t, intensity, t0, h, D, answer):
    """A box of length D along the ray, wide across it: light from beside the ray stays inside the box."""
    frame = affine(np.diag([D, 400.0, 400.0]), (0, -200, -200))
    fog = box_of(medium("homogeneous", sigma_t, sigma_s / sigma_t), frame)
    emitter = point([t0, h, 0.0] if t0 > 0 else [1e-6, h, 0], intensity)[0]
    seen = pencils({"fog": fog, "emitter": emitter}, [-1, 0, 0], [1, 0, 0])
    m = seen.moments(mivol(), 16384)
    # sigma_s/sigma_t and the emitter's place are float32 numbers; a few EPS each.
    assert_same_mean(m, np.full((1, 3), answer), rounding=1e-5 * answer, what="fog")
    assert_precise(m, 0.01 * answer)


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["isotropic", "rayleigh"])
def test_thin_limit(name):
    """tau of 1e-4: the closed form without extinction, up to a relative error of this size."""
    frame = affine(np.diag([4.0, 400.0, 400.0]), (0, -200, -200))
    fog = box_of(medium("homogeneous", 1e-5, 0.5, phase={"type": name}), frame)
    seen = pencils({"fog": fog, "emitter": point([1.2, 0.3, 0.0], 2.0)[0]}, [-1, 0, 0], [1, 0, 0])
    m = seen.moments(mivol(), 8192)
    answer = twins.point_thin(0.5e-5, 2.0, 1.2, 0.3, 4.0, name)
    assert_same_mean(m, np.full((1, 3), answer), rounding=1e-4 * answer, what=name)
    assert_precise(m, 0.01 * answer)


@pytest.mark.slow_for("grid-0.6-0.9")
@pytest.mark.statistical
@pytest.mark.parametrize(("mu", "mu0"), [(0.6, 0.9), (0.9, 0.6), (0.7, 0.7), (1.0, 1.0)])
@pytest.mark.parametrize("kind", ["homogeneous", "grid"])
def test_collimated_slab(mu, mu0, kind):
    """Reflected and transmitted light of a slab 400 wide and 1 high, with its edges 200 away; mu = mu0 is no special case."""
    sigma, albedo, g, E0 = 1.7, 0.8, 0.4, 2.0
    frame = as_float32(affine(np.diag([400.0, 400, 1]), (-200, -200, 0)))
    build = fog(sigma, albedo, frame, "hg", g) if kind == "homogeneous" else smoke(
        np.full((3, 2, 2, 1), sigma), albedo, "own", frame, "hg", g
    )  # fmt: skip
    travel = np.array([math.sqrt(1 - mu0 * mu0), 0, -mu0])
    view = np.array([0, math.sqrt(1 - mu * mu), mu])
    eyes = np.array([view, view * [1, 1, -1]])
    # A camera that looks straight into the sun's direction is no problem: a directional emitter cannot be seen.
    seen = pencils({"slab": build[0], "sun": sun(travel, E0)[0]}, np.array([0, 0, 0.5]) + 5 * eyes, -eyes)
    p = twins.hg(g)
    answer = [
        formula(albedo, p(-seen.d[i] @ travel), E0, abs(seen.d[i, 2]), mu0, sigma)
        for i, formula in enumerate((twins.slab_reflected, twins.slab_transmitted))
    ]
    m = seen.moments(mivol(), 4096)
    truth = np.repeat(np.array(answer)[:, None], 3, axis=1)
    assert_same_mean(m, truth, rounding=1e-5 * max(answer), what="slab")
    assert_precise(m, 0.01 * truth)


@pytest.mark.slow_for("grid")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["homogeneous", "grid"])
def test_cube_lit_from_above_seen_from_the_side(kind):
    """alpha p E0 e^{-sigma y} (1 - e^{-sigma D}) at each depth y, where a second scattering would add 30 % and more; nothing at
    max_depth 1."""
    sigma, depths = 2.2, np.array([0.1, 0.45, 0.9])
    build = fog(sigma, 0.6, np.eye(4)) if kind == "homogeneous" else smoke(np.full((4, 3, 2, 1), sigma), 0.6, "own", np.eye(4))
    o = np.stack([np.full(3, -2.0), np.full(3, 0.3), 1 - depths], axis=1)
    seen = pencils({"cube": build[0], "sun": sun([0, 0, -1.0], 3.0)[0]}, o, [1.0, 0, 0])
    assert not scenes.render(seen.scene, mivol(max_depth=1), 16).any()
    m = seen.moments(mivol(), 4096)
    truth = [[twins.cube_from_the_side(0.6, 1 / (4 * math.pi), 3.0, sigma, 1 - z, 1.0)] * 3 for z in seen.o[:, 2]]
    assert_same_mean(m, np.array(truth), rounding=1e-5 * truth[0][0], what="cube")
    assert_precise(m, 0.01 * np.array(truth))


@pytest.mark.statistical
@pytest.mark.parametrize("sigma", [0.2, 1.3, 8.0])
def test_ball_in_a_constant_sky(sigma):
    """By symmetry two nested integrals; the boundary is traced, a few EPS of its coordinates."""
    parts = {"ball": ball_of(medium("homogeneous", sigma, 0.9), (0, 0, 0), 1.0), "sky": scenes.sky(1.0)}
    impact = np.array([0.0, 0.4, 0.95])
    seen = pencils(parts, np.stack([np.full(3, -3.0), impact, np.zeros(3)], axis=1), [1.0, 0, 0])
    m = seen.moments(mivol(), 4096)
    truth = np.repeat([[twins.ball_in_sky(0.9, sigma, 1.0, b)] for b in seen.o[:, 1]], 3, axis=1)
    # Shadow rays leave Mitsuba's sphere at float32 distances; sigma times 1e-5 of a length.
    assert_same_mean(m, truth, rounding=1e-5 * max(sigma, 1), what="ball")


@pytest.mark.statistical
@pytest.mark.parametrize("scale", small.cases([1e-3, 1e3], [1e3]))
def test_the_size_of_the_scene(scale):
    """A scene k times larger and thinner by k, under a directional emitter, has the same radiance."""
    frame = as_float32(centred(2 * scale * np.eye(3)))
    box, m = smoke(rough_grid(14) / scale, 0.8, "own", frame)
    o, d = aimed(14)
    check({"smoke": box}, [m], [sun([0.3, 0.2, -1.0])], as_float32(o * scale), d)


def test_radiance_is_linear_in_the_emitters():
    """Twice the emitter gives twice the image, to the last bit, with the same samples."""
    box, _ = smoke(rough_grid(15), 0.8)
    o, d = aimed(15)
    images = [
        scenes.render(pencils({"smoke": box, "emitter": point([1.5, 1, 2.0], power)[0]}, o, d).scene, mivol(), 16, seed=3)
        for power in (1.0, 2.0)
    ]
    assert np.array_equal(2 * images[0], images[1])
    assert images[0].max() > 0


def test_where_nothing_is_sampled_twice_is_the_same():
    """The seed determines the image: two renders with one seed are equal to the last bit."""
    box, _ = smoke(rough_grid(16), 0.8)
    seen = pencils({"smoke": box, "emitter": point([1.5, 1, 2.0])[0]}, *aimed(16))
    first, second, other = (scenes.render(seen.scene, mivol(), 16, seed=s) for s in (3, 3, 4))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


HERE, THERE = centred(np.eye(3)), centred(np.eye(3), (0, 0, 2))


def scene_of(*interiors: dict) -> SceneMedia:
    """Boxes on the z axis, about 0 and 2."""
    boxes = {f"box{k}": box_of(own, place) for k, (own, place) in enumerate(zip(interiors, (HERE, THERE), strict=False))}
    return media_of(mi.load_dict({"type": "scene", **boxes, "sensor": camera([0, -4, 1], [0, 0, 1])}))


def upwards(media: SceneMedia) -> list[int]:
    """Indices of the media, the lower one first: Mitsuba orders shapes as it likes."""
    return np.argsort([body.box.to_world[2, 3] for body in media.bodies]).tolist()


def event(media: SceneMedia) -> MediumEvent:
    """Events in the lower medium, in the upper medium, and in none."""
    low, top = upwards(media)[0], upwards(media)[-1]
    sigma, t = mi.Float(5, 6, 7), mi.Float64(1, 3, 3)
    return MediumEvent(t, t, mi.Float(1), [sigma] * 3, [sigma] * 3, mi.UInt32(low, top, top), mi.Bool(True, True, False))


def upward() -> mi.Ray3f:
    return mi.Ray3f(mi.Point3f(0, 0, -1), mi.Vector3f(0, 0, 1), mi.Float(0, 0, 0), mi.Color0f())


GREY = {"sigma_t": 2.0, "albedo": 0.25}
COLOURS = {
    "type": "mivol_medium",
    "sigma_a": 0.5,
    "sigma_s": {"type": "constvolume", "value": {"type": "rgb", "value": [1, 2, 4]}},
}

LANES = [[True, False, False], [False, True, False]]


def test_events_know_their_medium():
    media = scene_of(medium("mivol_medium", **GREY), COLOURS)
    found, order = event(media), upwards(media)
    at = media.bodies_at(found.body, found.on)
    assert [np.array(at[k][1]).tolist() for k in order] == LANES
    assert [at[k][0] for k in order] == [media.bodies[k] for k in order]
    mei = event_interaction(media, upward(), event(media))
    pointers = [mi.MediumPtr(media.bodies[k].view.medium) for k in order]
    assert [np.array(mei.medium == p).tolist() for p in pointers] == LANES
    np.testing.assert_array_equal(np.array(mei.p.z), [0, 2, 2])


def test_coefficients_are_those_of_the_medium():
    """The extinction, and the albedo times the extinction or sigma_s itself; 0 without a scattering event."""
    media = scene_of(medium("mivol_medium", **GREY), COLOURS)
    mei = event_interaction(media, upward(), event(media))
    sigma_t, sigma_s = event_coefficients(media, upward(), event(media), mei, is_exact=False)
    np.testing.assert_array_equal(np.array(sigma_t), [[2, 1.5, 0], [2, 2.5, 0], [2, 4.5, 0]])
    np.testing.assert_array_equal(np.array(sigma_s), [[0.5, 1, 0], [0.5, 2, 0], [0.5, 4, 0]])


def test_a_single_walk_knows_the_extinction_already():
    """The event of a single medium carries the extinction; no second look-up. The third lane has no event."""
    media = scene_of(medium("mivol_medium", **GREY))
    mei = event_interaction(media, upward(), event(media))
    found, _ = event_coefficients(media, upward(), event(media), mei, is_exact=True)
    np.testing.assert_array_equal(np.array(found), [[5, 6, 0]] * 3)


def test_the_weight_of_an_event_is_its_gain_times_all_direct_light():
    value = mi.Spectrum(1, 2, 4)
    dr.enable_grad(value)
    samples = [SimpleNamespace(value=value), SimpleNamespace(value=mi.Spectrum(3))]
    found = Scattering(None, None, mi.Spectrum(0.5, 1, 2), samples, mi.Spectrum(8), mi.Spectrum(7), mi.Float(0)).weight
    assert np.array(found).ravel().tolist() == [2, 5, 14] and not dr.grad_enabled(found)


# -- Reciprocity -------------------------------------------------------------------------------------------------------

ALONG, SHONE = [0.2, 1.0, -0.3], [0.9, -0.1, -0.6]
"""Where the camera looks, and where the light travels."""


def swapped(shape: dict, looks: list[float], travels: list[float], depth: int) -> Estimate:
    """Mean radiance that a camera at infinity sees of a shape under a directional emitter of irradiance 1."""
    d = np.array(looks) / np.linalg.norm(looks)
    # A square of 4 x 4 around the origin holds the shape from every side.
    place = mi.ScalarTransform4f().look_at(origin=(-5 * d).tolist(), target=[0, 0, 0], up=[0.1, 0.2, 0.9]).scale(2)
    sensor = {"type": "orthographic", "to_world": place, "film": scenes.film(8, 8), "sampler": {"type": "independent"}}
    sun = {"type": "directional", "direction": travels, "irradiance": 1.0}
    scene = mi.load_dict({"type": "scene", "shape": shape, "sun": sun, "sensor": sensor})
    integrator = mi.load_dict({"type": "mivol", "max_depth": depth})
    means = [scenes.render(scene, integrator, 512, seed=fresh(k)).mean(dtype=np.float64) for k in range(16)]
    return Estimate.from_result(Moments.from_values(np.array(means)[:, None]))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("depth", [2, -1])
def test_camera_and_emitter_change_places(variant_rgb: str, depth: int) -> None:
    """In a grid that is dense towards the emitter and thin towards the camera, with a peaked phase function."""
    ramp = (np.arange(6)[::-1] / 5) ** 3
    fog = smoke(rough_grid(3, 30.0) * ramp[None, None, :, None], 0.95, name="hg", g=0.6)[0]
    there, back = swapped(fog, ALONG, SHONE, depth), swapped(fog, SHONE, ALONG, depth)
    assert_same_mean(there, back, rounding=1e-5 * back.mean, what="radiance")
    assert_precise(difference(there, back), 0.02 * back.mean, what="radiance")
