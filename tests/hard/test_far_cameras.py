"""Dense media seen from afar: extinctions of 1e5 and more, cameras hundreds of box sizes away.

A float32 distance of 300 is rounded by 1.5e-5: 15 optical depths of an extinction of 1e6. Where an interval begins, how long it
is and where a point lies are therefore found in float64. The face that is seen lies at z = 0, where coordinates are exact; one
test says what the float32 points from which shadow rays start do elsewhere.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean
from scattering_scenes import mivol, pencils, sun

from scenes import affine, box_of, grid_volume, medium

MU, ALBEDO, IRRADIANCE = 0.6, 0.8, 2.0
VIEW = np.array([0.36, 0.48, 0.8])
"""Slanted, so that no distance to the face is a float32 number by chance."""

RATE = 1 + VIEW[2] / MU
TRUTH = ALBEDO * IRRADIANCE / (4 * np.pi) / RATE
"""Of a half-space, seen along VIEW and lit at the cosine MU, whatever its extinction."""

PARTS = {
    "homogeneous": lambda s: medium("homogeneous", s, ALBEDO),
    "grid": lambda s: medium("mivol_medium", grid_volume("mivol_voxels", np.full((4, 3, 5, 1), s)), ALBEDO),
    "both": lambda s: {
        "type": "mivol_medium",
        "sigma_s": grid_volume("mivol_voxels", np.full((4, 3, 5, 1), ALBEDO * s)),
        "sigma_a": (1 - ALBEDO) * s,
    },
}


def half_space(name: str, sigma: float, away: float, beside: bool = False):
    """A dense box above z = 0, lit from below, seen by one ray from ``away`` below."""
    box = box_of(PARTS[name](sigma), np.eye(4))
    parts = {"box": box, "emitter": sun([0.8, 0, MU], IRRADIANCE)[0]}
    if beside:  # a second medium: the optical depth in front of a point is walked again
        parts["other"] = box_of(medium("homogeneous", 1.0), affine(np.eye(3), [0, 0, 2]))
    return pencils(parts, np.array([0.45, 0.4, 0]) - away * VIEW, VIEW)


@pytest.mark.slow_for("both-100000.0-30.7")
@pytest.mark.parametrize("away", [30.7, 300.7])
@pytest.mark.parametrize("sigma", [1e5, 1e6])
@pytest.mark.parametrize("name", PARTS)
def test_quadrature(name, sigma, away):
    found = half_space(name, sigma, away).scene
    found = np.array(mi.render(found, integrator=mi.load_dict(mivol(deterministic=True)), spp=1))[0, 0]
    # The error of the rule, as in tests/analytic/test_quadrature.py.
    assert np.abs(found / TRUTH - 1).max() <= 1e-4


@pytest.mark.slow_for("both-beside another", "grid-beside another")
@pytest.mark.statistical
@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside another"])
@pytest.mark.parametrize("name", PARTS)
def test_drawn_light(name, beside):
    m = half_space(name, 1e6, 300.7, beside).moments(mivol(), 1024)
    assert_precise(m, 0.02 * TRUTH, what="rays")
    assert_same_mean(m, TRUTH, rounding=1e-5 * TRUTH, what="rays")


def far_half_space(name: str, sigma: float, place: float, light: dict | None = None, **phase: object):
    """A half-space whose face lies at z = ``place``, where steps of float32 are as long as a free path."""
    at = affine(np.eye(3), [0, 0, place])
    sigma_t = grid_volume("mivol_voxels", np.full((4, 3, 5, 1), sigma), at) if name == "grid" else sigma
    box = box_of(medium("mivol_medium", sigma_t, ALBEDO, **phase), at)
    parts = {"box": box, "light": light or sun([0.8, 0, MU], IRRADIANCE)[0]}
    return pencils(parts, np.array([0.45, 0.4, place]) - 0.5 * VIEW, VIEW)


FAR = [(100.0, 1e5), (8.0, 1e6)]
"""Places and extinctions: from points that are rounded to float32 light would be 16 and 24 % too bright, since a shorter way
to the face counts for more than a longer one."""


@pytest.mark.statistical
@pytest.mark.parametrize(("place", "sigma"), FAR)
@pytest.mark.parametrize("name", ["homogeneous", "grid"])
def test_shadows_far_from_the_origin_of_the_world(name, place, sigma):
    """Shadow rays start where light scatters, and not at the nearest float32 point."""
    scene = far_half_space(name, sigma, place)
    m = scene.moments(mivol(), 1024)
    assert_precise(m, 0.005 * TRUTH, what="rays")
    assert_same_mean(m, TRUTH, rounding=1e-5 * TRUTH, what="rays")


@pytest.mark.parametrize(("place", "sigma"), FAR)
def test_quadrature_far_from_the_origin_of_the_world(place, sigma):
    scene, exact = far_half_space("grid", sigma, place).scene, mi.load_dict(mivol(deterministic=True))
    found = np.array(mi.render(scene, integrator=exact, spp=1))
    # The error of the rule, as in tests/analytic/test_quadrature.py.
    assert np.abs(found[0, 0] / TRUTH - 1).max() <= 1e-4


@pytest.mark.statistical
def test_phase_samples_far_from_the_origin_of_the_world():
    """A constant environment, whose light phase samples find: the mean over directions of 1 / (1 + VIEW_z / mu)."""
    truth = 0.5 * ALBEDO * (1 - VIEW[2] * np.log(1 + 1 / VIEW[2]))
    m = far_half_space("homogeneous", 1e5, 100.0, {"type": "constant", "radiance": 1.0}).moments(mivol(), 4096)
    assert_precise(m, 0.02 * truth, what="rays")
    assert_same_mean(m, truth, rounding=1e-5 * truth, what="rays")


@pytest.mark.statistical
@pytest.mark.parametrize("phase", ["isotropic", "hg"])
def test_paths_far_from_the_origin_of_the_world(phase):
    """Light that scatters often is as bright as at the origin of the world, where coordinates near the face are exact.

    A peaked phase function has side flights besides.
    """
    phases = {"isotropic": {}, "hg": {"phase": {"type": "hg", "g": 0.8}}}
    scenes = (far_half_space("homogeneous", 1e6, z, **phases[phase]) for z in (8.0, 0.0))
    far, near = (scene.moments(mivol(max_depth=16), 16384) for scene in scenes)
    assert_precise(far, 0.01 * near.mean.mean(), what="rays")
    assert_same_mean(far, near, rounding=1e-5 * near.mean.mean(), what="rays")


@pytest.mark.slow_for("grid")
@pytest.mark.parametrize("name", ["homogeneous", "grid"])
def test_derivative_of_the_extinction(name):
    """None: what is lit nearer to the face is what is dimmed behind it. Each half of it is as large as the light."""
    scene = half_space(name, 1e6, 300.7).scene
    params, found = mi.traverse(scene), []
    key = next(k for k, _ in params if k.endswith(("sigma_t.data", "sigma_t.value.value")))
    for seed in range(16):
        dr.enable_grad(params[key])
        dr.set_grad(params[key], 0)
        image = mi.render(scene, params, integrator=mi.load_dict(mivol()), spp=1024, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        found.append(np.array(dr.grad(params[key])).sum() * 1e6)
    mean, error = np.mean(found), np.std(found, ddof=1) / 4
    assert error < 0.05 * TRUTH
    # Student's t with 15 degrees of freedom: 7.3 standard errors at 1e-6 (both sides).
    assert abs(mean) <= 7.3 * error


THIN = 2.0**-20
"""Thickness of a sheet whose extinction is the inverse: optical depth 1. Seen from 30, it is half a step of float32 thick."""


@pytest.mark.statistical
@pytest.mark.parametrize("away", [0.5, 30.7])
def test_thin_sheets(away):
    """Emission, and scattered light, of a sheet of optical depth 1: its length is a difference of distances."""
    sheet = affine(np.diag([1, 1, THIN]))
    o, d, crossed = np.array([0.45, 0.4, 0]) - away * VIEW, VIEW, 1 / VIEW[2]
    emitting = box_of(medium("mivol_medium", 1 / THIN, emission=2.0), sheet)
    seen = np.array(mi.render(pencils({"sheet": emitting}, o, d).scene, integrator=mi.load_dict(mivol(max_depth=1)), spp=1))
    # The sheet is as thick as float32 vertices have it: exactly. The rest is some roundings of float32.
    assert np.abs(seen / (2 * (1 - np.exp(-crossed))) - 1).max() <= 1e-6
    fog = box_of(medium("homogeneous", 1 / THIN, ALBEDO), sheet)
    fog = pencils({"sheet": fog, "emitter": sun([0.8, 0, MU], IRRADIANCE)[0]}, o, d)
    truth = TRUTH * (1 - np.exp(-crossed * RATE))
    seen = np.array(mi.render(fog.scene, integrator=mi.load_dict(mivol(deterministic=True)), spp=1))
    assert np.abs(seen / truth - 1).max() <= 1e-4
    m = fog.moments(mivol(), 1024)
    assert_same_mean(m, truth, rounding=1e-5 * truth, what="rays")
