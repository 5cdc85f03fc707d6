"""What an integrator is asked beside the picture: when it is computed, whether it is developed, and what it is called."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from scenes import pencil, refused, sky

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_a_picture_is_computed_at_once_or_when_it_is_looked_at():
    """Mitsuba's ``evaluate``; the numbers are the same."""
    scene = mi.load_dict({"type": "scene", "sky": sky(0.5), "sensor": pencil((0, 0, 0), (0, 0, 1))})
    integrator = mi.load_dict({"type": "mivol"})
    now, later = (integrator.render(scene, spp=1, evaluate=asked) for asked in (True, False))
    assert now.array.state == dr.VarState.Evaluated and later.array.state == dr.VarState.Unevaluated
    np.testing.assert_array_equal(np.array(now), np.full((1, 1, 3), 0.5))
    np.testing.assert_array_equal(np.array(later), np.array(now))


def test_pictures_are_developed():
    scene = mi.load_dict({"type": "scene", "sensor": pencil((0, 0, 0), (0, 0, 1))})
    with refused("develop=False was asked for"):
        mi.load_dict({"type": "mivol"}).render(scene, spp=1, develop=False)


def test_an_integrator_prints_its_depths_and_aovs():
    integrator = mi.load_dict({"type": "mivol", "max_depth": 3, "rr_depth": 4, "aovs": "tau, depth"})
    assert "mivol[max_depth=3, rr_depth=4, aovs=tau,depth]" in str(integrator)
