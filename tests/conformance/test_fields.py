"""Every field keeps the promises of the protocol: values below the bound, nothing outside, a transpose that is one."""

from __future__ import annotations

from collections.abc import Callable

import bounded_ball
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.fields.hash_density import HashDensity
from mivol.fields.hash_encoding import HashSizes
from mivol.fields.plugin_field import PluginField
from mivol.fields.protocol import BOUNDED, EXACT_LINE, Field
from mivol.fields.voxels import Voxels

POINTS = 5000


def voxels(channels: int) -> Voxels:
    values = np.random.default_rng(2).uniform(0, 3, (5, 6, 7, channels)).astype(np.float32)
    place = np.array([[1.5, -0.4, 0, 0.2], [0.4, 1.5, 0, -1], [0, 0.3, 2, -0.7], [0, 0, 0, 1]])
    return Voxels(values, place, "voxels")


def hash_density() -> HashDensity:
    """A hash grid with values of order 1, so that densities spread between 0 and the bound."""
    sizes = HashSizes(levels=3, log2_table=7, coarsest=2, finest=9, width=8, geometry=1)
    place, rng = voxels(1).to_world, np.random.default_rng(3)
    shapes = HashDensity.untrained(sizes, place, 2.0).shapes()
    tensors = {name: mi.TensorXf(2 * rng.normal(size=shape).astype(np.float32)) for name, shape in shapes.items()}
    return HashDensity(sizes, place, 2.0, tensors)


def plugin_field(sigma: float | list[float]) -> PluginField:
    bounded_ball.register()
    ball = {"type": "strangers_ball", "sigma": sigma, "radius": 0.8, "centre": mi.ScalarPoint3f(0.1, 0.2, -0.3)}
    return PluginField(mi.load_dict(ball))


FIELDS: dict[str, tuple[Callable[[], Field], str]] = {
    "grey voxels": (lambda: voxels(1), EXACT_LINE),
    "rgb voxels": (lambda: voxels(3), EXACT_LINE),
    "a ball": (lambda: bounded_ball.Ball(dr.opaque(mi.Float, 1.5), 0.8, (0.1, 0.2, -0.3)), BOUNDED),
    "a hash grid": (hash_density, BOUNDED),
    "a volume of another package": (lambda: plugin_field(1.5), BOUNDED),
    "an rgb volume of another package": (lambda: plugin_field([1.2, 2, 3]), BOUNDED),
    "an rgb ball": (lambda: bounded_ball.Ball(mi.Color3f(0.2, 1, 3), 0.8, (0.1, 0.2, -0.3), 2.0), BOUNDED),
}


def renew(field: Field) -> None:
    """Do what a shell does after an update. An rgb texture is padded, and Dr.Jit passes that edge but once."""
    if isinstance(field, Voxels):
        field.refresh()


def points(field: Field, margin: float) -> tuple[np.ndarray, mi.Point3f, mi.Vector3f]:
    """Points in and around the box of a field, in its own coordinates and in the world, and directions."""
    rng = np.random.default_rng(4)
    q = rng.uniform(-margin, 1 + margin, (3, POINTS))
    p = field.to_world[:3, :3] @ q + field.to_world[:3, 3:]
    w = rng.normal(size=(3, POINTS))
    return q, mi.Point3f(p.astype(np.float32)), mi.Vector3f((w / np.linalg.norm(w, axis=0)).astype(np.float32))


@pytest.mark.parametrize("name", FIELDS)
def test_values_are_bounded_and_lie_in_the_box(name: str) -> None:
    make, line = FIELDS[name]
    field = make()
    q, p, w = points(field, 0.2)
    values = np.array([np.array(v) for v in field.eval(p, w, mi.Bool(True))])
    # A convex combination of float32 values may be rounded up, once for each of its 8 terms.
    bound = np.array(field.bound()) * (1 + 8 * 2**-24)
    assert field.line == line
    assert values.shape == (field.channels, POINTS)
    assert (values <= bound[:, None]).all()
    assert (values.max(axis=1) > 0.3 * np.array(field.bound())).all()
    # Places are rounded to float32: 1e-6 of the box beside its faces may count for either side.
    outside = ((q < -1e-6) | (q > 1 + 1e-6)).any(axis=0)
    assert outside.any()
    assert (values[:, outside] == 0).all()


@pytest.mark.parametrize("name", FIELDS)
def test_accumulate_is_the_transpose_of_eval(name: str) -> None:
    """<J v, d> = <v, accumulate d>, lanes that are not active left out: there the weight may be NaN."""
    field, rng = FIELDS[name][0](), np.random.default_rng(6)
    _, p, w = points(field, 0.1)
    parameters = list(field.parameters().values())
    v = [rng.normal(size=dr.shape(parameter)).astype(np.float32) for parameter in parameters]
    on, weights = rng.uniform(size=POINTS) < 0.7, rng.normal(size=(field.channels, POINTS)).astype(np.float32)
    active, d = mi.Bool(on), [mi.Float(np.where(on, row, np.nan)) for row in weights]
    dr.enable_grad(parameters)
    renew(field)
    with dr.suspend_grad():
        field.accumulate(p, w, d, active)
    vjp = [np.array(dr.grad(parameter), np.float64) for parameter in parameters]
    renew(field)
    for parameter, tangent in zip(parameters, v, strict=True):
        dr.set_grad(parameter, type(parameter)(tangent))
    jvp = dr.forward_to(field.eval(p, w, mi.Bool(True)), flags=dr.ADFlag.ClearEdges)
    terms = np.array([np.array(x, np.float64) * row * on for x, row in zip(jvp, weights, strict=True)])
    # Sums of 5000 float32 numbers: 1e-5 of the sum of their sizes.
    assert np.abs(terms).sum() > 100
    by_parameters = sum((a * b).sum() for a, b in zip(v, vjp, strict=True))
    assert abs(terms.sum() - by_parameters) < 1e-5 * np.abs(terms).sum()


def test_values_below_0_of_a_volume_known_at_points_count_as_0(variant_rgb: str) -> None:
    """Of a gridvolume of the nearest voxels: -2, 0 and 3, with the derivative of each voxel by itself."""
    values = np.array([-2.0, 0.0, 3.0], np.float32).reshape(1, 1, 3, 1)
    volume = mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(values), "filter_type": "nearest"})
    params = mi.traverse(volume)
    dr.enable_grad(params["data"])
    params.update()
    x = mi.Point3f(mi.Float(1 / 6, 1 / 2, 5 / 6), 0.5, 0.5)
    (found,) = PluginField(volume).eval(x, mi.Vector3f(0, 0, 1), mi.Bool(True))
    np.testing.assert_array_equal(found, [0, 0, 3])
    dr.backward(dr.sum(found))
    np.testing.assert_array_equal(np.ravel(dr.grad(params["data"])), [1, 1, 1])
