"""Scattered light by quadrature along pencils: against the float64 twin, without any noise to hide behind.

The rule is exact for smooth light to far below what is allowed; its error is where shadows bend within a piece: tau towards
an emitter has a kink where the shadow ray begins to cross another cell, or to leave by another face. A piece of optical depth p
with a kink of its own slope errs by p^2 / 8 of its light: 0.25^2 / 8 = 8e-3; of the pieces of a ray at most half have one.
"""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_scattering as twins
import pytest
from scattering_scenes import PLACE, aimed, close_up, fog, mivol, pencils, point, rough_grid, smoke, spot, sun

from mivol.transport.estimators.single_scattering import scattering_quadrature as quadrature
from scenes import as_float32, box_of, centred, grid_volume, refused, sky

EMITTERS = {
    "point outside": lambda: [point([1.5, 1, 2.0])],
    "point inside": lambda: [point([0.3, -0.2, 0.35])],
    "spot": lambda: [spot([1.0, -2, 2.5], [0, 0, 0], cutoff=60, beam=59)],
    "sun": lambda: [sun([0.3, 0.2, -1.0])],
    "two": lambda: [point([1.5, 1, 2.0]), sun([0.3, 0.2, -1.0], 0.3)],
}


def image(seen, **more) -> np.ndarray:
    return np.array(mi.render(seen.scene, integrator=mi.load_dict(mivol(deterministic=True, **more)), spp=1))[0]


def beside(parts: dict, media: list, emitters: list, order: int = 6) -> tuple[np.ndarray, np.ndarray]:
    seen = pencils(parts | {f"emitter{i}": emitter for i, (emitter, _) in enumerate(emitters)}, *aimed(3))
    truth = twins.radiance(media, [twin for _, twin in emitters], seen.o, seen.d, order=order)
    return image(seen), np.broadcast_to(truth, (len(seen.o), 3))


@pytest.mark.parametrize("emitters", EMITTERS)
def test_grid(emitters):
    box, m = smoke(rough_grid(1), name="hg", g=0.4)
    found, truth = beside({"smoke": box}, [m], EMITTERS[emitters]())
    assert np.abs(found - truth).max() <= 4e-3 * truth.max()


@pytest.mark.parametrize("emitters", ["point outside", "sun", "point inside"])
@pytest.mark.parametrize("sigma_t", [0.1, 2.0, 30.0])
def test_homogeneous(emitters, sigma_t):
    box, m = fog(sigma_t)
    # Sixty optical depths across: the twin's own Gauss rule needs more points than a cell would.
    found, truth = beside({"fog": box}, [m], EMITTERS[emitters](), order=96)
    # 64 to 256 pieces; the face by which shadows leave changes once or twice along a ray.
    assert np.abs(found - truth).max() <= 4e-3 * truth.max()


SCATTERERS = {"numbers": (0.4, 0.9), "grids": ("grid", "grid"), "haze": (0.4, "grid"), "soot": ("grid", 0.5)}


@pytest.mark.slow_for("grids", "haze", "soot")
@pytest.mark.parametrize("name", SCATTERERS)
def test_absorption_beside_scattering(name):
    """What turns is sigma_s; a constant fills its box around the grid, too."""
    kinds = dict(zip(("sigma_a", "sigma_s"), SCATTERERS[name], strict=True))
    grids = {"sigma_a": rough_grid(4), "sigma_s": rough_grid(5)}
    inner = centred(1.2 * np.eye(3))
    volumes = {k: grid_volume("mivol_voxels", grids[k], inner) if v == "grid" else v for k, v in kinds.items()}
    box = box_of({"type": "mivol_medium", **volumes, "phase": {"type": "isotropic"}}, PLACE)
    media = [
        twins.Medium(twins.Grid(grids[k], inner) if v == "grid" else twins.Box(float(as_float32(v)), PLACE), alone)
        for (k, v), alone in zip(kinds.items(), (0.0, 1.0), strict=True)
    ]
    found, truth = beside({"smoke": box}, media, [point([1.5, 1, 2.0])], order=24)
    assert np.abs(found - truth).max() <= 4e-3 * truth.max()


FAINT = 1e-7


@pytest.mark.slow_for("smoke")
@pytest.mark.parametrize("name", ["fog", "smoke"])
def test_a_floor_is_seen_through_dark_smoke(name):
    """reflectance / pi irradiance T^2, straight down and straight back: 1.2 optical depths each way. Smoke of no albedo at all
    would be left to another estimator; what this one scatters, FAINT 2 / (4 pi), is 6e-7 of what is seen."""
    box, _ = fog(0.6, FAINT) if name == "fog" else smoke(np.full((3, 4, 5, 1), 0.6, np.float32), FAINT)
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.5]).scale(4)}
    floor["bsdf"] = {"type": "diffuse", "reflectance": 0.5}
    seen = pencils({"smoke": box, "floor": floor, "emitter": sun([0, 0, -1.0])[0]}, [0.2, 0.1, 3.0], [0.0, 0.0, -1.0])
    # Optical depths of 1.2 to 1e-6 of themselves, twice, and float32 products.
    np.testing.assert_allclose(image(seen), 0.5 / np.pi * 2 * np.exp(-2.4), rtol=1e-5)


def test_two_renders_are_the_same():
    box, _ = smoke(rough_grid(1))
    emitter, _ = point([1.5, 1, 2.0])
    seen = pencils({"smoke": box, "emitter": emitter}, *aimed(3))
    assert np.array_equal(image(seen), image(seen))


@pytest.mark.slow
def test_gradients_are_drawn():
    """A deterministic image has the derivative of the image that is drawn: the same integrator makes it."""
    box, _ = smoke(rough_grid(1))
    emitter, _ = point([1.5, 1, 2.0])
    scene = close_up({"smoke": box, "emitter": emitter})
    params, grads = mi.traverse(scene), []
    key = next(k for k, _ in params if k.endswith("sigma_t.data"))
    for more in ({}, {"deterministic": True}):
        dr.enable_grad(params[key])
        picture = mi.render(scene, params, integrator=mi.load_dict(mivol(**more)), spp=4, seed=1, seed_grad=2)
        dr.backward(dr.sum(picture, axis=None))
        grads.append(np.array(dr.grad(params[key])))
        dr.disable_grad(params[key])
        params[key] = mi.TensorXf(np.array(params[key]))
        params.update()
    # The order of sums over threads is not fixed.
    assert np.abs(grads[0] - grads[1]).max() <= 1e-5 * np.abs(grads[0]).max()


def test_refusals():
    box, _ = smoke(rough_grid(1))
    emitter, _ = point([1.5, 1, 2.0])
    for more, why in (({"deterministic": True}, "ConstantBackground"), ({"shadows": "grid"}, "without deterministic")):
        with refused(why):
            mi.render(close_up({"smoke": box, "emitter": emitter, "sky": sky()}), integrator=mi.load_dict(mivol(**more)), spp=1)
    apart = {"sigma_a": rough_grid(1), "sigma_s": rough_grid(2, shape=(2, 3, 4))}
    for volumes, more, why in (
        (apart, {}, "share their cells"),
        ({"sigma_a": apart["sigma_a"], "sigma_s": 0.4}, {"shadows": "grid"}, "sigma_s of the medium in smoke is a constant"),
    ):
        given = {k: v if isinstance(v, float) else grid_volume("mivol_voxels", v, PLACE) for k, v in volumes.items()}
        scene = close_up({"smoke": box_of({"type": "mivol_medium", **given}, PLACE), "emitter": emitter})
        with refused(why):
            mi.render(scene, integrator=mi.load_dict(mivol(deterministic=True, **more)), spp=1)
    glowing = box_of({"type": "mivol_medium", "sigma_t": 1.0, "albedo": 0.5, "emission": 0.5}, PLACE)
    behind_glass = box | {"bsdf": {"type": "dielectric"}}
    for inside, why in (
        (glowing, "smoke emits light too"),
        (behind_glass, r"the boundary smoke \(SmoothDielectric\) refracts"),
    ):
        with refused(why):
            mi.render(
                close_up({"smoke": inside, "emitter": emitter}), integrator=mi.load_dict(mivol(deterministic=True)), spp=1
            )
    with refused("estimated or grid"):
        mi.render(close_up({"smoke": box, "emitter": emitter}), integrator=mi.load_dict(mivol(shadows="soft")), spp=1)


DEEP_CELLS = {
    "grid": lambda tau: grid_volume("gridvolume", np.full((4, 4, 4, 1), 4 * tau)),
    "layers": lambda tau: grid_volume("gridvolume", 4 * tau * LAYERS * np.ones((4, 4, 4, 1))),
    "rgb grid": lambda tau: grid_volume("mivol_voxels", np.full((4, 4, 4, 3), 4.0) * [20, 20 * tau**0.5, tau]),
    "rgb": lambda tau: {"type": "rgb", "value": [80.0, 80 * tau**0.5, 4 * tau]},
}
LAYERS = np.array([0.0, 1.0, 0.02, 0.5])[:, None, None, None]
"""From the face that is lit: the first voxel empty, and a dark layer behind a clear one."""


@pytest.mark.parametrize("tau", [500, 2500, 5000, 1e5])
@pytest.mark.parametrize("name", DEEP_CELLS)
def test_deep_cells_lose_no_light(name, tau):
    """Layers lit by a sun at the cosine mu, seen along their normal: albedo irradiance / (4 pi) / (1 + 1 / mu) for any layers.

    The medium is dark long before its far end. `tau` is the optical depth of a cell.
    """
    mu, albedo = 0.6, 0.8
    box = box_of({"type": "mivol_medium", "sigma_t": DEEP_CELLS[name](tau), "albedo": albedo}, np.eye(4))
    seen = pencils({"smoke": box, "emitter": sun([0.8, 0, mu], 2.0)[0]}, [0.55, 0.45, -0.25], [0.0, 0.0, 1.0])
    found = image(seen)[0]
    truth = albedo * 2.0 / (4 * np.pi) / (1 + 1 / mu)
    # Distances along the ray are rounded by half an ulp of 1/4 (the face is at z = 0, coordinates are exact there): what is lit
    # errs by the optical depth of that, seen from the sun. Pieces of 0.25 add a
    # fourth order of that: 0.25^4 / 4320 (the Gauss rule's), which leaves room for float32 sums of 700 pieces: 700 ulp, 1e-4.
    rounding = 4 * tau * np.spacing(np.float32(0.25)) / 2 / mu
    assert np.abs(found / truth - 1).max() <= 1e-4 + rounding


@pytest.mark.parametrize(
    ("sigma", "angle", "least", "pieces"),
    [
        (0.01, None, 1, 1),
        (0.01, None, 3, 3),
        (2.0, None, 1, 16),  # an optical depth of 4 in pieces of 1/4
        (0.01, 0.45, 1, 5),  # an angle of 0.45 in turns of 0.1
        (2.0, 0.45, 1, 16),
        (0.01, -1.0, 1, 1),  # an emitter at infinity has no angle
    ],
)
def test_a_span_is_cut_by_optical_depth_and_by_angle(
    monkeypatch: pytest.MonkeyPatch, sigma: float, angle: float | None, least: int, pieces: int
) -> None:
    counted = []
    monkeypatch.setattr(quadrature, "_add_pieces", lambda state, span, is_deep, edges, count: counted.append(count) or state)
    towards = None
    if angle is not None:
        towards = SimpleNamespace(finite=mi.Bool(angle > 0), angle=lambda start, dt: mi.Float(abs(angle)))
    profile = lambda x: [mi.Float(part * sigma) for part in (0.5, 1.0, 0.25)]  # noqa: E731
    span = quadrature._Span(mi.Float64(1), mi.Float(2), profile, None, towards, mi.Bool(True))
    state = quadrature._LightSum([mi.Float(0)] * 3, [mi.Float(1)] * 3, mi.Spectrum(0))
    quadrature._add_span(state, span, mi.Float(least))
    assert [int(count[0]) for count in counted] == [pieces]
