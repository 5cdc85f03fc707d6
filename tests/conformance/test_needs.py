"""A scene is asked what it needs, and nothing else is computed: what the kernels hold is counted."""

from __future__ import annotations

import contextlib
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import scenes
from mivol.experiments.script import explain
from mivol.scene import plan
from mivol.scene.needs import find_needs
from mivol.scene.nesting import find_nesting_fault
from mivol.scene.plan import make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path.estimators import Settings
from scenes import ball_of, box_of, camera, film, grid_volume, medium, refused, sky

PLACE = scenes.centred(2 * np.eye(3))


def values(channels: int = 1) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.1, 1, (4, 5, 6, channels)).astype(np.float32)


def scene_of(*, boundary=box_of, where=(PLACE,), sigma_t=None, albedo=0.0, kind="mivol_medium", **more) -> mi.Scene:
    sigma_t = grid_volume("mivol_voxels", values(), PLACE) if sigma_t is None else sigma_t
    return mi.load_dict(
        {
            "type": "scene",
            "box": boundary(medium(kind, sigma_t, albedo), *where),
            "sky": sky(),
            "sensor": camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=8, fov=45.0),
            **more,
        }
    )


def kernels(scene: mi.Scene, depth: int = 1) -> str:
    """The LLVM code of all that a warm render launches."""
    if not mi.variant().startswith("llvm"):
        pytest.skip(f"counts instructions of LLVM kernels; the variant is {mi.variant()}")
    integrator = mi.load_dict({"type": "mivol", "max_depth": depth})
    dr.eval(mi.render(scene, integrator=integrator, spp=4))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(mi.render(scene, integrator=integrator, spp=4, seed=1))
        return "\n".join(k["ir"].getvalue() for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT)


def lookups(code: str) -> int:
    return len(re.findall(r"call <\d+ x \w+> @llvm\.masked\.gather", code))


def traced_rays(code: str) -> int:
    return len(re.findall(r"call void %\w+\(ptr %\w+, ptr %\w+, ptr %\w+_in_ctx", code))


def test_grey_field_carries_one_channel():
    """A homogeneous medium reads no grid; a grey one 8 corners and then 4 a cell; an rgb one three times that. Both place the
    grid by 12 numbers, and the homogeneous medium its upright box by 6.
    """
    none = lookups(kernels(scene_of(sigma_t=0.7)))
    grey = lookups(kernels(scene_of()))
    rgb = lookups(kernels(scene_of(sigma_t=grid_volume("mivol_voxels", values(3), PLACE))))
    assert grey - none == 6 + 8 + 4
    assert rgb - none == 6 + 3 * (8 + 4)


def test_albedo_is_not_looked_up():
    """An albedo grid costs nothing: at depth 1, and at any depth where it is 0."""
    plain = lookups(kernels(scene_of()))
    zero = grid_volume("mivol_voxels", 0 * values(), PLACE)
    some = grid_volume("mivol_voxels", 0.5 * values(), PLACE)
    assert lookups(kernels(scene_of(albedo=zero), depth=6)) == plain
    assert lookups(kernels(scene_of(albedo=some), depth=1)) == plain


def test_no_phase_function_and_no_light_sampling():
    """The kernels of any phase function and depth are the same, to the letter: none is in them."""
    plain = kernels(scene_of())
    with_phase = scene_of(kind="heterogeneous", sigma_t=grid_volume("gridvolume", values(), PLACE))
    peaked = mi.load_dict(
        {
            "type": "scene",
            "box": box_of(
                medium("heterogeneous", grid_volume("gridvolume", values(), PLACE), phase={"type": "hg", "g": 0.9}), PLACE
            ),
            "sky": sky(),
            "sensor": camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=8, fov=45.0),
        }
    )
    assert lookups(kernels(peaked, depth=6)) == lookups(kernels(with_phase, depth=1)) == lookups(plain)
    assert len(kernels(peaked, depth=6).splitlines()) == len(kernels(with_phase, depth=1).splitlines())


def test_boxes_trace_no_acceleration_structure(tmp_path):
    """A box is a slab test, also from a file, a ball a quadratic equation; a cylinder is traced, and a box beside a surface."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3])}
    assert traced_rays(kernels(scene_of())) == 0
    assert traced_rays(kernels(scene_of(boundary=ball_of, where=((0, 0, 0), 1.0)))) == 0
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "box.ply"))
    null = {"type": "null"}
    file = {"type": "ply", "filename": str(tmp_path / "box.ply"), "bsdf": null}
    assert traced_rays(kernels(scene_of(boundary=lambda interior: file | {"interior": interior}, where=()))) == 0
    tube = lambda interior: {"type": "cylinder", "bsdf": {"type": "null"}, "interior": interior}  # noqa: E731
    assert traced_rays(kernels(scene_of(boundary=tube, where=()))) == 1
    assert traced_rays(kernels(scene_of(wall=wall))) == 1


@pytest.mark.parametrize("kind", ["plain", "inside out", "named by the sensor", "over another", "lit"])
def test_balls_that_are_clipped_in_closed_form(kind: str) -> None:
    """Not a sphere whose inside is out, whose medium also surrounds the camera, that shares space, or that is a lamp."""
    fog = medium("homogeneous", 1.0) | {"id": "fog"}
    parts = {"ball": ball_of(fog, (0, 0, 0), 1.0), "sensor": camera((0, 0, 5), (0, 0, 0))}
    if kind == "inside out":
        parts["ball"]["flip_normals"] = True
    elif kind == "named by the sensor":
        parts["sensor"]["medium"] = {"type": "ref", "id": "fog"}
    elif kind == "over another":
        parts["other"] = ball_of(medium("homogeneous", 2.0), (0, 0, 0), 0.5) | {"exterior": {"type": "ref", "id": "fog"}}
    elif kind == "lit":
        parts["ball"]["emitter"] = {"type": "area", "radiance": 1.0}
    boxes = [b.box for b in survey_scene(mi.load_dict({"type": "scene", **parts})).boundaries]
    assert [b is not None and b.is_round for b in boxes] == [kind == "plain"] * len(boxes)


def test_depth_1_shades_no_surface():
    """What a surface would need (light sampling, its shadow ray) is not in the kernel of depth 1."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3])}
    lamp = {"type": "point", "position": [0, 0, 3]}
    assert traced_rays(kernels(scene_of(wall=wall, lamp=lamp), depth=1)) == 1
    assert traced_rays(kernels(scene_of(wall=wall, lamp=lamp), depth=2)) == 2
    # A sky of one radiance is found by the directions of the BSDF alone.
    assert traced_rays(kernels(scene_of(wall=wall), depth=2)) == 1


def test_explain_gives_a_reason_for_each_choice():
    text = explain(scene_of(sigma_t=grid_volume("mivol_voxels", values(3), PLACE)))
    for fact in ("rgb extinction", "4x5x6", "albedo 0", "ConstantBackgroundEmitter", "not traced", "gradient step"):
        assert fact in text
    plan, _, references = text.split("plan\n")[1].partition("references\n")
    choices = [line for line in plan.splitlines() if "because" not in line]
    assert text.count("because") == len(choices) >= 5
    assert "A fast voxel traversal algorithm" in references


def test_explain_names_a_medium_around_the_camera() -> None:
    """A medium without a shape is called by its id, as any other."""
    fog = {"type": "homogeneous", "id": "fog", "sigma_t": 0.2, "albedo": 0.5}
    sensor = camera((0, 0, 5), (0, 0, 0)) | {"medium": {"type": "ref", "id": "fog"}}
    assert "fog: " in explain(mi.load_dict({"type": "scene", "fog": fog, "sensor": sensor, "sky": sky()}))


@pytest.mark.parametrize(
    ("integrator", "depth"),
    [
        ({"type": "mivol", "max_depth": 2, "deterministic": True, "shadows": "grid"}, 2),
        ({"type": "mivol", "max_depth": -1}, -1),
        ({"type": "volpath", "max_depth": 2}, 2),
        ({"type": "prbvolpath", "max_depth": -1}, -1),
        ({"type": "moment", "inner": {"type": "volpath", "max_depth": 2}}, 2),
        ({"type": "aov", "aovs": "d:depth", "inner": {"type": "mivol", "max_depth": 2}}, 2),
        ({"type": "direct"}, 6),
    ],
    ids=lambda x: x["type"] if isinstance(x, dict) else str(x),
)
def test_explain_asks_the_scene_how_deep_its_paths_are(integrator, depth):
    """What scatters is told of as it would be rendered; an argument says otherwise."""
    bulb = {"type": "point", "position": [3, 3, 3]}
    scene = scene_of(albedo=0.5, sigma_t=grid_volume("mivol_voxels", values(1), PLACE), sky=bulb, integrator=integrator)
    if depth == 2:
        text = explain(scene)
        assert ("quadrature, a light grid" in text) == ("deterministic" in integrator)
        assert "max_depth 2 leaves out" in text
    else:
        text = explain(scene)
        assert "free flights from collision to collision" in text and f"max_depth is {depth}" in text
    assert "max_depth 2 leaves out" not in explain(scene, max_depth=1)


def test_scene_without_a_sensor():
    with refused("no sensor 0, only 0"):
        explain(mi.load_dict({"type": "scene", "sky": sky()}))


def test_quadrature_of_several_scatterings_is_refused_before_anything_is_rendered():
    scene = scene_of(albedo=0.5)
    for depth in (3, -1):
        with refused(f"scatters and max_depth is {depth}"):
            make_plan(find_needs(scene, scene.sensors()[0]), Settings(max_depth=depth, deterministic=True))
        make_plan(find_needs(scene, scene.sensors()[0]), Settings(max_depth=depth))


def test_gradient_step_that_cannot_fit_is_refused(monkeypatch):
    scene = scene_of()
    params = mi.traverse(scene)
    dr.enable_grad(params["box.interior_medium.sigma_t.data"])
    needs = find_needs(scene, scene.sensors()[0])
    assert "box.interior_medium.sigma_t.data" in needs.parameters
    make_plan(needs, Settings(max_depth=1))
    monkeypatch.setattr(plan, "free_memory", lambda: 1000)
    make_plan(needs, Settings(max_depth=1))  # so small a step is not compared with the free memory
    monkeypatch.setattr(plan, "SMALL_STEP", 0)
    if mi.variant().startswith("llvm"):
        with refused("gradient step would take"):
            make_plan(needs, Settings(max_depth=1))


@pytest.mark.parametrize("key", ["bulb.to_world", "sensor.to_world", "box.vertex_positions"])
def test_derivatives_of_places_are_refused(key):
    """They would be 0 without a word."""
    bulb = {"type": "sphere", "center": [2, 2, 0], "radius": 0.3, "emitter": {"type": "area"}}
    scene = scene_of(sigma_t=1.0, bulb=bulb)
    params = mi.traverse(scene)
    ask(scene)
    dr.enable_grad(params[key])
    params.update()
    with refused(f"the derivative of {key} was requested"):
        make_plan(find_needs(scene, scene.sensors()[0]), Settings(max_depth=1))


def test_derivatives_of_what_is_painted_on_a_mesh_are_taken():
    """A colour of its vertices is no place."""
    floor = mi.load_dict({"type": "rectangle"})
    mesh = mi.Mesh("floor", 4, 2, has_vertex_normals=True)
    params = mi.traverse(mesh)
    for name in ("vertex_positions", "vertex_normals", "faces"):
        params[name] = mi.traverse(floor)[name] if name in mi.traverse(floor) else params[name]
    mesh.add_attribute("vertex_color", 3, [0.5] * 12)
    scene = scene_of(sigma_t=1.0, floor=mesh)
    params = mi.traverse(scene)
    key = next(k for k, _ in params if k.endswith("vertex_color"))
    dr.enable_grad(params[key])
    params.update()
    needs = find_needs(scene, scene.sensors()[0])
    assert key in needs.parameters and needs.places == ()


def test_empty_space_is_skipped_where_it_pays():
    sparse = np.zeros((40, 40, 40, 1), np.float32)
    sparse[:8, :8, :8] = 1
    scene = scene_of(sigma_t=grid_volume("mivol_voxels", sparse, PLACE))
    needs = find_needs(scene, scene.sensors()[0])
    assert make_plan(needs, Settings(max_depth=1)).skips_empty == (True,)
    scene = scene_of()
    assert make_plan(find_needs(scene, scene.sensors()[0]), Settings(max_depth=1)).skips_empty == (False,)


def nested(*balls: dict, kind: str = "homogeneous") -> mi.Scene:
    """A box of haze with balls."""
    return scene_of(kind=kind, sigma_t=0.5, **{f"ball{i}": b for i, b in enumerate(balls)})


def ask(scene: mi.Scene) -> None:
    find_needs(scene, scene.sensors()[0])


@pytest.mark.parametrize(("centre", "radius"), [((0, 0, 0), 0.5), ((1, 0, 0), 0.4), ((0.8, 0.8, 0.8), 0.3), ((0, 0, 0), 4)])
def test_media_that_overlap_without_saying_which_is_where_are_refused(centre, radius):
    """Inside, across a face, across a corner, around: stock integrators lose the outer medium behind the inner one."""
    with refused("(box and ball0|ball0 and box) overlap"):
        ask(nested(ball_of(medium("homogeneous", 2.0), centre, radius)))


def test_media_that_say_what_is_around_them_are_taken():
    haze = medium("homogeneous", 0.5)
    ask(nested(ball_of(medium("homogeneous", 2.0), (0, 0, 0), 0.5) | {"exterior": haze}))
    ask(nested(ball_of(medium("homogeneous", 2.0), (1.6, 0, 0), 0.6)))
    # Their boxes overlap, they do not.
    side = 1 + 1 / np.sqrt(3) * 0.9
    ask(nested(ball_of(medium("homogeneous", 2.0), (side, side, side), 0.9)))
    one, two = ((x, 0.4 * x / abs(x), 0) for x in (-2.0, 2.0))
    ask(scene_of(ball=ball_of(haze, one, 0.9), other=ball_of(medium("homogeneous", 2.0), two, 0.9)))


def test_the_crossings_of_a_row_of_boxes_share_their_kernels():
    """4 faces of 2 boxes, up to 12 of 6: rays that are not evaluated at each would have it compiled anew."""

    def launched(boxes: int) -> set:
        row = {f"box{k}": box_of(medium("homogeneous", 1.0), scenes.centred(np.eye(3), (0, 0, 1.5 * k))) for k in range(boxes)}
        scene = mi.load_dict({"type": "scene", **row})
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            assert find_nesting_fault(scene) is None
            return {k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])}

    assert 0 < len(launched(6)) == len(launched(2))


def _turned(centre: tuple, size: tuple = (1, 1, 1)) -> np.ndarray:
    """A box around a centre, all of it turned about an oblique axis."""
    turn = np.array(mi.ScalarTransform4f().rotate([1, 2, 3], 40).matrix)
    return turn @ scenes.affine(np.diag(size), np.subtract(centre, np.divide(size, 2)))


def test_neighbours_that_are_turned_are_boxes():
    """Their upright boxes overlap, they share a face: no ray is traced, so none loses a medium at that face."""
    one, two = (box_of(medium("homogeneous", s), _turned((x, 0, 0))) for s, x in ((1.0, -0.5), (2.0, 0.5)))
    scene = mi.load_dict(
        {"type": "scene", "one": one, "two": two, "sky": sky(), "sensor": camera((2.0, 1.5, 3.0), (0, 0, 0), res=8)}
    )
    needs = find_needs(scene, scene.sensors()[0])
    assert all(b.box is not None for b in needs.boundaries)
    one["to_world"] = scenes.transform(_turned((-0.49, 0, 0)))
    overlapping = mi.load_dict({"type": "scene", "one": one, "two": two, "sensor": camera((2.0, 1.5, 3.0), (0, 0, 0), res=8)})
    with refused("overlap"):
        ask(overlapping)


@pytest.mark.parametrize(("gap", "sits"), [(0.0, False), (1e-5, False), (0.02, True)])
def test_coinciding_faces_of_traced_boundaries_are_refused(gap, sits):
    """A box that stands on the floor of another: rays meet one face of both, and would carry haze out without end."""
    haze = medium("homogeneous", 0.5)
    inner = box_of(medium("homogeneous", 2.0), scenes.affine(np.diag([1, 1, 1]), (-0.5, -0.5, gap - 1))) | {"exterior": haze}
    if sits:
        ask(scene_of(kind="homogeneous", sigma_t=0.5, inner=inner))
    else:
        with refused("(box and inner|inner and box) overlap, or parts of their surfaces coincide"):
            ask(scene_of(kind="homogeneous", sigma_t=0.5, inner=inner))


def test_an_exterior_is_where_it_is_said_to_be():
    """A ball that names the haze around it and reaches out of it: there would be haze all the way to the camera."""
    haze = medium("homogeneous", 0.5)
    with refused("(box and ball|ball and box) overlap"):
        ask(
            scene_of(
                kind="homogeneous", sigma_t=0.5, ball=ball_of(medium("homogeneous", 2.0), (1, 0, 0), 0.4) | {"exterior": haze}
            )
        )


@pytest.mark.parametrize(
    ("shift", "parts"), [((1.0, 0.3, 0.2), False), ((2.0, 0.0, 0.0), False), ((2.0, 1.0, 0.0), False), ((2.1, 0.0, 0.0), True)]
)
def test_merged_meshes_are_one_that_may_overlap_itself(shift, parts):
    """Mitsuba makes one mesh of shapes that share medium and BSDF."""
    scene = scene_of(
        kind="homogeneous",
        sigma_t=0.5,
        other=box_of(medium("homogeneous", 0.5), scenes.affine(2 * np.eye(3), np.add(shift, -1))),
    )
    assert [s.class_name() for s in scene.shapes()] == ["Mesh"]
    if parts:
        ask(scene)
    else:
        with refused("pieces of .* overlap, or their surfaces coincide in part"):
            ask(scene)


def test_a_dome_without_a_floor_may_stand_on_one(tmp_path):
    """What is below an opaque floor is not in the dome, though nothing of the dome was left."""
    dome = mi.Mesh("dome", 5, 4)
    params = mi.traverse(dome)
    params["vertex_positions"] = np.array([[-1, -1, -1], [1, -1, 1], [1, 1, 1], [-1, 1, -1], [-0.8, 0, 2]], np.float32).ravel()
    params["faces"] = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]], np.uint32).ravel()
    params.update()
    dome.write_ply(str(tmp_path / "dome.ply"))
    ply = {"type": "ply", "filename": str(tmp_path / "dome.ply"), "bsdf": {"type": "null"}}
    floor = mi.ScalarTransform4f().rotate([0, 1, 0], -45).scale(4)
    scene = {
        "type": "scene",
        "dome": ply | {"interior": medium("homogeneous", 1.0)},
        "ball": ball_of(medium("homogeneous", 2.0), (0.5, 0, -0.1), 0.4),
        "sensor": camera((2.0, 1.5, 3.0), (0, 0, 0), res=8),
    }
    ask(mi.load_dict(scene | {"floor": {"type": "rectangle", "to_world": floor}}))
    scene["ball"] = ball_of(medium("homogeneous", 2.0), (-0.3, 0, 0.6), 0.3)
    with refused("(dome and ball|ball and dome) overlap"):
        ask(mi.load_dict(scene))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_stock_voxels_are_named(bad):
    """Stock gridvolume takes them in silence; the voxel is named before a kernel runs. Hard case 27."""
    wrong = values()
    wrong[1, 2, 3] = bad
    scene = scene_of(kind="heterogeneous", sigma_t=grid_volume("gridvolume", wrong, PLACE))
    with refused(r"z=1, y=2, x=3"):
        make_plan(find_needs(scene, scene.sensors()[0]), Settings(max_depth=1))


def test_a_pass_is_shorter_where_rays_cross_more_cells():
    """Ctrl-C is heard between passes: a ray of a long grid counts for more."""
    long = np.zeros((1, 1, 4000, 1), np.float32)
    scene = scene_of(sigma_t=grid_volume("mivol_voxels", long, PLACE))
    few = make_plan(find_needs(scene, scene.sensors()[0]), Settings(max_depth=1)).pass_rays
    scene = scene_of()
    many = make_plan(find_needs(scene, scene.sensors()[0]), Settings(max_depth=1)).pass_rays
    backend = mi.variant().split("_")[0]
    assert few == plan.PASS_STEPS[backend] // 4002 < many == plan.PASS_RAYS[backend]


def meter(z: float) -> dict:
    """A sensor that is a surface, and has no near plane."""
    place = mi.ScalarTransform4f().translate([0, 0, z]).scale(0.1)
    return {"type": "rectangle", "to_world": place, "meter": {"type": "irradiancemeter", "film": film(1, 1)}}


SENSORS = {
    "above, far": (lambda: camera((0, 0, 1.5), (0, 0, 0)) | {"near_clip": 0.1}, False),
    "above, near": (lambda: camera((0, 0, 1.5), (0, 0, 0)) | {"near_clip": 0.15}, True),
    "below, far": (lambda: camera((0, 0, -1.5), (0, 0, 0)) | {"near_clip": 0.1}, False),
    "below, near": (lambda: camera((0, 0, -1.5), (0, 0, 0)) | {"near_clip": 0.15}, True),
    "at infinity": (lambda: {"type": "distant", "film": film(1, 1)}, False),
    "a surface above": (lambda: meter(1.5), False),
    "a surface within": (lambda: meter(0.5), True),
}


@pytest.mark.usefixtures("traced_balls")
@pytest.mark.parametrize("name", SENSORS)
def test_a_camera_is_inside_where_its_rays_may_begin_in_a_boundary(name: str) -> None:
    """A ball of radius 1, which is traced, with or without a box: rays begin up to four near planes to the side of the eye."""
    make, inside = SENSORS[name]
    fog = medium("homogeneous", 1.0)
    ball, box = ball_of(fog, (0, 0, 0), 1.0), box_of(fog, PLACE)
    # Equal media would be merged into one, which is traced for both.
    apart = box_of(medium("homogeneous", 2.0), scenes.centred(2 * np.eye(3), (8, 0, 0)))
    for shapes, expected in (({"ball": ball}, inside), ({"box": box}, False), ({"ball": ball, "box": apart}, inside)):
        scene = mi.load_dict({"type": "scene", **shapes, "sensor": make()})
        assert find_needs(scene, scene.sensors()[0], survey_scene(scene)).camera_inside == expected


# -- Grids outside of their shape ------------------------------------------------------------------------------------------


def frame_at(x: float) -> np.ndarray:
    frame = PLACE.copy()
    frame[0, 3] += x
    return frame


@pytest.mark.parametrize("kind", ["mivol_voxels", "gridvolume"])
@pytest.mark.parametrize("boundary", [box_of, ball_of])
def test_a_grid_outside_of_its_shape_is_told(kind: str, boundary) -> None:
    """By explain, and by the first render, in one sentence."""
    where = (PLACE,) if boundary is box_of else ((0.0, 0.0, 0.0), 1.0)
    scene = scene_of(boundary=boundary, where=where, sigma_t=grid_volume(kind, values(), frame_at(10.0)))
    sentence = "the whole grid sigma_t of the medium in .* lies outside of .* and adds nothing to the medium"
    assert re.search(f"warning   {sentence}", explain(scene))
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    with pytest.warns(RuntimeWarning, match=sentence):
        mi.render(scene, integrator=integrator, spp=1)
    mi.render(scene, integrator=integrator, spp=1)  # warnings are errors in tests: said once


@pytest.mark.parametrize("x", [0.0, 1.9])
def test_a_grid_that_meets_its_shape_is_not(x: float) -> None:
    assert "lies outside" not in explain(scene_of(sigma_t=grid_volume("mivol_voxels", values(), frame_at(x))))


def test_a_grid_in_another_shape_of_its_medium_is_not() -> None:
    fog = {**medium("mivol_medium", grid_volume("mivol_voxels", values(), PLACE), 0.0), "id": "fog"}
    scene = scene_of(box=box_of(fog, frame_at(10.0)), other=box_of({"type": "ref", "id": "fog"}, PLACE))
    assert "lies outside" not in explain(scene)


@pytest.mark.parametrize("far", [28.9, 29.1])
def test_a_camera_that_ends_before_the_media_is_told(far: float) -> None:
    """The box begins at 29, in front of the camera."""
    box = box_of(medium("homogeneous", 1.0), scenes.centred(2 * np.eye(3), (0, 0, 30)))
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    sensor = {"type": "perspective", "far_clip": far, "film": film}
    scene = mi.load_dict({"type": "scene", "box": box, "sensor": sensor, "sky": {"type": "constant"}})
    sentence = f"the media begin 29 from the camera, whose far_clip is {far:.4g}"
    assert (f"warning   {sentence}" in explain(scene)) == (far < 29)
    integrator = mi.load_dict({"type": "mivol", "max_depth": 1})
    with pytest.warns(RuntimeWarning, match=sentence) if far < 29 else contextlib.nullcontext():
        mi.render(scene, integrator=integrator, spp=1)
    mi.render(scene, integrator=integrator, spp=1)  # warnings are errors in tests: said once


UNDEFINED = {  # whether it is said, the light, and what else is in the scene
    "sky": (True, lambda: {"type": "constant", "id": "sky"}, dict),
    "panorama": (True, lambda: {"type": "envmap", "id": "sky", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}, dict),
    "sun, as in volpath": (False, lambda: {"type": "directional"}, dict),
    "lamp": (False, lambda: {"type": "point"}, dict),
    "behind walls": (
        False,
        lambda: {"type": "constant"},
        lambda: {"room": {"type": "sphere", "radius": 9, "flip_normals": True}},
    ),
    "in a shape": (
        False,
        lambda: {"type": "constant"},
        lambda: {"end": {"type": "sphere", "radius": 9, "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "fog"}}},
    ),
}


@pytest.mark.parametrize("case", UNDEFINED)
def test_light_from_infinity_in_a_medium_without_an_end_is_told(case: str) -> None:
    said, light, parts = UNDEFINED[case]
    fog = {**medium("homogeneous", 0.2, 0.9), "id": "fog"}
    sensor = {**camera([0, -1, 0], [0, 0, 0], res=4), "fog": {"type": "ref", "id": "fog"}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1])}
    scene = mi.load_dict({"type": "scene", "fog": fog, "floor": floor, "light": light(), **parts(), "sensor": sensor})
    sentence = "the medium fog has no end, so it is not defined how much light of sky crosses it from infinity"
    assert (f"warning   {sentence}" in explain(scene)) == said
    integrator = mi.load_dict({"type": "mivol", "max_depth": 3})
    with pytest.warns(RuntimeWarning, match=sentence) if said else contextlib.nullcontext():
        mi.render(scene, integrator=integrator, spp=1)
    mi.render(scene, integrator=integrator, spp=1)  # warnings are errors in tests: said once
