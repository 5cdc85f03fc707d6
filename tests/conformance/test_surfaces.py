"""Depth images become a surface: a ball seen from all sides, against the closed form."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import assert_refused

from mivol.experiments.gaussian_conversion import cameras_around
from mivol.fields.surfaces import DepthView, fuse_depths
from mivol.photos import pixel_centres, rays

RADIUS, MIDDLE = 0.6, np.array([0.1, -0.2, 0.3])
LOW, HIGH = MIDDLE - 0.8, MIDDLE + np.array([0.8, 0.9, 0.8])


def views_of_a_ball(count: int = 24, edge: int = 96) -> list[DepthView]:
    """Depth images of a ball from the roots of a quadratic; the colour is the position."""
    to_world = np.diag([2.0, 2, 2, 1])
    to_world[:3, 3] = MIDDLE - 1
    views = []
    for camera in cameras_around(to_world, edge, count):
        o, d = camera.origin, rays(camera, pixel_centres(camera.size))[1]
        near = -(d @ (o - MIDDLE))
        root = near**2 - (np.sum((o - MIDDLE) ** 2) - RADIUS**2)
        with np.errstate(invalid="ignore"):
            t = np.where(root >= 0, near - np.sqrt(root), np.inf)
        colour = np.where(np.isfinite(t)[..., None], 0.5 + 0.4 * d, 0)
        views.append(DepthView(camera, t * (d @ -camera.to_world[:3, 2]), colour))
    return views


def test_a_ball_comes_back_with_its_normals_and_its_orientation() -> None:
    """Points lie within a voxel (1.7/20) of the ball, half a voxel in the median; normals within 60 degrees, 11 in the median.

    A slanting view takes the depth along its line for the distance, which is too long by 1 / cos, and views past the ball pull
    the surface inwards. Normals follow the steps of the images.
    """
    mesh = fuse_depths(views_of_a_ball(), LOW, HIGH, 20)
    voxel = 1.7 / 20
    away = mesh.points - MIDDLE
    radius = np.linalg.norm(away, axis=1)
    assert np.abs(radius - RADIUS).max() < voxel and np.median(np.abs(radius - RADIUS)) < 0.5 * voxel
    facing = np.sum(mesh.normals * away / radius[:, None], axis=1)
    assert (facing > 0.5).all() and np.median(facing) > 0.98
    a, b, c = (mesh.points[mesh.faces[:, k]] - MIDDLE for k in range(3))
    volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6  # above 0 where corners go round counterclockwise, seen from outside
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.1)
    assert len(mesh.points) - len(mesh.faces) * 3 / 2 + len(mesh.faces) == 2  # closed, of one piece, without a handle


def test_colours_are_means_of_what_views_show_there() -> None:
    """A view along d shows 0.5 + 0.4 d; over the half sphere of views of a point the mean of -d . n is 1/2."""
    mesh = fuse_depths(views_of_a_ball(), LOW, HIGH, 20)
    shown = (mesh.colours - 0.5) / -0.4
    facing = np.sum(shown * mesh.normals, axis=1)
    assert (facing > 0).all() and abs(np.median(facing) - 0.5) < 0.15


def test_one_view_through_a_surface_does_not_tear_a_hole() -> None:
    """Six of 24 views see free space only; about ten views of each surface point have ten times their weight.

    The surface moves inwards by less than a voxel. Deep inside, no other view contributes, and the six views make a hollow.
    """
    views = views_of_a_ball()
    for view in views[::4]:
        view.depth[:] = np.inf
    mesh = fuse_depths(views, LOW, HIGH, 20)
    is_outer = np.linalg.norm(mesh.points - MIDDLE, axis=1) > RADIUS - 1.7 / 20
    faces = is_outer[mesh.faces].all(axis=1).sum()
    assert is_outer.sum() - faces * 3 / 2 + faces == 2


def test_what_has_no_surface_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = views_of_a_ball(2, 8)
    for view in nothing:
        view.depth[:] = np.inf
    for low, high, resolution, said in ((HIGH, LOW, 8, "a corner above the other"), (LOW, HIGH, 1, "at least 2 voxels")):
        assert_refused(said, fuse_depths, [], low, high, resolution)
    assert_refused("no surface was seen", fuse_depths, nothing, LOW, HIGH, 8)
    monkeypatch.setattr("mivol.machine.available_memory", lambda: 64 * 100**3)
    # (1.6 / 1.7)^2 of the cube of 1000^3: 100 / that^(1/3) = 104
    assert_refused("a resolution of at most 104 fits", fuse_depths, nothing, LOW, HIGH, 1000)
