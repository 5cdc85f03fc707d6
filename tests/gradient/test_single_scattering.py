"""Derivatives of light that turns once: every parameter against the float64 twin, forward against reverse, differences.

A gradient is an estimate: its mean over 16 independent backward passes is held against the twin's by Student's t, voxel by
voxel (tests/false_alarms.py). The twin's derivatives are exact, or central differences in float64 (h = 1e-4: truncation
1e-8 of the value).
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, fresh
from scattering_gradients import (
    BATCHES,
    DENSITIES,
    GRID,
    assert_each_transposed,
    assert_gradient,
    gradients,
    release,
    twin_difference,
    vjp,
    watched,
    weights,
)
from scattering_scenes import PLACE, Pencils, aimed, fog, mivol, pencils, point, rough_grid, smoke, spot, sun

import scenes
from mivol.transport.estimators.single_scattering.single_scattering import _choose_shadow_ray
from mivol.transport.media.ray_intervals import RaySegment
from mivol.validate.statistics import Moments
from scenes import as_float32, box_of, centred, grid_volume, medium

MEDIUM = "smoke.interior_medium."


def jvp(scene: mi.Scene, key: str, v: np.ndarray, spp: int, seed: int, integrator: mi.Integrator) -> np.ndarray:
    """J v: the derivative of the image along v, by `mi.render` with the same random numbers as :func:`vjp`."""
    params, variable = watched(scene, key)
    image = mi.render(scene, params, integrator=integrator, spp=1, spp_grad=spp, seed=seed + 10_000, seed_grad=seed)
    kind = type(variable)
    dr.set_grad(variable, kind(np.asarray(v, dtype=np.float32)) if np.ndim(v) else kind(float(v)))
    dr.enqueue(dr.ADMode.Forward, variable)
    dr.traverse(dr.ADMode.Forward)
    tangent = np.array(dr.grad(image), dtype=np.float64)
    release(scene, key, variable)
    return tangent


EMITTERS = {
    "point": lambda: point([1.5, 1, 2.0]),
    "point inside": lambda: point([0.3, -0.2, 0.35]),
    "point at a corner": lambda: point([1, 1, 1]),
    "spot": lambda: spot([1.0, -2, 2.5], [0, 0, 0]),
    "sun": lambda: sun([0.3, 0.2, -1.0]),
}


def lit_smoke(density: str, emitter: tuple, kind: str = "own", albedo: float = 0.7, n: int = 8) -> tuple[Pencils, twins.Medium]:
    box, m = smoke(as_float32(DENSITIES[density]()), albedo, kind, PLACE, "hg", 0.4)
    return pencils({"smoke": box, "emitter": emitter[0]}, *aimed(1, n)), m


STOCK = [("empty", "stock"), ("flat", "stock"), ("rough", "stock")]


@pytest.mark.slow_for("empty-own", "empty-stock", "rough-own")
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("density", "kind"),
    small.cases(
        [*((name, "own") for name in DENSITIES), *STOCK],
        [*((name, "own") for name in DENSITIES if name not in ("empty", "rough")), *STOCK[1:]],
    ),
)
def test_density_under_a_point_light(density, kind):
    """Empty, half empty and flat (density equal to the majorant) are where other estimators are biased."""
    emitter = EMITTERS["point"]()
    seen, m = lit_smoke(density, emitter, kind)
    w, rows = weights(8)
    truth, _ = twins.radiance_gradient(m, [emitter[1]], seen.o, seen.d, rows)
    assert_gradient(gradients(seen, GRID, w, 512), truth[..., None], density, 0.05 if density == "dense" else 0.02)


LIT = [("rough", "point inside"), ("rough", "sun")]


@pytest.mark.slow_for("rough-point inside", "rough-sun")
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("density", "name"),
    small.cases(
        [(d, n) for d in ("empty", "rough") for n in ("point inside", "point at a corner", "spot", "sun")],
        [(d, n) for d in ("empty", "rough") for n in ("point inside", "point at a corner", "spot", "sun") if (d, n) not in LIT],
    ),
)
def test_density_under_other_emitters(density, name):
    emitter = EMITTERS[name]()
    seen, m = lit_smoke(density, emitter)
    w, rows = weights(8)
    truth, _ = twins.radiance_gradient(m, [emitter[1]], seen.o, seen.d, rows)
    assert_gradient(gradients(seen, GRID, w, 512), truth[..., None], name)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("density", "albedo"), small.cases([("empty", 0.6), ("rough", 0.6), ("rough", 0.0)], [("empty", 0.6), ("rough", 0.0)])
)
def test_density_under_a_sky(density, albedo):
    """Turned light against the background that is taken away, of nearly the same size."""
    box, m = smoke(as_float32(DENSITIES[density]()), albedo, "own", PLACE, "hg", 0.4)
    seen = pencils({"smoke": box, "sky": scenes.sky(0.7)}, *aimed(1, 3))
    w, rows = weights(3)
    truth, _ = twins.radiance_gradient(m, [twins.Sky(0.7, 12)], seen.o, seen.d, rows, background=0.7, order=3)
    # 12 x 24 directions: 1e-3 of the derivative of the turned light.
    assert_gradient(gradients(seen, GRID, w, 512), truth[..., None], density, rounding=2e-3 if albedo else 2e-5)


@pytest.mark.statistical
def test_beside_an_emitter_whose_light_no_path_finds():
    """A surface that shines along its normal only; Mitsuba cannot evaluate its light, and it adds none."""
    parts = {"smoke": smoke(rough_grid(2))[0], "bulb": point([1.5, 1, 2.0])[0]}
    above = mi.ScalarTransform4f().translate([0, 0, 9])
    beam = {"type": "rectangle", "to_world": above, "emitter": {"type": "directionalarea"}}
    key, ours, w = MEDIUM + "sigma_t.data", mi.load_dict(mivol(max_depth=3)), np.ones((8, 8, 3))

    def slope(more: dict, first: int) -> Moments:
        scene = small.close_up(parts | more, res=8)
        seeds = range(first, first + BATCHES)
        return Moments.from_values(np.stack([vjp(scene, key, w, 16, fresh(s), ours).sum(keepdims=True) for s in seeds]))

    # Without the beam first: Dr.Jit records calls for the emitters of all scenes in memory.
    judge = slope({}, 100)
    found = slope({"beam": beam}, 0)
    assert_same_mean(found, judge, what="derivatives by the density")
    assert_precise(small.difference(found, judge), 0.05 * np.abs(judge.mean), what="derivatives by the density")


@pytest.mark.slow
@pytest.mark.statistical
def test_constvolume_whose_density_is_its_majorant():
    """The constant extinction of a stock heterogeneous, where prbvolpath is twice too large."""
    at = np.eye(4)
    interior = medium("heterogeneous", {"type": "constvolume", "value": 1.2}, 0.7)
    emitter = point([1.5, 1.2, 2.0])
    o, d = aimed(2, 4)
    seen = pencils({"smoke": box_of(interior, at), "emitter": emitter[0]}, as_float32(0.5 * o + 0.5), d)
    w, rows = weights(4)

    def light(sigma):
        return rows @ twins.radiance([twins.Medium(twins.Box(sigma, at), 0.7)], [emitter[1]], seen.o, seen.d)[:, 0]

    truth = np.array([twin_difference(light, float(as_float32(1.2)))])
    assert_gradient(gradients(seen, MEDIUM + "sigma_t.value.value", w, 2048), truth, "constvolume", 0.06)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("lit", small.cases(["point", "sky"], ["sky"]))
def test_rgb_extinction(lit):
    """Each channel has the derivatives of its own grey picture, also where one of them is vacuum."""
    values = as_float32(rough_grid(14) * np.array([1.0, 0.2, 0.0]))
    emitter = EMITTERS["point"]() if lit == "point" else ({"type": "constant", "radiance": 0.5}, twins.Sky(0.5, 8))
    interior = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.7, phase={"type": "hg", "g": 0.4})
    seen = pencils({"smoke": box_of(interior, PLACE), "emitter": emitter[0]}, *aimed(5, 3))
    w, _ = weights(3)
    found = gradients(seen, GRID, w, 1024)
    background = 0.5 if lit == "sky" else 0.0
    for c in range(3):
        m = twins.Medium(twins.Grid(values[..., c], PLACE), 0.7, twins.hg(0.4))
        truth, _ = twins.radiance_gradient(m, [emitter[1]], seen.o, seen.d, w[0, :, c], background=background, order=4)
        # 8 x 16 directions of the sky: 3e-3 of the turned light's derivative.
        assert_gradient(found[..., c], truth, f"channel {c}", 0.04, rounding=3e-3 if lit == "sky" else 2e-5)


LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
"""Of linear sRGB, by which Mitsuba makes one number of three in mono variants."""


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("shares", [pytest.param([1.0], id="grey"), pytest.param(LUMINANCE, id="rgb")])
def test_a_mono_variant(shares):
    """One number a sample: density voxel by voxel, and albedo. An rgb grid counts by its luminance, in derivatives too."""
    mi.set_variant("llvm_ad_mono")
    emitter = EMITTERS["point"]()
    tints = np.array([[1.0, 0.4, 1.7]])[:, : len(shares)]
    values = as_float32(rough_grid(1) * tints)
    interior = medium("mivol_medium", grid_volume("mivol_voxels", values, PLACE), 0.7, phase={"type": "hg", "g": 0.4})
    seen = pencils({"smoke": box_of(interior, PLACE), "emitter": emitter[0]}, *aimed(1, 8))
    w = weights(8)[0][..., :1]
    m = twins.Medium(twins.Grid((values @ shares)[..., None], PLACE), 0.7, twins.hg(0.4))
    truth, _ = twins.radiance_gradient(m, [emitter[1]], seen.o, seen.d, w[0, :, 0])
    # Luminance is known to 1e-6 of itself.
    assert_gradient(gradients(seen, GRID, w, 512), truth[..., None] * shares, "density")

    def light(x):
        return w[0, :, 0] @ twins.radiance([twins.Medium(m.field, x, twins.hg(0.4))], [emitter[1]], seen.o, seen.d)[:, 0]

    truth = np.array([twin_difference(light, float(as_float32(0.7)))])
    assert_gradient(sums(seen, MEDIUM + "albedo.value.value", w, 512), truth, "albedo")


@pytest.mark.statistical
@pytest.mark.slow
def test_two_media():
    """A grid beside a homogeneous box, a ball between them and the emitter; derivatives of the grid and of both constants."""
    place, beside = as_float32(scenes.centred(np.eye(3), (-0.5, 0, 0))), as_float32(scenes.centred(np.eye(3), (0.51, 0, 0)))
    values, emitter = rough_grid(15, 1.0), point([1.5, 1, 2.0])
    ball = scenes.ball_of(medium("homogeneous", 0.5, 0.6), (0.2, 0.4, 1.05), 0.5)
    volumes = {"smoke": smoke(values, 0.95, "own", place)[0], "fog": fog(0.8, 0.9, beside)[0]}
    parts = {**volumes, "ball": ball, "emitter": emitter[0]}
    seen = pencils(parts, *aimed(6, 5, 0.4))
    w, rows = weights(5)
    v = np.random.default_rng(8).uniform(0.2, 1, values.shape)

    fog_is = float(as_float32(0.8))

    def light(x=0.0, fog_sigma=fog_is, ball_sigma=0.5):
        media = [
            twins.Medium(twins.Grid(values + x * v, place), 0.95),
            twins.Medium(twins.Box(fog_sigma, beside), 0.9),
            twins.Medium(twins.Ball(ball_sigma, [0.2, 0.4, 1.05], 0.5), 0.6),
        ]
        return rows @ twins.radiance(media, [emitter[1]], seen.o, seen.d, order=10)[:, 0]

    for key, along, truth in (
        (GRID, v, twin_difference(lambda x: light(x), 0.0)),
        ("fog.interior_medium.sigma_t.value.value", 1.0, twin_difference(lambda x: light(fog_sigma=x), fog_is)),
        ("ball.interior_medium.sigma_t.value.value", 1.0, twin_difference(lambda x: light(ball_sigma=x), 0.5)),
    ):
        # The ball's edges are kinks of the twin's shadows: 1e-3.
        assert_gradient(sums(seen, key, w, 2048, along), np.array([truth]), key, 0.08, rounding=2e-3)


def sums(seen: Pencils, key: str, w: np.ndarray, spp: int, v: object = 1.0) -> np.ndarray:
    """The derivative along v, (BATCHES, 1): by default all entries move together, as the channels of a grey parameter do."""
    return np.stack([[np.sum(v * g)] for g in gradients(seen, key, w, spp)])


F7, F9, F3, F6 = (float(as_float32(x)) for x in (0.7, 0.9, 0.3, 0.6))
TWO_COEFFICIENTS = {"type": "mivol_medium", "sigma_a": F3, "sigma_s": F6, "phase": {"type": "rayleigh"}}
BLEND = {"type": "blendphase", "weight": 0.3, "a": {"type": "hg", "g": 0.7}, "b": {"type": "rayleigh"}}


def grid_twin(seed: int, albedo: float = 0.7, phase: Callable = twins.isotropic, scale: float = 1.0) -> twins.Medium:
    return twins.Medium(twins.Grid(rough_grid(seed), PLACE, scale), albedo, phase)


def smoke_of(seed: int, kind: str = "own", **more: object) -> dict:
    medium_type, volume_type = small.KINDS[kind]
    return box_of(medium(medium_type, grid_volume(volume_type, rough_grid(seed), PLACE), 0.7, **more), PLACE)


def of_absorption(a: float, s: float) -> list[twins.Medium]:
    return [twins.Medium(twins.Box(a, PLACE), 0.0), twins.Medium(twins.Box(s, PLACE), 1.0, twins.rayleigh)]


NUMBERS = {
    "fog, sigma_t": lambda: (
        fog(0.9, 0.7, name="hg", g=0.3)[0], "sigma_t.value.value", 0.9,
        lambda x: [twins.Medium(twins.Box(x, PLACE), F7, twins.hg(0.3))],
    ),
    "fog, albedo": lambda: (
        fog(0.9, 0.7, name="hg", g=0.3)[0], "albedo.value.value", 0.7,
        lambda x: [twins.Medium(twins.Box(F9, PLACE), x, twins.hg(0.3))],
    ),
    "sigma_a": lambda: (box_of(TWO_COEFFICIENTS, PLACE), "sigma_a.value.value", F3, lambda x: of_absorption(x, F6)),
    "sigma_s": lambda: (box_of(TWO_COEFFICIENTS, PLACE), "sigma_s.value.value", F6, lambda x: of_absorption(F3, x)),
    "scale": lambda: (smoke_of(6, scale=1.5), "scale", 1.5, lambda x: [grid_twin(6, scale=x)]),
    "weight of a blend": lambda: (
        smoke_of(8, "stock", phase=BLEND), "phase_function.weight.value.value", 0.3,
        lambda x: [grid_twin(8, phase=lambda c: (1 - x) * twins.hg(0.7)(c) + x * twins.rayleigh(c))],
    ),
    # g = 0, where hg.g is a maximum of nothing
    **{
        f"g = {g}": lambda g=g: (
            smoke(rough_grid(7), 0.7, "own", PLACE, "hg", g)[0], "phase_function.g", g,
            lambda x: [grid_twin(7, phase=twins.hg(x))],
        ) for g in (-0.6, 0.0, 0.4, 0.9)
    },
    # at albedo 0 nothing turns, and the derivative is not 0
    **{
        f"albedo {a}, {kind}": lambda a=a, kind=kind: (
            smoke(rough_grid(2), a, kind)[0], "albedo.value.value", a, lambda x: [grid_twin(2, x)],
        ) for a in (0.0, 0.7, 1.0) for kind in small.KINDS
    },
}  # fmt: skip
"""Box of a medium, key of its parameter, value, and the twin's media as a function of the value."""


@pytest.mark.statistical
@pytest.mark.parametrize("name", small.cases(NUMBERS, [name for name in NUMBERS if name != "albedo 0.0, own"]))
def test_derivative_by_a_number(name):
    box, key, x, media = NUMBERS[name]()
    seen, emitter, w, rows = lit(box, "point")
    truth = twin_difference(lambda y: rows @ twins.radiance(media(y), [emitter], seen.o, seen.d)[:, 0], float(as_float32(x)))
    # Some of these are small differences of what turns towards the camera and what is turned away.
    assert_gradient(sums(seen, MEDIUM + key, w, 2048), np.array([truth]), name, 0.08)


@pytest.mark.statistical
@pytest.mark.parametrize("kind", small.cases(small.KINDS, ["stock"]))
def test_albedo_0_under_a_sky_has_a_derivative(kind):
    """At albedo 0 the derivative by the albedo is the integral of T sigma L_s, here with the light of a sky, and not 0."""
    values = rough_grid(2)
    seen = pencils({"smoke": smoke(values, 0.0, kind)[0], "sky": scenes.sky(0.4)}, *aimed(2, 2))
    medium_of_1 = twins.Medium(twins.Grid(values, PLACE), 1.0)
    truth = 3 * twins.radiance([medium_of_1], [twins.Sky(0.4, 10)], seen.o, seen.d, order=3)[:, 0].sum()  # three channels
    found = gradients(seen, MEDIUM + "albedo.value.value", np.ones((1, 2, 3)), 1024)
    # The twin has 10 x 20 directions of the sky: 2e-3 of the light.
    assert_same_mean(Moments.from_values(found.reshape(BATCHES, -1)), np.array([truth]), rounding=2e-3 * truth)


def lit(box: dict, emitter: str) -> tuple[Pencils, twins.Emitter, np.ndarray, np.ndarray]:
    """Six pencils through a box under an emitter, the emitter's twin, and weights."""
    stock, twin = EMITTERS[emitter]()
    return pencils({"smoke": box, "emitter": stock}, *aimed(3, 6)), twin, *weights(6)


@pytest.mark.slow_for("own-0.0", "stock-1.0")
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("kind", "top"), small.cases([(k, t) for k in small.KINDS for t in (0.0, 1.0)], [("stock", 0.0), ("own", 1.0)])
)
def test_albedo_grid(kind, top):
    """Voxel by voxel: the integral of w_k T sigma L_s; also where the albedo is 0 everywhere."""
    emitter, values, albedo = EMITTERS["point"](), rough_grid(3), rough_grid(4, top, (2, 3, 4))
    medium_type, volume_type = small.KINDS[kind]
    interior = medium(medium_type, grid_volume(volume_type, values, PLACE), grid_volume(volume_type, albedo, PLACE))
    seen = pencils({"smoke": box_of(interior, PLACE), "emitter": emitter[0]}, *aimed(3, 6))
    w, rows = weights(6)
    m = twins.Medium(twins.Grid(values, PLACE), twins.trilinear_albedo(albedo, PLACE))
    truth = np.zeros(albedo.shape[:3])
    for turned in twins.turns([m], [emitter[1]], seen.o, seen.d):
        sigma = m.field.sigma(turned.x)[:, 0]
        twins.Grid(albedo, PLACE).weigh(truth, turned.x, rows[turned.ray] * turned.light[:, 0] * sigma)
    assert_gradient(gradients(seen, MEDIUM + "albedo.data", w, 512), truth[..., None], "albedo")


@pytest.mark.slow
@pytest.mark.statistical
def test_scattering_grid():
    """sigma_s on a grid, also where it is 0: what turns is its own, not a share of sigma_t."""
    emitter = EMITTERS["point"]()
    absorb, scatter = rough_grid(5, 1.0, (2, 3, 4)), DENSITIES["half empty"]()
    interior = {
        "type": "mivol_medium",
        "sigma_a": grid_volume("mivol_voxels", absorb, PLACE),
        "sigma_s": grid_volume("mivol_voxels", scatter, PLACE),
    }
    seen = pencils({"smoke": box_of(interior, PLACE), "emitter": emitter[0]}, *aimed(3, 4))
    w, rows = weights(4)
    v = np.random.default_rng(7).uniform(0.2, 1, scatter.shape)

    def light(x):
        media = [twins.Medium(twins.Grid(absorb, PLACE), 0.0), twins.Medium(twins.Grid(scatter + x * v, PLACE), 1.0)]
        return rows @ twins.radiance(media, [emitter[1]], seen.o, seen.d)[:, 0]

    along = sums(seen, MEDIUM + "sigma_s.data", w, 512, v)
    assert_gradient(along, np.array([twin_difference(light, 0.0)]), "sigma_s")


def panorama() -> tuple[dict, twins.Sky]:
    """Radiance 1 + z, as an environment map and for the twin. Its texels are linear in the angle, not in its cosine: 4e-4."""
    rows = 64
    z = np.cos((np.arange(rows) + 0.5) / rows * np.pi)
    sky = np.repeat(np.repeat((1 + z)[:, None, None], 2 * rows, axis=1), 3, axis=2).astype(np.float32)
    up = mi.ScalarTransform4f().rotate([1, 0, 0], 90)  # Mitsuba's panorama has y upwards
    return {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": up}, twins.Sky(lambda w: 1 + w[:, 2:], 12)


@pytest.mark.statistical
@pytest.mark.slow
def test_asymmetry_under_a_sky_that_is_not_constant():
    """Directions are sampled here: the sampling follows g, the estimate of the derivative must not."""
    values, g, (sky, emitter) = rough_grid(7), 0.4, panorama()
    seen = pencils({"smoke": smoke(values, 0.7, "own", PLACE, "hg", g)[0], "sky": sky}, *aimed(3, 3))
    w, weight = weights(3)

    def light(x):
        m = twins.Medium(twins.Grid(values, PLACE), 0.7, twins.hg(x))
        return weight @ twins.radiance([m], [emitter], seen.o, seen.d, order=3)[:, 0]

    # 12 x 24 directions: 1e-3, and the texels.
    truth = np.array([twin_difference(light, g)])
    assert_gradient(sums(seen, MEDIUM + "phase_function.g", w, 2048), truth, "g under a sky", rounding=3e-3)


@pytest.mark.slow
@pytest.mark.statistical
def test_density_under_a_sky_that_is_not_constant():
    """Two shadow rays an event, of which one is walked back, drawn by what it brings; the background is not seen."""
    values, (sky, emitter) = rough_grid(7), panorama()
    seen = pencils({"smoke": smoke(values, 0.9, "own", PLACE, "hg", 0.4)[0], "sky": sky}, *aimed(3, 3))
    w, rows = weights(3)
    m = twins.Medium(twins.Grid(values, PLACE), 0.9, twins.hg(0.4))
    truth, _ = twins.radiance_gradient(m, [emitter], seen.o, seen.d, rows, order=3)
    # What is seen behind: the panorama in the direction of each ray, through all of the grid.
    for o, d, weight in zip(seen.o, seen.d, rows, strict=True):
        behind, _ = twins.radiance_gradient(m, [], o, d, weight, background=1 + d[2])
        truth += behind
    assert_gradient(gradients(seen, GRID, w, 2048), truth[..., None], "panorama", rounding=5e-3)


MICROFLAKES = [[0.3, 0.8, 0.2, 0.05, 0.02, -0.03]]


def of_microflakes() -> mi.Scene:
    """A medium whose extinction is in proportion to the area that microflakes show to the ray."""
    S = mi.VolumeGrid(np.array(MICROFLAKES, dtype=np.float32).reshape(1, 1, 1, 6))
    phase = {"type": "sggx", "S": {"type": "gridvolume", "grid": S, "raw": True}}
    box = box_of({"type": "mivol_medium", "sigma_a": 0.3, "sigma_s": 0.7, "phase": phase}, PLACE)
    return small.close_up({"smoke": box, "emitter": point([1.5, 1, 2.0])[0]}, res=8)


@pytest.mark.slow
def test_microflakes_forward_against_reverse():
    """<J v, w> = <v, J^T w> with the same random numbers, as below."""
    scene, integrator, key = of_microflakes(), mi.load_dict(mivol()), MEDIUM + "phase_function.S.data"
    rng = np.random.default_rng(3)
    v, w = rng.uniform(0.2, 1, (1, 1, 1, 6)), rng.uniform(0.2, 1, (8, 8, 3))
    jv, jtw = jvp(scene, key, v, 8, 5, integrator), vjp(scene, key, w, 8, 5, integrator)
    assert abs((jv * w).sum() - (jtw * v).sum()) <= 1e-5 * np.abs(jv * w).sum()
    assert np.abs(jv).max() > 1e-4


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("key", ["phase_function.S.data", "emitter.position"])
def test_extinction_of_microflakes(key):
    """Extinction changes with matrix and direction: against differences of renders by quadrature, which err by 5e-3 (where
    shadow rays begin to leave by another face)."""
    scene = of_microflakes()
    key = key if key.startswith("emitter") else MEDIUM + key
    params, still = mi.traverse(scene), mi.load_dict(mivol(deterministic=True))
    start, kind = np.array(params[key], dtype=np.float64), type(params[key])
    v, w = np.array([1.0, -0.5, 0.7, 0.3, -0.2, 0.4])[: start.size].reshape(start.shape), np.ones((8, 8, 3))

    def light(x):
        params[key] = kind((start + x * v).astype(np.float32))
        params.update()
        return np.array(mi.render(scene, integrator=still, spp=16, seed=1), dtype=np.float64).sum()

    truth = twin_difference(light, 0.0, 5e-3)
    light(0.0)
    found = gradients(Pencils(scene, None, None, {}), key, w, 512).reshape(BATCHES, -1) @ v.ravel()
    assert_gradient(found[:, None], np.array([truth]), key, rounding=1e-2)


@pytest.mark.slow_for("point-intensity")
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "key"),
    small.cases(
        [("point", "intensity"), ("spot", "intensity"), ("sun", "irradiance")], [("spot", "intensity"), ("sun", "irradiance")]
    ),
)
def test_power_of_an_emitter(name, key):
    """Linear: the derivative is the picture of an emitter of 1."""
    seen, twin, w, rows = lit(smoke(rough_grid(9), 0.7)[0], name)
    unit = type(twin)(**{**vars(twin), key: 1.0})
    truth = rows @ twins.radiance([grid_twin(9)], [unit], seen.o, seen.d)[:, 0]
    assert_gradient(sums(seen, f"emitter.{key}.value", w, 2048), np.array([truth]), name, 0.08)


@pytest.mark.statistical
def test_radiance_of_the_sky():
    box, m = fog(0.8, 0.7)
    seen = pencils({"smoke": box, "sky": scenes.sky(0.7)}, *aimed(3, 3))
    w, rows = weights(3)
    truth = rows @ twins.radiance([m], [twins.Sky(1.0, 24)], seen.o, seen.d, background=1.0)[:, 0]
    assert_gradient(sums(seen, "sky.radiance.value", w, 2048), np.array([truth]), "sky", rounding=3e-4)


def everything(kind: str = "own") -> mi.Scene:
    """A volume with a ball in it over a floor, under an emitter, a panorama and a bulb."""
    turn = mi.ScalarTransform4f
    sky = np.random.default_rng(3).uniform(0.1, 0.6, (8, 16, 3)).astype(np.float32)
    sky[2, 5] = (20.0, 15.0, 9.0)
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
    return small.close_up(
        {
            "smoke": smoke(0.2 + rough_grid(11), 0.7, kind, PLACE, "hg", 0.5)[0],
            "ball": {"type": "sphere", "radius": 0.4, "center": [0.2, 0.1, -0.2], "bsdf": {"type": "diffuse"}},
            "floor": {"type": "rectangle", "to_world": turn().translate([0, 0, -1.2]).scale(3), "bsdf": red},
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
            "bulb": point([1.6, -1.3, 1.7])[0],
            "emitter": {"type": "rectangle", "to_world": turn().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.5)}
            | {"emitter": {"type": "area", "radiance": 4.0}},
        },
        res=8,
    )


KEYS = {
    "sigma_t.data": MEDIUM + "sigma_t.data",
    "albedo": MEDIUM + "albedo.value.value",
    "g": MEDIUM + "phase_function.g",
    "bulb": "bulb.intensity.value",
    "emitter": "emitter.emitter.radiance.value",
    "sky": "sky.data",
    "floor": "floor.bsdf.reflectance.value",
    "scale": MEDIUM + "scale",
}


@pytest.mark.slow
def test_forward_against_reverse():
    """To float32 sums: 1e-5 of the terms."""
    assert_each_transposed(everything(), list(KEYS.values()), mi.load_dict(mivol()), 8, 5, 1e-5)


DIFFERENCES = [("sigma_t.data", "own"), ("g", "own")]


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(("key", "kind"), DIFFERENCES)
def test_against_differences_with_common_random_numbers(key, kind):
    """The mean over pixels of (far - near)/2h - J v over 32 seeds is 0: by Student's t, each channel.

    h = 0.02: truncation h^2 a^2/6 of the derivative with optical depths a of 5 at most along v: 2e-3.
    """
    scene, integrator = everything(kind), mi.load_dict(mivol())
    params = mi.traverse(scene)
    name = KEYS[key]
    start = np.array(params[name])
    v = np.random.default_rng(2).uniform(0.2, 1, start.shape) if start.ndim else 1.0
    kind_of_value, h, spp = type(params[name]), 0.02, 128

    def at(x: np.ndarray, seed: int) -> np.ndarray:
        params[name] = kind_of_value(x.astype(np.float32)) if np.ndim(x) else kind_of_value(float(x))
        params.update()
        return np.array(integrator.render(scene, seed=seed, spp=spp), dtype=np.float64).mean(axis=(0, 1))

    seeds = [fresh(s) for s in range(32)]
    differences = np.array([(at(start + h * v, s) - at(start - h * v, s)) / (2 * h) for s in seeds])
    at(start, 0)
    jv = np.array([jvp(scene, name, v, spp, s, integrator).mean(axis=(0, 1)) for s in seeds])
    m, level = Moments.from_values(differences - jv), np.abs(differences.mean(axis=0))
    assert_same_mean(m, rounding=2e-3 * level.max(), what=key)
    assert_precise(m, 0.02 * level.max(), what=key)


@pytest.mark.slow
@pytest.mark.statistical
def test_seeds_of_picture_and_gradient_are_independent():
    """The gradient of a squared loss through mi.render has the mean 2 (L - r) dL: their noise must not be correlated.

    With one seed for both, 2 cov(L, dL) would be added: with 1 sample a pixel, more than the mean itself. 64 pixels look
    along each of 4 rays, so that one render is 64 independent ones.
    """
    emitter = EMITTERS["sun"]()
    box, m = smoke(DENSITIES["rough"](), 0.7, "own", PLACE, "hg", 0.4)
    o, d = (np.repeat(x, 64, axis=0) for x in aimed(1, 4))
    seen = pencils({"smoke": box, "emitter": emitter[0]}, o, d)
    integrator, key = mi.load_dict(mivol()), MEDIUM + "albedo.value.value"
    L = np.repeat(twins.radiance([m], [emitter[1]], seen.o[::64], seen.d[::64])[:, 0], 64)
    target = mi.TensorXf(np.repeat(0.9 * L[None, :, None], 3, axis=2).astype(np.float32))
    found = []
    for seed in range(BATCHES):
        params, variable = watched(seen.scene, key)
        image = mi.render(seen.scene, params, integrator=integrator, spp=1, seed=fresh(seed))
        dr.backward(dr.sum(dr.square(image - target)))
        found.append(np.array(dr.grad(variable), dtype=np.float64).reshape(1))
        release(seen.scene, key, variable)
    assert_gradient(np.array(found), np.array([np.sum(3 * 2 * 0.1 * L * L / float(as_float32(0.7)))]), "squared loss", 0.2)


def shadow_ray(x: float, value: list[float], on: list[bool]) -> SimpleNamespace:
    """A ray towards +x from (x, 0, 0), of length 10 + x."""
    ray = mi.Ray3f(mi.Point3f(mi.Float([x] * len(on)), 0, 0), mi.Vector3f(1, 0, 0), 0, mi.Color0f())
    segment = RaySegment(ray, dr.zeros(mi.MediumPtr, len(on)), mi.Float([10 + x] * len(on)))
    return SimpleNamespace(ray_segment=segment, value=mi.Spectrum(*value), on=mi.Bool(on))


def test_each_has_its_light_as_probability() -> None:
    """Light of 3 and 1: the first ray for a chance below 3/4, with 4/3 of its value; else the second with 4 times its value.
    Without light, none."""
    probe = SimpleNamespace(
        chance=mi.Float([0.0, 0.74, 0.76, 0.99]),
        direct=[shadow_ray(1.0, [0.5, 1.0, 1.5], [True] * 4), shadow_ray(2.0, [0.25, 0.25, 0.5], [True, True, True, False])],
    )
    ray, value, on = _choose_shadow_ray(probe)
    assert np.array(ray.ray.o.x).tolist() == [1, 1, 2, 2] and np.array(ray.length).tolist() == [11, 11, 12, 12]
    np.testing.assert_allclose(np.array(value).T, [[2 / 3, 4 / 3, 2]] * 2 + [[1, 1, 2]] * 2, rtol=2.0**-21)  # three roundings
    assert np.array(on).tolist() == [True, True, True, False]
    dark = SimpleNamespace(chance=mi.Float([0.2, 0.8]), direct=[shadow_ray(x, [0, 0, 0], [True] * 2) for x in (1.0, 2.0)])
    _, value, on = _choose_shadow_ray(dark)
    assert not np.any(np.array(value)) and not np.any(np.array(on))


def test_one_alone_is_taken() -> None:
    probe = SimpleNamespace(chance=mi.Float(0.9), direct=[shadow_ray(1.0, [0.5, 1.0, 1.5], [True])])
    ray, value, on = _choose_shadow_ray(probe)
    assert ray is probe.direct[0].ray_segment and np.array(value).ravel().tolist() == [0.5, 1, 1.5] and on[0]


WHITE = {
    "a box": lambda interior: {"smoke": box_of(interior, PLACE)},
    "a ball": lambda interior: {"smoke": scenes.ball_of(interior, (0, 0, 0), 1.2)},
    "two boxes": lambda interior: {"smoke": box_of(interior, PLACE), "fog": fog(0.0, 1.0, centred(np.eye(3), (0, 0, 1.6)))[0]},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "place"),
    small.cases([("stock", "a box"), *(("own", place) for place in WHITE)], [("own", "a box"), ("own", "two boxes")]),
)
def test_white_smoke_of_no_density_in_a_constant_sky_has_no_gradient(kind, place):
    """In-scattering equals out-scattering: 0 in each sample, up to the rounding of the two (a few EPS of their size)."""
    gradients = []
    for albedo in (0.0, 1.0):
        medium_type, volume_type = small.KINDS[kind]
        interior = medium(medium_type, grid_volume(volume_type, as_float32(DENSITIES["empty"]()), PLACE), albedo)
        seen = pencils({**WHITE[place](interior), "sky": scenes.sky(0.7)}, *aimed(1, 8))
        integrator = mi.load_dict(mivol())
        gradients.append([vjp(seen.scene, GRID, np.ones((1, 8, 3)), 1, seed, integrator) for seed in range(8)])
    black, white = (np.abs(g).max() for g in gradients)
    assert black > 0.1
    assert white <= 4e-6 * black


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("alone", [True, False])
def test_a_ball_under_a_constant_sky(alone):
    """Density in a traced boundary, alone and behind a box shading it, against differences."""
    interior = medium("mivol_medium", grid_volume("mivol_voxels", 0.2 + rough_grid(1), PLACE), 0.8)
    parts = {"smoke": scenes.ball_of(interior, (0, 0, 0), 1.0), "sky": scenes.sky(0.7)}
    if not alone:
        parts["fog"] = fog(0.8, 0.3, centred(np.eye(3), (0.9, -0.9, 1.3)))[0]
    scene, integrator, w = small.close_up(parts, res=8), mi.load_dict(mivol()), np.ones((8, 8, 3))
    params = mi.traverse(scene)
    start, h = np.array(params[GRID]), 0.02
    v = np.random.default_rng(2).uniform(0.2, 1, start.shape)

    def at(x: float, seed: int) -> float:
        params[GRID] = mi.TensorXf((start + x * v).astype(np.float32))
        params.update()
        return np.array(integrator.render(scene, seed=seed, spp=256), dtype=np.float64).sum()

    seeds = [fresh(s) for s in range(BATCHES)]
    differences = np.array([(at(h, s) - at(-h, s)) / (2 * h) for s in seeds])
    at(0, 0)
    found = np.array([np.sum(v * vjp(scene, GRID, w, 256, s, integrator)) for s in seeds])
    m, level = Moments.from_values((differences - found)[:, None]), abs(differences.mean())
    # Truncation as below.
    assert_same_mean(m, rounding=2e-3 * level, what="ball")
    assert_precise(m, 0.02 * level, what="ball")
