"""What a plan brings along for the walk: lists of empty blocks where they are skipped, ranges of blocks where paths fly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scattering_scenes import close_up, smoke

from mivol.scene.needs import find_needs
from mivol.scene.plan import build_media, make_plan
from mivol.scene.survey import survey_scene
from mivol.transport.path.estimators import Settings
from scenes import sky

pytestmark = pytest.mark.usefixtures("variant_rgb")


CASES = [(False, False, 2), (True, False, 2), (False, True, 2), (False, False, 4)]


@pytest.mark.parametrize(("skips", "tracks", "depth"), CASES)
def test_a_grid_has_what_the_plan_asks_for(skips: bool, tracks: bool, depth: int) -> None:
    """Nothing is read from the grid that no estimator will ask for."""
    values = np.zeros((8, 8, 8, 1), np.float32)
    values[2:4, 2:4, 2:4] = 1
    scene = close_up({"smoke": smoke(values)[0], "sky": sky()})
    survey, settings = survey_scene(scene), Settings(max_depth=depth)
    needs = find_needs(scene, scene.sensors()[0], survey)
    plan = make_plan(needs, settings)
    assert (plan.segment == "free_flight") == (depth == 4)
    media = build_media(scene, needs, replace(plan, skips=(skips,), tracks=(tracks,)), survey)
    ((part,),) = [body.view.parts for body in media.bodies]
    assert (part.lattice.empty_distances is not None) == skips
    assert (part.lattice.block_ranges is not None) == (tracks or depth == 4)
    assert media.bodies[0].estimates_shadows == tracks
    assert not media.has_surfaces
