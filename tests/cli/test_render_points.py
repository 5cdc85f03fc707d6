"""``mivol render`` of clouds of points and of Gaussians: a picture in one command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gaussian_sets import random_gaussians
from skimage.io import imread

from mivol.cli import main
from mivol.experiments.render import frame_points
from mivol.points.cloud import PointCloud, write_points
from mivol.points.gaussian_files import write_gaussians

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
