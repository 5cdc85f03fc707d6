"""An emitter is chosen by the light that it gives at a vertex or along a ray: probabilities, means, variance, derivatives."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import Estimate, assert_precise, assert_same_mean, assert_same_spread
from scattering_scenes import assert_same_images, close_up, fog, mivol, moments, point, spot, sun
from volpath_scenes import LEAK, area, floor, panorama, textured

from mivol.transport.estimators.lighting.emitter_grid import EVEN_SHARE, MARGIN, MAX_CELLS, MEAN_SHARE
from mivol.transport.estimators.lighting.emitters import SceneEmitters, read_emitters

STRONG, WEAK = [1.5, -1.0, 1.8], [-1.6, 0.9, 0.4]
ROUNDING = 2.0**-20


def scene_of(lights: dict) -> mi.Scene:
    return mi.load_dict({"type": "scene", "fog": fog(0.3)[0], **lights})


def emitters_of(lights: dict) -> SceneEmitters:
    return SceneEmitters(scene_of(lights))


def pair(ratio: float, **more: object) -> dict:
    """Two lamps beside the box, one ``ratio`` times as strong."""
    return {"strong": point(STRONG, 5.0 * ratio)[0], "weak": point(WEAK, 5.0)[0] | more}


def lamps(count: int) -> dict:
    """Points, spots and panels in and around the box; their powers differ by up to a thousand times."""
    rng, lights = np.random.default_rng(count), {}
    for k in range(count):
        p, q, power = rng.uniform(-1.6, 1.6, 3), rng.uniform(-0.5, 0.5, 3), 10 ** rng.uniform(-2, 1) / count**0.5
        make = (lambda p=p, w=power: point(p, w)[0], lambda p=p, q=q, w=power: spot(p, q, 4 * w)[0],
                lambda p=p, w=power: area(*p, 8 * w, 0.3))  # fmt: skip
        lights[f"light{k}"] = make[k % 3]()
    return lights


def textures() -> dict:
    return {"sky": {"type": "envmap", "bitmap": panorama()}, "panel": textured(), **pair(3.0)}


# -- Probabilities -------------------------------------------------------------------------------------------------------


def probabilities(found: SceneEmitters, distribution: object) -> np.ndarray:
    """Of all sampled emitters (emitters, points)."""
    return np.array([np.array(distribution.probability(mi.UInt32(k))) for k in range(len(found.sampled))])


def test_two_lamps_at_points() -> None:
    """Each probability lies between those of the nearest and farthest points of the grid's cell, by 1 / r^2."""
    found, rng = emitters_of(pair(30.0)), np.random.default_rng(1)
    p = rng.uniform(-1, 1, (300, 3))
    seen = probabilities(found, found._grid.at_point(mi.Point3f(p.T.astype(np.float32))))
    # An edge of a cell is 1 / 6 of the box's half; a point of the cell may lie in its margin on the other side.
    reach = np.sqrt(3) * (1 + MARGIN) * (8 / 3 / MAX_CELLS)
    ratios = []
    for sign in (1, -1):
        strong, weak = (np.linalg.norm(p - lamp, axis=1) for lamp in (STRONG, WEAK))
        ratios.append(30.0 * np.maximum(weak - sign * reach, 0) ** 2 / (strong + sign * reach) ** 2)
    rest = 1 - EVEN_SHARE - MEAN_SHARE
    # The share by the light in all cells is at least even for the stronger lamp.
    low, high = ratios[0] / (1 + ratios[0]), ratios[1] / (1 + ratios[1])
    low, high = rest * low + MEAN_SHARE / 2 + EVEN_SHARE / 2, rest * high + MEAN_SHARE + EVEN_SHARE / 2
    it = dr.zeros(mi.Interaction3f)
    places = [np.array(e.sample_direction(it, mi.Point2f(0))[0].p).ravel() for e in found.sampled]
    strongest = int(np.argmin([np.linalg.norm(place - STRONG) for place in places]))
    assert (seen[strongest] >= low - ROUNDING).all() and (seen[strongest] <= high + ROUNDING).all()
    np.testing.assert_allclose(seen.sum(0), 1, rtol=ROUNDING)
    assert (high - low).max() < 0.6 and seen[strongest].min() > 0.5


@pytest.mark.parametrize("along", [False, True])
def test_frequencies_are_probabilities(along: bool) -> None:
    """Numbers of a fine even sequence choose each emitter as often as its probability says, and their rest is even again."""
    found, n = emitters_of(lamps(7)), 1 << 16
    ray = mi.Ray3f(mi.Point3f(0.2, -3, 0.1), mi.Vector3f(0, 1, 0))
    distribution = found._grid.along_ray(ray, False) if along else found._grid.at_point(mi.Point3f(0.2, 0.4, 0.1))
    u = (dr.arange(mi.Float, n) + 0.5) / n
    number, rest = (np.array(x) for x in distribution.sample(u))
    expected = probabilities(found, distribution).ravel()
    # A step of u in each row of 16 points may fall on either side.
    np.testing.assert_allclose(np.bincount(number, minlength=7) / n, expected, atol=2 * 16 / n)
    for k in range(7):
        mine = np.sort(rest[number == k])
        if not along and len(mine) > 100:
            np.testing.assert_allclose(mine, (np.arange(len(mine)) + 0.5) / len(mine), atol=2 / len(mine) + 1e-3)


def test_a_ray_chooses_the_lamp_that_it_passes() -> None:
    """Half of the choices of a ray go by the integral of 1 / r^2, which rises as 1 / h at a distance h of a lamp."""
    lights = {f"lamp{k}": point([0.3 * k - 1.2, 0.4 * (k % 3), 0.2], 0.2 if k == 5 else 2.0)[0] for k in range(8)}
    found, h = emitters_of(lights), np.array([1e-4, 3e-4])
    rays = mi.Ray3f(mi.Point3f(0.3, -3, 0.2 + mi.Float(h)), mi.Vector3f(0, 1, 0))
    seen = probabilities(found, found._grid.along_ray(rays, False))
    # The integral is at most pi / 0.3 for each of seven others, ten times as strong; their places change it less than 4 times.
    assert (seen[5] > 0.5 * (1 - 4 * 70 * h / 0.3)).all() and (seen[5] < 0.6).all()
    np.testing.assert_allclose(seen.sum(0), 1, rtol=ROUNDING)


def test_cells_are_fine_around_lamps_in_a_wide_box() -> None:
    """In a fog a hundred times as wide as the lamps are apart, a vertex beside one of them chooses it."""
    wide = {"type": "scene", "fog": fog(0.3, to_world=np.diag([200.0, 200, 200, 1]))[0]}
    pair = {"a": point([0, 0, 0])[0], "b": point([2, 0, 0])[0]}
    found = SceneEmitters(mi.load_dict(wide | pair))
    # At a tenth of their distance one gives 81 times as much as the other, in a cell 0.1 away still 16 times as much.
    seen = probabilities(found, found._grid.at_point(mi.Point3f([0.2, 1.8], 0, 0)))
    assert (seen.max(axis=0) > 0.8).all() and seen.argmax(axis=0)[0] != seen.argmax(axis=0)[1]


def test_numbers_of_emitters_and_of_others() -> None:
    """An emitter has its number, a constant sky and no emitter have none."""
    found = emitters_of({**lamps(4), "sky": {"type": "constant"}})
    scene_emitters = [mi.EmitterPtr(e) for e in found.sampled]
    p = found._grid.at_point(mi.Point3f(0.1, 0.2, 0.3))
    each = [p.probability(found._table.number(e))[0] for e in scene_emitters]
    assert sum(each) == pytest.approx(1, rel=ROUNDING) and min(each) >= 0.99 * EVEN_SHARE / 4
    assert p.probability(found._table.number(dr.zeros(mi.EmitterPtr, 1)))[0] == 0


def test_the_density_of_a_direction_is_the_density_of_its_sample() -> None:
    """The density of a direction that hits a panel is the density with which emitter samples find it."""
    scene, n = scene_of(lamps(7)), 4096
    found = SceneEmitters(scene)
    it, k = dr.zeros(mi.Interaction3f, n), dr.arange(mi.Float, n)
    it.p = mi.Point3f(*(dr.sin(k * step) for step in (1.1, 2.3, 3.7)))
    u = mi.Point2f((k + 0.5) / n, k * 0.618034 - dr.floor(k * 0.618034))
    draw = found.sample_direction(it, u, mi.Bool(True))
    direct, again = draw.direct, found.pdf_direction(it, draw.direct, mi.Bool(True))
    panel = np.array(~direct.delta & (direct.pdf > 0) & (draw.emitter == direct.emitter))
    assert panel.sum() > 100
    np.testing.assert_allclose(np.array(again)[panel], np.array(direct.pdf)[panel], rtol=ROUNDING)


def test_weights_of_the_scene_count() -> None:
    """A ``sampling_weight`` of 3 beside 1 multiplies the probability of a lamp that gives as much light; 0 leaves it out.
    Also in the array that recordings take, behind a sky that is not sampled and another weight.
    """
    for weight in (3.0, 0.0):
        far = {"a": sun([0, 0, -1])[0] | {"sampling_weight": weight}, "b": sun([0, 1, 0])[0]}
        scene = scene_of({"sky": {"type": "constant", "sampling_weight": 7.0}, **far})
        for found in (SceneEmitters(scene), SceneEmitters(scene, numbers=read_emitters(scene))):
            seen = probabilities(found, found._grid.at_point(mi.Point3f(0))).ravel()
            assert seen == pytest.approx([weight / (weight + 1), 1 / (weight + 1)], abs=ROUNDING)


# -- Means and variance --------------------------------------------------------------------------------------------------


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("lights", "depth"),
    [
        (lambda: pair(1000.0), 2),
        (lambda: lamps(16), 5),
        pytest.param(lambda: lamps(2), 5, marks=pytest.mark.slow),
        pytest.param(lambda: lamps(16), 2, marks=pytest.mark.slow),
        pytest.param(lambda: lamps(200), 2, marks=pytest.mark.slow),
        pytest.param(lambda: lamps(200), 5, marks=pytest.mark.slow),
        pytest.param(textures, 4, marks=pytest.mark.slow),
    ],
    ids=["strong", "16 deep", "2 deep", "16", "200", "200 deep", "textures"],
)  # fmt: skip
def test_as_in_volpath(lights: Callable[[], dict], depth: int) -> None:
    scene = close_up({"fog": fog(0.4)[0], **floor(), **lights()}, res=8)
    more = {"max_depth": depth, "rr_depth": 100}
    assert_same_images(scene, (64, 256), rounding=LEAK, ours=mivol(**more), stock={"type": "volpath", **more}, precision=0.05)


@pytest.mark.slow
@pytest.mark.statistical
def test_the_variance_of_a_lamp_beside_a_dark_one() -> None:
    """A second lamp of no light takes half of the even share.

    One sample a pixel has the variance s of a lamp alone, of mean m. Beside the dark lamp it is (s + m^2) / q - m^2 with
    q = 1 - EVEN_SHARE / 2; an even choice would give q = 1/2, at least twice the variance.
    """
    settings = mivol(max_depth=3)
    alone, beside = (
        moments(close_up({"fog": fog(0.4)[0], "lamp": point(STRONG, 5.0)[0], **dark}, res=24), settings, 1, 64)
        for dark in ({}, {"dark": point(WEAK, 0.0)[0]})
    )
    q = 1 - EVEN_SHARE / 2
    s, m2 = float(alone.variance[..., 0].mean()), float(np.square(alone.mean[..., 0]).mean())
    expected = ((s + m2) / q - m2) / s
    assert 1 < expected < 1.2
    a, b = (Estimate(x.mean[..., 0], x.variance[..., 0], 63) for x in (beside, alone))
    assert_same_spread(a, b, expected=expected, low=0.75, high=1.5, what="variances")


# -- Derivatives ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow_for("3")
@pytest.mark.statistical
@pytest.mark.parametrize("depth", [2, 3])
def test_a_dark_lamp_has_its_derivative(depth: int) -> None:
    """The derivative of the mean image by the intensity of a dark lamp is the image of the lamp alone at intensity 1."""
    parts, key, n = {"fog": fog(0.4)[0], "strong": point(STRONG, 50.0)[0]}, "dark.intensity.value", 24
    scene, settings = close_up({**parts, "dark": point(WEAK, 0.0)[0]}, res=8), mi.load_dict(mivol(max_depth=depth))
    params, slopes = mi.traverse(scene), []
    for seed in range(n):
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=settings, spp=64, seed=seed), axis=None))
        slopes.append(float(np.sum(np.array(dr.grad(params[key])))))
        dr.disable_grad(params[key])
    alone = close_up({"fog": fog(0.4)[0], "dark": point(WEAK, 1.0)[0]}, res=8)
    images = [float(np.mean(np.array(mi.render(alone, integrator=settings, spp=64, seed=seed)))) for seed in range(n)]
    found, truth = (Estimate(np.array([np.mean(x)]), np.array([np.var(x, ddof=1) / n]), n - 1) for x in (slopes, images))
    assert_precise(found, 0.1 * truth.mean, what="slopes")
    assert_same_mean(found, truth, what="slopes")
