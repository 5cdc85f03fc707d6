"""Scans lit by their gradients: normals of spheres and planes in closed form, the picture of a plane, and derivatives."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from emission_scenes import PLACE, aimed, changes, colours, find, gradients, light, moved, pencils
from scipy.ndimage import gaussian_filter

from mivol.fields.shading import gradient_grid
from scenes import as_float32, box_of, centred, rotation, tensor, transform

pytestmark = pytest.mark.usefixtures("variant_rgb")

SHAPE = (9, 8, 10)
TURNED = as_float32(centred(rotation([1, 2, 1], 0.5) @ np.diag([1.0, 1.4, 0.7])))
"""A box with edges of three lengths, turned."""
EYE = (0.4, -2.0, 3.0)
LIT = {"ambient": 0.25, "diffuse": 0.5, "specular": 0.4, "specular_power": 7.0}


def nodes(place: np.ndarray, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    """Where the voxels of a box are in the world, (Z, Y, X, 3)."""
    z, y, x = np.meshgrid(*[(np.arange(n) + 0.5) / n for n in shape], indexing="ij")
    return np.stack([x, y, z, np.ones(shape)], axis=-1) @ np.asarray(place, np.float64).T[:, :3]


def of_scan(values: np.ndarray, table: str, place: np.ndarray = PLACE, **more: object) -> dict:
    """A scan through a table over values from -20 to 20."""
    given = {"data": tensor(as_float32(values)), "table": table, "domain": "-20, 20", "to_world": transform(place)}
    return {"type": "mivol_transfer", **given, **more}


def shaded(**more: object) -> dict:
    """The settings of a light."""
    return {"shade": True, "eye": list(EYE), **LIT, **more}


def inner(grid: np.ndarray) -> np.ndarray:
    """All but the outermost layers, where differences are one-sided."""
    return grid[1:-1, 1:-1, 1:-1]


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@pytest.mark.parametrize("place", [PLACE, TURNED], ids=["box", "turned"])
def test_normals_of_spheres_are_radial(place: np.ndarray) -> None:
    """Level sets of r^2 are spheres: its gradient 2 (x - c) is exact, since central differences are of a quadratic.

    Rounding: values of at most 4 are stored to 2.4e-7, of which two are divided by two voxels of at least 0.07.
    """
    away = nodes(place) - (0.1, 0.0, -0.2)
    found = np.array(gradient_grid(tensor(as_float32((away**2).sum(-1, keepdims=True))), place))
    assert np.abs(inner(found - 2 * away)).max() < 2 * 2.4e-7 / (2 * 0.07) * 2


def test_differences_are_one_sided_in_the_outermost_layers() -> None:
    """A linear scan has the same gradient everywhere, to rounding (of values of 4, as above), and none along one voxel."""
    slope = np.array([0.5, -1.0, 2.0])
    for shape in (SHAPE, (1, 8, 10)):
        found = np.array(gradient_grid(tensor(as_float32(nodes(PLACE, shape) @ slope)[..., None]), PLACE))
        assert np.abs(found - slope * (1, 1, shape[0] > 1)).max() < 2 * 2.4e-7 / 0.07 * 2


@pytest.mark.parametrize("light_at", [None, (3.0, 1.0, 0.5)], ids=["headlight", "lamp"])
@pytest.mark.parametrize("sign", [1, -1], ids=["inwards", "outwards"])
def test_a_sphere_is_lit_as_levoy_has_it(light_at: tuple | None, sign: int) -> None:
    """k_a c + k_d c |n.l| + k_s |n.h|^m with the sphere's own normal, whichever side is denser."""
    p = nodes(TURNED)
    away = p - (0.1, 0.0, -0.2)
    more = {} if light_at is None else {"light": list(light_at)}
    volume = mi.load_dict(of_scan(sign * (away**2).sum(-1), "0.2 0.4 0.8, 0.2 0.4 0.8", TURNED, **shaded(**more)))
    found = np.array(mi.traverse(volume)["data"])
    n, v = unit(away), unit(np.array(EYE) - p)
    lamp = v if light_at is None else unit(np.array(light_at) - p)
    matte = 0.25 + 0.5 * np.abs((n * lamp).sum(-1))
    expected = matte[..., None] * (0.2, 0.4, 0.8) + 0.4 * np.abs((n * unit(lamp + v)).sum(-1))[..., None] ** 7
    # The gradient errs by 7e-6 (above) where it is 2 |x - c|, at least 0.1 long at a node; a power of 7 has a slope of 7 x 0.4.
    assert np.abs(inner(found - expected)).max() < (0.5 + 7 * 0.4) * 7e-6 / 0.1


def test_without_a_gradient_there_is_ambient_light_alone() -> None:
    """A constant scan has no surfaces, its magnitude the first factor, and its values derivatives that are numbers."""
    more = {"gradient_opacity": "0.5, 1", **shaded()}
    volume = mi.load_dict(of_scan(np.full(SHAPE, 3.0), "0.2 0.4 0.8, 0.2 0.4 0.8", **more))
    params = mi.traverse(volume)
    assert np.allclose(np.array(params["data"]), 0.5 * 0.25 * np.array([0.2, 0.4, 0.8]), rtol=1e-6)
    dr.enable_grad(params["scalar"])
    dr.backward(dr.sum(volume.mivol_transfer.classify().array))
    assert np.isfinite(np.array(dr.grad(params["scalar"]))).all()


def test_opacity_by_the_gradient() -> None:
    """On r^2 the magnitude is 2 r: a table that rises from 0 at 1 to 2 at 3 and is constant beyond."""
    away = nodes(PLACE) - (0.1, 0.0, -0.2)
    steep = {"gradient_opacity": "0, 1, 2", "gradient_domain": "1, 3"}
    found = np.array(mi.traverse(mi.load_dict(of_scan((away**2).sum(-1), "0.5, 0.5", **steep)))["data"])[..., 0]
    magnitude = 2 * np.linalg.norm(away, axis=-1)
    assert inner(magnitude).min() < 1 < inner(magnitude).max()
    assert np.abs(inner(found - 0.5 * np.clip(magnitude - 1, 0, 2))).max() < 1e-5
    whole = np.array(mi.traverse(mi.load_dict(of_scan((away**2).sum(-1), "0.5, 0.5", gradient_opacity="0, 1")))["data"])
    assert whole.max() == pytest.approx(0.5, rel=1e-6)  # the last factor is that of the largest magnitude
    assert np.ptp(inner(whole[..., 0] / magnitude)) < 1e-5


def plane_view(**more: object):
    """Pencils through a scan that is linear in x, of one opacity, before black."""
    values = nodes(PLACE)[..., 0]
    inside = {
        "type": "mivol_medium",
        "sigma_t": of_scan(values, "0.9, 0.9"),
        "emission": of_scan(values, "0.2 0.4 0.8, 0.2 0.4 0.8", **more),
    }
    return pencils({"box": box_of(inside, PLACE), "sky": colours(np.zeros(3))}, *aimed(3, 12))


def test_the_picture_of_a_plane() -> None:
    """Seen by an eye far away all nodes are lit alike: the picture is that without light, times the matte factor, and the
    highlight where matter hides the sky. A camera that moves takes the highlight with it."""
    far = 1e4 * unit(np.array([0.6, 0.0, 0.8]))
    flat, lit = light(plane_view()), plane_view(**shaded(eye=far.tolist()))
    hidden = flat[:, 2:] / 0.8
    # The box is 1e-4 of the distance to the eye, and the factors have a slope of 7 x 0.4 + 0.5 by an angle.
    assert np.abs(light(lit) - (0.25 + 0.5 * 0.6) * flat - 0.4 * 0.6**7 * hidden).max() < 2 * 3.3e-4
    params = mi.traverse(lit.scene)
    params[find(params, "emission.eye")] = mi.Point3f(1e4, 0, 0)
    params.update()
    assert np.abs(light(lit) - 0.75 * flat - 0.4 * hidden).max() < 2 * 3.3e-4
    assert np.array_equal(light(plane_view(**{**shaded(), "shade": False})), flat)


def test_derivatives_of_a_lit_scan() -> None:
    """By the scan's values, which move the normals and the magnitudes, at three nodes a voxel."""
    rough = gaussian_filter(np.random.default_rng(2).normal(size=SHAPE), 1.5)
    values = 10 * rough / rough.std()
    inside = {
        "type": "mivol_medium",
        "sigma_t": of_scan(values, "0.2, 3", refine=3, gradient_opacity="0.5, 1.5"),
        "emission": of_scan(values, "0.9 0.3 0.1, 0.3 0.4 0.9", refine=3, **shaded()),
    }
    seen, rng = pencils({"box": box_of(inside, PLACE), "sky": colours(np.zeros(3))}, *aimed(3, 12)), np.random.default_rng(1)
    w = rng.uniform(size=(12, 3))
    for end in ("sigma_t.scalar", "emission.scalar"):
        along = {end: 0.002 * values[..., None] * rng.uniform(0.2, 1, (*SHAPE, 1))}
        fd, jv = moved(seen.scene, along, lambda: light(seen)), changes(seen, along)
        (g,) = gradients(seen, [end], w)
        assert np.abs(fd).max() > 1e-4
        # As without light (test_transfer.py), where normals turn within a step of 2e-3.
        assert np.abs(jv - fd).max() <= 5e-2 * np.abs(fd).max() + 8e-6, end
        assert abs((g * along[end]).sum() - (jv * w).sum()) <= 1e-5 * np.abs(g * along[end]).sum(), end


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"shade": True}, "was given no eye; give the place of the camera"),
        (shaded(specular=-1.0), "was given specular -1; finite numbers"),
        ({"gradient_opacity": "1"}, "the gradient_opacity of mivol_transfer has the shape"),
        ({"gradient_opacity": "0 0 0, 1 1 1"}, "at least two entries of 1 finite numbers"),
        ({"gradient_opacity": "0, 1", "gradient_domain": "2, 1"}, "the gradient_domain of mivol_transfer is 2, 1"),
        ({"gradient_domain": "2"}, "the gradient_domain of mivol_transfer is 2; two numbers"),
    ],
)
def test_refusals(change: dict, why: str) -> None:
    with pytest.raises(RuntimeError, match=why):
        mi.load_dict(of_scan(nodes(PLACE)[..., 0], "0, 1", **change))


def test_light_is_no_extinction() -> None:
    lit = of_scan(nodes(PLACE)[..., 0], "0, 1", **shaded())
    with pytest.raises(RuntimeError, match="a shaded mivol_transfer as sigma_t; shade what it emits"):
        mi.load_dict({"type": "mivol_medium", "sigma_t": lit})
