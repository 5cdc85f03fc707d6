"""Scenes with media that emit: against the float64 twin and stock Mitsuba, in any order, before and behind surfaces."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_emission as twins
import pytest
from emission_scenes import (
    LE,
    PLACE,
    B,
    aimed,
    body,
    changes,
    colours,
    directions,
    emitting,
    find,
    gradients,
    interior,
    light,
    like,
    moved,
    pencils,
    put,
    rough,
)
from false_alarms import Estimate, assert_precise, assert_same_mean
from oracle import box_interval, sphere_interval
from scattering_scenes import Pencils, moments

from scenes import (
    FRAMES,
    as_float32,
    ball_of,
    box_of,
    camera,
    centred,
    grid_volume,
    medium,
    refused,
    skip_recorded_grids_on_a_gpu,
)

pytestmark = pytest.mark.usefixtures("traced_balls")

EPS = 2.0**-23


# -- One medium --------------------------------------------------------------------------------------------------------------


@pytest.mark.slow_for("stretched-gridvolume")
@pytest.mark.parametrize("kind", ["mivol_voxels", "gridvolume"])
@pytest.mark.parametrize("frame", ["stretched", pytest.param("sheared", marks=pytest.mark.slow)])
def test_grids_in_any_frame(kind, frame):
    """Extinction, albedo, source function and emission density in one place, wherever that is."""
    place = as_float32(FRAMES[frame])
    at = {"sigma": (1, 0.0, 3.0), "source": (3, 0.0, 1.0), "emission_density": (3, 0.0, 1.0), "albedo": (1, 0.0, 0.8)}
    m = twins.Medium(**{k: (rough(i, low, top, n), place) for i, (k, (n, low, top)) in enumerate(at.items())})
    centre = (place @ [0.5, 0.5, 0.5, 1])[:3]
    o, d = aimed(3, 12, away=8)
    seen = pencils({"box": box_of(interior(m, kind), place), "sky": colours(B)}, as_float32(o + centre), d)
    # Lengths to 2e-6 of the walk; a stock grid that is turned tells its place to 6 digits.
    assert np.abs(light(seen) - twins.cell_radiance(m, seen.o, seen.d, B)).max() <= (2e-5 if kind == "mivol_voxels" else 1e-4)


def assert_differentiated(seen: Pencils, ends: tuple[str, ...]) -> None:
    """Tangents are finite differences, and gradients are their transpose."""
    along, w = directions(seen.scene, ends), np.random.default_rng(2).uniform(size=(len(seen.o), 3))
    jv, found = changes(seen, along), gradients(seen, list(ends), w)
    fd = moved(seen.scene, along, lambda: light(seen))
    assert np.abs(jv - fd).max() <= 2e-4 * np.abs(fd).max()
    total = [np.sum(g * v) for g, v in zip(found, along.values(), strict=True)]
    assert abs(sum(total) - (jv * w).sum()) <= 1e-5 * sum(np.abs(total))


FINE = {
    "coarser, inside of cells": ((3, 2, 4), centred(1.7 * np.eye(3)), 4),
    "finer": ((9, 12, 17), PLACE, 3),
    "finer, turned": ((9, 7, 8), FRAMES["rotated"], 4),
    "half of the cells": ((3, 2, 3), PLACE @ np.diag([0.5, 0.5, 0.6, 1]), 2),
}
"""Voxels (Z, Y, X) of the emission, its place, and the parts of a cell."""


@pytest.mark.slow_for("finer, turned")
@pytest.mark.parametrize("name", FINE)
def test_light_on_other_cells_than_the_extinction(name):
    """A source function has a grid of its own: it is looked up in parts of the extinction's cells. Derivatives too."""
    shape, place, parts = FINE[name]
    m = twins.Medium((rough(1, 0.1, 3), PLACE), (rough(2, 0.1, 1, 3, shape), as_float32(place)), parts=parts)
    seen = emitting(m)
    assert np.abs(light(seen) - twins.cell_radiance(m, seen.o, seen.d, B)).max() <= 4e-6
    assert_differentiated(seen, ("sigma_t.data", "emission.data"))


@pytest.mark.slow_for("gridvolume")
@pytest.mark.parametrize("kind", ["mivol_voxels", "gridvolume"])
def test_light_is_vacuum_outside_its_grid(kind):
    """In a larger boundary of constant extinction: a stock grid would repeat its border for ever."""
    m = twins.Medium(0.5, (rough(5, 0.2, 1, 3), PLACE))
    seen, m = emitting(m, "larger", kind=kind), body(m, "larger")[1]
    assert np.abs(light(seen) - twins.cell_radiance(m, seen.o, seen.d, B)).max() <= 4e-6


def test_emission_ends_with_its_boundary():
    """A constant emission density fills the box, and nothing in front of or behind it."""
    m = twins.Medium((rough(1, 0, 2), PLACE), 0.0, LE)
    seen, m = emitting(m), body(m)[1]
    assert np.abs(light(seen) - twins.cell_radiance(m, seen.o, seen.d, B)).max() <= 4e-6


@pytest.mark.statistical
def test_against_the_transmittance_of_volpath():
    """C = Le (1 - T) + B T with the T that stock Mitsuba estimates in the same extinction."""
    values = rough(1, 0, 3)
    o, d = aimed(1, 12)
    stock = box_of(medium("heterogeneous", grid_volume("gridvolume", values, PLACE)), PLACE)
    T = moments(pencils({"box": stock, "sky": colours(1)}, o, d).scene, {"type": "volpath", "max_depth": 2}, 256, 16)
    C = light(pencils({"box": box_of(interior(twins.Medium((values, PLACE), LE)), PLACE), "sky": colours(B)}, o, d))
    mean, var = T.mean[0], T.variance_of_mean[0]
    # One channel: those of stock share their paths.
    composed = Estimate(LE * (1 - mean) + B * mean, (LE - B) ** 2 * var, T.n - 1)
    assert_same_mean(composed, C, rounding=1e-6, what="radiances")
    assert_precise(T, 0.02, what="transmittances")
    assert mean.min() < 0.3


def test_white_background():
    """C on white less C on black is T: what is rendered once can be put on any background, as posed photographs are."""
    seen = emitting(twins.Medium((rough(1, 0, 3), PLACE), (rough(2, 0, 1, 3), PLACE)), background=1)
    white, (alpha,) = light(seen), light(seen, aovs="alpha")[:, 3:].T
    put(seen.scene, **{"radiance.value": 0 * B})
    black = light(seen)
    assert np.abs(white - black - (1 - alpha)[:, None]).max() <= 4 * EPS
    put(seen.scene, **{"radiance.value": B})
    assert np.abs(light(seen) - (black + B * (1 - alpha)[:, None])).max() <= 4 * EPS


def test_aovs_do_not_see_the_light():
    """tau, alpha and depth with an emission are those without."""
    names = "tau,alpha,depth"
    grid = (rough(1, 0, 3), PLACE)
    plain, bright = twins.Medium(grid), twins.Medium(grid, (rough(2, 0, 1, 3), PLACE), LE)
    found = [light(emitting(m), aovs=names)[:, 3:] for m in (plain, bright)]
    # Two walks of one rule: the order of roundings may differ.
    assert np.abs(found[0] - found[1]).max() <= 4 * EPS * np.abs(found[0]).max()


# -- Several media -----------------------------------------------------------------------------------------------------------


def stack(kinds: str) -> tuple[dict, list[twins.Medium]]:
    """Media one after the other along z: boxed grids (b), traced balls with a grid (t) or without (c)."""
    parts, media = {"sky": colours(B)}, []
    for i, kind in enumerate(kinds):
        z = 2.2 * (i - (len(kinds) - 1) / 2)
        place = as_float32(centred(2 * np.eye(3), (0, 0, z)))
        tops = enumerate(((1.5, 1), (1, 3), (1, 3)))
        sigma, source, density = (rough(3 * i + k, 0, top, n, (4, 5, 3)) for k, (top, n) in tops)
        fields = ((sigma, place), (source, place), (density, place)) if kind != "c" else (as_float32([0.3, 0.5, 0.9]), LE, B)
        m = twins.Medium(*fields)
        if kind == "b":
            parts[f"part{i}"] = box_of(interior(m), place)
            media.append(twins.Medium(*fields, 0.0, lambda o, d, place=place: box_interval(place, o, d)))
        else:
            parts[f"part{i}"] = ball_of(interior(m), [0, 0, z], 1.0)
            media.append(twins.Medium(*fields, 0.0, lambda o, d, z=z: sphere_interval([0, 0, z], 1.0, o, d)))
    return parts, media


def along_z(n: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Rays up and down."""
    rng = np.random.default_rng(4)
    way = np.where(np.arange(n) % 2, 1.0, -1.0)[:, None]
    o = np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), -6 * way])
    d = np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), 6 * way]) - o
    return as_float32(o), as_float32(d / np.linalg.norm(d, axis=1, keepdims=True))


@pytest.mark.slow
@pytest.mark.parametrize("kinds", ["bt", "bb", "bcb", "tt", "tbt", "cbc"])
def test_several_media(kinds):
    """Whatever order media are declared in, and whether they are traced: each dims what is behind it; derivatives too."""
    parts, media = stack(kinds)
    seen = pencils(parts, *along_z())
    truth = twins.chain_radiance(media, seen.o, seen.d, B)
    # Ends of traced intervals are Mitsuba's, 4e-6 of an extinction or emission density of 1.5 at coordinates of 6.
    assert np.abs(light(seen) - truth).max() <= 1e-4
    ends = [k for k, _ in mi.traverse(seen.scene) if "interior_medium" in k and k.endswith(("data", "value.value"))]
    assert_differentiated(seen, tuple(k for k in ends if "albedo" not in k))


@pytest.mark.slow
def test_a_ball_within_a_box():
    """Nested boundaries: the outer medium is left where the inner one begins."""
    outer, inner = twins.Medium(as_float32([0.2, 0.4, 0.3]), LE), twins.Medium(1.5, B, LE)
    ball = ball_of(interior(inner), [0, 0, 0], 0.5) | {"exterior": interior(outer)}
    seen = pencils({"box": box_of(interior(outer), PLACE), "ball": ball, "sky": colours(0.3)}, *aimed(1, 12, size=0.3))
    truth = []
    for o, d in zip(seen.o, seen.d, strict=True):
        (a, b), (c, e) = box_interval(PLACE, o, d), sphere_interval([0, 0, 0], 0.5, o, d)
        cuts = [(outer, a, c), (inner, c, e), (outer, e, b)] if e > c else [(outer, a, b)]
        media = [twins.Medium(m.sigma, m.source, m.emission_density, 0.0, lambda o, d, i=(x, y): i) for m, x, y in cuts]
        truth.append(twins.chain_radiance(media, o, d, 0.3)[0])
    assert np.abs(light(seen) - truth).max() <= 2e-5


@pytest.mark.slow_for("box")
@pytest.mark.parametrize("boundary", ["box", pytest.param("ball", marks=pytest.mark.slow)])
def test_an_opaque_surface_occludes_and_is_seen_through(boundary):
    """An emitter in the field: what is behind it is hidden, what is before it dims it and shines over it."""
    grids = [(rough(i, 0, top, n), PLACE) for i, (top, n) in enumerate(((2, 1), (1, 3), (1, 3)))]
    shape, m = body(twins.Medium(*grids), boundary)
    facing = mi.ScalarTransform4f().look_at([0.1, 0, 0.2], [0.1, 0, 5], [0, 1, 0]).scale(9)
    shine = {"type": "area", "radiance": {"type": "rgb", "value": [2, 3, 1]}}
    emitter = {"type": "rectangle", "to_world": facing, "emitter": shine}
    o, d = along_z()
    o, d = o[d[:, 2] < 0], d[d[:, 2] < 0]
    seen = pencils({"box": shape, "emitter": emitter, "sky": colours(B)}, o, d)
    ends = (0.2 - seen.o[:, 2]) / seen.d[:, 2]
    truth = [twins.cell_radiance(m, *ray, [2, 3, 1], end)[0] for *ray, end in zip(seen.o, seen.d, ends, strict=True)]
    assert np.abs(light(seen) - truth).max() <= 2e-5
    assert np.abs(light(seen, max_depth=3) - truth).max() <= 2e-5


# -- Variants, recordings ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_mono():
    """A grey field is any channel of the rgb image; a coloured light is its luminance, with its derivative."""
    m = twins.Medium((rough(1, 0, 2), PLACE), (rough(2, 0, 1, 3), PLACE), (rough(3, 0, 1, 3), PLACE))
    rgb = emitting(m, background=0.5)
    w = np.random.default_rng(1).uniform(size=(12, 1))
    ends = ["sigma_t.data", "emission.data", "emission_density.data"]
    luminance = np.array([0.212671, 0.715160, 0.072169])
    colour, vjp = light(rgb), gradients(rgb, ends, w * luminance)
    try:
        mi.set_variant("llvm_ad_mono")
        mono = emitting(m, background=0.5)
        assert np.abs(light(mono)[:, :1] - colour @ luminance[:, None]).max() <= 4e-6
        for g, truth in zip(gradients(mono, ends, w), vjp, strict=True):
            assert np.abs(g - truth).max() <= 4e-6 * np.abs(truth).max()
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_frozen_renders_follow_the_light():
    """dr.freeze: extinction, source function and emission density that change between calls."""
    skip_recorded_grids_on_a_gpu()
    m = twins.Medium((rough(1, 0, 2), PLACE), (rough(2, 0, 1, 3), PLACE), (rough(3, 0, 1, 3), PLACE))
    seen, integrator = emitting(m), mi.load_dict({"type": "mivol", "max_depth": 1})
    params = mi.traverse(seen.scene)
    frozen = dr.freeze(lambda scene, integrator: mi.render(scene, integrator=integrator, spp=1))
    light(seen)
    for call in range(4):
        for k, end in enumerate(("sigma_t.data", "emission.data", "emission_density.data")):
            params[find(params, end)] = mi.TensorXf(rough(10 * call + k, 0, 1, 1 if k == 0 else 3).astype(np.float32))
        params.update()
        dr.eval([v for k, v in params if k.endswith("data")])
        assert np.array_equal(np.array(frozen(seen.scene, integrator))[0], light(seen).astype(np.float32))
    assert frozen.n_recordings < 4


@pytest.mark.parametrize("end", ["emission.data", pytest.param("albedo.data", marks=pytest.mark.slow)])
def test_frozen_gradient_steps(end):
    """The update of a volume that is looked up as a texture, the render and its reverse pass in one recording."""
    skip_recorded_grids_on_a_gpu()
    grids = [(rough(i, 0, top, n), PLACE) for i, (top, n) in enumerate(((2, 1), (1, 3), (0.9, 3)))]
    seen = emitting(twins.Medium(grids[0], grids[1], 0.0, grids[2]))
    integrator, params = mi.load_dict({"type": "mivol", "max_depth": 1}), mi.traverse(seen.scene)
    key = find(params, end)

    def step(scene, integrator, params, x):
        dr.enable_grad(x)
        params[key] = x
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=1)
        dr.backward(dr.mean(image * image, axis=None))
        return dr.grad(x)

    light(seen)
    frozen = dr.freeze(step)
    for call in range(3):
        values = rough(call, 0.1, 0.9, 3).astype(np.float32)
        x, y = mi.TensorXf(values), mi.TensorXf(values)
        dr.eval(x, y)
        replayed, plain = (np.array(f(seen.scene, integrator, params, z)) for f, z in ((frozen, x), (step, y)))
        assert np.abs(replayed - plain).max() <= 1e-5 * np.abs(plain).max() > 0


# -- Refusals ----------------------------------------------------------------------------------------------------------------


def picture(inside: dict, **more: dict) -> mi.Scene:
    view = camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=4, fov=40.0)
    return mi.load_dict({"type": "scene", "box": box_of(inside, PLACE), "sky": colours(B), "sensor": view, **more})


def shoot(scene: mi.Scene, **more: object) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": 1, **more}), spp=1))


def test_volpath_does_not_leave_the_light_out():
    """An integrator of Mitsuba's that meets an emitting medium shows NaN; one that only shares the process with it does not."""
    bright = picture(interior(twins.Medium(0.5, LE)))
    plain = picture(medium("mivol_medium", 0.5))
    volpath = mi.load_dict({"type": "volpath", "max_depth": 2})
    assert np.isnan(np.array(mi.render(bright, integrator=volpath, spp=4))).any()
    assert np.isfinite(np.array(mi.render(plain, integrator=volpath, spp=4))).all()


def test_emission_density_in_other_cells_is_refused():
    sigma = (rough(1, 0, 2), PLACE)
    for density in ((rough(2, 0, 1, 3, (5, 4, 7)), PLACE), (rough(2, 0, 1, 3), as_float32(centred(1.5 * np.eye(3))))):
        with refused("it is summed in the cells of the extinction"):
            shoot(picture(interior(twins.Medium(sigma, 0.0, density))))
    # Where the extinction has no grid, the emission density's own cells are walked.
    assert np.isfinite(shoot(picture(interior(twins.Medium(0.5, 0.0, (rough(2, 0, 1, 3), PLACE)))))).all()


@pytest.mark.slow_for("mivol_voxels")
@pytest.mark.parametrize("kind", ["mivol_voxels", "gridvolume"])
def test_an_albedo_alone_brings_the_cells(kind):
    """Nothing else is a grid: the same light as through an extinction of the same values on the albedo's own cells."""
    albedo = (rough(5, 0, 1), PLACE)
    alone = light(emitting(twins.Medium(0.8, LE, 0.0, albedo), kind=kind))
    on_cells = light(emitting(twins.Medium((np.full_like(albedo[0], 0.8), PLACE), LE, 0.0, albedo), kind=kind))
    # Sums of up to 15 cells of at most 0.7 in float32, twice.
    assert np.abs(alone - on_cells).max() <= 30 * 0.7 * 2.0**-24
    flat = light(emitting(twins.Medium(0.8, LE, 0.0, float(albedo[0].mean())), kind=kind))
    assert np.abs(alone - flat).max() > 0.01


def test_the_finer_of_emission_and_albedo_brings_the_cells():
    albedo, emission = (rough(5, 0, 1, 1, (5, 8, 6)), PLACE), (rough(6, 0, 1, 3, (5, 4, 3)), PLACE)
    alone = light(emitting(twins.Medium(0.8, emission, 0.0, albedo)))
    on_cells = light(emitting(twins.Medium((np.full_like(albedo[0], 0.8), PLACE), emission, 0.0, albedo)))
    assert np.abs(alone - on_cells).max() <= 30 * 2.0**-24


def test_an_albedo_that_varies_within_the_cells_is_refused():
    sigma, albedo = (rough(1, 0, 2), PLACE), (rough(2, 0, 1, 1, (5, 50, 6)), PLACE)
    with refused("the albedo of the medium in box varies over lengths of .* of its extinction's cells"):
        shoot(picture(interior(twins.Medium(sigma, LE, 0.0, albedo))))
    # Without emission there is nothing to be looked at.
    assert np.isfinite(shoot(picture(interior(twins.Medium(sigma, 0.0, 0.0, albedo))))).all()


@pytest.mark.slow_for("gridvolume")
@pytest.mark.parametrize("kind", ["mivol_voxels", "gridvolume"])
def test_a_source_that_varies_within_the_cells_is_refused(kind):
    """Eight parts of a cell would miss it."""
    sigma = (rough(1, 0, 2), PLACE)
    for source in (
        (rough(2, 0, 1, 3, (5, 4, 57)), PLACE),
        (rough(2, 0, 1, 3), as_float32(PLACE @ np.diag([0.1, 0.9, 0.9, 1]))),
    ):
        with refused("the emission of the medium in box varies over lengths of .* of its extinction's cells"):
            shoot(picture(interior(twins.Medium(sigma, source), kind)))
    # In a constant extinction it is the light's cells that are walked: the emission density's, where there are both.
    fine, coarse = (rough(2, 0, 1, 3, (45, 4, 6)), PLACE), (rough(3, 0, 1, 3), PLACE)
    with refused("the emission of the medium in box varies over lengths of .* of its emission_density's cells"):
        shoot(picture(interior(twins.Medium(0.5, fine, coarse), kind)))
    for m in (twins.Medium(0.5, fine), twins.Medium(0.5, coarse, fine), twins.Medium(sigma, coarse)):
        assert np.isfinite(shoot(picture(interior(m, kind)))).all()


def test_extinctions_in_other_cells_are_refused():
    parts = {"sigma_a": rough(1, 0, 2), "sigma_s": rough(2, 0, 2, 1, (3, 4, 5)), "emission": rough(3, 0, 1, 3)}
    inside = {"type": "mivol_medium", **{k: grid_volume("mivol_voxels", v, PLACE) for k, v in parts.items()}}
    with refused(r"a medium emits and a medium sums grids of .* take its emission out"):
        shoot(picture(inside))


def test_microflakes_are_refused():
    microflakes = {"type": "sggx", "S": {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((1, 1, 1, 6), np.float32))}}
    with refused("a medium emits and a medium has the phase function sggx"):
        shoot(picture(interior(twins.Medium(0.5, LE)) | {"phase": microflakes}))


@pytest.mark.parametrize("bad", [-0.1, np.nan, np.inf])
@pytest.mark.parametrize("kind", ["mivol_voxels", "gridvolume"])
def test_light_that_cannot_be(kind, bad):
    """Our grids look at their values when they are loaded, stock ones are looked at before a render. Hard cases 26 and 27."""
    values = rough(2, 0, 1, 3).astype(np.float32)
    values[1, 2, 3, 0] = bad
    given = interior(twins.Medium((rough(1, 0, 2), PLACE), (values, PLACE)), kind)
    if kind == "mivol_voxels":
        with pytest.raises(RuntimeError, match=r"voxel \(z=1, y=2, x=3, channel=0\)"):
            picture(given)
        return
    with refused("the emission of the medium in box lies in"):
        shoot(picture(given))


def test_a_constant_that_became_negative():
    """Hard case 26."""
    scene = picture(interior(twins.Medium(0.5, LE)))
    params = mi.traverse(scene)
    key = find(params, "emission.value.value")
    params[key] = like(params[key], [0.1, -0.2, 0.3])
    with refused("emission of a mivol_medium is -0.2"):
        params.update()
    with refused("the emission of the medium in box lies in"):
        shoot(scene)


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("bright", "emission is 'bright'"),
        ({"type": "sphere"}, "emission is a Sphere"),
        (-1.0, "emission is -1"),
        ({"type": "rgb", "value": [0.1, -0.5, 0]}, "emission is -0.5"),
    ],
)
def test_light_that_is_no_field(value, why):
    with pytest.raises(RuntimeError, match=why):
        picture({"type": "mivol_medium", "sigma_t": 1.0, "emission": value})
