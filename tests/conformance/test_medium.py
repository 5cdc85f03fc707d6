"""Where stock grids lie, and what a view of a medium holds."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import scenes
from mivol.scene.needs import Survey, is_scattering
from mivol.transport.medium import box_of_cube, place_of_grid, view_medium
from scenes import FRAMES, box_of, camera, grid_volume, medium, refused, render, sky

pytestmark = pytest.mark.usefixtures("variant_rgb")

VALUES = np.ones((3, 4, 5, 1), np.float32)


@pytest.mark.parametrize("draw", range(6))
def test_a_stock_grid_that_fills_its_boundary_is_placed_exactly(draw):
    """The six digits that a gridvolume prints are replaced by the boundary's vertices (float32)."""
    rng = np.random.default_rng(draw)
    turned = scenes.rotation(rng.normal(size=3), rng.uniform(0.3, 3)) @ np.diag(rng.uniform(1, 3, 3))
    place = scenes.centred(turned, rng.uniform(1, 3, 3))
    cube = mi.load_dict(box_of(medium("heterogeneous", grid_volume("gridvolume", VALUES, place)), place))
    found = view_medium(cube.interior_medium(), box_of_cube(cube)).parts[0].lattice.to_world
    # Vertices of size 6 at most, each rounded to half an ulp (2^-22) once in the transform and once in the product; the fit
    # over 24 of them averages. Six digits would leave 5e-6.
    assert np.abs(found - place).max() <= 2 * 2.0**-22


@pytest.mark.parametrize("frame", FRAMES)
def test_a_stock_grid_elsewhere_is_placed_to_six_digits(frame):
    place = FRAMES[frame]
    volume = mi.load_dict(grid_volume("gridvolume", VALUES, place))
    # The promise of place_of_grid: 5e-6 of the size.
    assert np.abs(place_of_grid(volume) - place).max() <= 5e-6 * np.abs(place).max()


def test_our_grid_knows_its_place():
    place = FRAMES["sheared"]
    volume = mi.load_dict(grid_volume("mivol_voxels", VALUES, place))
    assert np.array_equal(place_of_grid(volume), np.float32(place).astype(np.float64))


def scatters(description: dict) -> bool:
    return is_scattering(view_medium(mi.load_dict(description)), Survey((), (), False, (), (), ()), "box")


def test_a_medium_that_scatters_says_so():
    assert scatters(medium("homogeneous", 1.0, 0.5))
    assert not scatters(medium("homogeneous", 1.0, 0.0))
    both = {"type": "mivol_medium", "sigma_a": 1.0, "sigma_s": grid_volume("mivol_voxels", VALUES)}
    assert scatters(both)


def test_a_volume_of_another_kind_is_refused():
    """A medium over something that is neither a number nor a grid."""

    class Odd(mi.Volume):
        def max(self):
            return 1.0

        def traverse(self, callback):
            callback.put("strange", mi.Float(1), mi.ParamFlags.Differentiable)

        def to_string(self):
            return "Odd"

    mi.register_texture("odd_volume", lambda props: Odd(props))
    odd = mi.load_dict({"type": "heterogeneous", "sigma_t": {"type": "odd_volume"}, "albedo": 0.0})
    with refused("strange.*gridvolume"):
        view_medium(odd)


def test_coefficients_of_both_pairs_agree():
    """sigma_a = 2, sigma_s = 1 is sigma_t = 3 with albedo 1/3, at every scale; the null part is what the bound leaves."""
    import drjit as dr

    grid = grid_volume("mivol_voxels", np.linspace(0.2, 2.0, 60, dtype=np.float32).reshape(3, 4, 5, 1))
    parts = {"type": "mivol_medium", "sigma_a": grid, "sigma_s": 1.0, "scale": 0.5}
    medium_a = mi.load_dict(parts)
    mei = dr.zeros(mi.MediumInteraction3f, 64)
    mei.p = mi.Point3f(np.random.default_rng(1).uniform(0.1, 0.9, (3, 64)).astype(np.float32))
    sigma_s, sigma_n, sigma_t = (np.array(c) for c in medium_a.get_scattering_coefficients(mei))
    sigma_a = np.array(mi.load_dict(grid).eval_1(mei))
    majorant = np.array(medium_a.get_majorant(mei))
    # Products and sums of three float32 numbers below 2.
    assert np.abs(sigma_t - 0.5 * (sigma_a + 1)).max() <= 8 * 2.0**-24
    assert np.abs(sigma_s - 0.5).max() <= 2.0**-24
    assert np.abs(sigma_n + sigma_t - majorant).max() <= 8 * 2.0**-24
    assert sigma_n.min() >= 0


# -- Numbers that an optimiser can reach ---------------------------------------------------------------------------------


def fog(interior: dict) -> mi.Scene:
    view = camera([0.5, 0.4, 4], [0.5, 0.5, 0.5], 4, fov=5)
    return mi.load_dict({"type": "scene", "smoke": box_of(interior, np.eye(4)), "sky": sky(), "sensor": view})


def put(scene: mi.Scene, name: str, number: float, channel: int = 0) -> None:
    """Set a number of the medium, or one channel of it."""
    params = mi.traverse(scene)
    key = next(k for k in (f"{MEDIUM}.{name}{end}" for end in ("", ".value.value")) if k in params)
    old = params[key]
    if dr.size_v(old) == 3:
        params[key] = mi.Color3f(*(number if c == channel else old[c] for c in range(3)))
    else:
        params[key] = number if isinstance(old, float) else mi.Float(number)
    params.update()


MEDIUM = "smoke.interior_medium"
GREY, RGB = 1.0, {"type": "rgb", "value": [1.0, 2.0, 0.5]}
CONSTVOLUME = {"type": "constvolume", "value": 1.0}
HALF = {"type": "rgb", "value": [0.5, 0.4, 0.3]}
NUMBERS = {
    "scale, homogeneous": ("scale", lambda: medium("homogeneous", GREY, scale=1.0)),
    "scale, heterogeneous": ("scale", lambda: medium("heterogeneous", grid_volume("gridvolume", VALUES), scale=1.0)),
    "scale, ours": ("scale", lambda: medium("mivol_medium", grid_volume("mivol_voxels", VALUES), scale=1.0)),
    "sigma_t, homogeneous": ("sigma_t", lambda: medium("homogeneous", GREY)),
    "sigma_t, heterogeneous": ("sigma_t", lambda: medium("heterogeneous", CONSTVOLUME)),
    "sigma_t, ours": ("sigma_t", lambda: medium("mivol_medium", GREY)),
    "sigma_t, rgb homogeneous": ("sigma_t", lambda: medium("homogeneous", HALF)),
    "sigma_t, rgb ours": ("sigma_t", lambda: medium("mivol_medium", RGB)),
    "sigma_a": ("sigma_a", lambda: {"type": "mivol_medium", "sigma_a": RGB, "sigma_s": 0.0}),
    "sigma_s": ("sigma_s", lambda: {"type": "mivol_medium", "sigma_a": 0.0, "sigma_s": GREY}),
    "albedo, homogeneous": ("albedo", lambda: medium("homogeneous", GREY, HALF)),
    "albedo, ours": ("albedo", lambda: medium("mivol_medium", GREY, HALF)),
    "emission": ("emission", lambda: medium("mivol_medium", GREY, emission=RGB)),
    "emission_density": ("emission_density", lambda: medium("mivol_medium", GREY, emission_density=0.3)),
}


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
@pytest.mark.parametrize("name", NUMBERS)
def test_hard_26_a_number_that_no_medium_has_is_refused(name, bad):
    """When it is handed in or at the next image, in each channel; after a step back all is as before."""
    key, interior = NUMBERS[name]
    scene = fog(interior())
    before = render(scene, {"type": "mivol", "max_depth": 1}, 1)
    good = mi.traverse(scene)
    good = {k: type(v)(v) for k, v in good if k.startswith((f"{MEDIUM}.{key}.value", f"{MEDIUM}.scale"))}
    for channel in range(3 if any(dr.size_v(v) == 3 for v in good.values()) else 1):
        with refused(f"{key} .*clip it after each step"):
            put(scene, key, bad, channel)
            render(scene, {"type": "mivol", "max_depth": 1}, 1)
        params = mi.traverse(scene)
        params.update(good)
    assert np.array_equal(render(scene, {"type": "mivol", "max_depth": 1}, 1), before)


@pytest.mark.parametrize("name", ["scale, ours", "sigma_t, ours", "sigma_t, rgb ours", "albedo, ours", "emission"])
def test_ours_refuses_a_number_when_it_is_handed_in(name):
    """Mitsuba's integrators would render what is left."""
    key, interior = NUMBERS[name]
    with refused(f"{key} of a mivol_medium is -0.25; .*at least 0"):
        put(fog(interior()), key, -0.25)


def test_a_session_looks_at_new_numbers():
    """One integrator on one scene: what was read of the old number says nothing of the new one."""
    scene, integrator = fog(medium("homogeneous", GREY)), mi.load_dict({"type": "mivol", "max_depth": 1})
    for good in (0.5, 0.25):
        put(scene, "sigma_t", good)
        render(scene, integrator, 1)
    put(scene, "sigma_t", -0.25)
    with refused("sigma_t of the medium in smoke is -0.25; .*at least 0"):
        render(scene, integrator, 1)


def test_a_number_is_read_once(monkeypatch):
    from mivol.scene import needs

    scene, integrator, read = fog(medium("mivol_medium", RGB)), mi.load_dict({"type": "mivol", "max_depth": 1}), []
    monkeypatch.setattr(needs, "check_constant", lambda value, name, owner: read.append(name))
    for _ in range(3):
        render(scene, integrator, 1)
    assert sorted(read) == ["scale", "sigma_t"]
