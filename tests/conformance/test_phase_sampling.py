"""Phase functions in single scattering: stock ones, ours, and microflakes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean
from scattering_scenes import PLACE, close_up, mivol, point, rough_grid
from volpath_scenes import EMITTERS, same

import scenes
from scenes import box_of, grid_volume, medium, refused, transform


def microflakes(voxels: int = 1) -> dict:
    """Microflakes: a random symmetric matrix in each voxel of a row (xx, yy, zz, xy, xz, yz)."""
    m = np.random.default_rng(6).normal(size=(1, 1, voxels, 3, 3))
    m = np.einsum("...ij,...kj->...ik", m, m) / 6 + 0.1 * np.eye(3)
    S = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2], m[..., 0, 1], m[..., 0, 2], m[..., 1, 2]], axis=-1)
    return {"type": "sggx", "S": {"type": "gridvolume", "grid": mi.VolumeGrid(S.astype(np.float32)), "raw": True,
                                  "to_world": transform(PLACE)}}  # fmt: skip


PHASES = {
    "isotropic": lambda: {"type": "isotropic"},
    "hg forward": lambda: {"type": "hg", "g": 0.85},
    "hg backward": lambda: {"type": "hg", "g": -0.6},
    "rayleigh": lambda: {"type": "rayleigh"},
    "tabphase": lambda: {"type": "tabphase", "values": "0.2, 0.1, 0.5, 0.3, 1.5"},
    "blendphase": lambda: {"type": "blendphase", "weight": 0.3, "a": {"type": "hg", "g": 0.7}, "b": {"type": "rayleigh"}},
    "blendphase of hg": lambda: {
        "type": "blendphase",
        "weight": 0.3,
        "a": {"type": "hg", "g": 0.7},
        "b": {"type": "hg", "g": -0.4},
    },
    "blendphase by a grid": lambda: {
        "type": "blendphase",
        "weight": grid_volume("gridvolume", np.random.default_rng(7).uniform(0, 1, (2, 3, 2, 1)), PLACE),
        "a": {"type": "hg", "g": 0.7},
        "b": {"type": "hg", "g": -0.3},
    },
    "sggx": microflakes,
}


OWN_PHASES = [("hg forward", "own"), ("tabphase", "own"), ("blendphase", "own")]


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "kind"),
    small.cases(
        [*((name, "stock") for name in PHASES), *OWN_PHASES],
        [*((name, "stock") for name in PHASES if name != "blendphase by a grid"), *OWN_PHASES],
    ),
)
def test_phase_functions(name, kind):
    """Under a sky with a bright spot (directions are sampled both ways) and a point light (one direction only).

    Volpath draws the directions of microflakes wrongly (tests/conformance/test_reference.py): the point light judges them.
    """
    medium_type, volume_type = small.KINDS[kind]
    interior = medium(medium_type, grid_volume(volume_type, rough_grid(2), PLACE), 0.7, phase=PHASES[name]())
    emitters = {} if name == "sggx" else EMITTERS["envmap"]()
    same({"smoke": box_of(interior, PLACE), **emitters, "bulb": point([1.5, -1.2, 1.6], 1.5)[0]})


@pytest.mark.slow_for("a mixture", "alone")
@pytest.mark.statistical
@pytest.mark.parametrize("inside", small.cases(["alone", "a blend", "a mixture"], ["a blend"]))
def test_microflakes_in_a_sky(inside):
    """Thin: albedo tau sqrt(w^T S w) times the sky's mean over eval_pdf; the sun in it is found by both ways of sampling."""
    lobes = {"a": microflakes(), "b": {"type": "hg", "g": 0.5}}
    phase = {"alone": microflakes(), "a blend": {"type": "blendphase", "weight": 0.3, **lobes},
             "a mixture": {"type": "mivol_mixture", "weight_a": 0.7, "weight_b": 0.3, **lobes}}[inside]  # fmt: skip
    tau, albedo = 1e-3, 0.8
    box = box_of(medium("homogeneous", tau / 2, albedo, phase=phase), PLACE)
    o, d = np.array([0.1, -3.0, 0.2]), np.array([0, 1.0, 0])
    seen = small.pencils({"smoke": box, **EMITTERS["envmap"]()}, o, d)
    found = seen.moments(mivol(hide_emitters=True), 1 << 14)
    n = 1 << 20
    k = np.arange(n) + 0.5
    w = mi.warp.square_to_uniform_sphere(mi.Point2f(np.stack([k / n, k * 0.6180339887 % 1]).astype(np.float32)))
    mei = dr.zeros(mi.MediumInteraction3f, n)
    mei.wi = mi.Vector3f(0, -1, 0)
    mei.sh_frame = mi.Frame3f(mei.wi)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = -w
    phase = seen.scene.shapes()[0].interior_medium().phase_function()
    _, pdf = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, w)
    light = seen.scene.environment().eval(si) * pdf
    area = phase.projected_area(mei)[0] if inside == "alone" else 1.0
    truth = [albedo * tau * area * 4 * np.pi * dr.mean(light[c])[0] for c in range(3)]
    truth = np.array(truth)
    # light is lost again on the way, less than 2 tau of it; the rule of 2^20 points errs by 1e-3 at the edges of the texels
    assert_same_mean(found, truth[None], rounding=4e-3 * truth.min(), what="radiances")
    assert_precise(found, 0.01 * truth, what="radiances")


def test_microflakes_that_vary_are_refused():
    """Their extinction along a ray is no longer that of the grid times a number."""
    interior = medium("heterogeneous", grid_volume("gridvolume", rough_grid(2), PLACE), 0.7, phase=microflakes(2))
    scene = close_up({"smoke": box_of(interior, PLACE), "sky": scenes.sky(1.0)}, res=2)
    with refused("sggx"):
        scenes.render(scene, mivol(), 1)
