"""<volume type="mivol_sh">: a radiance field in a scene, with surfaces, derivatives and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from octrees import random_octree
from refusals import assert_refused
from scattering_scenes import cases

from mivol.experiments.script import explain
from mivol.fields.field_files import read_field, write_field
from mivol.fields.harmonics import decode_srgb_code
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.hash_grid import HashField
from mivol.fields.resampling import sample_to_grid
from mivol.fields.spherical_grid import SphericalGrid
from mivol.files import encode_srgb
from mivol.files.image_files import decode_srgb
from mivol.optim.photographs.sampled_problem import find_region
from scenes import box_of, camera, centred, refused, render, rotation, sky, tensor, transform

PLACE = centred(2 * np.eye(3))

KEY = "box.interior_medium.emission"


def values(seed: int = 0, res: tuple[int, int, int] = (5, 6, 7), basis: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    density = rng.normal(1, 3, (*res, 1)).astype(np.float32)
    return density, rng.normal(0, 0.3, (*res, basis, 3)).astype(np.float32)


def field(place: np.ndarray = PLACE, seed: int = 0, **more: object) -> dict:
    density, sh = values(seed)
    volume = {"type": "mivol_sh", "density": tensor(density), "sh": tensor(sh), "to_world": transform(place), **more}
    return box_of({"type": "mivol_medium", "emission": volume}, place)


def scene(volume: dict, integrator: dict | None = None, **more: object) -> mi.Scene:
    parts = {"sensor": camera([1.5, 1.8, 4], [0, 0, 0], 12, 45), "box": volume, "sky": sky(0.5)}
    return mi.load_dict({"type": "scene", "integrator": integrator or {"type": "mivol"}, **parts, **more})


def image(volume: dict, **more: object) -> np.ndarray:
    return render(scene(volume, **more), {"type": "mivol"}, 4)


def test_parameters_and_their_shapes(variant_rgb: None) -> None:
    params = mi.traverse(scene(field()))
    assert tuple(params[f"{KEY}.density"].shape) == (5, 6, 7, 1)
    assert tuple(params[f"{KEY}.sh"].shape) == (5, 6, 7, 4, 3)
    assert f"{KEY.rpartition('.')[0]}.scale" not in params


def test_negative_values_add_nothing_to_the_optical_depth(variant_rgb: str) -> None:
    """ReLU: at most 1 along the diagonal of the box of edge 2, whatever stands below 0."""
    density, colours = np.full((4, 4, 4, 1), -5, np.float32), tensor(np.zeros((4, 4, 4, 1, 3), np.float32))
    density[0, 0, 0] = 1
    made = field(density=tensor(density), sh=colours, activation="relu")
    assert f"optical depth at most {2 * 3**0.5:.3g}" in explain(scene(made))


@pytest.mark.slow
def test_a_constant_colour_is_a_constant_source(variant_rgb: None) -> None:
    """C = c (1 - T) + B T for any density: colour 0.5 + 0.282095 k of degree 0, whatever the activation."""
    density, sh = values()
    sh[:] = 0
    sh[..., 0, :] = [1.0, -0.5, 0.2]
    colour = 0.5 + 0.28209479 * sh[0, 0, 0, 0]
    for activation in ("relu", "softplus", "exp"):
        made = field(density=tensor(density), sh=tensor(sh), activation=activation)
        shown = render(scene(made), {"type": "mivol", "aovs": "alpha"}, 4)
        alpha = shown[..., -1:]
        # Rounding alone: a ray sums some 20 cells, each with 4 roundings of 6e-8.
        assert np.abs(shown[..., :3] - (colour * alpha + 0.5 * (1 - alpha))).max() < 5e-6
        assert np.ptp(alpha) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("activation", cases(["none", "relu", "softplus", "exp"], ["none", "relu", "softplus"]))
def test_derivatives_against_differences(activation: str, variant_rgb: None) -> None:
    """Reverse and forward, of both parameters, against central differences with the same samples, at depth 2 among surfaces."""
    density, sh = values()
    if activation == "none":
        density = np.abs(density) + 0.1
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse"}}
    made = field(density=tensor(density), sh=tensor(sh), activation=activation)
    loaded = scene(made, {"type": "mivol", "max_depth": 2}, ball=ball)
    params, integrator = mi.traverse(loaded), loaded.integrator()
    rng = np.random.default_rng(3)
    start = {name: np.array(params[f"{KEY}.{name}"]) for name in ("density", "sh")}
    steps = {name: rng.normal(size=v.shape).astype(np.float32) for name, v in start.items()}
    weight = rng.normal(size=(12, 12, 3)).astype(np.float32)

    def put(name: str, t: float, tangent: bool | None = None) -> mi.TensorXf:
        x = tensor(start[name] + np.float32(t) * steps[name])
        if tangent is not None:
            dr.enable_grad(x)
        if tangent:
            dr.set_grad(x, tensor(steps[name]))
        params[f"{KEY}.{name}"] = x
        return x

    def shown(name: str, t: float) -> np.ndarray:
        put(name, t)
        params.update()
        return np.array(mi.render(loaded, seed=1, spp=4), dtype=np.float64)

    eps = 1e-3
    expected, size = {}, {}
    for name in start:
        change = (shown(name, eps) - shown(name, -eps)) / (2 * eps)
        expected[name], size[name] = float((change * weight).sum()), float(np.abs(change * weight).sum())
        put(name, 0)

    attached = {name: put(name, 0, False) for name in start}
    params.update()
    integrator.render_backward(loaded, params, tensor(weight), seed=1, spp=4)
    reverse = {name: float((np.array(dr.grad(x)) * steps[name]).sum()) for name, x in attached.items()}
    for name in start:
        # A difference of float32 images: 6e-8 of a radiance near 1, over 2e-3, in each of 432 values, 1e-4 of their sum; and
        # the cells in which a relu sets in between the two, a share of eps times the slope (0.3 a length in 1e-3): 3e-3.
        assert abs(reverse[name] - expected[name]) < 4e-3 * size[name]

    for name in start:
        put(name, 0, True)
    params.update()
    forward = float((np.array(integrator.render_forward(loaded, params, seed=1, spp=4)) * weight).sum())
    # The two modes do the same sums in another order.
    assert abs(forward - sum(reverse.values())) < 1e-4 * sum(size.values())


def test_the_colour_of_a_node(variant_rgb: None) -> None:
    """At a node the colour is 0.5 + Y k, Y of the direction in which the eye looks: Y_1 = 0.488603 (-y, z, -x) (Sloan 2008)."""
    density, sh = values()
    volume = field(density=tensor(density), sh=tensor(sh))["interior"]["emission"]
    loaded = mi.load_dict({**volume, "to_world": mi.ScalarTransform4f()})
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p = mi.Point3f(2.5 / 7, 1.5 / 6, 3.5 / 5)  # node x 2, y 1, z 3
    d = np.array([2.0, -1, 2]) / 3
    mei.wi = mi.Vector3f([float(-v) for v in d])
    basis = np.array([0.28209479, -0.48860251 * d[1], 0.48860251 * d[2], -0.48860251 * d[0]])
    expected = np.maximum(0.5 + basis @ sh[3, 1, 2], 0)
    # 8 roundings of terms below 1.
    assert np.abs(np.array(loaded.eval(mei)).ravel() - expected).max() < 5e-7
    assert abs(loaded.eval_1(mei)[0] - max(density[3, 1, 2, 0], 0)) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("aov", ["tau", "depth"])
def test_aovs_have_derivatives(aov: str, variant_rgb: None) -> None:
    """The optical depth and the mean distance are those of the extinction after the activation, forwards and backwards."""
    density, sh = values()
    loaded = scene(field(density=tensor(density), sh=tensor(sh), activation="exp"), {"type": "mivol", "aovs": aov})
    params, key = mi.traverse(loaded), f"{KEY}.density"
    step = np.random.default_rng(3).normal(size=density.shape).astype(np.float32)
    weight = np.zeros((12, 12, 4), np.float32)
    weight[..., 3] = np.random.default_rng(4).uniform(0.5, 1, (12, 12))

    def shown(t: float) -> np.ndarray:
        params[key] = tensor(density + np.float32(t) * step)
        params.update()
        return np.array(mi.render(loaded, seed=1, spp=4), dtype=np.float64)

    change = (shown(1e-2) - shown(-1e-2)) / 2e-2 * weight
    x = tensor(density)
    dr.enable_grad(x)
    params[key] = x
    params.update()
    loaded.integrator().render_backward(loaded, params, tensor(weight), seed=1, spp=4)
    # exp(x): the difference errs by eps^2 / 6 of its third derivative, 2e-5 of it where the step is 1, 3e-4 where it is 4.
    assert abs(float((np.array(dr.grad(x)) * step).sum()) - change.sum()) < 1e-3 * np.abs(change).sum()


def test_turning_the_field_turns_its_look(variant_rgb: None) -> None:
    """A camera that turns with the field sees the same picture: directions are in the field's own frame."""
    turn = np.eye(4)
    turn[:3, :3] = rotation([1, 2, 3], 0.8)
    here = image(field())
    there = {"sensor": camera(turn[:3, :3] @ [1.5, 1.8, 4], [0, 0, 0], 12, 45)}
    there["sensor"]["to_world"] = transform(turn) @ camera([1.5, 1.8, 4], [0, 0, 0], 12, 45)["to_world"]
    turned = image(field(turn @ PLACE), **there)
    # Entry points round differently: 1e-6 of a voxel, where colours differ by about 1 from voxel to voxel.
    assert np.abs(turned - here).max() < 2e-4
    without = image(field(turn @ PLACE))
    assert np.abs(without - here).max() > 0.05


@pytest.mark.slow
def test_a_surface_hides_what_is_behind_it_and_is_seen_through_the_field(variant_rgb: None) -> None:
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [1.5, 1.8, 4], [0, 1, 0]).scale(20),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}},
    }
    loaded = scene(field(), wall=wall)
    params = mi.traverse(loaded)
    x = params[f"{KEY}.density"]
    dr.enable_grad(x)
    loaded.integrator().render_backward(loaded, params, dr.ones(mi.TensorXf, (12, 12, 3)), seed=0, spp=4)
    hidden = np.array(dr.grad(x))[..., 0]
    # Voxels further than a voxel's diagonal (0.6) behind the plane through the origin cannot be seen.
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n * 2 - 1 for n in (5, 6, 7)), indexing="ij")
    depth = (np.stack([x, y, z], -1) @ np.array([1.5, 1.8, 4])) / np.linalg.norm([1.5, 1.8, 4])
    assert (hidden[depth < -0.7] == 0).all()
    assert np.abs(hidden[depth > 0.2]).max() > 0


def test_a_sparse_field_renders_as_the_dense_one(variant_rgb: None, tmp_path: Path) -> None:
    """What is stored at all nodes that are not empty gives the same image; half floats move it by their 11 bits."""
    density, sh = values()
    density[:, :2], sh[:, :2] = 0, 0
    keep = np.ones(density.shape[:3], bool)
    keep[:, :2] = False
    dense = SphericalGrid.from_dense(density, sh, PLACE, space="linear")
    for half, bound in ((False, 1e-6), (True, 5e-3)):
        write_field(tmp_path / "field.npz", dense.select_nodes(keep), half=half)
        volume = {"type": "mivol_sh", "filename": str(tmp_path / "field.npz")}
        loaded = scene(box_of({"type": "mivol_medium", "emission": volume}, PLACE))
        assert tuple(mi.traverse(loaded)[f"{KEY}.density"].shape) == (int(keep.sum()), 1)
        packed = render(loaded, {"type": "mivol"}, 4)
        whole = image(field(density=tensor(density), sh=tensor(sh)))
        assert np.abs(packed - whole).max() < bound


def grey(codes: list[float], density: float) -> SphericalGrid:
    """A field of one density, which shows one colour from everywhere."""
    sh = np.zeros((3, 3, 3, 1, 3), np.float32)
    sh[...] = (np.array(codes) - 0.5) / 0.28209479
    return SphericalGrid.from_dense(np.full((3, 3, 3), density, np.float32), sh, PLACE)


def test_codes_of_photographs_are_shown_as_the_light_that_they_stand_for(variant_rgb: None, tmp_path: Path) -> None:
    """A picture of an opaque field, written as a photograph is, has the codes that the field was given.

    At a density of 40 the box, 2 wide, lets through exp(-40) at least where the camera looks at it frontally.
    """
    codes = [0.02, 0.5, 0.9]
    write_field(tmp_path / "field.npz", grey(codes, 40.0), half=False)
    volume = {"type": "mivol_sh", "filename": str(tmp_path / "field.npz")}
    shown = {}
    for name, more in (("file", {}), ("told", {"space": "linear"})):
        made = box_of({"type": "mivol_medium", "emission": volume | more}, PLACE)
        whole = scene(made, sensor=camera([0, 0, 4], [0, 0, 0], 12, 20))
        shown[name] = render(whole, {"type": "mivol"}, 1)[6, 6, :3]
    np.testing.assert_allclose(encode_srgb(shown["file"]), codes, atol=1e-5)
    np.testing.assert_allclose(shown["told"], codes, atol=1e-5)


def test_light_of_codes_has_the_curve_and_the_slope_of_srgb(variant_rgb: None) -> None:
    """As the reader of photographs has it; differences of the curve itself are its derivatives, and none is NaN below 0."""
    codes = np.array([-0.2, 0.0, 0.04, 0.05, 0.5, 1.0, 1.5])
    x = mi.Float(codes)
    dr.enable_grad(x)
    light = decode_srgb_code(x)
    dr.backward(dr.sum(light))
    inside = (codes >= 0) & (codes <= 1)
    np.testing.assert_allclose(np.array(light)[inside], decode_srgb(codes[inside]), rtol=1e-5)
    slope = np.where(codes <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((np.maximum(codes, 0.04) + 0.055) / 1.055) ** 1.4)
    np.testing.assert_allclose(np.array(x.grad), slope, rtol=1e-4)


def test_the_space_of_colours_is_kept(variant_rgb: None, tmp_path: Path) -> None:
    """By files, by what makes a field sparse or gives it another degree; a third space is refused."""
    field = replace(grey([0.5] * 3, 1.0), space="linear")
    write_field(tmp_path / "field.npz", field)
    kept = field.select_nodes(np.ones((3, 3, 3), bool)), field.with_degree(1), read_field(tmp_path / "field.npz")
    assert [one.space for one in kept] == ["linear"] * 3
    assert_refused("'rec709'; srgb or linear", replace, field, space="rec709")


def test_a_mono_variant_shows_the_luminance(variant_rgb: None) -> None:
    colours = image(field())
    mi.set_variant("llvm_ad_mono")
    grey = image(field())
    # ITU-R BT.709, each with the rounding of a sum of 20 cells.
    assert np.abs(grey[..., 0] - colours @ [0.212671, 0.715160, 0.072169]).max() < 1e-5


def test_another_degree_may_be_given_later(variant_rgb: None) -> None:
    loaded = scene(field())
    params = mi.traverse(loaded)
    before = render(loaded, {"type": "mivol"}, 4)
    params[f"{KEY}.sh"] = tensor(np.concatenate([values()[1], np.zeros((5, 6, 7, 5, 3), np.float32)], axis=-2))
    params.update()
    assert np.abs(render(loaded, {"type": "mivol"}, 4) - before).max() < 1e-6


def test_refusals(variant_rgb: None) -> None:
    density, sh = values()
    with pytest.raises(RuntimeError, match="give filename, or density and sh"):
        mi.load_dict({"type": "mivol_sh", "density": tensor(density)})
    with pytest.raises(RuntimeError, match="activation 'gelu' was given"):
        mi.load_dict({"type": "mivol_sh", "density": tensor(density), "sh": tensor(sh), "activation": "gelu"})
    with pytest.raises(RuntimeError, match="brings its own extinction"):
        mi.load_dict({"type": "mivol_medium", "sigma_t": 1.0, "emission": field()["interior"]["emission"]})
    for kind in ("mivol_medium", "heterogeneous"):
        with pytest.raises(RuntimeError, match="a mivol_sh (was given as an extinction|as sigma_t); give it as the emission"):
            mi.load_dict({"type": kind, "sigma_t": field()["interior"]["emission"]})
    with pytest.raises(RuntimeError, match="a mivol_sh as emission_density; give it as the emission"):
        mi.load_dict({"type": "mivol_medium", "sigma_t": 1.0, "emission_density": field()["interior"]["emission"]})
    assert np.isnan(render(scene(field()), {"type": "volpath"}, 1)).any()
    params = mi.traverse(scene(field()))
    with refused("are expected"):
        params[f"{KEY}.density"] = tensor(density[1:])
        params.update()


@pytest.mark.parametrize(
    ("activation", "value", "said"),
    [("none", -1.0, "at least 0"), ("relu", np.nan, "or is NaN"), ("relu", np.inf, "inf"), ("softplus", -np.inf, "-inf")],
)
def test_densities_that_are_none_are_refused(variant_rgb: None, activation: str, value: float, said: str) -> None:
    """Whoever sets them: a ReLU would show NaN as vacuum, and without an activation what is negative has a derivative of 1."""
    density, _ = values()
    made = scene(field(density=tensor(np.abs(density)), activation=activation))
    params = mi.traverse(made)
    density = np.abs(density)
    density[1, 1, 1] = value
    params[f"{KEY}.density"] = tensor(density)
    params.update()
    with refused(f"the density of the field in box .*{said}"):
        render(made, {"type": "mivol"}, 1)


def test_a_file_is_checked_for_the_activation_it_is_given(variant_rgb: None, tmp_path: Path) -> None:
    density, sh = values()
    write_field(tmp_path / "field.npz", SphericalGrid.from_dense(density - 2 * density.max(), sh, np.eye(4)))
    with pytest.raises(RuntimeError, match="without an activation none may be negative"):
        mi.load_dict({"type": "mivol_sh", "filename": str(tmp_path / "field.npz"), "activation": "none"})


def test_other_representations_are_shown_as_their_grids(variant_rgb: None, tmp_path: Path) -> None:
    """A hash grid at the nodes that are asked for, an octree in its smallest cells; nodes of what is stored are refused."""
    octree = random_octree(3)
    hashed = HashField.random(HashSizes(levels=2, log2_table=6, coarsest=2, finest=5, width=4), PLACE, 3)
    for name, one in {"hash": find_region(hashed, cells=4), "tree": octree, "grid": octree.to_grid()}.items():
        write_field(tmp_path / f"{name}.npz", one)
    stored = {name: read_field(tmp_path / f"{name}.npz") for name in ("hash", "tree")}
    for name, more, grid in (
        ("hash", {"nodes": 6}, sample_to_grid(stored["hash"], 6)),
        ("tree", {}, stored["tree"].to_grid()),
    ):
        volume = mi.load_dict({"type": "mivol_sh", "filename": str(tmp_path / f"{name}.npz"), **more})
        assert volume.mivol_field.res == grid.res and np.array_equal(volume.mivol_field.stored_nodes(), grid.stored_nodes())
        for ours, theirs in zip(volume.mivol_field.values(), grid.values(), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(volume.mivol_to_world, grid.to_world)
    for name in ("tree", "grid"):
        with pytest.raises(RuntimeError, match="found nodes that are stored, expected a hash grid or a NeRF"):
            mi.load_dict({"type": "mivol_sh", "filename": str(tmp_path / f"{name}.npz"), "nodes": 6})
    with pytest.raises(RuntimeError, match="nodes beside density and sh"):
        mi.load_dict({"type": "scene", "box": field(nodes=6)})
