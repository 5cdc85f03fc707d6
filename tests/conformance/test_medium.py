"""The numbers and voxels of media: what agrees, what is refused, and what counts as 0."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scattering_scenes import cases

from scenes import box_of, camera, grid_volume, medium, refused, render, sky

VALUES = np.ones((3, 4, 5, 1), np.float32)


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


# -- Numbers that an optimizer can reach ---------------------------------------------------------------------------------


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
def test_a_number_that_no_medium_has_is_refused(name, bad):
    """When it is handed in or at the next image, in each channel; after a step back all is as before. Hard case 26."""
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
    from mivol.scene import readings

    scene, integrator, read = fog(medium("mivol_medium", RGB)), mi.load_dict({"type": "mivol", "max_depth": 1}), []
    monkeypatch.setattr(readings, "check_constant", lambda value, name, owner: read.append(name))
    for _ in range(3):
        render(scene, integrator, 1)
    assert sorted(read) == ["scale", "sigma_t"]


# -- Voxels that an optimizer or a filter has brought below 0 ------------------------------------------------------------


CELLS = 0.1 + np.random.default_rng(7).uniform(0, 2, (5, 4, 6, 3))
HOLES = np.random.default_rng(8).uniform(0, 1, (5, 4, 6, 1)) < 0.3
"""Where a voxel, or one channel of it, is below 0."""

GRIDS = {
    "grey, stock": ("heterogeneous", "gridvolume", 1, {}),
    "grey, ours": ("mivol_medium", "mivol_voxels", 1, {}),
    "rgb, ours": ("mivol_medium", "mivol_voxels", 3, {}),
    "shadows by blocks": ("mivol_medium", "mivol_voxels", 1, {"shadows": "estimated"}),
    "deterministic": ("heterogeneous", "gridvolume", 1, {"deterministic": True}),
}


def with_holes(name: str, depth: float) -> np.ndarray:
    """A grid in which holes are ``depth``; in an rgb one, only of the second channel."""
    values = CELLS[..., : GRIDS[name][2]].copy()
    values[..., -2:][..., :1][HOLES] = depth
    return values.astype(np.float32)


def image_and_derivatives(scene: mi.Scene, values: np.ndarray, more: dict) -> list[np.ndarray]:
    """The image, its gradient by the voxels and its tangent along a change of all of them."""
    params, key = mi.traverse(scene), f"{MEDIUM}.sigma_t.data"
    params[key] = mi.TensorXf(values)
    params.update()
    dr.enable_grad(params[key])
    integrator = mi.load_dict({"type": "mivol", "max_depth": 2, **more})
    image = mi.render(scene, params, integrator=integrator, spp=4, seed=3)
    dr.backward(dr.sum(image * image, axis=None))
    gradient = np.array(dr.grad(params[key]))
    dr.set_grad(params[key], 1)
    return [np.array(image), gradient, np.array(dr.forward_to(mi.render(scene, params, integrator=integrator, spp=4, seed=3)))]


@pytest.mark.slow_for("grey, ours", "grey, stock", "shadows by blocks")
@pytest.mark.parametrize("name", cases(GRIDS, ["rgb, ours", "deterministic"]))
def test_voxels_below_0_count_as_0(name):
    """The same image, gradient and tangent as of a grid with 0 there, and a gradient to leave 0 by; told once."""
    kind, volume, channels, more = GRIDS[name]
    emitter = {"type": "point", "position": [1.5, 1.2, 2.0], "intensity": 3.0}
    scene = fog(medium(kind, grid_volume(volume, np.ones((5, 4, 6, channels))), 0.6))
    view = camera([0.5, 0.4, 4], [0.5, 0.5, 0.5], 6, fov=15)
    parts = {"smoke": scene.shapes()[0], "emitter": emitter, "sensor": view}
    scene = mi.load_dict({"type": "scene", **parts})
    want = image_and_derivatives(scene, with_holes(name, 0.0), more)
    count = int(HOLES.sum())
    told = f"{count} of {120 * channels} values of sigma_t of the medium in smoke are below 0, the least -0.02.*dr.maximum"
    with pytest.warns(RuntimeWarning, match=told) as said:
        got = image_and_derivatives(scene, with_holes(name, -0.02), more)
    # Derivatives are summed over threads in no fixed order: float32 sums of some thousand terms.
    for a, b in zip(got, want, strict=True):
        assert np.abs(a - b).max() <= 1e-5 * np.abs(b).max()
    assert np.array_equal(got[0], want[0])
    assert np.count_nonzero(got[1][with_holes(name, -1.0) < 0]) > 0.9 * count
    assert len(said) == 1


def test_what_is_below_0_is_told_once():
    """Not after each step of an optimizer, of the same integrator on the same scene."""
    scene = fog(medium("mivol_medium", grid_volume("mivol_voxels", CELLS[..., :1])))
    integrator = mi.load_dict({"type": "mivol"})
    params, images = mi.traverse(scene), []
    with pytest.warns(RuntimeWarning, match="below 0") as said:
        for depth in (-0.02, -0.3, 0.0):
            params[f"{MEDIUM}.sigma_t.data"] = mi.TensorXf(with_holes("grey, ours", depth))
            params.update()
            images.append(render(scene, integrator, 4))
    assert len(said) == 1
    assert np.array_equal(images[0], images[2]) and np.array_equal(images[1], images[2])


@pytest.mark.slow
def test_unclamped_steps_reach_the_truth_through_0():
    """Adam as stock Mitsuba's users write it: voxels that were thrown below 0 come back to what they were."""
    truth = np.full((2, 2, 2, 1), 0.6, np.float32)
    scene = fog(medium("heterogeneous", grid_volume("gridvolume", truth)))
    params, key = mi.traverse(scene), f"{MEDIUM}.sigma_t.data"
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    target = mi.render(scene, integrator=integrator, spp=16, seed=0)
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer[key] = mi.TensorXf(np.full((2, 2, 2, 1), -0.02, np.float32))
    params.update(optimizer)
    with pytest.warns(RuntimeWarning, match="8 of 8 values of sigma_t"):
        for _ in range(60):
            image = mi.render(scene, params, integrator=integrator, spp=16, seed=0)
            dr.backward(dr.mean(dr.square(image - target), axis=None))
            optimizer.step()
            params.update(optimizer)
    error = np.array(mi.render(scene, integrator=integrator, spp=16, seed=0)) - np.array(target)
    # Transmittances were 1, where those of the target are exp(-0.6): 0.45 off. A step moves them by its size at most, over
    # paths of length 1 (the camera looks along the box), and that is what Adam may still sway by.
    assert np.abs(error).max() < 0.05
