"""Derivatives of free flights, of their probes, and of the kept shadow ray."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
import scattering_scenes as small
from false_alarms import Estimate, assert_precise, assert_same_mean, difference, fresh
from scattering_gradients import (
    BATCHES,
    DENSITIES,
    GRID,
    along,
    assert_each_transposed,
    assert_gradient,
    backward,
    forward,
    gradients,
    release,
    upper_half,
    vjp,
    watched,
    weights,
)
from scattering_scenes import PLACE, aimed, close_up, mivol, pencils, point, rough_grid, smoke, sun

import scenes
from mivol.bench.scenes import ParameterGradient, box_scene, constant_light
from mivol.bench.studies.gradients.twin import Light, Twin
from mivol.scene import plan
from mivol.transport.estimators.flights.flight_derivatives import Probe, Probes, ShadowReservoir, ShadowTerm
from mivol.transport.estimators.lighting.direct_lighting import DirectLight
from mivol.transport.estimators.segment import FlightPoint, PathSegment
from mivol.transport.media.ray_intervals import RaySegment, UniformPoint
from mivol.transport.traversal.random_numbers import draw_pcg32, seed_pcg32
from mivol.transport.traversal.rays import FineRay
from mivol.validate.statistics import Moments
from scenes import as_float32, ball_of, box_of, camera, grid_volume, media_of, medium

MEDIUM = "smoke.interior_medium."


# -- One scattering, against the twin -----------------------------------------------------------------------------------


@pytest.mark.slow_for("empty-point", "half empty-point")
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("density", "emitter"),
    small.cases(
        [("empty", "point"), ("half empty", "point"), ("flat", "point"), ("rough", "sun"), ("dense", "point")],
        [("flat", "point"), ("dense", "point"), ("rough", "sun")],
    ),
)
def test_density(flies, density, emitter):
    """Empty, half empty and flat (density equal to the majorant), where other estimators are biased."""
    shine = point([1.5, 1, 2.0]) if emitter == "point" else sun([0.3, 0.2, -1.0])
    box, m = smoke(as_float32(DENSITIES[density]()), 0.7, "own", PLACE, "hg", 0.4)
    seen = pencils({"smoke": box, "emitter": shine[0]}, *aimed(1, 8))
    w, rows = weights(8)
    truth, _ = twins.radiance_gradient(m, [shine[1]], seen.o, seen.d, rows)
    assert_gradient(gradients(seen, GRID, w, 512), truth[..., None], density, 0.1)


# -- Any number ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow_for("0.0")
@pytest.mark.parametrize("g", [0.0, 0.6])
def test_a_white_furnace_has_no_derivative(g):
    """The light at the end of a flight and at a probe equals the baseline, sample by sample."""
    scene = close_up({"smoke": smoke(rough_grid(2, 5.0), 1.0, "own", name="hg", g=g)[0], "sky": scenes.sky(1.0)}, res=8)
    integrator = mi.load_dict(mivol(max_depth=-1, rr_depth=100))
    found = backward(scene, GRID, np.ones((8, 8, 3)), 16, fresh(3), integrator)
    # A white surface in place of the sky's light has the derivative of the optical depth: some samples a voxel of size 1.
    plain = backward(scene, GRID, np.ones((8, 8, 3)), 16, fresh(3), mi.load_dict({"type": "mivol", "max_depth": 1}))
    assert np.abs(found).max() <= 1e-5 * np.abs(plain).max()


def _everything(colour: bool = False) -> mi.Scene:
    """One scene with each kind of parameter; half of the density is empty, and the albedo is partly 0."""
    density = rough_grid(4, 3.0) * (np.arange(6) < 3)[None, None, :, None]
    albedo = 0.9 * rough_grid(5, 1.0, (3, 3, 3)) * (np.arange(3) > 0)[None, None, :, None]
    if colour:
        density = np.concatenate([density, 0.2 * density, 2 * density], axis=-1)
    interior = medium(
        "mivol_medium",
        grid_volume("mivol_voxels", density, PLACE),
        grid_volume("mivol_voxels", albedo, PLACE),
        phase={"type": "mivol_hg", "g": 0.3},
        emission=grid_volume("mivol_voxels", rough_grid(6, 1.0, (3, 3, 3)), PLACE),
    )
    down = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    floor = {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}}
    parts = {"smoke": box_of(interior, PLACE), "bulb": point([1.7, -0.6, 1.4])[0], "sky": scenes.sky(0.3), "floor": floor}
    return close_up(parts, res=8)


PARAMETERS = {
    "density": MEDIUM + "sigma_t.data",
    "albedo": MEDIUM + "albedo.data",
    "g": MEDIUM + "phase_function.g",
    "emission": MEDIUM + "emission.data",
    "scale": MEDIUM + "scale",
    "emitter": "bulb.intensity.value",
    "floor": "floor.bsdf.reflectance.value",
}

OF_A_SUN = PARAMETERS | {"emitter": "sun.irradiance.value"}


def _in_the_sun() -> mi.Scene:
    """A peaked phase function under the sun, with side flights."""
    smoky = grid_volume("mivol_voxels", rough_grid(4, 4.0), PLACE)
    albedo = grid_volume("mivol_voxels", 0.9 * rough_grid(5, 1.0, (3, 3, 3)), PLACE)
    interior = medium("mivol_medium", smoky, albedo, phase={"type": "mivol_hg", "g": 0.8})
    return close_up({"smoke": box_of(interior, PLACE), "sun": sun([0.3, 0.2, -1.0])[0]}, res=8)


SCENES = {
    "grey": (_everything, PARAMETERS, {"max_depth": 5, "rr_depth": 3}),
    "rgb": (lambda: _everything(True), PARAMETERS, {"max_depth": 5, "rr_depth": 3}),
    "side flights": (_in_the_sun, OF_A_SUN, {"max_depth": 4}),
    "near light": (_everything, PARAMETERS, {"max_depth": 5, "rr_depth": 3, "near_light": "segments"}),
    "rgb near light": (lambda: _everything(True), PARAMETERS, {"max_depth": 4, "near_light": "segments"}),
}
FOLLOWED = {
    "grey": tuple(PARAMETERS),
    "rgb": ("density", "albedo", "scale"),
    "side flights": ("density", "albedo", "g", "emitter"),
    "near light": ("density", "albedo", "g", "scale", "emitter"),
    "rgb near light": ("density",),
}


@pytest.mark.slow
@pytest.mark.parametrize("place", SCENES)
def test_forward_is_the_transpose_of_reverse(place, whole_paths):
    build, keys, settings = SCENES[place]
    assert_each_transposed(build(), [keys[name] for name in FOLLOWED[place]], mi.load_dict(mivol(**settings)), 16, fresh(5))


@pytest.mark.statistical
def test_tangents_in_uneven_light_have_the_mean_of_replays() -> None:
    """A lamp beside thin smoke: flights and their probes must have one baseline, though the light differs along flights."""
    density = rough_grid(1, 1.5, (18, 17, 16))
    parts = {"smoke": smoke(density, 0.9, "own")[0], "lamp": point([1.4, 0.1, 0.0], 5.0)[0]}
    scene = close_up(parts, res=8, fov=70.0, origin=(-0.9, 0.1, 0.1), target=(0.0, 0.1, 0.0))
    key, integrator = "smoke.interior_medium.sigma_t.data", mi.load_dict(mivol(max_depth=3, near_light="vertices"))
    tangents = [forward(scene, key, density, 256, fresh(100 + k), integrator).mean() for k in range(BATCHES)]
    there = Moments.from_values(np.array(tangents)[:, None])
    assert_same_mean(along(scene, key, density, integrator, 256), there, what="the derivative by the density")


def _difference(scene: mi.Scene, key: str, v: np.ndarray, h: float, integrator: mi.Integrator, spp: int) -> Estimate:
    """(f(x + h v) - f(x - h v)) / 2 h of the mean image; batches share random numbers, which cancels most of the noise."""
    params = mi.traverse(scene)
    kind, start = type(params[key]), np.array(params[key], dtype=np.float64)
    found = []
    for k in range(BATCHES):
        both = []
        for sign in (1, -1):
            value = np.asarray(start + sign * h * v, dtype=np.float32)
            params[key] = kind(value) if value.ndim else kind(float(value))
            params.update()
            both.append(scenes.render(scene, integrator, spp, seed=fresh(900 + k)).astype(np.float64).mean())
        found.append((both[0] - both[1]) / (2 * h))
    value = start.astype(np.float32)
    params[key] = kind(value) if value.ndim else kind(float(value))
    params.update()
    return Estimate.from_result(Moments.from_values(np.array(found)[:, None]))


ROOMS = {
    "sky": lambda density: {"smoke": smoke(density, 0.75, "own")[0], "sky": scenes.sky(1.0)},
    "sun": lambda density: {"smoke": smoke(density, 0.75, "own", name="hg", g=0.8)[0], "sun": sun([0.3, 0.2, -1.0])[0]},
    "emitter inside": lambda density: {
        "smoke": smoke(density, 0.75, "own")[0],
        "emitter": {"type": "sphere", "center": [0.2, 0.1, 0.3], "radius": 0.2, "emitter": {"type": "area", "radiance": 9.0}},
    },
    "glass": lambda density: {
        "smoke": ball_of(medium("mivol_medium", grid_volume("mivol_voxels", density, PLACE), 0.75), (0, 0, 0), 0.9)
        | {"bsdf": {"type": "dielectric"}},
        "sky": scenes.sky(0.5),
        "emitter": {"type": "sphere", "center": [1.2, 0.3, 1.9], "radius": 0.6, "emitter": {"type": "area", "radiance": 9.0}},
    },
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("room", "depth", "spp"), [("sky", -1, 256), ("sun", 6, 512), ("emitter inside", 6, 256), ("glass", -1, 1024)]
)
def test_density_by_differences(room, depth, spp):
    """Along the density itself, which keeps empty voxels empty.

    The truncation error of a central difference is h^2/6 of the third derivative. Along the density, the third derivative is of
    the size of the derivative at an optical depth of about 1, so the error is 0.05^2/6 = 4e-4 of it.
    """
    density = rough_grid(4, 3.0)
    scene = close_up(ROOMS[room](density), res=8)
    integrator = mi.load_dict(mivol(max_depth=depth, rr_depth=50))
    found = along(scene, GRID, density, integrator, spp)
    truth = _difference(scene, GRID, density, 0.05, integrator, 4 * spp)
    assert_same_mean(found, truth, rounding=2e-3 * np.abs(truth.mean), what="derivative")
    assert_precise(difference(found, truth), 0.03 * np.abs(truth.mean) + 1e-4, what="derivative")


def _area_lamp() -> dict:
    place = mi.ScalarTransform4f().look_at([0.2, 0.3, 1.5], [0, 0, 0], [0, 1, 0]).scale(0.5)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 5.0}}


LAMPS = {
    "point": lambda: point([0.4, -0.3, 1.4])[0],
    "spot": lambda: small.spot([0.5, -0.4, 1.8], [0, 0, 0], 9.0)[0],
    "area": _area_lamp,
    "inside": lambda: point([0.2, -0.1, 0.15])[0],
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("lamp", "kind", "depth"),
    [("point", "density", 3), ("point", "albedo", 8), ("spot", "density", 8), ("spot", "g", 3), ("area", "density", 3),
     ("area", "homogeneous", 8), ("inside", "density", 3)],
)  # fmt: skip
def test_near_light_by_differences(lamp, kind, depth):
    """Half of the voxels are empty. The truncation error is that of :func:`test_density_by_differences`; along a uniform
    direction the third derivative is smaller than 20 times the first, and h is 0.02."""
    density = rough_grid(4, 3.0) * (np.arange(6) < 3)[None, None, :, None]
    albedo = grid_volume("mivol_voxels", rough_grid(5, 0.9, (3, 3, 3)), PLACE)
    sigma_t = 1.5 if kind == "homogeneous" else grid_volume("mivol_voxels", density, PLACE)
    interior = medium("mivol_medium", sigma_t, albedo, phase={"type": "mivol_hg", "g": 0.4})
    scene = close_up({"smoke": box_of(interior, PLACE), "lamp": LAMPS[lamp]()}, res=8)
    integrator = mi.load_dict(mivol(max_depth=depth, rr_depth=50, near_light="segments"))
    key = MEDIUM + {"albedo": "albedo.data", "g": "phase_function.g"}.get(kind, "sigma_t.data")
    if kind == "homogeneous":
        key = MEDIUM + "sigma_t.value.value"
    start = np.array(mi.traverse(scene)[key])
    # Not below 0: empty voxels grow only in the derivative; the difference follows the full ones.
    v = np.where(start > 0.05, 1.0, 0.0) if start.size > 1 else 1.0
    found, truth = along(scene, key, v, integrator, 64), _difference(scene, key, v, 0.02, integrator, 512)
    assert_same_mean(found, truth, rounding=3e-3 * np.abs(truth.mean), what="derivative")
    assert_precise(difference(found, truth), 0.02 * np.abs(truth.mean) + 1e-3, what="derivative")


@dataclass(frozen=True)
class _Aside(Light):
    """A camera seeing only the dense half of a box."""

    def scene(self, values: np.ndarray, side: int) -> mi.Scene:
        parts = box_scene(values, side, self.albedo, **self.parts())
        parts["sensor"] = camera((-0.5, 0.0, 6.0), (-0.5, 0.0, 0.0), res=side, fov=5.0)
        return mi.load_dict(parts)


@pytest.mark.slow
@pytest.mark.statistical
def test_what_no_camera_ray_meets():
    """The empty half beside the visible half: light passes it after a scattering event, so only later probes find its
    derivative. The reference is a path tracer with forward derivatives."""
    left = np.broadcast_to(np.arange(8) < 4, (8, 8, 8))
    values, direction = np.where(left, 2.0, 0), np.where(left, 0.0, 1.0)
    light = _Aside(constant_light, depth=4)
    subject = ParameterGradient(light.scene(np.float32(values), 8), light.integrator("mivol"))
    twin = Twin(values, direction, 8, light)
    found = [float(np.array(subject.of_mean(fresh(k), 512), np.float64) @ direction.ravel()) for k in range(BATCHES)]
    truth = [twin.derivative(fresh(100 + k), 256) for k in range(BATCHES)]
    found, truth = (Estimate.from_result(Moments.from_values(np.array(x)[:, None])) for x in (found, truth))
    assert_same_mean(found, truth, rounding=1e-6, what="derivative")
    assert_precise(difference(found, truth), 0.1 * np.abs(truth.mean), what="derivative")


def test_probes_are_kept_in_proportion_to_their_gain():
    """The first probe comes from the first flight. Of later flights with gains 1 and 3, 1/4 and 3/4 of evenly spread lanes keep
    the probe, with a total of 4. Flights of paths that may not scatter any more, and lanes without a point, keep none."""
    n, never = 64, dr.full(mi.Bool, False, 64)
    ray = FineRay.from_ray(mi.Ray3f(mi.Point3f(dr.zeros(mi.Float, n), 0, 0), mi.Vector3f(0, 0, 1)))
    on, zero = ~never, dr.zeros(mi.UInt32, n)

    def offered(probes: Probes, t: float, gain: float, depth: int, may_scatter: mi.Bool = on, found: mi.Bool = on) -> Probes:
        segment = PathSegment(ray, dr.zeros(mi.MediumPtr, n), mi.Spectrum(1), may_scatter, None, zero + depth)
        point = UniformPoint(dr.full(mi.Float64, t, n), dr.full(mi.Float, 1, n), zero, found)
        return probes.offer(segment, FlightPoint(point, dr.full(mi.Spectrum, gain, n)), (dr.arange(mi.Float, n) + 0.5) / n)

    probes = offered(Probes(Probe.empty(ray), Probe.empty(ray)), 7.0, 2.0, 0)
    for t, gain, *lanes in ((1.0, 1.0), (2.0, 3.0), (3.0, 100.0, never), (4.0, 100.0, on, never)):
        probes = offered(probes, t, gain, 1, *lanes)
    assert np.all(np.array(probes.first.t) == 7) and np.all(np.array(probes.first.total) == 2)
    second = np.array(probes.later.t) == 2
    assert second.sum() == 3 * n // 4 and np.all(np.array(probes.later.t)[~second] == 1)
    assert np.all(np.array(probes.later.total) == 4) and np.all(np.array(probes.later.weight) == np.where(second, 3, 1))
    assert np.all(np.array(probes.later.depth) == 1)


# -- Side flights --------------------------------------------------------------------------------------------------------


def test_of_side_flights_light_is_linear_in_a_sky(whole_paths):
    """The derivative along the sky itself is the image with the same seed, up to float32 sums in another order."""
    light = np.random.default_rng(3).uniform(0.1, 1, (8, 16, 3)).astype(np.float32)
    light[2, 5] = 200
    interior = medium("mivol_medium", 1.5, 0.8, phase={"type": "mivol_hg", "g": 0.8})
    scene = close_up({"smoke": box_of(interior, PLACE), "sky": {"type": "envmap", "bitmap": mi.Bitmap(light)}}, res=8)
    integrator, w = mi.load_dict(mivol(max_depth=4)), np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3))
    start = np.array(mi.traverse(scene)["sky.data"], np.float64)
    # As for derivatives, no emitter sample of a map with gradients is drawn from the bright part alone.
    _, variable = watched(scene, "sky.data")
    seen = np.array(mi.render(scene, integrator=integrator, seed=fresh(4), spp=16), np.float64)
    release(scene, "sky.data", variable)
    found = vjp(scene, "sky.data", w, 16, fresh(4), integrator)
    assert np.sum(found.reshape(start.shape) * start) == pytest.approx(np.sum(w * seen), rel=1e-4)


def _gradient(scene: mi.Scene, keys: list[str]) -> np.ndarray:
    """The derivative of the sum of an image by the first of several followed parameters."""
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    mi.load_dict(mivol(max_depth=4)).render_backward(scene, params, dr.ones(mi.TensorXf, (8, 8, 3)), seed=fresh(3), spp=8)
    found = np.array(dr.grad(params[keys[0]]), np.float64)
    for key in keys:
        dr.disable_grad(params[key])
    params.update()
    return found


@pytest.mark.parametrize("name", ["albedo.value.value", "intensity.value"])
def test_derivatives_do_not_depend_on_what_else_is_followed(name):
    """With a fixed extinction no probe, shadow ray or flight is differentiated by it; the other derivatives stay as they are.
    The low albedo needs its probes all the same."""
    fog = box_of(medium("homogeneous", 0.5, 0.05), PLACE)
    scene = close_up({"smoke": fog, "bulb": point([1.7, -0.6, 1.4])[0]}, res=8)
    key = next(k for k, _ in mi.traverse(scene) if k.endswith(name))
    alone, beside = (_gradient(scene, [key, *more]) for more in ([], [MEDIUM + "sigma_t.value.value"]))
    # Sums of some thousand terms in float32, added in another order.
    np.testing.assert_allclose(alone, beside, rtol=1e-4)
    assert np.all(alone != 0)


@pytest.mark.slow
@pytest.mark.statistical
def test_collisions_find_the_derivatives_of_thick_media(monkeypatch):
    """Without probes, collisions have the whole weight: the same mean as with probes."""
    fog, bulb = box_of(medium("homogeneous", 0.75, 0.7), PLACE), point([1.2, -0.6, 1.4])[0]
    scene = close_up({"smoke": fog, "bulb": bulb, "sky": scenes.sky(0.3)}, res=8)
    key, integrator = MEDIUM + "sigma_t.value.value", mi.load_dict(mivol(max_depth=4))
    found = []
    for bound in (0.5, np.inf):
        monkeypatch.setattr(plan, "THICK", bound)
        found.append(along(scene, key, 1.0, integrator, 64))
    assert_same_mean(*found, rounding=1e-4 * np.abs(found[1].mean), what="derivative")
    assert_precise(difference(*found), 0.05 * np.abs(found[1].mean), what="derivative")


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", ["density", "albedo", "g"])
def test_side_flights_keep_the_mean_of_derivatives(name, monkeypatch):
    scene, key, integrator = _in_the_sun(), OF_A_SUN[name], mi.load_dict(mivol(max_depth=4))
    v = upper_half(scene, key)
    with_them = along(scene, key, v, integrator, 512)
    monkeypatch.setattr(plan, "choose_side_flights", lambda *_: (None, []))
    without = along(scene, key, v, integrator, 1024)
    assert_same_mean(with_them, without, rounding=1e-4 * np.abs(without.mean), what="derivative")
    assert_precise(difference(with_them, without), 0.1 * np.abs(without.mean), what="derivative")


@pytest.mark.slow_for("emission-5")
@pytest.mark.parametrize(("name", "depth"), [("emission", 5), ("emitter", 5)])
def test_light_is_linear_in_what_emits(name, depth, whole_paths):
    """The derivative along an emission is the image of this emission alone, sample by sample (images have no branches here)."""
    scene, key = _everything(), PARAMETERS[name]
    integrator, params = mi.load_dict(mivol(max_depth=depth, rr_depth=3)), mi.traverse(scene)
    kind, value = type(params[key]), np.array(params[key], dtype=np.float32)
    seed = fresh(7)
    tangent = forward(scene, key, value if value.size > 3 else float(value.ravel()[0]), 16, seed, integrator)
    images = []
    for factor in (1.0, 0.0):
        params[key] = kind(value * np.float32(factor)) if value.size > 3 else kind(float(value.ravel()[0]) * factor)
        params.update()
        images.append(scenes.render(scene, integrator, 16, seed=seed))
    assert np.abs(tangent).max() > 0.01
    # Sums of some hundred terms in float32, of which the rest of the light cancels.
    assert np.abs(tangent - (images[0] - images[1])).max() <= 2e-5 * images[0].max()


@pytest.mark.slow
@pytest.mark.statistical
def test_albedo_of_zero(monkeypatch):
    """An albedo of 0 has a derivative, from probes; the estimator of single scattering never divides by it."""
    values = 0.9 * rough_grid(5, 1.0, (3, 3, 3)) * (np.arange(3) > 0)[None, None, :, None]
    density, albedo = (grid_volume("mivol_voxels", grid, PLACE) for grid in (rough_grid(4), values))
    interior = medium("mivol_medium", density, albedo)
    scene = close_up({"smoke": box_of(interior, PLACE), "bulb": point([1.5, 1, 2.0])[0]}, res=8)
    at_zero, integrator = 1.0 * (values == 0), mi.load_dict(mivol())
    truth = along(scene, MEDIUM + "albedo.data", at_zero, integrator, 64)
    monkeypatch.setattr(plan, "choose_segment_estimator", lambda asked: "free_flight")
    found = along(scene, MEDIUM + "albedo.data", at_zero, integrator, 512)
    assert_same_mean(found, truth, rounding=1e-7, what="derivative")
    assert_precise(difference(found, truth), 0.05 * np.abs(truth.mean), what="derivative")


@pytest.mark.slow
@pytest.mark.statistical
def test_coefficients_are_those_of_density_and_albedo():
    """sigma_a and sigma_s in place of sigma_t and albedo, at voxels of 0 of each: the chain rule between the two."""
    density, albedo = rough_grid(4, 2.0), 0.6
    whole = close_up({"smoke": smoke(density, albedo, "own")[0], "bulb": point([1.5, 1, 2.0])[0]}, res=8)
    shares = (("sigma_a", 0.4), ("sigma_s", 0.6))
    parts = {name: grid_volume("mivol_voxels", as_float32(c * density), PLACE) for name, c in shares}
    interior = {"type": "mivol_medium", **parts}
    split = close_up({"smoke": box_of(interior, PLACE), "bulb": point([1.5, 1, 2.0])[0]}, res=8)
    integrator = mi.load_dict(mivol(max_depth=4))
    by_density = along(whole, GRID, density, integrator, 256)
    a, s = (along(split, f"{MEDIUM}{name}.data", as_float32(c * density), integrator, 256) for name, c in shares)
    total = Estimate(a.mean + s.mean, a.var + s.var, np.minimum(a.dof, s.dof))
    assert_same_mean(total, by_density, rounding=1e-6, what="derivative")
    assert_precise(difference(total, by_density), 0.2 * np.abs(by_density.mean) + 1e-3, what="derivative")


LIGHTS, LENGTHS = (0.5, 0.0, 2.0, 0.1), (0.3, 0.9, 0.2, 0.7)


def fog() -> object:
    """Media of one homogeneous box, prepared for derivatives."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "fog": box_of(medium("mivol_medium", 0.5, 0.8), np.diag([2.0, 2.0, 2.0, 1.0])),
            "sky": {"type": "constant"},
            "sensor": camera((0, -4, 0), (0, 0, 0), res=2),
        }
    )
    return media_of(scene)


@pytest.mark.statistical
def test_mean_is_the_sum() -> None:
    """The derivative of light L over a length l by a constant extinction is -L l."""
    media, n = fog(), 1 << 14
    ray = FineRay.from_ray(mi.Ray3f(dr.full(mi.Point3f, 0.1, n), mi.Vector3f(0, 0, 1)))
    rng, kept = seed_pcg32(mi.Float((0.4 + fresh(0) * 0.6180339887498949) % 1), n), ShadowReservoir.empty(media, ray)
    for light, length in zip(LIGHTS, LENGTHS, strict=True):
        rng, (chance,) = draw_pcg32(rng, 1)
        nowhere = dr.zeros(mi.MediumPtr, n)
        segment = RaySegment(ray, nowhere, dr.full(mi.Float, length, n), True, passages=[])
        term = DirectLight(media, segment, dr.full(mi.Spectrum, light, n), mi.Bool(light > 0))
        kept = kept.offer(term, chance)
    term = ShadowTerm(media, kept)
    assert np.all(np.array(term.value) == 0)
    media.bodies[0].tangents, media.bodies[0].has_tangent = [mi.Float(1)], [True]
    found = np.array(term.jvp().x, dtype=np.float64) * np.ones(n)
    truth = -sum(a * b for a, b in zip(LIGHTS, LENGTHS, strict=True))
    assert_same_mean(Estimate(found.mean(), found.var(ddof=1) / n, n - 1), truth, rounding=1e-6, what="derivative")
    # The transpose, lane by lane: 16384 terms summed in float32.
    media.start_gradients()
    term.vjp(dr.full(mi.Spectrum, 1, n))
    assert float(np.array(media.bodies[0].gradients[0]).sum()) == pytest.approx(3 * found.sum(), rel=1e-4)
