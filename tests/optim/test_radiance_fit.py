"""A fit of a radiance field by hand, a step at a time."""

from __future__ import annotations

import numpy as np
import pytest
from ball_photos import BOX, PLAN

from mivol.optim.photographs.radiance_problem import begin_radiance_fit, current_field
from mivol.optim.photographs.ray_batches import RayBatches
from mivol.photos import Photo


@pytest.mark.slow
def test_the_field_is_that_of_the_newest_step(variant_rgb: str, photos: list[Photo]) -> None:
    fit = begin_radiance_fit(RayBatches.from_photos(photos[:4], (1, 2)), BOX, PLAN)
    before = np.array(current_field(fit).density)
    for _ in range(2):
        fit.advance()
        found = current_field(fit)
        assert np.array_equal(found.density, fit.run.reals["density"].array)
        assert not np.array_equal(found.density, before)
        before = np.array(found.density)
