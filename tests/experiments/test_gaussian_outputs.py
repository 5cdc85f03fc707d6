"""What a fit of Gaussians leaves in its folder, from a problem that is made up: which views, which film, which numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.cli import main
from mivol.experiments import gaussian_conversion, photo_fit
from mivol.experiments import gaussian_fit as outputs
from mivol.experiments.film import Film
from mivol.experiments.fit_kind import NullProgress
from mivol.fields.surfaces import DepthView, interpolate_corners
from mivol.files.mesh import Atlas, Mesh, read_glb, turn_to_y
from mivol.photos import Camera, pixel_centres, rays
from mivol.photos.camera import project
from mivol.photos.camera_path import HomeView
from mivol.points import Gaussians, write_gaussians
from mivol.scene.sensors import to_camera
from mivol.validate.metrics import ImageScore


def cloud(n: int = 3) -> Gaussians:
    """Opacities of 1/2, 3/4 and 1/4 in turn; axes of 1, 2 and 8, 4, 4 and 4, 3, 1 and 2."""
    scales = np.array([[1.0, 2, 8], [4, 4, 4], [3, 1, 2]])[:n]
    return Gaussians(
        means=np.zeros((n, 3), np.float32),
        log_scales=np.log(scales).astype(np.float32),
        quaternions=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        opacity_logits=np.log([1.0, 3.0, 1 / 3][:n]).astype(np.float32),
        harmonics=np.zeros((n, 4, 3), np.float32),
    )


def test_what_the_gaussians_take() -> None:
    """Medians of the opacities, of the longest axes, and of these over the shortest ones."""
    table = outputs.tabulate_gaussians(cloud(), 3 * 2**19)
    assert (table.title, table.head) == ("Fitted Gaussians", ("", ""))
    assert table.rows == (
        ("Gaussians", "3"),
        ("harmonics", "degree 1"),
        ("file", "1.50 MiB"),
        ("opacity: median", "0.5"),
        ("longest axis: median [length]", "4"),
        ("longest over shortest axis: median", "3"),
    )


@pytest.mark.parametrize("has_view", [True, False])
def test_gaussians_become_a_scene(variant_rgb: str, tmp_path: Path, has_view: bool, capsys: pytest.CaptureFixture) -> None:
    """The camera is the first view of the file. The blur is that of splats in an image of 480 pixels, 60 degrees wide, at 5."""
    place, means = tmp_path / "place.xml", np.float32([[0, 0, 0], [3, -1, 2], [5, 1, -4]])
    view = HomeView((0.0, -1.0, 0.0), (5.0, 0.0, -5.0), (5.0, 0.0, 0.0), 60.0, (960, 540)) if has_view else None
    write_gaussians(tmp_path / "a.ply", replace(cloud(), means=means), view)
    assert main(["export", str(tmp_path / "a.ply"), str(place)]) == 0
    assert capsys.readouterr().out.split() == [str(place), str(tmp_path / "place-gaussians.ply")]
    scene = mi.load_file(str(place))
    camera = to_camera(scene.sensors()[0])
    if has_view:
        assert camera.size == (480, 270)
        np.testing.assert_allclose(camera.to_world[:3, 3], [5, 0, -5], atol=1e-6)
        np.testing.assert_allclose(camera.to_world[:3, 1], [0, -1, 0], atol=1e-6)
        blur = np.sqrt(0.3) * 5 / (240 / np.tan(np.radians(30)))
        assert f'name="blur" value="{blur:.6g}"' in place.read_text()
    pixels, depth = project(camera, np.median(means, axis=0))
    assert depth > 0 and (pixels > 0).all() and (pixels < camera.size).all()
    box = scene.shapes()[0].bbox()
    assert (np.array(box.min) < means.min(axis=0)).all() and (np.array(box.max) > means.max(axis=0)).all()
    for target, fault in ((tmp_path / "place.obj", "expected a scene"), (place, "--level is for the mesh of a field")):
        assert main(["export", str(tmp_path / "a.ply"), str(target), *(["--level", "1"] if target == place else [])]) == 1
        assert fault in capsys.readouterr().err


def test_a_mesh_of_gaussians_is_upright_as_the_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    triangle = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    monkeypatch.setattr(gaussian_conversion, "mesh_of_gaussians", lambda *given: triangle)
    monkeypatch.setattr(gaussian_conversion, "paint_mesh", lambda *given: np.zeros((8, 8, 3), np.uint8))
    monkeypatch.setattr(gaussian_conversion, "measure_mesh_error", lambda *given: gaussian_conversion.MeshLoss(0, 0, 0, 0))
    view = HomeView((0.6, -0.8, 0.0), (5.0, 0.0, -5.0), (5.0, 0.0, 0.0), 60.0, (960, 540))
    write_gaussians(tmp_path / "a.ply", cloud(), view)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.glb"), "--to", "mesh"]) == 0
    document, _ = read_glb(tmp_path / "b.glb")
    np.testing.assert_allclose(document["nodes"][0]["rotation"], turn_to_y(view.up), atol=1e-9)


def test_a_mesh_is_painted_by_the_views_that_see_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A square is red on the left and green on the right, and a near thing hides its upper half from all views, whose colour
    there is that of the points. Two texels beside a border may mix."""

    def views_of(cloud: None, cameras: list[Camera]) -> Iterator[DepthView]:
        for camera in cameras:
            o, d = rays(camera, pixel_centres(camera.size))
            t = (0.5 - o[..., 2]) / d[..., 2]
            p = o + t[..., None] * d
            hidden = p[..., 1] > 0.5
            colour = np.where(hidden[..., None], [0, 0, 1.0], np.where(p[..., :1] < 0.5, [1.0, 0, 0], [0, 1.0, 0]))
            depth = t * (d @ -camera.to_world[:3, 2])
            yield DepthView(camera, np.where(hidden, 0.5, 1) * depth, colour)

    monkeypatch.setattr(gaussian_conversion, "_splat_depths", views_of)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)))
    number = np.arange(81).reshape(9, 9)
    a, b, c, d = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    mesh = Mesh(np.stack([x, y, np.full(81, 0.5)], axis=1), faces, colours=np.full((81, 3), 0.2))
    image = gaussian_conversion.paint_mesh(None, mesh, np.zeros(3), np.ones(3), 32)
    atlas = Atlas.of(len(faces))
    places = atlas.paint(lambda numbers, weights: interpolate_corners(mesh.points, faces[numbers], weights))[..., :2] / 255
    served = atlas.paint(lambda numbers, weights: np.ones((len(numbers), len(weights), 3)))[..., 0] > 0
    far = served & (np.abs(places - 0.5) > 0.1).all(axis=-1)
    expected = np.where(places[..., 1:] > 0.5, 51, np.where(places[..., :1] < 0.5, [255, 0, 0], [0, 255, 0]))
    assert far.sum() > 2000 and np.abs(image[far].astype(int) - expected[far]).max() <= 1


def test_a_picture_stands_before_a_colour() -> None:
    """A quarter of what is seen is the background; the splatter is that of the camera's size and low-pass filter."""
    seen = np.zeros((2, 3, 4), np.float32)
    seen[..., :3], seen[..., 3] = 0.5, 0.75
    asked = []

    def splatter_for(size: tuple, low_pass: float) -> SimpleNamespace:
        asked.append((size, low_pass))
        return SimpleNamespace(forward=lambda values, camera, derivatives: (seen, None) if not derivatives else None)

    problem = SimpleNamespace(splatter_for=splatter_for, values=dict)
    found = outputs.render_gaussians(problem, SimpleNamespace(size=(3, 2)), np.array([1.0, 0.0, 0.4]), 0.3)
    np.testing.assert_allclose(found, np.broadcast_to([0.75, 0.5, 0.6], (2, 3, 3)), rtol=1e-6)
    assert asked == [((3, 2), 0.3)]


def finished_fit(monkeypatch: pytest.MonkeyPatch, folder: Path, views: int, shown: int, frames: int) -> tuple:
    """A fit to some views, a run folder that lists what is written, and a function that writes all outputs."""
    run = SimpleNamespace(path=folder, written=[])
    run.make = lambda *names: [(folder / name).mkdir() for name in names]
    run.write_curves = lambda: run.written.append("curves")
    camera = SimpleNamespace(size=(1600, 1200))
    background = np.array([0.1, 0.2, 0.3])
    photos = SimpleNamespace(
        views=[SimpleNamespace(camera=camera, background=background, name=f"{k}") for k in range(views)],
        space="srgb",
        box="box",
    )
    fit = object.__new__(outputs.GaussianFit)
    fit.record = SimpleNamespace(results={}, images=[], tables=[], volumes=[])
    fit.settings = SimpleNamespace(show=SimpleNamespace(views=shown, frames=frames, metrics=("psnr", "ssim")))
    fit.context = SimpleNamespace(progress=NullProgress())
    fit.photos, fit.judged, fit.film = photos, photos if shown else None, Film(("camera",) * frames, shrink=4.0)
    fit.plan = SimpleNamespace(low_pass=0.3, low_pass_at=lambda shrink: ("low pass at", shrink))
    arrays = {name: getattr(cloud(), name) for name in outputs.Gaussians.__dataclass_fields__}
    fit.problem = SimpleNamespace(exposure=None, motions=None, cloud=arrays)
    monkeypatch.setattr(outputs, "write_gaussians", lambda path, gaussians, view: path.write_bytes(view))
    monkeypatch.setattr(photo_fit, "find_home_view", lambda cameras, box: {("box", views): bytes(100)}[box, len(cameras)])
    monkeypatch.setattr(outputs, "rectify", lambda photo: photo)
    monkeypatch.setattr(photo_fit, "draw_photo_cameras", lambda *given: run.written.append(given) or [])
    written = lambda folder, photo, number, seen, space, caption, edge=None: [(photo.name, seen.tolist(), caption, edge)]  # noqa: E731
    monkeypatch.setattr(photo_fit, "write_view", written)
    monkeypatch.setattr(
        outputs,
        "judge_view",
        lambda problem, judged, photo, metrics: (np.array(int(photo.name)), ImageScore(photo.name, {metrics[0]: 20.0})),
    )
    return fit, run, lambda: fit.write_outputs(SimpleNamespace(next_iteration=77), run, None)


@pytest.mark.parametrize(("views", "shown", "full"), [(7, 3, [0, 3, 6]), (2, 5, [0, 1]), (4, 1, [0])])
def test_judged_views_are_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, views: int, shown: int, full: list[int]
) -> None:
    """All are judged and kept beside their photographs: as many as are asked for in full, of which the first is the worst."""
    fit, run, write = finished_fit(monkeypatch, tmp_path, views, shown, frames=0)
    write()
    record = fit.record
    assert [(name, seen) for name, seen, _, edge in record.images if edge is None] == [(f"{k}", k) for k in full]
    assert sorted(name for name, *_ in record.images) == [f"{k}" for k in range(views)]
    assert record.images[0][2] == f"the worst of {views}: PSNR 20.00 dB"
    assert record.tables[1].title == "Held-out views, at 1600 x 1200 pixels, the worst first"
    assert set(record.tables[1].rows) == {(f"{k}", "20.00") for k in range(views)}
    assert record.judged == f"{views} views at 1600 x 1200 pixels"
    assert record.results == {"views": views, "iterations": 77.0, "gaussians": 3.0, "held_out_psnr": pytest.approx(20.0)}
    # The cameras that judge are drawn beside those that were fitted to.
    assert run.written == [(tmp_path, fit.photos, fit.judged, 1), "curves"]
    assert record.tables[0].rows[2] == ("file", "0.00 MiB")
    assert (tmp_path / "views").is_dir() and (tmp_path / "film").is_dir()


@pytest.mark.parametrize(("has_gains", "has_motions"), [(True, False), (False, True)])
def test_fitted_gains_and_motions_are_tabled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, has_gains: bool, has_motions: bool
) -> None:
    fit, _, write = finished_fit(monkeypatch, tmp_path, 3, 0, frames=0)
    gains, motions = np.array([[1.0, 1.05, 1.0], [0.5, 1.0, 1.0], [1.0, 1.0, 1.3]]), np.arange(18.0).reshape(3, 6) / 1000
    fit.gains, fit.motions = lambda: gains if has_gains else None, lambda: motions if has_motions else None
    write()
    expected = [photo_fit.tabulate_gains(["0", "1", "2"], gains)] * has_gains
    assert fit.record.tables[1:] == expected + [photo_fit.tabulate_motions(["0", "1", "2"], motions)] * has_motions


def test_frames_are_filtered_as_the_smaller_picture_asks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A film that is four times smaller than the photographs, over the first one's background; without judged views nothing
    is judged."""
    fit, _, write = finished_fit(monkeypatch, tmp_path, 2, 0, frames=8)
    asked, given = [], []
    monkeypatch.setattr(outputs, "render_gaussians", lambda problem, *how: asked.append(how) or "picture")
    monkeypatch.setattr(Film, "write", lambda film, folder, picture, progress: given.append(folder) or picture("camera"))
    write()
    ((camera, behind, low_pass),) = asked
    assert (camera, behind.tolist(), low_pass) == ("camera", [0.1, 0.2, 0.3], ("low pass at", 4.0))
    assert given == [tmp_path] and fit.record.images == ["picture"]
    assert set(fit.record.results) == {"views", "iterations", "gaussians"}


def test_a_view_is_judged_as_a_pinhole_sees_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a lens distorts is rectified, filtered as in the fit, and judged in the space of the photographs."""
    photo = SimpleNamespace(camera="bent")
    flat = SimpleNamespace(camera="flat", background="behind", image="image", mask="mask", name="name")
    monkeypatch.setattr(outputs, "rectify", lambda given: flat if given is photo else None)
    monkeypatch.setattr(outputs, "render_gaussians", lambda *asked: asked)
    monkeypatch.setattr(outputs, "score_image", lambda *given, **named: (given, named))
    problem = SimpleNamespace(plan=SimpleNamespace(low_pass=0.3))
    seen, (given, named) = outputs.judge_view(problem, SimpleNamespace(space="srgb"), photo, ("psnr",))
    assert seen == (problem, "flat", "behind", 0.3)
    assert given == (seen, "image")
    assert named == {"space": "srgb", "mask": "mask", "metrics": ("psnr",), "name": "name"}
