"""Emitter samples of the bright part of an environment map: their density, their directions, and their noise."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.lighting.bright_map import LUMINANCE, SHARE, BrightMap, MapReading
from mivol.transport.estimators.lighting.direct_lighting import power_heuristic
from mivol.transport.estimators.lighting.emitters import SceneEmitters

EDGE = 512
"""Random numbers along each axis."""


def make_scene(pixels: np.ndarray, axis: tuple = (0.6, 0.8, 0), angle: float = 50, **more: dict) -> mi.Scene:
    turned = mi.ScalarTransform4f().rotate(axis, angle)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(pixels.astype(np.float32)), "to_world": turned}
    return mi.load_dict({"type": "scene", "sky": sky, **more})


def make_pixels(rows: int, columns: int) -> np.ndarray:
    pixels = np.random.default_rng(rows).random((rows, columns, 3)) ** 4
    pixels[rows // 2, 1] = 20
    return pixels


def read(scene: mi.Scene) -> BrightMap:
    return MapReading().follow(scene).table


def numbers() -> tuple[mi.Point2f, mi.Interaction3f]:
    """A regular grid of numbers in the unit square, and as many points."""
    at = (np.arange(EDGE) + 0.5) / EDGE
    u = mi.Point2f(*(mi.Float(part.ravel().astype(np.float32)) for part in np.meshgrid(at, at)))
    return u, dr.zeros(mi.Interaction3f, EDGE * EDGE)


def directions(u: mi.Point2f) -> mi.Vector3f:
    return mi.warp.square_to_uniform_sphere(u)


def test_the_focus_is_where_the_square_of_the_radiance_is() -> None:
    """Rationale: directions count by the square of their radiance. Expected: the mean direction of two suns of the radiances 10
    and 20, which count 1 to 4, and their root mean square angle about it, by single pixels of a fine map: 1e-3 of a radian."""
    rows, columns = 64, 128
    pixels = np.zeros((rows, columns, 3))
    places = {(20, 30): 10.0, (26, 36): 20.0}
    for place, radiance in places.items():
        pixels[place] = radiance
    scene = make_scene(pixels)
    turned = np.array(scene.environment().world_transform().matrix).reshape(4, 4)[:3, :3]
    suns, weights = [], []
    for (row, column), radiance in places.items():
        theta, phi = np.pi * row / (rows - 1), 2 * np.pi * (column + 0.5) / columns
        suns.append(turned @ [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)])
        weights.append(radiance**2 * np.sin(theta))
    mean = np.average(suns, axis=0, weights=weights)
    angle = np.sqrt(2 - 2 * np.linalg.norm(mean))
    np.testing.assert_allclose(read(scene).focus, [*(mean / np.linalg.norm(mean)), angle], atol=1e-3)


def test_an_even_map_has_no_focus() -> None:
    """All directions together: a mean of 0, and an angle of sqrt(2)."""
    assert float(read(make_scene(np.ones((8, 16, 3)))).focus[3]) == pytest.approx(np.sqrt(2), abs=1e-3)


@pytest.mark.parametrize(("rows", "columns"), [(6, 9), (9, 4)])
def test_the_density_is_the_radiance_above_a_share_of_its_mean(rows: int, columns: int) -> None:
    """Rationale: bilinear between the nodes of the map, in proportion to the excess times the sine. Expected: a twin in
    float64, and an integral of 1. A regular grid of 512^2 directions integrates a bilinear density with an error below 1e-3."""
    pixels = make_pixels(rows, columns)
    scene = make_scene(pixels)
    table = read(scene)
    light, height = pixels.astype(np.float32).astype(np.float64) @ LUMINANCE, np.linspace(0, np.pi, rows)
    mean = np.average(light.mean(axis=1), weights=np.sin(height))
    excess = np.maximum(light - SHARE * mean, 0) * np.sin(height)[:, None]
    total = (excess[1:] + excess[:-1]).mean() / 2  # bilinear, around and from pole to pole
    for row in range(1, rows - 1):
        phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns
        local = [np.sin(phi) * np.sin(height[row]), np.full(columns, np.cos(height[row])), -np.cos(phi) * np.sin(height[row])]
        turned = np.array(scene.environment().world_transform().matrix).reshape(4, 4)[:3, :3] @ local
        expected = excess[row] / total / (2 * np.pi**2 * np.sin(height[row]))
        assert np.array(table.pdf(mi.Vector3f(*turned), True)) == pytest.approx(expected, rel=1e-3, abs=1e-4)
    u, _ = numbers()
    assert np.mean(table.pdf(directions(u), True)) * 4 * np.pi == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(("rows", "columns"), [(6, 9), (9, 4), (3, 2)])
def test_samples_have_their_density_and_the_radiance_of_the_map(rows: int, columns: int) -> None:
    """Rationale: with the density p, the mean of f / p is the integral of f where p > 0, for any f. Expected: equal for f = 1,
    x, y^2 times p over p + 1, which is smooth; the errors of two regular grids of 512^2 are below 2e-3 of the integral of p."""
    scene = make_scene(make_pixels(rows, columns))
    table, (u, it) = read(scene), numbers()
    emitter = mi.EmitterPtr(scene.environment())
    direct, weight = table.sample(it, emitter, u, mi.Bool(True))
    pdf = np.array(direct.pdf, np.float64)
    assert np.array(table.pdf(direct.d, True)) == pytest.approx(pdf, rel=2e-2, abs=1e-4 * pdf.max())
    for f in (lambda d: 1 + 0 * d[0], lambda d: d[0], lambda d: d[1] ** 2):
        ways = []
        for d, divides in ((direct.d, True), (directions(u), False)):
            p = np.array(table.pdf(d, True), np.float64)
            ways.append(np.mean(f(np.array(d)) * (1 if divides else p * 4 * np.pi) / (p + 1)))
        assert ways[0] == pytest.approx(ways[1], abs=2e-3)
    si = dr.zeros(mi.SurfaceInteraction3f, EDGE * EDGE)
    si.wi = -direct.d
    radiance = np.array(scene.environment().eval(si), np.float64)
    assert np.array(weight) * pdf == pytest.approx(radiance, abs=1e-3 * radiance.max())
    assert np.all(np.array(direct.dist) >= 2) and np.all(
        np.linalg.norm(np.array(direct.d), axis=0) == pytest.approx(1, abs=1e-6)
    )


def test_a_reading_holds_until_the_map_changes() -> None:
    scene = make_scene(make_pixels(6, 9), ball={"type": "sphere"})
    first = MapReading().follow(scene)
    assert first.table is not None and first.follow(scene) is first
    params = mi.traverse(scene)
    params["sky.data"] = params["sky.data"] * 2
    params.update()
    second = first.follow(scene)
    assert second is not first and np.array(second.table.density) == pytest.approx(np.array(first.table.density), rel=1e-5)
    params["sky.to_world"] = mi.Transform4f().rotate([0, 1, 0], 10)
    params.update()
    assert not np.allclose(second.follow(scene).table.to_world, second.table.to_world)
    dr.enable_grad(params["sky.data"])
    params.update()
    assert second.follow(scene).table is None  # images of a fit draw what its derivatives draw


@pytest.mark.parametrize("sky", [None, {"type": "constant"}, {"type": "directional"}])
def test_other_skies_have_no_bright_part(sky: dict | None) -> None:
    parts = {"ball": {"type": "sphere"}, **({} if sky is None else {"sky": sky})}
    assert MapReading().follow(mi.load_dict({"type": "scene", **parts})).table is None


def test_a_black_map_and_a_stretched_one_have_none() -> None:
    assert MapReading().follow(make_scene(np.zeros((6, 9, 3)))).table is None
    scene = make_scene(make_pixels(6, 9))
    params = mi.traverse(scene)
    params["sky.to_world"] = mi.Transform4f().scale([1, 2, 1])
    params.update()
    assert MapReading().follow(scene).table is None


def test_samples_of_the_bright_part_are_balanced() -> None:
    """The balance heuristic weighs samples of the map, the power heuristic those of lamps: 1 / 4 and 1 / 10 for 1 and 3."""
    scene = make_scene(make_pixels(6, 9), lamp={"type": "point", "position": [0, 0, 3]})
    found = SceneEmitters(scene, bright=read(scene))
    weights = [power_heuristic(mi.Float(1), mi.Float(3), found.are_balanced(mi.EmitterPtr(e)))[0] for e in scene.emitters()]
    expected = [0.25 if e.is_environment() else 0.1 for e in scene.emitters()]
    assert weights == pytest.approx(expected, rel=1e-6) and len(weights) == 2


def test_a_floor_under_a_map_has_less_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationale: under an overcast sky, directions of the floor and the fog meet most light without noise. Expected: the
    variance of images with the table is below 0.85 of that without; it is 0.59 with these seeds. The means agree to 1 %, nearly
    four standard errors."""
    height = np.linspace(0, np.pi, 32)[:, None, None]
    pixels = np.where(height < np.pi / 2, (1 + 2 * np.cos(height)) / 3, 0.15) * np.ones((32, 64, 3))
    view = mi.ScalarTransform4f().look_at([0, 4, 3], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 0.5}}
    scene = make_scene(
        pixels,
        (1, 0, 0),
        90,
        ball=ball,
        floor={"type": "rectangle"},
        sensor={"type": "perspective", "to_world": view, "film": film},
    )
    assert read(scene) is not None
    variances, means = [], []
    for is_bright in (True, False):
        if not is_bright:
            monkeypatch.setattr(MapReading, "follow", lambda self, scene: self)
        integrator = mi.load_dict({"type": "mivol", "max_depth": 3})
        images = np.array([np.array(mi.render(scene, integrator=integrator, spp=16, seed=s)) for s in range(12)])
        variances.append(images.var(axis=0, ddof=1).mean())
        means.append(images.mean())
    assert variances[0] < 0.85 * variances[1]
    assert means[0] == pytest.approx(means[1], rel=0.01)


def test_a_recorded_image_follows_the_map() -> None:
    """Rationale: the table is an input of a recording. Expected: after a change of the map the image of the same integrator is
    that of a new one to the bit, and no other recording is made."""
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    fog = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 0.5}}
    sensor = {"type": "perspective", "to_world": mi.ScalarTransform4f().translate([0, 0, -4]), "film": film}
    scene = make_scene(make_pixels(6, 9), fog=fog, sensor=sensor)
    integrator = mi.load_dict({"type": "mivol", "max_depth": 3})
    params = mi.traverse(scene)
    for number in range(4):
        pixels = np.array(params["sky.data"])
        pixels[2, number + 2] += 40
        params["sky.data"] = mi.TensorXf(pixels)
        params.update()
        image = np.array(mi.render(scene, integrator=integrator, spp=8))
        if number == 1:
            known = integrator.session.recordings.count
    assert integrator.session.recordings.count == known
    other = mi.load_dict({"type": "mivol", "max_depth": 3})
    assert np.array_equal(np.array(mi.render(scene, integrator=other, spp=8)), image)
