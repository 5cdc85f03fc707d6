"""Fisheyes and panoramas: directions against independent formulas, files of cameras, and rays of a fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import capture_photos
import mitsuba as mi
import numpy as np
import pytest
from photo_sets import COLMAP_CAMERAS, look_at, ring, write_colmap, write_transforms
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.experiments.field_fit import explain_wide_lenses
from mivol.optim.loop import reconstruct
from mivol.optim.photographs.field_view import render_view
from mivol.optim.photographs.radiance_plan import PRESETS, RadianceStage
from mivol.optim.photographs.radiance_problem import RadianceProblem
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Camera, Lens, Photo, load_photos, pixel_centres, project, rays, rectify, survey_photos, turntable
from mivol.photos.camera import directions, field_of_view, intrinsics, is_seen
from mivol.photos.camera_path import WIDE
from mivol.photos.dataset import to_pinhole
from mivol.photos.lens import Fisheye, Panorama
from mivol.photos.region import count_views, find_focus, silhouette_box
from mivol.photos.transforms import write_transforms as write_cameras
from mivol.report.cameras import frustum_edges
from mivol.scene.sensors import to_sensor
from mivol.splatting.projection import pack_view

LENS = Fisheye(-0.01, 0.0005, 0.00002, 0.000001)
"""Of the size of what calibrations of fisheyes give. Its slope, 1 - 0.03 t^2 + 0.0025 t^4 and more, is above 0 at any t."""

PLACE = look_at(np.array([3.0, -2.0, 1.0]))


def fisheye(size: tuple[int, int] = (48, 48), lens: Fisheye = LENS, pose: np.ndarray = PLACE) -> Camera:
    """Its image circle has 24 pixels' radius at about 1.5 radian and more, so that corners may lie outside."""
    return Camera(intrinsics(16, 17, size[0] / 2 + 0.5, size[1] / 2), size, pose, lens, "fish")


def panorama(size: tuple[int, int] = (64, 32), pose: np.ndarray = PLACE) -> Camera:
    return Camera(intrinsics(size[0] / (2 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2), size, pose, Panorama(), "pano")


# -- Lenses -------------------------------------------------------------------------------------------------------


def test_fisheye_against_its_polynomial() -> None:
    """Directions by angles from and about the axis: the image radius is the polynomial, on the same side."""
    rng = np.random.default_rng(1)
    theta, phi = rng.uniform(0, 3, 200), rng.uniform(-np.pi, np.pi, 200)
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    radius = theta - 0.01 * theta**3 + 0.0005 * theta**5 + 0.00002 * theta**7 + 0.000001 * theta**9
    wanted = np.stack([radius * np.cos(phi), radius * np.sin(phi)], axis=-1)
    # Angles near 3 have a sine of 0.14: 1e-16 in a component turns them by 1e-15.
    np.testing.assert_allclose(LENS.point(2.5 * d), wanted, atol=1e-14)


@pytest.mark.parametrize("lens", [Fisheye(), LENS, Fisheye(k1=-0.1)])
def test_fisheye_directions_invert_points(lens: Fisheye) -> None:
    """The root of the polynomial to 1e-14; near the rim of the third lens a slope of 1/100 loses two digits."""
    angles = np.linspace(-1, 1, 41) * 0.99 * lens.widest
    d = np.stack([np.sin(angles) * 0.6, np.sin(angles) * 0.8, np.cos(angles)], axis=-1)
    np.testing.assert_allclose(lens.direction(lens.point(d)), d, atol=2e-12)
    np.testing.assert_array_equal(lens.direction(np.zeros(2)), [0, 0, 1])


def test_a_fisheye_ends_at_the_fold_of_its_image() -> None:
    """t - t^3 / 12 grows up to t = 2, to 4/3; points beyond get the direction at the rim."""
    lens = Fisheye(k1=-1 / 12)
    assert lens.widest == pytest.approx(2)
    assert Fisheye().widest == np.pi
    rim = float(lens.radius(np.float64(lens.widest)))
    np.testing.assert_array_equal(lens.sees(np.array([[1.33, 0], [0, -1.34], [rim, 0]])), [True, False, True])
    np.testing.assert_allclose(lens.direction(np.array([0, -5.0])), [0, -np.sin(2), np.cos(2)], atol=1e-7)
    beyond = np.array([np.sin(2.01), 0, np.cos(2.01)])
    assert np.isnan(lens.point(beyond)).all()
    assert np.isfinite(lens.point(np.array([np.sin(1.99), 0, np.cos(1.99)]))).all()


def test_pixels_of_a_panorama() -> None:
    """The centre looks along -z, a quarter to the right along +x, the top up; the pose rotates all directions."""
    camera = panorama(pose=np.eye(4))
    at = np.array([[32.0, 16], [48, 16], [16, 16], [32, 0], [32, 32], [0, 16]])
    wanted = [[0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]
    np.testing.assert_allclose(directions(camera, at), wanted, atol=1e-15)
    turned = panorama()
    np.testing.assert_allclose(rays(turned, at[0])[1], turned.forward, atol=1e-15)
    assert is_seen(turned, pixel_centres(turned.size)).all()
    assert not is_seen(turned, np.array([3.0, -0.1]))


@pytest.mark.parametrize("camera", [fisheye(), panorama()], ids=["fisheye", "panorama"])
def test_project_inverts_rays_of_wide_lenses(camera: Camera) -> None:
    pixel = pixel_centres(camera.size)[is_seen(camera, pixel_centres(camera.size))]
    o, d = rays(camera, pixel)
    back, distance = project(camera, o + 2.5 * d)
    # 64 pixels with 1e-16 each, and angles near pi have a sine of 0.1.
    np.testing.assert_allclose(back, pixel, atol=1e-11)
    np.testing.assert_allclose(distance, 2.5, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1, atol=1e-15)
    half = camera.resized(tuple(n // 2 for n in camera.size))
    np.testing.assert_allclose(rays(half, pixel / 2)[1], d, atol=1e-13)
    assert (count_views([camera, camera], o + 2.5 * d) == 2).all()


def test_fields_of_view() -> None:
    assert field_of_view(panorama()) == pytest.approx(360)
    assert field_of_view(Camera(intrinsics(20, 20, 20, 15), (40, 30), np.eye(4))) == pytest.approx(90)
    # The equidistant projection: an angle is a length, of 24.5 and 23.5 pixels at 16 a radian.
    assert field_of_view(fisheye(lens=Fisheye())) == pytest.approx(np.degrees(48 / 16))
    # Both ends lie beyond the rim, at 2 radian. The root's residual of 1e-14 moves an angle by its square root, where the
    # slope is 0.
    assert field_of_view(fisheye(lens=Fisheye(k1=-1 / 12))) == pytest.approx(np.degrees(4), abs=np.degrees(4e-7))


def test_fisheyes_and_pinholes_have_the_same_focus() -> None:
    pinholes = [Camera(intrinsics(50, 50, 24, 24), (48, 48), pose) for pose in ring(5)]
    np.testing.assert_allclose(find_focus([replace(c, distortion=LENS) for c in pinholes]), find_focus(pinholes), atol=1e-14)
    around = [panorama(pose=pose) for pose in ring(5)]
    np.testing.assert_allclose(find_focus(around), np.mean([c.origin for c in around], axis=0), atol=1e-14)


def test_films_of_wide_lenses_use_pinholes() -> None:
    film = turntable([fisheye(pose=pose) for pose in ring(6)], np.array([[-1.0] * 3, [1.0] * 3]), 4)
    assert all(camera.distortion == Lens() and field_of_view(camera) == pytest.approx(WIDE) for camera in film)


def test_a_wide_camera_is_drawn_with_90_degrees() -> None:
    """Opposite edges: (1, 1, -1) and (-1, 1, -1) times the length are 2 apart."""
    ends = frustum_edges(type("Frame", (), {"camera": panorama(pose=np.eye(4))}), 0.5)[:4, 1]
    np.testing.assert_allclose(np.abs(ends), 0.5)
    assert len({tuple(np.sign(end)) for end in ends}) == 4


# -- Files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["bin", "txt"])
@pytest.mark.parametrize(
    ("model", "parameters", "lens"),
    [
        ("OPENCV_FISHEYE", (50.0, 55.0, 31.0, 22.0, 0.07, -0.04, 0.002, -0.003), Fisheye(0.07, -0.04, 0.002, -0.003)),
        ("SIMPLE_RADIAL_FISHEYE", (50.0, 31.0, 22.0, 0.07), Fisheye(0.07)),
        ("RADIAL_FISHEYE", (50.0, 31.0, 22.0, 0.07, -0.04), Fisheye(0.07, -0.04)),
        ("SIMPLE_FISHEYE", (50.0, 31.0, 22.0), Fisheye()),
        ("FISHEYE", (50.0, 55.0, 31.0, 22.0), Fisheye()),
    ],
)
def test_colmap_fisheyes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str, parameters: tuple, lens: Fisheye, encoding: str
) -> None:
    monkeypatch.setitem(COLMAP_CAMERAS, model, parameters)
    survey = survey_photos(write_colmap(tmp_path / "set", model, encoding))
    camera = survey.frames[1].camera
    assert camera.distortion == lens
    np.testing.assert_array_equal(camera.K, intrinsics(50, 55 if 55.0 in parameters else 50, 31, 22))
    assert "48 pixels, fisheye" in survey.describe()


@pytest.mark.parametrize("encoding", ["bin", "txt"])
def test_colmap_panoramas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    monkeypatch.setitem(COLMAP_CAMERAS, "EQUIRECTANGULAR", (64.0, 48.0))
    survey = survey_photos(write_colmap(tmp_path / "set", "EQUIRECTANGULAR", encoding))
    np.testing.assert_array_equal(survey.frames[1].camera.K, intrinsics(64 / (2 * np.pi), 48 / np.pi, 32, 24))
    assert "48 pixels, panorama" in survey.describe()


def test_cameras_of_nerfstudio_and_instant_ngp(tmp_path: Path) -> None:
    given = {"fl_x": 9.0, "fl_y": 8.0, "k1": 0.01, "k4": -0.001}
    for name, settings in {"a": {"camera_model": "OPENCV_FISHEYE"}, "b": {"is_fisheye": True}}.items():
        camera = survey_photos(write_transforms(tmp_path / name, given | settings)).frames[0].camera
        assert camera.distortion == Fisheye(k1=0.01, k4=-0.001)
        np.testing.assert_array_equal(camera.K, intrinsics(9, 8, 6, 4))
    around = survey_photos(write_transforms(tmp_path / "c", {"camera_model": "EQUIRECTANGULAR", "fl_x": 7}, (16, 8)))
    np.testing.assert_allclose(around.frames[0].camera.K, panorama((16, 8)).K)
    assert "panorama" in around.describe() and "horizontal field of view 360 degrees" in around.describe()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, r"a panorama of 12 x 8 pixels, expected an image twice as wide as high"),
        ({"camera_model": "OPENCV_FISHEYE", "fl_x": 9, "p1": 0.1}, "_FISHEYE with p1 = 0.1, expected only k1, k2, k3, k4"),
        ({"camera_model": "THIN_PRISM_FISHEYE", "fl_x": 9}, "camera_model THIN_PRISM_FISHEYE, expected .*OPENCV_FISHEYE"),
        ({"camera_model": ["OPENCV"], "fl_x": 9}, r"camera_model \['OPENCV'\], expected one of OPENCV"),
        ({"equirectangular": True, "fl_x": 9}, "found equirectangular = True, expected one of"),
    ],
)
def test_invalid_wide_cameras_are_refused(tmp_path: Path, settings: dict, said: str) -> None:
    assert_refused(said, survey_photos, write_transforms(tmp_path / "set", settings))


@pytest.mark.parametrize("camera", [fisheye(), panorama()], ids=["fisheye", "panorama"])
def test_written_wide_cameras_are_read_unchanged(tmp_path: Path, camera: Camera) -> None:
    folder = write_transforms(tmp_path / "set", {"fl_x": 1}, camera.size, 2)
    made = {f"images/{k:04d}.png": replace(camera, to_world=pose) for k, pose in enumerate(ring(2))}
    write_cameras(folder / "transforms.json", made)
    for frame, wanted in zip(survey_photos(folder).frames, made.values(), strict=True):
        assert frame.camera.distortion == camera.distortion
        np.testing.assert_allclose(frame.camera.K, camera.K, rtol=1e-15)
        np.testing.assert_allclose(frame.camera.to_world, wanted.to_world, atol=1e-15)
    with pytest.raises(MivolError, match="the camera models OPENCV, OPENCV_FISHEYE, expected a single model per file"):
        write_cameras(folder / "transforms.json", {"a": fisheye(), "b": replace(fisheye(), distortion=Lens())})


def test_pixels_outside_the_image_circle_are_masked(tmp_path: Path) -> None:
    """At 8 pixels per radian the circle of an equidistant fisheye has a radius of 8 pi pixels, inside the corners."""
    lens = {"camera_model": "OPENCV_FISHEYE", "fl_x": 8.0, "fl_y": 8.0}
    (view, *_) = load_photos(write_transforms(tmp_path / "set", lens, (48, 40))).views
    x, y = np.moveaxis(pixel_centres((48, 40)) - (24, 20), -1, 0)
    np.testing.assert_array_equal(view.mask, np.hypot(x, y) <= 8 * np.pi)
    assert not view.mask.all()
    narrow = load_photos(write_transforms(tmp_path / "narrow", lens | {"fl_x": 80.0, "fl_y": 80.0})).views[0]
    assert narrow.mask is None


# -- What they are used for ---------------------------------------------------------------------------------------


def photo(camera: Camera) -> Photo:
    """What a camera among the walls of :mod:`capture_photos` sees."""
    seen = is_seen(camera, pixel_centres(camera.size))
    mask = None if seen.all() else seen
    return Photo(camera.name, np.float32(capture_photos.trace_image(camera)), None, mask, camera, np.zeros(3, np.float32))


def test_batches_have_the_rays_of_each_lens(variant_rgb: str) -> None:
    """A fisheye, a pinhole, another fisheye and a panorama in one data set, in two sizes."""
    poses = [camera.to_world for camera in capture_photos.cameras(4)]
    pinhole = Camera(intrinsics(40, 40, 24, 24), (48, 48), poses[1])
    other = fisheye(lens=Fisheye(k1=0.01), pose=poses[2])
    cameras = [fisheye(pose=poses[0]), pinhole, other, fisheye(pose=poses[3]), panorama()]
    batches = RayBatches.from_photos([photo(camera) for camera in cameras], (1, 2))
    for shrink in (1, 2):
        for number, camera in enumerate(cameras):
            found = batches.all_pixels(shrink, number)
            wanted = np.float32(rays(camera.resized(tuple(n // shrink for n in camera.size)), by_tiles(camera, shrink))[1])
            # float32 directions of three rounded products and sums, normalised: a few times 6e-8.
            np.testing.assert_allclose(np.array(found.rays.d).T, wanted, atol=4e-7)
            np.testing.assert_allclose(np.array(found.rays.o).T[:1], camera.origin[None], rtol=1e-7, atol=1e-7)
    # Three lenses, two of which are one in two places, at both sizes: rays of 2 x 48^2 and 64 x 32 pixels, of 12 bytes each.
    few = RayBatches.from_photos([photo(pinhole)] * 5, (1, 2))
    tables = batches.bytes - sum(len(level.codes) for level in batches.levels.values())
    assert tables == 12 * (2 * 48**2 + 64 * 32) * 5 // 4
    assert all(level.wide is None for level in few.levels.values())
    shown = [photo(camera) for camera in cameras]
    shown[0] = replace(shown[0], camera=replace(cameras[0], distortion=Fisheye(k1=-0.03)))
    assert RayBatches.from_photos(shown, (1, 2)).digest() != batches.digest()


def by_tiles(camera: Camera, shrink: int) -> np.ndarray:
    """Pixel centres in the order of :meth:`RayBatches.whole`: tiles of 4 x 4, row by row."""
    width, height = (n // shrink for n in camera.size)
    centres = pixel_centres((width, height)).reshape(height // 4, 4, width // 4, 4, 2)
    return centres.swapaxes(1, 2).reshape(-1, 2)


def test_functions_of_an_image_plane_refuse_wide_lenses(variant_rgb: str) -> None:
    camera = fisheye()
    assert_refused("fish: found a fisheye, expected a lens with an image plane", to_pinhole, camera)
    assert_refused("fish: .*cut pinholes out of it", to_sensor, camera)
    assert_refused("fish: .*cut pinholes out of it", pack_view, camera, camera.size)
    shown = photo(camera)
    assert rectify(shown) is shown
    with pytest.raises(MivolError, match="fish: found a wide lens, expected cameras with an image plane"):
        silhouette_box([camera], [np.ones((48, 48), np.float32)], np.zeros((2, 3)))


def test_the_plan_names_wide_photographs() -> None:
    (line,) = explain_wide_lenses(type("Photos", (), {"views": [photo(fisheye()), photo(fisheye())]}))
    assert line.choice == "rays of 2 fisheye photographs"
    assert not explain_wide_lenses(type("Photos", (), {"views": [photo(Camera(intrinsics(40, 40, 4, 4), (8, 8), PLACE))]}))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [fisheye, panorama])
def test_a_place_is_reconstructed_from_wide_photographs(variant_rgb: str, kind: object) -> None:
    """Held-out views of the same lens: the best single colour has the variance of the images as its error, about 0.07.

    The field must have a tenth of this error (0.002 to 0.03 measured; 0.9 with the rays of a pinhole).
    """
    views = [photo(kind(pose=camera.to_world)) for camera in capture_photos.cameras(28)]
    plan = replace(PRESETS["capture"], stages=(RadianceStage(16, 40, 1, 8, 32), RadianceStage(32, 40, 1, 8, 32)))
    problem = RadianceProblem(RayBatches.from_photos(views[:24]), np.array([[-0.9] * 3, [0.9] * 3]), plan)
    reconstruct(problem, plan.optimizer, plan.course())
    for view in views[24:]:
        counts = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask
        error = (render_view(problem.field, view.camera, problem.sky).image - view.image)[counts]
        assert np.mean(error**2) < 0.1 * view.image[counts].var(axis=0).mean()
    assert isinstance(problem.field.density, mi.Float)
