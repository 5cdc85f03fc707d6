"""A sparse grid is its dense twin: values, walks, images and derivatives, in every estimator, for every pattern of bricks.

Both grids visit the same cells with the same arithmetic, so images agree to rounding; sums over lanes have any order. 1e-6 of
the largest value is 8 float32 roundings.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.test_bad_files import refused
from conformance.test_recordings import Pair
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scattering_scenes import PLACE, cases, close_up, sun

import mivol
from mivol.errors import MivolError
from mivol.fields import voxels
from mivol.fields.bricks import Bricks
from mivol.files import SparseVolumeData, check_bricks, write_volume
from mivol.scene_graph import find_children
from mivol.transport.media.grid_extinction import integrate_tau
from mivol.transport.traversal.lattice import Lattice
from scenes import FRAMES, box_of, medium, random_rays, sky

ROUNDING = 1e-6
INSIDE = "smoke.interior_medium."


def patches(rng: np.random.Generator, shape: tuple[int, int, int], channels: int = 1, share: float = 0.3) -> np.ndarray:
    """Random values (Z, Y, X, C) in random patches; the corners of the box are filled, whose outer half voxels are constant."""
    coarse = rng.random(tuple(-(-n // 5) for n in shape)) < share
    mask = coarse.repeat(5, 0).repeat(5, 1).repeat(5, 2)[: shape[0], : shape[1], : shape[2], None]
    values = rng.random((*shape, channels)) * mask * 12
    values[0, 0, 0] = values[-1, -1, -1] = 3
    return values.astype(np.float32)


def cut(values: np.ndarray, offset: tuple[int, int, int] = (0, 0, 0)) -> SparseVolumeData:
    """The bricks of a dense grid, the first brick ``offset`` voxels before the box."""
    margins = [(o, 0) for o in (*offset, 0)]
    whole = SparseVolumeData.from_dense(np.pad(values, margins))
    return SparseVolumeData(whole.values, whole.bricks, values.shape[:3], np.eye(4), offset)


def plugin(volume: SparseVolumeData, **more: object) -> dict:
    """A sparse ``mivol_voxels`` as a dictionary."""
    return {
        "type": "mivol_voxels",
        "data": mi.TensorXf(volume.values),
        "bricks": mi.UInt32(volume.numbers),
        "resolution": list(volume.shape[::-1]),
        "offset": list(volume.offset[::-1]),
        **more,
    }


def lattice_of(volume: mi.Volume, skip: bool | str = True) -> Lattice:
    lattice = Lattice(volume.data, volume.mivol_to_world, bricks=volume.mivol_bricks, trims=skip == "ends")
    return lattice.where_derivatives() if skip else lattice


TWINS = {
    "one brick": (0, (8, 8, 8), (0, 0, 0), 1, "unit", True),
    "part of a brick": (1, (1, 5, 2), (6, 0, 3), 3, "mirrored", False),
    "bricks": (2, (19, 9, 26), (0, 0, 0), 1, "sheared", True),
    "bricks before the box": (3, (17, 24, 11), (7, 1, 5), 1, "rotated", True),
    "ends skipped": (5, (21, 9, 30), (3, 0, 6), 1, "sheared", "ends"),
    "every cell walked": (4, (9, 23, 16), (2, 0, 1), 1, "stretched", False),
}
"""seed, shape, offset, channels, place, and whether the walk skips what is not stored."""


@pytest.mark.parametrize("name", cases(TWINS, slow=("one brick", "part of a brick", "every cell walked")))
def test_a_sparse_grid_is_its_dense_twin(name: str) -> None:
    assert_twins(*TWINS[name])


@pytest.mark.slow
@settings(max_examples=3, deadline=None, derandomize=True, phases=[Phase.generate])
@given(st.integers(0, 2**32 - 1), *2 * [st.tuples(*(st.integers(1, 7) for _ in range(3)))], st.sampled_from(sorted(FRAMES)))
def test_random_sparse_grids_are_their_dense_twins(seed: int, size: tuple, offset: tuple, frame: str) -> None:
    assert_twins(seed, tuple(4 * n - 1 for n in size), offset, 1, frame, True)


def assert_twins(seed: int, shape: tuple, offset: tuple, channels: int, frame: str, skip: bool | str) -> None:
    """Values at points (outer half voxels and outside too), optical depths, and their transposes at stored voxels."""
    rng, to_world = np.random.default_rng(seed), FRAMES[frame]
    values = patches(rng, shape, channels)
    volume = cut(values, offset)
    assert np.array_equal(volume.dense(), values)
    place = mi.ScalarTransform4f(to_world)
    sparse = mi.load_dict(plugin(volume, to_world=place))
    dense = mi.load_dict({"type": "mivol_voxels", "data": mi.TensorXf(values), "to_world": place})
    it = dr.zeros(mi.Interaction3f, 500)
    points = rng.uniform(-0.05, 1.05, (500, 3)) @ to_world[:3, :3].T + to_world[:3, 3]
    it.p = mi.Point3f(points.T.astype(np.float32))
    # The dense grid is Mitsuba's texture, which finds its place in float32: one ulp of 27 voxels, times the steepest slope.
    tolerance = 12 * 8 * 27 * 2.0**-23
    assert np.abs(np.array(sparse.eval_n(it)) - np.array(dense.eval_n(it))).max() <= tolerance

    o, d = (mi.Vector3f(np.asarray(a, np.float32).T) for a in random_rays(rng, to_world, 300)[:2])
    weight = mi.Float(rng.random(300).astype(np.float32))
    found = []
    for lattice in (Lattice(mi.TensorXf(values), to_world), lattice_of(sparse, skip)):
        dr.enable_grad(lattice.values)
        tau = integrate_tau(lattice, o, d)
        dr.backward(sum(weight * t for t in ([tau] if channels == 1 else tau)))
        found.append((np.array(tau), np.array(dr.grad(lattice.values))))
    (truth, gradient), (tau, own) = found
    # Positions after a leap, and products in another kernel, differ by rounding: each optical depth is within its stated bound,
    # and h |grad sigma| <= 36.
    length = np.linalg.norm(to_world[:3, :3] @ np.ones(3))
    assert np.abs(tau - truth).max() <= 2 * 2e-6 * (12 + 36) * length
    own = SparseVolumeData(own, volume.bricks, shape, np.eye(4), offset).dense()
    is_stored = SparseVolumeData(np.ones_like(volume.values), volume.bricks, shape, np.eye(4), offset).dense() > 0
    # A leap moves a position by at most 2^-23 of a cell for each cell crossed, and each of three factors of a weight likewise.
    moved = 3 * 2 * sum(shape) * 2.0**-23
    assert np.abs(own - gradient * is_stored).max() <= (moved + 8 * ROUNDING) * np.abs(gradient).max()
    assert not own[~is_stored].any()


def smoke_scene(grid: dict, depth: int, albedo: float = 0.8, **more: dict) -> mi.Scene:
    emission = {k: more.pop(k) for k in ("emission", "emission_density", "scale") if k in more}
    smoke = medium("mivol_medium", grid | {"to_world": mi.ScalarTransform4f(PLACE)}, albedo, **emission)
    integrator = {"type": "mivol", "max_depth": depth}
    return close_up({"smoke": box_of(smoke, PLACE), "integrator": integrator, **(more or {"sky": sky(0.7)})}, res=10)


SUN = {"sun": sun([0.3, 0.2, -1.0])[0]}
ESTIMATORS: dict[str, dict] = {
    "absorption": {"depth": 1, "albedo": 0.0},
    "one scattering": {"depth": 2},
    "one scattering, sun": {"depth": 2, "scale": 1.5, **SUN},
    "flights": {"depth": 5, "scale": 1.5, **SUN},
    "emission": {"depth": 1, "albedo": 0.0, "emission": 2.0},
    "emission density": {"depth": 3, "emission_density": 2.0},
}


@pytest.mark.parametrize("channels", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", cases(ESTIMATORS, slow=("one scattering", "emission")))
def test_images_and_derivatives_are_those_of_the_dense_grid(name: str, channels: int) -> None:
    """Every brick of this grid is stored, so the random numbers of derivatives are the same too."""
    values = np.maximum(patches(np.random.default_rng(3), (13, 17, 21), channels), 0.01).astype(np.float32)
    images, gradients = [], []
    for grid in ({"type": "mivol_voxels", "data": mi.TensorXf(values)}, plugin(cut(values, (0, 3, 7)))):
        scene = smoke_scene(grid, **ESTIMATORS[name])
        params = mi.traverse(scene)
        images.append(np.array(mi.render(scene, seed=1, spp=4)))
        key = INSIDE + "sigma_t.data"
        dr.enable_grad(params[key])
        dr.backward(dr.mean(dr.square(mi.render(scene, params, seed=2, spp=4)), axis=None))
        gradients.append(np.array(dr.grad(params[key])))
    volume = cut(values, (0, 3, 7))
    own = SparseVolumeData(gradients[1], volume.bricks, volume.shape, np.eye(4), volume.offset).dense()
    assert np.abs(images[1] - images[0]).max() <= ROUNDING * images[0].max()
    # Sums over 1600 lanes in any order: 40 roundings of the sum of magnitudes.
    assert np.abs(own - gradients[0]).max() <= 40 * ROUNDING * np.abs(gradients[0]).max()
    assert np.abs(own).max() > 0


ROLES: dict[str, dict] = {
    "albedo, one scattering": {"roles": ("albedo",), "depth": 2},
    "albedo, flights": {"roles": ("albedo",), "depth": 5, **SUN},
    "emission": {"roles": ("emission",), "depth": 1},
    "emission density": {"roles": ("emission_density",), "depth": 3},
    "all, each in its own place": {"roles": ("sigma_t", "albedo", "emission"), "depth": 4, "moves": True, **SUN},
    "all, absorbing": {"roles": ("sigma_t", "emission"), "depth": 1, "moves": True},
}
"""The sparse grids of a medium, and whether each has another place and resolution than the extinction."""


def grids_of(roles: tuple[str, ...], moves: bool, is_sparse: bool, channels: int) -> dict[str, dict]:
    """The grids of a medium; where ``moves``, they have resolutions of their own, and boxes that end in it or beyond."""
    grids = {}
    for k, role in enumerate(("sigma_t", "albedo", "emission", "emission_density")):
        if role not in roles and role != "sigma_t":
            continue
        rng, shape = np.random.default_rng(30 + k), (13 + 3 * k * moves, 17 - 2 * k * moves, 15)
        values = np.maximum(patches(rng, shape, 1 if role == "sigma_t" else channels), 0.01).astype(np.float32)
        if role == "albedo":
            values /= values.max() * 1.1
        move = np.eye(4)
        if moves and k:
            move[:3, :3], move[:3, 3] = np.diag([1.1, 0.8, 1.3 - 0.2 * k]), (-0.05, 0.1, 0.05 * k)
        place = mi.ScalarTransform4f(PLACE @ move)
        given = (
            plugin(cut(values, (k, 3, 7)))
            if is_sparse and role in roles
            else {"type": "mivol_voxels", "data": mi.TensorXf(values)}
        )
        grids[role] = given | {"to_world": place}
    return grids


@pytest.mark.parametrize("channels", [1, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", cases(ROLES, slow=("albedo, one scattering", "emission density", "all, absorbing")))
def test_other_grids_of_a_medium_are_their_dense_twins(name: str, channels: int) -> None:
    """As the test before, for albedo and emission, and for grids of several resolutions and places in one medium."""
    given = dict(ROLES[name])
    roles, depth, moves = given.pop("roles"), given.pop("depth"), given.pop("moves", False)
    images, gradients = [], []
    for is_sparse in (False, True):
        grids = {"albedo": 0.0 if depth == 1 else 0.8} | grids_of(roles, moves, is_sparse, channels)
        integrator = {"type": "mivol", "max_depth": depth}
        smoke = {"type": "mivol_medium", **grids}
        scene = close_up({"smoke": box_of(smoke, PLACE), "integrator": integrator, **(given or {"sky": sky(0.7)})}, res=10)
        params = mi.traverse(scene)
        images.append(np.array(mi.render(scene, seed=1, spp=4)))
        keys = [f"{INSIDE}{role}.data" for role in roles]
        for key in keys:
            dr.enable_grad(params[key])
        dr.backward(dr.mean(dr.square(mi.render(scene, params, seed=2, spp=4)), axis=None))
        found = [np.array(dr.grad(params[key])) for key in keys]
        if is_sparse:
            bricks = [find_children(scene.shapes()[0].interior_medium())[role].mivol_bricks for role in roles]
            found = [unfold(g, b) for g, b in zip(found, bricks, strict=True)]
        gradients.append(found)
    assert np.abs(images[1] - images[0]).max() <= ROUNDING * images[0].max()
    for own, dense in zip(gradients[1], gradients[0], strict=True):
        # Sums over 1600 lanes in any order: 40 roundings of the sum of magnitudes.
        assert np.abs(own - dense).max() <= 40 * ROUNDING * np.abs(dense).max()
        assert np.abs(own).max() > 0


def unfold(values: np.ndarray, bricks: Bricks) -> np.ndarray:
    """The dense grid (Z, Y, X, C) of values in bricks."""
    places = np.stack(np.unravel_index(np.array(bricks.stored), bricks.counts), axis=1).astype(np.int32)
    return SparseVolumeData(values, places, bricks.res, np.eye(4), bricks.offset).dense()


@pytest.mark.parametrize("depth", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_a_derivative_is_the_slope_of_the_image(depth: int) -> None:
    """Common random numbers: the image is a smooth function of a stored voxel, if flights do not depend on it (depth 1)."""
    values = np.zeros((24, 8, 8, 1), np.float32)
    values[2:6] = values[20:] = 1.5
    scene = smoke_scene(plugin(cut(values)), depth, 0.0 if depth == 1 else 0.6)
    params, key = mi.traverse(scene), INSIDE + "sigma_t.data"
    start = np.array(params[key])
    direction = np.random.default_rng(0).random(start.shape).astype(np.float32) * (start > 0)
    spp = 16 if depth == 1 else 4096

    def loss(step: float) -> float:
        params[key] = mi.TensorXf(start + step * direction)
        params.update()
        return float(np.array(mi.render(scene, seed=3, spp=spp), np.float64).mean())

    slope = (loss(0.05) - loss(-0.05)) / 0.1 if depth == 1 else (loss(0.4) - loss(0)) / 0.4
    params[key] = mi.TensorXf(start)
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, seed=3, spp=spp), axis=None))
    found = float((np.array(dr.grad(params[key]), np.float64) * direction).sum())
    # exp(-tau) has a third derivative of at most its slope: 0.05^2 / 6; float32 images of 100 pixels round to 1e-6 / 0.1. With
    # scattering, a one-sided step bends by 0.4 / 2 of itself at most.
    assert slope < 0 and abs(found / slope - 1) < (2e-3 if depth == 1 else 0.25)


def test_recordings_follow_values_and_bricks() -> None:
    values = patches(np.random.default_rng(1), (20, 20, 20), share=0.2)
    pair = Pair(smoke_scene(plugin(cut(values)), 4), 4)
    key = INSIDE + "sigma_t.data"
    for call in range(3):
        pair.scale(key, 0.9)
        pair.assert_same(call)
        found, truth = pair.gradients(key, call)
        assert np.array_equal(found, truth) and truth.any()
    count = pair.recordings.count
    other = cut(patches(np.random.default_rng(2), (20, 20, 20), share=0.2))
    keep = min(len(other.values), len(np.array(pair.params[INSIDE + "sigma_t.bricks"])))
    pair.params[key], pair.params[INSIDE + "sigma_t.bricks"] = mi.TensorXf(other.values), mi.UInt32(other.numbers)
    pair.params.update()
    pair.assert_same(5)
    fresh = smoke_scene(plugin(other), 4)
    assert np.array_equal(np.array(mi.render(fresh, seed=5, spp=2)), np.array(mi.render(pair.scene, seed=5, spp=2)))
    assert keep > 0 and pair.recordings.count >= count and not any(pair.recordings.failures.values())


def test_storage_is_chosen_by_size_and_share(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = np.zeros((32, 32, 32, 1), np.float32)
    few[3, 4, 5] = 2
    write_volume(tmp_path / "few.vdb", np.pad(few, ((0, 30), (0, 30), (0, 30), (0, 0))) + 0)
    spread = np.zeros((40, 40, 40, 1), np.float32)
    spread[0, 0, 0] = spread[-1, -1, -1] = 1
    write_volume(tmp_path / "spread.vdb", spread)
    load = lambda **given: mi.load_dict({"type": "mivol_voxels", "filename": str(tmp_path / "spread.vdb"), **given})  # noqa: E731
    assert load().mivol_bricks is None and load(storage="sparse").mivol_bricks.count == 2
    monkeypatch.setattr(voxels, "LEAST_SPARSE_BYTES", 1 << 10)
    assert load().mivol_bricks.count == 2 and load(storage="dense").mivol_bricks is None
    monkeypatch.setattr(voxels, "MAX_STORED_SHARE", 1e-3)
    assert load().mivol_bricks is None
    # A program's own array stays the array that it gave.
    assert mi.load_dict({"type": "mivol_voxels", "data": mi.TensorXf(spread)}).mivol_bricks is None
    assert mi.load_dict({"type": "mivol_voxels", "data": mi.TensorXf(spread), "storage": "sparse"}).mivol_bricks.count == 2


def test_explain_says_what_is_stored() -> None:
    values = np.zeros((64, 64, 64, 1), np.float32)
    values[:8, :8, :8] = 1
    lines = str(mivol.explain(smoke_scene(plugin(cut(values)), 2)))
    assert "0.2% of its voxels are stored, 0.00195 MiB a channel instead of 1" in lines


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"storage": "vdb"}, "expected one of auto, dense, sparse"),
        ({"bricks": [0, 1]}, "places of shape"),
        ({"resolution": [0, 9, 9]}, "expected voxels of at least 1 and offsets of 0 to 7"),
        ({"resolution": [1, 23200, 23200]}, "at most 2^23 bricks"),
        ({"offset": [8, 0, 0]}, "expected voxels of at least 1 and offsets of 0 to 7"),
        ({"bricks": [0, 1, 2, 3, 4, 5, 6, 8]}, "numbers below 8 in a box of (2, 2, 2) bricks"),
        ({"bricks": [0, 1, 2, 3, 4, 5, 7, 6]}, "bricks out of order or twice"),
        ({"resolution": None}, "found sparse data without resolution"),
    ],
    ids=lambda v: next(iter(v)) if isinstance(v, dict) else None,
)
def test_bad_bricks_are_refused(given: dict, words: str) -> None:
    ready = {k: mi.UInt32(v) if k == "bricks" else v for k, v in given.items()}
    whole = plugin(cut(np.ones((9, 9, 9, 1), np.float32))) | ready
    with pytest.raises((MivolError, RuntimeError)) as caught:
        mi.load_dict({k: v for k, v in whole.items() if v is not None})
    assert words in str(caught.value)


def test_fewer_values_than_the_slots_are_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    volume = plugin(cut(np.ones((9, 9, 9, 1), np.float32)))
    monkeypatch.setattr(voxels, "MOST_SLOTS", 8 * 512 + 1)
    mi.load_dict(volume)
    monkeypatch.setattr(voxels, "MOST_SLOTS", 8 * 512)
    with pytest.raises(RuntimeError, match=r"fewer than 2\^31 values"):
        mi.load_dict(volume)


def test_a_bad_voxel_is_named_by_its_place_in_the_box() -> None:
    values = np.ones((9, 9, 9, 1), np.float32)
    values[8, 2, 7] = -1
    with refused("-1 at voxel (z=8, y=2, x=7, channel=0)"):
        check_bricks(cut(values, (1, 2, 3)), name="grid")


def test_data_and_bricks_change_together() -> None:
    scene = smoke_scene(plugin(cut(patches(np.random.default_rng(0), (9, 9, 9)))), 1)
    params = mi.traverse(scene)
    params[INSIDE + "sigma_t.data"] = mi.TensorXf(np.ones((3, 8, 8, 8, 1), np.float32))
    with refused("replace data and bricks together"):
        params.update()


def test_memory_is_that_of_the_bricks() -> None:
    """The tables of a grid of 512^3: 4 bytes a brick of the box, and a word for eight of 129^3 blocks."""
    volume = SparseVolumeData(np.ones((2, 8, 8, 8, 1), np.float32), np.array([[0, 0, 0], [63, 63, 63]]), (512,) * 3, np.eye(4))
    scene = smoke_scene(plugin(volume), 1)
    voxels_of = find_children(scene.shapes()[0].interior_medium())["sigma_t"]
    arrays = [voxels_of.data.array, voxels_of.table, voxels_of.distances, voxels_of.bricks]
    held = sum(dr.width(a) * dr.itemsize_v(type(a)) for a in arrays)
    assert held == 2 * 512 * 4 + 64**3 * 4 + (129**3 + 7) // 8 * 4 + 2 * 4


def test_a_fit_keeps_no_values_of_earlier_steps() -> None:
    """A reading keeps its array, so readings of earlier steps would hold their values."""
    scene, integrator = (
        smoke_scene(plugin(cut(patches(np.random.default_rng(0), (9, 9, 9)))), 2),
        mi.load_dict({"type": "mivol"}),
    )
    params, key = mi.traverse(scene), INSIDE + "sigma_t.data"
    for _ in range(4):
        params[key] = dr.detach(params[key]) * 0.9
        dr.make_opaque(params[key])
        dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))
    kept = integrator.session._surveyed.survey.values
    assert {array.index for (kind, _), (array, _) in kept.items() if kind == "part"} == {dr.detach(params[key]).array.index}
