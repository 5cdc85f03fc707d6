"""The depth that a scene needs: what is left out, on numbers made up and on media whose answer is known."""

from __future__ import annotations

import re
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.experiments.script import explain
from mivol.scene import session
from mivol.scene.previews import (
    DEPTHS,
    DepthError,
    SufficientDepth,
    _camera_ray,
    find_sufficient_depth,
    last_order_share,
    measure_depth_error,
)
from mivol.transport.path.estimators import Settings
from scenes import box_of, camera, centred, medium, sky

PLACE = centred(2 * np.eye(3))
SIGMA, ALBEDO = 1.5, 0.9


def fog(sigma: float, albedo: float) -> mi.Scene:
    parts = {"fog": box_of(medium("homogeneous", sigma, albedo), PLACE), "sky": sky(1.0)}
    return mi.load_dict({"type": "scene", **parts, "sensor": camera([0, -4, 0], [0, 0, 0])})


def test_a_square_is_the_mean_product_of_two_batches() -> None:
    """Cells lose 0.5, 0.2 and 0.2 of a mean of 1 in three batches: the products are 0.1, 0.1 and 0.04; no squares."""
    full = np.array([[1.3, 1.3], [0.7, 0.7], [1.0, 1.0]])
    found = measure_depth_error(2, full - np.array([[0.5], [0.2], [0.2]]), full)
    assert found.share == pytest.approx(0.3)
    assert found.rms == pytest.approx(np.sqrt(0.08))


def test_an_error_is_the_jackknife_of_the_square() -> None:
    """Of four batches that lose 0.1, 0.2, 0.3 and 0.4 everywhere: with one left out, the mean product of pairs of the rest."""
    lost = np.array([0.1, 0.2, 0.3, 0.4])
    pairs = np.array([np.mean([a * b for i, a in enumerate(rest) for b in rest[:i]]) for rest in
                      (np.delete(lost, k) for k in range(4))])  # fmt: skip
    square = np.mean([a * b for i, a in enumerate(lost) for b in lost[:i]])
    error = np.sqrt(3 / 4 * np.sum((pairs - pairs.mean()) ** 2))
    full = np.ones((4, 5))
    assert measure_depth_error(3, full - lost[:, None], full).at_most == pytest.approx(np.sqrt(square + 2 * error))


def test_the_smallest_depth_below_the_noise_is_enough() -> None:
    found = tuple(DepthError(d, 0.0, 0.0, most) for d, most in zip(DEPTHS, (0.5, 0.1, 0.01), strict=False))
    assert [SufficientDepth(found, noise).depth for noise in (0.6, 0.1, 0.05, 0.001)] == [2, 3, 6, -1]


FOGS = [(1.0, 0.0, 1e-6, 2), (0.02, 0.5, 0.01, 2), (5.0, 0.95, 0.02, -1)]


@pytest.mark.slow_for("0.02-0.5-0.01-2")
@pytest.mark.parametrize(("sigma", "albedo", "noise", "depth"), FOGS)
def test_fog_needs_the_depth_it_is_known_to_need(variant_rgb, sigma: float, albedo: float, noise: float, depth: int) -> None:
    """Fog that does not scatter, thin fog (what scatters twice is below albedo^2 tau^2 = 4e-4), and fog as dense as a cloud."""
    scene = fog(sigma, albedo)
    found = find_sufficient_depth(scene, scene.sensors()[0], Settings(), noise)
    assert found.depth == depth
    if albedo == 0:
        assert all(abs(left.share) < 1e-6 for left in found.left_out)


def test_what_is_left_out_is_what_renders_differ_by(variant_rgb: str) -> None:
    """Against pictures of 147,456 paths: over 8 seeds the shares deviate by 0.2 % and 0.1 %, so 2 % are nine deviations."""
    scene = fog(SIGMA, ALBEDO)
    found = find_sufficient_depth(scene, scene.sensors()[0], Settings()).left_out[0]
    two, all_of_it = (
        np.array(mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": d}), spp=1024, seed=1)).mean()
        for d in (2, -1)
    )
    assert found.share == pytest.approx((all_of_it - two) / all_of_it, rel=0.02)
    assert found.rms > found.share


def test_explain_says_which_depth_is_enough(variant_rgb: str) -> None:
    scene = fog(SIGMA, ALBEDO)
    said = explain(scene, max_depth=2, noise=0.5)
    assert "depth     max_depth 2 is enough\n              because depth 2 leaves out" in said
    assert "noise of 50.00% is requested" in said
    assert "max_depth -1 (no limit) is enough" in explain(scene, max_depth=2, noise=1e-9)
    assert "is enough" not in explain(scene, max_depth=2) + explain(scene, max_depth=1, noise=0.5)


# -- A depth that nobody chose -------------------------------------------------------------------------------------------------


KEY = "fog.interior_medium.sigma_t.value.value"


def look(scene: mi.Scene, way: str, **settings: object) -> list[str]:
    """Render twice, or differentiate by the extinction; the warnings."""
    integrator = mi.load_dict({"type": "mivol", **settings})
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        for seed in range(2):
            if way == "picture":
                dr.eval(mi.render(scene, integrator=integrator, spp=1, seed=seed))
                continue
            params = mi.traverse(scene)
            dr.enable_grad(params[KEY])
            integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (12, 12, 3)), spp=1, seed=seed)
    return [str(one.message) for one in found]


@pytest.mark.parametrize("way", ["picture", "gradient"])
def test_light_beyond_a_depth_that_nobody_chose_is_mentioned_once(variant_rgb: str, way: str) -> None:
    """Fog as dense as a cloud; the means of the fifth order of scattering and of all that is rendered are compared."""
    scene = fog(5.0, 0.95)
    (found,) = look(scene, way)
    whole, shorter = (
        np.array(mi.render(scene, integrator=mi.load_dict({"type": "mivol", "max_depth": depth}), spp=512)).mean()
        for depth in (6, 5)
    )
    share = 1 - shorter / whole
    assert 0.03 < share < 0.3
    said = int(re.search(r"carries (\d+)% of the image", found)[1]) / 100
    # A whole percent, and both estimates: 9216 paths of a share of some percent have a standard error below 0.2 %.
    assert abs(said - share) < 0.005 + 6 * 0.002
    assert found.startswith("max_depth was not given: light that scatters 5 times, the last order of the default of 6,")


def test_no_light_beyond_the_depth_is_mentioned_without_reason(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thin fog; fog without scattering, of which nothing is walked; and a given depth, after which nothing is measured."""
    assert look(fog(0.05, 0.5), "picture") == []
    assert look(fog(5.0, 0.0), "picture") == []
    measured = []
    monkeypatch.setattr(session, "warn_of_last_order", lambda *given: measured.append(given))
    look(fog(5.0, 0.95), "picture", max_depth=6)
    assert measured == []
    look(fog(5.0, 0.95), "picture")
    assert len(measured) == 1  # of two renders of the same state


def test_noise_alone_is_not_mentioned() -> None:
    """The error of the share of a ratio of sums, against the spread of 4000 such shares."""
    rng = np.random.default_rng(4)
    whole = rng.gamma(2.0, size=(4000, 9, 16))
    last = 0.02 * whole * rng.uniform(0, 2, whole.shape) * rng.gamma(0.5, 2.0, (4000, 1, 16))
    shares, errors = np.array([last_order_share(w, w - d) for w, d in zip(whole, last, strict=True)]).T
    # The mean square of the errors has a relative standard error of sqrt(2 / 15 / 4000) and more for the tails of the gamma.
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(shares.std(), rel=0.1)
    assert last_order_share(np.zeros((3, 4)), np.zeros((3, 4))) == (0.0, 0.0)


# -- Orders of light and noise of lights, in words -------------------------------------------------------------------------


def lit_fog(g: float = 0.0, **lights: dict) -> mi.Scene:
    interior = medium("homogeneous", 2.0, 0.8, phase={"type": "hg", "g": g})
    parts = {"fog": box_of(interior, PLACE), **lights, "sensor": camera([0, -4, 0], [0, 0, 0], res=16)}
    return mi.load_dict({"type": "scene", **parts})


SUN = {"type": "directional", "direction": [0, 0, -1], "irradiance": 2.0}


@pytest.mark.parametrize(
    ("g", "light", "depth", "words"),
    [
        (0.0, SUN, 2, "one scattering, at points of each camera ray"),
        (0.0, sky(1.0), 4, "all by paths that escape"),
        (0.0, {"type": "point", "position": [0.2, 0, 0.1]}, 4, "a distance of its own on each segment"),
        (0.9, SUN, 4, "side flights"),
        (0.0, SUN, 4, "each at the collisions of a path"),
    ],
)
def test_explain_says_what_finds_which_order(variant_rgb: str, g: float, light: dict, depth: int, words: str) -> None:
    text = explain(lit_fog(g, lamp=light), max_depth=depth)
    (line,) = (line for line in text.splitlines() if line.startswith("  scattering orders"))
    assert words in line


def test_explain_names_the_light_that_makes_the_noise(variant_rgb: str) -> None:
    """A lamp of 1000 beside a lamp of 1: without the first the variance falls to about 1e-6. Both shine again afterwards."""
    lamps = {name: {"type": "point", "id": name, "position": [x, 0, 2.5], "intensity": i}
             for name, x, i in (("dim", 0.5, 1.0), ("bright", -0.5, 1000.0))}  # fmt: skip
    scene = lit_fog(**lamps)
    text = explain(scene, max_depth=4)
    (line,) = (line for line in text.splitlines() if line.startswith("  noise"))
    assert line.split()[1:4] == ["bright", "makes", "100%"] and "together" not in line
    found = mi.traverse(scene)
    assert [np.array(found[f"{name}.intensity.value"]).max() for name in lamps] == [1.0, 1000.0]
    assert "  noise" not in explain(lit_fog(lamp=SUN), max_depth=4)


def test_a_light_without_a_name_is_told_by_its_kind(variant_rgb: str) -> None:
    scene = mi.load_string(
        """<scene version="3.0.0">
        <sensor type="perspective"><transform name="to_world"><lookat origin="0,-4,0" target="0,0,0" up="0,0,1"/></transform>
            <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>
        <emitter type="constant"><rgb name="radiance" value="1e-3"/></emitter>
        <emitter type="directional"><vector name="direction" x="0" y="0" z="-1"/></emitter>
        <shape type="cube"><bsdf type="null"/><medium name="interior" type="homogeneous"><float name="albedo" value="0.8"/>
            </medium></shape></scene>"""
    )
    (line,) = (line for line in explain(scene, max_depth=4).splitlines() if line.startswith("  noise"))
    assert "DirectionalEmitter 1 makes 100%" in line


@pytest.mark.parametrize("kind", ["perspective", "orthographic", "thinlens"])
def test_previews_of_a_crop_see_the_whole_film(variant_rgb: str, kind: str) -> None:
    """A crop is planned as the whole film; places on the film are float32, and rays end a few units in the last place apart."""
    made = camera([1.0, -4.0, 0.5], [0, 0, 0], res=24) | {"type": kind}
    if kind == "thinlens":
        made |= {"aperture_radius": 0.1, "focus_distance": 4.0}
    elif kind == "orthographic":
        made.pop("fov")
    crop = {"crop_width": 10, "crop_height": 9, "crop_offset_x": 7, "crop_offset_y": 8}
    place = mi.Point2f([0.02, 0.4, 0.98], [0.97, 0.5, 0.03])
    whole, part = (_camera_ray(mi.load_dict(made | {"film": made["film"] | more}), place)[0] for more in ({}, crop))
    assert np.abs(np.array(whole.d - part.d)).max() < 4e-6 and np.abs(np.array(whole.o - part.o)).max() < 4e-6
