"""`mivol_transfer`: scans seen through tables, against dense quadrature of the same model and against differences."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest
from emission_scenes import PLACE, B, aimed, changes, colours, find, gradients, light, moved, pencils, put
from oracle import box_interval, to_lattice, trilinear
from scipy.ndimage import gaussian_filter

from mivol.experiments.script import explain
from scenes import as_float32, box_of, tensor, transform

pytestmark = pytest.mark.usefixtures("variant_rgb")

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
