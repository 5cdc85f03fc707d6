"""Segments that only absorb, and light and transmittance that share a walk of the cells."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.scores import IMAGE
from mivol.transport.estimators.segment import (
    Absorption,
    AbsorptionToLamps,
    PathSegment,
    SegmentLight,
    SegmentTransmittance,
)
from scenes import box_of, camera, centred, media_of, medium

KEY = "box.interior_medium.sigma_t.value.value"


class Recorder:
    """A shared segment and an estimator, recording the calls they receive."""

    def __init__(self) -> None:
        self.said, self.dL = [], None

    def vjp_light(self, dL: object) -> None:
        self.said.append(("vjp_light", dL, self.dL))

    def vjp(self, dlog: object) -> None:
        self.said.append(("vjp", dlog, self.dL))

    def jvp_light(self) -> str:
        return "tangent of the light"

    def jvp_transmittance(self) -> str:
        return "tangent of log T"

    def draw(self, *asked: object) -> str:
        self.said.append(asked)
        return "samples"


def test_light_and_transmittance_tell_the_segment_that_they_share():
    """The light is reported first, so its weight is known when the transmittance starts the walk."""
    shared = Recorder()
    light, T = SegmentLight(shared, mi.Spectrum(1), True), SegmentTransmittance(shared)
    light.vjp("dL")
    T.vjp("dlog")
    assert shared.said == [("vjp_light", "dL", "dL"), ("vjp", "dlog", "dL")]
    assert (light.jvp(), T.jvp()) == ("tangent of the light", "tangent of log T")


def test_absorption_draws_for_the_estimator_whose_path_it_follows():
    """Absorption draws the numbers of the other estimator, and returns none."""
    other = Recorder()
    absorption = Absorption(None, other)
    assert absorption.draw("sampler", "active") is None and other.said == [("sampler", "active")]
    assert Absorption(None).draw("sampler", "active") is None
    assert absorption.replayed() is absorption


def test_media_are_walked_in_front_of_lamps_only():
    """A lamp, a wall, a mask that lets half of the light pass, and nothing, each behind a quarter of a box: T = exp(-0.5) in
    front of the lamp and of the mask. The ends are those of a walk."""
    place = mi.ScalarTransform4f().translate([0, 0, 2]).rotate([0, 1, 0], 180)
    mask = {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}
    kinds = {"lamp": {"emitter": {"type": "area"}}, "wall": {"bsdf": {"type": "diffuse"}}, "mask": {"bsdf": mask}}
    x = np.float32([-0.375, -0.125, 0.125, 0.375])
    squares = {
        name: {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([float(a), 0, 0]) @ place.scale(0.1), **more}
        for a, (name, more) in zip(x, kinds.items(), strict=False)
    }
    box = box_of(medium("mivol_medium", 0.5), centred(np.eye(3)))
    media = media_of(mi.load_dict({"type": "scene", "box": box, "sensor": camera([0, -4, 0], [0, 0, 0]), **squares}))
    ray = mi.Ray3f(mi.Point3f(mi.Float(x), 0, -3), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    segment = PathSegment(ray, dr.zeros(mi.MediumPtr, 4), mi.Spectrum(1), mi.Bool(True), None, mi.UInt32(0))
    with dr.suspend_grad():
        walked, found = (kind(media).estimate(segment, IMAGE, mi.Bool(True)) for kind in (Absorption, AbsorptionToLamps))
    np.testing.assert_allclose(np.array(found.T)[0], np.exp([-0.5, 0, -0.5, 0]), rtol=4 * 2.0**-23)
    np.testing.assert_array_equal(np.array(found.end.t), np.array(walked.end.t))
    assert np.array(found.end.si.is_valid()).tolist() == [True, True, True, False]


def test_absorption_is_beers_law_with_its_derivatives():
    """T = exp(-sigma), over a length of 1 in a box; d log T / d sigma = -1 in each colour."""
    box = box_of(medium("mivol_medium", 0.5), centred(np.eye(3)))
    scene = mi.load_dict({"type": "scene", "box": box, "sensor": camera([0, -4, 0], [0, 0, 0])})
    params = mi.traverse(scene)
    dr.enable_grad(params[KEY])
    dr.set_grad(params[KEY], 0.25)
    media = media_of(scene)
    ray = mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1), dr.inf, mi.Float(0), mi.Color0f())
    segment = PathSegment(ray, mi.MediumPtr(None), mi.Spectrum(1), mi.Bool(True), None, mi.UInt32(0))
    media.start_tangent()
    with dr.suspend_grad():
        found = Absorption(media).estimate(segment, IMAGE, mi.Bool(True))
        tangent = found.transmittance.jvp()
    rounding = 4 * 2.0**-23
    assert found.light is None and not found.end.si.is_valid()[0]
    np.testing.assert_allclose(np.array(found.T).ravel(), [np.exp(-0.5)] * 3, rtol=rounding)
    np.testing.assert_allclose(np.array(tangent).ravel(), [-0.25] * 3, rtol=rounding)
    dr.set_grad(params[KEY], 0)
    with dr.suspend_grad():
        media.start_gradients()
        found.transmittance.vjp(mi.Spectrum(1, 2, 4))
    media.deliver_gradients()
    assert dr.grad(params[KEY])[0] == pytest.approx(-7, rel=rounding)
