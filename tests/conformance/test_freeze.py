"""``dr.freeze`` over media, fields and integrator: a recording follows parameters that change between calls."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import scenes
from mivol.errors import MivolError
from mivol.fields.voxels import Voxels
from scenes import box_of, camera, grid_volume, medium, skip_recorded_grids_on_a_gpu, sky

GRID, SCALE = "box.interior_medium.sigma_t.data", "box.interior_medium.scale"
PLACE = scenes.centred(2 * np.eye(3))


VALUES = np.random.default_rng(1).uniform(0.1, 1.0, (4, 5, 6, 1)).astype(np.float32)


SPAWNED = 1e-3
"""Mitsuba spawns a ray 1.8e-4 (1 + coordinate) beside its surface; light and shadows of a floor change by a few times this."""


def build(kind: str, floor: bool = False, sigma_t: object = None, albedo: float = 0.0) -> mi.Scene:
    volume = "mivol_voxels" if kind == "mivol_medium" else "gridvolume"
    parts = {
        "type": "scene",
        "box": box_of(medium(kind, grid_volume(volume, VALUES, PLACE) if sigma_t is None else sigma_t, albedo), PLACE),
        "sky": sky(),
        "sensor": camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=8, fov=45.0),
    }
    if floor:
        down = mi.ScalarTransform4f().translate([0, -1.2, 0]).rotate([1, 0, 0], -90).scale(5)
        parts["floor"] = {"type": "rectangle", "to_world": down, "bsdf": {"type": "diffuse"}}
    return mi.load_dict(parts)


def times(values: np.ndarray, factor: float) -> mi.TensorXf:
    """A grid in memory of Dr.Jit's own: a recording is also one of how NumPy happened to align an array."""
    grid = mi.TensorXf(values) * factor
    dr.eval(grid)
    return grid


def shoot(scene: mi.Scene, integrator: mi.Integrator, seed: mi.UInt32) -> mi.TensorXf:
    return mi.render(scene, integrator=integrator, spp=4, seed=seed)


def follow(scene: mi.Scene, depth: int, key: str, values: list) -> list[np.ndarray]:
    """The images of a recording whose parameter changes between calls.

    Every call gives the image that an ordinary render gives, with fewer recordings than calls: to the last bit, but with
    surfaces. An ordinary render then traces these alone, and a recording of the user the boundaries of media too: a ray that
    goes on behind a boundary begins ``SPAWNED`` of the scene aside.
    """
    integrator, params, images = mi.load_dict({"type": "mivol", "max_depth": depth}), mi.traverse(scene), []
    # A recording cannot read whether the medium scatters; an earlier render has.
    mi.render(scene, integrator=integrator, spp=1)
    frozen = dr.freeze(shoot)
    for call, value in enumerate(values):
        if value is not None:
            params[key] = value
            params.update()
        images.append(np.array(frozen(scene, integrator, mi.UInt32(call))))
        judge = np.array(shoot(scene, integrator, mi.UInt32(call)))
        allowed = SPAWNED * judge.max() if "floor.bsdf.reflectance.value" in params else 0
        np.testing.assert_allclose(images[-1], judge, rtol=0, atol=allowed)
    assert frozen.n_recordings < len(values)
    return images


@pytest.mark.slow_for("heterogeneous-True-3", "mivol_medium-True-3")
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize("kind", ["heterogeneous", "mivol_medium"])
def test_values_that_change_between_calls(kind, floor, depth):
    if kind == "mivol_medium":
        skip_recorded_grids_on_a_gpu()
    follow(build(kind, floor), depth, GRID, [times(VALUES, 1 + call) for call in range(6)])


@pytest.mark.slow_for("heterogeneous")
@pytest.mark.parametrize("kind", ["heterogeneous", "mivol_medium"])
def test_light_that_scatters_many_times(kind):
    """The majorants of a grid are made in the recording, also of an array that an ordinary render has read before."""
    if kind == "mivol_medium":
        skip_recorded_grids_on_a_gpu()
    follow(build(kind, albedo=0.7), 4, GRID, [None, *(times(VALUES, 2 + 3 * call) for call in range(5))])


def test_scale_that_changes_between_calls():
    """The scale of mivol_medium is an array, so that a recording follows it; stock media keep a Python number."""
    skip_recorded_grids_on_a_gpu()
    images = follow(build("mivol_medium"), 6, SCALE, [dr.opaque(mi.Float, 0.5 * (1 + call)) for call in range(4)])
    assert np.all(np.diff([image.mean() for image in images]) < -0.01)


def test_constant_that_changes_between_calls():
    """A homogeneous extinction is an array too: it is neither read nor baked into the recording."""
    values = [dr.opaque(mi.Float, 0.25 * (1 + call)) for call in range(4)]
    follow(build("mivol_medium", sigma_t=0.5), 6, "box.interior_medium.sigma_t.value.value", values)


@pytest.mark.slow
def test_gradient_step():
    """The update of the grid, the render and the reverse pass in one recording."""
    scene = build("mivol_medium", True)
    integrator = mi.load_dict({"type": "mivol", "max_depth": 2})
    params = mi.traverse(scene)

    def step(scene: mi.Scene, integrator: mi.Integrator, params: mi.SceneParameters, x: mi.TensorXf, seed: mi.UInt32):
        dr.enable_grad(x)
        params[GRID] = x
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=4, seed=seed)
        dr.backward(dr.mean(image * image, axis=None))
        return dr.grad(x)

    # A recording cannot read whether the medium scatters; an earlier render has.
    mi.render(scene, integrator=integrator, spp=1)
    frozen = dr.freeze(step)
    for call in range(3):
        x = times(VALUES, 1 + call)
        replayed = np.array(frozen(scene, integrator, params, x, mi.UInt32(call)))
        fresh = mi.TensorXf(VALUES * (1 + call))
        plain = np.array(step(scene, integrator, params, fresh, mi.UInt32(call)))
        assert np.abs(replayed - plain).max() <= SPAWNED * np.abs(plain).max()


@pytest.mark.slow
@pytest.mark.parametrize("emitter", ["sky", "bulb"])
def test_gradient_step_of_scattered_light(emitter):
    """Density, albedo and asymmetry of a medium that turns light once, in one recording: what an ordinary step gives."""
    skip_recorded_grids_on_a_gpu()
    interior = medium("mivol_medium", grid_volume("mivol_voxels", VALUES, PLACE), 0.8, phase={"type": "mivol_hg", "g": 0.3})
    bulb = {"type": "point", "position": [1.5, 1.0, 2.0], "intensity": 3.0}
    sensor = camera((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), res=8, fov=45.0)
    shine = {"sky": sky, "bulb": lambda: bulb}[emitter]()
    scene = mi.load_dict({"type": "scene", "box": box_of(interior, PLACE), "emitter": shine, "sensor": sensor})
    integrator = mi.load_dict({"type": "mivol", "max_depth": 2})
    params = mi.traverse(scene)
    keys = (GRID, "box.interior_medium.albedo.value.value", "box.interior_medium.phase_function.g")

    def step(
        scene: mi.Scene, integrator: mi.Integrator, params: mi.SceneParameters, at: list, seed: mi.UInt32, target: mi.Float
    ) -> list:
        for key, value in zip(keys, at, strict=True):
            dr.enable_grad(value)
            params[key] = value
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=16, seed=seed)
        dr.backward(dr.mean(dr.square(image - target), axis=None))
        return [dr.grad(value) for value in at]

    def start(call: int) -> list:
        at = [times(VALUES, 1 + call), mi.Float(0.8 - 0.1 * call), mi.Float(0.3 + 0.1 * call)]
        dr.make_opaque(at)
        return at

    # A recording cannot read whether the medium scatters; an earlier render has.
    mi.render(scene, integrator=integrator, spp=1)
    frozen = dr.freeze(step)
    target = dr.opaque(mi.Float, 0.2)
    for call in range(6):
        replayed = [np.array(g) for g in frozen(scene, integrator, params, start(call), mi.UInt32(call), target)]
        plain = [np.array(g) for g in step(scene, integrator, params, start(call), mi.UInt32(call), target)]
        for a, b in zip(replayed, plain, strict=True):
            assert np.abs(b).max() > 1e-6
            # The order of sums over threads is not fixed: float32 sums of some ten thousand terms.
            assert np.abs(a - b).max() <= 1e-4 * np.abs(b).max()
    assert frozen.n_recordings < 6


def test_grids_that_cannot_be_followed_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU Dr.Jit would abort the process."""
    monkeypatch.setattr(Voxels, "freezable_texture", None)
    scene = build("mivol_medium")
    integrator = mi.load_dict({"type": "mivol"})
    frozen = dr.freeze(shoot)
    with pytest.raises(RuntimeError) as caught:
        frozen(scene, integrator, mi.UInt32(0))
    assert isinstance(caught.value.__cause__, MivolError) and "dr.freeze records mivol_voxels" in str(caught.value.__cause__)
    assert np.isfinite(np.array(mi.render(scene, integrator=integrator, spp=4))).all()


def test_a_recording_reads_no_numbers(monkeypatch):
    """What is looked at when a medium is updated, and before an image, is left alone while a function is recorded."""
    if not mi.variant().startswith("llvm"):
        pytest.skip("on a GPU Mitsuba copies something when a medium of a shape is updated, and a recording refuses that")
    from mivol.plugins import media
    from mivol.scene import readings

    scene = build("mivol_medium", sigma_t=0.5)
    integrator, params, read = mi.load_dict({"type": "mivol"}), mi.traverse(scene), []
    for module in (media, readings):
        monkeypatch.setattr(module, "check_constant", lambda value, name, owner: read.append(name))
    monkeypatch.setattr(media.Coefficients, "check_constants", lambda self: read.append("constants"))

    def step(scene: mi.Scene, integrator: mi.Integrator, params: mi.SceneParameters, scale: mi.Float) -> mi.TensorXf:
        params[SCALE] = scale
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=1)

    dr.freeze(step)(scene, integrator, params, dr.opaque(mi.Float, 2.0))
    assert read == []
    step(scene, integrator, params, dr.opaque(mi.Float, 3.0))
    assert read == ["constants", "scale", "scale", "sigma_t"]
