"""Domains of the parameters of phase functions: refusals and projections."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.phase.domain import ASYMMETRY, NEXT_TO_ONE, WEIGHT

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.parametrize("bad", [1.0, -1.0, 0.99999999, 2.0, np.nan, np.inf])
def test_asymmetry_outside_is_refused(bad):
    with pytest.raises(MivolError, match="above -1 and below 1"):
        ASYMMETRY.check(np.array([bad]), "g")
    with pytest.raises(MivolError, match=r"g is .* at 1;"):
        ASYMMETRY.check(np.array([0.0, bad]), "g")


def test_projection_to_the_nearest_allowed_value():
    x = mi.Float(-3, -NEXT_TO_ONE, 0, 0.5, 1, np.inf)
    assert list(ASYMMETRY.project(x)) == [-NEXT_TO_ONE, -NEXT_TO_ONE, 0, 0.5, NEXT_TO_ONE, NEXT_TO_ONE]
    assert list(WEIGHT.project(mi.Float(-1, 0, 5))) == [0, 0, 5]
    x = mi.Float(0, 2, -2)
    dr.enable_grad(x)
    dr.backward(ASYMMETRY.project(x) + WEIGHT.project(x))
    assert list(dr.grad(x)) == [2, 1, 0]  # on a bound the derivative is that of the parameter; outside it is 0
