"""A radiance field as meshes, volumes and checkpoints: position, orientation and colour of surfaces."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused

from mivol.cli import main
from mivol.errors import MivolError
from mivol.fields.activation import ACTIVATIONS
from mivol.fields.field_files import FIELD_FORMATS, read_field, write_field
from mivol.fields.spherical_grid import SphericalGrid
from mivol.fields.surfaces import default_level, extract_surface
from mivol.files import encode_srgb, read_volume
from mivol.files.mesh import Atlas, Mesh, read_ply, write_mesh
from scenes import centred, rotation

RADIUS = 0.6
RES = (20, 22, 24)
PLACE = np.array([[2.0, 0.0, 0.0, -1.0], [0.0, 2.0, 0.0, -1.0], [0.0, 0.0, 2.0, -1.0], [0.0, 0.0, 0.0, 1.0]])


def nodes(place: np.ndarray, res: tuple[int, int, int] = RES) -> np.ndarray:
    """(Z, Y, X, 3) world positions of the nodes."""
    z, y, x = res
    grid = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (z, y, x)), indexing="ij")
    return np.stack(grid[::-1], axis=-1) @ place[:3, :3].T + place[:3, 3]


def ball(place: np.ndarray = PLACE, activation: str = "relu", keep: bool = False, space: str = "srgb") -> SphericalGrid:
    """A ball of RADIUS about the origin; its extinction is 4 at the surface and grows inwards by 10 for each unit of length.

    Coefficients of degree 1 make the colour seen along -z redder than along +z.
    """
    inside = RADIUS - np.linalg.norm(nodes(place), axis=-1)
    sigma = np.maximum(4 + 10 * inside, 1e-3)
    raw = np.vectorize(ACTIVATIONS[activation].inverse)(sigma) if activation != "relu" else 4 + 10 * inside
    sh = np.zeros((*RES, 4, 3), np.float32)
    sh[..., 0, :] = (0.0, 0.3, -0.6)
    sh[..., 2, 0] = -0.5
    return SphericalGrid.from_dense(raw, sh, place, inside > -0.3 if keep else None, activation, space=space)


def volume_of(mesh: Mesh) -> float:
    """The signed volume of a mesh: positive if faces look outwards (divergence theorem)."""
    a, b, c = (mesh.points[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_surface_of_a_ball(variant_rgb: None, activation: str) -> None:
    """Vertices lie within half a voxel of the ball, and normals point outwards.

    Voxels are up to 0.1 long. The interpolated distance has the curvature 1 / RADIUS, so vertices are within h^2 / (8 RADIUS) =
    0.002 of the ball, and slightly more for logarithms of the distance.
    """
    mesh = extract_surface(ball(activation=activation), 4.0)
    distance = np.linalg.norm(mesh.points, axis=1)
    assert np.abs(distance - RADIUS).max() < 0.05
    assert np.abs(distance.mean() - RADIUS) < 0.005
    # Triangles of a tenth of the ball's size: their normals are off by up to 0.1 rad or so, means of them by less.
    assert np.einsum("ij,ij->i", mesh.normals, mesh.points / distance[:, None]).min() > 0.97
    assert volume_of(mesh) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)


def test_a_mesh_stands_where_the_field_does(variant_rgb: None) -> None:
    """Turned, mirrored, shifted and stretched: the ball stays a ball, and its faces look outwards."""
    turned = centred(rotation([1.0, 2.0, -1.0], 0.7) @ np.diag([2.2, -2.0, 2.4]))
    mesh = extract_surface(ball(turned), 4.0)
    assert np.abs(np.linalg.norm(mesh.points, axis=1) - RADIUS).max() < 0.06
    assert volume_of(mesh) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.03)
    moved = turned.copy()
    moved[:3, 3] += (5, -3, 2)
    there = extract_surface(SphericalGrid.from_dense(*ball(turned).to_dense(), moved), 4.0)
    assert there.points == pytest.approx(mesh.points + np.array([5, -3, 2]), abs=1e-9)


def test_colours_are_those_seen_from_outside(variant_rgb: None) -> None:
    """A ray against the normal n travels along -n and sees the red 0.5 - 0.4886 (-0.5) (-n_z), to 8 bits."""
    mesh = extract_surface(ball(), 4.0)
    red = 0.5 + 0.48860251 * -0.5 * -mesh.normals[:, 2]
    assert mesh.colours[:, 0] == pytest.approx(red, abs=1e-5)
    assert mesh.colours[:, 1] == pytest.approx(np.full(len(red), 0.5 + 0.28209479 * 0.3), abs=1e-6)
    assert np.ptp(mesh.colours[:, 0]) > 0.4


def test_a_texture_has_the_colours_of_the_corners(variant_rgb: None) -> None:
    """The texel at a corner has the colour of its point, to half a step of 8 bits."""
    mesh = extract_surface(ball(), 4.0, textured=True)
    corners = Atlas.of(len(mesh.faces)).corners().reshape(-1, 2)
    column, row = (corners * mesh.texture.shape[1::-1]).astype(int).T
    assert np.abs(mesh.texture[row, column] / 255 - np.clip(mesh.colours[mesh.faces.ravel()], 0, 1)).max() <= 0.5 / 255 + 1e-6


def test_a_sparse_field_has_the_surface_of_the_dense_one(variant_rgb: None) -> None:
    dense, sparse = extract_surface(ball(), 4.0), extract_surface(ball(keep=True), 4.0)
    assert np.array_equal(dense.points, sparse.points)
    assert np.array_equal(dense.faces, sparse.faces)


def test_hard_a_field_that_reaches_its_sides_is_closed(variant_rgb: None) -> None:
    """The surface of a full box is closed, and at most half a voxel outside (cells of 1/3, 1/4, 1/5)."""
    sh = np.zeros((3, 4, 5, 1, 3), np.float32)
    mesh = extract_surface(SphericalGrid.from_dense(np.full((3, 4, 5), 9.0), sh, np.eye(4)), 1e-3)
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    step = 1 / np.array([5, 4, 3])
    assert (mesh.points >= -step / 2 - 1e-6).all()
    assert (mesh.points <= 1 + step / 2 + 1e-6).all()
    assert mesh.colours == pytest.approx(np.full(mesh.points.shape, 0.5))


def test_the_level_of_a_mesh(variant_rgb: None) -> None:
    """With a longest edge of 0.1 a dense field has the level ln 2 / 0.1; a thin field of 2 and 6 in equal parts has half of
    (4 + 36) / 8. A level lower by 1 makes the ball larger by 0.1.
    """
    block, sh = np.full((10, 10, 10), -1.0), np.zeros((10, 10, 10, 1, 3))
    block[2:8, 2:8, 2:5], block[2:8, 2:8, 5:8] = 2, 6
    thin, dense = (SphericalGrid.from_dense(k * block, sh, np.eye(4)) for k in (1, 10))
    assert default_level(thin) == pytest.approx(2.5)
    assert default_level(dense) == pytest.approx(np.log(2) / 0.1)
    assert np.ptp(extract_surface(thin).points, axis=0) == pytest.approx([0.4, 0.6, 0.6], abs=0.1)  # where the denser half is
    radius = [np.linalg.norm(extract_surface(ball(), level).points, axis=1).mean() for level in (3.0, 5.0)]
    assert radius == pytest.approx([0.7, 0.5], abs=0.005)
    for activation in ACTIVATIONS.values():
        for level in (1e-3, 0.7, 40.0):
            extinction, _ = activation.value_and_slope(mi.Float(activation.inverse(level)))
            assert float(extinction[0]) == pytest.approx(level, rel=1e-5)


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_meshes_on_disk(variant_rgb: None, tmp_path: Path, suffix: str) -> None:
    """Mitsuba reads the file: the same box, and as many triangles. mivol reads the same mesh to float32 and 8 bits."""
    mesh = extract_surface(ball(), 4.0)
    path = tmp_path / f"ball{suffix}"
    assert write_field(path, ball(), 4.0) == [path]
    read = mi.load_dict({"type": suffix[1:], "filename": str(path)})
    assert read.face_count() == len(mesh.faces)
    box = read.bbox()
    corners = np.array([mesh.points.min(axis=0), mesh.points.max(axis=0)])
    assert np.array([box.min, box.max]).reshape(2, 3) == pytest.approx(corners, abs=1e-5)
    if suffix == ".ply":
        again = read_ply(path)
        assert np.array_equal(again.faces, mesh.faces)
        assert again.points == pytest.approx(mesh.points, abs=1e-6)
        assert again.normals == pytest.approx(mesh.normals, abs=1e-6)
        assert np.abs(again.colours - mesh.colours).max() <= 0.5 / 255 + 1e-6
        reflectances = np.array(mi.traverse(read)["vertex_color"]).reshape(-1, 3)
        assert encode_srgb(reflectances) == pytest.approx(mesh.colours, abs=1e-6)
    else:
        lines = [line.split() for line in path.read_text().splitlines()]
        values = {k: np.array([w[1:] for w in lines if w[0] == k], float) for k in ("v", "vn")}
        assert values["v"] == pytest.approx(np.concatenate([mesh.points, mesh.colours], axis=1), abs=1e-5)
        assert values["vn"] == pytest.approx(mesh.normals, abs=1e-5)
        corners = np.array([[w.split("//") for w in line[1:]] for line in lines if line[0] == "f"], int)
        assert np.array_equal(corners[..., 0] - 1, mesh.faces)
        assert np.array_equal(corners[..., 1], corners[..., 0])


def test_bare_meshes_on_disk(tmp_path: Path) -> None:
    points, faces = np.eye(3), np.array([[0, 1, 2]])
    write_mesh(tmp_path / "a.ply", Mesh(points, faces))
    again = read_ply(tmp_path / "a.ply")
    assert np.array_equal(again.points, points)
    assert again.normals is None
    assert again.colours is None
    coloured = Mesh(points, faces, colours=np.array([[0, 0.5, 1], [2, -1, 0.2], [1, 1, 1]]))
    write_mesh(tmp_path / "b.ply", coloured)
    again = read_ply(tmp_path / "b.ply")
    assert again.normals is None and np.array_equal(again.points, points)
    assert again.colours * 255 == pytest.approx(np.array([[0, 128, 255], [255, 0, 51], [255, 255, 255]]))
    write_mesh(tmp_path / "a.obj", Mesh(points, faces))
    assert (tmp_path / "a.obj").read_text().splitlines() == ["v 1 0 0", "v 0 1 0", "v 0 0 1", "f 1 2 3"]


@pytest.mark.parametrize("suffix", [".vol", ".nrrd"])
def test_volumes_show_the_nodes(variant_rgb: None, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ball{suffix}"
    written = write_field(path, ball())
    assert [p.name for p in written] == [f"ball{suffix}", f"ball-colour{suffix}"]
    sigma, colour = (read_volume(p) for p in written)
    assert sigma.to_world == pytest.approx(PLACE)
    assert sigma.values[..., 0] == pytest.approx(np.maximum(ball().to_dense()[0], 0))
    assert colour.values == pytest.approx(np.broadcast_to(0.5 + 0.28209479 * np.array([0.0, 0.3, -0.6]), colour.values.shape))


def test_a_checkpoint_of_svox2(variant_rgb: None, tmp_path: Path) -> None:
    """The written field is read again to half floats, 11 bits."""
    rng = np.random.default_rng(0)
    keep = rng.random((3, 4, 5)) < 0.5
    field = SphericalGrid.from_dense(rng.normal(size=keep.shape), rng.normal(size=(*keep.shape, 9, 3)), PLACE, keep)
    write_field(tmp_path / "field.svox2.npz", field)
    again = read_field(tmp_path / "field.svox2.npz")
    assert again.to_world == pytest.approx(field.to_world)
    assert np.array_equal(again.stored_nodes(), field.stored_nodes())
    for mine, theirs in zip(again.values(), field.values(), strict=True):
        assert mine == pytest.approx(theirs, rel=2**-11)


def test_meshes_hold_codes_whatever_the_field_holds(variant_rgb: None) -> None:
    """Viewers show the colours of a mesh unchanged, so radiance is encoded."""
    codes, light = (extract_surface(ball(space=space)).colours for space in ("srgb", "linear"))
    np.testing.assert_allclose(light, encode_srgb(codes), atol=1e-6)
    assert np.ptp(codes) > 0.2


@pytest.mark.parametrize(
    ("name", "change", "level", "sentence"),
    [
        ("a.vdb", {}, None, "found a name for OpenVDB, for which no package can be installed, expected one of .npz"),
        ("a.stl", {}, None, "found the suffix '.stl', expected one of .npz (field of mivol), .svox2.npz"),
        ("a.vol", {}, 3.0, "found a level for a pair of Mitsuba grids"),
        ("a.ply", {}, 0.0, "the level 0 was given for a surface; an extinction above 0"),
        ("a.ply", {}, 50.0, "no node of the field reaches the extinction 50, only"),
        ("a.vol", {"place": centred(rotation([0.0, 0.0, 1.0], 0.5))}, None, "a rotated, sheared or mirrored to_world"),
        ("a.svox2.npz", {"place": centred(rotation([0.0, 0.0, 1.0], 0.5))}, None, "found a turned or mirrored field"),
        ("a.svox2.npz", {"space": "linear"}, None, "found colours of linear radiance, expected code values"),
        ("a.svox2.npz", {"activation": "exp"}, None, "found activation exp, offset 0.5, clamp True"),
    ],
)
def test_what_cannot_be_exported(variant_rgb, tmp_path, name, change, level, sentence) -> None:
    with pytest.raises(MivolError) as refused:
        write_field(tmp_path / name, ball(**change), level)
    assert sentence in str(refused.value)
    assert list(tmp_path.iterdir()) == []


def test_meshes_that_are_none(tmp_path: Path) -> None:
    assert_refused("corners 0 to 3, expected indices of its 3 points", Mesh, np.eye(3), np.array([[0, 1, 3]]))
    assert_refused(r"expected \(V, 3\)", Mesh, np.eye(3), np.array([[0, 1]]))
    of_points = ({"normals": np.eye(4)}, {"colours": np.eye(3)[:2]}, {"points": np.eye(3)[:, :2]})
    for spoilt in (*of_points, {"faces": np.array([0, 1, 2])}):
        assert_refused("per point and", Mesh, **{"points": np.eye(3), "faces": np.array([[0, 1, 2]])} | spoilt)
    with pytest.raises(MivolError, match="the suffix '.stl', expected one of .ply, .obj"):
        write_mesh(tmp_path / "a.stl", Mesh(np.eye(3), np.array([[0, 1, 2]])))
    write_mesh(tmp_path / "a.ply", Mesh(np.eye(3), np.array([[0, 1, 2]])))
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-1])
    assert_refused("truncated", read_ply, tmp_path / "b.ply")
    (tmp_path / "c.ply").write_text("ply\nformat ascii 1.0\nend_header\n")
    assert_refused("another layout", read_ply, tmp_path / "c.ply")


def test_the_verb(variant_rgb: None, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_field(tmp_path / "field.npz", ball(keep=True))
    for suffix in FIELD_FORMATS:
        made = main(["export", str(tmp_path / "field.npz"), str(tmp_path / f"out{suffix}")])
        assert made == (1 if suffix == ".svox.npz" else 0)  # an octree's format
    names = ("out.npz", "out.svox2.npz", "out.vol", "out-colour.vol", "out.nrrd", "out-colour.nrrd", "out.ply", "out.obj")
    names += ("out.glb", "out.xml", "out-field.npz")
    printed = capsys.readouterr()
    assert printed.out.split() == [str(tmp_path / name) for name in names] and "--to octree" in printed.err
    assert main(["export", str(tmp_path / "field.npz"), str(tmp_path / "out.vdb")]) == 1
    assert "OpenVDB" in capsys.readouterr().err
