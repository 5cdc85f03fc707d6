"""Written files of Gaussians: what is read back is within the steps of the format, and other programs read the same.

Tolerances are half a step of each format; the readers are tested by encoders of their own in ``test_splat_formats.py``.
"""

from __future__ import annotations

import io
import json
import shutil
import subprocess
from pathlib import Path

import browser
import drjit as dr
import mitsuba as mi
import numpy as np
import PIL.Image
import pytest
from browser import start_browser
from gaussian_sets import random_gaussians
from refusals import assert_refused
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from mivol.experiments.render import make_camera
from mivol.fields.surfaces import interpolate_corners
from mivol.files.image_files import decode_srgb
from mivol.files.mesh import Atlas, Mesh, read_accessor, read_glb, turn_to_y, write_mesh
from mivol.photos.camera_path import HomeView
from mivol.points import Gaussians
from mivol.points.gaussian_files import GAUSSIAN_WRITERS, read_gaussians, turn_half, write_gaussians
from mivol.points.sog import fit_palette, fit_table, morton_order
from mivol.splatting import Splatter, to_tensors

SUFFIXES = (".spz", ".splat", ".ksplat", ".sog", ".glb")
DEGREES = {".splat": 0, ".ksplat": 2}
"""Highest degree of a format; 3 for the others."""

COUNT = 300


def written(tmp_path: Path, suffix: str, degree: int = 3) -> tuple[Gaussians, Gaussians]:
    """Gaussians, and what is read of their file, in the same order."""
    one = random_gaussians(COUNT, min(degree, DEGREES.get(suffix, 3)))
    write_gaussians(tmp_path / f"a{suffix}", one)
    read = read_gaussians(tmp_path / f"a{suffix}")
    return one, read.select(cKDTree(read.means).query(one.means)[1])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_numbers_are_within_the_steps_of_the_format(tmp_path: Path, suffix: str) -> None:
    """Positions: 2^-13 (.spz), 16 bits of log(1 + |x|) <= log 2 with slope <= 2 (.sog). Scales: 1/32 (.spz), a table of 256
    values of which 128 are evenly spaced over 3 (.sog). Opacities: half a byte. Axes: an error of e in each entry of a unit
    quaternion turns by at most 2 sqrt(4) e; e is half a step of each format, and the third entry's error is that of the
    others, at most sqrt(3) times theirs where the largest entry is at least 1/2."""
    one, read = written(tmp_path, suffix)
    position = {".spz": 2.0**-13, ".sog": 2 * 2 * np.log(2) / 65535 / 2}.get(suffix, 0)
    scale = {".spz": 1 / 32, ".sog": 3 / 127 / 2}.get(suffix, 0)
    colour = {".spz": 0.5 / 255 / 0.15, ".splat": 0.5 / 255 / 0.2820948, ".ksplat": 0.5 / 255 / 0.2820948, ".sog": 1 / 127 / 2}
    step = {".spz": 0.5 / 511 / np.sqrt(2), ".splat": 0.5 / 128 + 1 / 128, ".sog": 1 / 255 / np.sqrt(2)}.get(suffix, 0)
    assert np.abs(read.means - one.means).max() <= position + 1e-6
    assert np.abs(read.log_scales - one.log_scales).max() <= scale + 1e-6
    assert np.abs(read.opacities() - one.opacities()).max() <= (0 if suffix == ".glb" else 0.5 / 255) + 1e-6
    assert np.abs(read.harmonics[:, 0] - one.harmonics[:, 0]).max() <= colour.get(suffix, 0) + 1e-6
    assert np.abs(read.rotations() - one.rotations()).max() <= 2 * 2 * np.sqrt(3) * step + 1e-5


@pytest.mark.parametrize("suffix", [".spz", ".ksplat", ".sog", ".glb"])
def test_higher_harmonics_keep_their_places(tmp_path: Path, suffix: str) -> None:
    """Half of 1/128 (.spz); a table of 256 values of which 128 are evenly spaced over 1 (.sog)."""
    one, read = written(tmp_path, suffix)
    bound = {".spz": 0.5 / 128, ".sog": 1 / 127 / 2}.get(suffix, 0)
    assert read.degree == one.degree and np.abs(read.harmonics - one.harmonics)[:, 1:].max() <= bound + 1e-6


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_gaussians_give_the_same_file(tmp_path: Path, suffix: str) -> None:
    one = random_gaussians(20, 0)
    for name in "ab":
        write_gaussians(tmp_path / f"{name}{suffix}", one)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_what_a_format_cannot_hold_is_said(tmp_path: Path) -> None:
    for suffix, degree in DEGREES.items():
        with pytest.warns(RuntimeWarning, match=f"up to degree {degree}"):
            write_gaussians(tmp_path / f"a{suffix}", random_gaussians(5, 3))


def test_names_that_are_not_written_are_refused(tmp_path: Path) -> None:
    assert_refused("read only", write_gaussians, tmp_path / "a.compressed.ply", random_gaussians(5, 0))
    for suffix in sorted(GAUSSIAN_WRITERS.keys() - {".ply"}):
        assert_refused(f"a{suffix}: found no Gaussians", write_gaussians, tmp_path / f"a{suffix}", random_gaussians(0, 0))


def test_2d_gaussians_are_refused_by_name(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", random_gaussians(5, 0))
    data = (tmp_path / "a.ply").read_bytes().replace(b"property float scale_2\n", b"property float extra_2\n")
    (tmp_path / "a.ply").write_bytes(data)
    assert_refused("found 2D Gaussians", read_gaussians, tmp_path / "a.ply")


# -- glTF ----------------------------------------------------------------------------------------------------------------


def test_half_a_turn_turns_everything(variant_rgb: str) -> None:
    """Covariances by the matrix, colours by their values along turned directions; twice is the same."""
    one, matrix = random_gaussians(20, 3), np.diag([-1.0, -1.0, 1.0])
    turned = turn_half(one)
    assert np.allclose(turned.covariances(), matrix @ one.covariances() @ matrix, atol=1e-6)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)

    def basis(directions: np.ndarray) -> np.ndarray:
        values = dr.sh_eval(mi.Vector3f(*np.float32(directions.T)), 3)
        return np.stack([np.broadcast_to(np.array(value), len(directions)) for value in values], axis=1)

    before = np.einsum("db,nbc->dnc", basis(d), one.harmonics)
    assert np.allclose(np.einsum("db,nbc->dnc", basis(d @ matrix), turned.harmonics), before, atol=1e-5)
    again = turn_half(turned)
    assert np.allclose(again.means, one.means) and np.allclose(again.rotations(), one.rotations(), atol=1e-6)


def test_a_glb_says_what_the_extension_asks(tmp_path: Path) -> None:
    one = random_gaussians(7, 1)
    write_gaussians(tmp_path / "a.glb", one)
    document, data = read_glb(tmp_path / "a.glb")
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    names = primitive["attributes"]
    assert {"POSITION", "COLOR_0", "KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"} < names.keys() and len(names) == 9
    quaternions = read_accessor(tmp_path / "a.glb", document, data, names["KHR_gaussian_splatting:ROTATION"])
    assert np.allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
    opacity = read_accessor(tmp_path / "a.glb", document, data, names["KHR_gaussian_splatting:OPACITY"])
    assert np.allclose(opacity[:, 0], one.opacities())


def test_a_mesh_keeps_its_colours_as_linear_light_and_its_up(tmp_path: Path) -> None:
    points, faces = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])
    colours = np.array([[0, 0.5, 1.0]] * 3)
    write_mesh(tmp_path / "a.glb", Mesh(points, faces, colours=colours, up=(0.0, 0.0, 1.0)))
    document, data = read_glb(tmp_path / "a.glb")
    names = document["meshes"][0]["primitives"][0]["attributes"]
    stored = read_accessor(tmp_path / "a.glb", document, data, names["COLOR_0"])
    assert np.abs(stored[:, :3] - decode_srgb(colours)).max() <= 0.5 / 65535 + 1e-7 and (stored[:, 3] == 1).all()
    assert np.allclose(read_accessor(tmp_path / "a.glb", document, data, names["POSITION"]), points)
    for up in ((0.0, 0.0, 1.0), (0.3, -2.0, 0.5), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)):
        x, y, z, w = turn_to_y(up)
        axis, v = np.array([x, y, z]), np.array(up) / np.linalg.norm(up)
        assert np.allclose(v + 2 * np.cross(axis, np.cross(axis, v) + w * v), [0, 1, 0], atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 7, 40])
def test_a_texture_of_a_glb_is_linear_in_each_triangle(tmp_path: Path, count: int) -> None:
    """Random colours at the corners: linear interpolation between texels, as of a graphics card, gives their linear mean in the
    whole triangle. Texels are rounded to 8 bits; positions are in float32, an error of 2^-24 of up to 40 texels."""
    rng = np.random.default_rng(count)
    points, colours = rng.normal(size=(3 * count, 3)), rng.uniform(0.35, 0.65, (3 * count, 3))
    faces = rng.permutation(3 * count).reshape(-1, 3)
    atlas = Atlas.of(count)
    image = atlas.paint(lambda numbers, weights: interpolate_corners(colours, faces[numbers], weights))
    write_mesh(tmp_path / "a.glb", Mesh(points, faces, colours=colours, texture=image))
    document, data = read_glb(tmp_path / "a.glb")
    primitive, view = document["meshes"][0]["primitives"][0], document["bufferViews"][document["images"][0]["bufferView"]]
    assert "COLOR_0" not in primitive["attributes"]  # glTF multiplies it with the texture
    packed = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    texels = np.asarray(PIL.Image.open(io.BytesIO(packed)), np.float64) / 255
    names = primitive["attributes"]
    uv, stored = (read_accessor(tmp_path / "a.glb", document, data, names[name]) for name in ("TEXCOORD_0", "POSITION"))
    corners = read_accessor(tmp_path / "a.glb", document, data, primitive["indices"]).reshape(-1, 3)
    assert np.allclose(stored[corners], points[faces])
    weights = rng.dirichlet([0.5] * 3, (count, 50))
    places = np.einsum("npc,ncd->npd", weights, uv[corners]).reshape(-1, 2) * texels.shape[1::-1] - 0.5
    nodes = np.clip(places[:, ::-1].T, 0, np.array(texels.shape[:2])[:, None] - 1)
    shown = np.stack([map_coordinates(channel, nodes, order=1) for channel in np.moveaxis(texels, 2, 0)], axis=1)
    expected = np.einsum("npc,ncd->npd", weights, colours[faces]).reshape(-1, 3)
    assert np.abs(shown - expected).max() <= 0.5 / 255 + 1e-4
    assert_refused("--resolution", Atlas.of, 3_000_000)


# -- SOG -----------------------------------------------------------------------------------------------------------------


def test_few_values_are_kept_exactly() -> None:
    values = np.float32(np.random.default_rng(0).choice([-1.5, 0, 2.25, 7], 1000))
    table, codes = fit_table(values)
    assert np.array_equal(table[codes], values)


def test_a_table_is_as_fine_as_even_steps() -> None:
    """128 of 256 first entries are evenly spaced, and Lloyd's rounds only lower the mean squared error."""
    values = np.random.default_rng(0).standard_t(2, 20_000)
    table, codes = fit_table(values)
    assert (np.diff(table) >= 0).all() and ((table[codes] - values) ** 2).mean() < (np.ptp(values) / 127) ** 2 / 12


def test_large_sets_of_harmonics_share_a_palette(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of 10 clusters, far more than the palette holds: each is as near as its cluster is wide. The most points that are
    kept as they are, and one more, which makes the palette."""
    monkeypatch.setattr("mivol.points.sog.MOST", 5000)
    monkeypatch.setattr("mivol.points.sog.FEWER", 100)
    rng = np.random.default_rng(0)
    rows = np.float32(rng.integers(0, 10, 5001)[:, None] * 10 + rng.normal(0, 0.1, (5001, 3)))
    palette, numbers = fit_palette(rows)
    assert len(palette) == 100 and np.abs(palette[numbers] - rows).max() < 1
    palette, numbers = fit_palette(rows[:-1])
    assert np.array_equal(palette[numbers], rows[:-1])


def test_neighbours_on_the_curve_are_neighbours_in_space() -> None:
    places = np.random.default_rng(0).uniform(size=(4000, 3))
    steps = np.linalg.norm(np.diff(places[morton_order(places)], axis=0), axis=1)
    assert np.median(steps) < 0.12  # random neighbours are 0.66 apart on average, nearest ones 4000^(-1/3) / 2 = 0.03


# -- The page ------------------------------------------------------------------------------------------------------------

VIEW = HomeView((0.0, 0.0, 1.0), (3.0, -4.0, 2.0), (0.0, 0.0, 0.0), 40.0, browser.SIZE)


def test_a_page_needs_nothing_else(tmp_path: Path) -> None:
    one = random_gaussians(7, 2)
    write_gaussians(tmp_path / "a.html", one, VIEW)
    text = (tmp_path / "a.html").read_text()
    assert "http" not in text and "src=" not in text
    about = json.loads(text.partition('id="about">')[2].partition("</script>")[0])
    assert (about["count"], about["degree"], about["view"]["fov"]) == (7, 2, 40.0)


@pytest.mark.slow
@pytest.mark.skipif(browser.PROGRAM is None, reason="needs Chromium (apt install chromium)")
@pytest.mark.parametrize("degree", [0, 3])
def test_the_page_shows_what_mivol_shows(tmp_path: Path, variant_rgb: str, artefacts: Path, degree: int) -> None:
    """Picture of the page beside the splatter's. Steps of opacity, colour and blending are up to 1/255 each, and about ten
    Gaussians lie behind a pixel: 35 dB is a root mean square of 4.5 such steps. Then a drag turns the picture."""
    one = random_gaussians(2000, degree)
    write_gaussians(tmp_path / "a.html", one, VIEW)
    camera = make_camera([*VIEW.origin, *VIEW.target], VIEW.up, VIEW.fov, VIEW.size)
    wanted = np.array(Splatter(*VIEW.size, degree).forward(to_tensors(one), camera, derivatives=False)[0])[..., :3]
    with start_browser() as started:
        tab = started.tab((tmp_path / "a.html").as_uri() + "#still")
        tab.wait_for("typeof sorted !== 'undefined' && sorted !== null")
        shown = tab.screenshot(artefacts / "page.png")
        tab.drag((300, 300), (450, 330))
        tab.wait_for("!turning")
        turned = tab.screenshot(artefacts / "turned.png")
        assert tab.errors == []
    rows = slice(0, 660)  # the line of help is below
    error = (shown[rows] / 255 - np.clip(wanted[rows], 0, 1)).astype(np.float64)
    assert -10 * np.log10((error**2).mean()) > 35
    assert (np.abs(turned.astype(int) - shown) > 30).mean() > 0.02


# -- splat-transform -----------------------------------------------------------------------------------------------------

PEER = shutil.which("splat-transform")
"""PlayCanvas' converter: npm install -g @playcanvas/splat-transform."""


@pytest.mark.slow
@pytest.mark.skipif(PEER is None, reason="needs splat-transform (npm install -g @playcanvas/splat-transform)")
@pytest.mark.parametrize("suffix", [".spz", ".splat", ".ksplat", ".sog"])
def test_splat_transform_reads_the_same(tmp_path: Path, suffix: str) -> None:
    """Its decoder of .splat takes 2 q / 255 - 1 for quaternions, ours q / 128 - 1: half a step more."""
    _, read = written(tmp_path, suffix)
    subprocess.run([PEER, "-q", tmp_path / f"a{suffix}", tmp_path / "peer.ply"], check=True)
    peer = read_gaussians(tmp_path / "peer.ply")
    peer = peer.select(cKDTree(peer.means).query(read.means)[1])
    assert np.abs(peer.means - read.means).max() < 1e-5 and np.abs(peer.harmonics - read.harmonics).max() < 1e-5
    assert np.abs(peer.rotations() - read.rotations()).max() < (0.03 if suffix == ".splat" else 1e-5)
    assert np.abs(peer.opacities() - read.opacities()).max() < 1e-5


@pytest.mark.slow
@pytest.mark.skipif(PEER is None, reason="needs splat-transform (npm install -g @playcanvas/splat-transform)")
def test_a_glb_of_splat_transform_is_read(tmp_path: Path) -> None:
    one = random_gaussians(50, 3)
    write_gaussians(tmp_path / "a.ply", one)
    subprocess.run([PEER, "-q", tmp_path / "a.ply", tmp_path / "peer.glb"], check=True)
    read = read_gaussians(tmp_path / "peer.glb")
    assert np.allclose(read.means, one.means, atol=1e-6) and np.allclose(read.harmonics, one.harmonics, atol=1e-6)
    assert np.allclose(read.rotations(), one.rotations(), atol=1e-5)


def test_a_table_is_near_every_value() -> None:
    """Of 2000 even values, those at the ends included: each lies in a cell that is narrower than 1 / 256."""
    values = np.linspace(0, 1, 2000)
    table, codes = fit_table(values)
    assert np.abs(table[codes] - values).max() < 1 / 256


# -- Other programs ----------------------------------------------------------------------------------------------------

ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics")


@pytest.mark.parametrize("degree", [0, 3])
def test_mitsuba_opens_what_is_written(variant_rgb: str, tmp_path: Path, degree: int) -> None:
    """Mitsuba holds centre, scale, unit quaternion (x, y, z, w), opacity and coefficients in float32: activations are rounded
    some eight times, 8 * 2^-24 of numbers not above 1; the rest are the same numbers."""
    one = random_gaussians(6, degree)
    write_gaussians(tmp_path / "a.ply", one)
    held = mi.traverse(mi.load_dict({"type": "ellipsoids", "filename": str(tmp_path / "a.ply")}))
    means, scales, quaternions = np.split(np.array(held["data"]).reshape(6, 10), [3, 6], axis=1)
    assert np.array_equal(means, one.means)
    assert np.abs(scales - one.scales()).max() <= 8 * 2**-24
    unit = one.quaternions / np.linalg.norm(one.quaternions, axis=1, keepdims=True)
    assert np.abs(np.roll(quaternions, 1, axis=1) - unit).max() <= 8 * 2**-24
    assert np.abs(np.array(held["opacities"]).ravel() - one.opacities()).max() <= 8 * 2**-24
    assert np.array_equal(np.array(held["sh_coeffs"]).reshape(one.harmonics.shape), one.harmonics)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_opens_what_is_written(tmp_path: Path, degree: int) -> None:
    """It writes the same PLY again to the bit; its compressed PLY and SPZ are read here within half a step of positions: in a
    box of at most 2 in 10 bits, and 2^-12."""
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("splat-transform is not on the PATH: npm install --global @playcanvas/splat-transform")
    one = random_gaussians(300, degree)
    write_gaussians(tmp_path / "a.ply", one)
    for name in ("b.ply", "b.compressed.ply", "b.spz"):
        subprocess.run([program, tmp_path / "a.ply", tmp_path / name], check=True, timeout=60, capture_output=True)
    again = read_gaussians(tmp_path / "b.ply")
    assert all(np.array_equal(getattr(again, name), getattr(one, name)) for name in ARRAYS)
    for name, bound in (("b.compressed.ply", 1 / 1023), *((("b.spz", 2**-13),) if has_zstandard() else ())):
        packed = read_gaussians(tmp_path / name)
        apart = np.abs(packed.means[:, None] - one.means).max(axis=2)
        assert len(set(apart.argmin(axis=1))) == 300
        assert apart.min(axis=1).max() <= bound + 1e-6


def has_zstandard() -> bool:
    """Whether an SPZ of version 4 can be read."""
    try:
        import zstandard  # noqa: F401
    except ImportError:
        return False
    return True
