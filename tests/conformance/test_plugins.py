"""The shells: reached by name from XML and dict, in each variant, under Mitsuba's own media and keys."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from contextlib import nullcontext

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.fields import voxels
from scenes import FRAMES, as_float32, box_of, camera, grid_volume, medium, refused, render, sky, tensor, transform


def grid(seed=0, channels=1):
    return as_float32(np.random.default_rng(seed).uniform(0, 2, (5, 6, 7, channels)))


def point_interaction(points):
    """An interaction at points (n, 3)."""
    it = dr.zeros(mi.Interaction3f, len(points))
    it.p = mi.Point3f(np.ascontiguousarray(points.T, dtype=np.float32))
    return it


def vol_file(path, values):
    mi.VolumeGrid(np.asarray(values, dtype=np.float32)).write(str(path))
    return str(path)


# -- Loading -------------------------------------------------------------------------------------------------------------


def test_volume_from_dict_and_xml(each_variant, tmp_path):
    values = grid()
    path = vol_file(tmp_path / "smoke.vol", values)
    xml = f"""<volume version="3.0.0" type="mivol_voxels"><string name="filename" value="{path}"/>
              <transform name="to_world"><scale value="2"/><translate x="1"/></transform></volume>"""
    to_world = np.diag([2.0, 2, 2, 1])
    to_world[0, 3] = 1
    for volume in (
        mi.load_string(xml),
        mi.load_dict({"type": "mivol_voxels", "filename": path, "to_world": transform(to_world)}),
        mi.load_dict(grid_volume("mivol_voxels", values, to_world)),
    ):
        assert np.array_equal(np.asarray(mi.traverse(volume)["data"]), values.astype(np.float32))
        assert volume.channel_count() == 1
        assert list(volume.resolution()) == [7, 6, 5]
        assert dr.allclose(volume.max(), values.max())
        assert np.array_equal(np.array([volume.bbox().min, volume.bbox().max]).reshape(2, 3), [[1, 0, 0], [3, 2, 2]])


def test_medium_and_integrator_from_xml(each_variant, tmp_path):
    path = vol_file(tmp_path / "smoke.vol", grid())
    scene = mi.load_string(f"""
        <scene version="3.0.0">
            <integrator type="mivol"><integer name="max_depth" value="2"/></integrator>
            <sensor type="perspective">
                <transform name="to_world"><lookat origin="0.5, 0.5, -3" target="0.5, 0.5, 0" up="0, 1, 0"/></transform>
                <film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>
            </sensor>
            <emitter type="constant"/>
            <shape type="cube" id="smoke">
                <transform name="to_world"><scale value="0.5"/><translate x="0.5" y="0.5" z="0.5"/></transform>
                <bsdf type="null"/>
                <medium name="interior" type="mivol_medium">
                    <volume name="sigma_t" type="mivol_voxels"><string name="filename" value="{path}"/></volume>
                    <float name="albedo" value="0"/>
                    <float name="scale" value="1.5"/>
                </medium>
            </shape>
        </scene>""")
    image = np.asarray(mi.render(scene, spp=4))
    assert np.isfinite(image).all()
    assert image.min() > 0


@pytest.mark.parametrize("kind", ["mivol_voxels", "mivol_medium", "mivol"])
def test_unknown_property_is_an_error(each_variant, kind):
    needed = {
        "mivol_voxels": {"data": tensor(grid())},
        "mivol_medium": {"sigma_t": grid_volume("mivol_voxels", grid()), "albedo": 0.0},
        "mivol": {},
    }[kind]
    mi.load_dict({"type": kind, **needed})
    with pytest.raises(Exception, match="sigma_tt|albedoo|unreferenced"):
        mi.load_dict({"type": kind, **needed, "albedoo": 0.5})


def test_switching_variants_in_one_process():
    # A class of an earlier variant must never be used by accident: load and render after each switch, scalar included.
    reference = {}
    for name in ("llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
        mi.set_variant(name)
        if name.startswith("scalar"):
            continue
        smoke = medium("mivol_medium", grid_volume("mivol_voxels", grid()))
        parts = {"sky": sky(), "smoke": box_of(smoke, np.eye(4)), "sensor": camera([0.5, 0.4, 4], [0.5, 0.5, 0.5], 4)}
        image = render(mi.load_dict({"type": "scene", **parts}), {"type": "mivol"}, 4)
        assert np.array_equal(reference.setdefault(name, image), image)


@pytest.mark.slow_for("llvm_ad_mono-import mivol; mi.set_variant('{0}')", "llvm_ad_mono-mi.set_variant('{0}'); import mivol")
@pytest.mark.parametrize("order", ["import mivol; mi.set_variant('{0}')", "mi.set_variant('{0}'); import mivol"])
@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_mono"])
def test_import_in_any_order(order, name):
    # In a process of its own, since this one has imported mivol already; the LLVM library is the one of this process.
    script = f"""
        import os, mitsuba as mi
        {order.format(name)}
        if not mi.variant().startswith("scalar"):
            mi.load_dict({{"type": "mivol"}})
        print("loaded", mi.variant())
    """
    run = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert f"loaded {name}" in run.stdout


@pytest.mark.parametrize("name", ["llvm_ad_spectral", "llvm_ad_mono_polarized"])
def test_spectral_and_polarised_variants_are_refused_by_name(name):
    mi.set_variant(name)
    fog = box_of(medium("homogeneous", 1.0), np.eye(4))
    scene = mi.load_dict({"type": "scene", "fog": fog, "sky": sky(), "sensor": camera([0, 0, 4], [0, 0, 0], 2)})
    with refused(name):
        render(scene, {"type": "mivol"}, 1)


# -- mivol_voxels is gridvolume ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("channels", [1, 3])
def test_values_equal_gridvolume_bit_for_bit(each_variant, frame, channels):
    values = grid(1, channels)
    ours, stock = (mi.load_dict(grid_volume(kind, values, FRAMES[frame])) for kind in ("mivol_voxels", "gridvolume"))
    rng = np.random.default_rng(2)
    points = rng.uniform(0.0001, 0.9999, (4096, 3)) @ FRAMES[frame][:3, :3].T + FRAMES[frame][:3, 3]
    it = point_interaction(points)
    for method in ("eval", "eval_1") if channels == 1 else ("eval", "eval_3"):
        a, b = (np.asarray(getattr(volume, method)(it)) for volume in (ours, stock))
        assert np.array_equal(a, b)
    assert np.array_equal(np.asarray(ours.max()), np.asarray(stock.max()))
    assert np.array_equal(np.asarray(ours.bbox().min), np.asarray(stock.bbox().min))
    assert np.array_equal(np.asarray(ours.bbox().max), np.asarray(stock.bbox().max))


@pytest.mark.parametrize("channels", [1, 3])
def test_vacuum_outside_the_box(each_variant, channels):
    # Where gridvolume goes on for ever with its border values, and a stock medium fills the bounding box of a rotated
    # grid with them, there is nothing.
    volume = mi.load_dict(grid_volume("mivol_voxels", np.ones((2, 3, 4, channels)), FRAMES["rotated"]))
    u = np.random.default_rng(3).uniform(-1, 2, (4096, 3))
    outside = np.any(np.abs(u - 0.5) > 0.5001, axis=1)
    values = np.asarray(volume.eval_1(point_interaction(u @ FRAMES["rotated"][:3, :3].T + FRAMES["rotated"][:3, 3])))
    assert np.array_equal(values[outside], np.zeros(outside.sum()))
    assert np.all(values[np.all(np.abs(u - 0.5) < 0.4999, axis=1)] > 0.99)


@pytest.mark.slow_for("llvm_ad_rgb-rotated")
@pytest.mark.parametrize("frame", [pytest.param("unit", marks=pytest.mark.slow), "rotated"])
def test_same_picture_as_gridvolume_under_stock_medium_and_volpath(each_variant, frame):
    # Same numbers, same random numbers, same paths: the pictures differ at most by the order of float sums in a pixel.
    to_world = as_float32(FRAMES[frame])
    images = []
    for kind in ("mivol_voxels", "gridvolume"):
        smoke = medium("heterogeneous", grid_volume(kind, grid(3), to_world), albedo=0.6)
        target = to_world[:3] @ [0.5, 0.5, 0.5, 1]
        sensor = camera(target + np.array([0.1, 0.3, 4]), target, 8)
        scene = mi.load_dict({"type": "scene", "sky": sky(), "smoke": box_of(smoke, to_world), "sensor": sensor})
        images.append(render(scene, {"type": "volpath", "max_depth": 8}, 16, seed=4))
    assert images[0].std() > 0.01
    assert np.all(np.abs(images[0] - images[1]) <= 16 * 2.0**-23 * (1 + images[1]))


def test_grid_bbox_of_the_file_is_used(each_variant, tmp_path):
    values = mi.VolumeGrid(grid()[..., 0].astype(np.float32))
    path = str(tmp_path / "placed.vol")
    values.write(path)
    raw = bytearray((tmp_path / "placed.vol").read_bytes())
    raw[24:48] = np.array([-1, -2, -3, 1, 4, 9], dtype="<f4").tobytes()  # the header's bounding box
    (tmp_path / "placed.vol").write_bytes(raw)
    ours, stock = (
        mi.load_dict({"type": kind, "filename": path, "use_grid_bbox": True}) for kind in ("mivol_voxels", "gridvolume")
    )
    for corner, exact in (("min", [-1, -2, -3]), ("max", [1, 4, 9])):
        assert np.array_equal(np.asarray(getattr(ours.bbox(), corner)), exact)
        # Stock goes through the inverse of a matrix, whose roundings depend on the processor: two in it and two in the product.
        assert np.allclose(np.asarray(getattr(stock.bbox(), corner)), exact, rtol=4 * 2.0**-23, atol=0)
    it = point_interaction(np.random.default_rng(5).uniform([-1, -2, -3], [1, 4, 9], (512, 3)))
    # Stock composes the file's box in float32, ours in float64: local coordinates differ by a few roundings (4 eps), voxel
    # ones by 7 times that, and values by 2 (the largest step between neighbours) times that.
    assert np.abs(np.asarray(ours.eval_1(it)) - np.asarray(stock.eval_1(it))).max() <= 4 * 2.0**-23 * 7 * 2


# -- Keys and updates ------------------------------------------------------------------------------------------------------


def traversed(interior):
    scene = mi.load_dict({"type": "scene", "smoke": box_of(interior, np.eye(4)), "sky": sky()})
    return mi.traverse(scene)


def test_keys_are_those_of_mitsuba(each_variant):
    sigma_t, albedo = grid_volume("mivol_voxels", grid()), grid_volume("mivol_voxels", np.full((2, 2, 2, 1), 0.5))
    ours = traversed(medium("mivol_medium", sigma_t, albedo))
    stock = traversed(medium("heterogeneous", grid_volume("gridvolume", grid()), albedo))
    prefix = "smoke.interior_medium."
    for key in ("sigma_t.data", "albedo.data", "scale"):
        assert prefix + key in ours, f"{prefix + key} is missing among {sorted(k for k, _ in ours)}"
        assert prefix + key in stock
    assert ours.flags(prefix + "sigma_t.data") == stock.flags(prefix + "sigma_t.data")


def test_keys_of_absorption_and_scattering(each_variant):
    volume = grid_volume("mivol_voxels", grid())
    params = traversed({"type": "mivol_medium", "sigma_a": volume, "sigma_s": 0.0})
    assert "smoke.interior_medium.sigma_a.data" in params


def test_scale_is_differentiable(each_variant):
    params = traversed(medium("mivol_medium", grid_volume("mivol_voxels", grid()), scale=2.0))
    key = "smoke.interior_medium.scale"
    assert params.flags(key) & mi.ParamFlags.NonDifferentiable == 0


@pytest.mark.slow_for("llvm_ad_rgb")
def test_update_of_the_data_is_seen(each_variant):
    parts = {
        "smoke": box_of(medium("mivol_medium", grid_volume("mivol_voxels", grid(6))), np.eye(4)),
        "sky": sky(),
        "sensor": camera([0.5, 0.4, 4], [0.5, 0.5, 0.5], 4, fov=5),
    }
    scene = mi.load_dict({"type": "scene", **parts})
    params = mi.traverse(scene)
    key = "smoke.interior_medium.sigma_t.data"
    for new in (np.zeros((5, 6, 7, 1)), np.full((3, 2, 4, 1), 1.5)):  # of the same and of another resolution
        params[key] = tensor(new)
        params.update()
        fresh = {**parts, "smoke": box_of(medium("mivol_medium", grid_volume("mivol_voxels", new)), np.eye(4))}
        expected = render(mi.load_dict({"type": "scene", **fresh}), {"type": "mivol"}, 4)
        for integrator in ({"type": "mivol"}, {"type": "volpath", "max_depth": 4}):
            seen = render(scene, integrator, 4)
            assert np.isfinite(seen).all()
        assert np.array_equal(render(scene, {"type": "mivol"}, 4), expected)


@pytest.mark.slow_for("llvm_ad_mono")
def test_gradients_arrive_at_stock_keys(each_variant):
    # d image / d sigma_t of a constant grid along rays of length about 1: -T, in sum over the voxels.
    for kind, volume in (("heterogeneous", "gridvolume"), ("mivol_medium", "mivol_voxels")):
        smoke = medium(kind, grid_volume(volume, np.full((4, 4, 4, 1), 0.7)))
        sensor = camera([0.5, 0.5, 40], [0.5, 0.5, 0.5], 4, fov=0.5)
        scene = mi.load_dict({"type": "scene", "smoke": box_of(smoke, np.eye(4)), "sky": sky(), "sensor": sensor})
        params = mi.traverse(scene)
        key = "smoke.interior_medium.sigma_t.data"
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, integrator=mi.load_dict({"type": "mivol"}), spp=8)
        dr.backward(dr.mean(image.array))
        # The rays are within 0.25 degrees of the axis: lengths within 1e-5 of 1.
        assert np.asarray(dr.grad(params[key])).sum() == pytest.approx(-np.exp(-0.7), rel=1e-4)


# -- What cannot be rendered is refused ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"sigma_t": 1.0, "sigma_a": 1.0, "albedo": 0.0}, "sigma_a"),
        ({"sigma_a": 1.0, "sigma_s": 0.0, "albedo": 0.5}, "albedo"),
        ({}, "sigma_t"),
    ],
)
def test_medium_wants_one_pair_of_coefficients(each_variant, given, named):
    with pytest.raises(Exception, match=named):
        mi.load_dict({"type": "mivol_medium", **given})


def test_absorption_and_scattering_are_the_same_medium(each_variant):
    sensor = camera([0.5, 0.4, 4], [0.5, 0.5, 0.5], 4, fov=5)
    images = []
    for given in (
        {"sigma_t": grid_volume("mivol_voxels", grid(7)), "albedo": 0.0},
        {"sigma_a": grid_volume("mivol_voxels", grid(7)), "sigma_s": 0.0},
    ):
        smoke = box_of({"type": "mivol_medium", **given}, np.eye(4))
        scene = mi.load_dict({"type": "scene", "smoke": smoke, "sky": sky(), "sensor": sensor})
        images.append(render(scene, {"type": "mivol"}, 16))
    assert np.array_equal(*images)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_bad_voxels_are_named(each_variant, bad):
    """Hard case 27."""
    values = grid()
    values[3, 1, 4, 0] = bad
    with pytest.raises(Exception, match="z=3, y=1, x=4"):
        mi.load_dict(grid_volume("mivol_voxels", values))


def test_signed_voxels_are_a_g_and_no_extinction(each_variant):
    """Back-scattering voxels; NaN is refused as ever, and negative numbers count as 0 where they would be an extinction."""
    values = grid()
    values[3, 1, 4, 0] = -0.9
    phase = {"type": "mivol_hg", "g": grid_volume("mivol_voxels", np.clip(values, -0.9, 0.9)) | {"signed": True}}
    params = mi.traverse(mi.load_dict(phase))
    assert np.array(params["g.data"])[3, 1, 4, 0] == np.float32(-0.9)
    params["g.data"] = mi.TensorXf(np.full_like(values, np.nan, np.float32))
    with pytest.raises(Exception, match="z=0, y=0, x=0"):
        params.update()
    smoke = box_of({"type": "mivol_medium", "sigma_t": grid_volume("mivol_voxels", values) | {"signed": True}}, np.eye(4))
    sensor = camera([0.5, 0.4, 4], [0.5, 0.5, 0.5], 4, fov=5)
    scene = mi.load_dict({"type": "scene", "smoke": smoke, "sky": sky(), "sensor": sensor})
    with pytest.warns(RuntimeWarning, match="1 of .* values of sigma_t .* below 0, the least -0.9"):
        render(scene, {"type": "mivol"}, 1)


def test_degenerate_place_is_refused(each_variant):
    """Hard case 49."""
    with pytest.raises(Exception, match="degenerate|invert|singular"):
        mi.load_dict(grid_volume("mivol_voxels", grid(), np.diag([1.0, 0, 1, 1])))


def test_a_rotation_about_an_axis_of_another_length_is_refused(each_variant):
    """Mitsuba takes the axis as it is for the matrix and its transpose for the inverse, which it then is not."""
    place = mi.ScalarTransform4f().rotate([1, 1, 0], 40)
    with pytest.raises(Exception, match="rotate about an axis of length 1"):
        mi.load_dict({"type": "mivol_voxels", "data": tensor(grid()), "to_world": place})
    long = mi.ScalarTransform4f().translate([1e6, 0, 0]).rotate([0.6, 0.8, 0], 40).scale([1e-3, 1e3, 1])
    mi.load_dict({"type": "mivol_voxels", "data": tensor(grid()), "to_world": long})


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_update_with_bad_values_is_refused(each_variant, bad):
    """What an optimizer's overshoot leaves behind is named when it is handed in, not when it is rendered.

    Hard cases 26 and 27.
    """
    params = mi.traverse(mi.load_dict(grid_volume("mivol_voxels", grid())))
    wrong = grid().astype(np.float32)
    wrong[1, 2, 3] = bad
    params["data"] = mi.TensorXf(wrong)
    with refused("z=1, y=2, x=3"):
        params.update()


def test_update_may_change_the_resolution(each_variant):
    """Three channels are stored padded: the texture has to be rebuilt."""
    volume = mi.load_dict(grid_volume("mivol_voxels", grid(channels=3)))
    params = mi.traverse(volume)
    params["data"] = mi.TensorXf(np.full((3, 2, 2, 3), 0.7, np.float32))
    params.update()
    it = point_interaction(np.random.default_rng(0).uniform(0.1, 0.9, (64, 3)))
    assert tuple(volume.resolution()) == (2, 2, 3)
    # A convex combination of equal numbers, rounded.
    assert np.abs(np.array(volume.eval_3(it)) - 0.7).max() <= 4 * 2.0**-24


@pytest.mark.parametrize(("error", "agrees"), [(0.001, True), (0.02, False)])
def test_the_inverse_of_a_sheared_box_may_err_as_float32_does(error: float, agrees: bool) -> None:
    """The error of each edge counts beside its length: an edge of 1000 beside others of 1 may come back off by 1."""
    to_world = np.array([[1.0, 1000.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    wrong = np.eye(4)
    wrong[0, 1] = 1000 * error
    with nullcontext() if agrees else pytest.raises(MivolError, match="do not agree; rotate about an axis of length 1"):
        voxels._check_inverse(to_world, wrong @ np.linalg.inv(to_world), "to_world")
