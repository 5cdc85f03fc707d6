"""Light that scatters any number of times: furnaces, half-spaces and slabs of known radiance, one scattering against the twin,
channels against their own grey renders, and scenes of surfaces, refraction and emission against Mitsuba."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from false_alarms import assert_precise, assert_same_mean, difference, fresh, over_pixels
from scattering_scenes import PLACE, aimed, close_up, fog, mivol, pencils, phase, point, rough_grid, smoke

import scenes
from mivol.transport.estimators.flights import free_flight
from mivol.validate.statistics import Moments
from scenes import as_float32, ball_of, box_of, centred, grid_volume, medium


def volpath(**more: object) -> dict:
    return {"type": "volpath", "max_depth": -1, "rr_depth": 1000, **more}


def unlimited(**more: object) -> dict:
    return mivol(max_depth=-1, **more)


# -- Known radiance ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("top", [1.0, 40.0])
def test_white_furnace(top):
    """A purely scattering medium is invisible in even light: each sample is 1, up to rounding.

    The throughput is a product of albedos of 1 and of phase weights equal to 1 up to some ulps; paths through an optical depth
    of 40 have some hundreds of them.
    """
    scene = close_up({"smoke": smoke(rough_grid(2, top), 1.0, name="hg", g=0.6)[0], "sky": scenes.sky(1.0)}, res=8)
    image = scenes.render(scene, unlimited(), 4, seed=fresh(1))
    assert np.abs(image - 1).max() <= 1e-5


@pytest.mark.statistical
def test_absorption_and_scattering_are_a_density_and_an_albedo():
    """The same smoke, given by sigma_a and sigma_s, and by sigma_t and an albedo of 0.6."""
    density = rough_grid(4, 2.0)
    parts = {f"sigma_{k}": grid_volume("mivol_voxels", as_float32(c * density), PLACE) for k, c in (("a", 0.4), ("s", 0.6))}
    found = []
    for box in (smoke(density, 0.6, "own")[0], box_of({"type": "mivol_medium", **parts}, PLACE)):
        scene = close_up({"smoke": box, "bulb": point([1.5, 1, 2.0])[0], "sky": scenes.sky(0.2)}, res=8)
        found.append(over_pixels(small.moments(scene, mivol(max_depth=4), 256, first=300 * len(found))))
    assert_same_mean(*found, rounding=1e-6, what="radiance")
    assert_precise(difference(*found), 0.02 * found[0].mean, what="radiance")


def test_roulette_spares_paths_that_lose_little():
    """Each of 4096 paths through an optical depth of 4 ends with the power of 0.99 that it has lost, none with 0 or more than
    that. After 68 collisions one would be below 1/2, from where roulette may end it; the longest path here has 34."""
    scene = close_up({"smoke": smoke(np.full((3, 3, 3, 1), 2.0, np.float32), 0.99)[0], "sky": scenes.sky(1.0)}, res=64)
    image = scenes.render(scene, unlimited(rr_depth=1), 1, seed=fresh(4))
    powers = np.log(image) / np.log(0.99)
    assert powers.max() > 10
    np.testing.assert_allclose(powers, np.round(powers), atol=1e-2)  # a hundred roundings of 6e-8, over log(0.99) = 0.01


@pytest.mark.statistical
def test_isothermal_furnace():
    """A medium glowing like its surroundings is invisible too, for any scattering."""
    interior = medium("mivol_medium", grid_volume("mivol_voxels", rough_grid(3, 3.0), PLACE), 0.6, emission=1.0)
    scene = close_up({"smoke": box_of(interior, PLACE), "sky": scenes.sky(1.0)}, res=8)
    found = over_pixels(small.moments(scene, unlimited(rr_depth=50), 64))
    assert_same_mean(found, 1.0, rounding=1e-5, what="radiance")
    assert_precise(found, 5e-3, what="radiance")


def h_function(albedo: float, mu: float = 1.0) -> float:
    """Chandrasekhar's H for isotropic scattering, from 1/H = sqrt(1 - w) + w/2 int_0^1 x H(x)/(mu + x) dx (1960, Ch. V)."""
    x, weight = np.polynomial.legendre.leggauss(200)
    x, weight = (x + 1) / 2, weight / 2
    h = np.ones_like(x)
    for _ in range(3000):
        h = 1 / (np.sqrt(1 - albedo) + albedo / 2 * (weight * x * h / (x[:, None] + x)).sum(axis=1))
    return 1 / (np.sqrt(1 - albedo) + albedo / 2 * (weight * x * h / (mu + x)).sum())


def half_space(albedo: float) -> mi.Scene:
    """A half-space seen from above in a constant sky: 400 mean free paths deep, and wider to each side than any path."""
    place = centred(np.diag([8000.0, 8000.0, 400.0]), (0, 0, -200.0))
    sensor = {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])}
    sensor |= {"film": scenes.film(4, 4), "sampler": {"type": "independent"}}
    parts = {"ground": box_of(medium("homogeneous", 1.0, albedo), place), "sky": scenes.sky(1.0), "sensor": sensor}
    return mi.load_dict({"type": "scene", **parts})


@pytest.mark.slow_for("0.5")
@pytest.mark.statistical
@pytest.mark.parametrize(
    "albedo", [0.5, 0.9, pytest.param(0.99, marks=pytest.mark.slow), pytest.param(0.999, marks=pytest.mark.slow)]
)
def test_half_space(albedo):
    """By reciprocity the radiance straight down is the plane albedo for light straight down, 1 - H(1) sqrt(1 - w)."""
    found = over_pixels(small.moments(half_space(albedo), unlimited(rr_depth=20), 1 << 12))
    truth = 1 - h_function(albedo) * np.sqrt(1 - albedo)
    assert_same_mean(found, truth, rounding=1e-5, what="albedo")
    assert_precise(found, 1.5e-3, what="albedo")


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(("behind", "truth"), [(-1e3, 0.0973946), (1e3, 0.6609577)], ids=["reflectance", "transmittance"])
def test_slab_of_van_de_hulst(behind, truth):
    """Optical depth 2, albedo 0.9, HG 0.75: R and T of light that falls in straight (van de Hulst 1980, table 35).

    A black plane takes the light of one side of the sky; what is left is, by reciprocity, R or T.
    """
    place = centred(np.diag([2000.0, 2000.0, 2.0]))
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    lid = mi.ScalarTransform4f().translate([0, 0, behind]).scale(1e8)
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    sensor = {"type": "orthographic", "to_world": look, "film": scenes.film(8, 8), "sampler": {"type": "independent"}}
    interior = medium("homogeneous", 1.0, 0.9, phase={"type": "hg", "g": 0.75})
    parts = {"slab": box_of(interior, place), "sky": scenes.sky(1.0), "sensor": sensor}
    parts["lid"] = {"type": "rectangle", "to_world": lid, "bsdf": {"type": "twosided", "inner": black}}
    found = over_pixels(small.moments(mi.load_dict({"type": "scene", **parts}), unlimited(rr_depth=20), 1 << 13))
    assert_same_mean(found, truth, rounding=2e-5, what="radiance")
    assert_precise(found, 2e-4 * 2, what="radiance")


# -- One scattering, against the twin -----------------------------------------------------------------------------------------


@pytest.mark.slow_for("grid", "rgb")
@pytest.mark.statistical
@pytest.mark.parametrize("kind", ["grid", "fog", "rgb"])
def test_one_scattering_is_that_of_the_twin(flies, kind):
    emitter, twin = point([1.7, -0.6, 1.4])
    if kind == "fog":
        box, own = fog(0.8, name="hg", g=0.4)
    else:
        grid = rough_grid(4, 3.0)
        box, own = smoke(np.concatenate([grid, 0.1 * grid, 0 * grid], axis=-1) if kind == "rgb" else grid, name="hg", g=0.4)
    seen = pencils({"smoke": box, "bulb": emitter}, *aimed(5))
    small.assert_twin(seen, [own], [twin], mivol(), 1 << 11, precision=0.05)


# -- Channels ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("ratio", [(1.0, 0.1, 3.0), (1.0, 0.0, 1e4)], ids=str)
def test_each_channel_is_its_grey_render(ratio):
    grid, emitters = rough_grid(6, 1.0), {"sky": scenes.sky(0.5), "bulb": point([1.7, -0.6, 1.4])[0]}
    seen = lambda values: small.moments(close_up({"smoke": smoke(values, 0.8)[0], **emitters}, res=8), mivol(max_depth=6), 256)  # noqa: E731
    colour = over_pixels(seen(np.concatenate([r * grid for r in ratio], axis=-1)))
    for channel, r in enumerate(ratio):
        grey = over_pixels(seen(np.float32(r) * grid))
        both = [type(e)(*(np.asarray(v)[channel, None] for v in e)) for e in (colour, grey)]
        assert_same_mean(*both, rounding=1e-5, what=f"channel {channel}")
        assert_precise(difference(*both), 0.02 * grey.mean[channel], what=f"channel {channel}")


@pytest.mark.statistical
def test_a_coloured_fog_in_a_grey_smoke_is_its_grey_renders():
    """Absorption of a colour beside a grid that scatters alike in all channels: camera rays fly in each of the channels."""
    parts, emitters = {"sigma_s": grid_volume("mivol_voxels", rough_grid(6, 2.0), PLACE)}, {"sky": scenes.sky(0.5)}

    def radiance(absorption: object) -> Moments:
        smoke = box_of({"type": "mivol_medium", "sigma_a": absorption, **parts}, PLACE)
        return over_pixels(small.moments(close_up({"smoke": smoke, **emitters}, res=8), mivol(max_depth=6), 64))

    colours = (0.2, 0.8, 2.0)
    colour = radiance({"type": "rgb", "value": list(colours)})
    for channel, absorption in enumerate(colours):
        grey = radiance(absorption)
        both = [type(e)(*(np.asarray(v)[channel, None] for v in e)) for e in (colour, grey)]
        assert_same_mean(*both, rounding=1e-5, what=f"channel {channel}")
        assert_precise(difference(*both), 0.02 * grey.mean[channel], what=f"channel {channel}")


# -- Scenes, against Mitsuba ---------------------------------------------------------------------------------------------------


def _floor() -> dict:
    down = mi.ScalarTransform4f().translate([0, 0, -1.3]).scale(3)
    return {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}}


def _area(radius: float = 0.4, radiance: float = 8.0) -> dict:
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return {"type": "sphere", "center": [1.2, 0.3, 1.9], "radius": radius, "emitter": emitter}


def _tank(bsdf: dict) -> dict:
    milk = medium("homogeneous", 2.0, 0.9, phase=phase("hg", 0.5)[0])
    return ball_of(milk, (0, 0, 0), 0.9) | {"bsdf": bsdf}


SCENES = {
    "smoke in a room": lambda: {
        "smoke": smoke(rough_grid(7, 3.0), 0.8, name="hg", g=0.5)[0],
        "floor": _floor(),
        "emitter": _area(),
    },
    "milk in a glass": lambda: {"tank": _tank({"type": "dielectric"}), "sky": scenes.sky(0.4), "emitter": _area(0.7)},
    "milk in rough glass": lambda: {"tank": _tank({"type": "roughdielectric", "alpha": 0.3}), "sky": scenes.sky(0.4)},
    "two media": lambda: {
        "smoke": box_of(medium("homogeneous", 0.7, 0.9), centred(np.eye(3), (0.8, 0, 0))),
        "ball": ball_of(medium("homogeneous", 1.5, 0.6, phase=phase("hg", -0.3)[0]), (-0.7, 0, 0), 0.6),
        "sky": scenes.sky(0.4),
        "emitter": _area(),
    },
    "a wall inside": lambda: {
        "smoke": smoke(rough_grid(9, 2.0), 0.9)[0],
        "wall": {"type": "sphere", "radius": 0.4, "bsdf": {"type": "conductor"}},
        "bulb": point([1.7, -0.6, 1.4])[0],
    },
}


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", small.cases(SCENES, slow=[name for name in SCENES if name != "milk in a glass"]))
def test_scenes_are_those_of_volpath(name):
    """Grids have empty borders, where volpath's delta tracking loses light at a boundary."""
    scene = close_up(SCENES[name](), res=8)
    small.assert_same_images(
        scene, (128, 128), 16, ours=unlimited(rr_depth=1000), stock=volpath(), rounding=1e-5, precision=0.03
    )


@pytest.mark.statistical
def test_roulette_keeps_the_mean():
    scene = close_up({"smoke": smoke(rough_grid(7, 3.0), 0.7)[0], "sky": scenes.sky(1.0)}, res=8)
    early, never = (over_pixels(small.moments(scene, unlimited(rr_depth=k), 128, first=k)) for k in (1, 1000))
    assert_same_mean(early, never, rounding=1e-6, what="radiance")
    assert_precise(difference(early, never), 5e-3, what="radiance")


@pytest.mark.statistical
def test_alpha_is_the_opacity():
    """The drawn alpha has the mean of the exact alpha."""
    rgba = mi.load_dict({"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgba", "rfilter": {"type": "box"}})
    scene = mi.load_dict(
        {"type": "scene", "smoke": smoke(rough_grid(7, 2.0), 0.8)[0], "bulb": point([1.7, -0.6, 1.4])[0]}
        | {"sensor": scenes.camera((1.5, -2.5, 1.2), (0, 0, 0), res=8, fov=40.0) | {"film": rgba}}
    )
    drawn, known = (small.moments(scene, mivol(max_depth=depth), 64) for depth in (3, 2))
    a, b = (over_pixels(Moments(m.n, m.mean[..., 3:], m.m2[..., 3:])) for m in (drawn, known))
    assert_same_mean(a, b, rounding=1e-6, what="alpha")
    assert_precise(difference(a, b), 5e-3, what="alpha")


STRANGERS = (
    "hetero_sigmat",
    "hetero_spectral_sigmat_no_scattering",
    "homo_area_light",
    "homo_null_envmap",
    "homo_obj_inside_medium",
    "surf_area_light",
)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("name", STRANGERS)
def test_media_scenes_of_mitsubas_own_tests(two_threads, name, data_dir):
    """At their own depth of 6, with the name of the integrator as the only change: the means of whole pictures.

    A wide filter shares samples between pixels, so batches tell the noise of a mean. An rgb extinction is rendered
    by volpathmis, since volpath errs there.
    """
    folder = data_dir / "scenes" / "mitsuba-data" / "tests" / "scenes" / "participating_media"
    scene = mi.load_file(str(folder / f"test_{name}_volpath.xml"))
    judge = "volpathmis" if "spectral" in name else "volpath"
    found = []
    for kind, spp in (("mivol", 2), (judge, 4)):
        integrator = mi.load_dict({"type": kind, "max_depth": 6, "rr_depth": 5})
        pictures = [scenes.render(scene, integrator, spp, seed=fresh(k))[..., :3].mean(axis=(0, 1)) for k in range(16)]
        found.append(Moments.from_values(np.array(pictures, dtype=np.float64)))
    assert_same_mean(*found, rounding=1e-6, what="pictures")
    assert_precise(difference(*found), 0.02 * found[1].mean, what="pictures")


@pytest.mark.parametrize(
    ("beta", "u", "channel"),
    [((0, 1, 0), 0, 1), ((0, 0, 3), 0, 2), ((1, 0, 1), 0.5, 2), ((1, 1, 2), 0.2, 0), ((1, 1, 2), 0.3, 1), ((1, 1, 2), 0.6, 2)],
)
def test_a_channel_without_throughput_is_never_drawn(beta, u, channel):
    """Shares of [0, 1) in the order of the channels; one of no width holds no number, not even 0."""
    found = free_flight._sample_channel(mi.Spectrum(*map(float, beta)), mi.Float(u))
    assert int(np.array(found).item()) == channel
