"""Derivatives of expected depth, in one cell and along a ray."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aov_gradients import VALUE, mivol, vjp

from mivol.transport.line_integrals import expected_depth
from mivol.transport.media.compositing import CellIntegral
from scenes import box_of, medium, pencil

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.3, 3.0, 40.0])
def test_derivatives_of_a_cell(size):
    # Central differences of the formula itself: of order h^2 = 1e-8 in the scale on which it bends, and the 5e-10 to which
    # the moments are known, over h.
    rng = np.random.default_rng([6, int(size * 1000)])
    a, dt = rng.uniform(-2, 2, 200), rng.uniform(0.1, 1, 200)
    sigma = size * rng.uniform(0, 1, (3, 200))

    def stop(sigma: np.ndarray) -> CellIntegral:
        return expected_depth.integrate_distance_in_cell(*(mi.Float64(x) for x in (a, dt, *sigma)))

    exact, h = stop(sigma), 1e-4 * (1 + size)
    for q in range(3):
        step = h * np.eye(3)[q][:, None]
        up, down = stop(sigma + step), stop(sigma - step)
        for slope, f in ((exact.dtau[q], "tau"), (exact.dN[q], "N")):
            difference = (np.array(getattr(up, f)) - np.array(getattr(down, f))) / (2 * h)
            assert np.array(slope) == pytest.approx(difference, abs=2e-5 * np.abs(difference).max())


@pytest.mark.parametrize("sigma", [0.7, 4.0])
def test_derivatives_of_a_slab(sigma: float) -> None:
    """The depth behind the entry is 1/s - 1/(e^s - 1): forward and in reverse -1/s^2 + e^s/(e^s - 1)^2."""
    box = box_of(medium("homogeneous", sigma), np.eye(4))
    scene = mi.load_dict({"type": "scene", "box": box, "sensor": pencil([0.3, 0.4, -1], [0, 0, 1])})
    slope = -1 / sigma**2 + np.exp(sigma) / np.expm1(sigma) ** 2
    key, integrator = f"box.{VALUE}", mivol("depth")
    found = vjp(scene, integrator, [key], np.ones((1, 1, 1)), 1)[key]
    # Differences of numbers of size 1, each of some roundings.
    assert found.sum() == pytest.approx(slope, abs=32 * 2.0**-23)
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    dr.set_grad(params[key], 0.5)
    tangent = np.array(integrator.render_forward(scene, params, seed=1, spp=1))
    assert tangent[0, 0, 3] == pytest.approx(0.5 * slope, abs=32 * 2.0**-23)


@pytest.mark.parametrize("sigma", [0.7, 4.0])
def test_derivatives_of_a_slab_before_a_wall(sigma: float) -> None:
    """Entered at 1 and left at 2, with a wall at 3.5: 1 + (1 - e^-s)/s + 1.5 e^-s, since the slab dims what is behind it."""
    place = mi.ScalarTransform4f().translate([0.5, 0.5, 2.5]).scale(2)
    scene = mi.load_dict(
        {
            "type": "scene",
            "box": box_of(medium("homogeneous", sigma), np.eye(4)),
            "wall": {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
            "sensor": pencil([0.3, 0.4, -1], [0, 0, 1]),
        }
    )
    slope = ((1 + sigma) * np.exp(-sigma) - 1) / sigma**2 - 1.5 * np.exp(-sigma)
    key, integrator = f"box.{VALUE}", mivol("depth")
    found = vjp(scene, integrator, [key], np.ones((1, 1, 1)), 1)[key]
    # Differences of numbers of size 3, each of some roundings.
    assert found.sum() == pytest.approx(slope, abs=3 * 32 * 2.0**-23)
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    dr.set_grad(params[key], 0.5)
    tangent = np.array(integrator.render_forward(scene, params, seed=1, spp=1))
    assert tangent[0, 0, 3] == pytest.approx(0.5 * slope, abs=3 * 32 * 2.0**-23)
