"""Clouds of points: files, densities of the same mass, random points of a density, and Gaussians of points."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from gaussian_sets import inria_bytes, ply_bytes, random_gaussians
from refusals import assert_refused

from mivol.points.cloud import (
    PointCloud,
    gaussians_to_points,
    points_to_density,
    points_to_gaussians,
    read_points,
    sample_points,
    write_points,
)

BOX = np.array([[2.0, 0.5, 0, -1], [0, 3, 0, 4], [0, 0, 1.5, 2], [0, 0, 0, 1]])
"""Unit cube to world: a sheared box of volume 9."""


def inside(count: int, seed: int = 5) -> np.ndarray:
    """Points in the box, some on its faces and corners."""
    unit = np.random.default_rng(seed).uniform(size=(count, 3))
    unit[:8] = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    unit[8:11] = [[0, 0.3, 0.4], [0.2, 1, 0.7], [0.99, 0.5, 0]]
    return unit @ BOX[:3, :3].T + BOX[:3, 3]


# -- Files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".npy"])
def test_what_is_written_is_read(tmp_path: Path, suffix: str) -> None:
    """Positions return in float32; colours return in bytes, if the format has colours."""
    cloud = PointCloud(inside(20), np.linspace(0, 1, 60).reshape(20, 3))
    write_points(tmp_path / f"a{suffix}", cloud)
    read = read_points(tmp_path / f"a{suffix}")
    assert np.array_equal(read.positions, cloud.positions.astype(np.float32))
    if suffix == ".ply":
        assert np.abs(read.colours - cloud.colours).max() <= 0.5 / 255 + 1e-6
    else:
        assert read.colours is None


def test_ply_of_doubles_keeps_them(tmp_path: Path) -> None:
    """Surveys lie millions of metres from their origin, where float32 steps by half a metre."""
    far = 5e6 + inside(12)
    body = b"".join(struct.pack(">3d", *row) for row in far)
    properties = [("double", axis) for axis in "xyz"]
    (tmp_path / "a.ply").write_bytes(ply_bytes([("vertex", 12, properties)], body, "binary_big_endian"))
    assert np.array_equal(read_points(tmp_path / "a.ply").positions, far)


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_points_of_colmap_keep_their_colours(tmp_path: Path, suffix: str) -> None:
    rows = [(7, 1.5, -2.0, 0.25, 255, 0, 51, 0.5, [(1, 2), (3, 4)]), (9, 0.0, 3.0, -1.0, 0, 102, 255, 0.1, [])]
    if suffix == ".bin":
        data = struct.pack("<Q", 2)
        for *fields, track in rows:
            data += struct.pack("<Q3d3Bd", *fields) + struct.pack(f"<Q{2 * len(track)}I", len(track), *sum(track, ()))
    else:
        lines = ["# points", *(" ".join(map(str, [*fields, *sum(track, ())])) for *fields, track in rows)]
        data = "\n".join(lines).encode()
    (tmp_path / f"points3D{suffix}").write_bytes(data)
    read = read_points(tmp_path / f"points3D{suffix}")
    assert read.positions.tolist() == [[1.5, -2, 0.25], [0, 3, -1]]
    assert np.array_equal(read.colours, np.array([[1, 0, 0.2], [0, 0.4, 1]], np.float32))


def test_las_is_read(tmp_path: Path) -> None:
    """Positions are multiples of the scale in the header."""
    laspy = pytest.importorskip("laspy", reason="LAS needs the optional package laspy")
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.offsets, header.scales = [5e6, 0, 0], [0.001, 0.001, 0.001]
    points = laspy.LasData(header)
    points.x, points.y, points.z = (inside(12) + np.array([5e6, 0, 0])).T
    points.red, points.green, points.blue = np.full(12, 65535), np.zeros(12), np.full(12, 13107)
    points.write(str(tmp_path / "a.las"))
    read = read_points(tmp_path / "a.las")
    assert np.abs(read.positions - inside(12) - [5e6, 0, 0]).max() <= 0.0005 + 1e-6
    assert np.abs(read.colours - np.array([1, 0, 0.2])).max() <= 1e-6


def npy(array: np.ndarray, tmp_path: Path) -> bytes:
    """The bytes of a file of an array."""
    np.save(tmp_path / "other.npy", array)
    return (tmp_path / "other.npy").read_bytes()


def test_clouds_that_cannot_be_are_refused(tmp_path: Path) -> None:
    sound = npy(np.zeros((4, 3), np.float32), tmp_path)
    hostile = {
        "a.npy": [
            (npy(np.zeros((4, 2)), tmp_path), r"an array \(4, 2\), expected real numbers \(N, 3\)"),
            (npy(np.array([[0.0, np.nan, 0], [0, 0, 0]]), tmp_path), "a position that is not finite in point 0 "),
            (sound.replace(b"(4, 3)", b"(9, 3)"), "a damaged array"),
            (sound[:40], "a damaged array"),
        ],
        "a.ply": [(ply_bytes([("vertex", 1, [("float", "x")])], bytes(4)), "no x, y, z of vertices")],
        "a.xyz": [(b"1 2 3", r"the suffix '\.xyz'")],
    }
    for name, cases in hostile.items():
        for data, said in cases:
            (tmp_path / name).write_bytes(data)
            assert_refused(said, read_points, tmp_path / name)


@pytest.mark.parametrize(
    ("positions", "colours", "said"),
    [
        (np.zeros((5, 2)), None, r"positions of shape \(5, 2\), expected \(N, 3\)"),
        (np.zeros((5, 3)), np.zeros((4, 3)), r"colours of shape \(4, 3\), expected \(5, 3\)"),
        (np.zeros((5, 3)), np.full((5, 3), 200, np.uint8), "whole numbers as colours, expected code values from 0 to 1"),
    ],
)
def test_arrays_that_make_no_cloud_are_refused(positions: np.ndarray, colours: np.ndarray | None, said: str) -> None:
    assert_refused(said, PointCloud, positions, colours)


def test_a_published_cloud_is_read(data_dir: Path) -> None:
    assert read_points(data_dir / "splats" / "points_halo_low_res.npy").count == 32314


# -- A density ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [(4, 5, 6), (1, 3, 2), (1, 1, 1)])
def test_the_mass_is_kept_up_to_the_faces(resolution: tuple[int, int, int]) -> None:
    """The eight weights of a point sum to 1 to about eight roundings, and the mass is a sum of positive numbers; 1000 roundings
    of 2^-53 bound its relative error.
    """
    points = inside(500)
    masses = np.random.default_rng(6).uniform(0.5, 2, 500)
    density = points_to_density(points, resolution, BOX, masses)
    assert density.min() >= 0
    assert abs(density.sum() * 9 / np.prod(resolution) - masses.sum()) <= 1000 * 2**-53 * masses.sum()


def test_the_centre_of_mass_is_kept_inside() -> None:
    """For a single point, at least half a voxel from the faces, the sum of density times voxel centres is the point, to about
    twenty roundings of numbers below 8.
    """
    resolution = (4, 5, 6)
    index = np.stack(np.meshgrid(*map(np.arange, resolution), indexing="ij"), axis=-1)[..., ::-1]
    centres = (index + 0.5) / resolution[::-1] @ BOX[:3, :3].T + BOX[:3, 3]
    for unit in np.random.default_rng(7).uniform(0.125, 0.875, (10, 3)):
        point = BOX[:3, :3] @ unit + BOX[:3, 3]
        mass = points_to_density(point[None], resolution, BOX) * 9 / 120
        assert np.abs((mass[..., None] * centres).sum(axis=(0, 1, 2)) - point).max() <= 20 * 8 * 2**-53


def test_a_point_outside_is_refused_by_index() -> None:
    points = inside(20)
    points[13] += [0, 0, 10]
    assert_refused(r"point 13 outside the box \(the first of 1\)", points_to_density, points, (4, 5, 6), BOX)


def test_each_voxel_holds_its_share_of_the_points() -> None:
    """Voxels are drawn systematically, so the count of each is its share to less than one point; voxels without mass stay
    empty. Tolerance 1e-9 for rounding.
    """
    density = np.random.default_rng(8).uniform(size=(3, 4, 5))
    density[1] = 0
    points = sample_points(density, BOX, 1000, seed=3)
    unit = (points - BOX[:3, 3]) @ np.linalg.inv(BOX[:3, :3]).T
    index = tuple(np.floor(unit * [5, 4, 3]).astype(int).T[::-1])
    held = np.zeros(density.shape)
    np.add.at(held, index, 1)
    assert np.abs(held - 1000 * density / density.sum()).max() < 1 + 1e-9
    assert not held[1].any()
    assert np.array_equal(points, sample_points(density, BOX, 1000, seed=3))
    assert not np.array_equal(points, sample_points(density, BOX, 1000, seed=4))


@pytest.mark.parametrize("density", [np.zeros((2, 2, 2)), -np.ones((2, 2, 2)), np.ones((2, 2)), np.full((1, 1, 1), np.nan)])
def test_a_density_that_nothing_can_be_drawn_from_is_refused(density: np.ndarray) -> None:
    assert_refused("not below 0, with mass", sample_points, density, BOX, 5, seed=0)


# -- Gaussians ----------------------------------------------------------------------------------------------------


def test_gaussians_are_as_wide_as_their_neighbours_are_away() -> None:
    """Corners of a cube of edge 2 have three neighbours at distance 2; a point with two copies gets the smallest scale.
    Tolerance 1e-6: logarithms below 8 in float32.
    """
    corners = np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (0, 2)], float)
    balls = points_to_gaussians(PointCloud(corners, np.full((8, 3), 0.75)), opacity=0.2).check()
    assert np.abs(balls.log_scales - np.log(2)).max() <= 1e-6
    assert np.abs(balls.opacities() - 0.2).max() <= 1e-6
    assert np.abs(balls.base_colours() - 0.75).max() <= 1e-6
    twice = points_to_gaussians(PointCloud(np.concatenate([corners, corners[:1], corners[:1], corners[:1]])))
    assert np.abs(twice.log_scales[[0, 8, 9, 10]] - np.log(2e-3)).max() <= 1e-6


def test_centres_and_colours_come_back(tmp_path: Path) -> None:
    cloud = PointCloud(inside(30).astype(np.float32), np.random.default_rng(9).uniform(size=(30, 3)))
    again = gaussians_to_points(points_to_gaussians(cloud))
    assert np.array_equal(again.positions, cloud.positions)
    assert np.abs(again.colours - cloud.colours).max() <= 1e-6
    one = random_gaussians(5, 1)
    (tmp_path / "a.ply").write_bytes(inria_bytes(one))
    assert np.array_equal(read_points(tmp_path / "a.ply").positions, one.means)


@pytest.mark.parametrize(
    ("positions", "opacity", "said"),
    [
        (np.zeros((3, 3)), 0.1, "3 points, expected at least 4"),
        (np.zeros((9, 3)), 0.1, "mostly coincide"),
        (inside(9 + 3), 2, "0 to 1"),
    ],
)
def test_points_that_make_no_gaussians_are_refused(positions: np.ndarray, opacity: float, said: str) -> None:
    assert_refused(said, points_to_gaussians, PointCloud(positions), opacity)
