"""``mivol convert`` and ``mivol explain`` on files of points and of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gaussian_sets import inria_bytes, random_gaussians, spz_bytes

from mivol.cli import main
from mivol.points.cloud import PointCloud, read_points, write_points
from mivol.points.gaussian_files import read_gaussians
from mivol.points.gaussians import Gaussians


def test_convert_writes_what_was_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An SPZ becomes the authors' PLY, and that one points; the numbers are those that were read."""
    (tmp_path / "a.spz").write_bytes(spz_bytes(random_gaussians(9, 1), 3))
    assert main(["convert", str(tmp_path / "a.spz"), str(tmp_path / "b.ply")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'b.ply'}: 9 Gaussians of degree 1\n"
    one, other = read_gaussians(tmp_path / "a.spz"), read_gaussians(tmp_path / "b.ply")
    assert all(np.array_equal(getattr(one, name), getattr(other, name)) for name in vars(one))
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.npy")]) == 0
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.ply"), "--to", "points"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'c.npy'}: 9 points\n{tmp_path / 'c.ply'}: 9 points\n"
    assert np.array_equal(read_points(tmp_path / "c.npy").positions, one.means)
    assert read_points(tmp_path / "c.ply").colours is not None


def test_convert_makes_gaussians_of_points_where_asked(tmp_path: Path) -> None:
    """A PLY may hold either: points stay points where nothing is said."""
    write_points(tmp_path / "a.npy", PointCloud(np.eye(5, 3)[:4]))
    assert main(["convert", str(tmp_path / "a.npy"), str(tmp_path / "b.ply")]) == 0
    assert read_points(tmp_path / "b.ply").colours is None
    assert main(["convert", str(tmp_path / "b.ply"), str(tmp_path / "c.ply"), "--to", "gaussians"]) == 0
    assert read_gaussians(tmp_path / "c.ply").count == 4


def test_convert_refuses_a_format_that_it_does_not_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.ply").write_bytes(inria_bytes(random_gaussians(2, 0)))
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.spz")]) == 1
    assert "the suffix '.spz', expected one of .ply, .npy" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "none.ply"), str(tmp_path / "b.ply")]) == 1
    assert "nothing there" in capsys.readouterr().err


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
