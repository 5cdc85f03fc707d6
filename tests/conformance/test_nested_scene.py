"""A nested radiance field in a scene: all levels as its own cameras see them, light for surfaces, derivatives, and files."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_same_mean
from radiance_rays import rays_of
from scattering_scenes import moments

from mivol.cli import main
from mivol.errors import MivolError
from mivol.fields.field_files import write_field, write_scene
from mivol.fields.sky import Sky
from mivol.fields.spherical_grid import SphericalGrid
from mivol.fields.surfaces import extract_surface
from mivol.files import read_exr, read_volume, write_exr
from mivol.files.image_files import decode_srgb
from mivol.scene.load import load_scene
from mivol.transport.line_integrals.radiance_field import find_occupied_cells, make_model, render_rays
from mivol.transport.line_integrals.radiance_source import make_exact
from scenes import ball_of, box_of, camera, centred, medium, refused, rotation, sky, tensor

TURNED = centred(1.2 * rotation([1, 2, 3], 0.5), (0.1, 0.2, 0.3))
FLAT = centred(1.2 * np.eye(3), (0.1, 0.2, 0.3))
RES = (5, 6, 7)
Y0 = 0.28209479177387814
KEY = "box.interior_medium.emission"


def nested(
    values: list[tuple[np.ndarray, np.ndarray]], place: np.ndarray = TURNED, keep: bool = True, space: str = "linear"
) -> SphericalGrid:
    """Levels of densities and harmonics about one middle."""
    grids = []
    for level, (density, sh) in enumerate(values):
        there = (grids[0] if grids else SphericalGrid.from_dense(density, sh, place)).level_to_world(level)
        stored = np.ones(density.shape, bool) if keep else None
        grids.append(SphericalGrid.from_dense(density, sh, there, stored, space=space))
    return SphericalGrid.from_levels(grids)


def rough(levels: int = 3, place: np.ndarray = TURNED) -> SphericalGrid:
    """Rough densities, thinner from level to level as voxels grow, and colours that go with the direction."""
    rng = np.random.default_rng(0)
    values = [(rng.normal(-0.2, 2, RES) / 2.0**k, rng.normal(0, 0.3, (*RES, 4, 3))) for k in range(levels)]
    return nested(values, place)


def plain(densities: list[float], codes: list[float], place: np.ndarray = FLAT, space: str = "linear") -> SphericalGrid:
    """One density a level, one colour from everywhere."""
    sh = np.broadcast_to((np.array(codes) - 0.5) / Y0, (4, 4, 4, 1, 3))
    return nested([(np.full((4, 4, 4), density), sh) for density in densities], place, space=space)


def boxed(field: SphericalGrid, folder: Path) -> dict:
    """A field's medium in the cube of its outermost level."""
    write_field(folder / "field.npz", field, half=False)
    emission = {"type": "mivol_sh", "filename": str(folder / "field.npz")}
    return box_of({"type": "mivol_medium", "emission": emission}, field.level_to_world(field.levels - 1))


def scene(field: SphericalGrid, folder: Path, **more: object) -> mi.Scene:
    parts = {"sensor": camera([1.5, 1.8, 4], [0.1, 0.2, 0.3], 8, 60), "box": boxed(field, folder), "sky": sky(0.5)}
    return mi.load_dict({"type": "scene", "integrator": {"type": "mivol", "max_depth": 2}, **parts, **more})


def lines(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays that begin in each level and outside of all, and that hit and miss the inner boxes."""
    rng, middle = np.random.default_rng(4), np.array([0.1, 0.2, 0.3])
    o = np.float32(middle + rng.normal(size=(count, 3)) * rng.choice([0.3, 1.0, 3.0, 9.0], (count, 1)))
    d = middle + rng.normal(size=(count, 3)) * rng.choice([0.3, 3.0], (count, 1)) - o
    return o, np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))


@pytest.mark.slow
def test_rays_of_a_scene_see_what_the_field_shows_its_own_cameras(tmp_path: Path) -> None:
    """The same cells and points of them, so what differs are roundings: sums of some 60 cells of colours below 1."""
    field = rough()
    o, d = lines(600)
    ray = rays_of(o, d)
    seen = render_rays(find_occupied_cells(field), make_exact(field, ray.d), make_model(field), ray)
    expected = np.array(seen.colour + seen.T * 0.5)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(o))
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    found = np.array(integrator.sample(scene(field, tmp_path), sampler, mi.RayDifferential3f(ray.o, ray.d))[0])
    assert np.abs(found - expected).max() < 1e-5
    assert np.ptp(np.array(seen.T)) > 0.9


def test_the_parameters_are_all_levels_rows(tmp_path: Path) -> None:
    field = rough()
    params = mi.traverse(scene(field, tmp_path))
    assert tuple(params[f"{KEY}.density"].shape) == (3 * 210, 1)
    assert tuple(params[f"{KEY}.sh"].shape) == (3 * 210, 4, 3)
    volume = mi.load_dict({"type": "mivol_sh", "filename": str(tmp_path / "field.npz")})
    assert "3 levels of 7x6x5" in str(volume)
    every = SphericalGrid.from_rows(RES, TURNED, *field.values(), levels=3, space="linear")
    write_field(tmp_path / "every.npz", every, half=False)
    whole = mi.traverse(mi.load_dict({"type": "mivol_sh", "filename": str(tmp_path / "every.npz")}))
    assert tuple(whole["density"].shape) == (3, *RES, 1)


def furnace(folder: Path) -> mi.Scene:
    """A ball in the empty innermost box of a field that is opaque around it, of one colour everywhere."""
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    ball = {"type": "sphere", "center": [0.1, 0.2, 0.3], "radius": 0.2, "bsdf": white}
    near = camera([0.4, 0.5, 0.6], [0.1, 0.2, 0.3], 4, 20)
    return scene(plain([0.0, 60.0, 3.0], [0.8, 0.4, 0.2]), folder, ball=ball, sensor=near)


def test_what_stands_in_a_field_is_lit_by_its_outer_levels(tmp_path: Path) -> None:
    """Wherever a path leaves to it meets 0.8, 0.4, 0.2, behind an optical depth of 60 times 0.3 at least: half is seen."""
    image = np.array(mi.render(furnace(tmp_path), integrator=mi.load_dict({"type": "mivol", "media_light": "met"}), spp=4))
    np.testing.assert_allclose(image, np.broadcast_to([0.4, 0.2, 0.1], image.shape), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.statistical
def test_light_that_is_drawn_has_the_mean_of_light_that_is_met(tmp_path: Path) -> None:
    found = moments(furnace(tmp_path), {"type": "mivol", "media_light": "drawn"}, 256)
    assert_same_mean(found, np.broadcast_to([0.4, 0.2, 0.1], found.mean.shape), tile=2, rounding=1e-5, what="tiles")


@pytest.mark.slow
def test_derivatives_against_differences(tmp_path: Path) -> None:
    """Of both parameters, at depth 2 around a ball, with the same samples.

    A difference of float32 images errs by 6e-8 of a radiance near 1, over 2e-3, in each value: 1e-4 of their sum; cells in
    which the ReLU sets in between the two are a share of eps: 3e-3.
    """
    ball = {"type": "sphere", "center": [0.1, 0.2, 0.3], "radius": 0.3, "bsdf": {"type": "diffuse"}}
    loaded = scene(rough(2), tmp_path, ball=ball, integrator={"type": "mivol", "max_depth": 2, "media_light": "met"})
    params, rng, eps = mi.traverse(loaded), np.random.default_rng(3), 1e-3
    weight = rng.normal(size=(8, 8, 3)).astype(np.float32)
    for name in ("density", "sh"):
        key = f"{KEY}.{name}"
        start = np.array(params[key])
        step = rng.normal(size=start.shape).astype(np.float32)

        def shown(t: float, key: str = key, start: np.ndarray = start, step: np.ndarray = step) -> np.ndarray:
            params[key] = mi.TensorXf(start + np.float32(t) * step)
            params.update()
            return np.array(mi.render(loaded, seed=1, spp=4), dtype=np.float64)

        change = (shown(eps) - shown(-eps)) / (2 * eps) * weight
        x = mi.TensorXf(start)
        dr.enable_grad(x)
        params[key] = x
        params.update()
        loaded.integrator().render_backward(loaded, params, tensor(weight), seed=1, spp=4)
        assert abs(float((np.array(dr.grad(x)) * step).sum()) - change.sum()) < 4e-3 * np.abs(change).sum()
        params[key] = mi.TensorXf(start)


def test_where_a_nested_field_cannot_stand(tmp_path: Path) -> None:
    """In anything but a cube of its own; and no lamp is moved by derivatives among its levels."""
    field = rough(2)
    interior = boxed(field, tmp_path)["interior"]
    with refused("the medium in ball is a nested field, .* but Sphere is not a separate box: give the medium a cube"):
        mi.render(scene(field, tmp_path, box=ball_of(interior, (0, 0, 0), 2.0) | {"id": "ball"}), spp=1)
    field_medium, ref = interior | {"id": "field"}, {"type": "ref", "id": "field"}
    fog = ball_of(medium("homogeneous", 0.5), (0.1, 0.2, 0.3), 0.3) | {"exterior": ref}
    with refused("that overlaps no other medium's shape"):
        parts = {"a": field_medium, "box": box_of(ref, field.level_to_world(1)), "fog": fog}
        mi.render(scene(field, tmp_path, **parts), spp=1)
    lamp = {"type": "point", "position": [0, 0, 3], "intensity": 1.0}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse"}}
    lit = scene(field, tmp_path, lamp=lamp, floor=floor)
    params = mi.traverse(lit)
    dr.enable_grad(params["lamp.position"])
    with refused("lamp.position was requested and box .level 1. belongs to a nested field"):
        lit.integrator().render_backward(lit, params, dr.ones(mi.TensorXf, (8, 8, 3)), spp=1)


# -- Files -----------------------------------------------------------------------------------------------------------------


def test_volumes_are_a_pair_a_level(tmp_path: Path) -> None:
    field = rough(2, FLAT)
    written = write_field(tmp_path / "field.nrrd", field)
    names = ["field.nrrd", "field-colour.nrrd", "field-level-1.nrrd", "field-level-1-colour.nrrd"]
    assert [path.name for path in written] == names
    for level, path in enumerate(written[::2]):
        one, read = field.extract_level(level), read_volume(path)
        np.testing.assert_allclose(read.values[..., 0], np.maximum(one.to_dense()[0], 0), rtol=1e-6)
        np.testing.assert_allclose(read.to_world, one.to_world, atol=1e-6)


def shell(radius: float, res: int = 24) -> SphericalGrid:
    """A ball about the middle of three levels, as a density of 40 a length from its surface inwards, around 8 at it."""
    values = []
    for level in range(3):
        edge = 1.2 * 2**level
        at = ((np.arange(res) + 0.5) / res - 0.5) * edge
        z, y, x = np.meshgrid(at, at, at, indexing="ij")
        values.append((8 + 40 * (radius - np.sqrt(x * x + y * y + z * z)), np.zeros((res, res, res, 1, 3))))
    return nested(values, FLAT)


@pytest.mark.parametrize(("radius", "voxel"), [(0.4, 0.05), (0.7, 0.05), (1.5, 0.1)])
def test_a_surface_goes_on_from_level_to_level(radius: float, voxel: float) -> None:
    """Inside the innermost box, across its sides (0.6 from the middle), and across those of the next (1.2).

    Corners lie within h^2 / (8 r) of the ball for voxels h of 0.05, 0.1 and 0.2. At a side, the field stays as it is for half a
    voxel, and triangles reach as far out of the box: a voxel's error there. No area is missing (chords take
    (h / r)^2 / 12 at most), and a triangle's width, of the larger voxels, is there twice along a seam of at most 6 circles.
    """
    mesh = extract_surface(shell(radius), 8.0)
    away = mesh.points - [0.1, 0.2, 0.3]
    off = np.abs(np.linalg.norm(away, axis=1) - radius)
    assert np.quantile(off, 0.8) < 0.01 and off.max() < (0.01 if radius == 0.4 else voxel)
    a, b, c = (away[mesh.faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    area = np.linalg.norm(across, axis=1).sum() / 2
    side = {0.4: 0.4, 0.7: 0.6, 1.5: 1.2}[radius]
    seam = 6 * 2 * np.pi * np.sqrt(radius**2 - side**2)
    assert 0.995 < area / (4 * np.pi * radius**2) < 1.001 + 2 * voxel * seam / (4 * np.pi * radius**2)
    assert (np.einsum("ij,ij->i", across, a) > 0).mean() > 0.999
    assert len(np.unique(mesh.faces)) == len(mesh.points)


def test_levels_that_no_surface_reaches_are_left_out() -> None:
    assert len(extract_surface(shell(0.4), 8.0).points) == len(extract_surface(shell(0.4).extract_level(0), 8.0).points)
    with pytest.raises(MivolError, match=r"no node of the field reaches the extinction 1000, only 3\d.*; give a lower level"):
        extract_surface(shell(0.7), 1000.0)


def test_svox2_has_no_levels(tmp_path: Path) -> None:
    with pytest.raises(MivolError, match="a field of 2 nested levels, expected one grid, as svox2 has; write .npz or .xml"):
        write_field(tmp_path / "field.svox2.npz", rough(2, FLAT))


def test_a_scene_shows_the_field_before_its_sky(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Rows of the sky from its zenith to its nadir; codes as the light that they stand for, of the field and of its sky."""
    write_field(tmp_path / "field.npz", plain([500.0, 0.0], [0.8, 0.4, 0.2], space="srgb"), half=False)
    codes = np.linspace(0.9, 0.1, 8)[:, None, None] * np.array([1.0, 0.5, 0.25])
    write_exr(tmp_path / "sky.exr", {"": np.float32(np.broadcast_to(codes, (8, 16, 3)))})
    assert main(["export", str(tmp_path / "field.npz"), str(tmp_path / "place.xml")]) == 0
    names = ["place.xml", "place-field.npz", "place-sky.exr"]
    assert capsys.readouterr().out.split() == [str(tmp_path / name) for name in names]
    loaded = load_scene(tmp_path / "place.xml").scene
    size = loaded.sensors()[0].film().size()
    image = np.array(mi.render(loaded, spp=1))
    np.testing.assert_allclose(image[size[1] // 2, size[0] // 2], decode_srgb(np.array([0.8, 0.4, 0.2])), rtol=1e-3)
    held, _ = read_exr(tmp_path / "place-sky.exr")
    np.testing.assert_allclose(held["R"], decode_srgb(codes[..., 0]) * np.ones((8, 16)), rtol=1e-3)
    # Up is z here, and y to an environment: what is seen beside the cube has the colours of rows of the middle.
    beside = image[:, 5] / image[:, 5, :1]
    assert np.ptp(image[:, 5, 0]) < 0.7 and (beside[:, 2] < 0.5).all()


def test_a_scene_of_radiance_has_the_radiance_of_its_sky(tmp_path: Path) -> None:
    written = write_scene(tmp_path / "a.xml", plain([1.0, 1.0], [0.5] * 3), Sky.uniform(4, 3.0))
    assert [path.name for path in written] == ["a.xml", "a-field.npz", "a-sky.exr"]
    np.testing.assert_allclose(read_exr(written[2])[0]["G"], 3.0)
    assert [path.name for path in write_scene(tmp_path / "b.xml", plain([1.0], [0.5] * 3))] == ["b.xml", "b-field.npz"]
    assert "envmap" not in (tmp_path / "b.xml").read_text()
