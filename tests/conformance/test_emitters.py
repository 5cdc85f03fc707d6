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

from mivol.transport.estimators.lighting.emitters import SceneEmitters

pytestmark = pytest.mark.usefixtures("variant_rgb")


@pytest.mark.slow_for("envmap", "several")
@pytest.mark.statistical
@pytest.mark.parametrize(
    # Several have a constant sky, a point, a sun and an area among them.
    "name",
    small.cases(EMITTERS, [name for name in EMITTERS if name not in ("envmap", "several")]),
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


def test_what_is_sampled_and_what_is_seen_through() -> None:
    """A constant sky is hit by chance; a masked panel transmits, an opaque one is hit by directions of the phase function."""
    panel = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1.0}}
    masked = {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}
    sun = {"type": "directional", "direction": [0, 0, -1]}
    near = {"type": "point", "position": [0, 1, 2]}
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "a": panel, "b": {**panel, "bsdf": masked}, "sun": sun})
    found = SceneEmitters(scene)
    assert sorted(e.class_name() for e in found.sampled) == ["AreaLight", "AreaLight", "DirectionalEmitter"]
    (seen_through,) = found.transmissive
    assert seen_through is scene.shapes()[1].emitter() or seen_through is scene.shapes()[0].emitter()
    assert mi.has_flag(seen_through.get_shape().bsdf().flags(), mi.BSDFFlags.Null)
    assert found.samples_phase and found.is_near
    assert sum(found.bounding_ball(k) is None for k in range(3)) == 1
    for emitter, at_hand in ((sun, False), (near, True), ({**panel, "bsdf": masked}, True)):
        found = SceneEmitters(mi.load_dict({"type": "scene", "only": emitter}))
        assert not found.samples_phase and found.is_near == at_hand
