"""Scans seen through tables, against quadrature and differences; shading of spheres and planes in closed form."""

from __future__ import annotations

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from emission_scenes import PLACE, B, aimed, changes, colours, find, gradients, light, moved, pencils, put
from oracle import box_interval, to_lattice, trilinear
from scipy.ndimage import gaussian_filter

from mivol.experiments.script import explain
from mivol.fields.transfer import gradient_grid
from scenes import as_float32, box_of, centred, rotation, tensor, transform

DOMAIN = (-500.0, 1500.0)
OPACITY = as_float32([0, 0, 0.2, 3, 1, 6])
COLOUR = as_float32([[0, 0, 0], [0.1, 0, 0], [0.9, 0.3, 0.1], [0.2, 0.7, 0.3], [0.3, 0.4, 0.9], [1, 1, 0.9]])


def scan(shape: tuple[int, ...] = (9, 8, 10)) -> np.ndarray:
    """A smooth scalar field with values on both sides of 0, some beyond the table."""
    rough = gaussian_filter(np.random.default_rng(2).normal(size=shape), 1.5)
    return as_float32(500 + 700 * rough / rough.std())


def through(values: np.ndarray, table: np.ndarray, refine: int = 1) -> dict:
    """A scan through a table."""
    rows = ", ".join(" ".join(map(str, row)) for row in np.atleast_2d(table.T).T)
    domain, place = f"{DOMAIN[0]}, {DOMAIN[1]}", transform(PLACE)
    given = {"data": tensor(values), "table": rows, "domain": domain, "refine": refine, "to_world": place}
    return {"type": "mivol_transfer", **given}


def view(values: np.ndarray, refine: int = 1):
    """Pencils through a scan before a background."""
    inside = {"type": "mivol_medium", "sigma_t": through(values, OPACITY, refine), "emission": through(values, COLOUR, refine)}
    return pencils({"box": box_of(inside, PLACE), "sky": colours(B)}, *aimed(3, 12))


def looked_up(table: np.ndarray, s: np.ndarray) -> np.ndarray:
    nodes = np.linspace(*DOMAIN, len(table))
    return np.stack([np.interp(s, nodes, column) for column in np.atleast_2d(table.T)], axis=-1)


def truth(values: np.ndarray, o: np.ndarray, d: np.ndarray, n: int = 20000) -> np.ndarray:
    """The model itself, by midpoints: the scan is linear between its nodes, and looked up at each point."""
    t0, t1 = box_interval(PLACE, o, d)
    t, dt = t0 + (np.arange(n) + 0.5) * (t1 - t0) / n, (t1 - t0) / n
    q, dq = to_lattice(values, PLACE, o, d)
    s = trilinear(values, np.clip(q + t[:, None] * dq, -0.5, np.array(values.shape[::-1]) - 0.5))[:, 0]
    tau = looked_up(OPACITY, s) * dt
    T = np.exp(-np.vstack([np.zeros((1, 1)), np.cumsum(tau, axis=0)]))
    return (T[:-1] * -np.expm1(-tau) * looked_up(COLOUR, s)).sum(0) + T[-1] * B


@pytest.mark.slow
def test_refinement_converges_to_the_model():
    """A table with kinks, of which a voxel passes one or two, classified on grids of 1, 3 and 7 nodes a voxel.

    Second order would divide the error by 9 and by 5.4, once a node's cell has no more than one kink in it.
    """
    values = scan()
    error = []
    for refine in (1, 3, 7):
        seen = view(values, refine)
        exact = np.array([truth(values, *ray) for ray in zip(seen.o, seen.d, strict=True)])
        error.append(np.sqrt(np.mean((light(seen) - exact) ** 2)))
    assert error[1] < 0.3 * error[0] and error[2] < 0.3 * error[1] and error[2] < 4e-3, error


def test_explain_says_what_a_grid_misses_of_its_table():
    """As numpy finds it half-way between the scan's nodes; a finer grid misses less."""
    values = scan()
    ends = [(values.take(range(n - 1), a).ravel(), values.take(range(1, n), a).ravel()) for a, n in enumerate(values.shape)]
    low, high = (np.concatenate(side).astype(np.float64) for side in zip(*ends, strict=True))
    missed = looked_up(OPACITY, (low + high) / 2) - (looked_up(OPACITY, low) + looked_up(OPACITY, high)) / 2
    told = re.findall(r"(\w+) of box differs from its table by (\S+) of", explain(view(values).scene))
    assert [name for name, _ in told] == ["sigma_t", "emission"]
    # Two digits are printed.
    assert float(told[0][1]) == pytest.approx(np.sqrt(np.mean(missed**2)) / OPACITY.max(), rel=0.06)
    finer = [float(v) for v in re.findall(r"by (\S+) of the largest", explain(view(values, 5).scene))]
    assert finer[0] < 0.3 * float(told[0][1]) and "refine = 3 would" in explain(view(values).scene)


def test_a_table_of_nothing_departs_by_nothing():
    volume = mi.load_dict(through(scan(), 0 * OPACITY))
    assert volume.mivol_transfer.interpolation_error() == 0


@pytest.mark.slow
def test_derivatives_by_table_and_scan():
    """Opacity and colour are optimisable, and so are the values that they are of."""
    seen, rng = view(scan(), 3), np.random.default_rng(1)
    params = put(seen.scene, **{"sigma_t.table": OPACITY[:, None] + 0.2, "emission.table": COLOUR + 0.2})
    ends = ("sigma_t.table", "emission.table", "sigma_t.scalar", "emission.scalar")
    sizes = {"table": 0.3, "scalar": 0.0005}
    w = rng.uniform(size=(12, 3))
    for end in ends:
        start = np.array(params[find(params, end)], dtype=np.float64)
        along = {end: sizes[end.split(".")[1]] * start * rng.uniform(0.2, 1, start.shape)}
        fd = moved(seen.scene, along, lambda: light(seen))
        jv = changes(seen, along)
        (g,) = gradients(seen, [end], w)
        assert np.abs(fd).max() > 1e-4
        # Values that pass a kink of the table within a step: few, of a step of 5e-5 of their size.
        allowed = 1e-4 if "table" in end else 5e-2
        # Rounding: 1.5 x 2e-7 of an image of size 1, over the step of 0.05.
        assert np.abs(jv - fd).max() <= allowed * np.abs(fd).max() + 8e-6, end
        assert abs((g * along[end]).sum() - (jv * w).sum()) <= 1e-5 * np.abs(g * along[end]).sum(), end


def test_the_update_of_a_table():
    """A new table is looked up at once; the keys are there."""
    values = scan()
    seen = view(values)
    params = mi.traverse(seen.scene)
    assert {k.rsplit(".", 1)[1] for k, _ in params if "sigma_t" in k} == {"table", "scalar", "data"}
    params[find(params, "sigma_t.table")] = mi.TensorXf(np.zeros((6, 1), np.float32))
    params.update()
    assert np.abs(light(seen) - B).max() <= 1e-6


def test_constant_scan_is_a_homogeneous_medium():
    """Every node has one value, between two entries."""
    seen = view(np.full((4, 5, 6), 300.0))
    sigma, colour = looked_up(OPACITY, np.array([300.0]))[0], looked_up(COLOUR, np.array([300.0]))[0]
    length = np.array([np.diff(box_interval(PLACE, *ray))[0] for ray in zip(seen.o, seen.d, strict=True)])[:, None]
    T = np.exp(-sigma * length)
    assert np.abs(light(seen) - colour * (1 - T) - B * T).max() <= 4e-6


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"table": "0, 1 2 3"}, "rows of numbers"),
        ({"table": "nothing"}, "rows of numbers"),
        ({"table": "1"}, "at least two entries"),
        ({"table": "0, -1"}, "not negative"),
        ({"table": "0 1, 1 2"}, "1 or 3 finite numbers"),
        ({"domain": "3, 3"}, "rising order"),
        ({"domain": "3"}, "MivolError: the domain of mivol_transfer is 3; two numbers"),
        ({"refine": 0}, "at least 1"),
        ({"refine": 2.5}, "refine of mivol_transfer is 2.5; a whole number"),
        ({"data": np.full((3, 3, 3), np.nan)}, r"finite numbers are expected"),
        ({"data": np.ones((3, 3, 3, 3))}, r"\(Z, Y, X, 1\)"),
    ],
)
def test_refusals(change, why):
    given = through(scan(), OPACITY) | change
    if "data" in change:
        given["data"] = tensor(change["data"])
    with pytest.raises(RuntimeError, match=why):
        mi.load_dict(given)


def test_a_table_that_became_negative_is_refused():
    seen = view(scan())
    params = mi.traverse(seen.scene)
    params[find(params, "sigma_t.table")] = mi.TensorXf(np.full((6, 1), -1.0, np.float32))
    with pytest.raises(Exception, match="clip them after each step"):
        params.update()


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
        (shaded(diffuse=np.inf), "was given diffuse inf; finite numbers"),
        ({"gradient_opacity": "1"}, "the gradient_opacity of mivol_transfer has the shape"),
        ({"gradient_opacity": "0 0 0, 1 1 1"}, "at least two entries of 1 finite numbers"),
        ({"gradient_opacity": "0, 1", "gradient_domain": "2, 1"}, "the gradient_domain of mivol_transfer is 2, 1"),
        ({"gradient_domain": "2"}, "the gradient_domain of mivol_transfer is 2; two numbers"),
    ],
)
def test_refusals_of_shading(change: dict, why: str) -> None:
    with pytest.raises(RuntimeError, match=why):
        mi.load_dict(of_scan(nodes(PLACE)[..., 0], "0, 1", **change))


def test_light_is_no_extinction() -> None:
    lit = of_scan(nodes(PLACE)[..., 0], "0, 1", **shaded())
    with pytest.raises(RuntimeError, match="a shaded mivol_transfer as sigma_t; shade what it emits"):
        mi.load_dict({"type": "mivol_medium", "sigma_t": lit})
