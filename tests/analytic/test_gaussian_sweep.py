"""The light and the optical depth of Gaussians over intervals of rays, against the float64 twin that sorts them all."""

from __future__ import annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from gaussian_sets import random_gaussians

from mivol.fields.gaussians import GaussianField
from mivol.points.gaussians import Gaussians
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.media.gaussian_sweep import GaussianSweep

pytestmark = pytest.mark.usefixtures("variant_rgb")

RAYS, ROUNDING = 64, 1e-4
"""ROUNDING as in tests/conformance/test_gaussian_radiance.py."""


def cloud() -> Gaussians:
    found = random_gaussians(60, 2)
    found.means[:] *= 0.5
    found.log_scales[:] += 1.5
    return found


def sweep(gaussians: Gaussians, ends: tuple[np.ndarray, np.ndarray], scale: float, shows: bool, rows: int = 3) -> tuple:
    """Rays (o, d), and what is summed along them: N (rows, RAYS) and tau (RAYS,)."""
    rng = np.random.default_rng(1)
    o = rng.normal(size=(RAYS, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.3, 0.3, (RAYS, 3)) - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = (v.astype(np.float32).astype(np.float64) for v in (o, d))
    part = GaussianExtinction("sigma_t", GaussianField.of(gaussians, np.eye(4)), mi.Float(scale), shows)
    body = SimpleNamespace(view=SimpleNamespace(gaussians=part, scale=mi.Float(scale)), tangents=[])
    ray = mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    t0, t1 = (mi.Float64(t) for t in ends)
    interval = SimpleNamespace(ray=ray, t0=t0, t1=t1, active=dr.full(mi.Bool, True, RAYS), body=body)
    integral = GaussianSweep(interval, rows).integrate(False)
    return (o, d), np.array([np.array(row) for row in integral.N]), np.array(integral.tau[0])


@pytest.mark.parametrize("span", [(0.0, np.inf), (2.5, 3.3), (3.0, np.inf)])
@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_light_over_an_interval_is_that_of_the_twin(span: tuple[float, float], scale: float) -> None:
    gaussians, ends = cloud(), tuple(np.full(RAYS, t) for t in span)
    rays, N, tau = sweep(gaussians, ends, scale, shows=True)
    colour = oracle.colours(gaussians.harmonics.astype(np.float64), rays[1], "srgb")
    light, T = oracle.composite(oracle.Cloud.of(gaussians), colour, rays, ends, scale=scale)
    assert light.max() > 0.1
    np.testing.assert_allclose(N.T, light, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(np.exp(-tau), T, atol=ROUNDING)


def test_gaussians_that_are_not_shown_only_dim() -> None:
    ends = np.zeros(RAYS), np.full(RAYS, np.inf)
    rays, N, tau = sweep(cloud(), ends, 1.0, shows=False)
    assert not N.any()
    truth = oracle.optical_depth(oracle.Cloud.of(cloud()), *rays, *ends)
    np.testing.assert_allclose(tau, truth, rtol=ROUNDING, atol=ROUNDING)


def test_one_row_is_their_luminance() -> None:
    """As in mono variants: ITU-R BT.709."""
    ends = np.zeros(RAYS), np.full(RAYS, np.inf)
    _, rgb, _ = sweep(cloud(), ends, 1.0, shows=True)
    _, grey, _ = sweep(cloud(), ends, 1.0, shows=True, rows=1)
    np.testing.assert_allclose(grey[0], [0.212671, 0.715160, 0.072169] @ rgb, rtol=1e-5, atol=1e-6)
