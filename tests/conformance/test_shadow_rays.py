"""Shadow rays: surfaces and emitters that transmit part of the light undeviated."""

from __future__ import annotations

import pytest
import scattering_scenes as small
from scattering_scenes import (
    PLACE,
    point,
)
from volpath_scenes import (
    EMITTERS,
    RED,
    area,
    behind_a_mask,
    cube,
    grid_in,
    same,
    square,
)

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("emitter", small.cases(["bulb", "emitter", "sky"], ["emitter", "sky"]))
def test_shadow_rays_go_on_through_what_is_partly_clear(emitter):
    """A mask dims them by its transparency, as volpath does, towards all kinds of emitters."""
    sky = EMITTERS["envmap"]()["emitter"]
    shine = {"bulb": point([1.6, -1.3, 1.7])[0], "emitter": area(1.6, -1.3, 1.7), "sky": sky}[emitter]
    same(behind_a_mask() | {"shine": shine})


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("emitter", small.cases(["bulb", "sky"], ["sky"]))
@pytest.mark.parametrize("kind", small.cases(["transmissive", "boundary"], ["boundary"]))
def test_emitters_that_let_light_pass(kind, emitter):
    """A luminous mask before another emitter, and a boundary that shines itself: what is behind them is seen through them."""
    shine = {"bulb": {"bulb": point([1.6, -1.3, 1.7], 40.0)[0]}, "sky": EMITTERS["envmap"]()}[emitter]
    light = {"emitter": {"type": "area", "radiance": 5.0}}
    if kind == "boundary":
        same({"smoke": grid_in(cube(PLACE)) | light, **shine})
        return
    mask = {"type": "mask", "opacity": 0.4, "nested": {"type": "twosided", "nested": RED}}
    same({"smoke": grid_in(cube(PLACE)), "transmissive": square(0.8, -0.65, 0.85, 0.6) | light | {"bsdf": mask}, **shine})
