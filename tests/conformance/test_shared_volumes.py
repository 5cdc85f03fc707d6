"""One volume that is several coefficients of a medium: by a ``ref``, or because Mitsuba merges equal objects of a scene."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, difference, fresh
from scattering_scenes import PLACE, assert_same_images, close_up, mivol, point, rough_grid

from mivol.scene_graph import traverse_children
from mivol.transport.media.medium_view import view_medium
from mivol.validate.reference import render_reference
from mivol.validate.statistics import Moments
from scenes import box_of, centred, grid_volume, medium, sky, transform

LEAK = 1e-4
"""What volpath's shadow rays miss behind each boundary, of a radiance of 1."""

BOTH = {"type": "ref", "id": "both"}


def stock() -> dict:
    return grid_volume("gridvolume", rough_grid(4, 0.9), PLACE)


def constants(*sizes: float) -> list[dict]:
    """Boxes of one number in different places: Mitsuba merges the textures in them."""
    return [{"type": "constvolume", "value": 0.7, "to_world": transform(centred(size * np.eye(3)))} for size in sizes]


MEDIA = {
    "ref": lambda: {"both": stock(), "smoke": box_of(medium("heterogeneous", BOTH, BOTH), PLACE)},
    "equal": lambda: {"smoke": box_of(medium("heterogeneous", stock(), stock()), PLACE)},
    "constvolumes": lambda: {"smoke": box_of(medium("heterogeneous", *constants(1.5, 1.8)), PLACE)},
    "ref, own": lambda: {
        "both": grid_volume("mivol_voxels", rough_grid(4, 0.9), PLACE),
        "smoke": box_of(medium("mivol_medium", BOTH, BOTH), PLACE),
    },
    "sigma_a and sigma_s": lambda: {
        "both": stock(),
        "smoke": box_of({"type": "mivol_medium", "sigma_a": BOTH, "sigma_s": BOTH}, PLACE),
    },
}


@pytest.mark.slow_for("sigma_a and sigma_s")
@pytest.mark.statistical
@pytest.mark.parametrize("name", small.cases(MEDIA, ["ref", "equal", "ref, own"]))
def test_the_same_picture_as_volpath(name):
    parts = MEDIA[name]() | {"sky": sky(0.3), "bulb": point([1.6, -1.3, 1.7], 4.0)[0]}
    assert_same_images(close_up(parts), rounding=LEAK)


def test_each_coefficient_stands_under_its_own_name():
    interior = close_up(MEDIA["constvolumes"]()).shapes()[0].interior_medium()
    assert {"sigma_t.value.value", "albedo.value.value"} <= set(traverse_children(interior).properties)
    np.testing.assert_allclose(view_medium(interior).parts[0].lattice.to_world, centred(1.5 * np.eye(3)), atol=1e-6)
    interior = close_up(MEDIA["sigma_a and sigma_s"]()).shapes()[0].interior_medium()
    assert [p.name for p in view_medium(interior).parts] == ["sigma_a", "sigma_s"]


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", small.cases(["ref", "sigma_a and sigma_s"], ["sigma_a and sigma_s"]))
def test_the_derivative_is_the_sum_of_both(name):
    """Reverse and forward, against central differences of pictures without noise (the same rays, a point light)."""
    scene = close_up(MEDIA[name]() | {"bulb": point([1.6, -1.3, 1.7], 9.0)[0]}, res=6)
    params, base = mi.traverse(scene), rough_grid(4, 0.9)
    w = np.random.default_rng(1).uniform(0.5, 1.5, base.shape).astype(np.float32)

    def picture(h: float, seed: int) -> float:
        params["both.data"] = mi.TensorXf((base + h * w).astype(np.float32))
        params.update()
        image = mi.render(scene, integrator=mi.load_dict(mivol(deterministic=True)), spp=64, seed=fresh(seed))
        return float(np.array(image).mean(dtype=np.float64))

    slopes = [(picture(0.04, s) - picture(0.0, s)) / 0.04 for s in map(fresh, range(8))]
    base = (base + 0.02 * w).astype(np.float32)  # voxels may not be below 0: the middle of the difference
    drawn = {"reverse": [], "forward": []}
    for seed in range(16):
        for mode, found in drawn.items():
            variable = mi.TensorXf(base.astype(np.float32))
            dr.enable_grad(variable)
            dr.set_grad(variable, mi.TensorXf(w) if mode == "forward" else 0)
            params["both.data"] = variable
            params.update()
            image = mi.render(scene, params, integrator=mi.load_dict(mivol()), spp=64, seed=fresh(seed))
            if mode == "forward":
                found.append(float(np.array(dr.forward_to(image)).mean(dtype=np.float64)))
            else:
                dr.backward(dr.mean(image, axis=None))
                found.append(float((np.array(dr.grad(variable), dtype=np.float64) * w).sum()))
    slopes = Moments.from_values(np.array(slopes))
    slope = abs(float(slopes.mean))
    for mode, found in drawn.items():
        found = Moments.from_values(np.array(found))
        assert_precise(difference(found, slopes), 0.02 * slope, what=mode)
        # A step of h = 0.02 either way in an extinction that is
        # 0.3 on average changes the slope by less than h^2 / 6 times its second derivative, (2 optical lengths)^2: 3e-4.
        assert_same_mean(found, slopes, rounding=3e-4 * slope, what=mode)


@pytest.mark.slow
def test_a_reference_knows_the_shared_extinction(tmp_path):
    """Its doubts look at it, and where it differs between channels each of them is rendered alone."""
    colours = np.array([0.2, 0.5, 0.9]) * np.ones((2, 2, 2, 1))
    grid = grid_volume("gridvolume", colours, PLACE)
    scene = close_up({"smoke": box_of(medium("heterogeneous", grid, grid), PLACE), "sky": sky()}, res=4)
    found = render_reference(scene, tmp_path / "r.exr", max_depth=1, max_spp=64, progress=False)
    assert found.identity["channels_alone"]
