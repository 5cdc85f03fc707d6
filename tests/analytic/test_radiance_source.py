"""Baked harmonics of pinholes: derivatives, and convergence to exact directions."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from radiance_rays import TO_WORLD, make, rays_of, see
from sampled_fields import CUBE

from mivol.fields.spherical_grid import SphericalGrid
from mivol.transport.line_integrals.radiance_field import RayGradient, find_occupied_cells, make_model, render_rays, vjp_rays
from mivol.transport.line_integrals.radiance_source import bake, vjp_bake


def test_pinhole_derivatives_are_those_of_what_a_pinhole_sees(variant_rgb: str) -> None:
    """The baked table is linear in the field: a step along the gradient changes the image by its squared norm."""
    density, sh = make(basis=9)
    pinholes = np.array([[3.0, 1, 0.5], [-2.0, 2.5, 1]])
    o = np.repeat(pinholes, 10, axis=0)
    target = np.random.default_rng(0).uniform(0.2, 0.8, (20, 3)) @ TO_WORLD[:3, :3].T + TO_WORLD[:3, 3]
    d = (target - o) / np.linalg.norm(target - o, axis=1, keepdims=True)
    rays, view = rays_of(o, d), mi.UInt32(np.repeat([0, 1], 10))

    def total(field, slope=False):
        cells = find_occupied_cells(field)
        source = bake(field, cells, pinholes, view, slope)
        model = make_model(field)
        seen = render_rays(cells, source, model, rays)
        if slope:
            vjp_rays(cells, source, model, seen, RayGradient(mi.Color3f(1, 0.5, -0.7)))
            return field.with_values(*vjp_bake(field, cells, source, pinholes)).values()
        return float(np.dot(np.array(seen.colour, np.float64).sum(axis=1), [1, 0.5, -0.7]))

    slopes = total(SphericalGrid.from_dense(density, sh, TO_WORLD), True)
    for which in (0, 1):
        move = slopes[which].reshape((density, sh)[which].shape) / np.linalg.norm(slopes[which])
        step = 0.02 if which == 0 else 0.002
        ends = []
        for sign in (-1, 1):
            moved = [density, sh]
            moved[which] = moved[which] + sign * step * move
            ends.append(total(SphericalGrid.from_dense(*moved, TO_WORLD)))
        # Differences lose 1e-6 of the sum of 20 rays over the step, and their own bias is of second order in it.
        expected = np.linalg.norm(slopes[which])
        assert abs((ends[1] - ends[0]) / (2 * step) - expected) <= 5e-3 * expected


@pytest.mark.slow
def test_a_pinhole_table_converges_to_exact_directions(variant_rgb: str) -> None:
    pinhole = np.array([2.5, 1.5, 2.0])
    differences = []
    for n in (8, 16):
        g = (np.arange(n) + 0.5) / n * 2 - 1
        z, y, x = np.meshgrid(g, g, g, indexing="ij")
        sh = np.stack([np.sin(x + b) * np.cos(y - b + c) * 0.3 for b in range(9) for c in range(3)], axis=-1)
        field = SphericalGrid.from_dense(6 * (0.7 - np.sqrt(x * x + y * y + z * z)), sh.reshape(n, n, n, 9, 3), CUBE)
        d = np.random.default_rng(2).uniform(-0.5, 0.5, (200, 3)) - pinhole
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        o = np.broadcast_to(pinhole, d.shape)
        differences.append(np.sqrt(np.mean((see(field, o, d)[0] - see(field, o, d, pinhole=pinhole)[0]) ** 2)))
    # Second order: a quarter, within a third of it; 16^3 is already 60 dB below white.
    assert differences[1] < differences[0] / 3
    assert differences[1] < 1e-3
