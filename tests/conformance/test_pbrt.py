"""Scenes of pbrt-v4: media against closed forms, pbrt's definition of a grid and ``volpath``; cameras, skies, bad scenes.

Rays run along z through the middle of the image. A grid of pbrt is trilinear between the centres of its voxels, and 0 outside
of its bounds (fourth edition of the book, section 11.4); :func:`look_up` is that definition in float64.
"""

from __future__ import annotations

import gzip
import math
import re
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
from conformance.test_bad_files import refused
from false_alarms import assert_same_mean
from scattering_scenes import moments

import mivol
from mivol.cli import main
from mivol.fields.blackbody import blackbody_rgb, planck
from mivol.files import VolumeData, frame_from_steps, read_volume, write_exr, write_grids
from mivol.files.mesh import Mesh, write_mesh
from mivol.scene.pbrt import fold_direction, noise, unfold_sky

HEAD = """LookAt 0 0 -4  0 0 0  0 1 0   # the eye
Camera "perspective" "float fov" 0.02
Film "rgb" "integer xresolution" [ 3 ] "integer yresolution" [ 3 ] "string filename" "a.exr"
Sampler "halton" "integer pixelsamples" 1
Integrator "volpath" "integer maxdepth" {depth}
WorldBegin
LightSource "infinite" "rgb L" [ 1 2 3 ] "float scale" 0.5
"""
SKY = np.array([0.5, 1, 1.5])
BOX = """AttributeBegin {place} MakeNamedMedium "m" {medium}
AttributeEnd
AttributeBegin MediumInterface "m" "" Material "interface" {shape} AttributeEnd
"""
BALL = 'Shape "sphere" "float radius" 2'


def convert(folder: Path, medium: str, place: str = "", shape: str = BALL, depth: int = 0) -> mi.Scene:
    """The scene of a medium in a boundary."""
    (folder / "a.pbrt").write_text(HEAD.format(depth=depth) + BOX.format(place=place, medium=medium, shape=shape))
    mivol.convert_pbrt(folder / "a.pbrt", folder / "a.xml")
    return mi.load_file(str(folder / "a.xml"), parallel=False)


def middle(scene: mi.Scene) -> np.ndarray:
    """The rgb of the pixel in the middle, whose rays leave the axis by at most 4e-4."""
    return np.array(mi.render(scene, spp=64, integrator=mi.load_dict({"type": "mivol", "max_depth": 1})))[1, 1]


def look_up(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Values (Z, Y, X) at points (n, 3) of the unit cube of the bounds: trilinear, 0 outside."""
    padded = np.pad(np.asarray(values, np.float64), 1)
    n = np.array(values.shape[::-1])
    u = q * n + 0.5
    i = np.clip(np.floor(u).astype(int), 0, n)
    f, total = u - i, 0
    for corner in np.ndindex(2, 2, 2):
        w = np.prod(np.where(corner, f, 1 - f), axis=1)
        x, y, z = (i + corner).T
        total = total + w * padded[z, y, x]
    return total * ((q >= 0) & (q <= 1)).all(axis=1)


def along_axis(values: np.ndarray, low: np.ndarray, high: np.ndarray, steps: int = 4000) -> tuple[np.ndarray, float]:
    """Values of a grid on points of the axis, and their distance."""
    z = np.linspace(low[2], high[2], steps + 1)
    z = (z[1:] + z[:-1]) / 2
    points = np.column_stack([0 * z, 0 * z, z])
    return look_up(values, (points - low) / (np.array(high) - low)), (high[2] - low[2]) / steps


# -- Media ---------------------------------------------------------------------------------------------------------------


def test_homogeneous(tmp_path: Path) -> None:
    """Beer and Lambert over a diameter of 2, and light of sigma_a Le; the transform scales the ball, not the coefficients."""
    medium = '"string type" "homogeneous" "rgb sigma_a" [.2 .3 .4] "spectrum sigma_s" [300 .1 800 .1] "float scale" 2 '
    medium += '"rgb Le" [1 2 4]'
    scene = convert(tmp_path, medium, shape='Scale 2 2 2 Shape "sphere" "float radius" .5')
    assert 'name="max_depth" value="1"' in (tmp_path / "a.xml").read_text()  # no bounce is one segment
    sigma_a, sigma_t = 2 * np.array([0.2, 0.3, 0.4]), 2 * np.array([0.3, 0.4, 0.5])
    T = np.exp(-2 * sigma_t)
    np.testing.assert_allclose(middle(scene), T * SKY + sigma_a / sigma_t * [1, 2, 4] * (1 - T), rtol=2e-5)


GRID = np.random.default_rng(5).uniform(0.2, 2, (3, 4, 2))
LOW, HIGH = np.array([-0.5, -0.7, -0.9]), np.array([0.6, 0.5, 1.1])


@pytest.mark.parametrize("line", ["", 'Integrator "volpath"\n'])
def test_light_bounces_five_times_where_no_depth_is_given(tmp_path: Path, line: str) -> None:
    """As in pbrt-v4; with six segments."""
    (tmp_path / "a.pbrt").write_text(f"{line}WorldBegin\n{BALL}\n")
    mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    assert 'name="max_depth" value="6"' in (tmp_path / "a.xml").read_text()


def numbers(values: np.ndarray) -> str:
    return "[ " + " ".join(map(repr, np.ravel(values).tolist())) + " ]"


def grid_text(**lists: object) -> str:
    size = " ".join(f'"integer {n}" {k}' for n, k in zip(("nx", "ny", "nz"), GRID.shape[::-1], strict=True))
    return f'{size} "point3 p0" {numbers(LOW)} "point3 p1" {numbers(HIGH)} ' + " ".join(
        f'"{name.replace("__", " ")}" {value}' for name, value in lists.items()
    )


def test_uniform_grid(tmp_path: Path) -> None:
    """A coloured extinction: density times rgb."""
    text = grid_text(float__density=numbers(GRID), rgb__sigma_a="[.5 1 2]", rgb__sigma_s="[0 0 1]", float__scale=0.7)
    scene = convert(tmp_path, '"string type" "uniformgrid" ' + text)
    density, step = along_axis(GRID, LOW, HIGH)
    np.testing.assert_allclose(middle(scene), SKY * np.exp(-0.7 * density.sum() * step * np.array([0.5, 1, 3])), rtol=1e-4)


def test_light_of_a_uniform_grid(tmp_path: Path) -> None:
    """Le times a grid of factors times the absorption."""
    factors = np.random.default_rng(6).uniform(0, 3, GRID.shape)
    text = grid_text(
        float__density=numbers(GRID), float__sigma_a="1", float__sigma_s="0", rgb__Le="[1 0 2]", float__Lescale=numbers(factors)
    )
    density, step = along_axis(GRID, LOW, HIGH)
    light, _ = along_axis(factors, LOW, HIGH)
    T = np.exp(-step * (np.cumsum(density) - density / 2))
    expected = SKY * np.exp(-step * density.sum()) + np.array([1, 0, 2]) * (T * density * light).sum() * step
    np.testing.assert_allclose(middle(convert(tmp_path, '"string type" "uniformgrid" ' + text)), expected, rtol=2e-3)


def test_rgb_grid(tmp_path: Path) -> None:
    colours = np.random.default_rng(7).uniform(0, 1, (*GRID.shape, 3))
    text = grid_text(rgb__sigma_a=numbers(colours), rgb__sigma_s=numbers(2 * colours), float__scale=0.5)
    sums = np.array([along_axis(colours[..., c], LOW, HIGH)[0].sum() * along_axis(GRID, LOW, HIGH)[1] for c in range(3)])
    np.testing.assert_allclose(
        middle(convert(tmp_path, '"string type" "rgbgrid" ' + text)), SKY * np.exp(-1.5 * sums), rtol=1e-4
    )


def test_nanovdb(tmp_path: Path) -> None:
    """Constant density and temperature, scaled and turned by the transform of the medium. The bounds end one voxel behind the
    last centre, where pbrt's density has fallen to 0 and a box of voxels ended half a voxel before: the same optical depth."""
    soot = VolumeData(np.full((10, 10, 10, 1), 0.4, np.float32), frame_from_steps((10,) * 3, 0.1 * np.eye(3), [-0.45] * 3))
    heat = VolumeData(np.full((10, 10, 10, 1), 15.0, np.float32), soot.to_world)
    write_grids(tmp_path / "a.nvdb", {"density": soot, "temperature": heat})
    medium = '"string type" "nanovdb" "string filename" "a.nvdb" "float sigma_a" 1.5 "float sigma_s" 0.5 "float LeScale" 2 '
    scene = convert(
        tmp_path, medium + '"float temperaturescale" 100 "float temperatureoffset" 1', "Scale 1 1 2 Rotate 90 0 0 1"
    )
    # 0.95 of the edge of the box, which is 2 long: half a voxel lies before the bounds.
    T, peak = np.exp(-2 * 0.4 * 2 * 0.95), planck(2.897771955e6 / 1400, 1400)
    expected = SKY * T + 0.75 * 2 * blackbody_rgb(np.array(1400.0)) / peak * (1 - T)
    np.testing.assert_allclose(middle(scene), expected, rtol=2e-4)


def test_cloud(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Below the height 0.5 - 0.5 the density is 1; above 1 there is none; wisps change it."""
    monkeypatch.setattr("mivol.scene.pbrt.CLOUD_VOXELS", 32)
    bounds = '"point3 p0" [0 -.5 0] "point3 p1" [1 1.5 1] '
    found = []
    for wisps in ("0", "1"):
        convert(tmp_path, '"string type" "cloud" "float sigma_s" 10 "float density" 2 ' + bounds + f'"float wispiness" {wisps}')
        values = read_volume(tmp_path / "a_1.vdb").values[..., 0]
        assert (values[:, :8] == 1).all()  # up to the height 0
        assert 0.05 < values[:, 8:24].mean() < 0.9 and values[:, 16:24].std() > 0.1
        found.append(values)
    assert not np.array_equal(*found)


WAYS = np.array([[x, y, 0] for y in (1, -1) for x in (1, -1)] + [[x, 0, z] for z in (1, -1) for x in (1, -1)]
                + [[0, y, z] for z in (1, -1) for y in (1, -1)] + [[1, 1, 0], [0, -1, 1], [-1, 1, 0], [0, -1, -1]])  # fmt: skip
"""Perlin's directions: the middles of a cube's edges, four of them twice."""


def test_noise_is_perlins() -> None:
    """Of random places, those below 0 included, against the definition in float64: a gradient at each corner, faded between."""
    table, places = np.random.default_rng(1).permutation(256), np.random.default_rng(2).uniform(-300, 300, (50, 3))
    places = np.float32(places).astype(np.float64)
    cell = np.floor(places).astype(int)
    f, expected = places - cell, np.zeros(50)
    fade = 6 * f**5 - 15 * f**4 + 10 * f**3
    for corner in np.ndindex(2, 2, 2):
        number = 0
        for k in range(3):
            number = table[(cell[:, k] + corner[k] + number) % 256]
        weight = np.prod(np.where(corner, fade, 1 - fade), axis=1)
        expected += weight * (WAYS[number % 16] * (f - corner)).sum(1)
    found = np.array(noise(mi.Point3f(*np.float32(places.T)), mi.UInt32(table.astype(np.uint32))))
    # Terms of at most 2, in a dozen operations of float32.
    np.testing.assert_allclose(found, expected, rtol=0, atol=24 * 2**-23)


@pytest.mark.slow
@pytest.mark.statistical
def test_against_volpath(tmp_path: Path) -> None:
    """Scattered light of a coloured grid: stock heterogeneous media on the grid that was written, with ``volpath``."""
    text = grid_text(float__density=numbers(GRID), float__sigma_a="0.2", float__sigma_s="1.5", float__g="0.4")
    scene = convert(tmp_path, '"string type" "uniformgrid" ' + text, depth=5)
    (path,) = tmp_path.glob("*.nrrd")
    written = read_volume(path)
    box = np.eye(4)
    box[:3, :3], box[:3, 3] = np.diag(HIGH - LOW) / 2, (HIGH + LOW) / 2
    to_world = mi.ScalarTransform4f
    stock = {
        "type": "heterogeneous",
        "albedo": 1.5 / 1.7,
        "scale": 1.7,
        "phase": {"type": "hg", "g": 0.4},
        "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(written.values), "to_world": to_world(written.to_world)},
    }
    other = mi.load_dict(
        {
            "type": "scene",
            "sensor": scene.sensors()[0],
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY.tolist()}},
            "box": {"type": "cube", "to_world": to_world(box), "bsdf": {"type": "null"}, "interior": stock},
        }
    )
    ours, theirs = (
        moments(each, {"type": kind, "max_depth": 6}, 512, 16) for each, kind in ((scene, "mivol"), (other, "volpath"))
    )
    assert_same_mean(ours, theirs, what="pixels")


# -- Cameras, lights and shapes ------------------------------------------------------------------------------------------


def test_the_right_is_on_the_right(tmp_path: Path) -> None:
    """Up times forwards is right in pbrt: a ball at +x for an eye that looks along +z with y up; a ball above is above."""
    (tmp_path / "a.pbrt").write_text(
        'LookAt 0 0 0  0 0 1  0 1 0 Camera "perspective" "float fov" 60 Film "rgb" '
        '"integer xresolution" 8 "integer yresolution" 4 WorldBegin AttributeBegin Translate 2 1 4 '
        'AreaLightSource "diffuse" "blackbody L" 5000 "float scale" 3 '
        'Shape "sphere" "float radius" .4 AttributeEnd'
    )
    mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    image = np.array(mi.render(mi.load_file(str(tmp_path / "a.xml"), parallel=False), spp=256)) @ [0.2126, 0.7152, 0.0722]
    row, column = np.unravel_index(np.argmax(image), image.shape)
    # The shorter side has the tangent 0.577: the ball is at 0.25 and 0.5 of it from the middle.
    assert row == 1 and column in (5, 6)
    # Of a black body the luminance is 1, times the scale. The ball is 0.4 wide at a distance of sqrt(21), seen aslant.
    pixels = np.pi * 0.4**2 / 21 * (21**0.5 / 4) ** 3 / (2 * np.tan(np.pi / 6) / 4) ** 2
    assert image.sum() == pytest.approx(3 * pixels, rel=0.1)


def test_directions_of_the_equal_area_mapping() -> None:
    axes = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, -1]], float).T
    u, v = fold_direction(axes)
    np.testing.assert_allclose(u[:4], [0.5, 1, 0.5, 0], atol=1e-12)
    np.testing.assert_allclose(v[:4], [0.5, 0.5, 1, 0.5], atol=1e-12)
    assert {u[4], v[4]} <= {0.0, 1.0}
    # Equal areas: uniform directions fill the square evenly.
    d = np.random.default_rng(0).normal(size=(3, 40000))
    counts = np.histogram2d(*fold_direction(d / np.linalg.norm(d, axis=0)), bins=4, range=[(0, 1), (0, 1)])[0]
    assert np.abs(counts - 2500).max() < 6 * np.sqrt(2500)


def test_a_sky_keeps_its_directions(tmp_path: Path, two_threads: None) -> None:
    """An image in pbrt's mapping whose colour tells the direction, under a transform; Mitsuba's sky says the same."""
    n = 64
    grid = np.random.default_rng(1).normal(size=(3, 400000))
    grid /= np.linalg.norm(grid, axis=0)
    u, v = fold_direction(grid)
    sky, count = np.zeros((n, n, 3)), np.zeros((n, n, 1))
    at = (np.minimum((v * n).astype(int), n - 1), np.minimum((u * n).astype(int), n - 1))
    np.add.at(sky, at, grid.T + 1)
    np.add.at(count, at, 1)
    write_exr(tmp_path / "sky.exr", {"": (sky / count).astype(np.float32)})
    text = HEAD.format(depth=0).replace('"rgb L" [ 1 2 3 ] "float scale" 0.5', '"string filename" "sky.exr" "float scale" 2')
    (tmp_path / "a.pbrt").write_text(
        text.replace("LightSource", "AttributeBegin Rotate 90 1 0 0 LightSource") + " AttributeEnd"
    )
    mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    emitter = mi.load_file(str(tmp_path / "a.xml"), parallel=False).environment()
    world = np.random.default_rng(2).normal(size=(3, 200))
    world /= np.linalg.norm(world, axis=0)
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(world.astype(np.float32))
    # Rotate by 90 degrees about x: the light's y is the world's z, its z the world's -y.
    expected = 2 * (np.stack([world[0], world[2], -world[1]]) + 1)
    assert np.abs(np.array(emitter.eval(si)) - expected).max() < 0.2  # a pixel is 0.06 wide, two of them are averaged
    assert unfold_sky(np.ones((8, 8, 3), np.float32)).shape == (16, 32, 3)


def test_photometric_lights(tmp_path: Path) -> None:
    """Illuminance pi of a sky of luminance 1, of a distant light 1; power 4 pi of the intensity 1; named illuminants."""
    (tmp_path / "a.pbrt").write_text(
        'WorldBegin LightSource "infinite" "float illuminance" 6 "spectrum L" "stdillum-D65" LightSource "distant" '
        '"rgb L" [1 2 3] "float illuminance" 7 "float scale" 2 LightSource "point" "float power" 5 "spectrum I" "stdillum-A"'
    )
    assert "0 media, 3 lights" in mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    text = (tmp_path / "a.xml").read_text()
    sky, sun, lamp = (np.array(re.search(f'name="{n}" value="([^"]*)"', text)[1].split(), float) for n in LIGHTS)
    np.testing.assert_allclose(sky, 6 / np.pi, rtol=1e-8)
    np.testing.assert_allclose(sun, [14, 28, 42], rtol=1e-8)
    assert lamp @ [0.2126, 0.7152, 0.0722] == pytest.approx(5 / (4 * np.pi)) and lamp[0] > 2 * lamp[2]


LIGHTS = ("radiance", "irradiance", "intensity")


def test_what_is_left_out_is_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "b.pbrt.gz").write_bytes(gzip.compress(b'Shape "curve" Material "hair" Shape "disk"'))
    (tmp_path / "a.pbrt").write_text(
        'Camera "realistic" Film "rgb" "string sensor" "nikon" WorldBegin Include "b.pbrt.gz" LightSource "goniometric" '
        'Texture "t" "spectrum" "imagemap" "string filename" "a.png" Option "string rendercoordsys" "world" '
        'ObjectBegin "o" Material "conductor" Shape "disk" ObjectEnd ObjectInstance "o" Shape "disk"'
    )
    assert main(["convert", str(tmp_path / "a.pbrt"), str(tmp_path / "a.xml")]) == 0
    said = capsys.readouterr().out
    assert "a.xml: 2 shapes, 0 media, 0 lights" in said
    for words in (
        "camera 'realistic'",
        "shape 'curve'",
        "material 'hair'",
        "light 'goniometric'",
        "texture 't'",
        "instances of objects",
        "the option 'rendercoordsys'",
    ):
        assert words in said
    assert "conductor" not in said  # the material of an object ends with it


@pytest.mark.parametrize(("names", "outside"), [('"m" ""', ""), ('"m" "n"', "n"), ('"m"', "m")])
def test_a_medium_outside_of_a_shape_is_named(tmp_path: Path, capsys: pytest.CaptureFixture, names: str, outside: str) -> None:
    """One name is the medium on both sides."""
    medium = 'MakeNamedMedium "m" "string type" "homogeneous"'
    text = f'Camera "perspective" Film "rgb" WorldBegin {medium} MediumInterface {names} Shape "sphere"'
    (tmp_path / "a.pbrt").write_text(text)
    assert main(["convert", str(tmp_path / "a.pbrt"), str(tmp_path / "a.xml")]) == 0
    assert re.findall(r"the medium '(\w*)' outside of a shape", capsys.readouterr().out) == [outside] * bool(outside)


PATCH = [[0, 0, 2], [1, 0, 2], [0, 3, 2], [2, 3, 2]]
"""Corners of a bilinear patch: along its first axis, then along its second."""


@pytest.mark.parametrize(
    ("shape", "area", "low", "high"),
    [
        (f'"bilinearmesh" "point3 P" {numbers(PATCH)}', 4.5, (0, 0, 2), (2, 3, 2)),
        (f'"bilinearmesh" "point3 P" {numbers([PATCH[0], *PATCH])} "integer indices" [1 2 3 4]', 4.5, (0, 0, 2), (2, 3, 2)),
        (f'"trianglemesh" "point3 P" {numbers(PATCH[:3])}', 1.5, (0, 0, 2), (1, 3, 2)),
        (f'"trianglemesh" "point3 P" {numbers(PATCH)} "integer indices" [0 1 2 1 3 2]', 4.5, (0, 0, 2), (2, 3, 2)),
        ('"plymesh" "string filename" "m.ply"', 1.5, (0, 0, 2), (1, 3, 2)),
        ('"disk" "float radius" 2 "float height" 3', 4 * math.pi, (-2, -2, 3), (2, 2, 3)),
        ('"sphere" "float radius" 2', 16 * math.pi, (-2, -2, -2), (2, 2, 2)),
    ],
)
def test_shapes_keep_their_place_and_area(tmp_path: Path, shape: str, area: float, low: tuple, high: tuple) -> None:
    write_mesh(tmp_path / "m.ply", Mesh(np.array(PATCH[:3], np.float64), np.array([[0, 1, 2]])))
    (tmp_path / "a.pbrt").write_text(f"WorldBegin Translate 1 0 0 Shape {shape}")
    mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    (found,) = mi.load_file(str(tmp_path / "a.xml"), parallel=False).shapes()
    assert found.surface_area()[0] == pytest.approx(area, rel=1e-6)
    assert np.allclose([found.bbox().min, found.bbox().max], np.add([low, high], [1, 0, 0]), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("material", "kinds", "values"),
    [
        ('"dielectric" "float eta" 1.3', ["dielectric"], {"int_ior": 1.3}),
        ('"thindielectric"', ["thindielectric"], {"int_ior": 1.5}),
        ('"dielectric" "spectrum eta" "glass-BK7"', ["dielectric"], {"int_ior": 1.5}),
        ('"coateddiffuse" "float roughness" 0.04', ["twosided", "roughplastic"], {"alpha": 0.2}),
        ('"coateddiffuse" "rgb reflectance" [.1 .2 .3]', ["twosided", "plastic"], {"diffuse_reflectance": [0.1, 0.2, 0.3]}),
        ('"diffuse" "rgb reflectance" [.1 .2 .3]', ["twosided", "diffuse"], {"reflectance": [0.1, 0.2, 0.3]}),
        ('"interface"', ["null"], {}),
    ],
)
def test_materials(tmp_path: Path, material: str, kinds: list[str], values: dict) -> None:
    (tmp_path / "a.pbrt").write_text(f'WorldBegin Material {material} Shape "sphere"')
    mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    tree = ElementTree.parse(tmp_path / "a.xml")
    assert [node.get("type") for node in tree.iter("bsdf")] == kinds
    given = {node.get("name"): node.get("value") for bsdf in tree.iter("bsdf") for node in bsdf if node.get("value")}
    for name, value in values.items():
        words = [float(word) for word in given[name].replace(",", " ").split()]
        assert words == pytest.approx(np.ravel(value).tolist(), rel=1e-5)


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [
        ("Transform [1 0 0 0  0 2 0 0  0 0 3 0  4 5 6 1]", (3, 3, 3), (5, 7, 9)),
        ("Translate 4 5 6 Scale 1 2 3", (3, 3, 3), (5, 7, 9)),
        ("Translate 4 5 6 ConcatTransform [1 0 0 0  0 2 0 0  0 0 3 0  0 0 0 1]", (3, 3, 3), (5, 7, 9)),
        ("Rotate 90 0 0 1 Translate 3 0 0", (-1, 2, -1), (1, 4, 1)),
        ("Translate 9 9 9 Identity", (-1, -1, -1), (1, 1, 1)),
    ],
)
def test_transforms(tmp_path: Path, text: str, low: tuple, high: tuple) -> None:
    """Columns of a matrix are written one after the other; a later transform acts in the space of the earlier ones."""
    corners = numbers([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    shape = f'"trianglemesh" "point3 P" {corners} "integer indices" [0 1 2 3 4 5 6 7 0]'
    (tmp_path / "a.pbrt").write_text(f"WorldBegin {text} Shape {shape}")
    mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    (found,) = mi.load_file(str(tmp_path / "a.xml"), parallel=False).shapes()
    assert np.allclose([found.bbox().min, found.bbox().max], [low, high], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Shapes", "the directive 'Shapes'"),
        ("Scale 1 2", "3 numbers after Scale"),
        ("AttributeEnd", "AttributeEnd without a beginning"),
        ("ObjectEnd", "the directive 'ObjectEnd'"),
        ('Shape "sphere" "float radius" [ 1', "a closing bracket"),
        ('Shape "sphere" "float" 1', "a type and a name in quotes"),
        ('Shape "sphere" "float radius" [ a ]', "in line 1, expected numbers"),
        ('MakeNamedMedium "m" "string type" "fog"', "the medium 'm' of type 'fog'"),
        ('MakeNamedMedium "m" "string type" "homogeneous" "string preset" "Coke"', "the preset 'Coke'"),
        ('MakeNamedMedium "m" "string type" "uniformgrid" "integer nx" 2 "float density" [1]', "1 numbers density"),
        ('MakeNamedMedium "m" "string type" "rgbgrid"', "without sigma_a and sigma_s"),
        ('MakeNamedMedium "m" "string type" "homogeneous" "float sigma_a" -1', "coefficients of the medium 'm' below 0"),
        ('Include "a.pbrt"', "more than 16 files within each other"),
    ],
)
def test_bad_scenes_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "a.pbrt").write_text(text)
    with refused(words):
        mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.xml")
    assert not (tmp_path / "a.xml").exists()


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    with refused("the suffix '.json'"):
        mivol.convert_pbrt(tmp_path / "a.pbrt", tmp_path / "a.json")
