"""Emitters of every kind light a medium as in volpath."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scattering_scenes as small
from scattering_scenes import (
    close_up,
    mivol,
    moments,
    rough_grid,
    smoke,
)
from volpath_scenes import (
    EMITTERS,
    same,
)

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.statistical
@pytest.mark.parametrize(
    # Several have a constant sky, a point, a sun and an area among them.
    "name", small.cases(EMITTERS, [name for name in EMITTERS if name not in ("envmap", "several")])
)
def test_emitters(name):
    box, _ = smoke(rough_grid(1), name="hg", g=0.4)
    image, _ = same({"smoke": box, **EMITTERS[name]()}, precision=0.02)
    assert image.mean.min() >= 0


def test_no_emitter_at_all():
    """Nothing shines, nothing is seen: exactly. Nor does anything change it."""
    box, _ = smoke(rough_grid(1))
    scene = close_up({"smoke": box})
    assert not moments(scene, mivol(), 4, 2).mean.any()
    params = mi.traverse(scene)
    key = "smoke.interior_medium.sigma_t.data"
    dr.enable_grad(params[key])
    dr.backward(dr.mean(mi.render(scene, params, integrator=mi.load_dict(mivol()), spp=4), axis=None))
    assert not np.any(dr.grad(params[key]))
