"""``mivol_octree`` as extinction and albedo of a medium: exact optical depths, voxels that it joins, and refused values."""

from __future__ import annotations

import itertools
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from false_alarms import assert_precise, assert_same_mean
from octrees import random_octree

from mivol.fields.field_files import write_field
from mivol.transport.media.extinction import RayInterval
from mivol.transport.media.octree_extinction import LeafField, OctreeExtinction, merge_voxels
from mivol.validate.statistics import Moments
from scenes import box_of, camera, medium

KEY = "box.interior_medium.sigma_t.data"


def blocks(n: int = 8, seed: int = 3) -> np.ndarray:
    """Voxels (n, n, n, 1) of which whole octants are equal, others differ, and some are 0."""
    rng = np.random.default_rng(seed)
    values = rng.random((n, n, n, 1)).astype(np.float32) * 3
    values[: n // 2, : n // 2] = 1.25
    values[n // 2 :, :, n // 2 :] *= rng.random((n // 2, n, n // 2, 1)) > 0.5
    return values


def field(values: np.ndarray, tolerance: float = 0.0, to_world: np.ndarray | None = None) -> LeafField:
    depth, codes, sizes, leaves = merge_voxels(values, tolerance)
    return LeafField(depth, np.eye(4) if to_world is None else to_world, codes, sizes, mi.TensorXf(leaves))


def nearest_depth(values: np.ndarray, o: np.ndarray, d: np.ndarray, t0: float, t1: float) -> float:
    """Optical depth of a grid of nearest nodes over the unit cube, from plane to plane in float64."""
    n = np.array(values.shape[2::-1], np.float64)
    planes = np.concatenate([(np.arange(k + 1) / k - x) / v for k, x, v in zip(n, o, d, strict=True)])
    t = np.unique(np.clip(planes, t0, t1))
    total = 0.0
    for a, b in itertools.pairwise(t):
        at = np.floor((o + (a + b) / 2 * d) * n).astype(int)
        if ((at >= 0) & (at < n)).all():
            total += (b - a) * float(values[at[2], at[1], at[0], 0])
    return total


def random_rays(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    o = rng.normal(size=(count, 3))
    o = 0.5 + 1.5 * o / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.random((count, 3)) - o
    return np.float32(o), np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))


def interval(o: np.ndarray, d: np.ndarray, t0: float = 0.0, t1: float = 10.0) -> RayInterval:
    ray = mi.Ray3f(mi.Point3f(np.ascontiguousarray(o.T)), mi.Vector3f(np.ascontiguousarray(d.T)))
    width = len(o)
    return RayInterval(ray, dr.full(mi.Float64, t0, width), dr.full(mi.Float64, t1, width), dr.full(mi.Bool, True, width))


@pytest.mark.parametrize("ends", [(0.0, 10.0), (0.9, 1.6)])
def test_optical_depths_equal_those_of_nearest_nodes(variant_rgb: str, ends: tuple[float, float]) -> None:
    """To 1e-6 of the largest extinction times the length, in uniform leaves and in joined ones."""
    values = blocks()
    o, d = random_rays(64)
    (found,) = OctreeExtinction("sigma_t", field(values)).integrate(interval(o, d, *ends))
    expected = [nearest_depth(values, a, b, *ends) for a, b in zip(np.float64(o), np.float64(d), strict=True)]
    assert max(expected) > 0.5
    assert np.abs(np.array(found) - expected).max() < 1e-6 * values.max() * 2


def test_equal_voxels_share_a_leaf_and_empty_ones_have_none(variant_rgb: str) -> None:
    depth, codes, sizes, leaves = merge_voxels(blocks(), 0.0)
    assert depth == 3
    # Two octants of 4^3 equal voxels (low z, low y) are one leaf each.
    assert (sizes == 2).sum() == 2
    assert (leaves[sizes == 2] == 1.25).all()
    assert len(codes) == (blocks() > 0).sum() - 2 * 64 + 2
    coarse = merge_voxels(blocks(), 0.99)
    assert len(coarse[1]) < len(codes)
    # Joined leaves keep the mean: no matter is lost where all eight voxels have some.
    full = merge_voxels(1 + blocks(), 0.99)
    assert (full[3][:, 0] * 8.0 ** full[2]).sum() == pytest.approx((1 + blocks()).sum(), rel=1e-5)


def test_a_collision_lies_at_its_optical_depth(variant_rgb: str) -> None:
    part = OctreeExtinction("sigma_t", field(blocks()))
    o, d = random_rays(64)
    whole = np.array(part.integrate(interval(o, d))[0])
    goal = mi.Float(np.float32(0.6 * whole))
    t = np.array(part.find_collision(mi.Float(1), interval(o, d), goal, mi.UInt32(0)))
    hits = whole > 0
    up_to = [
        nearest_depth(blocks(), a, b, 0.0, c) for a, b, c in zip(np.float64(o)[hits], np.float64(d)[hits], t[hits], strict=True)
    ]
    assert np.abs(up_to - np.array(goal)[hits]).max() < 3e-6 * blocks().max() * 2
    beyond = part.find_collision(mi.Float(1), interval(o, d), mi.Float(np.float32(1.01 * whole + 0.01)), mi.UInt32(0))
    assert np.isinf(np.array(beyond)).all()


def test_derivatives_are_those_of_a_sum(variant_rgb: str) -> None:
    """The optical depth is linear in the values: its tangent is the optical depth of the tangents, and vjp its transpose."""
    part = OctreeExtinction("sigma_t", field(blocks()))
    o, d = random_rays(32)
    rng = np.random.default_rng(0)
    change = rng.random(part.field.leaves).astype(np.float32)
    weight = rng.random(32).astype(np.float32)
    along = np.array(part.jvp(mi.Float(change), interval(o, d))[0])
    gradient = part.start_gradient()
    part.vjp(gradient, [mi.Float(weight)], interval(o, d))
    assert np.dot(np.float64(gradient), change) == pytest.approx(np.dot(along, np.float64(weight)), rel=1e-5)


def scene(sigma_t: dict, albedo: object = 0.6, kind: str = "mivol_medium") -> mi.Scene:
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "mivol", "max_depth": 5},
            "sensor": camera((0.4, -2, 0.7), (0.5, 0.5, 0.5), 4, 30),
            "light": {"type": "constant"},
            "box": box_of(medium(kind, sigma_t, albedo), np.eye(4)),
        }
    )


def moments(values: list[float]) -> Moments:
    found = np.array(values, np.float64)
    return Moments(len(found), found.mean(), ((found - found.mean()) ** 2).sum())


@pytest.mark.slow
@pytest.mark.statistical
def test_scattering_equals_volpath_in_nearest_voxels(variant_rgb: str) -> None:
    """An image at depth 5 with an octree as extinction and as albedo, beside Mitsuba's nearest ``gridvolume``."""
    values, albedo = 2 * blocks(), 0.3 * blocks(seed=5) / 3 + 0.5
    octree = scene({"type": "mivol_octree", "data": mi.TensorXf(values)}, {"type": "mivol_octree", "data": mi.TensorXf(albedo)})
    grid = {"type": "gridvolume", "filter_type": "nearest", "raw": True}
    stock = scene(grid | {"grid": mi.VolumeGrid(values)}, grid | {"grid": mi.VolumeGrid(albedo)}, "heterogeneous")
    volpath = mi.load_dict({"type": "volpath", "max_depth": 5, "rr_depth": 64})
    runs = 16
    ours = moments([np.array(mi.render(octree, spp=256, seed=k)).mean() for k in range(runs)])
    theirs = moments([np.array(mi.render(stock, integrator=volpath, spp=256, seed=99 + k)).mean() for k in range(runs)])
    assert_precise(ours, 0.01 * float(ours.mean), what="mean pixels")
    assert_same_mean(ours, theirs, what="mean pixels")


@pytest.mark.slow
def test_a_fit_through_scattering_finds_the_values(variant_rgb: str) -> None:
    """Ten steps of Adam from a uniform octree towards the image of another at least halve the squared error."""
    target = scene({"type": "mivol_octree", "data": mi.TensorXf(2 * blocks())})
    reference = mi.render(target, spp=2048, seed=99)
    box = scene({"type": "mivol_octree", "data": mi.TensorXf(np.where(blocks() > 0, np.float32(0.5) + 1e-6 * blocks(), 0))})
    params = mi.traverse(box)
    optimizer = mi.ad.Adam(lr=0.2, params={KEY: params[KEY]})
    errors = []
    for step in range(11):
        optimizer[KEY] = dr.maximum(dr.detach(optimizer[KEY]), 0)
        params.update(optimizer)
        errors.append(float(dr.mean(dr.square(mi.render(box, spp=512, seed=7) - reference), axis=None).array[0]))
        dr.backward(dr.mean(dr.square(mi.render(box, params, spp=128, seed=step) - reference), axis=None))
        optimizer.step()
    assert errors[-1] < 0.5 * errors[0], errors


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, "given no values: give filename or data"),
        ({"data": np.zeros((2, 2, 2, 1), np.float32)}, "no value above 0"),
        ({"data": -np.ones((2, 2, 2, 1), np.float32)}, "mivol_octree"),
        ({"data": np.full((2, 2, 2, 1), np.nan, np.float32)}, "mivol_octree"),
        ({"data": np.ones((2, 2, 2, 1), np.float32), "tolerance": 2.0}, "a tolerance of 2: 0 to 1 of the largest value"),
    ],
)
def test_invalid_values_are_refused(variant_rgb: str, given: dict, said: str) -> None:
    tensors = {name: mi.TensorXf(v) if isinstance(v, np.ndarray) else v for name, v in given.items()}
    with pytest.raises((RuntimeError, ValueError), match=said):
        mi.load_dict({"type": "mivol_octree", **tensors})


def test_a_step_below_zero_is_refused(variant_rgb: str) -> None:
    params = mi.traverse(mi.load_dict({"type": "mivol_octree", "data": mi.TensorXf(blocks())}))
    params["data"] = mi.TensorXf(np.full(params["data"].shape, -0.5, np.float32))
    with pytest.raises((RuntimeError, ValueError), match=r"leaf 0 of a mivol_octree has the value \[-0.5\]"):
        params.update()


@pytest.mark.parametrize("moved", [False, True])
def test_an_octree_file_stands_where_it_was_fitted_unless_it_is_moved(variant_rgb: str, tmp_path: Path, moved: bool) -> None:
    tree, elsewhere = random_octree(3), np.diag([3.0, 3.0, 3.0, 1.0])
    write_field(tmp_path / "tree.npz", tree, half=False)
    props = mi.Properties("mivol_octree")
    props["filename"] = str(tmp_path / "tree.npz")
    if moved:
        props["to_world"] = mi.ScalarTransform4f(elsewhere)
    np.testing.assert_allclose(LeafField.from_props(props).to_world, elsewhere if moved else tree.to_world, atol=1e-6)
