"""``mivol convert``, ``mivol explain`` and ``mivol render`` on files of points and of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gaussian_sets import inria_bytes, random_gaussians, spz_bytes
from skimage.io import imread

from mivol.cli import main
from mivol.experiments.render import frame_points
from mivol.files.mesh import read_ply
from mivol.points.cloud import PointCloud, read_points, write_points
from mivol.points.gaussian_files import GAUSSIAN_READERS, read_gaussians, write_gaussians
from mivol.points.gaussians import CONSTANT_HARMONIC, Gaussians


def test_convert_writes_what_was_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An SPZ becomes the authors' PLY, and that one points; the numbers are those that were read."""
    (tmp_path / "a.spz").write_bytes(spz_bytes(random_gaussians(9, 1), 3))
    assert main(["convert", str(tmp_path / "a.spz"), str(tmp_path / "b.ply")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'b.ply'}: 9 Gaussians\n"
    one, other = read_gaussians(tmp_path / "a.spz"), read_gaussians(tmp_path / "b.ply")
    assert all(np.array_equal(getattr(one, name), getattr(other, name)) for name in vars(one))
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.npy")]) == 0
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.ply"), "--to", "points"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'c.npy'}: 9 points\n{tmp_path / 'c.ply'}: 9 points\n"
    assert np.array_equal(read_points(tmp_path / "c.npy").positions, one.means)
    assert read_points(tmp_path / "c.ply").colours is not None


def test_convert_reads_a_laser_scan(tmp_path: Path) -> None:
    """A LAS file becomes points in NumPy's file: its positions lie on steps of its scale, 1/8, which float32 holds."""
    laspy = pytest.importorskip("laspy", reason="LAS needs the optional package laspy")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.offsets, header.scales = [0, 0, 0], [0.125, 0.125, 0.125]
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = positions = np.array([[0.5, 1.25, -3], [2, -0.125, 7.5], [0, 4, 0.25]])
    scan.write(str(tmp_path / "cloud.las"))
    assert main(["convert", str(tmp_path / "cloud.las"), str(tmp_path / "cloud.npy")]) == 0
    assert np.array_equal(read_points(tmp_path / "cloud.npy").positions, positions.T)


def test_convert_makes_gaussians_of_points_where_asked(tmp_path: Path) -> None:
    """A PLY may hold either: points stay points where nothing is said."""
    write_points(tmp_path / "a.npy", PointCloud(np.eye(5, 3)[:4]))
    assert main(["convert", str(tmp_path / "a.npy"), str(tmp_path / "b.ply")]) == 0
    assert read_points(tmp_path / "b.ply").colours is None
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.ply"), "--to", "gaussians"]) == 0
    assert read_gaussians(tmp_path / "c.ply").count == 4


def test_convert_refuses_a_format_that_it_does_not_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.ply").write_bytes(inria_bytes(random_gaussians(2, 0)))
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.drc")]) == 1
    assert "the suffix '.drc', expected one of .ply, .npy" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "none.ply"), str(tmp_path / "b.ply")]) == 1
    assert "nothing there" in capsys.readouterr().err
    (tmp_path / "a.jpg").write_bytes(b"a photograph")
    assert main(["convert", str(tmp_path / "a.jpg"), str(tmp_path / "b.html")]) == 1
    assert set(GAUSSIAN_READERS) <= set(capsys.readouterr().err.replace(",", " ").replace(";", " ").split())


def test_convert_says_which_flags_are_of_fields(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.ply").write_bytes(inria_bytes(random_gaussians(2, 0)))
    for source, target, flags, said in (
        ("a.ply", "b.npz", ["--to", "points"], "leave out --to points"),
        ("a.ply", "b.ply", ["--to", "field"], "leave out --to field"),
        ("a.ply", "b.ply", ["--resolution", "9"], "--resolution is for a radiance field"),
        ("a.ply", "b.ply", ["--box", *"111000"], "expected a lower corner, then a higher corner"),
        ("a.ply", "b.ply", ["--box", *"888999"], "found nothing of 2 inside --box"),
        ("a.npz", "b.ply", ["--box", *"000111"], "--box crops Gaussians and points, not a radiance field"),
        ("a.npz", "b.obj", [], "mivol export writes it as a mesh"),
        ("a.npz", "b.npy", [], "expected one of .ply"),
        ("a.ply", "b.stl", ["--to", "mesh"], "expected one of .ply, .obj"),
    ):
        assert main(["convert", str(tmp_path / source), str(tmp_path / target), *flags]) == 1
        assert said in capsys.readouterr().err
        assert not (tmp_path / target).exists()


@pytest.mark.slow
def test_convert_makes_a_field_and_says_its_loss(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Soft balls apart from each other: what a grid loses falls with its voxels, and half of them cut off are a worse picture.

    A voxel widens them by 5/12 voxel^2 of the variance; cut to a quarter at twice the resolution, the error falls
    by about 12 dB: 6 are asked for.
    """
    rng = np.random.default_rng(4)
    places = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    balls = Gaussians(
        places, np.full((8, 3), np.log(0.3)), np.tile([1.0, 0, 0, 0], (8, 1)), np.full(8, 0.5), rng.normal(size=(8, 4, 3))
    )
    balls = Gaussians(**{**vars(balls), "opacity_logits": np.append(np.zeros(7), np.inf)})
    (tmp_path / "a.ply").write_bytes(inria_bytes(balls.select(slice(7))))
    loss = {}
    for resolution in (8, 16):
        assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.npz"), "--resolution", str(resolution)]) == 0
        written, share, lost = capsys.readouterr().out.splitlines()
        assert f"b.npz: {resolution} x {resolution} x {resolution} nodes" in written and "degree 1" in written
        assert "dB between the field and splatted Gaussians: 6 views, 128 x 128 pixels each, 40 degrees wide, from a" in lost
        assert float(share.split()[0]) == pytest.approx(99, abs=1)  # within three deviations of the outer ones
        loss[resolution] = float(lost.split()[0])
    assert loss[16] > loss[8] + 6
    write_gaussians(tmp_path / "c.ply", balls)
    box = ["--box", "-2", "-2", "-2", "0", "2", "2"]
    assert main(["convert", str(tmp_path / "c.ply"), str(tmp_path / "b.npz"), "--resolution", "16", *box]) == 0
    _, share, lost, capped = capsys.readouterr().out.splitlines()
    assert float(share.split()[0]) < 60 and float(lost.split()[0]) < loss[8]
    assert capped == "1 Gaussians of an opacity above 0.999 were made as opaque as that"


def ball_of_gaussians(count: int = 1500) -> Gaussians:
    """Opaque ones on a sphere of radius 1, as wide as their neighbours are far."""
    height = 1 - (2 * np.arange(count) + 1) / count
    turn, flat = np.pi * (3 - np.sqrt(5)) * np.arange(count), np.sqrt(1 - height**2)
    places = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    scales = np.full((count, 3), np.log(np.sqrt(4 * np.pi / count) / 2))
    colours = (places / 4 / CONSTANT_HARMONIC)[:, None]
    return Gaussians(places, scales, np.tile([1.0, 0, 0, 0], (count, 1)), np.full(count, 4.0), colours)


@pytest.mark.slow
def test_convert_makes_gaussians_of_a_field_and_says_their_loss(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """There and back. Soft balls of 2 voxels: half the resolution widens them from 2 to 2.4 voxels and loses dB; Gaussians of
    single voxels, which overlap, keep more of them than Gaussians of blocks of 4, which do not."""
    balls = ball_of_gaussians(60)
    write_gaussians(tmp_path / "a.ply", balls)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.npz"), "--resolution", "24"]) == 0
    capsys.readouterr()
    loss, count = {}, {}
    for resolution in (12, 4):
        assert main(["convert", str(tmp_path / "b.npz"), str(tmp_path / "c.ply"), "--resolution", str(resolution)]) == 0
        written, lost = capsys.readouterr().out.splitlines()
        assert "dB between views of c.ply and b.npz: 6 views, 128 x 128 pixels each" in lost
        count[resolution], loss[resolution] = read_gaussians(tmp_path / "c.ply").count, float(lost.split()[0])
        assert f"c.ply: {count[resolution]} Gaussians" in written
    assert count[12] > 4 * count[4] and loss[12] > loss[4] + 3


@pytest.mark.slow
def test_convert_makes_a_mesh_and_says_its_distance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A sphere. The depth of a splat is that of its mean, and a nearer one hides by its tail: half a voxel of 0.095, with
    Gaussians of 0.046; the mesh follows such depths, which jump from splat to splat, to a voxel."""
    write_gaussians(tmp_path / "a.ply", ball_of_gaussians())
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--to", "mesh", "--resolution", "24"]) == 0
    written, apart, missed, views = capsys.readouterr().out.splitlines()
    mesh = read_ply(tmp_path / "b.ply")
    assert f"b.ply: {len(mesh.points)} points, {len(mesh.faces)} triangles, fused from 64 views" in written
    radius = np.linalg.norm(mesh.points, axis=1)
    assert np.abs(np.median(radius) - 1) < 0.095
    median, most = (float(part.rpartition("(")[2]) for part in apart.split(" voxels)")[:2])
    assert median < 1.5 and median < most < 3
    assert float(missed.split()[0]) < 5 and "128 x 128 pixels" in views


def test_explain_says_what_gaussians_there_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Facts first, then what cannot be drawn: its Gaussian is left out of the box."""
    one = Gaussians(
        means=[[0, 1, 2], [4, 1, -2], [2, np.nan, 0]],
        log_scales=np.log([[1, 2, 4]] * 3),
        quaternions=np.ones((3, 4)),
        opacity_logits=[0, 0, -6],
        harmonics=np.zeros((3, 4, 3)),
    )
    (tmp_path / "a.ply").write_bytes(inria_bytes(one))
    assert main(["explain", str(tmp_path / "a.ply")]) == 1
    said = capsys.readouterr().out
    for fact in (
        "a.ply: 3 Gaussians, harmonics of degree 1\nbox (0, 1, -2) to (4, 1, 2);",
        "scales 1 to 4, median 2\nopacities 0.002473 to 0.5, median 0.5, 33.3 % below 0.05\nrefused\n",
        "means that are not finite in Gaussian 2 (the first of 1)",
    ):
        assert fact in said


def test_explain_says_what_points_there_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_points(tmp_path / "a.npy", PointCloud([[0, 1, 2], [4, 1, -2]]))
    assert main(["explain", str(tmp_path / "a.npy")]) == 0
    assert "a.npy: 2 points, without colours\nbox (0, 1, -2) to (4, 1, 2);" in capsys.readouterr().out


# -- Views -------------------------------------------------------------------------------------------------------------

SMALL = ["--size", "48", "32"]


def two_cores(path: Path) -> None:
    """A dense ball and a thin one, far from the origin."""
    rng = np.random.default_rng(3)
    dense, thin = rng.normal(size=(300, 3)) * 0.1, rng.normal(size=(100, 3)) * 0.4 + [2, 0, 0]
    write_points(path, PointCloud(np.concatenate([dense, thin]) + np.array([70, 20, 90])))


@pytest.mark.parametrize("drawn_as", ["discs", "splats"])
def test_a_cloud_is_seen_whole_without_a_camera(tmp_path: Path, drawn_as: str) -> None:
    """Where points stand densely they are lighter; nothing touches the border, where the outermost 1 % may be."""
    two_cores(tmp_path / "cloud.npy")
    out = tmp_path / "picture.png"
    flags = ["--points", drawn_as, "--radius", "0.04", "--opacity", "0.8", "--fov", "30", *SMALL]
    assert main(["render", str(tmp_path / "cloud.npy"), "-o", str(out), *flags]) == 0
    picture = imread(out).astype(float).sum(axis=2)
    assert picture.shape == (32, 48) and picture.max() > 400
    assert 4 < picture.argmax() % 48 < 24  # the dense ball is to the left
    assert (picture[[0, -1]] > 0).mean() < 0.1 and (picture > 0).mean() > 0.05


def test_colours_of_points_are_shown_and_gaussians_as_they_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    write_points(tmp_path / "red.ply", PointCloud(rng.normal(size=(200, 3)), np.tile([1.0, 0, 0], (200, 1))))
    write_gaussians(tmp_path / "set.ply", random_gaussians(200, 1))
    for name in ("red", "set"):
        seen = ["--look-at", "0", "-6", "0", "0", "0", "0", *SMALL]
        assert main(["render", str(tmp_path / f"{name}.ply"), "-o", str(tmp_path / f"{name}.png"), *seen]) == 0
        assert imread(tmp_path / f"{name}.png")[..., 0].max() > 50
    assert imread(tmp_path / "red.png")[..., 1:].max() == 0


def test_all_places_lie_in_the_cone_of_the_view() -> None:
    """A ball about all of them touches the cone of the smaller angle: directions to the places are within it."""
    places = np.random.default_rng(5).uniform(-1, 3, (500, 3))
    look = np.array(frame_points(places, (0, 0, 1), 40.0, (64, 32)))
    towards, axis = places - look[:3], look[3:] - look[:3]
    angle = np.arccos(towards @ axis / np.linalg.norm(towards, axis=1) / np.linalg.norm(axis))
    half = np.arctan(np.tan(np.radians(20)) / 2)
    assert 0.6 * half < angle.max() < 1.05 * half


def test_flags_that_do_not_fit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    two_cores(tmp_path / "cloud.npy")
    write_gaussians(tmp_path / "set.ply", random_gaussians(5, 0))
    out = ["-o", str(tmp_path / "a.png"), *SMALL]
    for name, flags, said in (
        ("cloud.npy", ["--opacity", "0"], "expected 0.03 to 1"),
        ("cloud.npy", ["--radius", "-1"], "a length above 0"),
        ("set.ply", ["--radius", "1"], "have their own shapes"),
        ("none.ply", ["--radius", "1"], "nothing there"),
        ("scene.xml", ["--radius", "1"], "are for clouds of points"),
        ("scene.xml", ["--look-at", *"000111"], "a scene has its own cameras"),
    ):
        assert main(["render", str(tmp_path / name), *flags, *out]) == 1
        assert said in capsys.readouterr().err
        assert not (tmp_path / "a.png").exists()
